"""Unlisted physics: an equation for the latent signal, searched over memory operators, believed only after a refit in the simulator."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from host.diagnosis.effect import Candidate, Context, Effect, Parameter, Port, Scale
from host.diagnosis.evidence import correlation_time
from host.diagnosis.fit import Fit, Problem
from host.diagnosis.model import Piece
from host.diagnosis.operators import lag, play

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
ROWS = 2500
LONGEST = 14                  # symbols in an equation
SEEDS = (1, 2)
RIDGE = 1e-3


@dataclass(frozen=True)
class Equation:
    """Text in feature names, and a function of the feature table (n, features) giving (n,)."""

    text: str
    evaluate: Callable[[Array], Array]
    length: int


def features(problem: Problem, piece: Piece, port: Port) -> Array:
    """Feature table (n, features) of one recording; the same scales in every recording."""
    return np.array([values for values, _ in described(problem, piece, port)]).T


def described(problem: Problem, piece: Piece, port: Port) -> list[tuple[Array, str]]:
    """Features and their text in the names of columns: the motion, its memory, its rate, the other inputs and their rates."""
    x, span, dt = problem.model.motion(piece, port), _span(problem, port), piece.recording.dt_s
    name = problem.columns.get(problem.model.moves[port.name], problem.model.moves[port.name])
    out = [(x / span, f"({name} / {span:.6g})")]
    for part in (0.1, 0.4):
        out.append(((x - play(x, 0.5 * part * span, 0.0)) / span, f"(({name} - play({name}, {part * span:.6g})) / {span:.6g})"))
    if piece.recording.timed:
        duration = max(float(p.recording.time_s[-1] - p.recording.time_s[0]) for p in problem.pieces)
        out.append(_rated(problem, piece, name, lambda p: problem.model.motion(p, port)))
        for time_constant in (max(5 * dt, 0.005 * duration), 0.1 * duration):
            out.append(((x - lag(x, dt, time_constant)) / span, f"(({name} - lag({name}, {time_constant:.6g})) / {span:.6g})"))
    for other in dict.fromkeys((*port.loads, *port.others)):
        if other in piece.inputs:
            size = float(np.sqrt(np.mean(np.concatenate([p.inputs[other] for p in problem.pieces]) ** 2))) or 1.0
            text = problem.columns.get(other, other)
            out.append((piece.inputs[other] / size, f"({text} / {size:.6g})"))
            if piece.recording.timed and other in port.others:
                out.append(_rated(problem, piece, text, lambda p, other=other: p.inputs[other]))  # type: ignore[misc]
    return out


def _rated(problem: Problem, piece: Piece, name: str, signal: Callable[[Piece], Array]) -> tuple[Array, str]:
    """Rate of a signal over the RMS rate of all recordings, and its text."""
    def rate(p: Piece) -> Array:
        return np.gradient(signal(p), p.recording.dt_s)
    size = float(np.sqrt(np.mean(np.concatenate([rate(p) for p in problem.pieces]) ** 2))) or 1.0
    return rate(piece) / size, f"(rate({name}) / {size:.6g})"


def _span(problem: Problem, port: Port) -> float:
    return float(np.ptp(np.concatenate([problem.model.motion(piece, port) for piece in problem.pieces]))) or 1.0


def latent(problem: Problem, fit: Fit, piece: Piece, residual: Array, port: Port) -> Array:
    """What the port would have to add to explain the residual, (n,); NaN where nothing was measured."""
    need = problem.model.needs(piece, port, fit.values[: len(problem.model.parameters)], residual)
    seen = np.isfinite(residual).any(axis=0)
    return np.where(seen, need, np.nan)


@dataclass(frozen=True)
class Predictable:
    """How much of the latent signal of a port can be foretold on held-out samples by any smooth function of the features."""

    port: Port
    share: float
    log_likelihood: float


def predictable(problem: Problem, fit: Fit, port: Port) -> Predictable:
    """Ridge regression on the features, their products and random tanh of them, fitted to the samples to fit and scored on those held out."""
    rng = np.random.default_rng(0)
    weights = bias = None
    tables: list[Array] = []
    targets: list[Array] = []
    held: list[tuple[Array, Array, Mask]] = []
    for piece, residual in zip(problem.pieces, fit.residuals, strict=True):
        F, z = features(problem, piece, port), latent(problem, fit, piece, residual, port)
        if weights is None:
            weights = rng.normal(size=(F.shape[1], 60)) * rng.choice([0.5, 2.0, 6.0], size=60)
            bias = rng.uniform(-2.0, 2.0, 60)
        a, b = np.triu_indices(F.shape[1])
        H = np.column_stack([np.ones(len(F)), F, F[:, a] * F[:, b], np.tanh(F @ weights + bias)])
        mask = piece.fit & np.isfinite(z)
        tables.append(H[mask])
        targets.append(z[mask])
        if (piece.heldout & np.isfinite(z)).sum() > 50:
            held.append((H, z, piece.heldout & np.isfinite(z)))
    H, z = np.concatenate(tables), np.concatenate(targets)
    limit = 6.0 * np.median(np.abs(z - np.median(z))) + 1e-300
    size = np.sqrt(np.mean(H * H, axis=0)) + 1e-12
    H = H / size
    w = np.linalg.solve(H.T @ H + RIDGE * len(H) * np.eye(H.shape[1]), H.T @ np.clip(z, -limit, limit)) / size
    before = after = count = total = 0.0
    for table, z, mask in held:
        target = np.clip(z, -limit, limit)
        left = target - table @ w
        before += float(np.sum(target[mask] ** 2))
        after += float(np.sum(left[mask] ** 2))
        total += mask.sum()
        count += mask.sum() / correlation_time(np.where(mask, left, np.nan))
    gain = 0.5 * count * float(np.log(max(before, 1e-300) / max(after, 1e-300)))
    return Predictable(port, 1.0 - after / max(before, 1e-300), gain)


def search_equation(problem: Problem, fit: Fit, port: Port) -> list[Equation]:
    """Equations for the latent signal by genetic programming on thinned samples to fit, short ones first."""
    from pyoperon.sklearn import SymbolicRegressor

    tables, targets = [], []
    for piece, residual in zip(problem.pieces, fit.residuals, strict=True):
        F, z = features(problem, piece, port), latent(problem, fit, piece, residual, port)
        mask = piece.fit & np.isfinite(z)
        tables.append(F[mask])
        targets.append(z[mask])
    X, z = np.concatenate(tables), np.concatenate(targets)
    size = float(np.sqrt(np.mean(z**2))) or 1.0
    step = max(1, len(X) // ROWS)
    cut = len(X) // step * step
    X = X[:cut].reshape(-1, step, X.shape[1]).mean(axis=1)
    z = np.clip(z[:cut].reshape(-1, step).mean(axis=1) / size, -8.0, 8.0)
    names, found = [text for _, text in described(problem, problem.pieces[0], port)], []
    for seed in SEEDS:
        regressor = SymbolicRegressor(
            allowed_symbols="add,sub,mul,div,sin,exp,abs,square,tanh,constant,variable", population_size=300, generations=60, max_length=LONGEST,
            max_depth=6, optimizer_iterations=3, n_threads=1, random_state=seed, max_time=8, objectives=["r2", "length"])
        regressor.fit(X, z)
        front = getattr(regressor, "pareto_front_", [])
        for item in front:
            found.append(_equation(regressor, item, names, size))
    unique = {equation.text: equation for equation in found if equation.length <= LONGEST}
    ranked = sorted(unique.values(), key=lambda e: float(np.mean((e.evaluate(X) / size - z) ** 2)) * (1.0 + 0.02 * e.length))
    return ranked[:3]


def _equation(regressor: object, item: dict, names: list[str], size: float) -> Equation:
    tree = item["tree"]
    text = regressor.get_model_string(tree, 4)  # type: ignore[attr-defined]
    readable = re.sub(r"X(\d+)", lambda m: names[int(m.group(1)) - 1], text)
    def evaluate(X: Array) -> Array:
        out = np.asarray(regressor.evaluate_model(tree, np.asarray(X, dtype=np.float32)), dtype=np.float64)  # type: ignore[attr-defined]
        return size * np.clip(np.where(np.isfinite(out), out, 0.0), -20.0, 20.0)
    return Equation(readable, evaluate, int(getattr(tree, "Length", LONGEST)))


def as_candidate(port: Port, equation: Equation) -> Candidate:
    """The equation as an effect at `port`: one amplitude, to be refitted with everything else. Its features stand in `Piece.extra`."""

    def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
        return (Parameter("amplitude", "", (1.0,), -5.0, 5.0, linear=True, step=1.0),)

    def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
        return np.asarray(signal + p[0] * equation.evaluate(c.extra["features"][port.name]))

    effect = Effect("unlisted", port.kind.split("+")[0], 76, parameters, "None of the known effects: the mismatch follows an equation found by search.",
                    equation.text, apply, side="input")
    return Candidate(effect, port, "", "search")
