"""A force on the tip and one on the body at once, from the poses of several sensors, with covariance (8.1.2).

The rod of chapter 3 carries both forces. Unknown are the tip's force (3), the body's force (3), its place (1) and small
errors of insertion, curvature and roll (3), of which something is known beforehand. Each pose gives six numbers. Little
friction is assumed at the body: its force along the shaft has a small standard deviation. What the poses leave open is said
in words and by `observable`; it is never returned as if it were known.

The poses show the moment of the body's force well, its size and its place less well: the probable answers lie on a curve.
A linearized model states a covariance that is too small across it. Therefore the place is not linearized. At each place of
a grid the other unknowns x are fitted; given the place, they are nearly linear. With the cost c (chi square) and the
covariance C of x at a place, the density of the place is proportional to exp(-c / 2) sqrt(det C). Mean and covariance are

    mean = sum of w x,   covariance = sum of w (C + (x - mean) (x - mean)'),   w: density times width of the cell,

with p a component of x (integrated nested Laplace approximation; Rue, Martino and Chopin, J. R. Stat. Soc. B 71, 2009). The
grid covers the shaft, so a second minimum is not missed; its cells are halved where the probability is.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from host.estimation.contact_place import measured_poses
from host.estimation.sensor_noise import PoseSensor, chi_square_limit
from host.mechanics.cosserat import CosseratSolution, solve_cosserat
from host.mechanics.rod import rod_record
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
PLACES = 7  # of the first grid, along the exposed length
# A cell of the grid is halved while it is wider than this next to a minimum of the cost, unless that minimum exceeds the
# best by so much, and while it holds more than this share of the probability; up to so many places.
WIDEST_m, HOPELESS, LARGEST_SHARE, MOST_PLACES = 0.003, 30.0, 0.12, 48
STEPS = np.array([1e-5] * 6 + [np.nan, 1e-6, 1e-3, 1e-5])  # of the difference quotients: N, -, m, 1/m, rad
ODD_DEVIATIONS = 5.0
MOST_STEPS, MOST_TRIALS = 8, 8  # more are needed only at places that are far from any answer
UNSOLVED = 1e3  # residual where the rod has no solution
# Relative. The information, scaled to a unit diagonal, has a condition number of some 6000: with 1e-4 and an end by small
# gains, fits stopped at a chi square of 18.7 instead of 11.7.
LEAST_DAMPING = 1e-9
END_DECREMENT = 0.1  # of the chi square, expected of the last step; what remains after it is of second order
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
) -> ContactsEstimate:
    """Estimate a force on the tip and one on the body from the poses of three sensors, or of two.

    Arguments: insertion_m, curvature_per_m, roll_rad as in `solve_cosserat`; sensors, poses in the base frame, from the tip
    backwards; actuation, what is known of the errors of those three, by default that there are none; touching_tip, False
    where the tip is known to be free.
    Result: `ContactsEstimate`, mean and covariance over the places; where `observable` is False the `warnings` say what is
    open. Raises: InputError.
    """
    search = search_contacts(
        catheter,
        insertion_m,
        curvature_per_m,
        sensors,
        roll_rad=roll_rad,
        actuation=actuation,
        touching_tip=touching_tip,
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
) -> Generator[None, None, ContactsEstimate]:
    """Estimate as `estimate_contacts` does, in parts of some 15 ms of one core: a generator that returns the estimate.

    Raises: InputError, at the first part.
    """
    problem = _Problem(catheter, insertion_m, curvature_per_m, roll_rad, sensors, actuation or ActuationPrior.exact())
    free = np.array([*(range(6) if touching_tip else range(3, 6)), *range(7, UNKNOWNS)])
    fits: list[_PlaceFit] = []
    for place_m in np.linspace(NEAREST_m, problem.total_m - NEAREST_m, PLACES):
        start = fits[-1].x if fits else problem.start()
        fits.append((yield from problem.fit_at(float(place_m), start, free)))
    while len(fits) < MOST_PLACES and (cell := _cell_to_halve(fits)) is not None:
        before, after = fits[cell : cell + 2]
        start = 0.5 * (before.x + after.x)
        found = yield from problem.fit_at(float(start[PLACE]), start, free)
        better = min(before, after, key=lambda fit: fit.cost)
        if found.cost > max(before.cost, after.cost):  # between two minima, or a fit that was caught
            again = yield from problem.fit_at(float(start[PLACE]), better.x, free)
            found = min(found, again, key=lambda fit: fit.cost)
        fits.insert(cell + 1, found)
    return problem.report(fits, touching_tip)


class _PlaceFit(NamedTuple):
    """The best answer with the body's force at one place."""

    x: Array  # (10,)
    cost: float
    covariance: Array  # (10, 10) given the place; 0 in the rows of what is not free
    log_volume: float  # half the logarithm of the covariance's determinant


def _densities(fits: list[_PlaceFit]) -> Array:
    """Probability densities of the places, relative to the largest."""
    logs = np.array([fit.log_volume - 0.5 * fit.cost for fit in fits])
    return np.asarray(np.exp(logs - logs.max()))


def _shares(fits: list[_PlaceFit]) -> Array:
    """Share of the probability in each cell between two places."""
    density = _densities(fits)
    cells = 0.5 * (density[1:] + density[:-1]) * np.diff([fit.x[PLACE] for fit in fits])
    return np.asarray(cells / cells.sum())


def _cell_to_halve(fits: list[_PlaceFit]) -> int | None:
    """Return the number of a cell that is too wide, first at each minimum of the cost, then by share; None if none is."""
    costs, places = np.array([fit.cost for fit in fits]), np.array([fit.x[PLACE] for fit in fits])
    padded = np.concatenate([[np.inf], costs, [np.inf]])
    for i in np.flatnonzero((costs <= padded[:-2]) & (costs <= padded[2:]) & (costs < costs.min() + HOPELESS)):
        for cell in (i - 1, i):
            if 0 <= cell < len(fits) - 1 and places[cell + 1] - places[cell] > WIDEST_m:
                return int(cell)
    shares = _shares(fits)
    return int(np.argmax(shares)) if shares.max() > LARGEST_SHARE else None


def _moments(fits: list[_PlaceFit]) -> tuple[Array, Array]:
    """Mean (10,) and covariance (10, 10) over the places, by the trapezoidal rule."""
    density, width = _densities(fits), np.diff([fit.x[PLACE] for fit in fits])
    weights = 0.5 * density * (np.append(width, 0.0) + np.append(0.0, width))
    weights /= weights.sum()
    answers = np.array([fit.x for fit in fits])
    mean = weights @ answers
    away = answers - mean
    between = np.einsum("k,ki,kj->ij", weights, away, away)
    within = np.einsum("k,kij->ij", weights, np.array([fit.covariance for fit in fits]))
    return mean, between + within


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
        self._catheter, self.total_m = catheter, float(rod[6] + rod[7])
        if self.total_m < 3.0 * NEAREST_m:
            raise InputError("insertion_m", insertion_m, f"more than {1e3 * 3.0 * NEAREST_m:.0f} mm outside the sheath")
        self._joint = np.array([insertion_m, curvature_per_m, roll_rad])
        self._offsets, self._positions, self._quaternions, self._weights = measured_poses(sensors)
        self._prior, self._root = prior, np.linalg.inv(np.linalg.cholesky(prior.covariance))

    def start(self) -> Array:
        x = np.zeros(UNKNOWNS)
        x[ERRORS] = self._prior.mean
        return x

    def _solve(self, x: Array) -> CosseratSolution:
        insertion, curvature, roll = self._joint + x[ERRORS]
        # An error of the insertion shortens what is outside.
        place_m = min(float(x[PLACE]), self.total_m + float(x[ERRORS][0]) - 0.5 * NEAREST_m)
        stations = [*self._offsets, place_m]
        return solve_cosserat(
            self._catheter,
            float(insertion),
            float(curvature),
            x[TIP],
            "base",
            stations_m=stations,
            roll_rad=float(roll),
            point_loads=[PointLoad(place_m, x[BODY])],
        )

    def residual(self, x: Array) -> Array:
        """Weighted residuals: poses (6 k), the prior's of the actuation (3), of the forces (6), of friction (1)."""
        found = self._solve(x)
        k = len(self._offsets)
        if not found.converged:
            return np.full(6 * k + 10, UNSOLVED)
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

    def fit_at(self, place_m: float, start: Array, free: NDArray[np.int64]) -> Generator[None, None, _PlaceFit]:
        """Levenberg-Marquardt in the unknowns `free` with the place fixed, a part for each Jacobian."""
        x = start.copy()
        x[PLACE] = place_m
        z, damping = self.residual(x), LEAST_DAMPING
        cost = float(z @ z)
        for _ in range(MOST_STEPS):
            J = np.column_stack([self._slope(x, z, int(c)) for c in free])
            yield
            H, g = J.T @ J, -J.T @ z
            diagonal = np.diag(np.maximum(np.diag(H), 1e-12 * float(np.trace(H)) + 1e-12))
            for _ in range(MOST_TRIALS):
                trial = self._within(x, free, np.linalg.solve(H + damping * diagonal, g).astype(np.float64))
                z_new = self.residual(trial)
                new = float(z_new @ z_new)
                if new < cost:
                    break
                damping *= 50.0
            else:
                break
            cost, x, z = new, trial, z_new
            # What the undamped step promised: the gain itself is small, too, where damping holds a weak direction back.
            if float(g @ np.linalg.solve(H + LEAST_DAMPING * diagonal, g)) < END_DECREMENT:
                break
            damping = max(0.01 * damping, LEAST_DAMPING)
        scale = 1.0 / np.sqrt(np.diag(diagonal))
        covariance = np.zeros((UNKNOWNS, UNKNOWNS))
        # Every unknown has a prior, so the information is regular where the rod has a solution; elsewhere the cost decides.
        values, axes = np.linalg.eigh(H * np.outer(scale, scale))
        values = np.maximum(values, 1e-12)
        covariance[np.ix_(free, free)] = (axes / values) @ axes.T * np.outer(scale, scale)
        log_volume = float(np.log(scale).sum() - 0.5 * np.log(values).sum())
        return _PlaceFit(x, cost, covariance, log_volume)

    def _slope(self, x: Array, z: Array, unknown: int) -> Array:
        for step in (STEPS[unknown], -STEPS[unknown]):
            moved = x.copy()
            moved[unknown] += step
            there = self.residual(moved)
            if there[0] != UNSOLVED:
                return np.asarray((there - z) / step)
        return np.zeros(len(z))

    def _within(self, x: Array, free: NDArray[np.int64], step: Array) -> Array:
        """`x` after a step, the forces at most LARGEST_FORCE_N, the errors at most FURTHEST_DEVIATIONS."""
        out = x.copy()
        out[free] += step
        for force in (TIP, BODY):
            out[force] *= min(1.0, LARGEST_FORCE_N / max(float(np.linalg.norm(out[force])), 1e-300))
        spread = FURTHEST_DEVIATIONS * np.sqrt(np.diag(self._prior.covariance))
        out[ERRORS] = np.clip(out[ERRORS], self._prior.mean - spread, self._prior.mean + spread)
        return out

    def report(self, fits: list[_PlaceFit], touching_tip: bool) -> ContactsEstimate:
        x, joint = _moments(fits)
        cost = min(fit.cost for fit in fits)
        place_sd = float(np.sqrt(joint[PLACE, PLACE]))
        freedom = 6 * len(self._offsets) - (7 if touching_tip else 4)
        converged = bool(cost <= chi_square_limit(max(freedom, 1), ODD_DEVIATIONS))
        notes = self._notes(min(fits, key=lambda fit: fit.cost), joint, converged, place_sd, touching_tip)
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

    def _notes(self, best: _PlaceFit, joint: Array, converged: bool, place_sd: float, touching_tip: bool) -> list[str]:
        """Return the quantities that the poses do not determine, in words; empty if all are observable."""
        notes, body_sd = [], np.sqrt(np.linalg.eigvalsh(joint[BODY, BODY]))
        # Whether there is a force on the body is asked of the best answer, given its place: without a force there is none.
        size = float(np.linalg.norm(best.x[BODY]))
        along = best.x[BODY] / max(size, 1e-12)
        size_sd = float(np.sqrt(along @ best.covariance[BODY, BODY] @ along))
        if not converged:
            notes.append(f"a force on the tip and one on the body do not explain these poses (chi square {best.cost:.3g})")
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
