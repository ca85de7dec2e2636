"""The initial state of each recording: measured at its first samples, and estimated again from its outputs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import block_diag

from host.diagnosis.estimation.fit import RAN_AWAY, Fit, Problem, Term, free, jacobian, minimize, moved, robust, size_of
from host.diagnosis.estimation.noise import correlation_time
from host.diagnosis.model.effect import memory_keys, rate_key
from host.diagnosis.model.model import ActiveEffect, Model, Segment

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
STEPS_OF_A_STATE = 4  # from the measured state, at most
WEIGHINGS = 3  # of the outputs by what a step leaves
FINE_SHARE = 0.05  # of a standard deviation, of difference quotients about an estimated state
STATE_STEPS = 3  # of parameters and initial states together
SHARES = (1.0, 0.5, 0.25)  # of such a step that are tried
STATE_ROUNDS = 4  # of such steps and a fit of the parameters alone, at most
MUCH_LESS = 0.7  # cost relative to that of the round before, for another round
FARTHEST = 4.0  # standard deviations of the measured state within which the estimated one stays


def estimate_state(model: Model, segment: Segment, theta: Array, active: list[ActiveEffect], unseen: int = 0) -> None:
    """Estimate `segment.begin` by Gauss-Newton steps from the measured state.

    Measured state and outputs are weighed by their variances; that of an output's mean counts correlated samples once.
    One step is enough where the outputs are linear in the state. Another one follows where they end elsewhere than the
    step predicted, by as much as their noise would move a state. Nothing happens where the model knows its state.

    unseen: first samples that a dead time makes of what was before the recording. No state explains them.
    """
    begin = segment.begin
    if begin is None or not begin.estimated:
        return
    moving = model.begins_with(segment, theta, active)
    if not moving.size:
        return
    begin.values = begin.measured.copy()
    at, share = np.zeros(moving.size), 1.0  # standard deviations from the measured state; that of the difference quotients
    r = _left(model, segment, theta, active, unseen)
    for _ in range(STEPS_OF_A_STATE):
        base, columns = begin.values, []
        for k in moving:
            begin.values = base + np.eye(base.size)[k] * share * begin.spread[k]
            columns.append((r - _left(model, segment, theta, active, unseen)) / share)
        to, predicted, scale = _step(r, np.array(columns), at)
        begin.values = begin.measured.copy()
        begin.values[moving] += to * begin.spread[moving]
        now = _left(model, segment, theta, active, unseen)
        if not float(np.nansum(((now - predicted) / scale) ** 2)) > 1.0:
            return
        at, r, share = to, now, FINE_SHARE


def _step(r: Array, rates: Array, at: Array) -> tuple[Array, Array, Array]:
    """Return where a step leads (k,), the residual (outputs, n) predicted there, and the size (outputs, 1) of one of its
    independent samples.

    r: residual (outputs, n); rates (k, outputs, n): by how much it falls for a standard deviation of each state; at (k,):
    where the states are, in standard deviations from the measured ones. The outputs are weighed by what the step leaves of
    them: what it takes away says nothing of their noise.
    """
    used, predicted = np.isfinite(r), r
    to = at
    for _ in range(WEIGHINGS):
        scale = np.array([_weighing(row) for row in predicted])[:, None]
        A = np.array([(rate / scale)[used] for rate in rates]).T
        by = np.linalg.solve(A.T @ A + np.eye(at.size), A.T @ (r / scale)[used] - at)
        to = np.clip(at + by, -FARTHEST, FARTHEST)
        predicted = r - np.tensordot(to - at, rates, axes=1)
    return to, predicted, scale


def _left(model: Model, segment: Segment, theta: Array, active: list[ActiveEffect], unseen: int) -> Array:
    """Residual (outputs, n) from the state that the recording begins with now."""
    r = segment.y - model.simulate(segment, theta, active)
    r[:, :unseen] = np.nan
    return np.asarray(r)


@dataclass(frozen=True)
class _State:
    """One number that a recording begins with: of its model (`index`), or the memory of an effect (`key`).

    mean, spread: what is known of it before the fit. A memory begins within its port's motion of the input.
    """

    segment: Segment
    mean: float
    spread: float
    index: int = -1
    key: str = ""

    @property
    def value(self) -> float:
        if self.key:
            return self.segment.start.get(self.key, 0.0)
        assert self.segment.begin is not None
        return float(self.segment.begin.values[self.index])

    def put(self, value: float) -> None:
        """Let the recording begin with `value`, within four standard deviations."""
        reach = FARTHEST * self.spread
        value = min(max(value, self.mean - reach), self.mean + reach)
        if self.key:
            self.segment.start[self.key] = value
        elif self.segment.begin is not None:
            self.segment.begin.values = self.segment.begin.values.copy()
            self.segment.begin.values[self.index] = value


def _states(problem: Problem, segment: Segment, fit: Fit) -> list[_State]:
    """Every unknown number that `segment` begins with: of its model's state, and of memories that fade with time."""
    found, begin = [], segment.begin
    if begin is not None and begin.estimated:
        for k in problem.model.begins_with(segment, *problem.parted(fit.terms, fit.values)):
            found.append(_State(segment, float(begin.measured[k]), float(begin.spread[k]), int(k)))
    for term in fit.terms:
        candidate = term.candidate
        if candidate.effect.remembers and (candidate.effect.invariant or candidate.effect.timed):
            port, motion = candidate.port.name, problem.model.motion(segment, candidate.port)
            span = _memory_span(segment, term, fit, motion)
            found += [_State(segment, 0.0, span, key=key) for key in memory_keys(candidate)]
            if candidate.effect.begins_with_speed:
                hurry = float(np.ptp(np.gradient(motion, segment.recording.dt_s))) / (float(np.ptp(motion)) or 1.0)
                found.append(_State(segment, 0.0, span * hurry or 1.0, key=rate_key(port)))
    return found


def _memory_span(segment: Segment, term: Term, fit: Fit, motion: Array) -> float:
    """How far from its rest a memory can begin: as far as its input (n,) moves, times its share."""
    if term.candidate.effect.memories:
        return max(float(np.nanmax(row) - np.nanmin(row)) for row in segment.y if np.isfinite(row).any())
    moved_by = segment.inputs[term.candidate.source] if term.candidate.source else motion
    pairs = zip(term.parameters, fit.values_of(term), strict=True)
    share = max((abs(float(value)) for p, value in pairs if p.linear), default=1.0)
    return share * float(np.ptp(moved_by)) or 1.0


def _weighed(problem: Problem, segment: Segment, fit: Fit, values: Array, mask: Mask) -> Array:
    """Weighted residual (samples,) of a recording, NaN where nothing was read or the simulation ran away."""
    r = (problem.left(segment, fit.terms, values)[:, mask] / problem.scale[:, None]).ravel()
    return np.where(np.abs(r) < RAN_AWAY, r, np.nan)


def _answers(
    problem: Problem, segment: Segment, fit: Fit, values: Array, mask: Mask, only: list[_State] | None = None
) -> tuple[Array, Array, list[_State]]:
    """Weighted residual (samples,) of a recording and its change (samples, k) per standard deviation of each state, or of
    `only` some of them.

    A state from which the simulation runs away, as a loop may that saturates, stays where it is: its change is zero.
    """
    states = _states(problem, segment, fit) if only is None else only
    r, columns = _weighed(problem, segment, fit, values, mask), []
    seen = np.isfinite(r)
    for state in states:
        now = state.value
        state.put(now + state.spread)
        by = (state.value - now) / state.spread
        if by < 0.5:  # at its upper end
            state.put(now - state.spread)
            by = (state.value - now) / state.spread
        change = (r - _weighed(problem, segment, fit, values, mask)) / by
        columns.append(np.where(seen, change, 0.0) if np.isfinite(change[seen]).all() else np.zeros(r.size))
        state.put(now)
    return np.where(seen, r, 0.0), np.array(columns).reshape(-1, r.size).T, states


def answers_to_memories(problem: Problem, segment: Segment, fit: Fit) -> list[Array]:
    """Change (samples,) of the weighted simulation of a recording per standard deviation of each memory at its begin.

    samples: those to fit, one output after the other.
    """
    memories = [state for state in _states(problem, segment, fit) if state.key]
    return list(_answers(problem, segment, fit, fit.values, segment.fit, memories)[1].T) if memories else []


def fit_with_states(problem: Problem, fit: Fit, steps: int) -> Fit:
    """`fit` after Gauss-Newton steps of all its parameters and the states of the recordings to fit, together.

    In turn they converge slowly where a state can take the place of an effect for as long as the plant remembers: an
    offset of a tank's reading, for one. A step that does not lower the cost is undone and is the last. On a linear path,
    where the states are those of a plant, it is halved first; elsewhere a mode without damping would ring down through a
    whole recording. Then the states of all recordings are estimated with these parameters, those of recordings that are
    held out too.
    """
    parameters = problem.parameters(fit.terms)
    used = [segment for segment in problem.segments if segment.fit.any()]
    values, r = fit.values, problem.stacked(fit.terms, fit.values)
    cost, _ = robust(r)
    for _ in range(steps):
        J = jacobian(problem, fit.terms, values, r, [size_of(p, v) for p, v in zip(parameters, values, strict=True)])
        answers = [_answers(problem, segment, fit, values, segment.fit) for segment in used]
        states = [state for _, _, own in answers for state in own]
        if not states:
            return fit
        weights = np.repeat([_heaviest(problem, own) for own, _, _ in answers], [len(own) for _, _, own in answers])
        A = np.vstack(
            [
                np.hstack([J, block_diag(*(columns for _, columns, _ in answers))]),
                np.hstack([np.zeros((len(states), J.shape[1])), np.diag(weights)]),
            ]
        )
        by = _least_squares(A, np.concatenate([r, weights * _pull(states)]))
        before = [state.value for state in states]
        for share in SHARES if problem.joint_states else SHARES[:1]:
            trial = values.copy()
            for index, step in zip(free(parameters), by, strict=False):
                of_effect = index >= len(problem.model.parameters)
                trial[index] = moved(parameters[index], values[index], share * float(step), of_effect)
            _move(states, share * by[J.shape[1] :])
            r_new = problem.stacked(fit.terms, trial)
            cost_new, _ = robust(r_new)
            if cost_new < cost:
                break
            for state, old in zip(states, before, strict=True):
                state.put(old)
        else:
            break
        values, r, cost = trial, r_new, cost_new
    for segment in problem.segments:
        own, columns, states = _answers(problem, segment, fit, values, np.ones(segment.n, dtype=bool))
        if states:
            weight = _heaviest(problem, own)
            A = np.vstack([columns, weight * np.eye(len(states))])
            b = np.concatenate([own, weight * _pull(states)])
            before = [state.value for state in states]
            _move(states, _least_squares(A, b))
            # A full step lowers the cost where the outputs are linear in the states. In a loop that saturates it may not.
            now = _weighed(problem, segment, fit, values, np.ones(segment.n, dtype=bool))
            b_new = np.concatenate([now, weight * _pull(states)])
            if not np.isfinite(now[own != 0.0]).all() or np.nansum(b_new**2) > np.sum(b**2) * (1.0 + 1e-9):
                for state, old in zip(states, before, strict=True):
                    state.put(old)
    return Fit(fit.terms, values, cost=cost)


def _least_squares(A: Array, b: Array) -> Array:
    size = np.sqrt(np.sum(A * A, axis=0)) + 1e-300
    return np.asarray(np.linalg.lstsq(A / size, b, rcond=1e-10)[0] / size)


def _pull(states: list[_State]) -> Array:
    return np.array([(state.mean - state.value) / state.spread for state in states])


def _move(states: list[_State], by: Array) -> None:
    for state, step in zip(states, by, strict=True):
        state.put(state.value + float(step) * state.spread)


def _heaviest(problem: Problem, r: Array) -> float:
    """Weight of what is known of a state beforehand, in units of the weighted residual r (outputs * n,) of its recording."""
    return max(_weighing(row) for row in r.reshape(len(problem.noise), -1))


def _weighing(row: Array) -> float:
    """RMS of a residual (n,) times the root of its correlation time (samples)."""
    seen = row[np.isfinite(row)]
    return float(np.sqrt(np.mean(seen**2) * correlation_time(row))) or 1e-300 if seen.size else 1.0


def start_again(problem: Problem, fit: Fit) -> None:
    """Lets a model that runs freely from a measured state find that state again."""
    if problem.joint_states:
        fit_with_states(problem, fit, 0)
        return
    for segment in problem.segments:
        unseen = problem.unseen(segment, fit.terms, fit.values)
        estimate_state(problem.model, segment, *problem.parted(fit.terms, fit.values), unseen)


def begun_again(problem: Problem, fit: Fit) -> Fit:
    """`fit` with its own states at the first samples, where the model is a linear path.

    A delay of the input begins with another state of a linear plant than a delay of its reading does. With the state of
    one of them the other looks worse than it is; with that of the nominal fit, every effect looks better than it is.
    What is known of a state beforehand weighs as much as the residual is large: far from the end it holds the states back,
    and they hold back a delay. So this is repeated while it lowers the cost by much.
    """
    if not problem.joint_states:
        return fit
    for _ in range(STATE_ROUNDS):
        before = fit.cost
        fit = fit_with_states(problem, fit, STATE_STEPS)
        fit = minimize(problem, fit.terms, fit.values, rounds=problem.rules.further_iterations, tolerance=1e-4)
        if not fit.cost < MUCH_LESS * before:
            break
    return fit
