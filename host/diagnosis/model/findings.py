"""Data before physics: what is wrong with the recordings themselves, in plain sentences, before anything is fitted.

Each check compares channels with each other and with what the nominal model says of them. What can be put right without a
guess (a reversed sign, a clock that runs ahead) is put right for the diagnosis, and the sentence says so; the recording
is never changed. A channel that says nothing (constant, all missing) leaves nothing to compare: no verdict on physics.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from host.diagnosis.model.data_rules import DataRules
from host.diagnosis.model.dataset import Recording, named_apart
from host.diagnosis.model.frozen import frozen_finding, frozen_readings, without_runs
from host.diagnosis.model.nominal import NominalSpec
from host.diagnosis.model.operators import fill, later, reading_noise
from host.diagnosis.model.pairs import (
    LawFit,
    Pair,
    agreement,
    as_stated,
    centred,
    copy_of,
    driven_of,
    elsewhere,
    explained_by_gain,
    explained_by_law,
    lead_by_gain,
    lead_by_law,
    pairs_of,
    regression,
    regression_by_spectra,
    typical,
)
from host.diagnosis.model.readings import (
    MECHANICAL,
    Finding,
    coarse,
    counts,
    held_levels,
    outliers,
    resolution,
    without_outliers,
)
from host.diagnosis.model.spikes import NEAR, around, unanswered
from host.diagnosis.model.time_constants import slowest_s

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

FACTORS = {1e3: "1000 (milli)", 1e-3: "1/1000 (milli)", 1e6: "10^6 (micro)", 1e-6: "10^-6 (micro)"}
FACTORS |= {180.0 / np.pi: "57.3 (degrees and radians)", np.pi / 180.0: "1/57.3 (degrees and radians)"}


@dataclass(frozen=True)
class Inspected:
    """Recordings fit to be compared (none: there is nothing to judge), and what was found."""

    recordings: list[Recording]
    findings: list[Finding]


def inspect(spec: NominalSpec, recordings: list[Recording], rules: DataRules) -> Inspected:
    """Look at the recordings of `spec` before any fit."""
    data = _Inspection(spec, rules, recordings, {key: channel.column for key, channel in spec.channels.items()})
    paths = pairs_of(spec)
    vital = {name for path in paths for name in (path.input, path.output)}
    data.dead(vital)
    if not data.recordings:
        return Inspected([], data.findings)
    data.stamps()
    data.frozen(driven_of(spec))
    driven = {path.input if path.law and spec.impedance is not None else path.output for path in paths}
    data.alone(sorted(vital), driven, paths)
    data.exchanged_outputs([path for path in paths if not path.law])
    for path in paths:
        data.compared(path)
        if not data.recordings:
            return Inspected([], data.findings)
    for path in paths:
        data.saturated(path, driven)
    for path in paths:
        data.excitation(path)
    return Inspected(data.recordings, list(dict.fromkeys(data.findings)))


def factor_of(ratio: float, near: float) -> float:
    """The factor of a slip of units that `ratio` (positive) is within `near` (logarithm) of; 0 if there is none."""
    away, best = min((abs(float(np.log(max(ratio, 1e-300) / factor))), factor) for factor in FACTORS)
    return best if away < near else 0.0


@dataclass
class _Inspection:
    """What the checks share: each reads the recordings as the checks before it left them, and adds what it finds.

    columns: column of each channel in the recordings, by which a finding names it.
    """

    spec: NominalSpec
    rules: DataRules
    recordings: list[Recording]
    columns: dict[str, str]
    findings: list[Finding] = field(default_factory=list)

    def find(self, id: str, column: str, says: str) -> None:
        """State what is wrong with a column of the recordings, in the sentence `says`; `id` as in `Finding`."""
        self.findings.append(Finding(id, column, says))

    def change(self, name: str, changed: Callable[[Array], Array]) -> None:
        """Put `changed` of its values (n,) in the place of channel `name`, in every recording."""
        self.recordings = [_with(recording, name, changed(recording.channels[name])) for recording in self.recordings]

    def exchange(self, one: str, other: str) -> None:
        """Put each of two channels in the place of the other, in every recording."""
        self.recordings = [_exchanged(recording, one, other) for recording in self.recordings]

    def shift_back(self, name: str, lead: float) -> None:
        """Put the values of channel `name` `lead` samples later, in every recording; its first samples are missing.

        A part of a sample is what all other channels are put later by, past the next whole one: an interpolated reading of
        what is driven would have less noise.
        """
        whole = math.ceil(lead)
        self.change(name, lambda values: np.concatenate((np.full(whole, np.nan), values[:-whole])))
        if whole > lead:
            for other in {other for recording in self.recordings for other in recording.channels} - {name}:
                self.change(other, lambda values: later(values, whole - lead, smooth=not held_levels(values, self.rules)))

    def dead(self, vital: set[str]) -> None:
        """Channels that say nothing; only recordings are left in which every vital one is measured and moves."""
        names = dict.fromkeys(name for recording in self.recordings for name in recording.channels)
        unusable: set[str] = set()
        for name in names:
            column = self.columns.get(name, name)
            with_it = [recording for recording in self.recordings if name in recording.channels]
            values = np.concatenate([recording.channels[name] for recording in with_it])
            good = values[np.isfinite(values)]
            empty = [recording.name for recording in self.recordings if _seen(recording, name) == 0.0]
            if empty:
                where = "in every recording" if len(empty) == len(self.recordings) else "in " + ", ".join(empty)
                self.find("missing", column, f"Column {column} holds no number {where}.")
                unusable |= set(empty) if name in vital else set()
            elif (share := _lost(self.recordings, name, self.rules)) > self.rules.missing_share:
                self.find("missing", column, f"{share:.0%} of the samples of column {column} are missing.")
            if any(name in recording.infinite for recording in self.recordings):
                self.find("missing", column, f"Column {column} holds infinite values. They count as missing.")
            if good.size and float(np.ptp(good)) <= self.rules.constant_span * max(float(np.max(np.abs(good))), 1e-300):
                says = f"Column {column} has the same value, {good[0]:.4g}, in every sample."
                if name in vital:
                    says += " If this channel does not change, it cannot be compared with the nominal model."
                    unusable |= {recording.name for recording in self.recordings}
                self.find("constant", column, says)
        self.recordings = [recording for recording in self.recordings if recording.name not in unusable]

    def stamps(self) -> None:
        """Irregular stamps, recordings of unlike sampling periods, and stamps that are probably no seconds."""
        column, rules = self.spec.data.time, self.rules
        timed = [recording for recording in self.recordings if recording.timed]
        uneven = [recording for recording in timed if recording.jitter > rules.uneven_period_share]
        if uneven:
            worst = max(uneven, key=lambda recording: recording.jitter)
            empty = 1.0 - float(np.mean(np.concatenate([_sampled(recording, rules) for recording in uneven])))
            says = f"Time stamps are not even: in {worst.name} periods differ from the median one, {worst.dt_s:.4g} s, by "
            says += f"up to {worst.jitter:.0%}. Channels were interpolated to even steps; gaps of more than three periods "
            says += f"are left out ({empty:.0%} of the steps). " if empty > 0.0 else "are left out. "
            says += f"Behind a gap of more than {rules.gap_samples} samples a recording begins again, from a state of its "
            says += "own."
            self.find("clock", "time", says)
        periods = [recording.dt_s for recording in timed]
        if periods and max(periods) > rules.sampling_period_ratio * min(periods):
            says = f"Recordings are sampled at different rates, every {min(periods):.4g} to {max(periods):.4g} s."
            self.find("clock", "time", says)
        if column is not None and periods and self.too_slow(timed, min(periods)):
            says = f"Column {column}, taken for seconds, grows by {min(periods):.4g} between samples. If it is in "
            says += "milliseconds or microseconds, every rate and time constant below is in that unit, not in seconds: set "
            says += "data.time_scale (0.001 for milliseconds)."
            self.find("unit", column, says)

    def too_slow(self, timed: list[Recording], period_s: float) -> bool:
        """Whether stamps are probably no seconds: the plant is faster by what is stated, or whole numbers stamp a mechanism.

        A thermal plant that is sampled once a second is not remarkable.
        """
        if period_s < self.rules.slow_period_s or self.spec.data.time_scale != 1.0:
            return False
        stated_s = slowest_s(self.spec)
        if stated_s is not None:
            return stated_s < self.rules.slow_period_ratio * period_s
        whole = all(np.all(r.time_s + r.begin_s == np.round(r.time_s + r.begin_s)) for r in timed)
        return whole and all(channel.unit in MECHANICAL for channel in self.spec.channels.values())

    def frozen(self, driven: set[str]) -> None:
        """Leave out readings of outputs that are frozen whatever moves them. driven: outputs.

        What follows the last reading is left out, too: it can be compared with nothing.
        """
        units = {key: channel.unit for key, channel in self.spec.channels.items()}
        kept: list[Recording] = []
        for recording in self.recordings:
            found = frozen_readings(recording, driven, self.rules)
            for name, mover in {run.name: mover for run, mover in found}.items():
                runs = [run for run, _ in found if run.name == name]
                names = self.columns.get(name, name), self.columns.get(mover, mover)
                self.findings.append(frozen_finding(recording, runs, names[0], units.get(name, ""), names[1]))
            kept += without_runs(recording, [run for run, _ in found], driven, self.rules)
        self.recordings = named_apart(kept)

    def outliers(self, recording: Recording, names: list[str], driven: set[str], paths: list[Pair]) -> dict[str, Mask]:
        """Samples (n,) of each channel that are not readings. A spike of an input that its output answers is one, as is the
        answer.
        """
        bad = {name: outliers(recording.channels[name], self.rules) for name in names if name in recording.channels}
        for path in paths:
            pair = (path.input, path.output)
            for name, output in (pair, pair[::-1]):
                if name in driven or output not in driven or not {name, output} <= bad.keys() or not bad[name].any():
                    continue
                answer = unanswered(recording, path, name, bad[name], bad[output], self.rules)
                bad[output] = bad[output] & ~around(bad[name] & ~answer, NEAR)
                bad[name] = answer
        return bad

    def alone(self, names: list[str], driven: set[str], paths: list[Pair]) -> None:
        """Each of the channels `names` by itself: outliers, coarse steps, and whole numbers where a unit says otherwise."""
        columns, units = self.columns, {key: channel.unit for key, channel in self.spec.channels.items()}
        bad = [self.outliers(recording, names, driven, paths) for recording in self.recordings]
        self.recordings = without_outliers(self.recordings, bad, columns, self.findings)
        coarse(self.recordings, names, driven, columns, units, self.findings, self.rules)
        for name in counts(self.recordings, names, units, self.rules):
            says = f"Column {columns[name]} holds whole numbers only, called {units[name]}: these are probably counts. "
            says += f"State the value of one count (channels.{name}.scale)."
            self.find("unit", columns[name], says)

    def exchanged_outputs(self, paths: list[Pair]) -> None:
        """Outputs of two pairs that follow the input of the other pair, and hardly their own."""
        for one, other in itertools.combinations(paths, 2):
            if len({one.input, other.input, one.output, other.output}) < 4:
                continue
            own, crossed = (
                [explained_by_gain(self.recordings, a.input, b.output) for a, b in both]
                for both in (((one, one), (other, other)), ((one, other), (other, one)))
            )
            better = 1.0 - min(crossed) < self.rules.exchanged_unexplained_ratio * (1.0 - max(own))
            if min(crossed) > self.rules.exchanged_explained and better:
                first, second = self.columns[one.output], self.columns[other.output]
                says = f"Columns {first} and {second} are probably exchanged: each follows the other's input "
                says += f"({min(crossed):.0%} of its variance), not its own ({max(own):.0%}). "
                says += "The diagnosis continues with them exchanged."
                self.find("swapped", first, says)
                self.exchange(one.output, other.output)

    def compared(self, path: Pair) -> None:
        """Sign, unit, copy, order and clock of one pair of channels; no recording is left where one is the other's copy."""
        self.copies(path)
        if not self.recordings or not path.related:
            return
        if path.law:
            self.by_law(path)
        else:
            self.by_gain(path)

    def copies(self, path: Pair) -> None:
        """An output that is a copy of its input, and other channels that are a copy of the output."""
        input_column, output_column = self.columns[path.input], self.columns[path.output]
        copied = copy_of(self.recordings, path.input, path.output, self.rules)
        if copied is not None:
            units = {self.spec.channels[name].unit for name in (path.input, path.output)}
            copied = replace(copied, unlike=bool(path.law) or len(units) > 1)
            self.find("alias", output_column, copied.sentence(output_column, input_column, self.recordings[0]))
            if copied.whole:
                self.recordings = []
                return
        names = dict.fromkeys(name for recording in self.recordings for name in recording.channels)
        for name in (name for name in names if name not in (path.input, path.output)):
            copied = copy_of(self.recordings, path.output, name, self.rules)
            if copied is not None and copied.whole and self.spec.kind != "rig":
                column = self.columns[name]
                says = f"Column {column} is a copy of column {output_column}: it cannot explain it, and is left out."
                self.find("alias", column, says)
                self.change(name, np.zeros_like)

    def by_gain(self, path: Pair) -> None:
        """A pair that a gain connects."""
        x, y = centred(self.recordings, path.input), centred(self.recordings, path.output)
        if not np.any(x) or not np.any(y):
            return
        correlation = float(x @ y / np.sqrt((x @ x) * (y @ y)))
        gain = correlation * float(np.std(y) / np.std(x))
        output_column, input_column = self.columns[path.output], self.columns[path.input]
        if path.gain is not None and correlation * np.sign(path.gain) < self.rules.opposite_correlation:
            moves, stated = ("against", "positive") if gain < 0.0 else ("with", "negative")
            says = f"Column {output_column} moves {moves} column {input_column} (gain {gain:.3g}), "
            says += f"but the nominal gain is {stated}. One of them has the opposite sign (channels.*.sign)."
            self.find("sign", output_column, says)
        if path.gain and abs(correlation) > self.rules.gain_correlation:
            self.units_by_gain(path, path.gain, gain)
        self.clock_by_gain(path)

    def units_by_gain(self, path: Pair, nominal: float, gain: float) -> None:
        """A gain that is the nominal one times a factor of units, or its inverse."""
        output_column, input_column = self.columns[path.output], self.columns[path.input]
        near = self.rules.unit_factor_default
        factor = factor_of(abs(gain / nominal), self.rules.unit_factor_stated if path.stated else near)
        if factor:
            says = f"Column {output_column} is about {FACTORS[factor]} times what the nominal model says of {input_column}: "
            says += "the unit of one of them is probably another (channels.*.scale)."
            if path.stated:
                says += f" The diagnosis continues with {output_column} divided by that."
                self.change(path.output, lambda values: values / factor)
            self.find("unit", output_column, says)
        unlike = abs(nominal**2 - 1.0) > self.rules.inverse_gain_distance * near
        if unlike and abs(gain * nominal - 1.0) < near:
            says = f"The gain from {input_column} to {output_column} is the inverse of the nominal one: "
            says += "the two columns are probably exchanged."
            self.find("swapped", output_column, says)

    def clock_by_gain(self, path: Pair) -> None:
        """An output that comes before its input: clocks disagree; it is shifted back."""
        leads = [lead_by_gain(recording, path, self.rules) for recording in self.recordings if recording.timed]
        if not leads or round(min(leads)) < self.rules.clock_lead_samples:
            return
        lead = float(np.median(leads))
        early, output_column = f"{lead * self.recordings[0].dt_s:.3g} s", self.columns[path.output]
        says = f"Column {output_column} moves {early} before column {self.columns[path.input]} that drives it: "
        says += "their clocks disagree, or the columns are exchanged. The diagnosis continues with it shifted back."
        self.find("clock", output_column, says)
        self.shift_back(path.output, lead)

    def by_law(self, path: Pair) -> None:
        """A pair that an equation of motion connects."""
        used = self.long_enough()
        if not used:
            return
        if path.reads == "acceleration":
            self.sign_by_law(path, [regression_by_spectra(recording, path) for recording in used])
            return
        fits = [regression(recording, path) for recording in used]
        if self.exchanged_by_law(path, fits):
            fits = [regression(recording, path) for recording in self.long_enough()]
        self.sign_by_law(path, fits)
        self.clock_by_law(path)
        self.units_by_law(path, fits)

    def long_enough(self) -> list[Recording]:
        """Return the recordings in which an equation of motion is looked at."""
        return [r for r in self.recordings if r.timed and r.n >= self.rules.law_fewest_samples]

    def exchanged_by_law(self, path: Pair, fits: list[LawFit]) -> bool:
        """Whether a force and a motion are exchanged, and if so, exchange them. fits: the law as the columns are named."""
        rules, explained = self.rules, explained_by_law(fits)
        unexplained, least = 1.0 - explained, rules.exchanged_least_unexplained
        if not (unexplained > least or elsewhere(path, fits, rules)):
            return False
        across = [regression(recording, path, exchanged=True) for recording in self.long_enough()]
        crossed = explained_by_law(across)
        passive = abs(agreement(across)) >= abs(agreement(fits))
        better = unexplained > least and 1.0 - crossed < rules.exchanged_unexplained_ratio * unexplained
        enough = passive and crossed > rules.exchanged_explained
        if not (enough and (better or as_stated(path, fits, across, rules))):
            return False
        says = f"Columns {self.columns[path.input]} and {self.columns[path.output]} are probably exchanged: "
        if better:
            says += f"as named the nominal law explains {max(explained, 0.0):.0%} of the variance, "
            says += f"exchanged {crossed:.0%}. "
        else:
            says += "only exchanged do all terms of the nominal law have one sign, and the stated values within a factor "
            says += f"of {rules.as_stated_factor:.0f}. "
        says += "The diagnosis continues with them exchanged."
        self.find("swapped", self.columns[path.input], says)
        self.exchange(path.input, path.output)
        return True

    def sign_by_law(self, path: Pair, fits: list[LawFit]) -> None:
        """A force that has the opposite sign of the motion."""
        highest = max(fit.sign for fit in fits)
        if explained_by_law(fits) <= self.rules.law_explained or highest >= self.rules.opposite_correlation:
            return
        column = self.columns[path.input]
        says = f"Columns {column} and {self.columns[path.output]} have opposite signs: every term of the nominal law comes "
        says += f"out negative. The diagnosis continues with {column} reversed (channels.*.sign)."
        self.find("sign", column, says)
        self.change(path.input, np.negative)

    def clock_by_law(self, path: Pair) -> None:
        """A force that comes before the motion that causes it, or the reverse: clocks disagree, so it is shifted back.

        A relaxing material advances its force too, by another amount at every frequency. The shift therefore has to leave
        nothing but the noise of the force, and to be the same in every recording.
        """
        driven, driver = (path.input, path.output) if self.spec.impedance is not None else (path.output, path.input)
        recordings = self.long_enough()
        leads = [lead_by_law(recording, path, driven, self.rules) for recording in recordings]
        lead = float(np.median(leads)) if leads else 0.0
        if not leads or round(min(leads)) < self.rules.clock_lead_samples or np.ptp(np.round(leads)) > 1 + lead // 10:
            return
        if self.spec.impedance is None:  # a force may be held between its samples
            lead = float(round(lead))
        early, column = f"{lead * recordings[0].dt_s:.3g} s", self.columns[driven]
        says = f"Column {column} comes {early} before column {self.columns[driver]}, which drives it: with that shift the "
        says += "nominal law leaves only noise. Their clocks disagree. "
        says += f"The diagnosis continues with {column} shifted back."
        self.find("clock", column, says)
        self.shift_back(driven, lead)

    def units_by_law(self, path: Pair, fits: list[LawFit]) -> None:
        """Coefficients that all differ from the stated ones by one factor of units, or of time for each derivative."""
        stated = np.abs(np.array(path.values))
        found, sizes = typical(fits)
        usable = (stated > 0.0) & (found > 0.0) & (sizes > self.rules.law_term_share * np.max(sizes))
        if explained_by_law(fits) < self.rules.law_explained or not usable.any():
            return
        ratios = np.log(found[usable] / stated[usable])
        order = np.array([("stiffness", "damping", "mass").index(term) for term in path.law])[usable]
        near, motion_column = self.rules.unit_factor_stated, self.columns[path.output]
        factor = factor_of(1.0 / float(np.exp(np.mean(ratios))), near)
        if factor and np.ptp(ratios) < 2.0 * near:
            says = f"{motion_column} over {self.columns[path.input]} is about {FACTORS[factor]} times what the nominal "
            says += "parameters say: the unit of one of them is probably another (channels.*.scale). "
            says += f"The diagnosis continues with {motion_column} divided by that."
            self.find("unit", motion_column, says)
            self.change(path.output, lambda values: values / factor)
            return
        for thousands, unit in ((1e3, "milliseconds"), (1e6, "microseconds")):
            if order.any() and np.all(np.abs(ratios - order * np.log(thousands)) < near * np.maximum(order, 1)):
                says = f"Nominal mass, damping and stiffness agree with the recordings if time is in {unit}, not in "
                says += "seconds. The diagnosis continues with this."
                self.find("unit", "time", says)
                self.recordings = [
                    replace(r, time_s=r.time_s / thousands, dt_s=r.dt_s / thousands, begin_s=r.begin_s / thousands)
                    for r in self.recordings
                ]
                return

    def saturated(self, path: Pair, driven: set[str]) -> None:
        """Find readings that stay at their largest or smallest value while their input continues to move.

        An input that is made of levels is meant to stay at them, and one that is zero rests. driven: outputs.
        """
        both = [(path.output, path.input), (path.input, path.output)]
        for name, driver in both if path.law else both[:1]:
            fine = [r for r in self.recordings if resolution(r.channels[name], self.rules, switched=False) <= 0.0]
            fine = [r for r in fine if name in driven or not held_levels(r.channels[name], self.rules)]
            lines = [(fill(r.channels[name]), fill(r.channels[driver])) for r in fine]
            for side, word in ((1.0, "largest"), (-1.0, "smallest")):
                limited = [(y, x) for y, x in lines if name in driven or np.max(side * y) != 0.0]
                share = max((_clipped(y, x, side, self.rules) for y, x in limited), default=0.0)
                if share > self.rules.clipped_share:
                    says = f"Column {self.columns[name]} stays at its {word} reading for {share:.1%} of a recording while "
                    says += f"{self.columns[driver]} moves on: it is limited there."
                    self.find("saturated", self.columns[name], says)

    def excitation(self, path: Pair) -> None:
        """Inputs of one sinusoid, and inputs that never turn: effects that these recordings cannot separate or show."""
        moving = path.output if path.law else path.input
        tones = [_tone(recording, moving, self.rules) for recording in self.recordings if recording.timed]
        name = self.columns[moving]
        if tones and all(tone > 0.0 for tone in tones) and max(tones) < self.rules.tone_frequency_ratio * min(tones):
            says = f"Column {name} is one sinusoid of {tones[0]:.3g} Hz: effects that differ in how they depend on "
            says += "frequency (delay, lag, viscous friction, mass, stiffness) are indistinguishable. Record two "
            says += "frequencies a decade apart, and steps."
            self.find("excitation", name, says)
        if not any(_turns(recording, moving, self.rules) for recording in self.recordings):
            says = f"Column {name} never reverses: these recordings cannot show backlash or dry friction."
            self.find("excitation", name, says)


def _with(recording: Recording, name: str, values: Array) -> Recording:
    return replace(recording, channels={**recording.channels, name: values})


def _exchanged(recording: Recording, one: str, other: str) -> Recording:
    return _with(_with(recording, one, recording.channels[other]), other, recording.channels[one])


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


def _clipped(y: Array, x: Array, side: float, rules: DataRules) -> float:
    """Share of the readings `y` (n,) in runs at the extreme one, in which their driver `x` (n,) continues and returns.

    side: 1 for the largest reading, -1 for the smallest. What a noisy driver does while both rest is not to continue.
    """
    if np.ptp(x) == 0.0:
        return 0.0
    least = max(rules.clipped_overrun * float(np.ptp(x)), rules.motion_over_noise * reading_noise(x))
    y = side * y
    x = x if float(np.corrcoef(x, y)[0, 1]) >= 0.0 else -x
    at = (y >= np.max(y)).astype(np.int8)
    edges = np.flatnonzero(np.diff(np.concatenate(([0], at, [0]))))
    total = 0
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        if last - first >= rules.clipped_run_samples:
            inside = x[first:last]
            beyond = float(np.max(inside) - max(inside[0], inside[-1]))
            total += int(last - first) if beyond > least else 0
    return total / y.size


def _tone(recording: Recording, name: str, rules: DataRules) -> float:
    """Frequency (Hz) of a channel that is one sinusoid; 0 for any other."""
    x = fill(recording.channels[name])
    window = np.blackman(x.size)
    power = np.abs(np.fft.rfft((x - np.mean(x)) * window)) ** 2
    top = int(np.argmax(power))
    around = np.arange(max(top - 3, 0), min(top + 4, power.size))
    near = power[around].sum()
    turns = float(around @ power[around] / near) / (x.size * recording.dt_s) if top > 3 else 0.0
    return turns if top > 3 and near > rules.tone_power_share * power.sum() else 0.0


def _turns(recording: Recording, name: str, rules: DataRules) -> bool:
    """Whether a channel goes back by more than a small share of its span."""
    x = fill(recording.channels[name])
    limit = rules.reversal_share * float(np.ptp(x))
    fall = float(np.max(np.maximum.accumulate(x) - x))
    rise = float(np.max(x - np.minimum.accumulate(x)))
    return fall > limit and rise > limit
