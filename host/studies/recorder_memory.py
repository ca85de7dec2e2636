"""Memory after an hour of recording: this project's writer and the mcap package's, on the same messages.

`python -m host.studies.recorder_memory` prints bytes for each hour. Every second one chunk with a message of each
of three topics. What a writer keeps depends on the chunks and the topics in them, not on the messages in a chunk.
"""

from __future__ import annotations

import gc
import os
import tempfile
import tracemalloc
from collections.abc import Callable
from pathlib import Path

from mcap.writer import Writer

from host.recordings.header import RecordingHeader
from host.recordings.writer import RecordingWriter
from protocol.topics import CommandCounts, Log, Message, Stage

HOUR_S = 3600
CHUNK_BYTES = 4096
NAMES = ("stage", "log", "commander")


def messages(second: int) -> list[tuple[str, Message]]:
    """Return a few messages of different topics, with the stamp of `second`."""
    stamp_ns = second * 1_000_000_000
    counts = CommandCounts(stamp_ns=stamp_ns, accepted=1, refused=0, expired=0, replayed=0, malformed=0, flooded=0)
    stage = Stage(stamp_ns=stamp_ns, command_insertion_m=1e-6 * second, command_roll_rad=0.0, command_knob_rad=0.0)
    return [("stage", stage), ("log", Log(stamp_ns=stamp_ns, level="info", source="s", text="t")), ("commander", counts)]


def grown_bytes(record: Callable[[int], None]) -> int:
    """Return what an hour of `record(second)` adds to the memory held, after half an hour to settle."""
    held: list[int] = []
    tracemalloc.start()
    for second in range(HOUR_S // 2 + HOUR_S + 1):
        record(second)
        if second in (HOUR_S // 2, HOUR_S // 2 + HOUR_S):
            gc.collect()
            held.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    return held[1] - held[0]


def main() -> None:
    """Print the memory that both MCAP writers need for two hours."""
    with tempfile.TemporaryDirectory() as folder:
        with RecordingWriter(Path(folder) / "ours.mcap", RecordingHeader("simulated", "virtual", {}, {})) as ours:
            os.fdatasync = lambda fd: None  # the disk is not what is measured

            def record(second: int) -> None:
                for topic, message in messages(second):
                    ours.write(topic, message)
                ours.flush()

            print(f"this project's writer: {grown_bytes(record)} bytes an hour")
        with (Path(folder) / "library.mcap").open("wb") as stream:
            library = Writer(stream, chunk_size=CHUNK_BYTES)
            library.start("seldinger", "library")
            schema = library.register_schema("Any", "jsonschema", b"{}")
            channels = {name: library.register_channel(name, "json", schema) for name in NAMES}

            def record_there(second: int) -> None:
                for topic, message in messages(second):
                    # The package ends a chunk by its size: the second's last message fills it.
                    data = b" " * CHUNK_BYTES if topic == NAMES[-1] else b"{}"
                    library.add_message(channels[topic], message.stamp_ns, data, message.stamp_ns)

            print(f"the mcap package's writer: {grown_bytes(record_there)} bytes an hour")


if __name__ == "__main__":
    main()
