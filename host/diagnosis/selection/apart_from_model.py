"""Single samples that stand alone in the residual: a motion hides them in the reading, the nominal model does not.

A channel by itself shows an outlier only against how much it moves within a few samples (`model/readings.py`). An echo
of 0.3 m passes there for motion at 1 m/s read 25 times a second; past the nominal model it is 150 standard deviations of
noise. Physics that the model lacks lasts longer than one sample, with one exception: the answer to an input that jumps.
Samples at a jump of an input are therefore excluded only if errors of timing and gain cannot leave so much.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from host.diagnosis.estimation.fit import Fit, Problem
from host.diagnosis.estimation.rules import SelectionRules
from host.diagnosis.model import readings
from host.diagnosis.model.dataset import Recording
from host.diagnosis.model.model import Segment
from host.diagnosis.model.operators import fill
from host.diagnosis.model.readings import Finding

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
NEAR = 3  # samples about a jump of an input: half of the neighbours by which a sample is judged
STILL = 1e-9  # of a signal's range, below which it does not move


def outliers_of_residual(full: Problem, fit: Fit, recordings: Sequence[Recording]) -> tuple[list[Recording], list[Finding]]:
    """The recordings without samples that stand alone in the residual of the nominal `fit`, and what was found.

    full: the problem at the rate that was recorded. Only outputs that are compared as they were read are examined.
    """
    rules = full.rules
    counts = dict.fromkeys((output.channel for output in full.model.outputs), 0)
    totals, first = dict(counts), dict.fromkeys(counts, "")
    cleaned = []
    for segment, recording in zip(full.segments, recordings, strict=True):
        left = full.left(segment, fit.terms, fit.values)
        jumps = _jumps(segment, full.model.quiet_inputs, rules)
        for row, output in enumerate(full.model.outputs):
            values = recording.channels.get(output.channel)
            if (
                values is None
                or not _as_read(segment.y[row], values)
                or np.isfinite(left[row]).sum() < rules.data.outlier_fewest_samples
            ):
                continue
            noise = readings.scatter(left[row])
            alone = ~jumps | (np.abs(left[row]) > rules.input_jump_over_output * _span(values - left[row]))
            bad = readings.wild(left[row], noise, rules.data) & np.isfinite(values) & alone
            rest = np.where(bad, np.nan, values)
            if float(np.nanstd(rest)) <= rules.data.motion_over_noise * noise:
                continue  # it may be blows that are meant, as in a channel by itself
            totals[output.channel] += values.size
            if bad.any():
                counts[output.channel] += int(bad.sum())
                where = recording.begin_s + float(recording.time_s[int(np.argmax(bad))])
                unit = "s" if recording.timed else "samples"
                first[output.channel] = first[output.channel] or f"first at {where:.4g} {unit} of {recording.name}"
                recording = replace(recording, channels={**recording.channels, output.channel: rest})
        cleaned.append(recording)
    findings = []
    for channel, count in counts.items():
        if count:
            column = full.columns.get(channel, channel)
            says = f"{count} of {totals[channel]} samples of column {column} are outliers, single samples far from what the "
            says += f"nominal model predicts while their neighbours are near it ({first[channel]}). "
            says += "They are left out of the comparison."
            findings.append(Finding("outliers", column, says))
    return cleaned, findings


def _as_read(y: Array, values: Array) -> bool:
    """Whether the output `y` (n,) is the channel `values` (n,) itself, not made of it."""
    both = np.isfinite(y) & np.isfinite(values)
    return y.size == values.size and bool(both.any()) and bool(np.array_equal(y[both], values[both]))


def _jumps(segment: Segment, inputs: Sequence[str], rules: SelectionRules) -> Mask:
    """Samples (n,) about which an input jumps: one step makes most of all that it moves there."""
    found = np.zeros(segment.n, dtype=bool)
    for name in inputs:
        values = segment.inputs.get(name)
        if values is None or values.size < 4 * NEAR or np.ptp(values) == 0.0:
            continue
        line = fill(values)
        windows = np.lib.stride_tricks.sliding_window_view(np.pad(line, NEAR, mode="edge"), 2 * NEAR + 1)
        span = windows.max(axis=1) - windows.min(axis=1)
        step = np.max(np.abs(np.diff(windows, axis=1)), axis=1)
        found |= (step > rules.input_jump_share * span) & (span > STILL * float(np.ptp(line)))
    return found


def _span(simulated: Array) -> Array:
    """What a simulated output (n,) moves within NEAR samples of each."""
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(fill(simulated), NEAR, mode="edge"), 2 * NEAR + 1)
    return np.asarray(windows.max(axis=1) - windows.min(axis=1))
