"""Distortion of the tracker's field as it is seen within seconds, while the sensors stay near one place.

A magnetic tracker finds the pose (R, x) of a sensor from the field F(x) of its generator: the coils read R^T F(x). Metal
adds a field D(x). To first order in D, the pose that explains R^T (F + D) differs from the true one by a displacement and by
a turn, independent of each other and both linear in D(x) (linearized equations of Raab et al. 1979, IEEE Trans. AES 15(5)).
D changes over about the distance of the metal, so that it is constant to first order over a motion of some mm.

The turn has no lever: it turns what the sensors read as their orientation, and no position. A motion of the base turns both.
"""

from __future__ import annotations

import numpy as np

from host.diagnosis.effects.base_motion import turned
from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Displacement and turn along the base axes."""
    return (
        *(Parameter(f"pull_{a}", "m", (1e-3,), linear=True) for a in "xyz"),
        *(Parameter(f"turn_{a}", "rad", (0.02,), -1.0, 1.0, step=0.02, linear=True) for a in "xyz"),
    )


def apply(run: dict, c: Context, p: Array, form: str) -> dict:
    """Both sensors read positions displaced by p[:3] and orientations turned by p[3:6]."""
    turn = turned(p[3:6, None])[:, :, 0]
    moved = {name: run[name] + p[:3, None] for name in ("tip", "shaft")}
    return {**run, **moved, **{name: np.einsum("ab,bcn->acn", turn, run[name]) for name in ("tip_R", "shaft_R")}}


LOCAL_FIELD = Effect(
    "field_distortion",
    "pose",
    84,
    parameters,
    "Metal nearby distorts the tracker's field: it reads positions displaced and orientations turned.",
    "y = x + pull, R_y = turn R",
    apply,
)
