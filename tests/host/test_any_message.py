"""Whatever a topic carries: recorder, page, estimator service and report take it in and go on, in bounded time."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import msgspec
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from host.estimation.service import DEFAULT_ESTIMATOR, EstimationService, load_estimator
from host.recordings.header import header_of
from host.recordings.recording import RecordingFile
from host.recordings.rig_picture import Picture
from host.recordings.writer import RecordingWriter
from host.report.run_report import render
from protocol.catheter import load_catheter
from protocol.messages import FieldSpec, specs
from protocol.rig_file import SIMULATED_RIG, load_rig
from protocol.topics import TOPICS, Message, decode, encode

# Processor time, so that a busy machine changes nothing. A message with 1e6 m outside the sheath took 20 s.
LONGEST_PER_MESSAGE_s = 1.0
LONGEST_REPORT_s = 60.0
QUATERNIONS = [(1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, -1.0), (0.5, -0.5, 0.5, -0.5)]
RECORDED = [name for name, topic in TOPICS.items() if topic.kind != "query"]


def extreme(spec: FieldSpec) -> st.SearchStrategy[Any]:
    """Bounds first, then anything between them."""
    if spec.kind == "bool":
        return st.booleans()
    if spec.choices:
        return st.sampled_from(spec.choices)
    if spec.kind == "text":
        return st.sampled_from(["", "x" * 500, "\u0000\n\x1b[31m<b>{{}}", "🫀" * 100])
    low, high = spec.minimum, spec.maximum
    assert low is not None and high is not None
    if spec.kind == "integer":
        return st.sampled_from([int(low), int(high)]) | st.integers(int(low), int(high))
    return st.sampled_from([low, high, 0.0 if low <= 0 else low, 5e-324 if low <= 0 else low]) | st.floats(low, high)


def value_of(spec: FieldSpec) -> st.SearchStrategy[Any]:
    count = len(spec.columns)
    value = st.tuples(*[extreme(spec)] * count) if count else extreme(spec)
    return st.none() | value if spec.optional else value


class Hidden(NamedTuple):
    """Payloads that a failing test does not print: 30 kB of bytes help nobody."""

    payloads: list[tuple[str, bytes]]

    def __repr__(self) -> str:
        return f"{len(self.payloads)} payloads"


@st.composite
def payloads(draw: st.DrawFn) -> tuple[str, bytes]:
    """A topic and a payload that its decoder lets through."""
    name = draw(st.sampled_from(RECORDED))
    message_class = TOPICS[name].message
    values = {field: draw(value_of(spec)) for field, spec in specs(message_class).items()}
    if "quaternion_wxyz" in values and values["quaternion_wxyz"] is not None:
        values["quaternion_wxyz"] = draw(
            st.sampled_from([(1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, -1.0), (0.5, -0.5, 0.5, -0.5)])
        )
    if name == "command":
        values |= {"id": "c", "commander": "console", "action": "arm", "target": "none", "expires_ns": values["stamp_ns"]}
        values["axis"] = "none"
    if name == "plan":
        values["steps"] = min(values["step"] + 1 + values["steps"], 255)
        values["step"] = min(values["step"], values["steps"] - 1)
    message = message_class(**values)
    try:
        return name, encode(message)
    except ValueError:  # two fields contradict each other
        loose = (
            {"missing": True, "position_m": None, "quaternion_wxyz": None}
            if name.startswith("pose/")
            else {"converged": False}
        )
        return name, encode(msgspec.structs.replace(message, **loose))


@pytest.fixture(scope="module")
def readers(tmp_path_factory: pytest.TempPathFactory) -> tuple[RecordingWriter, Picture, EstimationService]:
    rig = load_rig(SIMULATED_RIG)
    header = header_of(rig, "virtual", 1)
    service = EstimationService(load_estimator(DEFAULT_ESTIMATOR, rig))
    picture = Picture(header.configuration, dataclasses.asdict(load_catheter(rig.catheter.name)))
    return RecordingWriter(tmp_path_factory.mktemp("any") / "any.mcap", header), picture, service


def timed(call: Callable[[], object]) -> float:
    begin_s = time.process_time()
    call()
    return time.process_time() - begin_s


def take_in(
    readers: tuple[RecordingWriter, Picture, EstimationService], topic: str, payload: bytes, recorded_ns: int
) -> None:
    recorder, picture, service = readers
    message: Message = decode(TOPICS[topic].message, payload)
    recorder.write_encoded(topic, payload, message.stamp_ns, message.sequence, recorded_ns)
    picture.take(topic, msgspec.msgpack.decode(payload))
    picture.frame()
    service.receive(topic, message)
    answer = service.answer(recorded_ns)
    if answer is not None:
        encode(answer)


@pytest.mark.slow
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(arrived=st.lists(payloads(), min_size=1, max_size=6), recorded_ns=st.integers(0, 2**62))
def test_recorder_picture_and_estimator_go_on(
    readers: tuple[RecordingWriter, Picture, EstimationService], arrived: list[tuple[str, bytes]], recorded_ns: int
) -> None:
    take_in(readers, *arrived[0], recorded_ns)  # the first call of a process loads kernels
    for topic, payload in arrived:
        assert timed(lambda t=topic, p=payload: take_in(readers, t, p, recorded_ns)) < LONGEST_PER_MESSAGE_s  # type: ignore[misc]
    assert not readers[0].failure


@pytest.mark.slow
@settings(
    max_examples=6,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
    phases=[Phase.explicit, Phase.generate],  # to shrink a failing report takes minutes
)
@given(data=st.data())
def test_a_report_is_written_of_it(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    arrived = data.draw(st.lists(payloads(), min_size=5, max_size=40).map(Hidden)).payloads
    path = tmp_path_factory.mktemp("report") / "any.mcap"
    with RecordingWriter(path, header_of(load_rig(SIMULATED_RIG), "virtual", 1)) as writer:
        for topic, payload in arrived:
            message = decode(TOPICS[topic].message, payload)
            writer.write_encoded(topic, payload, message.stamp_ns, message.sequence, message.stamp_ns)
    recording = RecordingFile(path)
    assert sum(recording.topics.values()) == len(arrived)
    assert timed(lambda: render(recording)) < LONGEST_REPORT_s
