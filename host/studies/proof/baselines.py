"""What others would do with the same recordings: the refitted nominal alone, PySINDy, a Gaussian process, the oracle.

They are given more than the finder gets (the true noise level, and the oracle the true effect), and still say no names.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from host.studies.proof.scoring import gap_closed
from sim.concealed.label import Label
from sim.concealed.rig import NoiselessRecordings
from sim.concealed.suite import rebuild
from sim.concealed.system import ScaledEffect, System, columns

Array = np.ndarray
Model = Callable[[Array, Array, Array], Array]  # features train (n, k), residuals (n, m), features held out -> (l, m)
NAMES = ("refitted_nominal", "pysindy", "gaussian_process", "oracle")
_POINTS = 350


class Unavailable(Exception):
    """A baseline whose package is not installed."""


def read_columns(path: Path) -> dict[str, Array]:
    """Columns of a recording, missing samples as NaN."""
    from pyarrow import csv, parquet

    table = parquet.read_table(path) if path.suffix == ".parquet" else csv.read_csv(path)
    return {name: table[name].to_numpy(zero_copy_only=False).astype(float) for name in table.column_names}


def read_session(system: System, folder: Path) -> NoiselessRecordings:
    """The recordings of a case as the system's session."""
    tables = [read_columns(path) for path in sorted(folder.glob("[abc].*"))]
    none = NoiselessRecordings(
        tuple(t["time_s"] for t in tables),
        *(tuple(np.zeros((len(t["time_s"]), k)) for t in tables) for k in _widths(system)),
    )
    names = list(columns(system, none, 0))[1:]
    k = _widths(system)[0]
    stacked = [np.column_stack([t[name] for name in names]) for t in tables]
    return NoiselessRecordings(none.time_s, tuple(x[:, :k] for x in stacked), tuple(x[:, k:] for x in stacked))


def _widths(system: System) -> tuple[int, int]:
    return {"rig": (3, 17), "transmission": (3, 2), "axis": (1, 1), "impedance": (1, 1)}[system.kind]


def compare(label: Label, folder: Path) -> dict[str, dict[str, Any]]:
    """Per baseline: detected, gap_closed, seconds; or why it is unavailable."""
    system, planted = rebuild(label)
    session = read_session(system, folder)
    p = system.calibrate(session, (0, 1), system.case.nominal)
    left = system.residuals(p, session)
    ways: dict[str, Callable[[], Array]] = {
        "refitted_nominal": lambda: np.zeros_like(left[2]),
        "pysindy": lambda: _learned(_sindy, session, left, system),
        "gaussian_process": lambda: _learned(_gaussian_process, session, left, system),
        "oracle": lambda: _oracle(system, planted, session, left),
    }
    out: dict[str, dict[str, Any]] = {}
    for name in NAMES:
        began = time.monotonic()
        try:
            explained = ways[name]()
        except Unavailable as reason:
            out[name] = {"unavailable": str(reason)}
            continue
        out[name] = {**_scores(label, system, left[2], explained), "seconds": time.monotonic() - began}
        if name == "refitted_nominal":
            out[name]["detected"] = None
    return out


def _scores(label: Label, system: System, left: Array, explained: Array) -> dict[str, Any]:
    """Detected: mean squared error falls, over blocks of one second, by more than four standard errors in a channel."""
    before, after = left**2, (left - explained) ** 2
    block = max(1, round(1.0 / system.period_s))
    rows = len(left) // block
    gain = np.nanmean((before - after)[: rows * block].reshape(rows, block, -1), axis=1)
    spread = np.nanstd(gain, axis=0, ddof=1) / np.sqrt(rows)
    z = np.where(spread > 0.0, np.nanmean(gain, axis=0) / np.maximum(spread, 1e-300), 0.0)
    per_channel = {
        name: {
            "rmse_before": float(np.sqrt(np.nanmean(before[:, k]))),
            "rmse_after": float(np.sqrt(np.nanmean(after[:, k]))),
        }
        for k, name in enumerate(system.channels)
    }
    return {"detected": bool(np.max(z) > 4.0), "gap_closed": gap_closed(label, {"fit": {"per_channel": per_channel}})}


def _features(session: NoiselessRecordings, i: int, system: System) -> Array:
    """Inputs and their speeds (n, 2k), scaled to about one."""
    u = session.inputs[i]
    return np.hstack([u, np.gradient(u, system.period_s, axis=0)])


def _learned(model: Model, session: NoiselessRecordings, left: list[Array], system: System) -> Array:
    """Held-out residuals as `model` predicts them from inputs, trained on the others."""
    train = np.vstack([_features(session, i, system) for i in (0, 1)])
    middle, spread = train.mean(axis=0), np.maximum(train.std(axis=0), 1e-12)
    target = np.vstack(left[:2])
    held = (_features(session, 2, system) - middle) / spread
    known = ~np.any(np.isnan(target), axis=1)
    size = np.maximum(target[known].std(axis=0), 1e-300)
    return np.asarray(model((train[known] - middle) / spread, target[known] / size, held) * size)


def _sindy(train: Array, target: Array, held: Array) -> Array:
    try:
        import pysindy
    except ImportError:
        raise Unavailable("pysindy is not installed (pip install 'seldinger[baselines]')") from None
    import warnings

    model = pysindy.SINDy(
        optimizer=pysindy.STLSQ(threshold=0.1, alpha=0.05), feature_library=pysindy.PolynomialLibrary(degree=2)
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model.fit(train, t=1.0, x_dot=target)
        return np.asarray(model.predict(np.clip(held, -4.0, 4.0)))


def _gaussian_process(train: Array, target: Array, held: Array) -> Array:
    """Squared-exponential kernel on a few hundred points; length and noise by marginal likelihood on a grid, per channel."""
    chosen = np.random.default_rng(0).permutation(len(train))[:_POINTS]
    x, y = train[chosen], target[chosen]
    near, far = _distances(x, x), _distances(held, x)
    out, best = np.zeros((len(held), y.shape[1])), np.full(y.shape[1], -np.inf)
    for length in (0.5, 1.0, 2.0, 4.0):
        kernel, cross = np.exp(-0.5 * near / length**2), np.exp(-0.5 * far / length**2)
        for noise in (0.05, 0.3, 1.0, 3.0, 10.0):
            factor = cho_factor(kernel + noise * np.eye(len(x)), lower=True)
            weight = cho_solve(factor, y)
            scale = np.maximum(np.mean(y * weight, axis=0), 1e-300)
            likelihood = -0.5 * len(x) * np.log(scale) - np.sum(np.log(np.diag(factor[0])))
            better = likelihood > best
            out[:, better], best[better] = (cross @ weight)[:, better], likelihood[better]
    return out


def _distances(a: Array, b: Array) -> Array:
    return np.asarray(np.sum(a**2, axis=1)[:, None] + np.sum(b**2, axis=1) - 2.0 * a @ b.T)


def _oracle(system: System, planted: list[ScaledEffect], session: NoiselessRecordings, left: list[Array]) -> Array:
    """The true module with its size fitted to the training recordings, with nominal parameters as they are."""
    if not planted:
        return np.zeros_like(left[2])

    def apart(factor: float) -> tuple[float, Array]:
        chosen = [ScaledEffect(p.effect, factor * p.size, p.start_s) for p in planted]
        model = system.run(chosen, session.inputs)
        rest = [system.apart(m, y) / system.sigma for m, y in zip(model.outputs, session.outputs, strict=True)]
        return float(np.nansum(np.vstack(rest[:2]) ** 2)), rest[2] * system.sigma

    tried = {factor: apart(factor) for factor in (0.9, 1.0, 1.1)}
    cost = [tried[f][0] for f in (0.9, 1.0, 1.1)]
    bend = cost[0] - 2.0 * cost[1] + cost[2]
    if bend > 0.0:
        factor = float(np.clip(1.0 + 0.05 * (cost[0] - cost[2]) / bend, 0.8, 1.25))
        tried[factor] = apart(factor)
    return left[2] - min(tried.values(), key=lambda t: t[0])[1]
