"""Open a recording for a command: one line where it cannot be read, and a warning where it is incomplete."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from protocol.errors import Description, InputError

if TYPE_CHECKING:
    from host.recordings.recording import RecordingFile


UnpackLimit = Annotated[
    int | None,
    typer.Option(
        "--unpack-limit", min=1, help="Largest unpacked size of the file, MiB; default: 64, or 64 times the file's size."
    ),
]


def open_recording(path: Path, unpack_limit_MiB: int | None = None) -> RecordingFile:
    """Open the recording at `path`; print a warning if it is incomplete. Raises InputError."""
    from host.recordings.recording import RecordingFile

    recording = RecordingFile(path, None if unpack_limit_MiB is None else unpack_limit_MiB * 2**20)
    if not recording.topics:
        raise InputError(str(path), Description("no message that is intact"), "a recording with messages of the rig")
    if recording.truncated or recording.damaged_chunks:
        print(
            f"seldinger: {path} is {'cut short' if recording.truncated else 'damaged'} "
            f"({recording.damaged_chunks} damaged chunks): using the messages that are intact",
            file=sys.stderr,
        )
    return recording
