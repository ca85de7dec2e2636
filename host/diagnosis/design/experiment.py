"""The recording that would separate two models: of a family of motions the one whose predictions differ most.

T-optimality (Atkinson & Fedorov 1975): the separation is the remaining difference after the rival has adapted its
parameters to the best model's prediction, as far as the present recordings let it; here by linearization, in units of
what the best model leaves.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from host.diagnosis.design.excitation import Excitation, Span, family
from host.diagnosis.estimation.fit import Fit, Problem, jacobian, minimize, size_of
from host.diagnosis.estimation.noise import correlation_time
from host.diagnosis.model.dataset import Recording
from host.diagnosis.model.effect import Candidate, alike_everywhere
from host.diagnosis.selection.equivalence import Standing
from host.diagnosis.selection.found import Found
from host.diagnosis.selection.screening import without

Array = npt.NDArray[np.float64]
LONGEST_S, MOST_SAMPLES = 40.0, 12000
FINALISTS = 16
INSIDE = (0.02, 0.98)  # quantiles of the recorded inputs that a motion stays between


@dataclass(frozen=True)
class Design:
    """The best excitation against one rival. `separation`, and `had` by these recordings, in units of the remaining
    residual. `separates`: whether a recording of the excitation separates the two.
    """

    candidate: Candidate
    other: Candidate
    excitation: Excitation
    separation: float
    had: float
    inputs: dict[str, Array]
    separates: bool

    @property
    def says(self) -> str:
        """Describe the excitation and its predicted separation in one line."""
        held = "".join(f", {name.replace('_', ' ')} at {value:.3g}" for name, value in self.excitation.held)
        doubt = "" if self.separates else " No motion of this family separates them."
        return (
            f"{self.excitation.channel.replace('_', ' ')}: {self.excitation.words}{held}. "
            f"Predicted separation of {self.candidate.name} and {self.other.name}: {self.separation:.3g} in units of "
            f"the remaining residual; these recordings: {self.had:.2g}.{doubt}"
        )


def design(problem: Problem, found: Found, standing: list[Standing], progress: Callable[[str, float], None]) -> list[Design]:
    """Design, for each pair that the recordings cannot separate, a motion that separates them; none where an equation of
    recorded signals is involved, since a motion that was not recorded has no such signals.
    """
    out: list[Design] = []
    made: list[tuple[Excitation, Problem]] | None = None
    for stands in standing if all(not term.candidate.effect.searched for term in found.best.terms) else ():
        for other in (o for o in stands.alike if not o.effect.searched and not alike_everywhere(stands.candidate, o)):
            progress(f"motion that separates {stands.candidate.key} and {other.key}", 0.0)
            rival = rival_fit(problem, found, stands.candidate, other)
            if rival is None:
                continue
            made = trials(weighed(problem, found.best), found.best) if made is None else made
            best = against(problem, found.best, rival, stands.candidate, other, made)
            out += [] if best is None else [best]
    return out


def rival_fit(problem: Problem, found: Found, candidate: Candidate, other: Candidate) -> Fit | None:
    """The best model with `other` in the place of `candidate`, refitted; None where it was never tried."""
    trial = next((t for step in reversed(found.steps) for t in step.trials if t.candidate.key == other.key), None)
    if trial is None:
        return None
    terms, values = without(found.best, problem, (candidate.key,))
    term = trial.fit.terms[-1]
    start = trial.fit.values_of(term)
    return minimize(problem, (*terms, term), np.concatenate((values, start)), rounds=8, tolerance=1e-4)


def against(
    problem: Problem, best: Fit, rival: Fit, candidate: Candidate, other: Candidate, made: list[tuple[Excitation, Problem]]
) -> Design | None:
    """The excitation of `made` (`trials`) that separates `best` from `rival` most; None where there is none."""
    weighted = weighed(problem, best)
    known = information(weighted, rival)
    had = float(np.linalg.norm(difference(weighted, best, rival)))
    ranked = []
    for excitation, trial in made:
        r = trial.stacked(rival.terms, rival.values)
        ranked.append((float(r @ r), excitation, trial))
    ranked.sort(key=lambda item: -item[0])
    top: tuple[float, Excitation, Problem] | None = None
    for size, excitation, trial in ranked[:FINALISTS]:
        if top is not None and np.sqrt(size) <= top[0]:
            break  # a rival that adapts takes a part of the difference: the others cannot be further apart
        reached = separation(trial, rival, known)
        if top is None or reached > top[0]:
            top = (reached, excitation, trial)
    if top is None:
        return None
    segment = top[2].segments[0]
    inputs = {name: segment.recording.channels[name] for name in asked(problem)}
    return Design(candidate, other, top[1], top[0], had, inputs, top[0] > problem.rules.experiment_separation)


def weighed(problem: Problem, best: Fit) -> Problem:
    """`problem` with residuals in units of what `best` leaves, correlated samples counted once."""
    together = [max(correlation_time(r[row]) for r in best.residuals) for row in range(len(problem.noise))]
    scale = problem.scale * np.sqrt(np.maximum(together, 1.0))
    return Problem(problem.model, problem.segments, problem.noise, scale, problem.columns, problem.rules)


def difference(problem: Problem, one: Fit, two: Fit) -> Array:
    """What two models say of the present recordings, apart, weighted."""
    rows = []
    for segment in problem.segments:
        apart = problem.simulate(segment, one.terms, one.values) - problem.simulate(segment, two.terms, two.values)
        rows.append(np.where(np.isfinite(segment.y) & np.isfinite(apart), apart, 0.0) / problem.scale[:, None])
    return np.concatenate([row.ravel() for row in rows])


def rates(problem: Problem, fit: Fit) -> Array:
    """Change (samples, free parameters) of the weighted prediction by the parameters of `fit`, each in its own scale."""
    base = problem.stacked(fit.terms, fit.values)
    sizes = [size_of(p, v) for p, v in zip(problem.parameters(fit.terms), fit.values, strict=True)]
    return np.nan_to_num(jacobian(problem, fit.terms, fit.values, base, sizes))


def information(problem: Problem, fit: Fit) -> Array:
    """What the present recordings say of the parameters of `fit`, (free, free)."""
    J = rates(problem, fit)
    return np.asarray(J.T @ J)


def separation(trial: Problem, rival: Fit, known: Array) -> float:
    """Size of the difference that `rival` cannot take up by changes that the present recordings allow."""
    r = trial.stacked(rival.terms, rival.values)
    J = rates(trial, rival)
    G, g = J.T @ J + known, J.T @ r
    taken = float(g @ np.linalg.lstsq(G, g, rcond=1e-10)[0])
    return float(np.sqrt(max(float(r @ r) - taken, 0.0)))


def trials(problem: Problem, best: Fit) -> list[tuple[Excitation, Problem]]:
    """Every excitation of the family with the best model's prediction of it as its record."""
    own = problem.model.inner
    usual = at_rest(problem)
    made = own.excitations(problem, best) if own.on_rig else excitations(problem)
    out = []
    for excitation, channels in made:
        recording = synthetic(usual, excitation.time_s, channels)
        out.append((excitation, predicted(problem, best, recording)))
    return [(e, p) for e, p in out if p is not None]


def predicted(problem: Problem, best: Fit, recording: Recording) -> Problem | None:
    """Return a problem of one recording with the outputs of `best`; None if they are not finite."""
    segment = problem.model.prepare(recording)
    if not problem.model.inner.on_rig:
        problem.model.settle(segment, best.values[: len(problem.model.parameters)])
    trial = Problem(problem.model, [segment], problem.noise, problem.scale, problem.columns, problem.rules)
    segment.y = problem.simulate(segment, best.terms, best.values)
    return trial if np.isfinite(segment.y).all() and np.max(np.abs(segment.y)) < 1e100 else None


def asked(problem: Problem) -> tuple[str, ...]:
    """Return the channels that an experiment script sets."""
    return problem.model.inner.scripted


def at_rest(problem: Problem) -> tuple[Recording, dict[str, float]]:
    """A recording to copy from, and where each of its channels usually is."""
    first = problem.segments[0].recording
    usual = {}
    for name in first.channels:
        together = np.concatenate([p.recording.channels[name] for p in problem.segments if name in p.recording.channels])
        usual[name] = float(np.nanmedian(together)) if np.isfinite(together).any() else np.nan
    return first, usual


def synthetic(usual: tuple[Recording, dict[str, float]], time_s: Array, channels: dict[str, Array]) -> Recording:
    """A recording with `channels` moved and everything else at rest."""
    like, rest = usual
    whole = {name: channels.get(name, np.full(time_s.size, rest[name])) for name in {**like.channels, **channels}}
    every = np.ones(time_s.size, dtype=bool)
    dt_s = float(np.median(np.diff(time_s)))
    return replace(
        like, name="planned", time_s=time_s - time_s[0], dt_s=dt_s, channels=whole, fit=every, heldout=~every, begin_s=0.0
    )


def excitations(problem: Problem) -> list[tuple[Excitation, dict[str, Array]]]:
    """The family for a model of any kind: every input within what was recorded of it; further inputs at three levels."""
    like, _ = at_rest(problem)
    n = min(MOST_SAMPLES, max(200, round(LONGEST_S / like.dt_s))) if like.timed else 1000
    time_s: Array = like.dt_s * np.arange(n, dtype=np.float64)
    names = asked(problem)
    spans = {name: recorded_span(problem, name) for name in names}
    out = []
    for name in names:
        for excitation in family(name, spans[name], time_s, like.timed):
            for levels in held_levels(name, names, spans):
                channels = {other: np.full(n, value) for other, value in levels} | {name: excitation.values}
                out.append((replace(excitation, held=levels), channels))
    return out


def held_levels(name: str, names: tuple[str, ...], spans: dict[str, Span]) -> list[tuple[tuple[str, float], ...]]:
    """The others at rest in the middle; where there is but one other, also at both ends of what was recorded."""
    others = [other for other in names if other != name]
    if len(others) != 1:
        return [tuple((other, spans[other].centre) for other in others)]
    span = spans[others[0]]
    return [((others[0], span.centre + side * span.reach),) for side in (-1.0, 0.0, 1.0)]


def recorded_span(problem: Problem, name: str) -> Span:
    """Where input `name` has been, and how fast."""
    values = np.concatenate([p.recording.channels[name] for p in problem.segments])
    values = values[np.isfinite(values)]
    low, high = (float(q) for q in np.quantile(values, INSIDE))
    steps = np.concatenate([np.abs(np.diff(p.recording.channels[name])) / p.recording.dt_s for p in problem.segments])
    speed = float(np.nanquantile(steps, 0.999))
    unit = problem.segments[0].recording.units.get(name, "")
    return Span(unit, 0.5 * (low + high), 0.5 * (high - low), speed)


def lines(made: list[Design], candidate: Candidate) -> str:
    """The designs for one effect, a line each."""
    return "\n".join(one.says for one in made if one.candidate.key == candidate.key)


def planned(result: Any) -> list[Design]:
    """Return the useful designs of a diagnosis, each excitation once, the largest separation first."""
    seen: dict[str, Design] = {}
    for one in sorted((d for d in result.designs if d.separates), key=lambda d: -d.separation):
        seen.setdefault(f"{one.excitation.channel} {one.excitation.words} {one.excitation.held}", one)
    return list(seen.values())
