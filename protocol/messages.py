"""How a declared message class becomes msgpack and comes back: fields with units and bounds, strictly checked."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar, dataclass_transform

import msgpack
import numpy as np
import numpy.typing as npt

SCHEMA_VERSION = 1
MAX_PAYLOAD_BYTES = 4096
MAX_TEXT = 500

Vector = Sequence[float] | npt.NDArray[np.float64]  # arrives as a tuple
_Check = Callable[[Any], Any]


class Spec(NamedTuple):
    """What a field is: its wire kind (float, integer, bool, text), unit, bounds and the names of its columns."""

    kind: str
    unit: str
    doc: str
    columns: tuple[str, ...] = ()
    optional: bool = False
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple[str, ...] = ()


def _field(spec: Spec, default: Any = dataclasses.MISSING) -> Any:
    return dataclasses.field(default=default, metadata={"spec": spec})


def number(
    unit: str, doc: str, *, minimum: float | None = None, maximum: float | None = None, default: Any = dataclasses.MISSING
) -> Any:
    """A finite float. With default None it may be nil (NaN in a table); NaN itself never travels."""
    return _field(Spec("float", unit, doc, (), default is None, minimum, maximum), default)


def integer(unit: str, doc: str, *, bits: int = 63, default: Any = dataclasses.MISSING) -> Any:
    """An integer; `bits` > 0: 0 .. 2^bits - 1, `bits` < 0: two's complement of that many bits."""
    low, high = (0, 2**bits - 1) if bits > 0 else (-(2 ** (-bits - 1)), 2 ** (-bits - 1) - 1)
    return _field(Spec("integer", unit, doc, (), False, low, high), default)


def vector(unit: str, doc: str, columns: tuple[str, ...], *, default: Any = dataclasses.MISSING) -> Any:
    """Finite floats, one for each column name; arrays are flattened in C order. With default None it may be nil."""
    return _field(Spec("float", unit, doc, columns, default is None), default)


def integers(unit: str, doc: str, columns: tuple[str, ...], *, bits: int = -32) -> Any:
    """Integers, one for each column name, bounded as in `integer`."""
    low, high = (0, 2**bits - 1) if bits > 0 else (-(2 ** (-bits - 1)), 2 ** (-bits - 1) - 1)
    return _field(Spec("integer", unit, doc, columns, False, low, high))


def flag(doc: str) -> Any:
    """True or false."""
    return _field(Spec("bool", "", doc))


def text(doc: str, *, default: Any = dataclasses.MISSING) -> Any:
    """A text of at most MAX_TEXT characters; longer ones are cut when they are sent, refused when they arrive."""
    return _field(Spec("text", "", doc), default)


def choice(doc: str, choices: tuple[str, ...]) -> Any:
    """One of a few words."""
    return _field(Spec("text", "", doc, (), False, None, None, choices))


ClassType = TypeVar("ClassType")


@dataclass_transform(
    kw_only_default=True, frozen_default=True, field_specifiers=(number, integer, vector, integers, flag, text, choice)
)
def message(cls: type[ClassType]) -> type[ClassType]:
    """Declares a message class: frozen, by keyword only, every field made by one of the functions above."""
    return dataclasses.dataclass(frozen=True, slots=True, kw_only=True)(cls)


@message
class Message:
    """Base of every message. Freshness is judged by `sequence` and `stamp_ns`, never by when something arrived."""

    stamp_ns: int = integer("ns", "time that the content is about, on the rig's clock")
    sequence: int = integer("", "counts up by one with each message of a topic from one publisher", default=0)

    def check(self) -> None:
        """What must hold between fields. Raises ValueError."""


MessageType = TypeVar("MessageType", bound=Message)


def specs(message_class: type[Message]) -> dict[str, Spec]:
    """Field name -> Spec, in the order of declaration."""
    return {field.name: field.metadata["spec"] for field in dataclasses.fields(message_class)}


def _wanted(spec: Spec) -> str:
    if spec.choices:
        return "one of " + ", ".join(spec.choices)
    what = {
        "float": "a finite number",
        "integer": "an integer",
        "bool": "true or false",
        "text": f"a text of at most {MAX_TEXT} characters",
    }[spec.kind]
    if spec.columns:
        what = f"{len(spec.columns)} of " + what.removeprefix("a ").removeprefix("an ") + "s"
    if spec.minimum is not None:
        what += f" not below {spec.minimum:g}"
    if spec.maximum is not None:
        what += f" not above {spec.maximum:g}"
    return what + (", or nil" if spec.optional else "")


def _scalar_ok(spec: Spec) -> Callable[[Any], bool]:
    low = -math.inf if spec.minimum is None else spec.minimum
    high = math.inf if spec.maximum is None else spec.maximum
    if spec.kind == "float":
        largest = 1.7976931348623157e308
        low, high = max(low, -largest), min(high, largest)
        return lambda value: (type(value) is float or type(value) is int) and low <= value <= high
    if spec.kind == "integer":
        return lambda value: type(value) is int and low <= value <= high
    if spec.kind == "bool":
        return lambda value: type(value) is bool
    if spec.choices:
        return lambda value: type(value) is str and value in spec.choices
    return lambda value: type(value) is str and len(value) <= MAX_TEXT


def _reader(name: str, spec: Spec) -> _Check:
    """Checks one field that arrived; returns it in the type of its class. Raises ValueError."""
    good, count = _scalar_ok(spec), len(spec.columns)
    convert = float if spec.kind == "float" else lambda value: value

    def read(value: Any) -> Any:
        if value is None and spec.optional:
            return None
        if count:
            if type(value) is list and len(value) == count and all(map(good, value)):
                return tuple(map(convert, value))
        elif good(value):
            return convert(value)
        raise ValueError(f"{name}: found {_short(value)}, wanted {_wanted(spec)}")

    return read


def _short(value: Any) -> str:
    shown = repr(value)
    return shown if len(shown) <= 60 else shown[:57] + "..."


def _plain(spec: Spec, value: Any) -> Any:
    """A field's value in msgpack's own types: numpy to Python, long texts cut, NaN to nil where nil is allowed."""
    if hasattr(value, "tolist"):
        value = value.ravel().tolist() if spec.columns else value.tolist()
    elif spec.columns and value is not None:
        value = list(value)
    if spec.kind == "text" and isinstance(value, str) and len(value) > MAX_TEXT and not spec.choices:
        return value[: MAX_TEXT - 3] + "..."
    if spec.kind == "float" and spec.optional and value is not None:
        numbers = value if spec.columns else (value,)
        if not all(map(math.isfinite, numbers)):
            return None
    return value


_plans: dict[type[Message], tuple[tuple[str, Spec, _Check], ...]] = {}


def _plan(message_class: type[Message]) -> tuple[tuple[str, Spec, _Check], ...]:
    plan = _plans.get(message_class)
    if plan is None:
        plan = tuple(
            (name, spec, _reader(f"{message_class.__name__}.{name}", spec)) for name, spec in specs(message_class).items()
        )
        _plans[message_class] = plan
    return plan


def body_of(of: Message) -> dict[str, Any]:
    """The message as a dict of plain Python values, in order of declaration. Raises ValueError for a bad field."""
    body: dict[str, Any] = {}
    for name, spec, read in _plan(type(of)):
        value = _plain(spec, getattr(of, name))
        read(value)
        body[name] = value
    if type(of).check is not Message.check:
        type(of)(**body).check()
    return body


def encode(of: Message, sequence: int | None = None) -> bytes:
    """The message as a msgpack map with `schema_version`, `stamp_ns`, `sequence` and its fields.

    sequence: takes the place of the message's own. Raises ValueError where a field is not what its class declares:
    nothing bad leaves this process.
    """
    body = {"schema_version": SCHEMA_VERSION, **body_of(of)}
    if sequence is not None:
        body["sequence"] = sequence
    return msgpack.packb(body)


def _no_twins(pairs: list[tuple[Any, Any]]) -> dict[str, Any]:
    body = dict(pairs)
    if len(body) != len(pairs):
        raise ValueError("found a key twice, wanted each key once")
    return body


def _unpack(payload: bytes) -> dict[str, Any]:
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise ValueError(f"payload: found {len(payload)} bytes, wanted at most {MAX_PAYLOAD_BYTES}")
    try:
        body = msgpack.unpackb(
            payload,
            raw=False,
            strict_map_key=True,
            object_pairs_hook=_no_twins,
            max_bin_len=0,
            max_ext_len=0,
            max_array_len=256,
            max_map_len=64,
            max_str_len=4 * MAX_TEXT,
        )
    except (ValueError, TypeError, msgpack.exceptions.UnpackException) as error:
        raise ValueError(f"payload: found {str(error) or type(error).__name__}, wanted one msgpack map") from None
    if not isinstance(body, dict):
        raise ValueError(f"payload: found {_short(body)}, wanted one msgpack map")
    return body


def decode(message_class: type[MessageType], payload: bytes) -> MessageType:
    """The message in `payload`. Raises ValueError, one line that names the field, what was found and what is wanted."""
    body = _unpack(payload)
    version = body.pop("schema_version", None)
    if type(version) is not int or version != SCHEMA_VERSION:
        raise ValueError(f"schema_version: found {_short(version)}, wanted {SCHEMA_VERSION}")
    plan = _plan(message_class)
    values = {}
    for name, spec, read in plan:
        if name not in body:
            raise ValueError(f"{message_class.__name__}.{name}: found nothing, wanted {_wanted(spec)}")
        values[name] = read(body[name])
    if len(body) != len(plan):
        unknown = sorted(set(body) - set(values))
        raise ValueError(f"{message_class.__name__}: found unknown key {_short(unknown[0])}, wanted none")
    arrived = message_class(**values)
    arrived.check()
    return arrived


def columns(message_class: type[Message]) -> dict[str, Spec]:
    """Column name -> Spec of the table that messages of this class make; a vector gives one column per element."""
    flat: dict[str, Spec] = {}
    for name, spec in specs(message_class).items():
        for column in spec.columns or (name,):
            flat[column] = spec
    return flat


_JSON_TYPES = {"float": "number", "integer": "integer", "bool": "boolean", "text": "string"}


def json_schema(message_class: type[Message]) -> str:
    """The class as JSON Schema text: each property with its unit, its words, and the columns of a vector."""
    properties: dict[str, Any] = {"schema_version": {"const": SCHEMA_VERSION}}
    for name, spec in specs(message_class).items():
        item: dict[str, Any] = {"type": _JSON_TYPES[spec.kind]}
        if spec.minimum is not None and spec.kind == "float":
            item["minimum"] = spec.minimum
        if spec.maximum is not None and spec.kind == "float":
            item["maximum"] = spec.maximum
        if spec.choices:
            item["enum"] = list(spec.choices)
        if spec.columns:
            item = {
                "type": "array",
                "items": item,
                "minItems": len(spec.columns),
                "maxItems": len(spec.columns),
                "columns": list(spec.columns),
            }
        if spec.optional:
            item["type"] = [item["type"], "null"]
        properties[name] = {**item, "unit": spec.unit, "description": spec.doc}
    return json.dumps(
        {
            "$schema": "https://json-schema.org/draft/2020-12/schema",
            "title": message_class.__name__,
            "description": (message_class.__doc__ or "").strip(),
            "type": "object",
            "properties": properties,
            "required": list(properties),
            "additionalProperties": False,
        }
    )
