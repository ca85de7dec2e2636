"""Requests checked before anything computes: unknown keys, NaN and wrong types are refused with the key named."""

from __future__ import annotations

import difflib
import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, ValidationError

from protocol.errors import Description, InputError
from protocol.unit_slips import hint_of

Model = TypeVar("Model", bound=BaseModel)


class Request(BaseModel):
    """Base of every request: unknown keys refused, NaN and infinity refused, strings are not converted."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


# Type of a pydantic error -> what is wanted, with the names of its context.
_WANTED = {
    "missing": "a value",
    "float_type": "a number",
    "int_type": "an integer",
    "string_type": "a text",
    "bool_type": "true or false",
    "list_type": "a list",
    "tuple_type": "a list of three numbers",
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
    "union_tag_not_found": "an object with the key {discriminator}",
    "union_tag_invalid": "{discriminator} of {expected_tags}",
}


def wanted_of(error: Mapping[str, Any]) -> str:
    """Return what is wanted instead of the value that `error`, one of pydantic's, refuses."""
    pattern = _WANTED.get(error["type"])
    return pattern.format(**error.get("ctx") or {}) if pattern else str(error["msg"]).removeprefix("Value error, ")


def validate(model: type[Model], data: Any) -> Model:
    """Check `data` against `model` (a `Request`) and return the result. Raises InputError with the first wrong key."""
    if not isinstance(data, dict):
        raise InputError("request", data, "one JSON object")
    try:
        return model.model_validate(data)
    except ValidationError as error:
        first = first_of(error.errors())
        key = ".".join(str(part) for part in first["loc"]) or "request"
        if first["type"] == "extra_forbidden":
            known = known_keys(model, first["loc"])
            raise InputError(key, first["input"], unknown_key(str(first["loc"][-1]), known)) from None
        found = Description("nothing") if first["type"] == "missing" else first["input"]
        raise InputError(key, found, wanted_of(first) + hint_of(first)) from None


def first_of(errors: Sequence[Any]) -> Any:
    """Return the error to report: an unknown key first, because a misspelt key is unknown and missing at once."""
    return next((error for error in errors if error["type"] == "extra_forbidden"), errors[0])


def unknown_key(key: str, known: Collection[str]) -> str:
    """Return what is wanted instead of an unknown key: the one that it resembles, or all."""
    near = difflib.get_close_matches(key, known, 1) or [name for name in known if name.lower() == key.lower()]
    if near:
        return f"no such key; did you mean {near[0]}?"
    return "no such key" + (f"; known keys: {', '.join(known)}" if known else "")


def known_keys(model: Any, place: tuple[Any, ...]) -> list[str]:
    """The keys of the section of `model` that `place` (keys from the top to the unknown key) lies in; [] where unclear."""
    sections = [model]
    for part in place[:-1]:
        named = [section.model_fields[part].annotation for section in sections if part in section.model_fields]
        # A number is a place in a list, and a text that no section has the tag of one of several forms.
        sections = [inner for annotation in named for inner in _sections_in(annotation)] or sections
    return sorted({name for section in sections for name in section.model_fields})


def _sections_in(annotation: Any) -> list[Any]:
    """Return the sections that a field's type names, also within lists, dicts and alternatives."""
    if hasattr(annotation, "model_fields"):
        return [annotation]
    return [inner for part in get_args(annotation) for inner in _sections_in(part)]


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


__all__ = ["InputError", "Request", "plain", "validate", "wanted_of"]
