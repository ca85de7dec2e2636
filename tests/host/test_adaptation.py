"""Stiffness tracked in free moments: the force error with and without it at 10 % drift, and that contact never moves it."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from host.estimation import planar
from host.estimation.adaptation import AdaptationConfig, StiffnessState, StiffnessTracker, scaled
from host.mechanics import pcar
from protocol.catheter import load_catheter

THERMOCOOL = load_catheter("thermocool_sf")
RATE_HZ, INSERTION_m = 40, 0.04
STD = np.sqrt(np.diag(planar.tip_covariance()))


def run(
    drift: Callable[[float], float], seconds: float = 90.0, force: tuple[float, float] = (-0.1, -0.15), always: bool = False
) -> tuple[NDArray, NDArray, list[StiffnessState]]:
    """A run of 2 s in free space and 4 s on the beating heart in turns, with tracker noise and a true stiffness
    `drift(t)`; force errors in contact without and with adaptation, (k, 2), and the states."""
    rng = np.random.default_rng(0)
    tracker, without, with_it, states = StiffnessTracker(THERMOCOOL), [], [], []
    for i in range(int(seconds * RATE_HZ)):
        t = i / RATE_HZ
        scale, nominal = drift(t), 20.0 + 8.0 * math.sin(t / 3.0)
        contact = always or t % 6.0 >= 2.0
        load = np.array(force) * (1.0 + 0.3 * math.sin(4.0 * math.pi * t)) * contact
        found = pcar.solve(pcar.arcs_of(scaled(THERMOCOOL, scale), INSERTION_m, nominal / scale), load)
        pose = np.array([*found.tip_position_m, found.tip_angle_rad]) + STD * rng.normal(size=3)
        states.append(tracker.update(t, INSERTION_m, nominal, pose))
        if contact and i % 4 == 0 and t > 0.5 * seconds:
            nominal_arcs = pcar.arcs_of(THERMOCOOL, INSERTION_m, nominal)
            adapted = pcar.arcs_of(tracker.adapted(), INSERTION_m, tracker.adapted_curvature(nominal))
            without.append(planar.estimate(nominal_arcs, pose).force_N - load)
            with_it.append(planar.estimate(adapted, pose).force_N - load)
    return np.array(without), np.array(with_it), states


def median(error: NDArray) -> float:
    return float(np.median(np.hypot(*error.T)))


@pytest.mark.slow
def test_ten_percent_drift_costs_the_force_little_with_adaptation() -> None:
    without, with_it, states = run(lambda t: 1.0 - 0.1 * min(1.0, t / 40.0))
    undisturbed, _, _ = run(lambda t: 1.0)
    assert states[-1].scale == pytest.approx(0.9, abs=0.01)
    assert median(without) > 0.05  # tens of millinewtons of bias
    assert median(with_it) < 1.1 * median(undisturbed) < 0.012  # as good as if nothing had drifted
    assert np.abs(np.median(with_it, axis=0)).max() < 0.002


def test_without_drift_the_force_estimate_is_not_disturbed() -> None:
    without, with_it, states = run(lambda t: 1.0)
    assert abs(states[-1].scale - 1.0) < 0.01 and not any(state.changed for state in states)
    assert median(with_it) < 1.03 * median(without)


def test_a_sudden_change_is_detected_once_and_followed() -> None:
    _, with_it, states = run(lambda t: 0.9 if t > 40.0 else 1.0)
    detected = [i / RATE_HZ for i, state in enumerate(states) if state.changed]
    assert len(detected) == 1 and 40.0 < detected[0] < 45.0  # within the next free moment
    assert states[-1].scale == pytest.approx(0.9, abs=0.01)
    assert median(with_it) < 0.012


def test_contact_does_not_move_the_stiffness() -> None:
    for force in ((-0.1, -0.15), (0.0, -0.03), (-0.05, 0.02)):
        _, _, states = run(lambda t: 1.0, seconds=20.0, force=force, always=True)
        assert sum(state.free for state in states) < 0.02 * len(states)
        assert all(abs(state.scale - 1.0) < 0.02 for state in states)
        # what is not measured is known less and less
        assert states[-1].std > states[0].std


def test_curvature_exponent_of_a_stiff_wire() -> None:
    tracker = StiffnessTracker(THERMOCOOL, config=AdaptationConfig(curvature_exponent=0.5))
    true = 0.85
    for i in range(400):
        arcs = pcar.arcs_of(THERMOCOOL, INSERTION_m, 25.0 * true**-0.5)
        position, angle = pcar.point_at(arcs, arcs.unloaded_curvature_per_m, arcs.total_length_m)
        state = tracker.update(i / RATE_HZ, INSERTION_m, 25.0, [*position, angle])
    assert state.scale == pytest.approx(true, rel=0.01)
    assert tracker.adapted_curvature(25.0) == pytest.approx(25.0 * true**-0.5, rel=0.01)


def test_straight_shafts_and_missing_poses_tell_nothing() -> None:
    tracker = StiffnessTracker(THERMOCOOL)
    for i in range(50):
        assert not tracker.update(i / RATE_HZ, INSERTION_m, 0.0, [0.11, 0.0, 0.0]).free
        assert not tracker.update((i + 0.5) / RATE_HZ, INSERTION_m, 20.0, [math.nan, 0.0, 0.0]).free
    with pytest.raises(ValueError, match="time_s"):
        tracker.update(0.0, INSERTION_m, 20.0, [0.1, 0.0, 0.0])


def test_scaling_multiplies_every_stiffness_of_both_models() -> None:
    blazer = load_catheter("blazer_prime_xp")
    half = scaled(blazer, 0.5)
    assert blazer.pcar and half.pcar and blazer.cosserat and half.cosserat
    assert half.pcar.EI_N_m2 == tuple(0.5 * EI for EI in blazer.pcar.EI_N_m2)
    assert vars(half.cosserat) == {key: 0.5 * value for key, value in vars(blazer.cosserat).items()}
    for bad in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="scale"):
            scaled(blazer, bad)
