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
from host.diagnosis.estimation.fit import Fit, Problem
from host.diagnosis.estimation.rules import RULES, Budget, SelectionRules
from host.diagnosis.estimation.uncertainty import idle_inputs, intervals, uncertain
from host.diagnosis.model.dataset import Recording
from host.diagnosis.model.findings import Finding, Inspected
from host.diagnosis.model.model import Model
from host.diagnosis.model.nominal import NominalSpec
from host.diagnosis.model.pairs import driven_of
from host.diagnosis.model.progress import Overall
from host.diagnosis.model.tables import Table
from host.diagnosis.models.simulated import driven_along
from host.diagnosis.problems import (
    candidates_of,
    inspected,
    problem_of,
    problems,
    thinning,
)
from host.diagnosis.second_search import Again, Searched, past_held_values, past_sampling
from host.diagnosis.selection.apart_from_model import outliers_of_residual
from host.diagnosis.selection.between_recordings import inadequate, unlike_recordings
from host.diagnosis.selection.corners import over_alike
from host.diagnosis.selection.down_to_noise import at_white_noise, ran_away
from host.diagnosis.selection.drifting import drifting
from host.diagnosis.selection.early import early_outputs
from host.diagnosis.selection.equivalence import (
    Standing,
    most_probable,
    standings,
    with_unlisted_rival,
    without_improbable,
)
from host.diagnosis.selection.found import Found
from host.diagnosis.selection.frozen_inputs import without_frozen
from host.diagnosis.selection.full_rate import Figures, FullRate, at_full_rate, figures_of, fits_at_full_rate
from host.diagnosis.selection.locate import Location, locate, unexplained
from host.diagnosis.selection.readings_apart import readings_apart
from host.diagnosis.selection.refits import fit_nominal
from host.diagnosis.selection.remarks import (
    jumps_in_level,
    larger_than_noise,
    lines_in_spectrum,
    noise_of_motion,
    not_explained,
    read_seldom,
    slow_noise,
    times_noise,
)
from host.diagnosis.selection.sampling import hold_between_samples, lead_instead
from host.diagnosis.selection.search import concluded, forward
from host.diagnosis.selection.trial import within_sample
from host.diagnosis.selection.unlisted import Remainder, explain_remainder, slow_outputs, structured_outputs
from host.diagnosis.selection.within_recordings import changed_within

Array = npt.NDArray[np.float64]
Progress = Callable[[str, float], None]
FIRST_SHARE = 0.6  # of the progress of a search that a second one may follow
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # of glibc's mallopt


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
        budget, twice = Budget(time_budget_s), _may_have_forces_inside(spec)
        overall = Overall(_share_of(progress, 0.0, FIRST_SHARE) if twice else progress)
        overall.part(0.0, 0.02)("reading recordings", 0.0)
        data = clocks_put_right(spec, inspected(spec, sources, rules), left_out, rules)
        first = _diagnosed(spec, data, overall, left_out, rules, budget)
        if not twice:
            return first
        if budget.spent() or not _unexplained(first):
            progress("done", 1.0)
            return first
        overall = Overall(_share_of(progress, FIRST_SHARE, 1.0))
        second = _diagnosed(_with_forces_inside(spec), data, overall, left_out, rules, budget)
        return second if _explains_more(second, first) else first


def _may_have_forces_inside(spec: NominalSpec) -> bool:
    """Whether forces along measured motions may be missing in a simulator, and are not among its candidates."""
    section, units = spec.simulator, {name: channel.unit for name, channel in spec.channels.items()}
    if section is None or section.forces_inside or spec.kind == "linear":
        return False
    return bool(driven_along(section, units))


def _with_forces_inside(spec: NominalSpec) -> NominalSpec:
    """`spec` with forces along measured motions among the candidates of its simulator."""
    assert spec.simulator is not None
    return spec.model_copy(update={spec.kind: spec.simulator.model_copy(update={"forces_inside": True})})


def _share_of(progress: Progress, low: float, high: float) -> Progress:
    return lambda what, share: progress(what, low + (high - low) * share)


def _unexplained(result: Diagnosis) -> bool:
    """Whether more is left than noise, which may be a guess: a further search is worth its time."""
    ratios = times_noise(result.full, result.full_rate, result.figures)
    return result.remainder.sure or bool(np.any(ratios > result.full.rules.residual_over_noise))


def _explains_more(second: Diagnosis, first: Diagnosis) -> bool:
    """Whether forces inside the simulator are named, and leave less of the output that is compared."""
    inside = any(term.candidate.port.against for term in second.found.best.terms)
    row, most = first.figures.primary, 1.0 - first.problem.rules.refinement_error_reduction
    less = second.figures.after[row] < most * first.figures.after[row]
    return second.verdict == "missing_physics" and inside and bool(less)


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
    data: Inspected,
    overall: Overall,
    left_out: frozenset[str],
    rules: SelectionRules,
    budget: Budget,
) -> Diagnosis:
    """The diagnosis of recordings that were read."""
    done = None
    axis = spec.axis
    if axis is not None and axis.runs_away and axis.compare is None:
        by_motion = _by_motion(spec)
        done = _searched(by_motion, data, left_out, rules, _third(budget), overall, (0.02, 0.3), to_noise=True)
        if done is not None:
            spec = by_motion
            done.problem.budget = budget
    done = done or _searched(spec, data, left_out, rules, budget, overall, (0.3 if axis is not None else 0.02, 0.7))
    assert done is not None
    problem, full, found = done.problem, done.full, done.found
    model = problem.model
    overall.part(0.7, 0.75)("comparing rivals in the place of each effect", 0.0)
    standing = most_probable(problem, found)
    named_before = found.best
    remainder = explain_remainder(problem, found, overall.part(0.75, 0.85))
    if found.best is not named_before:  # an equation took the place of effects
        standing = standings(problem, found)
    while fewer := without_improbable(problem, found, standing, remainder):
        standing, remainder = fewer
    between = [] if budget.spent() else _parameters_differ(full, problem, found)
    if not between and (found.best.terms or remainder.sure):
        between = drifting(problem, found)
    if between and found.best.terms:
        found.best, standing = fit_nominal(problem), []
    standing = with_unlisted_rival(standing, remainder)
    overall.part(0.85, 0.9)("intervals", 0.0)
    alike = [intervals(problem, fit) for fit in found.alike]
    spans = over_alike(problem, found, intervals(problem, found.best), alike)
    fits = fits_at_full_rate(full, found, problem)
    located, figures = locate(full, found, fits), figures_of(full, fits)
    result = Diagnosis(spec, model, problem, full, found, fits, standing, spans, located, figures)
    result.remainder = remainder
    result.findings = [
        *data.findings,
        *done.findings,
        *noise_of_motion(problem),
        *read_seldom(full),
        *between,
        *lead_instead(problem, found, standing),
        *idle_inputs(problem, found.best),
        *uncertain(problem, found.best, spans),
        *done.contradicted(spans),
        *model.findings(),
    ]
    result.findings.sort(key=lambda finding: finding.id != "frozen")  # it is to be corrected before anything else
    if not found.best.terms and remainder.sure:
        result.findings += jumps_in_level(full, fits)
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
        result.findings += lines_in_spectrum(full, fits)
    if result.verdict == "nothing_missing":
        slow = slow_outputs(problem, found.best)
        # a delay or lead that is not named explains what exceeds the noise
        late = any(finding.id in ("within_sample", "clock") for finding in done.findings)
        result.findings += slow_noise(full, fits, slow) or ([] if late else larger_than_noise(full, fits, figures))
    known = between or any(finding.id in ("jump", "line") for finding in result.findings)
    if result.verdict == "mismatch_not_identified" and not found.best.terms and not known:
        result.findings += not_explained(full, fits, figures, structured_outputs(problem, found.best))
    if not located and remainder.sure and remainder.predicted is not None:
        result.located = [unexplained(full, fits, remainder.predicted.subsystem)]
    overall.end()
    return result


def _parameters_differ(full: Problem, problem: Problem, found: Found) -> list[Finding]:
    """What shows that the recordings, or two parts of one, have different nominal parameters."""
    nominal, rival = found.nominal, inadequate(problem, found.best)
    if rival is None:
        return []
    whole = [segment.recording for segment in full.segments]
    factor = thinning(problem.model, whole) if full is not problem else 1

    def prepared(recordings: list[Recording]) -> Problem:
        return problem_of(problem.model, recordings, problem.columns, problem.rules, factor)

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
    effects = candidates_of(problem, left_out)
    recordings, findings = early_outputs(problem, data.recordings, effects)
    return Inspected(recordings, [*data.findings, *findings])


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
) -> Searched | None:
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
    candidate_effects = candidates_of(problem, left_out)
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
    begun = Searched(problem, full, found, [*apart, *frozen, *lone, *held])
    again = Again(spec, recordings, candidate_effects, overall.part(later, high))
    again, begun = past_held_values(again, begun)
    return past_sampling(again, begun)


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
