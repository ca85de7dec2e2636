"""Recordings read back; cut or damaged files give what is intact; a full disk stops nothing."""

from __future__ import annotations

import gc
import os
import signal
import struct
import subprocess
import sys
import textwrap
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Chunk, Message, MessageIndex
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from mcap.summary import Summary
from mcap.writer import Writer

from host.recordings import writer as writer_module
from host.recordings.header import RecordingHeader
from host.recordings.index import file_end
from host.recordings.recording import RecordingFile, is_whole
from host.recordings.writer import RecordingWriter
from protocol.topics import ForceEstimate, ForceSensor, Pose, RigState, Stage, columns
from tests.small_disk import fill_up
from tests.waiting import PATIENCE_S

HEADER = RecordingHeader(
    rig="simulated",
    clock="virtual",
    configuration={"control": {"loop_hz": 1000}},
    catheter={"name": "blazer_prime_xp"},
    seed=7,
)


def stage(time_ns: int, value: float = 0.0) -> Stage:
    return Stage(stamp_ns=time_ns, command_insertion_m=value, command_roll_rad=0.0, command_knob_rad=0.0)


def pose(time_ns: int, missing: bool = False) -> Pose:
    if missing:
        return Pose(stamp_ns=time_ns, arrival_ns=time_ns, frame=0, missing=True)
    return Pose(
        stamp_ns=time_ns,
        arrival_ns=time_ns + 25_000_000,
        frame=3,
        missing=False,
        position_m=np.array([0.001, 0.002, 0.04]),
        quaternion_wxyz=(1.0, 0.0, 0.0, 0.0),
    )


def write(path: Path, count: int) -> Path:
    with RecordingWriter(path, HEADER) as writer:
        for tick in range(count):
            writer.write("stage", stage(tick * 1_000_000, value=tick * 1e-6), recorded_ns=tick * 1_000_000 + 5)
            if tick % 25 == 0:
                writer.write("pose/tip", pose(tick * 1_000_000, missing=tick % 50 == 0))
    return path


def test_what_is_written_reads_back_as_columns(tmp_path: Path) -> None:
    recording = RecordingFile(write(tmp_path / "a.mcap", 200))
    assert not recording.truncated and recording.damaged_chunks == 0
    assert recording.topics == {"stage": 200, "pose/tip": 8}
    table = recording.table("stage")
    assert set(table) == {*columns(Stage), "recorded_ns"}
    np.testing.assert_array_equal(table["stamp_ns"], np.arange(200) * 1_000_000)
    np.testing.assert_array_equal(table["recorded_ns"], table["stamp_ns"] + 5)
    np.testing.assert_array_equal(table["command_insertion_m"], np.arange(200) * 1e-6)
    np.testing.assert_array_equal(table["sequence"], np.arange(200))
    assert np.isnan(table["encoder_insertion_m"]).all()
    poses = recording.table("pose/tip")
    np.testing.assert_array_equal(poses["missing"], np.arange(8) % 2 == 0)
    np.testing.assert_array_equal(np.isnan(poses["z_m"]), poses["missing"])
    assert recording.span_ns == (0, 199_000_005)


def test_header_tells_where_it_comes_from(tmp_path: Path) -> None:
    recording = RecordingFile(write(tmp_path / "a.mcap", 1))
    assert recording.run["seed"] == "7" and recording.run["rig"] == "simulated" and recording.run["clock"] == "virtual"
    assert recording.run["git_revision"] and recording.run["software_version"]
    assert recording.configuration == HEADER.configuration
    assert recording.catheter == HEADER.catheter


def test_schema_in_the_file_names_units_and_columns(tmp_path: Path) -> None:
    recording = RecordingFile(write(tmp_path / "a.mcap", 30))
    assert recording.units("stage")["command_roll_rad"] == "rad"
    assert recording.units("pose/tip")["z_m"] == "m"
    assert recording.schema("pose/tip")["title"] == "Pose"


def test_other_readers_read_it(tmp_path: Path) -> None:
    with write(tmp_path / "a.mcap", 100).open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        assert summary.statistics.message_count == 104 + 2  # and two poses of foxglove/tip
        schema, channel, _ = next(iter(reader.iter_messages(topics=["pose/tip"])))
        assert schema is not None and schema.encoding == "jsonschema" and channel.message_encoding == "json"


def summary_of(path: Path) -> Summary:
    with path.open("rb") as stream:
        found = make_reader(stream, validate_crcs=True).get_summary()
    assert found is not None
    return found


def test_its_index_is_what_the_library_writes(tmp_path: Path) -> None:
    by_library, by_us = tmp_path / "library.mcap", tmp_path / "us.mcap"
    with by_library.open("wb") as stream:
        writer = Writer(stream, chunk_size=2000)
        writer.start("seldinger", "library")
        writer.add_metadata("run", {"rig": "simulated"})
        schema = writer.register_schema("Stage", "jsonschema", b"{}")
        channels = [writer.register_channel(topic, "json", schema, {"rate_hz": "1"}) for topic in ("stage", "pose/tip")]
        for number in range(500):
            writer.add_message(channels[number % 7 == 3], 1000 - number, b'{"a":%d}' % number, number, number)
        writer.finish()
    wanted = summary_of(by_library)
    last = wanted.chunk_indexes[-1]
    by_us.write_bytes(by_library.read_bytes()[: last.chunk_start_offset + last.chunk_length + last.message_index_length])
    with by_us.open("rb") as stream:
        end = file_end(stream, wanted.schemas.values(), wanted.channels.values())
    by_us.write_bytes(by_us.read_bytes() + end)
    found = summary_of(by_us)
    assert len(found.chunk_indexes) > 5 and vars(found) == vars(wanted)


def test_the_index_of_each_chunk_points_at_its_messages(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "a.mcap", HEADER) as writer:
        for tick in range(2500):
            writer.write("stage", stage(tick * 1_000_000, value=float(np.sin(tick))))
            if tick % 25 == 0:
                writer.write("pose/tip", pose(tick * 1_000_000))
    content, pointed = b"", []
    with (tmp_path / "a.mcap").open("rb") as stream:
        for record in StreamReader(stream, emit_chunks=True).records:
            if isinstance(record, Chunk):
                content = get_chunk_data_stream(record, validate_crc=True)[0].read(record.uncompressed_size)
            elif isinstance(record, MessageIndex):
                for time_ns, place in record.records:
                    opcode, _, channel, _, log_ns = struct.unpack_from("<BQHIQ", content, place)
                    pointed.append((opcode, channel == record.channel_id, log_ns == time_ns))
    with (tmp_path / "a.mcap").open("rb") as stream:
        messages = sum(isinstance(record, Message) for record in StreamReader(stream).records)
    assert messages >= 2600 and pointed == [(Opcode.MESSAGE, True, True)] * messages


def test_a_long_recording_is_read_by_its_index_and_keeps_no_index_in_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "fdatasync", lambda fd: None)
    monkeypatch.setattr(writer_module, "CHUNKS_PER_DESCRIPTION", 20)
    path, held = tmp_path / "a.mcap", []
    tracemalloc.start()
    with RecordingWriter(path, HEADER) as writer:
        for second in range(1001):
            writer.write("pose/tip", pose(second * 1_000_000_000))
            if second in (200, 1000):
                gc.collect()
                held.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    assert held[1] - held[0] < 400 * 100  # the index of 400 chunks takes 600 bytes and more for each
    summary = summary_of(path)
    assert summary.statistics is not None and summary.statistics.chunk_count == len(summary.chunk_indexes) == 501
    with path.open("rb") as stream:
        times = [message.log_time for _, _, message in make_reader(stream).iter_messages(topics=["pose/tip"])]
    assert times == [second * 1_000_000_000 for second in range(1001)]
    assert is_whole(path) and RecordingFile(path).topics == {"pose/tip": 1001}
    path.write_bytes(path.read_bytes()[:-20])
    assert not is_whole(path)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("whole") / "a.mcap", 6000)


def altered(whole: Path, share: float, change: Callable[[bytearray, int], bytearray]) -> RecordingFile:
    """A recording of the file `whole` with `change(content, place)` done to it, place at `share` of its length."""
    content = bytearray(whole.read_bytes())
    copy = whole.with_name("altered.mcap")
    copy.write_bytes(change(content, 8 + int(share * (len(content) - 9))))
    return RecordingFile(copy)


@settings(max_examples=30, deadline=None)
@given(share=st.floats(0, 1))
def test_cut_anywhere_gives_a_prefix_up_to_the_last_chunk(share: float, whole: Path) -> None:
    recording = altered(whole, share, lambda content, place: content[:place])
    assert recording.truncated
    if "stage" in recording.topics:
        ticks = recording.table("stage")["sequence"]
        np.testing.assert_array_equal(ticks, np.arange(len(ticks)))


def test_a_cut_at_the_end_loses_at_most_the_last_second(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    writer = RecordingWriter(path, HEADER)
    for tick in range(5500):
        writer.write("stage", stage(tick * 1_000_000))
    recording = RecordingFile(path)
    assert recording.truncated
    assert recording.topics["stage"] > 4500
    writer.close()


@settings(max_examples=60, deadline=None)
@given(share=st.floats(0, 1), bit=st.integers(0, 7))
def test_a_flipped_bit_never_raises_and_never_lies(share: float, bit: int, whole: Path) -> None:
    def flip(content: bytearray, place: int) -> bytearray:
        content[place] ^= 1 << bit
        return content

    recording = altered(whole, share, flip)
    if "stage" in recording.topics:
        table = recording.table("stage")
        np.testing.assert_array_equal(table["stamp_ns"], table["sequence"] * 1_000_000)


def test_a_damaged_chunk_costs_that_chunk_only(whole: Path) -> None:
    recording = altered(whole, 0.5, lambda content, place: content[:place] + b"damage" + content[place + 6 :])
    assert recording.damaged_chunks == 1
    assert 4900 <= recording.topics["stage"] < 6000


def test_full_disk_is_told_once_and_what_was_there_is_readable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []
    path = tmp_path / "a.mcap"
    writer = RecordingWriter(path, HEADER, on_failure=told.append)
    fill_up(monkeypatch, 10_000)
    for tick in range(20_000):
        writer.write("stage", stage(tick * 1_000_000, value=float(np.sin(tick))))
    writer.close()
    writer.close()
    assert len(told) == 1 and "disk is full" in told[0] and "readable" in told[0]
    recording = RecordingFile(path)
    assert recording.truncated and recording.damaged_chunks == 0
    monkeypatch.undo()


def test_sigterm_closes_and_sigkill_leaves_it_readable(tmp_path: Path) -> None:
    program = textwrap.dedent("""
        import signal, sys, time
        from host.recordings.writer import RecordingWriter
        from tests.host.test_recording import HEADER, stage
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
        with RecordingWriter(sys.argv[1], HEADER) as writer:
            for tick in range(3000):
                writer.write("stage", stage(tick * 1_000_000))
            print("ready", flush=True)
            time.sleep(60)
    """)
    for number, whole in ((signal.SIGTERM, True), (signal.SIGKILL, False)):
        path = tmp_path / f"{number}.mcap"
        child = subprocess.Popen(
            [sys.executable, "-c", program, str(path)], stdout=subprocess.PIPE, cwd=Path(__file__).parents[2]
        )
        assert child.stdout is not None and child.stdout.readline() == b"ready\n"
        child.send_signal(number)
        child.wait(timeout=PATIENCE_S)
        child.stdout.close()
        recording = RecordingFile(path)
        assert recording.truncated is not whole
        kept = recording.topics["stage"]
        assert kept == 3000 if whole else 2000 < kept < 3000


def test_refusals_name_the_thing(tmp_path: Path) -> None:
    (tmp_path / "no.mcap").write_bytes(b"something else entirely")
    with pytest.raises(ValueError, match="wanted an MCAP recording"):
        RecordingFile(tmp_path / "no.mcap")
    with pytest.raises(ValueError, match="wanted a readable recording"):
        RecordingFile(tmp_path / "missing.mcap")
    path = write(tmp_path / "a.mcap", 1)
    with pytest.raises(FileExistsError):
        RecordingWriter(path, HEADER)
    with pytest.raises(ValueError, match='"force/sensor", wanted one of pose/tip, stage'):
        RecordingFile(path).table("force/sensor")


def test_wrong_message_for_a_topic_is_refused(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "a.mcap", HEADER) as writer:
        with pytest.raises(ValueError, match="found Pose, wanted Stage"):
            writer.write("stage", pose(0))
        with pytest.raises(ValueError, match=r"ForceSensor\.force_N"):
            writer.write("force/sensor", ForceSensor(stamp_ns=0, arrival_ns=0, force_N=(0.0, float("nan"), 0.0)))


def test_texts_and_flags_keep_their_types(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "a.mcap", HEADER) as writer:
        writer.write("state", RigState(stamp_ns=1, mode="contact", safety_action="hold", cause="no fresh pose"))
        writer.write(
            "force/estimate", ForceEstimate(stamp_ns=1, frame="base", converged=False, published_ns=2, compute_us=3.0)
        )
    recording = RecordingFile(tmp_path / "a.mcap")
    assert recording.table("state")["cause"].tolist() == ["no fresh pose"]
    assert recording.table("force/estimate")["converged"].dtype == np.bool_
    assert np.isnan(recording.table("force/estimate")["czz_N2"]).all()


def test_a_full_disk_is_told_without_a_listener_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`seldinger run --simulated` recorded into nothing and said that the recording was there."""
    fill_up(monkeypatch, 0)
    with RecordingWriter(tmp_path / "full.mcap", HEADER) as writer:
        assert writer.failure
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "full.mcap ended early: the disk is full; nothing of it was written" in said
