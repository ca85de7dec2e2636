"""`seldinger check-device tracker|force|board --rig FILE`: is a device fit for an experiment; figures and what is wrong."""

from __future__ import annotations

import contextlib
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from host.cli.contract_io import write_json
from host.cli.options import Json, RigFile, within
from host.cli.progress import Working
from protocol.errors import InputError, one_of
from protocol.rig_file import SIMULATED_RIG, load_rig

if TYPE_CHECKING:
    from realtime.drivers.check_device import DeviceReport

DEVICES = ("tracker", "force", "board")


def check_device(
    device: Annotated[str, typer.Argument(help="tracker, force or board.")],
    rig: RigFile = SIMULATED_RIG,
    seconds: Annotated[float, typer.Option(help="Time to read the device, s.")] = 5.0,
    port: Annotated[str, typer.Option(help="Serial port, or the box's address, instead of the rig file's.")] = "",
    udp_port: Annotated[int, typer.Option(help="RDT port of the force box.", hidden=True)] = 49152,
    web_port: Annotated[int, typer.Option(help="Port of the force box's page.", hidden=True)] = 80,
    trace: Annotated[
        Path | None, typer.Option(help="File for the dialogue on the serial line, byte by byte (Aurora and board).")
    ] = None,
    json: Json = False,
) -> None:
    """Read a device for some seconds; nothing moves. Exit status 1 if it is not fit for an experiment."""
    from host.commissioning.device_check import check_board, check_force_box, check_tracker
    from realtime.core.device_sources import AURORA

    one_of("device", device, DEVICES)
    within("--seconds", seconds, 0.1, 3600.0, "s")
    within("--udp-port", udp_port, 1, 65535)
    within("--web-port", web_port, 1, 65535)
    settings = load_rig(rig)
    if trace is not None and (device == "force" or (device == "tracker" and settings.tracker.kind != AURORA)):
        raise InputError("--trace", str(trace), f"the board or an Aurora; this {device} has no serial line of the rig's")
    with contextlib.ExitStack() as stack:
        out = None
        if trace is not None:
            try:
                out = stack.enter_context(trace.open("w", encoding="ascii"))
            except OSError as error:
                raise InputError("--trace", str(trace), f"a file that can be written ({error.strerror})") from None
        stack.enter_context(Working(f"reading {device}"))
        if device == "force":
            report = check_force_box(settings, port, seconds, udp_port, web_port)
        else:
            report = (check_tracker if device == "tracker" else check_board)(settings, port, seconds, out)
    _print_table(report)
    if json:
        write_json({"device": report.device, "good": report.good, "figures": report.figures, "problems": report.problems})
    raise typer.Exit(0 if report.good else 1)


def _print_table(report: DeviceReport) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console(stderr=True, highlight=False)
    table = Table(box=None, padding=(0, 2, 0, 0), show_header=False)
    for name, value in report.figures.items():
        table.add_row(name, f"{value:.6g}" if isinstance(value, float) else str(value))
    if report.figures:
        console.print(table)
    for problem in report.problems:
        print(f"seldinger: {report.device}: {problem.removeprefix(f'{report.device}: ')}", file=sys.stderr)
    print(f"{report.device}: {'good' if report.good else 'not fit for an experiment'}", file=sys.stderr)
