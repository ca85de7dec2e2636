"""Noise of measured inputs that the nominal model passes on to its outputs: part of the residual that is not a mismatch.

A nominal model takes its inputs for exact. Noise n that was read with an input, and that no plant ever felt, makes
w = f(u + n) - f(u) of the simulated output, and -w of the residual e. Noise that a plant did feel, such as that of a
controller's command, is in both outputs and makes nothing of the residual. With z the part of an input that its past does
not predict, and r what z makes of the simulated output, the share b of the noise that was only read is

    b = -<e, r> / <w, r>

where white noise of the input's own level, drawn and simulated, gives <w, r>. The past alone predicts: a controller feeds
the noise of the output into the inputs that follow, and a smoothing of both sides would find it there. Of e, w and r too the
predictable part is taken away: a mismatch is mostly slow, and would hide the noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from host.diagnosis.estimation.noise import prediction_error
from host.diagnosis.model.model import Model, Segment
from host.diagnosis.model.operators import fill, reading_noise

Array = npt.NDArray[np.float64]
DEGREES = (1, 2, 3, 4, 5, 6)  # of the polynomials that predict a sample from those before it,
LENGTHS = (2, 3, 5)  # so many times as many of them as the polynomial has coefficients
LEAST = 200  # samples of an input whose noise is estimated
FAR = 4.0  # times what noise alone leaves of a prediction, beyond which an input jumps or turns
MOST = 2.0  # times that, above which predictions fail because of the motion and not of noise
SURE = 2.0  # standard errors that are added to the share that was only read


def noise_through(model: Model, segment: Segment, theta: Array) -> Array:
    """Standard deviation (outputs,), at most, of what noise of the measured inputs makes of the outputs.

    theta: nominal parameters. Inputs are those that may move without noise, `Model.quiet_inputs`. Takes four simulations.
    """
    rng, calm = np.random.default_rng(0), np.ones(segment.n, dtype=bool)
    noise, innovation, drawn_innovation = {}, {}, {}
    for name in model.quiet_inputs:
        u = segment.inputs[name]
        sigma = reading_noise(u)
        if u.size < LEAST or sigma <= 0.0:
            continue
        weights = _best_predictor(u)
        usual, z = sigma * float(np.sqrt(1.0 + weights @ weights)), prediction_error(u, weights)
        if _missed(u, weights) > MOST * usual:
            continue
        near = np.abs(z) < FAR * usual
        calm &= near
        noise[name] = sigma * rng.standard_normal(u.size)
        innovation[name], drawn_innovation[name] = np.where(near, z, 0.0), prediction_error(noise[name], weights)
    out = np.zeros(len(model.outputs))
    if not noise:
        return out

    def simulated(*changes: dict[str, Array]) -> Array:
        inputs = {name: u + sum(c.get(name, 0.0) for c in changes) for name, u in segment.inputs.items()}
        return model.simulate(replace(segment, inputs=inputs), theta, [])

    base, noisy = simulated(), simulated(noise)
    response = base - simulated({name: -z for name, z in innovation.items()})
    drawn = noisy - simulated(noise, {name: -z for name, z in drawn_innovation.items()})
    for row, (e, r, w, own) in enumerate(zip(segment.y - base, response, noisy - base, drawn, strict=True)):
        used = calm & np.isfinite(e)
        if np.count_nonzero(used) < LEAST or not (np.isfinite(r) & np.isfinite(w) & np.isfinite(own)).all():
            continue
        filled = fill(e)
        weights = _best_predictor(filled)
        fast = [prediction_error(signal, weights)[used] for signal in (filled, r, w, own)]
        expected = float(np.mean(fast[2] * fast[3]))
        if expected != 0.0:
            share = -float(np.mean(fast[0] * fast[1])) / expected
            error = float(np.sqrt(np.mean(fast[0] ** 2) * np.mean(fast[1] ** 2) / fast[0].size)) / abs(expected)
            out[row] = float(np.clip(share + SURE * error, 0.0, 1.0)) * float(np.std(w[used]))
    return out


def _predictor(degree: int, past: int) -> Array:
    """Weights (past,) in the prediction of a sample by a polynomial through those before it, the nearest first."""
    before = -np.arange(1.0, past + 1.0) / past
    return np.asarray(np.linalg.pinv(np.vander(before, degree + 1, increasing=True))[0])


PREDICTORS = [_predictor(degree, length * (degree + 1)) for degree in DEGREES for length in LENGTHS]


def _best_predictor(u: Array) -> Array:
    return min(PREDICTORS, key=lambda weights: _missed(u, weights))


def _missed(u: Array, weights: Array) -> float:
    """Standard deviation of what a predictor misses of `u` (n,), robust against jumps."""
    return 1.4826 * float(np.median(np.abs(prediction_error(u, weights)[weights.size :])))
