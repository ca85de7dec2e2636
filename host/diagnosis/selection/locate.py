"""Where and when: windows of the mismatch, and the condition that gathers most of it, under false-discovery control."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from host.diagnosis.estimation.fit import Fit, Problem
from host.diagnosis.estimation.rules import SelectionRules
from host.diagnosis.model.model import Segment
from host.diagnosis.model.operators import fill, since_reversal
from host.diagnosis.selection.found import Found
from host.diagnosis.selection.full_rate import FullRate, rms
from host.diagnosis.selection.screening import without

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
AVERAGE_S = 0.5  # that a moving RMS is taken over
SHIFTS = 60  # circular ones, by which a condition is compared with chance


@dataclass(frozen=True)
class Condition:
    """When a mismatch is large, in words, and the p-value by circular shifts."""

    says: str
    p_value: float


def moving_rms(values: Array, dt_s: float) -> Array:
    """RMS of `values` (n,) over half a second around each sample."""
    width = max(3, min(round(AVERAGE_S / dt_s), values.size - 2) | 1)  # some recordings are shorter than the average
    power = np.convolve(np.where(np.isfinite(values), values, 0.0) ** 2, np.ones(width), mode="same")
    count = np.convolve(np.isfinite(values).astype(float), np.ones(width), mode="same")
    return np.sqrt(power / np.maximum(count, 1.0))


def windows(
    mismatch: Array, time_s: Array, dt_s: float, rules: SelectionRules, level: float | None = None
) -> list[tuple[float, float]]:
    """Return the time spans in which the moving RMS of `mismatch` exceeds half of its own 95th percentile (or `level`);
    short gaps are closed, short spans dropped.
    """
    size = moving_rms(fill(mismatch), dt_s)
    high = size > (rules.window_level * np.quantile(size, rules.window_quantile) if level is None else level)
    edges = np.flatnonzero(np.diff(np.concatenate(([0], high.astype(np.int8), [0]))))
    spans = [[time_s[a], time_s[b - 1]] for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return joined([(float(a), float(b)) for a, b in spans], rules)


def joined(spans: list[tuple[float, float]], rules: SelectionRules) -> list[tuple[float, float]]:
    """Windows in order, those nearer than half a second made one, those shorter than 0.3 s dropped."""
    out: list[list[float]] = []
    for a, b in sorted(spans):
        if out and a - out[-1][1] < rules.window_gap_s:
            out[-1][1] = max(out[-1][1], b)
        else:
            out.append([a, b])
    return [(a, b) for a, b in out if b - a >= rules.window_shortest_s]


def inside(spans: list[tuple[float, float]], time_s: Array) -> Mask:
    """Return the mask (n,) of the samples within `spans`."""
    mask = np.zeros(time_s.size, dtype=bool)
    for a, b in spans:
        mask |= (time_s >= a) & (time_s <= b)
    return mask


def mismatch_of(nominal: Fit, best: Fit) -> list[Array]:
    """Return extended minus refitted nominal model per segment (outputs, n); the nominal residual without effects."""
    if not best.terms:
        return nominal.residuals
    return [n - b for n, b in zip(nominal.residuals, best.residuals, strict=True)]


def features(problem: Problem, segment: Segment) -> dict[str, Array]:
    """Signals a condition may speak of, by words; every one (n,)."""
    found: dict[str, Array] = {}
    dt = segment.recording.dt_s
    for name, key, _ in problem.model.travel:
        values = fill(segment.inputs[key])
        span = float(np.ptp(values)) or 1.0
        found[f"distance from reversals of {name}"] = since_reversal(values, 0.01 * span)
        found[f"size of {name}"] = np.abs(values)
        found[f"place of {name}"] = values
        if segment.recording.timed:
            width = max(3, min(round(0.05 / dt), values.size - 2) | 1)
            found[f"speed of {name}"] = np.abs(np.gradient(np.convolve(values, np.ones(width) / width, mode="same"), dt))
    if segment.recording.timed:
        found["time"] = segment.recording.time_s
    return found


def condition(problem: Problem, mismatch: list[Array], row: int, stride: int = 1) -> Condition | None:
    """The condition under which the mismatch of output `row` gathers most, beyond its share of samples; None if none is
    sure.

    `stride`: every so many samples are looked at.
    """
    energy, tables, rules = [], [], problem.rules
    for segment, m in zip(problem.segments, mismatch, strict=True):
        energy.append(np.where(np.isfinite(m[row]), m[row], 0.0)[::stride] ** 2)
        tables.append({name: values[::stride] for name, values in features(problem, segment).items()})
    together = np.concatenate(energy)
    total = float(together.sum())
    if total <= 0.0:
        return None
    rng = np.random.default_rng(0)
    shifts = rng.integers(together.size // 10, together.size - together.size // 10, SHIFTS)
    found: list[tuple[float, Condition]] = []
    for name in tables[0]:
        values = np.concatenate([table[name] for table in tables])
        for share in (0.15, 0.3, 0.5):
            for side in ("below", "above"):
                limit = float(np.quantile(values, share if side == "below" else 1.0 - share))
                mask = values <= limit if side == "below" else values >= limit
                held = float(together[mask].sum()) / total
                part = float(mask.mean())
                usual = rules.condition_fewest_share < part < rules.condition_most_share
                if held - part < rules.condition_excess or not usual:
                    continue
                by_chance = np.array([float(np.roll(together, s)[mask].sum()) / total for s in shifts])
                z = (held - by_chance.mean()) / (by_chance.std() + 1e-12)
                p = max(float(np.mean(by_chance >= held)), float(np.exp(-0.5 * z * z)) if z > 0 else 1.0)
                found.append((held - part, Condition(_words(name, side, limit, problem), p)))
    return _discover(found, rules.condition_false_discovery)


def _discover(found: list[tuple[float, Condition]], rate: float) -> Condition | None:
    """Largest excess among those that pass Benjamini and Hochberg's bound."""
    if not found:
        return None
    order = sorted(found, key=lambda item: item[1].p_value)
    passed = [k for k, (_, c) in enumerate(order) if c.p_value <= rate * (k + 1) / len(order)]
    if not passed:
        return None
    return max(order[: passed[-1] + 1], key=lambda item: item[0])[1]


def _words(name: str, side: str, limit: float, problem: Problem) -> str:
    unit = next((unit for channel, _, unit in problem.model.travel if name.endswith(f" of {channel}")), "")
    if name == "time":
        return f"{'before' if side == 'below' else 'after'} {limit:.3g} s"
    kind, channel = name.split(" of ", 1)
    if kind == "distance from reversals":
        where = "within" if side == "below" else "further than"
        return f"{where} {limit:.3g} {unit} {'of' if side == 'below' else 'from'} {channel} reversals"
    unit = f"{unit}/s" if kind == "speed" else unit
    return f"{kind} of {channel} {side} {limit:.3g} {unit}".rstrip()


@dataclass
class Location:
    """One subsystem with a mismatch: where and when."""

    subsystem: str
    channels: list[str]
    windows_s: dict[str, list[tuple[float, float]]]  # of every recording, in its file's own time
    condition: Condition | None
    residual_share: float


def locate(full: Problem, found: Found, fits: FullRate) -> list[Location]:
    """Where, when and under which condition the effects that were found act, one location for each subsystem."""
    out: list[Location] = []
    for subsystem in dict.fromkeys(term.candidate.port.subsystem for term in found.best.terms):
        alone = _contribution(full, found, fits, subsystem)
        rows = _rows_touched(full, alone)
        if not rows:
            continue
        top = max(rows, key=lambda row: _weight(full, alone, row))
        least = full.rules.window_output_share * _weight(full, alone, top)
        strong = [row for row in rows if _weight(full, alone, row) >= least]
        spans = [
            joined([span for row in strong for span in _windows_of(segment, m[row], full.rules)], full.rules)
            for segment, m in zip(full.segments, alone, strict=True)
        ]
        share = _share(full, fits, spans, top)
        where = condition(full, alone, top, max(1, sum(p.n for p in full.segments) // 20000))
        out.append(
            Location(subsystem, [full.model.outputs[row].channel for row in rows], _by_recording(full, spans), where, share)
        )
    return out


def unexplained(full: Problem, fits: FullRate, subsystem: str) -> Location:
    """Where the refitted nominal model fails, if no effect explains it."""
    residuals, rules = fits.nominal.residuals, full.rules
    rows = _rows_touched(full, residuals)
    top = max(rows, key=lambda row: _weight(full, residuals, row))
    spans = [
        windows(r[top], p.recording.time_s, p.recording.dt_s, rules, rules.window_over_noise * full.noise[top].sigma)
        for p, r in zip(full.segments, residuals, strict=True)
    ]
    spans_s = _by_recording(full, spans)
    where = condition(full, residuals, top, max(1, sum(p.n for p in full.segments) // 20000))
    return Location(
        subsystem, [full.model.outputs[row].channel for row in rows], spans_s, where, _share(full, fits, spans, top)
    )


def _contribution(full: Problem, found: Found, fits: FullRate, subsystem: str) -> list[Array]:
    """What the effects at `subsystem` add: best model against the best model with them at rest, nominal part refitted
    for neither.
    """
    if len({term.candidate.port.subsystem for term in found.best.terms}) == 1:
        return mismatch_of(fits.nominal, fits.best)
    here = tuple(term.candidate.key for term in found.best.terms if term.candidate.port.subsystem == subsystem)
    terms, values = without(found.best, full, here)
    out = []
    for segment, r in zip(full.segments, fits.best.residuals, strict=True):
        change = (segment.y - r) - full.simulate(segment, terms, values)
        out.append(change - np.nanmean(change, axis=1, keepdims=True))
    return out


def _rows_touched(full: Problem, change: list[Array]) -> list[int]:
    """Outputs in which the change is at least a third of the largest, in units of noise."""
    weights = [_weight(full, change, row) for row in range(len(full.noise))]
    least = max(weights) / full.rules.located_output_ratio
    return [row for row, weight in enumerate(weights) if weight >= least and weight > 0.0]


def _weight(full: Problem, change: list[Array], row: int) -> float:
    return (
        rms([c[row] for c in change]) / max(full.noise[row].sigma, 1e-300)
        if any(np.isfinite(c[row]).any() for c in change)
        else 0.0
    )


def _by_recording(full: Problem, spans: list[list[tuple[float, float]]]) -> dict[str, list[tuple[float, float]]]:
    """Windows of every recording by its name, in the time of its file."""
    begins = [segment.recording.begin_s for segment in full.segments]
    return {
        segment.recording.name: [(a + begin, b + begin) for a, b in each]
        for segment, each, begin in zip(full.segments, spans, begins, strict=True)
    }


def _windows_of(segment: Segment, change: Array, rules: SelectionRules) -> list[tuple[float, float]]:
    return windows(change, segment.recording.time_s, segment.recording.dt_s, rules)


def _share(full: Problem, fits: FullRate, spans: list[list[tuple[float, float]]], row: int) -> float:
    """Part of the nominal model's residual energy above noise that falls into the windows."""
    held = total = 0.0
    for segment, r, span in zip(full.segments, fits.nominal.residuals, spans, strict=True):
        good = np.isfinite(r[row])
        above = np.where(good, r[row] ** 2 - full.noise[row].sigma ** 2, 0.0)
        total += float(above.sum())
        held += float(above[inside(span, segment.recording.time_s)].sum())
    return float(np.clip(held / total, 0.0, 1.0)) if total > 0.0 else 0.0
