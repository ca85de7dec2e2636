"""A Python function as nominal model; effects act on what goes into it and on what comes out."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from host.diagnosis.model.dataset import Recording
from host.diagnosis.model.effect import Parameter, Port
from host.diagnosis.model.model import ActiveEffect, Model, Output, Segment, apply_effects, filled, stack, tolerance_of
from host.diagnosis.model.nominal import NominalSpec
from protocol.errors import InputError

Array = npt.NDArray[np.float64]
Function = Callable[[dict[str, Array], dict[str, float], Array], dict[str, Array]]


class ExternalModel(Model):
    """Nominal model of kind `callable`. A port at every input, before the function, and at every output, behind it."""

    kind = "callable"
    scan_points = 24

    def __init__(self, spec: NominalSpec) -> None:
        if spec.callable is None:
            raise ValueError("callable: found nothing, wanted a section")
        self.spec = spec.callable
        self.function = function_of(self.spec.function, spec.folder)
        self.units = {name: channel.unit for name, channel in spec.channels.items()}
        inputs, outputs, name = self.spec.inputs, self.spec.outputs, self.spec.subsystem
        self.outputs = tuple([Output(output, self.units[output], name) for output in outputs])
        loads = tuple(self.spec.load)
        self.ports: tuple[Port, ...] = tuple(
            [
                Port(
                    channel,
                    "motion+turn" if self.units[channel] == "rad" else "motion",
                    name,
                    tuple(outputs),
                    loads,
                    tuple(other for other in inputs if other != channel),
                )
                for channel in inputs
            ]
        )
        self.ports += tuple(
            [
                Port(f"{channel}_reading", "drift+timing+limit+mix", name, (channel,), loads, tuple(inputs))
                for channel in outputs
            ]
        )
        parameters = []
        for key in spec.parameters:
            value, free = spec.start(key, 0.0)
            bounds = (-np.inf, np.inf) if free else (value, value)
            parameters.append(Parameter(key, "", (value,), *bounds, step=abs(value) or 1.0))
        self.parameters = tuple(parameters)
        self.travel = tuple((n.replace("_", " "), n, self.units[n]) for n in dict.fromkeys((*inputs, *loads)))
        self.unlisted_at = tuple((channel, channel) for channel in inputs)
        self.moves = {channel: channel for channel in inputs}
        self.quiet_inputs = tuple(dict.fromkeys((*inputs, *loads)))

    def prepare(self, recording: Recording) -> Segment:
        """Inputs bridged, outputs stacked."""
        spec = self.spec
        segment = Segment(
            recording,
            stack(recording, spec.outputs),
            recording.fit,
            recording.heldout,
            filled(recording, list(self.quiet_inputs)),
        )
        units = dict(self.units)
        for channel in spec.inputs:
            values = segment.inputs[channel]
            segment.tolerances[channel] = tolerance_of(values, float(np.ptp(values)))
            units[f"output:{channel}"] = self.units[channel]
        segment.units = {**units, **{f"{channel}_reading": self.units[channel] for channel in spec.outputs}}
        return segment

    def guess(self, segments: list[Segment]) -> Array:
        """Start values of the TOML."""
        return np.array([p.grid[0] for p in self.parameters])

    def simulate(self, segment: Segment, theta: Array, active: list[ActiveEffect]) -> Array:
        """Every output (outputs, n). Raises InputError where the function does not give what it should."""
        given = {name: apply_effects(segment.inputs[name], active, name, segment, None) for name in self.spec.inputs}
        values = {p.name: float(value) for p, value in zip(self.parameters, theta, strict=True)}
        found = self.function(given, values, segment.recording.time_s)
        rows = []
        for name in self.spec.outputs:
            row = np.asarray(found[name] if isinstance(found, dict) and name in found else np.nan, dtype=np.float64)
            if row.shape != (segment.n,):
                raise InputError(
                    "callable.function",
                    f"{self.spec.function} gave {name} of shape {row.shape}",
                    f"a dictionary with {name} of shape ({segment.n},)",
                )
            rows.append(apply_effects(row, active, f"{name}_reading", segment, None))
        return np.vstack(rows)

    def motion(self, segment: Segment, port: Port) -> Array:
        """The input at its port, or the measured output."""
        if port.name in segment.inputs:
            return segment.inputs[port.name]
        row = segment.y[self.spec.outputs.index(port.channels[0])]
        return np.where(np.isfinite(row), row, np.nanmedian(row))

    def needs(self, segment: Segment, port: Port, theta: Array, residual: Array) -> Array:
        """Residual of the port's output; at an input, what it would have to be moved by, all outputs weighed by their
        noise.
        """
        if port.name not in segment.inputs:
            return np.asarray(residual[self.spec.outputs.index(port.channels[0])])
        step = 1e-4 * (float(np.ptp(segment.inputs[port.name])) or 1.0)
        moved = replace(segment, inputs={**segment.inputs, port.name: segment.inputs[port.name] + step})
        slope = (self.simulate(moved, theta, []) - self.simulate(segment, theta, [])) / step
        weight = segment.weights()
        s = np.where(np.isfinite(residual), slope, 0.0) / weight
        return np.asarray(
            np.sum(s * np.nan_to_num(residual) / weight, axis=0) / (np.sum(s * s, axis=0) + 1e-12 * np.mean(s * s) + 1e-300)
        )


def function_of(text: str, folder: str) -> Function:
    """The function that `text` (module:name) stands for; modules are looked for in `folder` too. Raises InputError."""
    module, _, name = text.partition(":")
    sys.path.insert(0, folder)
    try:
        found: Any = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise InputError("callable.function", f"{text} ({error})", "module:name of a Python function") from None
    finally:
        sys.path.remove(folder)
    if not callable(found):
        raise InputError("callable.function", text, "module:name of a Python function")
    return found
