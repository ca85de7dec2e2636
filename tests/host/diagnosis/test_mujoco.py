"""MuJoCo models as nominal models: what is concealed in a second model is named, and the patched file has it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from host.diagnosis.model.effect import Array
from host.diagnosis.model.nominal import nominal_of
from host.diagnosis.model.tables import Table
from host.diagnosis.problems import prepare
from protocol.errors import InputError

mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed: pip install 'seldinger[mujoco]'")

ARM = """
<mujoco model="arm">
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" type="hinge" axis="0 1 0" damping="0.05"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="0.6"/>
      <body name="forearm" pos="0 0 -0.3">
        <joint name="elbow" type="hinge" axis="0 1 0" damping="0.03"/>
        <geom type="capsule" size="0.015" fromto="0 0 0 0 0 -0.25" mass="0.3"/>
        <site name="hand" pos="0 0 -0.25"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="m1" joint="shoulder"/>
    <motor name="m2" joint="elbow"/>
  </actuator>
  <sensor>
    <jointpos name="q1" joint="shoulder"/>
    <jointpos name="q2" joint="elbow"/>
    <jointvel name="w2" joint="elbow"/>
  </sensor>
</mujoco>
"""
NOMINAL: dict[str, Any] = {
    "name": "arm",
    "kind": "mujoco",
    "data": {"time": "t"},
    "channels": {
        "shoulder_torque": {"column": "u1", "unit": "N m"},
        "elbow_torque": {"column": "u2", "unit": "N m"},
        "shoulder": {"column": "q1", "unit": "rad"},
        "elbow": {"column": "q2", "unit": "rad"},
    },
    "mujoco": {
        "model": "arm.xml",
        "actuators": {"shoulder_torque": "m1", "elbow_torque": "m2"},
        "sensors": {"shoulder": "q1", "elbow": "q2"},
    },
    "parameters": {"shoulder.damping": {"value": 0.1, "low": 0.0, "high": 5.0, "unit": "N m s"}},
}
NOISE_RAD = 3e-4


def real(xml: str, seed: int, samples: int = 1000, dt_s: float = 0.01) -> dict[str, Array]:
    """A recording of the model in `xml`, cut from motion after two seconds; steps of MuJoCo of its own."""
    rng = np.random.default_rng(seed)
    model = mujoco.MjModel.from_xml_string(xml)
    model.opt.timestep = 0.0005
    data = mujoco.MjData(model)
    n = samples + 200
    t = np.arange(n) * dt_s
    u = [
        sum(a * size * np.sin(2 * np.pi * f * t + rng.uniform(0, 6.28)) for a, f in ((1.0, 0.31), (0.6, 0.87), (0.4, 1.9)))
        for size in (0.8, 0.25)
    ]
    q = np.empty((n, 2))
    for k in range(n):
        q[k] = data.qpos
        data.ctrl[:] = u[0][k], u[1][k]
        for _ in range(round(dt_s / 0.0005)):
            mujoco.mj_step(model, data)
    q += NOISE_RAD * rng.standard_normal(q.shape)
    columns = {"t": t, "u1": u[0], "u2": u[1], "q1": q[:, 0], "q2": q[:, 1]}
    return {name: values[200:] - (t[200] if name == "t" else 0.0) for name, values in columns.items()}


def nominal(folder: Path) -> Any:
    (folder / "arm.xml").write_text(ARM)
    return nominal_of(NOMINAL, folder)


def concealed(what: str) -> str:
    """The arm with physics that its model file lacks."""
    if what == "friction":
        return ARM.replace('name="elbow" type="hinge"', 'name="elbow" type="hinge" frictionloss="0.06"')
    if what == "payload":
        return ARM.replace(
            '<site name="hand"', '<geom type="sphere" size="0.001" mass="0.12" pos="0 0 -0.25"/><site name="hand"'
        )
    return ARM


def test_a_run_is_what_mujoco_steps(tmp_path: Path) -> None:
    columns = real(ARM, 1, 200)
    model, problem, _ = prepare(nominal(tmp_path), [Table("r", columns)])
    segment = problem.segments[0]
    assert segment.begin is not None
    segment.begin.values = np.zeros(4)
    out = model.simulate(segment, np.array([0.05]), [])
    mj = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(mj)
    stepped = []
    for k in range(200):
        stepped.append(data.qpos.copy())
        data.ctrl[:] = columns["u1"][k], columns["u2"][k]
        for _ in range(10):
            mujoco.mj_step(mj, data)
    assert np.allclose(out, np.array(stepped).T, atol=1e-9)


def test_joints_bodies_and_gears_are_offered(tmp_path: Path) -> None:
    model, _, _ = prepare(nominal(tmp_path), [Table("r", real(ARM, 1, 100))])
    offered = {port.name: (port.offers[0].id, port.subsystem) for port in model.ports if port.offers}
    assert offered["elbow.frictionloss"] == ("coulomb_friction", "elbow")
    assert offered["forearm.payload"] == ("gravity_load", "forearm") and offered["m1.gear"][0] == "sensor_scale"
    assert "shoulder.damping" not in offered  # it is a nominal parameter


@pytest.mark.parametrize(
    ("key", "value", "wanted"),
    [
        ("mujoco", {**NOMINAL["mujoco"], "model": "none.xml"}, "mujoco.model"),
        ("mujoco", {**NOMINAL["mujoco"], "sensors": {"shoulder": "q9", "elbow": "q2"}}, "q9"),
        ("parameters", {"wrist.damping": 0.1}, "wrist.damping"),
    ],
)
def test_a_name_that_the_file_does_not_have_is_bad_input(tmp_path: Path, key: str, value: Any, wanted: str) -> None:
    (tmp_path / "arm.xml").write_text(ARM)
    with pytest.raises(InputError, match=wanted):
        prepare(nominal_of({**NOMINAL, key: value}, tmp_path), [Table("r", real(ARM, 1, 100))])
