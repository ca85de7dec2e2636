"""Tables of every file kind in SUFFIXES, as one dictionary from column name to float array."""

from __future__ import annotations

import gzip
import io
import os
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from host.recordings.recording import CHUNK_LIMIT_BYTES, unpack_chunk
from protocol.errors import Description, InputError, reason
from protocol.text_files import kind_of

Array = npt.NDArray[np.float64]
SUFFIXES = (".csv", ".csv.gz", ".tsv", ".parquet", ".mat", ".npz", ".mcap")
# A packed table may unpack to so much, or to so many times its own size where that is more.
UNPACKED_LIMIT_BYTES, UNPACKED_PER_PACKED = 256 * 2**20, 64
_BLOCK_BYTES = 2**20
_HEAD_BYTES = 65536
_COMMENTS = ("#", "%", "//")  # that begin a line of comment before the heading
_MAT_COMPRESSED, _MAT_HEAD_BYTES = 15, 128


@dataclass(frozen=True)
class Table:
    """One recording as it was given: columns by name, each (n,), and the file that it was read from, if any.

    unread: columns that hold no real numbers -> what they hold.
    """

    name: str
    columns: dict[str, Array]
    path: Path | None = None
    unread: dict[str, str] = field(default_factory=dict)


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
    unread: dict[str, str] = {}
    signals: dict[Any, Any] = dict(source) if isinstance(source, Mapping) else {key: source[key] for key in source.columns}
    index = None if isinstance(source, Mapping) else getattr(source, "index", None)
    if index is not None and index.name is not None:  # a DataFrame with its time as index
        signals = {index.name: index} | signals
    for key in signals:
        try:
            values = _numbers_of(signals[key])
        except (TypeError, ValueError):
            values = None
        if values is None:  # words: not a signal
            unread[str(key)] = f"an array of type {np.asarray(signals[key]).dtype}"
            continue
        if values.ndim != 1:
            raise InputError(f"{name}, {key}", f"shape {values.shape}", "one-dimensional arrays (n,)")
        columns[str(key)] = values
    if not columns:
        raise InputError(name, "no numeric column", "at least one numeric column")
    return Table(name, columns, unread=unread)


def _numbers_of(given: Any) -> Array | None:
    """Numbers or instants as floats, instants in seconds since 1970; None for anything else."""
    if getattr(getattr(given, "dtype", None), "tz", None) is not None:  # instants of pandas with a time zone
        given = given.to_numpy(dtype="datetime64[ns]")
    array = np.asarray(given)
    if array.dtype.kind == "M":
        return _seconds_of(array)
    return np.array(array, dtype=np.float64) if array.dtype.kind in "fiubO" else None


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
    if name.endswith((".csv", ".csv.gz", ".tsv")):
        return _from_arrow(_read_csv(path, limit))
    if name.endswith(".parquet"):
        return _from_arrow(_read_parquet(path, limit))
    if name.endswith(".mat"):
        return _read_mat(path, limit)
    if name.endswith(".npz"):
        return _read_npz(path, limit)
    return _read_mcap(path, limit)


@dataclass(frozen=True)
class _TextForm:
    """How a text table is written: mark between columns, mark of the fraction, lines of comment before the heading."""

    separator: str
    decimal_point: str
    comment_lines: int


def _read_csv(path: Path, limit: int) -> Any:
    import pyarrow
    import pyarrow.csv

    source: Any = path
    if path.name.lower().endswith(".gz"):
        with gzip.open(path) as stream:
            content = stream.read(limit + 1)
        if len(content) > limit:
            raise _TooLarge
        source, head = pyarrow.BufferReader(content), content[:_HEAD_BYTES]
    else:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    form = _text_form(path.name, head)
    table = pyarrow.csv.read_csv(
        source,
        read_options=pyarrow.csv.ReadOptions(skip_rows=form.comment_lines),
        parse_options=pyarrow.csv.ParseOptions(delimiter=form.separator),
        convert_options=pyarrow.csv.ConvertOptions(
            null_values=["", "nan", "NaN", "NA", "null"], strings_can_be_null=True, decimal_point=form.decimal_point
        ),
    )
    texts = {
        name: column.to_pylist()
        for name, column in zip(table.column_names, table.columns, strict=True)
        if pyarrow.types.is_string(column.type)
    }
    for name, cells in texts.items():
        _refuse_text_among_numbers(path.name, form.comment_lines + 2, name, cells, len(texts) == len(table.column_names))
    return table


def _text_form(file: str, head: bytes) -> _TextForm:
    """Find how the text table with the first bytes `head` is written. Raises InputError for bytes that are not UTF-8 text.

    A comma is the mark of the fraction only where semicolons or tabs separate the columns.
    """
    found = kind_of(head)
    if found:
        wanted = "a text (UTF-8) with commas, semicolons or tabs between the columns"
        raise InputError("recording", Description(f"{file}: {found}"), wanted)
    lines = head.decode("utf-8-sig", errors="replace").splitlines()
    comments = next((number for number, line in enumerate(lines) if not line.startswith(_COMMENTS)), 0)
    heading, body = (lines[comments], lines[comments + 1 :]) if lines else ("", [])
    first = body[0] if body else heading
    separator = next((mark for mark in (";", "\t") if 0 < heading.count(mark) == first.count(mark)), ",")
    comma = separator != "," and any("," in line for line in body) and not any("." in line for line in body)
    return _TextForm(separator, "," if comma else ".", comments)


def _refuse_text_among_numbers(file: str, first_line: int, column: str, cells: list[str | None], all_texts: bool) -> None:
    """Raise InputError for the first text in a column of numbers; a column of texts, such as notes, is left out later.

    first_line: of the first cell in the file. all_texts: no column of the file has numbers alone, as with a row of units.
    """
    texts = [(line, cell) for line, cell in enumerate(cells, start=first_line) if cell is not None and not _is_number(cell)]
    given = sum(cell is not None for cell in cells)
    if texts and len(texts) < 0.5 * given:
        line, cell = texts[0]
        units = "; delete a row of units, and give the units in [channels]" if all_texts and line == first_line else ""
        wanted = f"a number, as in the other {given - len(texts)} cells{units}"
        raise InputError(f"{file}: line {line}: {column}", cell, wanted)


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
        elif pyarrow.types.is_timestamp(column.type):
            columns[name.strip()] = _seconds_of(column.cast(pyarrow.timestamp("ns")).to_numpy())
        elif pyarrow.types.is_time(column.type):  # of a day
            since_ns = column.cast(pyarrow.time64("ns")).cast(pyarrow.int64()).cast(pyarrow.float64(), safe=False)
            columns[name.strip()] = since_ns.to_numpy().astype(np.float64) * 1e-9
    return columns


def _seconds_of(instants: npt.NDArray[Any]) -> Array:
    """Instants (datetime64) as seconds since 1970, to 0.3 us; NaN where there is none."""
    since_ns = instants.astype("datetime64[ns]").astype(np.int64)
    return np.where(np.isnat(instants), np.nan, since_ns * 1e-9)


def _columns(arrays: dict[str, Any]) -> dict[str, Array]:
    """Vectors as columns; a matrix gives one column each, named `key.0`, `key.1`, ..."""
    columns = {}
    for key, value in arrays.items():
        array = np.asarray(value)
        if key.startswith("__") or array.dtype.kind not in "fiubM":
            continue
        array = _seconds_of(array) if array.dtype.kind == "M" else array
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
        for key in {key for _, row in rows for key in row}:
            values = np.array([row.get(key, np.nan) for _, row in rows])
            columns[f"{topic}.{key}"] = np.where(close, values[nearest], np.nan)
    return columns


def _numbers(body: dict[str, Any]) -> dict[str, float]:
    flat: dict[str, float] = {}
    for key, value in body.items():
        if isinstance(value, bool | int | float):
            flat[key] = float(value)
        elif isinstance(value, list | tuple) and all(isinstance(item, int | float) for item in value):
            flat.update({f"{key}.{index}": float(item) for index, item in enumerate(value)})
    return flat
