"""Motion in, force out: force = m a + c v + k x + ratio * load + offset, with the force terms of the vocabulary added."""

from __future__ import annotations

from dataclasses import dataclass, replace

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
from host.diagnosis.model.operators import fill
from host.diagnosis.models.moved import Moved, force_along

Array = npt.NDArray[np.float64]

NEGLIGIBLE = 0.1  # of a second mass: what an inexact acceleration can leave of a mass that is not there
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
        balance = "force" if "mass" in self.spec.terms else "force+inertia"
        pressing = loads or forces_among(others, self.units)
        self.ports = (
            Port(name, balance, name, (self.spec.output,), pressing, others, springs=() if pressing else self._springs()),
            Port(f"{name}_motion", "travel", name, (self.spec.output,)),
            Port(f"{name}_reading", "drift+timing+limit+mix+wrap", name, (self.spec.output,), (), others),
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
        # A constant force is an offset of the reading of force.
        self.taken = frozenset(("gravity_load:constant", *(("viscous_friction:",) if "damping" in self.spec.terms else ())))
        stiff = "stiffness" in self.spec.terms
        if stiff or not {"mass", "damping"} & set(self.spec.terms):  # a path of load needs no spring
            self.taken |= {"compliance:spring"}
        if not stiff:
            self.taken |= {"contact_nonlinear:", "softening:"}
        self.travel = tuple((n.replace("_", " "), n, self.units[n]) for n in (self.spec.input, *loads))
        self.unlisted_at = ((name, f"{name}_reading"),)
        self.moves = {name: self.spec.input}
        self.quiet_inputs = (self.spec.input, *loads)

    def _springs(self) -> tuple[str, ...]:
        """The force of the spring, which may press what rubs where no other force is recorded."""
        return (f"{self.spec.subsystem}_spring",) if "stiffness" in self.spec.terms else ()

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
        for port in (self.spec.subsystem, f"{self.spec.subsystem}_motion"):
            segment.tolerances[port] = segment.moved.tolerance
        name, force, unit = self.spec.subsystem, self.units[self.spec.output], self.units[self.spec.input]
        spring = f"{name}_spring"
        segment.inputs[spring] = fill(segment.y[0])  # of its size; `simulate` has the force itself
        segment.units = {
            **self.units,
            spring: force,
            name: force,
            f"motion:{name}": unit,
            f"{name}_motion": unit,
            f"{name}_reading": force,
        }
        return segment

    def guess(self, segments: list[Segment]) -> Array:
        """Start values of the TOML; linear parameters find their place from anywhere."""
        return np.array([p.grid[0] for p in self.parameters])

    def simulate(self, segment: Segment, theta: Array, active: list[ActiveEffect]) -> Array:
        """Force along the measured motion. Shape (1, n)."""
        assert isinstance(segment, MovedSegment)
        force = np.zeros(segment.n)
        moved = self._handed_on(segment, active)
        given = {"mass": moved.a, "damping": moved.v, "stiffness": moved.x, "offset": 1.0}
        stiffness = 0.0
        for (term, source), value in zip(self.terms, theta, strict=True):
            force = force + value * (segment.inputs[source] if term == "load" else given[term])
            stiffness = value if term == "stiffness" else stiffness
        port = self.spec.subsystem
        here = [effect for effect in active if effect[0].port.name == port]
        if any(candidate.effect.source == "spring" for candidate, _ in here):
            segment.inputs[f"{port}_spring"] = stiffness * moved.x
        force = force + force_along(moved, here, segment, port, float(stiffness))
        return np.asarray(apply_effects(force, active, f"{self.spec.subsystem}_reading", segment, None))[None, :]

    def passive(self, theta: Array, active: list[ActiveEffect]) -> bool:
        """Whether the mass is not below zero next to a second one on a spring.

        The two together would have a smaller mass at low frequencies than at high ones. That makes up for what differences
        of a sampled motion lack, and takes noise of the motion out of the force.
        """
        mass = sum(float(value) for (term, _), value in zip(self.terms, theta, strict=True) if term == "mass")
        slots = [c.effect.slots(values, c.form) for c, values in active if c.effect.slots is not None]
        second = sum(own.get("second_mass", 0.0) for own in slots)
        return mass >= -NEGLIGIBLE * second

    def _handed_on(self, segment: MovedSegment, active: list[ActiveEffect]) -> Moved:
        """The motion behind the effects between where it is measured and where the force acts."""
        place, moved = f"{self.spec.subsystem}_motion", segment.moved
        if not any(candidate.port.name == place for candidate, _ in active):
            return moved
        x = apply_effects(moved.x, active, place, segment, None)
        moves = np.diff(x, prepend=x[0]) != 0.0
        return replace(moved, x=x, v=np.where(moves, moved.v, 0.0), a=np.where(moves, moved.a, 0.0))

    def noise_of_inputs(self, segment: Segment, theta: Array) -> Array:
        """Force (1,) that the noise of the motion makes through the law."""
        assert isinstance(segment, MovedSegment)
        law = {term: float(value) for (term, _), value in zip(self.terms, theta, strict=True)}
        coefficients = (law.get("stiffness", 0.0), law.get("damping", 0.0), law.get("mass", 0.0))
        return np.array([segment.moved.noise_of_force(coefficients, segment.recording.dt_s)])

    def motion(self, segment: Segment, port: Port) -> Array:
        """The measured motion, or the measured force for the reading port."""
        if port.name in (self.spec.subsystem, f"{self.spec.subsystem}_motion"):
            return segment.inputs[self.spec.input]
        return np.where(np.isfinite(segment.y[0]), segment.y[0], np.nanmedian(segment.y[0]))

    def needs(self, segment: Segment, port: Port, theta: Array, residual: Array) -> Array:
        """The residual is a force already; a motion makes it through the stiffness or, without one, the damping."""
        if port.name != f"{self.spec.subsystem}_motion":
            return np.asarray(residual[0])
        law = {term: abs(float(value)) for (term, _), value in zip(self.terms, theta, strict=True)}
        assert isinstance(segment, MovedSegment)
        moved = segment.moved
        sizes = [law.get(term, 0.0) * float(np.std(x)) for term, x in (("stiffness", moved.x), ("damping", moved.v))]
        return np.asarray(residual[0] * float(np.std(moved.x)) / max(*sizes, 1e-300))
