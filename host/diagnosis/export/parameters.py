"""The parameters of a simulator as it takes them: names and values as JSON."""

from __future__ import annotations

import json

from host.diagnosis.export.module import extended
from host.diagnosis.models.simulated import SimulatedModel
from host.diagnosis.pipeline import Diagnosis
from protocol.errors import InputError


def parameter_values(result: Diagnosis) -> dict[str, float]:
    """Every fitted parameter of the simulator by name, nominal ones and those offered that were found.

    Raises:
        InputError: the kind runs no simulator, or an effect acts outside the simulator, where no parameter stands for it.
    """
    theta, active = extended(result)
    model = result.model.inner
    if not isinstance(model, SimulatedModel):
        raise InputError("--export", f"kind {model.kind}", "a kind that runs a simulator, or a file ending in .py")
    outside = [candidate.key for candidate, _ in active if not candidate.port.offers]
    if outside:
        wanted = "effects that the simulator offers; a file ending in .py holds every effect"
        raise InputError("--export", f"{outside[0]}, which no parameter of the simulator stands for", wanted)
    values = {p.name: float(value) for p, value in zip(model.parameters, theta, strict=True)}
    return values | {candidate.port.name: float(its[0]) for candidate, its in active}


def parameters_of(result: Diagnosis) -> str:
    """Names and values as one JSON object."""
    return json.dumps(parameter_values(result), indent=2) + "\n"
