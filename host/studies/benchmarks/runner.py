"""Registry and stopwatch of `seldinger bench`: every row times ours and a peer in one run, alternating, on equal inputs."""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from protocol.errors import InputError

Row = dict[str, Any]
Report = Callable[[str], None]
Benchmark = Callable[[int, Report], list[Row]]

# name -> "module:function". The function takes (seed, report) and returns rows made by `row_of`; `report` is progress
# to read. A module or a peer that is not installed leaves its row out, with the reason; a row of CONTRACT that is left
# out makes the command fail.
BENCHMARKS: dict[str, str] = {
    "pcar_direct": "host.studies.benchmarks.planar:direct",
    "pcar_inverse": "host.studies.benchmarks.planar:inverse",
    "cosserat_tip": "host.studies.benchmarks.statics:tip_frame",
    "cosserat_global": "host.studies.benchmarks.statics:base_frame",
    "helical_global": "host.studies.benchmarks.statics:helical",
    "estimate_case_1": "host.studies.benchmarks.estimation:case_1",
    "estimate_case_2": "host.studies.benchmarks.estimation:case_2",
    "estimate_case_3": "host.studies.benchmarks.estimation:case_3",
    "estimate_case_4": "host.studies.benchmarks.estimation:case_4",
    "estimate_case_5": "host.studies.benchmarks.estimation:case_5",
    "estimate_case_6": "host.studies.benchmarks.estimation:case_6",
    "estimate_batch": "host.studies.benchmarks.estimation:batch",
    "estimate_rig": "host.studies.benchmarks.rig_estimators:estimate_rig",
    "public_solve": "host.studies.benchmarks.public_face:public_solve",
    "public_estimate": "host.studies.benchmarks.public_face:public_estimate",
    "import_and_solve": "host.studies.benchmarks.start_up:import_and_solve",
    "control_tick": "host.studies.benchmarks.control:control_tick",
    "kalman_predict": "host.studies.benchmarks.control:kalman_predict",
    "message_decode": "host.studies.benchmarks.messages:message_decode",
    "message_encode": "host.studies.benchmarks.messages:message_encode",
    "diagnose": "host.studies.benchmarks.diagnosis:diagnose",
}
CONTRACT = {
    "pcar_direct",
    "pcar_inverse",
    "cosserat_tip",
    "cosserat_global",
    *(f"estimate_case_{case}" for case in range(1, 7)),
    "control_tick",
    "kalman_predict",
    "diagnose",
}
SECONDS_PER_BLOCK = 100e-6  # a call shorter than this is repeated inside one reading of the clock
BLOCKS = 3  # readings of each side, of which the least counts: other programs on the machine only add to it
PEER_BLOCKS_LONGER_THAN_s = 0.02  # ... and one reading is enough


@dataclass
class PairedTimes:
    """Seconds per call, one for each input, of ours and of the peer."""

    ours_s: list[float] = field(default_factory=list)
    peer_s: list[float] = field(default_factory=list)


def alternate(ours: Sequence[Callable[[int], object]], peers: Sequence[Callable[[], object]]) -> PairedTimes:
    """Times ours[i](repeats) and peers[i]() in turn, input by input.

    Arguments: ours[i] runs input i as often as given, inside compiled code; peers[i] runs it once.
    """
    timed = PairedTimes()
    for mine, theirs in zip(ours, peers, strict=True):
        once = _seconds(lambda mine=mine: mine(1))  # type: ignore[misc]
        repeats = max(1, int(SECONDS_PER_BLOCK / max(once, 1e-9)))
        best, best_peer = np.inf, np.inf
        for _ in range(BLOCKS):
            best = min(best, _seconds(lambda mine=mine, n=repeats: mine(n)) / repeats)  # type: ignore[misc]
            if not PEER_BLOCKS_LONGER_THAN_s < best_peer < np.inf:
                best_peer = min(best_peer, _seconds(theirs))
        timed.ours_s.append(best)
        timed.peer_s.append(best_peer)
    return timed


def _seconds(call: Callable[[], object]) -> float:
    start = time.perf_counter_ns()
    call()
    return (time.perf_counter_ns() - start) * 1e-9


def row_of(name: str, variant: str, peer: str, timed: PairedTimes, seed: int, **accuracy: object) -> Row:
    """One row of the result: medians and 95th percentiles in microseconds, and what both sides reached.

    `accuracy`: for instance tip_error_m and peer_tip_error_m, right and peer_right of cases; what they mean is in docs.
    """
    ours, theirs = np.array(timed.ours_s) * 1e6, np.array(timed.peer_s) * 1e6
    return {
        "name": name,
        "variant": variant,
        "unit": "us",
        "median": float(np.median(ours)),
        "p95": float(np.percentile(ours, 95)),
        "seed": seed,
        "cases": len(ours),
        "peer": peer,
        "peer_median": float(np.median(theirs)),
        "peer_p95": float(np.percentile(theirs, 95)),
        "speedup": float(np.median(theirs) / np.median(ours)),
        **accuracy,
    }


def run(only: Sequence[str], seed: int, report: Report) -> tuple[list[Row], dict[str, str]]:
    """Run benchmarks.

    Args:
        only: Names of BENCHMARKS; all where it is empty.
        seed: Seed of the random inputs.
        report: Called with a line of progress.

    Returns:
        The rows, and for each benchmark that could not run the reason: a module or a peer that is not installed.

    Raises:
        InputError: A name is not registered.
    """
    for name in only:
        if name not in BENCHMARKS:
            raise InputError("only", name, "one of " + ", ".join(BENCHMARKS))
    rows: list[Row] = []
    missing: dict[str, str] = {}
    for name in only or BENCHMARKS:
        report(f"{name} ...")
        try:
            rows += find(name)(seed, report)
        except ModuleNotFoundError as error:
            missing[name] = f"the module {error.name} is not installed"
            report(f"{name}: left out, {missing[name]}")
    return rows, missing


def missing_of_contract(only: Sequence[str], missing: Mapping[str, str]) -> list[str]:
    """Return one line for each row that had to be there and is not: those of CONTRACT, and those requested by name."""
    wanted = set(only) or CONTRACT
    return [f"{name}: {reason}" for name, reason in missing.items() if name in wanted]


def find(name: str) -> Benchmark:
    """Return the registered benchmark. Raises ModuleNotFoundError where its module, or one that it needs, is missing."""
    module, function = BENCHMARKS[name].split(":")
    found: Benchmark = getattr(importlib.import_module(module), function)
    return found
