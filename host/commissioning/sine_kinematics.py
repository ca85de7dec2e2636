"""The thesis' inverse kinematics: sums of two sines fitted to a knob sweep (6.3, Algorithm 6.1), and its errors.

Curves 1 and 2 give the knob for the tip's offset across, past and below the fold; curve 3 the tip's place along the axis
for the knob. The thesis' printed coefficients are of another catheter (and curve 3's lost digits): the method is kept,
the coefficients come from the rig's own sweep.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from host.commissioning.characterization import KnobSweep
from protocol.errors import InputError
from realtime.control.inverse_kinematics import FOLD_BEND, FOLD_REACH

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SineCurve:
    """y = sum of a_i sin(b_i x + c_i). `parameters` (6,): a1, b1, c1, a2, b2, c2; `r_square` of the fit, (6.3)'s table."""

    parameters: Array
    r_square: float

    def __call__(self, x: Array | float) -> Array:
        """Return the curve at `x`, of the same shape."""
        a1, b1, c1, a2, b2, c2 = self.parameters
        return np.asarray(a1 * np.sin(b1 * np.asarray(x) + c1) + a2 * np.sin(b2 * np.asarray(x) + c2))


@dataclass(frozen=True)
class SineKinematics:
    """The three curves of one half of the knob's travel, the other half by symmetry. Knob in rad, places in m."""

    past_fold: SineCurve
    below_fold: SineCurve
    along: SineCurve
    fold_knob_rad: float

    def knob_and_body(self, lateral_m: float, axial_m: float, last_knob_rad: float) -> tuple[float, float]:
        """Knob (rad) and body insertion (m) for a tip `lateral_m` off and `axial_m` along; Algorithm 6.1, d = x_T - x_TP."""
        side = math.copysign(1.0, lateral_m)
        candidates = [side * float(curve(abs(lateral_m))) for curve in (self.past_fold, self.below_fold)]
        knob = min(candidates, key=lambda angle: abs(angle - last_knob_rad))
        return knob, axial_m - float(self.along(abs(knob)))


class CurveErrors(NamedTuple):
    """Errors of one inverse over held-out samples: knob (rad) and the tip's place that follows from it (m), RMS and worst 1
    %."""

    knob_rms_rad: float
    tip_rms_m: float
    tip_p99_m: float


def fit_sines(x: Array, y: Array, terms_start: Array | None = None) -> SineCurve:
    """Two sines through (x, y) by least squares from several starts. Raises InputError for fewer than 12 points."""
    if x.size < 12:
        raise InputError.from_sentence(f"curve: found {x.size} points, wanted at least 12")
    span, size = float(np.ptp(x)), float(np.ptp(y))
    best: tuple[float, Array] | None = None

    def residuals(p: Array) -> Array:
        return p[0] * np.sin(p[1] * x + p[2]) + p[3] * np.sin(p[4] * x + p[5]) - y

    starts = (
        [terms_start]
        if terms_start is not None
        else [
            np.array([size, 0.5 * math.pi * k / span, phase, 0.2 * size, 2.0 * math.pi * (k + 0.5) / span, 0.0])
            for k in (0.6, 1.2, 2.0)
            for phase in (0.0, 1.2)
        ]
    )
    for start in starts:
        found = least_squares(residuals, start, max_nfev=400, x_scale=np.maximum(np.abs(start), 0.1))
        if best is None or found.cost < best[0]:
            best = (float(found.cost), found.x)
    assert best is not None
    return SineCurve(best[1], 1.0 - 2.0 * best[0] / float(np.sum((y - y.mean()) ** 2)))


def fit_sine_kinematics(sweep: KnobSweep, fold_knob_rad: float, thin: int = 600) -> SineKinematics:
    """Curves 1 to 3 from one half of a knob sweep, at most `thin` points each. `fold_knob_rad`: where the tip is furthest
    off."""
    knob, lateral = np.abs(sweep.knob_rad), np.sign(sweep.knob_rad) * sweep.lateral_m

    def thinned(keep: NDArray[np.bool_], *columns: Array) -> list[Array]:
        index = np.flatnonzero(keep)
        index = index[:: max(1, index.size // thin)]
        return [column[index] for column in columns]

    past = thinned((knob > fold_knob_rad), lateral, knob)
    below = thinned((knob <= fold_knob_rad), lateral, knob)
    along = thinned(np.ones(knob.size, bool), knob, sweep.axial_m)
    return SineKinematics(fit_sines(*past), fit_sines(*below), fit_sines(*along), fold_knob_rad)


def monotone_knob_and_body(
    curve: tuple[Array, Array], length_m: float, lateral_m: float, axial_m: float, last_knob_rad: float
) -> tuple[float, float]:
    """The same by the monotone knob curve (knob (n,) rad over curvature (n,) 1/m, rising) and the arc's geometry."""
    from realtime.control.inverse_kinematics import bend_of_reach

    knobs, curvatures = curve
    side, ratio = math.copysign(1.0, lateral_m), min(abs(lateral_m) / length_m, FOLD_REACH)
    bends = [bend_of_reach(ratio, False), bend_of_reach(ratio, True)]
    found = [float(np.interp(side * bend / length_m, curvatures, knobs)) for bend in bends]
    pick = min((0, 1), key=lambda k: abs(found[k] - last_knob_rad))
    if bends[pick] / length_m > 1.03 * curvatures[-1]:
        pick = 0
    bend = bends[pick]
    return found[pick], axial_m - length_m * float(np.sinc(bend / math.pi))


def compare(
    held_out: KnobSweep,
    truth_curve: tuple[Array, Array],
    length_m: float,
    sines: SineKinematics,
    monotone: tuple[Array, Array],
) -> dict[str, CurveErrors]:
    """Errors of both inverses where the tip was seen in sweeps not used for the fits, outside the dead zones.

    `truth_curve`: knob (rad) and curvature (1/m) of the held-out sweep's own fit, to turn a knob error into a tip error.
    """
    errors: dict[str, list[list[float]]] = {"sines": [], "monotone": []}
    step = max(1, held_out.knob_rad.size // 1500)
    bends = np.interp(held_out.knob_rad, *truth_curve)
    live = (np.abs(bends) > 1.0) & (np.abs(bends) < 0.98 * truth_curve[1][-1])
    for i in np.flatnonzero(live)[::step]:
        knob, lateral = float(held_out.knob_rad[i]), float(held_out.lateral_m[i])
        given = (lateral, float(held_out.axial_m[i]), knob)
        for name, answer in (
            ("sines", sines.knob_and_body(*given)),
            ("monotone", monotone_knob_and_body(monotone, length_m, *given)),
        ):
            bend = float(np.interp(answer[0], *truth_curve)) * length_m
            across = length_m * 0.5 * bend * float(np.sinc(bend / (2 * math.pi))) ** 2
            along = length_m * float(np.sinc(bend / math.pi)) + answer[1]
            errors[name].append([answer[0] - knob, math.hypot(across - lateral, along - given[1])])
    out = {}
    for name, rows in errors.items():
        table = np.array(rows)
        out[name] = CurveErrors(
            float(np.sqrt(np.mean(table[:, 0] ** 2))),
            float(np.sqrt(np.mean(table[:, 1] ** 2))),
            float(np.percentile(table[:, 1], 99)),
        )
    return out


__all__ = [
    "FOLD_BEND",
    "CurveErrors",
    "SineCurve",
    "SineKinematics",
    "compare",
    "fit_sine_kinematics",
    "fit_sines",
    "monotone_knob_and_body",
]
