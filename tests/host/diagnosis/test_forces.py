"""Forces along motions that a simulator lacks: joint friction and payload of an arm given as inverse dynamics."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import seldinger as sd
from host.diagnosis.effects.gravity_load import payload_torques
from host.diagnosis.export.module import module_of
from host.diagnosis.model.effect import Array
from host.diagnosis.model.nominal import nominal_of
from host.diagnosis.model.tables import Table
from host.diagnosis.models.external import ExternalModel
from host.diagnosis.pipeline import diagnose
from host.studies.proof.worlds.nominal_arm import torques
from protocol.errors import InputError

pytestmark = pytest.mark.slow  # together: each takes some seconds

LINKS = {"mass_1": 1.2, "mass_2": 0.8, "inertia_1": 0.01, "inertia_2": 0.006}
LINKS |= {"length_1": 0.3, "centre_1": 0.14, "centre_2": 0.12, "damping_1": 0.2, "damping_2": 0.05}
NAMES = ("shoulder_rad", "elbow_rad", "shoulder_Nm", "elbow_Nm")
PERIOD_S, NOISE_NM = 0.002, 0.01


def nominal(**section: Any) -> dict[str, Any]:
    """The arm with link data of the drawing; both dampings are fitted."""
    held = {k: {"value": v, "free": False} for k, v in LINKS.items() if not k.startswith("damping")}
    given = {"inputs": list(NAMES[:2]), "outputs": list(NAMES[2:]), "subsystem": "arm", **section}
    return {
        "name": "arm",
        "kind": "callable",
        "data": {"time": "t"},
        "channels": {n: {"column": n, "unit": n.rpartition("_")[2].replace("Nm", "N m")} for n in NAMES},
        "callable": {"function": torques, **given},
        "parameters": {"damping_1": 0.1, "damping_2": 0.1, **held},
    }


def recorded(seed: int, links: dict[str, float] = LINKS, friction_Nm: float = 0.0, seconds: float = 6.0) -> dict[str, Array]:
    """Both joints move at once, cut from motion; the torques that this needs, with noise."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds / PERIOD_S)) * PERIOD_S
    tones = [(0.37, 0.45), (0.71, 0.2), (1.3, 0.1)]
    q = {n: sum(a * np.sin(2 * np.pi * f * t + rng.uniform(0, 6.28)) for f, a in tones) for n in NAMES[:2]}
    out = torques(q, links, t)
    out["elbow_Nm"] = out["elbow_Nm"] + friction_Nm * np.sign(np.gradient(q["elbow_rad"]))
    return {"t": t, **q, **{n: out[n] + NOISE_NM * rng.standard_normal(t.size) for n in NAMES[2:]}}


def carrying(mass_kg: float, at_m: float) -> dict[str, float]:
    """Link data with a point mass on the forearm: centre and inertia of both bodies together (parallel axes)."""
    m, c = LINKS["mass_2"], LINKS["centre_2"]
    total = m + mass_kg
    centre = (m * c + mass_kg * at_m) / total
    inertia = LINKS["inertia_2"] + m * (c - centre) ** 2 + mass_kg * (at_m - centre) ** 2
    return {**LINKS, "mass_2": total, "centre_2": centre, "inertia_2": inertia}


@pytest.mark.slow
def test_friction_at_a_joint_is_named_with_its_joint() -> None:
    verdict = sd.diagnose([recorded(k, friction_Nm=0.02) for k in range(3)], nominal())
    (effect,) = verdict.effects
    assert (effect["id"], effect["port"]) == ("coulomb_friction", "elbow_Nm_along_elbow_rad")
    assert effect["parameters"]["force_N_m"]["value"] == pytest.approx(0.02, rel=0.05)


@pytest.mark.slow
def test_a_payload_is_a_load_and_not_a_coupling() -> None:
    verdict = sd.diagnose([recorded(k, carrying(0.01, 0.25)) for k in range(3)], nominal())
    (effect,) = verdict.effects
    assert (effect["id"], effect["port"]) == ("gravity_load", "payload")
    found = {key: p["value"] for key, p in effect["parameters"].items()}
    assert found["mass_kg"] == pytest.approx(0.01, rel=0.3)
    assert found["length_1_m"] == pytest.approx(0.3, rel=0.2)


@pytest.mark.slow
def test_an_arm_that_lacks_nothing_has_nothing_named() -> None:
    verdict = sd.diagnose([recorded(k) for k in range(3)], nominal())
    assert (verdict.verdict, verdict.effects) == ("nothing_missing", [])


@pytest.mark.parametrize("seed", [pytest.param(3, marks=pytest.mark.long), 5])
def test_a_law_outside_the_vocabulary_is_flagged_in_short_recordings(seed: int) -> None:
    """Friction of the elbow that goes with the shoulder's torque; it is slow, and noise was never recorded alone."""
    recordings = [recorded(10 * seed + k, seconds=4.0) for k in range(2)]
    for r in recordings:
        r["elbow_Nm"] += 0.05 * np.abs(r["shoulder_Nm"]) * np.tanh(np.gradient(r["elbow_rad"], PERIOD_S) / 0.1)
    verdict = sd.diagnose(recordings, nominal())
    assert (verdict.verdict, verdict.effects) == ("mismatch_not_identified", [])
    (finding,) = [finding for finding in verdict.data_findings if finding["id"] == "unexplained"]
    assert finding["channel"] == "elbow_Nm" and "noises with its spectrum" in finding["says"]


def test_torques_of_a_payload_are_those_of_the_composite_link() -> None:
    with_load, without = (recorded(1, links, seconds=2.0) for links in (carrying(0.1, 0.25), LINKS))
    rows = []
    for name in NAMES[:2]:
        x = with_load[name]
        v = np.gradient(x, PERIOD_S, edge_order=2)
        rows.append([x, v, np.gradient(v, PERIOD_S, edge_order=2)])
    found = payload_torques(np.array(rows), None, np.array([0.1, 0.3, 0.25, 0.0]), "")
    for row, name in zip(found, NAMES[2:], strict=True):
        inner = slice(5, -5)  # noise is the same in both and cancels
        assert np.max(np.abs(row - (with_load[name] - without[name]))[inner]) < 2e-3 * np.ptp(row)


def test_forces_act_along_motions_of_their_own_subsystem() -> None:
    every = ExternalModel(nominal_of(nominal()))
    assert len(every.forced) == 4
    ports = {n: n.partition("_")[0] for n in NAMES}
    own = ExternalModel(nominal_of(nominal(ports=ports)))
    assert list(own.forced.values()) == [("shoulder_Nm", "shoulder_rad"), ("elbow_Nm", "elbow_rad")]


@pytest.mark.long
def test_a_force_along_a_motion_has_no_module() -> None:
    spec = nominal_of(nominal())
    found = diagnose(spec, [Table(f"r{k}", recorded(k, friction_Nm=0.05, seconds=3.0)) for k in range(2)], lambda *_: None)
    with pytest.raises(InputError, match="a force along a motion"):
        module_of(found)
