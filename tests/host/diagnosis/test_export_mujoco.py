"""An exported MuJoCo file: plain MuJoCo loads it, and steps what the finder simulated."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from host.diagnosis.effects import candidates
from host.diagnosis.estimation.fit import Fit, Term
from host.diagnosis.export.mjcf import mjcf_of
from host.diagnosis.export.write import export
from host.diagnosis.model.model import scale_of
from host.diagnosis.model.nominal import nominal_of
from host.diagnosis.model.tables import Table
from host.diagnosis.problems import prepare
from protocol.errors import InputError
from tests.host.diagnosis.test_mujoco import ARM, NOMINAL, mujoco, real

OFFER = [{"id": "gravity_load", "parameter": "hand.payload", "high": 2.0}]
KEYS = ("coulomb_friction@elbow.frictionloss", "gravity_load@hand.payload", "sensor_scale@m1.gear")


def found(folder: Path, keys: tuple[str, ...], text: str = ARM, **changed: Any) -> Any:
    """A diagnosis of the arm in `folder` that found `keys`, with the last values of their grids."""
    folder.mkdir(exist_ok=True)
    (folder / "arm.xml").write_text(text)
    spec = nominal_of({**NOMINAL, "offer": OFFER, **changed}, folder)
    model, problem, _ = prepare(spec, [Table("r", real(ARM, 1, 150))])
    every = {candidate.key: candidate for candidate in candidates(model.ports, True)}
    terms = []
    for key in keys:
        scale = scale_of(model, problem.segments, every[key].port, every[key], 0.1)
        terms.append(Term(every[key], every[key].effect.parameters(scale, every[key].form)))
    values = np.concatenate([model.guess(problem.segments), [p.grid[-1] for term in terms for p in term.parameters]])
    return SimpleNamespace(spec=spec, model=model, problem=problem, found=SimpleNamespace(best=Fit(tuple(terms), values)))


def stepped(path: Path, result: Any) -> np.ndarray:
    """Both joints (2, n) as plain MuJoCo steps the file, from the finder's initial state."""
    segment = result.problem.segments[0]
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    data.qpos[:2], data.qvel[:2] = segment.begin.values[[0, 2]], segment.begin.values[[1, 3]]
    rows = []
    for k in range(segment.n):
        rows.append(data.qpos[:2].copy())
        data.ctrl[:] = segment.inputs["shoulder_torque"][k], segment.inputs["elbow_torque"][k]
        for _ in range(10):
            mujoco.mj_step(model, data)
    return np.array(rows).T


def agrees(path: Path, result: Any) -> bool:
    best = result.found.best
    exact = result.problem.simulate(result.problem.segments[0], best.terms, best.values)
    return bool(np.max(np.abs(stepped(path, result) - exact)) <= 1e-9 * np.max(np.abs(exact)))


def test_plain_mujoco_steps_what_was_simulated(tmp_path: Path) -> None:
    parameters = {**NOMINAL["parameters"], "forearm.mass": 0.41}
    result = found(tmp_path, KEYS, parameters=parameters)
    assert export(result, tmp_path / "patched.xml") == []
    assert agrees(tmp_path / "patched.xml", result)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["arm.xml", "patched.xml"]


def test_comments_stay_and_values_keep_all_digits(tmp_path: Path) -> None:
    result = found(tmp_path, (), ARM.replace("<worldbody>", "<!-- measured in May --><worldbody>"))
    result.found.best.values[0] = 0.12345678901234567
    text = mjcf_of(result, tmp_path / "patched.xml")
    assert "measured in May" in text and repr(0.12345678901234567) in text


def test_included_files_and_assets_are_found_from_another_folder(tmp_path: Path) -> None:
    source, target = tmp_path / "model", tmp_path / "out"
    source.mkdir(), target.mkdir()
    head, _, tail = ARM.partition("<actuator>")
    (source / "drives.xml").write_text(f"<mujoco><actuator>{tail.replace('</mujoco>', '')}</mujoco>")
    corners = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    (source / "cube.obj").write_text(
        "".join(f"v {x} {y} {z}\n" for x, y, z in corners)
        + "".join(f"f {a} {b} {c}\n" for a, b, c in ((1, 2, 3), (2, 4, 3), (5, 7, 6), (6, 7, 8), (1, 3, 5), (3, 7, 5)))
        + "f 2 6 4\nf 4 6 8\nf 1 5 2\nf 2 5 6\nf 3 4 7\nf 4 8 7\n"
    )
    mesh = '<asset><mesh name="cube" file="cube.obj" scale="0.01 0.01 0.01"/></asset><worldbody>'
    shown = '<geom type="mesh" mesh="cube" contype="0" conaffinity="0" mass="0.01"/><site name="hand"'
    text = head.replace("<worldbody>", mesh).replace('<site name="hand"', shown) + '<include file="drives.xml"/></mujoco>'
    result = found(source, KEYS, text)
    export(result, target / "patched.xml")
    assert agrees(target / "patched.xml", result)


@pytest.mark.parametrize(
    ("keys", "changed", "wanted"),
    [
        (("sensor_drift@elbow_reading",), {}, "no parameter of the simulator"),
        ((), {"parameters": {"elbow.qpos_spring": 0.1}}, "qpos_spring"),
    ],
)
def test_what_the_file_cannot_hold_is_refused_in_one_line(
    tmp_path: Path, keys: tuple[str, ...], changed: dict[str, Any], wanted: str
) -> None:
    result = found(tmp_path, keys, **changed)
    with pytest.raises(InputError, match=wanted) as refused:
        export(result, tmp_path / "patched.xml")
    assert "\n" not in str(refused.value)
    assert not (tmp_path / "patched.xml").exists()


def test_another_kind_has_no_model_file(tmp_path: Path) -> None:
    from tests.host.diagnosis.test_export import case

    with pytest.raises(InputError, match="kind mujoco"):
        mjcf_of(case(tmp_path, "callable", ()), tmp_path / "patched.xml")
