"""The stepper board's side of the loop: limits from the rig file, status into the input record and into a message."""

from __future__ import annotations

import numpy as np

from protocol.enums import BoardState
from protocol.rig_file import Rig
from protocol.serial_frames import Fault, Reject
from protocol.topics import BoardCounters
from realtime.drivers.stepper_board import AxisLimits, LinkPhase, StepperBoardLink

# A better offset comes in by this much a STATUS (5 ms), so that execution times always rise; a larger error at once.
OFFSET_SLEW_NS = 200_000
OFFSET_JUMP_NS = 50_000_000


def axis_limits(rig: Rig) -> tuple[AxisLimits, ...]:
    """Return the limits of the three axes in steps that the board enforces: those of the loop, widened by the rounding."""
    limits = []
    for axis in range(3):
        stage = rig.stage(axis)
        limits.append(
            AxisLimits(
                max_speed_steps_per_s=min(round(1.05 * stage.max_speed_unit_per_s * stage.steps_per_unit) + 1, 20_000),
                max_accel_steps_per_s2=round(stage.max_accel_unit_per_s2 * stage.steps_per_unit),
                soft_min_steps=round(stage.min_unit * stage.steps_per_unit) - 1,
                soft_max_steps=round(stage.max_unit * stage.steps_per_unit) + 1,
            )
        )
    return tuple(limits)


def take_status(record: np.record, link: StepperBoardLink, now_ns: int) -> None:
    """Copy the newest STATUS of `link` into a BOARD record."""
    status = link.status
    if status is None:
        return
    offset_ns = link.mcu_offset_ns(now_ns)
    change_ns = offset_ns - int(record.mcu_offset_ns)
    if record.count > 0 and abs(change_ns) < OFFSET_JUMP_NS:
        offset_ns -= change_ns - min(max(change_ns, -OFFSET_SLEW_NS), OFFSET_SLEW_NS)
    record.count += 1
    record.arrival_ns = status.arrival_ns
    record.mcu_offset_ns = offset_ns
    record.position_steps[:] = status.position_steps
    record.encoder_counts[:] = status.encoder_counts
    # The position of a board that was reset or replaced is unknown, so it counts as a fault.
    unknown = link.phase in (LinkPhase.RESET, LinkPhase.MISMATCH)
    record.state, record.fault = (BoardState.FAULT if unknown else status.state), status.fault
    record.ready = 1 if link.armed and not unknown else 0


def board_message(link: StepperBoardLink, now_ns: int) -> BoardCounters:
    """Return the message of the newest STATUS. Raises ValueError before the first."""
    status = link.status
    if status is None:
        raise ValueError("board: found no status yet, wanted one before its message")
    return BoardCounters(
        stamp_ns=now_ns,
        mcu_time_us=status.mcu_time_us,
        state=status.state,
        fault=status.fault,
        fault_name=Fault(status.fault).name.lower() if status.fault else "",
        inputs=status.inputs,
        queue_depth=status.queue_depth,
        last_setpoint=status.last_setpoint,
        position_steps=status.position_steps,
        encoder_counts=status.encoder_counts,
        crc_errors=status.crc_errors,
        host_crc_errors=link.decoder.counters.crc_errors,
        underruns=status.underruns,
        rejected=status.rejected + status.expired + status.overflows,
        last_reject=Reject(status.last_reject).name.lower() if status.last_reject else "",
        boot_count=status.boot_count,
        deadman_age_ms=float(status.deadman_age_ms),
    )
