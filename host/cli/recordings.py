"""Open a recording for a command: one line where it cannot be read, and a warning where it is incomplete."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from protocol.errors import InputError

if TYPE_CHECKING:
    from host.recordings.recording import Recording


def open_recording(path: Path) -> Recording:
    """Open the recording at `path`; say on standard error where it is incomplete. Raises InputError."""
    from host.recordings.recording import Recording

    try:
        recording = Recording(path)
    except ValueError as error:
        found, _, wanted = str(error).removeprefix(f"{path}: found ").partition(", wanted ")
        raise InputError(str(path), found, wanted) from None
    if recording.truncated or recording.damaged_chunks:
        print(
            f"seldinger: {path} is {'cut short' if recording.truncated else 'damaged'} "
            f"({recording.damaged_chunks} damaged chunks): using the messages that are intact",
            file=sys.stderr,
        )
    return recording
