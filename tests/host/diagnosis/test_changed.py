"""Nominal parameters that change in the middle of a recording: a load was added, a spring broke, a clutch slips."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from host.diagnosis import diagnose
from tests.host.proof import everyday as make

Array = np.ndarray


def _carried(number: int, loaded_s: float, load_kg: float) -> dict[str, Array]:
    """A sprung mass of 1.2 kg under a force of tones, on which a load is put at `loaded_s`; solved for each sample."""
    rng, t = make.stream(number), 0.01 * np.arange(2000)
    force = 3.0 * make.tones(rng, t, 2.6)
    state, positions = np.zeros(2), np.zeros(t.size)
    for k in range(1, t.size):
        mass = 1.2 if t[k - 1] < loaded_s else 1.2 + load_kg
        rates = lambda _, s, m=mass, f=force[k - 1]: (s[1], (f - 3.0 * s[1] - 150.0 * s[0]) / m)  # noqa: E731
        state = solve_ivp(rates, (0.0, 0.01), state, rtol=1e-9, atol=1e-12).y[:, -1]
        positions[k] = state[0]
    return {"t": t, "f": force, "x": positions + rng.normal(0.0, 1e-4, t.size)}


def _says(content: dict[str, Any]) -> str:
    said = [finding["says"] for finding in content["data_findings"] if finding["id"] == "changed"]
    assert len(said) <= 1
    return said[0] if said else ""


@pytest.mark.slow
def test_a_load_that_is_added_is_stated_with_its_time_and_both_masses() -> None:
    nominal = make.axis_nominal(hold="zero")
    nominal["parameters"] = {"mass": 1.1, "damping": 3.5, "stiffness": 140.0}
    content = diagnose([_carried(3, 10.0, 0.6)], nominal).as_dict()
    assert content["verdict"] == "mismatch_not_identified" and not content["effects"]
    assert "mass is 1.2 before and 1.8 " in _says(content) and " near 10" in _says(content)
    assert "at that time" in content["next"]


def test_a_gain_that_falls_is_stated() -> None:
    columns = make.gear(5)
    columns["load"] = np.where(columns["t"] < 12.0, 1.0, 0.8) * columns["load"]
    content = diagnose([make.gear(6), columns], make.gear_nominal()).as_dict()
    assert content["verdict"] == "mismatch_not_identified"
    assert "recording 2 near 1" in _says(content)
    gains = [float(value) for value in re.findall(r"gain is (\S+) before and (\S+)", _says(content))[0]]
    assert gains == pytest.approx([0.4, 0.32], rel=0.01)


def test_a_spring_that_breaks_is_stated() -> None:
    columns = make.spring(2)
    columns["f"] = columns["f"] - np.where(columns["t"] < 8.0, 0.0, 80.0) * columns["x"]
    content = diagnose([columns], make.spring_nominal()).as_dict()
    assert content["verdict"] == "mismatch_not_identified"
    before, after = re.findall(r"stiffness is (\S+) before and (\S+)", _says(content))[0]
    assert float(before) == pytest.approx(200.0, rel=0.01) and float(after) == pytest.approx(120.0, rel=0.01)


@pytest.mark.slow
def test_an_effect_of_amplitude_is_not_called_a_change() -> None:
    """Play behind a motion that doubles in the middle: the gain of each half differs, and neither half is explained."""
    columns = make.gear(7)
    wider = np.interp(columns["t"], (9.0, 11.0), (1.0, 2.0)) * columns["motor"]
    columns = {**columns, "motor": wider, "load": columns["load"] + 0.4 * (wider - columns["motor"])}
    content = diagnose([make.with_play(columns, 0.3)], make.gear_nominal()).as_dict()
    assert [effect["id"] for effect in content["effects"]] == ["backlash"] and not _says(content)
