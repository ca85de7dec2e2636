"""What a candidate's response takes from a residual past all that is fitted, and past the states of recordings.

With orthonormal columns Q of the rates of all that is fitted, the residual e past them, responses D of a candidate and
responses C to the states that recordings begin from (rows of D and C), normal equations past Q are

    G = D D' - (D Q)(D Q)',   N = D C' - (D Q)(C Q)',   M = C C' - (C Q)(C Q)',   g = D e,   h = C e

and past the states G - N M^-1 N', g - N M^-1 h. Only inner products enter. Where outputs answer a motion m sample by sample
(`Model.pointwise`), a response is w(row, t) m(t), and its inner product with any x is that of |w(t)| m(t) with
sum over rows of w(row, t) x(row, t) / |w(t)|: a sample of many outputs is one point.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
SEEN = 1e-12  # share of the largest energy of a state's response that has to be left past `Q`
APART = 1e-10  # smallest eigenvalue of states of unit size that are separate


@dataclass(frozen=True)
class ResponseFrame:
    """Points in which responses are compared with a residual.

    Q: (points, columns), rest: (points,), of what is fitted and of the residual past it; edges: (recordings + 1,), first
    points of the recordings and the end. Where a sample of many outputs is one point, units: of each recording (outputs,
    samples), the direction w / |w| of its outputs; sizes: (samples,), |w|. Else none: points are the stacked residuals.
    """

    Q: Array
    rest: Array
    edges: Array
    units: tuple[Array, ...] = ()
    sizes: tuple[Array, ...] = ()

    def of_motion(self, moved: list[Array]) -> Array:
        """The response (points,) to changes of the motion (samples,) of each recording."""
        return np.concatenate([size * m for size, m in zip(self.sizes, moved, strict=True)])

    def stacked(self, response: Array) -> Array:
        """The same response in stacked residuals."""
        if not self.units:
            return response
        parts = [
            (unit * response[first : first + unit.shape[1]]).ravel()
            for unit, first in zip(self.units, self.edges[:-1], strict=True)
        ]
        return np.concatenate(parts)


def pointwise(Q: Array, rest: Array, weights: list[Array]) -> ResponseFrame:
    """The frame of responses with `weights` (outputs, samples) of each recording. Q and rest: of the stacked residuals."""
    sizes = tuple(np.sqrt(np.einsum("rt,rt->t", w, w)) for w in weights)
    units = tuple(w / np.where(size > 0.0, size, 1.0) for w, size in zip(weights, sizes, strict=True))
    parts = np.split(np.column_stack((Q, rest)), np.cumsum([w.size for w in weights])[:-1])
    along = [np.einsum("rt,rtk->tk", u, part.reshape(*u.shape, -1)) for u, part in zip(units, parts, strict=True)]
    both = np.concatenate(along)
    edges = np.cumsum([0, *(size.size for size in sizes)])
    return ResponseFrame(np.ascontiguousarray(both[:, :-1]), both[:, -1].copy(), edges, units, sizes)


@dataclass(frozen=True)
class States:
    """Responses (states, points) to states of recordings, in `frame`, each with some energy past what is fitted.

    rates: with `Q` (states, columns); inverse: of their normal equations; best: what they are without any response.
    """

    frame: ResponseFrame
    responses: Array
    rates: Array
    inverse: Array
    best: Array

    @property
    def taken(self) -> float:
        """Squared error that they take from the residual alone."""
        return float(self.best @ (self.responses @ self.frame.rest))

    def along(self, D: Array, DQ: Array) -> Array:
        """Inner products (responses, states) with responses D (responses, points), past what is fitted.

        DQ: inner products (responses, columns) of the responses with `Q`.
        """
        return np.asarray(D @ self.responses.T - DQ @ self.rates.T)


def states_of(frame: ResponseFrame, responses: Array) -> States:
    """States that are seen past what is fitted, of `responses` (states, points)."""
    raw = np.einsum("sp,sp->s", responses, responses)
    rates = responses @ frame.Q
    energy = raw - np.einsum("sk,sk->s", rates, rates)
    seen = energy > SEEN * max(float(np.max(raw, initial=0.0)), 1e-300)
    C, rates, size = responses[seen], rates[seen], np.sqrt(energy[seen])
    M = (C @ C.T - rates @ rates.T) / np.outer(size, size)
    values, vectors = np.linalg.eigh(M) if size.size else (np.zeros(0), np.zeros((0, 0)))
    kept = values > APART
    inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T / np.outer(size, size)
    return States(frame, C, rates, inverse, inverse @ (C @ frame.rest))
