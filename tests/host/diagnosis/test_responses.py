"""Responses in few points have the inner products of the stacked ones."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from host.diagnosis.selection.responses import ResponseFrame, pointwise, states_of

Array = npt.NDArray[np.float64]
ROWS, SAMPLES, FITTED = 3, (40, 25), 4


def _frames() -> tuple[ResponseFrame, ResponseFrame, list[Array]]:
    """The stacked frame, that of one point a sample, and the weights; one output is missing at some samples, all at one."""
    rng = np.random.default_rng(7)
    weights = [rng.standard_normal((ROWS, n)) for n in SAMPLES]
    weights[0][1, 5:9] = 0.0
    weights[1][:, 3] = 0.0
    size = ROWS * sum(SAMPLES)
    Q = np.linalg.qr(rng.standard_normal((size, FITTED)))[0]
    rest = rng.standard_normal(size)
    rest -= Q @ (Q.T @ rest)
    edges = np.cumsum([0, *(ROWS * n for n in SAMPLES)])
    return ResponseFrame(Q, rest, edges), pointwise(Q, rest, weights), weights


def _motions(seed: int, which: int | None = None) -> list[Array]:
    rng = np.random.default_rng(seed)
    return [rng.standard_normal(n) if which in (None, k) else np.zeros(n) for k, n in enumerate(SAMPLES)]


def test_a_response_of_few_points_is_the_stacked_one() -> None:
    whole, few, weights = _frames()
    moved = _motions(1)
    response = few.of_motion(moved)
    stacked = np.concatenate([(w * m).ravel() for w, m in zip(weights, moved, strict=True)])
    assert response.size == sum(SAMPLES)
    assert few.stacked(response) == pytest.approx(stacked)
    assert response @ few.rest == pytest.approx(stacked @ whole.rest)
    assert response @ few.Q == pytest.approx(stacked @ whole.Q)
    assert response @ few.of_motion(_motions(2)) == pytest.approx(stacked @ few.stacked(few.of_motion(_motions(2))))


def test_states_take_what_least_squares_do() -> None:
    whole, few, _ = _frames()
    states = np.array([few.of_motion(_motions(3 + k, k)) for k in range(len(SAMPLES))])
    stacked = np.array([few.stacked(row) for row in states])
    response = few.of_motion(_motions(9))[None]
    past = stacked.T - whole.Q @ (whole.Q.T @ stacked.T)
    left = whole.rest - past @ np.linalg.lstsq(past, whole.rest, rcond=None)[0]
    for frame, rows, D in ((few, states, response), (whole, stacked, few.stacked(response[0])[None])):
        found = states_of(frame, rows)
        assert found.taken == pytest.approx(whole.rest @ whole.rest - left @ left)
        N = found.along(D, D @ frame.Q)
        assert (D @ frame.rest - N @ found.best)[0] == pytest.approx(few.stacked(response[0]) @ left)


def test_a_state_that_is_fitted_already_is_not_counted() -> None:
    whole, _, _ = _frames()
    states = states_of(whole, np.array([whole.Q[:, 0] - 2.0 * whole.Q[:, 2], np.ones(whole.rest.size)]))
    assert states.best.shape == (1,)
    assert states_of(whole, np.zeros((0, whole.rest.size))).taken == 0.0
