"""`seldinger bench`: times of the kernels, each with a peer in the same run, with the accuracy of both."""

from __future__ import annotations

import sys
from typing import Annotated, Any

import typer

from host.cli.contract_io import write_json
from host.cli.options import Json, Seed, checked_seed

ACCURACY_KEYS = (("tip_error_m", "m"), ("force_error_N", "N"), ("width_error_rad", "rad"))


def bench(
    json: Json = False,
    only: Annotated[
        list[str] | None, typer.Option(help="Benchmark to run; may be given several times. Default: all.")
    ] = None,
    seed: Seed = 1,
) -> None:
    """Time the kernels and their peers on equal inputs, one core. Progress on standard error."""
    from host.studies.benchmarks import runner as benchmarks

    checked_seed(seed)
    rows, missing = benchmarks.run(only or [], seed, lambda line: print(f"seldinger: {line}", file=sys.stderr))
    if json:
        write_json({"results": rows, "missing": missing})
    else:
        print(_table(rows))
    lacking = benchmarks.missing_of_contract(only or [], missing)
    for line in lacking:
        print(f"seldinger: missing row {line}", file=sys.stderr)
    if lacking:
        raise typer.Exit(1)


def _table(rows: list[dict[str, Any]]) -> str:
    lines = [f"{'benchmark':<34} {'median us':>10} {'p95 us':>9} {'peer us':>10} {'times':>8}  accuracy (peer), peer"]
    for row in rows:
        name = f"{row['name']} {row['variant']}".strip()
        lines.append(
            f"{name:<34} {row['median']:>10.2f} {row['p95']:>9.2f} {row['peer_median']:>10.1f} "
            f"{row['speedup']:>8.1f}  {_accuracy(row)} {row['peer']}"
        )
    return "\n".join(lines)


def _accuracy(row: dict[str, Any]) -> str:
    parts = [
        f"{row[key]:.1e} ({row['peer_' + key]:.1e}) {unit}"
        for key, unit in ACCURACY_KEYS
        if row.get(key) is not None and row.get("peer_" + key) is not None
    ]
    if "right" in row:
        parts.append(f"right {row['right']} ({row['peer_right']}) of {row['cases']}")
    if "noise_over_bound" in row:
        parts.append(
            f"noise {row['noise_over_bound']:.3f} of the bound ({row['peer_noise_over_bound']:.3f}, {row['noise_peer']})"
        )
    if "poses_per_s" in row:
        parts.append(f"{row['poses_per_s']:,.0f} poses/s on {row['workers']} cores")
    return ", ".join(parts) + ";"
