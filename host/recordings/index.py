"""The end of an MCAP file, made from the file itself when it is closed, so that a recorder keeps no index while it runs."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Iterator
from typing import BinaryIO

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    McapRecord,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")  # of every record: what it is, its length after this head
_CHUNK_HEAD = struct.Struct("<QQQII")  # first and last time, bytes unpacked, their CRC, length of the packing's name
_MESSAGE_INDEX_HEAD = struct.Struct("<HI")
_BYTES_PER_MESSAGE = 16  # in a message index
_FOOTER_BYTES = 20


def _heads(stream: BinaryIO) -> Iterator[tuple[int, int, int]]:
    """Opcode, place and whole length of each record, the stream standing after the record's head."""
    place = len(MAGIC)
    stream.seek(place)
    while len(head := stream.read(_HEAD.size)) == _HEAD.size:
        opcode, length = _HEAD.unpack(head)
        yield opcode, place, length + _HEAD.size
        place += length + _HEAD.size
        stream.seek(place)


def _chunk_index(stream: BinaryIO, place: int, length: int) -> ChunkIndex:
    first, last, unpacked, _, name_bytes = _CHUNK_HEAD.unpack(stream.read(_CHUNK_HEAD.size))
    compression = stream.read(name_bytes).decode()
    (packed,) = struct.unpack("<Q", stream.read(8))
    return ChunkIndex(
        chunk_length=length,
        chunk_start_offset=place,
        compression=compression,
        compressed_size=packed,
        message_end_time=last,
        message_index_length=0,
        message_index_offsets={},
        message_start_time=first,
        uncompressed_size=unpacked,
    )


def _metadata_index(stream: BinaryIO, place: int, length: int) -> MetadataIndex:
    (name_bytes,) = struct.unpack("<I", stream.read(4))
    return MetadataIndex(offset=place, length=length, name=stream.read(name_bytes).decode())


def _indexed(stream: BinaryIO) -> tuple[list[ChunkIndex], list[MetadataIndex], dict[int, int]]:
    """Indexes of chunks and of metadata, and how many messages each channel has."""
    chunks: list[ChunkIndex] = []
    metadata: list[MetadataIndex] = []
    counts: dict[int, int] = {}
    for opcode, place, length in _heads(stream):
        if opcode == Opcode.CHUNK:
            chunks.append(_chunk_index(stream, place, length))
        elif opcode == Opcode.MESSAGE_INDEX:
            channel, index_bytes = _MESSAGE_INDEX_HEAD.unpack(stream.read(_MESSAGE_INDEX_HEAD.size))
            chunks[-1].message_index_offsets[channel] = place
            chunks[-1].message_index_length += length
            counts[channel] = counts.get(channel, 0) + index_bytes // _BYTES_PER_MESSAGE
        elif opcode == Opcode.METADATA:
            metadata.append(_metadata_index(stream, place, length))
    return chunks, metadata, counts


def file_end(stream: BinaryIO, schemas: Iterable[Schema], channels: Iterable[Channel]) -> bytes:
    """What is to follow the last chunk of the MCAP file `stream`: end of data, summary with all indexes, footer.

    stream: readable, whole records only, not ended yet. schemas, channels: all that the file holds.
    """
    chunks, metadata, counts = _indexed(stream)
    schemas, channels = list(schemas), list(channels)
    data_end = RecordBuilder()
    DataEnd(0).write(data_end)
    ended = data_end.end()
    start = stream.seek(0, 2) + len(ended)
    statistics = Statistics(
        attachment_count=0,
        channel_count=len(channels),
        channel_message_counts=counts,
        chunk_count=len(chunks),
        message_count=sum(counts.values()),
        metadata_count=len(metadata),
        schema_count=len(schemas),
        message_start_time=min((chunk.message_start_time for chunk in chunks), default=0),
        message_end_time=max((chunk.message_end_time for chunk in chunks), default=0),
    )
    groups: list[tuple[Opcode, list[McapRecord]]] = [
        (Opcode.SCHEMA, [*schemas]),
        (Opcode.CHANNEL, [*channels]),
        (Opcode.STATISTICS, [statistics]),
        (Opcode.CHUNK_INDEX, [*chunks]),
        (Opcode.METADATA_INDEX, [*metadata]),
    ]
    summary = RecordBuilder()
    offsets = []
    for opcode, records in groups:
        begin = summary.count
        for record in records:
            record.write(summary)
        if records:
            offsets.append(SummaryOffset(group_opcode=opcode, group_start=start + begin, group_length=summary.count - begin))
    offset_start = start + summary.count
    for offset in offsets:
        offset.write(summary)
    text = summary.end()
    check = zlib.crc32(struct.pack("<BQQQ", Opcode.FOOTER, _FOOTER_BYTES, start, offset_start), zlib.crc32(text))
    footer = RecordBuilder()
    Footer(summary_start=start, summary_offset_start=offset_start, summary_crc=check).write(footer)
    return ended + text + footer.end() + MAGIC
