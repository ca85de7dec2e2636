"""Which effects are missing: joint refits; forward, upgrade, swap and backward moves on held-out evidence."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from host.diagnosis.estimation.fit import (
    Fit,
    Problem,
    Term,
    finish,
    first_needs,
    get_starts,
    minimize,
    reweigh,
    robust,
    set_starts,
)
from host.diagnosis.estimation.initial_state import start_again
from host.diagnosis.estimation.rules import SelectionRules
from host.diagnosis.model.effect import Candidate
from host.diagnosis.selection.corners import round_corners
from host.diagnosis.selection.folds import with_other_recordings
from host.diagnosis.selection.found import Found, SearchMove, Step
from host.diagnosis.selection.joint import PairFit, best_pair, pair_first, pair_instead, second_mass_instead
from host.diagnosis.selection.lost_steps import lost_steps, without_lost_steps
from host.diagnosis.selection.refits import fit_nominal, fit_without, refined, settled, try_fit
from host.diagnosis.selection.removal import drop_unsure, drop_unsure_events, prune, reduce
from host.diagnosis.selection.restart import along_motion, hidden
from host.diagnosis.selection.screening import Screened, above_noise, screen, term_of, without
from host.diagnosis.selection.trial import (
    Trial,
    at_bound,
    called_for,
    contained,
    good_enough,
    only_sampling,
    rank,
    related,
    weighty,
    wider,
)

Array = npt.NDArray[np.float64]
Progress = Callable[[str, float], None]


def search(problem: Problem, candidate_effects: list[Candidate], progress: Progress, earned: float = 0.0) -> Found:
    """Nominal refit, then moves until none is earned; then detours by other first effects, where two may do better.

    earned: likelihood by which the nominal model was extended before; each effect is then a further one.
    """
    return concluded(problem, forward(problem, candidate_effects, progress, earned), candidate_effects, progress)


def forward(problem: Problem, candidate_effects: list[Candidate], progress: Progress, earned: float = 0.0) -> Found:
    """Nominal refit, then single effects until none is earned: the first part of `search`."""
    progress("refitting the nominal model", 0.0)
    nominal = fit_nominal(problem)
    found = Found(nominal, nominal, [])
    _grow(problem, found, candidate_effects, earned, progress)
    return found


def concluded(problem: Problem, found: Found, candidate_effects: list[Candidate], progress: Progress) -> Found:
    """Pairs, detours, exchanges and removals after `forward`: the second part of `search`."""
    _join(problem, found, candidate_effects, progress)
    found = _detour(problem, found, candidate_effects, progress)
    _revise(problem, found, candidate_effects, progress)
    return _past_lost_steps(problem, found, candidate_effects, progress)


def _revise(problem: Problem, found: Found, candidate_effects: list[Candidate], progress: Progress) -> None:
    """Exchanges, simpler shapes and removals, once no further effect earns its place."""
    _exchange(problem, found, candidate_effects, progress)
    if len(found.best.terms) > 1:
        reduce(problem, found)
    if found.best.terms:
        found.best = refined(problem, found.best)
    round_corners(problem, found)
    drop_unsure_events(problem, found, candidate_effects)
    drop_unsure(problem, found)


def _past_lost_steps(problem: Problem, found: Found, candidate_effects: list[Candidate], progress: Progress) -> Found:
    """The search from steps on that each recording lost at its own instants, where that ends better than `found`.

    No effect of a law explains them, and as long as they are in the residual they hide what else is missing. What else is
    missing hides them as well: they are looked for past each of the effects that were tried first, too.
    """
    if problem.budget.spent():
        return found
    begun, scale = get_starts(problem), problem.scale.copy()
    tried = found.steps[0].trials if found.steps else []
    bases = [(found.nominal, begun), *((trial.fit, trial.starts) for trial in tried[: problem.rules.joint_first])]
    paths = []
    for base, starts in [*bases, *([(found.best, begun)] if found.best.terms else [])]:
        set_starts(problem, starts)
        lost = lost_steps(problem, without_lost_steps(problem, base), candidate_effects)
        if lost is not None:
            paths.append((_total(problem, found.nominal, lost.trial.fit), lost))
    set_starts(problem, begun)
    if not paths:
        return found
    lost = max(paths, key=lambda path: path[0])[1]
    first = Step(SearchMove.FORWARD, lost.trial.candidate.key, lost.trial.heldout, [lost.trial, *tried])
    other = Found(found.nominal, _taken(problem, lost.trial), [first], lost.forms)
    earned = problem.gain("both", found.nominal.residuals, other.best.residuals).log_likelihood
    _grow(problem, other, candidate_effects, earned, progress)
    _revise(problem, other, candidate_effects, progress)
    if any(term.candidate.effect.dated for term in other.best.terms) and (
        not found.best.terms or _ahead(problem, other, found)
    ):
        return other
    _put_back(problem, found, begun, scale)
    return found


def _grow(problem: Problem, found: Found, candidate_effects: list[Candidate], earned: float, progress: Progress) -> None:
    """Forward, upgrade, swap and backward moves from `found.best` on; `earned`: likelihood so far."""
    best, steps = found.best, found.steps
    rules, refits = problem.rules, 0
    while len(best.terms) < rules.most_effects and len(steps) < rules.most_steps and not problem.budget.spent():
        ranked = screen(problem, best, candidate_effects, progress)
        trials: list[Trial] = []
        promising = worth_fitting(problem, best, ranked)
        if not best.terms:
            promising += hidden(problem, best, candidate_effects)
        if above_noise(problem, best, rules.noise_uncertainty):
            promising = along_motion(problem, best, candidate_effects, promising, progress)
        for count, item in enumerate(promising):
            if trials and problem.budget.spent():
                break
            progress(f"fitting {item.candidate.key}", count / len(promising))
            trials.append(try_fit(problem, best, item))
        rank(problem, trials, best)
        trials = _with_simpler(problem, best, trials, ranked)
        trials = with_wider(problem, best, trials, ranked)
        with_other_recordings(problem, best, trials)
        winner = next(
            (t for t in trials if good_enough(t, best) and weighty(t, earned) and not only_sampling(t, trials)), None
        )
        if winner is None:
            steps.append(Step(SearchMove.STOP, "", trials=trials))
            break
        better = _better_base(problem, best, winner) if refits < rules.most_refits else None
        if better is not None:  # the gain was that of a better minimum: judged again over that
            refits += 1
            steps.append(Step(SearchMove.REFIT, winner.candidate.key, trials=trials))
            best = better
            if not best.terms:
                found.nominal = best
            continue
        move = SearchMove.UPGRADE if len(winner.fit.terms) <= len(best.terms) else SearchMove.FORWARD
        steps.append(Step(move, winner.candidate.key, winner.heldout, trials))
        earned += winner.both.log_likelihood
        best = _parted(problem, _taken(problem, winner), candidate_effects)
        two = None
        if len(best.terms) == 1:
            two, found.pairs = pair_instead(problem, found.nominal, best, trials)
            two = two or second_mass_instead(problem, found.nominal, best, candidate_effects)
        if two is not None:
            best = _joined(problem, two)
            steps += [Step(SearchMove.JOINT, term.candidate.key, two.heldout, trials) for term in best.terms]
        if len(best.terms) > 1:
            best = _swap(problem, best, steps)
        best = prune(problem, best, steps)
    found.best = best


def _better_base(problem: Problem, base: Fit, trial: Trial) -> Fit | None:
    """`base` fitted again from the parameters that a trial found, if that ends in a better minimum; else None.

    A fit can end in a poor local minimum. The first candidate that leads out of it would be taken for what is missing.
    """
    if trial.replaced:
        return None
    again = minimize(problem, base.terms, trial.fit.values[: len(base.values)], rounds=problem.rules.further_iterations)
    cost = robust(problem.stacked(base.terms, base.values))[0]
    if again.cost > (1.0 - problem.rules.least_excess_reduction) * cost:
        return None
    again = minimize(problem, again.terms, again.values, states=True)
    if base.terms:
        again = refined(problem, again)
        reweigh(problem, again)
        return again
    return settled(problem, again)


def worth_fitting(problem: Problem, best: Fit, ranked: list[Screened]) -> list[Screened]:
    """Candidates to fit: those that promise enough, and the first few wherever the residual is above noise.

    A promise counts independent samples by what one projection leaves. In a recording of seconds a slow residual has few
    of them until a full fit has taken it away.
    """
    rules = problem.rules
    enough = [item for item in ranked if item.promise > rules.screening_log_likelihood]
    if len(enough) < rules.least_fits and above_noise(problem, best, rules.noise_uncertainty):
        enough = ranked[: rules.least_fits]
    return _varied(enough, rules)


def _with_simpler(problem: Problem, best: Fit, trials: list[Trial], ranked: list[Screened]) -> list[Trial]:
    """`trials`, and the simpler shapes of the first, and of what is likelier by more parameters, that were screened but not
    fitted; ranked again.

    A richer shape can promise more than each of the simpler ones it contains, and several rich ones fill the places of a
    port. Which of them the data call for shows only where all are fitted.
    """
    if not trials or problem.budget.spent():
        return trials
    least, fitted = trials[0].both.log_likelihood, {trial.candidate.key for trial in trials}
    richer = [t for t in trials if t is trials[0] or (t.both.log_likelihood >= least and called_for(t, best))]
    missing = [
        item
        for item in ranked
        if item.candidate.key not in fitted
        and any(contained(item.candidate, t.candidate) or _fewer_events(item.term, t.fit.terms[-1]) for t in richer)
        and item.promise > problem.rules.screening_log_likelihood
    ]
    if not missing:
        return trials
    missing.sort(key=lambda item: item.term.fitted)  # the simplest first; of equally simple ones, the most promising
    more = [*trials, *(try_fit(problem, best, item) for item in missing[: problem.rules.simpler_fits])]
    rank(problem, more, best)
    return more


def _fewer_events(one: Term, other: Term) -> bool:
    """Whether both are one effect at one place that happens at instants, and `one` at fewer of them."""
    a, b = one.candidate, other.candidate
    few = [sum(p.event for p in term.parameters) for term in (one, other)]
    return (a.effect.id, a.port.name) == (b.effect.id, b.port.name) and 0 < few[0] < few[1]


def with_wider(problem: Problem, best: Fit, trials: list[Trial], ranked: list[Screened]) -> list[Trial]:
    """`trials`, and wider forms of those that the data call for but that ended at a bound of their form; ranked again.

    A bound that is not nature's means that the form is wrong and what it stands for is near: other forms at its place are
    worth a fit, however little their projection promised.
    """
    bounded = [trial for trial in trials if at_bound(trial.fit) and called_for(trial, best)]
    fitted = {trial.candidate.key for trial in trials}
    left = [item for item in ranked if item.candidate.key not in fitted]
    missing = [item for item in left if any(wider(item.candidate, trial.candidate) for trial in bounded)]
    if bounded and bounded[0] is trials[0]:  # nothing does as well: what else is there at its place
        port = bounded[0].candidate.port.name
        missing += [item for item in left if item not in missing and item.candidate.port.name == port]
    if not missing or problem.budget.spent():
        return trials
    more = [*trials, *(try_fit(problem, best, item) for item in missing[: problem.rules.wider_fits])]
    rank(problem, more, best)
    return more


def _join(problem: Problem, found: Found, candidate_effects: list[Candidate], progress: Progress) -> None:
    """Two effects at once where none passed alone, then further ones."""
    refused = found.steps[-1].trials if found.steps else []
    if found.best.terms or len(refused) < 2 or problem.budget.spent():
        return
    if called_for(refused[0], found.best) and only_sampling(refused[0], refused):
        return  # what a delay within a sample leaves is how exactly its moment is known
    begun = get_starts(problem)

    def fit_next(base: Fit, starts: list[dict[str, float]]) -> list[Trial]:
        """The likeliest effects past one that was refused, fitted with it."""
        set_starts(problem, starts)
        ranked = [item for item in screen(problem, base, candidate_effects, progress) if not item.drop]
        enough = [item for item in ranked if item.promise > problem.rules.screening_log_likelihood]
        chosen = _varied(enough, problem.rules, here=2)[: problem.rules.joint_second]
        return [try_fit(problem, base, item) for item in chosen]

    pair = best_pair(problem, found.nominal, refused, fit_next, progress)
    if pair is None:
        set_starts(problem, begun)
        return
    found.best = _parted(problem, _joined(problem, pair), candidate_effects)
    found.steps += [Step(SearchMove.JOINT, term.candidate.key, pair.heldout, refused) for term in found.best.terms]
    _grow(problem, found, candidate_effects, pair.heldout.log_likelihood, progress)


def _joined(problem: Problem, pair: PairFit) -> Fit:
    """The fit of a pair brought to its end, memories started and outputs weighed as it has them."""
    set_starts(problem, pair.starts)
    fit = refined(problem, pair.fit)
    reweigh(problem, fit)
    return fit


def _taken(problem: Problem, trial: Trial) -> Fit:
    """The fit of a trial brought to its end, memories started and outputs weighed as it has them."""
    set_starts(problem, trial.starts)
    best = trial.fit
    for _ in range(2 if len(problem.noise) > 1 else 1):  # the output that the mismatch was largest in weighs more afterwards
        best = refined(problem, best)
        reweigh(problem, best)
    if trial.candidate.effect.hides:  # the nominal parameters that the starts were found with were led astray
        set_starts(problem, first_needs(problem, best))
    return best


def _parted(problem: Problem, fit: Fit, candidate_effects: list[Candidate]) -> Fit:
    """`fit` with each effect that is a sum of others (`joins`) replaced by these: the same outputs, and each is judged by
    what it gains itself.
    """
    n = len(problem.model.parameters)
    terms: list[Term] = []
    values = [fit.values[:n]]
    for term in fit.terms:
        joined = term.candidate
        parts = [
            next((c for c in candidate_effects if (c.effect.id, c.form, c.port.name) == (*part, joined.port.name)), None)
            for part in joined.effect.joins
        ]
        values.append(fit.values_of(term))
        terms += [term_of(problem, part, fit) for part in parts if part is not None] if parts and all(parts) else [term]
    if len(terms) == len(fit.terms):
        return fit
    return finish(problem, Fit(tuple(terms), np.concatenate(values), cost=fit.cost))


def _detour(problem: Problem, found: Found, candidate_effects: list[Candidate], progress: Progress) -> Found:
    """One effect that stands in for two can beat each of them alone: the first step's rivals are taken up where what
    screening promises together with them would outdo all that was found.
    """
    if not found.best.terms or problem.budget.spent():
        return found
    begun, scale = get_starts(problem), problem.scale.copy()
    best, first = found, found.steps[0]
    top = first.trials[0].score
    for trial in _rivals(first.trials, found.best, found.best.terms[0].candidate)[: problem.rules.alternative_starts]:
        if trial.score < problem.rules.alternative_start_score * top or not good_enough(trial, found.nominal):
            continue
        base = _parted(problem, _taken(problem, trial), candidate_effects)
        ranked = screen(problem, base, candidate_effects, progress)
        if (
            not ranked
            or _total(problem, found.nominal, base) + ranked[0].promise
            < _total(problem, found.nominal, best.best) + len(best.best.terms) * problem.rules.heldout_log_likelihood
        ):
            continue
        other = Found(found.nominal, base, [Step(SearchMove.FORWARD, trial.candidate.key, trial.heldout, first.trials)])
        _grow(problem, other, candidate_effects, trial.both.log_likelihood, progress)
        if _ahead(problem, other, best):
            best, begun, scale = other, get_starts(problem), problem.scale.copy()
    if above_noise(problem, best.best, problem.rules.residual_over_noise):
        pair = pair_first(problem, found.nominal, first.trials, progress)
        if pair is not None:
            base = _parted(problem, _joined(problem, pair), candidate_effects)
            steps = [Step(SearchMove.JOINT, term.candidate.key, pair.heldout, first.trials) for term in base.terms]
            other = Found(found.nominal, base, steps)
            likelier = _ahead(problem, other, best)
            earned = problem.gain("both", found.nominal.residuals, base.residuals).log_likelihood
            _grow(problem, other, candidate_effects, earned, progress)
            if likelier or _ahead(problem, other, best):
                best, begun, scale = other, get_starts(problem), problem.scale.copy()
    _put_back(problem, best, begun, scale)
    return best


def _put_back(problem: Problem, found: Found, begun: list[dict[str, float]], scale: Array) -> None:
    """Memories, weights and initial states as `found` has them."""
    set_starts(problem, begun)
    problem.scale[:] = scale
    for segment in problem.segments:
        segment.weight = problem.scale
    start_again(problem, found.best)


def _ahead(problem: Problem, other: Found, best: Found) -> bool:
    """Whether another beginning ends plainly likelier, with one effect more at most."""
    ahead = problem.gain("both", best.best.residuals, other.best.residuals)
    more = max(other.best.fitted - best.best.fitted, 0)
    least = problem.rules.heldout_log_likelihood + problem.rules.parameter_penalty * more
    return ahead.log_likelihood > least and len(other.best.terms) <= len(best.best.terms) + 1


def _total(problem: Problem, nominal: Fit, fit: Fit) -> float:
    """Likelihood on all samples that a structure has earned, less the price of its parameters."""
    gain = problem.gain("both", nominal.residuals, fit.residuals)
    return gain.log_likelihood - problem.rules.parameter_penalty * (fit.fitted - nominal.fitted)


def _swap(problem: Problem, best: Fit, steps: list[Step]) -> Fit:
    """Refit each effect's rivals together with the others: one that only replaced several has to leave now."""
    for term in best.terms:
        step = next((s for s in reversed(steps) if s.key == term.candidate.key), None)
        rest, values = without(best, problem, (term.candidate.key,))
        for trial in _rivals(step.trials if step else [], best, term.candidate)[: problem.rules.swap_fits]:
            new = trial.fit.terms[-1]
            begin = np.concatenate((values, trial.fit.values[-len(new.parameters) :]))
            other = finish(
                problem, minimize(problem, (*rest, new), begin, rounds=problem.rules.further_iterations, tolerance=1e-4)
            )
            ahead = problem.gain("both", best.residuals, other.residuals)
            more = other.fitted - best.fitted
            if ahead.log_likelihood > problem.rules.heldout_log_likelihood + problem.rules.parameter_penalty * max(
                more, 0
            ) and not at_bound(other):
                steps.append(Step(SearchMove.SWAP, new.candidate.key, ahead, step.trials if step else []))
                return refined(problem, other)
    return best


def _exchange(problem: Problem, found: Found, candidate_effects: list[Candidate], progress: Progress) -> None:
    """Each of several effects taken out, and all candidates screened again for its place: what was the best alone
    may not be the best together with the others.
    """
    for _ in range(problem.rules.exchange_rounds):
        before = found.best.names
        for term in found.best.terms:
            if term not in found.best.terms:
                continue  # it left with another of its name (several jumps at one port), which was exchanged
            if term.candidate.effect.dated:
                continue  # no law has its instants
            if (len(found.best.terms) > 1 or _frequencies(found.best, term)) and not problem.budget.spent():
                _in_place_of(problem, found, term, candidate_effects, progress)
        found.best = prune(problem, found.best, found.steps)
        if found.best.names == before or len(found.best.terms) < 2:
            return


def _frequencies(fit: Fit, term: Term) -> tuple[float, ...]:
    """Frequencies (Hz) that were fitted for `term`: no rival should miss them for lack of a start."""
    at = len(fit.values) - sum(len(t.parameters) for t in fit.terms[fit.terms.index(term) :])
    pairs = zip(term.parameters, fit.values[at : at + len(term.parameters)], strict=True)
    return tuple(float(value) for p, value in pairs if p.spectral)


def _in_place_of(problem: Problem, found: Found, term: Term, candidate_effects: list[Candidate], progress: Progress) -> None:
    known = _frequencies(found.best, term)
    less = fit_without(problem, found.best, (term.candidate.key,), nominal=found.nominal)
    ranked = [
        item
        for item in screen(problem, less, candidate_effects, progress, known)
        if item.promise > problem.rules.screening_log_likelihood and not item.drop
    ]
    own = [item for item in ranked if item.candidate.key == term.candidate.key]
    top = max((item.promise for item in ranked), default=0.0)
    others = [item for item in ranked if item not in own and item.promise > problem.rules.exchange_promise * top]
    trials = [
        try_fit(problem, less, item) for item in [*own, *_varied(others, problem.rules)[: problem.rules.exchange_fits]]
    ]
    rank(problem, trials, less)
    with_other_recordings(problem, less, trials)
    found.steps.append(Step(SearchMove.EXCHANGE, term.candidate.key, trials=trials))
    winner = next((trial for trial in trials if good_enough(trial, less)), None)
    if winner is None or winner.candidate.key == term.candidate.key:
        return
    simpler = winner.fit.fitted < found.best.fitted and related(winner.candidate, term.candidate)
    ahead = problem.gain("both", found.best.residuals, winner.fit.residuals)
    more = winner.fit.fitted - found.best.fitted
    if (
        simpler  # preferred by `rank`, which weighs what the finer shape takes more
        or ahead.log_likelihood
        > (problem.rules.heldout_log_likelihood if more >= 0 else -problem.rules.parameter_penalty)
        + problem.rules.parameter_penalty * more
    ):
        found.steps[-1] = Step(SearchMove.SWAP, winner.candidate.key, ahead, trials)
        found.best = _parted(problem, _taken(problem, winner), candidate_effects)


def _rivals(trials: list[Trial], best: Fit, candidate: Candidate) -> list[Trial]:
    """Trials of other effects, the likeliest of each name first; none that acts already, no finer shape of `candidate`."""
    active = {term.candidate.key for term in best.terms}
    kept: dict[str, Trial] = {}
    for trial in trials:
        other = trial.candidate
        if other.key not in active and other.key != candidate.key and not trial.replaced and not related(candidate, other):
            kept.setdefault(other.name, trial)
    return list(kept.values())


def _varied(items: list[Screened], rules: SelectionRules, here: int = 0) -> list[Screened]:
    """The most promising, few of one effect or port so that rivals of other kinds get their chance.

    The best form of each effect comes first, then further forms: three forms of two effects would fill the places of a
    port, and an effect whose start values promise half as much may fit best.

    here: how many effects of one port; 0: `fits_per_port`.
    """
    most_here = here or rules.fits_per_port
    kept: list[Screened] = []
    for further in (False, True):
        for item in items:
            effect, port = item.candidate.effect.id, item.candidate.port.name
            same = sum(other.candidate.effect.id == effect for other in kept)
            at_port = {other.candidate.effect.id for other in kept if other.candidate.port.name == port}
            known = effect in at_port
            room = same < rules.fits_per_effect and (known or len(at_port) < most_here)
            if known is further and room and not any(item is k for k in kept):
                kept.append(item)
            if len(kept) == rules.fits_per_step:
                return kept
    return kept
