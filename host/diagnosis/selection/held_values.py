"""Nominal values that the file holds: those that, fitted, would explain what a search names an effect for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from host.diagnosis.estimation.fit import Fit, Problem, free_states, jacobian, rate, size_of
from host.diagnosis.estimation.known import Known
from host.diagnosis.model.nominal import NominalSpec
from host.diagnosis.model.readings import Finding
from host.diagnosis.selection.found import Found

Array = npt.NDArray[np.float64]
FARTHEST = 100.0  # times what is held, or that part of it: where a value without bounds of its own is looked for


@dataclass(frozen=True)
class HeldValue:
    """A value that the nominal file holds: a parameter under its name, or all those of a known effect."""

    name: str
    indices: tuple[int, ...]  # among the nominal parameters
    effect: int | None = None  # place among the known effects


@dataclass(frozen=True)
class Freed:
    """Values that the nominal file holds and that were fitted; `held_at`: what it holds, for each index of `values`."""

    values: tuple[HeldValue, ...]
    held_at: tuple[float, ...]
    before: list[Array]  # residuals (outputs, n) of each recording with what the file holds


def held_values(spec: NominalSpec, problem: Problem) -> list[HeldValue]:
    """What `spec` holds at values other than zero; a zero says that something is absent, which effects are about."""
    model = problem.model
    own = model.own if isinstance(model, Known) else len(model.parameters)
    found = []
    for index, p in enumerate(model.parameters[:own]):
        given = spec.parameters.get(p.name)
        if given is not None and not given.free and given.value != 0.0:
            found.append(HeldValue(p.name, (index,)))
    if isinstance(model, Known):
        at = own
        for place, (effect, (candidate, parameters)) in enumerate(zip(spec.effect, model.active, strict=True)):
            indices = tuple(range(at, at + len(parameters)))
            at += len(parameters)
            if not effect.free:
                found.append(HeldValue(candidate.name, indices, place))
    return found


def with_free(spec: NominalSpec, held: Sequence[HeldValue]) -> NominalSpec:
    """`spec` with these values fitted, between its bounds or within two decades of what was held."""
    parameters, effects = dict(spec.parameters), list(spec.effect)
    for each in held:
        if each.effect is not None:
            effects[each.effect] = effects[each.effect].model_copy(update={"free": True})
            continue
        given = parameters[each.name]
        ends = sorted((given.value / FARTHEST, given.value * FARTHEST))
        low, high = (ends[k] if end is None else end for k, end in enumerate((given.low, given.high)))
        parameters[each.name] = given.model_copy(update={"free": True, "low": low, "high": high})
    return spec.model_copy(update={"parameters": parameters, "effect": effects})


def promising(problem: Problem, fit: Fit, held: Sequence[HeldValue], most: int) -> list[HeldValue]:
    """Up to `most` of `held`, those first whose small change explains the largest part of what `fit` leaves.

    The part is that which neither the parameters of `fit` nor the states that recordings begin with can explain.
    """
    sizes = [size_of(p, v) for p, v in zip(problem.parameters(fit.terms), fit.values, strict=True)]
    base = problem.stacked(fit.terms, fit.values)
    states = free_states(problem, fit.terms, fit.values)
    known = [jacobian(problem, fit.terms, fit.values, base, sizes), *([] if states is None else [states.rates])]
    frame = np.linalg.qr(np.hstack(known))[0] if any(part.shape[1] for part in known) else np.zeros((base.size, 0))
    r = base - frame @ (frame.T @ base)
    promises = []
    for each in held:
        C = np.array([rate(problem, fit.terms, fit.values, base, index, sizes[index]) for index in each.indices]).T
        C = np.linalg.qr(C - frame @ (frame.T @ C))[0]
        promises.append(float(np.sum((C.T @ r) ** 2)))
    order = np.argsort(promises)[::-1][:most]
    return [held[k] for k in order if promises[k] > 0.0]


def contradicted(problem: Problem, found: Found, spans: Sequence[tuple[float, float]], freed: Freed) -> list[Finding]:
    """Say which held values the recordings contradict, and by what. spans: intervals of all parameters of `found.best`."""
    said, before = [], iter(freed.held_at)
    for each in freed.values:
        for index in each.indices:
            p, value, (low, high) = problem.model.parameters[index], found.best.values[index], spans[index]
            digits = _digits(float(value), high - low)
            says = f"The nominal model holds {p.name} at {next(before):.4g} {p.unit}".rstrip()
            says += f"; these recordings say {value:.{digits}g} (95 %: {low:.{digits}g} to {high:.{digits}g}). "
            said.append(Finding("held", each.name, says))
    end = "The diagnosis continues with that. Correct the value, or let it be fitted (free = true)."
    errors = [_rms(rs) for rs in (freed.before, found.nominal.residuals)]
    row = int(np.argmin(errors[1] / np.maximum(errors[0], 1e-300)))
    if errors[1][row] < errors[0][row]:
        output = problem.model.outputs[row]
        column, was, now = problem.columns.get(output.channel, output.channel), errors[0][row], errors[1][row]
        end = f"The RMS error of column {column} is then {now:.3g} {output.unit} instead of {was:.3g}. {end}"
    return [*said[:-1], replace(said[-1], says=said[-1].says + end)] if said else []


def _rms(residuals: Sequence[Array]) -> Array:
    """RMS (outputs,) of residuals (outputs, n) of several recordings."""
    return np.asarray(np.sqrt(np.nanmean(np.concatenate(residuals, axis=1) ** 2, axis=1)))


def _digits(value: float, width: float) -> int:
    """Significant digits of `value` that show an interval of this width."""
    return int(np.clip(np.ceil(np.log10(max(abs(value), 1e-300) / max(width, 1e-300))) + 1, 3, 8))
