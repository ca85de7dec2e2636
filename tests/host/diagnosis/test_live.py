"""The live watch on messages of a plant: silent without an effect, an alarm with the right place within 10 s of one."""

from collections.abc import Iterator

import numpy as np
import pytest

from host.diagnosis.live.twin import FrameCollector
from host.diagnosis.live.watch import Watch, watch
from protocol.rig_file import SIMULATED_RIG, load_rig
from protocol.topics import Alarm, ForceSensor, Message, Pose, RigState, Stage
from protocol.zenoh_session import Session
from sim.effects import PlantedEffect, parse
from sim.plant import Plant, PlantConfig
from tests.waiting import free_port, until

RIG = load_rig(SIMULATED_RIG)
ON_S, END_S = 15.0, 24.0
STEP_NS = 1_000_000
Heard = tuple[int, str, Message]


def messages(effects: tuple[PlantedEffect, ...], seconds: float, seed: int = 1) -> Iterator[Heard]:
    """What a rig under a hand that moves all axes in front of the wall and onto it would publish, with its arrival (ns)."""
    plant = Plant(PlantConfig(tool_offsets_m=(0.0, RIG.tracker.shaft_sensor_offset_m), effects=effects), seed)
    rng, frame = np.random.default_rng(seed), 0
    yield 0, "state", RigState(stamp_ns=0, mode="hold", safety_action="none", cause="", poses_rejected=0, forces_rejected=0)
    for now in range(STEP_NS, round(seconds * 1e9), STEP_NS):
        t = now * 1e-9
        begin = min(t, 1.0)
        handle = begin * np.array(
            [0.003 * np.sin(2.0 * t) + 0.001 * np.sin(5.3 * t), 0.5 * np.sin(1.1 * t), 0.6 + 0.12 * np.sin(0.9 * t)]
        )
        plant.step(1e-3, handle)
        ms = now // STEP_NS
        if ms % 5 == 0:
            a, b, c = map(float, handle)
            yield (
                now,
                "stage",
                Stage(
                    stamp_ns=now,
                    command_insertion_m=a,
                    command_roll_rad=b,
                    command_knob_rad=c,
                    encoder_insertion_m=a,
                    encoder_roll_rad=b,
                    encoder_knob_rad=c,
                ),
            )
            force = plant.measured_wrench()[0] + 1e-3 * rng.standard_normal(3)
            yield now, "force/sensor", ForceSensor(stamp_ns=now, arrival_ns=now, force_N=tuple(map(float, force)))
        if ms % 25 == 0:
            for tool, topic in enumerate(("pose/tip", "pose/shaft")):
                yield now + 30 * STEP_NS, topic, _pose(plant, tool, now, frame, rng)
            frame += 1


def _pose(plant: Plant, tool: int, now: int, frame: int, rng: np.random.Generator) -> Pose:
    shown = plant.measured_pose(tool)
    position = shown.position_m + 2.9e-4 * rng.standard_normal(3)
    quaternion = shown.quaternion_wxyz + 1.75e-3 * rng.standard_normal(4)
    quaternion /= np.linalg.norm(quaternion)
    return Pose(
        stamp_ns=now,
        arrival_ns=now + 30 * STEP_NS,
        frame=frame,
        missing=rng.random() < 0.02,
        position_m=tuple(map(float, position)),
        quaternion_wxyz=tuple(map(float, quaternion)),
    )


def alarms(effects: tuple[PlantedEffect, ...], seconds: float = END_S, seed: int = 1) -> list[Alarm]:
    watcher, found = Watch(RIG), []
    for _, topic, message in sorted(messages(effects, seconds, seed), key=lambda heard: heard[0]):
        watcher.receive(topic, message)
        alarm = watcher.look() if topic == "pose/shaft" else None
        found += [alarm] if alarm else []
    assert watcher.phase == "watching"
    return found


def test_silent_where_nothing_is_missing() -> None:
    assert alarms((), 30.0, seed=2) == []


@pytest.mark.parametrize(
    ("planted", "cause"),
    [
        ("backlash@insertion:width_m=0.002", "backlash"),
        ("latency@pose_sensor:delay_s=0.06", "latency"),
        ("sensor_bias@pose_sensor:x_m=0.001", "sensor_bias"),
        ("whip@roll:amplitude_rad=0.3", "periodic_disturbance"),
        ("base_motion@base:rise_s=1", "base_motion"),
    ],
)
def test_alarm_within_ten_seconds_of_the_effect(planted: str, cause: str) -> None:
    found = alarms((parse(f"{planted},start_s={ON_S}"),))
    assert len(found) == 1
    alarm = found[0]
    assert ON_S < alarm.stamp_ns * 1e-9 < ON_S + 10.0 and alarm.score > 1.0
    assert alarm.subsystem == parse(planted).port and alarm.effect == cause, alarm.words
    assert ON_S < alarm.since_ns * 1e-9 < ON_S + 3.0


def test_the_twin_is_only_held_against_an_armed_rig() -> None:
    watcher = Watch(RIG)
    for _, topic, message in messages((), 3.0):
        if topic != "state":
            watcher.receive(topic, message)
            assert watcher.look() is None
    assert watcher.phase == "waiting"


def test_rows_are_even_and_lost_frames_stay_empty() -> None:
    frames = FrameCollector(RIG, 5.0)
    for _, topic, message in sorted(messages((), 2.0), key=lambda heard: heard[0]):
        if not (isinstance(message, Pose) and message.frame in (20, 21, 22)):
            frames.receive(topic, message)
            frames.settle()
    assert np.all(np.diff(frames.stamps_ns) == frames.period_ns)
    recording = frames.recording(0)
    tip = recording.channels["tip_x_m"]
    assert np.isnan(tip[20:23]).all() and np.isfinite(tip).mean() > 0.7
    handle = recording.channels["handle_roll"]
    assert np.max(np.abs(np.diff(handle[:20], 2))) < 2e-3 and np.ptp(handle[:20]) > 0.01


def test_watch_publishes_what_it_finds() -> None:
    heard = sorted(messages((parse(f"latency@pose_sensor:delay_s=0.06,start_s={ON_S}"),), END_S), key=lambda h: h[0])
    chunks = [[(topic, message, b"") for _, topic, message in heard[k : k + 40]] for k in range(0, len(heard), 40)]
    said: list[str] = []

    class Bus:
        def take(self) -> list[tuple[str, Message, bytes]]:
            return chunks.pop(0) if chunks else []

    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with Session(RIG.name, [endpoint], []) as here, Session(RIG.name, [], [endpoint]) as there:
        arriving, publisher = there.latest("alarm"), here.publisher("alarm")
        count = watch(RIG, Bus(), publisher.put, said.append, lambda: not chunks)
        got: list[Message | None] = []
        until(lambda: got.append(arriving.take()) or got[-1] is not None, "the alarm")
    assert count == 1 and said == ["learning", "watching"]
    assert isinstance(got[-1], Alarm) and got[-1].subsystem == "pose_sensor"


def test_effects_of_the_command_line() -> None:
    assert parse("backlash@insertion:width_m=0.002,start_s=25") == PlantedEffect(
        "backlash", "insertion", {"width_m": 0.002}, 25.0
    )
    with pytest.raises(ValueError, match="found 'width', wanted NAME=NUMBER"):
        parse("backlash@insertion:width")
    with pytest.raises(ValueError, match="found parameter 'wide_m'"):
        parse("backlash@insertion:wide_m=1")
    with pytest.raises(ValueError, match="effect port: found 'nowhere'"):
        parse("backlash@nowhere")
