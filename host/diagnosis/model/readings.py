"""One channel by itself: samples that stand alone, codes for a lost reading, coarse steps, raw counts."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import comb

import numpy as np
import numpy.typing as npt

from host.diagnosis.model.data_rules import DataRules
from host.diagnosis.model.dataset import Recording
from host.diagnosis.model.operators import constant_speed, fill, quantum

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Places = npt.NDArray[np.int64]
MECHANICAL = ("rad", "m", "m/s", "m/s2", "N", "N m")  # units of motions and forces, which are not whole numbers


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong with the data. `id`: sign, unit, alias, constant, missing, clock, excitation, swapped,
    saturated, outliers, frozen, quantized, repeated, session, hold or jump; `channel`: the column's name in the recordings.
    """

    id: str
    channel: str
    says: str


def wild(values: Array, sigma: float, rules: DataRules) -> Mask:
    """Samples of `values` (n,) that stand alone, far from the median of the seven about them. sigma: noise.

    Two of seven may stand alone; three, where outliers are so frequent that three fall together by chance.
    """
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(fill(values), 3, mode="reflect"), 7)
    middle = np.median(windows, axis=1)
    sizes = np.sort(np.abs(windows - middle[:, None]), axis=1)
    away = np.abs(fill(values) - middle)
    beyond = rules.outlier_noise_deviations * sigma
    measured = np.isfinite(values) & (away > rules.outlier_resolution_steps * resolution(values, rules, switched=False))
    alone = measured & (away > beyond + rules.outlier_local_spreads * sizes[:, 4])
    triples = values.size * comb(7, 3) * float(np.mean(alone)) ** 3
    if triples > rules.outlier_expected_triples:
        alone |= measured & (away > beyond + rules.outlier_local_spreads * sizes[:, 3])
    return np.asarray(alone)


def scatter(values: Array) -> float:
    """Standard deviation of noise that single samples do not raise: the larger of two robust ones, about the median of the
    neighbours, which in a steep motion is the sample itself, and of the second differences.
    """
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(fill(values), 3, mode="reflect"), 7)
    about = np.median(np.abs(fill(values) - np.median(windows, axis=1)))
    bends = np.median(np.abs(np.diff(fill(values), 2))) / np.sqrt(6.0)
    return float(1.4826 * max(about, bends))


def lost(values: Array, rules: DataRules) -> Mask:
    """Samples of a code for a lost reading: one value, again and again, that the channel jumps to and back from."""
    line = fill(values)
    step = np.abs(np.diff(line))
    moved = step[step > 0.0]
    if moved.size < 10:
        return np.zeros(line.size, dtype=bool)
    far = rules.outlier_noise_deviations * float(np.median(moved))
    far = max(far, rules.lost_jump_ratio * float(np.quantile(moved, 0.9)))
    longest = rules.lost_code_samples
    starts = np.flatnonzero(step > far) + 1
    found = np.zeros(line.size, dtype=bool)
    codes: dict[float, list[slice]] = {}
    for first in starts:
        last = first
        while last < line.size and last - first <= longest and line[last] == line[first]:
            last += 1
        ends = last < line.size and last - first <= longest and abs(line[last] - line[first]) > far
        if ends and (line[last] - line[first]) * (line[first - 1] - line[first]) > 0.0:
            codes.setdefault(float(line[first]), []).append(slice(int(first), int(last)))
    for spans in codes.values():
        if len(spans) >= rules.lost_code_returns:
            for span in spans:
                found[span] = True
    ordinary = np.count_nonzero(~found) > 0.5 * line.size
    return found & np.isfinite(values) if ordinary else np.zeros(line.size, dtype=bool)


def outliers(values: Array, rules: DataRules) -> Mask:
    """Samples (n,) of a channel that are not readings: those that stand alone, and codes for a lost reading.

    Single samples of a channel that holds still otherwise are left: those may be blows, and meant.
    """
    if np.count_nonzero(np.isfinite(values)) < rules.outlier_fewest_samples:
        return np.zeros(values.size, dtype=bool)
    noise = scatter(values)
    bad = wild(values, noise, rules)
    if float(np.nanstd(np.where(bad, np.nan, values))) <= rules.motion_over_noise * noise:
        bad = np.zeros(values.size, dtype=bool)
    return bad | lost(values, rules)


def without_outliers(
    recordings: list[Recording], bad: list[dict[str, Mask]], columns: dict[str, str], findings: list[Finding]
) -> list[Recording]:
    """Recordings in which the `bad` samples (n,) of each channel are missing; a finding says how many.

    bad: of each recording, by channel.
    """
    for name in dict.fromkeys(name for of_one in bad for name in of_one):
        count = total = 0
        first = ""
        cleaned = []
        for recording, of_one in zip(recordings, bad, strict=True):
            if name in of_one:
                values, mask = recording.channels[name], of_one[name]
                count, total = count + int(mask.sum()), total + values.size
                if mask.any():
                    where = recording.begin_s + float(recording.time_s[int(np.argmax(mask))])
                    unit = "s" if recording.timed else "samples"
                    first = first or f"first at {where:.4g} {unit} of {recording.name}"
                    recording = replace(recording, channels={**recording.channels, name: np.where(mask, np.nan, values)})
            cleaned.append(recording)
        recordings = cleaned
        if count:
            column = columns.get(name, name)
            says = f"{count} of {total} samples of column {column} are outliers, far from their neighbours ({first}). "
            says += "They are left out of the comparison."
            findings.append(Finding("outliers", column, says))
    return recordings


def resolution(values: Array, rules: DataRules, switched: bool) -> float:
    """Step in which a channel reads, 0 if it is not visibly coarse. switched: few levels may be meant."""
    step = quantum(values)
    if step > 0.0:
        return step
    good = values[np.isfinite(values)]
    levels = np.unique(good)
    if switched or not 3 <= levels.size <= rules.switched_levels or good.size < 10 * levels.size:
        return 0.0
    steps = np.diff(levels)
    smallest = float(np.min(steps))
    even = np.abs(steps / smallest - np.round(steps / smallest)) < 1e-3
    return smallest if bool(even.all()) and not constant_speed(values, smallest) else 0.0


def held_levels(values: Array, rules: DataRules) -> bool:
    """Whether a channel (n,) is held at levels and jumps from one to the next: a step, pulses, a staircase, a PRBS.

    A motion that a limit clips runs through many values between two limits.
    """
    good = values[np.isfinite(values)]
    lasts = np.diff(np.flatnonzero(np.concatenate(([True], np.diff(good) != 0.0, [True]))))
    held = lasts >= rules.level_samples
    between = int(np.sum(lasts[~held]))
    return bool(np.unique(good).size == 2 or between <= rules.samples_between_levels * np.count_nonzero(held))


def repeated(values: Array, rules: DataRules) -> Places | None:
    """Sample (n,) whose reading each sample of `values` (n,) repeats, where a sensor is read more seldom than it is logged.

    None where readings do not last equally long: a coarse reading stays the same for as long as the motion is slow.
    """
    new = np.concatenate(([0], np.flatnonzero(np.diff(values) != 0.0) + 1))
    lasts = np.diff(new)
    if lasts.size < rules.repeated_fewest_readings:
        return None
    period = int(np.median(lasts))
    if period < 2:
        return None
    regular = np.abs(lasts - period * np.maximum(np.round(lasts / period), 1)) <= 1
    steps = np.abs(np.diff(values[new]))
    if np.mean(regular) < rules.repeated_regular_share:
        return None
    if float(np.nanmedian(steps)) < rules.repeated_fine_steps * float(np.nanmin(steps)):
        return None
    return np.asarray(new[np.searchsorted(new, np.arange(values.size), side="right") - 1])


def coarse(
    recordings: list[Recording],
    names: list[str],
    driven: set[str],
    columns: dict[str, str],
    units: dict[str, str],
    findings: list[Finding],
    rules: DataRules,
) -> None:
    """Channels that read in steps, of which fewer than `resolution_steps` make their range. driven: outputs, whose few
    levels are not meant.
    """
    for name in names:
        found = [r.channels[name] for r in recordings if name in r.channels and np.isfinite(r.channels[name]).any()]
        steps = [resolution(values, rules, name not in driven) for values in found]
        spans = [float(np.nanmax(values) - np.nanmin(values)) for values in found]
        if not steps or min(steps) <= 0.0 or max(spans) > rules.resolution_steps * max(steps):
            continue
        step, column, unit = max(steps), columns.get(name, name), units.get(name, "")
        says = f"Column {column} reads in steps of {step:.4g} {unit}".rstrip()
        says += f", 1/{max(spans) / step:.0f} of its range: what changes it by less than half a step cannot be seen."
        findings.append(Finding("quantized", column, says))


def counts(recordings: list[Recording], names: list[str], units: dict[str, str], rules: DataRules) -> list[str]:
    """Channels that hold whole numbers only, many of them, though their unit is not one of counts."""
    found = []
    for name in names:
        values = [r.channels[name][np.isfinite(r.channels[name])] for r in recordings if name in r.channels]
        together = np.concatenate(values) if values else np.zeros(0)
        whole = together.size > 0 and bool(np.all(together == np.round(together)))
        if whole and np.unique(together).size > rules.switched_levels and units.get(name, "") in MECHANICAL:
            found.append(name)
    return found
