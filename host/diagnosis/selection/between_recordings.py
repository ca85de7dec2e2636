"""Nominal parameters that differ from recording to recording, because something was changed between the sessions."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from host.diagnosis.estimation.fit import Fit, Problem, free, get_starts, minimize, set_starts
from host.diagnosis.estimation.uncertainty import intervals
from host.diagnosis.model.readings import Finding
from host.diagnosis.selection.refits import refined

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Inadequate:
    """What a model leaves, in the output where most is above noise."""

    row: int
    above_noise: float  # mean square above that of noise


@dataclass(frozen=True)
class Apart:
    """Nominal fits of each recording alone, with the intervals of their parameters."""

    fits: tuple[Fit, ...]
    spans: tuple[tuple[tuple[float, float], ...], ...]
    left: float  # RMS that they leave together


def inadequate(problem: Problem, fit: Fit) -> Inadequate | None:
    """What `fit` leaves above noise; None where that is no more than noise may be."""
    level, noise_sd = root_mean_square(problem, fit.residuals), problem.noise_sd
    row = int(np.argmax(level / np.maximum(noise_sd, 1e-300)))
    if not level[row] >= problem.rules.residual_over_noise * noise_sd[row]:
        return None
    return Inadequate(row, float(level[row] ** 2 - noise_sd[row] ** 2))


def unlike_recordings(problem: Problem, nominal: Fit, rival: Inadequate) -> list[Finding]:
    """A finding (id `session`) where each recording alone is explained by the nominal model, with parameters of its own,
    and all together are not. Nothing where a recording cannot tell the parameters that it is given.

    An effect that depends on what differs between the recordings, such as their amplitude, looks alike: the finding says so.
    rival: what the best model with the same parameters for all leaves.
    """
    moving = free(list(problem.model.parameters))
    if len(problem.segments) < 2 or not moving:
        return []
    if min(segment.n for segment in problem.segments) < problem.rules.session_samples_per_parameter * len(moving):
        return []
    apart = fitted_alone(problem, nominal, rival)
    if apart is None:
        return []
    said = []
    for index in moving:
        p = problem.model.parameters[index]
        own = [fit.values[index] for fit in apart.fits]
        ends = [spans[index] for spans in apart.spans]
        if max(low for low, _ in ends) <= min(high for _, high in ends):
            continue  # one value is inside all intervals
        each = [f"{value:.4g} in {segment.recording.name}" for value, segment in zip(own, problem.segments, strict=True)]
        said.append(f"{p.name} is {', '.join(each)}")
    if not said:
        return []
    output, together = problem.model.outputs[rival.row], root_mean_square(problem, nominal.residuals)[rival.row]
    says = f"The recordings have not one nominal model: {'; '.join(said)}. Each alone leaves {apart.left:.3g} {output.unit} "
    says += f"RMS, all together with the same parameters leave {together:.3g}. Something was changed between them, or an "
    says += "effect depends on what differs between them (amplitude, speed, load)."
    return [Finding("session", problem.columns.get(output.channel, output.channel), says)]


def fitted_alone(problem: Problem, nominal: Fit, rival: Inadequate) -> Apart | None:
    """Each recording fitted alone; None where they leave more than a small part of what the rival leaves above noise."""
    most = problem.noise_sd[rival.row] ** 2 + problem.rules.session_residual_share * rival.above_noise
    begun = get_starts(problem)
    fits: list[Fit] = []
    spans: list[tuple[tuple[float, float], ...]] = []
    residuals: list[Array] = []
    left = 0.0
    for segment in problem.segments:
        seen = segment.fit | segment.heldout
        alone = replace(problem, segments=[replace(segment, fit=seen)], scale=problem.scale.copy())
        fit = refined(alone, minimize(alone, (), nominal.values, states=True))
        fits.append(fit)
        residuals += fit.residuals
        left = float(root_mean_square(problem, residuals)[rival.row])
        if left**2 > most:
            set_starts(problem, begun)
            return None
        spans.append(tuple(intervals(alone, fit)))
    set_starts(problem, begun)
    return Apart(tuple(fits), tuple(spans), left)


def root_mean_square(problem: Problem, residuals: list[Array]) -> Array:
    """RMS (outputs,) of the samples that are compared."""
    parts = [
        np.where(segment.fit | segment.heldout, residual, np.nan)
        for segment, residual in zip(problem.segments, residuals, strict=False)
    ]
    return np.asarray(np.sqrt(np.nanmean(np.hstack(parts) ** 2, axis=1)))
