"""Messages: msgspec types over msgpack. Each field declares its unit, its bounds and its meaning once.

A payload is checked while it is decoded: types, bounds, unknown and missing keys. The same declaration makes the JSON
Schema of a recording, the columns of its tables and the pages of the documentation.
"""

from __future__ import annotations

import json
import math
from functools import cache
from typing import Annotated, Any, ClassVar, NamedTuple, TypeVar

import msgspec
from msgspec import Meta
from msgspec import inspect as declared

SCHEMA_VERSION = 1
MAX_PAYLOAD_BYTES = 4096
MAX_TEXT = 500
# Stamps end after 126 years, so that the difference of two fits a signed 64-bit integer.
MAX_STAMP_ns = 4_000_000_000_000_000_000
# Counts stay exact as a JSON number, and the sum of a thousand fits a signed 64-bit integer.
MAX_COUNT = 2**53 - 1

Vector = tuple[float, ...]


def bounds(unit: str, low: float, high: float) -> Meta:
    """Declare unit and bounds of a number. Both bounds are allowed values; NaN and infinity never are."""
    return Meta(ge=low, le=high, extra={"unit": unit})


def doc(text: str) -> Meta:
    """Declare a field with its meaning."""
    return Meta(description=text)


def columns_of(text: str, columns: tuple[str, ...]) -> Meta:
    """Declare a vector with its meaning and the table column of each element."""
    return Meta(description=text, min_length=len(columns), max_length=len(columns), extra={"columns": columns})


def choice(text: str, choices: tuple[str, ...]) -> Meta:
    """Declare a field with its meaning and its allowed words."""
    return Meta(description=text, pattern=f"^(?:{'|'.join(choices)})\\Z", extra={"choices": choices})


Stamp_ns = Annotated[int, bounds("ns", 0, MAX_STAMP_ns)]
Count = Annotated[int, bounds("", 0, MAX_COUNT)]
Text = Annotated[str, Meta(max_length=MAX_TEXT)]


class Message(
    msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="schema_version", tag=SCHEMA_VERSION
):
    """Base of every message. Freshness is judged by `sequence` and `stamp_ns`, never by when something arrived."""

    # Whether a measurement that is not finite or not plausible is sent as nil. A command is sent as given or not at all.
    measured: ClassVar[bool] = True

    stamp_ns: Annotated[Stamp_ns, doc("time to which the content applies, on the rig's clock")]
    sequence: Annotated[Count, doc("number of the message, increases by one for each topic and publisher")] = 0

    def check(self) -> None:
        """Check what must hold between fields.

        Raises:
            ValueError: Two fields contradict each other.
        """


MessageType = TypeVar("MessageType", bound=Message)


class FieldSpec(NamedTuple):
    """What a field is: its kind (float, integer, bool, text), unit, meaning, bounds and the columns that it makes."""

    kind: str
    unit: str
    doc: str
    columns: tuple[str, ...] = ()
    optional: bool = False
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple[str, ...] = ()


_KINDS: dict[type[declared.Type], str] = {
    declared.FloatType: "float",
    declared.IntType: "integer",
    declared.BoolType: "bool",
    declared.StrType: "text",
}


def _spec_of(kind: declared.Type, spec: FieldSpec) -> FieldSpec:
    """Return `spec` completed by what a field's declared type says."""
    if isinstance(kind, declared.Metadata):
        extra = kind.extra or {}
        return _spec_of(
            kind.type,
            spec._replace(
                unit=extra.get("unit", spec.unit),
                columns=extra.get("columns", spec.columns),
                choices=extra.get("choices", spec.choices),
                doc=(kind.extra_json_schema or {}).get("description", spec.doc),
            ),
        )
    if isinstance(kind, declared.UnionType):
        inner = next(item for item in kind.types if not isinstance(item, declared.NoneType))
        return _spec_of(inner, spec._replace(optional=True))
    if isinstance(kind, declared.VarTupleType):
        return _spec_of(kind.item_type, spec)
    low, high = getattr(kind, "ge", None), getattr(kind, "le", None)
    return spec._replace(kind=_KINDS[type(kind)], minimum=low, maximum=high)


@cache
def specs(message_class: type[Message]) -> dict[str, FieldSpec]:
    """Return field name -> FieldSpec, in the order of declaration."""
    info = declared.type_info(message_class)
    assert isinstance(info, declared.StructType)
    return {field.name: _spec_of(field.type, FieldSpec("", "", "")) for field in info.fields}


@cache
def _decoder(message_class: type[MessageType]) -> msgspec.msgpack.Decoder[MessageType]:
    return msgspec.msgpack.Decoder(message_class)


_encoder = msgspec.msgpack.Encoder()
_any_decoder = msgspec.msgpack.Decoder()


def _pairs(payload: bytes) -> int:
    """Return how many pairs the msgpack map that `payload` begins with has, -1 where it begins with something else."""
    first = payload[0] if payload else 0
    if first & 0xF0 == 0x80:
        return first & 0x0F
    return int.from_bytes(payload[1:3], "big") if first == 0xDE else -1


def decode(message_class: type[MessageType], payload: bytes) -> MessageType:
    """Decode and check one message.

    Args:
        message_class: What the topic carries.
        payload: A msgpack map with `schema_version` and every field of the class, at most MAX_PAYLOAD_BYTES long.

    Returns:
        The message.

    Raises:
        ValueError: One line that names the field, what was found and what is wanted.
    """
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise ValueError(f"payload: found {len(payload)} bytes, wanted at most {MAX_PAYLOAD_BYTES}")
    try:
        arrived: MessageType = _decoder(message_class).decode(payload)
    except (ValueError, RecursionError) as error:  # msgspec's errors and UnicodeDecodeError are ValueErrors
        raise ValueError(_explanation(message_class, payload, error)) from None
    # A field with a default would pass when it is missing; every field has to be there, and none twice.
    if _pairs(payload) != len(message_class.__struct_fields__) + 1:
        raise ValueError(_explanation(message_class, payload, None))
    arrived.check()
    return arrived


def encode(message: Message, sequence: int | None = None) -> bytes:
    """Encode a message as a msgpack map with `schema_version`, `stamp_ns`, `sequence` and its fields.

    Numpy values become plain numbers and long texts are cut. In a measurement, an optional number that is not finite or
    out of bounds is sent as nil. What is sent has passed the checks of `decode`.

    Args:
        message: What to send.
        sequence: Takes the place of the message's own number.

    Raises:
        ValueError: A field is not what its class declares.
    """
    body = _plain_body(message)
    if sequence is not None:
        body["sequence"] = sequence
    try:
        payload = _encoder.encode(body)
        arrived = _decoder(type(message)).decode(payload)
    except (TypeError, OverflowError, ValueError) as error:
        if not message.measured or not _drop_implausible(type(message), body):
            raise ValueError(_body_explanation(type(message), body) or str(error)) from None
        payload = _encoder.encode(body)
        arrived = decode(type(message), payload)
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise ValueError(f"payload: found {len(payload)} bytes, wanted at most {MAX_PAYLOAD_BYTES}")
    arrived.check()
    return payload


def body_of(message: Message) -> dict[str, Any]:
    """Return the checked message as a dict of plain Python values, in order of declaration.

    Raises:
        ValueError: A field is not what its class declares.
    """
    body: dict[str, Any] = _any_decoder.decode(encode(message))
    del body["schema_version"]
    return body


def _plain_body(message: Message) -> dict[str, Any]:
    """Return the fields in msgpack's own types: numpy to Python, texts cut, NaN to nil where nil is allowed."""
    body: dict[str, Any] = {"schema_version": SCHEMA_VERSION}
    for name, optional, many in _plan(type(message)):
        value = getattr(message, name)
        kind = type(value)
        if kind is float:
            if optional and not math.isfinite(value):
                value = None
        elif kind is str:
            value = value if len(value) <= MAX_TEXT else value[: MAX_TEXT - 3] + "..."
        elif many and value is not None:
            value = value.ravel().tolist() if hasattr(value, "ravel") else list(map(_plain, value))
            if optional and not all(type(item) is not float or math.isfinite(item) for item in value):
                value = None
        elif hasattr(value, "tolist"):
            value = value.tolist()
            if optional and isinstance(value, float) and not math.isfinite(value):
                value = None
        body[name] = value
    return body


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else value


@cache
def _plan(message_class: type[Message]) -> tuple[tuple[str, bool, bool], ...]:
    """Return (field, whether it may be nil, whether it has several elements), in order of declaration."""
    return tuple((name, spec.optional, bool(spec.columns)) for name, spec in specs(message_class).items())


def _drop_implausible(message_class: type[Message], body: dict[str, Any]) -> bool:
    """Set optional fields that are out of bounds to nil; True where there was one."""
    dropped = False
    for name, spec in specs(message_class).items():
        if spec.optional and body[name] is not None and _fault(message_class, name, body[name]):
            body[name], dropped = None, True
    return dropped


@cache
def _types(message_class: type[Message]) -> dict[str, Any]:
    return {field.name: field.type for field in msgspec.structs.fields(message_class)}


def _fault(message_class: type[Message], name: str, value: Any) -> str:
    """Return the fault of one field, as "found ..., wanted ..."; empty if there is none."""
    try:
        msgspec.convert(value, _types(message_class)[name])
    except (ValueError, TypeError, OverflowError):
        return f"found {_short(value)}, wanted {_wanted(specs(message_class)[name])}"
    return ""


def _body_explanation(message_class: type[Message], body: dict[str, Any]) -> str:
    for name in specs(message_class):
        if name not in body:
            return f"{message_class.__name__}.{name}: found nothing, wanted {_wanted(specs(message_class)[name])}"
        fault = _fault(message_class, name, body[name])
        if fault:
            return f"{message_class.__name__}.{name}: {fault}"
    return ""


def _explanation(message_class: type[Message], payload: bytes, error: Exception | None) -> str:
    """Return the reason why `payload` is refused, in one line."""
    try:
        body = _any_decoder.decode(payload)
    except (ValueError, RecursionError, TypeError) as unreadable:
        return f"payload: found {_short_text(str(unreadable))}, wanted one msgpack map"
    if not isinstance(body, dict):
        return f"payload: found {_short(body)}, wanted one msgpack map"
    if len(body) != _pairs(payload):
        return "payload: found a key twice, wanted each key once"
    version = body.pop("schema_version", None)
    if type(version) is not int or version != SCHEMA_VERSION:
        return f"schema_version: found {_short(version)}, wanted {SCHEMA_VERSION}"
    said = _body_explanation(message_class, body)
    unknown = [key for key in body if key not in specs(message_class)]
    if not said and unknown:
        said = f"{message_class.__name__}: found unknown key {_short(unknown[0])}, wanted none"
    return said or f"{message_class.__name__}: found {_short_text(str(error))}, wanted a message of this class"


def _short(value: Any) -> str:
    return _short_text(repr(value))


def _short_text(text: str) -> str:
    text = " ".join(text.split())
    return text if len(text) <= 60 else text[:57] + "..."


def _wanted(spec: FieldSpec) -> str:
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
    if spec.minimum is not None and spec.maximum is not None:
        what += f" from {spec.minimum:g} to {spec.maximum:g}" + (f" {spec.unit}" if spec.unit else "")
    return what + (", or nil" if spec.optional else "")


def columns(message_class: type[Message]) -> dict[str, FieldSpec]:
    """Return column name -> FieldSpec of the table that messages of this class make; a vector gives several columns."""
    flat: dict[str, FieldSpec] = {}
    for name, spec in specs(message_class).items():
        for column in spec.columns or (name,):
            flat[column] = spec
    return flat


_JSON_TYPES = {"float": "number", "integer": "integer", "bool": "boolean", "text": "string"}


def json_schema(message_class: type[Message]) -> str:
    """Return the class as JSON Schema text: each property with its unit, its meaning, and the columns of a vector."""
    properties: dict[str, Any] = {"schema_version": {"const": SCHEMA_VERSION}}
    for name, spec in specs(message_class).items():
        item: dict[str, Any] = {"type": _JSON_TYPES[spec.kind]}
        if spec.minimum is not None and spec.maximum is not None:
            item |= {"minimum": spec.minimum, "maximum": spec.maximum}
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
