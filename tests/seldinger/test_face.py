"""The public face: what it holds, what an import costs, its documentation, and that it answers as the rooms behind it."""

from __future__ import annotations

import gc
import inspect
import math
import re
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher

import seldinger as sd

ROOT = Path(__file__).parents[2]
FUNCTIONS = [name for name in sd.__all__ if name[0].islower()]
LIVEWIRE = sd.load_catheter("livewire")
THERMOCOOL = sd.load_catheter("thermocool_sf")
OFFSETS_m = (0.0, 0.03)
FORCE_N = np.array([0.01, 0.04, -0.02])


def sensors(force_N: np.ndarray = FORCE_N) -> list[tuple[float, np.ndarray, np.ndarray]]:
    shape = sd.solve(LIVEWIRE, 0.01, 10.0, force_N, stations_m=OFFSETS_m)
    return list(zip(OFFSETS_m, shape.station_positions_m, shape.station_quaternions_wxyz, strict=True))


def test_the_face_is_seven_functions_and_types() -> None:
    assert sorted(FUNCTIONS) == [
        "calibrate",
        "connect",
        "diagnose",
        "estimate_force",
        "load_catheter",
        "open_recording",
        "solve",
    ]
    assert all(inspect.isclass(getattr(sd, name)) for name in sd.__all__ if name[0].isupper())
    with pytest.raises(AttributeError, match="no attribute 'solv'"):
        _ = sd.solv


def test_an_import_loads_no_library() -> None:
    """Processor time is not asserted: what costs it is numpy, numba, zenoh and pydantic, and none of them is loaded."""
    script = (
        "import sys, seldinger; print(*[m for m in ('numpy', 'numba', 'zenoh', 'pydantic', 'scipy') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.split() == []


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_argument_is_documented(name: str) -> None:
    function = getattr(sd, name)
    text = inspect.getdoc(function) or ""
    for section in ("Parameters:", "Returns:", "Raises:", "Examples:"):
        assert section in text, f"{name}: no section {section}"
    described = text.partition("Parameters:")[2].partition("Returns:")[0]
    for argument in inspect.signature(function).parameters:
        assert re.search(rf"^\s+{argument}: \S", described, re.MULTILINE), f"{name}: {argument} is not documented"


@pytest.mark.parametrize("name", [name for name in sd.__all__ if name[0].isupper()])
def test_every_type_is_documented(name: str) -> None:
    made = getattr(sd, name)
    assert len((made.__doc__ or "").splitlines()[0]) > 20
    for key, member in vars(made).items():
        if not key.startswith("_") and (inspect.isfunction(member) or isinstance(member, property)):
            assert inspect.getdoc(member), f"{name}.{key}"


@pytest.mark.parametrize("frame", ["base", "tip"])
def test_many_cases_are_what_single_calls_give(frame: str) -> None:
    rng = np.random.default_rng(1)
    forces, curvature = rng.uniform(-0.05, 0.05, (40, 3)), rng.uniform(0.0, 30.0, 40)
    insertion = rng.uniform(-0.02, 0.03, 40)
    many = sd.solve(LIVEWIRE, insertion, curvature, forces, frame, stations_m=[0.03, 0.0, 0.2], roll_rad=0.4)
    for i in range(40):
        one = sd.solve(
            LIVEWIRE, insertion[i], float(curvature[i]), forces[i], frame, stations_m=[0.03, 0.0, 0.2], roll_rad=0.4
        )
        assert one.converged == many.converged[i]
        if one.converged:
            assert one.stable == many.stable[i]
            np.testing.assert_allclose(many.tip_position_m[i], one.tip_position_m, rtol=0, atol=1e-8)
            np.testing.assert_allclose(many.station_positions_m[i], one.station_positions_m, rtol=0, atol=1e-8)
            np.testing.assert_allclose(many.force_tip_N[i], one.force_tip_N, rtol=0, atol=1e-8)
        else:
            assert np.isnan(many.tip_position_m[i]).all()


def test_one_force_for_many_curvatures() -> None:
    many = sd.solve(LIVEWIRE, 0.01, [5.0, 10.0], [0.0, 0.01, 0.0])
    assert np.array_equal(many.tip_position_m[1], sd.solve(LIVEWIRE, 0.01, 10.0, [0.0, 0.01, 0.0]).tip_position_m)


def test_many_planar_cases_are_what_single_calls_give() -> None:
    forces = np.array([[0.0, -0.12], [0.05, 0.1], [0.0, 0.0]])
    many = sd.solve(THERMOCOOL, 0.0485, 15.7, forces, model="pcar", stations_m=[0.02, 0.3])
    for i, force in enumerate(forces):
        one = sd.solve(THERMOCOOL, 0.0485, 15.7, force, model="pcar", stations_m=[0.02, 0.3])
        assert one.converged and many.converged[i] and one.stable == many.stable[i]
        for name in ("tip_position_m", "tip_angle_rad", "station_positions_m", "station_angles_rad", "arc_curvatures_per_m"):
            np.testing.assert_allclose(getattr(many, name)[i], getattr(one, name), rtol=0, atol=1e-14)


def test_estimates_find_the_force_one_by_one_and_many_at_once() -> None:
    rng = np.random.default_rng(2)
    forces = np.array([rng.uniform(-0.04, 0.04, 3) for _ in range(20)])
    shapes = sd.solve(LIVEWIRE, 0.01, 10.0, forces, stations_m=OFFSETS_m)
    many = sd.estimate_force(
        LIVEWIRE,
        0.01,
        10.0,
        [(s, shapes.station_positions_m[:, j], shapes.station_quaternions_wxyz[:, j]) for j, s in enumerate(OFFSETS_m)],
        case=4,
    )
    assert many.converged.all() and np.abs(many.force_N - shapes.force_tip_N).max() < 1e-6
    for i in range(20):
        one = sd.estimate_force(LIVEWIRE, 0.01, 10.0, sensors(forces[i]), case=4)
        assert one.converged and np.abs(one.force_N - shapes.force_tip_N[i]).max() < 1e-6
        np.testing.assert_allclose(one.covariance_N2, many.covariance_N2[i], rtol=1e-2)


def test_a_pose_sensor_is_a_tuple_with_perhaps_its_covariances() -> None:
    plain = sd.estimate_force(LIVEWIRE, 0.01, 10.0, sensors(), 4)
    named = sd.estimate_force(LIVEWIRE, 0.01, 10.0, [sd.PoseSensor(*sensor) for sensor in sensors()], 4)
    wide = [sd.PoseSensor(*sensor, 1e-6 * np.eye(3), 1e-4 * np.eye(3)) for sensor in sensors()]
    wider = sd.estimate_force(LIVEWIRE, 0.01, 10.0, wide, 4)
    assert np.array_equal(plain.force_N, named.force_N)
    assert np.trace(wider.covariance_N2) > 2.0 * np.trace(plain.covariance_N2)
    assert np.abs(wider.force_N - plain.force_N).max() < 1e-7


def test_many_planar_estimates_are_what_single_calls_give() -> None:
    forces = np.array([[0.0, -0.12], [0.05, 0.1]])
    arcs = sd.solve(THERMOCOOL, 0.0485, 15.7, forces, model="pcar")
    many = sd.estimate_force(THERMOCOOL, 0.0485, 15.7, [(0.0, arcs.tip_position_m, arcs.tip_angle_rad)], model="pcar")
    assert many.converged.all() and np.abs(many.force_N - forces).max() < 1e-6
    one = sd.estimate_force(THERMOCOOL, 0.0485, 15.7, [(0.0, arcs.tip_position_m[1], arcs.tip_angle_rad[1])], model="pcar")
    assert np.abs(one.force_N - forces[1]).max() < 1e-6


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"catheter": "livewire"}, "catheter"),
        ({"catheter": THERMOCOOL}, "catheter"),
        ({"insertion_m": math.nan}, "insertion_m"),
        ({"insertion_m": "long"}, "insertion_m"),
        ({"insertion_m": -0.2}, "insertion_m"),
        ({"curvature_per_m": 1e9}, "curvature_per_m"),
        ({"force_N": [0.0, 1.0]}, "force_N"),
        ({"force_N": [0.0, 1.0, math.inf]}, "force_N"),
        ({"force_N": "strong"}, "force_N"),
        ({"force_N": [[0.0, 1.0]]}, "force_N"),
        ({"force_N": [[0.0, 0.0, math.nan]]}, "force_N"),
        ({"force_N": [[0.0, 0.0, 0.0], [0.0, 0.0, 1e6]]}, "force_N.1"),
        ({"insertion_m": [0.01, -0.5]}, "insertion_m"),
        ({"insertion_m": [0.01, 0.02], "curvature_per_m": [1.0, 2.0, 3.0]}, "insertion_m"),
        ({"frame": "world"}, "frame"),
        ({"model": "beam"}, "model"),
        ({"model": "pcar", "frame": "tip"}, "frame"),
        ({"stations_m": [-0.01]}, "stations_m"),
        ({"roll_rad": math.inf}, "roll_rad"),
    ],
)
def test_bad_input_to_solve_is_named(change: dict, key: str) -> None:
    good = {"catheter": LIVEWIRE, "insertion_m": 0.01, "curvature_per_m": 10.0, "force_N": [0.0, 0.01, 0.0]}
    with pytest.raises(sd.InputError) as error:
        sd.solve(**(good | change))
    assert error.value.key == key and isinstance(error.value, ValueError)


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"case": 7}, "case"),
        ({"case": None}, "case"),
        ({"sensors": []}, "sensors"),
        ({"sensors": [(0.0, [0.0, 0.0, 0.08], [1.0, 0.0, 0.0, 0.0])]}, "sensors"),
        ({"sensors": [(0.0, [0.0, 0.08], [1.0, 0.0, 0.0, 0.0])] * 2}, "sensors.offset_m"),
        ({"sensors": [(0.0, [0.0, 0.08], [1.0, 0, 0, 0]), (0.03, [0.0] * 3, [1.0, 0, 0, 0])]}, "sensors.0.position_m"),
        ({"sensors": [(0.0, [0.0] * 3, [1.0, 1.0, 0, 0]), (0.03, [0.0] * 3, [1.0, 0, 0, 0])]}, "sensors.0.quaternion_wxyz"),
        ({"model": "beam"}, "model"),
        ({"model": "pcar"}, "case"),
        ({"model": "pcar", "case": None}, "sensors"),
        ({"model": "pcar", "case": None, "roll_rad": 0.1}, "roll_rad"),
        ({"model": "pcar", "case": None, "previous_force_N": [0.0, 0.0]}, "previous_force_N"),
        ({"roll_rad": [0.1, 0.2]}, "roll_rad"),
    ],
)
def test_bad_input_to_estimate_force_is_named(change: dict, key: str) -> None:
    good = {"catheter": LIVEWIRE, "insertion_m": 0.01, "curvature_per_m": 10.0, "sensors": sensors(), "case": 4}
    with pytest.raises(sd.InputError) as error:
        sd.estimate_force(**(good | change))
    assert error.value.key == key


def test_a_foreign_package_of_the_same_name_is_said_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "protocol").mkdir()
    (tmp_path / "protocol" / "__init__.py").write_text("")
    for module in ("seldinger", "host"):
        script = f"import sys; sys.path[:0] = [{str(tmp_path)!r}, {str(ROOT)!r}]; import {module}"
        done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False, cwd=tmp_path)
        assert done.returncode == 1
        line = done.stderr.strip().splitlines()[-1]
        assert line.startswith("ImportError: package 'protocol'") and "uninstall" in line and str(tmp_path) in line


def test_a_recording_that_is_none_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"no recording at all")
    for path in (tmp_path / "a.mcap", tmp_path / "none.mcap"):
        with pytest.raises(sd.InputError, match=path.name):
            sd.open_recording(path)


# Arguments that are wrong in kind, shape or size; each stands in turn for every argument, and inside every list.
WRONG: list[object] = [
    None, "", "x", b"x", math.nan, math.inf, -1, 1e300, 10**400, True, [], {}, (), set(), [None], ["x"], [math.nan] * 3,
    [1, 2], [1, 2, 3, 4], [[1, 2], [3]], np.zeros(0), np.zeros((4, 3, 2)), np.array(["a"]), np.array([None]), 1j,
    np.array([1j]), object(), range(3), np.ma.masked, np.ma.masked_invalid([1.0, math.nan, 0.0]), float, "pcar",
]  # fmt: skip


def _calls() -> list[tuple[Any, dict[str, Any]]]:
    rod = {"catheter": LIVEWIRE, "insertion_m": 0.01, "curvature_per_m": 10.0}
    one = sensors()
    many = [(offset, np.stack([place] * 3), np.stack([turn] * 3)) for offset, place, turn in one]
    return [
        (sd.solve, {**rod, "force_N": [0.05, 0.02, 0.0], "frame": "base", "stations_m": [0.0, 0.03], "roll_rad": 0.1}),
        (sd.solve, {**rod, "force_N": np.zeros((3, 3)), "start": None, "workers": 1}),
        (sd.solve, {**rod, "catheter": THERMOCOOL, "force_N": [0.05, 0.02], "model": "pcar"}),
        (sd.estimate_force, {**rod, "sensors": one, "case": 4, "previous_force_N": FORCE_N, "roll_rad": 0.0}),
        (sd.estimate_force, {**rod, "sensors": many, "case": 4, "ordered": True, "workers": 1}),
        (sd.estimate_force, {**rod, "sensors": [(0.0, [0.07, 0.01], 0.2)], "model": "pcar", "prior": None}),
        (sd.load_catheter, {"name_or_path": "livewire"}),
        (sd.open_recording, {"path": "no.mcap"}),
    ]


def _replaced(value: object, wrong: object) -> list[object]:
    """Return `value` with `wrong` in its place, and in the place of its first entries, three levels deep."""
    made = [wrong]
    if isinstance(value, list | tuple) and value:
        for entry in _replaced(value[0], wrong):
            made.append(type(value)([entry, *value[1:]]))
        made += [[*value[:-1], entry] for entry in _replaced(value[-1], wrong)]
    return made


@pytest.mark.slow
@pytest.mark.parametrize("number", range(8))
def test_whatever_is_wrong_with_an_argument_is_bad_input(number: int) -> None:
    function, right = _calls()[number]
    for key, value in right.items():
        for wrong in WRONG:
            for changed in _replaced(value, wrong):
                with warnings.catch_warnings():
                    warnings.simplefilter("error", np.exceptions.ComplexWarning)
                    try:
                        function(**{**right, key: changed})
                    except sd.InputError as error:
                        assert "\n" not in str(error) and ": found " in str(error), (key, changed)


def _arranged(values: np.ndarray) -> list[np.ndarray]:
    """The same numbers read-only, with a stride, in the order of Fortran and in single precision."""
    fixed = values.copy()
    fixed.flags.writeable = False
    return [fixed, np.repeat(values[..., None], 2, axis=-1)[..., 0], np.asfortranarray(values), values.astype(np.float32)]


def test_no_order_of_an_array_makes_a_kernel_compile_again() -> None:
    """Columns of a table are strided, arrays of pandas are read-only: each was another signature, and a minute's wait."""

    def compiled() -> set[tuple[str, str]]:
        kernels = [each for each in gc.get_objects() if isinstance(each, Dispatcher)]
        return {(kernel.__qualname__, str(signature)) for kernel in kernels for signature in kernel.signatures}

    catheter, stations, forces = LIVEWIRE, np.array([0.0, 0.03]), np.full((3, 3), [0.0, 0.05, 0.0])
    shape = sd.solve(catheter, 0.01, 10.0, forces[0], stations_m=stations)
    position, quaternion = (np.tile(a[0], (3, 1)) for a in (shape.station_positions_m, shape.station_quaternions_wxyz))

    def estimate(p: np.ndarray, q: np.ndarray) -> None:
        sd.estimate_force(catheter, 0.01, 10.0, [(0.0, p, q)], case=2, ordered=True)

    sd.solve(catheter, 0.01, 10.0, forces, stations_m=stations)
    estimate(position, quaternion)
    before = compiled()
    for f, s in zip(_arranged(forces), _arranged(stations), strict=True):
        sd.solve(catheter, 0.01, 10.0, f[0], stations_m=s)
        sd.solve(catheter, 0.01, 10.0, f, stations_m=s)
    for p, q in zip(_arranged(position), _arranged(quaternion), strict=True):
        estimate(p, q)
    assert compiled() == before
