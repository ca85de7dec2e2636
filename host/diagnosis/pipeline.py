"""One diagnosis from files to findings: load, noise, search, equals, intervals, location, figures on untouched samples."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from host.diagnosis.design.experiment import Design, design
from host.diagnosis.effects import candidates
from host.diagnosis.estimation import noise as noise_module
from host.diagnosis.estimation.coloured import independent_samples
from host.diagnosis.estimation.evidence import whiteness
from host.diagnosis.estimation.fit import Fit, Problem
from host.diagnosis.estimation.jumps import jumps_of
from host.diagnosis.estimation.known import Known
from host.diagnosis.estimation.noise import Noise
from host.diagnosis.estimation.rules import RULES, Budget, SelectionRules
from host.diagnosis.estimation.uncertainty import idle_inputs, intervals, uncertain
from host.diagnosis.live.recorded_rig import RecordedRig
from host.diagnosis.model import readings
from host.diagnosis.model.dataset import Recording, load, read_tables, thin
from host.diagnosis.model.effect import Candidate, Port
from host.diagnosis.model.findings import Finding, Inspected, inspect
from host.diagnosis.model.model import Model, Segment
from host.diagnosis.model.nominal import EffectSpec, NominalSpec
from host.diagnosis.model.pairs import driven_of
from host.diagnosis.model.progress import Overall
from host.diagnosis.model.spectral_line import common_line, distorted
from host.diagnosis.model.tables import Table
from host.diagnosis.models import build, channels_of
from host.diagnosis.selection.apart_from_model import outliers_of_residual
from host.diagnosis.selection.between_recordings import inadequate, unlike_recordings
from host.diagnosis.selection.down_to_noise import at_white_noise, ran_away
from host.diagnosis.selection.early import early_outputs
from host.diagnosis.selection.equivalence import (
    Standing,
    most_probable,
    probability_of,
    standings,
    with_unlisted_rival,
    without_improbable,
)
from host.diagnosis.selection.found import Found
from host.diagnosis.selection.frozen_inputs import without_frozen
from host.diagnosis.selection.locate import Condition, condition, inside, joined, mismatch_of, windows
from host.diagnosis.selection.readings_apart import readings_apart
from host.diagnosis.selection.refits import fit_nominal
from host.diagnosis.selection.sampling import hold_between_samples, late_by_a_sample
from host.diagnosis.selection.screening import without
from host.diagnosis.selection.search import concluded, forward, search
from host.diagnosis.selection.trial import Trial, within_sample
from host.diagnosis.selection.unlisted import Remainder, explain_remainder, slow_outputs
from host.diagnosis.selection.within_recordings import changed_within
from host.diagnosis.symbolic.dictionary import lay_out
from protocol.errors import InputError

Array = npt.NDArray[np.float64]
Progress = Callable[[str, float], None]
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # of glibc's mallopt


@dataclass
class Location:
    """One subsystem with a mismatch: where and when."""

    subsystem: str
    channels: list[str]
    windows_s: dict[str, list[tuple[float, float]]]  # of every recording, in its file's own time
    condition: Condition | None
    residual_share: float


@dataclass(frozen=True)
class FullRate:
    """The nominal and the best fit with their residuals on all samples of the recordings."""

    nominal: Fit
    best: Fit


@dataclass
class Figures:
    """RMSE on held-out samples at full rate, per output."""

    before: Array
    after: Array
    noise_sd: Array
    white_before: Array
    white_after: Array
    primary: int


@dataclass
class Diagnosis:
    """All that a verdict and a report are made of."""

    spec: NominalSpec
    model: Model
    problem: Problem
    full: Problem
    found: Found
    full_rate: FullRate
    standings: list[Standing]
    intervals: list[tuple[float, float]]
    located: list[Location]
    figures: Figures
    verdict: str = "nothing_missing"
    remainder: Remainder = field(default_factory=lambda: Remainder(None, 0.0))
    designs: list[Design] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)
    stopped_early: bool = False


class NothingToCompare(Exception):
    """No recording has what the nominal model compares; `findings` say why."""

    def __init__(self, findings: list[Finding]) -> None:
        super().__init__(" ".join(finding.says for finding in findings))
        self.findings = findings


def inspected(spec: NominalSpec, sources: Sequence[Path | Table], rules: SelectionRules = RULES) -> Inspected:
    """Recordings as they can be compared, and what is wrong with them. Raises InputError, NothingToCompare."""
    if spec.recorded_rig and not all(isinstance(source, Path) for source in sources):
        raise InputError("recordings", "arrays", "files (MCAP): a recorded rig is described in its own recordings")
    tables = read_tables(spec, sources)
    spec._files = [table.path for table in tables if table.path is not None]
    needed, optional = channels_of(spec)
    data = inspect(spec, load(spec, tables, needed, optional, rules.data), rules.data)
    if not data.recordings:
        raise NothingToCompare(data.findings)
    return data


def prepare(
    spec: NominalSpec, sources: Sequence[Path | Table], rules: SelectionRules = RULES
) -> tuple[Model, Problem, Problem]:
    """Model, the problem at the rate that is fitted, and the problem at full rate. Raises InputError, NothingToCompare."""
    return problems(spec, inspected(spec, sources, rules).recordings, rules)


def problems(
    spec: NominalSpec, recordings: list[Recording], rules: SelectionRules = RULES
) -> tuple[Model, Problem, Problem]:
    """Model, the problem at the rate that is fitted, and the problem at full rate."""
    model: Model = RecordedRig(spec) if spec.recorded_rig else build(spec)
    if spec.effect:
        model = Known(model, spec.effect, recordings)
    factor = thinning(model, recordings)
    columns = {name: channel.column for name, channel in channels_of(spec)[0].items()}
    full = _problem(model, recordings, columns, rules)
    if factor <= 1:
        return model, full, full
    return model, _problem(model, [thin(r, factor) for r in recordings], columns, rules), full


def thinning(model: Model, recordings: list[Recording]) -> int:
    """Samples averaged into one, so that a fit stays in seconds; never coarser than the model allows."""
    total = sum(r.n for r in recordings)
    factor = max(1, round(total / model.fit_samples))
    if recordings[0].timed:
        factor = min(factor, max(1, int(model.coarsest_s / recordings[0].dt_s + 1e-9)))
    return factor


def _problem(model: Model, recordings: list[Recording], columns: dict[str, str], rules: SelectionRules) -> Problem:
    segments = [model.prepare(r) for r in recordings]
    still = [
        noise_module.quiescent([p.inputs[name] for name in model.quiet_inputs], p.recording.dt_s, p.recording.timed, rules)
        for p in segments
    ]
    repeats = noise_module.repeated([[p.inputs[name] for name in model.quiet_inputs] for p in segments], rules)
    noises: list[Noise] = []
    for row in range(len(model.outputs)):
        # single wild samples would raise the noise by which they are found
        tame = [
            np.where(readings.wild(p.y[row], readings.scatter(p.y[row]), rules.data), np.nan, p.y[row]) for p in segments
        ]
        found = noise_module.estimate(tame, still, repeats, model.simulates, rules)
        seldom = [readings.repeated(p.y[row], rules.data) for p in segments]
        for segment, places in zip(segments, seldom, strict=True):
            if places is not None:
                segment.repeats[row] = places
        if any(places is not None for places in seldom):  # the noise of readings, not of their repetitions
            kept = [slice(None) if places is None else np.unique(places) for places in seldom]
            read = [y[k] for y, k in zip(tame, kept, strict=True)]
            alone = noise_module.estimate(read, [m[k] for m, k in zip(still, kept, strict=True)], rules=rules)
            found = replace(found, sigma=max(found.sigma, alone.sigma))
        own = [noise for noise in (model.noise_of(p) for p in segments) if noise is not None]
        if own:
            found = sorted(own, key=lambda noise: noise.sigma)[len(own) // 2]
        noises.append(found)
        for segment in segments:
            segment.y[row, readings.wild(segment.y[row], found.sigma, rules.data)] = np.nan
    for segment in segments:
        segment.resolution = np.array([readings.resolution(y, rules.data, switched=False) for y in segment.y]) / np.sqrt(
            12.0
        )
    return Problem(model, segments, noises, np.ones(len(model.outputs)), columns, rules)


def diagnose(
    spec: NominalSpec,
    sources: Sequence[Path | Table],
    progress: Progress,
    left_out: frozenset[str] = frozenset(),
    rules: SelectionRules = RULES,
    time_budget_s: float | None = None,
) -> Diagnosis:
    """The whole diagnosis. `left_out`: effect ids that are not considered (leave-one-out proof).

    Raises:
        InputError: the recordings do not fit the nominal model's file.
        NothingToCompare: a channel that the comparison needs says nothing.
    """
    _keep_freed_memory()
    with threadpool_limits(1, "blas"):  # products of a few columns: threads that wait for each other took 4 times the work
        return _diagnosed(spec, sources, progress, left_out, rules, Budget(time_budget_s))


def _keep_freed_memory() -> None:
    """Let glibc keep up to 256 MiB of freed memory, where it is the C library.

    A fit frees and allocates the same arrays again and again. Pages that are returned to the system each time and cleared
    again took two fifths of the processor time of some diagnoses of axes.
    """
    if sys.platform == "linux":
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
        if mallopt is not None:
            mallopt(M_TRIM_THRESHOLD, 256 << 20)
            mallopt(M_MMAP_THRESHOLD, 32 << 20)


def _diagnosed(
    spec: NominalSpec,
    sources: Sequence[Path | Table],
    progress: Progress,
    left_out: frozenset[str],
    rules: SelectionRules,
    budget: Budget,
) -> Diagnosis:
    overall = Overall(progress)
    overall.part(0.0, 0.02)("reading recordings", 0.0)
    data, done = clocks_put_right(spec, inspected(spec, sources, rules), left_out, rules), None
    axis = spec.axis
    if axis is not None and axis.runs_away and axis.compare is None:
        by_motion = _by_motion(spec)
        done = _searched(by_motion, data, left_out, rules, _third(budget), overall, (0.02, 0.3), to_noise=True)
        if done is not None:
            spec = by_motion
            done.problem.budget = budget
    done = done or _searched(spec, data, left_out, rules, budget, overall, (0.3 if axis is not None else 0.02, 0.7))
    assert done is not None
    model, problem, full, found = done.model, done.problem, done.full, done.found
    overall.part(0.7, 0.75)("comparing rivals in the place of each effect", 0.0)
    standing = most_probable(problem, found)
    named_before = found.best
    remainder = explain_remainder(problem, found, overall.part(0.75, 0.85))
    if found.best is not named_before:  # an equation took the place of effects
        standing = standings(problem, found)
    while fewer := without_improbable(problem, found, standing, remainder):
        standing, remainder = fewer
    probable = max((probability_of(one, remainder.share, problem.rules).effect for one in standing), default=0.0)
    same = found.best if probable >= problem.rules.further_probability else found.nominal
    between = [] if budget.spent() else _parameters_differ(full, problem, found.nominal, same)
    if between and found.best.terms:
        found.best, standing = fit_nominal(problem), []
    standing = with_unlisted_rival(standing, remainder)
    overall.part(0.85, 0.9)("intervals", 0.0)
    spans = intervals(problem, found.best)
    fits = _fits_at_full_rate(full, found, problem)
    located, figures = _locate(full, found, fits), _figures(full, fits)
    result = Diagnosis(spec, model, problem, full, found, fits, standing, spans, located, figures)
    result.remainder = remainder
    result.findings = [
        *data.findings,
        *done.findings,
        *_fed_back(problem),
        *_repeated(full),
        *between,
        *idle_inputs(problem, found.best),
        *uncertain(problem, found.best, spans),
        *model.findings(),
    ]
    result.findings.sort(key=lambda finding: finding.id != "frozen")  # it is to be corrected before anything else
    if not found.best.terms and remainder.sure:
        result.findings += _jumps(full, fits)
    result.designs = [] if budget.spent() else design(problem, found, standing, overall.part(0.9, 1.0))
    result.stopped_early = budget.spent()
    piled = remainder.doubtful and len(found.best.terms) > problem.rules.partial_effects
    named = bool(found.best.terms) and not piled
    result.verdict = (
        "missing_physics"
        if named
        else "mismatch_not_identified"
        if remainder.sure or found.best.terms or between
        else "nothing_missing"
    )
    if not found.best.terms:
        result.findings += _lines(full, fits)
    if result.verdict == "nothing_missing":
        slow = slow_outputs(problem, found.best)
        late = any(finding.id == "within_sample" for finding in done.findings)  # it explains what exceeds the noise
        result.findings += _too_slow(full, fits, slow) or ([] if late else _above_guess(full, figures, problem.rules))
    if not located and remainder.sure and remainder.predicted is not None:
        result.located = [_unexplained(full, fits, remainder.predicted.subsystem)]
    overall.end()
    return result


def _parameters_differ(full: Problem, problem: Problem, nominal: Fit, same: Fit) -> list[Finding]:
    """What shows that the recordings, or two parts of one, have different nominal parameters.

    same: the best model that has the same parameters throughout.
    """
    rival = inadequate(problem, same)
    if rival is None:
        return []
    whole = [segment.recording for segment in full.segments]
    factor = thinning(problem.model, whole) if full is not problem else 1

    def prepared(recordings: list[Recording]) -> Problem:
        return _problem(problem.model, [thin(r, factor) for r in recordings], problem.columns, problem.rules)

    return unlike_recordings(problem, nominal, rival) or changed_within(problem, nominal, rival, whole, prepared)


def _by_motion(spec: NominalSpec) -> NominalSpec:
    """`spec` with an axis that is compared by its motion."""
    return (
        spec if spec.axis is None else spec.model_copy(update={"axis": spec.axis.model_copy(update={"compare": "motion"})})
    )


def clocks_put_right(spec: NominalSpec, data: Inspected, left_out: frozenset[str], rules: SelectionRules) -> Inspected:
    """`data` with outputs that precede their inputs shifted back, and what was found.

    An impedance differentiates its input, for which it needs later samples. Its law was compared before (`inspect`).
    """
    axis = spec.axis
    if spec.impedance is not None or spec.recorded_rig or spec.kind == "rig":
        return data
    if axis is not None and axis.runs_away and axis.compare == "force":
        return data
    model, problem, _ = problems(spec if axis is None else _by_motion(spec), data.recordings, rules)
    model.try_out(problem.segments)
    effects = _candidates(problem, left_out)
    recordings, findings = early_outputs(problem, data.recordings, effects)
    return Inspected(recordings, [*data.findings, *findings])


def _candidates(problem: Problem, left_out: frozenset[str]) -> list[Candidate]:
    """Candidate effects of a problem, whose initial states are fitted together with the parameters on a linear path."""
    ports = candidate_ports(problem)
    problem.joint_states = any(port.path for port in ports)
    found = candidates(ports, problem.segments[0].recording.timed, problem.model.taken | left_out)
    return [candidate for candidate in found if candidate.effect.id not in left_out]


def _third(budget: Budget) -> Budget:
    return replace(budget, seconds=None if budget.seconds is None else budget.seconds / 3.0)


def _searched(
    spec: NominalSpec,
    data: Inspected,
    left_out: frozenset[str],
    rules: SelectionRules,
    budget: Budget,
    overall: Overall,
    share: tuple[float, float],
    to_noise: bool = False,
) -> _Searched | None:
    """Search in all recordings, between two shares of the whole work; `left_out`: effect ids that are not considered.

    to_noise: None unless single effects explain the outputs down to white noise.
    """
    low, high = share
    begin, later = low + 0.02 * (high - low), low + 0.85 * (high - low)
    model, problem, full = problems(spec, data.recordings, rules)
    model.try_out(problem.segments)
    recordings, apart = readings_apart(problem, data.recordings)
    if apart:
        model, problem, full = problems(spec, recordings, rules)
    recordings, frozen = _without_frozen(spec, problem, recordings)
    if frozen:
        model, problem, full = problems(spec, recordings, rules)
    recordings, lone = _without_lone_samples(problem, full, recordings)
    if lone:
        model, problem, full = problems(spec, recordings, rules)
    problem.budget = budget
    candidate_effects = _candidates(problem, left_out)
    held = hold_between_samples(problem, [full] if full is not problem else [], candidate_effects)
    cost = model.announce(problem.segments, model.guess(problem.segments))
    if cost:
        overall.part(low, begin)(cost, 0.0)
    progress = overall.part(begin, later)
    if to_noise and ran_away(problem, fit_nominal(problem)):
        return None
    found = forward(problem, candidate_effects, progress)
    late = within_sample(found.last_trials, found.best)
    if to_noise and not at_white_noise(problem, found.best if late is None else late.fit):
        return None
    found = concluded(problem, found, candidate_effects, progress)
    begun = _Searched(model, problem, full, found, [*apart, *frozen, *lone, *held])
    return _past_sampling(spec, begun, recordings, candidate_effects, overall.part(later, high))


@dataclass(frozen=True)
class _Searched:
    """What was searched, and what was found in it."""

    model: Model
    problem: Problem
    full: Problem
    found: Found
    findings: list[Finding]  # what was found about the data on the way


def _past_sampling(
    spec: NominalSpec,
    begun: _Searched,
    recordings: list[Recording],
    candidate_effects: Sequence[Candidate],
    progress: Progress,
) -> _Searched:
    """What a second search finds, with a delay within one sample among the nominal parameters, where the data call for one.

    Such a delay is not named, because it may be a matter of the recording. It still hides what else is missing.
    """
    late = within_sample(begun.found.last_trials, begun.found.best)
    if late is None:
        return begun
    if not begun.problem.budget.spent():
        past = _past_delay(spec, late, begun, recordings, candidate_effects, progress)
        if past is not None:
            return past
    if begun.found.best.terms:
        return begun
    return replace(begun, findings=[*begun.findings, *late_by_a_sample(begun.problem, late)])


def _past_delay(
    spec: NominalSpec,
    late: Trial,
    begun: _Searched,
    recordings: list[Recording],
    candidate_effects: Sequence[Candidate],
    progress: Progress,
) -> _Searched | None:
    """The search with the delay of `late` among the nominal parameters; None if that names nothing better.

    What is named may be no shape of the delay: its gain has to be that of a further effect, it is not a linear effect at the
    place of the delay, and the delay stays within the sample.
    """
    candidate, term, problem = late.candidate, late.fit.terms[-1], begun.problem
    values = {p.key: float(value) for p, value in zip(term.parameters, late.fit.values_of(term), strict=True)}
    known = EffectSpec(
        id=candidate.effect.id, at=candidate.port.name, values=values, source=candidate.source, form=candidate.form
    )
    model, again, full = problems(spec.model_copy(update={"effect": [*spec.effect, known]}), recordings, problem.rules)
    again.budget, again.joint_states = problem.budget, problem.joint_states
    for each in (again, full):
        model.hold_as(each.segments, problem.model.hold)
    others = [c for c in candidate_effects if not (c.effect.shifts and c.port.held)]
    found = search(again, others, progress, late.both.log_likelihood)
    place = {*candidate.port.path, candidate.port.name}
    own = [t for t in found.best.terms if not (t.candidate.effect.invariant and t.candidate.port.name in place)]
    delay_s = found.best.values[len(problem.model.parameters) : len(model.parameters)]
    if not own or float(np.sum(np.abs(delay_s))) > problem.rules.sampling_delay * problem.segments[0].recording.dt_s:
        return None
    before, rules = late.fit.residuals, problem.rules
    ahead = problem.gain("both", before, found.best.residuals).log_likelihood
    earned = problem.gain("both", begun.found.nominal.residuals, before).log_likelihood
    if ahead < -max(rules.heldout_log_likelihood, rules.refinement_tolerance * earned):
        return None
    return _Searched(model, again, full, found, [*begun.findings, *late_by_a_sample(again, late, past=True)])


def _without_frozen(
    spec: NominalSpec, problem: Problem, recordings: list[Recording]
) -> tuple[list[Recording], list[Finding]]:
    """Recordings without the runs in which a channel is frozen, and what was found. Those of a rig are not looked at."""

    def fitted(parts: list[Recording]) -> Fit:
        _, own, full = problems(spec, parts, problem.rules)
        return at_full_rate(full, fit_nominal(own), own)

    if spec.kind == "rig":
        return recordings, []
    outputs = [output.channel for output in problem.model.outputs]
    return without_frozen(recordings, driven_of(spec), outputs, problem.columns, fitted, problem.rules.data)


def _without_lone_samples(
    problem: Problem, full: Problem, recordings: list[Recording]
) -> tuple[list[Recording], list[Finding]]:
    """Recordings without samples that stand alone in the residual of the nominal model, and what was found."""
    read = {output.channel for output in problem.model.outputs} & {name for r in recordings for name in r.channels}
    if not read:
        return recordings, []
    nominal = fit_nominal(problem)
    return outliers_of_residual(full, at_full_rate(full, nominal, problem), recordings)


def _repeated(full: Problem) -> list[Finding]:
    """Sentences on sensors that are read more seldom than they are logged."""
    findings = []
    for row, output in enumerate(full.model.outputs):
        segment = next((segment for segment in full.segments if row in segment.repeats), None)
        if segment is None:
            continue
        column = full.columns.get(output.channel, output.channel)
        samples = int(np.median(np.diff(np.unique(segment.repeats[row]))))
        period = samples * segment.recording.dt_s
        timed = f", every {period:.4g} s" if segment.recording.timed else ""
        says = (
            f"Column {column} repeats each reading for {samples} samples{timed}: its sensor is read more seldom than it is "
        )
        says += "logged. The simulated readings are repeated likewise. A delay up to this period may be the sensor's."
        findings.append(Finding("repeated", column, says))
    return findings


def _lines(full: Problem, fits: FullRate) -> list[Finding]:
    """Sentences on lines in the spectrum of the nominal residual that no effect explains."""
    if not full.segments[0].recording.timed:
        return []
    findings = []
    periods = [segment.recording.dt_s for segment in full.segments]
    read = {output.channel for output in full.model.outputs}
    inputs = [
        [u for name, u in segment.inputs.items() if name in segment.recording.channels and name not in read]
        for segment in full.segments
    ]
    for row, output in enumerate(full.model.outputs):
        residuals = [r[row] for r in fits.nominal.residuals]
        simulated = [segment.y[row] - r for segment, r in zip(full.segments, residuals, strict=True)]
        known = [[*own, *distorted(said)] for own, said in zip(inputs, simulated, strict=True)]
        line = common_line(residuals, known, simulated, periods, full.rules.data)
        if line is None:
            continue
        column = full.columns.get(output.channel, output.channel)
        says = f"The residual of column {column} has a sine of {line.frequency_Hz:.4g} Hz, amplitude {line.amplitude:.3g} "
        says += (
            f"{output.unit}, in every recording. No input has this frequency, and the simulated output hardly moves at it: "
        )
        says += "a hum, a vibration or a rotating part is not in the nominal model."
        findings.append(Finding("line", column, says))
    return findings


def _fed_back(problem: Problem) -> list[Finding]:
    """A sentence where effects were not tried because the residual is noise of the motion, which a law with memory cancels:
    a controller fed it back into the input, or the nominal law passes it on.
    """
    names = [problem.columns.get(name, name) for name in problem.model.quiet_inputs]
    if problem.noise_passed > problem.rules.noise_passed_share and not problem.noise_fed:
        says = (
            f"The noise of column {names[0]} makes most of the residual, through the nominal law. No delay, lag, resonance "
        )
        says += "or second mass was tried: a law with memory can cancel this noise, so these recordings cannot show one. "
        says += "Read the motion with less noise, or record slower motions."
        return [Finding("noise_passed_on", names[0], says)]
    if not problem.noise_fed:
        return []
    says = f"A controller computes column {names[0]} from the recorded motion, whose noise is most of the residual. No "
    says += "delay, lag, resonance or second mass was tried: a law with memory can cancel this noise, so these recordings "
    says += "cannot show one. Record in open loop, or read the motion with less noise."
    return [Finding("noise_fed_back", names[0], says)]


def _too_slow(full: Problem, fits: FullRate, rows: list[int]) -> list[Finding]:
    """Sentences on outputs whose residual wanders so slowly that it is noise or a mismatch, and data cannot tell which."""
    findings = []
    for row in rows:
        output, residuals = full.model.outputs[row], [r[row] for r in fits.best.residuals]
        column = full.columns.get(output.channel, output.channel)
        says = f"The residual of column {column}, {rms(residuals):.3g} {output.unit} RMS, has only "
        says += f"{independent_samples(residuals):.0f} independent samples. No structure is common to the recordings. "
        says += "These data cannot separate slow noise from a mismatch: record five times as long, or repeat the motion."
        findings.append(Finding("slow_noise", column, says))
    return findings


def _above_guess(full: Problem, figures: Figures, rules: SelectionRules) -> list[Finding]:
    """Sentences on outputs whose residual is larger than a noise that was never seen alone: it may be noise all the same."""
    findings = []
    for output, left, noise in zip(full.model.outputs, figures.after, full.noise, strict=True):
        if noise.source.seen_alone or not left > rules.residual_over_noise * noise.sigma:
            continue
        column = full.columns.get(output.channel, output.channel)
        ratio = left / max(noise.sigma, 1e-300)
        says = f"The residual of column {column}, {left:.3g} {output.unit} RMS, is {ratio:.2g} times the noise that its "
        says += "spectrum suggests. The noise was never recorded alone, so this may be slower noise, or a mismatch that no "
        says += "effect explains: record some seconds at rest, or the same motion twice."
        findings.append(Finding("noise_unseen", column, says))
    return findings


def _jumps(full: Problem, fits: FullRate) -> list[Finding]:
    """Sentences on jumps of the nominal residual that no effect explains, such as those of a sensor that was moved."""
    findings = []
    for row, output in enumerate(full.model.outputs):
        jumps = jumps_of([r[row] for r in fits.nominal.residuals], full.rules)
        if not jumps:
            continue
        places = []
        for jump in jumps:
            recording = full.segments[jump.recording].recording
            at = recording.begin_s + float(recording.time_s[jump.sample])
            places.append(
                f"{jump.size:+.3g} {output.unit} at {at:.4g} {'s' if recording.timed else 'samples'} of {recording.name}"
            )
        column = full.columns.get(output.channel, output.channel)
        says = f"The level of column {column} jumps past what the nominal model predicts: {'; '.join(places)}. "
        says += "A sensor was moved, or an axis lost steps: an event, not a law of the model. It is not corrected."
        findings.append(Finding("jump", column, says))
    return findings


def candidate_ports(problem: Problem) -> tuple[Port, ...]:
    """Ports of the model, each with those at which a linear time-invariant effect does the same."""
    first = next(segment for segment in problem.segments if segment.fit.any())
    path = problem.model.linear_path(first, problem.model.guess(problem.segments))
    return tuple(replace(port, path=path) if port.name in path else port for port in problem.model.ports)


def _unexplained(full: Problem, fits: FullRate, subsystem: str) -> Location:
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


def at_full_rate(full: Problem, fit: Fit, like: Problem) -> Fit:
    """`fit` simulated on the samples of `full`."""
    for segment, coarse in zip(full.segments, like.segments, strict=True):
        segment.start = coarse.start
        if not fit.terms:
            full.model.settle(segment, fit.values)
        if segment.begin is not None and coarse.begin is not None:
            segment.begin.values = coarse.begin.values
    again = replace(fit)
    again.residuals = [full.left(segment, fit.terms, fit.values) for segment in full.segments]
    return again


def _fits_at_full_rate(full: Problem, found: Found, coarse: Problem) -> FullRate:
    """Both fits on the samples of `full`, whose segments then hold the equations, and the states of the best fit."""
    nominal = at_full_rate(full, found.nominal, coarse)
    for form in found.forms:
        lay_out(full.segments, form)
    return FullRate(nominal, at_full_rate(full, found.best, coarse))


def _figures(full: Problem, fits: FullRate) -> Figures:
    rows = range(len(full.noise))
    before, after, white_b, white_a = (np.zeros(len(full.noise)) for _ in range(4))
    nominal, best = fits.nominal, fits.best
    for row in rows:
        for store, fit in ((before, nominal), (after, best)):
            store[row] = rms([r[row][p.heldout] for r, p in zip(fit.residuals, full.segments, strict=True)])
        for store, fit in ((white_b, nominal), (white_a, best)):
            masks, noise = [p.heldout for p in full.segments], full.noise[row]
            # The colour of the noise is an estimate: a residual that is white itself must not fail for a wrong one.
            coloured = whiteness([noise.whiten(r[row]) for r in fit.residuals], masks)
            white = whiteness([r[row] / noise.sigma for r in fit.residuals], masks) if noise.sigma > 0.0 else 0.0
            store[row] = max(coloured, white)
    ratio = np.where(after > 0, before / np.maximum(after, 1e-300), 1.0)
    used = np.isfinite(before) & (before > 0)
    primary = int(np.argmax(np.where(used, ratio, 0.0)))
    # The residual is noise and perhaps more: an estimate above it, of parts taken for rest, is too high.
    left = np.array([rms([r[row] for r in best.residuals]) for row in rows])
    noise_sd = np.fmin(full.noise_sd, np.where(left > 0.0, left, np.nan))
    return Figures(before, after, noise_sd, white_b, white_a, primary)


def rms(parts: list[Array]) -> float:
    """Return the RMS of all finite samples of `parts`, NaN where there are none."""
    together = np.concatenate(parts)
    together = together[np.isfinite(together)]
    return float(np.sqrt(np.mean(together**2))) if together.size else float("nan")


def _locate(full: Problem, found: Found, fits: FullRate) -> list[Location]:
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
            joined([span for row in strong for span in _windows(segment, m[row], full.rules)], full.rules)
            for segment, m in zip(full.segments, alone, strict=True)
        ]
        share = _share(full, fits, spans, top)
        where = condition(full, alone, top, max(1, sum(p.n for p in full.segments) // 20000))
        out.append(
            Location(subsystem, [full.model.outputs[row].channel for row in rows], _by_recording(full, spans), where, share)
        )
    return out


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


def _windows(segment: Segment, change: Array, rules: SelectionRules) -> list[tuple[float, float]]:
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
