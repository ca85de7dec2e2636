"""Recordings that nobody here made: what is named, how well held-out data are met. Skips without the data folder."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from host.diagnosis.model.dataset import find_files
from host.diagnosis.model.nominal import nominal_path, read_nominal
from host.diagnosis.pipeline import Diagnosis, diagnose
from host.diagnosis.report.verdict import as_json
from host.studies.proof import real

FOLDER = Path(os.environ.get("SELDINGER_DATA", Path(__file__).parents[3] / ".." / "shared" / "data"))
pytestmark = [pytest.mark.data, pytest.mark.slow]


def run(name: str) -> tuple[Diagnosis, dict]:
    """Diagnosis with a nominal that ships."""
    spec = read_nominal(nominal_path(name))
    if not list(FOLDER.glob(spec.data.files[0])):
        pytest.skip(f"{spec.data.files[0]} is not in {FOLDER}; set SELDINGER_DATA")
    result = diagnose(spec, find_files(spec, [], str(FOLDER)), lambda what, part: None)
    return result, as_json(result, 0.0)


def test_cable_instrument_jaw_angle() -> None:
    _, verdict = run("davinci_jaw")
    assert {e["id"] for e in verdict["effects"]} >= {"compliance", "backlash"}
    assert verdict["fit"]["rmse_after"] < 0.0084


@pytest.mark.long
def test_cable_instrument_torque() -> None:
    _, verdict = run("davinci_torque")
    assert {e["id"] for e in verdict["effects"]} >= {"presliding_friction", "load_dependent_friction"}
    assert verdict["fit"]["rmse_after"] < 0.010


def test_positioning_system_friction() -> None:
    result, verdict = run("emps")
    assert verdict["effects"][0]["id"] == "coulomb_friction"
    assert result.found.steps[0].key.startswith("coulomb_friction")


@pytest.mark.long
def test_silverbox_spring() -> None:
    result, verdict = run("silverbox")
    assert verdict["effects"][0]["id"] == "nonlinear_stiffness"
    left = {
        p.recording.name: float(np.sqrt(np.nanmean(r[0][p.heldout] ** 2)))
        for p, r in zip(result.full.segments, result.full_rate.best.residuals, strict=True)
        if p.heldout.any()
    }
    assert left["multisine_10"] < 0.363e-3 and left["arrow"] < 0.523e-3


SETS = {one.name: one for one in real.SETS}


def judged(name: str) -> real.SetResult:
    """Diagnosis of one set that the README describes, held out as it says."""
    if not (FOLDER / SETS[name].file).exists():
        pytest.skip(f"{SETS[name].file} is not in {FOLDER}; set SELDINGER_DATA")
    return real.judged(SETS[name], FOLDER)


@pytest.mark.long
@pytest.mark.parametrize("seal", ["oring", "pk"])
def test_friction_of_a_seal_grows_with_pressure(seal: str) -> None:
    result = judged(f"pneumatic {seal}")
    assert result.named[0] == "load_dependent_friction" and "stribeck_friction" not in result.named
    assert result.after < result.hand


@pytest.mark.long
def test_friction_of_the_smoothest_seal() -> None:
    result = judged("pneumatic kdn")
    assert result.right and "stribeck_friction" not in result.named
    assert result.after < 0.75  # the fit by hand, with a spring and pressure, leaves 0.70 N


@pytest.mark.parametrize(
    ("volts", "others", "hand"),
    [("0V", {"presliding_friction"}, 8.8), ("0p88V", {"presliding_friction", "saturation"}, 22.5)],
)
def test_damper_yields_before_it_flows(volts: str, others: set[str], hand: float) -> None:
    """At 0.88 V the force grows ever less with speed, as in the fit by hand: tanh of speed and place."""
    result = judged(f"mr_damper {volts}")
    assert result.named[0] == "coulomb_friction" and set(result.named[1:]) <= others
    assert result.after < hand
