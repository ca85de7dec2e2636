"""Outputs that precede their inputs: their stamps are early, and they are shifted back before any physics is named.

No law of physics answers an input that is yet to come. An output that comes first by more than a sample is therefore a
matter of clocks. A nominal parameter, a mode or a second mass can take over a part of such a lead, at the price of values
that mean nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from host.diagnosis.estimation.fit import Fit, Problem, jacobian, minimize, size_of
from host.diagnosis.model.dataset import Recording
from host.diagnosis.model.effect import Candidate
from host.diagnosis.model.model import Model, Segment
from host.diagnosis.model.operators import fill, later
from host.diagnosis.model.readings import Finding
from host.diagnosis.selection.refits import fit_nominal, settle, settled, try_fit
from host.diagnosis.selection.screening import enough, screen
from host.diagnosis.selection.search import worth_fitting

Array = npt.NDArray[np.float64]
LONGEST_SHARE = 0.1  # of the shortest recording, and
LONGEST_SAMPLES = 200  # up to which an output may come first
LATE_SHARE = 0.25  # of it, up to which a delay is tried that a periodic motion cannot separate from a lead
STARTS = 2  # shifts to either side that are fitted in full, of each set of nominal parameters
STEPS = 6  # whole samples by which the best of them is moved at most
ANSWERED = 1e-3  # of the largest answer to a step, from which an output has answered
FINER = (1.0, 0.2)  # samples to either side of a lead through which a parabola finds the part of a sample


@dataclass(frozen=True)
class _Shifted:
    """The nominal model fitted to an output that is put `samples` later (negative: earlier), with what it leaves."""

    samples: float
    fit: Fit
    power: float


def early_outputs(
    problem: Problem, recordings: list[Recording], candidates: Sequence[Candidate]
) -> tuple[list[Recording], list[Finding]]:
    """Recordings whose early outputs are shifted back, and what was found.

    The nominal model is fitted to each output as it is, and with the output put later or earlier. A lead counts if it

    - is of `clock_lead_samples` at least, beyond the dead time that the nominal model has itself: a model that is later
      than its plant makes every output early,
    - leaves at most `clock_residual_ratio` of the power that is left without it, or with any delay: a motion of period T
      that is early by d is late by T - d as well,
    - leaves no more than `clock_over_noise` times the noise, or is not worse than the best single effect.

    A residual near the noise calls for nothing: what a controller makes of noise comes before its cause too.
    """
    if not recordings[0].timed:
        return recordings, []
    findings: list[Finding] = []
    nominal = fit_nominal(problem)
    for row, output in enumerate(problem.model.outputs):
        if not all(output.channel in recording.channels for recording in recordings):
            continue
        least = problem.rules.residual_over_noise * problem.noise[row].sigma
        if not _power(nominal, row) > least**2:
            continue
        found = _lead(problem, nominal, row, candidates)
        if found is None:
            continue
        dt_s = problem.segments[0].recording.dt_s
        lead_s, column = found * dt_s, problem.columns.get(output.channel, output.channel)
        recordings = [_put_later(problem, r, output.channel, lead_s / r.dt_s) for r in recordings]
        says = f"Column {column} comes {lead_s:.3g} s before the nominal model's answer to its recorded input, and no law "
        says += "answers an input that is yet to come: their clocks disagree. "
        says += f"The diagnosis continues with {column} shifted back."
        findings.append(Finding("clock", column, says))
    return recordings, findings


def _lead(problem: Problem, nominal: Fit, row: int, candidates: Sequence[Candidate]) -> float | None:
    """Samples by which output `row` comes first; None if it does not."""
    rules, data, stated = problem.rules, problem.rules.data, problem.model.hold
    leads, lags = _likely(problem, nominal, row)
    if not leads:
        return None
    first = _nearest(problem, row, [_shifted(problem, row, lead) for lead in leads])
    again = _from(problem, first.fit)
    if _power(again, row) < _power(nominal, row):
        nominal = again
    most = data.clock_residual_ratio * _power(nominal, row)
    late = (_shifted(problem, row, -lag).power for lag in lags)
    if first.power > most or any(first.power > data.clock_residual_ratio * power for power in late):
        return None
    plain = [replace(segment, fed_back=[]) for segment in problem.segments]
    gain = problem.gain("both", nominal.residuals, first.fit.residuals, plain)
    if gain.log_likelihood < rules.pooled_log_likelihood or gain.p_value > rules.significance:
        return None
    own = max(_dead_samples(problem, values, row) for values in (nominal.values, first.fit.values))
    if first.samples - own < data.clock_lead_samples:
        return None
    best = _with_fraction(problem, row, first)
    if not _clean(problem, row, best):
        _hold(problem.model, problem.segments, stated)
        base = fit_nominal(problem)
        ranked = worth_fitting(problem, base, screen(problem, base, list(candidates), lambda *_: None))
        for trial in (try_fit(problem, base, item) for item in ranked):
            ahead = problem.gain("both", best.fit.residuals, trial.fit.residuals, plain).log_likelihood
            if ahead > rules.equal_log_likelihood:
                return None
    return best.samples


def _power(fit: Fit, row: int) -> float:
    """Mean square of what `fit` leaves of an output."""
    return float(np.nanmean(np.concatenate([r[row] for r in fit.residuals]) ** 2))


def _from(problem: Problem, fit: Fit) -> Fit:
    """The nominal model fitted from the values of `fit`, in case its own fit ended in a poor minimum."""
    own = replace(problem, segments=[replace(segment) for segment in problem.segments], scale=problem.scale.copy())
    settle(own, fit.values)
    return settled(own, minimize(own, (), fit.values, states=True))


def _likely(problem: Problem, nominal: Fit, row: int) -> tuple[list[int], list[int]]:
    """Leads and delays (whole samples) at which simulated outputs and their rates, shifted, leave least of output `row`.

    They are simulated with the nominal parameters of the file, and with those fitted: an early output can lead a fit far
    away. No lead where each leaves more than the share `clock_residual_ratio` of what the best delay leaves, or none.
    """
    whole = enough(problem)
    whole = replace(whole, segments=[replace(s, fit=s.fit | s.heldout) if s.fit.any() else s for s in whole.segments])
    least_lead, leads, lags = np.inf, list[int](), list[int]()
    least_lag = np.inf
    for values in (nominal.values, problem.model.guess(problem.segments)):
        settle(whole, values)
        left = _left(whole, values, row)
        middle = left.size // 2
        after, before = left[middle::-1], left[middle:]
        least_lag = min(least_lag, float(np.nanmin(before)))
        longest = min(LONGEST_SAMPLES, int(LONGEST_SHARE * min(s.n for s in problem.segments)), middle)
        after = after[: longest + 1]
        least_lead = min(least_lead, float(np.nanmin(after[1:], initial=np.inf)))
        leads += _valleys(after)
        lags += _valleys(before)
    now = _power(nominal, row) / problem.scale[row] ** 2
    clear = least_lead < problem.rules.data.clock_residual_ratio * min(least_lag, now)
    return (list(dict.fromkeys(leads)), list(dict.fromkeys(lags))) if clear else ([], [])


def _valleys(left: Array) -> list[int]:
    """Shifts of the deepest minima of `left` (shifts,) past its begin."""
    inside = np.flatnonzero((left[1:-1] < left[:-2]) & (left[1:-1] <= left[2:])) + 1
    return [int(k) for k in inside[np.argsort(left[inside])[:STARTS]]]


def _left(problem: Problem, values: Array, row: int) -> Array:
    """Mean square (2 longest + 1,) left of output `row` when the simulated one and its rates are shifted, leads first."""
    used = [segment for segment in problem.segments if segment.fit.any()]
    residuals = problem.stacked((), values)
    sizes = [size_of(p, v) for p, v in zip(problem.model.parameters, values, strict=True)]
    J = jacobian(problem, (), values, residuals, sizes)
    longest = int(LATE_SHARE * min(segment.n for segment in used))
    columns, rows, first = J.shape[1] + 1, len(problem.noise), 0
    shifts = np.arange(-longest, longest + 1)
    products, squares = np.zeros((shifts.size, columns)), np.zeros((shifts.size, columns, columns))
    energy, counted = np.zeros(shifts.size), np.zeros(shifts.size)
    for segment in used:
        n = int(segment.fit.sum())
        part = slice(first + row * n, first + (row + 1) * n)
        first += rows * n
        y = segment.y[row, segment.fit] / problem.scale[row]
        seen = np.isfinite(y)
        y = np.where(seen, y, 0.0)
        X = np.column_stack((y - residuals[part], J[part])) * seen[:, None]
        size = 1 << math.ceil(math.log2(2 * n))
        across = np.fft.irfft(np.fft.rfft(y, size) * np.conj(np.fft.rfft(X.T, size)), size)
        products += across[:, shifts].T
        outer, power = X[:, :, None] * X[:, None, :], y**2
        to, since = np.cumsum(outer, axis=0), np.cumsum(outer[::-1], axis=0)[::-1]
        y_to, y_since = np.cumsum(power), np.cumsum(power[::-1])[::-1]
        late, early = np.arange(longest + 1), np.arange(longest, 0, -1)
        squares += np.concatenate((since[early], to[n - 1 - late]))
        energy += np.concatenate((y_to[n - 1 - early], y_since[late]))
        counted += n - np.abs(shifts)
    scale = np.sqrt(np.einsum("kii->ki", squares) + 1e-300)
    shaped = squares / (scale[:, :, None] * scale[:, None, :]) + 1e-9 * np.eye(columns)
    weights = np.linalg.solve(shaped, (products / scale)[:, :, None])[:, :, 0]
    return np.asarray((energy - np.einsum("ki,ki->k", products / scale, weights)) / np.maximum(counted, 1.0))


def _nearest(problem: Problem, row: int, fits: list[_Shifted]) -> _Shifted:
    """The best of `fits`, moved by whole samples to where the least is left."""
    best = min(fits, key=lambda one: one.power)
    for step in (1, -1):
        for _ in range(STEPS):
            next_one = _shifted(problem, row, best.samples + step)
            if not next_one.power < best.power:
                break
            best = next_one
    return best


def _with_fraction(problem: Problem, row: int, best: _Shifted) -> _Shifted:
    """`best`, or a lead by a part of a sample, or one of whole samples with another hold of the input, if that is better.

    A held input is half a sample late, so smooth recordings may not separate a hold from half a sample of lead. Other holds
    are tried only where the stated one leaves more than noise.
    """
    model, stated, rules = problem.model, problem.model.hold, problem.rules
    plain = [replace(segment, fed_back=[]) for segment in problem.segments]

    def better(one: _Shifted, other: _Shifted) -> bool:
        """Whether `one` is better by as much as an effect has to be."""
        gain = problem.gain("both", other.fit.residuals, one.fit.residuals, plain)
        return gain.log_likelihood > rules.pooled_log_likelihood and gain.p_value < rules.significance

    around = [best.samples - 1.0, best.samples, best.samples + 1.0]
    between = best
    for step in FINER if len(model.outputs) == 1 else ():
        low, high = (_shifted(problem, row, between.samples + by).power for by in (-step, step))
        bend = low - 2.0 * between.power + high
        if not bend > 0.0:
            break
        part = float(np.clip(0.5 * (low - high) / bend, -1.0, 1.0)) * step
        between = min((between, _shifted(problem, row, between.samples + part)), key=lambda one: one.power)
    best = between if better(between, best) else best
    if _clean(problem, row, best):
        return best
    for hold in (hold for hold in model.holds if hold != stated):
        _hold(model, problem.segments, hold)
        for one in [_shifted(problem, row, samples) for samples in (between.samples, *around)]:
            best = one if better(one, best) else best
    _hold(model, problem.segments, stated)
    return best


def _clean(problem: Problem, row: int, one: _Shifted) -> bool:
    """Whether a lead leaves nothing but noise of output `row`."""
    return one.power <= (problem.rules.data.clock_over_noise * problem.noise[row].sigma) ** 2


def _hold(model: Model, segments: list[Segment], hold: str) -> None:
    if model.holds:
        model.hold_as(segments, hold)


def _shifted(problem: Problem, row: int, samples: float) -> _Shifted:
    """The nominal model fitted to output `row` that is put `samples` later; its residuals in the rows of the recording."""
    model, channel = problem.model, problem.model.outputs[row].channel
    segments = [model.prepare(_put_later(problem, segment.recording, channel, samples)) for segment in problem.segments]
    for segment, original in zip(segments, problem.segments, strict=True):
        segment.resolution = original.resolution
    fit = fit_nominal(replace(problem, segments=segments, scale=problem.scale.copy()))
    for index, original in enumerate(problem.segments):
        short = original.n - fit.residuals[index].shape[1]
        ends = (0, short) if samples < 0.0 else (short, 0)
        fit.residuals[index] = np.pad(fit.residuals[index], ((0, 0), ends), constant_values=np.nan)
    return _Shifted(samples, fit, _power(fit, row))


def _put_later(problem: Problem, recording: Recording, channel: str, samples: float) -> Recording:
    """A recording with `channel` put `samples` later.

    Samples for which it has no reading then are left out, where the model finds the state that a recording begins from. A
    model that always begins alike needs the inputs from the first one on: there readings are missing.

    A part of a sample is what all other channels are put later by, past the next whole one: interpolated readings of an
    output would have less noise. A line interpolates inputs that are held, a spline others.
    """
    n, whole = recording.n, math.ceil(samples)
    rest, smooth = whole - samples, problem.model.hold in ("linear", "band_limited")
    begins = all(segment.begin is not None and segment.begin.estimated for segment in problem.segments)
    first = max(whole, 1 if rest > 0.0 else 0) if begins else 0
    kept = slice(first, n + min(whole, 0))
    moved = {}
    for name, values in recording.channels.items():
        if name == channel:
            padded = np.concatenate((np.full(max(whole, 0), np.nan), values))
            moved[name] = padded[kept.start - min(whole, 0) :][: kept.stop - kept.start]
        elif rest > 0.0:
            moved[name] = later(values, rest, smooth)[kept]
        else:
            moved[name] = values[kept]
    return replace(
        recording,
        time_s=recording.time_s[kept] - first * recording.dt_s,
        begin_s=recording.begin_s + first * recording.dt_s,
        channels=moved,
        fit=recording.fit[kept],
        heldout=recording.heldout[kept],
    )


def _dead_samples(problem: Problem, values: Array, row: int) -> int:
    """Samples after which the nominal model answers a step of all its inputs, beyond the one of an input that is held."""
    segment = max(problem.segments, key=lambda one: one.n)
    recording, middle = segment.recording, segment.n // 2
    channels = dict(recording.channels)
    for name in problem.model.quiet_inputs:
        if name in channels:
            x = fill(channels[name])
            channels[name] = x + (np.std(x) or 1.0) * (np.arange(x.size) >= middle)
    before, after = (problem.model.prepare(r) for r in (recording, replace(recording, channels=channels)))
    change = np.abs(problem.model.simulate(after, values, []) - problem.model.simulate(before, values, []))[row, middle:]
    largest = float(np.nanmax(change))
    if not largest > 0.0:
        return segment.n
    return max(int(np.argmax(change > ANSWERED * largest)) - 1, 0)
