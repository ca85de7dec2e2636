"""JSON requests in, one JSON object out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from protocol.requests import plain


def write_json(value: Any, target: str | None = None) -> None:
    """One JSON object on standard output, or into file `target`."""
    text = json.dumps(plain(value), allow_nan=False)
    if target is None or target == "-":
        print(text)
    else:
        Path(target).write_text(text + "\n", encoding="utf-8")
