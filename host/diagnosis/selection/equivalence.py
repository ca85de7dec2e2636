"""Models that are indistinguishable from the best: rivals in each effect's place, refitted, compared on held-out blocks."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from host.diagnosis.estimation.evidence import Gain
from host.diagnosis.estimation.fit import Fit, Problem, finish, get_starts, minimize, set_starts, size_of
from host.diagnosis.estimation.initial_state import begun_again
from host.diagnosis.estimation.noise import correlation_time
from host.diagnosis.estimation.rules import SelectionRules
from host.diagnosis.model.effect import Candidate
from host.diagnosis.selection.folds import unexcited
from host.diagnosis.selection.found import Found, SearchMove, Step
from host.diagnosis.selection.posterior import Posterior, ahead_of_rival, coarse, posterior
from host.diagnosis.selection.refits import fit_without, refined
from host.diagnosis.selection.removal import unsure
from host.diagnosis.selection.screening import replaced_by, term_of, without
from host.diagnosis.selection.trial import Trial, at_bound, reached, related
from host.diagnosis.selection.unlisted import Remainder, equations_for, remainder_of
from host.diagnosis.symbolic.dictionary import equation_at


@dataclass(frozen=True)
class Standing:
    """Evidence of one effect of the best model, and what could stand in its place."""

    candidate: Candidate
    gain: Gain  # on held-out samples, or of all recordings predicted by one another
    both: Gain  # on all samples
    alike: tuple[Candidate, ...]
    rivals: tuple[tuple[Candidate, float], ...] = ()  # refitted in its place, with the coarsened difference of likelihoods
    parameters: int = 1
    share: float = np.inf  # part of the nominal mismatch that it alone removes; infinite where it is the only effect
    rests_on: str = ""  # recording without which the others are not evidence enough
    crossed: bool = False  # `gain` is that of recordings that are predicted from one another


def standings(problem: Problem, found: Found) -> list[Standing]:
    """For every effect of the best structure: its gain over the structure without it, and its equals."""
    out, law = [], _with_law_alone(problem, found)
    for term in found.best.terms:
        begun = get_starts(problem)
        less = fit_without(problem, found.best, (term.candidate.key,), nominal=found.nominal, begin_again=True)
        set_starts(problem, begun)
        gain = problem.gain("heldout", less.residuals, found.best.residuals)
        both = problem.gain("both", less.residuals, found.best.residuals)
        crossed = unexcited(problem, less, found.best, term.fitted, gain)
        gain = both if term.candidate.effect.dated else crossed or gain
        alike, rivals = _equals(problem, found, term.candidate, less, both)
        said = _better_said(problem, found, term.candidate, less, both)
        alike += tuple(candidate for candidate, _ in said if candidate.name != term.candidate.name)
        paired = _pairs(problem, found, term.candidate, both)
        alike += tuple(dict.fromkeys(part for part, _ in paired if part not in alike))
        least = -np.log(problem.rules.prior_equal / max(len(alike), 1))
        differences = tuple((rival, min(d, least) if rival in alike else d) for rival, d in (*rivals, *said, *paired))
        if term.candidate.effect.extended and not any(other.effect.searched for other in alike):
            alike += (_as_equation(term.candidate),)
        if term.candidate.effect.dated:  # what happened at these instants may be no physics of the model at all
            event = _as_equation(term.candidate)
            alike, differences = (*alike, event), (*differences, (event, 0.0))
        alone = _rests_on(problem, less, found.best, term.fitted)
        # No inexact formula of another effect leaves a line that no motion has.
        doubtful = less.terms and not term.candidate.effect.memories
        whole = found.nominal if term.candidate.effect.of_law else law
        share = mismatch_removed(problem, whole, less, found.best) if doubtful else np.inf
        out.append(Standing(term.candidate, gain, both, alike, differences, term.fitted, share, alone, crossed is not None))
    return out


def _with_law_alone(problem: Problem, found: Found) -> Fit:
    """The nominal model with those effects of the best one that are terms of a law, which no formula idealizes.

    What another effect removes is compared with what this leaves. Without its spring or damper, a law leaves so much that
    everything else is small.
    """
    others = tuple(term.candidate.key for term in found.best.terms if not term.candidate.effect.of_law)
    if not others or len(others) == len(found.best.terms):
        return found.nominal
    begun = get_starts(problem)
    law = fit_without(problem, found.best, others, begin_again=True)
    set_starts(problem, begun)
    return law


def most_probable(problem: Problem, found: Found) -> list[Standing]:
    """Standings of a structure in which no listed rival is plainly likelier than the effect that it could replace.

    An effect enters by what it gains on held-out samples. Among effects of one step these gains can be alike while all
    samples speak for another one; the verdict would then state a probability near zero for its own name. The rival takes
    the place if the effect would be distinguishable from it, were the rival named. A rival with fewer parameters takes it
    where it is likelier at all: a gain of more parameters below their cost is chance. Changes `found.best`.
    """
    seen = [found.best.names]
    standing = standings(problem, found)
    for _ in range(problem.rules.exchange_rounds):
        behind = [
            (difference, k, rival)
            for k, one in enumerate(standing)
            for rival, difference in one.rivals
            if not rival.effect.searched
            and difference - _own(one) < (0.0 if _simpler(found, rival, one) else -problem.rules.equal_log_likelihood)
        ]
        if not behind or problem.budget.spent():
            return standing
        _, k, rival = min(behind, key=lambda item: item[0])
        begun, before = get_starts(problem), found.best
        step = next(s for s in found.steps if any(t.candidate.key == rival.key for t in s.trials))
        trial = next(t for t in step.trials if t.candidate.key == rival.key)
        other = _with_rival(problem, found.best, standing[k].candidate, trial)
        ahead = problem.gain("both", before.residuals, other.residuals)
        likelier = coarse(ahead, other.fitted - before.fitted, standing[k].both, problem.rules) > 0.0
        if other.names in seen or not likelier or at_bound(other):
            set_starts(problem, begun)
            return standing
        found.best = other
        found.steps.append(Step(SearchMove.SWAP, rival.key, ahead, step.trials))
        seen.append(other.names)
        standing = standings(problem, found)
    return standing


def _simpler(found: Found, rival: Candidate, standing: Standing) -> bool:
    """Whether `rival` has fewer parameters than the effect of `standing`."""
    tried = (trial for step in found.steps for trial in step.trials if trial.candidate.key == rival.key)
    return any(trial.fit.terms[-1].fitted < standing.parameters for trial in tried)


def _pairs(problem: Problem, found: Found, candidate: Candidate, earned: Gain) -> list[tuple[Candidate, float]]:
    """Effects of pairs that do as well as `candidate`, the only effect that is named: each with its coarsened difference.

    A pair is one explanation: its two effects share its weight.
    """
    if len(found.best.terms) > 1:
        return []
    parts = []
    for pair in found.pairs:
        if candidate in [term.candidate for term in pair.terms]:
            return []  # another effect was named when they were compared
        ahead = problem.gain("both", pair.residuals, found.best.residuals)
        if ahead.log_likelihood < problem.rules.equal_log_likelihood:
            difference = coarse(ahead, found.best.fitted - pair.fitted, earned, problem.rules) + float(
                np.log(len(pair.terms))
            )
            parts += [(term.candidate, difference) for term in pair.terms]
    return parts


def _own(standing: Standing) -> float:
    """Coarsened difference of the likeliest form of an effect's name: zero or less."""
    return min([0.0, *(difference for rival, difference in standing.rivals if rival.name == standing.candidate.name)])


def without_improbable(
    problem: Problem, found: Found, standing: list[Standing], remainder: Remainder
) -> tuple[list[Standing], Remainder] | None:
    """Standings and remainder without the least probable effect, where another one is probable and it is not.

    An effect enters by what it gains on held-out samples, which formulas that are only nearly true let small further
    effects do. It stays if no other one is probable and sure without it: what it explained then counts as physics that is
    in no list. It stays too where it or one of its rivals is probable and removes more than an inexact formula leaves: then
    its name is in doubt, and not that something is there. Probabilities are those before calibration. None where all stay.
    Changes `found.best`.
    """
    least = problem.rules.further_probability
    probable = [probability_of(one, remainder.share, problem.rules) for one in standing]
    doubtful = [
        (p.raw, k)
        for k, (p, one) in enumerate(zip(probable, standing, strict=True))
        if p.raw < least and (p.raw_listed < least or one.share < problem.rules.partial_share)
    ]
    if not doubtful or max(p.raw for p in probable) < least or problem.budget.spent():
        return None
    weakest = standing[min(doubtful)[1]]
    begun, before = get_starts(problem), found.best
    found.best = fit_without(problem, before, (weakest.candidate.key,), rounds=10, begin_again=True)
    fewer = standings(problem, found)
    left = remainder_of(problem, found)
    if max(probability_of(one, left.share, problem.rules).raw for one in fewer) < least or unsure(problem, found.best):
        found.best = before
        set_starts(problem, begun)
        return None
    found.steps.append(Step(SearchMove.IMPROBABLE, weakest.candidate.key, weakest.gain))
    return fewer, left


def probability_of(standing: Standing, left: float, rules: SelectionRules) -> Posterior:
    """Probabilities at the place of one effect. left: share of the mismatch that the best model leaves."""
    rivals, name = list(standing.rivals), standing.candidate.name
    return posterior(standing.both, standing.gain, standing.parameters, rivals, left, rules, standing.share, name)


def _with_rival(problem: Problem, best: Fit, candidate: Candidate, trial: Trial) -> Fit:
    """`best` with the effect of `trial` in the place of `candidate`, brought to its end."""
    terms, values = without(best, problem, (candidate.key,))
    term = trial.fit.terms[-1]
    begin = np.concatenate((values, trial.fit.values_of(term)))
    return refined(problem, finish(problem, minimize(problem, (*terms, term), begin, rounds=10, tolerance=1e-4)))


def mismatch_removed(problem: Problem, nominal: Fit, less: Fit, more: Fit) -> float:
    """Part of the mismatch of `nominal` above noise that `more` removes from what `less` leaves, in the output where that is
    most.
    """
    largest = 0.0
    for row, sigma in enumerate(problem.noise_sd):
        whole, before, after = (
            float(np.nanmean(np.concatenate([r[row] for r in fit.residuals]) ** 2)) for fit in (nominal, less, more)
        )
        if whole > sigma**2:
            largest = max(largest, (before - after) / (whole - sigma**2))
    return largest


def _rests_on(problem: Problem, less: Fit, best: Fit, parameters: int) -> str:
    """The recording that the evidence rests on: without it, the gain of all others would let no effect enter.

    The fits are those of all recordings; the evidence is summed without one at a time.
    """
    needed = problem.rules.heldout_log_likelihood + problem.rules.parameter_penalty * parameters
    gains = []
    for left_out, segment in enumerate(problem.segments):
        keep = [k for k in range(len(problem.segments)) if k != left_out]
        segments = [problem.segments[k] for k in keep]
        before, after = [less.residuals[k] for k in keep], [best.residuals[k] for k in keep]
        gain = problem.gain("both", before, after, segments).log_likelihood if keep else 0.0
        gains.append((gain, segment.recording.name))
    gain, name = min(gains)
    return name if gain < needed else ""


def _as_equation(candidate: Candidate) -> Candidate:
    """The same law under the name of an equation: the vocabulary's effect of this id is a narrower one."""
    return replace(candidate, effect=replace(candidate.effect, id="unlisted", listed=False, searched=True, extended=False))


def with_unlisted_rival(standing: list[Standing], remainder: Remainder) -> list[Standing]:
    """`standing` where known effects leave more than noise: the strongest may replace an unlisted effect."""
    if not standing or not remainder.doubtful:
        return standing
    first = max(range(len(standing)), key=lambda k: standing[k].gain.log_likelihood)
    named = standing[first]
    forms = remainder.predicted.forms if remainder.predicted is not None else ()
    if not forms or any(other.effect.searched for other in named.alike):
        return standing
    unknown = equation_at(named.candidate.port, *forms[0])
    if unknown.name == named.candidate.name:
        return standing
    return [*standing[:first], replace(named, alike=(*named.alike, unknown)), *standing[first + 1 :]]


def _better_said(
    problem: Problem, found: Found, candidate: Candidate, less: Fit, earned: Gain
) -> tuple[tuple[Candidate, float], ...]:
    """An equation that does plainly better in the place of `candidate`: if it says something else, `candidate` may be the
    wrong name; if it says the same, the form of `candidate` is not exact, and no rival's form has to be the better name.
    """
    if candidate.effect.searched:
        return ()
    for trial in equations_for(problem, less, candidate.port):
        behind = problem.gain("both", found.best.residuals, trial.fit.residuals)
        if behind.log_likelihood > problem.rules.equal_log_likelihood:
            # its form was chosen among hundreds: it is not simpler than an effect with more parameters
            more = max(trial.fit.fitted - found.best.fitted, 0)
            return ((trial.candidate, -coarse(behind, more, earned, problem.rules)),)
    return ()


def _equals(
    problem: Problem, found: Found, candidate: Candidate, less: Fit, earned: Gain
) -> tuple[tuple[Candidate, ...], list[tuple[Candidate, float]]]:
    """Rivals in the place of `candidate`: those that neither held-out samples nor all together separate from it, and all
    that were refitted with their coarsened differences.

    A form that ended as the named effect says nothing of another one: the next form of its name is refitted then.
    """
    best = found.best
    kept: list[Candidate] = []
    refitted: list[tuple[Candidate, float]] = []
    rivals = _rivals(found, candidate, problem.rules)
    same = set(replaced_by(less, candidate) or ())  # active effects of its family, next to which it is named
    names = [*dict.fromkeys(trial.candidate.name for trial in rivals)][: problem.rules.equals_fits]
    refits = 0
    for trial in rivals:
        if problem.budget.spent() or refits == problem.rules.equals_fits:
            break
        if trial.candidate.name not in names:
            continue
        dropped = replaced_by(less, trial.candidate)
        if dropped is None or not set(dropped) <= same:
            continue  # it stands for another active effect too: both together would say one thing twice
        if _elsewhere(trial.candidate, candidate):
            refitted.append((trial.candidate, 0.0))
            kept.append(trial.candidate)
            names.remove(trial.candidate.name)
            continue
        term = term_of(problem, trial.candidate, less)
        start = trial.fit.values[-len(term.parameters) :]
        begin = np.concatenate((less.values, start))
        begun, refits = get_starts(problem), refits + 1
        other = minimize(problem, (*less.terms, term), begin, rounds=10, tolerance=1e-4)
        other = finish(problem, begun_again(problem, other))
        set_starts(problem, begun)
        compared = _another(problem, best, candidate, other)
        if compared is None:
            continue
        other = compared
        names.remove(trial.candidate.name)
        ahead = problem.gain("both", other.residuals, best.residuals)
        held = problem.gain("heldout", other.residuals, best.residuals)
        rival = problem.gain("both", less.residuals, other.residuals)
        more = max(earned, rival, key=lambda gain: gain.log_likelihood)
        refitted.append((trial.candidate, ahead_of_rival(ahead, best.fitted - other.fitted, more, problem.rules)))
        if trial.candidate.name == candidate.name:
            continue  # another form of the same answer
        if len(kept) < problem.rules.most_equals and _indistinguishable(ahead, held, earned, rival, problem.rules):
            kept.append(trial.candidate)
    return tuple(kept), refitted


def _another(problem: Problem, best: Fit, candidate: Candidate, rival: Fit) -> Fit | None:
    """`rival`, or another fit of it that the data allow as well, where it ended as a simpler effect; None if there is none.

    At a bound, or as the effect of `candidate` that it contains, it is no other explanation. An effect of one family may be
    one all the same: with its shape inside the bounds, or with more of what distinguishes it, it may do as well as `best`.
    """
    other = rival.terms[-1].candidate
    contained = candidate.effect.id in other.effect.contains
    simpler = contained and (at_bound(rival) or _collapsed(problem, best, rival))
    if not simpler and not (at_bound(rival) and rival.fitted > best.fitted):
        return rival
    alike = bool(candidate.effect.family) and other.effect.family == candidate.effect.family
    if not alike or other.name == candidate.name or (contained and not simpler):
        return None
    held = _enlarged(problem, rival) if simpler else _inside(problem, rival)
    if held is None or (simpler and at_bound(held)):
        return None
    behind = problem.gain("both", held.residuals, best.residuals).log_likelihood
    return held if behind <= problem.rules.equal_log_likelihood else None


def _inside(problem: Problem, fit: Fit) -> Fit:
    """`fit` with each shape of its last term that ended at a bound held at the best of the values that are tried first.

    If that is no less likely than the named effect, the data leave the shape open, and with it the name.
    """
    for k, p in enumerate(fit.terms[-1].parameters):
        term = fit.terms[-1]
        if p.linear or not reached(p, float(fit.values_of(term)[k]), term.candidate.effect.natural_bounds):
            continue
        fit = _likeliest(problem, fit, [_held(problem, fit, k, value) for value in p.grid])
    return fit


def _enlarged(problem: Problem, fit: Fit) -> Fit | None:
    """`fit` with a further amount of its last term held at the size that is tried first; None if it has one amount only.

    The term ended as a simpler effect that it contains. If it is as likely with an amount that changes the law plainly, the
    data leave that amount open: nominal parameters take up what it does.
    """
    parameters = fit.terms[-1].parameters
    amounts = [(k, size_of(p, 0.0)) for k, p in enumerate(parameters) if p.linear]
    first, held = fit.first_of(fit.terms[-1]), []
    for k, size in amounts[1:]:
        begins = [fit]
        for shape, p in enumerate(parameters):  # with none of this amount, its shape ended anywhere
            for value in () if p.linear else p.grid:
                values = fit.values.copy()
                values[first + shape] = value
                begins.append(replace(fit, values=values))
        tried = [_held(problem, begin, k, size, problem.rules.first_iterations) for begin in begins]
        held.append(_held(problem, _likeliest(problem, fit, tried), k, size))
    return _likeliest(problem, fit, held) if held else None


def _held(problem: Problem, fit: Fit, k: int, value: float, rounds: int = 0) -> Fit:
    """`fit` with parameter `k` of its last term held at `value`. rounds: iterations; 0: those of a last fit."""
    term, begin = fit.terms[-1], fit.values.copy()
    begin[fit.first_of(term) + k] = value
    p = replace(term.parameters[k], low=value, high=value)
    terms = (*fit.terms[:-1], replace(term, parameters=(*term.parameters[:k], p, *term.parameters[k + 1 :])))
    rounds = rounds or problem.rules.further_iterations
    return finish(problem, minimize(problem, terms, begin, rounds=rounds, tolerance=1e-4))


def _likeliest(problem: Problem, than: Fit, fits: list[Fit]) -> Fit:
    return max(fits, key=lambda fit: problem.gain("both", than.residuals, fit.residuals).log_likelihood)


def _elsewhere(rival: Candidate, candidate: Candidate) -> bool:
    """Whether `rival` is the effect of `candidate`, in any form, at another place of one linear path: both say the same.

    The form that was tried there, or the last steps of its fit, would pass for evidence of a place.
    """
    same = rival.effect.id == candidate.effect.id and rival.name != candidate.name
    return same and candidate.effect.invariant and rival.port.name in candidate.port.path


def _rivals(found: Found, candidate: Candidate, rules: SelectionRules) -> list[Trial]:
    """Trials of other names, tried when `candidate` was or after, that earned much of what the best of its step did.

    A simpler shape of `candidate` is a rival whatever it earned alone: past the other effects it may do as well. So is a
    form of its own name with fewer parameters: a rival that is as simple has to outdo that form.
    """
    active = {term.candidate.key for term in found.best.terms}
    others = {term.candidate.name for term in found.best.terms} - {candidate.name}
    own = next(term for term in found.best.terms if term.candidate == candidate)
    kept: dict[str, Trial] = {}
    for step in (s for s in found.steps if any(trial.candidate.key == candidate.key for trial in s.trials)):
        most = max(trial.score for trial in step.trials)
        for trial in step.trials:
            simpler = trial.candidate.effect.id in candidate.effect.contains and related(trial.candidate, candidate)
            same = trial.candidate.name == candidate.name
            if same and trial.fit.terms[-1].fitted >= own.fitted:
                continue
            if (
                trial.candidate.key not in active
                and trial.candidate.name not in others
                and (simpler or trial.score > rules.equals_score * most)
            ):
                kept.setdefault(trial.candidate.key, trial)
    return sorted(kept.values(), key=lambda trial: -trial.score)


def _collapsed(problem: Problem, best: Fit, other: Fit) -> bool:
    """Whether `other`, which contains the best model, ended as that model: their outputs differ by less than chance.

    Its further parameters are then where they change nothing, such as a limit that is never reached. It says what the
    best model says, so it is not another explanation.
    """
    lead = 0.0
    for segment, a, b in zip(problem.segments, best.residuals, other.residuals, strict=True):
        for row in range(len(problem.noise)):
            used = (segment.fit | segment.heldout) & np.isfinite(a[row]) & np.isfinite(b[row])
            if used.any():
                left = np.where(used, a[row], np.nan)
                power = float(np.nanmean(left**2)) * correlation_time(left)
                lead += float(np.sum((a[row] - b[row])[used] ** 2)) / max(power, 1e-300)
    return 0.5 * lead < problem.rules.parameter_penalty * max(other.fitted - best.fitted, 1)


def _indistinguishable(ahead: Gain, held: Gain, earned: Gain, rival: Gain, rules: SelectionRules) -> bool:
    """Whether the best model is no more `ahead` of a rival than chance or the modules' own idealization explains."""
    if ahead.log_likelihood < rules.equal_log_likelihood or (
        ahead.p_value > rules.equal_significance and held.p_value > rules.equal_significance
    ):
        return True
    top = int(np.argmax(earned.independent * earned.log_ratio))
    best, other = (1.0 - np.exp(-gain.log_ratio[top]) for gain in (earned, rival))
    idealized = earned.excesses[top] > 0.0  # where the best model leaves noise only, its formula is exact enough
    near = ahead.share < rules.equal_error or (idealized and best - other < rules.equal_mismatch * best)
    return bool(near and ahead.log_likelihood < rules.equal_likelihood_ratio * earned.log_likelihood)
