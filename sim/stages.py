"""The three stages: step edges turn rotors, rotors move lead screw and gears; encoders sit on the rotors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sim.effect_codes import PORTS
from sim.effects import PlantedEffect

Array = np.ndarray
_NONE = np.zeros(3, np.int64)


@dataclass(frozen=True)
class StagesConfig:
    """Three axes in the order insertion, roll, knob; unit m, rad, rad.

    `screw_error_unit` and `screw_pitch_unit`: once-per-turn error of lead screw or gear, which the encoder does not see.
    `rotor_Hz` above 0: the rotor follows its field as a damped spring-mass; 0: at once.
    """

    steps_per_unit: tuple[float, float, float] = (320000.0, 12800.0 / (2.0 * math.pi), 12800.0 / (2.0 * math.pi))
    encoder_counts_per_step: tuple[float, float, float] = (1.0, 1.0, 1.0)
    screw_error_unit: tuple[float, float, float] = (0.0, 0.0, 0.0)
    screw_pitch_unit: tuple[float, float, float] = (0.002, 2.0 * math.pi, 2.0 * math.pi)
    rotor_Hz: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotor_damping_ratio: float = 0.4


@dataclass
class _Trouble:
    """A rotor that does not follow its field until `until_s`, or until it has lost `steps`: `lost` of them so far.

    steps_per_s above 0: it is set back at this speed; 0: it stands.
    """

    axis: int
    steps: float
    until_s: float
    steps_per_s: float = 0.0
    lost: float = 0.0

    def lose(self, dt_s: float, turned: float) -> float:
        """Steps lost in `dt_s`, in which the field turned by `turned` steps."""
        new = self.lost + (math.copysign(self.steps_per_s * dt_s, self.steps) if self.steps_per_s > 0.0 else turned)
        most = abs(self.steps)
        before, self.lost = self.lost, min(max(new, -most), most)
        return self.lost - before

    def over(self, now_s: float) -> bool:
        """Return whether the rotor follows its commands again."""
        return now_s >= self.until_s or abs(self.lost) >= abs(self.steps)


class SimulatedStages:
    """Positions of the stages from step edges; loses steps where an effect `missed_steps`, a jam or a slip says so."""

    def __init__(self, config: StagesConfig | None = None, effects: Sequence[PlantedEffect] = ()) -> None:
        """At step zero, at rest. Of `effects` only missed_steps is used here; the plant takes the others."""
        self.config = config or StagesConfig()
        self._per_unit = np.array(self.config.steps_per_unit)
        self._encoder_ratio = np.array(self.config.encoder_counts_per_step)
        self._screw_error, self._screw_pitch = np.array(self.config.screw_error_unit), np.array(self.config.screw_pitch_unit)
        self._screws_err = bool(self._screw_error.any())
        self._counts = np.zeros(3, np.int64)  # edges seen
        self._lost = np.zeros(3)  # steps that the rotor did not follow
        self._rotor, self._speed = np.zeros(3), np.zeros(3)
        self._time_s = 0.0
        self._encoder_stands: dict[int, int] = {}
        self._troubles: list[_Trouble] = []
        self._losses = [(PORTS.index(e.port), e.start_s, e.says()["parameters"]) for e in effects if e.id == "missed_steps"]
        self._next_loss_s = [start for _, start, _ in self._losses]

    def advance(self, dt_s: float, edge_axis: Array | Sequence[int], edge_sign: Array | Sequence[int]) -> Array:
        """Take the step edges of the last `dt_s` and return the new position (3,) m, rad, rad.

        edge_axis (n,) 0..2; edge_sign (n,) +1 or -1.
        """
        self._time_s += dt_s
        turned = _NONE
        if len(edge_axis):
            signs = np.asarray(edge_sign, float)
            turned = np.rint(np.bincount(np.asarray(edge_axis, np.int64), signs, minlength=3)).astype(np.int64)
            self._counts += turned
        if self._troubles or self._losses:
            self._lose(dt_s, turned)
        field = self._counts - self._lost
        for axis, frequency_Hz in enumerate(self.config.rotor_Hz):
            if frequency_Hz > 0.0:
                self._swing(axis, field[axis], 2.0 * math.pi * frequency_Hz * dt_s)
            else:
                self._rotor[axis] = field[axis]
        return self.position

    def _swing(self, axis: int, field: float, angle: float) -> None:
        """Rotor behind its field over `angle` = natural frequency times step: trapezoidal rule."""
        damping, spring = self.config.rotor_damping_ratio * angle, 0.25 * angle * angle
        speed = self._speed[axis]
        new = (speed * (1.0 - damping - spring) + angle * angle * (field - self._rotor[axis])) / (1.0 + damping + spring)
        self._rotor[axis] += 0.5 * (speed + new)
        self._speed[axis] = new

    def _lose(self, dt_s: float, turned: Array) -> None:
        """Steps lost that are due by now, of edges `turned` (3,) in the last `dt_s`."""
        for trouble in self._troubles:
            self._lost[trouble.axis] += trouble.lose(dt_s, float(turned[trouble.axis]))
        self._troubles = [trouble for trouble in self._troubles if not trouble.over(self._time_s)]
        for i, (axis, _, parameters) in enumerate(self._losses):
            assert isinstance(parameters, dict)
            if self._time_s >= self._next_loss_s[i]:
                self._lost[axis] += parameters["steps"]
                every = parameters["every_s"]
                self._next_loss_s[i] += every if every > 0.0 else math.inf

    def jam(self, axis: int, steps: float, seconds: float) -> None:
        """Block the rotor of `axis` against all commands until `steps` are lost or `seconds` are over."""
        self._troubles.append(_Trouble(axis, steps, self._time_s + seconds))

    def slip(self, axis: int, steps: float, seconds: float, speed_unit_per_s: float) -> None:
        """The rotor of `axis` falls behind its field (`steps` below 0: runs ahead), at this speed, by at most `steps`."""
        self._troubles.append(_Trouble(axis, steps, self._time_s + seconds, speed_unit_per_s * self._per_unit[axis]))

    @property
    def lost_steps(self) -> Array:
        """Steps (3,) that the rotors are behind their fields, less what a heavy rotor will still swing."""
        return self._lost.copy()

    def unplug_encoder(self, axis: int) -> None:
        """The encoder of `axis` shows the same count from now on."""
        self._encoder_stands[axis] = int(self.encoder_counts[axis])

    @property
    def step_counts(self) -> Array:
        """Edges counted on the pins (3,), as the board counts the stages."""
        return self._counts.copy()

    @property
    def encoder_counts(self) -> Array:
        """Encoder counts (3,) int64 of the rotors."""
        counts = np.floor(self._rotor * self._encoder_ratio + 0.5).astype(np.int64)
        for axis, stands in self._encoder_stands.items():
            counts[axis] = stands
        return counts

    @property
    def position(self) -> Array:
        """Stage positions (3,) m, rad, rad: rotors through lead screw and gears."""
        position = self._rotor / self._per_unit
        if self._screws_err:
            position += self._screw_error * np.sin(2.0 * math.pi * position / self._screw_pitch)
        return position
