"""How well poses alone can determine a lasting contact force: the Fisher information of many poses.

    python -m host.studies.benchmarks.pose_information

The rig's catheter under 0.2 N, as in the demo, with its two sensors. All poses share the force, the error of the curvature
and the force along the wall. In each pose the insertion is new to 0.1 mm and the roll to 0.016 rad, as in the running
estimator's steady state. No unbiased estimate has a smaller standard deviation.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from host.estimation.sensor_noise import TrackedSensors
from host.estimation.spatial_rig_kernels import ROWS_OF_POSE, UNKNOWNS, TrackedFrame, model, new_fit
from host.mechanics.cosserat import solve_cosserat
from host.mechanics.cosserat_kernels import ROW, WORK
from host.mechanics.rod import rod_record
from protocol.catheter import load_catheter
from protocol.rig_file import SIMULATED_RIG, load_rig

Array = NDArray[np.float64]

FORCE_N, INSERTION_m, CURVATURE_per_m = 0.2, -0.082, 19.5  # of the demo's contact
NEW_INSERTION_m, NEW_ROLL_rad, NEW_ACROSS_N = 1e-4, 0.016, 0.02
SHARED, NEW = (1, 2, 4), (0, 3, 5)  # of force along e1, e2, e3, insertion, curvature, roll
UNKNOWN = 1e3


class KnownBefore(NamedTuple):
    """Standard deviations before the poses are seen: force along the wall in the bending plane (N), curvature (1/m)."""

    along_N: float
    curvature_per_m: float


def of_one_pose() -> Array:
    """Information (6, 6) of one frame on the force in the base frame (3) and the errors of insertion, curvature and roll."""
    rig = load_rig(SIMULATED_RIG)
    catheter, sensors = load_catheter(rig.catheter.name), TrackedSensors.from_rig(rig)
    offsets = np.array([0.0, sensors.shaft_offset_m])
    on_tip = np.array([0.0, 0.0, -FORCE_N])
    shape = solve_cosserat(catheter, INSERTION_m, CURVATURE_per_m, on_tip, "base", stations_m=offsets)
    frame = TrackedFrame(
        rod_record(catheter, INSERTION_m, CURVATURE_per_m)[:6].copy(),
        catheter.distal_length_m,
        np.array([INSERTION_m, CURVATURE_per_m, 0.0]),
        offsets,
        np.hstack([shape.station_positions_m, shape.station_quaternions_wxyz]),
        sensors.position_std_m,
        sensors.angle_std_rad,
        np.zeros((0, 9)),
        np.zeros(0),
    )
    found, tangents = new_fit(2), np.zeros((2, ROWS_OF_POSE, UNKNOWNS))
    x = np.zeros(UNKNOWNS)
    for _ in range(20):  # the force in the tip frame that is `on_tip` in the base frame
        model(frame, x, np.zeros((3, ROW)), np.zeros(WORK), found, tangents)
        x[:3] += np.linalg.solve(found.by_x[:, :3], on_tip - found.force_N)
    std = np.repeat([sensors.position_std_m, sensors.angle_std_rad], 3)
    rows = (tangents / std[:, None]).reshape(-1, UNKNOWNS)
    by_base = np.linalg.inv(np.vstack([found.by_x, np.eye(3, UNKNOWNS, 3)]))
    return np.asarray((rows @ by_base).T @ (rows @ by_base))


def deviations(one: Array, count: int, known: KnownBefore) -> Array:
    """Standard deviations (3,) by `count` poses: of the force along the wall and across it (N), of the curvature (1/m)."""
    held = one + np.diag(np.array([NEW_ACROSS_N, np.inf, np.inf, NEW_INSERTION_m, np.inf, NEW_ROLL_rad]) ** -2.0)
    cross = held[np.ix_(SHARED, NEW)]
    shared = held[np.ix_(SHARED, SHARED)] - cross @ np.linalg.solve(held[np.ix_(NEW, NEW)], cross.T)
    before = np.diag([known.along_N**-2, 0.0, known.curvature_per_m**-2])
    return np.sqrt(np.diag(np.linalg.inv(count * shared + before)))


def main() -> None:
    """Print a row for each number of poses and each knowledge."""
    one = of_one_pose()
    print("| poses | known before: force along the wall, curvature | force along the wall | force across it | curvature |")
    print("|---|---|---|---|---|")
    cases = [KnownBefore(along_N, UNKNOWN) for along_N in (UNKNOWN, 0.02)]
    cases += [KnownBefore(0.02, curvature_per_m) for curvature_per_m in (0.2, 0.1, 0.05)]
    for count, known in product((1, 600, 2400), [*cases, KnownBefore(0.005, 0.2), KnownBefore(1e-6, UNKNOWN)]):
        along = "nothing" if known.along_N == UNKNOWN else f"{1e3 * known.along_N:.0f} mN"
        curvature = "nothing" if known.curvature_per_m == UNKNOWN else f"{known.curvature_per_m:g} 1/m"
        along_N, across_N, curvature_per_m = deviations(one, count, known)
        print(
            f"| {count} | {along}, {curvature} | {1e3 * along_N:.1f} mN | {1e3 * across_N:.1f} mN "
            f"| {curvature_per_m:.2f} 1/m |"
        )


if __name__ == "__main__":
    main()
