"""Periodic disturbance: beat, respiration (over time) or lead-screw period (over place)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from host.diagnosis.model.effect import Array, Context, Effect, Evidence, Parameter, Scale, lines, spread
from host.diagnosis.model.spectral_line import common_line

LEAST_PERIODS = 1.0  # in a recording: less of a sine cannot be separated from an offset, a ramp and a bend (Rayleigh)
PERIODS = 2.0 / 3.0  # pitch against the span beyond which a bend is not a period: crest and trough have to come back
# Pitch of an angle beyond which it is once a turn, which is whip: midway to twice a turn, as of a universal joint.
LONGEST_ANGLE = float(np.sqrt(2.0) * np.pi)
PHASE = Parameter("phase", "rad", (0.0, np.pi / 3.0, 2.0 * np.pi / 3.0), -np.pi, 2.0 * np.pi, step=0.1)


def frequency(s: Scale, highest_Hz: float) -> Parameter:
    """The frequency (Hz) of a sine over time, tried up to `highest_Hz`."""
    tried = lines(s, 2.0 / s.duration_s, min(0.2 / s.dt_s, highest_Hz), 0.4)
    least, most, step = LEAST_PERIODS / s.duration_s, 0.45 / s.dt_s, 0.1 / s.duration_s
    return Parameter("frequency", "Hz", tried, least, most, step=step, spectral=True)


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Amplitudes of sine and cosine, and frequency or pitch."""
    pair = (Parameter("sine", s.unit, (s.need,), linear=True), Parameter("cosine", s.unit, (s.need,), linear=True))
    if form == "place":
        longest = PERIODS * s.motion_span
        if (s.motion_unit or s.unit) == "rad":
            longest = min(longest, LONGEST_ANGLE)
        return (
            *pair,
            Parameter(
                "pitch",
                s.motion_unit or s.unit,
                spread(s.motion_span / 40.0, 0.9 * longest, 54),
                s.motion_span / 200.0,
                longest,
                log=True,
                step=3e-3,
            ),
        )
    return (*pair, frequency(s, 8.0))


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Adds a sine over time or over place."""
    phase = 2.0 * np.pi * (c.motion / p[2] if form == "place" else c.time_s * p[2])
    return np.asarray(signal + p[0] * np.sin(phase) + p[1] * np.cos(phase))


def slots(p: Array, form: str) -> dict[str, float]:
    """A sine over time or over place, as a force."""
    return {"sine": p[0], "cosine": p[1], ("pitch" if form == "place" else "frequency"): p[2]}


def of_a_line(s: Scale, form: str) -> tuple[Parameter, ...]:
    """The frequency; amplitude and phase are those of each recording."""
    return (Parameter("frequency", "Hz", (LEAST_PERIODS / s.duration_s,), LEAST_PERIODS / s.duration_s, 0.5 / s.dt_s),)


def on_the_line(evidence: Evidence, parameters: tuple[Parameter, ...], form: str) -> tuple[Parameter, ...]:
    """The frequency of a line that stands out of the residual of every recording; no parameter where none does, or where
    a law may have made it from another signal, recorded or simulated.
    """
    count = len(evidence.need)
    periods = [float(np.median(np.diff(time_s))) if time_s.size > 1 else 1.0 for time_s in evidence.time_s]
    laid = [_on_grid(t, x, dt) for t, x, dt in zip(evidence.time_s, evidence.need, periods, strict=True)]
    outputs = len(evidence.readings) // max(count, 1)
    known = [
        [*others, *(one.course for one in evidence.readings[k * outputs : (k + 1) * outputs])]
        for k, others in enumerate(evidence.others or [()] * count)
    ]
    line = common_line(laid, known, [np.zeros(x.size) for x in laid], periods)
    (p,) = parameters
    return () if line is None else (replace(p, grid=(min(max(line.frequency_Hz, p.low), p.high),)),)


def _on_grid(time_s: Array, values: Array, dt_s: float) -> Array:
    """`values` (n,) at even steps, NaN in the gaps."""
    place = np.round((time_s - time_s[0]) / dt_s).astype(int)
    out = np.full(place[-1] + 1, np.nan)
    out[place] = values
    return out


def apply_line(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Adds a sine over time, of the recording's own amplitudes of cosine and sine at its middle.

    There they do not depend on the frequency, to first order. Fits of both in turns end at once.
    """
    phase = 2.0 * np.pi * p[0] * (c.time_s - 0.5 * (c.time_s[0] + c.time_s[-1]))
    return np.asarray(signal + c.starts[0] * np.cos(phase) + c.starts[1] * np.sin(phase))


SAYS = "A periodic disturbance is added to the signal."


def wall(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Motion of the wall along its normal."""
    return (
        Parameter("sine", "m", (3e-4,), linear=True),
        Parameter("cosine", "m", (3e-4,), linear=True),
        frequency(s, 5.0),
    )


def apply_wall(law: dict, c: Context, p: Array, form: str) -> dict:
    """The wall moves to and fro."""
    phase = 2.0 * np.pi * p[2] * c.time_s
    return {**law, "gap": law["gap"] + p[0] * np.sin(phase) + p[1] * np.cos(phase)}


def reading(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Amplitudes of sine and cosine along the base axes, and frequency."""
    pairs = tuple(Parameter(f"{part}_{a}", s.unit, (s.need,), linear=True) for a in "xyz" for part in ("sine", "cosine"))
    return (
        *pairs,
        frequency(s, 5.0),
    )


def reading_on_a_line(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Amplitudes along the base axes of an oscillation with one phase, the phase and the frequency.

    A base that oscillates on a line has as many parameters: neither of the two is preferred for having fewer.
    """
    return (*(Parameter(f"amplitude_{a}", s.unit, (s.need,), linear=True) for a in "xyz"), PHASE, frequency(s, 5.0))


def oscillation(c: Context, p: Array, form: str) -> Array:
    """Three sums of sine and cosine (3, n), amplitudes in pairs; form `line`: three amplitudes of one sine with a phase."""
    phase = 2.0 * np.pi * p[-1] * c.time_s
    if form == "line":
        return np.outer(p[:3], np.sin(phase + p[3]))
    return np.outer(p[0:6:2], np.sin(phase)) + np.outer(p[1:6:2], np.cos(phase))


def apply_pose(run: dict, c: Context, p: Array, form: str) -> dict:
    """Add an oscillation that no motion causes to both positions; orientations and forces are unchanged."""
    wave = oscillation(c, p, form)
    return {**run, "tip": run["tip"] + wave, "shaft": run["shaft"] + wave}


def apply_force(signal: Array, c: Context, p: Array, form: str) -> Array:
    """The force reads with a line."""
    return np.asarray(signal + oscillation(c, p, form))


EFFECTS = (
    Effect(
        "periodic_disturbance",
        "pose",
        87,
        reading,
        "The tracker's positions contain an oscillation at {frequency} that no motion causes.",
        "x = x + sine*sin(2 pi f t) + cosine*cos(2 pi f t)",
        apply_pose,
        timed=True,
        at_rest=True,
        several=True,
    ),
    Effect(
        "periodic_disturbance",
        "forces",
        87,
        reading,
        "The force readings contain an oscillation at {frequency} that no contact causes.",
        "F = F + sine*sin(2 pi f t) + cosine*cos(2 pi f t)",
        apply_force,
        timed=True,
        at_rest=True,
        several=True,
    ),
    Effect(
        "periodic_disturbance",
        "pose",
        88,
        reading_on_a_line,
        "The tracker's positions contain an oscillation on a line at {frequency} that no motion causes.",
        "x = x + amplitude*sin(2 pi f t + phase)",
        apply_pose,
        forms=("line",),
        timed=True,
        at_rest=True,
        several=True,
    ),
    Effect(
        "periodic_disturbance",
        "forces",
        88,
        reading_on_a_line,
        "The force readings contain an oscillation with one phase at {frequency} that no contact causes.",
        "F = F + amplitude*sin(2 pi f t + phase)",
        apply_force,
        forms=("line",),
        timed=True,
        at_rest=True,
        several=True,
    ),
    Effect(
        "periodic_disturbance",
        "contact",
        10,
        wall,
        "The wall moves to and fro at {frequency}.",
        "depth = depth + sine*sin(2 pi f t) + cosine*cos(2 pi f t)",
        apply_wall,
        timed=True,
        at_rest=True,
        several=True,
    ),
    Effect(
        "periodic_disturbance",
        "motion",
        75,
        parameters,
        SAYS,
        "y = x + sine*sin(2 pi f t) + cosine*cos(2 pi f t)",
        apply,
        side="output",
        timed=True,
        at_rest=True,
        several=True,
    ),
    Effect(
        "periodic_disturbance",
        "motion",
        25,
        parameters,
        SAYS,
        "y = x + sine*sin(2 pi x/pitch) + cosine*cos(2 pi x/pitch)",
        apply,
        forms=("place",),
        at_rest=True,
        several=True,
    ),
    Effect(
        "periodic_disturbance",
        "force",
        30,
        parameters,
        SAYS,
        "F = sine*sin(2 pi f t) + cosine*cos(2 pi f t)",
        slots=slots,
        timed=True,
        at_rest=True,
        several=True,
    ),
    Effect(
        "periodic_disturbance",
        "force",
        31,
        parameters,
        SAYS,
        "F = sine*sin(2 pi x/pitch) + cosine*cos(2 pi x/pitch)",
        slots=slots,
        forms=("place",),
        at_rest=True,
        several=True,
    ),
    Effect(
        "periodic_disturbance",
        "mix",
        81,
        parameters,
        SAYS,
        "y = x + sine*sin(2 pi f t) + cosine*cos(2 pi f t)",
        apply,
        timed=True,
        at_rest=True,
        several=True,
    ),
    Effect(
        "periodic_disturbance",
        "drift",
        76,
        of_a_line,
        "The reading contains an oscillation at {frequency} that no motion causes, with another phase in each recording.",
        "y = x + a*cos(2 pi f t) + b*sin(2 pi f t),  a and b of each recording",
        apply_line,
        forms=("phases",),
        seeds=on_the_line,
        timed=True,
        at_rest=True,
        several=True,
        remembers=True,
        memories=("cosine", "sine"),
    ),
)
