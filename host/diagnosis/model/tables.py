"""Tables of any of the five file kinds, as one dictionary from column name to float array."""

from __future__ import annotations

import gzip
import io
import os
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from host.recordings.recording import CHUNK_LIMIT_BYTES, unpack_chunk
from protocol.errors import Description, InputError, reason
from protocol.text_files import kind_of

Array = npt.NDArray[np.float64]
SUFFIXES = (".csv", ".csv.gz", ".parquet", ".mat", ".npz", ".mcap")
# A packed table may unpack to so much, or to so many times its own size where that is more.
UNPACKED_LIMIT_BYTES, UNPACKED_PER_PACKED = 256 * 2**20, 64
_BLOCK_BYTES = 2**20
_HEAD_BYTES = 4096
_MAT_COMPRESSED, _MAT_HEAD_BYTES = 15, 128


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


class _TooLarge(ValueError):
    """The table unpacks to more than its limit."""


def read_table(path: Path, unpacked_limit_bytes: int | None = None) -> dict[str, Array]:
    """The columns of the table at `path`, each (n,) float64, NaN where a field is empty.

    unpacked_limit_bytes: what a packed file may unpack to; by default UNPACKED_LIMIT_BYTES, or UNPACKED_PER_PACKED times its
    size where that is more. The size is known before anything is kept.

    Raises:
        InputError: no such file, an unknown kind, nothing numeric in it, a damaged file, or one that unpacks to more.
    """
    if not path.is_file():
        raise InputError("recording", str(path), "a file that exists")
    if not is_table(path):
        raise InputError("recording", path.name, "a table ending in " + ", ".join(SUFFIXES))
    limit = unpacked_limit_bytes or max(UNPACKED_LIMIT_BYTES, UNPACKED_PER_PACKED * path.stat().st_size)
    try:
        columns = _read(path, limit)
    except _TooLarge:
        found = Description(f"{path.name}, which unpacks to more than {limit / 2**20:.3g} MiB")
        raise InputError("recording", found, "less; unpack or split the table if it is trusted and that large") from None
    except InputError:
        raise
    # Readers of damaged files raise whatever the damage leads to (RecursionError, SyntaxError, struct.error, ...).
    except Exception as error:
        said = str(reason(error)).partition("\n")[0][:200]
        raise InputError("recording", Description(f"{path.name}: {said}"), "a readable table") from None
    if not columns:
        raise InputError("recording", path.name, "at least one numeric column")
    return columns


def _read(path: Path, limit: int) -> dict[str, Array]:
    name = path.name.lower()
    if name.endswith((".csv", ".csv.gz")):
        return _from_arrow(_read_csv(path, limit))
    if name.endswith(".parquet"):
        return _from_arrow(_read_parquet(path, limit))
    if name.endswith(".mat"):
        return _read_mat(path, limit)
    if name.endswith(".npz"):
        return _read_npz(path, limit)
    return _read_mcap(path, limit)


def _read_csv(path: Path, limit: int) -> Any:
    import pyarrow
    import pyarrow.csv

    options = pyarrow.csv.ConvertOptions(null_values=["", "nan", "NaN", "NA", "null"], strings_can_be_null=True)
    source: Any = path
    if path.name.lower().endswith(".gz"):
        with gzip.open(path) as stream:
            content = stream.read(limit + 1)
        if len(content) > limit:
            raise _TooLarge
        source = pyarrow.BufferReader(content)
    _refuse_other_separators(path, content if path.name.lower().endswith(".gz") else None)
    table = pyarrow.csv.read_csv(source, convert_options=options)
    for name, column in zip(table.column_names, table.columns, strict=True):
        if pyarrow.types.is_string(column.type):
            _refuse_text_among_numbers(path.name, name, column.to_pylist())
    return table


def _refuse_other_separators(path: Path, unpacked: bytes | None) -> None:
    """Raise InputError for a table that is no UTF-8 text, or has semicolons or tabs between its columns."""
    if unpacked is None:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    else:
        head = unpacked[:_HEAD_BYTES]
    found = kind_of(head)
    heading = head.partition(b"\n")[0]
    if not found and b"," not in heading:
        found = {b";": "semicolons between the columns", b"\t": "tabs between the columns"}.get(
            next((mark for mark in (b";", b"\t") if mark in heading), b""), ""
        )
    if found:
        wanted = "a text (UTF-8) with commas between the columns and points in the numbers"
        raise InputError("recording", Description(f"{path.name}: {found}"), wanted)


def _refuse_text_among_numbers(file: str, column: str, cells: list[str | None]) -> None:
    """Raise InputError for the first text in a column of numbers; a column of texts, such as notes, is left out later."""
    texts = [(line, cell) for line, cell in enumerate(cells, start=2) if cell is not None and not _is_number(cell)]
    given = sum(cell is not None for cell in cells)
    if texts and len(texts) < 0.5 * given:
        line, cell = texts[0]
        raise InputError(f"{file}: line {line}: {column}", cell, f"a number, as in the other {given - len(texts)} cells")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _read_parquet(path: Path, limit: int) -> Any:
    import pyarrow.parquet

    with pyarrow.parquet.ParquetFile(path) as file:
        head = file.metadata
        packed = sum(head.row_group(index).total_byte_size for index in range(head.num_row_groups))
        # A column of one repeated value takes no room in the file, and 8 bytes a row here.
        if max(packed, 8 * head.num_rows * head.num_columns) > limit:
            raise _TooLarge
        return file.read()


def _read_npz(path: Path, limit: int) -> dict[str, Array]:
    with zipfile.ZipFile(path) as archive:
        if sum(info.file_size for info in archive.infolist()) > limit:
            raise _TooLarge
        arrays = {}
        for info in archive.infolist():
            with archive.open(info) as stream:
                content = stream.read(limit + 1)
            arrays[info.filename.removesuffix(".npy")] = _array_of(content)
    return _columns(arrays)


def _array_of(content: bytes) -> Any:
    """The array in an .npy file. Raises ValueError where its head announces more than there is: numpy allocates first."""
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    read_head = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read_head(stream)
    size = dtype.itemsize
    for length in shape:
        size *= length
    if dtype.hasobject or not 0 <= size <= len(content):
        raise ValueError("an array with objects, or larger than its file")
    return np.load(io.BytesIO(content), allow_pickle=False)


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


def _read_mat(path: Path, limit: int) -> dict[str, Array]:
    import scipy.io

    packed = path.read_bytes()
    _check_mat(packed, limit)
    content = scipy.io.loadmat(io.BytesIO(packed), squeeze_me=True, struct_as_record=False)
    flat: dict[str, Any] = {}
    for key, value in content.items():
        fields = getattr(value, "_fieldnames", None)
        if fields:
            flat.update({f"{key}.{field}": getattr(value, field) for field in fields})
        else:
            flat[key] = value
    return _columns(flat)


def _check_mat(content: bytes, limit: int) -> None:
    """Unpack the compressed variables of a MATLAB 5 file block by block, and keep none. Raises _TooLarge."""
    if content[_MAT_HEAD_BYTES - 2 : _MAT_HEAD_BYTES] not in (b"IM", b"MI"):
        return
    order: Any = "little" if content[_MAT_HEAD_BYTES - 2 : _MAT_HEAD_BYTES] == b"IM" else "big"
    place, total = _MAT_HEAD_BYTES, 0
    while place + 8 <= len(content):
        kind, length = (int.from_bytes(content[place + at : place + at + 4], order) for at in (0, 4))
        body, place = content[place + 8 : place + 8 + length], place + 8 + length
        if kind == _MAT_COMPRESSED:
            unpacker, waiting = zlib.decompressobj(), body
            while waiting and not unpacker.eof:
                total += len(unpacker.decompress(waiting, _BLOCK_BYTES))
                waiting = unpacker.unconsumed_tail
                if total > limit:
                    raise _TooLarge


def _mcap_messages(path: Path, limit: int) -> Iterator[tuple[Any, Any]]:
    """Channel and message of every message, chunk by chunk; no chunk unpacks to more than it declares."""
    from mcap.records import Channel, Chunk, Message
    from mcap.stream_reader import StreamReader, breakup_chunk

    channels: dict[int, Channel] = {}
    total = 0
    with path.open("rb") as stream:
        for record in StreamReader(stream, emit_chunks=True, record_size_limit=CHUNK_LIMIT_BYTES).records:
            inner: Any = [record]
            if isinstance(record, Chunk):
                total += record.uncompressed_size
                if record.uncompressed_size > CHUNK_LIMIT_BYTES or total > limit:
                    raise _TooLarge
                inner = breakup_chunk(replace(record, compression="", data=unpack_chunk(record)))
            for one in inner:
                if isinstance(one, Channel):
                    channels[one.id] = one
                elif isinstance(one, Message):
                    yield channels[one.channel_id], one


def _read_mcap(path: Path, limit: int) -> dict[str, Array]:
    """Every numeric field of every topic on the time line of the topic with most messages; column `topic.field`."""
    import json

    import msgpack

    topics: dict[str, list[tuple[float, dict[str, float]]]] = {}
    for channel, message in _mcap_messages(path, limit):
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
