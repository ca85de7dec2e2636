"""Writing a recording: MCAP chunks of the topics' messages, readable up to the last chunk after a power cut.

The mcap package's writer keeps an index of all chunks in memory, megabytes for each hour (`python -m
host.studies.recorder_memory`), and a failed write leaves half a record. This writer makes the index from the file when it
is closed, packs a recording an eighth smaller, and cuts a file that hits a full disk back to its last whole chunk.
"""

from __future__ import annotations

import errno
import json
import os
import sys
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import msgspec
import orjson
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Chunk, McapRecord, Message, MessageIndex, Metadata, Schema
from mcap.records import Header as McapHeader

from host.recordings.foxglove import SCHEMAS, FoxgloveChannels, plain_schema
from host.recordings.header import RecordingHeader, software_version
from host.recordings.index import MAGIC, file_end
from protocol import topics

PROFILE = "seldinger"
CHUNK_BYTES = 256 * 1024
CHUNK_NS = 1_000_000_000
# Schemas and channels are written again after so many chunks: a damaged chunk does not cost all that follow.
CHUNKS_PER_DESCRIPTION = 60
# Messages repeat each other in long stretches between digits that never repeat: only matches of six bytes and more pay.
# An eighth smaller than the library's level 3, for 3 ms of computing each second of a recording.
_PACKING = zstandard.ZstdCompressionParameters(
    window_log=19, chain_log=18, hash_log=18, search_log=5, min_match=6, target_length=32, strategy=zstandard.STRATEGY_LAZY2
)


class ChunkBuilder:
    """Takes records in; `end` gives the chunk and its message indexes as bytes of the file, and begins the next."""

    def __init__(self) -> None:
        self._compressor = zstandard.ZstdCompressor(compression_params=_PACKING)
        self._records = RecordBuilder()
        self._index: dict[int, list[tuple[int, int]]] = {}

    @property
    def empty(self) -> bool:
        """Return whether the chunk holds no message."""
        return not self._index

    def describe(self, record: Schema | Channel) -> None:
        """Add a schema or channel, before the first message that needs it."""
        record.write(self._records)

    def add(self, message: Message) -> None:
        """Add a message; its log_time is its key in the index."""
        self._index.setdefault(message.channel_id, []).append((message.log_time, self._records.count))
        message.write(self._records)

    def end(self) -> bytes:
        """End the chunk and return its bytes. Not allowed for an empty chunk."""
        times = [time_ns for places in self._index.values() for time_ns, _ in places]
        content = self._records.end()
        out = RecordBuilder()
        Chunk(
            compression="zstd",
            data=self._compressor.compress(content),
            message_start_time=min(times),
            message_end_time=max(times),
            uncompressed_crc=zlib.crc32(content),
            uncompressed_size=len(content),
        ).write(out)
        for channel, places in self._index.items():
            MessageIndex(channel_id=channel, records=places).write(out)
        self._index = {}
        return out.end()


class GuardedFile:
    """The file under the MCAP writer: the first failed write cuts the file back to its last whole chunk and ends it."""

    def __init__(self, path: Path) -> None:
        # A recording may come from a patient's procedure: for its user and group alone.
        self._fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o640)
        self._position = 0
        self._whole = 0
        self.error: OSError | None = None

    def write(self, data: bytes) -> int:
        """Write all of `data`, or keep the error; return its length, as a file does."""
        view = memoryview(data)
        try:
            while self.error is None and len(view):
                view = view[os.write(self._fd, view) :]
        except OSError as error:
            self._fail(error)
        self._position += len(data)
        return len(data)

    @property
    def whole(self) -> int:
        """Return the number of bytes that are on the disk and readable by themselves."""
        return self._whole

    def tell(self) -> int:
        """Return the number of bytes written so far."""
        return self._position

    def flush(self) -> None:
        """Write everything so far to the disk; it is then whole."""
        if self.error is not None:
            return
        try:
            os.fdatasync(self._fd)
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.ENOTSUP):
                self._fail(error)
                return
        self._whole = self._position

    def read_back(self) -> BinaryIO:
        """Open the bytes that were written so far for reading."""
        return open(f"/proc/self/fd/{self._fd}", "rb")

    def _fail(self, error: OSError) -> None:
        self.error = error
        os.ftruncate(self._fd, self._whole)

    def close(self) -> None:
        """Close the file descriptor; `flush` has brought whole chunks to the disk."""
        os.close(self._fd)


def _description(topic: str) -> tuple[str, str, dict[str, str]]:
    """Name and text of a channel's schema, and its metadata."""
    if topic in SCHEMAS:
        return SCHEMAS[topic]["title"], json.dumps(SCHEMAS[topic]), {}
    row = topics.TOPICS[topic]
    metadata = {"rate_hz": f"{row.rate_hz:g}", "direction": row.direction, "description": row.doc}
    return row.message.__name__, plain_schema(row.message), metadata


def new_recording_path(directory: Path, name: str) -> Path:
    """Return a path in `directory` (made if needed) that no file has yet: name, date and time, and a number if needed."""
    directory.mkdir(parents=True, exist_ok=True)
    stem = f"{name}-{time.strftime('%Y%m%d-%H%M%S')}"
    path, number = directory / f"{stem}.mcap", 1
    while path.exists():
        number += 1
        path = directory / f"{stem}-{number}.mcap"
    return path


def _print_failure(text: str) -> None:
    print(f"seldinger: {text}", file=sys.stderr, flush=True)


class RecordingWriter:
    """Writes one recording. Not thread-safe: one thread records.

    path: a file that does not exist yet (FileExistsError otherwise). on_failure: called once, with one sentence,
    when the disk is full or gone (default: prints it on standard error); writing then goes on doing nothing, so that
    nothing else has to stop.
    """

    def __init__(
        self, path: str | Path, header: RecordingHeader, on_failure: Callable[[str], None] = _print_failure
    ) -> None:
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
        """Write a record outside the chunks."""
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

    def write(self, topic: str, message: topics.Message, recorded_ns: int | None = None) -> None:
        """Append `message` of `topic`, numbered here. recorded_ns: the rig's clock now, else the message's own stamp.

        Raises ValueError for a message of another topic or with a field that is not what its class declares.
        """
        if type(message) is not topics.TOPICS[topic].message:
            raise ValueError(f"{topic}: found {type(message).__name__}, wanted {topics.TOPICS[topic].message.__name__}")
        sequence = self._sequence.get(topic, 0)
        self._sequence[topic] = sequence + 1
        self.write_encoded(topic, topics.encode(message, sequence), message.stamp_ns, sequence, recorded_ns)

    def write_encoded(
        self, topic: str, payload: bytes, stamp_ns: int, sequence: int, recorded_ns: int | None = None
    ) -> None:
        """Append a payload that has already been decoded (and so checked) as a message of `topic`."""
        if self._closed or self.failure:
            return
        now_ns = stamp_ns if recorded_ns is None else recorded_ns
        body = {name: value for name, value in msgspec.msgpack.decode(payload).items() if value is not None}
        self._add(topic, body, stamp_ns, sequence, now_ns)
        for derived in self._foxglove.derive(topic, body):
            self._add(derived.topic, derived.body, derived.stamp_ns, 0, now_ns)
        if self._chunk_bytes >= CHUNK_BYTES or abs(now_ns - self._chunk_start_ns) >= CHUNK_NS:
            self._sync()

    def _add(self, topic: str, body: dict[str, Any], stamp_ns: int, sequence: int, now_ns: int) -> None:
        data = orjson.dumps(body)
        self._chunk.add(
            Message(
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
        kept = "what was written before is readable" if self._file.whole else "nothing of it was written"
        self.failure = f"recording {self.path} ended early: {cause}; {kept}"
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
