"""Behind a gap a recording begins again, from a state of its own."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.signal import lsim

from host.diagnosis.estimation.initial_state import estimate_state
from host.diagnosis.model.nominal import nominal_of
from host.diagnosis.model.tables import Table
from host.diagnosis.problems import prepare

DT = 0.01
T = DT * np.arange(2000)
MASS, DAMPING, STIFFNESS, NOISE = 0.5, 0.2, 20.0, 1e-5  # rings at 1 Hz for ten seconds
AXIS: dict[str, Any] = {
    "name": "stage",
    "kind": "axis",
    "data": {"time": "t"},
    "channels": {"force": {"column": "f", "unit": "N"}, "position": {"column": "x", "unit": "m"}},
    "axis": {"input": "force", "output": "position", "terms": ["mass", "damping", "stiffness"], "hold": "linear"},
    "parameters": {"mass": MASS, "damping": DAMPING, "stiffness": STIFFNESS},
}


def recorded() -> dict[str, np.ndarray]:
    """Twenty seconds with hard pushes, one of them within what is cut out below."""
    rng = np.random.default_rng(1)
    f = np.sin(2 * np.pi * 0.4 * T) + np.where((T > 9.0) & (T < 9.4), 15.0, 0.0)
    x = lsim(([1.0], [MASS, DAMPING, STIFFNESS]), f, T)[1]
    return {"t": T, "f": f, "x": x + NOISE * rng.standard_normal(T.size)}


def without(columns: dict[str, np.ndarray], first_s: float, last_s: float, blank: bool) -> dict[str, np.ndarray]:
    """The recording without these seconds: rows absent, or there and empty."""
    out = (columns["t"] >= first_s) & (columns["t"] < last_s)
    if blank:
        return {name: np.where(out & (name != "t"), np.nan, values) for name, values in columns.items()}
    return {name: values[~out] for name, values in columns.items()}


@pytest.mark.parametrize("blank", [False, True])
def test_the_state_behind_a_gap_is_estimated_again(blank: bool) -> None:
    model, problem, _ = prepare(nominal_of(AXIS), [Table("r.csv", without(recorded(), 8.5, 10.5, blank))])
    first, second = problem.segments
    assert (first.recording.name, second.recording.name) == ("r.csv", "r.csv (2)")
    assert second.recording.time_s[0] == pytest.approx(10.5, abs=DT)
    for segment in problem.segments:
        estimate_state(model, segment, model.guess([segment]), [])
        error = segment.y[0] - model.simulate(segment, model.guess([segment]), [])[0]
        # swings of a metre; one Gauss-Newton step from the measured state leaves up to two times the noise
        assert np.sqrt(np.nanmean(error**2)) < 3.0 * NOISE


def test_a_short_gap_is_bridged() -> None:
    _, problem, _ = prepare(nominal_of(AXIS), [Table("r.csv", without(recorded(), 8.5, 8.55, False))])
    assert len(problem.segments) == 1


def test_parts_are_held_out_by_the_name_of_their_file() -> None:
    tables = [Table("a.csv", without(recorded(), 8.5, 10.5, False)), Table("b.csv", recorded())]
    spec = nominal_of({**AXIS, "data": {"time": "t", "heldout": ["a.csv"]}})
    _, problem, _ = prepare(spec, tables)
    assert {s.recording.name: bool(s.heldout.any()) for s in problem.segments} == {
        "a.csv": True,
        "a.csv (2)": True,
        "b.csv": False,
    }


def test_a_part_of_few_samples_is_left_out() -> None:
    columns = without(without(recorded(), 8.5, 10.0, False), 10.2, 11.0, False)
    _, problem, _ = prepare(nominal_of(AXIS), [Table("r.csv", columns)])
    assert [float(s.recording.time_s[0]) for s in problem.segments] == pytest.approx([0.0, 11.0], abs=2.0 * DT)


def test_a_gap_of_days_needs_no_memory() -> None:
    columns = recorded()
    later = {**columns, "t": np.where(T < 10.0, T, T + 1e9)}
    _, problem, _ = prepare(nominal_of(AXIS), [Table("r.csv", later)])
    first, second = (segment.recording for segment in problem.segments)
    assert (first.n, second.n) == pytest.approx((1000, 1000), abs=2)
    assert second.time_s[0] == pytest.approx(10.0 + 1e9, abs=2 * DT)
    at = np.searchsorted(T + 1e9, second.time_s[1:] + first.begin_s)
    assert np.allclose(second.channels["position"][1:], columns["x"][np.minimum(at, 1999)], atol=2e-3 * np.ptp(columns["x"]))
