"""The thesis' control laws on the models it used: planar hybrid control on a rod against a spring (7.3), position control
(6.4).

Gains are per iteration, as printed; an iteration is PERIOD_S, a tracker frame, which the thesis does not state. The joint
error is the difference of two calls of the inverse kinematics (Fig. 6.12). The law can be read in two forms (`LawForm`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from host.mechanics import pcar_kernels as kernels
from host.mechanics.pcar import NO_DRAG, arcs_of
from protocol.catheter import load_catheter
from realtime.control import inverse_kinematics

Array = NDArray[np.float64]
PERIOD_S = 0.025
TISSUE_N_PER_M = 1000.0


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
    """Where the simulated catheter starts, planar: body insertion (m, negative: in the sheath), bend outside (rad), gap (m).

    And in which form the law controls it.

    The thesis gives no numbers. With its steerocath_t a whole distal shaft (70 mm) cannot press 0.2 N across without
    buckling (F L^2 / EI = 5), so 40 mm are outside.
    """

    catheter: str = "steerocath_t"
    insertion_m: float = -0.030
    bend_rad: float = math.radians(45.0)
    gap_m: float = 0.001
    form: LawForm = INCREMENTAL

    @property
    def curvature_per_m(self) -> float:
        """Return the curvature at the start in 1/m."""
        return self.bend_rad / (load_catheter(self.catheter).distal_length_m + self.insertion_m)


class ThesisRun(NamedTuple):
    """A row an iteration: force across (N), tip (m), joints (curvature 1/m, insertion m), wall (m)."""

    force_N: Array
    tip_m: Array
    joint: Array
    wall_m: Array

    @property
    def time_s(self) -> Array:
        """Return the time of each row (n,) in s."""
        return np.asarray(PERIOD_S * np.arange(self.force_N.size), np.float64)


class _Rod(NamedTuple):
    """Arc lengths outside are cut from `distal` (m); `EI` body first (N m2)."""

    distal: Array
    EI: Array


@njit(cache=True)
def _shape(  # noqa: PLR0913 - a kernel: plain arrays
    rod: _Rod,
    curvature: float,
    insertion_m: float,
    force_N: float,
    EI: Array,
    length: Array,
    kappa0: Array,
    kappa: Array,
    work: Array,
) -> tuple[int, float, float]:
    """(status, x, y) of the tip under (0, -force)."""
    inside = max(0.0, -insertion_m)
    length[0], kappa0[0] = max(0.0, insertion_m), 0.0
    for i in range(rod.distal.size):
        length[i + 1] = max(0.0, rod.distal[i] - inside)
        inside = max(0.0, inside - rod.distal[i])
        kappa0[i + 1] = curvature
    external = kernels.Load(0.0, -force_N, NO_DRAG)
    status, _, share = kernels.load_path(kernels.Shaft(length, EI, np.zeros_like(EI), kappa0), external, kappa, work)
    x, y, _ = kernels.evaluate(length, kappa, external, share, work)
    return status, x, y


@njit(cache=True)
def contact(
    rod: _Rod, curvature: float, insertion_m: float, wall_m: float, tissue_N_per_m: float, EI: Array, guess_N: float
) -> tuple[float, float, float]:
    """Force (N) with which the tip rests at the depth that the spring asks for, and the tip (m); Fig. 7.3, by regula falsi.

    A shape that folds under a force counts as too much of it.
    """
    n = rod.EI.size
    length, kappa0, kappa, work = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros((kernels.ROWS, n))
    _, x, y = _shape(rod, curvature, insertion_m, 0.0, EI, length, kappa0, kappa, work)
    if y <= wall_m:
        return 0.0, x, y
    low, high, low_gap, high_gap = 0.0, max(0.02, 1.5 * guess_N), y - wall_m, 0.0
    for _ in range(30):
        status, x, y = _shape(rod, curvature, insertion_m, high, EI, length, kappa0, kappa, work)
        high_gap = y - wall_m - high / tissue_N_per_m
        if status != 0 or high_gap <= 0.0:
            break
        low, low_gap, high = high, high_gap, 2.0 * high
    for k in range(60):
        share = low_gap / (low_gap - high_gap) if status == 0 and k % 3 != 2 else 0.5
        middle = low + min(max(share, 0.01), 0.99) * (high - low)
        status_here, x, y = _shape(rod, curvature, insertion_m, middle, EI, length, kappa0, kappa, work)
        gap = y - wall_m - middle / tissue_N_per_m
        if status_here != 0 or gap <= 0.0:
            high, high_gap, status = middle, gap, status_here
        else:
            low, low_gap = middle, gap
        if high - low < 1e-7 or (status_here == 0 and abs(gap) < 1e-9):
            return middle, x, y
    return low, x, y


@njit(cache=True)
def planar_inverse(x: float, y: float, length_m: float, last_curvature: float) -> tuple[float, float]:
    """Curvature (1/m) and insertion (m) of the unloaded tip at (x, y), (7.1) and (7.2); the fold's side of the last one."""
    bend = 2.0 * math.atan2(abs(y), x)
    chord = math.hypot(x, y)
    out_m = chord if bend < 1e-9 else chord * 0.5 * bend / math.sin(0.5 * bend)
    if out_m <= length_m:
        return math.copysign(bend / out_m, y), out_m - length_m
    beyond = abs(last_curvature) * length_m > inverse_kinematics.FOLD_BEND
    bend = inverse_kinematics.bend_of_reach(abs(y) / length_m, beyond)
    along = length_m * (1.0 if bend < 1e-6 else math.sin(bend) / bend)
    return math.copysign(bend / length_m, y), x - along


@njit(cache=True)
def _run(  # noqa: PLR0913 - a kernel: plain arrays
    rod: _Rod,
    length_m: float,
    gains: Array,
    pi: bool,
    from_desired: bool,
    start: Array,
    wall: Array,
    stiffness: Array,
    wanted: Array,
    tissue_N_per_m: float,
    force: Array,
    tip: Array,
    joint: Array,
) -> None:
    q0, q1, guess, touched = start[0], start[1], 0.0, False
    sum_f, last_f, sum_q, last_q = 0.0, 0.0, np.zeros(2), np.zeros(2)
    goal_x, goal_y, first0, first1 = start[2], start[3], q0, q1
    for k in range(wall.size):
        guess, x, y = contact(rod, q0, q1, wall[k], tissue_N_per_m, rod.EI * stiffness[k], guess)
        force[k], tip[k, 0], tip[k, 1], joint[k, 0], joint[k, 1] = guess, x, y, q0, q1
        error_f = wanted[k] - guess
        if not touched:
            touched, last_f = True, error_f
        sum_f += error_f
        across = gains[3] * error_f + gains[4] * sum_f + gains[5] * (error_f - last_f)
        last_f = error_f
        a0, a1 = planar_inverse(x, y, length_m, q0)
        b0, b1 = planar_inverse(goal_x, (goal_y if from_desired else y) + across, length_m, q0)
        for axis in range(2):
            error = b0 - a0 if axis == 0 else b1 - a1
            sum_q[axis] += error
            step = gains[0] * error + gains[1] * sum_q[axis] + (gains[2] * (error - last_q[axis]) if k > 0 else 0.0)
            last_q[axis] = error
            if axis == 0:
                q0 = min(max((first0 if pi else q0) + step, -80.0), 80.0)
            else:
                q1 = min(max((first1 if pi else q1) + step, 0.005 - length_m), 0.05)


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
    catheter = load_catheter(setting.catheter)
    arcs = arcs_of(catheter, 0.001, setting.curvature_per_m)
    assert catheter.pcar is not None
    rod = _Rod(np.array(catheter.pcar.distal_arcs_m), np.array(arcs.EI_N_m2))
    length_m = catheter.distal_length_m
    out_m = length_m + setting.insertion_m
    first = np.array(
        [
            out_m * np.sinc(setting.bend_rad / np.pi),
            out_m * 0.5 * setting.bend_rad * np.sinc(setting.bend_rad / (2 * np.pi)) ** 2,
        ]
    )
    number = np.arange(iterations, dtype=np.float64)
    motion = wall_motion(np.asarray(PERIOD_S * number, np.float64)) if wall_motion else np.zeros(iterations)
    wall = first[1] + setting.gap_m + motion
    factor = stiffness(number) if stiffness else np.ones(iterations)
    joint = np.array([setting.curvature_per_m, setting.insertion_m]) if start_joint is None else start_joint
    listed = np.zeros(6) if still else np.array([gains.K_pp, gains.K_ip, gains.K_dp, gains.K_pf, gains.K_if, gains.K_df])
    force, tip, joints = np.zeros(iterations), np.zeros((iterations, 2)), np.zeros((iterations, 2))
    _run(
        rod,
        length_m,
        listed,
        setting.form.pi,
        setting.form.from_desired,
        np.array([*joint, *first]),
        np.asarray(wall, float),
        np.asarray(factor, float),
        np.full(iterations, force_N),
        TISSUE_N_PER_M,
        force,
        tip,
        joints,
    )
    return ThesisRun(force, tip, joints, np.asarray(wall, float))


def heart(
    time_s: Array, beat_m: float = 0.001, beat_Hz: float = 2.0, respiration_m: float = 0.0004, respiration_Hz: float = 0.33
) -> Array:
    """The wall's motion (7.5), frequencies in Hz."""
    return beat_m * np.sin(2 * np.pi * beat_Hz * time_s) + respiration_m * np.sin(2 * np.pi * respiration_Hz * time_s)


def cost(gains: Gains, forces_N: tuple[float, ...] = (0.1, 0.2, 0.3), iterations: int = 40) -> float:
    """J of (7.4), as printed: summed over iterations, mean over forces (N)."""
    return float(np.mean([np.abs(hybrid(force, iterations, gains).force_N - force).sum() for force in forces_N]))


class ThesisStep(NamedTuple):
    """Figures of a step response: overshoot (N), iterations to stay within 5 %, error over the last tenth (N), ringing
    (N)."""

    overshoot_N: float
    settling: int
    steady_error_N: float
    ringing_N: float


def step_figures(run: ThesisRun, force_N: float) -> ThesisStep:
    """Of `run` with `force_N` wanted; settling is the run's length where it never settles."""
    outside = np.flatnonzero(np.abs(run.force_N - force_N) > 0.05 * force_N)
    late = run.force_N[-max(8, run.force_N.size // 10) :]
    return ThesisStep(
        float(max(run.force_N.max() - force_N, 0.0)),
        int(outside[-1] + 1 if outside.size else 0),
        float(abs(late.mean() - force_N)),
        float(late.std()),
    )
