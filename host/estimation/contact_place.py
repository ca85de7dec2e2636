"""Contact away from the tip: where along the catheter a force acts, and which, from the poses of several sensors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from host.estimation.sensor_noise import (
    ORIENTATION_STD_rad,
    PoseSensor,
    POSITION_STD_m,
    checked_covariance,
    checked_quaternion,
    chi_square_limit,
)
from host.estimation.spatial import GATE, LARGEST_FORCE_N, ODD_DEVIATIONS, WEAK_STD_N
from host.estimation.spatial_residuals import section_tangents
from host.mechanics import sections
from host.mechanics.rod import finite, rod_record
from host.mechanics.rotations import conjugate, quaternion_product, rotation_matrix, skew, vector_of_quaternion
from protocol.catheter import Catheter
from protocol.errors import InputError

Array = NDArray[np.float64]

PLACES = 9  # tried along the exposed length before the place is set free
STEP_m = 2e-5  # of the difference quotient by the place
WEAK_PLACE_m = 0.01
MOST_ITERATIONS = 40
Model = Callable[[Array], tuple[Array, Array]]


@dataclass(frozen=True)
class ContactEstimate:
    """Estimate of a force along the catheter and of its place."""

    force_N: Array  # (3,) tip frame
    covariance_N2: Array  # (3, 3)
    converged: bool
    residual: float  # dimensionless, as in `SpatialEstimate`
    chi_square: float
    degrees_of_freedom: int
    warnings: tuple[str, ...]
    contact_offset_m: float  # where the force acts, back from the tip
    contact_offset_std_m: float


def estimate_contact(
    catheter: Catheter,
    insertion_m: float,
    curvature_per_m: float,
    sensors: Sequence[PoseSensor],
    *,
    largest_force_N: float = LARGEST_FORCE_N,
) -> ContactEstimate:
    """One force anywhere on the exposed catheter, from the absolute poses of two or more sensors (three to be sure).

    Arguments: insertion_m, curvature_per_m as in `solve_cosserat`; sensors, poses in the base frame of zero roll.
    Result: force in the tip frame (the tip beyond the contact is not bent by it), `contact_offset_m` back from the tip
    with its standard deviation; four unknowns. Beyond the contact the catheter keeps its unloaded shape.
    Raises: InputError naming the key.
    """
    rod = rod_record(catheter, insertion_m, curvature_per_m)
    if len(sensors) < 2:
        raise InputError("sensors", len(sensors), "at least 2, to find a place as well as a force")
    offsets, positions, quaternions, weights = measured_poses(sensors)
    total = float(rod[6] + rod[7])
    shortest = 0.15 * total

    def model(unknown: Array) -> tuple[Array, Array]:
        z, A = _residual(rod, offsets, positions, quaternions, unknown)
        return np.einsum("kij,kj->ki", weights, z).ravel(), np.einsum("kij,kjc->kic", weights, A).reshape(-1, 4)

    best, best_cost = np.zeros(4), np.inf
    for place in np.linspace(0.0, total - shortest, PLACES):
        found, cost = _descend(model, np.array([0.0, 0.0, 0.0, place]), 3, total - shortest, largest_force_N)
        if cost < best_cost:
            best, best_cost = found, cost
    best, best_cost = _descend(model, best, 4, total - shortest, largest_force_N)
    return _report(model, best, best_cost, rod, catheter.distal_length_m, offsets, positions, quaternions)


def measured_poses(sensors: Sequence[PoseSensor]) -> tuple[Array, Array, Array, Array]:
    """Offsets (k,), positions (k, 3), quaternions (k, 4), inverse roots (k, 6, 6) of the poses' covariances."""
    k = len(sensors)
    offsets, positions, quaternions, weights = np.empty(k), np.empty((k, 3)), np.empty((k, 4)), np.zeros((k, 6, 6))
    for i, sensor in enumerate(sensors):
        key = f"sensors.{i}"
        offsets[i] = finite(f"{key}.offset_m", sensor.offset_m, (), "an arc length in m")
        positions[i] = finite(f"{key}.position_m", sensor.position_m, (3,), "three finite numbers in m")
        quaternions[i] = checked_quaternion(f"{key}.quaternion_wxyz", sensor.quaternion_wxyz)
        blocks = (
            checked_covariance(f"{key}.position_covariance_m2", sensor.position_covariance_m2, POSITION_STD_m),
            checked_covariance(
                f"{key}.orientation_covariance_rad2", sensor.orientation_covariance_rad2, ORIENTATION_STD_rad
            ),
        )
        for j, block in enumerate(blocks):
            weights[i, 3 * j : 3 * j + 3, 3 * j : 3 * j + 3] = np.linalg.inv(np.linalg.cholesky(block))
    if np.any(offsets < 0.0) or np.any(np.diff(offsets) <= 0.0):
        raise InputError("sensors.offset_m", offsets.tolist(), "0 or more and growing from the tip backwards")
    return offsets, positions, quaternions, weights


def poses_with_contact(rod: Array, offsets: Array, force: Array, place: float) -> tuple[Array, Array, Array, Array]:
    """Poses of sensors when `force` (3,), in the frame of the section `place` m back from the tip, acts there.

    Result: positions (k, 3), quaternions (k, 4), their motion (k, 3, 3; base frame) and turn (k, 3, 3; own frame) by it.
    The part behind the contact is a shorter rod with a force at its tip; the part beyond is carried along.
    """
    behind = rod.copy()
    behind[6], behind[7] = max(rod[6] - place, 0.0), rod[7] - max(place - rod[6], 0.0)
    back, at, inside = sections.exposed(behind, np.maximum(offsets - place, 0.0))
    rows = sections.exact_rows(behind, force, back)
    k = len(offsets)
    r, q, move, turn = np.empty((k, 3)), np.empty((k, 4)), np.empty((k, 3, 3)), np.empty((k, 3, 3))
    for i in range(k):
        row = rows[at[i]]
        sections.section_pose(rows[-1], row, inside[i], r[i], q[i])
        section_tangents(rows[-1], row, rotation_matrix(q[i]), turn[i], move[i])
        if offsets[i] < place:
            arm, bend = beyond_contact(rod, place, offsets[i])
            R = rotation_matrix(q[i])
            move[i] -= R @ skew(arm) @ turn[i]
            r[i] += R @ arm
            q[i] = quaternion_product(q[i], bend)
            turn[i] = rotation_matrix(bend).T @ turn[i]
    return r, q, move, turn


def beyond_contact(rod: Array, place: float, offset: float) -> tuple[Array, Array]:
    """Pose of the section `offset` seen from the section `place` behind it, unloaded: straight body, then an arc."""
    straight = max(place - max(offset, rod[6]), 0.0)
    length = max(min(place, rod[6]) - offset, 0.0)
    half = 0.5 * rod[8] * length
    chord = length * np.sinc(half / np.pi)
    arm = np.array([0.0, -chord * np.sin(half), straight + chord * np.cos(half)])
    return arm, np.array([np.cos(half), np.sin(half), 0.0, 0.0])


def _residual(rod: Array, offsets: Array, positions: Array, quaternions: Array, unknown: Array) -> tuple[Array, Array]:
    """Measured minus modelled (k, 6) and the model's sensitivity (k, 6, 4) to force and place."""
    force, place = unknown[:3], float(unknown[3])
    r, q, move, turn = poses_with_contact(rod, offsets, force, place)
    step = STEP_m if place > STEP_m else 0.0
    ahead, behind = (poses_with_contact(rod, offsets, force, place + s) for s in (STEP_m, -step))
    z, A = np.empty((len(offsets), 6)), np.empty((len(offsets), 6, 4))
    for i in range(len(offsets)):
        z[i, :3] = positions[i] - r[i]
        z[i, 3:] = vector_of_quaternion(quaternion_product(conjugate(q[i]), quaternions[i]))
        A[i, :3, :3], A[i, 3:, :3] = move[i], turn[i]
        A[i, :3, 3] = (ahead[0][i] - behind[0][i]) / (STEP_m + step)
        A[i, 3:, 3] = vector_of_quaternion(quaternion_product(conjugate(behind[1][i]), ahead[1][i])) / (STEP_m + step)
    return z, A


def _descend(model: Model, start: Array, free: int, longest: float, largest: float) -> tuple[Array, float]:
    """Levenberg-Marquardt in the first `free` unknowns, inside the exposed length and the largest force."""
    x = start.copy()
    z, A = model(x)
    cost, damping = float(z @ z), 1e-3
    for _ in range(MOST_ITERATIONS):
        J = A[:, :free]
        H = J.T @ J
        step = np.linalg.solve(H + damping * np.diag(np.diag(H)) + 1e-12 * np.trace(H) * np.eye(free), J.T @ z)
        trial = x.copy()
        trial[:free] += step
        trial[3] = min(max(trial[3], 0.0), longest)
        size = float(np.linalg.norm(trial[:3]))
        trial[:3] *= min(1.0, largest / max(size, 1e-300))
        new_z, new_A = model(trial)
        new = float(new_z @ new_z)
        if new < cost:
            moved = np.abs(trial - x)
            x, z, A, cost, damping = trial, new_z, new_A, new, max(0.1 * damping, 1e-9)
            if moved[:3].max() < 1e-8 and moved[3] < 1e-8:
                break
        else:
            damping *= 10.0
            if damping > 1e9:
                break
    return x, cost


def _report(
    model: Model, x: Array, cost: float, rod: Array, length: float, offsets: Array, positions: Array, quaternions: Array
) -> ContactEstimate:
    _, A = model(x)
    information = A.T @ A + np.diag([1e-2, 1e-2, 1e-2, 1.0 / (rod[6] + rod[7]) ** 2])
    joint = np.linalg.inv(information)
    _, bend = beyond_contact(rod, float(x[3]), 0.0)
    T = rotation_matrix(bend).T
    covariance = (T @ joint[:3, :3] @ T.T).astype(np.float64)
    values = np.linalg.eigvalsh(covariance)
    freedom = max(6 * len(offsets) - 4, 0)
    converged = bool(cost <= GATE**2 * 6 * len(offsets) and np.all(np.isfinite(x)))
    z, _ = _residual(rod, offsets, positions, quaternions, x)
    residual = float(np.sqrt(np.sum((z[:, :3] / length) ** 2) + np.sum(z[:, 3:] ** 2)))
    place_std, weakest, notes = float(np.sqrt(joint[3, 3])), float(np.sqrt(values[-1])), []
    if not converged:
        notes.append(f"no single force explains these poses: residual {residual:.3g}")
    elif cost > chi_square_limit(freedom, ODD_DEVIATIONS):
        notes.append(f"larger residual than noise leaves (chi square {cost:.3g} for {freedom} degrees of freedom)")
    if place_std > WEAK_PLACE_m:
        notes.append(f"weakly observed: the place of the contact is only known to +-{place_std * 1e3:.0f} mm")
    if weakest > WEAK_STD_N:
        notes.append(f"weakly observed: one component of the force is only known to +-{weakest:.2g} N")
    force = T @ x[:3]
    return ContactEstimate(force, covariance, converged, residual, cost, freedom, tuple(notes), float(x[3]), place_std)
