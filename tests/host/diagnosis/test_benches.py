"""Machines as other laboratories have them: an arm with weight, a free stage on bristles, a cable in its sheath."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from host.diagnosis.model.force_kernel import sides
from host.diagnosis.model.nominal import read_nominal
from host.diagnosis.pipeline import diagnose
from host.diagnosis.report.verdict import as_json

ARM = """
name = "arm"
kind = "impedance"
[data]
time = "time_s"
[channels.angle]
column = "x"
unit = "rad"
[channels.torque]
column = "f"
unit = "N m"
[impedance]
subsystem = "joint"
input = "angle"
output = "torque"
terms = ["mass", "damping", "offset"]
"""
STAGE = """
name = "free stage"
kind = "axis"
[data]
time = "time_s"
[channels.force]
column = "f"
unit = "N"
[channels.position]
column = "x"
unit = "m"
[axis]
subsystem = "stage"
input = "force"
output = "position"
terms = ["mass", "damping", "offset"]
"""

SHEATH = """
name = "cable in a sheath"
kind = "transmission"
[data]
time = "time_s"
[channels.pull]
column = "x"
unit = "N"
[channels.far_pull]
column = "f"
unit = "N"
[[link]]
subsystem = "sheath"
input = "pull"
output = "far_pull"
"""


def tones(rng: np.random.Generator, t: np.ndarray, sizes: tuple[float, float], hertz: tuple[float, float]) -> np.ndarray:
    """Five tones of random size, frequency and phase, (n,)."""
    each = zip(rng.uniform(*sizes, 5), rng.uniform(*hertz, 5), rng.uniform(0.0, 6.0, 5), strict=True)
    return np.asarray(sum(size * np.sin(2.0 * np.pi * f * t + phase) for size, f, phase in each))


def written(folder: Path, nominal: str, tables: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> tuple[Path, list[Path]]:
    """Nominal TOML and recordings of time, motion and force."""
    files = [folder / f"run{number}.csv" for number in range(len(tables))]
    for path, table in zip(files, tables, strict=True):
        np.savetxt(path, np.array(table).T, delimiter=",", header="time_s,x,f", comments="", fmt="%.9g")
    (folder / "nominal.toml").write_text(nominal)
    return folder / "nominal.toml", files


def arm(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Inertia 0.8, viscous 1.5, dry 3 N m, weight 6 N m at a quarter turn; an encoder of 20,000 counts."""
    t = np.arange(3000) / 200.0
    q = tones(rng, t, (0.1, 0.6), (0.05, 0.6))
    v = np.gradient(q, t)
    torque = 0.8 * np.gradient(v, t) + 1.5 * v + 3.0 * np.tanh(v / 0.003) + 6.0 * np.sin(q)
    count = 2.0 * np.pi / 20000.0
    return t, np.round(q / count) * count, torque + 0.05 * rng.normal(size=t.size)


def stage(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """2 kg, 5 N s/m, LuGre friction of 3 N with bristles of 20 um, led by a PD controller; a scale of 2 um."""
    t, fine = np.arange(4000) / 500.0, 40
    h, bristle, wanted = 0.002 / fine, 3.0 / 2e-5, tones(rng, t, (0.005, 0.02), (0.1, 1.5))
    x, v, z, motion, force = 0.0, 0.0, 0.0, np.zeros(t.size), np.zeros(t.size)
    for i in range(t.size):
        push = 400.0 * (wanted[i] - x) - 25.0 * v + 0.2 * rng.normal()
        motion[i], force[i] = x, push
        for _ in range(fine):
            rate = v - bristle * abs(v) / 3.0 * z
            z += h * rate
            v += h * 0.5 * (push - 5.0 * v - bristle * z - 500.0 * rate * np.exp(-((v / 0.01) ** 2)))
            x += h * v
    return t, np.round(motion / 2e-6) * 2e-6, force + 0.02 * rng.normal(size=t.size)


def sheath(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A pull of some 8 N behind a wrap of 0.4 (friction times angle), both read with 10 mN of noise."""
    t = np.arange(3000) / 100.0
    pull = np.maximum(8.0 + tones(rng, t, (0.5, 2.5), (0.05, 0.5)), 0.5)
    far = pull.copy()
    for i in range(1, t.size):
        far[i] = min(max(far[i - 1], pull[i] * np.exp(-0.4)), pull[i] * np.exp(0.4))
    return t, pull + 0.01 * rng.normal(size=t.size), far + 0.01 * rng.normal(size=t.size)


def test_an_arm_has_weight_and_dry_friction(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    nominal, files = written(tmp_path, ARM, [arm(rng) for _ in range(4)])
    verdict = as_json(diagnose(read_nominal(nominal), files, lambda what, part: None), 0.0)
    found = {effect["id"]: effect for effect in verdict["effects"][:2]}
    assert set(found) == {"gravity_load", "coulomb_friction"}
    weight, friction = found["gravity_load"], found["coulomb_friction"]
    assert weight["parameters"]["moment_sine_N_m"]["value"] == pytest.approx(6.0, rel=0.03)
    assert friction["parameters"]["force_N_m"]["value"] == pytest.approx(3.0, rel=0.03)
    assert verdict["fit"]["nominal_parameters"]["mass_N_m_s2_per_rad"]["value"] == pytest.approx(0.8, rel=0.05)


def test_a_free_stage_on_bristles(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    nominal, files = written(tmp_path, STAGE, [stage(rng) for _ in range(3)])
    verdict = as_json(diagnose(read_nominal(nominal), files, lambda what, part: None), 0.0)
    (friction,) = verdict["effects"]
    assert friction["id"] == "coulomb_friction"  # the bristles are a five-thousandth of the travel
    assert friction["parameters"]["force_N"]["value"] == pytest.approx(3.0, rel=0.05)
    assert friction["parameters"]["distance_m"]["value"] == pytest.approx(2e-5, rel=0.3)
    assert verdict["fit"]["nominal_parameters"]["mass_N_s2_per_m"]["value"] == pytest.approx(2.0, rel=0.05)


def test_a_cable_is_held_by_its_sheath(tmp_path: Path) -> None:
    rng = np.random.default_rng(8)
    nominal, files = written(tmp_path, SHEATH, [sheath(rng) for _ in range(4)])
    (friction,) = as_json(diagnose(read_nominal(nominal), files, lambda what, part: None), 0.0)["effects"]
    assert friction["id"] == "load_dependent_friction"
    assert friction["parameters"]["exponent"]["value"] == pytest.approx(0.4, rel=0.03)


def test_a_movement_ends_where_the_next_sets_off() -> None:
    t = np.arange(2000) * 0.005
    held = np.where(t < 4.0, np.sin(0.5 * np.pi * np.minimum(t, 1.0)), np.cos(np.pi * (t - 4.0)))
    found = sides(held, 1e-3)
    assert np.all(found[1:800] == 1.0) and np.all(found[803:995] == -1.0) and np.all(found[1005:1195] == 1.0)
    assert not sides(1e-4 * np.sin(t), 1e-3).any()
