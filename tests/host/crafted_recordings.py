"""Crafted and damaged recordings, from real ones: for the tests, and for `make fuzz-files`.

`python -m tests.host.crafted_recordings 100000 [SEED] [--corpus DIR]` reads that many; it stops at the first that does
anything but read or raise InputError, and keeps it in DIR.
"""

from __future__ import annotations

import argparse
import io
import random
import resource
import struct
import sys
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Chunk
from mcap.writer import CompressionType, Writer

from host.recordings.export import arrow_table
from host.recordings.header import RecordingHeader
from host.recordings.index import MAGIC
from host.recordings.recording import RecordingFile, is_whole
from host.recordings.writer import RecordingWriter
from protocol.errors import InputError
from protocol.topics import ForceSensor, Log, Pose, RigState, Stage

HEAD = struct.Struct("<BQ")
# What the reader may add to a process that has loaded it, however a file is crafted.
MEMORY_BYTES = 1 << 30


def small(path: Path) -> Path:
    """Write a short recording with five topics to `path`."""
    configuration = {"safety": {"over_force_N": 0.5}, "control": {"loop_hz": 1000}}
    with RecordingWriter(path, RecordingHeader("simulated", "virtual", configuration, {"name": "livewire"}, 1)) as writer:
        for tick in range(60):
            now = tick * 40_000_000
            writer.write("stage", Stage(stamp_ns=now, command_insertion_m=0.01, command_roll_rad=0.0, command_knob_rad=0.0))
            writer.write("force/sensor", ForceSensor(stamp_ns=now, arrival_ns=now, force_N=(0.0, 0.0, 0.001 * tick)))
            writer.write("pose/tip", Pose(stamp_ns=now, arrival_ns=now, frame=tick, missing=True))
            if tick % 10 == 0:
                writer.write("state", RigState(stamp_ns=now, mode="contact", safety_action="none"))
                writer.write("log", Log(stamp_ns=now, level="info", source="test", text="a line"))
    return path


def foreign(compression: CompressionType, use_chunking: bool = True) -> bytes:
    """Return a recording by the mcap package's own writer."""
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=500, compression=compression, use_chunking=use_chunking)
    writer.start("other", "library")
    text = b'{"type":"object","properties":{"stamp_ns":{"type":"integer","unit":"ns"},"x_m":{"type":"number","unit":"m"}}}'
    channel = writer.register_channel("stage", "json", writer.register_schema("S", "jsonschema", text))
    for number in range(40):
        writer.add_message(channel, number, b'{"stamp_ns":%d,"x_m":%d.5}' % (number, number), number, number)
    writer.finish()
    return stream.getvalue()


def originals(folder: Path) -> list[bytes]:
    """Return the files that are damaged: ours, and the package's with every packing and with none."""
    ours = small(folder / "original.mcap").read_bytes()
    packed = [foreign(kind) for kind in (CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE)]
    return [ours, *packed, foreign(CompressionType.NONE, use_chunking=False)]


def records(content: bytes) -> list[tuple[int, bytes]]:
    """Return (opcode, body) of the records that are whole."""
    found, place = [], len(MAGIC)
    while place + HEAD.size <= len(content):
        opcode, length = HEAD.unpack_from(content, place)
        place += HEAD.size
        if place + length > len(content):
            break
        found.append((opcode, content[place : place + length]))
        place += length
    return found


def rewritten(content: bytes, change: Callable[[bytearray], bytes]) -> bytes:
    """Return the file with `change` done to the content of each chunk, packed and summed again, so that it is read."""
    out = [MAGIC]
    for opcode, body in records(content):
        if opcode == Opcode.CHUNK:
            chunk = Chunk.read(ReadDataStream(io.BytesIO(body)))
            plain = {
                "": lambda data: data,
                "zstd": lambda data: zstandard.ZstdDecompressor().decompress(data),
                "lz4": lz4.frame.decompress,
            }[chunk.compression](chunk.data)
            body = chunk_body(change(bytearray(plain)))
        out += [HEAD.pack(opcode, len(body)), body]
    return b"".join(out) + MAGIC


def chunk_body(plain: bytes, declared: int | None = None) -> bytes:
    """Return a zstd chunk record's body. declared: the unpacked size that it states, by default the true one."""
    data = zstandard.ZstdCompressor().compress(plain)
    head = struct.pack("<QQQI", 0, 1, len(plain) if declared is None else declared, zlib.crc32(plain))
    return head + struct.pack("<I", 4) + b"zstd" + struct.pack("<Q", len(data)) + data


def damage(content: bytearray, chance: random.Random) -> bytes:
    """Return `content` with one to four changes: bytes, numbers, stretches cut, copied or moved."""
    for _ in range(chance.randint(1, 4)):
        if not content:
            break
        at = chance.randrange(len(content))
        kind = chance.randrange(7)
        if kind == 0:
            content[at] ^= 1 << chance.randrange(8)
        elif kind == 1:
            content[at] = chance.choice((0, 0x7F, 0x80, 0xFF, chance.randrange(256)))
        elif kind == 2:
            width = chance.choice((2, 4, 8))
            value = chance.choice((0, 1, 2 ** (8 * width) - 1, 2 ** (8 * width - 1), chance.getrandbits(8 * width)))
            content[at : at + width] = value.to_bytes(width, "little")
        elif kind == 3:
            del content[at : at + chance.choice((1, 8, 100, 10_000))]
        elif kind == 4:
            content[at:at] = content[at : at + chance.choice((1, 9, 200))] * chance.choice((1, 3))
        elif kind == 5:
            words = (b"[" * 3000, b"{}", b"null", b"1e999", b'"', b"\x00" * 50, b"NaN", b'"object"', b"true", b"-1", b"[]")
            content[at : at + chance.randrange(12)] = chance.choice(words)
        else:
            del content[at:]
    return bytes(content)


def mutated(files: list[bytes], chance: random.Random) -> bytes:
    """Return one damaged file: half of them damaged inside their chunks, behind a right checksum."""
    content = chance.choice(files)
    if chance.random() < 0.5:
        return rewritten(content, lambda plain: damage(plain, chance))
    return damage(bytearray(content), chance)


def read_all(path: Path) -> None:
    """Read all that a recording has, as export, replay and diagnosis do; an InputError of one line is an answer."""
    for read in (_tables, _replay, _sections, is_whole):
        try:
            read(path)
        except InputError as error:
            assert "\n" not in str(error) and len(str(error)) < 600, str(error)


def _tables(path: Path) -> None:
    recording = RecordingFile(path)
    for topic in recording.topics:
        try:
            arrow_table(recording, topic)
        except InputError:
            continue


def _replay(path: Path) -> None:
    recording = RecordingFile(path)
    for topic, count in recording.topics.items():
        recording.times_ns(topic)
        recording.message(topic, count - 1)


def _sections(path: Path) -> None:
    recording = RecordingFile(path)
    for section in ("run", "configuration", "catheter", "span_ns"):
        getattr(recording, section)


def main() -> int:
    """Read many crafted files; 0 when each was read or refused in one line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", type=int)
    parser.add_argument("seed", type=int, nargs="?", default=1)
    parser.add_argument("--corpus", type=Path, default=Path("build/crafted_recordings"))
    options = parser.parse_args()
    options.corpus.mkdir(parents=True, exist_ok=True)
    for old in options.corpus.glob("original.mcap"):
        old.unlink()
    files, path = originals(options.corpus), options.corpus / "newest.mcap"
    for kept in sorted(options.corpus.glob("kept-*.mcap")):
        read_all(kept)
    before_kib, begin_s = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.monotonic()
    for number in range(options.files):
        path.write_bytes(mutated(files, random.Random(f"{options.seed}/{number}")))
        try:
            read_all(path)
        except BaseException:
            path.rename(options.corpus / f"kept-{options.seed}-{number}.mcap")
            print(f"file {number} of seed {options.seed} is kept in {options.corpus}", file=sys.stderr)
            raise
    grown_MiB = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kib) / 1024
    took_s = time.monotonic() - begin_s
    print(f"{options.files} files read or refused in one line, {grown_MiB:.0f} MiB grown, {took_s:.0f} s")
    return 0 if grown_MiB * 2**20 < MEMORY_BYTES else 1


if __name__ == "__main__":
    sys.exit(main())
