"""Data before physics: what is wrong with the recordings themselves, in plain sentences, before anything is fitted.

Each check compares channels with each other and with what the nominal model says of them. What can be put right without a
guess (a reversed sign, a clock that runs ahead) is put right for the diagnosis, and the sentence says so; the recording
is never changed. A channel that says nothing (constant, all missing) leaves nothing to compare: no verdict on physics.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from host.diagnosis.model.data_rules import DataRules
from host.diagnosis.model.dataset import Recording
from host.diagnosis.model.nominal import NominalSpec
from host.diagnosis.model.operators import fill, smooth_derivatives, smoothing_window, white_level
from host.diagnosis.model.readings import Finding, coarse, counts, resolution, without_outliers

Array = npt.NDArray[np.float64]

LONGEST_FOR_CLOCK = 20000  # samples of a recording in which a shift is looked for
FACTORS = {1e3: "1000 (milli)", 1e-3: "1/1000 (milli)", 1e6: "10^6 (micro)", 1e-6: "10^-6 (micro)"}
FACTORS |= {180.0 / np.pi: "57.3 (degrees and radians)", np.pi / 180.0: "1/57.3 (degrees and radians)"}
SLOWEST_CYCLES = 5  # of a recording: what is slower is left out where an acceleration is integrated


@dataclass(frozen=True)
class Pair:
    """One input and the output that it drives, by a gain or by the terms `law` of input = m a + c v + k x.

    related: whether the nominal model connects the two at all (an impedance may follow its load alone).
    """

    input: str
    output: str
    law: tuple[str, ...] = ()
    reads: str = "position"
    gain: float | None = None  # what the nominal model says of it
    related: bool = True
    stated: bool = False  # whether the nominal model's file states the gain, so that it is no default
    values: tuple[float, ...] = ()  # of the terms `law`, 0 where the nominal model's file does not state one


@dataclass(frozen=True)
class Inspected:
    """Recordings fit to be compared (none: there is nothing to judge), and what was found."""

    recordings: list[Recording]
    findings: list[Finding]


def inspect(spec: NominalSpec, recordings: list[Recording], optional: set[str], rules: DataRules) -> Inspected:
    """Look at the recordings of `spec` before any fit. `optional`: channels that may be absent."""
    columns = {key: channel.column for key, channel in spec.channels.items()}
    findings: list[Finding] = []
    paths = pairs_of(spec)
    vital = {name for path in paths for name in (path.input, path.output)}
    recordings = _dead(recordings, vital, columns, findings, rules)
    if not recordings:
        return Inspected([], findings)
    _stamps(spec.data.time, recordings, findings, rules)
    driven = {path.input if path.law and spec.impedance is not None else path.output for path in paths}
    units = {key: channel.unit for key, channel in spec.channels.items()}
    recordings = without_outliers(recordings, sorted(vital), columns, findings, rules)
    coarse(recordings, sorted(vital), driven, columns, units, findings, rules)
    _counted(recordings, sorted(vital), columns, units, findings, rules)
    recordings = _exchanged_outputs(recordings, [path for path in paths if not path.law], columns, findings, rules)
    for path in paths:
        recordings = _compared(spec, recordings, path, columns, findings, rules)
        if not recordings:
            return Inspected([], findings)
    _saturated(recordings, paths, columns, findings, rules)
    _excitation(recordings, paths, columns, findings, rules)
    return Inspected(recordings, list(dict.fromkeys(findings)))


def _exchanged_outputs(
    recordings: list[Recording],
    paths: list[Pair],
    columns: dict[str, str],
    findings: list[Finding],
    rules: DataRules,
) -> list[Recording]:
    """Outputs of two pairs that follow the input of the other pair, and hardly their own."""
    for one, other in itertools.combinations(paths, 2):
        if len({one.input, other.input, one.output, other.output}) < 4:
            continue
        own, crossed = (
            [_explained(recordings, a.input, b.output) for a, b in both]
            for both in (((one, one), (other, other)), ((one, other), (other, one)))
        )
        better = 1.0 - min(crossed) < rules.exchanged_unexplained_ratio * (1.0 - max(own))
        if min(crossed) > rules.exchanged_explained and better:
            says = f"Columns {columns[one.output]} and {columns[other.output]} are probably exchanged: each follows the "
            says += f"other's input ({min(crossed):.0%} of its variance), not its own ({max(own):.0%}). "
            says += "The diagnosis continues with them exchanged."
            findings.append(Finding("swapped", columns[one.output], says))
            recordings = [_exchanged(recording, one.output, other.output) for recording in recordings]
    return recordings


def _explained(recordings: list[Recording], input: str, output: str) -> float:
    """Share of the variance of `output` that a gain on `input` explains, the offset of each recording apart."""
    x, y = _centred(recordings, input), _centred(recordings, output)
    power = float(x @ x) * float(y @ y)
    return float(x @ y) ** 2 / power if power > 0.0 else 0.0


def pairs_of(spec: NominalSpec) -> list[Pair]:
    """Pairs of channels that the nominal model says to move together."""
    found = []
    for link in spec.link:
        gain = spec.start("gain" if len(spec.link) == 1 else f"{link.subsystem}_gain", 1.0)[0]
        same = spec.channels[link.input].unit == spec.channels[link.output].unit
        stated = "gain" in spec.parameters or f"{link.subsystem}_gain" in spec.parameters
        found.append(Pair(link.input, link.output, gain=gain if stated or same else None, stated=stated))
    if spec.axis is not None:
        law = tuple(term for term in spec.axis.terms if term != "offset")
        found.append(Pair(spec.axis.input, spec.axis.output, law, spec.axis.reads, values=_stated(spec, law)))
    if spec.impedance is not None:
        law = tuple(term for term in spec.impedance.terms if term in ("mass", "damping", "stiffness"))
        path = Pair(spec.impedance.output, spec.impedance.input, law, related=bool(law), values=_stated(spec, law))
        found.append(path)
    return found


def _stated(spec: NominalSpec, law: Sequence[str]) -> tuple[float, ...]:
    return tuple(spec.start(term, 0.0)[0] if term in spec.parameters else 0.0 for term in law)


def _counted(
    recordings: list[Recording],
    names: list[str],
    columns: dict[str, str],
    units: dict[str, str],
    findings: list[Finding],
    rules: DataRules,
) -> None:
    """Whole numbers where a unit says otherwise."""
    for name in counts(recordings, names, columns, units, rules):
        says = f"Column {columns[name]} holds whole numbers only, called {units[name]}: these are probably counts. "
        says += f"State the value of one count (channels.{name}.scale)."
        findings.append(Finding("unit", columns[name], says))


def _dead(
    recordings: list[Recording], vital: set[str], columns: dict[str, str], findings: list[Finding], rules: DataRules
) -> list[Recording]:
    """Recordings in which every vital channel is measured and moves in at least one of them."""
    names = list(dict.fromkeys(name for recording in recordings for name in recording.channels))
    unusable: set[str] = set()
    for name in names:
        column = columns.get(name, name)
        all_values = [recording.channels[name] for recording in recordings if name in recording.channels]
        empty = [recording.name for recording in recordings if _seen(recording, name) == 0.0]
        together = np.concatenate(all_values)
        good = together[np.isfinite(together)]
        if empty:
            where = "in every recording" if len(empty) == len(recordings) else "in " + ", ".join(empty)
            findings.append(Finding("missing", column, f"Column {column} holds no number {where}."))
            unusable |= set(empty) if name in vital else set()
        elif (share := _lost(recordings, name, rules)) > rules.missing_share:
            findings.append(Finding("missing", column, f"{share:.0%} of the samples of column {column} are missing."))
        if any(name in recording.infinite for recording in recordings):
            findings.append(Finding("missing", column, f"Column {column} holds infinite values. They count as missing."))
        if good.size and float(np.ptp(good)) <= rules.constant_span * max(float(np.max(np.abs(good))), 1e-300):
            says = f"Column {column} has the same value, {good[0]:.4g}, in every sample."
            if name in vital:
                says += " If this channel does not change, it cannot be compared with the nominal model."
                unusable |= {recording.name for recording in recordings}
            findings.append(Finding("constant", column, says))
    return [recording for recording in recordings if recording.name not in unusable]


def _lost(recordings: list[Recording], name: str, rules: DataRules) -> float:
    """Share of the samples of a channel that are missing. Where stamps are not even, steps without any sample are none."""
    lost = total = 0
    for recording in recordings:
        if name in recording.channels:
            sampled = _sampled(recording, rules)
            lost += int(np.count_nonzero(sampled & ~np.isfinite(recording.channels[name])))
            total += int(np.count_nonzero(sampled))
    return lost / max(total, 1)


def _sampled(recording: Recording, rules: DataRules) -> npt.NDArray[np.bool_]:
    """Steps (n,) that have a sample of some channel; all of them where the stamps are even."""
    if not recording.timed or recording.jitter <= rules.uneven_period_share:
        return np.ones(recording.n, dtype=bool)
    return np.asarray(np.any([np.isfinite(values) for values in recording.channels.values()], axis=0))


def _seen(recording: Recording, name: str) -> float:
    values = recording.channels.get(name)
    return 1.0 if values is None else float(np.mean(np.isfinite(values)))


def _stamps(column: str | None, recordings: list[Recording], findings: list[Finding], rules: DataRules) -> None:
    """Irregular stamps, recordings of unlike sampling periods, and stamps that are probably no seconds."""
    uneven = [recording for recording in recordings if recording.timed and recording.jitter > rules.uneven_period_share]
    if uneven:
        worst = max(uneven, key=lambda recording: recording.jitter)
        empty = 1.0 - float(np.mean(np.concatenate([_sampled(recording, rules) for recording in uneven])))
        says = f"Time stamps are not even: in {worst.name} periods differ from the median one, {worst.dt_s:.4g} s, by up to "
        says += f"{worst.jitter:.0%}. Channels were interpolated to even steps; gaps of more than three periods are "
        says += f"left out ({empty:.0%} of the steps). " if empty > 0.0 else "left out. "
        says += f"Behind a gap of more than {rules.gap_samples} samples a recording begins again, from a state of its own."
        findings.append(Finding("clock", "time", says))
    periods = [recording.dt_s for recording in recordings if recording.timed]
    if periods and max(periods) > rules.sampling_period_ratio * min(periods):
        says = f"Recordings are sampled at different rates, every {min(periods):.4g} to {max(periods):.4g} s."
        findings.append(Finding("clock", "time", says))
    if column is not None and periods and min(periods) >= rules.slow_period_s:
        says = (
            f"Column {column}, taken for seconds, grows by {min(periods):.4g} between samples. If it is in milliseconds or "
        )
        says += (
            "microseconds, every rate and time constant below is in that unit, not in seconds: set data.time_scale (0.001 "
        )
        says += "for milliseconds)."
        findings.append(Finding("unit", column, says))


def _compared(
    spec: NominalSpec,
    recordings: list[Recording],
    path: Pair,
    columns: dict[str, str],
    findings: list[Finding],
    rules: DataRules,
) -> list[Recording]:
    """Sign, unit, copy, order and clock of one pair of channels."""
    input_column, output_column = columns[path.input], columns[path.output]
    copied = _copy(recordings, path.input, path.output, rules)
    if copied is not None:
        findings.append(Finding("alias", output_column, copied.sentence(output_column, input_column, recordings[0])))
        if copied.whole:
            return []
    for name in {name for recording in recordings for name in recording.channels} - {path.input, path.output}:
        copied = _copy(recordings, path.output, name, rules)
        if copied is not None and copied.whole and spec.kind != "rig":
            says = f"Column {columns[name]} is a copy of column {output_column}: it cannot explain it, and is left out."
            findings.append(Finding("alias", columns[name], says))
            recordings = [_with(recording, name, np.zeros(recording.n)) for recording in recordings]
    if not path.related:
        return recordings
    if path.law:
        return _by_law(spec, recordings, path, columns, findings, rules)
    return _by_gain(recordings, path, columns, findings, rules)


def _with(recording: Recording, name: str, values: Array) -> Recording:
    return replace(recording, channels={**recording.channels, name: values})


def _exchanged(recording: Recording, one: str, other: str) -> Recording:
    return _with(_with(recording, one, recording.channels[other]), other, recording.channels[one])


def _centred(recordings: list[Recording], name: str) -> Array:
    """Channel `name` of all recordings (n,), gaps bridged, each recording without its mean."""
    each = [fill(recording.channels[name]) for recording in recordings]
    return np.concatenate([values - np.mean(values) for values in each])


@dataclass(frozen=True)
class _Copied:
    """A channel that is another one, scaled and shifted, up to `tolerance`.

    noisy: with the noise of that one, so that it was not measured.
    """

    gain: float
    offset: float
    lag: float  # samples
    noisy: bool
    tolerance: float

    @property
    def whole(self) -> bool:
        """Return whether the channel has no information beyond the other."""
        return self.noisy or (self.lag == 0.0 and abs(self.gain - 1.0) < self.tolerance and self.offset == 0.0)

    def sentence(self, copy: str, original: str, recording: Recording) -> str:
        """Return the sentence of the finding."""
        if self.gain == 1.0 and self.offset == 0.0:
            says = f"Column {copy} is column {original} in every sample"
        else:
            says = f"Column {copy} is column {original} times {self.gain:.4g}"
        if self.lag:
            late = f"{self.lag * recording.dt_s:.4g} s" if recording.timed else f"{self.lag:.4g} samples"
            says += f", {late} later"
        if self.whole:
            return says + ", noise included: it was computed from it, not measured. There is nothing to compare."
        return says + ", exactly and without any noise: was it measured, or computed from it?"


def _copy(recordings: list[Recording], a: str, b: str, rules: DataRules) -> _Copied | None:
    """How `b` is `a` scaled and shifted, alike in every recording and exact; None if it is not."""
    found = [_copied(recording, a, b, rules) for recording in recordings]
    first = found[0] if found else None
    if first is None:
        return None
    for other in found:
        if other is None or abs(other.lag - first.lag) > 1e-3 or abs(other.gain - first.gain) > 1e-6 * abs(first.gain):
            return None
    return replace(first, noisy=all(other is not None and other.noisy for other in found))


def _copied(recording: Recording, a: str, b: str, rules: DataRules) -> _Copied | None:
    """As `_copy`, of one recording: lags of whole samples and between two."""
    x, y = recording.channels.get(a), recording.channels.get(b)
    if x is None or y is None:
        return None
    x, y = fill(x), fill(y)
    if np.ptp(x) == 0.0 or np.ptp(y) == 0.0:
        return None
    most_left = rules.copy_residual
    if np.array_equal(x, y):
        return _Copied(1.0, 0.0, 0.0, white_level(x) >= rules.copy_noise * float(np.ptp(x)), most_left)
    dx, dy = np.diff(x, 2), np.diff(y, 2)
    size = 1 << int(np.ceil(np.log2(2 * dx.size)))
    across = np.fft.irfft(np.conj(np.fft.rfft(dx, size)) * np.fft.rfft(dy, size), size)
    most = x.size // 10
    near = int(np.argmax(np.abs(across[: most + 1])))
    for lag in dict.fromkeys((0, near, max(near - 1, 0))):
        now, before = x[1 : x.size - lag], x[: x.size - lag - 1]
        columns = np.array([now, before, np.ones(now.size)]).T
        late = y[lag + 1 :]
        (p, q, offset), *_ = np.linalg.lstsq(columns, late, rcond=1e-12)
        inside = slice(lag, None)  # what is held at the start is not yet the other's
        left = (late - columns @ (p, q, offset))[inside]
        if left.size < 50 or float(np.max(np.abs(left))) > most_left * float(np.ptp(y)) or p * q < -most_left * (p + q) ** 2:
            continue
        gain = float(p + q)
        if gain == 0.0:
            continue
        whole = float(q / gain) + lag
        near_whole = abs(whole - round(whole)) < 1e-4
        noisy = white_level(x) >= rules.copy_noise * float(np.ptp(x))
        return _Copied(gain, float(offset), round(whole) if near_whole else whole, noisy, most_left)
    return None


def _by_gain(
    recordings: list[Recording], path: Pair, columns: dict[str, str], findings: list[Finding], rules: DataRules
) -> list[Recording]:
    """A pair that a gain connects."""
    x, y = _centred(recordings, path.input), _centred(recordings, path.output)
    if not np.any(x) or not np.any(y):
        return recordings
    correlation = float(x @ y / np.sqrt((x @ x) * (y @ y)))
    gain = correlation * float(np.std(y) / np.std(x))
    output_column, input_column = columns[path.output], columns[path.input]
    if path.gain is not None and correlation * np.sign(path.gain) < rules.opposite_correlation:
        says = f"Column {output_column} moves against column {input_column}; the nominal model says with it. "
        says += "One of them has the opposite sign (channels.*.sign)."
        findings.append(Finding("sign", output_column, says))
    if path.gain and abs(correlation) > rules.gain_correlation:
        ratio, near = abs(gain / path.gain), rules.unit_factor_default
        factor = factor_of(ratio, rules.unit_factor_stated if path.stated else near)
        if factor:
            says = f"Column {output_column} is about {FACTORS[factor]} times what the nominal model says of {input_column}: "
            says += "the unit of one of them is probably another (channels.*.scale)."
            if path.stated:
                says += f" The diagnosis continues with {output_column} divided by that."
                recordings = [_with(r, path.output, r.channels[path.output] / factor) for r in recordings]
            findings.append(Finding("unit", output_column, says))
        unlike = abs(path.gain**2 - 1.0) > rules.inverse_gain_distance * near
        if unlike and abs(gain * path.gain - 1.0) < near:
            says = f"The gain from {input_column} to {output_column} is the inverse of the nominal one: "
            says += "the two columns are probably exchanged."
            findings.append(Finding("swapped", output_column, says))
    return _causal(recordings, path, columns, findings, rules)


def factor_of(ratio: float, near: float) -> float:
    """The factor of a slip of units that `ratio` (positive) is within `near` (logarithm) of; 0 if there is none."""
    away, best = min((abs(float(np.log(max(ratio, 1e-300) / factor))), factor) for factor in FACTORS)
    return best if away < near else 0.0


def _causal(
    recordings: list[Recording], path: Pair, columns: dict[str, str], findings: list[Finding], rules: DataRules
) -> list[Recording]:
    """An output that comes before its input: clocks disagree; it is shifted back."""
    leads = [_lead(recording, path, rules) for recording in recordings if recording.timed]
    if not leads or min(leads) < rules.clock_lead_samples:
        return recordings
    lead = round(float(np.median(leads)))
    output_column, input_column = columns[path.output], columns[path.input]
    says = f"Column {output_column} moves {lead * recordings[0].dt_s:.3g} s before column {input_column} that drives it: "
    says += "their clocks disagree, or the columns are exchanged. The diagnosis continues with it shifted back."
    findings.append(Finding("clock", output_column, says))
    moved = []
    for recording in recordings:
        late = np.concatenate((np.full(lead, np.nan), recording.channels[path.output][:-lead]))
        moved.append(_with(recording, path.output, late))
    return moved


def _lead(recording: Recording, path: Pair, rules: DataRules) -> float:
    """Samples by which the output comes before the input, by the residual of a gain at each shift; 0 if it does not."""
    x, y = fill(recording.channels[path.input]), fill(recording.channels[path.output])
    most = min(x.size // 10, 200)
    if most < rules.clock_lead_samples + 1:
        return 0.0
    leads = [_left(x[lag:], y[: y.size - lag]) for lag in range(most)]
    lags = [_left(x[: x.size - lag], y[lag:]) for lag in range(most)]  # merely late, it would do no worse that way
    best = int(np.argmin(leads))
    return float(best) if leads[best] < rules.clock_residual_ratio * min(leads[0], *lags) else 0.0


def _left(x: Array, y: Array) -> float:
    """Variance of `y` (n,) that a positive gain on `x` (n,) leaves: a lag of half a period does not count as a lead."""
    a, b = x - x.mean(), y - y.mean()
    across, spread = max(float(a @ b), 0.0), float(a @ a)
    return (float(b @ b) - (across**2 / spread if spread > 0.0 else 0.0)) / a.size


def regression(recording: Recording, path: Pair, exchanged: bool = False) -> tuple[Array, Array, float]:
    """Coefficients of the law by smoothed derivatives, RMS of each term, and the share of the variance explained."""
    force, motion = fill(recording.channels[path.input]), fill(recording.channels[path.output])
    if exchanged:
        force, motion = motion, force
    dt = recording.dt_s
    window = smoothing_window(motion, dt, white_level(motion), 7 * dt)
    x, v, a = smooth_derivatives(motion, dt, window)
    if path.reads == "velocity":
        x, v, a = np.cumsum(x) * dt, x, v
    table = {"mass": a, "damping": v, "stiffness": x}
    f = smooth_derivatives(force, dt, window)[0]
    inside = slice(window, -window) if f.size > 6 * window else slice(None)
    columns = np.array([*(table[term] for term in path.law), np.ones_like(f)])[:, inside]
    found, rms, explained = _least_squares(columns, f[inside])
    return found[:-1], rms[:-1], explained


def _least_squares(terms: Array, force: Array) -> tuple[Array, Array, float]:
    """Coefficients of `terms` (k, n) for `force` (n,), RMS of each term, and the share of the variance explained."""
    size = np.linalg.norm(terms, axis=1) + 1e-300
    found = np.linalg.lstsq((terms / size[:, None]).T, force, rcond=1e-9)[0] / size
    explained = 1.0 - float(np.var(force - found @ terms)) / max(float(np.var(force)), 1e-300)
    return found, np.std(terms, axis=1) * np.abs(found), explained


def _by_law(
    spec: NominalSpec,
    recordings: list[Recording],
    path: Pair,
    columns: dict[str, str],
    findings: list[Finding],
    rules: DataRules,
) -> list[Recording]:
    """A pair that an equation of motion connects."""
    used = _long_enough(recordings, rules)
    if not used:
        return recordings
    if path.reads == "acceleration":
        return _sign_by_law([_by_spectra(recording, path) for recording in used], recordings, path, columns, findings, rules)
    straight = [regression(recording, path) for recording in used]
    explained = float(np.median([part[2] for part in straight]))
    force_column, motion_column = columns[path.input], columns[path.output]
    unexplained, least = 1.0 - explained, rules.exchanged_least_unexplained
    if unexplained > least or _elsewhere(path, straight, rules):
        across = [regression(recording, path, exchanged=True) for recording in used]
        crossed = float(np.median([part[2] for part in across]))
        passive = abs(_agreement(across)) >= abs(_agreement(straight))
        better = unexplained > least and 1.0 - crossed < rules.exchanged_unexplained_ratio * unexplained
        enough = passive and crossed > rules.exchanged_explained
        if enough and (better or _as_stated(path, straight, across, rules)):
            says = f"Columns {force_column} and {motion_column} are probably exchanged: "
            if better:
                says += (
                    f"as named the nominal law explains {max(explained, 0.0):.0%} of the variance, exchanged {crossed:.0%}. "
                )
            else:
                says += (
                    "only exchanged do all terms of the nominal law have one sign, and the stated values within a factor of "
                )
                says += f"{rules.as_stated_factor:.0f}. "
            says += "The diagnosis continues with them exchanged."
            findings.append(Finding("swapped", force_column, says))
            recordings = [_exchanged(recording, path.input, path.output) for recording in recordings]
            straight = [regression(recording, path) for recording in _long_enough(recordings, rules)]
    recordings = _sign_by_law(straight, recordings, path, columns, findings, rules)
    leading = path.input if spec.impedance is not None else path.output
    recordings = _causal_by_law(recordings, path, leading, columns, findings, rules)
    return _in_units(recordings, path, straight, columns, findings, rules)


def _long_enough(recordings: list[Recording], rules: DataRules) -> list[Recording]:
    return [recording for recording in recordings if recording.timed and recording.n >= rules.law_fewest_samples]


def _as_stated(
    path: Pair, straight: list[tuple[Array, Array, float]], across: list[tuple[Array, Array, float]], rules: DataRules
) -> bool:
    """Whether the law of exchanged columns alone is passive and has the stated values, where it has several terms.

    Uneven stamps and noise leave a part of either order, and slow motion little of both, so that what is unexplained does
    not decide.
    """
    if len(path.law) < 2 or _agreement(across) < 1.0 or _agreement(straight) > rules.passive_agreement:
        return False
    if not _elsewhere(path, straight, rules):
        return False
    return bool(np.max(_from_stated(path, across)) < np.log(rules.as_stated_factor))


def _elsewhere(path: Pair, fits: list[tuple[Array, Array, float]], rules: DataRules) -> bool:
    """Whether every coefficient whose value is stated has another one."""
    away = _from_stated(path, fits)
    return bool(away.size and np.min(away) > np.log(rules.not_as_stated_factor))


def _from_stated(path: Pair, fits: list[tuple[Array, Array, float]]) -> Array:
    """Magnitude of the logarithm of the ratio of each coefficient to its value, of those that are stated."""
    stated = np.abs(np.array(path.values))
    found = np.median([np.abs(c) for c, _, _ in fits], axis=0)[stated > 0.0]
    return np.asarray(np.abs(np.log(np.maximum(found, 1e-300) / stated[stated > 0.0])))


def _sign_by_law(
    straight: list[tuple[Array, Array, float]],
    recordings: list[Recording],
    path: Pair,
    columns: dict[str, str],
    findings: list[Finding],
    rules: DataRules,
) -> list[Recording]:
    """A force that has the opposite sign of the motion; straight: the law as regressed in each recording."""
    explained = float(np.median([part[2] for part in straight]))
    if explained <= rules.law_explained or max(map(_signs, straight)) >= rules.opposite_correlation:
        return recordings
    says = f"Columns {columns[path.input]} and {columns[path.output]} have opposite signs: every term of the nominal law "
    says += f"comes out negative. The diagnosis continues with {columns[path.input]} reversed (channels.*.sign)."
    findings.append(Finding("sign", columns[path.input], says))
    return [_with(recording, path.input, -recording.channels[path.input]) for recording in recordings]


def _by_spectra(recording: Recording, path: Pair) -> tuple[Array, Array, float]:
    """As `regression`, of a recorded acceleration: speed and place by integration in the spectrum, without what is slow.

    An integral of a reading with an offset drifts. All terms and the force lose the same slow part.
    """
    rows = np.vstack([fill(recording.channels[name]) for name in (path.output, path.input)])
    n = rows.shape[1]
    window = np.sin(np.pi * (np.arange(n) + 0.5) / n) ** 2
    spectra = np.fft.rfft((rows - rows.mean(axis=1, keepdims=True)) * window, axis=1)
    turn = 2.0 * np.pi * np.fft.rfftfreq(n, recording.dt_s)
    kept = np.arange(turn.size) >= SLOWEST_CYCLES
    turn[~kept] = 1.0
    a, force = np.where(kept, spectra, 0.0)
    table = {"mass": a, "damping": a / (1j * turn), "stiffness": -a / turn**2}
    terms = np.array([np.fft.irfft(table[term], n) for term in path.law])
    return _least_squares(terms, np.fft.irfft(force, n))


def _signs(regressed: tuple[Array, Array, float]) -> float:
    """Return 1 if all terms of a law are positive, -1 if all are negative, weighted by their size in between.

    Mass, damping and stiffness have one sign. The law of exchanged columns is nearly that of a spring at low frequency, with
    a damping of the other sign.
    """
    found, rms, _ = regressed
    return float(np.sum(np.sign(found) * rms)) / max(float(np.sum(rms)), 1e-300)


def _agreement(regressed: list[tuple[Array, Array, float]]) -> float:
    return float(np.median([_signs(each) for each in regressed]))


def _causal_by_law(
    recordings: list[Recording],
    path: Pair,
    leading: str,
    columns: dict[str, str],
    findings: list[Finding],
    rules: DataRules,
) -> list[Recording]:
    """A force that comes before the motion that causes it (or the reverse): their clocks disagree, so it is shifted back.

    leading: the channel that cannot come first. A relaxing material advances its force too, by another amount at every
    frequency. The shift therefore has to leave nothing but the noise of the force, and to be the same in every recording.
    """
    leads = [_lead_by_law(recording, path, leading, rules) for recording in _long_enough(recordings, rules)]
    lead = round(float(np.median(leads))) if leads else 0
    if not leads or min(leads) < rules.clock_lead_samples or max(leads) - min(leads) > 1 + lead // 10:
        return recordings
    other = path.output if leading == path.input else path.input
    early = f"{lead * recordings[0].dt_s:.3g} s"
    says = f"Column {columns[leading]} comes {early} before column {columns[other]}, which drives it: with that shift the "
    says += "nominal law leaves only noise. Their clocks disagree. "
    says += f"The diagnosis continues with {columns[leading]} shifted back."
    findings.append(Finding("clock", columns[leading], says))
    moved = []
    for recording in recordings:
        late = np.concatenate((np.full(lead, np.nan), recording.channels[leading][:-lead]))
        moved.append(_with(recording, leading, late))
    return moved


def _lead_by_law(recording: Recording, path: Pair, leading: str, rules: DataRules) -> int:
    """Samples by which `leading` comes first, by what the law leaves at each shift of it; 0 if it does not."""
    part = slice(0, LONGEST_FOR_CLOCK)
    force, motion = fill(recording.channels[path.input])[part], fill(recording.channels[path.output])[part]
    dt, noise = recording.dt_s, white_level(force)
    most = min(force.size // 10, 200)
    window = smoothing_window(motion, dt, white_level(motion), 7 * dt)
    if most < rules.clock_lead_samples + 1 or force.size < 4 * window + 4 * most:
        return 0
    x, v, a = smooth_derivatives(motion, dt, window)
    if path.reads == "velocity":
        x, v, a = np.cumsum(x) * dt, x, v
    table = {"mass": a, "damping": v, "stiffness": x}
    rows = np.array([*(table[term] for term in path.law), np.ones_like(force)])
    rows /= np.linalg.norm(rows, axis=1, keepdims=True) + 1e-300
    edge = most + window
    middle = rows[:, edge:-edge].T
    gram = np.linalg.pinv(middle.T @ middle, rcond=1e-10, hermitian=True)

    def left(shift: int, signal: Array = force) -> float:
        """RMS that the law leaves of a force that comes `shift` samples later than its motion."""
        f = signal[edge + shift : signal.size - edge + shift]
        return float(np.sqrt(np.mean((f - middle @ (gram @ (middle.T @ f))) ** 2)))

    now, clean, ratio = left(0), rules.clock_over_noise * noise, rules.clock_residual_ratio
    if ratio * now < clean:
        return 0
    side = -1 if leading == path.input else 1  # a force that comes first is found before its motion
    after = min(left(-side * lag) for lag in range(0, most, 2))
    # A damping takes over a part of a shift. Only a force that is smoothed as its motion is finds the whole of it.
    smooth = smooth_derivatives(force, dt, window)[0]
    best = int(np.argmin([left(side * lead, smooth) for lead in range(most)]))
    return best if left(side * best) < min(clean, ratio * now, ratio * after) else 0


def _in_units(
    recordings: list[Recording],
    path: Pair,
    fits: list[tuple[Array, Array, float]],
    columns: dict[str, str],
    findings: list[Finding],
    rules: DataRules,
) -> list[Recording]:
    """Coefficients that all differ from the stated ones by one factor of units, or by that of time for each derivative."""
    stated = np.abs(np.array(path.values))
    found = np.median([np.abs(c) for c, _, _ in fits], axis=0)
    sizes = np.median([rms for _, rms, _ in fits], axis=0)
    usable = (stated > 0.0) & (found > 0.0) & (sizes > rules.law_term_share * np.max(sizes))
    if float(np.median([part[2] for part in fits])) < rules.law_explained or not usable.any():
        return recordings
    ratios = found[usable] / stated[usable]
    order = np.array([("stiffness", "damping", "mass").index(term) for term in path.law])[usable]
    force_column, motion_column = columns[path.input], columns[path.output]
    near = rules.unit_factor_stated
    factor = factor_of(1.0 / float(np.exp(np.mean(np.log(ratios)))), near)
    if factor and np.ptp(np.log(ratios)) < 2.0 * near:
        says = f"{motion_column} over {force_column} is about {FACTORS[factor]} times what the nominal parameters say: "
        says += (
            f"the unit of one of them is probably another (channels.*.scale). The diagnosis continues with {motion_column} "
        )
        says += "divided by that."
        findings.append(Finding("unit", motion_column, says))
        return [_with(r, path.output, r.channels[path.output] / factor) for r in recordings]
    for thousands in (1e3, 1e6):
        if order.any() and np.all(np.abs(np.log(ratios) - order * np.log(thousands)) < near * np.maximum(order, 1)):
            unit = "milliseconds" if thousands == 1e3 else "microseconds"
            says = f"Nominal mass, damping and stiffness agree with the recordings if time is in {unit}, not in seconds. "
            says += "The diagnosis continues with this."
            findings.append(Finding("unit", "time", says))
            return [
                replace(r, time_s=r.time_s / thousands, dt_s=r.dt_s / thousands, begin_s=r.begin_s / thousands)
                for r in recordings
            ]
    return recordings


def _saturated(
    recordings: list[Recording], paths: list[Pair], columns: dict[str, str], findings: list[Finding], rules: DataRules
) -> None:
    """Find readings that stay at their largest or smallest value while their input continues to move."""
    for path in paths:
        pairs = [(path.output, path.input), (path.input, path.output)]
        for name, driver in pairs if path.law else pairs[:1]:
            for side, word in ((1.0, "largest"), (-1.0, "smallest")):
                share = max(_clipped(recording, name, driver, side, rules) for recording in recordings)
                if share > rules.clipped_share:
                    says = f"Column {columns[name]} stays at its {word} reading for {share:.1%} of a recording while "
                    says += f"{columns[driver]} moves on: it is limited there."
                    findings.append(Finding("saturated", columns[name], says))


def _clipped(recording: Recording, name: str, driver: str, side: float, rules: DataRules) -> float:
    """Share of samples in runs at the extreme reading, in which the input continues in the same direction and returns."""
    y, x = side * fill(recording.channels[name]), fill(recording.channels[driver])
    if resolution(recording.channels[name], rules, switched=False) > 0.0 or np.ptp(x) == 0.0:
        return 0.0
    x = side * x * (1.0 if float(np.corrcoef(x, side * y)[0, 1]) * side >= 0.0 else -1.0)
    at = (y >= np.max(y)).astype(np.int8)
    edges = np.flatnonzero(np.diff(np.concatenate(([0], at, [0]))))
    total = 0
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        if last - first >= rules.clipped_run_samples:
            inside = x[first:last]
            beyond = float(np.max(inside) - max(inside[0], inside[-1]))
            total += int(last - first) if beyond > rules.clipped_overrun * float(np.ptp(x)) else 0
    return total / y.size


def _excitation(
    recordings: list[Recording], paths: list[Pair], columns: dict[str, str], findings: list[Finding], rules: DataRules
) -> None:
    """Inputs of one sinusoid, and inputs that never turn: effects that these recordings cannot separate or show."""
    for path in paths:
        moving = path.output if path.law else path.input
        tones = [_tone(recording, moving, rules) for recording in recordings if recording.timed]
        name = columns[moving]
        if tones and all(tone > 0.0 for tone in tones) and max(tones) < rules.tone_frequency_ratio * min(tones):
            says = f"Column {name} is one sinusoid of {tones[0]:.3g} Hz: effects that differ in how they depend on "
            says += (
                "frequency (delay, lag, viscous friction, mass, stiffness) are indistinguishable. Record two frequencies "
            )
            says += "a decade apart, and steps."
            findings.append(Finding("excitation", name, says))
        if not any(_turns(recording, moving, rules) for recording in recordings):
            says = f"Column {name} never reverses: these recordings cannot show backlash or dry friction."
            findings.append(Finding("excitation", name, says))


def _tone(recording: Recording, name: str, rules: DataRules) -> float:
    """Frequency (Hz) of a channel that is one sinusoid; 0 for any other."""
    x = fill(recording.channels[name])
    window = np.blackman(x.size)
    power = np.abs(np.fft.rfft((x - np.mean(x)) * window)) ** 2
    top = int(np.argmax(power))
    near = power[max(top - 3, 0) : top + 4].sum()
    around = np.arange(max(top - 3, 0), top + 4)
    turns = float(around @ power[around] / near) / (x.size * recording.dt_s) if top > 3 else 0.0
    return turns if top > 3 and near > rules.tone_power_share * power.sum() else 0.0


def _turns(recording: Recording, name: str, rules: DataRules) -> bool:
    """Whether a channel goes back by more than a small share of its span."""
    x = fill(recording.channels[name])
    limit = rules.reversal_share * float(np.ptp(x))
    fall = float(np.max(np.maximum.accumulate(x) - x))
    rise = float(np.max(x - np.minimum.accumulate(x)))
    return fall > limit and rise > limit
