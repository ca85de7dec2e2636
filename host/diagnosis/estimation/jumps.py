"""Jumps of a residual's level inside a recording: a bumped prism, a slipped clamp, a sensor that was switched on again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from host.diagnosis.estimation.rules import SelectionRules
from host.diagnosis.model.operators import fill

Array = npt.NDArray[np.float64]
SIDE = 20  # samples before and after a jump whose medians are compared
NEAR = 3  # samples before and after a jump, between which most of it happens


@dataclass(frozen=True)
class Jump:
    """A jump by `size` before the sample `sample` of recording number `recording`."""

    recording: int
    sample: int
    size: float


def jumps_of(residuals: Sequence[Array], rules: SelectionRules, step: float = 0.0) -> list[Jump]:
    """Jumps in residuals (n_i,) of recordings, in order; none where the level steps again and again.

    step: in which the output is read. Rounding is off by half of it at most, so it makes no larger jump than one step.
    """
    found: list[Jump] = []
    for number, r in enumerate(residuals):
        if np.isfinite(r).sum() < 10 * SIDE:
            continue
        own = _jumps(fill(r), number, rules, step)
        if len(own) > rules.jumps_per_recording:
            return []
        found += own
    return found


def steps_there(signal: Array, sample: int, least: float, rules: SelectionRules) -> bool:
    """Whether `signal` (n,) itself steps at `sample`, by more than `least` of its span."""
    before, after = signal[max(sample - SIDE, 0) : sample], signal[sample : sample + SIDE]
    if not before.size or not after.size:
        return False
    near = float(np.ptp(signal[max(sample - NEAR, 0) : sample + NEAR]))
    far = abs(float(np.median(after) - np.median(before)))
    return near > least * float(np.ptp(signal)) and near > rules.jump_abrupt_share * far


def _jumps(r: Array, number: int, rules: SelectionRules, step: float) -> list[Jump]:
    shift, abrupt = _shift(r, SIDE), _shift(r, NEAR)
    level = 1.4826 * float(np.median(np.abs(shift - np.median(shift)))) + 1e-300
    found: list[Jump] = []
    least = np.maximum(rules.jump_deviations * np.maximum(level * _unrest(r), _scatter(r)), step)
    left = np.where(np.abs(shift) > least, np.abs(shift), 0.0)
    while left.size and np.max(left) > 0.0 and len(found) <= rules.jumps_per_recording:
        place = int(np.argmax(left))
        at = place + SIDE  # first sample after it
        near = np.arange(max(at - SIDE // 2, NEAR), min(at + SIDE // 2, r.size - NEAR) + 1)  # medians are flat about it
        sizes = abrupt[near - NEAR] * np.sign(shift[place])
        near = near[sizes > rules.jump_abrupt_share * left[place]]
        if near.size:
            steps = (r[near] - r[near - 1]) * np.sign(shift[place])
            sample = int(near[np.argmax(steps)])
            if sample >= 2 * SIDE:  # before, an initial state may fade that is not quite right
                found.append(Jump(number, sample, float(shift[place])))
        left[max(place - SIDE, 0) : place + SIDE + 1] = 0.0
    return sorted(found, key=lambda jump: jump.sample)


def _scatter(r: Array) -> Array:
    """Standard deviation of `_shift` if the samples around are white: noise can grow with the motion."""
    steps = np.lib.stride_tricks.sliding_window_view(np.abs(np.diff(r)), 2 * SIDE - 1)
    one = 1.4826 / np.sqrt(2.0) * np.median(steps, axis=1)
    return np.asarray(one * np.sqrt(np.pi / SIDE))  # a median of n samples scatters by sqrt(pi / 2n) of one sample


def _unrest(r: Array) -> Array:
    """Spread of the samples on the noisier side of each place of `_shift`, over the usual one, and at least 1.

    Coloured noise that comes in bursts has levels of its own there.
    """
    windows = np.lib.stride_tricks.sliding_window_view(r, SIDE)
    spread = np.median(np.abs(windows - np.median(windows, axis=1, keepdims=True)), axis=1)
    noisier = np.maximum(spread[:-SIDE], spread[SIDE:])
    return np.asarray(np.maximum(noisier / (np.median(noisier) + 1e-300), 1.0))


def _shift(r: Array, side: int) -> Array:
    """Median of `side` samples from each on less that of as many before it, from sample `side` on.

    An outlier is not a jump: it does not change these medians.
    """
    medians = np.median(np.lib.stride_tricks.sliding_window_view(r, side), axis=1)
    return np.asarray(medians[side:] - medians[:-side])
