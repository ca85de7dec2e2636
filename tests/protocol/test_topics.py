"""The topics: every message round-trips, and nothing malformed comes through as a message."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.messages import MAX_TEXT, FieldSpec, specs
from protocol.topics import (
    HISTOGRAM_EDGES_US,
    MAX_PAYLOAD_BYTES,
    TOPICS,
    Command,
    ForceEstimate,
    Log,
    Message,
    PlannedStep,
    Pose,
    Stage,
    as_markdown,
    columns,
    decode,
    encode,
    histogram_bucket,
    json_schema,
    key,
    request_key,
    topic_of,
)

CLASSES = sorted({topic.message for topic in TOPICS.values()}, key=lambda cls: cls.__name__)
UNIT_SUFFIXES = ("m", "rad", "N", "N2", "Nm", "s", "ns", "us", "ms", "Hz", "hz", "per_m", "per_s", "steps", "counts")


def scalar(spec: FieldSpec) -> st.SearchStrategy[Any]:
    if spec.kind == "float":
        return st.floats(spec.minimum, spec.maximum, allow_nan=False, allow_infinity=False)
    if spec.kind == "integer":
        assert spec.minimum is not None and spec.maximum is not None
        return st.integers(int(spec.minimum), min(int(spec.maximum), 2**63 - 1))
    if spec.kind == "bool":
        return st.booleans()
    return st.sampled_from(spec.choices) if spec.choices else st.text(max_size=MAX_TEXT // 10)


def any_value(spec: FieldSpec) -> st.SearchStrategy[Any]:
    count = len(spec.columns)
    value = st.tuples(*[scalar(spec)] * count) if count else scalar(spec)
    return st.none() | value if spec.optional else value


def consistent(cls: type[Message], values: dict[str, Any]) -> dict[str, Any]:
    """`values` made to satisfy what holds between the fields of `cls`."""
    if cls is Pose:
        return values | {"missing": True, "position_m": None, "quaternion_wxyz": None}
    if cls is ForceEstimate:
        return values | {"converged": False}
    if cls is PlannedStep:
        return values | {"steps": max(values["steps"], 1), "step": 0}
    if cls is Command:
        return values | {
            "id": "c1",
            "commander": "console",
            "expires_ns": values["stamp_ns"],
            "action": "arm",
            "target": "none",
            "axis": "none",
        }
    return values


@pytest.mark.parametrize("cls", CLASSES)
@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_round_trip(cls: type[Message], data: st.DataObject) -> None:
    values = {name: data.draw(any_value(spec)) for name, spec in specs(cls).items()}
    message = cls(**consistent(cls, values))
    payload = encode(message)
    assert len(payload) <= MAX_PAYLOAD_BYTES
    assert decode(cls, payload) == message


@pytest.mark.parametrize("cls", CLASSES)
def test_every_float_of_a_message_names_its_unit(cls: type[Message]) -> None:
    for column, spec in columns(cls).items():
        assert spec.doc, f"{cls.__name__}.{column} has no words"
        if spec.kind == "float" and spec.unit:
            assert column.endswith(tuple("_" + suffix for suffix in UNIT_SUFFIXES)), f"{cls.__name__}.{column}"


@pytest.mark.parametrize("cls", CLASSES)
def test_schema_describes_what_is_sent(cls: type[Message]) -> None:
    schema = json.loads(json_schema(cls))
    assert set(schema["properties"]) == {"schema_version", *specs(cls)}
    assert all("unit" in item for name, item in schema["properties"].items() if name != "schema_version")


def pose_body(**changes: Any) -> bytes:
    body: dict[str, Any] = {
        "schema_version": 1,
        "stamp_ns": 5,
        "sequence": 1,
        "arrival_ns": 6,
        "frame": 2,
        "missing": False,
        "position_m": [0.0, 0.0, 0.04],
        "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0],
        "quality_m": None,
    }
    return msgpack.packb({name: value for name, value in (body | changes).items() if value != "absent"})


def test_the_body_used_below_is_good() -> None:
    assert decode(Pose, pose_body()).position_m == (0.0, 0.0, 0.04)


@pytest.mark.parametrize(
    ("payload", "says"),
    [
        (b"", "wanted one msgpack map"),
        (b"\xc1", "wanted one msgpack map"),
        (b"\x93\x01\x02\x03", "wanted one msgpack map"),
        (pose_body()[:-1], "wanted one msgpack map"),
        (pose_body() + b"\x00", "wanted one msgpack map"),
        (b"\x82\xa1a\x01\xa1a\x02", "a key twice"),
        (b"\x00" * (MAX_PAYLOAD_BYTES + 1), f"at most {MAX_PAYLOAD_BYTES}"),
        (b"\xdf\xff\xff\xff\xff", "wanted one msgpack map"),
        (b"\x91" * 4000 + b"\x00", "wanted one msgpack map"),
        (pose_body(schema_version=2), "schema_version: found 2, wanted 1"),
        (pose_body(schema_version=True), "schema_version: found True, wanted 1"),
        (pose_body(schema_version="absent"), "schema_version: found None"),
        (pose_body(stamp_ns=-1), "Pose.stamp_ns: found -1"),
        (pose_body(stamp_ns=1.0), "Pose.stamp_ns: found 1.0"),
        (pose_body(stamp_ns=True), "Pose.stamp_ns: found True"),
        (pose_body(frame=2**32), "Pose.frame"),
        (pose_body(frame="absent"), "Pose.frame: found nothing"),
        (pose_body(surprise=1), "unknown key 'surprise'"),
        (pose_body(position_m=[0.0, math.nan, 0.0]), "Pose.position_m"),
        (pose_body(position_m=[0.0, math.inf, 0.0]), "Pose.position_m"),
        (pose_body(position_m=[0.0, 0.0]), "3 of finite numbers"),
        (pose_body(position_m=[0.0, [0.0], 0.0]), "Pose.position_m"),
        (pose_body(position_m="abc"), "Pose.position_m"),
        (pose_body(position_m=[0, 0, "0"]), "Pose.position_m"),
        (pose_body(position_m=None), "wanted both, or missing true"),
        (pose_body(quaternion_wxyz=[1.1, 0.0, 0.0, 0.0]), "length 1.1, wanted 1"),
        (pose_body(missing=0), "true or false"),
        (pose_body(missing=True), "wanted neither"),
        (pose_body(position_m=[0.0, 1e300, 0.0]), "from -10 to 10 m"),
        (pose_body(stamp_ns=2**62), "from 0 to 4e+18 ns"),
    ],
)
def test_malformed_payloads_are_refused_in_one_line(payload: bytes, says: str) -> None:
    with pytest.raises(ValueError) as caught:
        decode(Pose, payload)
    assert says in str(caught.value) and "\n" not in str(caught.value) and len(str(caught.value)) < 300


@settings(max_examples=300, deadline=None)
@given(payload=st.binary(max_size=300), cls=st.sampled_from(CLASSES))
def test_noise_raises_value_error_only(payload: bytes, cls: type[Message]) -> None:
    with pytest.raises(ValueError):
        decode(cls, payload)


@settings(max_examples=300, deadline=None)
@given(data=st.data())
def test_a_changed_byte_is_refused_or_still_a_good_message(data: st.DataObject) -> None:
    payload = bytearray(pose_body())
    place = data.draw(st.integers(0, len(payload) - 1))
    payload[place] = data.draw(st.integers(0, 255))
    try:
        message = decode(Pose, bytes(payload))
    except ValueError:
        return
    assert message.position_m is not None and all(map(math.isfinite, message.position_m))
    assert message.quaternion_wxyz is not None and abs(math.hypot(*message.quaternion_wxyz) - 1) <= 1e-3


def test_nothing_bad_leaves() -> None:
    with pytest.raises(ValueError, match=r"Stage\.command_roll_rad: found nan"):
        encode(Stage(stamp_ns=0, command_insertion_m=0.0, command_roll_rad=math.nan, command_knob_rad=0.0))
    with pytest.raises(ValueError, match="found converged without force"):
        encode(ForceEstimate(stamp_ns=0, frame="base", converged=True, published_ns=0, compute_us=1.0))


def test_numpy_values_travel_and_optional_nan_becomes_nil() -> None:
    values: dict[str, Any] = {
        "stamp_ns": np.int64(7),
        "frame": "base",
        "converged": np.bool_(True),
        "force_N": np.array([1.0, 2.0, 3.0]),
        "covariance_N2": np.eye(3),
        "residual": np.float64("nan"),
        "published_ns": 8,
        "compute_us": np.float32(2.5),
    }
    message = ForceEstimate(**values)
    back = decode(ForceEstimate, encode(message))
    assert back.force_N == (1.0, 2.0, 3.0) and back.residual is None and back.covariance_N2 == tuple(np.eye(3).ravel())


def test_an_implausible_measurement_is_sent_as_nil_and_an_implausible_command_is_not_sent() -> None:
    body: dict[str, Any] = {"command_insertion_m": 0.0, "command_roll_rad": 0.0, "command_knob_rad": 0.0}
    sent = decode(Stage, encode(Stage(stamp_ns=0, encoder_insertion_m=-26_843.0, encoder_roll_rad=0.5, **body)))
    assert sent.encoder_insertion_m is None and sent.encoder_roll_rad == 0.5
    with pytest.raises(
        ValueError, match=r"Stage\.command_insertion_m: found 1e\+300, wanted a finite number from -1 to 1 m"
    ):
        encode(Stage(stamp_ns=0, **body | {"command_insertion_m": 1e300}))


@pytest.mark.parametrize("cls", CLASSES)
def test_every_number_has_bounds(cls: type[Message]) -> None:
    for name, spec in specs(cls).items():
        if spec.kind in ("float", "integer"):
            assert spec.minimum is not None and spec.maximum is not None, name
            assert abs(spec.maximum) <= 4e18 and abs(spec.minimum) <= 4e18, name


def test_sequence_can_be_given_when_sending() -> None:
    assert decode(Log, encode(Log(stamp_ns=0, level="info", source="a", text="b"), 41)).sequence == 41


def test_long_texts_are_cut_when_sent_and_refused_when_received() -> None:
    sent = decode(Log, encode(Log(stamp_ns=0, level="info", source="a", text="x" * 10_000)))
    assert len(sent.text) == MAX_TEXT
    body = msgpack.unpackb(encode(sent)) | {"text": "x" * (MAX_TEXT + 1)}
    with pytest.raises(ValueError, match=r"Log\.text"):
        decode(Log, msgpack.packb(body))


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"action": "target"}, "wanted a kind with action target"),
        ({"target": "hold"}, "none without"),
        ({"action": "target", "target": "position"}, "Command.target_m"),
        ({"action": "target", "target": "contact", "target_m": (0, 0, 0.04), "force_N": 0.2}, "no unit normal"),
        ({"action": "target", "target": "contact", "target_m": (0, 0, 0.04), "normal": (0, 0, 2), "force_N": 0.2}, "unit"),
        ({"force_N": 1.5}, "Command.force_N"),
        ({"force_N": -0.1}, "Command.force_N"),
        ({"expires_ns": 5}, "before stamp_ns"),
        ({"action": "force"}, "Command.force_N"),
        ({"commander": ""}, "commander: found"),
        ({"commander": "Console"}, "commander: found"),
        ({"commander": "a/b"}, "commander: found"),
        ({"id": ""}, "Command.id"),
        ({"axis": "tip"}, "Command.axis"),
        ({"action": "jog"}, "Command.axis"),
        ({"action": "jog", "axis": "knob"}, "travel_unit"),
        ({"action": "jog", "axis": "tip", "travel_unit": 0.001, "speed_unit_per_s": 0.01}, "Command.direction"),
        ({"action": "jog", "axis": "elbow", "travel_unit": 0.001, "speed_unit_per_s": 0.01}, "Command.axis"),
        ({"action": "mark"}, "Command.note"),
        ({"id": "x" * 65}, "Command.id"),
    ],
)
def test_incomplete_commands_are_refused(changes: dict[str, Any], says: str) -> None:
    good: dict[str, Any] = {
        "stamp_ns": 10,
        "id": "c1",
        "commander": "console",
        "expires_ns": 20,
        "action": "arm",
        "target": "none",
    }
    assert decode(Command, encode(Command(**good))).action == "arm"
    with pytest.raises(ValueError, match=says):
        encode(Command(**(good | changes)))


@pytest.mark.parametrize("name", TOPICS)
def test_keys_go_both_ways(name: str) -> None:
    assert key("simulated", name) == f"seldinger/v1/simulated/{name}"
    assert topic_of(key("simulated", name)) == ("simulated", TOPICS[name])


@pytest.mark.parametrize(
    "bad",
    [
        "seldinger/v2/simulated/stage",
        "seldinger/v1/simulated/nothing",
        "stage",
        "",
        "seldinger/v1/Rig/stage",
        "seldinger/v1/a/b/stage",
        "seldinger/v1/simulated/stage\n",
    ],
)
def test_other_keys_are_refused(bad: str) -> None:
    with pytest.raises(ValueError, match="key: found"):
        topic_of(bad)


@pytest.mark.parametrize("name", ["", "a/b", "**", "a*", "$*", "Console", "x" * 33, "a\n"])
def test_names_of_commanders_cannot_widen_a_key(name: str) -> None:
    assert request_key("simulated", "console") == "seldinger/v1/simulated/request/console"
    with pytest.raises(ValueError, match="commander: found"):
        request_key("simulated", name)


@pytest.mark.parametrize("rig", ["", "a/b", "**", "Rig", "x" * 33])
def test_rig_names_cannot_widen_a_key(rig: str) -> None:
    with pytest.raises(ValueError, match="rig: found"):
        key(rig, "stage")


@given(st.floats(0, 1e9))
def test_histogram_buckets_hold_what_their_edges_say(time_us: float) -> None:
    bucket = histogram_bucket(time_us)
    assert bucket == 0 or HISTOGRAM_EDGES_US[bucket] <= time_us * (1 + 1e-12)
    assert bucket == len(HISTOGRAM_EDGES_US) - 2 or time_us <= HISTOGRAM_EDGES_US[bucket + 1] * (1 + 1e-12)


def test_the_page_has_the_table_as_it_is() -> None:
    page = (Path(__file__).parents[2] / "docs" / "topics.md").read_text(encoding="utf-8")
    assert as_markdown() in page, "docs/topics.md: found another table, wanted that of `python -m protocol.topics`"


def test_the_table_prints_every_topic_and_unit() -> None:
    page = as_markdown()
    assert all(f"`{name}`" in page for name in TOPICS) and "`force_N`" in page and "N^2" in page
