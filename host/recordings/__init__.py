"""Recordings: write, read, repair, export, and channels that Foxglove draws.

The public face; a name is loaded when it is first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from host.recordings.header import RecordingHeader, header_of
    from host.recordings.recording import RecordingFile
    from host.recordings.writer import RecordingWriter, new_recording_path

_HOMES = {
    "RecordingFile": "recording",
    "RecordingHeader": "header",
    "RecordingWriter": "writer",
    "header_of": "header",
    "new_recording_path": "writer",
}
__all__ = ["RecordingFile", "RecordingHeader", "RecordingWriter", "header_of", "new_recording_path"]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
