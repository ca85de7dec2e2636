"""Definition files of Aurora tools that have no memory of their own: the host writes them before the tool is initialised."""

from __future__ import annotations

from pathlib import Path

from protocol.errors import Description, InputError

# The memory that PVWR fills: pages of 64 bytes; the files of the device's maker (.rom) have at most 1024 bytes.
PAGE_BYTES, MOST_BYTES = 64, 1024
_WANTED = f"a tool definition (.rom) of 1 to {MOST_BYTES} bytes"


def read_definition(key: str, path: str) -> bytes:
    """Return the content of a tool definition file, filled with zeros to whole pages of 64 bytes.

    Args:
        key: of the rig file, for the message.
        path: of the file.

    Raises:
        InputError: the file cannot be read, is empty, or is larger than the memory of a tool.
    """
    try:
        with Path(path).expanduser().open("rb") as file:
            content = file.read(MOST_BYTES + 1)
    except OSError as error:
        raise InputError(key, path, f"{_WANTED} that can be read ({error.strerror})") from None
    if not 0 < len(content) <= MOST_BYTES:
        size = "an empty file" if not content else f"more than {MOST_BYTES} bytes"
        raise InputError(key, Description(f"{path} ({size})"), _WANTED)
    return content + bytes(-len(content) % PAGE_BYTES)
