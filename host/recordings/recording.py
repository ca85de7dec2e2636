"""Recordings: MCAP files of the topics' messages, self-describing, readable up to the last chunk after a power cut."""

from __future__ import annotations

import dataclasses
import errno
import json
import struct
import subprocess
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import msgpack
import numpy as np
import orjson
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, McapRecord, Metadata, Schema
from mcap.records import Header as McapHeader
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader, breakup_chunk

from host.recordings.chunk import ChunkBuilder
from host.recordings.file import GuardedFile
from host.recordings.foxglove import PREFIX, SCHEMAS, FoxgloveChannels, plain_schema
from host.recordings.index import MAGIC, file_end
from protocol.catheter import load_catheter
from protocol.rig_file import Rig
from protocol.topics import TOPICS, Message, encode

PROFILE = "seldinger"
CHUNK_BYTES = 256 * 1024
CHUNK_NS = 1_000_000_000
# Schemas and channels are said again after so many chunks: a damaged one does not cost what follows for ever.
CHUNKS_PER_DESCRIPTION = 60
_MAX_RECORD_BYTES = 64 * 1024 * 1024
_DAMAGE = (McapError, ValueError, struct.error, zstandard.ZstdError, OverflowError, MemoryError)


def software_version() -> str:
    """The installed version of this software, `unknown` when it is not installed."""
    try:
        return version("seldinger")
    except PackageNotFoundError:
        return "unknown"


def git_revision() -> str:
    """The revision that this code stands at, with `+changes` where files differ from it; `unknown` outside git."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return "unknown"
    command = ["git", "-C", str(root), "describe", "--always", "--abbrev=40", "--dirty=+changes", "--exclude=*"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=5, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return "unknown"
    return done.stdout.strip() or "unknown"


class Header(NamedTuple):
    """What must be known to understand a recording, besides its messages."""

    rig: str
    clock: str
    configuration: dict[str, Any]
    catheter: dict[str, Any]
    seed: int | None = None
    notes: dict[str, str] = {}  # noqa: RUF012 - a NamedTuple's default, never written to

    def sections(self) -> dict[str, dict[str, str]]:
        """The MCAP metadata records: name -> texts."""
        run = {
            "rig": self.rig,
            "clock": self.clock,
            "seed": "" if self.seed is None else str(self.seed),
            "software_version": software_version(),
            "git_revision": git_revision(),
            "started_utc": datetime.now(UTC).isoformat(timespec="seconds"),
            **self.notes,
        }
        return {
            "run": run,
            "configuration": {"json": json.dumps(self.configuration)},
            "catheter": {"json": json.dumps(self.catheter)},
        }


def _description(topic: str) -> tuple[str, str, dict[str, str]]:
    """Name and text of a channel's schema, and its metadata."""
    if topic in SCHEMAS:
        return SCHEMAS[topic]["title"], json.dumps(SCHEMAS[topic]), {}
    row = TOPICS[topic]
    metadata = {"rate_hz": f"{row.rate_hz:g}", "direction": row.direction, "description": row.doc}
    return row.message.__name__, plain_schema(row.message), metadata


def header_of(rig: Rig, clock: str, seed: int | None = None, notes: dict[str, str] | None = None) -> Header:
    """The recording's header for `rig`. clock: `virtual` or `wall`."""
    return Header(
        rig=rig.name,
        clock=clock,
        configuration=rig.effective(),
        catheter=dataclasses.asdict(load_catheter(rig.catheter.name)),
        seed=seed,
        notes=notes or {},
    )


def new_recording_path(directory: Path, name: str) -> Path:
    """A path in `directory` (made if needed) that no file has yet: name, date and time, and a number if needed."""
    directory.mkdir(parents=True, exist_ok=True)
    stem = f"{name}-{time.strftime('%Y%m%d-%H%M%S')}"
    path, number = directory / f"{stem}.mcap", 1
    while path.exists():
        number += 1
        path = directory / f"{stem}-{number}.mcap"
    return path


class RecordingWriter:
    """Writes one recording. Not thread-safe: one thread records.

    path: a file that does not exist yet (FileExistsError otherwise). on_failure: called once, with one sentence,
    when the disk is full or gone; writing then goes on doing nothing, so that nothing else has to stop.
    """

    def __init__(self, path: str | Path, header: Header, on_failure: Callable[[str], None] | None = None) -> None:
        self.path = Path(path)
        self.failure = ""
        self._on_failure = on_failure
        self._file = GuardedFile(self.path)
        self._chunk = ChunkBuilder()
        self._channels: dict[str, Channel] = {}
        self._schemas: dict[str, Schema] = {}
        self._foxglove = FoxgloveChannels(header.configuration, header.catheter)
        self._sequence: dict[str, int] = {}
        self._chunk_bytes, self._chunk_start_ns, self._chunks = 0, 0, 0
        self._closed = False
        self._file.write(MAGIC)
        self._record(McapHeader(profile=PROFILE, library=f"seldinger {software_version()}"))
        for name, texts in header.sections().items():
            self._record(Metadata(name=name, metadata=texts))
        self._sync()

    def _record(self, record: McapRecord) -> None:
        """A record outside the chunks."""
        out = RecordBuilder()
        record.write(out)
        self._file.write(out.end())

    def _channel(self, topic: str) -> int:
        known = self._channels.get(topic)
        if known is not None:
            return known.id
        name, text, metadata = _description(topic)
        if name not in self._schemas:
            schema = Schema(id=len(self._schemas) + 1, data=text.encode(), encoding="jsonschema", name=name)
            self._schemas[name] = schema
            self._chunk.describe(schema)
        channel = Channel(
            id=len(self._channels) + 1,
            topic=topic,
            message_encoding="json",
            metadata=metadata,
            schema_id=self._schemas[name].id,
        )
        self._channels[topic] = channel
        self._chunk.describe(channel)
        return channel.id

    def write(self, topic: str, message: Message, recorded_ns: int | None = None) -> None:
        """Append `message` of `topic`, numbered here. recorded_ns: the rig's clock now, else the message's own stamp.

        Raises ValueError for a message of another topic or with a field that is not what its class declares.
        """
        if type(message) is not TOPICS[topic].message:
            raise ValueError(f"{topic}: found {type(message).__name__}, wanted {TOPICS[topic].message.__name__}")
        sequence = self._sequence.get(topic, 0)
        self._sequence[topic] = sequence + 1
        self.write_encoded(topic, encode(message, sequence), message.stamp_ns, sequence, recorded_ns)

    def write_encoded(
        self, topic: str, payload: bytes, stamp_ns: int, sequence: int, recorded_ns: int | None = None
    ) -> None:
        """Append a payload that has already been decoded (and so checked) as a message of `topic`."""
        if self._closed or self.failure:
            return
        now_ns = stamp_ns if recorded_ns is None else recorded_ns
        body = {name: value for name, value in msgpack.unpackb(payload).items() if value is not None}
        self._add(topic, body, stamp_ns, sequence, now_ns)
        for derived in self._foxglove.hear(topic, body):
            self._add(derived.topic, derived.body, derived.stamp_ns, 0, now_ns)
        if self._chunk_bytes >= CHUNK_BYTES or abs(now_ns - self._chunk_start_ns) >= CHUNK_NS:
            self._sync()

    def _add(self, topic: str, body: dict[str, Any], stamp_ns: int, sequence: int, now_ns: int) -> None:
        data = orjson.dumps(body)
        self._chunk.add(
            McapMessage(
                channel_id=self._channel(topic),
                log_time=now_ns,
                publish_time=stamp_ns,
                data=data,
                sequence=sequence & 0xFFFFFFFF,
            )
        )
        if self._chunk_bytes == 0:
            self._chunk_start_ns = now_ns
        self._chunk_bytes += len(data) + 31

    def _sync(self) -> None:
        if not self._chunk.empty:
            self._file.write(self._chunk.end())
            self._chunks += 1
            if self._chunks % CHUNKS_PER_DESCRIPTION == 0:
                records: list[Schema | Channel] = [*self._schemas.values(), *self._channels.values()]
                for record in records:
                    self._chunk.describe(record)
        self._file.flush()
        self._chunk_bytes = 0
        self._report()

    def flush(self) -> None:
        """End the chunk in progress and bring it to the disk; for quiet times, when no message ends it."""
        if not self._closed and not self.failure and self._chunk_bytes:
            self._sync()

    def _report(self) -> None:
        error = self._file.error
        if error is None or self.failure:
            return
        cause = "the disk is full" if error.errno in (errno.ENOSPC, errno.EDQUOT) else str(error.strerror or error)
        self.failure = f"recording {self.path} ended early: {cause}; what was written before is readable"
        if self._on_failure is not None:
            self._on_failure(self.failure)

    def close(self) -> None:
        """Finish the file with its index. Safe to call twice."""
        if self._closed:
            return
        self._closed = True
        if not self.failure:
            self._sync()
        if not self.failure:
            with self._file.read_back() as stream:
                end = file_end(stream, self._schemas.values(), self._channels.values())
            self._file.write(end)
            self._file.flush()
            self._report()
        self._file.close()

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


class _Row(NamedTuple):
    recorded_ns: int
    data: bytes


class Recording:
    """A recording, read whole. A file cut short, or with damaged chunks, gives every message that is intact.

    path: the MCAP file. Raises ValueError where it cannot be read at all or is no recording.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.truncated = False
        self.damaged_chunks = 0
        self._metadata: dict[str, dict[str, str]] = {}
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._rows: dict[str, list[_Row]] = {}
        self._of_channel: dict[int, list[_Row]] = {}
        self._tables: dict[str, dict[str, np.ndarray]] = {}
        try:
            with self.path.open("rb") as stream:
                self._read(stream)
        except OSError as error:
            raise ValueError(f"{path}: found {error.strerror or error}, wanted a readable recording") from None
        for number, rows in self._of_channel.items():
            if number in self._channels and not self._channels[number].topic.startswith(PREFIX):
                self._rows.setdefault(self._channels[number].topic, []).extend(rows)

    def _read(self, stream: Any) -> None:
        magic = stream.read(8)
        if magic != MAGIC:
            raise ValueError(f"{self.path}: found {magic!r} at its start, wanted an MCAP recording")
        records = StreamReader(stream, skip_magic=True, emit_chunks=True, record_size_limit=_MAX_RECORD_BYTES).records
        self.truncated = True
        try:
            for record in records:
                self._take(record)
            self.truncated = False
        except _DAMAGE:
            return

    def _take(self, record: Any) -> None:
        if isinstance(record, Chunk):
            try:
                inside = breakup_chunk(record, validate_crc=True)
            except _DAMAGE:
                self.damaged_chunks += 1
                return
            for item in inside:
                self._take(item)
        elif isinstance(record, McapMessage):
            self._of_channel.setdefault(record.channel_id, []).append(_Row(record.log_time, record.data))
        elif isinstance(record, Schema):
            self._schemas.setdefault(record.id, record)
        elif isinstance(record, Channel):
            self._channels.setdefault(record.id, record)
        elif isinstance(record, Metadata):
            self._metadata[record.name] = record.metadata

    @property
    def run(self) -> dict[str, str]:
        """Rig, clock, seed, software version, git revision, start and notes, as texts."""
        return self._metadata.get("run", {})

    @property
    def configuration(self) -> dict[str, Any]:
        """The effective configuration of the rig."""
        return json.loads(self._metadata.get("configuration", {}).get("json", "{}"))

    @property
    def catheter(self) -> dict[str, Any]:
        """The catheter's parameters."""
        return json.loads(self._metadata.get("catheter", {}).get("json", "{}"))

    @property
    def topics(self) -> dict[str, int]:
        """Topic -> number of messages, for topics that have any."""
        return {topic: len(rows) for topic, rows in self._rows.items()}

    @property
    def span_ns(self) -> tuple[int, int]:
        """Earliest and latest time of recording, (0, 0) for an empty one."""
        times = [row.recorded_ns for rows in self._rows.values() for row in (rows[0], rows[-1])]
        return (min(times), max(times)) if times else (0, 0)

    def schema(self, topic: str) -> dict[str, Any]:
        """The JSON Schema of `topic` as this file carries it. Raises ValueError for a topic that is not in it."""
        for channel in self._channels.values():
            if channel.topic == topic and channel.schema_id in self._schemas:
                return json.loads(self._schemas[channel.schema_id].data)
        known = ", ".join(sorted(self._rows)) or "none, the recording is empty"
        raise ValueError(f"topic: found {topic!r}, wanted one of {known}")

    def units(self, topic: str) -> dict[str, str]:
        """Column -> unit of `topic`'s table, empty text where it has none."""
        units = {}
        for name, item in self.schema(topic)["properties"].items():
            if name != "schema_version":
                for column in item.get("columns", [name]):
                    units[column] = item.get("unit", "")
        return {**units, "recorded_ns": "ns"}

    def messages(self, topic: str) -> Iterator[dict[str, Any]]:
        """The messages of `topic` as dicts, in the order of recording, nil as None; none for a topic that is not there."""
        if topic in self._rows:
            names = list(self.schema(topic)["properties"])
            for row in self._rows[topic]:
                body = _body(row.data)
                yield {name: body.get(name) for name in names}

    def message(self, topic: str, index: int) -> dict[str, Any]:
        """Message number `index` of `topic`, in the order of recording; nil is absent. Raises KeyError, IndexError."""
        return _body(self._rows[topic][index].data)

    def times_ns(self, topic: str) -> np.ndarray:
        """When each message of `topic` was recorded, (n,), not falling; empty for a topic that is not there."""
        return np.maximum.accumulate(np.array([row.recorded_ns for row in self._rows.get(topic, [])], dtype=np.int64))

    def table(self, topic: str) -> dict[str, np.ndarray]:
        """The messages of `topic` as columns, one array of shape (n,) each; vectors are spread over named columns.

        nil becomes NaN. `recorded_ns` is when it was recorded. Raises ValueError for a topic that is not in the file.
        """
        if topic not in self._tables:
            bodies = list(self.messages(topic))
            table = {}
            for name, item in self.schema(topic)["properties"].items():
                if name != "schema_version":
                    table.update(_columns(name, item, [body.get(name) for body in bodies]))
            table["recorded_ns"] = np.array([row.recorded_ns for row in self._rows.get(topic, [])], dtype=np.int64)
            self._tables[topic] = table
        return self._tables[topic]


def _body(data: bytes) -> dict[str, Any]:
    # Older recordings hold msgpack, whose maps never begin with the byte of `{`.
    body = orjson.loads(data) if data[:1] == b"{" else msgpack.unpackb(data)
    return {name: value for name, value in body.items() if value is not None}


_DTYPES: dict[str, Any] = {"number": np.float64, "integer": np.int64, "boolean": np.bool_, "string": np.str_}


def _columns(name: str, item: dict[str, Any], values: list[Any]) -> dict[str, np.ndarray]:
    """The columns that one property of a schema makes out of its values."""
    names = item.get("columns")
    if names is None:
        kind = item["type"][0] if isinstance(item["type"], list) else item["type"]
        return {name: np.array(values, dtype=_DTYPES[kind])}
    hole = [None] * len(names)
    dtype = _DTYPES[item["items"]["type"]]
    rows = np.array([hole if value is None else value for value in values], dtype=dtype).reshape(-1, len(names))
    return {column: np.ascontiguousarray(rows[:, index]) for index, column in enumerate(names)}
