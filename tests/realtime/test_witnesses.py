"""Sensor, estimate and geometry compared: what agrees raises nothing, one that is wrong is named, none presses unseen."""

from __future__ import annotations

import math

import numpy as np
import pytest

from protocol.rig_file import SIMULATED_RIG, load_rig
from realtime.control import free_tip, witnesses
from realtime.control.codes import PHASE_APPROACH, PHASE_CONTACT, PHASE_HOLD, SOURCE_ESTIMATE, SOURCE_SENSOR
from realtime.control.configure import tick_parameters
from realtime.control.records import INPUTS, STATE, new
from realtime.core.telemetry import witness_text

MS = 1_000_000
SD_N = 0.05


class Witnesses:
    """The block with a reading of the sensor each millisecond and an estimate each 25 ms."""

    def __init__(self) -> None:
        self.params, self.state, self.inputs = tick_parameters(load_rig(SIMULATED_RIG))[0], new(STATE)[0], new(INPUTS)[0]
        witnesses.start(self.state.witness)
        self.rng = np.random.default_rng(4)
        self.phase = PHASE_CONTACT

    def run(self, seconds: float, sensor_N: float, estimate_N: float, adapted: float = 1.0) -> int:
        """Return the greatest answer of `disagree` over a time with these forces, in noise."""
        worst, force, inputs = 0, self.state.force, self.inputs
        for _ in range(round(seconds * 1000)):
            inputs.now_ns += MS
            inputs.sensor.arrival_ns = inputs.now_ns
            force.normal_N[SOURCE_SENSOR] = sensor_N + 0.003 * self.rng.normal()
            force.reading_N[:] = (0.0, 0.0, sensor_N)
            force.arrival_ns[SOURCE_SENSOR] = inputs.now_ns
            new_estimate = inputs.now_ns % (25 * MS) == 0
            if new_estimate:
                force.nominal_N = estimate_N + SD_N * self.rng.normal()
                force.normal_N[SOURCE_ESTIMATE] = adapted * force.nominal_N
                force.noise_N2, force.nominal_noise_N2 = (adapted * SD_N) ** 2, SD_N**2
                force.estimate_stamp_ns = inputs.now_ns - 30 * MS
                force.sensor_then = sensor_N
                force.arrival_ns[SOURCE_ESTIMATE] = inputs.estimate.arrival_ns = inputs.now_ns
            force.new[SOURCE_SENSOR], force.new[SOURCE_ESTIMATE] = 1, new_estimate
            witnesses.take_forces(self.state.witness, force, 1e-3)
            worst = max(worst, witnesses.disagree(self.params, self.state.witness, inputs, self.phase))
        return worst


def test_a_tip_that_is_held_back_in_an_approach_without_a_force_makes_the_loop_hold_and_then_retract() -> None:
    """Both sources may be wrong at once: a sensor with two axes swapped, and estimates that come late."""
    rig = Witnesses()
    rig.phase = PHASE_APPROACH
    rig.state.witness.geometry_N = 0.2  # 2 mm behind the free tip
    assert rig.run(1.0, 0.0, 0.0) == 0
    rig.state.witness.geometry_N = 0.5
    assert rig.run(0.25, 0.0, 0.0) == 1
    assert rig.run(0.1, 0.0, 0.0) == 2
    rig.phase = PHASE_CONTACT  # a loop that feels its contact knows why
    assert rig.run(0.5, 0.2, 0.2) == 0


def test_readings_that_agree_within_noise_never_differ() -> None:
    assert Witnesses().run(15.0, 0.2, 0.22) == 0


@pytest.mark.parametrize(
    ("sensor_N", "estimate_N"), [(0.0, 0.2), (0.2, 0.0), (0.2, -0.2), (0.2, 0.5), (0.25, 0.0), (-0.2, 0.2)]
)
def test_one_that_is_wrong_makes_the_loop_hold_and_then_retract(sensor_N: float, estimate_N: float) -> None:
    rig = Witnesses()
    rig.run(1.0, 0.0, 0.0)
    assert rig.run(0.25, sensor_N, estimate_N) == 1
    assert rig.run(0.5, sensor_N, estimate_N) == 2


def test_without_one_of_them_nothing_is_compared() -> None:
    rig = Witnesses()
    rig.run(0.5, 0.0, 0.3)
    rig.inputs.now_ns += 300 * MS
    assert witnesses.disagree(rig.params, rig.state.witness, rig.inputs, PHASE_CONTACT) == 0


@pytest.mark.parametrize(("sensor_N", "estimate_N", "geometry_N"), [(0.51, 0.0, 0.0), (0.0, 0.7, 0.0), (0.0, 0.0, 2.6)])
def test_each_witness_alone_proves_too_much_force(sensor_N: float, estimate_N: float, geometry_N: float) -> None:
    rig = Witnesses()
    rig.run(1.0, sensor_N, estimate_N)
    rig.state.witness.geometry_N = geometry_N
    assert witnesses.over(rig.params, rig.state.witness, rig.state.force, rig.inputs)


@pytest.mark.parametrize("adapted", [0.7, 0.8, 1.25, 1.3])
def test_an_adapted_stiffness_hides_nothing_from_the_witnesses(adapted: float) -> None:
    """What is found without adaptation is found with it, at the same forces; a stiffer catheter adds too much force."""
    for sensor_N, estimate_N in ((0.2, 0.0), (0.0, 0.2), (0.2, 0.5)):
        rig = Witnesses()
        rig.run(1.0, 0.0, 0.0, adapted)
        assert rig.run(0.75, sensor_N, estimate_N, adapted) == 2
    for estimate_N, without in ((0.7, True), (0.55, False)):
        rig = Witnesses()
        rig.run(1.0, 0.0, estimate_N, adapted)
        found = witnesses.over(rig.params, rig.state.witness, rig.state.force, rig.inputs)
        assert found or not without
        if adapted * estimate_N > 0.66:
            assert found


@pytest.mark.parametrize("adapted", [-1.0, 0.0, 0.3])
def test_a_wrong_adapted_force_is_compared_with_the_sensor_too(adapted: float) -> None:
    rig = Witnesses()
    rig.run(1.0, 0.2, 0.2)
    assert rig.run(0.75, 0.2, 0.2, adapted) == 2


@pytest.mark.parametrize(
    ("sensor_N", "estimate_N", "retracts"),
    [(0.2, 0.2, True), (0.0, 0.35, True), (0.2, 0.0, True), (0.1, 0.1, False), (0.0, 0.0, False)],
)
def test_a_stopped_catheter_is_pressed_by_the_word_of_one_witness(
    sensor_N: float, estimate_N: float, retracts: bool
) -> None:
    """A dead sensor must not leave a stopped catheter to a wall that comes nearer."""
    rig = Witnesses()
    rig.run(1.0, sensor_N, estimate_N)
    found = [witnesses.standing(rig.params, rig.state.witness, rig.inputs, 1e-3) for _ in range(20)]
    assert found[-1] == retracts and not found[0]


def test_what_is_below_the_limit_is_not_too_much() -> None:
    rig = Witnesses()
    rig.run(5.0, 0.45, 0.45)
    assert not witnesses.over(rig.params, rig.state.witness, rig.state.force, rig.inputs)


def test_the_text_names_the_witness_that_is_wrong() -> None:
    assert witness_text(np.array([0.0, 0.21, 0.18])).endswith("the force sensor disagrees with both others")
    assert witness_text(np.array([0.2, 0.0, 0.22])).endswith("the estimate disagrees with both others")
    assert "disagrees" not in witness_text(np.array([0.2, 0.21, 0.1]))


@pytest.mark.parametrize("felt", [False, True])
def test_a_turn_about_the_axis_is_a_deflection_only_while_no_force_is_felt(felt: bool) -> None:
    """A tip that a tilted wall turned by 0.7 rad about the axis stays 4 mm behind along the normal, by 0.4 N of bending."""
    rig = Witnesses()
    joint, normal = (-0.075, 0.2, 0.8), (0.5, 0.0, -math.sqrt(0.75))
    turned_m = free_tip.apply(rig.params.kinematics, (joint[0], joint[1] + 0.7, joint[2]))
    for phase, tip_m in ((PHASE_HOLD, free_tip.apply(rig.params.kinematics, joint)), (PHASE_APPROACH, turned_m)):
        for _ in range(60):
            rig.inputs.tip.stamp_ns += 25 * MS
            rig.inputs.tip.position_m[:] = tip_m
            witnesses.take_pose(rig.params, rig.state.witness, rig.inputs, joint, np.array(normal), phase, felt)
    geometry_N = rig.state.witness.geometry_N
    assert geometry_N < 0.02 if felt else geometry_N > 0.3
