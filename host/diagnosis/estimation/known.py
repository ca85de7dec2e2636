"""Effects that are known and switched on in the nominal model, so that only what is still missing is looked for."""

from __future__ import annotations

from copy import copy
from typing import Any

import numpy as np
import numpy.typing as npt

from host.diagnosis.effects import candidates
from host.diagnosis.model.dataset import Recording
from host.diagnosis.model.effect import Candidate, Parameter, Port
from host.diagnosis.model.model import ActiveEffect, Model, Segment, scale_of
from host.diagnosis.model.nominal import EffectSpec
from host.diagnosis.model.readings import Finding
from protocol.errors import InputError

Array = npt.NDArray[np.float64]


class Known(Model):
    """`inner` with effects of the vocabulary switched on; their parameters join the nominal ones and are refitted
    with them.
    """

    def __init__(self, inner: Model, effects: list[EffectSpec], recordings: list[Recording]) -> None:
        self._inner = inner
        for name in Model.__annotations__:  # an attribute that is added to `Model` is one of every model
            setattr(self, name, getattr(inner, name))
        segments = [inner.prepare(recording) for recording in recordings]
        self.active: list[tuple[Candidate, tuple[Parameter, ...]]] = []
        for spec in effects:
            candidate = chosen(inner, spec, recordings[0].timed)
            scale = scale_of(inner, segments, candidate.port, candidate, 1e-3)
            self.active.append((candidate, placed(candidate, candidate.effect.parameters(scale, candidate.form), spec)))
        self.own = len(inner.parameters)
        self.parameters = (*inner.parameters, *(p for _, parameters in self.active for p in parameters))
        self.taken = inner.taken | {f"{c.effect.id}:{c.form}@{c.port.name}" for c, _ in self.active}

    @property
    def inner(self) -> Model:
        """The model without the known effects."""
        return self._inner

    @property
    def scripted(self) -> tuple[str, ...]:
        """Channels that the script of an experiment sets, of the model without the known effects."""
        return self._inner.scripted

    @property
    def on_rig(self) -> bool:
        """Whether experiments of the model without the known effects run on a rig."""
        return self._inner.on_rig

    def excitations(self, problem: Any, best: Any) -> list[Any]:
        """Call the model without the known effects."""
        return self._inner.excitations(problem, best)

    def prepare(self, recording: Recording) -> Segment:
        """Call the model without the known effects."""
        return self._inner.prepare(recording)

    def hold_as(self, segments: list[Segment], hold: str) -> None:
        """Call the model without the known effects."""
        self._inner.hold_as(segments, hold)
        self.hold = hold

    def guess(self, segments: list[Segment]) -> Array:
        """Start values of the model, then the values given for the effects."""
        return np.concatenate(
            [self._inner.guess(segments), [p.grid[0] for _, parameters in self.active for p in parameters]]
        )

    def with_known(self, theta: Array, active: list[ActiveEffect]) -> list[ActiveEffect]:
        """`active` and the known ones, with their share of `theta`."""
        known, at = [], self.own
        for candidate, parameters in self.active:
            known.append((candidate, theta[at : at + len(parameters)]))
            at += len(parameters)
        return [*known, *active]

    def simulate(self, segment: Segment, theta: Array, active: list[ActiveEffect]) -> Array:
        """Outputs (outputs, n) with the known effects at work."""
        return self._inner.simulate(segment, theta[: self.own], self.with_known(theta, active))

    def begins_with(self, segment: Segment, theta: Array, active: list[ActiveEffect]) -> npt.NDArray[np.intp]:
        """Return the unknown states that show with the known effects."""
        return self._inner.begins_with(segment, theta[: self.own], self.with_known(theta, active))

    def passive(self, theta: Array, active: list[ActiveEffect]) -> bool:
        """Whether the law with the known effects is passive."""
        return self._inner.passive(theta[: self.own], self.with_known(theta, active))

    def motion(self, segment: Segment, port: Port) -> Array:
        """Call the model without the known effects."""
        return self._inner.motion(segment, port)

    def needs(self, segment: Segment, port: Port, theta: Array, residual: Array) -> Array:
        """Call the model without the known effects."""
        return self._inner.needs(segment, port, theta[: self.own], residual)

    def simulate_all(self, segments: list[Segment], theta: Array, active: list[ActiveEffect]) -> list[Array]:
        """Outputs of several recordings with the known effects at work."""
        return self._inner.simulate_all(segments, theta[: self.own], self.with_known(theta, active))

    def try_out(self, segments: list[Segment]) -> None:
        """Run the simulator without the known effects. Raises InputError."""
        self._inner.try_out(segments)

    def announce(self, segments: list[Segment], theta: Array) -> str:
        """Call the model without the known effects."""
        return self._inner.announce(segments, theta[: self.own])

    def findings(self) -> list[Finding]:
        """Return what the model without the known effects has to say."""
        return self._inner.findings()

    def linear_path(self, segment: Segment, theta: Array) -> tuple[str, ...]:
        """Call the model without the known effects; a known effect that is not linear and time-invariant ends the path."""
        linear = all(candidate.effect.invariant for candidate, _ in self.active)
        return self._inner.linear_path(segment, theta[: self.own]) if linear else ()

    def settle(self, segment: Segment, theta: Array) -> None:
        """Call the model without the known effects."""
        self._inner.settle(segment, theta[: self.own])

    def along_motion(self) -> Model | None:
        """That of the model without the known effects, with them at work."""
        inner = self._inner.along_motion()
        if inner is None or inner is self._inner:
            return None if inner is None else self
        other = copy(self)
        for name in Model.__annotations__:
            setattr(other, name, getattr(inner, name))
        other._inner, other.parameters, other.taken = inner, self.parameters, self.taken
        return other

    def noise_of_inputs(self, segment: Segment, theta: Array) -> Array:
        """Call the model without the known effects."""
        return self._inner.noise_of_inputs(segment, theta[: self.own])

    def noise_of(self, segment: Segment) -> Any:
        """Call the model without the known effects."""
        return self._inner.noise_of(segment)

    def restarts(self, segments: list[Segment]) -> list[Array]:
        """Those of the model, each with the values given for the effects."""
        given = [p.grid[0] for _, parameters in self.active for p in parameters]
        return [np.concatenate([theta, given]) for theta in self._inner.restarts(segments)]

    def sensitivity(self, segment: Segment, theta: Array, axis: str, active: list[ActiveEffect]) -> Array:
        """Call the model with the known effects active."""
        return self._inner.sensitivity(segment, theta[: self.own], axis, self.with_known(theta, active))

    def slopes(self, segment: Segment, theta: Array, active: list[ActiveEffect]) -> dict[str, Any]:
        """Call the model with the known effects active."""
        return self._inner.slopes(segment, theta[: self.own], self.with_known(theta, active))

    def change(self, segment: Segment, theta: Array, slopes: dict[str, Any], candidate: Candidate, values: Array) -> Array:
        """Call the model with its own parameters."""
        return self._inner.change(segment, theta[: self.own], slopes, candidate, values)

    def moved(self, segment: Segment, theta: Array, candidate: Candidate, values: Array) -> Array:
        """Call the model with its own parameters."""
        return self._inner.moved(segment, theta[: self.own], candidate, values)

    def answer(self, slope: Any, moved: Array) -> Array:
        """Call the model with its own parameters."""
        return self._inner.answer(slope, moved)


def chosen(model: Model, spec: EffectSpec, timed: bool) -> Candidate:
    """The candidate that `spec` names. Raises InputError with those there are."""
    candidate_effects = candidates(model.ports, timed)
    at = [
        c
        for c in candidate_effects
        if spec.id in (c.effect.id, *c.effect.spans)
        and spec.at in (c.port.name, c.port.subsystem)
        and f"{c.effect.id}:{c.form}@{c.port.name}" not in model.taken
    ]
    if not at:
        raise InputError(
            "effect",
            f"{spec.id}@{spec.at}",
            "one of " + ", ".join(dict.fromkeys(f"{c.effect.id}@{c.port.name}" for c in candidate_effects)),
        )
    exact = [c for c in at if c.form == spec.form and c.source == (spec.source or c.source) and fits(c, spec)]
    if not exact:
        alike = [c for c in at if fits(c, spec)] or at
        written = [",".join(f"{key}={v}" for key, v in (("source", c.source), ("form", c.form)) if v) for c in alike]
        raise InputError(
            f"effect {spec.id}@{spec.at}",
            f"source {spec.source!r}, form {spec.form!r}, {', '.join(spec.values)}",
            "in front of the values one of " + " | ".join(dict.fromkeys(text or "no source and form" for text in written)),
        )
    return exact[0]


def fits(candidate: Candidate, spec: EffectSpec) -> bool:
    """Whether the keys of `spec` begin with the names of the candidate's parameters (units follow)."""
    from host.diagnosis.model.effect import Scale

    size = Scale("x", 1.0, -1.0, 1.0, 1.0, 1e-3, 1.0, 1e-2, 10.0, True, "x")
    names = [p.name for p in candidate.effect.parameters(size, candidate.form)]
    return all(any(key.startswith(name) for name in names) for key in spec.values)


def placed(candidate: Candidate, parameters: tuple[Parameter, ...], spec: EffectSpec) -> tuple[Parameter, ...]:
    """`parameters` that start at the values given, renamed after effect and place. Raises InputError for a
    key unknown.
    """
    from dataclasses import replace

    keys = {p.key: p for p in parameters}
    for key in spec.values:
        if key not in keys:
            raise InputError(f"effect {candidate.effect.id}@{candidate.port.name}", key, "one of " + ", ".join(keys))
    out = []
    for key, p in keys.items():
        value = spec.values.get(key, p.grid[0])
        bounds = (min(p.low, value), max(p.high, value)) if spec.free else (value, value)
        out.append(
            replace(
                p,
                name=f"{candidate.effect.id}_{candidate.port.name}_{p.name}",
                grid=(value,),
                low=bounds[0],
                high=bounds[1],
                step=p.step or abs(value) or 1.0,
            )
        )
    return tuple(out)
