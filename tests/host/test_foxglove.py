"""What Foxglove asks of a recording: JSON messages, one plain type a property, its own schemas by their names."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from host.diagnosis.model.tables import read_table
from host.recordings.foxglove import SCHEMAS, plain_schema
from host.recordings.header import RecordingHeader
from host.recordings.recording import RecordingFile
from host.recordings.writer import RecordingWriter
from protocol.catheter import load_catheter
from protocol.messages import json_schema
from protocol.rig_file import SIMULATED_RIG, load_rig
from protocol.topics import TOPICS, ForceSensor, Log, Pose, RigState, Stage, encode

PLAIN = {
    "boolean": (bool,),
    "string": (str,),
    "number": (int, float),
    "integer": (int,),
    "object": (dict,),
    "array": (list,),
}
MS = 1_000_000


def header() -> RecordingHeader:
    rig = load_rig(SIMULATED_RIG)
    return RecordingHeader("simulated", "virtual", rig.effective(), dataclasses.asdict(load_catheter(rig.catheter.name)))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("foxglove") / "a.mcap"
    with RecordingWriter(path, header()) as writer:
        for tick in range(0, 1000, 10):
            now = tick * MS
            writer.write(
                "stage",
                Stage(
                    stamp_ns=now,
                    command_insertion_m=0.01,
                    command_roll_rad=0.0,
                    command_knob_rad=0.6,
                    joint_insertion_m=-0.08,
                    joint_roll_rad=0.0,
                    joint_curvature_per_m=18.0,
                ),
            )
            writer.write("force/sensor", ForceSensor(stamp_ns=now, arrival_ns=now, force_N=(0.0, 0.0, 0.2)))
            writer.write(
                "pose/tip",
                Pose(
                    stamp_ns=now,
                    arrival_ns=now,
                    frame=tick,
                    missing=tick == 500,
                    position_m=None if tick == 500 else (0.0, -0.008, 0.027),
                    quaternion_wxyz=None if tick == 500 else (1.0, 0.0, 0.0, 0.0),
                ),
            )
            writer.write(
                "state",
                RigState(
                    stamp_ns=now,
                    mode="contact",
                    safety_action="none",
                    tip_m=(0.0, -0.008, 0.027),
                    target_m=(0.0, -0.0107, 0.025),
                    force_direction=(0.0, 0.0, 1.0),
                    force_N=0.2,
                ),
            )
        writer.write("log", Log(stamp_ns=now, level="warning", source="board", text="a word"))
    return path


def assert_plain(schema: dict[str, Any], where: str) -> None:
    """The part of JSON Schema that Foxglove's reader knows; anything else makes it refuse the channel."""
    assert isinstance(schema.get("type"), str) and schema["type"] in PLAIN, f"{where}: {schema.get('type')}"
    if schema["type"] == "object":
        for name, item in schema["properties"].items():
            assert_plain(item, f"{where}.{name}")
    elif schema["type"] == "array":
        assert schema["items"]["type"] != "array", where
        assert_plain(schema["items"], f"{where}[]")


def assert_fits(value: Any, schema: dict[str, Any], where: str) -> None:
    assert isinstance(value, PLAIN[schema["type"]]), f"{where}: {value!r}"
    if schema["type"] == "object":
        assert set(value) <= set(schema["properties"]), where
        assert set(schema.get("required", [])) <= set(value), where
        for name, item in value.items():
            assert_fits(item, schema["properties"][name], f"{where}.{name}")
    elif schema["type"] == "array":
        for item in value:
            assert_fits(item, schema["items"], f"{where}[]")


def test_every_schema_is_plain() -> None:
    for row in TOPICS.values():
        assert_plain(json.loads(plain_schema(row.message)), row.name)
    for topic, schema in SCHEMAS.items():
        assert_plain(schema, topic)
    with pytest.raises(AssertionError):
        assert_plain(json.loads(json_schema(Pose)), "a union of types")


def test_every_message_fits_its_schema_and_its_channel_says_json(recording: Path) -> None:
    seen = set()
    with recording.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None and (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            assert_fits(json.loads(message.data), json.loads(schema.data), channel.topic)
            seen.add((channel.topic, schema.name))
    assert {
        ("foxglove/tip", "foxglove.PoseInFrame"),
        ("foxglove/scene", "foxglove.SceneUpdate"),
        ("foxglove/log", "foxglove.Log"),
        ("state", "RigState"),
    } <= seen


def test_the_scene_has_the_catheter_up_to_the_tip_at_its_rate(recording: Path) -> None:
    scenes, tips = [], 0
    with recording.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            tips += channel.topic == "foxglove/tip"
            if channel.topic == "foxglove/scene":
                scenes.append(json.loads(message.data)["entities"][0])
    assert len(scenes) == 10 and tips == 20
    catheter, arrow = scenes[-1]["lines"]
    first, last = ([point[axis] for axis in "xyz"] for point in (catheter["points"][0], catheter["points"][-1]))
    np.testing.assert_allclose(first, 0.0, atol=1e-9)
    np.testing.assert_allclose(last, [0.0, -0.008, 0.027], atol=1e-6)
    assert arrow["points"][1]["z"] - arrow["points"][0]["z"] == pytest.approx(0.02)
    assert scenes[-1]["spheres"][0]["pose"]["position"]["y"] == pytest.approx(-0.0107)


def test_its_channels_are_not_among_ours(recording: Path) -> None:
    assert set(RecordingFile(recording).topics) == {"stage", "force/sensor", "pose/tip", "state", "log"}
    columns = read_table(recording)
    assert columns["time_s"].size == 100 and (columns["force/sensor.force_N.2"] == 0.2).all()


def test_older_recordings_of_msgpack_read_as_before(tmp_path: Path) -> None:
    path = tmp_path / "old.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("Pose", "jsonschema", json_schema(Pose).encode())
        channel = writer.register_channel("pose/tip", "msgpack", schema)
        message = Pose(stamp_ns=5, arrival_ns=6, frame=1, missing=True)
        writer.add_message(channel, log_time=7, publish_time=5, data=encode(message, 3))
        writer.finish()
    old = RecordingFile(path)
    assert next(old.messages("pose/tip")) == msgpack.unpackb(encode(message, 3))
    assert old.table("pose/tip")["missing"].tolist() == [True] and np.isnan(old.table("pose/tip")["x_m"]).all()


def test_nil_is_absent_in_the_file_and_none_when_read(recording: Path) -> None:
    missing = [body for body in RecordingFile(recording).messages("pose/tip") if body["missing"]]
    assert missing[0]["position_m"] is None and missing[0]["frame"] == 500
