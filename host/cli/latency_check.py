"""`seldinger latency-check`: how punctual the loop is on this machine, beside cyclictest."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from host.cli.contract_io import write_json
from protocol.errors import InputError
from protocol.rig_file import SIMULATED_RIG, load_rig
from realtime.control.configure import tick_parameters
from realtime.control.tick import tick
from realtime.loop.latency import LatencyResult, as_contract, check_latency, text_histogram
from realtime.loop.native_loop import GAP_PLACES
from realtime.loop.scheduling import RealtimeSettings

RATES_HZ = (100, 4000)
MAX_SECONDS = 86_400
_RIG = SIMULATED_RIG


def latency_check(
    seconds: Annotated[float, typer.Option(help="how long in all; cyclictest, where installed, takes half")] = 20.0,
    hz: Annotated[int, typer.Option(help="ticks per second, 100 to 4000")] = 1000,
    json: Annotated[bool, typer.Option("--json", help="one JSON object on standard output")] = False,
    beside: Annotated[
        str,
        typer.Option(
            "--with",
            help="subscribers beside which to measure, by commas: frozen, flooding, "
            "leaving, view, or all; runs the simulated rig",
        ),
    ] = "",
    docs: Annotated[Path | None, typer.Option(help="with --with: page whose section on subscribers is written anew")] = None,
) -> None:
    """Run the wall-clock loop with the real tick and say how late it woke and how long it worked."""
    if not RATES_HZ[0] <= hz <= RATES_HZ[1]:
        raise InputError("hz", hz, f"{RATES_HZ[0]} to {RATES_HZ[1]}")
    if not 0 < seconds <= MAX_SECONDS:
        raise InputError("seconds", seconds, f"more than 0, at most {MAX_SECONDS}")
    if beside:
        _beside(beside, seconds, json, docs)
        return
    if docs is not None:
        raise InputError("docs", docs, "--with beside it")
    params = tick_parameters(load_rig(_RIG))
    params[0].period_s = 1.0 / hz
    result = check_latency(tick, params, hz, seconds, RealtimeSettings())
    if result.granted.warning:
        print(f"seldinger: {result.granted.warning}", file=sys.stderr)
    if result.cyclictest_failed:
        print(f"seldinger: {result.cyclictest_failed}", file=sys.stderr)
    if json:
        write_json(as_contract(result))
    else:
        print(_table(result))


def _beside(names: str, seconds: float, json: bool, docs: Path | None) -> None:
    from host.studies.bad_subscriber import KINDS
    from host.studies.reliability_page import write_section
    from host.studies.subscriber_study import page_section, study

    kinds = list(KINDS) if names == "all" else names.split(",")
    for kind in kinds:
        if kind not in KINDS:
            raise InputError("with", kind, f"all, or some of {', '.join(KINDS)}")
    try:
        found = study(kinds, seconds)
    except OSError as error:
        print(f"seldinger: {error}", file=sys.stderr)
        raise typer.Exit(1) from None
    section = page_section(found, kinds, seconds)
    if docs is not None:
        write_section(docs, "subscribers", section)
    if json:
        write_json(found.as_dict())
    else:
        print(section)


def _table(result: LatencyResult) -> str:
    figures = as_contract(result)
    columns = {"loop": result.lateness}
    if result.cyclictest is not None:
        columns["cyclictest"] = result.cyclictest
    lines = [f"{'us':>24} {'p50':>9} {'p99':>9} {'p99.9':>9} {'max':>9}"]
    for label, key in (
        ("loop woken late by", "lateness_us"),
        ("cyclictest late by", "cyclictest_us"),
        ("one pass of the loop", "tick_us"),
    ):
        row = figures[key]
        if isinstance(row, dict):
            lines.append(f"{label:>24} " + " ".join(f"{row[name]:9.1f}" for name in ("p50", "p99", "p999", "max")))
        else:
            lines.append(f"{label:>24} not measured (cyclictest of rt-tests is not installed, or failed)")
    gap = f"{result.longest_gap_ns * 1e-6:.3f} ms ({GAP_PLACES[result.longest_gap_place]})"
    lines += [
        f"{result.ticks} ticks at {result.hz} Hz, {result.missed} missed, longest gap {gap}",
        "",
        text_histogram(columns),
    ]
    return "\n".join(lines)
