"""Cross-validation over recordings, where those held out hardly excite an effect that the others call for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from host.diagnosis.estimation.evidence import Gain
from host.diagnosis.estimation.fit import Fit, Problem, finish, get_starts, minimize, set_starts
from host.diagnosis.estimation.initial_state import begun_again, start_again
from host.diagnosis.model.model import Segment
from host.diagnosis.selection.trial import Trial, at_bound, called_for, of_sampling, refuted, vanished

Array = npt.NDArray[np.float64]


def with_other_recordings(problem: Problem, base: Fit, trials: list[Trial]) -> None:
    """Give each trial that only the recordings to fit call for its gain by cross-validation (`Trial.crossed`)."""
    begun = get_starts(problem)
    possible = [
        trial
        for trial in trials
        if not (at_bound(trial.fit) or of_sampling(trial) or called_for(trial, base))
        and not refuted(trial.heldout, problem.rules)
        and not vanished(trial.fit, trial.fit.terms[-1], problem.rules)
    ]
    for trial in possible[: problem.rules.crossed_fits]:
        more = max(trial.fit.fitted - base.fitted, 0)
        trial.crossed = _where_called_for(problem, base, trial.fit, more, trial.starts)
    set_starts(problem, begun)


def unexcited(problem: Problem, base: Fit, fit: Fit, more: int, heldout: Gain | None = None) -> Gain | None:
    """Gain of `fit` by cross-validation, if the recordings held out say little of it; None where that is not called for.

    more: number of its further parameters. heldout: its gain there; None: it is known to say nothing.
    """
    rules = problem.rules
    if heldout is not None and (heldout.log_likelihood > rules.weak_log_likelihood or heldout.p_value < rules.significance):
        return None
    if heldout is not None and refuted(heldout, rules):
        return None
    return _where_called_for(problem, base, fit, more, get_starts(problem))


def _where_called_for(problem: Problem, base: Fit, fit: Fit, more: int, starts: list[dict[str, float]]) -> Gain | None:
    rules = problem.rules
    trained = problem.gain("fit", base.residuals, fit.residuals)
    least = rules.pooled_log_likelihood + rules.parameter_penalty * more
    if not problem.apart or trained.log_likelihood < least or problem.budget.spent():
        return None
    return _crossed(problem, base, fit, starts)


def _crossed(problem: Problem, base: Fit, fit: Fit, starts: list[dict[str, float]]) -> Gain:
    """Gain of `fit` over `base` on all samples, where each recording is predicted by a fit of the others.

    The recordings held out keep the residuals that they have. starts: of the memories in `fit`, for every recording.
    """
    begun = get_starts(problem)
    used = [k for k, segment in enumerate(problem.segments) if segment.fit.any()]
    before, after = list(base.residuals), list(fit.residuals)
    for fold in np.array_split(used, min(problem.rules.crossed_folds, len(used))):
        part = replace(
            problem,
            segments=[_exchanged(segment, k in fold, k in used) for k, segment in enumerate(problem.segments)],
        )
        for residuals, model, memory in ((before, base, begun), (after, fit, starts)):
            set_starts(problem, memory)
            again = _refitted(part, model)
            for k in fold:
                residuals[k] = again.residuals[k]
    set_starts(problem, begun)
    return problem.gain("both", before, after)


def _exchanged(segment: Segment, out: bool, used: bool) -> Segment:
    """`segment` held out where it is `out`; fitted where it is not, also if the problem holds it out."""
    none = np.zeros(segment.n, dtype=bool)
    if out:
        return replace(segment, fit=none, heldout=segment.fit)
    return segment if used else replace(segment, fit=segment.heldout, heldout=none)


def _refitted(problem: Problem, fit: Fit) -> Fit:
    """`fit` again, on the samples that `problem` fits."""
    alone = not problem.joint_states
    fit = minimize(problem, fit.terms, fit.values, rounds=problem.rules.further_iterations, tolerance=1e-4, states=alone)
    if alone:
        start_again(problem, fit)
    else:
        fit = begun_again(problem, fit)
    return finish(problem, fit)
