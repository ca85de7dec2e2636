"""A line in the spectrum of a residual: a hum, a vibration or a rotating part, of another phase in each recording.

A sine over time with one phase for all recordings is a candidate effect. If each recording starts at another instant of
the disturbance, no such sine fits, and an autoregression predicts a sine as it predicts noise. The line itself shows in
every periodogram, against the level of the bins around it. A frequency at which the simulated output moves more says
nothing: the residual rings there if a parameter or a start of the nominal model is a little off. Where another signal, or
its square, cube or magnitude, has a line there too, a law may have made the one from the other; but then the other parts
of that signal are in the residual as well, and the law answers alike in all recordings. A line that has nearly all of the
residual does not come from a signal of which it has next to nothing, nor one of another phase in each recording from one
that has it in phase.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import median_filter

from host.diagnosis.model.data_rules import DataRules
from host.diagnosis.model.operators import fill

Array = npt.NDArray[np.float64]
AROUND = 41  # bins of which the median is the level of the noise
FEWEST = 4 * AROUND  # samples


@dataclass(frozen=True)
class Tone:
    """A sine of `amplitude` (unit of the output) at `frequency_Hz` in the residual of every recording."""

    frequency_Hz: float
    amplitude: float


def common_line(
    residuals: Sequence[Array],
    inputs: Sequence[Sequence[Array]],
    simulated: Sequence[Array],
    periods_s: Sequence[float],
    rules: DataRules = DataRules(),
) -> Tone | None:
    """The line at one frequency in all residuals (n_i,) that no law makes of one of the inputs; None if there is none.

    simulated: output (n_i,) of each recording; it moves less than the residual at that frequency. rules: an effect that
    reads its start values from a residual uses the defaults.
    """
    if not residuals or min(int(np.isfinite(r).sum()) for r in residuals) < FEWEST:
        return None
    limit = np.log(sum(r.size // 2 for r in residuals) / rules.line_significance)
    found, makers = [], []  # makers: of each recording, for each input and law, what the law would have to answer
    for r, own, said, dt_s in zip(residuals, inputs, simulated, periods_s, strict=True):
        x = fill(r)
        over = _over_level(x)
        bin_ = int(np.argmax(over))
        if over[bin_] < limit:
            return None
        near = slice(max(bin_ - 2, 0), bin_ + 3)
        if np.sum(_periodogram(fill(said))[near]) > np.sum(_periodogram(x)[near]):
            return None
        tone = _sine(x, bin_, dt_s)
        makers.append([_laws(fill(u), x, tone, dt_s, limit, rules) for u in own])
        found.append(tone)
    answers = np.array(makers).reshape(len(makers), -1).T  # (inputs * laws, recordings)
    if any(_one_law(each, rules) for each in answers):
        return None
    hertz = np.array([each.frequency_Hz for each in found])
    widest = max(1.0 / (r.size * dt_s) for r, dt_s in zip(residuals, periods_s, strict=True))
    amplitude = float(np.sqrt(np.mean([each.amplitude**2 for each in found])))
    share = 0.5 * amplitude**2 / float(np.nanvar(np.concatenate(residuals)))
    return Tone(float(np.mean(hertz)), amplitude) if np.ptp(hertz) < widest and share > rules.line_variance_share else None


def _laws(u: Array, x: Array, tone: Tone, dt_s: float, limit: float, rules: DataRules) -> list[complex]:
    """What each law of `_distorted` would have to answer to the signal `u` (n,) at the line `tone` of the residual `x` (n,).

    NaN where it cannot have made the line; infinite where it may have, whatever it answers: `u` is such a line itself. A
    filter raises its gain at the line above that elsewhere by `rules.line_gain` at most. A distortion leaves the other parts
    of the distorted signal in the residual too, but for what the nominal model takes: the signal and its rate.
    """
    bin_ = round(tone.frequency_Hz * u.size * dt_s)
    near = slice(max(bin_ - 1, 0), bin_ + 2)
    centred, *forms = _distorted(u)
    taken = np.column_stack([np.ones(u.size), centred, np.gradient(centred)])
    left = [form - taken @ np.linalg.lstsq(taken, form, rcond=None)[0] for form in forms]
    share = 0.5 * tone.amplitude**2 / float(np.var(x))
    least = [share / rules.line_gain**2, *(share * rules.line_origin_share for _ in forms)]
    per_sample = tone.frequency_Hz * dt_s
    here, answers = _component(x, per_sample), []
    for form, rest, lowest in zip([centred, *forms], [centred, *left], least, strict=True):
        part = _component(rest, per_sample)
        has = 0.5 * abs(part) ** 2 / max(float(np.var(rest)), 1e-300)
        if not (np.max(_over_level(form)[near], initial=0.0) > limit and has > lowest):
            answers.append(complex(np.nan))
        elif form is centred and has > rules.line_origin_share * share:
            answers.append(complex(np.inf))
        else:
            answers.append(here / part)
    return answers


def _one_law(answers: npt.NDArray[np.complex128], rules: DataRules) -> bool:
    """Whether `answers` (recordings,) are those of one law: alike in size and phase, where they matter."""
    asked = answers[~np.isinf(answers)]
    mean = complex(np.mean(asked)) if asked.size else 0.0
    return not np.isnan(answers).any() and bool(np.all(np.abs(asked - mean) <= rules.line_answer_spread * abs(mean)))


def _component(x: Array, per_sample: float) -> complex:
    """Complex amplitude of the sine of `per_sample` periods a sample in `x` (n,)."""
    window = np.hanning(x.size)
    turns = np.exp(-2j * np.pi * per_sample * np.arange(x.size))
    return complex(2.0 * np.sum(window * turns * (x - np.mean(x))) / np.sum(window))


def _distorted(x: Array) -> list[Array]:
    """Forms of a signal (n,), itself among them, whose lines a nonlinear law makes of those of the signal."""
    centred = fill(x) - np.mean(fill(x))
    speed = np.gradient(centred)
    return [centred, centred**2, centred**3, np.abs(centred), np.sign(speed), speed * np.abs(speed)]


def _over_level(x: Array) -> Array:
    """Periodogram of `x` (n,) over the level around each bin: exponential of mean 1 for noise. Ends say nothing."""
    power = _periodogram(x)
    level = median_filter(power, AROUND, mode="nearest") / np.log(2.0)
    over = power / np.maximum(level, 1e-300)
    over[:3] = over[-2:] = 0.0
    return np.asarray(over)


def _periodogram(x: Array) -> Array:
    return np.asarray(np.abs(np.fft.rfft((x - np.mean(x)) * np.hanning(x.size))) ** 2)


def _sine(x: Array, bin_: int, dt_s: float) -> Tone:
    """The sine near bin `bin_` that takes most of `x` (n,)."""
    t, x = np.arange(x.size) * dt_s, x - np.mean(x)
    tried = (bin_ + np.linspace(-1.0, 1.0, 81)) / (x.size * dt_s)
    sizes = np.array([2.0 / x.size * abs(np.exp(-2j * np.pi * f * t) @ x) for f in tried])
    best = int(np.argmax(sizes))
    return Tone(float(tried[best]), float(sizes[best]))
