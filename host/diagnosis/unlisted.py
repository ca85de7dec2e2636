"""What is left after the known effects: is it predictable, and does an equation found by search explain it in the simulator."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from host.diagnosis.effect import Port
from host.diagnosis.evidence import compare
from host.diagnosis.fit import Problem, finish, minimize, reweigh
from host.diagnosis.screening import Screened, term_of, without
from host.diagnosis.search import Found, Step, good_enough, rank, try_fit
from host.diagnosis.symbolic import Predictable, as_candidate, features, predictable, search_equation

Array = npt.NDArray[np.float64]
Tell = Callable[[str, float], None]
SURE_LIKELIHOOD = 12.0     # held-out log-likelihood a smooth predictor has to gain before a rest counts as mismatch
SMALLEST_SHARE = 0.03
MUCH = 0.15                # share of the mismatch that one known effect may leave; two at a port may leave half of that, and so on:
                           # several effects that pile up and still do not fit stand for something that is in no list
MEASURED = 2.0             # times a noise level from quiescent parts, beyond which the rest is not noise where effects are named,
MEASURED_BARE = 3.0        # and where none is;
GUESSED = 8.0              # times a level guessed from the spectrum, whose colour is not known
AS_GOOD = 1.2              # error of an equation against that of the known effects it takes the place of


@dataclass(frozen=True)
class Rest:
    """What known effects leave. `predictable`: at the port where it is most so; `left`: share of the nominal mismatch still there."""

    predictable: Predictable | None
    left: float
    doubtful: bool = False     # known effects are named, but they are probably stand-ins
    loud: bool = False         # more is left than noise can be, foretold or not

    @property
    def sure(self) -> bool:
        """Whether there is a mismatch that the finder knows to be there."""
        p = self.predictable
        return self.loud or (p is not None and p.log_likelihood > SURE_LIKELIHOOD and p.share > SMALLEST_SHARE)


def left_over(problem: Problem, found: Found, floor: Array) -> float:
    """Share of the nominal model's held-out error above noise that the best model leaves, in the output where it mattered most."""
    shares, weights = [], []
    for row in range(floor.size):
        before = _power(problem, found.nominal.residuals, row) - floor[row] ** 2
        after = _power(problem, found.best.residuals, row) - floor[row] ** 2
        if before > 0.0:
            shares.append(float(np.clip(after / before, 0.0, 1.0)))
            weights.append(before / floor[row] ** 2)
    return shares[int(np.argmax(weights))] if shares else 0.0


def _above_noise(problem: Problem, found: Found, floor: Array) -> bool:
    """Whether the best model leaves more than the noise of some output can be: noise known from quiescent parts, or guessed."""
    measured = MEASURED if found.best.terms else MEASURED_BARE
    return any(_power(problem, found.best.residuals, row) > ((measured if noise.source == "quiescent parts" else GUESSED) * floor[row]) ** 2
               for row, noise in enumerate(problem.noise))


def _power(problem: Problem, residuals: list[Array], row: int) -> float:
    parts = [r[row][piece.heldout] for piece, r in zip(problem.pieces, residuals, strict=True)]
    together = np.concatenate(parts)
    together = together[np.isfinite(together)]
    return float(np.mean(together**2)) if together.size else 0.0


def explain_rest(problem: Problem, found: Found, floor: Array, tell: Tell) -> Rest:
    """Looks at the rest, and adds an equation to `found.best` where one earns its place."""
    ports = {port.name: port for port in problem.model.ports}
    pairs = [(ports[a], ports[b]) for a, b in problem.model.unlisted_at]
    rest = _rest(problem, found, floor, pairs)
    crowd = Counter(term.candidate.port.name for term in found.best.terms).most_common(1)
    if not rest.sure or rest.predictable is None or (crowd and rest.left < MUCH / crowd[0][1]):
        return rest
    port = rest.predictable.port.name
    pair = next(pair for pair in pairs if pair[0].name == port)
    if _equation_instead(problem, found, floor, *pair, tell):
        return _rest(problem, found, floor, pairs)
    return replace(rest, doubtful=bool(crowd))


def _rest(problem: Problem, found: Found, floor: Array, pairs: list[tuple[Port, Port]]) -> Rest:
    tried = [predictable(problem, found.best, port) for port, _ in pairs]
    best = max(tried, key=lambda p: p.log_likelihood, default=None)
    return Rest(best, left_over(problem, found, floor), loud=_above_noise(problem, found, floor))


def _equation_instead(problem: Problem, found: Found, floor: Array, port: Port, target: Port, tell: Tell) -> bool:
    """Puts an equation in the place of all effects at its port, if it earns its place and does about as well as they."""
    tell("searching an equation", 0.0)
    there = tuple(term.candidate.key for term in found.best.terms if term.candidate.port.name in (port.name, target.name))
    terms, values = without(found.best, problem, there)
    base = finish(problem, minimize(problem, terms, values, rounds=8)) if there else found.best
    for piece in problem.pieces:
        piece.extra.setdefault("features", {})[target.name] = features(problem, piece, port)
    trials = []
    for equation in search_equation(problem, base, port):
        candidate = as_candidate(target, equation)
        term = term_of(problem, candidate, base)
        trials.append(try_fit(problem, base, Screened(candidate, term, (), 1.0, [np.ones(1)]), floor))
    rank(trials, base)
    winner = next((trial for trial in trials if good_enough(trial, base)), None)
    if winner is None or (there and np.max(compare(problem.pieces, "heldout", winner.fit.residuals, found.best.residuals, floor).log_ratio)
                          > 2.0 * np.log(AS_GOOD)):
        return False
    found.steps.append(Step("equation", winner.candidate.key, winner.heldout, trials))
    found.best = finish(problem, minimize(problem, winner.fit.terms, winner.fit.values))
    reweigh(problem, found.best)
    return True
