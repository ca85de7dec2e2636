"""The faults of the campaign: what each is, how bad it may be drawn, how it is put in, and what must come of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import msgspec
import numpy as np

from protocol.topics import ForceEstimate
from realtime.control.codes import SOURCE_ESTIMATE
from sim.fault_run import MS, FaultyScenario
from sim.sensor_faults import SensorFault

Rng = np.random.Generator
Inject = Callable[[FaultyScenario, float, float], None]

# The limits that hold for every fault: true force, and rest after a lost link.
PEAK_N, LINK_REST_S = 0.55, 0.050
# Steps of a rotor behind its field that have to be noticed: 0.5 mm of insertion, 4.5 degrees of handle or knob.
STEPS_TO_FIND = 160
KNOB = 2
PHASES = ("approach", "contact", "hold")


@dataclass(frozen=True)
class FaultKind:
    """A row of the table.

    size: least and greatest of what is drawn (log-uniform where both have one sign), in `unit`; seconds: how long it
    lasts, drawn alike; inject(run, size, seconds) puts it in at once. must_detect(size, seconds): whether it has to be
    noticed within `within_s`; or, where what is drawn does not say how bad it gets, large(run): whether it is so bad by
    now that it has to be noticed `within_s` from here. rest_s: the stages must be at rest so long after a fault of the
    link, 0: no such demand. stops: it must end with the rig stopped (by the loop or by the board).
    """

    name: str
    says: str
    inject: Inject
    size: tuple[float, float] = (1.0, 1.0)
    unit: str = ""
    seconds: tuple[float, float] = (0.2, 1.0)
    within_s: float = 0.2
    must_detect: Callable[[float, float], bool] = lambda size, seconds: True
    large: Callable[[FaultyScenario], bool] | None = None
    rest_s: float = 0.0
    stops: bool = False
    tail_s: float = 0.6

    def draw(self, rng: Rng) -> tuple[float, float]:
        """Draw a size and a duration (s)."""
        return _drawn(rng, self.size), _drawn(rng, self.seconds)


def _drawn(rng: Rng, limits: tuple[float, float]) -> float:
    low, high = limits
    if low * high > 0:
        sign = math.copysign(1.0, low)
        least, most = sorted((math.log(abs(low)), math.log(abs(high))))
        return float(sign * np.exp(rng.uniform(least, most)))
    return float(rng.uniform(low, high))


def _span(run: FaultyScenario, seconds: float) -> tuple[int, int]:
    return run.now_ns, run.now_ns + round(seconds * 1e9)


def _on_line(kind: str) -> Inject:
    return lambda run, size, seconds: run.noise.add(SensorFault(kind, *_span(run, seconds), value=size))


def _on_tracker(kind: str) -> Inject:
    def inject(run: FaultyScenario, size: float, seconds: float) -> None:
        run.world.tracker.faults.append(SensorFault(kind, *_span(run, seconds), value=size))

    return inject


def _on_force(kind: str) -> Inject:
    def inject(run: FaultyScenario, size: float, seconds: float) -> None:
        run.world.force_box.faults.append(SensorFault(kind, *_span(run, seconds), value=size))

    return inject


def _on_board(what: str) -> Inject:
    return lambda run, size, seconds: getattr(run.world.board, what)()


def _axis(size: float) -> int:
    """An axis out of a drawn size: its whole part modulo three, so that one number says both."""
    return int(abs(size)) % 3


def _jam(run: FaultyScenario, size: float, seconds: float) -> None:
    run.world.stages.jam(_axis(size), size, seconds)


def _slip(run: FaultyScenario, size: float, seconds: float) -> None:
    """The load turns a rotor at the stage's full speed; the bent catheter its knob until it is straight."""
    axis, stages = _axis(size), run.world.stages
    stage = run.loop.rig.stage(axis)
    if axis == KNOB:
        bent_steps = stages.position[KNOB] * stage.steps_per_unit
        size = math.copysign(min(abs(size), abs(bent_steps)), bent_steps)
    stages.slip(axis, size, seconds, stage.max_speed_unit_per_s)


def _steps_apart(run: FaultyScenario) -> bool:
    return bool(np.abs(run.world.stages.lost_steps).max() > STEPS_TO_FIND)


def _sensor_off(run: FaultyScenario) -> bool:
    """Whether the sensor is wrong by more than three standard deviations that the estimate states."""
    truth_N, witness = float(np.linalg.norm(run.world.plant.contact_force_N)), run.loop.state[0].witness
    return abs(truth_N - witness.sensor_N) > max(3.0 * witness.estimate_sd_N, 0.15)


def _estimate_off(run: FaultyScenario) -> bool:
    """Whether the estimate that may close the loop is wrong by more than four of its standard deviations."""
    truth_N, force = float(np.linalg.norm(run.world.plant.contact_force_N)), run.loop.state[0].force
    sd_N = math.sqrt(max(force.noise_N2, force.nominal_noise_N2))
    return abs(truth_N - force.normal_N[SOURCE_ESTIMATE]) > max(4.0 * sd_N, 0.2)


def _on_estimate(*forces: str) -> Inject:
    def inject(run: FaultyScenario, size: float, seconds: float) -> None:
        def wrong(estimate: ForceEstimate) -> ForceEstimate:
            return msgspec.structs.replace(estimate, **{name: _scaled(getattr(estimate, name), size) for name in forces})

        run.wrong = wrong

    return inject


def _scaled(force_N: tuple[float, ...] | None, size: float) -> tuple[float, ...] | None:
    return None if force_N is None else tuple(size * component for component in force_N)


def _force_turned(run: FaultyScenario, size: float, seconds: float) -> None:
    """Swap two axes of the sensor: along the catheter with one across it."""
    read, across = run.world.plant.measured_wrench, _axis(size) % 2
    order = [2, 1, 0] if across == 0 else [0, 2, 1]

    def turned() -> tuple[np.ndarray, np.ndarray]:
        force_N, torque_Nm = read()
        return force_N[order], torque_Nm[order]

    run.world.plant.measured_wrench = turned  # type: ignore[method-assign]


def _tracker_moved(axis: int) -> Inject:
    """Displace the field generator along an axis of the base frame within `seconds`: every pose is off by `size`."""

    def inject(run: FaultyScenario, size: float, seconds: float) -> None:
        tracker, plant = run.world._tracker_shift_m, run.world.plant
        step, start_m, begin_s = plant.step, float(tracker[axis]), plant.time_s

        def moving(dt_s: float, stage_position: np.ndarray) -> None:
            tracker[axis] = start_m + size * min((plant.time_s - begin_s) / seconds, 1.0)
            step(dt_s, stage_position)

        plant.step = moving  # type: ignore[method-assign, assignment]

    return inject


def _wall_nearer(run: FaultyScenario, size: float, seconds: float) -> None:
    """Move the whole wall by `size` towards the catheter's base within `seconds`, as a patient who moves does."""
    plant = run.world.plant
    step, start_m, begin_s = plant.step, float(plant._wall_point[2]), plant.time_s

    def moving(dt_s: float, stage_position: np.ndarray) -> None:
        share = min((plant.time_s - begin_s) / seconds, 1.0)
        plant._wall_point[2] = start_m - size * share
        step(dt_s, stage_position)

    plant.step = moving  # type: ignore[method-assign, assignment]


def _host(state: str) -> Inject:
    def inject(run: FaultyScenario, size: float, seconds: float) -> None:
        run.host = state

    return inject


def _host_late(run: FaultyScenario, size: float, seconds: float) -> None:
    run.host_late_ns = round(size * 1e9)


def _pause(run: FaultyScenario, size: float, seconds: float) -> None:
    run.pause_ns = round(size * 1e3) * MS


def _clock(run: FaultyScenario, size: float, seconds: float) -> None:
    run.clock_shift_ns += round(size * 1e9)


def _none(run: FaultyScenario, size: float, seconds: float) -> None:
    """The control of the experiment: nothing is wrong, and nothing may be found."""


def _long(least_s: float) -> Callable[[float, float], bool]:
    return lambda size, seconds: seconds >= least_s


def _never(size: float, seconds: float) -> bool:
    return False


def _displaced(size: float, seconds: float) -> bool:
    """Whether the tracker was displaced by more than a catheter's usual motion in the time of a push."""
    return abs(size) > 0.005


_BIT = "share of bits"
_CHANCE = "chance per frame"

FAULTS: tuple[FaultKind, ...] = (
    FaultKind("none", "no fault: any detection is a false alarm", _none, must_detect=_never),
    FaultKind(
        "serial_bit_errors",
        "bits flipped on the board's line, both ways",
        _on_line("bit_errors"),
        (1e-6, 1e-2),
        _BIT,
        within_s=0.1,
        must_detect=lambda size, seconds: size * seconds * 3e5 > 20,
    ),
    FaultKind(
        "frames_dropped",
        "frames lost on the board's line, both ways",
        _on_line("drop"),
        (0.02, 1.0),
        _CHANCE,
        must_detect=lambda size, seconds: size > 0.05,
    ),
    FaultKind(
        "frames_duplicated",
        "frames that arrive twice",
        _on_line("duplicate"),
        (0.02, 1.0),
        _CHANCE,
        must_detect=lambda size, seconds: size > 0.05,
    ),
    FaultKind(
        "frames_reordered",
        "frames overtaken by the next",
        _on_line("reorder"),
        (0.02, 1.0),
        _CHANCE,
        must_detect=lambda size, seconds: size > 0.05,
    ),
    FaultKind(
        "link_cut",
        "the board's cable unplugged, permanently",
        _on_line("cut"),
        seconds=(1.0, 1.0),
        tail_s=0.0,
        rest_s=LINK_REST_S,
        stops=True,
        within_s=0.1,
    ),
    FaultKind(
        "link_interrupted",
        "the board's cable unplugged for a moment",
        _on_line("cut"),
        seconds=(0.005, 0.5),
        must_detect=_long(0.012),
    ),
    FaultKind("mcu_reset", "the board's reset pin pulled", _on_board("reset"), stops=True, rest_s=LINK_REST_S),
    FaultKind(
        "power_cycle", "the board's supply lost during a motion", _on_board("power_cycle"), stops=True, rest_s=LINK_REST_S
    ),
    FaultKind(
        "mcu_hang",
        "the board's processor hangs until its watchdog acts",
        _on_board("freeze"),
        stops=True,
        rest_s=LINK_REST_S,
    ),
    FaultKind(
        "encoder_loss",
        "one encoder unplugged: its count does not change",
        lambda run, size, seconds: run.world.stages.unplug_encoder(_axis(size)),
        (1.0, 3.99),
        "axis",
        must_detect=_never,
        seconds=(1.0, 1.0),
    ),
    FaultKind(
        "missed_steps",
        "a jam: one rotor does not move, and commanded steps are lost",
        _jam,
        (20.0, 2000.0),
        "steps at most",
        seconds=(0.05, 1.0),
        within_s=0.1,
        large=_steps_apart,
    ),
    FaultKind(
        "slipped_steps",
        "motor too weak or its supply sags: the load turns one rotor, at its full speed",
        _slip,
        (-2000.0, 2000.0),
        "steps at most",
        seconds=(0.05, 1.0),
        within_s=0.1,
        large=_steps_apart,
    ),
    FaultKind(
        "tracker_dropout",
        "tools missing for some time",
        _on_tracker("missing"),
        seconds=(0.01, 5.0),
        must_detect=_long(0.03),
        within_s=0.12,
    ),
    FaultKind("tracker_silent", "tracker unplugged", _on_tracker("silent"), seconds=(0.1, 2.0)),
    FaultKind(
        "tracker_bit_errors",
        "bits flipped on the tracker's line",
        _on_tracker("bit_errors"),
        (1e-6, 1e-2),
        _BIT,
        must_detect=lambda size, seconds: size * seconds * 2e5 > 20,
    ),
    FaultKind(
        "wild_poses",
        "poses scattered about the true one",
        _on_tracker("wild"),
        (0.005, 0.2),
        "m",
        must_detect=lambda size, seconds: size > 0.03 and seconds > 0.1,
        within_s=0.15,
    ),
    FaultKind(
        "frozen_poses",
        "the same pose with new frame numbers",
        _on_tracker("frozen"),
        seconds=(0.3, 1.5),
        within_s=0.35,
        must_detect=_long(0.3),
    ),
    FaultKind(
        "tracker_stuck", "frame counter and pose do not change", _on_tracker("stuck"), seconds=(0.2, 1.5), within_s=0.35
    ),
    FaultKind(
        "force_drift",
        "the force sensor's zero drifts, either way",
        _on_force("drift"),
        (-0.3, 0.3),
        "N/s",
        tail_s=0.1,
        seconds=(2.0, 5.0),
        must_detect=lambda size, seconds: abs(size) * seconds > 0.5,
        within_s=5.0,
    ),
    FaultKind(
        "force_scaled",
        "the force sensor reads this times the true force: dead, too little, or reversed",
        _on_force("scale"),
        (-1.0, 0.6),
        "times",
        seconds=(1.5, 1.5),
        within_s=0.6,
        must_detect=_never,
        large=_sensor_off,
    ),
    FaultKind(
        "force_offset",
        "the force sensor reads so much more along its axis",
        _on_force("offset"),
        (-0.3, 0.3),
        "N",
        seconds=(1.5, 1.5),
        within_s=0.6,
        must_detect=lambda size, seconds: abs(size) > 0.2,
    ),
    FaultKind(
        "estimate_scaled",
        "the model process answers this times its estimate: zero, or the wrong sign",
        _on_estimate("force_N", "nominal_force_N"),
        (-1.0, 0.3),
        "times",
        seconds=(1.5, 1.5),
        within_s=0.6,
        must_detect=_never,
        large=_estimate_off,
    ),
    FaultKind(
        "adapted_scaled",
        "the same, of the force by the adapted stiffness alone",
        _on_estimate("force_N"),
        (-1.0, 0.3),
        "times",
        seconds=(1.5, 1.5),
        within_s=0.6,
        must_detect=_never,
        large=_estimate_off,
    ),
    FaultKind(
        "force_turned",
        "two axes of the force sensor swapped",
        _force_turned,
        (0.0, 1.99),
        "axis",
        seconds=(1.5, 1.5),
        within_s=0.6,
        must_detect=_never,
        large=_sensor_off,
    ),
    FaultKind(
        "tracker_moved",
        "the field generator is displaced along the catheter: all poses are off by so much",
        _tracker_moved(2),
        (-0.02, 0.02),
        "m",
        seconds=(0.001, 0.3),
        must_detect=_displaced,
        within_s=0.6,
        tail_s=1.5,
    ),
    FaultKind(
        "tracker_moved_aside",
        "the field generator is displaced across the catheter",
        _tracker_moved(0),
        (-0.02, 0.02),
        "m",
        seconds=(0.001, 0.3),
        must_detect=_displaced,
        within_s=0.6,
        tail_s=1.5,
    ),
    FaultKind(
        "wall_nearer",
        "the patient moves: the whole wall comes nearer",
        _wall_nearer,
        (0.001, 0.004),
        "m",
        seconds=(0.2, 1.0),
        must_detect=_never,
        tail_s=1.0,
    ),
    FaultKind("force_saturated", "the gauges at their limit", _on_force("saturated")),
    FaultKind("force_unplugged", "no record of the force sensor", _on_force("silent")),
    FaultKind("force_frozen", "the same reading with new sequence numbers", _on_force("frozen")),
    FaultKind("host_killed", "the model process was killed", _host("dead"), seconds=(0.5, 0.5), within_s=0.35),
    FaultKind(
        "host_slow",
        "the model process answers late",
        _host_late,
        (0.02, 0.6),
        "s",
        seconds=(0.8, 0.8),
        within_s=0.8,
        must_detect=lambda size, seconds: size > 0.25,
    ),
    FaultKind(
        "computer_paused",
        "the realtime process is paused; the rig is not",
        _pause,
        (0.005, 0.5),
        "s",
        must_detect=lambda size, seconds: size > 0.004,
        within_s=0.51,
    ),
    FaultKind("disk_full", "no room for the recording", _none, seconds=(1.5, 1.5), within_s=1.5),
    FaultKind("clock_step_forward", "the computer's clock jumps ahead", _clock, (0.01, 10.0), "s"),
    FaultKind("clock_step_back", "the computer's clock jumps back", _clock, (-10.0, -0.01), "s"),
    FaultKind("flood_in", "board and force sensor send everything ten times", _on_line("flood_in"), (10.0, 10.0), "times"),
    FaultKind(
        "flood_out",
        "every frame to the board sent ten times: more than its line carries",
        _on_line("flood_out"),
        (10.0, 10.0),
        "times",
        seconds=(0.1, 0.6),
    ),
)
BY_NAME = {fault.name: fault for fault in FAULTS}
