"""Unlisted physics: an equation for the latent signal, searched over memory operators, accepted only after a refit."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from host.diagnosis.estimation.fit import Fit, Problem
from host.diagnosis.model.effect import Port
from host.diagnosis.model.model import Segment
from host.diagnosis.model.operators import lag, play
from host.diagnosis.symbolic.dictionary import Form, is_curve

Array = npt.NDArray[np.float64]
ROWS = 2500
LONGEST = 14  # symbols in an equation
SEEDS = (1, 2)
INFORMATIVE = 0.1  # precision of a sample, over the mean, from which it is searched


def features(problem: Problem, segment: Segment, port: Port) -> Array:
    """Feature table (n, features) of one recording; the same scales in every recording."""
    return np.array([values for values, _ in described(problem, segment, port)]).T


def described(problem: Problem, segment: Segment, port: Port) -> list[tuple[Array, str]]:
    """Features and their text in the names of columns: the motion, its memory, its rate, the other inputs and their
    rates.
    """
    x, span, dt = problem.model.motion(segment, port), _span(problem, port), segment.recording.dt_s
    name = problem.columns.get(problem.model.moves[port.name], problem.model.moves[port.name])
    out = [(x / span, f"({name} / {span:.6g})")]
    for part in (0.1, 0.4):
        out.append(
            ((x - play(x, 0.5 * part * span, 0.0)) / span, f"(({name} - play({name}, {part * span:.6g})) / {span:.6g})")
        )
    if segment.recording.timed:
        duration = max(float(p.recording.time_s[-1] - p.recording.time_s[0]) for p in problem.segments)
        out.append(_rated(problem, segment, name, lambda p: problem.model.motion(p, port)))
        for time_constant in (max(5 * dt, 0.005 * duration), 0.1 * duration):
            out.append(
                ((x - lag(x, dt, time_constant)) / span, f"(({name} - lag({name}, {time_constant:.6g})) / {span:.6g})")
            )
    for other in dict.fromkeys((*port.loads, *port.others)):
        if other in segment.inputs:
            size = float(np.sqrt(np.mean(np.concatenate([p.inputs[other] for p in problem.segments]) ** 2))) or 1.0
            text = problem.columns.get(other, other)
            out.append((segment.inputs[other] / size, f"({text} / {size:.6g})"))
            if segment.recording.timed and other in port.others:
                out.append(_rated(problem, segment, text, lambda p, other=other: p.inputs[other]))  # type: ignore[misc]
    return out


def _rated(problem: Problem, segment: Segment, name: str, signal: Callable[[Segment], Array]) -> tuple[Array, str]:
    """Rate of a signal over the RMS rate of all recordings, and its text."""

    def rate(p: Segment) -> Array:
        return np.gradient(signal(p), p.recording.dt_s)

    size = float(np.sqrt(np.mean(np.concatenate([rate(p) for p in problem.segments]) ** 2))) or 1.0
    return rate(segment) / size, f"(rate({name}) / {size:.6g})"


def _span(problem: Problem, port: Port) -> float:
    return float(np.ptp(np.concatenate([problem.model.motion(segment, port) for segment in problem.segments]))) or 1.0


def latent(problem: Problem, fit: Fit, segment: Segment, residual: Array, port: Port) -> tuple[Array, Array]:
    """What the port would have to add to explain the residual, (n,), NaN where nothing was measured; and its precision (n,),
    relative.
    """
    nominal, active = problem.parted(fit.terms, fit.values)
    seen = np.isfinite(residual)
    if not problem.model.pointwise:
        need = problem.model.needs(segment, port, nominal, residual)
        return np.where(seen.any(axis=0), need, np.nan), np.ones(segment.n)
    unit = np.array([noise.sigma for noise in problem.noise])[:, None]
    s, r = (
        np.where(seen, problem.model.sensitivity(segment, nominal, port.name, active), 0.0) / unit,
        np.where(seen, residual, 0.0) / unit,
    )
    precision = np.sum(s * s, axis=0)
    return np.where(precision > 0.0, np.sum(s * r, axis=0) / np.maximum(precision, 1e-300), np.nan), precision


def search_equation(problem: Problem, fit: Fit, port: Port) -> list[Form]:
    """Equations for the latent signal by genetic programming, on the samples to fit that depend on it; short ones first."""
    from pyoperon.sklearn import SymbolicRegressor

    tables, targets, precisions = [], [], []
    for segment, residual in zip(problem.segments, fit.residuals, strict=True):
        F, (z, precision) = features(problem, segment, port), latent(problem, fit, segment, residual, port)
        mask = segment.fit & np.isfinite(z)
        tables.append(F[mask])
        targets.append(z[mask])
        precisions.append(precision[mask])
    X, z, precision = np.concatenate(tables), np.concatenate(targets), np.concatenate(precisions)
    informative = precision > INFORMATIVE * float(np.mean(precision))
    X, z = X[informative], z[informative]
    size = float(np.sqrt(np.mean(z**2))) or 1.0
    step = max(1, len(X) // ROWS)
    cut = len(X) // step * step
    X = X[:cut].reshape(-1, step, X.shape[1]).mean(axis=1)
    z = np.clip(z[:cut].reshape(-1, step).mean(axis=1) / size, -8.0, 8.0)
    names, found = [text for _, text in described(problem, problem.segments[0], port)], []
    for seed in SEEDS:
        regressor = SymbolicRegressor(
            allowed_symbols="add,sub,mul,div,sin,exp,abs,square,tanh,constant,variable",
            population_size=300,
            generations=60,
            max_length=LONGEST,
            max_depth=6,
            optimizer_iterations=3,
            n_threads=1,
            random_state=seed,
            objectives=["r2", "length"],
        )
        regressor.fit(X, z)
        front = getattr(regressor, "pareto_front_", [])
        for item in front:
            found.append(_form(regressor, item, names, size, lambda p: features(problem, p, port)))
    unique = {
        form.text: (form, on_table) for form, on_table in found if form.length <= LONGEST and form.text.count("exp(") < 2
    }
    own = problem.columns.get(problem.model.moves[port.name], problem.model.moves[port.name])
    ranked = sorted(unique.values(), key=lambda f: float(np.mean((f[1](X) / size - z) ** 2)) * (1.0 + 0.02 * f[0].length))
    return [replace(form, curve=is_curve(form.text, own)) for form, _ in ranked[:3]]


def _form(
    regressor: object, item: dict, names: list[str], size: float, table: Callable[[Segment], Array]
) -> tuple[Form, Callable[[Array], Array]]:
    """A tree of the search as a form, and as a function of the feature table (n, features)."""
    tree = item["tree"]
    text = regressor.get_model_string(tree, 4)  # type: ignore[attr-defined]
    readable = re.sub(r"X(\d+)", lambda m: names[int(m.group(1)) - 1], text)

    def on_table(X: Array) -> Array:
        out = np.asarray(regressor.evaluate_model(tree, np.asarray(X, dtype=np.float32)), dtype=np.float64)  # type: ignore[attr-defined]
        return size * np.clip(np.where(np.isfinite(out), out, 0.0), -20.0, 20.0)

    return Form(readable, lambda p: on_table(table(p)), int(getattr(tree, "Length", LONGEST))), on_table
