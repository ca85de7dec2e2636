"""The extended model as a Python module: gathered sources, fitted numbers, and one function `simulate`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from host.diagnosis.estimation.known import Known
from host.diagnosis.export import runtime
from host.diagnosis.export.sources import Gathered
from host.diagnosis.model.force_kernel import slot_array
from host.diagnosis.model.model import ActiveEffect
from host.diagnosis.models.axis import AxisModel
from host.diagnosis.models.external import ExternalModel, module_path
from host.diagnosis.models.linear import LinearModel
from host.diagnosis.models.simulated import SimulatedModel
from host.diagnosis.models.transmission import TransmissionModel
from host.diagnosis.pipeline import Diagnosis
from protocol.errors import InputError

Array = npt.NDArray[np.float64]
HEAD = '''"""{name}: the nominal model with the effects that a diagnosis found. Runs without the diagnosis.

    simulate(inputs, time_s, initial=None, start=None) -> outputs

inputs, outputs: dictionaries of arrays (n,) in SI units, by channel. time_s: (n,), evenly spaced.
initial: state at the first sample ({initial}). start: port -> displacement of a memory at the first sample.

Effects: {effects}.
"""

from __future__ import annotations

'''
NUMBA = """try:
    from numba import njit
except ImportError:

    def njit(*given, **options):
        \"\"\"Run a function as it is written.\"\"\"
        return given[0] if given else lambda function: function
"""


def module_of(result: Diagnosis) -> str:
    """Source text of a module that simulates the extended model of `result`. Raises InputError for a kind without one."""
    theta, active = extended(result)
    gathered = Gathered()
    for one in (runtime.ExportedEffect, runtime.ExportedRun):
        gathered.add(one)
    model = result.model.inner
    active = model.components(active) if isinstance(model, SimulatedModel) else active
    law, initial = _law(model, theta, active, gathered)
    effects = []
    for candidate, values in sorted(active, key=lambda one: one[0].effect.order):
        if candidate.effect.apply is None:
            continue
        name = gathered.add(candidate.effect.apply)
        numbers = tuple(float(value) for value in values)
        form, source, side = candidate.form, candidate.source, candidate.effect.side
        last = f", {candidate.effect.memories!r}" if candidate.effect.memories else ""
        listed = f"{candidate.port.name!r}, {name}, {numbers!r}, {form!r}, {source!r}, {side!r}{last}"
        effects.append(f"    ExportedEffect({listed}),")
    gathered.imports.setdefault("import numpy as np")
    text = gathered.text().replace("from numba import njit\n", NUMBA)
    named = ", ".join(candidate.key for candidate, _ in active) or "none"
    listed = "\n".join(["EFFECTS = (", *effects, ")"])
    head = HEAD.format(name=result.spec.name, effects=named, initial=initial)
    return f"{head}{text}\n\n{listed}\n{law}"


def extended(result: Diagnosis) -> tuple[Array, list[ActiveEffect]]:
    """Nominal parameters without those of known effects, and all effects, known ones too. Raises InputError."""
    best = result.found.best
    theta, active = result.problem.parted(best.terms, best.values)
    if isinstance(result.model, Known):
        active, theta = result.model.with_known(theta, active), theta[: result.model.own]
    dated = [candidate.key for candidate, _ in active if candidate.effect.dated]
    if dated:
        raise InputError("--export", f"{dated[0]}, events at instants of these recordings", "effects of every recording")
    searched = [candidate.key for candidate, _ in active if candidate.effect.searched]
    if searched:
        raise InputError("--export", f"{searched[0]}, an equation found by search", "effects of the vocabulary")
    return theta, active


SIMULATE = """

def simulate(inputs, time_s, initial=None, start=None):
    \"\"\"Outputs by channel, each (n,), for inputs by channel; see the head of this file.\"\"\"
    run = ExportedRun(inputs, time_s, start or {}, EFFECTS)
"""


def _law(model: Any, theta: Array, active: list[ActiveEffect], gathered: Gathered) -> tuple[str, str]:
    """Constants and the function `simulate` of this kind, and what its initial state is."""
    if isinstance(model, TransmissionModel):
        return _links(model, theta, gathered), "none"
    if isinstance(model, AxisModel) and model.free_run and model.spec.controller is None:
        said = "position and speed; then those of a second mass from there, if the law has one"
        return _axis(model, theta, active, gathered), said
    along = [c.key for c, _ in active if {"force", "chain"} & set(c.port.kind.split("+"))]
    if along:
        wanted = "effects at inputs and outputs, or a parameter that the simulator offers ([[offer]])"
        raise InputError("--export", f"{along[0]}, a force along a motion", wanted)
    values = {p.name: float(value) for p, value in zip(model.parameters, theta, strict=True)}
    values |= {c.port.name: float(its[0]) for c, its in active if c.port.kind == "offered"}
    if isinstance(model, ExternalModel):
        return _function(model, {**model.offs, **values}, gathered), "as the function takes it"
    if isinstance(model, LinearModel) and model.spec.feedback is None:
        return _linear(model, {**model.offs, **values}, gathered), "state vector"
    wanted = "kind transmission, axis (simulated, without controller), callable or linear (without feedback)"
    raise InputError("--export", f"kind {model.kind}", f"{wanted}, for a module")


def _array(values: Any) -> str:
    return f"np.array({np.asarray(values).tolist()!r})"


def _links(model: TransmissionModel, theta: Array, gathered: Gathered) -> str:
    gathered.add(runtime.run_links)
    gathered.add(runtime.ExportedLink)
    rows, at = [], 0
    for name, link in zip(model.names, model.links, strict=True):
        lags = tuple(float(value) for value in theta[at + 2 : at + 2 + link.lag_order])
        one = runtime.ExportedLink(name, link.input, link.output, float(theta[at]), float(theta[at + 1]), lags)
        rows.append(f"    {one!r},")
        at += 2 + link.lag_order
    listed = "\n".join(["LINKS = (", *rows, ")"])
    return f"{listed}\n{SIMULATE}    return run_links(LINKS, run)\n"


def _axis(model: AxisModel, theta: Array, active: list[ActiveEffect], gathered: Gathered) -> str:
    gathered.add(runtime.run_axis_law)
    spec = model.spec
    given = dict(zip(spec.terms, map(float, theta), strict=True))
    linear = [given.get("mass", 1.0), given.get("damping", 0.0), given.get("stiffness", 0.0), given.get("offset", 0.0)]
    slots = [c.effect.slots(values, c.form) for c, values in active if c.effect.slots is not None]
    p = slot_array([*slots, {"stiffness": linear[2]}])
    names = {"input": spec.input, "output": spec.output, "subsystem": spec.subsystem, "reads": spec.reads}
    substeps = 2 if "stiffness" not in spec.terms else 3
    return (
        f"NAMES = {names!r}\nLINEAR = {_array(linear)}  # mass, damping, stiffness, offset\nSLOTS = {_array(p)}\n{SIMULATE}"
        f"    begin = np.zeros(2) if initial is None else np.asarray(initial, dtype=float)\n"
        f"    return run_axis_law(NAMES, {model.hold!r}, {substeps}, LINEAR, SLOTS, begin, run)\n"
    )


def _function(model: ExternalModel, values: dict[str, float], gathered: Gathered) -> str:
    text = model.spec.function
    if not isinstance(text, str):
        raise InputError("--export", f"the function {model.label}", "module:name in the nominal model, for a module")
    gathered.add(runtime.run_simulator)
    module, _, name = text.partition(":")
    path = module_path(module, model.folder)
    folder = str(Path(model.folder).resolve()) if path is not None else ""
    search = f"sys.path.insert(0, {folder!r})  # where {module}.py lies\n" if folder else ""
    more = ", initial or {}" if model.takes_initial else ""
    names = (tuple(model.spec.inputs), tuple(model.spec.outputs))
    return (
        f"PARAMETERS = {values!r}\nNAMES = {names!r}\n{'import sys' if folder else ''}\n{search}"
        f"from {module} import {name} as simulator  # noqa: E402\n{SIMULATE}"
        f"    return run_simulator(lambda given: simulator(given, dict(PARAMETERS), time_s{more}), NAMES, run)\n"
    )


def _linear(model: LinearModel, values: dict[str, float], gathered: Gathered) -> str:
    gathered.add(runtime.run_simulator)
    gathered.add(runtime.run_state_space)
    A, B, C, D = model.matrices(values)
    names = (tuple(model.spec.inputs), tuple(model.spec.outputs))
    hold = "" if model.spec.period_s is not None else model.hold
    matrices = "".join(f"{key} = {_array(value)}\n" for key, value in zip("ABCD", (A, B, C, D), strict=True))
    return (
        f"PARAMETERS = {values!r}\nNAMES = {names!r}\n{matrices}{SIMULATE}"
        "    begin = np.zeros(A.shape[0]) if initial is None else np.asarray(initial, dtype=float)\n\n"
        "    def plant(given):\n"
        "        u = np.vstack([given[name] for name in NAMES[0]])\n"
        f"        return dict(zip(NAMES[1], run_state_space((A, B, C, D), {hold!r}, begin, u, time_s)))\n\n"
        "    return run_simulator(plant, NAMES, run)\n"
    )
