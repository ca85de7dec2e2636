"""Whether a residual is coloured noise: its level alone is not evidence where noise was never seen alone.

The quietest part of a spectrum bounds white noise only. Floor vibration, 1/f noise of a bridge or a sensor with a filter
exceed it by any factor. Such noise is a stationary process with innovations that neither jump, nor repeat, nor depend on
an input. Each is tested on the innovations e of an autoregression of the residual r:

    e[t] = r[t] - sum_k a_k r[t - k],  k = 1..ORDER
    jumps:   |e| in units of its robust standard deviation
    lines:   the periodogram of e over its own level (Fisher's test: exponential under the hypothesis)
    inputs:  the coherence of e with inputs, their squares, magnitudes and directions (Welch; Carter 1987)

The innovations of a slow wander say nothing of its shape. A residual with few independent samples counts as noise only if
no structure is common to its recordings as well: averaged over parts of a correlation time, it is correlated with features
of the inputs (the largest share of variance over all of them), with time, and between recordings. The limits come from
simulated noise of the same correlation time, since few samples have chance correlations of any size (Yule 1926).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from host.diagnosis.estimation.evidence import correlation_time
from host.diagnosis.estimation.feedback import unpredicted
from host.diagnosis.estimation.noise import autoregression
from host.diagnosis.estimation.rules import SelectionRules
from host.diagnosis.model.operators import fill, lag, play

Array = npt.NDArray[np.float64]
ORDER = 20  # of the autoregression
LONGEST = 512  # samples of a part of a recording, of which at least
PARTS = 16.0  # of an integrated correlation time (an eighth of the time constant) that a slow residual is averaged over
SIMULATED = 999  # noises that a slow residual is compared with
PLAYS, LAGS = (0.1, 0.3, 0.6), (1 / 60, 1 / 20, 1 / 6)  # memories: widths over the span, times over the recording's length
EARLIER = (2, 3, 5, 8, 13, 21, 34, 55, 89)  # samples by which a cause precedes; the speed reads one sample ahead
AVERAGES = 8  # of a recording estimate a coherence: 1 - (p)^(1 / (parts - 1)) is exceeded by chance with p (Carter 1987)


def only_coloured(residuals: Sequence[Array], inputs: Sequence[Sequence[Array]], rules: SelectionRules) -> bool:
    """Whether residuals (n_i,) of recordings are coloured noise that no input (n_i,) of its recording explains."""
    pairs = [(r, u) for r, u in zip(residuals, inputs, strict=True) if np.isfinite(r).sum() >= 20 * ORDER]
    if not pairs:
        return False
    lines = [fill(r) - np.nanmean(r) for r, _ in pairs]
    new, own = _innovations(lines), [u for _, u in pairs]
    significance = rules.coloured_significance
    if _jump(new, significance) or _repeat(new, significance):
        return False
    if _follow(new, own, significance) and _caused(new, own, rules):
        return False
    return not too_slow(residuals, rules) or not _common(lines, own, rules)


def too_slow(residuals: Sequence[Array], rules: SelectionRules) -> bool:
    """Whether residuals (n_i,) of recordings have too few independent samples to be separated from a mismatch."""
    return independent_samples(residuals) < rules.slow_noise_samples


def independent_samples(residuals: Sequence[Array]) -> float:
    """Number of independent samples of residuals (n_i,) of recordings, each less its mean."""
    return float(sum(np.isfinite(r).sum() / correlation_time(r - np.nanmean(r)) for r in residuals if np.isfinite(r).any()))


def _common(lines: list[Array], inputs: Sequence[Sequence[Array]], rules: SelectionRules) -> bool:
    """Whether slow residuals (n_i,) of recordings share a structure that noise of their correlation time hardly has."""
    step = max(1, int(np.median([correlation_time(r) for r in lines]) / PARTS))
    rows = [_averaged(r, step) for r in lines]
    fade = _fade(rows)
    tables = [_slow_features(u, step, len(rows)) for u in inputs]
    rng = np.random.default_rng(0)
    noises = [_wander(rng, SIMULATED, r.size, fade) for r in rows]
    of_inputs, by_inputs = _of_features([r[None, :] for r in rows], tables), _of_features(noises, tables)
    usual = np.quantile(by_inputs, 0.95, axis=1, keepdims=True) + 1e-12  # features have unlike numbers of turns
    tests = [(np.max(of_inputs / usual), np.max(by_inputs / usual, axis=0))] if tables[0] else []
    if len(rows) > 1:
        tests.append((_of_each_other([r[None, :] for r in rows])[0], _of_each_other(noises)))
    limit = rules.slow_structure_significance / max(len(tests), 1) * (SIMULATED + 1)
    return any(1 + np.count_nonzero(by_chance >= found) <= limit for found, by_chance in tests)


def _averaged(x: Array, step: int) -> Array:
    """`x` (n,) averaged over parts of `step` samples, less its mean."""
    parts = x[: x.size // step * step].reshape(-1, step).mean(axis=1)
    return np.asarray(parts - np.mean(parts))


def _fade(rows: list[Array]) -> float:
    """Correlation of neighbours of a first-order process, less the bias of short records (Kendall 1954)."""
    a = sum(float(r[1:] @ r[:-1]) for r in rows) / (sum(float(r @ r) for r in rows) + 1e-300)
    n = float(np.mean([r.size for r in rows]))
    return float(np.clip(a + (1.0 + 4.0 * a) / n, 0.0, 1.0 - 1.0 / n))


def _wander(rng: np.random.Generator, count: int, n: int, fade: float) -> Array:
    """Draws (count, n) of a stationary first-order process of unit variance, each less its mean."""
    out = np.empty((count, n))
    out[:, 0] = rng.standard_normal(count)
    for k in range(1, n):
        out[:, k] = fade * out[:, k - 1] + np.sqrt(1.0 - fade**2) * rng.standard_normal(count)
    return out - out.mean(axis=1, keepdims=True)


def _of_features(rows: list[Array], tables: list[list[Array]]) -> Array:
    """Share (features, count) of the variance of draws (count, n_i) that a feature takes with one coefficient in all."""
    power = sum(np.sum(r * r, axis=1) for r in rows) + 1e-300
    shares = []
    for feature in zip(*tables, strict=True):
        size = sum(float(f @ f) for f in feature) + 1e-300
        shares.append(sum(r @ f for r, f in zip(rows, feature, strict=True)) ** 2 / (size * power))
    return np.array(shares)


def _of_each_other(rows: list[Array]) -> Array:
    """Share (count,) of the variance of draws (count, n_i) that is their mean over recordings, as a function of time."""
    n = min(r.shape[1] for r in rows)
    mean = np.mean([r[:, :n] for r in rows], axis=0)
    power = np.mean([np.sum(r[:, :n] ** 2, axis=1) for r in rows], axis=0) + 1e-300
    return np.asarray(np.sum(mean**2, axis=1) / power)


def _slow_features(inputs: Sequence[Array], step: int, recordings: int) -> list[Array]:
    """Forms of the inputs of a recording, and of time if there are several, averaged over parts of `step` samples."""
    table: list[Array] = []
    filled = [fill(u) for u in inputs]
    for u in filled:
        table += [*_features(u), np.gradient(u)]
        table += [play(u, 0.5 * width * float(np.ptp(u)), 0.0) - u for width in PLAYS]
        table += [lag(u, 1.0, share * u.size) - u for share in LAGS]
    table += [a * b for k, a in enumerate(filled) for b in filled[k + 1 :]]
    if recordings > 1 and filled:
        table.append(np.arange(filled[0].size, dtype=float))
    return [_averaged(feature, step) for feature in table]


def _innovations(lines: list[Array]) -> list[Array]:
    """Innovations (n_i - ORDER,) of one autoregression of all recordings, in robust standard deviations."""
    lags = np.array([sum(float(r[: r.size - k] @ r[k:]) for r in lines) for k in range(ORDER + 1)])
    a = autoregression(lags)
    new = [r[ORDER:] - np.column_stack([r[ORDER - k - 1 : r.size - k - 1] for k in range(ORDER)]) @ a for r in lines]
    together = np.concatenate(new)
    spread = 1.4826 * float(np.median(np.abs(together - np.median(together)))) + 1e-300
    return [e / spread for e in new]


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
