"""Motion in, force out: force = m a + c v + k x + ratio * load + offset, with the force terms of the vocabulary added."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from host.diagnosis.model.dataset import Recording
from host.diagnosis.model.effect import Parameter, Port
from host.diagnosis.model.model import (
    ActiveEffect,
    Model,
    Output,
    Segment,
    apply_effects,
    filled,
    forces_among,
    stack,
)
from host.diagnosis.model.nominal import NominalSpec
from host.diagnosis.models.moved import Moved, force_along

Array = npt.NDArray[np.float64]

NOWHERE = Moved(np.zeros(0), np.zeros(0), np.zeros(0), 0.0)


@dataclass
class MovedSegment(Segment):
    """A recording with its motion and the derivatives of that."""

    moved: Moved = NOWHERE


class ImpedanceModel(Model):
    """Nominal model of kind `impedance`: force = m a + c v + k x + ratio load + offset."""

    kind = "impedance"
    either_sign = True
    fit_samples = 24000
    coarsest_s = 0.02
    screen_samples = 24000
    scan_points = 160

    def __init__(self, spec: NominalSpec) -> None:
        if spec.impedance is None:
            raise ValueError("impedance: found nothing, wanted a section")
        self.spec = spec.impedance
        self.units = {name: channel.unit for name, channel in spec.channels.items()}
        force, motion, name = self.units[self.spec.output], self.units[self.spec.input], self.spec.subsystem
        self.outputs = (Output(self.spec.output, force, name),)
        loads, others = tuple(self.spec.load), tuple(self.spec.others)
        self.ports = (
            Port(name, "force", name, (self.spec.output,), loads or forces_among(others, self.units), others),
            Port(f"{name}_reading", "drift+timing+limit+mix", name, (self.spec.output,), (), others),
        )
        unit = {
            "mass": f"{force} s2/{motion}",
            "damping": f"{force} s/{motion}",
            "stiffness": f"{force}/{motion}",
            "offset": force,
        }
        self.terms: list[tuple[str, str]] = []
        parameters = []
        for term in self.spec.terms:
            for source in loads if term == "load" else ("",):
                key = term if term != "load" else "load_ratio" if len(loads) == 1 else f"load_ratio_{source}"
                load_unit = self.units.get(source, "")
                value, free = spec.start(key, 0.0)
                bounds = (-np.inf, np.inf) if free else (value, value)
                text = unit.get(term, "" if load_unit == force else f"{force}/{load_unit}")
                parameters.append(Parameter(key, text, (value,), *bounds, linear=True))
                self.terms.append((term, source))
        self.parameters = tuple(parameters)
        have = {"damping": "viscous_friction:", "mass": "added_mass"}
        # A constant force is an offset of the reading of force.
        self.taken = frozenset(("gravity_load:constant", *(have[term] for term in self.spec.terms if term in have)))
        if "stiffness" not in self.spec.terms:
            self.taken |= {"contact_nonlinear:", "softening:"}
        self.travel = tuple((n.replace("_", " "), n, self.units[n]) for n in (self.spec.input, *loads))
        self.unlisted_at = ((name, f"{name}_reading"),)
        self.moves = {name: self.spec.input}
        self.quiet_inputs = (self.spec.input, *loads)

    def prepare(self, recording: Recording) -> MovedSegment:
        """Motion smoothed to velocity and acceleration without phase."""
        segment = MovedSegment(
            recording,
            stack(recording, [self.spec.output]),
            recording.fit,
            recording.heldout,
            filled(recording, [self.spec.input, *self.spec.load, *self.spec.others]),
        )
        motion = segment.inputs[self.spec.input]
        segment.moved = Moved.of(motion, recording)
        segment.inputs[f"motion:{self.spec.subsystem}"] = motion
        segment.tolerances[self.spec.subsystem] = segment.moved.tolerance
        name, force, unit = self.spec.subsystem, self.units[self.spec.output], self.units[self.spec.input]
        segment.units = {**self.units, name: force, f"motion:{name}": unit, f"{name}_reading": force}
        return segment

    def guess(self, segments: list[Segment]) -> Array:
        """Start values of the TOML; linear parameters find their place from anywhere."""
        return np.array([p.grid[0] for p in self.parameters])

    def simulate(self, segment: Segment, theta: Array, active: list[ActiveEffect]) -> Array:
        """Force along the measured motion. Shape (1, n)."""
        assert isinstance(segment, MovedSegment)
        force = np.zeros(segment.n)
        moved = segment.moved
        given = {"mass": moved.a, "damping": moved.v, "stiffness": moved.x, "offset": 1.0}
        stiffness = 0.0
        for (term, source), value in zip(self.terms, theta, strict=True):
            force = force + value * (segment.inputs[source] if term == "load" else given[term])
            stiffness = value if term == "stiffness" else stiffness
        port = self.spec.subsystem
        here = [effect for effect in active if effect[0].port.name == port]
        force = force + force_along(segment.moved, here, segment, port, float(stiffness))
        return np.asarray(apply_effects(force, active, f"{self.spec.subsystem}_reading", segment, None))[None, :]

    def noise_of_inputs(self, segment: Segment, theta: Array) -> Array:
        """Force (1,) that the noise of the motion makes through the law."""
        assert isinstance(segment, MovedSegment)
        law = {term: float(value) for (term, _), value in zip(self.terms, theta, strict=True)}
        coefficients = (law.get("stiffness", 0.0), law.get("damping", 0.0), law.get("mass", 0.0))
        return np.array([segment.moved.noise_of_force(coefficients, segment.recording.dt_s)])

    def motion(self, segment: Segment, port: Port) -> Array:
        """The measured motion, or the measured force for the reading port."""
        if port.name == self.spec.subsystem:
            return segment.inputs[self.spec.input]
        return np.where(np.isfinite(segment.y[0]), segment.y[0], np.nanmedian(segment.y[0]))

    def needs(self, segment: Segment, port: Port, theta: Array, residual: Array) -> Array:
        """The residual is a force already."""
        return np.asarray(residual[0])
