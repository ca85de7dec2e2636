"""A parameter that drifts while a recording runs: friction fades as grease warms, a tank runs empty.

No effect of the vocabulary changes with time but a stiffness and a reading. Several effects at once can pass for such a
drift: weakly damped modes beat, clocks run apart. Here one parameter p of the nominal model, alone or with one effect, runs
straight between values p_k at times t_k over each recording, all others being constant. Slow as it is, the outputs are

    y(t) = sum_k h_k(t) y(t; p_k),   h_k(t) = max(0, 1 - |t - t_k| / (t_1 - t_0))

One drift that predicts held-out samples better than all the effects named do is the better explanation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from host.diagnosis.estimation.fit import Array, Fit, Problem, free, get_starts, jacobian, moved, rate, set_starts, size_of
from host.diagnosis.model.readings import Finding
from host.diagnosis.selection.between_recordings import inadequate, root_mean_square
from host.diagnosis.selection.found import Found

KNOTS = 7
MOST_TRIED = 5  # effects of the first step with which a parameter may drift: the one that promises most, of each
ROUNDS = 10  # of Gauss and Newton's steps
GAINED = 1e-4  # of the squared residual, below which a step is the last one


@dataclass(frozen=True)
class _Drift:
    """Values (parameters,) of a structure, and those (KNOTS,) of its parameter `index` over the time of a recording.

    left: squared residual, to first order or in fact. starts: of the memories.
    """

    fit: Fit
    index: int
    values: Array
    course: Array
    left: float
    starts: list[dict[str, float]]


def drifting(problem: Problem, found: Found) -> list[Finding]:
    """A finding (id `drifting`) where one parameter that drifts explains more than the effects that are named.

    Looked for where many effects are named, or these leave more than noise.
    """
    best, rules = found.best, problem.rules
    if problem.budget.spent():
        return []
    if len(best.terms) <= rules.partial_effects and inadequate(problem, best) is None:
        return []
    begun = get_starts(problem)
    promising = [
        min(_screened(problem, *structure), key=lambda d: d.left) for structure in _structures(problem, found, begun)
    ]
    fitted = [_fitted(problem, drift) for drift in promising]
    drift = min(fitted, key=lambda each: each.left, default=None)
    residuals = [] if drift is None else _residuals(problem, drift)
    set_starts(problem, begun)
    if drift is None:
        return []
    more = drift.fit.fitted + KNOTS - 1 - best.fitted
    held = problem.gain("heldout", best.residuals, residuals)
    both = problem.gain("both", best.residuals, residuals)
    alone = problem.gain("heldout", drift.fit.residuals, residuals)  # of the course, without the effect that it is one of
    least = rules.heldout_log_likelihood + rules.parameter_penalty * max(more, 0)
    better = all(
        gain.share > rules.refinement_error_reduction and gain.p_value < rules.significance for gain in (held, alone)
    )
    if better and held.log_likelihood > rules.heldout_log_likelihood and both.log_likelihood > least:
        return [_said(problem, found, drift, residuals)]
    return []


def _structures(problem: Problem, found: Found, begun: list[dict[str, float]]) -> list[tuple[Fit, list[dict[str, float]]]]:
    """The nominal model, and each of the likeliest effects of the first step in its simplest form, with their starts; those
    in which a parameter may move.
    """
    tried = [trial for trial in (found.steps[0].trials if found.steps else ()) if len(trial.fit.terms) == 1]
    simplest: dict[str, tuple[Fit, list[dict[str, float]]]] = {}
    for trial in sorted(tried, key=lambda trial: (trial.fit.fitted, trial.fit.cost)):
        simplest.setdefault(trial.candidate.name, (trial.fit, trial.starts))
    likeliest = sorted(simplest.values(), key=lambda pair: pair[0].cost)
    structures = [(found.nominal, begun), *likeliest[:MOST_TRIED]]
    return [structure for structure in structures if free(problem.parameters(structure[0].terms))]


def _shapes(problem: Problem) -> Array:
    """h_k at the samples to fit, (KNOTS, samples), in the order of stacked residuals."""
    rows = len(problem.model.outputs)
    parts = [np.tile(_shape(s.n)[:, s.fit], (1, rows)) for s in problem.segments if s.fit.any()]
    return np.hstack(parts)


def _shape(n: int) -> Array:
    """h_k of a recording (KNOTS, n)."""
    at = np.linspace(0.0, KNOTS - 1.0, n)
    return np.asarray(np.maximum(0.0, 1.0 - np.abs(at - np.arange(KNOTS)[:, None])))


def _screened(problem: Problem, fit: Fit, starts: list[dict[str, float]]) -> list[_Drift]:
    """Each parameter that may drift in the structure of `fit`, with what its drift leaves to first order."""
    set_starts(problem, starts)
    parameters, shapes = problem.parameters(fit.terms), _shapes(problem)
    r = problem.stacked(fit.terms, fit.values)
    sizes = [size_of(p, v) for p, v in zip(parameters, fit.values, strict=True)]
    J = jacobian(problem, fit.terms, fit.values, r, sizes)
    found = []
    for column, index in enumerate(free(parameters)):
        columns = np.hstack((J, (shapes[1:] * J[:, column]).T))
        size = np.linalg.norm(columns, axis=0) + 1e-300
        by = np.linalg.lstsq(columns / size, r, rcond=1e-9)[0]
        left = float(np.sum((r - columns / size @ by) ** 2))
        found.append(_Drift(fit, index, fit.values, np.full(KNOTS, fit.values[index]), left, starts))
    return found


def _fitted(problem: Problem, drift: _Drift) -> _Drift:
    """`drift` fitted by damped steps of Gauss and Newton, with rates of what is constant at the middle of the course."""
    set_starts(problem, drift.starts)
    terms, parameters, shapes = drift.fit.terms, problem.parameters(drift.fit.terms), _shapes(problem)
    p, others = parameters[drift.index], [k for k in free(parameters) if k != drift.index]
    drift, stacks = _tried(problem, drift, drift.values, drift.course, shapes)
    damping = 1e-3
    for _ in range(ROUNDS):
        r = np.sum(shapes * stacks, axis=0)
        at = [_with(drift, drift.values, value) for value in drift.course]  # values of each knot
        sizes = [size_of(q, v) for q, v in zip(parameters, at[KNOTS // 2], strict=True)]
        constant = [rate(problem, terms, at[KNOTS // 2], stacks[KNOTS // 2], k, sizes[k]) for k in others]
        knots = zip(shapes, at, stacks, strict=True)
        own = [shape * rate(problem, terms, now, own, drift.index, sizes[drift.index]) for shape, now, own in knots]
        J = np.array([*constant, *own]).T
        size = np.linalg.norm(J, axis=0) + 1e-300
        A, g = (J / size).T @ (J / size), (J / size).T @ r
        for _ in range(6):
            by = np.linalg.lstsq(A + damping * np.eye(A.shape[0]), g, rcond=1e-10)[0] / size
            new = drift.values.copy()
            for k, step in zip(others, by, strict=False):
                new[k] = moved(parameters[k], drift.values[k], float(step), of_effect=True)
            course = np.array(
                [moved(p, v, float(s), of_effect=True) for v, s in zip(drift.course, by[len(others) :], strict=True)]
            )
            trial, after = _tried(problem, drift, new, course, shapes)
            if trial.left < drift.left:
                break
            damping *= 10.0
        else:
            return drift
        gained, drift, stacks, damping = 1.0 - trial.left / drift.left, trial, after, 0.1 * damping
        if gained < GAINED:
            break
    return drift


def _with(drift: _Drift, values: Array, value: float) -> Array:
    """`values` with `value` for the parameter that drifts."""
    now = values.copy()
    now[drift.index] = value
    return now


def _tried(problem: Problem, drift: _Drift, values: Array, course: Array, shapes: Array) -> tuple[_Drift, Array]:
    """`drift` with these values, and its weighted and stacked residuals with the value of each knot (KNOTS, samples)."""
    stacks = np.array([problem.stacked(drift.fit.terms, _with(drift, values, value)) for value in course])
    left = float(np.sum(np.sum(shapes * stacks, axis=0) ** 2))
    return replace(drift, values=values, course=course, left=left), stacks


def _residuals(problem: Problem, drift: _Drift) -> list[Array]:
    """Residuals (outputs, n) of every recording."""
    set_starts(problem, drift.starts)
    out = [np.zeros_like(segment.y) for segment in problem.segments]
    for knot, value in enumerate(drift.course):
        values = _with(drift, drift.values, value)
        for whole, segment in zip(out, problem.segments, strict=True):
            whole += _shape(segment.n)[knot] * problem.left(segment, drift.fit.terms, values)
    return out


def _said(problem: Problem, found: Found, drift: _Drift, residuals: list[Array]) -> Finding:
    p = problem.parameters(drift.fit.terms)[drift.index]
    owner = f" of {drift.fit.terms[0].candidate.name}" if drift.index >= len(problem.model.parameters) else ""
    course = ", ".join(f"{value:.3g}" for value in drift.course)
    row = int(np.argmax(root_mean_square(problem, found.best.residuals) / np.maximum(problem.noise_sd, 1e-300)))
    output = problem.model.outputs[row]
    before, after = (root_mean_square(problem, r)[row] for r in (found.best.residuals, residuals))
    named = "".join(f", and {term.candidate.name}" for term in found.best.terms)
    says = f"A parameter drifts with time: {p.name}{owner} is {course} {p.unit}".rstrip()
    says += f", at {KNOTS} equal distances from the begin of each recording to its end. So the model leaves {after:.3g} "
    says += f"{output.unit} RMS; {before:.3g} is left with constant parameters{named}. Something warms up, wears or "
    says += "runs empty, or an effect depends on what differs over the recording (amplitude, speed, load)."
    return Finding("drifting", problem.columns.get(output.channel, output.channel), says)
