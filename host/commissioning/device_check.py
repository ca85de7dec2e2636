"""Is a device fit for an experiment: read tracker, force box or board for some seconds; figures and what is wrong."""

from __future__ import annotations

import time
from typing import TextIO

from host.commissioning.board_inputs import input_lines, input_problems
from protocol.rig_file import Pins, Rig
from protocol.serial_frames import Fault, Mcu
from realtime.core.board_intake import axis_limits
from realtime.core.device_sources import AURORA, NET_FT, force_thread, tracker_thread
from realtime.core.lines import tracker_config
from realtime.drivers.check_device import DeviceReport, check_aurora, check_forces, check_net_ft, check_poses
from realtime.drivers.stepper_board import FAULT_ADVICE, BoardEventKind, BoardStatus, LinkPhase, StepperBoardLink
from realtime.drivers.transport import TracedTransport, Transport, open_serial

STATUS_HZ, BRING_UP_S = 200.0, 5.0
# A box states its counts with at least six digits.
COUNTS_TOLERANCE = 1e-3


def _opened(path: str, baud: int, trace: TextIO | None) -> Transport:
    line = open_serial(path, baud)
    return line if trace is None else TracedTransport(line, trace)


def check_tracker(rig: Rig, port: str, seconds: float, trace: TextIO | None = None) -> DeviceReport:
    """Read the tracker at `port` (empty: the rig file's) for `seconds`; report its rate, gaps and noise.

    trace: file for the dialogue with an Aurora, byte by byte; other kinds have none.
    """
    tracker = rig.tracker
    tools = tuple(tool.handle for tool in tracker.tools)
    if tracker.kind != AURORA:
        return check_poses(
            lambda sample, event: tracker_thread(rig, port or None, sample, event),
            tools,
            tracker.rate_hz,
            seconds,
            tracker.kind,
        )
    config = tracker_config(rig)
    return check_aurora(lambda: _opened(port or tracker.port, 9600, trace), config, seconds)


def check_force_box(rig: Rig, address: str, seconds: float, udp_port: int, web_port: int) -> DeviceReport:
    """Read the force box at `address` (empty: the rig file's) for `seconds`; report its rate, lost records and noise."""
    if rig.force_sensor.kind != NET_FT:
        return check_forces(
            lambda sample, event: force_thread(rig, udp_port, sample, event),
            rig.force_sensor.rate_hz,
            seconds,
            rig.force_sensor.kind,
        )
    report = check_net_ft(address or rig.force_sensor.address, seconds, udp_port, web_port)
    report.problems += _count_problems(rig, report)
    return report


def _count_problems(rig: Rig, report: DeviceReport) -> list[str]:
    """Compare the rig file's counts, with which the control loop converts every force, with those of the box."""
    sensor, problems = rig.force_sensor, []
    for key, own, quantity in (
        ("counts_per_N", sensor.counts_per_newton, "newton"),
        ("counts_per_Nm", sensor.counts_per_newton_metre, "newton_metre"),
    ):
        of_box = report.figures.get(key)
        if isinstance(of_box, float) and abs(own / of_box - 1.0) > COUNTS_TOLERANCE:
            problems.append(
                f"force_sensor.counts_per_{quantity}: found {own:g}, wanted {of_box:g}, which the box has; "
                f"{'forces' if quantity == 'newton' else 'torques'} are read {of_box / own:.4g} times as large as they are"
            )
    return problems


def check_board(rig: Rig, port: str, seconds: float, trace: TextIO | None = None) -> DeviceReport:
    """Bring the stepper board up (protocol, firmware, limits) and count its status for `seconds`. It is never armed.

    Arguments: `port`, empty: the rig file's; `trace`, file for the dialogue, byte by byte.
    """
    report = DeviceReport("board")
    try:
        transport = _opened(port or rig.board.port, rig.board.baud, trace)
    except OSError as error:
        report.problems.append(str(error))
        return report
    link = StepperBoardLink(axis_limits(rig))
    try:
        _read_board(link, transport, seconds, report)
        _name_inputs(rig.board.pins, link, report)
    except OSError as error:
        report.problems.append(f"the port was closed: {error}")
    finally:
        transport.close()
    return report


def _name_inputs(pins: Pins, link: StepperBoardLink, report: DeviceReport) -> None:
    """Report every switch input, also of a board that did not come as far as READY: an open e-stop keeps it from there."""
    if link.status is None:
        return
    report.figures["inputs"] = f"{link.status.inputs:07b}"
    report.figures |= {line.name: str(line) for line in input_lines(pins, link.status.inputs)}
    report.problems += input_problems(pins, link.status.inputs)
    if (
        link.identity is not None
        and Mcu(link.identity.mcu) is not Mcu.NATIVE
        and Mcu(link.identity.mcu).name.lower() != pins.mcu
    ):
        report.problems.append(
            f"board.pins.mcu: found {pins.mcu}, wanted {Mcu(link.identity.mcu).name.lower()}, the processor that answered"
        )


def _read_board(link: StepperBoardLink, transport: Transport, seconds: float, report: DeviceReport) -> None:
    begin_ns = time.monotonic_ns()
    ready_ns, statuses, first = 0, 0, None
    while True:
        now_ns = time.monotonic_ns()
        if (now_ns - begin_ns > BRING_UP_S * 1e9 and not ready_ns) or (ready_ns and now_ns - ready_ns > seconds * 1e9):
            break
        for event in link.feed(transport.read(), now_ns):
            if event.kind is BoardEventKind.STATUS:
                statuses += bool(ready_ns)
            elif event.kind in (BoardEventKind.FAULT, BoardEventKind.MISMATCH, BoardEventKind.REFUSED, BoardEventKind.RESET):
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
    }
    if rate_hz < 0.98 * STATUS_HZ:
        report.problems.append(f"{rate_hz:.0f} status frames a second, wanted {STATUS_HZ:g}")
    if damaged:
        report.problems.append(f"{damaged} damaged frames: cable, shield, speed of the port")
