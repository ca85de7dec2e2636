"""`seldinger latency-check`: how punctual the loop is on this machine, compared with cyclictest."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from host.cli.contract_io import write_json
from host.cli.options import Json, within, writable_file
from host.cli.progress import Working
from protocol.errors import InputError, one_of
from protocol.rig_file import SIMULATED_RIG, load_rig

if TYPE_CHECKING:
    from realtime.loop.latency import LatencyResult

RATES_HZ = (100, 4000)
MAX_SECONDS = 86_400


def latency_check(
    seconds: Annotated[float, typer.Option(help="Total time, s; cyclictest, if installed, takes half of it.")] = 20.0,
    hz: Annotated[int, typer.Option(help="Ticks per second, 100 to 4000.")] = 1000,
    json: Json = False,
    subscribers: Annotated[
        str,
        typer.Option(
            "--with",
            help="Subscribers to run during the measurement, comma separated: frozen, flooding, "
            "leaving, view, or all; runs the simulated rig.",
            hidden=True,
        ),
    ] = "",
    docs: Annotated[
        Path | None, typer.Option(help="With --with: page whose section on subscribers is written.", hidden=True)
    ] = None,
) -> None:
    """Run the wall-clock loop with the real tick; report the lateness of its wake-ups and the time of its work."""
    within("--hz", hz, *RATES_HZ)
    if not 0 < seconds <= MAX_SECONDS:
        raise InputError("--seconds", seconds, f"more than 0, at most {MAX_SECONDS}")
    if docs is not None:
        if not subscribers:
            raise InputError("--docs", str(docs), "--with too, because only the section on subscribers is on the page")
        writable_file("--docs", docs)
    if subscribers:
        _with_subscribers(subscribers, seconds, json, docs)
        return
    from realtime.control.configure import tick_parameters
    from realtime.control.tick import tick
    from realtime.core.control_loop import run
    from realtime.loop.latency import as_contract, check_latency
    from realtime.loop.scheduling import RealtimeSettings

    params = tick_parameters(load_rig(SIMULATED_RIG))
    params[0].period_s = 1.0 / hz
    with Working("the loop runs", seconds):
        result = check_latency(tick, params, hz, seconds, RealtimeSettings(), run=run)
    if result.granted.warning:
        print(f"seldinger: {result.granted.warning}", file=sys.stderr)
    if result.cyclictest_failed:
        print(f"seldinger: {result.cyclictest_failed}", file=sys.stderr)
    if json:
        write_json(as_contract(result))
    else:
        print(_table(result))


def _with_subscribers(names: str, seconds: float, json: bool, docs: Path | None) -> None:
    from host.studies.bad_subscriber import KINDS
    from host.studies.reliability_page import write_section
    from host.studies.subscriber_study import page_section, study

    kinds = list(KINDS) if names == "all" else names.split(",")
    for kind in kinds:
        one_of("--with", kind, KINDS)
    try:
        with Working("study of subscribers"):
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
    from realtime.loop.latency import as_contract, text_histogram
    from realtime.loop.native_loop import GAP_PLACES

    figures = as_contract(result)
    columns = {"loop": result.lateness}
    if result.cyclictest is not None:
        columns["cyclictest"] = result.cyclictest
    lines = [f"{'us':>24} {'p50':>9} {'p99':>9} {'p99.9':>9} {'max':>9}"]
    for label, key in (
        ("lateness of the loop", "lateness_us"),
        ("lateness of cyclictest", "cyclictest_us"),
        ("time of one pass", "tick_us"),
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
