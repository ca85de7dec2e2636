"""The parameters of a simulator as it takes them: names and values as JSON, or as the parameter file of FMI tools (SSV)."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET

from host.diagnosis.export.module import extended
from host.diagnosis.models.fmu import FmuModel
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
    outside = [candidate.key for candidate, _ in active if candidate.port.kind != "offered"]
    if outside:
        wanted = "effects that the simulator offers; a file ending in .py holds every effect"
        raise InputError("--export", f"{outside[0]}, which no parameter of the simulator stands for", wanted)
    values = {p.name: float(value) for p, value in zip(model.parameters, theta, strict=True)}
    return values | {candidate.port.name: float(its[0]) for candidate, its in active}


def parameters_of(result: Diagnosis) -> str:
    """Names and values as one JSON object."""
    return json.dumps(parameter_values(result), indent=2) + "\n"


SSV = "http://ssp-standard.org/SSP1/SystemStructureParameterValues"


def ssv_of(result: Diagnosis) -> str:
    """Names and values as a parameter set of SSP 1.0, which tools apply to the unit. Raises InputError for another kind."""
    model = result.model.inner
    if not isinstance(model, FmuModel):
        raise InputError("--export", f"kind {model.kind}", "kind fmu, for a file ending in .ssv")
    ET.register_namespace("ssv", SSV)
    root = ET.Element(f"{{{SSV}}}ParameterSet", {"version": "1.0", "name": model.path.stem})
    entries = ET.SubElement(root, f"{{{SSV}}}Parameters")
    for name, value in parameter_values(result).items():
        entry = ET.SubElement(entries, f"{{{SSV}}}Parameter", {"name": name})
        ET.SubElement(entry, f"{{{SSV}}}Real", {"value": repr(value)})
    ET.indent(root)
    return ET.tostring(root, encoding="unicode", xml_declaration=True) + "\n"
