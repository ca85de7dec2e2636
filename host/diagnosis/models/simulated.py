"""A simulator as nominal model: ports at what goes in and what comes out, and parameters that it offers as effects.

A kind of simulator defines `run`; everything else is here. The simulator's outputs are kept by what went in, so that an
effect behind it costs no simulation. For screening, each input is linearized: the change of the outputs after a step of
the input is measured once, and a candidate there is screened with it if that predicts a second simulation.
"""

from __future__ import annotations

import hashlib
import time
from abc import abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.signal import fftconvolve

from host.diagnosis.effects import library
from host.diagnosis.effects.gravity_load import COMPONENT, constant_load, payload
from host.diagnosis.estimation.noise_of_inputs import noise_through
from host.diagnosis.model.dataset import Recording
from host.diagnosis.model.effect import (
    FORCES,
    Candidate,
    Context,
    Effect,
    Parameter,
    Port,
    Scale,
    is_force,
    spread,
)
from host.diagnosis.model.model import (
    ActiveEffect,
    Begin,
    Model,
    Output,
    Segment,
    affine_reading,
    apply_effects,
    filled,
    stack,
    tolerance_of,
)
from host.diagnosis.model.nominal import NominalSpec, OfferSpec, SimulatorSpec
from host.diagnosis.model.operators import fill, smooth_derivatives
from host.diagnosis.model.readings import Finding
from host.diagnosis.models.moved import Moved, force_along
from protocol.errors import InputError

Array = npt.NDArray[np.float64]
KEPT_BYTES = 64_000_000  # of outputs kept by what went in
BEGIN_S = 0.02  # length of the first samples that the state is read from, where the period allows
BEGIN_SAMPLES = 7  # and at least so many
STEP = 0.01  # of an input's span: step by which it is linearized
TRUSTED = 0.25  # error of a linearized input relative to a simulation, up to which candidates are screened with it
FIT_CALLS = 60  # simulations of a recording in which a candidate is fitted in full; printed beforehand
FITS = 10  # candidates that are fitted in full, about
FORCE_OF = {"rad": "N m", "m": "N"}  # unit of the force that does work along a motion
OF_A_MOTOR = ("V", "mV", "A", "mA")  # units of inputs that stand for the force of a motor
# Linear laws of a measured motion: with one of them a simulator is an observer, which follows whatever was measured.
LINEAR_LAWS = ("viscous_friction:", "creep_relaxation:", "resonance:", "softening:")
PLACE_OF = {"rad": "rad", "m": "m", "rad/s": "rad", "m/s": "m"}  # unit of the place that a reading is, or is the rate of
CHAIN = "payload"  # port of what hangs on an arm
WEIGHT = "weight"  # port of a force that acts in addition to recorded loads
MOST_LINKS = 4
MOST_FORCED = 4  # pairs of a force and a motion up to which each force may act along each motion
MOST_DYNAMIC = 4096  # samples of a step response that are used
SAME_RUN = 1e-6  # deviation, relative, up to which two runs are the same
LINEAR = 1e-3  # deviation from superposition, relative, below which a simulator counts as linear


@dataclass(frozen=True)
class StepResponse:
    """Change of the outputs per change of one input.

    `prompt` (outputs, n): sample by sample; `impulse` (outputs, k): as a convolution. One of them is there.
    """

    active: list[ActiveEffect]  # at this input
    prompt: Array | None = None
    impulse: Array | None = None

    def to(self, moved: Array) -> Array:
        """Change of the outputs (outputs, n) when the input changes by `moved` (n,)."""
        if self.prompt is not None:
            return np.asarray(self.prompt * moved)
        assert self.impulse is not None
        return np.asarray(fftconvolve(self.impulse, moved[None, :], axes=1)[:, : moved.size])


@dataclass(frozen=True)
class SimulatorRun:
    """Arguments of one simulation. inputs: (n,) by channel."""

    inputs: dict[str, Array]
    parameters: dict[str, float]
    time_s: Array
    initial: dict[str, float]
    inside: tuple[Segment, list[ActiveEffect]] | None = None  # effects at ports inside the simulator
    rate: float = 1.0  # typical rate of the outputs (1/s): scale of time of initial derivatives

    @cached_property
    def key(self) -> Hashable:
        """Equal for runs that give the same outputs."""
        digest = hashlib.blake2b(repr((self.parameters, self.initial)).encode(), digest_size=16)
        if self.inside is not None:
            segment, active = self.inside
            digest.update(repr(([(c.key, tuple(values)) for c, values in active], segment.start)).encode())
            if any(c.effect.searched for c, _ in active):  # no other effect reads what is laid out
                for _, values in sorted(segment.equations.items()):
                    digest.update(values.tobytes())
        for signal in (self.time_s, *self.inputs.values()):
            digest.update(np.ascontiguousarray(signal).tobytes())
        return digest.digest()


@dataclass(frozen=True)
class FailedRun:
    """A run that raised an exception, in words."""

    says: str


def attempted(run: Callable[..., Mapping[str, Array]], *arguments: Any) -> Mapping[str, Array] | FailedRun:
    """Return what `run` gives, or how it failed: code of others may raise anything where its parameters leave its range."""
    try:
        return run(*arguments)
    except InputError:
        raise
    except Exception as error:
        return FailedRun(f"{type(error).__name__}: {error}")


@dataclass
class ForcedSegment(Segment):
    """A recording with the motion that each force acts along, by channel; filled where one is first needed."""

    moved: dict[str, Moved] = field(default_factory=dict)


class SimulatedModel(Model):
    """Base of the kinds `callable`, `linear`, `mujoco` and `fmu`."""

    scan_points = 24
    simulates = True
    either_sign = True
    # A constant force along a motion is an offset of the reading of force; a simulator has the springs it has.
    taken = frozenset({"gravity_load:constant", "compliance:spring"})
    inside: tuple[str, ...] = ()  # ports inside the simulator, whose effects `run_many` finds in a run
    shifted: bool = True  # whether a constant offset of an input is another one than that of a reading

    def __init__(self, spec: NominalSpec, section: SimulatorSpec, offers: list[OfferSpec]) -> None:
        self.section, self.specified = section, spec
        self.units = {name: channel.unit for name, channel in spec.channels.items()}
        self.session_offsets = [name for name in (*section.inputs, *section.outputs) if spec.channels[name].session_offset]
        inputs, outputs = section.inputs, section.outputs
        self.forced, self.chain = self._forced(), self._chain()
        self.along = driven_along(section, self.units) if section.forces_inside else {}
        self.weighed = tuple(n for n in section.load if n in section.inputs and is_force(self.units[n]) and self.shifted)
        self.outputs = tuple(Output(name, self.units[name], self.subsystem_of(name)) for name in outputs)
        self.ports = (*self._signal_ports(), *self._offered_ports(offers))
        self.taken |= {f"{law}@{name}" for law in LINEAR_LAWS for name in self.along}
        parameters = []
        for key, declared in spec.parameters.items():
            low, high = declared.bounds() if declared.free else (declared.value, declared.value)
            step = abs(declared.value) or (high - low if np.isfinite(high - low) else 1.0) or 1.0
            parameters.append(Parameter(key, declared.unit, (declared.value,), low, high, step=step))
        self.parameters = tuple(parameters)
        self.travel = tuple((n.replace("_", " "), n, self.units[n]) for n in dict.fromkeys((*inputs, *section.load)))
        self.unlisted_at = tuple((channel, channel) for channel in inputs)
        self.moves = {channel: channel for channel in inputs}
        self.quiet_inputs = tuple(dict.fromkeys((*inputs, *section.load)))
        self.calls, self.call_s = 0, 0.0  # simulations of one recording so far, and the time they took
        self.failed: list[str] = []  # of them, in words; none before the first that did not fail
        self.succeeded = False
        self._kept: OrderedDict[Hashable, Array] = OrderedDict()

    @abstractmethod
    def run(
        self, inputs: dict[str, Array], parameters: dict[str, float], time_s: Array, initial: dict[str, float]
    ) -> Mapping[str, Array]:
        """Outputs by channel, each (n,), of one simulation.

        inputs: (n,) by channel. parameters: nominal ones, and those offered that are not off. initial: each output and
        its rate at the first sample (`angle`, `angle_rate`), and the declared states.
        """

    def subsystem_of(self, channel: str) -> str:
        """Subsystem that a verdict names for `channel`."""
        return self.section.ports.get(channel, self.section.subsystem)

    def _signal_ports(self) -> list[Port]:
        section, loads = self.section, tuple(self.section.load)
        found = []
        for channel in section.inputs:
            # The simulator may have no gain and no zero at an input: errors of them are candidates, too.
            kind = "motion+turn+scale" if self.units[channel] == "rad" else "motion+scale"
            kind += "+shift" if self.shifted else ""
            kind += "+added" if channel in self.weighed else ""
            others = tuple(other for other in section.inputs if other != channel)
            found.append(Port(channel, kind, self.subsystem_of(channel), tuple(section.outputs), loads, others))
        for channel in section.outputs:
            kind, subsystem = "drift+timing+limit+mix+scale", self.subsystem_of(channel)
            found.append(Port(f"{channel}_reading", kind, subsystem, (channel,), loads, tuple(section.inputs)))
        for name, (force, motion) in self.forced.items():
            others = tuple(other for other in section.inputs if other != motion)
            found.append(Port(name, "force", self.subsystem_of(force), (force,), loads, others))
        if self.chain:
            torques = tuple(dict.fromkeys(force for force, _ in self.chain))
            found.append(Port(CHAIN, "chain", self.subsystem_of(torques[-1]), torques, offers=(payload(len(self.chain)),)))
        if self.weighed:
            offers = (constant_load({name: self.units[name] for name in self.weighed}),)
            found.append(Port(WEIGHT, "weight", self.subsystem_of(self.weighed[0]), tuple(section.outputs), offers=offers))
        for name, (force, motion) in self.along.items():
            others = tuple(other for other in section.inputs if other != force)
            found.append(Port(name, "force", self.subsystem_of(motion), tuple(section.outputs), loads, others, against=True))
        return found

    def _chain(self) -> list[tuple[str, str]]:
        """Torque and angle of each joint, where angles go in and as many torques come out: an arm, in the order given."""
        angles = [name for name in self.section.inputs if self.units[name] == "rad"]
        torques = [name for name in self.section.outputs if FORCES.get(self.units[name]) == "N m"]
        alike = len(torques) == len(self.section.outputs) and len({self.units[name] for name in torques}) == 1
        return list(zip(torques, angles, strict=True)) if alike and 1 < len(angles) == len(torques) <= MOST_LINKS else []

    def _forced(self) -> dict[str, tuple[str, str]]:
        """Ports of forces that the simulator may lack, each with the output that reads it and the input it acts along.

        A simulator that is given motions and predicts forces (inverse dynamics) cannot show friction at its inputs: that is
        a force along a motion. Where channels have subsystems of their own, a force belongs to the motion of its own.
        """
        pairs = [
            (force, motion)
            for force in self.section.outputs
            for motion in self.section.inputs
            if (wanted := FORCE_OF.get(self.units[motion])) and wanted == FORCES.get(self.units[force])
        ]
        own = of_one_subsystem(self.section, pairs)
        if len(pairs) > MOST_FORCED and not own:  # each force with the motion of its own place in the list
            forces, motions = (list(dict.fromkeys(names)) for names in zip(*pairs, strict=True))
            own = [pair for pair in zip(forces, motions, strict=False) if pair in pairs]
        return {f"{force}_along_{motion}": (force, motion) for force, motion in own or pairs}

    def _offered_ports(self, offers: list[OfferSpec]) -> list[Port]:
        """A port for every offered parameter, with its one effect."""
        found: list[Port] = []
        for offer in offers:
            if offer.parameter in self.specified.parameters:
                raise InputError("offer.parameter", offer.parameter, "a parameter that is not under [parameters]")
            if offer.parameter in {port.name for port in found}:
                raise InputError("offer.parameter", offer.parameter, "one [[offer]] for each parameter")
            effect = offered(offer)
            subsystem = offer.subsystem or self.section.subsystem
            found.append(Port(offer.parameter, "offered", subsystem, tuple(self.section.outputs), offers=(effect,)))
        return found

    def prepare(self, recording: Recording) -> Segment:
        """Inputs bridged, outputs stacked, the state at the first sample read off the outputs."""
        section = self.section
        segment = ForcedSegment(
            recording,
            stack(recording, section.outputs),
            recording.fit,
            recording.heldout,
            filled(recording, list(self.quiet_inputs)),
        )
        segment.units = dict(self.units)
        for channel in section.inputs:
            values = segment.inputs[channel]
            segment.tolerances[channel] = tolerance_of(values, float(np.ptp(values)))
            segment.units[f"output:{channel}"] = self.units[channel]
        for port in self.ports:
            if port.kind == "offered":
                segment.units[port.name] = ""
            elif port.kind == "chain":
                segment.units[port.name] = self.units[port.channels[0]]
            elif port.kind == "weight":
                segment.units[port.name] = self.units[self.weighed[0]]
            elif port.name in self.forced:
                motion = segment.inputs[self.forced[port.name][1]]
                segment.tolerances[port.name] = tolerance_of(motion, float(np.ptp(motion)))
                segment.units[port.name] = self.units[port.channels[0]]
                segment.units[f"motion:{port.name}"] = self.units[self.forced[port.name][1]]
            elif port.name in self.along:
                force, motion_read = self.along[port.name]
                segment.tolerances[port.name] = self._moved_of(segment, motion_read).tolerance
                segment.units[port.name] = self.units[force]
                segment.units[f"motion:{port.name}"] = PLACE_OF[self.units[motion_read]]
            elif port.name not in self.inside and port.name.endswith("_reading"):
                segment.units[port.name] = self.units[port.channels[0]]
        segment.begin = self._begin(segment)
        return segment

    def _begin(self, segment: Segment) -> Begin | None:
        """State at the first sample with its standard deviations; session offsets are part of it."""
        names, means, sds = self.initial_state(segment)
        for name in self.session_offsets:
            values = segment.recording.channels[name]
            names, means = [*names, f"offset:{name}"], [*means, 0.0]
            sds = [*sds, float(np.nanmax(values) - np.nanmin(values)) or 1.0]
        if not names:
            return None
        return Begin(tuple(names), np.array(means), np.array(sds), np.array(means))

    def initial_state(self, segment: Segment) -> tuple[list[str], list[float], list[float]]:
        """Names, means and standard deviations of the state that `run` is given."""
        names, means, sds = [], [], []
        for row, name in zip(segment.y, self.section.outputs, strict=True):
            (value, rate), (value_sd, rate_sd) = first_state(row, segment.recording.dt_s)
            names += [name, f"{name}_rate"]
            means += [value, rate]
            sds += [value_sd, rate_sd]
        for name, state in self.section.states.items():
            names, means, sds = [*names, name], [*means, state.value], [*sds, state.spread]
        return names, means, sds

    def simulate(self, segment: Segment, theta: Array, active: list[ActiveEffect]) -> Array:
        """Every output (outputs, n). Raises InputError where the simulator does not give what it should."""
        return self.simulate_all([segment], theta, active)[0]

    def simulate_all(self, segments: list[Segment], theta: Array, active: list[ActiveEffect]) -> list[Array]:
        """Outputs of several recordings; those whose run is not kept are run together."""
        runs = [self.run_of(segment, theta, active) for segment in segments]
        new = {run.key: run for run in runs if run.key not in self._kept}
        wholes = {run.key: self._kept[run.key] for run in runs if run.key not in new}  # before the new ones push them out
        began = time.perf_counter()
        wholes |= zip(new, self.run_many(list(new.values())), strict=True)
        if new:
            self.calls, self.call_s = self.calls + len(new), self.call_s + time.perf_counter() - began
        out = []
        for segment, run in zip(segments, runs, strict=True):
            whole = wholes[run.key]
            self._keep(run.key, whole)
            rows = []
            for row, name in zip(whole + self._payload(segment, active), self.section.outputs, strict=True):
                moved = row + self._begin_of(segment).get(f"offset:{name}", 0.0) + self._force(segment, name, active)
                ran = np.isfinite(moved).any()  # of a run that failed no effect has anything to read
                rows.append(apply_effects(moved, active, f"{name}_reading", segment, None) if ran else moved)
            out.append(np.vstack(rows))
        return out

    def _force(self, segment: Segment, output: str, active: list[ActiveEffect]) -> Array | float:
        """Return the sum (n,) of the effects along motions on `output`, which reads a force."""
        total: Array | float = 0.0
        for name, (force, motion) in self.forced.items():
            here = [effect for effect in active if effect[0].port.name == name]
            if force == output and here:
                total = total + force_along(self._moved_of(segment, motion), here, segment, name)
        return total

    def _payload(self, segment: Segment, active: list[ActiveEffect]) -> Array | float:
        """Return the torques (outputs, n) of a mass at the end of the arm."""
        total: Array | float = 0.0
        for candidate, values in active:
            if candidate.port.kind == "chain" and candidate.effect.apply is not None:
                joints = [self._moved_of(segment, angle) for _, angle in self.chain]
                moved = np.array([[joint.x, joint.v, joint.a] for joint in joints])
                context = Context(segment.recording.time_s, segment.recording.dt_s, joints[-1].x, joints[-1].tolerance)
                total = total + candidate.effect.apply(moved, context, values, candidate.form)
        return total

    def _moved_of(self, segment: Segment, motion: str) -> Moved:
        """Return the motion that a channel reads; of one that reads a speed, its integral from zero."""
        assert isinstance(segment, ForcedSegment)
        if motion not in segment.moved:
            moved = Moved.of(filled(segment.recording, [motion])[motion], segment.recording)
            if self.units[motion].endswith("/s"):
                place = np.cumsum(moved.x) * segment.recording.dt_s
                moved = replace(moved, x=place, v=moved.x, a=moved.v, tolerance=tolerance_of(place, float(np.ptp(place))))
            segment.moved[motion] = moved
        return segment.moved[motion]

    def _taken(self, segment: Segment, name: str, active: list[ActiveEffect]) -> Array:
        """Force (n,) along a measured motion that is missing at an input."""
        here = [effect for effect in active if effect[0].port.name == name]
        if not here:
            return np.zeros(segment.n)
        return force_along(self._moved_of(segment, self.along[name][1]), here, segment, name)

    def run_many(self, runs: list[SimulatorRun]) -> list[Array]:
        """Outputs (outputs, n) of each of `runs`."""
        arguments = [(run.inputs, run.parameters, run.time_s, run.initial) for run in runs]
        return [self._checked(run, attempted(self.run, *own)) for run, own in zip(runs, arguments, strict=True)]

    @staticmethod
    def _begin_of(segment: Segment) -> dict[str, float]:
        begin = segment.begin
        return {} if begin is None else dict(zip(begin.names, map(float, begin.values), strict=True))

    def run_of(self, segment: Segment, theta: Array, active: list[ActiveEffect]) -> SimulatorRun:
        """Return the arguments of the simulator for one recording."""
        begin, active = self._begin_of(segment), self.components(active)
        given = {}
        for name in self.section.inputs:
            signal = segment.inputs[name] + begin.get(f"offset:{name}", 0.0)
            given[name] = apply_effects(signal, active, name, segment, None)
        for place in dict.fromkeys(c.port.name for c, _ in active if c.port.name in self.along):
            force = self.along[place][0]
            given[force] = given[force] - self._taken(segment, place, active)
        values = {p.name: float(value) for p, value in zip(self.parameters, theta, strict=True)}
        for candidate, its in active:
            if candidate.port.kind == "offered":
                values[candidate.port.name] = float(its[0])
        # A reading with an offset of its own begins that much away from the state.
        initial = {
            name: value - begin.get(f"offset:{name}", 0.0) for name, value in begin.items() if not name.startswith("offset:")
        }
        self._undo(segment, initial, active)
        within = [effect for effect in active if effect[0].port.name in self.inside]
        inside = (segment, within) if within else None
        return SimulatorRun(given, values, segment.recording.time_s, initial, inside, self.rate_of(segment))

    def components(self, active: list[ActiveEffect]) -> list[ActiveEffect]:
        """`active` with an added load as one effect at each force that it adds to."""
        ports, found = {port.name: port for port in self.ports}, []
        for candidate, values in active:
            if candidate.port.kind == "weight":
                form = COMPONENT.forms[0]
                parts = zip(self.weighed, values[:, None], strict=True)
                found += [(Candidate(COMPONENT, ports[name], form=form), value) for name, value in parts]
            else:
                found.append((candidate, values))
        return found

    def _undo(self, segment: Segment, initial: dict[str, float], active: list[ActiveEffect]) -> None:
        """Let each output and its rate begin where the effects on its reading, if affine, have what was read."""
        for name in self.section.outputs:
            affine = affine_reading(segment, active, f"{name}_reading") if name in initial else None
            if affine is not None:
                offset, gain = affine
                initial[name] = (initial[name] - offset) / gain
                if f"{name}_rate" in initial:
                    initial[f"{name}_rate"] /= gain

    def rate_of(self, segment: Segment) -> float:
        """Scale of time (1/s) of the derivatives among the initial state."""
        return 1.0

    def _checked(self, run: SimulatorRun, found: Mapping[str, Array] | FailedRun) -> Array:
        """Outputs (outputs, n); not a number where the run failed. Raises InputError for outputs that are none."""
        if isinstance(found, FailedRun):
            if not self.succeeded:
                raise InputError(f"{self.kind} {self.label}", found.says, "outputs for the nominal parameters")
            self.failed.append(found.says)
            return np.full((len(self.section.outputs), run.time_s.size), np.nan)
        self.succeeded, rows = True, []
        for name in self.section.outputs:
            row = np.asarray(found[name] if isinstance(found, Mapping) and name in found else np.nan, dtype=np.float64)
            if row.shape != run.time_s.shape:
                raise InputError(
                    f"{self.kind}.outputs",
                    f"{name} of shape {row.shape} from {self.label}",
                    f"a dictionary with {name} of shape {run.time_s.shape}",
                )
            rows.append(row)
        return np.vstack(rows)

    def _keep(self, key: Hashable, whole: Array) -> None:
        self._kept[key] = whole
        self._kept.move_to_end(key)
        while len(self._kept) * whole.nbytes > KEPT_BYTES and len(self._kept) > 1:
            self._kept.popitem(last=False)

    @property
    def label(self) -> str:
        """Name of the simulator in messages."""
        return self.kind

    def try_out(self, segments: list[Segment]) -> None:
        """Simulate a recording twice. Raises InputError for outputs that are not numbers, differ, or do not move."""
        driven = [s for s in segments if any(np.ptp(s.inputs[name]) > 0.0 for name in self.section.inputs)]
        run, same = (self.run_of((driven or segments)[0], self.guess(segments), []) for _ in range(2))
        key = run.key  # before the run, which may change its arguments
        (first,), (again,) = self.run_many([run]), self.run_many([same])
        self._keep(key, first)
        for name, row, other in zip(self.section.outputs, first, again, strict=True):
            if not np.isfinite(row).any():
                raise InputError(f"{self.kind} {self.label}", f"no number in {name} with the nominal parameters", "numbers")
            away = float(np.nanmax(np.abs(row - other)))
            if away > SAME_RUN * float(np.nanmax(np.abs(row))):
                found = f"{name} that differs by {away:.3g} between two runs"
                raise InputError(f"{self.kind} {self.label}", found, "the same outputs for the same arguments")
        if driven and all(np.nanmax(row) - np.nanmin(row) <= SAME_RUN * np.nanmax(np.abs(row)) for row in first):
            found = f"{self.section.outputs[0]} that stays at {np.nanmax(first[0]):.3g} while its inputs move"
            wanted = "an output that answers: check what the simulator reads, or state parameters with which it moves"
            raise InputError(f"{self.kind} {self.label}", found, wanted)

    def announce(self, segments: list[Segment], theta: Array) -> str:
        """Return the cost of the diagnosis in simulations, from one simulation of each fitted recording."""
        used = [segment for segment in segments if segment.fit.any()]
        self.simulate_all(used[:1], theta, [])  # compiles or loads what later runs have
        before, spent = (self.calls, self.call_s) if len(used) > 1 else (0, 0.0)
        self.simulate_all(used, theta, [])
        each = (self.call_s - spent) / max(self.calls - before, 1)
        offers = sum(
            len(effect.parameters(UNSCALED, "")[0].grid)
            for port in self.ports
            if port.kind == "offered"
            for effect in port.offers
        )
        screening = len(used) * (2 * len(self.section.inputs) + offers + len(self.parameters))
        fits = len(used) * FITS * (FIT_CALLS + 10 * len(self.parameters))
        return (
            f"one simulation takes {each * 1e3:.3g} ms; a round of screening takes about {screening} of them "
            f"({screening * each:.0f} s), the fits of a round up to {fits} ({fits * each:.0f} s)"
        )

    def findings(self) -> list[Finding]:
        """Return what is to be said of runs that failed."""
        if not self.failed:
            return []
        says = f"The simulator failed in {len(self.failed)} of {self.calls} runs, first with {self.failed[0]!r}. "
        says += "Such a run counts as far from every recording. Let the simulator answer in all of its parameters' bounds, "
        says += "or narrow these."
        return [Finding("simulator_failed", self.section.inputs[0] if self.section.inputs else "", says)]

    def linear_path(self, segment: Segment, theta: Array) -> tuple[str, ...]:
        """Input and reading of a simulator with one of each that is linear and time-invariant, by four simulations.

        Superposition is tested with the recorded input and a late copy of it, both begun at the first sample's value.
        """
        if len(self.section.inputs) != 1 or len(self.section.outputs) != 1:
            return ()
        name, output = self.section.inputs[0], self.section.outputs[0]
        late = max(1, segment.n // 7)
        moved = segment.inputs[name] - segment.inputs[name][0]
        copy = np.concatenate([np.zeros(late), moved[:-late]])
        inputs = (0.0 * moved, moved, copy, 0.3 * copy - 0.6 * moved)
        rest, whole, copied, mixed = (self._moved(segment, theta, [], name, by - moved)[0] for by in inputs)
        whole, copied, mixed = whole - rest, copied - rest, mixed - rest
        errors = (mixed - 0.3 * copied + 0.6 * whole, copied[late:] - whole[:-late])
        size = float(np.std(whole))
        linear = all(np.isfinite(e).all() and float(np.sqrt(np.mean(e**2))) <= LINEAR * size for e in errors)
        return (name, f"{output}_reading") if linear and size > 0.0 else ()

    def slopes(self, segment: Segment, theta: Array, active: list[ActiveEffect]) -> dict[str, StepResponse]:
        """Step response of the outputs for each input that answers linearly enough, by two simulations.

        The simulator alone is linearized, about the inputs that the active effects leave of the recorded ones.
        """
        behind = [effect for effect in active if effect[0].port.name not in self.section.inputs]
        given = {name: apply_effects(segment.inputs[name], active, name, segment, None) for name in self.section.inputs}
        changed = replace(segment, inputs={**segment.inputs, **given})
        base = self.simulate(changed, theta, behind)
        found = {}
        for name in self.section.inputs:
            here = [effect for effect in active if effect[0].port.name == name]
            size = STEP * (float(np.ptp(given[name])) or 1.0)
            step = (self._moved(changed, theta, behind, name, np.full(segment.n, size)) - base) / size
            trial = 0.5 * size * _trial(given[name])
            change = self._moved(changed, theta, behind, name, trial) - base
            answers = [StepResponse(here, prompt=step), StepResponse(here, impulse=_impulse(step))]
            error, best = min((_misfit(answer.to(trial), change), k) for k, answer in enumerate(answers))
            if error < TRUSTED:
                found[name] = answers[best]
        for place, (force, _) in self.along.items():
            if force in found:
                found[place] = replace(found[force], active=[effect for effect in active if effect[0].port.name == place])
        return found

    def _moved(self, segment: Segment, theta: Array, active: list[ActiveEffect], name: str, by: Array) -> Array:
        moved = replace(segment, inputs={**segment.inputs, name: segment.inputs[name] + by})
        return self.simulate(moved, theta, active)

    def change(
        self, segment: Segment, theta: Array, slopes: dict[str, StepResponse], candidate: Candidate, values: Array
    ) -> Array:
        """Linearized change of the outputs (outputs, n) by a candidate at an input, after the effects that act there."""
        name = candidate.port.name
        here = slopes[name].active
        if name in self.along:
            more = self._taken(segment, name, [*here, (candidate, values)])
            return slopes[name].to(self._taken(segment, name, here) - more)
        u = segment.inputs[name]
        before = apply_effects(u, here, name, segment, None)
        return slopes[name].to(apply_effects(u, [*here, (candidate, values)], name, segment, None) - before)

    def noise_of_inputs(self, segment: Segment, theta: Array) -> Array:
        """Noise of each output (outputs,) that was read with the inputs of the simulator."""
        return noise_through(self, segment, theta)

    def answer(self, slope: StepResponse, moved: Array) -> Array:
        """Change of the outputs (outputs, n) when an input changes by `moved` (n,)."""
        return slope.to(moved)

    def motion(self, segment: Segment, port: Port) -> Array:
        """The input at its port, the motion that a force acts along, or the measured output."""
        if port.name in self.forced:
            return segment.inputs[self.forced[port.name][1]]
        if port.name in self.along:
            return self._moved_of(segment, self.along[port.name][1]).x
        if port.kind == "chain":
            return segment.inputs[self.chain[-1][1]]
        if port.kind == "weight":
            return segment.inputs[self.weighed[0]]
        if port.name in segment.inputs:
            return segment.inputs[port.name]
        row = segment.y[self.section.outputs.index(port.channels[0])]
        return np.where(np.isfinite(row), row, np.nanmedian(row))

    def needs(self, segment: Segment, port: Port, theta: Array, residual: Array) -> Array:
        """Residual of the port's output; at an input, what it would have to be moved by, all outputs weighed by their
        noise. For an added load, the component of which the least would do.
        """
        if port.kind == "weight":
            return min((self._need(segment, name, theta, residual) for name in self.weighed), key=np.linalg.norm)
        if port.name in self.along:
            return self._need(segment, self.along[port.name][0], theta, residual)
        if port.name not in segment.inputs:
            return np.asarray(residual[self.section.outputs.index(port.channels[0])])
        return self._need(segment, port.name, theta, residual)

    def _need(self, segment: Segment, channel: str, theta: Array, residual: Array) -> Array:
        """What the input `channel` (n,) would have to be moved by."""
        step = 1e-4 * (float(np.ptp(segment.inputs[channel])) or 1.0)
        moved = self._moved(segment, theta, [], channel, np.full(segment.n, step))
        slope = (moved - self.simulate(segment, theta, [])) / step
        weight = segment.weights()
        s = np.where(np.isfinite(residual), slope, 0.0) / weight
        return np.asarray(
            np.sum(s * np.nan_to_num(residual) / weight, axis=0) / (np.sum(s * s, axis=0) + 1e-12 * np.mean(s * s) + 1e-300)
        )


def of_one_subsystem(section: SimulatorSpec, pairs: list[tuple[str, str]]) -> list[tuple[str, str]]:
    """Those of `pairs` of channels whose subsystems are both declared, and are one."""
    return [(a, b) for a, b in pairs if a in section.ports and section.ports[a] == section.ports.get(b)]


def driven_along(section: SimulatorSpec, units: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    """Return ports of forces inside a simulator that gets forces and predicts motions, with their input and output.

    Such a force (a friction, a spring, a drag) follows the motion that is measured, and is as good as one at the input. That
    of a motor is stated in the voltage or the current that overcomes it.
    """
    pairs = [
        (force, motion)
        for force in section.inputs
        for motion in section.outputs
        if (place := PLACE_OF.get(units[motion]))
        and (units[force] in OF_A_MOTOR or FORCE_OF[place] == FORCES.get(units[force]))
    ]
    if len(pairs) > MOST_FORCED:
        pairs = of_one_subsystem(section, pairs)
    return {f"{force}_along_{motion}": (force, motion) for force, motion in pairs[:MOST_FORCED]}


UNSCALED = Scale("", 1.0, 0.0, 1.0, 1.0, 1e-3, 1.0, 1e-2, 10.0, True)


def offered(offer: OfferSpec) -> Effect:
    """The effect that `offer` stands for: its words are those of the vocabulary. Raises InputError for an id outside it."""
    known = {effect.id for effect in library()}
    if offer.id not in known:
        raise InputError("offer.id", offer.id, "one of " + ", ".join(sorted(known)))
    name = offer.parameter.rpartition(".")[2]
    positive = offer.low >= 0.0 and offer.off == offer.low
    size = offer.high - offer.low
    if offer.tried:
        tried = tuple(offer.tried)
    elif positive:
        tried = spread(offer.low + 1e-3 * size, offer.low + 0.4 * size, 5)
    else:
        tried = tuple(float(v) for v in np.linspace(offer.low, offer.high, 7)[1:-1] if abs(v - offer.off) > 1e-3 * size)
    positive = positive and offer.low == 0.0
    low = 1e-6 * size if positive else offer.low
    parameter = Parameter(name, offer.unit, tried, low, offer.high, log=positive, step=0.05 * size)

    def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
        return (parameter,)

    says = f"{offer.id.replace('_', ' ')}: the simulator's {offer.parameter} is {{{name}}} and not {offer.off:g}."
    return Effect(offer.id, "offered", 0, parameters, says, f"{offer.parameter} = {name}", at_rest=True)


def first_state(row: Array, dt_s: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Value and rate of an output (n,) at its first sample, and their standard deviations.

    A cubic over the first samples gives both; the scatter of the samples about the smoothed output gives the deviations.
    """
    y = fill(row)
    window = max(BEGIN_SAMPLES, round(BEGIN_S / dt_s) | 1)
    window = min(window, y.size | 1)
    x, v, _ = smooth_derivatives(y, dt_s, window)
    first = slice(0, min(y.size, 20 * window))
    noise = float(np.std((y - x)[first])) * float(np.sqrt(window / max(window - 4.0, 1.0)))
    t = np.arange(window) / (window - 1.0)
    V = np.vander(t, 4, increasing=True)
    sd = 1.5 * noise * np.sqrt(np.diag(np.linalg.inv(V.T @ V))[:2]) / np.array([1.0, (window - 1.0) * dt_s])
    return (float(x[0]), float(v[0])), (max(float(sd[0]), 1e-300), max(float(sd[1]), 1e-300))


def _trial(u: Array) -> Array:
    """A change (n,) of size one that has what candidates change: memory of the direction, and a late copy."""
    centred = (u - u.mean()) / (float(np.std(u)) or 1.0)
    late = np.concatenate([np.full(5, centred[0]), centred[:-5]])
    return np.asarray(0.5 * np.sign(np.gradient(u)) + 0.5 * late)


def _impulse(step: Array) -> Array:
    """Impulse response (outputs, k) from a step response (outputs, n)."""
    return np.diff(step[:, :MOST_DYNAMIC], axis=1, prepend=0.0)


def _misfit(predicted: Array, change: Array) -> float:
    """Error of a predicted change (outputs, n) relative to the change, of the output it fits worst."""
    size = np.sqrt(np.mean(change**2, axis=1))
    error = np.sqrt(np.mean((predicted - change) ** 2, axis=1))
    seen = size > 1e-9 * float(np.max(size, initial=0.0))
    return float(np.max(error[seen] / size[seen], initial=0.0)) if np.isfinite(error).all() else np.inf
