"""Crafted, damaged and oversized recordings: read as far as they are intact, or refused in one line."""

from __future__ import annotations

import json
import random
import struct
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode

from host.recordings.index import MAGIC
from host.recordings.recording import TABLE_LIMIT_BYTES, UNPACKED_LIMIT_BYTES, RecordingFile
from protocol.errors import InputError
from tests.host.crafted_recordings import HEAD, chunk_body, foreign, mutated, originals, read_all, records, small


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    return originals(tmp_path_factory.mktemp("originals"))


@settings(max_examples=300, deadline=None)
@given(number=st.integers(0, 2**32))
def test_damaged_files_are_read_or_refused_in_one_line(
    number: int, files: list[bytes], tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "mutated.mcap"
    path.write_bytes(mutated(files, random.Random(number)))
    read_all(path)


def test_the_originals_are_read_whole(files: list[bytes], tmp_path: Path) -> None:
    for number, content in enumerate(files):
        path = tmp_path / f"{number}.mcap"
        path.write_bytes(content)
        recording = RecordingFile(path)
        assert not recording.truncated and recording.damaged_chunks == 0
        assert len(recording.table("stage")["stamp_ns"]) == recording.topics["stage"] >= 40


def with_chunks(path: Path, *chunks: bytes) -> Path:
    """A recording with its own description and these chunks after it."""
    content = foreign_body()
    path.write_bytes(MAGIC + content + b"".join(HEAD.pack(Opcode.CHUNK, len(body)) + body for body in chunks) + MAGIC)
    return path


def foreign_body() -> bytes:
    from mcap.writer import CompressionType

    unchunked = foreign(CompressionType.NONE, use_chunking=False)
    kept = [
        (opcode, body) for opcode, body in records(unchunked) if opcode in (Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL)
    ]
    return b"".join(HEAD.pack(opcode, len(body)) + body for opcode, body in kept)


def messages(count: int, data: bytes) -> bytes:
    one = HEAD.pack(Opcode.MESSAGE, 22 + len(data)) + struct.pack("<HIQQ", 1, 0, 0, 0) + data
    return one * count


def test_a_small_file_that_unpacks_to_gigabytes_is_refused_and_the_limit_can_be_raised(tmp_path: Path) -> None:
    bomb = chunk_body(HEAD.pack(0x7F, 32 * 2**20) + bytes(32 * 2**20))
    path = with_chunks(tmp_path / "bomb.mcap", *[bomb] * 64)
    assert path.stat().st_size < 200_000
    with pytest.raises(
        InputError, match=rf"unpack to more than {UNPACKED_LIMIT_BYTES // 2**20} MiB.*, wanted less; .*unpack limit"
    ):
        RecordingFile(str(path))
    assert RecordingFile(str(with_chunks(tmp_path / "three.mcap", *[bomb] * 3)), 200 * 2**20).damaged_chunks == 0


def test_a_chunk_that_declares_less_than_it_unpacks_to_is_damaged(tmp_path: Path) -> None:
    body = chunk_body(bytes(2**24), declared=1000)
    assert RecordingFile(with_chunks(tmp_path / "a.mcap", body)).damaged_chunks == 1


def test_a_table_larger_than_its_limit_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("host.recordings.recording.TABLE_LIMIT_BYTES", 8000)
    path = with_chunks(tmp_path / "a.mcap", chunk_body(messages(2000, b'{"stamp_ns":1,"x_m":0.5}')))
    assert TABLE_LIMIT_BYTES >= 2**20
    with pytest.raises(InputError, match=r"found .a table of 4000 cells., wanted at most 1000"):
        RecordingFile(path).table("stage")


@pytest.mark.parametrize(
    "data",
    [
        b"[" * 100_000,
        b"{" + b'"a":{' * 50_000,
        b"{}",
        b"null",
        b'{"stamp_ns":1e400}',
        b'{"stamp_ns":"x"}',
        b"\x81\xa1a" * 1000,
        b'{"stamp_ns":99999999999999999999}',
        b'{"stamp_ns":1.5}',
        b"{\xff}",
        b"",
    ],
)
def test_a_message_that_is_no_message_is_named(data: bytes, tmp_path: Path) -> None:
    recording = RecordingFile(with_chunks(tmp_path / "a.mcap", chunk_body(messages(1, data))))
    with pytest.raises(InputError, match=r"a\.mcap stage") as caught:
        recording.table("stage")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["[" * 100_000, "5", "[]", "{", "\ud800".encode("utf-8", "replace").decode() + "{"])
def test_a_header_that_is_no_object_is_named(text: str, tmp_path: Path) -> None:
    recording = RecordingFile(small(tmp_path / "a.mcap"))
    recording._metadata["configuration"] = {"json": text}
    with pytest.raises(InputError, match=r"a\.mcap configuration.* wanted a JSON object"):
        _ = recording.configuration


def test_a_column_that_is_missing_is_named(tmp_path: Path) -> None:
    table = RecordingFile(with_chunks(tmp_path / "a.mcap", chunk_body(messages(3, b'{"stamp_ns":1,"x_m":0.5}')))).table(
        "stage"
    )
    with pytest.raises(
        InputError, match='found "no column command_insertion_m", wanted a recording that has it: stamp_ns, x_m'
    ):
        table["command_insertion_m"]


def test_replay_gets_only_messages_that_their_topic_allows(tmp_path: Path) -> None:
    good = {"schema_version": 1, "stamp_ns": 5, "sequence": 0, "command_insertion_m": 0.01, "command_roll_rad": 0.0}
    bodies = [good | {"command_knob_rad": 0.0}, good, good | {"command_knob_rad": 1e300}]
    chunk = chunk_body(b"".join(messages(1, json.dumps(body).encode()) for body in bodies))
    recording = RecordingFile(with_chunks(tmp_path / "a.mcap", chunk))
    assert [recording.message("stage", index) is not None for index in range(3)] == [True, False, False]
