"""Output of a command as one JSON object."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def write_json(value: Any, target: str | None = None) -> None:
    """Write one JSON object to standard output, or into file `target`; NaN and infinity become null."""
    from protocol.requests import plain

    text = json.dumps(plain(value), allow_nan=False)
    if target is None or target == "-":
        print(text)
    else:
        Path(target).write_text(text + "\n", encoding="utf-8")
