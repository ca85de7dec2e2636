"""Quantization: a reading moves in steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from host.diagnosis.model.effect import Array, Context, Effect, Evidence, Parameter, Scale

SAMPLES = 150  # of each output and recording, to look for steps in
# Steps that the range holds at the most, for the search: a reading of 12 bits. Without it, the search of recordings without
# noise would try as many steps as the range holds of their rounding errors.
MOST_STEPS = 4000
HARMONICS = 4  # of the saw tooth: a smooth approximation, so that a fit can follow it


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Return the height of a step, in the signal's unit."""
    return (Parameter("step", s.unit, (2.0 * s.need, 4.0 * s.need), 0.5 * s.need, 30.0 * s.need, step=0.01 * s.need),)


def of_a_force(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Height of a step, a quarter of the recorded range at most: a coarser one would say that nothing was read."""
    grid = tuple(size for size in (2.0 * s.need, 4.0 * s.need) if size < 0.25 * s.span)
    if not grid:
        return ()
    return (Parameter("step", s.unit, grid, 0.5 * s.need, min(30.0 * s.need, 0.25 * s.span), step=0.01 * s.need),)


def from_saw_tooth(evidence: Evidence, parameters: tuple[Parameter, ...], unit: str) -> tuple[Parameter, ...]:
    """The steps at which the residual follows the saw tooth of the readings as simulated; none that the range does not
    hold several times.
    """
    rows = [reading for reading in evidence.readings if reading.unit == unit]
    if not rows:
        return parameters
    every = [max(1, reading.residual.size // SAMPLES) for reading in rows]
    place = np.concatenate([reading.simulated[::k] for reading, k in zip(rows, every, strict=True)])
    rest = np.concatenate([reading.residual[::k] / reading.scale for reading, k in zip(rows, every, strict=True)])
    low, high = 1.2 * min(reading.scale for reading in rows), 12.0 * max(reading.scale for reading in rows)
    span = float(np.max(np.abs(place))) if place.size else 0.0
    if not span > high:
        return tuple(replace(p, grid=()) for p in parameters)
    turns = np.arange(1.0 / high, min(1.0 / low, MOST_STEPS / span), 0.2 / span)
    # not over k, as a saw tooth's height would be: that prefers coarse steps, which follow the noise
    follows = np.array([float(rest @ np.sin(2.0 * np.pi * k * place)) for k in turns])
    best = turns[np.argsort(follows)[:3]]
    grid = tuple(float(1.0 / k) for k in best)
    return (replace(parameters[0], grid=grid, low=0.5 * low, high=2.0 * high, step=0.01 * low),)


def of_positions(evidence: Evidence, parameters: tuple[Parameter, ...], form: str) -> tuple[Parameter, ...]:
    """Return the parameter `step` (m) with starts from the sawtooth of the residual."""
    return from_saw_tooth(evidence, parameters, "m")


def of_forces(evidence: Evidence, parameters: tuple[Parameter, ...], form: str) -> tuple[Parameter, ...]:
    """Return the parameter `step` (N) with starts from the sawtooth of the residual."""
    return from_saw_tooth(evidence, parameters, "N")


def stepped(x: Array, step: float) -> Array:
    """`x` rounded to steps, the saw tooth by its first harmonics."""
    phase = 2.0 * np.pi * x / step
    wave = np.zeros_like(x)
    for k in range(1, HARMONICS + 1):
        wave += (1.0 if k % 2 else -1.0) * np.sin(k * phase) / k
    return np.asarray(x - step / np.pi * wave)


def apply_pose(run: dict, c: Context, p: Array, form: str) -> dict:
    """Round both positions to steps of p[0] (m)."""
    return {**run, "tip": stepped(run["tip"], p[0]), "shaft": stepped(run["shaft"], p[0])}


def apply_force(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Round every component of the force to steps of p[0] (N)."""
    return stepped(signal, p[0])


EFFECTS = (
    Effect(
        "quantization",
        "pose",
        90,
        parameters,
        "The tracker's positions have steps of {step}.",
        "y = step*round(x/step)",
        apply_pose,
        seeds=of_positions,
    ),
    Effect(
        "quantization",
        "forces",
        90,
        of_a_force,
        "The force sensor's readings have steps of {step}.",
        "y = step*round(x/step)",
        apply_force,
        seeds=of_forces,
    ),
)
