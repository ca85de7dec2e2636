"""Base motion: the sheath's exit moves or turns, and all poses with it."""

from __future__ import annotations

import numpy as np

from host.diagnosis.effects.periodic_disturbance import PHASE, oscillation
from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale, lines


def drift(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Velocity of the exit along the base axes, and turning rates."""
    return tuple(Parameter(f"rate_{a}", "m/s", (1e-3 / s.duration_s,), linear=True) for a in "xyz")


def beat(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Amplitudes of sine and cosine along the base axes, and frequency."""
    pairs = tuple(Parameter(f"{part}_{a}", "m", (1e-3,), linear=True) for a in "xyz" for part in ("sine", "cosine"))
    top = min(0.2 / s.dt_s, 4.0)
    grid = lines(s, 2.0 / s.duration_s, top, 0.5)
    step = 0.1 / s.duration_s
    return (*pairs, Parameter("frequency", "Hz", grid, 0.5 / s.duration_s, 0.45 / s.dt_s, spectral=True, step=step))


def line(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Amplitudes along the base axes of a motion on one line, its phase and frequency."""
    amplitudes = (Parameter(f"amplitude_{a}", "m", (2e-5,), linear=True) for a in "xyz")
    return (*amplitudes, PHASE, beat(s, form)[-1])


def rock(s: Scale, form: str) -> tuple[Parameter, ...]:
    """As `beat`, with amplitudes of turning about the base axes."""
    *shift, frequency = beat(s, form)
    turns = (
        Parameter(f"turn_{part}_{a}", "rad", (0.01,), -1.0, 1.0, step=0.01, linear=True)
        for a in "xyz"
        for part in ("sine", "cosine")
    )
    return (*shift, *turns, frequency)


def jump(s: Scale, form: str) -> tuple[Parameter, ...]:
    """A displacement and a turn at one instant, or over some time from it on."""
    count = 12 if form == "shift" else 24
    instants = tuple(np.linspace(0.0 if form == "shift" else 0.04, 0.96, count) * s.duration_s)
    rise = (Parameter("rise", "s", (0.01 * s.duration_s, 0.05 * s.duration_s), 2.0 * s.dt_s, 0.3 * s.duration_s, log=True),)
    return (
        *(Parameter(f"displacement_{a}", "m", (1e-3,), linear=True) for a in "xyz"),
        *(Parameter(f"turn_{a}", "rad", (0.02,), -1.0, 1.0, step=0.02, linear=True) for a in "xyz"),
        Parameter("instant", "s", instants, 0.0, s.duration_s, step=0.005 * s.duration_s),
        *(rise if form == "shift" else ()),
    )


def tilt(s: Scale, form: str) -> tuple[Parameter, ...]:
    """A constant displacement and turn against the calibrated place."""
    return (
        *(Parameter(f"displacement_{a}", "m", (1e-3,), linear=True) for a in "xy"),
        *(Parameter(f"turn_{a}", "rad", (0.02,), -1.0, 1.0, step=0.02, linear=True) for a in "xy"),
    )


def turned(turn: Array) -> Array:
    """Rotations (3, 3, n) by small vectors `turn` (3, n)."""
    zero = np.zeros(turn.shape[1])
    K = np.array([[zero, -turn[2], turn[1]], [turn[2], zero, -turn[0]], [-turn[1], turn[0], zero]])
    return np.asarray(np.eye(3)[:, :, None] + K + 0.5 * np.einsum("abn,bcn->acn", K, K))


def _waves(p: Array, phase: Array) -> Array:
    """Three sums of sine and cosine (3, n), amplitudes in pairs."""
    return np.outer(p[0:6:2], np.sin(phase)) + np.outer(p[1:6:2], np.cos(phase))


def apply(state: dict, c: Context, p: Array, form: str) -> dict:
    """Adds a displacement over time, and a turn."""
    t = c.time_s
    if form == "drift":
        return {**state, "shift": state["shift"] + p[:, None] * t}
    if form == "line":
        return {**state, "shift": state["shift"] + oscillation(c, p, form)}
    if form in ("beat", "rock"):
        phase = 2.0 * np.pi * p[-1] * t
        moved = {**state, "shift": state["shift"] + _waves(p[:6], phase)}
        return moved if form == "beat" else {**moved, "turn": turned(_waves(p[6:12], phase))}
    if form == "constant":
        when = np.ones(t.size)
    elif form == "shift":
        when = 1.0 - np.exp(-np.maximum(t - p[6], 0.0) / p[7])
    else:
        when = c.after(p[6])
    place = np.array([p[0], p[1], 0.0]) if form == "constant" else p[:3]
    turn = np.array([p[2], p[3], 0.0]) if form == "constant" else p[3:6]
    return {**state, "shift": state["shift"] + np.outer(place, when), "turn": turned(np.outer(turn, when))}


SAYS = "The sheath's exit moves: all poses move with it."
EFFECTS = (
    Effect(
        "base_motion",
        "base",
        56,
        line,
        "The sheath's exit moves to and fro on a line at {frequency}: all poses move with it.",
        "x = x + amplitude*sin(2 pi f t + phase)",
        apply,
        timed=True,
        forms=("line",),
    ),
    Effect(
        "base_motion",
        "base",
        50,
        beat,
        SAYS,
        "x = x + sine*sin(2 pi f t) + cosine*cos(2 pi f t)",
        apply,
        timed=True,
        forms=("beat",),
    ),
    Effect("base_motion", "base", 51, drift, SAYS, "x = x + rate*t", apply, timed=True, forms=("drift",)),
    Effect(
        "base_motion",
        "base",
        52,
        jump,
        SAYS,
        "x = R (x + displacement) after the instant",
        apply,
        timed=True,
        forms=("jump",),
    ),
    Effect(
        "base_motion",
        "base",
        54,
        jump,
        "The sheath's exit moves, from {instant} on and within about {rise}: all poses move with it.",
        "x = R (x + displacement*w), turn*w,  w = 1 - exp(-(t - instant)/rise)",
        apply,
        timed=True,
        forms=("shift",),
    ),
    Effect(
        "base_motion",
        "base",
        55,
        rock,
        "The sheath's exit moves and turns to and fro at {frequency}: all poses move with it.",
        "x = R (x + sine*sin(2 pi f t) + cosine*cos(2 pi f t)), turning likewise",
        apply,
        timed=True,
        forms=("rock",),
    ),
    Effect("base_motion", "base", 53, tilt, SAYS, "x = R (x + displacement)", apply, forms=("constant",)),
)
