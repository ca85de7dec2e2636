"""A candidate fitted in full, and what it has to show to earn a place: likelihood, blocks, size, and no bound reached."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from host.diagnosis.estimation.evidence import Gain
from host.diagnosis.estimation.fit import Fit
from host.diagnosis.model.effect import Candidate

ENOUGH = 6.0  # held-out log-likelihood a new effect has to bring, besides its parameters' penalty
SURE = 1e-2  # p-value a new effect has to reach on held-out blocks
TOGETHER = 11.0  # log-likelihood on all samples that makes up for a held-out part that shows an effect only dimly,
DIM = 0.12  # with at most this p-value on held-out blocks,
LITTLE = 1.8  # and at least this log-likelihood there
OVERWHELMING = 25.0  # log-likelihood on all samples that needs no blocks to agree: few episodes may hold all of it
PRICE = 2.0  # log-likelihood that a parameter costs: one for the samples it was fitted to, one for the others
SMALLEST_SHARE = 0.015  # of the held-out error of some output it has to take away,
SMALLEST_EXCESS = 0.10  # and this much of what is above noise
FURTHER = 0.05  # of some output's error a further effect has to take: what idealized modules lack is no effect;
BESIDE = 0.2  # and of the likelihood of those named, but for one that takes
LARGE, SURER = 0.3, 1e-6  # this share of what is left, with blocks held out that agree so well
COARSE = 0.15  # far above noise, a finer shape has to take this share of the error to be told from a simpler one
INEXACT = 0.02  # part of the likelihood that a coarser shape of the same effect may lack and still be preferred if simpler
NATURAL_BOUNDS = frozenset({"rectified_sensor", "saturation", "missed_steps", "dead_zone"})


@dataclass
class Trial:
    """A candidate fitted in full, with its gains over the structure it was added to."""

    candidate: Candidate
    fit: Fit
    heldout: Gain
    trained: Gain
    both: Gain  # on all samples, fitted and held out
    score: float
    starts: list[dict[str, float]] = field(default_factory=list)
    replaced: bool = False
    period_s: float = 0.0
    apart: bool = True  # whether whole recordings are held out, not blocks between the fitted ones


def at_bound(fit: Fit) -> bool:
    """Whether the last term ended at a bound that is none of nature's: its shape is then not what it stands for."""
    term = fit.terms[-1]
    values = fit.values[-len(term.parameters) :]
    return (
        any(
            p.high > p.low
            and (
                (np.isfinite(p.low) and p.low != 0.0 and value <= p.low * (1.001 if p.low > 0 else 0.999))
                or (np.isfinite(p.high) and value >= p.high - 1e-3 * abs(p.high))
            )
            for p, value in zip(term.parameters, values, strict=True)
        )
        and term.candidate.effect.id not in NATURAL_BOUNDS
    )


def rank(trials: list[Trial], base: Fit) -> None:
    """Sorts trials by their likelihood on all samples, with one effective sample size for all, that of the trial with
    the least error.
    """
    if not trials:
        return
    most = np.max([trial.both.independent for trial in trials], axis=0)
    common = max(trials, key=lambda trial: float(most @ trial.both.log_ratio)).both.independent
    for trial in trials:
        more = max(len(trial.fit.values) - len(base.values), 0)
        trial.score = 0.5 * float(common @ trial.both.log_ratio) - PRICE * more
    trials.sort(key=lambda trial: trial.score, reverse=True)
    top = trials[0]
    coarse = 0.5 * float(common @ (-np.log(1.0 - COARSE * np.minimum(1.0, 2.0 * top.both.excesses))))
    near = top.score - max(ENOUGH, INEXACT * top.score, min(coarse, 0.3 * top.score))
    simpler = [
        t
        for t in trials
        if len(t.fit.values) < len(top.fit.values) and t.score > near and related(t.candidate, top.candidate)
    ]
    if simpler:
        best = max(simpler, key=lambda t: (-len(t.fit.values), t.score))
        trials.remove(best)
        trials.insert(0, best)


def of_sampling(trial: Trial) -> bool:
    """Whether a delay or lag of an axis' input, all of a drifting one, is within one sample: that is how the input was
    held between samples, not physics.
    """
    if not trial.candidate.port.name.endswith("_drive"):
        return False
    longest_s = max(r.shape[1] for r in trial.fit.residuals) * trial.period_s
    times = {"latency": 1.0, "rate_lag": 1.0, "clock_drift": longest_s}.get(trial.candidate.effect.id)
    return times is not None and abs(float(trial.fit.values[-1])) * times < 1.05 * trial.period_s


def related(simple: Candidate, general: Candidate) -> bool:
    """Whether `general` is a finer shape of `simple`, at the same place."""
    a, b = simple.effect, general.effect
    return simple.port.name == general.port.name and (
        a.id == b.id or a.id in b.contains or bool(a.family and a.family == b.family)
    )


def good_enough(trial: Trial, base: Fit) -> bool:
    """Whether a trial earns its place: likelihood, blocks, size, and agreement of fitted and held-out parts.

    Held-out samples alone are enough; where they show it dimly, because their excitation hardly calls for it, all
    samples together have to be surer by far. Blocks held out between the fitted ones have the same excitation: no excuse.
    """
    more = max(len(trial.fit.values) - len(base.values), 0)
    if at_bound(trial.fit) or of_sampling(trial):
        return False
    return _alone(trial, more) or (trial.apart and _together(trial, more)) or _plainly(trial, more)


def _alone(trial: Trial, more: int) -> bool:
    gain = trial.heldout
    return (
        gain.log_likelihood > ENOUGH + more
        and gain.p_value < SURE
        and gain.share > _least(trial, gain)
        and trial.trained.log_likelihood > ENOUGH + 2.0 * more
    )


def _together(trial: Trial, more: int) -> bool:
    gain = trial.both
    return (
        gain.log_likelihood > TOGETHER + PRICE * more
        and gain.p_value < 0.1 * SURE
        and gain.share > _least(trial, gain)
        and trial.heldout.log_likelihood > LITTLE
        and trial.heldout.p_value < DIM
    )


def _plainly(trial: Trial, more: int) -> bool:
    """Likelihood so large that noise cannot be its cause, gained in both parts, in however few episodes."""
    return (
        trial.both.log_likelihood > OVERWHELMING + PRICE * more
        and trial.both.share > _least(trial, trial.both)
        and trial.heldout.log_likelihood > LITTLE
        and trial.trained.log_likelihood > LITTLE
    )


def weighty(trial: Trial, earned: float) -> bool:
    """Whether a trial earns enough beside the likelihood of what is named already; a finer shape is judged alone."""
    large = trial.both.share > LARGE and trial.heldout.p_value < SURER
    enough = trial.both.share > FURTHER and (large or trial.both.log_likelihood > BESIDE * earned)
    return trial.replaced or earned == 0.0 or enough


def _least(trial: Trial, gain: Gain) -> float:
    return max(SMALLEST_SHARE, (COARSE if trial.replaced else SMALLEST_EXCESS) * gain.excess)
