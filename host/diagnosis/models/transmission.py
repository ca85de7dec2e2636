"""Motion in, motion out: each link is output = gain * input + offset, with ports before and after the gain."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from host.diagnosis.effects import library
from host.diagnosis.estimation.noise_of_inputs import noise_through
from host.diagnosis.model.dataset import Recording
from host.diagnosis.model.effect import Effect, Parameter, Port, is_force
from host.diagnosis.model.model import (
    ActiveEffect,
    Begin,
    Model,
    Output,
    Segment,
    apply_effects,
    filled,
    forces_among,
    stack,
    tolerance_of,
)
from host.diagnosis.model.nominal import LinkSpec, NominalSpec
from host.diagnosis.model.operators import lag

Array = npt.NDArray[np.float64]


class TransmissionModel(Model):
    """Nominal model of kind `transmission`; several links may share channels."""

    kind = "transmission"
    fit_samples = 24000
    coarsest_s = 0.02
    screen_samples = 24000
    scan_points = 160

    def __init__(self, spec: NominalSpec) -> None:
        self.links: list[LinkSpec] = spec.link
        self.units = {name: channel.unit for name, channel in spec.channels.items()}
        self.tared = tuple(link.output for link in self.links if spec.channels[link.output].session_offset)
        names = [
            link.subsystem if len(spec.link) == 1 or _alone(link, spec) else f"{link.subsystem}_{link.output}"
            for link in spec.link
        ]
        self.names = names
        self.outputs = tuple(Output(link.output, self.units[link.output], link.subsystem) for link in self.links)
        ports: list[Port] = []
        parameters: list[Parameter] = []
        taken: set[str] = set()
        for name, link in zip(names, self.links, strict=True):
            others = self._others(link)
            loads = tuple(link.load) or forces_among(others, self.units)
            turn = "motion+turn" if self.units[link.input] == "rad" else "motion"
            prefix = "" if len(self.links) == 1 else f"{name}_"
            held = not spec.start(f"{prefix}gain", 1.0)[1]  # a gain that is fitted would absorb an error of the scale
            deflects = is_force(self.units[link.input]) and not is_force(self.units[link.output])
            ports += [
                Port(name, turn, link.subsystem, (link.output,), loads, others),
                Port(f"{name}_reading", "drift+scale" if held else "drift", link.subsystem, (link.output,)),
            ]
            if deflects:
                ports += [
                    Port(f"{name}_friction", "load", link.subsystem, (link.output,), within=name),
                    Port(f"{name}_spring", "deflection", link.subsystem, (link.output,), within=name),
                ]
                taken |= {f"{e.id}:{form}@{name}" for e in library() for form in e.forms if _of_motion(e, form)}
            ratio = (
                ""
                if self.units[link.input] == self.units[link.output]
                else f"{self.units[link.output]}/{self.units[link.input]}"
            )
            for key, unit, default in (("gain", ratio, 1.0), ("offset", self.units[link.output], 0.0)):
                value, free = spec.start(prefix + key, default)
                free = free and not (key == "offset" and link.output in self.tared)  # each recording has its own
                bound = np.inf if free else value
                parameters.append(Parameter(prefix + key, unit, (value,), -bound if free else value, bound, linear=True))
            for order in range(link.lag_order):
                value, _ = spec.start(f"{prefix}time_constant_{order + 1}", 1.0)
                parameters.append(Parameter(f"{prefix}time_constant_{order + 1}", "s", (value,), 1e-6, 1e6, log=True))
        self.ports, self.parameters, self.taken = tuple(ports), tuple(parameters), frozenset(taken)
        used = dict.fromkeys(name for link in self.links for name in (link.input, *link.load))
        self.travel = tuple((name.replace("_", " "), name, self.units[name]) for name in used)
        self.unlisted_at = tuple((name, name) for name in names)
        self.moves = {name: link.input for name, link in zip(names, self.links, strict=True)}
        self.quiet_inputs = tuple(
            dict.fromkeys([link.input for link in self.links] + [name for link in self.links for name in link.load])
        )

    def _others(self, link: LinkSpec) -> tuple[str, ...]:
        """Channels that may move the output of `link` too: those that the nominal model names, or else all other inputs."""
        inputs = dict.fromkeys(other.input for other in self.links if other.input != link.input)
        return tuple(link.others) or tuple(inputs)

    def prepare(self, recording: Recording) -> Segment:
        """Return the segment of a recording: missing inputs interpolated, outputs as rows."""
        names = list(dict.fromkeys(name for link in self.links for name in (link.input, *link.load, *self._others(link))))
        segment = Segment(
            recording,
            stack(recording, [link.output for link in self.links]),
            recording.fit,
            recording.heldout,
            filled(recording, names),
        )
        units: dict[str, str] = dict(self.units)
        for name, link in zip(self.names, self.links, strict=True):
            motion = segment.inputs[link.input]
            segment.tolerances[name] = tolerance_of(motion, float(np.ptp(motion)))
            units[name], units[f"output:{name}"] = self.units[link.input], self.units[link.output]
            units[f"{name}_reading"] = units[f"{name}_spring"] = self.units[link.output]
            units[f"{name}_friction"] = self.units[link.input]
            segment.tolerances[f"{name}_friction"] = segment.tolerances[name]
            units[f"motion:{name}_spring"] = self.units[link.input]
        segment.units = units
        if self.tared:
            spans = [float(np.nanmax(recording.channels[name]) - np.nanmin(recording.channels[name])) for name in self.tared]
            none = np.zeros(len(spans))
            segment.begin = Begin(self.tared, none, np.array([span or 1.0 for span in spans]), none.copy())
        return segment

    def guess(self, segments: list[Segment]) -> Array:
        """Start values of the TOML; linear parameters find their place from anywhere."""
        return np.array([p.grid[0] for p in self.parameters])

    def restarts(self, segments: list[Segment]) -> list[Array]:
        """Nominal parameters that give each output its measured RMS, for readings that lead a linear fit astray.

        With lags, for a range of time constants, all of one link alike. Parameters that the TOML holds keep their values.
        """
        used = [segment for segment in segments if segment.fit.any()]
        if not used:
            return []
        order = max(link.lag_order for link in self.links)
        slowest_s = max(float(segment.recording.time_s[-1]) for segment in used) / 8.0
        times_s = np.geomspace(used[0].recording.dt_s, slowest_s, 9) if order else (1.0,)
        found = []
        for time_s in times_s:
            theta = np.array([float(time_s) if "time_constant" in p.name else p.grid[0] for p in self.parameters])
            at = 0
            for row, link in enumerate(self.links):
                theta[at], theta[at + 1] = 1.0, 0.0
                run = np.concatenate([self.simulate(segment, theta, [])[row][segment.fit] for segment in used])
                measured = np.concatenate([segment.y[row][segment.fit] for segment in used])
                theta[at] = float(np.sqrt(np.nanmean(measured**2)) / max(np.sqrt(np.mean(run**2)), 1e-300))
                at += 2 + link.lag_order
            held = [p.grid[0] if p.high <= p.low else t for p, t in zip(self.parameters, theta, strict=True)]
            found.append(np.array(held))
        return found

    def simulate(self, segment: Segment, theta: Array, active: list[ActiveEffect]) -> Array:
        """Every link's output, free run. Shape (outputs, n)."""
        out = np.empty_like(segment.y)
        at = 0
        tares = dict(zip(self.tared, segment.begin.values, strict=True)) if segment.begin is not None else {}
        for row, (name, link) in enumerate(zip(self.names, self.links, strict=True)):
            signal = apply_effects(segment.inputs[link.input], active, name, segment, "input")
            load = apply_effects(signal, active, f"{name}_friction", segment, None)
            signal = theta[at] * load + theta[at + 1]
            signal = apply_effects(signal, active, f"{name}_spring", segment, None, before_gain=load)
            for constant in theta[at + 2 : at + 2 + link.lag_order]:
                signal = lag(signal, segment.recording.dt_s, float(constant))
            at += 2 + link.lag_order
            signal = apply_effects(signal, active, name, segment, "output") + tares.get(link.output, 0.0)
            out[row] = apply_effects(signal, active, f"{name}_reading", segment, None)
        return out

    def noise_of_inputs(self, segment: Segment, theta: Array) -> Array:
        """Noise of each output (outputs,) that was read with the inputs of its link."""
        return noise_through(self, segment, theta)

    def motion(self, segment: Segment, port: Port) -> Array:
        """Nominal input of the link, or its measured output for the reading port."""
        for row, (name, link) in enumerate(zip(self.names, self.links, strict=True)):
            if port.name in (name, f"{name}_friction", f"{name}_spring"):
                return segment.inputs[link.input]
            if port.name == f"{name}_reading":
                return np.where(np.isfinite(segment.y[row]), segment.y[row], np.nanmedian(segment.y[row]))
        raise KeyError(port.name)

    def needs(self, segment: Segment, port: Port, theta: Array, residual: Array) -> Array:
        """Return the residual (n,) at the input of a link, divided by its gain."""
        at = 0
        for row, (name, link) in enumerate(zip(self.names, self.links, strict=True)):
            if port.name in (name, f"{name}_friction"):
                return np.asarray(residual[row] / (theta[at] or 1.0))
            if port.name in (f"{name}_reading", f"{name}_spring"):
                return np.asarray(residual[row])
            at += 2 + link.lag_order
        raise KeyError(port.name)


def _of_motion(effect: Effect, form: str) -> bool:
    """Whether an effect at an input stands for what only a motion does: dry friction and gaps between places (those of a
    load have ports of their own), lost steps, and position loops.
    """
    return effect.port == "motion" and (effect.family == "dry" or effect.id == "missed_steps" or form == "loop")


def _alone(link: LinkSpec, spec: NominalSpec) -> bool:
    return sum(other.subsystem == link.subsystem for other in spec.link) == 1
