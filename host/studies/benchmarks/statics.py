"""Benchmarks of the spatial statics: force in the tip frame, in the base frame cold and warm, few helical segments."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import njit
from numpy.typing import NDArray

from host.mechanics.base_force import solve_cold, solve_warm
from host.mechanics.branch import CONVERGED
from host.mechanics.cosserat_kernels import FINE, POSE, ROW, WORK, sweep
from host.mechanics.helical import chain_of, tip_of
from host.mechanics.helical_kernels import load_up
from host.mechanics.thesis_reference import ELEMENTS, ORIENTATION_THRESHOLD, algorithm_3_1, euler_sweep
from host.mechanics.tip_shooting import UNIQUE_BELOW, load_number
from host.studies.benchmarks import boundary_value
from host.studies.benchmarks.runner import PairedTimes, Report, Row, alternate, row_of
from host.studies.benchmarks.spatial_cases import NO_STATIONS, SpatialCase, direction, random_cases

Array = NDArray[np.float64]

CASES, MANY, LARGEST_NUMBER = 60, 300, 62.0
RIGHT_m = 1e-3  # an answer further off at the tip is another equilibrium
AWAY = 0.02  # of a warm start
BVP_TOLERANCE = 1e-6
TENSION_N = 0.0


@njit(cache=True, nogil=True)
def _sweeps(rod: Array, force: Array, bend: float, out: Array, work: Array, repeats: int) -> None:
    for _ in range(repeats):
        sweep(rod, force, NO_STATIONS, bend, POSE, out, work)


@njit(cache=True, nogil=True)
def _cold(rod: Array, force: Array, x: Array, out: Array, work: Array, repeats: int) -> int:
    status = 0
    for _ in range(repeats):
        status, _, _, _, _ = solve_cold(rod, force, NO_STATIONS, FINE, x, out, work)
    return status


@njit(cache=True, nogil=True)
def _warm(rod: Array, force: Array, start: Array, x: Array, out: Array, work: Array, repeats: int) -> bool:
    done = False
    for _ in range(repeats):
        x[:] = start
        done, _ = solve_warm(rod, force, NO_STATIONS, FINE, x, out, work)
        if not done:
            status, _, _, _, _ = solve_cold(rod, force, NO_STATIONS, FINE, x, out, work)
            done = status == CONVERGED
    return done


@njit(cache=True, nogil=True)
def _helical(chain: Array, force: Array, first: float, u: Array, repeats: int) -> bool:
    done = False
    for _ in range(repeats):
        done, _, _, _ = load_up(chain, force, first, u)
    return done


class SolveCalls:
    """One case on our side: keeps what the last run left, so that its error can be read after the timing."""

    def __init__(self, case: SpatialCase, run: Callable[[Array, Array, Array, int], object]) -> None:
        self.case, self.x, self.out, self.work = case, np.zeros(3), np.zeros((1, ROW)), np.zeros(WORK)
        self._run = run

    def __call__(self, repeats: int) -> object:
        """Solve the case `repeats` times in compiled code."""
        self.outcome = self._run(self.x, self.out, self.work, repeats)
        return self.outcome

    @property
    def error_m(self) -> float:
        """Distance of the tip from the reference."""
        return float(np.linalg.norm(-self.out[0, :3] - self.case.tip_position_m))


class SolvePeer:
    """One case on the peer's side; `run` returns the tip position, or None where it gave up."""

    def __init__(self, case: SpatialCase, run: Callable[[], Array | None]) -> None:
        self.case, self._run = case, run
        self.position: Array | None = None

    def __call__(self) -> object:
        """Solve the case once and keep the tip's position."""
        with np.errstate(all="ignore"):
            self.position = self._run()
        return self.position

    @property
    def error_m(self) -> float:
        """Distance of the tip from the reference; infinite where there is no answer."""
        return np.inf if self.position is None else float(np.linalg.norm(self.position - self.case.tip_position_m))


def compared(name: str, variant: str, peer: str, ours: list[SolveCalls], peers: list[SolvePeer], seed: int) -> Row:
    """Both sides timed, with the median and largest tip error of the answers that are the reference's equilibrium."""
    for mine, theirs in zip(ours[:1], peers[:1], strict=True):
        mine(1), theirs()
    timed: PairedTimes = alternate(ours, peers)
    errors = [np.array([side.error_m for side in sides]) for sides in (ours, peers)]
    found = [e[e < RIGHT_m] if np.any(e < RIGHT_m) else np.array([np.inf]) for e in errors]
    return row_of(
        name,
        variant,
        peer,
        timed,
        seed,
        tip_error_m=float(np.median(found[0])),
        tip_error_max_m=float(found[0].max()),
        peer_tip_error_m=float(np.median(found[1])),
        peer_tip_error_max_m=float(found[1].max()),
        right=int(np.sum(errors[0] < RIGHT_m)),
        peer_right=int(np.sum(errors[1] < RIGHT_m)),
    )


def tip_frame(seed: int, _report: Report) -> list[Row]:
    """Force in the tip frame, one sweep, compared with the thesis' two sweeps of Euler with 500 elements."""
    cases = random_cases(CASES, seed)
    shape = np.empty((ELEMENTS + 1, 7))

    def euler(case: SpatialCase) -> Array:
        euler_sweep(case.rod, case.force_tip_N, TENSION_N, ELEMENTS, shape)
        return shape[-1, :3].copy()

    ours = [
        SolveCalls(case, lambda x, out, work, n, c=case: _sweeps(c.rod, c.force_tip_N, FINE, out, work, n))  # type: ignore[misc]
        for case in cases
    ]
    peers = [SolvePeer(case, lambda c=case: euler(c)) for case in cases]  # type: ignore[misc]
    return [compared("cosserat_tip", "", "thesis' Euler 500, compiled", ours, peers, seed)]


def base_frame(seed: int, report: Report) -> list[Row]:
    """Force in the base frame: cold and warm compared with solve_bvp, cold with Algorithm 3.1, and the hard cases."""
    cases = random_cases(CASES, seed)
    cold = [cold_side(case) for case in cases]
    rows = [compared("cosserat_global", "cold", "scipy solve_bvp, tol 1e-6", cold, [_bvp_cold(c) for c in cases], seed)]
    report("cosserat_global warm ...")
    rng = np.random.default_rng(seed + 1)
    warm, near = [], []
    for case in cases:
        away = AWAY * float(np.linalg.norm(case.force_base_N)) * direction(rng)
        start = case.force_tip_N + away
        warm.append(_warm_calls(case, start))
        near.append(_bvp_warm(case, away))
    rows.append(compared("cosserat_global", "warm", "scipy solve_bvp, tol 1e-6, from 2 % away", warm, near, seed))
    rows.append(
        compared(
            "cosserat_global",
            "cold, thesis",
            "thesis' Algorithm 3.1, Euler 500, compiled",
            [cold_side(case) for case in cases],
            [_fixed_point(case) for case in cases],
            seed,
        )
    )
    report(f"cosserat_global, {MANY} cases up to a load number of {LARGEST_NUMBER:g} ...")
    hard = random_cases(MANY, seed, LARGEST_NUMBER)
    rows.append(
        compared(
            "cosserat_global",
            f"load numbers to {LARGEST_NUMBER:g}",
            "scipy solve_bvp, tol 1e-6",
            [cold_side(case) for case in hard],
            [_bvp_cold(case) for case in hard],
            seed,
        )
    )
    return rows


def helical(seed: int, _report: Report) -> list[Row]:
    """Four helical segments compared with the rod, for ordinary load numbers and for large ones."""
    rows = []
    for variant, largest in (("4 segments", None), (f"4 segments, load numbers to {LARGEST_NUMBER:g}", LARGEST_NUMBER)):
        cases = random_cases(CASES, seed, largest)
        chains = [chain_of(case.rod, 4) for case in cases]
        shapes = [np.empty((4, 3)) for _ in cases]
        firsts = [min(1.0, UNIQUE_BELOW / load_number(c.rod, float(np.linalg.norm(c.force_base_N)))) for c in cases]
        ours = [
            lambda n, c=c, f=c_.force_base_N, h=h, u=u: _helical(c, f, h, u, n)  # type: ignore[misc]
            for c, c_, h, u in zip(chains, cases, firsts, shapes, strict=True)
        ]
        rods = [cold_side(case) for case in cases]
        ours[0](1), rods[0](1)
        timed = alternate(ours, [lambda r=rod: r(1) for rod in rods])  # type: ignore[misc]
        errors = np.array(
            [
                np.linalg.norm(tip_of(chain, u)[0] - case.tip_position_m)
                for chain, u, case in zip(chains, shapes, cases, strict=True)
            ]
        )
        rows.append(
            row_of(
                "helical_global",
                variant,
                "our rod, cold (with a call from Python)",
                timed,
                seed,
                tip_error_m=float(np.median(errors)),
                tip_error_max_m=float(errors.max()),
                peer_tip_error_m=float(np.median([rod.error_m for rod in rods])),
            )
        )
    return rows


def cold_side(case: SpatialCase) -> SolveCalls:
    """Our solver from the unloaded shape, ready to be called."""
    return SolveCalls(case, lambda x, out, work, n: _cold(case.rod, case.force_base_N, x, out, work, n))


def _bvp_cold(case: SpatialCase) -> SolvePeer:
    def run() -> Array | None:
        found = boundary_value.solve(case.rod, case.force_base_N, boundary_value.unloaded(case.rod), BVP_TOLERANCE)
        return found.y[:3, -1] if found.success else None

    return SolvePeer(case, run)


def _warm_calls(case: SpatialCase, start: Array) -> SolveCalls:
    return SolveCalls(case, lambda x, out, work, n: _warm(case.rod, case.force_base_N, start, x, out, work, n))


def _bvp_warm(case: SpatialCase, away: Array) -> SolvePeer:
    guess = boundary_value.solve(case.rod, case.force_base_N + away, boundary_value.unloaded(case.rod), BVP_TOLERANCE)

    def run() -> Array | None:
        found = boundary_value.solve(case.rod, case.force_base_N, (guess.x, guess.y), BVP_TOLERANCE)
        return found.y[:3, -1] if found.success else None

    return SolvePeer(case, run)


def _fixed_point(case: SpatialCase) -> SolvePeer:
    def run() -> Array | None:
        found = algorithm_3_1(case.rod, case.force_base_N, TENSION_N, ELEMENTS, ORIENTATION_THRESHOLD)
        return found.position_m if found.converged else None

    return SolvePeer(case, run)
