"""`seldinger check-device tracker|force|board --rig FILE`: is a device fit for an experiment; figures and what is wrong."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from host.cli.contract_io import write_json
from protocol.errors import InputError
from protocol.rig_file import SIMULATED_RIG, Rig, load_rig
from protocol.serial_frames import Fault
from realtime.core.board_intake import axis_limits
from realtime.drivers.aurora import AuroraConfig
from realtime.drivers.check_device import DeviceReport, check_aurora, check_net_ft
from realtime.drivers.net_ft import RDT_PORT
from realtime.drivers.stepper_board import FAULT_ADVICE, BoardStatus, EventKind, LinkPhase, StepperBoardLink
from realtime.drivers.transport import Transport, open_serial

DEVICES = ("tracker", "force", "board")
STATUS_HZ, BRING_UP_S = 200.0, 5.0


def check_device(
    device: Annotated[str, typer.Argument(help="tracker, force or board.")],
    rig: Annotated[Path, typer.Option(help="Rig file.")] = SIMULATED_RIG,
    seconds: Annotated[float, typer.Option(help="How long to read it.")] = 5.0,
    port: Annotated[str, typer.Option(help="Serial port, or the box's address, in the place of the rig file's.")] = "",
    udp_port: Annotated[int, typer.Option(help="RDT port of the force box.")] = RDT_PORT,
    web_port: Annotated[int, typer.Option(help="Port of the force box's page.")] = 80,
    json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
) -> None:
    """Read a device for some seconds; nothing moves. Exit status 1 when it is not fit."""
    if device not in DEVICES:
        raise InputError("device", device, " or ".join(DEVICES))
    if not 0.1 <= seconds <= 3600.0:
        raise InputError("--seconds", seconds, "0.1 to 3600 (s)")
    settings = load_rig(rig)
    if device == "tracker":
        report = _tracker(settings, port, seconds)
    elif device == "force":
        report = check_net_ft(port or settings.force_sensor.address, seconds, udp_port, web_port)
    else:
        report = check_board(settings, port or settings.board.port, seconds)
    _tell(report)
    if json:
        write_json({"device": report.device, "good": report.good, "figures": report.figures, "problems": report.problems})
    raise typer.Exit(0 if report.good else 1)


def _tracker(rig: Rig, port: str, seconds: float) -> DeviceReport:
    tracker = rig.tracker
    tools = (tracker.tip_handle, tracker.shaft_handle)
    config = AuroraConfig(tools=tools, rate_hz=tracker.rate_hz, latency_s=tracker.latency_s)
    return check_aurora(lambda: open_serial(port or tracker.port, 9600), config, seconds)


def check_board(rig: Rig, port: str, seconds: float) -> DeviceReport:
    """Bring the stepper board up (protocol, firmware, limits) and count its status for `seconds`. It is never armed."""
    report = DeviceReport("board")
    try:
        transport = open_serial(port, rig.board.baud)
    except OSError as error:
        report.problems.append(str(error))
        return report
    link = StepperBoardLink(axis_limits(rig))
    try:
        _read_board(link, transport, seconds, report)
    except OSError as error:
        report.problems.append(f"the port went away: {error}")
    finally:
        transport.close()
    return report


def _read_board(link: StepperBoardLink, transport: Transport, seconds: float, report: DeviceReport) -> None:
    begin_ns = time.monotonic_ns()
    ready_ns, statuses, first = 0, 0, None
    while True:
        now_ns = time.monotonic_ns()
        if (now_ns - begin_ns > BRING_UP_S * 1e9 and not ready_ns) or (ready_ns and now_ns - ready_ns > seconds * 1e9):
            break
        for event in link.feed(transport.read(), now_ns):
            if event.kind is EventKind.STATUS:
                statuses += bool(ready_ns)
            elif event.kind in (EventKind.FAULT, EventKind.MISMATCH, EventKind.REFUSED, EventKind.RESET):
                report.problems.append(event.message)
        if link.phase is LinkPhase.READY and not ready_ns:
            ready_ns, first = now_ns, link.status
        if link.phase is LinkPhase.MISMATCH:
            break
        sending = link.advance(now_ns)
        if sending:
            transport.write(sending)
        time.sleep(0.001)
    _judge_board(link, report, statuses / seconds if ready_ns else 0.0, first)


def _judge_board(link: StepperBoardLink, report: DeviceReport, rate_hz: float, first: BoardStatus | None) -> None:
    identity, status = link.identity, link.status
    if identity is None:
        report.problems.append(f"no answer to HELLO within {BRING_UP_S:g} s: port, power, firmware (`seldinger flash`)?")
        return
    if link.phase is not LinkPhase.READY:
        report.problems.append(f"bring-up ended in phase {link.phase.value}, wanted ready")
    report.figures |= {
        "firmware": f"{identity.firmware_version >> 8}.{identity.firmware_version & 0xFF}",
        "boot_count": identity.boot_count,
        "timer_hz": identity.timer_hz,
        "status_hz": round(rate_hz, 1),
    }
    if status is None or first is None:
        return
    damaged = link.decoder.counters.crc_errors + status.crc_errors - first.crc_errors
    report.figures |= {
        "damaged_frames": damaged,
        "clock_drift": link.clock.drift,
        "fault": FAULT_ADVICE[Fault(status.fault)],
        "encoder_errors": status.encoder_errors,
        "inputs": f"{status.inputs:07b}",
    }
    if rate_hz < 0.98 * STATUS_HZ:
        report.problems.append(f"{rate_hz:.0f} status frames a second, wanted {STATUS_HZ:g}")
    if damaged:
        report.problems.append(f"{damaged} damaged frames: cable, shield, speed of the port")
    if status.inputs & 0x40:
        report.problems.append("the emergency stop is open")


def _tell(report: DeviceReport) -> None:
    console = Console(stderr=True, highlight=False)
    table = Table(box=None, padding=(0, 2, 0, 0), show_header=False)
    for name, value in report.figures.items():
        table.add_row(name, f"{value:.6g}" if isinstance(value, float) else str(value))
    console.print(table)
    for problem in report.problems:
        print(f"seldinger: {report.device}: {problem}", file=sys.stderr)
    print(f"{report.device}: {'good' if report.good else 'not fit for an experiment'}", file=sys.stderr)
