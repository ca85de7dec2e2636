"""How a record of the tick is declared: each field once, with its type, unit and one line of meaning.

A declared class is four things: the type that compiled kernels are checked against, the numpy dtype (`dtype_of`), the
rows of the table in docs/records.md (`as_markdown`), and the part of a message that it carries (`carried`).
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from operator import itemgetter
from typing import Any, NamedTuple, Protocol, overload

import numpy as np

from protocol.messages import Message, specs


class Floats(Protocol):
    """A vector of floats, as kernels use it: an array, or a field of a record."""

    def __getitem__(self, index: int, /) -> float: ...

    def __setitem__(self, index: int, value: float, /) -> None: ...


class ReadFloats(Protocol):
    """A vector of floats that is only read: an array, a field of a record, or a tuple."""

    def __getitem__(self, index: int, /) -> float: ...


class Ints(Protocol):
    """A vector of integers, as kernels use it: an array, or a field of a record."""

    def __getitem__(self, index: int, /) -> int: ...

    def __setitem__(self, index: int, value: int, /) -> None: ...


class Matrix(Protocol):
    """A table of floats; one index gives a row."""

    @overload
    def __getitem__(self, index: int, /) -> Floats: ...

    @overload
    def __getitem__(self, index: tuple[int, int], /) -> float: ...

    def __setitem__(self, index: tuple[int, int], value: float, /) -> None: ...


class Tensor(Protocol):
    """A table of three indices; one index gives a matrix."""

    @overload
    def __getitem__(self, index: int, /) -> Matrix: ...

    @overload
    def __getitem__(self, index: tuple[int, int, int], /) -> float: ...

    def __setitem__(self, index: tuple[int, int, int], value: float, /) -> None: ...


Joint = tuple[float, float, float]  # insertion (m), roll (rad), knob (rad)
Point = tuple[float, float, float]  # m


class RecordField(NamedTuple):
    """One field: "f8", "i8" or the class of a nested record; unit; meaning; shape, () for a scalar.

    message: class and field of the message that carries the value; None if none does.
    """

    kind: Any
    unit: str
    doc: str
    shape: tuple[int, ...] = ()
    message: tuple[type[Message], str] | None = None


def real(unit: str, doc: str, *shape: int) -> Any:
    """Declare a float of 64 bits, or an array of them."""
    return RecordField("f8", unit, doc, shape)


def whole(unit: str, doc: str, *shape: int) -> Any:
    """Declare an integer of 64 bits, or an array of them."""
    return RecordField("i8", unit, doc, shape)


def carried_by(message: type[Message], name: str) -> Any:
    """Declare a field whose value a message carries in its field `name`: kind, size, unit and meaning are declared there."""
    spec = specs(message)[name]
    shape = (len(spec.columns),) if spec.columns else ()
    return RecordField({"float": "f8", "integer": "i8"}[spec.kind], spec.unit, spec.doc, shape, (message, name))


def part(record: type, doc: str) -> Any:
    """Declare a field that is a record of its own."""
    return RecordField(record, "", doc)


def fields_of(record: type) -> dict[str, RecordField]:
    """Return the fields of a declared class by name, in the order of declaration."""
    return {name: field for name, field in vars(record).items() if isinstance(field, RecordField)}


@cache
def _carried_fields(record: type, message: type[Message]) -> tuple[tuple[str, str], ...]:
    return tuple(
        (name, field.message[1])
        for name, field in fields_of(record).items()
        if field.message is not None and field.message[0] is message
    )


def carried(message: type[Message], record: type, values: np.record) -> dict[str, Any]:
    """Return the fields of `message` that a declared class carries, as plain Python values.

    Arguments: record, the declared class; values, one record of it.
    """
    plain = ((name, values[field].tolist()) for field, name in _carried_fields(record, message))
    return {name: tuple(value) if isinstance(value, list) else value for name, value in plain}


class Record(np.record):  # type: ignore[misc]
    """One record whose fields are attributes; `dtype_of` makes a subclass with a property for each field.

    np.record looks every attribute up in Python, which takes five times as long. The loop reads some sixty a period.
    """

    __getattribute__ = np.void.__getattribute__  # type: ignore[assignment]
    __setattr__ = np.void.__setattr__  # type: ignore[assignment]
    __getitem__ = np.void.__getitem__  # type: ignore[assignment]


def _field(name: str, dtype: np.dtype[Any]) -> property:
    def put(record: Record, value: Any) -> None:
        record[name] = value

    if dtype.names is None:
        return property(itemgetter(name), put)
    # Numpy gives a nested record the class of the outer one; `view` gives it its own.
    return property(lambda record: record[name].view(dtype), put)


def dtype_of(record: type) -> np.dtype[np.void]:
    """Return the numpy dtype of a declared class, aligned as a C compiler would. Its scalars are of a class `Record`."""
    columns = [
        (name, field.kind if isinstance(field.kind, str) else dtype_of(field.kind), field.shape)
        for name, field in fields_of(record).items()
    ]
    layout = np.dtype(columns, align=True)
    fields = {name: _field(name, layout[name]) for name in layout.names or ()}
    return np.dtype((type(record.__name__, (Record,), fields), layout))


def _nested(record: type) -> Iterator[type]:
    yield record
    for field in fields_of(record).values():
        if not isinstance(field.kind, str):
            yield from _nested(field.kind)


def as_markdown(*records: type) -> str:
    """Return a table for each of `records` and those nested in them, each once."""
    lines = []
    for record in dict.fromkeys(inner for outer in records for inner in _nested(outer)):
        lines += ["", f"## {record.__name__}", "", (record.__doc__ or "").strip(), ""]
        lines += ["| field | type | unit | meaning |", "|---|---|---|---|"]
        for name, field in fields_of(record).items():
            kind = {"f8": "float", "i8": "integer"}.get(field.kind) if isinstance(field.kind, str) else field.kind.__name__
            size = " x ".join(map(str, field.shape))
            lines.append(f"| `{name}` | {kind}{f' [{size}]' if size else ''} | {field.unit or '-'} | {field.doc} |")
    return "\n".join(lines) + "\n"
