"""Models that the data cannot tell from the best: rivals in each effect's place, refitted, compared on held-out blocks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from host.diagnosis.effect import Candidate
from host.diagnosis.evidence import Gain, compare
from host.diagnosis.fit import Fit, Problem, finish, minimize
from host.diagnosis.screening import term_of, without
from host.diagnosis.search import Found, Trial

Array = npt.NDArray[np.float64]
MOST_RIVALS = 4
NEAR = 0.6  # a rival must have earned this part of the winner's likelihood
CANNOT_TELL = 4.0  # log-likelihood below which two models are not told apart


@dataclass(frozen=True)
class Standing:
    """Evidence of one effect of the best model, and what could stand in its place."""

    candidate: Candidate
    gain: Gain
    alike: tuple[Candidate, ...]


def standings(problem: Problem, found: Found, floor: Array) -> list[Standing]:
    """For every effect of the best structure: its gain over the structure without it, and its equals."""
    out = []
    for term in found.best.terms:
        terms, values = without(found.best, problem, (term.candidate.key,))
        less = finish(problem, minimize(problem, terms, values, rounds=8, tolerance=1e-4)) if terms else found.nominal
        gain = compare(problem.pieces, "heldout", less.residuals, found.best.residuals, floor)
        step = next((s for s in reversed(found.steps) if s.key == term.candidate.key), None)
        rivals = [trial for trial in (step.trials if step else []) if trial.candidate.key != term.candidate.key]
        alike = _equals(problem, found.best, term.candidate, rivals, less, gain, floor)
        out.append(Standing(term.candidate, gain, alike))
    return out


def _equals(
    problem: Problem, best: Fit, candidate: Candidate, rivals: list[Trial], less: Fit, gain: Gain, floor: Array
) -> tuple[Candidate, ...]:
    found: list[Candidate] = []
    reach = max((trial.heldout.log_likelihood for trial in rivals), default=0.0)
    for trial in rivals[: MOST_RIVALS + 2]:
        if trial.candidate.name == candidate.name or any(c.name == trial.candidate.name for c in found):
            continue
        if trial.score < NEAR * max(gain.log_likelihood, 0.2 * reach) or len(found) == MOST_RIVALS:
            continue
        if any(trial.candidate.key == term.candidate.key for term in best.terms):
            continue
        term = term_of(problem, trial.candidate, less)
        start = trial.fit.values[-len(term.parameters) :]
        other = finish(
            problem, minimize(problem, (*less.terms, term), np.concatenate((less.values, start)), rounds=10, tolerance=1e-4)
        )
        ahead = compare(problem.pieces, "heldout", other.residuals, best.residuals, floor)
        if ahead.log_likelihood < CANNOT_TELL or (ahead.p_value > 0.05 and ahead.share < 0.1):
            found.append(trial.candidate)
    return tuple(found)
