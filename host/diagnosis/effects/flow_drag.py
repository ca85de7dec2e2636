"""Flow drag: blood flow on the exposed shaft, pulsatile at the beat."""

from __future__ import annotations

import numpy as np

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale, lines


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Drag per exposed length, steady and pulsatile, across the axis; frequency of the beat."""
    parts = tuple(
        Parameter(f"{part}_{a}", "N/m", (0.05,), linear=True) for a in "xy" for part in ("steady", "sine", "cosine")
    )
    grid = lines(s, 0.3, min(3.0, 0.4 / s.dt_s), 0.5)
    return (*parts, Parameter("frequency", "Hz", grid, 0.1, 0.45 / s.dt_s, spectral=True, step=0.1 / s.duration_s))


def apply(state: dict, c: Context, p: Array, form: str) -> dict:
    """An even drag on the exposed shaft, pulsing."""
    phase = 2.0 * np.pi * p[6] * c.time_s
    wave = np.vstack([np.ones_like(phase), np.sin(phase), np.cos(phase)])
    force = np.vstack([p[0:3] @ wave, p[3:6] @ wave, np.zeros_like(phase)])
    return {**state, "load": state["load"] + force}


EFFECTS = (
    Effect(
        "flow_drag",
        "shape",
        31,
        parameters,
        "Blood flow exerts a drag on the exposed shaft that pulsates at {frequency}.",
        "dF/ds = steady + sine*sin(2 pi f t) + cosine*cos(2 pi f t)",
        apply,
        timed=True,
        contains=("gravity_load",),
    ),
)
