"""Reading a recording: which messages the file has, and each topic as messages or as a table.

Opening goes over the file once and keeps the place of each message, 24 bytes, not the message. A file that was cut off or
damaged gives every message that is intact. What a file may unpack to is bounded, so that a crafted one fills no memory.
"""

from __future__ import annotations

import io
import json
import struct
import zlib
from array import array
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import lz4.frame
import msgspec
import numpy as np
import orjson
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Metadata, Schema

from host.recordings.foxglove import PREFIX
from host.recordings.index import MAGIC
from protocol.errors import Description, InputError
from protocol.text_files import kind_of
from protocol.topics import TOPICS, Message

# A chunk is held whole while it is read; other recorders make chunks of 1 to 4 MB.
CHUNK_LIMIT_BYTES = 64 * 1024 * 1024
# All chunks together may unpack to this much, or to 64 times the file where that is more: messages of a rig pack 6 to 1.
UNPACKED_LIMIT_BYTES = 64 * 1024 * 1024
UNPACKED_PER_PACKED = 64
# A table is held whole: at most 512 MB of it.
TABLE_LIMIT_BYTES = 512 * 1024 * 1024
_RECORD_HEAD = struct.Struct("<BQ")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_LATEST_NS = 2**63 - 1
_DAMAGE = (
    McapError,
    ValueError,
    struct.error,
    zstandard.ZstdError,
    RuntimeError,  # lz4 and RecursionError
    EOFError,
    OverflowError,
    MemoryError,
    IndexError,
)
_BAD_CONTENT = (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError, MemoryError)
_OUTSIDE = -1  # the number of a chunk that a message is in, for a message in none


class _Places(NamedTuple):
    """Of each message of a topic: when it was recorded, its chunk, and the place and length of its data in it."""

    recorded_ns: array[int]
    chunk: array[int]
    start: array[int]
    length: array[int]

    @classmethod
    def empty(cls) -> _Places:
        return cls(array("q"), array("i"), array("q"), array("I"))

    def add(self, recorded_ns: int, chunk: int, start: int, length: int) -> None:
        self.recorded_ns.append(recorded_ns)
        self.chunk.append(chunk)
        self.start.append(start)
        self.length.append(length)


class RecordedTable(dict[str, np.ndarray]):
    """The columns of one topic, (n,) each. A column that the file does not have is bad input, not a KeyError."""

    def __init__(self, source: str, columns: dict[str, np.ndarray]) -> None:
        super().__init__(columns)
        self._source = source

    def __missing__(self, column: str) -> np.ndarray:
        raise InputError(self._source, f"no column {column}", "a recording that has it: " + ", ".join(self)[:200])


class RecordingFile:
    """A recording. A file that was cut off, or has damaged chunks, gives every message that is intact.

    Args:
        path: The MCAP file.
        unpacked_limit_bytes: What all chunks together may unpack to; by default UNPACKED_LIMIT_BYTES, or
            UNPACKED_PER_PACKED times the file's size where that is more.

    Raises:
        InputError: The file cannot be read, is not a recording, or unpacks to more than the limit.
    """

    def __init__(self, path: str | Path, unpacked_limit_bytes: int | None = None) -> None:
        self.path = Path(path)
        self.truncated = True
        self.damaged_chunks = 0
        self._metadata: dict[str, dict[str, str]] = {}
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._of_channel: dict[int, _Places] = {}
        self._chunk_places: list[tuple[int, int]] = []
        self._tables: dict[str, RecordedTable] = {}
        self._unpacked_bytes = 0
        self._held: tuple[int, bytes] = (_OUTSIDE, b"")
        try:
            with self.path.open("rb") as stream:
                size = stream.seek(0, io.SEEK_END)
                self._limit_bytes = unpacked_limit_bytes or max(UNPACKED_LIMIT_BYTES, UNPACKED_PER_PACKED * size)
                self._scan(stream, size)
        except OSError as error:
            raise InputError(str(path), error.strerror or str(error), "a readable recording") from None
        self._places = self._by_topic()

    def _by_topic(self) -> dict[str, tuple[int, _Places]]:
        """Topic -> schema's number and places. A topic that several channels carry keeps the order of the channels."""
        found: dict[str, tuple[int, _Places]] = {}
        for number, places in self._of_channel.items():
            channel = self._channels.get(number)
            if channel is None or channel.topic.startswith(PREFIX) or channel.schema_id not in self._schemas:
                continue
            if channel.topic in found:
                for own, more in zip(found[channel.topic][1], places, strict=True):
                    own.extend(more)
            else:
                found[channel.topic] = (channel.schema_id, places)
        return found

    def _scan(self, stream: BinaryIO, size: int) -> None:
        """Go over all records once; stops at the first that is not whole."""
        stream.seek(0)
        magic = stream.read(len(MAGIC))
        if magic != MAGIC:
            found = kind_of(magic) or (f"bytes {magic.hex(' ')} at its beginning" if magic else "an empty file")
            raise InputError(str(self.path), Description(found), "an MCAP recording")
        place = len(MAGIC)
        while len(head := stream.read(_RECORD_HEAD.size)) == _RECORD_HEAD.size:
            opcode, length = _RECORD_HEAD.unpack(head)
            place += _RECORD_HEAD.size
            if place + length > size:
                return
            if opcode == Opcode.FOOTER:
                stream.seek(place + length)
                self.truncated = stream.read(len(MAGIC)) != MAGIC
                return
            try:
                self._take(stream, opcode, place, length)
            except _DAMAGE as error:
                if isinstance(error, InputError):
                    raise
                if opcode != Opcode.CHUNK:
                    return
                self.damaged_chunks += 1
            place += length
            stream.seek(place)

    def _take(self, stream: BinaryIO, opcode: int, place: int, length: int) -> None:
        if opcode == Opcode.CHUNK:
            content = self._unpacked(stream, length)
            number = len(self._chunk_places)
            for inside, start, end in _records(content):
                self._describe(inside, content[start:end]) if inside != Opcode.MESSAGE else None
            for inside, start, end in _records(content):
                if inside == Opcode.MESSAGE:
                    self._add(content, number, start, end)
            self._chunk_places.append((place, length))
        elif opcode == Opcode.MESSAGE:
            if length < _MESSAGE_HEAD.size:
                raise ValueError("a message shorter than its header")
            self._note(stream.read(_MESSAGE_HEAD.size), 0, _OUTSIDE, place + _MESSAGE_HEAD.size, length - _MESSAGE_HEAD.size)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA):
            if length > CHUNK_LIMIT_BYTES:
                raise ValueError("a description above the limit of a chunk's size")
            self._describe(opcode, stream.read(length))

    def _describe(self, opcode: int, data: bytes) -> None:
        stream = ReadDataStream(io.BytesIO(data))
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            self._schemas.setdefault(schema.id, schema)
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(stream)
            self._channels.setdefault(channel.id, channel)
        elif opcode == Opcode.METADATA:
            metadata = Metadata.read(stream)
            self._metadata[metadata.name] = metadata.metadata

    def _add(self, content: bytes, chunk: int, start: int, end: int) -> None:
        self._note(content, start, chunk, start + _MESSAGE_HEAD.size, end - start - _MESSAGE_HEAD.size)

    def _note(self, content: bytes, at: int, chunk: int, start: int, length: int) -> None:
        channel, _, recorded_ns, _ = _MESSAGE_HEAD.unpack_from(content, at)
        known = self._channels.get(channel)
        if known is None or not known.topic.startswith(PREFIX):  # Foxglove's channels are derived from the others
            self._of_channel.setdefault(channel, _Places.empty()).add(min(recorded_ns, _LATEST_NS), chunk, start, length)

    def _unpacked(self, stream: BinaryIO, length: int) -> bytes:
        """Return the content of the chunk record that `stream` stands at.

        Raises:
            InputError: With this chunk the file unpacks to more than its limit.
        """
        if length > CHUNK_LIMIT_BYTES:
            raise ValueError("a chunk above the limit of a chunk's size")
        chunk = Chunk.read(ReadDataStream(io.BytesIO(stream.read(length))))
        if chunk.uncompressed_size > CHUNK_LIMIT_BYTES:
            raise ValueError("a chunk that unpacks to more than the limit")
        self._unpacked_bytes += chunk.uncompressed_size
        if self._unpacked_bytes > self._limit_bytes:
            raise InputError(
                str(self.path),
                f"chunks that unpack to more than {self._limit_bytes / 2**20:.0f} MiB",
                "less; raise the unpack limit if the recording is trusted and that large",
            )
        content = unpack_chunk(chunk)
        if len(content) != chunk.uncompressed_size or (
            chunk.uncompressed_crc and zlib.crc32(content) != chunk.uncompressed_crc
        ):
            raise ValueError("a chunk whose content does not match its checksum")
        return content

    @property
    def run(self) -> dict[str, str]:
        """Rig, clock, seed, software version, git revision, start and notes, as texts."""
        return self._metadata.get("run", {})

    @property
    def configuration(self) -> dict[str, Any]:
        """The effective configuration of the rig."""
        return self._section("configuration")

    @property
    def catheter(self) -> dict[str, Any]:
        """The catheter's parameters."""
        return self._section("catheter")

    def _section(self, name: str) -> dict[str, Any]:
        text = self._metadata.get(name, {}).get("json", "{}")
        try:
            found = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise InputError(f"{self.path} {name}", str(error), "a JSON object") from None
        if not isinstance(found, dict):
            raise InputError(f"{self.path} {name}", found, "a JSON object")
        return found

    @property
    def topics(self) -> dict[str, int]:
        """Topic -> number of messages, for topics that have any."""
        return {topic: len(places.chunk) for topic, (_, places) in self._places.items()}

    @property
    def span_ns(self) -> tuple[int, int]:
        """Earliest and latest time of recording, (0, 0) for an empty one."""
        times = [time for _, places in self._places.values() for time in (places.recorded_ns[0], places.recorded_ns[-1])]
        return (min(times), max(times)) if times else (0, 0)

    def schema(self, topic: str) -> dict[str, Any]:
        """Return the JSON Schema of `topic` as the file has it.

        Raises:
            InputError: The topic is not in the file, or its schema is not supported.
        """
        if topic not in self._places:
            known = ", ".join(sorted(self._places)) or "none, the recording is empty"
            raise InputError("topic", topic, f"one of {known}")
        data = self._schemas[self._places[topic][0]].data
        try:
            return _plain_properties(data)
        except _BAD_CONTENT as error:
            raise InputError(f"{self.path} {topic}", _brief(error), "a JSON Schema of numbers, texts and flags") from None

    def units(self, topic: str) -> dict[str, str]:
        """Return column -> unit of `topic`'s table, empty text where it has none. Raises InputError as `schema`."""
        units = {}
        for name, item in self.schema(topic)["properties"].items():
            if name != "schema_version":
                for column in item.get("columns", [name]):
                    units[column] = item.get("unit", "")
        return {**units, "recorded_ns": "ns"}

    def messages(self, topic: str) -> Iterator[dict[str, Any]]:
        """Yield the messages of `topic` as dicts, in the order of recording, nil as None.

        None are yielded for a topic that is not in the file. Raises InputError for a message that is not readable.
        """
        if topic in self._places:
            names = list(self.schema(topic)["properties"])
            for body in self._bodies(topic):
                yield {name: body.get(name) for name in names}

    def _bodies(self, topic: str) -> Iterator[dict[str, Any]]:
        places = self._places[topic][1]
        try:
            with self.path.open("rb") as stream:
                for index in range(len(places.chunk)):
                    yield self._body(stream, topic, places, index)
        except OSError as error:
            raise InputError(str(self.path), error.strerror or str(error), "a readable recording") from None

    def _body(self, stream: BinaryIO, topic: str, places: _Places, index: int) -> dict[str, Any]:
        number, start, length = places.chunk[index], places.start[index], places.length[index]
        try:
            if number == _OUTSIDE:
                stream.seek(start)
                data = stream.read(length)
            else:
                data = self._chunk(stream, number)[start : start + length]
            # Older recordings hold msgpack, whose maps never begin with the byte of `{`.
            body = orjson.loads(data) if data[:1] == b"{" else msgspec.msgpack.decode(data)
            return {name: value for name, value in body.items() if value is not None}
        except (*_DAMAGE, *_BAD_CONTENT) as error:
            key = f"{self.path} {topic}"
            raise InputError(key, f"message {index} that is {_brief(error)}", "one JSON or msgpack map") from None

    def _chunk(self, stream: BinaryIO, number: int) -> bytes:
        """Return the content of a chunk; the newest is kept, because readers go through a file in order."""
        if self._held[0] != number:
            place, length = self._chunk_places[number]
            stream.seek(place)
            self._held = (number, unpack_chunk(Chunk.read(ReadDataStream(io.BytesIO(stream.read(length))))))
        return self._held[1]

    def message(self, topic: str, index: int) -> dict[str, Any] | None:
        """Return message number `index` of `topic`, in the order of recording; nil is absent.

        A message of a known topic is checked as if it came over the network: None where it is not
        what the topic declares. Raises KeyError, IndexError.
        """
        with self.path.open("rb") as stream:
            body = self._body(stream, topic, self._places[topic][1], index)
        return body if topic not in TOPICS or _valid(TOPICS[topic].message, body) else None

    def times_ns(self, topic: str) -> np.ndarray:
        """Return when each message of `topic` was recorded, (n,), not falling; empty for a topic that is not there."""
        times = self._places[topic][1].recorded_ns if topic in self._places else array("q")
        return np.maximum.accumulate(np.array(times, dtype=np.int64))

    def table(self, topic: str) -> RecordedTable:
        """Return the messages of `topic` as columns, one array of shape (n,) each.

        A vector is spread over its named columns, nil becomes NaN, and `recorded_ns` is when a message was recorded.
        Names end in the unit (`command_insertion_m`); `units` has it as a text.

        Raises:
            InputError: The topic is not in the file, its messages are not what its schema says, or the table would take
                more than TABLE_LIMIT_BYTES.
        """
        if topic not in self._tables:
            key = f"{self.path} {topic}"
            properties = {n: item for n, item in self.schema(topic)["properties"].items() if n != "schema_version"}
            recorded_ns = np.array(self._places[topic][1].recorded_ns, dtype=np.int64)
            cells = len(recorded_ns) * sum(len(item.get("columns", "x")) for item in properties.values())
            if 8 * cells > TABLE_LIMIT_BYTES:
                raise InputError(key, f"a table of {cells} cells", f"at most {TABLE_LIMIT_BYTES // 8}")
            try:
                columns = _columns(properties, self._bodies(topic), len(recorded_ns))
            except InputError:
                raise
            except _BAD_CONTENT as error:
                raise InputError(key, _brief(error), "messages as their schema in the file declares") from None
            self._tables[topic] = RecordedTable(key, {**columns, "recorded_ns": recorded_ns})
        return self._tables[topic]


def is_whole(path: Path) -> bool:
    """Return whether the file has its end and every chunk of it is intact. Raises InputError as `Recording`."""
    recording = RecordingFile(path)
    return not recording.truncated and recording.damaged_chunks == 0


def _records(content: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, start and end of each record in a chunk's content. Raises ValueError where one is not whole."""
    place, size = 0, len(content)
    while place < size:
        opcode, length = _RECORD_HEAD.unpack_from(content, place)
        start = place + _RECORD_HEAD.size
        place = start + length
        if place > size or (opcode == Opcode.MESSAGE and length < _MESSAGE_HEAD.size):
            raise ValueError("a record that is not whole")
        yield opcode, start, place


def unpack_chunk(chunk: Chunk) -> bytes:
    """Return a chunk's content, never more than it declares. Raises ValueError, ZstdError, RuntimeError."""
    if chunk.compression == "":
        return chunk.data
    if chunk.compression == "zstd":
        # Not `decompress`, which allocates what the packed data's own head declares.
        with zstandard.ZstdDecompressor(max_window_size=2 * CHUNK_LIMIT_BYTES).stream_reader(chunk.data) as reader:
            return reader.read(chunk.uncompressed_size)
    if chunk.compression == "lz4":
        return lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=chunk.uncompressed_size)
    raise ValueError(f"packing {chunk.compression!r}")


_DTYPES: dict[str, Any] = {"number": np.float64, "integer": np.int64, "boolean": np.bool_, "string": np.str_}


@cache
def _plain_properties(data: bytes) -> dict[str, Any]:
    """Return the schema in `data`, each property checked to be one that makes columns."""
    schema = json.loads(data)
    for name, item in schema["properties"].items():
        if name == "schema_version":
            continue
        names = item.get("columns")
        kind = item["items"]["type"] if names is not None else _kind(item)
        if kind not in _DTYPES or (names is not None and not all(isinstance(column, str) for column in names)):
            raise ValueError(f"{name} of type {kind!r}")
    return dict(schema)


def _kind(item: dict[str, Any]) -> str:
    return item["type"][0] if isinstance(item["type"], list) else item["type"]


def _columns(properties: dict[str, Any], bodies: Iterable[dict[str, Any]], count: int) -> dict[str, np.ndarray]:
    """Return the columns of all properties. Numbers go straight into arrays, so that memory is that of the table."""
    texts: dict[str, list[str]] = {}
    numbers: dict[str, np.ndarray] = {}
    for name, item in properties.items():
        names = item.get("columns")
        kind = item["items"]["type"] if names is not None else _kind(item)
        if kind == "string":
            texts[name] = []
        else:
            numbers[name] = np.empty((count, len(names)) if names is not None else (count,), dtype=_DTYPES[kind])
            if kind == "number":
                numbers[name].fill(np.nan)
    for row, body in enumerate(bodies):
        for name, values in numbers.items():
            value = body.get(name)
            if value is None:
                if values.dtype != np.float64:
                    raise ValueError(f"message {row} without {name}")
            elif not _fits(value, values):
                raise ValueError(f"{name} {_brief(value)}")
            else:
                values[row] = value
        for name, column in texts.items():
            text = body.get(name, "")
            if not isinstance(text, str):
                raise ValueError(f"{name} {_brief(text)}")
            column.append(text)
    return {column: values for name, item in properties.items() for column, values in _spread(name, item, numbers, texts)}


def _fits(value: Any, values: np.ndarray) -> bool:
    """Return whether `value` is a row of `values`, without a conversion."""
    if values.ndim == 2:
        return isinstance(value, list) and len(value) == values.shape[1]
    if values.dtype == np.float64:
        return isinstance(value, (int, float))
    return type(value) is (int if values.dtype == np.int64 else bool)


def _spread(
    name: str, item: dict[str, Any], numbers: dict[str, np.ndarray], texts: dict[str, list[str]]
) -> list[tuple[str, np.ndarray]]:
    if name in texts:
        longest = max(map(len, texts[name]), default=1)
        if 4 * longest * len(texts[name]) > TABLE_LIMIT_BYTES:
            raise ValueError(f"{len(texts[name])} texts {name} of up to {longest} characters")
        return [(name, np.array(texts[name], dtype=np.str_))]
    values = numbers[name]
    names = item.get("columns")
    if names is None:
        return [(name, values)]
    return [(column, np.ascontiguousarray(values[:, index])) for index, column in enumerate(names)]


def _valid(message_class: type[Message], body: dict[str, Any]) -> bool:
    try:
        msgspec.convert(body, message_class).check()
    except (ValueError, TypeError, OverflowError, RecursionError):
        return False
    return True


def _brief(value: object) -> str:
    text = " ".join(f"{type(value).__name__} {value}".split()) if isinstance(value, Exception) else repr(value)
    return text if len(text) <= 80 else text[:77] + "..."
