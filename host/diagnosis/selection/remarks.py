"""Sentences on what the residual shows of the data: lines, jumps, slow or unseen noise, sensors that are read seldom."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from host.diagnosis.estimation.coloured import independent_samples
from host.diagnosis.estimation.fit import Problem
from host.diagnosis.estimation.jumps import jumps_of
from host.diagnosis.estimation.noise import NoiseSource
from host.diagnosis.model.findings import Finding
from host.diagnosis.model.spectral_line import common_line
from host.diagnosis.selection.between_recordings import root_mean_square
from host.diagnosis.selection.full_rate import Figures, FullRate, rms

Array = npt.NDArray[np.float64]


def read_seldom(full: Problem) -> list[Finding]:
    """Sentences on sensors that are read more seldom than they are logged."""
    findings = []
    for row, output in enumerate(full.model.outputs):
        segment = next((segment for segment in full.segments if row in segment.repeats), None)
        if segment is None:
            continue
        column = full.columns.get(output.channel, output.channel)
        samples = int(np.median(np.diff(np.unique(segment.repeats[row]))))
        period = samples * segment.recording.dt_s
        timed = f", every {period:.4g} s" if segment.recording.timed else ""
        says = (
            f"Column {column} repeats each reading for {samples} samples{timed}: its sensor is read more seldom than it is "
        )
        says += "logged. The simulated readings are repeated likewise. A delay up to this period may be the sensor's."
        findings.append(Finding("repeated", column, says))
    return findings


def noise_of_motion(problem: Problem) -> list[Finding]:
    """A sentence where effects were not tried because the residual is noise of the motion, which a law with memory cancels:
    a controller fed it back into the input, or the nominal law passes it on.
    """
    names = [problem.columns.get(name, name) for name in problem.model.quiet_inputs]
    if problem.noise_passed > problem.rules.noise_passed_share and not problem.noise_fed:
        says = (
            f"The noise of column {names[0]} makes most of the residual, through the nominal law. No delay, lag, resonance "
        )
        says += "or second mass was tried: a law with memory can cancel this noise, so these recordings cannot show one. "
        says += "Read the motion with less noise, or record slower motions."
        return [Finding("noise_passed_on", names[0], says)]
    if not problem.noise_fed:
        return []
    says = f"A controller computes column {names[0]} from the recorded motion, whose noise is most of the residual. No "
    says += "delay, lag, resonance or second mass was tried: a law with memory can cancel this noise, so these recordings "
    says += "cannot show one. Record in open loop, or read the motion with less noise."
    return [Finding("noise_fed_back", names[0], says)]


def jumps_in_level(full: Problem, fits: FullRate) -> list[Finding]:
    """Sentences on jumps of the nominal residual that no effect explains, such as those of a sensor that was moved."""
    findings = []
    for row, output in enumerate(full.model.outputs):
        jumps = jumps_of([r[row] for r in fits.nominal.residuals], full.rules, full.reading_step(row))
        if not jumps:
            continue
        places = []
        for jump in jumps:
            recording = full.segments[jump.recording].recording
            at = recording.begin_s + float(recording.time_s[jump.sample])
            places.append(
                f"{jump.size:+.3g} {output.unit} at {at:.4g} {'s' if recording.timed else 'samples'} of {recording.name}"
            )
        column = full.columns.get(output.channel, output.channel)
        says = f"The level of column {column} jumps past what the nominal model predicts: {'; '.join(places)}. "
        says += "A sensor was moved, or an axis lost steps: an event, not a law of the model. It is not corrected."
        findings.append(Finding("jump", column, says))
    return findings


def lines_in_spectrum(full: Problem, fits: FullRate) -> list[Finding]:
    """Sentences on lines in the spectrum of the nominal residual that no effect explains."""
    if not full.segments[0].recording.timed:
        return []
    findings = []
    periods = [segment.recording.dt_s for segment in full.segments]
    read = {output.channel for output in full.model.outputs}
    inputs = [
        [u for name, u in segment.inputs.items() if name in segment.recording.channels and name not in read]
        for segment in full.segments
    ]
    for row, output in enumerate(full.model.outputs):
        residuals = [r[row] for r in fits.nominal.residuals]
        simulated = [segment.y[row] - r for segment, r in zip(full.segments, residuals, strict=True)]
        known = [[*own, said] for own, said in zip(inputs, simulated, strict=True)]
        line = common_line(residuals, known, simulated, periods, full.rules.data)
        if line is None:
            continue
        column = full.columns.get(output.channel, output.channel)
        says = f"The residual of column {column} has a sine of {line.frequency_Hz:.4g} Hz, amplitude {line.amplitude:.3g} "
        says += (
            f"{output.unit}, in every recording. No law makes it of an input, and the simulated output hardly moves at it: "
        )
        says += "a hum, a vibration or a rotating part is not in the nominal model."
        findings.append(Finding("line", column, says))
    return findings


def slow_noise(full: Problem, fits: FullRate, rows: list[int]) -> list[Finding]:
    """Sentences on outputs whose residual wanders so slowly that it is noise or a mismatch, and data cannot tell which."""
    findings = []
    for row in rows:
        output, residuals = full.model.outputs[row], [r[row] for r in fits.best.residuals]
        column = full.columns.get(output.channel, output.channel)
        says = f"The residual of column {column}, {rms(residuals):.3g} {output.unit} RMS, has only "
        says += f"{independent_samples(residuals):.0f} independent samples. No structure is common to the recordings. "
        says += "These data cannot separate slow noise from a mismatch: record five times as long, or repeat the motion."
        findings.append(Finding("slow_noise", column, says))
    return findings


def times_noise(full: Problem, fits: FullRate, figures: Figures) -> Array:
    """Residual over noise (outputs,), in held-out samples or in all, whichever is larger."""
    left = np.maximum(figures.after, root_mean_square(full, fits.best.residuals))
    return np.asarray(left / np.maximum(full.noise_sd, 1e-300))


def not_explained(full: Problem, fits: FullRate, figures: Figures, structured: list[int]) -> list[Finding]:
    """Sentences on outputs whose residual is larger than the noise, where a mismatch is certain and no effect explains it.

    structured: rows of outputs whose residual follows inputs or repeats, as hardly any noise does.
    """
    findings, rules = [], full.rules
    for row, ratio in enumerate(times_noise(full, fits, figures)):
        if not ratio > rules.residual_over_noise:
            continue
        output, noise = full.model.outputs[row], full.noise[row]
        column = full.columns.get(output.channel, output.channel)
        says = (
            f"The residual of column {column}, {ratio * noise.sigma:.3g} {output.unit} RMS, is {ratio:.2g} times the noise "
        )
        says += _that_is_known(noise.source)
        if row in structured:
            kept = 100.0 * (1.0 - rules.slow_structure_significance)
            says += f", and follows the inputs, or repeats, more closely than {kept:.3g} % of noises with its spectrum"
        findings.append(Finding("unexplained", column, says + ". No known effect explains it."))
    return findings


def _that_is_known(source: NoiseSource) -> str:
    if source.seen_alone:
        return "that was recorded alone"
    return "that short rests show" if source is NoiseSource.SHORT_RESTS else "that its spectrum suggests"


def larger_than_noise(full: Problem, fits: FullRate, figures: Figures) -> list[Finding]:
    """Sentences on outputs whose residual is larger than the noise, and not surely so."""
    findings, rules = [], full.rules
    for output, noise, ratio in zip(full.model.outputs, full.noise, times_noise(full, fits, figures), strict=True):
        if not ratio > rules.residual_over_noise:
            continue
        column = full.columns.get(output.channel, output.channel)
        left = ratio * noise.sigma
        says = f"The residual of column {column}, {left:.3g} {output.unit} RMS, is {ratio:.2g} times the noise "
        says += f"{_that_is_known(noise.source)}. "
        if noise.source.seen_alone:
            says += "No effect explains it, and up to "
            says += f"{rules.residual_over_noise_nominal:.2g} times may be the simplifications of a model: something small "
            says += "may be missing. Record larger and faster motions, and diagnose again."
            findings.append(Finding("above_noise", column, says))
        else:
            short = noise.source is NoiseSource.SHORT_RESTS
            says += "The noise is too slow for them" if short else "The noise was never recorded alone"
            says += ", so this may be slower noise, or a mismatch that no effect explains: record "
            says += f"{'longer rests' if short else 'some seconds at rest'}, or the same motion twice."
            findings.append(Finding("noise_unseen", column, says))
    return findings
