"""The realtime core without threads, ports or a tick: what arrives by hand, what leaves compared with what must."""

from __future__ import annotations

from collections.abc import Iterable

import msgspec
import numpy as np
import pytest

from protocol.enums import BoardState, CommandKind, Phase, SafetyAction
from protocol.rig_file import Rig
from protocol.serial_frames import Fault
from protocol.topics import Command, ForceEstimate, Log, LoopTiming, Message, Reply, RigCause, encode
from realtime.control import safety
from realtime.control.records import INPUTS, OUTPUTS, new
from realtime.core.process import PUBLISHED
from realtime.core.rig_core import CAUSE_QUIET_NS, Arrived, CommandRequest, Leaving, RigCore, Tick
from realtime.core.telemetry import loop_message
from realtime.drivers.aurora import PoseSample
from realtime.drivers.device_events import DeviceEvent, DeviceEventKind
from realtime.drivers.net_ft import ForceSample
from realtime.drivers.stepper_board import LinkPhase
from realtime.loop.native_loop import HISTOGRAM_WORDS
from tests.realtime.test_stepper_board import Peer

MS = 1_000_000


class Bench:
    """A core with a board that answers, and sensors that send as long as `sensors` is true."""

    def __init__(self, rig: Rig) -> None:
        self.inputs = new(INPUTS)
        records = {name: getattr(self.inputs[0], name) for name in INPUTS.names or () if name != "now_ns"}
        self.core = RigCore(rig, records, self._timing, new_lease=lambda: "lease")
        self.rig, self.peer, self.now_ns, self.sensors = rig, Peer(), 20_000 * MS, True
        self.messages: list[tuple[str, Message]] = []
        self.state, self.steps, self.counts = BoardState.DISARMED, np.zeros(3, int), np.zeros(3, int)
        self.fault = Fault.NONE
        self.phase, self._ticks, self._commands, self._answers = Phase.DISARMED, 0, 0, b""

    @staticmethod
    def _timing(stamp_ns: int) -> LoopTiming:
        return loop_message(stamp_ns, 1000.0, 0, np.zeros(HISTOGRAM_WORDS, np.int64))

    def step(self, arrived: Arrived | None = None) -> Leaving:
        leaving = self.core.step(self.now_ns, arrived or Arrived())
        self._answers += self.peer.answer(b"".join(leaving.frames))
        self.messages += leaving.messages
        return leaving

    def tick(self, cause: int = 0, action: SafetyAction = SafetyAction.NONE) -> Tick:
        self._ticks += 1
        outputs = new(OUTPUTS)[0]
        outputs.now_ns, outputs.phase, outputs.cause, outputs.action = self.now_ns, self.phase, cause, action
        return Tick(self._ticks, outputs)

    def status(self) -> bytes:
        return self.peer.status(
            state=self.state,
            fault=self.fault,
            position_steps=tuple(self.steps),
            encoder_counts=tuple(self.counts),
            mcu_time_us=self.now_ns // 1000 & 0xFFFFFFFF,
        )

    def run(self, milliseconds: int, cause: int = 0, action: SafetyAction = SafetyAction.NONE) -> None:
        """A tick every ms, a status every 5, samples every 25."""
        for _ in range(milliseconds):
            self.now_ns += MS
            due = (self.now_ns // MS) % 5 == 0
            arrived = Arrived(ticks=[self.tick(cause, action)], board=self._answers + (self.status() if due else b""))
            self._answers = b""
            if self.sensors and (self.now_ns // MS) % 25 == 0:
                arrived.poses, arrived.forces = [self._pose()], [self._force()]
            self.step(arrived)

    def _pose(self) -> PoseSample:
        position, quaternion = np.array([0.0, 0.0, 0.03]), np.array([1.0, 0.0, 0.0, 0.0])
        tip = self.rig.tracker.tip_handle
        return PoseSample(tip, 1, self.now_ns - 25 * MS, self.now_ns, position, quaternion, 0.0, False)

    def _force(self) -> ForceSample:
        return ForceSample(self.now_ns, self.now_ns, np.zeros(3), np.zeros(3), 1, 0, 0)

    def ask(self, action: str, **fields: object) -> Reply:
        """A command of one who holds the lease."""
        self._commands += 1
        command = Command(
            **{  # type: ignore[arg-type]
                "stamp_ns": self.now_ns,
                "sequence": self._commands,
                "id": f"c{self._commands}",
                "commander": "console",
                "lease": "lease",
                "expires_ns": self.now_ns + 500 * MS,
                "action": action,
                "target": "none",
            }
            | fields
        )
        reply = self.step(Arrived(requests=[CommandRequest("console", encode(command))])).replies[0]
        assert reply is not None
        return reply

    def armed(self) -> Bench:
        """Brought up, armed, and holding."""
        self.run(300)
        assert self.core.link.phase is LinkPhase.READY and self.ask("take", lease="").result == "accepted"
        assert self.ask("arm").result == "accepted"
        self.phase, self.state = Phase.HOLD, BoardState.RUNNING
        self.run(20)
        return self

    def logged(self, source: str) -> list[str]:
        return [m.text for _, m in self.messages if isinstance(m, Log) and m.source == source]


@pytest.fixture
def core(rig: Rig) -> Bench:
    return Bench(rig)


def test_arming_with_silent_sensors_is_refused_and_with_fresh_ones_accepted(core: Bench) -> None:
    core.sensors = False
    core.run(300)
    assert core.core.link.phase is LinkPhase.READY and core.ask("take", lease="").result == "accepted"
    before = core.inputs.tobytes()
    reply = core.ask("arm")
    assert reply.result == "refused" and "the tracker (tip), the force sensor" in reply.text
    assert core.inputs.tobytes() == before and "ARM" not in core.peer.heard
    core.sensors = True
    core.run(30)
    assert core.ask("arm").result == "accepted" and core.core.commands.armed
    core.run(2)
    assert core.peer.heard[-1] == "ARM"


def test_by_estimates_alone_the_model_process_must_answer_before_arming(rig: Rig) -> None:
    bench = Bench(rig)
    bench.core.params[0].force_source = 1
    bench.run(300)
    bench.ask("take", lease="")
    assert "nothing from the model process" in bench.ask("arm").text
    estimate = ForceEstimate(
        stamp_ns=bench.now_ns - 30 * MS,
        frame="base",
        converged=True,
        force_N=(0.0, 0.0, 0.0),
        covariance_N2=tuple(np.eye(3).ravel()),
        published_ns=bench.now_ns,
        compute_us=1.0,
    )
    bench.step(Arrived(estimates=[estimate]))
    assert bench.ask("arm").result == "accepted"


def test_accepted_and_refused_commands_are_published_and_logged(core: Bench) -> None:
    core.armed()
    assert core.ask("target", target="position", target_m=(0.0, 0.0, 0.5)).result == "refused"
    lines = core.logged("commander")
    assert "console: arm: accepted" in lines and any("console: target position: refused" in line for line in lines)
    topics = [topic for topic, _ in core.messages]
    assert topics.count("command") == topics.count("reply") == 3
    assert all(m.lease == "" for _, m in core.messages if isinstance(m, Command | Reply))


def test_a_cause_that_acts_is_logged_when_it_appears_and_not_while_it_flickers(core: Bench) -> None:
    core.armed()
    core.run(100, safety.POSE_REJECTED, SafetyAction.WARN)
    assert not core.logged("safety"), "a warning moves nothing"
    for _ in range(20):
        core.run(10, safety.POSE_STALE, SafetyAction.HOLD)
        core.run(15)
    lines = core.logged("safety")
    assert len(lines) == 1 and lines[0].startswith("hold: no fresh pose")
    core.run(50, safety.POSE_STALE | safety.OVER_FORCE, SafetyAction.RETRACT)
    (line,) = core.logged("safety")[1:]
    assert line.startswith("retract: contact force above the limit: retracting (force sensor 0.00 N, estimate")
    core.run(CAUSE_QUIET_NS // MS + 10)
    core.run(5, safety.POSE_STALE, SafetyAction.HOLD)
    assert len(core.logged("safety")) == 3


def test_lost_steps_are_judged_by_the_phase_of_the_newest_tick(core: Bench) -> None:
    """A status that arrives together with the tick that armed the loop is the reference of the encoder check."""
    core.armed()
    core.phase = Phase.DISARMED
    core.run(10)
    core.counts = np.array([5000, 0, 0])  # turned by hand while disarmed
    core.phase = Phase.HOLD
    ticks = [core.tick()]
    core.ask("clear_fault")
    core.step(Arrived(ticks=ticks, board=core.status()))
    core.counts = core.counts + np.array([0, round(300 * core.rig.stage(1).encoder_counts_per_step), 0])
    count = int(core.inputs[0].command.count)
    core.run(30)
    lines = core.logged("supervision")
    assert len(lines) == 1 and lines[0].startswith("roll: encoder and steps differ by 300 steps")
    assert core.inputs[0].command.watch == safety.STEPS_LOST
    assert core.inputs[0].command.count == count, "a finding is no new command"


def test_arming_is_refused_while_a_cause_stops_the_rig(core: Bench) -> None:
    """The board would be live, the loop would not: its dead man would then latch another fault."""
    core.armed()
    assert core.ask("disarm").result == "accepted"
    core.run(30, safety.OVER_FORCE, SafetyAction.RETRACT)
    reply = core.ask("arm")
    assert reply.result == "refused" and "over_force" in reply.text and "clear it first" in reply.text
    assert not core.core.commands.armed and core.peer.heard[-1] != "ARM"
    core.run(30, safety.OPERATOR_STOP, SafetyAction.STOP)
    assert core.ask("arm").result == "accepted", "a stop ends as the rig is disarmed"


def test_a_refused_arm_does_not_forget_what_the_supervision_found(core: Bench) -> None:
    core.armed()
    core.counts = np.array([10_000, 0, 0])
    core.run(30)
    assert core.inputs[0].command.watch == safety.STEPS_LOST
    assert core.ask("arm").result == "refused" and core.inputs[0].command.watch == safety.STEPS_LOST
    assert core.ask("clear_fault").result == "accepted" and core.inputs[0].command.watch == 0


def test_another_force_is_no_new_command_to_the_tick(core: Bench) -> None:
    core.armed()
    target = {"target": "contact", "target_m": (0.0, -0.0107, 0.025), "normal": (0.0, 0.0, 1.0), "force_N": 0.1}
    assert core.ask("target", **target).result == "accepted"
    count = int(core.inputs[0].command.count)
    assert core.ask("force", force_N=0.2).result == "accepted" and core.inputs[0].command.force_N == 0.2
    assert core.inputs[0].command.count == count


def test_a_device_that_returns_disarms(core: Bench) -> None:
    core.armed()
    event = DeviceEvent(core.now_ns, "aurora", DeviceEventKind.RECONNECTED, "tools 0A, 0B")
    leaving = core.step(Arrived(device_events=[event]))
    assert not core.core.commands.armed and leaving.changed == {"command"} and len(leaving.frames) == 1
    assert core.inputs[0].command.kind == CommandKind.HOLD
    assert core.logged("aurora") == ["tools 0A, 0B", "aurora is back: disarmed, to be armed again"]


def test_while_the_loop_does_not_run_only_a_stop_is_accepted(core: Bench) -> None:
    core.armed()
    for action, result in (("disarm", "refused"), ("stop", "accepted")):
        command = Command(
            stamp_ns=core.now_ns,
            sequence=1000,
            id=action,
            commander="console",
            lease="lease",
            expires_ns=core.now_ns + MS,
            action=action,
            target="none",
        )
        replies = core.step(Arrived(requests=[CommandRequest("console", encode(command))], loop_runs=False)).replies
        assert replies[0] is not None and replies[0].result == result


def test_a_gap_between_two_ticks_is_logged_whatever_made_it(core: Bench) -> None:
    core.armed()
    core.now_ns += 50 * MS
    core.run(1)
    core.now_ns -= 1000 * MS
    core.run(2)
    lines = core.logged("realtime")
    assert len(lines) == 2 and "51.0 ms between two ticks, wanted 1 ms" in lines[0] and "-999.0 ms" in lines[1]


def test_telemetry_does_not_depend_on_how_ticks_are_grouped(rig: Rig) -> None:
    """A wall-clock shell hands over a few ticks at once, the lock step one at a time."""

    def published(group: int) -> list[tuple[str, Message]]:
        bench = Bench(rig).armed()
        bench.messages.clear()
        ticks = []
        for number in range(1000):
            bench.now_ns += MS
            ticks.append(bench.tick(safety.OVER_FORCE if number > 500 else 0, SafetyAction.RETRACT))
            if len(ticks) == group:
                bench.step(Arrived(ticks=ticks))
                ticks = []
        return list(_without_counts(bench.messages))

    assert published(1) == published(5) == published(20)


def _without_counts(messages: Iterable[tuple[str, Message]]) -> Iterable[tuple[str, Message]]:
    for topic, message in messages:
        yield topic, msgspec.structs.replace(message, stamp_ns=0) if topic == "commander" else message


def causes(bench: Bench) -> list[RigCause]:
    return [message for _, message in bench.messages if isinstance(message, RigCause)]


def test_the_process_publishes_every_topic_of_the_core(core: Bench) -> None:
    core.armed().run(600)
    core.ask("stop")
    core.run(20)
    sent = {topic for topic, _ in core.messages}
    assert {"stage", "state", "cause", "board", "loop", "command", "reply", "commander", "log"} <= sent <= set(PUBLISHED)


def test_every_stall_is_the_first_cause_of_its_stop_not_the_longest_alone(core: Bench) -> None:
    core.armed().run(600)
    for stall_ms in (120, 100):
        core.now_ns += stall_ms * MS
        core.run(20, safety.BOARD_SILENT, SafetyAction.STOP)
        newest = causes(core)[-1]
        assert newest.name == "loop_late" and f"{stall_ms + 1} ms" in newest.says and "real-time" in newest.remedy
        assert newest.followed == "+0 ms: The stepper board sent no status."
        assert core.ask("clear_fault").result == "accepted"
        core.phase, core.state = Phase.DISARMED, BoardState.DISARMED
        core.run(6_000)
        core.ask("take", lease="")
        reply = core.ask("arm")
        assert reply.result == "accepted", reply.text
        core.phase, core.state = Phase.HOLD, BoardState.RUNNING
        core.run(600)
        assert not causes(core)[-1].name, "armed again: what was before is over"


def test_a_program_that_listens_late_receives_the_first_cause_and_its_time(core: Bench) -> None:
    core.armed().run(600)
    core.now_ns += 100 * MS
    core.run(10, safety.BOARD_SILENT, SafetyAction.STOP)
    stopped_ns = core.now_ns
    core.run(7_000, safety.BOARD_SILENT, SafetyAction.STOP)
    newest = causes(core)[-1]
    assert newest.name == "loop_late" and newest.since_ns <= stopped_ns < newest.stamp_ns - 6_500 * MS


def test_a_fault_of_the_board_while_the_rig_is_armed_has_a_cause_although_the_loop_has_none(core: Bench) -> None:
    core.armed()
    core.now_ns += 100 * MS
    core.phase, core.state, core.fault = Phase.DISARMED, BoardState.FAULT, Fault.DEADMAN
    core.run(100)
    newest = causes(core)[-1]
    assert newest.name == "loop_late" and newest.followed.endswith("so its dead man stopped the axes.")
    core.state, core.fault = BoardState.DISARMED, Fault.NONE
    core.run(100)
    assert not causes(core)[-1].name


def test_a_device_that_is_back_is_why_the_rig_is_disarmed(core: Bench) -> None:
    core.armed().run(600)
    core.core.step(core.now_ns, Arrived(device_events=[DeviceEvent(core.now_ns, "net_ft", DeviceEventKind.RECONNECTED, "")]))
    core.run(50)
    newest = causes(core)[-1]
    assert newest.name == "device_returned" and "(net_ft)" in newest.says and "arm again" in newest.remedy
    assert core.ask("arm").result == "accepted"
    core.run(20)
    assert not causes(core)[-1].name


def test_what_was_over_long_before_a_stop_is_not_its_cause(core: Bench) -> None:
    core.armed().run(50, safety.POSE_REJECTED, SafetyAction.WARN)
    core.run(6_000)
    core.run(20, safety.BOARD_SILENT, SafetyAction.STOP)
    assert causes(core)[-1].name == "board_silent"


def test_a_stopped_rig_refuses_a_motion_that_it_would_not_carry_out_and_says_how_to_go_on(core: Bench) -> None:
    core.armed()
    core.phase = Phase.STOPPED
    core.run(5)
    for action, fields in (
        ("target", {"target": "position", "target_m": (0.0, -0.0107, 0.02)}),
        ("target", {"target": "retract"}),
        ("jog", {"axis": "insertion", "travel_unit": 1e-3, "speed_unit_per_s": 1e-3}),
    ):
        reply = core.ask(action, **fields)
        assert reply.result == "refused" and reply.text.endswith("disarm and arm again"), reply.text
    assert core.ask("hold").result == "accepted"
