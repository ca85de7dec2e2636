"""Steps that an axis loses at instants of its own in each recording: jumps of what its port would need, which stay."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from host.diagnosis.effects.missed_steps import Loss, own_losses
from host.diagnosis.estimation.evidence import asked
from host.diagnosis.estimation.fit import Fit, Problem, finish
from host.diagnosis.estimation.jumps import Jump, jumps_of, steps_there
from host.diagnosis.model.effect import Candidate, Port
from host.diagnosis.model.model import Segment
from host.diagnosis.selection.refits import try_fit
from host.diagnosis.selection.screening import Screened, term_of, without
from host.diagnosis.selection.trial import Trial, refuted
from host.diagnosis.symbolic.dictionary import Form, lay_out

Array = npt.NDArray[np.float64]
LEAST_STEP = 0.02  # of an input's span, from which it steps itself: a residual that jumps with it has another cause
LEAST_SIZE = 0.1  # of the largest: steps are lost by whole ones
ROUNDS = 2  # of the sizes of steps that are held out: one is enough where the outputs are linear in them


@dataclass(frozen=True)
class LostSteps:
    """The trial of an effect, and the courses of its steps, to be laid out in recordings at their full rate."""

    trial: Trial
    forms: list[Form]


def lost_steps(problem: Problem, base: Fit, candidate_effects: list[Candidate]) -> LostSteps | None:
    """The steps that the recordings call for at the port where they explain most; None where nothing calls for them."""
    ports = {c.port.name: c.port for c in candidate_effects if c.effect.id == "missed_steps"}
    found = [own for port in ports.values() if (own := _at(problem, base, port)) is not None]
    return max(found, key=lambda own: own.trial.both.log_likelihood, default=None)


def without_lost_steps(problem: Problem, fit: Fit) -> Fit:
    """`fit` with all its parameters but without the steps that all recordings lose at one instant, if it has any."""
    drop = tuple(term.candidate.key for term in fit.terms if term.candidate.effect.id == "missed_steps")
    return finish(problem, Fit(*without(fit, problem, drop), cost=np.inf)) if drop else fit


def _at(problem: Problem, base: Fit, port: Port) -> LostSteps | None:
    jumps = _jumps(problem, base, port)
    found = _fitted(problem, base, port, jumps) if jumps else None
    if found is None:
        return None
    sizes = np.abs(found.trial.fit.values_of(found.trial.fit.terms[-1]))
    small = iter(sizes < LEAST_SIZE * np.max(sizes, initial=0.0))
    kept = [jump for jump in jumps if not (_in_fit(problem, jump) and next(small))]
    found = _fitted(problem, base, port, kept) if len(kept) < len(jumps) else found
    rules, both = problem.rules, found.trial.both
    price = 3.0 * rules.parameter_penalty * len(kept)  # a size, and an instant that counts twice
    sure = both.log_likelihood > rules.decisive_log_likelihood + price and not refuted(found.trial.heldout, rules)
    return found if sure and both.share > rules.large_error_reduction else None


def _fitted(problem: Problem, base: Fit, port: Port, jumps: list[Jump]) -> LostSteps:
    """The trial of steps at `jumps`, added to `base`."""
    losses = tuple(_loss(problem, port, jump) for jump in jumps)
    forms = [_course(problem.segments[jump.recording], jump, loss) for jump, loss in zip(jumps, losses, strict=True)]
    for form in forms:
        lay_out(problem.segments, form)
    candidate = Candidate(own_losses(losses), port, "", "own")
    term = term_of(problem, candidate, base)
    begin = np.array([p.grid[0] for p in term.parameters])
    trial = try_fit(problem, base, Screened(candidate, term, (), 1.0, [begin]))
    shares = [_share(problem, trial.fit, loss) for loss in losses]
    losses = tuple(replace(loss, size=share * loss.size) for loss, share in zip(losses, shares, strict=True))
    forms = [_scaled(form, share) for form, share in zip(forms, shares, strict=True)]
    trial.candidate = Candidate(own_losses(losses), port, "", "own")
    trial.fit.terms = (*trial.fit.terms[:-1], replace(trial.fit.terms[-1], candidate=trial.candidate))
    trial.fit = finish(problem, trial.fit)
    trial.heldout = problem.gain("heldout", base.residuals, trial.fit.residuals)
    trial.both = problem.gain("both", base.residuals, trial.fit.residuals)
    return LostSteps(trial, forms)


def _in_fit(problem: Problem, jump: Jump) -> bool:
    return bool(problem.segments[jump.recording].fit[jump.sample])


def _jumps(problem: Problem, base: Fit, port: Port) -> list[Jump]:
    """Jumps of what `port` would need; none where an input steps at one of them."""
    needs = problem.needs(base, port)
    jumps = [jump for jump in jumps_of(needs, problem.rules) if asked(problem.segments[jump.recording], "both")[jump.sample]]
    for jump in jumps:
        segment = problem.segments[jump.recording]
        inputs = [problem.model.motion(segment, port), *segment.inputs.values()]
        if any(steps_there(signal, jump.sample, LEAST_STEP, problem.rules) for signal in inputs):
            return []
    return jumps


def _loss(problem: Problem, port: Port, jump: Jump) -> Loss:
    segment = problem.segments[jump.recording]
    recording, unit = segment.recording, segment.units.get(port.name, "")
    instant = recording.begin_s + float(recording.time_s[jump.sample])
    clock = "s" if recording.timed else "samples"
    return Loss(recording.name, instant, clock, jump.size, unit, _in_fit(problem, jump))


def _course(of: Segment, jump: Jump, loss: Loss) -> Form:
    """The course of one step: 0 before, 1 after it, or its size where it is held out; zero in all other recordings."""
    name, begin_s, instant_s = of.recording.name, of.recording.begin_s, float(of.recording.time_s[jump.sample])
    half_s = 0.5 * of.recording.dt_s
    height = 1.0 if loss.fitted else loss.size

    def evaluate(segment: Segment) -> Array:
        if segment.recording.name != name or segment.recording.begin_s != begin_s:
            return np.zeros(segment.n)
        return np.where(segment.recording.time_s > instant_s - half_s, height, 0.0)

    return Form(loss.key, evaluate, 1)


def _share(problem: Problem, fit: Fit, loss: Loss) -> float:
    """How much of its size a step that is held out has with the parameters of `fit`; its course is laid out so."""
    total = 1.0
    for _ in range(0 if loss.fitted else ROUNDS):
        for segment in problem.segments:
            course = segment.equations[loss.key]
            if not np.any(course):
                continue
            left = problem.left(segment, fit.terms, fit.values) / problem.scale[:, None]
            segment.equations[loss.key] = 1.1 * course
            change = (left - problem.left(segment, fit.terms, fit.values) / problem.scale[:, None]) / 0.1
            seen = np.isfinite(left) & np.isfinite(change)
            share = 1.0 + float(np.sum(left[seen] * change[seen])) / max(float(np.sum(change[seen] ** 2)), 1e-300)
            segment.equations[loss.key] = share * course
            total *= share
    return total


def _scaled(form: Form, share: float) -> Form:
    return form if share == 1.0 else replace(form, evaluate=lambda segment: share * form.evaluate(segment))
