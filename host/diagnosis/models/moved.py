"""Force terms of the vocabulary along a measured motion: where a model predicts the force that a motion needs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.signal import savgol_coeffs

from host.diagnosis.estimation.noise import estimate, quiescent
from host.diagnosis.model.dataset import Recording
from host.diagnosis.model.force_kernel import along, slot_array
from host.diagnosis.model.model import ActiveEffect, Segment, tolerance_of
from host.diagnosis.model.operators import least_error_window, smooth_derivative, smoothing_window

Array = npt.NDArray[np.float64]
SMOOTHING_S = 0.03
DEGREE = 5  # of the local polynomial that is differentiated,
WIDER = 1.45  # and its widest window over that of a cubic that passes as much noise
LEAST_WINDOW = 11  # samples of the shortest window of position and speed, whose noise would hide where a motion reverses
SHORTEST = 200  # samples of a motion whose spectrum says how far it may be smoothed
CLEAN = 0.02  # noise of a motion, in smallest movements, below which it is taken as it is


@dataclass(frozen=True)
class Moved:
    """A measured motion with its derivatives, each (n,), and the movement below which nothing has moved.

    noise: standard deviation of what was read of it; windows: samples that x, v and a are each smoothed over, 1 for an x
    that is taken as it is.
    """

    x: Array
    v: Array
    a: Array
    tolerance: float
    noise: float = 0.0
    windows: tuple[int, int, int] = (1, 1, 1)

    @classmethod
    def of(cls, motion: Array, recording: Recording) -> Moved:
        """Smooth `motion` (n,) to velocity and acceleration without phase."""
        noise = estimate([motion], [quiescent([motion], recording.dt_s, recording.timed)]).sigma
        window = smoothing_window(motion, recording.dt_s, noise, SMOOTHING_S) if recording.timed else 7
        tolerance = tolerance_of(motion, float(np.ptp(motion)))
        clean = noise < CLEAN * tolerance
        # Each derivative with the window of its own least error, no wider than the band allows. That of a clean motion is
        # narrower: an acceleration over the whole band is too small where the motion turns sharply.
        widest = window if clean else round(WIDER * window) | 1
        least = (LEAST_WINDOW, DEGREE + 2 if clean else LEAST_WINDOW, DEGREE + 2)
        best = [widest] * 3
        if recording.timed and motion.size >= SHORTEST:
            used = (1, 2) if clean else (0, 1, 2)  # a clean position is taken as it is
            best[-len(used) :] = [least_error_window(motion, recording.dt_s, noise, DEGREE, order) for order in used]
        windows = [max(min(one, widest), short) for one, short in zip(best, least, strict=True)]
        x, v, a = (smooth_derivative(motion, recording.dt_s, one, order, DEGREE) for order, one in enumerate(windows))
        # smoothing a clean motion would round its reversals, and friction with them
        taken = (1 if clean else windows[0], windows[1], windows[2])
        return cls(motion if clean else x, v, a, tolerance, noise, taken)

    def noise_of_force(self, law: tuple[float, float, float], dt_s: float) -> float:
        """Standard deviation of the force that the noise of the motion makes through stiffness, damping and mass (`law`)."""
        longest = max(self.windows)
        answer = np.zeros(longest)
        for order, (window, weight) in enumerate(zip(self.windows, law, strict=True)):
            kernel = np.ones(1) if window == 1 else savgol_coeffs(window, DEGREE, deriv=order, delta=dt_s, use="dot")
            first = (longest - window) // 2
            answer[first : first + window] += weight * kernel
        return self.noise * float(np.sqrt(np.sum(answer**2)))


def force_along(moved: Moved, here: list[ActiveEffect], segment: Segment, port: str, stiffness: float = 0.0) -> Array:
    """Force (n,) of the effects `here`, all of them at `port`, along its motion. stiffness: of the nominal model."""
    force = np.zeros(segment.n)
    terms = [(candidate, values) for candidate, values in here if candidate.effect.slots is not None]
    for source in dict.fromkeys(candidate.source for candidate, _ in terms):
        filled = [c.effect.slots(values, c.form) for c, values in terms if c.source == source and c.effect.slots is not None]
        load = segment.inputs[source] if source else np.zeros(segment.n)
        p = slot_array([*filled, {"stiffness": stiffness}])
        time_s, dt_s = segment.recording.time_s, segment.recording.dt_s
        start = segment.start.get(port, 0.0)
        force = force + along(moved.x, moved.v, moved.a, load, time_s, dt_s, moved.tolerance, start, p)
    return force
