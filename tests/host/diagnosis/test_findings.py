"""What is found in the recordings before any fit: readings that are limited, short noisy channels, copies in order."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from host.diagnosis.model.findings import Finding
from host.diagnosis.model.nominal import nominal_of
from host.diagnosis.model.tables import Table
from host.diagnosis.problems import NothingToCompare, inspected, prepare
from host.diagnosis.selection.refits import fit_nominal
from tests.host.proof.everyday import spring_nominal

GEAR: dict[str, Any] = {
    "name": "gear",
    "kind": "transmission",
    "data": {"time": "t"},
    "channels": {"motor": {"column": "m", "unit": "rad"}, "jaw": {"column": "y", "unit": "rad"}},
    "link": [{"input": "motor", "output": "jaw"}],
}


AXIS: dict[str, Any] = {
    "name": "stage",
    "kind": "axis",
    "data": {"time": "t"},
    "channels": {"force": {"column": "f", "unit": "N"}, "place": {"column": "y", "unit": "m"}},
    "axis": {"input": "force", "output": "place", "terms": ["mass", "damping", "stiffness"], "hold": "zero"},
    "parameters": {"mass": 1.1, "damping": 3.5, "stiffness": 140.0},
}


def stage(force: Callable[[np.ndarray], np.ndarray], noise_m: float = 1e-4) -> dict[str, np.ndarray]:
    """A mass of 1.2 kg on 150 N/m and 3 N s/m under a held force (N) of time, for 20 s at 100 Hz."""
    t, rng = np.arange(2000) * 0.01, np.random.default_rng(301)
    f = force(t)
    step = expm(np.array([[0.0, 1.0, 0.0], [-150.0 / 1.2, -3.0 / 1.2, 1.0 / 1.2], [0.0, 0.0, 0.0]]) * 0.01)[:2]
    state, y = np.zeros(2), np.zeros(t.size)
    for k in range(t.size):
        y[k] = state[0]
        state = step @ np.array([*state, f[k]])
    return {"t": t, "f": f, "y": y + noise_m * rng.standard_normal(t.size)}


def tones(t: np.ndarray) -> np.ndarray:
    """Four tones (N) that never repeat a value."""
    parts = zip((0.3, 0.9, 1.6, 2.6), (3.0, 2.0, 3.0, 2.0), (0.4, 2.1, 5.0, 1.2), strict=True)
    return sum(a * np.sin(2.0 * np.pi * f * t + phase) for f, a, phase in parts)


def motion(n: int = 600) -> dict[str, np.ndarray]:
    rng, t = np.random.default_rng(4), np.arange(n) * 0.02
    x = 0.3 * np.sin(1.3 * t + 1.0) + 0.2 * np.sin(2.9 * t)
    return {"t": t, "m": x, "y": x + 1e-3 * rng.standard_normal(n)}


def said(columns: dict[str, np.ndarray], nominal: dict[str, Any] = GEAR) -> list[Finding]:
    return inspected(nominal_of(nominal), [Table("a", columns), Table("b", columns)]).findings


@pytest.mark.parametrize("gain", [1.0, -1.0])
@pytest.mark.parametrize(("low", "high", "word"), [(-np.inf, 0.3, "largest"), (-0.3, np.inf, "smallest")])
def test_a_reading_that_is_limited_on_either_side_is_stated(gain: float, low: float, high: float, word: str) -> None:
    columns = motion()
    columns["y"] = np.clip(gain * columns["y"], low, high)
    limits = [finding.says for finding in said(columns) if finding.id == "saturated"]
    assert len(limits) == 1 and f"its {word} reading" in limits[0]


LEVELS = np.random.default_rng(910).uniform(-5.0, 5.0, 60)


@pytest.mark.parametrize(
    "force",
    [
        lambda t: np.where(t > 2.0, 4.0, 0.0),
        lambda t: np.where(t % 2.0 < 0.8, 4.0, 1.0),
        lambda t: np.sign(LEVELS)[(t / 0.35).astype(int)] * 5.0,
        lambda t: np.sign(np.random.default_rng(1).standard_normal(t.size)) * 5.0,
        lambda t: LEVELS[(t / 0.5).astype(int)],
        lambda t: np.convolve(LEVELS[(t / 0.5).astype(int)], [0.5, 0.5])[: t.size],
        lambda t: 4.0 * np.where(t % 2.0 < 0.8, np.sin(np.pi * (t % 2.0) / 0.8), 0.0),
    ],
    ids=["step", "pulses", "prbs", "white prbs", "staircase", "resampled staircase", "half sines"],
)
def test_an_input_that_is_held_at_levels_is_not_limited_there(force: Callable[[np.ndarray], np.ndarray]) -> None:
    assert "saturated" not in {finding.id for finding in said(stage(force), AXIS)}


def test_a_place_that_rests_at_its_end_while_a_load_cell_is_noisy_is_not_limited_there() -> None:
    rng, t = np.random.default_rng(912), np.arange(0.0, 12.0, 0.01)
    x = 0.05 * np.interp(t % 4.0, [0.0, 0.5, 1.5, 2.0, 3.0, 3.5, 4.0], [-1.0, -1.0, 0.6, 0.6, -0.4, -0.4, -1.0])
    f = 30.0 * np.gradient(x, t) + 100.0 * x + 0.06 * rng.standard_normal(t.size)
    assert "saturated" not in {
        finding.id for finding in said({"t": t, "x": x, "f": f}, spring_nominal("damping", "stiffness"))
    }


def test_an_input_that_is_clipped_is_stated() -> None:
    assert "saturated" in {finding.id for finding in said(stage(lambda t: np.clip(tones(t), -4.0, 4.0)), AXIS)}


@pytest.mark.parametrize(("nominal", "refused"), [(AXIS, True), (GEAR, False)])
def test_a_place_is_no_late_copy_of_a_force(nominal: dict[str, Any], refused: bool) -> None:
    """A delay was named (0.92). Behind a gear of one unit it may be a simulated one, and is only stated."""
    columns = stage(tones)
    columns["m"], columns["y"] = columns["f"], np.r_[np.full(5, columns["f"][0]), columns["f"][:-5]]
    if refused:
        with pytest.raises(NothingToCompare, match=r"0\.05 s later, exactly: it was copied, not measured"):
            said(columns, nominal)
    else:
        assert [finding.id for finding in said(columns, nominal)] == ["alias"]


def slowly(period: float, nominal: dict[str, Any]) -> set[str]:
    """Findings in a recording whose stamps grow by `period`."""
    columns = motion() | {"t": period * np.arange(600)}
    return {finding.id for finding in said(columns, nominal)}


HEATER: dict[str, Any] = {
    "name": "heater",
    "kind": "linear",
    "data": {"time": "t"},
    "channels": {"power": {"column": "m", "unit": "W"}, "rise": {"column": "y", "unit": "K"}},
    "linear": {"inputs": ["power"], "outputs": ["rise"], "numerator": ["K"], "denominator": ["tau", 1.0]},
}
STATES = {"inputs": ["power"], "outputs": ["rise"], "A": [["-1/tau"]], "B": [[1.0]], "C": [["K/tau"]]}


@pytest.mark.parametrize(
    ("period", "nominal", "stated"),
    [
        (1.0, HEATER | {"parameters": {"tau": 70.0, "K": 2.5}}, False),
        (1.0, HEATER | {"parameters": {"tau": 0.07, "K": 2.5}}, True),
        (10.0, HEATER | {"parameters": {"tau": 70.0, "K": 2.5}}, False),
        (10.0, HEATER | {"parameters": {"tau": 0.07, "K": 2.5}, "linear": STATES}, True),
        (10.0, GEAR, True),
        (1.003, GEAR, False),
        (10.0, GEAR | {"link": [GEAR["link"][0] | {"lag_order": 1}], "parameters": {"time_constant_1": 40.0}}, False),
        (10.0, GEAR | {"data": {"time": "t", "time_scale": 1.0001}}, False),
        (0.02, GEAR, False),
    ],
)
def test_slow_sampling_is_remarkable_for_a_fast_plant_alone(period: float, nominal: dict[str, Any], stated: bool) -> None:
    assert ("unit" in slowly(period, nominal)) is stated


SPIKES = np.random.default_rng(7).choice(np.arange(50, 1950), 12, replace=False)


def spiked(values: np.ndarray, size: float) -> np.ndarray:
    spikes = np.zeros(values.size)
    spikes[SPIKES] = size * np.where(SPIKES % 2, 1.0, -1.0)
    return values + spikes


@pytest.mark.parametrize("answered", [True, False])
@pytest.mark.parametrize("noise_m", [1e-5, 1e-3])
def test_a_spike_of_an_input_is_an_outlier_where_the_output_does_not_answer(answered: bool, noise_m: float) -> None:
    columns = stage(lambda t: spiked(tones(t), 100.0 if answered else 0.0), noise_m)
    columns["f"] = spiked(tones(columns["t"]), 100.0)
    texts = [finding.says for finding in said(columns, AXIS) if finding.id == "outliers"]
    assert [text[:8] for text in texts] == ([] if answered else ["24 of 40"])  # in two recordings


@pytest.mark.parametrize("late", [0, 2])
@pytest.mark.parametrize("answered", [True, False])
def test_a_gear_answers_a_spike_by_its_gain(answered: bool, late: int) -> None:
    """A mechanism that is late by two samples answers as well."""
    columns = motion(2000)
    columns["m"], smooth = spiked(columns["m"], 3.0), columns["m"]
    y = np.roll(columns["m"] if answered else smooth, late)
    columns["y"] = 1.2 * y + 1e-3 * np.random.default_rng(3).standard_normal(y.size)
    assert [f.channel for f in said(columns) if f.id == "outliers"] == ([] if answered else ["m"])


def test_derivative_kicks_of_a_controller_move_the_mass() -> None:
    """All set-point steps were cut off the force, the first at the first sample: the mass was 6.3 kg instead of 1.5."""
    rng, dt = np.random.default_rng(120), 0.005
    step = expm(np.array([[0.0, 1.0, 0.0], [-40.0 / 1.5, -5.0 / 1.5, 1.0 / 1.5], [0.0, 0.0, 0.0]]) * dt)[:2]
    goal = np.repeat(rng.uniform(-0.02, 0.02, 10), 160)
    f, y, state, total, before = np.zeros(goal.size), np.zeros(goal.size), np.zeros(2), 0.0, 0.0
    for k in range(goal.size):
        y[k] = state[0] + 2e-5 * rng.standard_normal()
        error = goal[k] - y[k]
        total += error * dt
        f[k] = 400.0 * error + 800.0 * total + 12.0 * (error - before) / dt
        before, state = error, step @ np.array([*state, f[k]])
    columns = {"t": np.arange(goal.size) * dt, "f": f, "y": y}
    assert not [finding for finding in said(columns, AXIS) if finding.id == "outliers"]
    _, problem, _ = prepare(nominal_of(AXIS), [Table("a", columns)])
    assert fit_nominal(problem).values == pytest.approx([1.5, 5.0, 40.0], rel=0.005)


def test_a_short_channel_of_noise_is_no_sinusoid() -> None:
    """Its strongest line may be among the last three of the spectrum."""
    for seed in range(40):
        rng = np.random.default_rng(seed)
        columns = motion(60) | {"m": rng.standard_normal(60), "y": rng.standard_normal(60)}
        assert not any("sinusoid" in finding.says for finding in said(columns))


def test_copies_are_stated_in_the_order_of_the_channels() -> None:
    columns = motion()
    columns["y"] += 0.03 * np.random.default_rng(7).standard_normal(columns["y"].size)  # noise that two gauges do not share
    others = {name: {"column": name, "unit": "N"} for name in "hgfe"}
    nominal = GEAR | {"channels": GEAR["channels"] | others, "link": [GEAR["link"][0] | {"load": list(others)}]}
    found = said(columns | {name: columns["y"].copy() for name in others}, nominal)
    assert [finding.channel for finding in found if finding.id == "alias"] == list(others)
