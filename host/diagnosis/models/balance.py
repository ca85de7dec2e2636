"""A free axis is balanced, not simulated: the force that its measured motion needs against the input, smoothed alike."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.signal import welch

from host.diagnosis.estimation.force_kernel import along
from host.diagnosis.estimation.noise import ORDER, Noise, autoregression, estimate, quiescent
from host.diagnosis.model.model import Piece
from host.diagnosis.model.operators import smooth_derivatives, smoothing_window

Array = npt.NDArray[np.float64]


def prepare(piece: Piece, motion: Array, least_s: float, hold: str, steps: Array) -> None:
    """Window of the filter that input, inertia and friction all pass, and the motion's (acceleration, speed, place), (3, n),
    behind it.

    The filter is a local cubic over the band in which the motion stands out of its noise; being the same for all terms it
    bends none of their coefficients. The noise of the comparison is told by what does not go with the motion.
    """
    dt_s, recording = piece.recording.dt_s, piece.recording
    sigma = estimate([motion], [quiescent([motion], dt_s, recording.timed)]).sigma
    window = smoothing_window(motion, dt_s, sigma, least_s, 1.0)
    x = _smooth(motion, window)
    second = np.diff(x, 2) / dt_s**2  # of a motion under a held force exactly its mean over the samples beside
    rows = np.array([np.concatenate((second[:1], second, second[-1:])), np.gradient(x, dt_s), x])
    piece.extra.update(window=window, balance=rows)
    force = applied(piece, steps, hold)
    columns = np.vstack([rows, np.ones(piece.n)]).T
    piece.extra["noise"] = _noise(force - columns @ np.linalg.lstsq(columns, force, rcond=1e-12)[0], window)


def _smooth(values: Array, window: int) -> Array:
    """A local cubic, twice: what it lets pass beyond its band would be noise, which acceleration multiplies."""
    return smooth_derivatives(smooth_derivatives(values, 1.0, window)[0], 1.0, window)[0]


def _noise(rest: Array, window: int) -> Noise:
    """Noise behind the filter, as loud in all of its band as `rest` (n,) is in the quietest fifth of it."""
    impulse = np.zeros(8 * window + 1)
    impulse[4 * window] = 1.0
    kernel = _smooth(impulse, window)
    frequency, power = welch(rest, nperseg=min(rest.size, 1024), window="blackman")
    gain = np.abs(np.exp(-2j * np.pi * np.outer(frequency, np.arange(kernel.size))) @ kernel) ** 2
    level = float(np.quantile((power / np.maximum(gain, 1e-12))[gain > 0.25], 0.2))
    lags = np.array([kernel[k:] @ kernel[: kernel.size - k] for k in range(ORDER + 1)])
    return Noise(float(np.sqrt(0.5 * level * lags[0])), autoregression(lags), "the band that is compared")


def applied(piece: Piece, steps: Array, hold: str) -> Array:
    """Input (n,) as it acts about each sample, behind the filter. One held between samples acts half a period late."""
    force = steps[:: 2 * piece.extra["substeps"]][: piece.n]
    if hold == "zero":
        force = 0.5 * (force + np.concatenate((force[:1], force[:-1])))
    return _smooth(force, piece.extra["window"])


def error(piece: Piece, linear: Array, steps: Array, hold: str, p: Array, start: float) -> Array:
    """Force (1, n) that the motion needs beyond the input. linear: m, c, k, offset; p: slots of the force kernel.

    An effect of the drive changes the input, which is what is compared here: where it shrinks the
    input the error counts in the size of the recorded one, so that nothing is gained by shrinking.
    """
    extra = piece.extra
    a, v, x = extra["balance"]
    need = linear[0] * a + linear[1] * v + linear[2] * x - linear[3]
    if np.any(p):
        dry = along(
            extra["x"],
            extra["v"],
            np.gradient(extra["v"], piece.recording.dt_s),
            np.zeros(piece.n),
            piece.recording.time_s,
            piece.recording.dt_s,
            extra["tolerance"],
            start,
            p,
        )
        need = need + _smooth(dry, extra["window"])
    size = float(np.std(steps)) / max(float(np.std(extra["steps"])), 1e-300)
    return np.asarray(need - applied(piece, steps, hold))[None, :] / min(max(size, 1e-6), 1.0)
