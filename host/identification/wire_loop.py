"""Identify the friction of a pull-wire from a loading-unloading loop: the knob goes up and comes back, the tip bends.

Model (8.1.1; capstan equation of Euler and Eytelwein, kappa0 = T e / EI as in 3.2.3): the free curvature stays within a
factor exp(mu (Theta_body + |kappa| L / 2)) of g kappa_knob and moves only at the edges of that band. Fitted are mu and the
gain g, by least squares on the tip's bend, with 95 % intervals. A loop that never reaches both edges does not determine mu.
"""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares

from protocol.catheter import Catheter, ConstitutiveParameters, catheter_toml
from protocol.errors import InputError, reason
from protocol.text_files import read_text

Array = NDArray[np.float64]

COLUMNS = ("curvature_per_m", "bend_rad")
FEWEST_SAMPLES = 12
LARGEST_FRICTION = 1.0
# Both edges of the band are reached where the knob returns by this share of its range.
LEAST_RETURN = 0.3


@dataclass(frozen=True)
class WireLoop:
    """A loop in the order of time: curvature that the knob's curve gives (1/m), bend of the free tip (rad)."""

    curvature_per_m: Array
    bend_rad: Array

    @classmethod
    def of(cls, curvature_per_m: ArrayLike, bend_rad: ArrayLike) -> WireLoop:
        """Check and keep both columns. Raises InputError naming the key."""
        columns = [np.asarray(values, dtype=float) for values in (curvature_per_m, bend_rad)]
        for name, column in zip(COLUMNS, columns, strict=True):
            if column.ndim != 1 or not np.isfinite(column).all():
                raise InputError(name, "no list of finite numbers", "one finite number for each sample")
        if len(columns[0]) != len(columns[1]) or len(columns[0]) < FEWEST_SAMPLES:
            raise InputError(
                "loop", f"{len(columns[0])} and {len(columns[1])} samples", f"as many of both, {FEWEST_SAMPLES} or more"
            )
        knob = columns[0]
        top = int(np.argmax(np.abs(knob)))
        span = float(np.ptp(knob))
        back = abs(float(knob[top])) - float(np.min(np.abs(knob[top:])))
        if span <= 0.0 or back < LEAST_RETURN * span:
            raise InputError("curvature_per_m", "no return", "a knob that goes up and comes back: a loading-unloading loop")
        return cls(columns[0], columns[1])


@dataclass(frozen=True)
class WireFriction:
    """Friction coefficient and gain with 95 % intervals; RMS error (rad) of the loop with the friction and without any."""

    friction_coefficient: float
    friction_ci95: tuple[float, float]
    gain: float
    gain_ci95: tuple[float, float]
    rms_rad: float
    rms_without_rad: float
    samples: int


def read_wire_loop(path: str | Path) -> WireLoop:
    """The loop in a CSV file headed curvature_per_m,bend_rad. Raises InputError naming the file or the key."""
    lines = read_text(path, wanted="a readable CSV file headed " + ",".join(COLUMNS)).splitlines()
    try:
        rows = list(csv.DictReader(lines))
    except csv.Error as error:
        raise InputError(str(path), reason(error), "a readable CSV file headed " + ",".join(COLUMNS)) from None
    values: list[list[float]] = []
    for name in COLUMNS:
        try:
            values.append([float(row[name]) for row in rows])
        except (KeyError, TypeError, ValueError):
            raise InputError(name, f"no such column of numbers in {path}", "columns " + ",".join(COLUMNS)) from None
    return WireLoop.of(*values)


def predicted_bend(
    curvature_per_m: Array, length_m: float, friction: float, gain: float, body_turning_rad: float = 0.0
) -> Array:
    """Bend (n,) rad of a free shaft of `length_m` along a history of the knob's curvature (n,) 1/m, from mid-band."""
    kappa = gain * float(curvature_per_m[0])
    out = np.empty(len(curvature_per_m))
    for i, asked in enumerate(gain * curvature_per_m):
        f = math.exp(friction * (body_turning_rad + 0.5 * abs(kappa) * length_m))
        near, far = asked / f, asked * f
        kappa = min(max(kappa, min(near, far)), max(near, far))
        out[i] = kappa * length_m
    return out


def identify_wire_friction(catheter: Catheter, loop: WireLoop, body_turning_rad: float = 0.0) -> WireFriction:
    """Fit friction and gain to a loop of the whole distal shaft.

    Arguments: `body_turning_rad`, bend of the body on the wire's way. Raises: InputError.
    """
    if not 0.0 <= body_turning_rad < math.inf:
        raise InputError("body_turning_rad", body_turning_rad, "0 or more")
    length = catheter.distal_length_m

    def residual(x: Array) -> Array:
        return predicted_bend(loop.curvature_per_m, length, x[0], x[1], body_turning_rad) - loop.bend_rad

    best = min(
        (
            least_squares(
                residual, [start, 1.0], bounds=([0.0, 0.2], [LARGEST_FRICTION, 5.0]), diff_step=1e-4, x_scale=[0.1, 1.0]
            )
            for start in (0.01, 0.05, 0.15, 0.4)
        ),
        key=lambda found: float(found.cost),
    )
    gain_alone = least_squares(lambda x: residual(np.array([0.0, x[0]])), [1.0])
    n = len(loop.bend_rad)
    noise2 = 2.0 * best.cost / (n - 2)
    covariance = noise2 * np.linalg.pinv(best.jac.T @ best.jac)
    half = 1.96 * np.sqrt(np.diag(covariance))
    friction, gain = (float(value) for value in best.x)
    return WireFriction(
        friction,
        (max(friction - float(half[0]), 0.0), friction + float(half[0])),
        gain,
        (gain - float(half[1]), gain + float(half[1])),
        math.sqrt(2.0 * best.cost / n),
        math.sqrt(2.0 * gain_alone.cost / n),
        n,
    )


def with_friction(catheter: Catheter, found: WireFriction, name: str) -> str:
    """The text of the catheter's file, called `name`, with the friction that was found."""
    cubic = catheter.constitutive.cubic_stiffening_m2 if catheter.constitutive else 0.0
    low, high = found.friction_ci95
    notes = [
        f"Friction of the pull-wire from a loop of {found.samples} samples: {found.friction_coefficient:.4g}, 95 %",
        f"{low:.4g} to {high:.4g}; error of the bend {found.rms_rad:.4g} rad, {found.rms_without_rad:.4g} rad without.",
        "Other values are those of the file that was given.",
    ]
    constitutive = ConstitutiveParameters(found.friction_coefficient, cubic)
    return catheter_toml(replace(catheter, name=name, constitutive=constitutive), notes)
