"""Pull-wire friction: the loop it makes, its capstan width, what it dissipates, and that it vanishes with friction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from host.mechanics import pcar
from host.mechanics.constitutive import FrictionalWire, hysteresis_loop, stick_or_slip
from protocol.catheter import Catheter, ConstitutiveParameters, load_catheter

UP, DOWN = np.linspace(0.0, 6.0, 25), np.linspace(6.0, 0.0, 25)[1:]
CYCLES = np.concatenate([UP, DOWN, UP[1:], DOWN])


def rubbing(friction: float, stiffening_m2: float = 0.0) -> Catheter:
    return replace(load_catheter("steerocath_t"), constitutive=ConstitutiveParameters(friction, stiffening_m2))


def test_without_friction_the_curvature_is_tension_times_offset_over_stiffness() -> None:
    catheter = rubbing(0.0)
    angle, tension = hysteresis_loop(catheter, 0.0, CYCLES)
    assert catheter.pcar is not None
    expected = CYCLES * catheter.pull_wire_offset_m / catheter.pcar.EI_N_m2[1] * catheter.distal_length_m
    assert np.allclose(angle, expected, rtol=1e-9, atol=1e-12) and np.allclose(tension, CYCLES, rtol=1e-12)


def test_friction_makes_a_closed_loop_of_the_capstan_width() -> None:
    friction, body = 0.15, 1.0
    angle, tension = hysteresis_loop(rubbing(friction), 0.0, CYCLES, body_turning_rad=body)
    first, second = slice(0, 49), slice(48, 97)
    assert np.allclose(angle[first], angle[second], atol=1e-8)  # the loop closes and repeats
    up, down = 12, 36  # 3 N on the way up and on the way down
    assert CYCLES[up] == CYCLES[down] == pytest.approx(3.0)
    assert angle[down] > angle[up] + 0.1
    assert tension[up] < 3.0 * np.exp(-friction * body) and tension[down] > 3.0 * np.exp(friction * body)
    work = float(np.trapezoid(CYCLES[first], angle[first]))  # the wire's pull against the bending
    assert work > 0.05


def test_small_reversals_are_swallowed() -> None:
    history = np.concatenate([UP, [5.9, 5.8, 5.9, 6.0]])
    angle, _ = hysteresis_loop(rubbing(0.15), 0.0, history, body_turning_rad=1.0)
    assert np.ptp(angle[-5:]) < 1e-9


def test_loop_widens_with_friction_and_with_the_bend_of_the_body() -> None:
    def width(friction: float, body: float) -> float:
        angle, _ = hysteresis_loop(rubbing(friction), 0.0, CYCLES[:49], body_turning_rad=body)
        return float(angle[36] - angle[12])

    assert width(0.0, 1.0) == pytest.approx(0.0, abs=1e-9)
    assert 0.0 < width(0.05, 1.0) < width(0.1, 1.0) < width(0.1, 2.0)


def test_friction_holds_a_shape_that_a_load_has_pushed() -> None:
    wire = FrictionalWire(rubbing(0.2), 0.0, body_turning_rad=1.0)
    before = wire.step(4.0).equilibrium
    loaded = wire.step(4.0, [0.0, -0.05])
    after = wire.step(4.0).equilibrium
    assert loaded.equilibrium.converged and loaded.equilibrium.tip_angle_rad < before.tip_angle_rad
    assert np.allclose(after.tip_position_m, before.tip_position_m, atol=5e-3)


def test_stiffening_bends_the_loop_over() -> None:
    plain, _ = hysteresis_loop(rubbing(0.1), 0.03, CYCLES[:25], force_N=(0.0, -0.1))
    stiff, _ = hysteresis_loop(rubbing(0.1, 5e-3), 0.03, CYCLES[:25], force_N=(0.0, -0.1))
    assert np.abs(stiff - plain).max() > 0.05
    # the load bends the stiffening shaft less far from where the wire wants it
    assert stiff[0] > plain[0]


@given(
    pull=st.floats(0.0, 50.0),
    friction=st.floats(0.0, 1.0),
    turning=st.lists(st.floats(0.0, 3.0), min_size=1, max_size=6),
    kept=st.floats(0.0, 50.0),
)
def test_tension_stays_in_the_capstan_band_and_a_second_step_changes_nothing(
    pull: float, friction: float, turning: list[float], kept: float
) -> None:
    turns, old = np.array(turning), np.full(len(turning), kept)
    result, again = np.empty_like(old), np.empty_like(old)
    stick_or_slip(pull, turns, friction, old, result)
    upstream = np.concatenate([[pull], result[:-1]])
    factor = np.exp(friction * turns)
    assert (result >= upstream / factor * (1.0 - 1e-12)).all() and (result <= upstream * factor * (1.0 + 1e-12)).all()
    stick_or_slip(pull, turns, friction, result, again)
    assert np.allclose(again, result, rtol=1e-12)


def test_bad_input_is_refused() -> None:
    with pytest.raises(ValueError, match="constitutive"):
        FrictionalWire(load_catheter("steerocath_t"), 0.0)
    wire = FrictionalWire(rubbing(0.1), 0.0)
    for tension in (-1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="tension_N"):
            wire.step(tension)
    with pytest.raises(ValueError, match="body_turning_rad"):
        FrictionalWire(rubbing(0.1), 0.0, body_turning_rad=np.nan)
    assert isinstance(wire.step(1.0).equilibrium, pcar.Equilibrium)
