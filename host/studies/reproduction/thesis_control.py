"""The thesis' hybrid controller (Fig. 7.1) on the plants of its simulations (7.3): a rod, or arcs, against a spring.

Gains are per iteration, as printed; an iteration is PERIOD_S, a tracker frame, which the thesis does not state. The joint
error is the difference of two calls of the inverse kinematics by polynomials (Fig. 6.12, 7.3.2). The law can be read in two
forms (`LawForm`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from host.studies.reproduction.thesis_inverse import fitted_polynomials, polynomial_inverse, unit_tip
from host.studies.reproduction.thesis_plant import Instant, PlantModel, plant_model, rest

Array = NDArray[np.float64]
CATHETER = "steerocath_t"
PERIOD_S = 0.025
# Bounds of the commanded joints: curvature either way (1/m), shaft outside and body outside at most (m).
MOST_CURVATURE_per_m, LEAST_OUTSIDE_m, MOST_BODY_m = 80.0, 0.005, 0.05


class LawForm(NamedTuple):
    """Reading of the law.

    pi: the joints are q_0 and the PID of the joint error (chapter 7), in place of moving by it in each iteration (6.4.1).
    from_desired: the force loop's displacement is added to the desired position (Fig. 7.1), in place of the tip's.
    """

    name: str
    pi: bool
    from_desired: bool


INCREMENTAL = LawForm("incremental form", False, False)
PI = LawForm("PI form", True, True)


@dataclass(frozen=True)
class Gains:
    """Of (7.5)'s section, per iteration. Position: dimensionless; force: m/N. The defaults are the thesis' optimum."""

    K_pp: float = 1.3704
    K_ip: float = 0.001
    K_dp: float = 0.2122
    K_pf: float = 0.0545
    K_if: float = 1e-4
    K_df: float = 0.0062

    def scaled(self, **factors: float) -> Gains:
        """Return these gains with some of them multiplied by a factor."""
        return replace(self, **{key: getattr(self, key) * factor for key, factor in factors.items()})


@dataclass(frozen=True)
class Setting:
    """What the thesis does not give: the start (body outside in m, negative: in the sheath; bend outside in rad; gap in m).

    And the form of the law. rod: the rod of chapter 3 is the plant, else the circular arcs.

    With the whole distal shaft (70 mm) of its steerocath_t outside, the printed gains lose contact before 0.25 N, and
    Algorithm 3.1 does not converge there. So part of the shaft is in the sheath (section 3.2.3), and the length of the part
    outside at the start is the length in the inverse kinematics.
    """

    insertion_m: float = -0.030
    bend_rad: float = math.radians(15.0)
    gap_m: float = 0.001
    form: LawForm = INCREMENTAL
    rod: bool = True

    @property
    def name(self) -> str:
        """Return the start in words."""
        return f"{self.length_m * 1e3:.0f} mm outside, bent by {math.degrees(self.bend_rad):.0f} degrees"

    @property
    def length_m(self) -> float:
        """Return the length of the distal shaft outside at the start, in m."""
        return plant_model(CATHETER, self.rod).length_m + min(self.insertion_m, 0.0)

    @property
    def curvature_per_m(self) -> float:
        """Return the curvature at the start in 1/m."""
        return self.bend_rad / self.length_m

    @property
    def tip_m(self) -> Array:
        """Return the unloaded tip (2,) at the start in m, along and across."""
        along, across = unit_tip(np.array(self.bend_rad))
        return self.length_m * np.array([along, across]) + [max(self.insertion_m, 0.0), 0.0]


# Starts from which 0.25 N can be reached, and that Algorithm 3.1 can solve: shaft outside (m) and bend (degrees).
STARTS = tuple(
    Setting(outside_m - 0.070, math.radians(bend_deg))
    for outside_m, bend_deg in ((0.040, 15.0), (0.040, 30.0), (0.040, 45.0), (0.050, 15.0))
)


class ThesisRun(NamedTuple):
    """A row an iteration: force across (N), tip (m), joints (curvature 1/m, insertion m), wall (m).

    From the iteration on in which the plant has no equilibrium, force and tip are not finite.
    """

    force_N: Array
    tip_m: Array
    joint: Array
    wall_m: Array

    @property
    def time_s(self) -> Array:
        """Return the time of each row (n,) in s."""
        return np.asarray(PERIOD_S * np.arange(self.force_N.size), np.float64)

    @property
    def failed(self) -> bool:
        """Return whether the plant had no equilibrium at some iteration."""
        return not np.isfinite(self.force_N).all()


class _Controller(NamedTuple):
    """Gains (6,), the form of the law, the polynomials (3, 10) and their length (m), and the desired position (2,) m."""

    gains: Array
    pi: bool
    from_desired: bool
    coefficients: Array
    length_m: float
    goal_m: Array


class _Course(NamedTuple):
    """Of each iteration: wall (m), factor of the stiffness, desired force (N)."""

    wall_m: Array
    stiffness: Array
    wanted_N: Array


@njit(cache=True, nogil=True)
def _run(model: PlantModel, law: _Controller, start: Array, course: _Course, run: ThesisRun) -> None:
    """Fill force, tip and joints of `run`, beginning with the joints start (2,)."""
    q0, q1, touched, carried = start[0], start[1], False, np.zeros(3)
    sum_f, last_f, sum_q, last_q = 0.0, 0.0, np.zeros(2), np.zeros(2)
    measured, gains = q0, law.gains
    before = Instant(q0, q1, course.wall_m[0], course.stiffness[0])
    run.force_N[:], run.tip_m[:] = np.inf, np.nan
    for k in range(course.wall_m.size):
        run.joint[k, 0], run.joint[k, 1] = q0, q1
        at = Instant(q0, q1, course.wall_m[k], course.stiffness[k])
        found = rest(model, at, before, carried)
        before = at
        if not found.found:
            run.joint[k:, 0], run.joint[k:, 1] = q0, q1
            return
        run.force_N[k], run.tip_m[k, 0], run.tip_m[k, 1] = found.force_N, found.x, found.y
        error_f = course.wanted_N[k] - found.force_N
        if not touched:
            touched, last_f = True, error_f
        sum_f += error_f
        across = gains[3] * error_f + gains[4] * sum_f + gains[5] * (error_f - last_f)
        last_f = error_f
        measured, a1 = polynomial_inverse(law.coefficients, found.x, found.y, law.length_m, measured)
        goal = (law.goal_m[1] if law.from_desired else found.y) + across
        b0, b1 = polynomial_inverse(law.coefficients, law.goal_m[0], goal, law.length_m, measured)
        for axis in range(2):
            error = b0 - measured if axis == 0 else b1 - a1
            sum_q[axis] += error
            step = gains[0] * error + gains[1] * sum_q[axis] + (gains[2] * (error - last_q[axis]) if k > 0 else 0.0)
            last_q[axis] = error
            if axis == 0:
                q0 = min(max((start[0] if law.pi else q0) + step, -MOST_CURVATURE_per_m), MOST_CURVATURE_per_m)
            else:
                q1 = min(max((start[1] if law.pi else q1) + step, LEAST_OUTSIDE_m - model.length_m), MOST_BODY_m)


_POLYNOMIALS = fitted_polynomials()


def hybrid(
    force_N: float,
    iterations: int,
    gains: Gains | None = None,
    setting: Setting | None = None,
    wall_motion: Callable[[Array], Array] | None = None,
    stiffness: Callable[[Array], Array] | None = None,
    still: bool = False,
    start_joint: Array | None = None,
) -> ThesisRun:
    """The external hybrid controller of Fig. 7.1 against a wall along x, `force_N` across it, the tip's x kept.

    The desired position is that of the start, the setting's gap in front of the wall. `wall_motion` (m over s, outwards
    positive), `stiffness` (factor of EI over iterations). `still`: the joints stay where they are, as a catheter left alone.
    `start_joint` (2,): instead of the setting's start.
    """
    gains, setting = gains or Gains(), setting or Setting()
    number = np.arange(iterations, dtype=np.float64)
    motion = wall_motion(np.asarray(PERIOD_S * number, np.float64)) if wall_motion else np.zeros(iterations)
    wall = np.asarray(setting.tip_m[1] + setting.gap_m + motion, float)
    factor = np.asarray(stiffness(number) if stiffness else np.ones(iterations), float)
    joint = np.array([setting.curvature_per_m, setting.insertion_m]) if start_joint is None else np.array(start_joint)
    listed = np.zeros(6) if still else np.array([gains.K_pp, gains.K_ip, gains.K_dp, gains.K_pf, gains.K_if, gains.K_df])
    form = setting.form
    law = _Controller(listed, form.pi, form.from_desired, _POLYNOMIALS, setting.length_m, setting.tip_m)
    run = ThesisRun(np.zeros(iterations), np.zeros((iterations, 2)), np.zeros((iterations, 2)), wall)
    _run(plant_model(CATHETER, setting.rod), law, joint, _Course(wall, factor, np.full(iterations, force_N)), run)
    return run


def heart(
    time_s: Array, beat_m: float = 0.001, beat_Hz: float = 2.0, respiration_m: float = 0.0004, respiration_Hz: float = 0.33
) -> Array:
    """The wall's motion (7.5), frequencies in Hz."""
    return beat_m * np.sin(2 * np.pi * beat_Hz * time_s) + respiration_m * np.sin(2 * np.pi * respiration_Hz * time_s)


def cost(gains: Gains, setting: Setting | None = None) -> float:
    """J of (7.4), as printed: summed over 40 iterations, mean over 0.1, 0.2 and 0.3 N (in N)."""
    return float(np.mean([np.abs(hybrid(force, 40, gains, setting).force_N - force).sum() for force in (0.1, 0.2, 0.3)]))


class ThesisStep(NamedTuple):
    """Figures of a step response: overshoot (N), iterations to stay within 5 %, error over the last tenth (N), ringing
    (N)."""

    overshoot_N: float
    settling: int
    steady_error_N: float
    ringing_N: float


def step_figures(run: ThesisRun, force_N: float) -> ThesisStep:
    """Of `run` with `force_N` wanted; settling is the run's length where it never settles. All infinite for a failed run."""
    if run.failed:
        return ThesisStep(math.inf, run.force_N.size, math.inf, math.inf)
    outside = np.flatnonzero(np.abs(run.force_N - force_N) > 0.05 * force_N)
    late = run.force_N[-max(8, run.force_N.size // 10) :]
    return ThesisStep(
        float(max(run.force_N.max() - force_N, 0.0)),
        int(outside[-1] + 1 if outside.size else 0),
        float(abs(late.mean() - force_N)),
        float(late.std()),
    )
