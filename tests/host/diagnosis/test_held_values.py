"""A value that the nominal file holds and that is wrong: stated with its size, never an effect, and hiding none."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

import seldinger as sd
from tests.host.diagnosis.shaken import shaken, tones
from tests.host.proof import everyday as make
from tests.host.proof.everyday import stream

Array = np.ndarray
Columns = dict[str, Array]


def held(value: float) -> dict[str, Any]:
    """A nominal value that is not to be fitted."""
    return {"value": value, "free": False}


def axis(**parameters: Any) -> dict[str, Any]:
    """The nominal mass, damper and spring of `shaken`, all fitted but for those of `parameters` that are held."""
    return make.axis_nominal(**{"mass": 2.0, "damping": 15.0, "stiffness": 900.0, **parameters})


def heated(seed: int) -> list[Columns]:
    """Three recordings of a plate that warms by 0.08 K/W within 4 s, its power switched every 5 s."""
    rng, out, rest = stream(seed), [], float(np.exp(-0.05 / 4.0))
    for _ in range(3):
        t = 0.05 * np.arange(3000)
        u = np.repeat(rng.uniform(0.0, 500.0, 30), 100)
        y = lfilter([0.0, 0.08 * (1.0 - rest)], [1.0, -rest], u)
        out.append({"t": t, "u": u, "y": y + 0.1 * rng.standard_normal(t.size)})
    return out


def plate(tau: dict[str, Any]) -> dict[str, Any]:
    """The nominal first-order lag of `heated`, its time constant (s) as `tau` says."""
    nominal = make.first_order_nominal("W", "K", 0.08, 4.0)
    return {**nominal, "parameters": {**nominal["parameters"], "tau": tau}}


def geared(seed: int, play: float) -> list[Columns]:
    """Three recordings of a gear of 1.3 with play (rad, whole width at the motor)."""
    rng, out = stream(seed), []
    for _ in range(3):
        t = 0.01 * np.arange(2500)
        u = 3.0 * tones(rng, t, 0.05, 1.5)
        y = u.copy()
        for k in range(1, u.size):
            y[k] = min(max(y[k - 1], u[k] - 0.5 * play), u[k] + 0.5 * play)
        out.append({"t": t, "motor": u, "load": 1.3 * y + 0.01 * rng.standard_normal(t.size)})
    return out


def gear(**more: Any) -> dict[str, Any]:
    """The nominal gear of `geared` with `more` sections, such as known effects."""
    return {**make.gear_nominal(gain=1.3), **more}


def stated(verdict: sd.Verdict) -> dict[str, str]:
    """What the verdict says about held values, by their names."""
    return {finding["channel"]: finding["says"] for finding in verdict.data_findings if finding["id"] == "held"}


def value_of(says: str) -> float:
    """The value that the recordings say."""
    return float(says.split("recordings say ")[1].split(" ")[0])


@pytest.mark.parametrize("wrong", [pytest.param(1.6, marks=pytest.mark.long), 2.3])
def test_a_wrong_mass_is_no_second_mass(wrong: float) -> None:
    verdict = sd.diagnose(shaken(811), axis(mass=held(wrong)))
    assert verdict.verdict == "nothing_missing" and verdict.effects == []
    assert list(stated(verdict)) == ["mass"] and value_of(stated(verdict)["mass"]) == pytest.approx(2.0, rel=2e-3)
    assert "mass in the nominal file" in verdict.as_dict()["next"]


@pytest.mark.long
def test_one_wrong_value_of_three_is_found() -> None:
    verdict = sd.diagnose(shaken(812), axis(mass=held(2.0), damping=held(15.0), stiffness=held(800.0)))
    assert verdict.verdict == "nothing_missing" and list(stated(verdict)) == ["stiffness"]


@pytest.mark.long
def test_two_wrong_values_are_found() -> None:
    verdict = sd.diagnose(shaken(813), axis(mass=held(1.7), damping=held(15.0), stiffness=held(840.0)))
    assert verdict.verdict == "nothing_missing" and sorted(stated(verdict)) == ["mass", "stiffness"]


@pytest.mark.parametrize("wrong", [3.0, pytest.param(5.0, marks=pytest.mark.long)])
def test_a_wrong_time_constant_is_no_creep(wrong: float) -> None:
    verdict = sd.diagnose(heated(814), plate(held(wrong)))
    assert verdict.verdict == "nothing_missing" and value_of(stated(verdict)["tau"]) == pytest.approx(4.0, rel=5e-3)


def test_values_that_are_right_are_not_mentioned() -> None:
    verdict = sd.diagnose(shaken(815), axis(mass=held(2.0), damping=held(15.0), stiffness=held(900.0)))
    assert verdict.verdict == "nothing_missing" and verdict.data_findings == []


@pytest.mark.parametrize("mass", [2.0, pytest.param(1.7, marks=pytest.mark.long)])
def test_friction_is_named_next_to_held_values(mass: float) -> None:
    verdict = sd.diagnose(shaken(816, friction=8.0), axis(mass=held(mass)))
    assert [effect["id"] for effect in verdict.effects] == ["coulomb_friction"]
    assert list(stated(verdict)) == ([] if mass == 2.0 else ["mass"])
    friction = next(iter(verdict.effects[0]["parameters"].values()))
    assert friction["value"] == pytest.approx(8.0, rel=0.03)


@pytest.mark.parametrize("play", [0.3, 0.5])
def test_a_known_effect_of_a_wrong_size_is_stated(play: float) -> None:
    known = {"id": "backlash", "at": "gear", "values": {"width_rad": 0.3}, "free": False}
    verdict = sd.diagnose(geared(817, play), gear(effect=[known]))
    assert verdict.verdict == "nothing_missing" and list(stated(verdict)) == ([] if play == 0.3 else ["backlash@gear"])


@pytest.mark.long
def test_a_wrong_time_constant_hides_no_delay() -> None:
    recordings = [{**r, "y": np.interp(r["t"] - 0.6, r["t"], r["y"])} for r in heated(818)]
    verdict = sd.diagnose(recordings, plate(held(5.0)))
    assert [effect["id"] for effect in verdict.effects] == ["latency"] and list(stated(verdict)) == ["tau"]
    assert next(iter(verdict.effects[0]["parameters"].values()))["value"] == pytest.approx(0.6, abs=0.02)
