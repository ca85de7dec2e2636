"""Definition files of Aurora tools that have no memory of their own: the host writes them before the tool is initialised."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from protocol.errors import Description, InputError

# The memory that PVWR fills: pages of 64 bytes; the files of the device's maker (.rom) have at most 1024 bytes.
PAGE_BYTES, MOST_BYTES = 64, 1024
START = b"NDI"  # of every such file
_WANTED = f"a tool definition (.rom) of 1 to {MOST_BYTES} bytes"


def read_definition(key: str, path: str) -> bytes:
    """Return the content of a tool definition file, filled with zeros to whole pages of 64 bytes.

    Args:
        key: of the rig file, for the message.
        path: of the file.

    Raises:
        InputError: the file cannot be read, is empty, larger than the memory of a tool, or not a definition of NDI's.
    """
    try:
        # Not waiting for a writer, should it be a pipe.
        with open(os.open(Path(path).expanduser(), os.O_RDONLY | os.O_NONBLOCK), "rb") as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                raise InputError(key, Description(f"{path} (not a file)"), _WANTED)
            content = file.read(MOST_BYTES + 1)
    except OSError as error:
        raise InputError(key, path, f"{_WANTED} that can be read ({error.strerror})") from None
    if not 0 < len(content) <= MOST_BYTES:
        size = "an empty file" if not content else f"more than {MOST_BYTES} bytes"
        raise InputError(key, Description(f"{path} ({size})"), _WANTED)
    if not content.startswith(START):
        raise InputError(
            key, Description(f"{path} (its first bytes are {content[:3].hex(' ')})"), f"{_WANTED} that begin with NDI"
        )
    return content + bytes(-len(content) % PAGE_BYTES)
