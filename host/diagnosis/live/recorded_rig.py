"""The rig as its recordings describe it: the twin of the live watch, refitted; the wall moves, so that force is an input."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from host.diagnosis.design.excitation import Excitation
from host.diagnosis.design.rig_experiment import rig_excitations
from host.diagnosis.estimation.fit import Fit, Problem
from host.diagnosis.live.twin import Twin
from host.diagnosis.model.dataset import Recording
from host.diagnosis.model.effect import Port
from host.diagnosis.model.model import ActiveEffect, Segment
from host.diagnosis.model.nominal import NominalSpec
from host.diagnosis.model.rig_recording import knob_gain, rig_of
from host.diagnosis.models.rig import FORCE, HANDLES, KEYS, PARAMETERS, POSE_ROWS, RigSegment
from host.recordings.recording import RecordingFile
from protocol.catheter import Catheter, CosseratParameters
from protocol.errors import InputError

Array = npt.NDArray[np.float64]
FREE = ("insertion_offset", "roll_slope", "roll_offset", "knob_gain", "knob_offset", "bending_stiffness")
EI = [name for name, _, _ in PARAMETERS].index("bending_stiffness")
NUDGE_N = 1e-3


class RecordedRig(Twin):
    """Nominal model of kind `rig` with `recorded = true`. Poses are compared; forces load the shape.

    Known play and knob curve are taken off the handle beforehand (rig_recording); offsets, slope, gain and bending
    stiffness are refitted.
    """

    def __init__(self, spec: NominalSpec) -> None:
        rig = rig_of(spec._files)
        super().__init__(rig, catheter_of(RecordingFile(spec._files[0]).catheter))
        self.recorded_on = rig
        wanted = []
        for p in self.parameters:
            value, free = spec.start(KEYS.get(p.name, p.name), knob_gain(rig) if p.name == "knob_gain" else p.grid[0])
            if p.name not in FREE or not free:
                wanted.append(replace(p, grid=(value,), low=value, high=value, log=False))
            elif p.name == "bending_stiffness":
                wanted.append(replace(p, grid=(value,), low=0.02 * value, high=50.0 * value, log=True))
            else:
                wanted.append(replace(p, grid=(value,), low=-np.inf, high=np.inf))
        self.rigidity = self.parameters[EI].grid[0]
        self.parameters = tuple(wanted)
        self.outputs = self.outputs[POSE_ROWS]
        self.ports = tuple(port for port in self.ports if port.name != "contact")

    def prepare(self, recording: Recording) -> RigSegment:
        """As the twin does, the force as it was averaged about each frame; it is not an output."""
        segment = super().prepare(recording)
        segment.y = segment.y[POSE_ROWS]
        return segment

    def simulate(self, segment: Segment, theta: Array, active: list[ActiveEffect]) -> Array:
        """Poses (12, n) of tip and shaft."""
        return super().simulate(segment, theta, active)[POSE_ROWS]

    def needs(self, segment: Segment, port: Port, theta: Array, residual: Array) -> Array:
        """As the nominal model has it; for the force sensor, the force along the wall's normal that the poses would need."""
        if port.name != "force_sensor":
            return super().needs(segment, port, theta, residual)
        assert isinstance(segment, RigSegment)
        given = segment.force
        base = self.simulate(segment, theta, [])
        segment.force = given + NUDGE_N * self.normal[:, None]
        slope = (self.simulate(segment, theta, []) - base) / NUDGE_N
        segment.force = given
        weight = segment.weights()
        slope = np.where(np.isfinite(residual), slope, 0.0) / weight
        return np.asarray(np.sum(slope * np.nan_to_num(residual) / weight, axis=0) / (np.sum(slope**2, axis=0) + 1e-12))

    @property
    def scripted(self) -> tuple[str, ...]:
        """Handle and force on the wall."""
        return (*HANDLES, *FORCE)

    @property
    def on_rig(self) -> bool:
        """Experiments run on the recorded rig."""
        return True

    def excitations(self, problem: Problem, best: Fit) -> list[tuple[Excitation, dict[str, Array]]]:
        """Motions that this rig can make in an experiment."""
        return rig_excitations(self, problem, best)

    def settle(self, segment: Segment, theta: Array) -> None:
        """Let the rod model correct the nominal model at these nominal parameters."""
        self.softness = self.rigidity / float(theta[EI])
        self.correct(segment, theta)

    def guess(self, segments: list[Segment]) -> Array:
        """Return the calibrated values of the parameters."""
        return np.array([p.grid[0] for p in self.parameters])


def catheter_of(data: dict[str, Any]) -> Catheter:
    """The catheter as a recording's header has it. Raises InputError for one without spatial mechanics."""
    if not data.get("cosserat"):
        raise InputError("recording.catheter", data.get("name", "nothing"), "a catheter with spatial mechanics (cosserat)")
    try:
        return Catheter(
            data["name"],
            data["distal_length_m"],
            data["diameter_m"],
            data["pull_wire_offset_m"],
            cosserat=CosseratParameters(**data["cosserat"]),
        )
    except (KeyError, TypeError) as error:
        raise InputError(
            "recording.catheter", str(error), "the catheter's parameters as this version records them"
        ) from None
