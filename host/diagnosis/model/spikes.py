"""Samples of an input that stand alone: a spike that the output answers, such as a derivative kick, is not an outlier.

The law of the pair is fitted past all spikes, once. A spike is left out if the law holds much better without it than with
it. Where both hold alike, because the motion is too noisy to show an answer, it stays.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from host.diagnosis.model.data_rules import DataRules
from host.diagnosis.model.dataset import Recording
from host.diagnosis.model.operators import fill, smoothing_window, white_level
from host.diagnosis.model.pairs import Pair, sides_of_law

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
NEAR = 3  # samples about a spike in which an answer is looked for, in addition to the law's smoothing


def around(spikes: Mask, reach: int) -> Mask:
    """Samples (n,) that are at most `reach` from one of the spikes (n,)."""
    return np.asarray(np.convolve(spikes, np.ones(2 * reach + 1), mode="same") > 0.0)


def unanswered(recording: Recording, path: Pair, name: str, spikes: Mask, others: Mask, rules: DataRules) -> Mask:
    """Those `spikes` (n,) of the input `name` of a pair that its output does not answer.

    others: (n,) samples that stand alone in the output, from which nothing is learned.
    """
    clean = replace(recording, channels={**recording.channels, name: np.where(spikes, np.nan, recording.channels[name])})
    if not path.related or (path.law and not recording.timed):
        return np.zeros(spikes.size, dtype=bool)
    motion = fill(clean.channels[path.output])
    dt = recording.dt_s
    window = smoothing_window(motion, dt, white_level(motion), 7 * dt) if path.law else 0
    reach = window + NEAR
    with_them, without = (sides_of_law(each, path, window) for each in (recording, clean))
    free = ~around(spikes | others, reach)
    inside = slice(window, free.size - window)  # next to an end neither the motion before nor its derivatives are known
    terms, force = without
    known = np.zeros(spikes.size, dtype=bool)
    known[inside] = True
    free &= known
    if np.count_nonzero(free) < rules.law_fewest_samples:
        return np.zeros(spikes.size, dtype=bool)
    size = np.linalg.norm(terms[:, free], axis=1) + 1e-300
    found = np.linalg.lstsq((terms[:, free] / size[:, None]).T, force[free], rcond=1e-9)[0] / size
    errors = [np.convolve((f - found @ rows) ** 2, np.ones(2 * reach + 1), mode="same") for rows, f in (with_them, without)]
    return np.asarray(spikes & known & (errors[1] < rules.spike_error_share * errors[0]))
