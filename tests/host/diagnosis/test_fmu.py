"""Functional mock-up units as nominal models: a small unit is compiled here, for both versions of FMI."""

from __future__ import annotations

import shutil
import subprocess
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import cont2discrete

from host.diagnosis.export.parameters import ssv_of
from host.diagnosis.model.nominal import nominal_of
from host.diagnosis.model.tables import Table
from host.diagnosis.model.trust import code_of, code_path
from host.diagnosis.problems import prepare
from protocol.errors import InputError
from tests.host.diagnosis.test_export import found

fmpy = pytest.importorskip("fmpy", reason="FMPy is not installed: pip install 'seldinger[fmu]'")
if shutil.which("gcc") is None:
    pytest.skip("gcc is not installed", allow_module_level=True)

# A sprung and damped shaft with Coulomb friction: inertia phi'' = torque - damping phi' - stiffness phi - friction.
SOURCE = r"""
#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdlib.h>
enum { TORQUE, ANGLE, TWICE, INERTIA, DAMPING, STIFFNESS, FRICTION, ANGLE_0, SPEED_0, COUNT };
typedef struct { double v[COUNT], x[2]; } Unit;
static void defaults(Unit *u) {
    const double first[COUNT] = {0, 0, 0, 0.02, 0.1, 3.0, 0, 0, 0};
    for (int i = 0; i < COUNT; i++) u->v[i] = first[i];
    u->x[0] = u->x[1] = 0;
}
static double speed_up(const Unit *u, double a, double w) {
    const double *v = u->v;
    return (v[TORQUE] - v[DAMPING] * w - v[STIFFNESS] * a - v[FRICTION] * tanh(w / 1e-3)) / v[INERTIA];
}
static int step(Unit *u, double h) {
    int n = (int)ceil(h / 2e-4);
    if (u->v[INERTIA] <= 0) return 3;
    h /= n;
    for (int i = 0; i < n; i++) {
        double a = u->x[0], w = u->x[1], b[4], s[4], c = 0;
        for (int k = 0; k < 4; k++) {
            double at = k == 3 ? h : 0.5 * h;
            double aa = k ? a + at * s[k - 1] : a, ww = k ? w + at * b[k - 1] : w;
            s[k] = ww; b[k] = speed_up(u, aa, ww); (void)c;
        }
        u->x[0] += h / 6 * (s[0] + 2 * s[1] + 2 * s[2] + s[3]);
        u->x[1] += h / 6 * (b[0] + 2 * b[1] + 2 * b[2] + b[3]);
    }
    return 0;
}
static void begin(Unit *u) { u->x[0] = u->v[ANGLE_0]; u->x[1] = u->v[SPEED_0]; }
static int get(Unit *u, const unsigned *r, size_t n, double *out) {
    u->v[ANGLE] = u->x[0]; u->v[TWICE] = 2 * u->v[TORQUE];
    for (size_t i = 0; i < n; i++) out[i] = u->v[r[i]];
    return 0;
}
static int set(Unit *u, const unsigned *r, size_t n, const double *in) {
    for (size_t i = 0; i < n; i++) u->v[r[i]] = in[i];
    return 0;
}
static Unit *make(void) { Unit *u = malloc(sizeof(Unit)); defaults(u); return u; }
#if FMI == 2
void *fmi2Instantiate(const char *a, int b, const char *c, const char *d, const void *e, int f, int g) { return make(); }
void fmi2FreeInstance(void *u) { free(u); }
int fmi2SetupExperiment(void *u, int a, double b, double c, int d, double e) { return 0; }
int fmi2EnterInitializationMode(void *u) { return 0; }
int fmi2ExitInitializationMode(void *u) { begin(u); return 0; }
int fmi2Terminate(void *u) { return 0; }
int fmi2Reset(void *u) { defaults(u); return 0; }
int fmi2GetReal(void *u, const unsigned *r, size_t n, double *out) { return get(u, r, n, out); }
int fmi2SetReal(void *u, const unsigned *r, size_t n, const double *in) { return set(u, r, n, in); }
int fmi2DoStep(void *u, double t, double h, int a) { return step(u, h); }
#else
void *fmi3InstantiateCoSimulation(const char *a, const char *b, const char *c, bool d, bool e, bool f, bool g,
    const unsigned *h, size_t i, void *j, void *k, void *l) { return make(); }
void fmi3FreeInstance(void *u) { free(u); }
int fmi3EnterInitializationMode(void *u, bool a, double b, double c, bool d, double e) { return 0; }
int fmi3ExitInitializationMode(void *u) { begin(u); return 0; }
int fmi3Terminate(void *u) { return 0; }
int fmi3Reset(void *u) { defaults(u); return 0; }
int fmi3GetFloat64(void *u, const unsigned *r, size_t n, double *out, size_t m) { return get(u, r, n, out); }
int fmi3SetFloat64(void *u, const unsigned *r, size_t n, const double *in, size_t m) { return set(u, r, n, in); }
int fmi3DoStep(void *u, double t, double h, bool a, bool *b, bool *c, bool *d, double *last) {
    *b = *c = *d = false; *last = t + h;
    return step(u, h);
}
#endif
"""
NAMES = ("torque", "angle", "twice", "inertia", "damping", "stiffness", "friction", "angle_0", "speed_0")
STARTS = (0, None, None, 0.02, 0.1, 3.0, 0, 0, 0)


def description(version: int, co_simulation: bool = True) -> str:
    """modelDescription.xml of the unit."""
    time = '<Float64 name="time" valueReference="99" causality="independent" variability="continuous"/>'
    variables, outputs = [time] if version == 3 else [], []
    for reference, (name, start) in enumerate(zip(NAMES, STARTS, strict=True)):
        causality = "output" if start is None else "input" if name == "torque" else "parameter"
        variability = "fixed" if causality == "parameter" else "continuous"
        begin = "" if start is None else f' start="{start}"'
        common = f'name="{name}" valueReference="{reference}" causality="{causality}" variability="{variability}"'
        if version == 2:
            variables.append(f"<ScalarVariable {common}><Real{begin}/></ScalarVariable>")
        else:
            variables.append(f"<Float64 {common}{begin}/>")
        if causality == "output":
            outputs.append(
                f'<Unknown index="{reference + 1}"/>' if version == 2 else f'<Output valueReference="{reference}"/>'
            )
    kind = "CoSimulation" if co_simulation else "ModelExchange"
    listed = "".join(outputs)
    structure = f"<ModelStructure><Outputs>{listed}</Outputs></ModelStructure>"
    token = 'guid="{shaft}"' if version == 2 else 'instantiationToken="{shaft}"'
    return (
        f'<?xml version="1.0"?><fmiModelDescription fmiVersion="{version}.0" modelName="shaft" {token}>'
        f'<{kind} modelIdentifier="shaft"{" canHandleVariableCommunicationStepSize=" + chr(34) + "true" + chr(34)}/>'
        f"<ModelVariables>{''.join(variables)}</ModelVariables>"
        f"{structure if version == 2 else f'<ModelStructure>{listed}</ModelStructure>'}</fmiModelDescription>"
    )


@pytest.fixture(scope="module", params=[2, 3])
def unit(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The unit of one version of FMI."""
    folder, version = tmp_path_factory.mktemp("unit"), request.param
    slave = fmpy.fmi2.FMU2Slave if version == 2 else fmpy.fmi3.FMU3Slave
    every = [name for one in slave.__mro__ for name in vars(one) if name.startswith(f"fmi{version}")]
    unused = [f"int {name}(void) {{ return 0; }}" for name in dict.fromkeys(every) if f"{name}(" not in SOURCE]
    (folder / "shaft.c").write_text("\n".join([SOURCE, *unused]))
    library = folder / "shaft.so"
    command = [
        "gcc",
        "-w",
        "-O2",
        "-shared",
        "-fPIC",
        f"-DFMI={version}",
        "-o",
        str(library),
        str(folder / "shaft.c"),
        "-lm",
    ]
    subprocess.run(command, check=True)
    place = f"binaries/{fmpy.platform if version == 2 else fmpy.platform_tuple}/shaft{fmpy.sharedLibraryExtension}"
    with zipfile.ZipFile(folder / "shaft.fmu", "w") as file:
        file.writestr("modelDescription.xml", description(version))
        file.write(library, place)
    return folder / "shaft.fmu"


T = 0.01 * np.arange(400)
TORQUE = 0.6 * np.sin(2 * np.pi * 0.7 * T + 0.4) + 0.3 * np.sin(2 * np.pi * 2.1 * T)
NOMINAL: dict[str, Any] = {
    "name": "shaft",
    "kind": "fmu",
    "data": {"time": "t"},
    "channels": {"drive": {"column": "u", "unit": "N m"}, "angle": {"column": "y", "unit": "rad"}},
    "fmu": {
        "model": "shaft.fmu",
        "inputs": ["drive"],
        "outputs": ["angle"],
        "variables": {"drive": "torque"},
        "initial": {"angle": "angle_0", "angle_rate": "speed_0"},
    },
    "parameters": {"damping": {"value": 0.1, "low": 0.0, "high": 5.0, "unit": "N m s"}},
    "offer": [{"id": "coulomb_friction", "parameter": "friction", "high": 1.0, "unit": "N m", "subsystem": "bearing"}],
}


def nominal(unit: Path, **changed: Any) -> Any:
    return nominal_of({**NOMINAL, **changed}, unit.parent)


def exact(x0: tuple[float, float], inertia: float = 0.02, damping: float = 0.1, stiffness: float = 3.0) -> np.ndarray:
    """The angle without friction, by the exact discretization of a held torque."""
    A = np.array([[0.0, 1.0], [-stiffness / inertia, -damping / inertia]])
    Ad, Bd, *_ = cont2discrete((A, np.array([[0.0], [1.0 / inertia]]), np.eye(2), np.zeros((2, 1))), 0.01)
    x, rows = np.array(x0), []
    for u in TORQUE:
        rows.append(x[0])
        x = Ad @ x + Bd[:, 0] * u
    return np.array(rows)


def columns(angle: np.ndarray) -> dict[str, np.ndarray]:
    return {"t": T, "u": TORQUE, "y": angle}


def test_a_run_is_the_exact_solution_from_its_initial_state(unit: Path) -> None:
    model, problem, _ = prepare(nominal(unit), [Table("r", columns(exact((0.2, -1.0))))])
    segment = problem.segments[0]
    assert segment.begin is not None and segment.begin.names == ("angle", "angle_rate")
    segment.begin.values = np.array([0.2, -1.0])
    for _ in range(2):  # the second run begins where the first did
        assert np.allclose(model.simulate(segment, np.array([0.1]), [])[0], exact((0.2, -1.0)), atol=1e-7)
    assert np.allclose(model.simulate(segment, np.array([0.3]), [])[0], exact((0.2, -1.0), damping=0.3), atol=1e-7)


def test_an_output_that_answers_at_once_is_not_late(unit: Path) -> None:
    fmu = {**NOMINAL["fmu"], "variables": {"drive": "torque", "angle": "twice"}, "initial": {}}
    model, problem, _ = prepare(nominal(unit, fmu=fmu), [Table("r", columns(TORQUE))])
    assert np.allclose(model.simulate(problem.segments[0], np.array([0.1]), [])[0], 2.0 * TORQUE)


def test_a_unit_that_fails_gives_no_numbers_and_runs_again(unit: Path) -> None:
    parameters = {**NOMINAL["parameters"], "inertia": 0.02}
    model, problem, _ = prepare(nominal(unit, parameters=parameters), [Table("r", columns(exact((0.0, 0.0))))])
    segment = problem.segments[0]
    assert np.isnan(model.simulate(segment, np.array([0.1, -1.0]), [])[0, 1:]).all()
    assert np.isfinite(model.simulate(segment, np.array([0.1, 0.02]), [])).all()


def test_offered_parameters_compete_and_go_into_a_parameter_set(unit: Path) -> None:
    result = found(nominal(unit), columns(exact((0.0, 0.0))), ("coulomb_friction@friction",))
    assert result.found.best.terms[0].candidate.port.subsystem == "bearing"
    text = ssv_of(result)
    assert '<ssv:Parameter name="friction">' in text and '<ssv:Real value="0.1"' in text


def test_what_runs_is_named_before_it_runs(unit: Path) -> None:
    spec = nominal(unit)
    assert code_path(spec) == unit and "shaft.fmu" in code_of(spec)


@pytest.mark.parametrize(
    ("changed", "wanted"),
    [
        ({"fmu": {**NOMINAL["fmu"], "variables": {"drive": "moment"}}}, "fmu.inputs: .*moment.*torque"),
        ({"fmu": {**NOMINAL["fmu"], "variables": {"drive": "torque", "angle": "phi"}}}, "fmu.outputs"),
        ({"fmu": {**NOMINAL["fmu"], "initial": {"angle": "phi_0"}}}, "fmu.initial"),
        ({"parameters": {"mass": 1.0}}, "fmu.parameters: .*mass.*inertia"),
        ({"parameters": {"angle": 1.0}}, "angle, which is output"),
        ({"fmu": {**NOMINAL["fmu"], "model": "none.fmu"}}, "fmu.model"),
        ({"fmu": {**NOMINAL["fmu"], "model": "broken.fmu"}}, "fmu.model"),
        ({"fmu": {**NOMINAL["fmu"], "model": "exchange.fmu"}}, "without co-simulation"),
        ({"fmu": {**NOMINAL["fmu"], "model": "elsewhere.fmu"}}, "an FMU with a library for"),
    ],
)
def test_bad_input_is_one_line(unit: Path, changed: dict[str, Any], wanted: str) -> None:
    (unit.parent / "broken.fmu").write_bytes(b"PK not a zip")
    with zipfile.ZipFile(unit.parent / "exchange.fmu", "w") as file:
        file.writestr(
            "modelDescription.xml",
            description(2, co_simulation=False).replace("canHandleVariableCommunicationStepSize", "needsExecutionTool"),
        )
    with zipfile.ZipFile(unit.parent / "elsewhere.fmu", "w") as file:
        file.writestr("modelDescription.xml", description(2))
        file.writestr("binaries/win32/shaft.dll", b"")
    with pytest.raises(InputError, match=wanted) as refused:
        prepare(nominal(unit, **changed), [Table("r", columns(exact((0.0, 0.0))))])
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("changed", "wanted"),
    [({"variables": {"wheel": "torque"}}, "not wheel"), ({"initial": {"winding": "i_0"}}, "not winding")],
)
def test_names_of_the_file_are_checked(changed: dict[str, Any], wanted: str) -> None:
    with pytest.raises(InputError, match=wanted):
        nominal_of({**NOMINAL, "fmu": {**NOMINAL["fmu"], **changed}})
