"""The extended model as a file: a module equals the finder's simulation, parameters go by name."""

from __future__ import annotations

import json
import os
import runpy
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from host.diagnosis.effects import candidates
from host.diagnosis.estimation.fit import Fit, Term
from host.diagnosis.export.module import module_of
from host.diagnosis.export.parameters import parameters_of
from host.diagnosis.export.write import WRITERS, check_target
from host.diagnosis.model.model import scale_of
from host.diagnosis.model.nominal import nominal_of
from host.diagnosis.model.tables import Table
from host.diagnosis.problems import prepare
from protocol.errors import InputError
from tests.host.diagnosis import test_linear

T = np.arange(600) * 0.01
U = np.sin(2 * np.pi * 0.4 * T) + 0.5 * np.sin(2 * np.pi * 1.3 * T + 1.0)
COLUMNS = {"t": T, "u": U, "y": 0.5 * U, "w": np.cos(T)}
CHANNELS = {"u": {"column": "u", "unit": "m"}, "y": {"column": "y", "unit": "m"}, "w": {"column": "w", "unit": "N"}}
COMMON = {"name": "case", "data": {"time": "t"}, "channels": CHANNELS}
LEVER = "def reach(inputs, parameters, time_s):\n    return {'y': parameters['gain'] * inputs['u'] ** 3}\n"
KINDS: dict[str, dict[str, Any]] = {
    "transmission": {"link": [{"subsystem": "cable", "input": "u", "output": "y", "load": ["w"], "lag_order": 1}]},
    "axis": {
        "axis": {"subsystem": "axis", "input": "u", "output": "y", "terms": ["mass", "damping", "stiffness", "offset"]},
        "parameters": {"mass": 0.3, "damping": 1.0, "stiffness": 30.0, "offset": 0.1},
    },
    "callable": {
        "callable": {"function": "lever:reach", "inputs": ["u"], "outputs": ["y"], "load": ["w"]},
        "parameters": {"gain": 1.2},
    },
    "linear": {"linear": test_linear.THIRD["linear"], "parameters": test_linear.THIRD["parameters"]},
}


def case(folder: Path, kind: str, keys: tuple[str, ...]) -> Any:
    """A diagnosis that found `keys`, with the values that their grids have first."""
    (folder / "lever.py").write_text(LEVER)
    spec = nominal_of({**COMMON, "kind": kind, **KINDS[kind]}, folder)
    return found(spec, COLUMNS, keys)


def found(spec: Any, columns: dict[str, Any], keys: tuple[str, ...]) -> Any:
    model, problem, _ = prepare(spec, [Table("r", columns)])
    every = {candidate.key: candidate for candidate in candidates(model.ports, True)}
    terms = []
    for key in keys:
        scale = scale_of(model, problem.segments, every[key].port, every[key], 0.1)
        terms.append(Term(every[key], every[key].effect.parameters(scale, every[key].form)))
    values = np.concatenate([model.guess(problem.segments), [p.grid[-1] for term in terms for p in term.parameters]])
    return SimpleNamespace(spec=spec, model=model, problem=problem, found=SimpleNamespace(best=Fit(tuple(terms), values)))


def simulated(result: Any) -> np.ndarray:
    """Outputs by the finder."""
    best = result.found.best
    return np.asarray(result.problem.simulate(result.problem.segments[0], best.terms, best.values))


EFFECTS = {
    "transmission": [
        ("backlash@cable",),
        ("compliance@cable(w)", "latency@cable"),
        ("creep_relaxation@cable",),
        ("rate_lag@cable", "sensor_drift@cable_reading"),
        ("rate_lag@cable(digital)", "periodic_disturbance@cable_reading(phases)"),
    ],
    "axis": [
        ("coulomb_friction@axis", "nonlinear_stiffness@axis"),
        ("presliding_friction@axis(dahl)", "latency@axis_drive"),
    ],
    "callable": [("backlash@u", "latency@y_reading"), ("resonance@u",)],
    "linear": [("backlash@u",), ()],
}
CASES = [(kind, keys) for kind, each in EFFECTS.items() for keys in each]


@pytest.mark.slow  # exported kernels are compiled anew
@pytest.mark.parametrize(("kind", "keys"), CASES, ids=["+".join((kind, *keys)) for kind, keys in CASES])
def test_a_module_equals_the_simulation(tmp_path: Path, kind: str, keys: tuple[str, ...]) -> None:
    result = case(tmp_path, kind, keys)
    segment = result.problem.segments[0]
    segment.start = {port.name: 0.02 for port in result.model.ports}
    segment.start |= {f"{port.name}/{name}": 0.03 for port in result.model.ports for name in ("cosine", "sine")}
    if segment.begin is not None:
        segment.begin.values = np.zeros(segment.begin.values.size)
    target = tmp_path / "extended.py"
    target.write_text(module_of(result))
    simulate = runpy.run_path(str(target))["simulate"]
    out = simulate(
        {name: segment.recording.channels[name] for name in ("u", "w") if name in segment.recording.channels},
        segment.recording.time_s,
        None,
        segment.start,
    )
    exact = simulated(result)[0]
    assert float(np.max(np.abs(out["y"] - exact))) <= 1e-9 * float(np.max(np.abs(exact)))


@pytest.mark.slow
def test_a_module_imports_nothing_of_the_project(tmp_path: Path) -> None:
    (tmp_path / "extended.py").write_text(module_of(case(tmp_path, "axis", ("coulomb_friction@axis",))))
    probe = (
        "import sys, numpy as np, extended as m; t = np.arange(100) * 0.01; m.simulate({'u': np.sin(t)}, t);"
        "print([n for n in sys.modules if n.partition('.')[0] in ('host', 'protocol', 'realtime', 'sim', 'seldinger')])"
    )
    plain = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}  # our cache of kernels
    done = subprocess.run([sys.executable, "-c", probe], cwd=tmp_path, capture_output=True, text=True, check=True, env=plain)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize(("name", "wanted"), [("model.txt", "ending in"), ("no/where.py", "folder that exists")])
def test_a_target_that_cannot_be_is_bad_input(tmp_path: Path, name: str, wanted: str) -> None:
    with pytest.raises(InputError, match=wanted):
        check_target(tmp_path / name)


def test_a_file_that_the_kind_does_not_have_is_refused_before_the_search(tmp_path: Path) -> None:
    for kind, suffixes in (("axis", {".py"}), ("mujoco", {".json", ".xml"}), ("rig", {".toml"}), ("impedance", set())):
        for suffix in WRITERS:
            if suffix in suffixes:
                check_target(tmp_path / f"model{suffix}", kind)
                continue
            with pytest.raises(InputError, match=kind):
                check_target(tmp_path / f"model{suffix}", kind)


def test_an_effect_outside_the_simulator_is_no_parameter_of_it(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no parameter of the simulator"):
        parameters_of(case(tmp_path, "callable", ("backlash@u",)))
    assert json.loads(parameters_of(case(tmp_path, "callable", ()))) == {"gain": 1.2}
