"""Quantization: a reading moves in steps."""

from __future__ import annotations

import numpy as np

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale

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


def stepped(x: Array, step: float) -> Array:
    """`x` rounded to steps, the saw tooth by its first harmonics."""
    phase = 2.0 * np.pi * x / step
    wave = np.zeros_like(x)
    for k in range(1, HARMONICS + 1):
        wave += (1.0 if k % 2 else -1.0) * np.sin(k * phase) / k
    return np.asarray(x - step / np.pi * wave)


def apply_pose(run: dict, c: Context, p: Array, form: str) -> dict:
    """Both positions in steps."""
    return {**run, "tip": stepped(run["tip"], p[0]), "shaft": stepped(run["shaft"], p[0])}


def apply_force(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Every component in steps."""
    return stepped(signal, p[0])


EFFECTS = (
    Effect(
        "quantization",
        "pose",
        90,
        parameters,
        "The tracker's positions move in steps of {step}.",
        "y = step*round(x/step)",
        apply_pose,
    ),
    Effect(
        "quantization",
        "forces",
        90,
        of_a_force,
        "The force sensor's readings move in steps of {step}.",
        "y = step*round(x/step)",
        apply_force,
    ),
)
