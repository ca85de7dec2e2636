"""New starts of the nominal parameters for an effect that hides them: a reading without sign leads their fit astray."""

from __future__ import annotations

import numpy as np

from host.diagnosis.estimation.fit import Fit, Problem, robust, starts
from host.diagnosis.model.effect import Candidate
from host.diagnosis.selection.screening import Screened, enough, term_of


def hidden(problem: Problem, nominal: Fit, candidate_effects: list[Candidate]) -> list[Screened]:
    """Candidates that change the nominal parameters so much that each needs start values of its own for them.

    A model with `restarts` says which parameters are worth a try; those that leave the least with the effect are
    kept.
    """
    few = enough(problem)
    begins = problem.model.restarts(few.segments) if any(c.effect.hides for c in candidate_effects) else []
    found = []
    for candidate in candidate_effects if begins else ():
        if not candidate.effect.hides:
            continue
        term = term_of(problem, candidate, nominal)
        begin = starts(term, {}, {})
        tried = [np.concatenate((theta, begin)) for theta in begins]
        tried.sort(key=lambda values: robust(few.stacked((term,), values))[0])
        nominals = [values[: -begin.size] for values in tried[: problem.rules.nominal_restarts]]
        if nominals:
            found.append(Screened(candidate, term, (), 0.0, [begin] * len(nominals), nominals))
    return found
