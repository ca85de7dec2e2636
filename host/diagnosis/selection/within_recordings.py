"""Nominal parameters that change in the middle of a recording, because something came loose, was added or was replaced."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from host.diagnosis.estimation.fit import FAR, Fit, Problem, free, parameter_rates
from host.diagnosis.model.dataset import Recording, parted
from host.diagnosis.model.readings import Finding
from host.diagnosis.selection.between_recordings import Apart, Inadequate, fitted_alone, root_mean_square
from host.diagnosis.selection.refits import fit_nominal, refined

Array = npt.NDArray[np.float64]
Prepared = Callable[[list[Recording]], Problem]
INSTANTS = 200  # at which a change is tried in one recording
FIRST_MARGIN, LAST_MARGIN = 0.05, 0.01  # of a recording, left out before and behind the instant as long as it is not exact
FAR_VARIANCE = 4.0  # squared residual of the part before, over the noise: more speaks for a sample behind the change


@dataclass(frozen=True)
class ParameterChange:
    """An instant in one recording at which other nominal parameters explain its residual best."""

    number: int  # of the recording
    time_s: float  # in the time of the recording
    reduction: float  # of the weighted sum of squares, to first order


def changed_within(
    problem: Problem, nominal: Fit, rival: Inadequate, recordings: Sequence[Recording], prepared: Prepared
) -> list[Finding]:
    """A finding (id `changed`) where a recording follows the nominal model, with other parameters behind an instant.

    The instant is searched by the first-order change of the residual with the parameters, and again by the residual of the
    part before it. The recording is cut there, each part gets an initial state of its own, and each part alone has to be
    explained. An effect that depends on what differs between the parts, such as their amplitude, looks alike: the finding
    says so.

    rival: what the best model with the same parameters throughout leaves. recordings: those of `problem`, at full rate.
    prepared: the problem of other recordings with the same model.
    """
    moving = free(list(problem.model.parameters))
    least = problem.rules.session_samples_per_parameter * len(moving)
    long = [k for k, segment in enumerate(problem.segments) if segment.n > 2 * least + 2]
    if not moving or not long:
        return []
    change = max((_likeliest(problem, nominal, k, least) for k in long), key=lambda found: found.reduction)
    whole = recordings[change.number]
    parts = _parts(problem, whole, change, FIRST_MARGIN)
    if parts:
        change = replace(change, time_s=_end_of_first(problem, prepared([_all_fitted(parts[0])]), change.number))
        parts = _parts(problem, whole, change, LAST_MARGIN)
    if not parts:
        return []
    cut = prepared([*recordings[: change.number], *parts, *recordings[change.number + 1 :]])
    cut.noise = problem.noise
    apart = fitted_alone(cut, fit_nominal(cut), rival)
    changed = [] if apart is None else _differences(problem, apart, change.number, moving)
    if apart is None or not changed:
        return []
    output, together = problem.model.outputs[rival.row], root_mean_square(problem, nominal.residuals)[rival.row]
    says = f"The nominal parameters change in {whole.name} near {whole.begin_s + change.time_s:.4g} "
    says += f"{'s' if whole.timed else 'samples'}: {'; '.join(changed)}. "
    says += f"Each part alone leaves {apart.left:.3g} {output.unit} RMS, the same parameters throughout leave "
    says += f"{together:.3g}. Something was changed there, or an effect depends on what differs between the two parts "
    says += "(amplitude, speed, load)."
    return [Finding("changed", problem.columns.get(output.channel, output.channel), says)]


def _likeliest(problem: Problem, nominal: Fit, number: int, least: int) -> ParameterChange:
    """The instant in one recording at which a change of the parameters removes most of the residual, to first order.

    least: samples before and behind it.
    """
    segment = problem.segments[number]
    base = problem.left(segment, (), nominal.values) / problem.scale[:, None]
    columns = parameter_rates(problem, nominal, segment) / problem.scale[:, None]
    seen = np.all(np.abs([base, *columns]) < FAR, axis=0)  # a simulation may run away
    residual, rates = np.where(seen, base, 0.0), np.where(seen, columns, 0.0)
    squares = np.cumsum(np.einsum("ikn,jkn->nij", rates, rates), axis=0)
    products = np.cumsum(np.einsum("ikn,kn->ni", rates, residual), axis=0)
    instants = np.unique(np.linspace(least, segment.n - 1 - least, INSTANTS).astype(int))
    removed = [
        _explained(squares[k], products[k]) + _explained(squares[-1] - squares[k], products[-1] - products[k])
        for k in instants
    ]
    best = int(np.argmax(removed))
    time_s = float(segment.recording.time_s[instants[best]])
    return ParameterChange(number, time_s, removed[best] - _explained(squares[-1], products[-1]))


def _explained(squares: Array, products: Array) -> float:
    """Sum of squares that least squares with these normal equations removes."""
    return float(products @ np.linalg.pinv(squares, rcond=1e-12, hermitian=True) @ products)


def _all_fitted(part: Recording) -> Recording:
    """The part with the samples that were held out among those to fit: alone it has to fit, not to predict."""
    return replace(part, fit=part.fit | part.heldout)


def _parts(problem: Problem, whole: Recording, change: ParameterChange, margin: float) -> list[Recording]:
    """A recording in two, without the samples about the instant; nothing where a part has too few samples."""
    margin_s = max(margin * whole.n, problem.rules.data.gap_samples + 1) * whole.dt_s
    parts = parted(whole, np.abs(whole.time_s - change.time_s) > margin_s, problem.rules.data)
    return parts if len(parts) == 2 else []


def _end_of_first(problem: Problem, first: Problem, number: int) -> float:
    """Time until which the parameters of the part before the change explain the recording `number`.

    first: the problem of that part alone.
    """
    segment = first.segments[0]
    fit = refined(first, fit_nominal(first))
    whole = replace(problem.segments[number], start=segment.start, begin=segment.begin)
    size = (problem.left(whole, (), fit.values) / problem.noise_sd[:, None]) ** 2 - FAR_VARIANCE
    return float(whole.recording.time_s[int(np.argmin(np.cumsum(np.nansum(size, axis=0))))])


def _differences(problem: Problem, apart: Apart, number: int, moving: list[int]) -> list[str]:
    """Parameters whose intervals before and after the change have no value in common, in words."""
    first, second = apart.fits[number].values, apart.fits[number + 1].values
    before, after = apart.spans[number], apart.spans[number + 1]
    parameters = problem.model.parameters
    return [
        f"{parameters[k].name} is {first[k]:.4g} before and {second[k]:.4g} {parameters[k].unit}".rstrip() + " after"
        for k in moving
        if before[k][1] < after[k][0] or after[k][1] < before[k][0]
    ]
