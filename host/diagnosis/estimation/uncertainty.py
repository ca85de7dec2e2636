"""Confidence intervals that stand coloured residuals and modules that are not quite true: a jackknife over blocks longer
than the correlation time, the residual's own level and colour, and the scatter between halves of recordings."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy import stats

from host.diagnosis.estimation.fit import Fit, Problem, answers_to_begin, free, jacobian, size_of
from host.diagnosis.estimation.initial_state import answers_to_memories
from host.diagnosis.estimation.instants import instant_interval
from host.diagnosis.estimation.noise import correlation_time
from host.diagnosis.model.effect import Parameter
from host.diagnosis.model.findings import Finding

Array = npt.NDArray[np.float64]


def intervals(problem: Problem, fit: Fit, level: float = 0.95) -> list[tuple[float, float]]:
    """Interval of every parameter (nominal, then effects) of `fit`; those held have none (value twice).

    Linearized at the fit, in each parameter's own scale (logarithm for positive ones). The half-width is the larger of two,
    neither of which may be trusted alone: the level of the residual, each output's counted by its correlation time; and
    the jackknife over blocks of at least four correlation times, whose quantile is Student's with as many degrees of
    freedom as blocks carry the parameter (Satterthwaite): sums of squared scores fall short where few blocks do (Bell and
    McCaffrey 2002). A module whose formula is not quite the true one errs alike all through one excitation and otherwise
    in the next. Sums of scores over halves of recordings, held-out ones too, show that: where these scatter more than
    chance would, the interval is made of them.

    At which moment of a sample an input acts and an output is read, a recording does not say: the two may be up to
    `sampling_delay` samples apart. Delays and time constants of effects are uncertain by that as well (uniform).
    """
    parameters = problem.parameters(fit.terms)
    if not free(parameters):
        return [(float(v), float(v)) for v in fit.values]
    sizes = [size_of(p, v) for p, v in zip(parameters, fit.values, strict=True)]
    base = problem.stacked(fit.terms, fit.values)
    by_begin, known = _by_begin(problem, fit, base)
    rates = jacobian(problem, fit.terms, fit.values, base, sizes)
    J = np.column_stack([rates, by_begin])
    bounds = _by_bounds(problem, parameters, sizes, base)
    prior = np.diag(np.concatenate((bounds, known)))
    inverse = _inverse(J.T @ J + prior)
    quantile = float(stats.norm.ppf(0.5 + 0.5 * level))
    # What is said by bounds alone varies as they do: a direction that no data show is as wide as they are.
    scores = _coloured(problem, J, base) + _level(base) * np.diag(np.concatenate((bounds, np.zeros(known.size))))
    even = np.sqrt(np.maximum(np.diag(inverse @ scores @ inverse), 0.0))
    spread, freedom = _jackknife(_blocks(problem, J, base), prior)
    own = slice(0, rates.shape[1])
    fine = np.maximum(quantile * even, stats.t.ppf(0.5 + 0.5 * level, freedom) * spread)[own]
    coarse, count = _across_recordings(problem, fit, sizes, inverse)
    by_chance = stats.f.ppf(problem.rules.scatter_probability, count - 1, np.maximum(freedom[own], 2.0))
    scattered = coarse > by_chance * (fine / quantile) ** 2
    wide = float(stats.t.ppf(0.5 + 0.5 * level, count - 1)) * np.sqrt(np.maximum(coarse, 0.0))
    widths = np.where(scattered, np.maximum(wide, fine), fine)
    out = [(float(v), float(v)) for v in fit.values]
    for place, index in enumerate(free(parameters)):
        p, value, half = parameters[index], float(fit.values[index]), float(widths[place])
        if p.event:
            out[index] = instant_interval(problem, fit, index, level)
            continue
        if p.unit == "s" and not p.linear and index >= len(problem.model.parameters):
            apart_s = problem.rules.sampling_delay * problem.recorded_s / np.sqrt(3.0)
            half = float(np.hypot(half, quantile * apart_s / (value if p.log else sizes[index])))
        if p.log:
            half = min(half, 20.0)
            low, high = value * np.exp(-half), value * np.exp(half)
        else:
            low, high = value - half * sizes[index], value + half * sizes[index]
        out[index] = (float(max(low, p.low)), float(min(high, p.high)))
    return out


def uncertain(problem: Problem, fit: Fit, spans: list[tuple[float, float]]) -> list[Finding]:
    """Nominal parameters that these recordings do not show: at a bound, or with an interval over a decade.

    One that may be negative counts only where half its interval changes the outputs by more than `undetermined_change` of
    what the parameter that contributes most does, and of what the outputs vary (the one that contributes most may be held).
    """
    parameters, rules = problem.model.parameters, problem.rules
    sizes = [size_of(p, v) for p, v in zip(parameters, fit.values, strict=False)]
    base = problem.stacked(fit.terms, fit.values)
    moving = [index for index in free(problem.parameters(fit.terms)) if index < len(parameters)]
    rates = {}  # RMS change of the weighted outputs by a change of one
    for index in moving:
        moved = fit.values.copy()
        moved[index] += 1e-3 * sizes[index]
        change = problem.stacked(fit.terms, moved) - base
        rates[index] = float(np.sqrt(np.mean(change**2))) / (1e-3 * sizes[index])
    outputs = np.hstack([segment.y[:, segment.fit] for segment in problem.segments]) / problem.scale[:, None]
    outputs = outputs[:, np.isfinite(outputs).all(axis=0)]
    varied = float(np.sqrt(np.mean(np.var(outputs, axis=1)))) if outputs.size else 0.0
    varied = max([varied, *(rates[index] * abs(float(fit.values[index])) for index in moving)])
    found = []
    for index in moving:
        p, value, (low, high) = parameters[index], float(fit.values[index]), spans[index]
        near = rules.nominal_bound_share
        at_bound = p.log and (value <= (1.0 + near) * p.low or value >= (1.0 - near) * p.high)
        widest = rules.undetermined_ratio
        wide = low * high <= 0.0 or low / high <= 1.0 / widest or low / high >= widest
        if not p.log:
            wide = wide and 0.5 * (high - low) * rates[index] > rules.undetermined_change * varied
        if at_bound or wide:
            where = "ended at a bound" if at_bound else "can be anything"
            says = f"The nominal parameter {p.name} {where} from {low:.3g} to {high:.3g} {p.unit}".rstrip()
            says += " (95 %): these recordings do not determine it. "
            says += "Hold it at a known value, or record a motion that depends on it."
            found.append(Finding("excitation", p.name, says))
    return found


def idle_inputs(problem: Problem, fit: Fit) -> list[Finding]:
    """Inputs that move the outputs by no more than noise: parameters that scale with them are not determined.

    A free decay shows damping and stiffness over mass. With the noise of a force that was not there, a mass is fitted too,
    whose interval takes that noise for an exact input.
    """
    model, found = problem.model, []
    if not model.driven or not fit.residuals:
        return []
    for name in model.quiet_inputs:
        still = []
        for segment in problem.segments:
            channels = segment.recording.channels
            level = np.full(segment.n, float(np.nanmedian(channels[name])))
            other = model.prepare(replace(segment.recording, channels={**channels, name: level}))
            other.start, other.begin, other.equations = segment.start, segment.begin, segment.equations
            still.append(segment.y - problem.simulate(other, fit.terms, fit.values))
        gain = problem.gain("both", still, fit.residuals)
        if gain.log_likelihood < problem.rules.heldout_log_likelihood:
            column = problem.columns.get(name, name)
            says = f"Column {column} moves the output by less than noise: the residual is as small without it. These "
            says += "recordings determine ratios of the nominal parameters, not those that scale with this column. "
            says += f"Record a motion that column {column} drives, or hold one of these parameters at a known value."
            found.append(Finding("excitation", column, says))
    return found


def _inverse(A: Array) -> Array:
    """Inverse of a matrix of products, scaled; directions that the data do not show have none."""
    scale = np.sqrt(np.maximum(np.diag(A), 1e-12 * (np.max(np.diag(A), initial=0.0) + 1e-300)))
    return np.asarray(np.linalg.pinv(A / np.outer(scale, scale), rcond=1e-11) / np.outer(scale, scale))


def _across_recordings(problem: Problem, fit: Fit, sizes: list[float], inverse: Array) -> tuple[Array, int]:
    """Variances from the scatter of scores between halves of recordings, fitted and held-out ones alike; their number.

    The states that each recording begins with are fitted to it. Scores are those of what the parameters change past them
    (Frisch and Waugh 1933).
    """
    both = replace(problem, segments=[replace(segment, fit=segment.fit | segment.heldout) for segment in problem.segments])
    base = both.stacked(fit.terms, fit.values)
    J = jacobian(both, fit.terms, fit.values, base, sizes)
    by_begin, known = _by_begin(both, fit, base)
    J = J - by_begin @ (_inverse(by_begin.T @ by_begin + np.diag(known)) @ (by_begin.T @ J))
    scores, at, rows = [], 0, len(problem.model.outputs)
    for segment, given in zip(both.segments, problem.segments, strict=True):
        n = int(segment.fit.sum())
        part = slice(at, at + rows * n)
        products = (J[part] * base[part, None]).reshape(rows, n, -1).sum(axis=0)
        at += rows * n
        for mask in (given.fit[segment.fit], given.heldout[segment.fit]):
            scores += [half.sum(axis=0) for half in np.array_split(products[mask], 2) if half.size]
    S, count = np.array(scores), len(scores)
    share = sum(p.fit.sum() for p in problem.segments) / max(sum(p.fit.sum() for p in both.segments), 1)
    of_parameters = inverse[: J.shape[1], : J.shape[1]]
    covariance = of_parameters @ (S.T @ S * (share * count / max(count - 1, 1))) @ of_parameters
    return np.diag(covariance), max(count, 2)


def _by_begin(problem: Problem, fit: Fit, base: Array) -> tuple[Array, Array]:
    """Rates of the weighted simulation by the state from which each recording runs freely, where a model has one, and by the
    memory with which each effect begins there, because both are estimated too; and how well each is known beforehand.

    Without its memories, the frequency of a line would be as certain as if the phase of each recording were known: half its
    interval. Columns are for one standard deviation of what is known of a state. Its precision in the units of the
    residuals is their level, counted by correlation time: without it, a block that holds the begin of a recording would
    leave that state free when it is left out.
    """
    columns, known, at, rows = [], [], 0, len(problem.model.outputs)
    for segment in problem.segments:
        n = rows * int(segment.fit.sum())
        part, at = slice(at, at + n), at + n
        if not n:
            continue
        own = [column for _, column in answers_to_begin(problem, fit.terms, fit.values, base, segment)]
        for change in answers_to_memories(problem, segment, fit):
            column = np.zeros(base.size)
            column[part] = change
            own.append(column)
        level = float(np.mean([np.mean(row**2) * correlation_time(row) for row in base[part].reshape(rows, -1)]))
        columns += own
        known += [level] * len(own)
    used = [k for k, column in enumerate(columns) if np.any(column)]
    if not used:
        return np.zeros((base.size, 0)), np.zeros(0)
    return np.array([columns[k] for k in used]).T, np.array([known[k] for k in used])


def _parts(problem: Problem, J: Array, base: Array) -> Iterator[tuple[Array, Array]]:
    """Weighted residuals (outputs, n) and their rates (outputs, n, parameters) of each recording that is fitted."""
    at, rows = 0, len(problem.model.outputs)
    for segment in problem.segments:
        n = int(segment.fit.sum())
        if n:
            yield base[at : at + rows * n].reshape(rows, n), J[at : at + rows * n].reshape(rows, n, -1)
            at += rows * n


def _coloured(problem: Problem, J: Array, base: Array) -> Array:
    """Covariance of J^T r for residuals of their own level and correlation time in every output and recording."""
    total = np.zeros((J.shape[1], J.shape[1]))
    for r, rates in _parts(problem, J, base):
        for row, rate in zip(r, rates, strict=True):
            seen = row[row != 0.0]
            if seen.size:
                total += rate.T @ rate * float(np.mean(seen**2)) * correlation_time(np.where(row != 0.0, row, np.nan))
    return total


def _level(base: Array) -> float:
    """Mean square of weighted residuals (samples,); missing ones are zero."""
    seen = base[base != 0.0]
    return float(np.mean(seen**2)) if seen.size else 1.0


def _by_bounds(problem: Problem, parameters: list[Parameter], sizes: list[float], base: Array) -> Array:
    """Precision of what the bounds of each free parameter say of it, in the units of the residuals; zero without bounds.

    Where some parameters can take each other's place, rounding decides how far they may go, and an effect that they hardly
    touch would go with them.
    """
    level = _level(base)
    reach = [
        np.log(parameters[k].high / parameters[k].low)
        if parameters[k].log and parameters[k].low > 0.0
        else (parameters[k].high - parameters[k].low) / sizes[k]
        for k in free(parameters)
    ]
    return np.array([level * (2.0 / width) ** 2 if np.isfinite(width) and width > 0.0 else 0.0 for width in reach])


def _blocks(problem: Problem, J: Array, base: Array) -> list[tuple[Array, Array]]:
    """J^T J and J^T r of blocks of time, all outputs of a block together."""
    found = []
    for r, rates in _parts(problem, J, base):
        n = r.shape[1]
        tau = max(correlation_time(row) for row in r)
        for part in np.array_split(np.arange(n), int(np.clip(n / max(4.0 * tau, 10.0), 1, 60))):
            rate = rates[:, part].reshape(-1, J.shape[1])
            found.append((rate.T @ rate, rate.T @ r[:, part].ravel()))
    return found


def _jackknife(blocks: list[tuple[Array, Array]], prior: Array) -> tuple[Array, Array]:
    """Standard deviations of the parameters by leaving out one block at a time, and their degrees of freedom.

    `prior`: precision of what is known beforehand, which no block holds.
    """
    whole, count = np.sum([A for A, _ in blocks], axis=0) + prior, len(blocks)
    changes, expected = [], []
    for A, score in blocks:
        inverse = _inverse(whole - A)
        changes.append(inverse @ score)
        expected.append(np.maximum(np.diag(inverse @ A @ inverse), 0.0))
    S, E = np.array(changes), np.array(expected)
    spread = np.sqrt((count - 1) / count * np.sum(S**2, axis=0))
    freedom = np.sum(E, axis=0) ** 2 / np.maximum(np.sum(E**2, axis=0), 1e-300)
    return spread, np.maximum(freedom, 1.0)
