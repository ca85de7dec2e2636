"""Base motion: the sheath's exit moves or turns, and all poses with it."""

from __future__ import annotations

import numpy as np

from host.diagnosis.effect import Array, Context, Effect, Parameter, Scale


def drift(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Velocity of the exit along the base axes, and turning rates."""
    return tuple(Parameter(f"rate_{a}", "m/s", (1e-3 / s.duration_s,), linear=True) for a in "xyz")


def beat(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Amplitudes of sine and cosine along the base axes, and frequency."""
    pairs = tuple(Parameter(f"{part}_{a}", "m", (1e-3,), linear=True) for a in "xyz" for part in ("sine", "cosine"))
    top = min(0.2 / s.dt_s, 4.0)
    lines = tuple(np.arange(2.0 / s.duration_s, top, 0.5 / s.duration_s))
    return (*pairs, Parameter("frequency", "Hz", lines, 0.5 / s.duration_s, 0.45 / s.dt_s, step=0.1 / s.duration_s))


def jump(s: Scale, form: str) -> tuple[Parameter, ...]:
    """A displacement and a turn at one instant."""
    instants = tuple(np.linspace(0.04, 0.96, 24) * s.duration_s)
    return (
        *(Parameter(f"displacement_{a}", "m", (1e-3,), linear=True) for a in "xyz"),
        *(Parameter(f"turn_{a}", "rad", (0.02,), -1.0, 1.0, step=0.02, linear=True) for a in "xyz"),
        Parameter("instant", "s", instants, 0.0, s.duration_s, step=0.005 * s.duration_s),
    )


def tilt(s: Scale, form: str) -> tuple[Parameter, ...]:
    """A constant displacement and turn against the calibrated place."""
    return (
        *(Parameter(f"displacement_{a}", "m", (1e-3,), linear=True) for a in "xy"),
        *(Parameter(f"turn_{a}", "rad", (0.02,), -1.0, 1.0, step=0.02, linear=True) for a in "xy"),
    )


def _turned(turn: Array, when: Array) -> Array:
    """Rotations (3, 3, n) by the small vector `turn` times `when`."""
    K = np.array([[0.0, -turn[2], turn[1]], [turn[2], 0.0, -turn[0]], [-turn[1], turn[0], 0.0]])
    return np.asarray(np.eye(3)[:, :, None] + K[:, :, None] * when + 0.5 * (K @ K)[:, :, None] * when**2)


def apply(state: dict, c: Context, p: Array, form: str) -> dict:
    """Adds a displacement over time, and a turn."""
    t = c.time_s
    if form == "drift":
        return {**state, "shift": state["shift"] + p[:, None] * t}
    if form == "beat":
        phase = 2.0 * np.pi * p[6] * t
        return {**state, "shift": state["shift"] + np.outer(p[0:6:2], np.sin(phase)) + np.outer(p[1:6:2], np.cos(phase))}
    when = np.clip((t - p[6]) / c.dt_s + 0.5, 0.0, 1.0) if form == "jump" else np.ones(t.size)
    place = p[:3] if form == "jump" else np.array([p[0], p[1], 0.0])
    turn = p[3:6] if form == "jump" else np.array([p[2], p[3], 0.0])
    return {**state, "shift": state["shift"] + np.outer(place, when), "turn": _turned(turn, when)}


SAYS = "The sheath's exit moves: all poses move with it."
EFFECTS = (
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
    Effect("base_motion", "base", 53, tilt, SAYS, "x = R (x + displacement)", apply, forms=("constant",)),
)
