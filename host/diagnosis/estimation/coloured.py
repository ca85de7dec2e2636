"""Whether a residual is coloured noise: its level alone is not evidence where noise was never seen alone.

The quietest part of a spectrum bounds white noise only. Floor vibration, 1/f noise of a bridge or a sensor with a filter
exceed it by any factor. Such noise is a stationary process with innovations that neither jump, nor repeat, nor depend on
an input. Each is tested on the innovations e of an autoregression of the residual r:

    e[t] = r[t] - sum_k a_k r[t - k],  k = 1..ORDER
    jumps:   |e| in units of its robust standard deviation
    lines:   the periodogram of e over its own level (Fisher's test: exponential under the hypothesis)
    inputs:  the coherence of e with inputs, their squares, magnitudes and directions (Welch; Carter 1987)

The innovations of a slow wander say nothing of its shape. There the residual itself is compared with features of the
inputs, and between recordings (`structured`). Averaged over parts of a correlation time, the largest share of its variance
that one feature takes is compared with that of surrogates of two kinds, and has to exceed both: noise with the residual's
own spectrum and random phases (Theiler et al., Physica D 1992), and the residual itself with random signs of its parts,
which keeps bursts where they are (Shao, JASA 2010). Few independent samples have chance correlations of any size (Yule
1926), and surrogates have as many. What nominal parameters absorb is removed from residual, features and surrogates alike,
and so is a trend of each recording: its ends do not meet, and random phases would not keep that.

Where a controller hands the noise of an output on to an input, forms of this input follow the residual without any mismatch.
Innovations show it (`feedback.handed_on`): noise of any colour is in the new part of an input some samples later. Features
say nothing there, and recordings are compared with each other alone.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from host.diagnosis.estimation.feedback import ORDER, handed_on, unpredicted
from host.diagnosis.estimation.noise import correlation_time, innovations
from host.diagnosis.estimation.rules import SelectionRules
from host.diagnosis.model.operators import fill, lag, play

Array = npt.NDArray[np.float64]
LONGEST = 512  # samples of a part of a recording, of which at least
PARTS = 16.0  # of an integrated correlation time (an eighth of the time constant) that a slow residual is averaged over
SURROGATES = 999  # noises that a residual is compared with
MOST_PARTS = 8192  # of all recordings, that a residual is averaged over
NOT_ABSORBED = 1e-4  # share of a feature's power that nominal parameters leave, at least
PLAYS, LAGS = (0.1, 0.3, 0.6), (1 / 60, 1 / 20, 1 / 6)  # memories: widths over the span, times over the recording's length
EARLIER = (2, 3, 5, 8, 13, 21, 34, 55, 89)  # samples by which a cause precedes; the speed reads one sample ahead
AVERAGES = 8  # of a recording estimate a coherence: 1 - (p)^(1 / (parts - 1)) is exceeded by chance with p (Carter 1987)


def only_coloured(
    residuals: Sequence[Array],
    inputs: Sequence[Sequence[Array]],
    rules: SelectionRules,
    absorbed: Callable[[], Sequence[Array]] = tuple,
) -> bool:
    """Whether residuals (n_i,) of recordings are coloured noise that no input (n_i,) of its recording explains.

    absorbed: gives (k, n_i) of each recording, what a change of each nominal parameter adds to the output. It is asked where
    a residual is slow, since it costs simulations.
    """
    pairs = [(r, u) for r, u in zip(residuals, inputs, strict=True) if np.isfinite(r).sum() >= 20 * ORDER]
    if not pairs:
        return False
    lines = [fill(r) - np.nanmean(r) for r, _ in pairs]
    new, own = innovations(lines, ORDER), [u for _, u in pairs]
    significance = rules.coloured_significance
    if _jump(new, significance) or _repeat(new, significance):
        return False
    if _follow(new, own, significance) and _caused(new, own, rules):
        return False
    return not too_slow(residuals, rules) or not structured(residuals, inputs, absorbed(), rules)


def too_slow(residuals: Sequence[Array], rules: SelectionRules) -> bool:
    """Whether residuals (n_i,) of recordings have too few independent samples to be separated from a mismatch."""
    return independent_samples(residuals) < rules.slow_noise_samples


def independent_samples(residuals: Sequence[Array]) -> float:
    """Number of independent samples of residuals (n_i,) of recordings, each less its mean."""
    return float(sum(np.isfinite(r).sum() / correlation_time(r - np.nanmean(r)) for r in residuals if np.isfinite(r).any()))


def structured(
    residuals: Sequence[Array], inputs: Sequence[Sequence[Array]], absorbed: Sequence[Array], rules: SelectionRules
) -> bool:
    """Whether residuals (n_i,) of recordings have a structure that noise with their spectra hardly has.

    inputs: (n_i,) of each recording, and simulated outputs; compared unless noise of the residual is handed on to them.
    absorbed: (k, n_i) of each recording, what a change of each nominal parameter adds to the output.
    """
    long = [k for k, r in enumerate(residuals) if np.isfinite(r).sum() >= 20 * ORDER]
    if not long:
        return False
    lines = [fill(residuals[k]) - np.nanmean(residuals[k]) for k in long]
    step = int(np.median([correlation_time(r) for r in lines]) / PARTS)
    step = max(1, step, -(-sum(r.size for r in lines) // MOST_PARTS))
    rows, own_inputs = [_averaged(r, step) for r in lines], [inputs[k] for k in long]
    repeats, follows = len(rows) > 1, all(own_inputs) and handed_on(lines, own_inputs, rules) is None
    significance = rules.slow_structure_significance / max(repeats + follows, 1)
    rng = np.random.default_rng(0)
    if repeats:
        found = float(_of_each_other([row[None, :] for row in rows])[0])
        if _p_value(found, _of_each_other([_random_phases(rng, row) for row in rows])) <= significance:
            return True
    if not follows:
        return False
    rows = [_without_trend(row) for row in rows]
    features = [[_without_trend(_averaged(form, step)) for form in _slow_forms(u)] for u in own_inputs]
    rates = [[_without_trend(_averaged(fill(rate), step)) for rate in absorbed[k]] for k in long if k < len(absorbed)]
    kept = _left_by([np.concatenate(own) for own in zip(*rates, strict=True)])
    forms = [np.concatenate(parts) for parts in zip(*features, strict=True)]
    left = [
        form for form, whole in zip(map(kept, forms), forms, strict=True) if form @ form > NOT_ABSORBED * (whole @ whole)
    ]
    directions, residual = [form / np.linalg.norm(form) for form in left], kept(np.concatenate(rows))
    return all(
        _p_value(*_along(directions, residual, kept(np.concatenate([draw(rng, row) for row in rows], axis=1)), rules))
        <= significance
        for draw in (_random_phases, _random_signs)
    )


def shifted(inputs: Sequence[Array]) -> Array:
    """Inputs (n,) and each of them earlier and later by up to 89 samples, one a row: what a linear law makes of them."""
    rows = []
    for u in map(fill, inputs):
        rows.append(u)
        for k in EARLIER:
            rows += [np.concatenate((np.full(k, u[0]), u[:-k])), np.concatenate((u[k:], np.full(k, u[-1])))]
    return np.array(rows)


def _random_phases(rng: np.random.Generator, row: Array) -> Array:
    """Draws (SURROGATES, n) of noise with the spectrum of `row` (n,), whose mean is zero."""
    size = np.abs(np.fft.rfft(row))
    phase = rng.uniform(0.0, 2.0 * np.pi, (SURROGATES, size.size))
    return np.asarray(np.fft.irfft(size * np.exp(1j * phase), row.size, axis=1))


def _random_signs(rng: np.random.Generator, row: Array) -> Array:
    """Draws (SURROGATES, n) of `row` (n,) with a random sign for each part of a correlation time."""
    length = max(1, round(correlation_time(row)))
    begins = rng.integers(length, size=SURROGATES)
    signs = rng.choice((-1.0, 1.0), (SURROGATES, row.size // length + 2))
    part = (begins[:, None] + np.arange(row.size)) // length
    return np.asarray(row * np.take_along_axis(signs, part, axis=1))


def _p_value(found: float, by_chance: Array) -> float:
    return float(1 + np.count_nonzero(by_chance >= found)) / (1 + by_chance.size)


def _along(directions: list[Array], found: Array, by_chance: Array, rules: SelectionRules) -> tuple[float, Array]:
    """Largest share of the variance along one of `directions` (n,) of unit length: of a residual and of each surrogate.

    Shares of a direction are relative to the one that a surrogate in twenty exceeds: features have unlike numbers of turns.
    One that takes less of the residual than an effect has to is not a structure, however rare it is in noise.

    found: residual (n,). by_chance: surrogates (SURROGATES, n).
    """
    power, powers = float(found @ found) + 1e-300, np.sum(by_chance * by_chance, axis=1) + 1e-300
    largest, largest_by_chance = 0.0, np.zeros(len(powers))
    for direction in directions:
        shares = (by_chance @ direction) ** 2 / powers
        usual = float(np.quantile(shares, 0.95)) + 1e-12
        share = float(found @ direction) ** 2 / power
        if share > rules.least_excess_reduction:
            largest = max(largest, share / usual)
        largest_by_chance = np.maximum(largest_by_chance, shares / usual)
    return largest, largest_by_chance


def _left_by(absorbed: list[Array]) -> Callable[[Array], Array]:
    """Return rows (..., n) less all that a sum of `absorbed` (n,) explains."""
    moving = [rate / np.linalg.norm(rate) for rate in absorbed if np.isfinite(rate).all() and np.ptp(rate) > 0.0]
    if not moving:
        return lambda rows: rows
    directions, sizes, _ = np.linalg.svd(np.column_stack(moving), full_matrices=False)
    basis = directions[:, sizes > 1e-6 * sizes[0]]
    return lambda rows: np.asarray(rows - (rows @ basis) @ basis.T)


def _averaged(x: Array, step: int) -> Array:
    """`x` (n,) averaged over parts of `step` samples, less its mean."""
    parts = x[: x.size // step * step].reshape(-1, step).mean(axis=1)
    return np.asarray(parts - np.mean(parts))


def _without_trend(row: Array) -> Array:
    """`row` (n,), whose mean is zero, less its best straight line."""
    time = np.linspace(-1.0, 1.0, row.size)
    return np.asarray(row - time * (time @ row) / (time @ time + 1e-300))


def _of_each_other(rows: list[Array]) -> Array:
    """Share (count,) of the variance of draws (count, n_i) that is their mean over recordings, as a function of time."""
    n = min(r.shape[1] for r in rows)
    mean = np.mean([r[:, :n] for r in rows], axis=0)
    power = np.mean([np.sum(r[:, :n] ** 2, axis=1) for r in rows], axis=0) + 1e-300
    return np.asarray(np.sum(mean**2, axis=1) / power)


def _slow_forms(inputs: Sequence[Array]) -> list[Array]:
    """Forms (n,) of the inputs (n,) of a recording that a slow residual may follow."""
    forms: list[Array] = []
    filled = [fill(u) for u in inputs]
    for u in filled:
        forms += [*_features(u), np.gradient(u)]
        forms += [play(u, 0.5 * width * float(np.ptp(u)), 0.0) - u for width in PLAYS]
        forms += [lag(u, 1.0, share * u.size) - u for share in LAGS]
    forms += [a * b for k, a in enumerate(filled) for b in filled[k + 1 :]]
    for a, b in itertools.product(filled, repeat=2):  # forces that go with one place and with another speed
        speed = np.gradient(b)
        forms += [a * speed, a * np.abs(speed), a * a * speed, np.abs(a) * np.sign(speed)]
    return forms


def _jump(new: list[Array], significance: float) -> bool:
    """Whether an innovation is larger than that of a normal process may be."""
    from scipy.stats import norm

    count = sum(e.size for e in new)
    return max(float(np.max(np.abs(e))) for e in new) > float(norm.isf(0.5 * significance / count))


def _repeat(new: list[Array], significance: float) -> bool:
    """Whether a line stands out of the spectrum of the innovations."""
    for e in new:
        power = np.abs(np.fft.rfft(e - np.mean(e)))[1:-1] ** 2
        if np.max(power) > np.mean(power) * np.log(power.size * len(new) / significance):
            return True
    return False


def _follow(new: list[Array], inputs: Sequence[Sequence[Array]], significance: float) -> bool:
    """Whether the innovations are coherent with a feature of an input."""
    from scipy.signal import csd, welch

    channels = min((len(u) for u in inputs), default=0)
    tests = channels * len(_features(new[0]))
    for channel in range(channels):
        tables = [_features(fill(u[channel])[ORDER:]) for u in inputs]
        for feature in range(len(tables[0])):
            by_length: dict[int, list[Array]] = {}
            for e, table in zip(new, tables, strict=True):
                size = min(LONGEST, e.size // AVERAGES)
                x = table[feature]
                if np.ptp(x) == 0.0:
                    continue
                given = {"nperseg": size, "noverlap": 0, "detrend": "constant"}  # parts that overlap are not independent
                sums = np.array([welch(x, **given)[1], welch(e, **given)[1], csd(x, e, **given)[1]])
                by_length.setdefault(size, []).append(sums * (e.size // size))
            for size, sums_ in by_length.items():
                xx, ee, xe = np.sum(sums_, axis=0)
                coherence = np.abs(xe[1:-1]) ** 2 / np.maximum((xx * ee)[1:-1].real, 1e-300)
                parts = sum(e.size // size for e in new if min(LONGEST, e.size // AVERAGES) == size)
                limit = 1.0 - (significance / (tests * coherence.size)) ** (1.0 / max(parts - 1, 1))
                if np.max(coherence) > limit:
                    return True
    return False


def _caused(new: list[Array], inputs: Sequence[Sequence[Array]], rules: SelectionRules) -> bool:
    """Whether earlier features of the inputs say something of the innovations (F test of a regression).

    A controller sends noise into its own and later rows of an input, so the two are coherent without any mismatch. Earlier
    inputs hold no later noise (Caines and Chan 1975), nor do steps of an input that are not noise, in whichever row.
    """
    from scipy.stats import f as fisher

    channels = min((len(u) for u in inputs), default=0)
    columns, targets = [], []
    for e, own in zip(new, inputs, strict=True):
        features = [feature for u in own[:channels] for feature in _features(fill(u)[ORDER:])]
        first = EARLIER[-1]
        steps = [_steps(fill(u), rules)[ORDER:] for u in own[:channels]]
        table = np.column_stack(
            [feature[first - k : e.size - k] for feature in features for k in EARLIER]
            + [step[first - k : e.size - k] for step in steps for k in (0, 1)]
        )
        columns.append(table - table.mean(axis=0))
        targets.append(e[first:] - np.mean(e[first:]))
    X, y = np.vstack(columns), np.concatenate(targets)
    explained = y - X @ np.linalg.lstsq(X, y, rcond=1e-9)[0]
    m = int(np.linalg.matrix_rank(X, rtol=1e-9))
    free = y.size - m - len(new)
    if free <= 0:
        return False  # more forms than samples say nothing
    ratio = (float(y @ y) - float(explained @ explained)) / m / (float(explained @ explained) / free + 1e-300)
    return bool(fisher.sf(ratio, m, free) < rules.coloured_significance)


def _steps(u: Array, rules: SelectionRules) -> Array:
    """Unpredicted changes of `u` (n,) that are too large for noise, zero elsewhere."""
    new = unpredicted(u)
    spread = 1.4826 * float(np.median(np.abs(new[ORDER:])))
    return np.asarray(np.where(np.abs(new) > rules.new_input_deviations * spread, new, 0.0))


def _features(u: Array) -> list[Array]:
    """Forms of an input (n,) that a missing effect may follow."""
    x = (u - np.mean(u)) / (np.std(u) + 1e-300)
    return [x, x * x, np.abs(x), x**3, np.sign(np.gradient(x)), np.abs(np.gradient(x))]
