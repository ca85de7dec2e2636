"""The knob that bends the shaft in spite of the pull-wire's friction, against the simulator's wire."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from protocol.catheter import CATHETER_FOLDER
from protocol.rig_file import SIMULATED_RIG, parse_rig, read_rig_data
from realtime.control import wire_friction
from realtime.control.configure import tick_parameters
from realtime.control.inverse_kinematics import curvature_of_knob
from realtime.control.records import STATE, new
from sim import knob
from sim.catheter_chain import CATHETERS

FRICTION, TURNING_rad = 0.15, 1.0
CATHETER = "blazer_prime_xp"
# Out, back past the straight shaft, and small to and fro about a bend.
PATH_rad = np.concatenate(
    [np.linspace(a, b, 800) for a, b in ((0.1, 0.9), (0.9, 0.4), (0.4, 0.7), (0.7, -0.8), (-0.8, -0.3), (-0.3, -0.6))]
)


@pytest.fixture
def params(tmp_path: Path) -> np.record:
    """Parameters of a rig whose catheter file has a wire that rubs."""
    path = tmp_path / "rubbing.toml"
    text = (CATHETER_FOLDER / f"{CATHETER}.toml").read_text(encoding="utf-8")
    terms = f"friction_coefficient = {FRICTION}\ncubic_stiffening_m2 = 0.0"
    path.write_text(f"{text}\n[constitutive]\n{terms}\n", encoding="utf-8")
    data = read_rig_data(SIMULATED_RIG)
    data["catheter"]["name"] = data["transmission"]["catheter"] = str(path)
    data["transmission"]["wire_turning_rad"] = TURNING_rad
    return tick_parameters(parse_rig(data))[0]


def bent(handle_rad: np.ndarray) -> np.ndarray:
    """Curvature (1/m) of the simulated shaft along a history of knob angles."""
    config = knob.KnobConfig(wire_stiffness_N_per_m=3500.0, wire_friction=FRICTION, wire_turning_rad=TURNING_rad)
    parameters, state = knob.parameters(config, CATHETERS[CATHETER]), knob.start()
    return np.array([knob.pull(parameters, state, angle) for angle in handle_rad])


def test_the_shaft_bends_as_requested_in_spite_of_friction(params: np.record) -> None:
    state = new(STATE)[0].wire
    wire_friction.start(params.kinematics, state, PATH_rad[0])
    handle = np.zeros(len(PATH_rad))
    for i, angle in enumerate(PATH_rad):
        handle[i] = wire_friction.apply(params.wire, params.kinematics, state, angle)
        wire_friction.follow(params.wire, params.kinematics, state, handle[i])
    wanted = np.array([curvature_of_knob(params.kinematics, angle) for angle in PATH_rad])
    without = float(np.sqrt(np.mean((bent(PATH_rad) - wanted) ** 2)))
    with_it = float(np.sqrt(np.mean((bent(handle) - wanted) ** 2)))
    assert without > 1.5, "friction has to show for the comparison to mean something"
    assert with_it < 0.25 * without


def test_the_bend_of_the_shaft_is_predicted(params: np.record) -> None:
    state = new(STATE)[0].wire
    wire_friction.start(params.kinematics, state, PATH_rad[0])
    joint = np.array([wire_friction.follow(params.wire, params.kinematics, state, angle) for angle in PATH_rad])
    predicted = np.array([curvature_of_knob(params.kinematics, angle) for angle in joint])
    nominal = np.array([curvature_of_knob(params.kinematics, angle) for angle in PATH_rad])
    true = bent(PATH_rad)
    assert np.sqrt(np.mean((predicted - true) ** 2)) < 0.3 * np.sqrt(np.mean((nominal - true) ** 2))


def test_a_shaft_that_got_there_is_predicted_there(params: np.record) -> None:
    """Inverse and prediction agree on the edges of the band, in both directions."""
    state = new(STATE)[0].wire
    wire_friction.start(params.kinematics, state, PATH_rad[0])
    errors = []
    for angle in PATH_rad:
        handle = wire_friction.apply(params.wire, params.kinematics, state, angle)
        errors.append(wire_friction.follow(params.wire, params.kinematics, state, handle) - angle)
    assert np.quantile(np.abs(errors), 0.95) < 0.02


def test_noise_does_not_send_the_knob_through_the_band(params: np.record) -> None:
    state, rng = new(STATE)[0].wire, np.random.default_rng(3)
    wire_friction.start(params.kinematics, state, 0.7)
    handle = []
    for angle in 0.7 + 1e-3 * rng.standard_normal(300):
        handle.append(wire_friction.apply(params.wire, params.kinematics, state, angle))
        wire_friction.follow(params.wire, params.kinematics, state, handle[-1])
    assert np.ptp(handle) < 0.02


def test_without_friction_nothing_changes() -> None:
    params = tick_parameters(parse_rig(read_rig_data(SIMULATED_RIG)))[0]
    state = new(STATE)[0].wire
    for angle in PATH_rad:
        assert wire_friction.apply(params.wire, params.kinematics, state, angle) == angle
        assert wire_friction.follow(params.wire, params.kinematics, state, angle) == angle
