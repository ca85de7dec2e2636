"""A force on the tip and one on the body at once, from the poses of several sensors, with covariance (8.1.2).

The rod of chapter 3 carries both forces. Unknown are the tip's force (3), the body's force (3), its place (1) and small
errors of insertion, curvature and roll (3), of which something is known beforehand. Each pose gives six numbers. Little
friction is assumed at the body: its force along the shaft has a small standard deviation. What the poses leave open is said
in words and by `observable`; it is never returned as if it were known.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from host.estimation.contact_place import measured_poses
from host.estimation.sensor_noise import PoseSensor, chi_square_limit
from host.mechanics.cosserat import CosseratSolution, solve_cosserat
from host.mechanics.rod import finite, rod_record
from host.mechanics.rod_loads import PointLoad
from host.mechanics.rotations import conjugate, quaternion_product, rotation_matrix, vector_of_quaternion
from protocol.catheter import Catheter
from protocol.errors import InputError

Array = NDArray[np.float64]

TIP, BODY, PLACE, ERRORS = slice(0, 3), slice(3, 6), 6, slice(7, 10)
UNKNOWNS = 10
LARGEST_FORCE_N = 1.0
# Standard deviations before the poses are seen: of each component of a force, and of the body's along the shaft.
FORCE_SD_N, ALONG_SHAFT_SD_N = 1.0, 0.03
NEAREST_m = 0.004  # of the body's contact to tip and sheath: nearer it is one with them
PLACES = 4  # starting places along the exposed length
STEPS = np.array([1e-5] * 6 + [2e-5, 1e-6, 1e-3, 1e-5])  # of the difference quotients: N, m, m, 1/m, rad
ODD_DEVIATIONS = 5.0
MOST_STEPS, MOST_TRIALS, END_GAIN = 40, 8, 1e-4
SURE_DAMPING = 1e-3
FURTHEST_DEVIATIONS = 6.0  # of the actuation's errors from what is known of them
# What is observable: place and forces at least as sure as this, and a body force that is not nothing.
OBSERVABLE_m, OBSERVABLE_N, LEAST_DEVIATIONS = 0.010, 0.10, 4.0


@dataclass(frozen=True)
class ActuationPrior:
    """What is known of the errors of insertion (m), curvature (1/m) and roll (rad): mean (3,) and covariance (3, 3)."""

    mean: Array
    covariance: Array

    @classmethod
    def exact(cls) -> ActuationPrior:
        """Return a prior without errors, to a hundredth of what a tracker resolves."""
        return cls(np.zeros(3), np.diag(np.square([1e-5, 0.01, 1e-4])))


@dataclass(frozen=True)
class ContactsEstimate:
    """Forces on the catheter at tip and body, base frame, and where the body is touched."""

    tip_force_N: Array  # (3,)
    tip_covariance_N2: Array  # (3, 3)
    body_force_N: Array  # (3,)
    body_covariance_N2: Array  # (3, 3)
    body_offset_m: float  # back from the tip
    body_offset_sd_m: float
    covariance: Array  # (7, 7) of tip force, body force, place
    chi_square: float
    degrees_of_freedom: int
    converged: bool  # the two forces explain the poses
    observable: bool  # and the poses determine them
    warnings: tuple[str, ...]


def estimate_contacts(
    catheter: Catheter,
    insertion_m: float,
    curvature_per_m: float,
    sensors: Sequence[PoseSensor],
    *,
    roll_rad: float = 0.0,
    actuation: ActuationPrior | None = None,
    touching_tip: bool = True,
    places_m: ArrayLike | None = None,
) -> ContactsEstimate:
    """Estimate a force on the tip and one on the body from the poses of three sensors, or of two.

    Arguments: insertion_m, curvature_per_m, roll_rad as in `solve_cosserat`; sensors, poses in the base frame, from the tip
    backwards; actuation, what is known of the errors of those three, by default that there are none; touching_tip, False
    where the tip is known to be free; places_m, starting places back from the tip, by default PLACES along the shaft.
    Result: `ContactsEstimate`; where `observable` is False the `warnings` say what is open. Raises: InputError.
    """
    search = search_contacts(
        catheter,
        insertion_m,
        curvature_per_m,
        sensors,
        roll_rad=roll_rad,
        actuation=actuation,
        touching_tip=touching_tip,
        places_m=places_m,
    )
    while True:
        try:
            next(search)
        except StopIteration as end:
            found: ContactsEstimate = end.value
            return found


def search_contacts(
    catheter: Catheter,
    insertion_m: float,
    curvature_per_m: float,
    sensors: Sequence[PoseSensor],
    *,
    roll_rad: float = 0.0,
    actuation: ActuationPrior | None = None,
    touching_tip: bool = True,
    places_m: ArrayLike | None = None,
) -> Generator[None, None, ContactsEstimate]:
    """Estimate as `estimate_contacts` does, in parts of some 15 ms of one core: a generator that returns the estimate.

    Raises: InputError, at the first part.
    """
    problem = _Problem(catheter, insertion_m, curvature_per_m, roll_rad, sensors, actuation or ActuationPrior.exact())
    starts = problem.starting_places() if places_m is None else np.atleast_1d(finite_places(places_m))
    best: tuple[float, Array, Array] | None = None
    for place in starts:
        found = yield from problem.descend(problem.start(float(place)), touching_tip)
        if best is None or found[0] < best[0]:
            best = found
    assert best is not None
    return problem.report(*best, touching_tip)


def finite_places(places_m: ArrayLike) -> Array:
    """`places_m` as finite floats (n,). Raises InputError."""
    places = np.asarray(places_m, dtype=float)
    return finite("places_m", places, places.shape, "finite lengths in m")


class _Problem:
    def __init__(
        self,
        catheter: Catheter,
        insertion_m: float,
        curvature_per_m: float,
        roll_rad: float,
        sensors: Sequence[PoseSensor],
        prior: ActuationPrior,
    ) -> None:
        rod = rod_record(catheter, insertion_m, curvature_per_m)
        if len(sensors) < 2:
            raise InputError("sensors", len(sensors), "at least 2, to separate a contact of the body from one of the tip")
        self._catheter, self._total_m = catheter, float(rod[6] + rod[7])
        if self._total_m < 3.0 * NEAREST_m:
            raise InputError("insertion_m", insertion_m, f"more than {1e3 * 3.0 * NEAREST_m:.0f} mm outside the sheath")
        self._joint = np.array([insertion_m, curvature_per_m, roll_rad])
        self._offsets, self._positions, self._quaternions, self._weights = measured_poses(sensors)
        self._prior, self._root = prior, np.linalg.inv(np.linalg.cholesky(prior.covariance))

    def starting_places(self) -> Array:
        return np.linspace(NEAREST_m, self._total_m - NEAREST_m, PLACES + 2)[1:-1]

    def start(self, place_m: float) -> Array:
        x = np.zeros(UNKNOWNS)
        x[PLACE] = min(max(place_m, NEAREST_m), self._total_m - NEAREST_m)
        x[ERRORS] = self._prior.mean
        return x

    def _solve(self, x: Array) -> CosseratSolution:
        insertion, curvature, roll = self._joint + x[ERRORS]
        stations = [*self._offsets, x[PLACE]]
        return solve_cosserat(
            self._catheter,
            float(insertion),
            float(curvature),
            x[TIP],
            "base",
            stations_m=stations,
            roll_rad=float(roll),
            point_loads=[PointLoad(float(x[PLACE]), x[BODY])],
        )

    def residual(self, x: Array) -> Array:
        """Weighted residuals: poses (6 k), the prior's of the actuation (3), of the forces (6), of friction (1)."""
        found = self._solve(x)
        k = len(self._offsets)
        if not found.converged:
            return np.full(6 * k + 10, 1e3)
        z = np.empty((k, 6))
        for i in range(k):
            z[i, :3] = self._positions[i] - found.station_positions_m[i]
            turn = quaternion_product(conjugate(found.station_quaternions_wxyz[i]), self._quaternions[i])
            z[i, 3:] = vector_of_quaternion(turn)
        tangent = rotation_matrix(found.station_quaternions_wxyz[k])[:, 2]
        return np.concatenate(
            [
                np.einsum("kij,kj->ki", self._weights, z).ravel(),
                self._root @ (x[ERRORS] - self._prior.mean),
                x[:6] / FORCE_SD_N,
                [float(tangent @ x[BODY]) / ALONG_SHAFT_SD_N],
            ]
        )

    def descend(self, start: Array, touching_tip: bool) -> Generator[None, None, tuple[float, Array, Array]]:
        """Levenberg-Marquardt from one start, a part for each Jacobian; the tip's force stays 0 where it does not touch.

        Returns cost, unknowns (10,) and Jacobian (n, 10) at the answer.
        """
        free = np.arange(UNKNOWNS) if touching_tip else np.arange(3, UNKNOWNS)
        x, z, damping = start.copy(), self.residual(start), 1e-3
        cost, jacobian = float(z @ z), np.zeros((len(z), UNKNOWNS))
        for _ in range(MOST_STEPS):
            jacobian[:, free] = np.column_stack([self._slope(x, z, int(c)) for c in free])
            yield
            J = jacobian[:, free]
            H, g = J.T @ J, -J.T @ z
            diagonal = np.diag(np.maximum(np.diag(H), 1e-12 * float(np.trace(H))))
            for _ in range(MOST_TRIALS):
                trial = self._within(x, free, np.linalg.solve(H + damping * diagonal, g).astype(np.float64))
                z_new = self.residual(trial)
                new = float(z_new @ z_new)
                if new < cost:
                    break
                damping *= 10.0
            else:
                break
            gained, cost, x, z = cost - new, new, trial, z_new
            if gained < END_GAIN * (1.0 + cost) and damping < SURE_DAMPING:  # not only held back by the damping
                break
            damping = max(0.1 * damping, 1e-9)
        return cost, x, jacobian

    def _slope(self, x: Array, z: Array, unknown: int) -> Array:
        moved = x.copy()
        beyond = unknown == PLACE and x[PLACE] + STEPS[PLACE] > self._total_m - NEAREST_m
        step = -STEPS[unknown] if beyond else STEPS[unknown]
        moved[unknown] += step
        return (self.residual(moved) - z) / step

    def _within(self, x: Array, free: NDArray[np.int64], step: Array) -> Array:
        """`x` after a step, the forces at most LARGEST_FORCE_N and the place on the shaft."""
        out = x.copy()
        out[free] += step
        for force in (TIP, BODY):
            out[force] *= min(1.0, LARGEST_FORCE_N / max(float(np.linalg.norm(out[force])), 1e-300))
        spread = FURTHEST_DEVIATIONS * np.sqrt(np.diag(self._prior.covariance))
        out[ERRORS] = np.clip(out[ERRORS], self._prior.mean - spread, self._prior.mean + spread)
        exposed_m = self._total_m + min(float(out[ERRORS][0]), 0.0)
        out[PLACE] = min(max(out[PLACE], NEAREST_m), max(exposed_m - NEAREST_m, NEAREST_m))
        return out

    def report(self, cost: float, x: Array, jacobian: Array, touching_tip: bool) -> ContactsEstimate:
        first = 0 if touching_tip else 3
        information = jacobian[:, first:].T @ jacobian[:, first:]
        scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-12))
        joint = np.zeros((UNKNOWNS, UNKNOWNS))
        joint[first:, first:] = np.linalg.pinv(information * np.outer(scale, scale), rcond=1e-12) * np.outer(scale, scale)
        place_sd = float(np.sqrt(joint[PLACE, PLACE]))
        freedom = 6 * len(self._offsets) - (7 if touching_tip else 4)
        converged = bool(cost <= chi_square_limit(max(freedom, 1), ODD_DEVIATIONS))
        notes = self._notes(x, joint, converged, cost, place_sd, touching_tip)
        return ContactsEstimate(
            x[TIP].copy(),
            joint[TIP, TIP],
            x[BODY].copy(),
            joint[BODY, BODY],
            float(x[PLACE]),
            place_sd,
            joint[:7, :7],
            cost,
            freedom,
            converged,
            not notes,
            tuple(notes),
        )

    def _notes(self, x: Array, joint: Array, converged: bool, cost: float, place_sd: float, touching_tip: bool) -> list[str]:
        """Return the quantities that the poses do not determine, in words; empty if all are observable."""
        notes, body_sd = [], np.sqrt(np.linalg.eigvalsh(joint[BODY, BODY]))
        size = float(np.linalg.norm(x[BODY]))
        along = x[BODY] / max(size, 1e-12)
        size_sd = float(np.sqrt(along @ joint[BODY, BODY] @ along))
        if not converged:
            notes.append(f"a force on the tip and one on the body do not explain these poses (chi square {cost:.3g})")
        if size < LEAST_DEVIATIONS * size_sd:
            notes.append(f"not observable: the body's force is {1e3 * size:.0f} mN +- {1e3 * size_sd:.0f} mN, perhaps none")
        if place_sd > OBSERVABLE_m:
            notes.append(f"not observable: the place is only known to +-{1e3 * place_sd:.0f} mm")
        if body_sd[-1] > OBSERVABLE_N:
            notes.append(f"not observable: one component of the body's force is only known to +-{body_sd[-1]:.2g} N")
        if touching_tip:
            tip_sd = np.sqrt(np.linalg.eigvalsh(joint[TIP, TIP]))
            if tip_sd[-1] > OBSERVABLE_N:
                notes.append(f"not observable: one component of the tip's force is only known to +-{tip_sd[-1]:.2g} N")
        return notes
