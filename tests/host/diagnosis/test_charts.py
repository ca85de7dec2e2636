"""Sequential charts of the live watch: no alarm in an hour of usual residual, one in seconds of twice as much."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from host.diagnosis.live.charts import Charts, Usual

PERIOD_S = 0.025
ROWS = 12
Array = np.ndarray


def residual(rng: np.random.Generator, n: int, colour: float = 0.0) -> Array:
    """Residual of `ROWS` outputs with unit RMS: white, or of first order."""
    white = rng.normal(size=(ROWS, n + 500))
    return np.asarray(lfilter([np.sqrt(1.0 - colour**2)], [1.0, -colour], white, axis=1)[:, 500:])


def learned(rng: np.random.Generator, colour: float = 0.0) -> Charts:
    """Charts that have seen 7.5 s of usual residual."""
    return Charts(Usual.of(residual(rng, 300, colour)), PERIOD_S)


def alarm_s(charts: Charts, r: Array) -> float:
    """Time until a chart passes its threshold; infinite if none does."""
    for k in range(r.shape[1]):
        charts.take(r[:, k : k + 1])
        if np.max(charts.score) > 1.0:
            return (k + 1) * PERIOD_S
    return float("inf")


@pytest.mark.parametrize("colour", [0.0, 0.7, 0.95])
def test_the_usual_residual_raises_no_alarm_in_an_hour(colour: float) -> None:
    highest = 0.0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        charts = learned(rng, colour)
        for _ in range(20):
            charts.take(residual(rng, round(30.0 / PERIOD_S), colour))
            highest = max(highest, float(np.max(charts.score)))
    assert highest < 1.0


@pytest.mark.parametrize("kind", ["scale", "mean"])
def test_twice_the_usual_residual_is_reported_within_three_seconds(kind: str) -> None:
    late = []
    for seed in range(20):
        rng = np.random.default_rng(100 + seed)
        charts = learned(rng)
        charts.take(residual(rng, 4000))
        r = residual(rng, 400)
        r[3] += np.sqrt(3.0) * (rng.normal(size=400) if kind == "scale" else 1.0)
        late.append(alarm_s(charts, r))
        assert charts.samples - charts.since < late[-1] / PERIOD_S + 40
    assert np.median(late) < 1.5 and sum(delay < 3.0 for delay in late) >= 18


def test_a_missing_sample_and_a_wild_one_are_no_mismatch() -> None:
    rng = np.random.default_rng(5)
    charts = learned(rng)
    r = residual(rng, 4000)
    r[:, ::7] = np.nan
    r[2, 100::200] = 50.0
    charts.take(r)
    assert np.max(charts.score) < 0.6


def test_charts_come_down_when_the_mismatch_is_over() -> None:
    rng = np.random.default_rng(6)
    charts = learned(rng)
    charts.take(residual(rng, 2000) * 3.0)
    assert np.max(charts.score) > 1.0
    charts.take(residual(rng, 800))
    assert np.max(charts.score) < 0.5


def test_one_call_or_many_give_the_same() -> None:
    rng = np.random.default_rng(7)
    usual, r = Usual.of(residual(rng, 300, 0.8)), residual(rng, 300, 0.8) * 1.8
    whole, parts = Charts(usual, PERIOD_S), Charts(usual, PERIOD_S)
    whole.take(r)
    for k in range(0, 300, 11):
        parts.take(r[:, k : k + 11])
    assert np.allclose(whole.score, parts.score)
