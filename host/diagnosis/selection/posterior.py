"""Probabilities of what was fitted, and of none of these.

For an effect of the extended model, M ranges over: the effect; its rivals, each refitted in its place with the other
effects; an equation of recorded signals in its place; nothing there at all; and physics that no candidate has. With

    dl(M) = log-likelihood of the extended model - that of M

computed on independent samples only (autocorrelation taken out), dk the parameters that it has more than M, each of which
costs c = `parameter_penalty`, and r = coarsening / (n + coarsening), where n counts each independent sample by the share of
its error that the effect removes,

    w(effect) = 1,   w(rival) = exp(-r dl + c dk),   w(nothing) = max(exp(-dl + c dk), p-value on held-out blocks)
    w(none)   = prior_none / (1 - prior_none) * (max(left, exact_share) / exact_share)^(coarsening_none / 2)
    w(other)  = prior_none / (1 - prior_none) * exact_share / share      only where further effects are named

Where dl is more than c dk > 0, and the rival leaves more than an idealized formula does, the cost is coarsened with the
likelihood, w(rival) = exp(-r (dl - c dk)): the further parameters of the effect have earned it. So are those of a rival
that is as far ahead (`ahead_of_rival`).

An effect is a name, whatever the form: the weight of another form of it, an equation that says the same, is its own. Where
another form or a rival weighs more than what was fitted, w(none) and w(other) are multiplied by its weight.

Here `left` is the share of the mismatch above noise that the extended model leaves. Probabilities are w over their sum;
rivals that are indistinguishable (`equivalence`) have at least the weight `prior_equal` together.
The power r is the coarsened posterior for models that are only nearly true (Miller & Dunson 2019): beyond `coarsening`
samples, more data say nothing more of a formula that idealizes. A sample of which the effect is only a small part is noise
for the most part, which hides what the formula idealizes, and counts by that part. `nothing` is compared without it, since
noise is known. w(none) is the same likelihood ratio against a model that would leave no more than an exact formula does.
w(other): an effect that removes the `share` of the mismatch may stand for what the inexact formula of another one leaves, up
to `exact_share`; its prior is scale-free. It counts as none of these at the place of the small effect.

Stated probabilities are calibrated by beta calibration (`calibrated`). Its a, b and c, for effects, for none of them and for
verdicts without an effect, are fields of `SelectionRules`, fitted on suites apart from those that judge
(host.studies.proof.calibrate). The probabilities before that are kept as raw.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from host.diagnosis.estimation.evidence import Gain
from host.diagnosis.estimation.rules import SelectionRules
from host.diagnosis.model.effect import Candidate
from host.diagnosis.selection.trial import Trial

FARTHEST = 700.0  # of a logarithm that is taken to its exponential
EDGE = 1e-4  # probabilities are kept this far from 0 and 1 before they are calibrated


@dataclass(frozen=True)
class Posterior:
    """Probability of an effect, of its rivals by name, of nothing in its place, and of physics that is in no list.

    raw: of the effect, before calibration; raw_listed: of the effect or one of its rivals, before calibration.
    """

    effect: float
    rivals: tuple[tuple[Candidate, float], ...]
    nothing: float
    none: float
    raw: float
    raw_listed: float


def showing(earned: Gain) -> float:
    """Independent samples, each counted by the share of its error that the effect with the gain `earned` removes."""
    return float(np.sum(earned.independent * -np.expm1(-np.maximum(earned.log_ratio, 0.0))))


def coarse(ahead: Gain, parameters_more: int, earned: Gain, rules: SelectionRules) -> float:
    """Coarsened difference of log-likelihoods of two models, the first with so many parameters more.

    earned: gain of the effect in question, over the model without it.
    """
    power = rules.coarsening / (showing(earned) + rules.coarsening)
    return power * ahead.log_likelihood - rules.parameter_penalty * parameters_more


def ahead_of_rival(ahead: Gain, parameters_more: int, earned: Gain, rules: SelectionRules) -> float:
    """Coarsened difference of a named effect from its rival; the cost of parameters that have earned it is coarsened too.

    They have earned it where all samples gain more than the cost, and the model without them leaves more than an idealized
    formula does, of the error or of what the effect removes. The full cost against the coarsened likelihood would let the
    model with fewer parameters win on every long recording.
    """
    if ahead.log_likelihood < 0.0:
        share = -float(np.expm1(np.min(ahead.log_ratio)))
        behind = replace(ahead, log_likelihood=-ahead.log_likelihood, log_ratio=-ahead.log_ratio, share=share)
        return -ahead_of_rival(behind, -parameters_more, earned, rules)
    cost = rules.parameter_penalty * parameters_more
    if 0.0 < cost < ahead.log_likelihood and _exceeds_idealization(ahead, earned, rules):
        return coarse(replace(ahead, log_likelihood=ahead.log_likelihood - cost), 0, earned, rules)
    return coarse(ahead, parameters_more, earned, rules)


def _exceeds_idealization(ahead: Gain, earned: Gain, rules: SelectionRules) -> bool:
    """Whether a model that another one is `ahead` of leaves more than an idealized formula does."""
    top = int(np.argmax(ahead.independent * ahead.log_ratio))
    of_effect = np.expm1(ahead.log_ratio[top]) / max(np.expm1(earned.log_ratio[top]), 1e-300)
    return bool(ahead.share > rules.equal_error or of_effect > rules.exact_share)


def posterior(
    gain: Gain,
    heldout: Gain,
    parameters: int,
    rivals: list[tuple[Candidate, float]],
    left: float,
    rules: SelectionRules,
    share: float = np.inf,
    name: str = "",
) -> Posterior:
    """Probabilities at the place of one effect.

    gain, heldout: of the effect on all and on held-out samples; parameters: their number; rivals: each with its coarsened
    difference; left: share of the mismatch that the extended model leaves; share: that this effect alone removes, infinite
    where it is the only one; name: of the effect.
    """
    weights = [(rival, _exp(-difference)) for rival, difference in rivals if rival.name != name]
    forms = [1.0, *(_exp(-difference) for rival, difference in rivals if rival.name == name)]
    own = sum(forms)
    nothing = max(_exp(-(gain.log_likelihood - rules.parameter_penalty * parameters)), min(heldout.p_value, 1.0))
    odds = rules.prior_none / (1.0 - rules.prior_none)
    none = odds * (max(left, rules.exact_share) / rules.exact_share) ** (0.5 * rules.coarsening_none)
    none += odds * min(rules.exact_share / max(share, 1e-300), 1.0 / odds)
    none *= max([*forms, *(weight for _, weight in weights)])  # its prior odds are those against the best that was fitted
    listed = own + sum(weight for _, weight in weights)
    total = listed + nothing + none
    raw = own / total
    stated = calibrated(raw, *rules.effect_curve)
    share = (1.0 - stated) / (1.0 - raw) if raw < 1.0 else 0.0  # of what is not the effect, every part alike
    others = tuple((rival, share * weight / total) for rival, weight in weights)
    return Posterior(stated, others, share * nothing / total, share * none / total, raw, listed / total)


def calibrated(p: float, a: float, b: float, c: float) -> float:
    """Return the probability that `p` states truly, by beta calibration: log-odds of a log p - b log(1 - p) + c.

    Source: Kull, Silva Filho and Flach, Beta calibration, AISTATS 2017.
    """
    if (a, b, c) == (1.0, 1.0, 0.0):
        return p
    q = min(max(p, EDGE), 1.0 - EDGE)
    return 1.0 / (1.0 + float(np.exp(-(a * np.log(q) - b * np.log1p(-q) + c))))


def of_refused(trials: list[Trial]) -> float:
    """Probability that one of the effects that were refused is there after all, each as probable beforehand as nothing is
    over their number.
    """
    odds = sum(_exp(min(trial.score, trial.heldout.log_likelihood)) for trial in trials) / max(len(trials), 1)
    return min(odds / (1.0 + odds), 0.5)


def _exp(value: float) -> float:
    return float(np.exp(np.clip(value, -FARTHEST, FARTHEST)))
