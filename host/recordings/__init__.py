"""Recordings: write, read, repair, export, and channels that Foxglove draws.

The public face; a name is loaded when it is first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from host.recordings.header import RecordingHeader, header_of
    from host.recordings.recording import Recording
    from host.recordings.writer import RecordingWriter, new_recording_path

_HOMES = {
    "Recording": "recording",
    "RecordingHeader": "header",
    "RecordingWriter": "writer",
    "header_of": "header",
    "new_recording_path": "writer",
}
__all__ = ["Recording", "RecordingHeader", "RecordingWriter", "header_of", "new_recording_path", "open_recording"]


def open_recording(path: str, unpacked_limit_bytes: int | None = None) -> Recording:
    """Open a recording to read it.

    Args:
        path: The MCAP file.
        unpacked_limit_bytes: What the file may unpack to; by default 64 MiB, or 64 times its size where that is more.

    Returns:
        The recording. `.topics` names its topics with their number of messages, `.table(topic)` returns a topic's columns
        as arrays (n,) whose names end in the unit, `.units(topic)` the unit of each column.

    Raises:
        InputError: The file cannot be read, is no recording, or unpacks to more than the limit.
    """
    from host.recordings.recording import Recording

    return Recording(path, unpacked_limit_bytes)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
