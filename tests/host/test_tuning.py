"""Tuning: the criterion (7.4), the margin, and gains that ring refused; on the tick and the plant."""

import numpy as np
import pytest

from host.commissioning.tuning import (
    FAILED_N,
    GAINS,
    cost_of,
    criterion,
    response,
    stability_margin,
    still_wall,
    tune,
    with_gains,
)
from protocol.enums import Phase
from protocol.errors import InputError
from protocol.rig_file import SIMULATED_RIG, Rig, load_rig
from sim.ideal_rig import IdealRig, IdealTrace


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig(SIMULATED_RIG)


def present(rig: Rig) -> dict[str, float]:
    return {name: float(getattr(rig.control, name)) for name in GAINS}


def flat(force_N: float, phase: int, n: int = 1000) -> IdealTrace:
    return IdealTrace(
        np.arange(n) * 1e-3, np.full(n, force_N), np.zeros((n, 3)), np.zeros(n), np.zeros((n, 3)), np.full(n, phase)
    )


def test_the_cost_is_the_mean_absolute_error_and_lost_contact_is_dear() -> None:
    assert cost_of(flat(0.15, Phase.CONTACT), 0.2, 1.0) == pytest.approx(0.05)
    assert cost_of(flat(0.15, Phase.CONTACT, 500), 0.2, 1.0) == pytest.approx(0.025 + 0.5 * FAILED_N, abs=2e-3)
    assert cost_of(flat(0.15, Phase.APPROACH), 0.2, 1.0) == pytest.approx(FAILED_N)


def test_the_ideal_rig_touches_and_holds_and_repeats_itself(rig: Rig) -> None:
    first, again = (response(rig, 0.2, 1.0, seed=3) for _ in range(2))
    assert first.time_s.size == 1000 and np.all(first.phase == Phase.CONTACT)
    assert np.array_equal(first.force_N, again.force_N)
    assert 0.02 < first.force_N[-1] < 0.35
    assert not np.array_equal(first.force_N, response(rig, 0.2, 1.0, seed=4).force_N)


def test_the_tip_goes_where_it_is_told(rig: Rig) -> None:
    bench = IdealRig(rig, still_wall(rig, clearance_m=0.010), 1)
    goal = bench.plant.sensor_pose(0.0)[0] + np.array([0.0, 0.002, 0.002])
    trace = bench.go(goal, 3.0)
    assert np.linalg.norm(trace.tip_m[-1] - goal) < 1.5e-3


def test_gains_out_of_bounds_or_unstable_at_the_rate_are_refused(rig: Rig) -> None:
    with pytest.raises(InputError, match=r"control.position_gain_per_s"):
        with_gains(rig, {"position_gain_per_s": 1e4})
    with pytest.raises(InputError, match="no such key"):
        with_gains(rig, {"no_such_gain": 1.0})
    with pytest.raises(ValueError, match=r"^gains: found a loop that rings at 1000 Hz"):
        stability_margin(rig, {**present(rig), "position_gain_per_s": 45.0, "force_gain_m_per_N": 0.09})


def test_present_gains_have_a_margin(rig: Rig) -> None:
    margin = stability_margin(rig, present(rig), steps=2)
    assert margin.gain_factor > 1.3 and margin.delay_s > 0.003


@pytest.mark.slow
def test_tuning_finds_no_worse_than_it_was_given(rig: Rig) -> None:
    before = criterion(rig, present(rig), iterations=16)
    names = ("force_gain_m_per_N", "force_integral_m_per_N_s")
    found = tune(rig, names, evaluations=12, processes=1, iterations=16)
    assert [item.method for item in found] == ["simplex", "differential evolution"]
    assert all(set(item.gains) == set(names) for item in found)
    assert min(item.cost_N for item in found) <= before + 1e-9


def test_gains_that_are_not_there_are_refused(rig: Rig) -> None:
    with pytest.raises(ValueError, match=r"gains: found nonsense = None"):
        tune(rig, ("nonsense",))
