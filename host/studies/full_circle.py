"""Test diagnosis and correction with MuJoCo: an arm with concealed physics, its diagnosis, the corrected model.

    python -m host.studies.full_circle --dir runs/circle --docs docs/diagnosis.md

The "real" arm is a second MuJoCo file, stepped twenty times finer, that the diagnosis never sees. `seldinger diagnose` gets
the nominal file and three noisy recordings cut from motion, and writes a patched file. Two fresh recordings, of other
motions that begin at rest, judge it: plain MuJoCo steps each file, and its error is compared with the noise of the readings.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from host.studies.reliability_page import write_section

Array = npt.NDArray[np.float64]
NOISE_RAD = 5e-4
PERIOD_S, SAMPLES, BEFORE = 0.02, 200, 100  # of a recording; samples before it that are cut off
REAL_STEP_S = 0.0005
TORQUE_Nm = (0.8, 0.25)
TONES = ((1.0, 0.31), (0.6, 0.87), (0.4, 1.9))  # relative amplitude, Hz
ARM = """<mujoco model="arm">
  <option timestep="0.01" integrator="RK4"/>
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
  </sensor>
</mujoco>
"""
# What the real arm has and its model file lacks.
CONCEALED = {"elbow.frictionloss": 0.06, "hand.payload": 0.12}
NOMINAL = """name = "two-link arm"
kind = "mujoco"

[data]
time = "t"

[mujoco]
model = "arm.xml"
actuators = {shoulder_torque = "m1", elbow_torque = "m2"}
sensors = {shoulder = "q1", elbow = "q2"}

[parameters]
"shoulder.damping" = {value = 0.03, low = 0.0, high = 5.0, unit = "N m s"}
"elbow.damping" = {value = 0.05, low = 0.0, high = 5.0, unit = "N m s"}

[[offer]]
id = "gravity_load"
parameter = "hand.payload"
subsystem = "hand"
high = 2.0
unit = "kg"

[channels]
shoulder_torque = {column = "u1", unit = "N m"}
elbow_torque = {column = "u2", unit = "N m"}
shoulder = {column = "q1", unit = "rad"}
elbow = {column = "q2", unit = "rad"}
"""


@dataclass(frozen=True)
class Circle:
    """Verdict, and RMS error (rad) of each joint on fresh recordings: of the nominal file and of the patched one."""

    verdict: dict[str, Any]
    nominal_rad: Array
    patched_rad: Array


def real_arm() -> str:
    """The model file of the real arm."""
    friction = f'name="elbow" type="hinge" frictionloss="{CONCEALED["elbow.frictionloss"]}"'
    load = f'<geom type="sphere" size="0.001" mass="{CONCEALED["hand.payload"]}" pos="0 0 -0.25"/>'
    return ARM.replace('name="elbow" type="hinge"', friction).replace("<site ", f"{load}<site ")


def torques(rng: np.random.Generator, samples: int) -> Array:
    """Torques (2, n) of shoulder and elbow: three tones of random phase."""
    t = PERIOD_S * np.arange(samples)
    return np.array(
        [sum(a * size * np.sin(2 * np.pi * f * t + rng.uniform(0, 2 * np.pi)) for a, f in TONES) for size in TORQUE_Nm]
    )


def stepped(model: Any, u: Array) -> Array:
    """Joint angles (2, n) from rest, the torques (2, n) held between samples: MuJoCo and nothing else."""
    import mujoco

    data = mujoco.MjData(model)
    steps = round(PERIOD_S / model.opt.timestep)
    q = np.empty_like(u)
    for k in range(u.shape[1]):
        q[:, k] = data.qpos
        data.ctrl[:] = u[:, k]
        mujoco.mj_step(model, data, steps)
    return q


def recorded(seed: int, before: int) -> tuple[Array, Array]:
    """Torques and noisy angles (2, n) of the real arm, its first `before` samples cut off."""
    import mujoco

    rng = np.random.default_rng(seed)
    model = mujoco.MjModel.from_xml_string(real_arm())
    model.opt.timestep = REAL_STEP_S
    u = torques(rng, SAMPLES + before)
    q = stepped(model, u)
    return u[:, before:], q[:, before:] + NOISE_RAD * rng.standard_normal((2, SAMPLES))


def run(folder: Path, seed: int = 1) -> Circle:
    """Record, diagnose through the public command, patch, and judge on fresh recordings. Files go to `folder`."""
    import mujoco

    folder.mkdir(parents=True, exist_ok=True)
    (folder / "arm.xml").write_text(ARM, encoding="utf-8")
    (folder / "arm.toml").write_text(NOMINAL, encoding="utf-8")
    tables = []
    for number in range(3):
        u, q = recorded(1000 * seed + number, BEFORE)
        tables.append(folder / f"arm_{number + 1}.csv")
        columns = np.vstack((PERIOD_S * np.arange(SAMPLES), u, q)).T
        np.savetxt(tables[-1], columns, delimiter=",", header="t,u1,u2,q1,q2", comments="", fmt="%.9g")
    patched = folder / "arm_patched.xml"
    command = [sys.executable, "-m", "host.cli.main", "diagnose", *map(str, tables), "--nominal", str(folder / "arm.toml")]
    command += ["--json", "--out", str(folder / "why"), "--export", str(patched)]
    said = subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout
    models = [mujoco.MjModel.from_xml_path(str(path)) for path in (folder / "arm.xml", patched)]
    fresh = [recorded(1000 * seed + 500 + number, 0) for number in range(2)]
    errors = [
        np.sqrt(np.mean(np.concatenate([q - stepped(model, u) for u, q in fresh], axis=1) ** 2, axis=1)) for model in models
    ]
    return Circle(json.loads(said), errors[0], errors[1])


def text(circle: Circle) -> str:
    """Tables of what was concealed, what was found, and the errors of both files."""
    lines = ["| concealed | value | named | value (95 %) | probability |", "|---|---|---|---|---|"]
    named = {effect["port"]: effect for effect in circle.verdict["effects"]}
    for parameter, value in CONCEALED.items():
        effect = named.pop(parameter, None)
        if effect is None:
            lines.append(f"| {parameter} | {value:g} | no | | |")
            continue
        ((_, p),) = effect["parameters"].items()
        low, high = p["ci95"]
        span = f"{p['value']:.4g} ({low:.4g} to {high:.4g})"
        lines.append(f"| {parameter} | {value:g} | {effect['id']} | {span} | {effect['probability']:.2f} |")
    lines += [f"| nothing | | {e['id']}@{e['subsystem']} | | {e['probability']:.2f} |" for e in named.values()]
    lines += ["", "| plain MuJoCo on two fresh recordings, RMS error | shoulder (mrad) | elbow (mrad) |", "|---|---|---|"]
    for name, error in (("arm.xml", circle.nominal_rad), ("arm_patched.xml", circle.patched_rad)):
        lines.append(f"| {name} | {1e3 * error[0]:.3g} | {1e3 * error[1]:.3g} |")
    lines.append(f"| noise of the readings | {1e3 * NOISE_RAD:.3g} | {1e3 * NOISE_RAD:.3g} |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> None:
    """Run the circle and print its tables, or write them into a page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--dir", type=Path, default=Path("runs/circle"), help="folder of the files")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--docs", type=Path, help="page whose tables are to be written")
    given = parser.parse_args(arguments)
    found = text(run(given.dir, given.seed))
    print(found)
    if given.docs is not None:
        write_section(given.docs, "full_circle", found)


if __name__ == "__main__":
    main()
