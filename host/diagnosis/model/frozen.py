"""A channel that repeats one value while what it reads moves on: a sensor, a bus or a logger that has stopped.

What a frozen channel has and a resting one has not: the value is exactly the same in many samples, although the channel
repeats hardly any value elsewhere, because it has noise in each sample or moves all the time. A mechanism that sticks
under a noisy sensor does not repeat a value. One that sticks without any noise does, but moves on from where it stood.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from host.diagnosis.model.data_rules import DataRules
from host.diagnosis.model.dataset import Recording, parted
from host.diagnosis.model.operators import fill
from host.diagnosis.model.readings import Finding

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
ORDER = 5  # of the differences that a motion hardly leaves: it moves by less than a sixth of its size in a sample
ORDER_POWER = 252.0  # sum of their squared coefficients, which is the variance of those of white noise of unit variance
ROUNDING = 1e-12  # of a channel's range, below which two values are the same but for rounding
SPANS = 3  # that a finding lists
GRID_GAPS = 20  # of neighbouring levels, from which they show whether all are multiples of the smallest,
GRID_RANGE = 1000.0  # times the smallest, up to which they do


@dataclass(frozen=True)
class HeldRun:
    """Samples `first` to `end` (exclusive) of channel `name` that have one value."""

    name: str
    first: int
    end: int
    value: float

    @property
    def samples(self) -> slice:
        """Return the samples of the run."""
        return slice(self.first, self.end)


def held_runs(name: str, values: Array, rules: DataRules) -> list[HeldRun]:
    """Long runs of one value in channel `name` (n,), where it repeats hardly any value outside of them."""
    edges = np.flatnonzero(np.concatenate(([True], np.diff(values) != 0.0, [True])))
    lasts = np.diff(edges)
    long = lasts >= rules.frozen_samples
    inside = int(lasts[long].sum())
    repeats = int((lasts[~long] - 1).sum())
    if not 0 < inside <= rules.frozen_share * values.size or repeats > rules.frozen_repeats * (values.size - inside):
        return []
    firsts, ends = edges[:-1][long], edges[1:][long]
    return [HeldRun(name, int(a), int(b), float(values[a])) for a, b in zip(firsts, ends, strict=True)]


def outside(runs: Sequence[HeldRun], size: int) -> Mask:
    """Samples (size,) in none of the runs."""
    free = np.ones(size, dtype=bool)
    for run in runs:
        free[run.samples] = False
    return free


def has_noise(values: Array, free: Mask, rules: DataRules) -> bool:
    """Whether the samples `free` (n,) of a channel have noise of their own, larger than its resolution.

    High differences of noise change their sign from sample to sample; those of a motion do not.
    """
    bends = np.diff(np.where(free, values, np.nan), ORDER)
    both = np.isfinite(bends[1:]) & np.isfinite(bends[:-1])
    if np.count_nonzero(both) < rules.frozen_samples:
        return False
    alternate = float(np.mean(bends[1:][both] * bends[:-1][both] < 0.0))
    sigma = 1.4826 * float(np.nanmedian(np.abs(bends))) / np.sqrt(ORDER_POWER)
    known = values[free & np.isfinite(values)]
    least = max(_grid(known), rules.frozen_noise * float(np.max(np.abs(known))))
    return alternate > rules.frozen_alternation and sigma > least


def _grid(values: Array) -> float:
    """Step of which all differences of `values` (n,) are multiples; 0 if there is none."""
    levels = np.unique(values)
    gaps = np.diff(levels)
    gaps = gaps[gaps > ROUNDING * float(np.ptp(levels))]
    if gaps.size == 0:
        return 0.0
    step = float(np.min(gaps))
    steps = gaps[gaps < GRID_RANGE * step] / step
    whole = float(np.mean(np.abs(steps - np.round(steps)) < 0.05))
    return step if steps.size >= GRID_GAPS and whole > 0.9 else 0.0


def jumps(values: Array, run: HeldRun, free: Mask, rules: DataRules) -> bool:
    """Whether the channel (n,) enters or leaves the run by far more than it moves in a sample elsewhere."""
    largest = max(_step(values, run.first), _step(values, run.end))
    return largest > rules.frozen_jump_ratio * float(np.quantile(_steps(values, free), 0.9))


def turns_abruptly(values: Array, run: HeldRun, free: Mask, rules: DataRules) -> bool:
    """Whether the channel (n,) moves about as fast as usual next to the run: what rests slows down first."""
    fastest = max(_step(values, run.first - 1), _step(values, run.end + 1))
    return fastest > rules.frozen_stop_ratio * float(np.median(_steps(values, free)))


def is_limit(values: Array, run: HeldRun) -> bool:
    """Whether the value of the run is the largest or smallest one of the channel (n,)."""
    known = values[np.isfinite(values)]
    return run.value in (np.min(known), np.max(known))


def _step(values: Array, place: int) -> float:
    """Magnitude of the change to sample `place`; 0 at either end, or where a sample is missing."""
    inside = 0 < place < values.size
    return float(np.nan_to_num(abs(values[place] - values[place - 1]))) if inside else 0.0


def _steps(values: Array, free: Mask) -> Array:
    steps = np.abs(np.diff(np.where(free, values, np.nan)))
    good = steps[np.isfinite(steps)]
    return good if good.size else np.full(1, np.inf)


def moving(recording: Recording, run: HeldRun, names: Sequence[str], rules: DataRules) -> str:
    """The one of the channels `names` that moves most during the run; empty if none does."""
    shares = {}
    for name in names:
        values = fill(recording.channels[name])
        shares[name] = float(np.ptp(values[run.samples])) / (float(np.ptp(values)) or np.inf)
    most = max(shares, key=lambda name: shares[name], default="")
    return most if most and shares[most] > rules.frozen_driver_share else ""


def frozen_readings(recording: Recording, driven: set[str], rules: DataRules) -> list[tuple[HeldRun, str]]:
    """Runs in which an output is frozen whatever moves it, each with the channel that moves on.

    driven: outputs. Their noise is that of a sensor; an input may be meant to be random, and to rest in between.
    """
    found = []
    for name in sorted(driven & set(recording.channels)):
        values = recording.channels[name]
        runs = held_runs(name, values, rules)
        free = outside(runs, values.size)
        if not runs or not has_noise(values, free, rules):
            continue
        drivers = [other for other in recording.channels if other not in driven]
        for run in runs:
            driver = moving(recording, run, drivers, rules)
            if driver and jumps(values, run, free, rules):
                found.append((run, driver))
    return found


def without_runs(recording: Recording, runs: Sequence[HeldRun], driven: set[str], rules: DataRules) -> list[Recording]:
    """The parts of a recording that are left without the runs. driven: outputs, whose samples are missing there.

    A recording is cut at a frozen input: what moved the outputs there is not known, so neither is the state behind it. It
    is cut where no output is left, too, and it ends with the last output.
    """
    channels = dict(recording.channels)
    known = outside([run for run in runs if run.name not in driven], recording.n)
    for run in (run for run in runs if run.name in driven):
        channels[run.name] = np.where(outside([run], recording.n), channels[run.name], np.nan)
    read = np.any([np.isfinite(channels[name]) for name in driven if name in channels] or [known], axis=0)
    known &= read | outside(runs, recording.n)
    last = int(np.flatnonzero(read).max(initial=-1))
    if recording.n - 1 - last > rules.gap_samples:
        known[last + 1 :] = False
    whole = replace(recording, channels=channels)
    return [whole] if known.all() or not known.any() else parted(whole, known, rules)


def frozen_finding(recording: Recording, runs: Sequence[HeldRun], column: str, unit: str, mover: str) -> Finding:
    """The sentence about the runs of one channel in one recording. mover: column that moves on."""
    ends = ((recording.begin_s + float(recording.time_s[k]) for k in (run.first, run.end - 1)) for run in runs)
    spans = [f"{begin:.4g} to {end:.4g}" for begin, end in ends]
    shown = ", ".join(spans[:SPANS]) + (f" and {len(spans) - SPANS} more spans" if len(spans) > SPANS else "")
    unit = unit if len({run.value for run in runs}) == 1 else f"{unit} first"
    value, timed = f"{runs[0].value:.4g} {unit}".strip(), "s" if recording.timed else "samples"
    says = f"Column {column} repeats one value ({value}) from {shown} {timed} of {recording.name}, "
    says += f"while {mover} moves on: the readings are frozen there. They are left out of the comparison."
    return Finding("frozen", column, says)
