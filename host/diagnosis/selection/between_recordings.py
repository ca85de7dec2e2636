"""Nominal parameters that differ from recording to recording, because something was changed between the sessions."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from host.diagnosis.estimation.fit import Fit, Problem, finish, free, get_starts, minimize, set_starts
from host.diagnosis.estimation.uncertainty import intervals
from host.diagnosis.model.readings import Finding

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Apart:
    """Nominal fits of each recording alone, with the intervals of their parameters."""

    row: int  # output that tells them apart
    fits: tuple[Fit, ...]
    spans: tuple[tuple[tuple[float, float], ...], ...]
    before: float  # RMS of that output with the same parameters for all
    left: float  # with their own


def unlike_recordings(problem: Problem, nominal: Fit) -> list[Finding]:
    """A finding (id `session`) where each recording alone is explained by the nominal model, with parameters of its own,
    and all together are not. Nothing where a recording cannot tell the parameters that it is given.

    An effect that depends on what differs between the recordings, such as their amplitude, looks alike: the finding says so.
    """
    moving = free(list(problem.model.parameters))
    if len(problem.segments) < 2 or not moving:
        return []
    if min(segment.n for segment in problem.segments) < problem.rules.session_samples_per_parameter * len(moving):
        return []
    apart = _apart(problem, nominal)
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
    output = problem.model.outputs[apart.row]
    says = f"The recordings have not one nominal model: {'; '.join(said)}. Each alone leaves {apart.left:.3g} {output.unit} "
    says += (
        f"RMS, all together with the same parameters leave {apart.before:.3g}. Something was changed between them, or an "
    )
    says += "effect depends on what differs between them (amplitude, speed, load)."
    return [Finding("session", problem.columns.get(output.channel, output.channel), says)]


def _apart(problem: Problem, nominal: Fit) -> Apart | None:
    """Each recording fitted alone; None where the nominal model explains all together, or not each alone."""
    before = _levels(problem, nominal.residuals)
    noise_sd = problem.noise_sd
    excess = before**2 - noise_sd**2
    row = int(np.argmax(excess / np.maximum(noise_sd, 1e-300) ** 2))
    if before[row] < problem.rules.residual_over_noise * noise_sd[row]:
        return None
    begun = get_starts(problem)
    fits: list[Fit] = []
    spans: list[tuple[tuple[float, float], ...]] = []
    residuals: list[Array] = []
    for segment in problem.segments:
        seen = segment.fit | segment.heldout
        alone = replace(problem, segments=[replace(segment, fit=seen)], scale=problem.scale.copy())
        fit = finish(alone, minimize(alone, (), nominal.values, states=True))
        fits.append(fit)
        residuals += fit.residuals
        left = _levels(problem, residuals)
        if left[row] ** 2 - noise_sd[row] ** 2 > problem.rules.session_residual_share * excess[row]:
            set_starts(problem, begun)
            return None
        spans.append(tuple(intervals(alone, fit)))
    set_starts(problem, begun)
    return Apart(row, tuple(fits), tuple(spans), float(before[row]), float(left[row]))


def _levels(problem: Problem, residuals: list[Array]) -> Array:
    """RMS (outputs,) of the samples that are compared."""
    parts = [
        np.where(segment.fit | segment.heldout, residual, np.nan)
        for segment, residual in zip(problem.segments, residuals, strict=False)
    ]
    return np.asarray(np.sqrt(np.nanmean(np.hstack(parts) ** 2, axis=1)))
