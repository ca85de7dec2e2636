"""Requests checked before anything computes: unknown keys, NaN and wrong types are refused with the key named."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from protocol.errors import Description, InputError, reason

Model = TypeVar("Model", bound=BaseModel)


class Request(BaseModel):
    """Base of every request: unknown keys refused, NaN and infinity refused, strings are not converted."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


def read_json(source: str) -> Any:
    """The JSON value in file `source`, or on standard input if it is `-`. Raises InputError."""
    try:
        text = sys.stdin.read() if source == "-" else Path(source).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(source, reason(error), "a readable JSON file, or - for standard input") from None
    try:
        return json.loads(text)
    except (json.JSONDecodeError, RecursionError) as error:
        raise InputError(source, Description(error), "one JSON object") from None


# Type of a pydantic error -> what is wanted, with the names of its context.
_WANTED = {
    "missing": "a value",
    "float_type": "a number",
    "int_type": "an integer",
    "string_type": "a text",
    "bool_type": "true or false",
    "list_type": "a list",
    "tuple_type": "a list",
    "dict_type": "an object",
    "model_type": "an object",
    "finite_number": "a finite number",
    "greater_than": "a number above {gt}",
    "greater_than_equal": "a number of at least {ge}",
    "less_than": "a number below {lt}",
    "less_than_equal": "a number of at most {le}",
    "too_short": "{min_length} items or more",
    "too_long": "{max_length} items or fewer",
    "string_too_short": "a text that is not empty",
    "literal_error": "{expected}",
}


def wanted_of(error: Mapping[str, Any]) -> str:
    """Say what is wanted instead of the value that `error`, one of pydantic's, refuses."""
    pattern = _WANTED.get(error["type"])
    return pattern.format(**error.get("ctx") or {}) if pattern else str(error["msg"]).removeprefix("Value error, ")


def validate(model: type[Model], data: Any) -> Model:
    """`data` checked against `model` (a `Request`). Raises InputError naming the first offending key."""
    if not isinstance(data, dict):
        raise InputError("request", data, "one JSON object")
    try:
        return model.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"]) or "request"
        if first["type"] == "extra_forbidden":
            raise InputError(key, first["input"], "no such key; known keys: " + ", ".join(model.model_fields)) from None
        found = Description("nothing") if first["type"] == "missing" else first["input"]
        raise InputError(key, found, wanted_of(first)) from None


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


__all__ = ["InputError", "Request", "plain", "read_json", "validate", "wanted_of"]
