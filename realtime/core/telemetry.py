"""Telemetry: converts tick records into the messages of `protocol.topics`."""

from __future__ import annotations

import msgspec
import numpy as np

from protocol.enums import CommandKind, Phase, SafetyAction
from protocol.topics import (
    HISTOGRAM_BUCKETS,
    ForceSensor,
    LoopTiming,
    Pose,
    RigState,
    Stage,
    histogram_bucket,
)
from realtime.control import safety
from realtime.control.declare import carried
from realtime.control.inverse_kinematics import curvature_of_knob
from realtime.control.records import Force, Outputs, PoseRecord
from realtime.loop.latency import bin_edges_ns, percentiles_us
from realtime.loop.loop_thread import NativeLoop
from realtime.loop.native_loop import GAP_PLACES, LATENESS_BIN_NS, WORK_BIN_NS

# Ticks (of 1 ms) between two messages of a topic; force readings between two of theirs.
STAGE_EVERY, FORCE_EVERY, STATE_EVERY, BOARD_EVERY, LOOP_EVERY = 4, 2, 10, 50, 500


def stage_message(params: np.record, board: np.record, outputs: np.record, located: bool) -> Stage:
    """Return handle commands, encoders (BOARD record), and the catheter's joints as the controller predicts them.

    located: whether a pose has been accepted; without one the joints are not known.
    """
    steps = params.stage.steps_per_unit
    encoder = np.asarray(board.encoder_counts) / steps
    known = board.count > 0
    return Stage(
        stamp_ns=int(outputs.now_ns),
        command_insertion_m=float(outputs.stage_unit[0]),
        command_roll_rad=float(outputs.stage_unit[1]),
        command_knob_rad=float(outputs.stage_unit[2]),
        encoder_insertion_m=float(encoder[0]) if known else None,
        encoder_roll_rad=float(encoder[1]) if known else None,
        encoder_knob_rad=float(encoder[2]) if known else None,
        joint_insertion_m=float(outputs.joint[0]) if located else None,
        joint_roll_rad=float(outputs.joint[1]) if located else None,
        joint_curvature_per_m=curvature_of_knob(params.kinematics, float(outputs.joint[2])) if located else None,
    )


def pose_message(record: np.record, frame: int = 0, quality_m: float | None = None) -> Pose:
    """Return the message of a POSE record (base frame)."""
    return Pose(
        stamp_ns=int(record.stamp_ns),
        frame=frame,
        missing=False,
        quality_m=quality_m,
        **carried(Pose, PoseRecord, record),
    )


def force_message(record: np.record, status: int = 0) -> ForceSensor:
    """Return the message of the sensor's FORCE record (base frame, on the tissue)."""
    return ForceSensor(
        stamp_ns=int(record.stamp_ns),
        arrival_ns=int(record.arrival_ns),
        status=status,
        **carried(ForceSensor, Force, record),
    )


def state_message(command: np.record, outputs: np.record, located: bool, homing: bool = False) -> RigState:
    """Return phase, safety action, messages of its causes, target (COMMAND record) and tip.

    located: whether a pose has been accepted; without one the tip is not known. homing: whether an axis is being homed.
    """
    pressing = float(command.force_N) if outputs.phase == Phase.CONTACT else None
    # The wall of a contact stays where it is while the rig holds or retracts; a new position leaves it.
    at_wall = command.kind in (CommandKind.CONTACT, CommandKind.HOLD, CommandKind.RETRACT) and bool(np.any(command.normal))
    loop = carried(RigState, Outputs, outputs)
    loop["pose_age_ns"] = max(loop["pose_age_ns"], 0)
    if not located:
        loop["tip_m"] = loop["tip_velocity_m_per_s"] = None
    return RigState(
        stamp_ns=int(outputs.now_ns),
        mode=(Phase.HOMING if homing else Phase(int(outputs.phase))).label,
        safety_action=SafetyAction(int(outputs.action)).label,
        cause="; ".join(safety.messages(int(outputs.cause)))[:500],
        target_m=tuple(map(float, command.target_m)) if command.kind != CommandKind.NONE else None,
        force_direction=tuple(-float(x) for x in command.normal) if at_wall else None,
        target_force_N=pressing,
        **loop,
    )


def witness_text(witness_N: np.ndarray) -> str:
    """Return the forces (3,) N of sensor, estimate and geometry as text, and which of the first two differs."""
    sensor_N, estimate_N, geometry_N = (float(force_N) for force_N in witness_N)
    says = f"force sensor {sensor_N:.2f} N, estimate {estimate_N:.2f} N, deflection of the tip {geometry_N:.2f} N"
    off_sensor, off_estimate = abs(sensor_N - geometry_N), abs(estimate_N - geometry_N)
    if abs(sensor_N - estimate_N) < max(2.0 * min(off_sensor, off_estimate), 0.05):
        return says
    return f"{says}: the {'force sensor' if off_sensor > off_estimate else 'estimate'} disagrees with both others"


def tick_buckets(work: np.ndarray) -> tuple[int, ...]:
    """Convert the loop's histogram of tick times (`native_loop.count_in`) into that of the message."""
    work = work.copy()  # the loop's thread counts on meanwhile; np.flatnonzero needs an array that does not change
    buckets = [0] * HISTOGRAM_BUCKETS
    for index in np.flatnonzero(work[:-1]):
        buckets[histogram_bucket(bin_edges_ns(index + 0.5, WORK_BIN_NS) * 1e-3)] += int(work[index])
    return tuple(buckets)


def loop_message(stamp_ns: int, loop_hz: float, missed: int, work: np.ndarray) -> LoopTiming:
    """Return the tick times so far (`work`: the loop's histogram). Virtual time has no lateness."""
    times = percentiles_us(work, WORK_BIN_NS)
    return LoopTiming(
        stamp_ns=stamp_ns,
        loop_hz=loop_hz,
        ticks=int(work[:-1].sum()),
        missed_ticks=missed,
        tick_p50_us=times["p50"],
        tick_p99_us=times["p99"],
        tick_p999_us=times["p999"],
        tick_max_us=times["max"],
        tick_histogram=tick_buckets(work),
    )


def wall_clock_timing(stamp_ns: int, loop_hz: float, loop: NativeLoop) -> LoopTiming:
    """Return the compiled loop's timing so far: tick times, lateness, and longest gap."""
    newest = loop.snapshot()
    late = percentiles_us(loop.lateness, LATENESS_BIN_NS)
    return msgspec.structs.replace(
        loop_message(stamp_ns, loop_hz, newest["missed"], loop.work),
        lateness_p50_us=late["p50"],
        lateness_p99_us=late["p99"],
        lateness_p999_us=late["p999"],
        lateness_max_us=late["max"],
        longest_gap_ns=newest["longest_gap_ns"],
        longest_gap_where=GAP_PLACES[newest["longest_gap_place"]],
    )
