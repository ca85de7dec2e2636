"""Noise of measured inputs that the nominal model passes on to its outputs: it is in the residual, and is no mismatch.

A nominal model takes its inputs for exact. Noise n that was read with an input, and that no plant ever felt, makes the
simulated output f(u + n) - f(u), and the residual the same with the other sign. Noise that a plant did feel, such as that
of a controller's command, is in both and makes nothing of the residual. With r the simulated output's change when each input
is smoothed, the residual e tells them apart by the slope of the regression

    e = -b r,   b = 1 for noise of the reading alone, 0 for noise that the plant felt.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from host.diagnosis.model.model import Model, Segment
from host.diagnosis.model.operators import reading_noise, smooth_derivatives

Array = npt.NDArray[np.float64]
WINDOW, DEGREE = 9, 3  # samples and degree of the local polynomial that smooths an input
FAR = 4.0  # an input that is this many times its noise from its smooth course jumps there: no noise
MOST = 2.0  # times the expected level, above which what smoothing takes from an input is motion and not noise


def noise_through(model: Model, segment: Segment, theta: Array) -> Array:
    """Standard deviation (outputs,) of what noise of the measured inputs makes of the outputs, by two simulations.

    theta: nominal parameters. Inputs are those that may move without noise, `Model.quiet_inputs`. Noise is white: what a
    short local polynomial takes from an input, where that is as strong as the upper half of its spectrum says.
    """
    smoothed, noisy = dict(segment.inputs), dict(segment.inputs)
    rng = np.random.default_rng(0)
    calm = np.ones(segment.n, dtype=bool)
    for name in model.quiet_inputs:
        u = segment.inputs[name]
        if u.size < 4 * WINDOW:
            continue
        sigma, rest = reading_noise(u), u - smooth_derivatives(u, 1.0, WINDOW, DEGREE)[0]
        near = np.abs(rest) < FAR * sigma
        if not near.any() or float(np.sqrt(np.mean(rest[near] ** 2))) > MOST * sigma:
            continue
        calm &= near
        smoothed[name], noisy[name] = np.where(near, u - rest, u), u + sigma * rng.standard_normal(u.size)
    none = np.zeros(len(model.outputs))
    if all(smoothed[name] is segment.inputs[name] for name in model.quiet_inputs):
        return none
    base = model.simulate(segment, theta, [])
    response = base - model.simulate(replace(segment, inputs=smoothed), theta, [])
    level = np.std(model.simulate(replace(segment, inputs=noisy), theta, []) - base, axis=1)
    out = none.copy()
    for row, (e, r) in enumerate(zip(segment.y - base, response, strict=True)):
        used = calm & np.isfinite(e) & np.isfinite(r)
        power = float(np.sum(r[used] ** 2))
        if power > 0.0 and np.isfinite(level[row]):
            slope = -float(np.sum(e[used] * r[used])) / power
            out[row] = float(np.clip(slope, 0.0, 1.0)) * float(level[row])
    return out
