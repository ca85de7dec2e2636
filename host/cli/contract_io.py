"""JSON requests in, one JSON object out, bad input as one line that names key, what was found and what is wanted."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

Model = TypeVar("Model", bound=BaseModel)


class BadInput(Exception):
    """Input that must not reach a kernel; `main` prints it as one line and exits with status 2."""

    def __init__(self, key: str, found: object, wanted: str) -> None:
        self.key, self.found, self.wanted = key, found, wanted
        super().__init__(f"{key}: found {_short(found)}, wanted {wanted}")


class Request(BaseModel):
    """Base of every request: unknown keys refused, NaN and infinity refused, no silent conversion of strings."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


def _short(value: object, limit: int = 80) -> str:
    text = json.dumps(value) if isinstance(value, (dict, list, str, int, float, bool, type(None))) else str(value)
    return text if len(text) <= limit else text[: limit - 3] + "..."


def read_json(source: str) -> Any:
    """The JSON value in file `source`, or on standard input if it is `-`. Raises BadInput."""
    try:
        text = sys.stdin.read() if source == "-" else Path(source).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise BadInput(source, str(error), "a readable JSON file, or - for standard input") from None
    try:
        return json.loads(text)
    except (json.JSONDecodeError, RecursionError) as error:
        raise BadInput(source, str(error), "one JSON object") from None


def validate(model: type[Model], data: Any) -> Model:
    """`data` checked against `model` (a `Request`). Raises BadInput naming the first offending key."""
    if not isinstance(data, dict):
        raise BadInput("request", data, "one JSON object")
    try:
        return model.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"]) or "request"
        if first["type"] == "extra_forbidden":
            raise BadInput(key, first["input"], "no such key; known keys: " + ", ".join(model.model_fields)) from None
        found = "nothing" if first["type"] == "missing" else first["input"]
        raise BadInput(key, found, first["msg"].removeprefix("Value error, ")) from None


def plain(value: Any) -> Any:
    """`value` with numpy arrays and scalars turned into JSON's own types; NaN and infinity become null."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def write_json(value: Any, target: str | None = None) -> None:
    """One JSON object on standard output, or into file `target`."""
    text = json.dumps(plain(value), allow_nan=False)
    if target is None or target == "-":
        print(text)
    else:
        Path(target).write_text(text + "\n", encoding="utf-8")
