"""A speed sensor without a sign leads the linear fit astray: it is found all the same, and the mode behind it too."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.signal import TransferFunction, lsim

import seldinger as sd
from host.diagnosis.estimation import noise
from host.diagnosis.model.nominal import read_nominal
from host.diagnosis.pipeline import diagnose
from host.diagnosis.report.verdict import as_json
from tests.host.proof.everyday import gear_nominal

NOMINAL = """
name = "belt drive"
kind = "axis"
[data]
time = "time_s"
heldout = ["run2*"]
[channels.voltage]
column = "u"
unit = "V"
[channels.speed]
column = "z"
unit = "V"
[axis]
subsystem = "belt"
input = "voltage"
output = "speed"
terms = ["mass", "damping"]
hold = "zero"
reads = "velocity"
"""
RATE_HZ, GAIN, SLOW_RAD_S, MODE_RAD_S, RATIO = 50.0, 1.7, 2.0, 10.0, 0.2


def switched(rng: np.random.Generator, n: int, size: float) -> np.ndarray:
    """A voltage that changes sign at random, held for a tenth of a second and more."""
    signs = np.cumprod(np.where(rng.random(n) < 0.7, -1.0, 1.0))
    return size * np.repeat(signs, rng.integers(1, 12, n) * 5)[:n]


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Path]]:
    """Motor and belt, 10 s at three voltages, |speed| read with a noise of 10 mV."""
    folder, rng, files = tmp_path_factory.mktemp("belt"), np.random.default_rng(5), []
    mode = [1.0, 2.0 * RATIO * MODE_RAD_S, MODE_RAD_S**2]
    system = TransferFunction([GAIN * SLOW_RAD_S * MODE_RAD_S**2], np.polymul([1.0, SLOW_RAD_S], mode))
    for number, size in enumerate((0.5, 1.0, 1.5)):
        u = switched(rng, 500, size)
        _, speed, _ = lsim(system, np.repeat(u, 10), np.arange(5000) / (10.0 * RATE_HZ))
        z = np.abs(speed[::10]) + 0.01 * rng.normal(size=500)
        files.append(folder / f"run{number}.csv")
        np.savetxt(files[-1], np.c_[np.arange(500) / RATE_HZ, u, z], delimiter=",", header="time_s,u,z", comments="")
    nominal = folder / "nominal.toml"
    nominal.write_text(NOMINAL)
    return nominal, files


@pytest.mark.long
def test_the_lost_sign_and_the_mode_behind_it_are_named(drive: tuple[Path, list[Path]]) -> None:
    result = diagnose(read_nominal(drive[0]), drive[1], lambda what, part: None)
    verdict = as_json(result, 0.0)
    assert [effect["id"] for effect in verdict["effects"]] == ["rectified_sensor", "resonance"]
    mode = verdict["effects"][1]["parameters"]
    assert mode["frequency_Hz"]["value"] == pytest.approx(MODE_RAD_S / (2.0 * np.pi), rel=0.05)
    assert mode["damping_ratio"]["value"] == pytest.approx(RATIO, rel=0.15)
    assert verdict["fit"]["rmse_after"] < 0.05 * verdict["fit"]["rmse_before"]


def test_an_output_on_its_way_is_no_noise() -> None:
    rng, t = np.random.default_rng(1), np.arange(4000) * 0.02
    step = np.sign(np.sin(2.0 * np.pi * t / 4.0))
    y = lsim(TransferFunction([1.0], [0.5, 1.0]), step, t)[1] + 0.01 * rng.normal(size=t.size)
    found = noise.estimate([y], [noise.quiescent([step], 0.02, True)])
    assert found.sigma == pytest.approx(0.01, rel=0.3)


def test_an_offset_behind_the_lost_sign_is_no_curve() -> None:
    """A gear whose sensor gives |angle| and adds 0.05 rad was named an even polynomial with 0.94."""
    recordings = []
    for number in (1, 2):
        rng = np.random.default_rng([6, number])
        t = np.arange(0.0, 12.0, 0.01)
        motor = np.sin(2.0 * np.pi * np.outer(t, [0.2, 0.5, 1.1]) + rng.uniform(0.0, 6.28, 3)).sum(axis=1)
        recordings.append({"t": t, "motor": motor, "load": np.abs(0.4 * motor) + 0.05 + 2e-3 * rng.standard_normal(t.size)})
    (found,) = sd.diagnose(recordings, gear_nominal()).effects
    assert found["id"] == "rectified_sensor"
    assert found["parameters"]["level_rad"]["value"] == pytest.approx(0.05, abs=1e-3)
