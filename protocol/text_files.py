"""Text files that people write, as text, TOML or JSON. One that cannot be read is refused in one line.

Accepted: UTF-8, also with the byte order mark that some editors write. Refused: other encodings,
more than LARGEST_BYTES (a device such as /dev/zero never ends), a key given twice, and nesting that no person writes.
"""

from __future__ import annotations

import json
import sys
import tomllib
from pathlib import Path
from typing import Any

from protocol.errors import Description, InputError, reason

LARGEST_BYTES = 64 * 2**20
# First bytes of files that are mistaken for text.
_KINDS = (
    (b"\x1f\x8b", "data packed by gzip"),
    (b"PK\x03\x04", "a zip archive"),
    (b"\x89MCAP", "an MCAP recording"),
    (b"PAR1", "a Parquet table"),
    (b"\x7fELF", "a program (ELF)"),
    (b"\x89PNG", "a picture (PNG)"),
    (b"%PDF", "a PDF document"),
    (b"\xff\xfe", "text in UTF-16"),
    (b"\xfe\xff", "text in UTF-16"),
)


def kind_of(head: bytes) -> str:
    """Return what kind of file begins with `head`, "" where that is not known."""
    return next((kind for mark, kind in _KINDS if head.startswith(mark)), "")


def read_text(source: str | Path, key: str = "", wanted: str = "a readable text file") -> str:
    """Return the text of file `source`, or of standard input if it is "-".

    Args:
        source: the file.
        key: name of the option or key that names the file; without it the error names the file itself.
        wanted: what the error says is wanted.

    Raises:
        InputError: no such file, too large, or not UTF-8.
    """
    try:
        if str(source) == "-":
            content = sys.stdin.buffer.read(LARGEST_BYTES + 1)
        else:
            with Path(source).open("rb") as file:
                content = file.read(LARGEST_BYTES + 1)
    except (OSError, ValueError) as error:  # ValueError: a name with a zero byte
        raise _refused(source, key, reason(error), wanted) from None
    if len(content) > LARGEST_BYTES:
        raise _refused(source, key, f"more than {LARGEST_BYTES // 2**20} MiB", wanted)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        found = kind_of(content) or f"byte 0x{content[error.start]:02x} at {error.start}, which is not UTF-8"
        raise _refused(source, key, found, wanted) from None


def toml_of(text: str, source: str | Path, key: str = "", wanted: str = "a readable TOML file") -> dict[str, Any]:
    """Return the content of TOML `text`, which came from file `source`. Raises InputError, as `read_text` names it."""
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise _refused(source, key, "lists nested too deeply", wanted) from None
    except ValueError as error:  # tomllib's own, and whole numbers of more digits than Python converts
        raise _refused(source, key, str(error).partition(";")[0], wanted) from None


def read_toml(source: str | Path, key: str = "", wanted: str = "a readable TOML file") -> dict[str, Any]:
    """Return the content of the TOML file `source`. Raises InputError, as `read_text` names it."""
    return toml_of(read_text(source, key, wanted), source, key, wanted)


def json_of(text: str, source: str | Path, key: str = "", wanted: str = "one JSON object") -> dict[str, Any]:
    """Return the JSON object in `text`, which came from file `source`.

    Raises:
        InputError: it is none, or a key is in an object twice: readers of JSON would take the last one without a word.
    """

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        names = [name for name, _ in pairs]
        twice = next((name for name in names if names.count(name) > 1), None) if len(set(names)) < len(names) else None
        if twice is not None:
            raise _refused(source, key, f"key {twice!r} twice", "each key once")
        return dict(pairs)

    try:
        value = json.loads(text, object_pairs_hook=once)
    except InputError:
        raise
    except RecursionError:
        raise _refused(source, key, "lists nested too deeply", wanted) from None
    except ValueError as error:  # also a whole number of more digits than Python converts
        raise _refused(source, key, str(error).partition(";")[0], wanted) from None
    if not isinstance(value, dict):
        raise _refused(source, key, value, wanted)
    return value


def read_json(source: str | Path, key: str = "", wanted: str = "one JSON object") -> dict[str, Any]:
    """Return the JSON object in file `source`, or on standard input if it is "-". Raises InputError, as `json_of` does."""
    return json_of(read_text(source, key, "a readable JSON file, or - for standard input"), source, key, wanted)


def _refused(source: str | Path, key: str, found: object, wanted: str) -> InputError:
    what = Description(found) if isinstance(found, str) else found
    if not key:
        return InputError(str(source), what, wanted)
    return InputError(key, Description(f"{source}: {what}"), wanted)
