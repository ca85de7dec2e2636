"""Tables of any of the five file kinds, as one dictionary from column name to float array."""

from __future__ import annotations

import io
import os
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from protocol.errors import Description, InputError, reason

Array = npt.NDArray[np.float64]
SUFFIXES = (".csv", ".csv.gz", ".parquet", ".mat", ".npz", ".mcap")


@dataclass(frozen=True)
class Table:
    """One recording as it was given: columns by name, each (n,), and the file that it was read from, if any."""

    name: str
    columns: dict[str, Array]
    path: Path | None = None


def table_of(source: Any, number: int) -> Table | Path:
    """A recording from Python: a path, a dictionary of arrays or a DataFrame. `number`: its place, for its name.

    Raises:
        InputError: anything else, no numeric column, or a column that is not one-dimensional.
    """
    if isinstance(source, str | os.PathLike):
        return Path(source)
    name = f"recording {number + 1}"
    if not isinstance(source, Mapping) and not (hasattr(source, "columns") and hasattr(source, "__getitem__")):
        raise InputError("recordings", type(source).__name__, "paths, dictionaries of arrays or DataFrames")
    columns: dict[str, Array] = {}
    for key in source if isinstance(source, Mapping) else source.columns:
        try:
            array = np.asarray(source[key])
            values = np.array(array, dtype=np.float64) if array.dtype.kind in "fiubO" else None
        except (TypeError, ValueError):
            values = None
        if values is None:  # words, dates: not a signal
            continue
        if values.ndim != 1:
            raise InputError(f"{name}, {key}", f"shape {values.shape}", "one-dimensional arrays (n,)")
        columns[str(key)] = values
    if not columns:
        raise InputError(name, "no numeric column", "at least one numeric column")
    return Table(name, columns)


def is_table(path: Path) -> bool:
    """True if the name of `path` ends like a table this module reads."""
    return path.name.lower().endswith(SUFFIXES)


def read_table(path: Path) -> dict[str, Array]:
    """The columns of the table at `path`, each (n,) float64, NaN where a field is empty.

    Raises:
        InputError: no such file, an unknown kind, or nothing numeric in it.
    """
    if not path.is_file():
        raise InputError("recording", str(path), "a file that exists")
    name = path.name.lower()
    try:
        if name.endswith((".csv", ".csv.gz")):
            columns = _from_arrow(_read_csv(path))
        elif name.endswith(".parquet"):
            import pyarrow.parquet

            columns = _from_arrow(pyarrow.parquet.read_table(path))
        elif name.endswith(".mat"):
            columns = _read_mat(path)
        elif name.endswith(".npz"):
            with np.load(path, allow_pickle=False) as archive:
                columns = _columns({key: archive[key] for key in archive.files})
        elif name.endswith(".mcap"):
            columns = _read_mcap(path)
        else:
            raise InputError("recording", path.name, "a table ending in " + ", ".join(SUFFIXES))
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise InputError("recording", Description(f"{path.name}: {reason(error)}"), "a readable table") from None
    if not columns:
        raise InputError("recording", path.name, "at least one numeric column")
    return columns


def _read_csv(path: Path) -> Any:
    import pyarrow
    import pyarrow.csv

    options = pyarrow.csv.ConvertOptions(null_values=["", "nan", "NaN", "NA", "null"], strings_can_be_null=True)
    try:
        return pyarrow.csv.read_csv(path, convert_options=options)
    except pyarrow.ArrowInvalid as error:
        raise ValueError(str(error)) from None


def _from_arrow(table: Any) -> dict[str, Array]:
    import pyarrow

    columns = {}
    for name, column in zip(table.column_names, table.columns, strict=True):
        if pyarrow.types.is_floating(column.type) or pyarrow.types.is_integer(column.type):
            columns[name.strip()] = column.cast(pyarrow.float64()).to_numpy().astype(np.float64)
        elif pyarrow.types.is_null(column.type):
            columns[name.strip()] = np.full(len(column), np.nan)
    return columns


def _columns(arrays: dict[str, Any]) -> dict[str, Array]:
    """Vectors as columns; a matrix gives one column each, named `key.0`, `key.1`, ..."""
    columns = {}
    for key, value in arrays.items():
        array = np.asarray(value)
        if key.startswith("__") or array.dtype.kind not in "fiub":
            continue
        array = np.squeeze(array).astype(np.float64)
        if array.ndim == 1:
            columns[key] = array
        elif array.ndim == 2:
            rows = array if array.shape[0] >= array.shape[1] else array.T
            for index in range(rows.shape[1]):
                columns[f"{key}.{index}"] = np.ascontiguousarray(rows[:, index])
    return columns


def _read_mat(path: Path) -> dict[str, Array]:
    import scipy.io

    content = scipy.io.loadmat(path, squeeze_me=True, struct_as_record=False)
    flat: dict[str, Any] = {}
    for key, value in content.items():
        fields = getattr(value, "_fieldnames", None)
        if fields:
            flat.update({f"{key}.{field}": getattr(value, field) for field in fields})
        else:
            flat[key] = value
    return _columns(flat)


def _read_mcap(path: Path) -> dict[str, Array]:
    """Every numeric field of every topic on the time line of the topic with most messages; column `topic.field`."""
    import json

    import msgpack
    from mcap.reader import make_reader

    topics: dict[str, list[tuple[float, dict[str, float]]]] = {}
    with path.open("rb") as stream:
        for _, channel, message in make_reader(io.BytesIO(stream.read())).iter_messages():
            is_json = channel.message_encoding == "json"
            body = json.loads(message.data) if is_json else msgpack.unpackb(message.data)
            if isinstance(body, dict):
                stamp = float(body.get("stamp_ns", message.log_time)) * 1e-9
                topics.setdefault(channel.topic, []).append((stamp, _numbers(body)))
    if not topics:
        return {}
    base = max(topics, key=lambda topic: len(topics[topic]))
    grid = np.array(sorted(stamp for stamp, _ in topics[base]))
    columns = {"time_s": grid - grid[0]}
    spacing = np.median(np.diff(grid)) if grid.size > 1 else 1.0
    for topic, rows in topics.items():
        rows.sort(key=lambda row: row[0])
        stamps = np.array([row[0] for row in rows])
        nearest = np.clip(np.round(np.interp(grid, stamps, np.arange(stamps.size))).astype(int), 0, stamps.size - 1)
        close = np.abs(stamps[nearest] - grid) <= 0.5 * spacing + 1e-9
        for field in {key for _, row in rows for key in row}:
            values = np.array([row.get(field, np.nan) for _, row in rows])
            columns[f"{topic}.{field}"] = np.where(close, values[nearest], np.nan)
    return columns


def _numbers(body: dict[str, Any]) -> dict[str, float]:
    flat: dict[str, float] = {}
    for key, value in body.items():
        if isinstance(value, bool | int | float):
            flat[key] = float(value)
        elif isinstance(value, list | tuple) and all(isinstance(item, int | float) for item in value):
            flat.update({f"{key}.{index}": float(item) for index, item in enumerate(value)})
    return flat
