"""Recordings: columns become channels in SI units on an even time line, split into parts to fit and parts held out."""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
import numpy.typing as npt

from host.diagnosis.model.data_rules import DataRules
from host.diagnosis.model.nominal import ChannelSpec, NominalSpec
from host.diagnosis.model.rig_recording import rig_rows
from host.diagnosis.model.tables import Table, is_table, read_table
from protocol.errors import InputError

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
# Names of columns that hold times, if their values increase: t, time_s, Time (s), stamp, timestamp_ms, ...
WITHOUT_TIME = ("transmission", "rig")  # kinds whose laws need no rates: their samples may be untimed
TIME = re.compile(r"(t|time|stamp|timestamp|seconds)(?![a-z0-9])", re.IGNORECASE)
BLOCKS_OF_A_LONE_RECORDING = 10
# Of an even grid: points for each row, and points in all, above which its gaps are cut short.
MOST_EMPTY, LARGEST_GRID = 10, 1_000_000


@dataclass(frozen=True)
class Recording:
    """One recording. `channels` maps name to (n,) SI values; `fit` and `heldout` are masks (n,) over samples.

    `time_s` counts from the first sample, or from the first recording where all share a clock; `begin_s` is where that
    is in the file.
    """

    name: str
    time_s: Array
    dt_s: float
    timed: bool
    channels: dict[str, Array]
    fit: Mask
    heldout: Mask
    units: dict[str, str] = field(default_factory=dict)
    begin_s: float = 0.0
    jitter: float = 0.0  # largest deviation of a period from the median one, over it, as recorded
    infinite: tuple[str, ...] = ()  # channels with infinite values as recorded, missing in `channels`

    @property
    def n(self) -> int:
        """Return the number of samples."""
        return int(self.time_s.size)


def find_files(spec: NominalSpec, named: list[str], data_folder: str | None) -> list[Path]:
    """Files named on the command line (folders are opened), or those of the TOML in the data folder. Raises InputError."""
    found: list[Path] = []
    for name in named:
        path = Path(name)
        if path.is_dir():
            patterns = [Path(pattern).name for pattern in spec.data.files] or ["*"]
            inside = sorted(p for p in path.rglob("*") if p.is_file() and is_table(p))
            found += [p for p in inside if any(fnmatch(p.name, pattern) for pattern in patterns)] or inside
        else:
            found.append(path)
    if not named:
        folder = data_folder or os.environ.get("SELDINGER_DATA", "")
        for pattern in spec.data.files:
            found += sorted(Path(folder).glob(pattern)) if folder else []
    if not found:
        wanted = "at least one table (name files, or set SELDINGER_DATA / --data to the folder that holds data.files)"
        raise InputError("recording", named or spec.data.files, wanted)
    return found


def read_tables(spec: NominalSpec, sources: Sequence[Path | Table]) -> list[Table]:
    """Read those of `sources` that are files. Raises InputError."""
    read = rig_rows if spec.recorded_rig else read_table
    tables = [source if isinstance(source, Table) else Table(source.name, read(source), source) for source in sources]
    return [part for table in tables for part in _separated(table, spec.data.by)]


def _separated(table: Table, by: str | None) -> list[Table]:
    """The recordings of one table: a new value of column `by` begins a new one, named after it."""
    if by is None:
        return [table]
    if by not in table.columns:
        raise InputError("data.by", by, f"a column of {table.name}: {', '.join(sorted(table.columns))}")
    key = table.columns[by]
    edges = [0, *(np.flatnonzero(key[1:] != key[:-1]) + 1), key.size]
    return [
        replace(table, name=f"{table.name} {by}={key[a]:g}", columns={name: v[a:b] for name, v in table.columns.items()})
        for a, b in itertools.pairwise(int(edge) for edge in edges)
    ]


def load(
    spec: NominalSpec, tables: list[Table], needed: dict[str, ChannelSpec], optional: set[str], rules: DataRules
) -> list[Recording]:
    """Recordings of `tables`; `needed`: the channels of the model; those in `optional` may be absent. Raises InputError."""
    segments: list[Recording] = []
    wholes = [_one(spec, table, needed, optional, rules) for table in tables]
    shared = one_clock(wholes)
    first = min(whole.time_s[0] for whole in wholes)
    for whole in wholes:
        begin = float(first if shared else whole.time_s[0])
        whole = replace(whole, time_s=whole.time_s - begin, begin_s=begin)
        cuts = [segment for segment in spec.data.segments if fnmatch(whole.name, segment.file)]
        segments += [
            _cut(whole, segment.name, segment.rows[0], segment.rows[1], lead=spec.data.lead_rows) for segment in cuts
        ] or [whole]
    parts = [part for segment in segments for part in _at_gaps(segment, rules)]
    return _split(named_apart(parts), spec.data.heldout)


def _at_gaps(segment: Recording, rules: DataRules) -> list[Recording]:
    """The recording, cut where nothing was recorded for more than `gap_samples`.

    What went in there is not known, so neither is the state behind it: each part is simulated from a state of its own.
    Time runs on. Parts of fewer than `least_rows` are left out, unless there is no other.
    """
    seen = np.any([np.isfinite(values) for values in segment.channels.values()], axis=0)
    between = np.diff(np.flatnonzero(seen))
    return parted(segment, seen, rules) if np.any(between > rules.gap_samples) else [segment]


def parted(segment: Recording, known: Mask, rules: DataRules) -> list[Recording]:
    """The recording between its first and last `known` (n,) sample, cut where more than `gap_samples` are not known."""
    rows = np.flatnonzero(known)
    ends = np.flatnonzero(np.diff(rows) > rules.gap_samples)
    firsts, lasts = [rows[0], *rows[ends + 1]], [*rows[ends], rows[-1]]
    parts = []
    for first, last in zip(firsts, lasts, strict=True):
        part = slice(int(first), int(last) + 1)
        used = segment.fit[part].any() or not segment.fit.any()
        if last + 1 - first >= rules.least_rows and used:
            channels = {name: values[part] for name, values in segment.channels.items()}
            fit, heldout = segment.fit[part], segment.heldout[part]
            parts.append(replace(segment, time_s=segment.time_s[part], channels=channels, fit=fit, heldout=heldout))
    return parts or [segment]


def named_apart(segments: list[Recording]) -> list[Recording]:
    """Recordings of one name get a number: two stay two."""
    taken: set[str] = set()
    out = []
    for segment in segments:
        names = (segment.name if k == 1 else f"{segment.name} ({k})" for k in itertools.count(1))
        name = next(name for name in names if name not in taken)
        taken.add(name)
        out.append(segment if name == segment.name else replace(segment, name=name))
    return out


def one_clock(recordings: list[Recording]) -> bool:
    """Whether the recordings lie one after the other on one clock, so that phases and drifts run on through all."""
    spans = sorted((r.time_s[0], r.time_s[-1]) for r in recordings)
    return len(spans) > 1 and all(a[1] < b[0] for a, b in itertools.pairwise(spans))


def _one(spec: NominalSpec, table: Table, needed: dict[str, ChannelSpec], optional: set[str], rules: DataRules) -> Recording:
    name, columns = table.name, table.columns
    channels = {}
    for key, channel in needed.items():
        if channel.column in columns:
            channels[key] = channel.sign * channel.scale * columns[channel.column] + channel.offset
        elif channel.column in table.unread:
            found = f"column {channel.column} of {name} with {table.unread[channel.column]}"
            raise InputError(f"channels.{key}.column", found, "real numbers")
        elif key not in optional:
            raise InputError(f"channels.{key}.column", channel.column, f"a column of {name}: {', '.join(sorted(columns))}")
    n = max(values.size for values in channels.values())
    short = [key for key, values in channels.items() if values.size != n]
    if short:
        raise InputError(f"channels.{short[0]}", f"{channels[short[0]].size} rows in {name}", f"{n} rows")
    if n < rules.least_rows:
        raise InputError("recording", f"{n} rows in {name}", f"at least {rules.least_rows} rows")
    infinite = tuple(key for key, values in channels.items() if np.isinf(values).any())
    channels = {key: np.where(np.isfinite(values), values, np.nan) for key, values in channels.items()}
    time_s, timed = _time_line(spec, table, n)
    dt_s = float(np.median(np.diff(time_s)))
    if dt_s <= 0.0:
        raise InputError("data.time", f"more than half of the stamps of {name} repeat", "seconds that increase")
    jitter = float(np.max(np.abs(np.diff(time_s) - dt_s))) / dt_s
    if timed and jitter > rules.uneven_period_share:
        time_s, channels = _even(time_s, dt_s, channels, spec.held_inputs, rules.gap_samples)
    nothing = np.zeros(time_s.size, dtype=bool)
    units = {key: channel.unit for key, channel in needed.items()}
    return Recording(name, time_s, dt_s, timed, channels, nothing, nothing, units, jitter=jitter, infinite=infinite)


def _time_line(spec: NominalSpec, table: Table, n: int) -> tuple[Array, bool]:
    name, columns = table.name, table.columns
    if spec.data.time is not None:
        if spec.data.time not in columns:
            raise InputError(
                "data.time", spec.data.time, f"a column of {name} with numbers or dates: {', '.join(sorted(columns))}"
            )
        time_s = columns[spec.data.time] * spec.data.time_scale
        if not np.all(np.isfinite(time_s)) or np.any(np.diff(time_s) < 0) or time_s[-1] <= time_s[0]:
            raise InputError("data.time", f"{spec.data.time} of {name} not increasing", "seconds that increase")
        return time_s, True
    if spec.data.rate_Hz is not None:
        return np.arange(n) / spec.data.rate_Hz, True
    channels = {channel.column for channel in spec.channels.values()}
    for column, values in columns.items() if spec.kind not in WITHOUT_TIME else ():
        if column not in channels and TIME.match(column) and values.size == n > 1 and bool(np.all(np.diff(values) > 0.0)):
            found = f"nothing, although column {column} of {name} seems to hold times"
            raise InputError("data.time", found, f'the column with seconds or dates, as time = "{column}", or rate_Hz')
    return np.arange(n, dtype=np.float64), False


def _grid(time_s: Array, dt_s: float, gap_samples: int) -> Array:
    """Even grid over the stamps. Where gaps are most of it, as between two days in one file, they are cut short."""
    if (time_s[-1] - time_s[0]) / dt_s <= max(MOST_EMPTY * time_s.size, LARGEST_GRID):
        return np.asarray(np.arange(time_s[0], time_s[-1] + 0.5 * dt_s, dt_s))
    empty = dt_s * np.arange(-gap_samples - 1, 0)  # enough for the recording to be divided there
    ends = np.flatnonzero(np.diff(time_s) > 2.0 * (gap_samples + 2) * dt_s)
    parts = []
    for first, last in zip([0, *(ends + 1)], [*ends, time_s.size - 1], strict=True):
        parts += [time_s[first] + empty] if first else []
        parts.append(np.arange(time_s[first], time_s[last] + 0.5 * dt_s, dt_s))
    return np.concatenate(parts)


def _even(
    time_s: Array, dt_s: float, channels: dict[str, Array], held: tuple[str, ...], gap_samples: int
) -> tuple[Array, dict[str, Array]]:
    """Even grid; a grid point further than one and a half periods from any sample stays missing.

    held: channels that keep their value from each stamp to the next. Their grid has the mean over each period, so that what
    integrates them goes as far as it went; a line between two samples would begin a step before its stamp.
    """
    grid = _grid(time_s, dt_s, gap_samples)
    after = np.clip(np.searchsorted(time_s, grid), 1, time_s.size - 1)
    hole = (time_s[after] - time_s[after - 1]) > 3.0 * dt_s
    even = {}
    for key, values in channels.items():
        good = np.isfinite(values)
        if np.count_nonzero(good) < 2:
            even[key] = np.full(grid.size, np.nan)
            continue
        on_grid = _mean_of_held if key in held else np.interp
        line = on_grid(grid, time_s[good], values[good])
        missing = np.interp(grid, time_s, (~good).astype(float)) > 0.49
        even[key] = np.where(missing | hole, np.nan, line)
    return grid, even


def _mean_of_held(grid: Array, time_s: Array, values: Array) -> Array:
    """Mean over the period after each point of `grid` (n,) of a signal that keeps each value until the next stamp."""
    ends = np.append(grid[1:], 2.0 * grid[-1] - grid[-2])
    stamps = np.concatenate(([min(time_s[0], grid[0])], time_s[1:], [max(time_s[-1], ends[-1]) + 1.0]))
    sums = np.concatenate(([0.0], np.cumsum(values * np.diff(stamps))))
    return np.asarray((np.interp(ends, stamps, sums) - np.interp(grid, stamps, sums)) / (ends - grid))


def _cut(whole: Recording, name: str, first: int, last: int, lead: int) -> Recording:
    if not 0 <= first < last <= whole.n:
        raise InputError("data.segments.rows", [first, last], f"0 <= first < last <= {whole.n}")
    start = max(0, first - lead)
    part = slice(start, last)
    use = np.arange(start, last) >= first
    channels = {key: values[part] for key, values in whole.channels.items()}
    return replace(
        whole,
        name=name,
        time_s=whole.time_s[part] - whole.time_s[start],
        channels=channels,
        fit=use,
        heldout=use,
        begin_s=whole.begin_s + float(whole.time_s[start]),
    )


def _split(segments: list[Recording], patterns: list[str] | None) -> list[Recording]:
    used = [p.fit if p.fit.any() else np.ones(p.n, dtype=bool) for p in segments]
    if patterns is not None:
        # a recording that was cut at a gap, or that shares its name with another, has a number behind its name
        names = [re.sub(r" \(\d+\)$", "", p.name) for p in segments]
        out = [
            any(fnmatch(name, pattern) for pattern in patterns for name in pair)
            for pair in zip(names, (p.name for p in segments), strict=True)
        ]
        if len(segments) > 1 and (all(out) or not any(out)):
            raise InputError(
                "data.heldout",
                patterns,
                "patterns that match some recordings, not all: " + ", ".join(p.name for p in segments),
            )
        if len(segments) == 1:
            patterns = None
    if patterns is None and len(segments) >= 3:
        places = np.argsort(np.argsort([_excitation(p, segments) for p in segments], kind="stable"), kind="stable")
        out = [int(place) % 3 == 1 for place in places]
    elif patterns is None:
        return [replace(p, fit=u & ~b, heldout=u & b) for p, u in zip(segments, used, strict=True) for b in [_blocks(p.n)]]
    nothing = [np.zeros(p.n, dtype=bool) for p in segments]
    return [
        replace(p, fit=z if o else u, heldout=u if o else z) for p, u, z, o in zip(segments, used, nothing, out, strict=True)
    ]


def _excitation(recording: Recording, beside: list[Recording]) -> float:
    """How much the channels of a recording move: their deviations over the median one of all recordings, on average.

    The recordings in between are held out: what only the strongest show has to be fitted, and can be seen in the next.
    """
    shares = []
    for name in recording.channels:
        spread = [float(np.nanstd(r.channels[name])) for r in beside if name in r.channels and _measured(r, name)]
        typical = float(np.median(spread)) if spread else 0.0
        if typical > 0.0 and _measured(recording, name):
            shares.append(float(np.nanstd(recording.channels[name])) / typical)
    return round(float(np.mean(shares)), 2) if shares else 0.0


def _measured(recording: Recording, name: str) -> bool:
    return bool(np.isfinite(recording.channels[name]).any())


def _blocks(n: int) -> Mask:
    """Alternate blocks: the held-out ones of a lone recording."""
    return (np.arange(n) * BLOCKS_OF_A_LONE_RECORDING // n) % 2 == 1


def thin(recording: Recording, factor: int) -> Recording:
    """`recording` with `factor` samples averaged into one; missing samples are left out of the average."""
    if factor <= 1:
        return recording
    n = recording.n // factor

    def average(values: Array) -> Array:
        blocks = values[: n * factor].reshape(n, factor)
        good = np.isfinite(blocks)
        count = good.sum(axis=1)
        total = np.where(good, blocks, 0.0).sum(axis=1)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    def every(mask: Mask) -> Mask:
        return np.asarray(mask[: n * factor].reshape(n, factor).all(axis=1))

    return replace(
        recording,
        time_s=average(recording.time_s),
        dt_s=recording.dt_s * factor,
        channels={key: average(values) for key, values in recording.channels.items()},
        fit=every(recording.fit),
        heldout=every(recording.heldout),
    )
