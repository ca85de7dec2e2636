"""Noiseless force estimation over a grid of forces and curvatures: counts exact, flagged, refused and wrong results.

`python -m host.studies.benchmarks.force_grid` prints the counts. Grids: section 5.3.1, and all directions.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from host.estimation.spatial import LARGEST_FORCE_N, PoseSensor, estimate_cosserat
from host.mechanics.cosserat import solve_cosserat
from host.mechanics.rod import rod_record
from host.mechanics.tip_shooting import load_number
from protocol.catheter import Catheter, load_catheter

Array = NDArray[np.float64]

OFFSETS_m = (0.0, 0.03, 0.05)
INSERTION_m = 0.01
SIZES_N = (0.02, 0.1, 0.2, 0.35)
CURVATURES_per_m = (0.0, 10.0, 30.0, 60.0)
EXACT_N = 1e-6


@dataclass
class Count:
    """Counts of one catheter and case: exact; error with a warning; not converged; error without a warning."""

    exact: int = 0
    warned: list[str] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)
    largest_error_N: float = 0.0  # of the exact ones
    largest_load_number: float = 0.0


def thesis_direction(alpha: float) -> Array:
    """Direction of section 5.3.1, with its size put right."""
    return np.array([math.cos(alpha) / math.sqrt(2.0), -math.cos(alpha) / math.sqrt(2.0), math.sin(alpha)])


def directions(count: int) -> Array:
    """Unit vectors (2 count, 3): the circle of section 5.3.1 and a Fibonacci sphere."""
    circle = [thesis_direction(a) for a in np.linspace(0.0, 2.0 * math.pi, count, endpoint=False)]
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    turn = np.arange(count) * math.pi * (3.0 - math.sqrt(5.0))
    sphere = np.column_stack([np.sqrt(1.0 - z * z) * np.cos(turn), np.sqrt(1.0 - z * z) * np.sin(turn), z])
    return np.vstack([circle, sphere])


def one(catheter: Catheter, case: int, k0: float, force: Array, count: Count) -> None:
    """The force (3,) in the tip frame estimated from its own poses, and counted."""
    found = solve_cosserat(catheter, INSERTION_m, k0, force, "tip", stations_m=OFFSETS_m)
    sensors = [
        PoseSensor(offset, found.station_positions_m[i], found.station_quaternions_wxyz[i])
        for i, offset in enumerate(OFFSETS_m)
    ]
    estimate = estimate_cosserat(catheter, INSERTION_m, k0, case, sensors)
    error = float(np.abs(estimate.force_N - force).max())
    number = load_number(rod_record(catheter, INSERTION_m, k0), float(np.linalg.norm(force)))
    count.largest_load_number = max(count.largest_load_number, number)
    says = (
        f"curvature {k0:g}, force {np.array2string(force, precision=4)}, load number {number:.0f}: error {error:.1e} N, "
        f"chi square {estimate.chi_square:.1e}"
    )
    if not estimate.converged:
        count.refused.append(says)
    elif error < EXACT_N:
        count.exact += 1
        count.largest_error_N = max(count.largest_error_N, error)
    else:
        (count.warned if estimate.warnings else count.wrong).append(says)


def grid(
    name: str,
    case: int,
    per_circle: int,
    sizes: tuple[float, ...] = SIZES_N,
    curvatures: tuple[float, ...] = CURVATURES_per_m,
) -> Count:
    """The whole grid of one shipped catheter in one case of chapter 5."""
    catheter, count = load_catheter(name), Count()
    for size in sizes:
        assert size <= LARGEST_FORCE_N
        for k0 in curvatures:
            for direction in directions(per_circle):
                one(catheter, case, k0, size * direction, count)
    return count


def main() -> None:
    """Print how many forces of the grid were estimated exactly, with a warning, wrongly or not at all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--directions", type=int, default=36, help="on the circle, and again on the sphere")
    parser.add_argument("--catheters", nargs="+", default=["livewire", "steerocath_t"])
    parser.add_argument("--cases", nargs="+", type=int, default=[2, 4, 6])
    parser.add_argument("--list", action="store_true", help="print every input that was not exact")
    options = parser.parse_args()
    for name in options.catheters:
        for case in options.cases:
            count = grid(name, case, options.directions)
            print(
                f"{name:13} case {case}: exact {count.exact} (largest error {count.largest_error_N:.1e} N), "
                f"off and warned of {len(count.warned)}, not converged {len(count.refused)}, "
                f"silently wrong {len(count.wrong)}; "
                f"load numbers to {count.largest_load_number:.0f}",
                flush=True,
            )
            for line in (count.warned + count.refused + count.wrong) if options.list else []:
                print("    " + line)


if __name__ == "__main__":
    main()
