"""Recordings held out that hardly excite an effect say nothing of it: the others are predicted from one another."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from host.diagnosis import diagnose
from tests.host.diagnosis.test_everyday import GEAR, SPRUNG, Array


def turned(rng: np.random.Generator, size: float, limit: float) -> dict[str, Array]:
    """A motor that turns by up to about twice `size`, and a tip that stops at `limit`; noise 2 mrad."""
    t = np.arange(0.0, 25.0, 0.02)
    x = size * sum(np.sin(2.0 * np.pi * f * t + rng.uniform(0.0, 6.0)) for f in (0.13, 0.31, 0.47))
    return {"t": t, "m": x, "y": 0.8 * np.minimum(x, limit) + 2e-3 * rng.standard_normal(t.size)}


@pytest.mark.parametrize(("limit", "found"), [(1.1, ["saturation"]), (9.0, [])])
def test_a_limit_that_only_the_recordings_to_fit_reach_is_named(limit: float, found: list[str]) -> None:
    rng = np.random.default_rng(7)
    runs = [turned(rng, size, limit) for size in (0.4, 0.4, 0.1)]
    content = diagnose(runs, {**GEAR, "data": {"time": "t", "heldout": ["recording 3"]}}).as_dict()
    assert [effect["id"] for effect in content["effects"]] == found
    for effect in content["effects"]:
        assert effect["cross_validated"] and "predicted from the others" in effect["says"]
        assert effect["parameters"]["limit_rad"]["value"] == pytest.approx(limit, rel=0.02)


@pytest.mark.parametrize("limit", [0.75, 0.85, 0.95])
def test_a_limit_is_not_taken_for_another_gain_beyond_it(limit: float) -> None:
    """Another gain on either side of a centre contains it: with a ratio of -1 nothing moves beyond the centre."""
    rng = np.random.default_rng(7)
    runs = [turned(rng, size, limit) for size in (0.4, 0.4, 0.1)]
    content = diagnose(runs, {**GEAR, "data": {"time": "t", "heldout": ["recording 3"]}}).as_dict()
    assert [effect["id"] for effect in content["effects"]] == ["saturation"]


def dragged(rng: np.random.Generator, force_N: float, slow_m_per_s: float) -> dict[str, Any]:
    """A sprung mass whose friction grows with speed below `slow_m_per_s`, as v over the root of v^2 + slow^2."""
    t, fine = 0.01 * np.arange(2500), 20
    drive = sum(np.sin(2.0 * np.pi * f * t + rng.uniform(0.0, 6.0)) for f in (0.21, 0.57, 1.3))
    x = v = 0.0
    out = np.empty(t.size)
    for k in range(t.size):
        out[k] = x
        ahead = drive[min(k + 1, t.size - 1)]
        for i in range(fine):
            f = drive[k] + (ahead - drive[k]) * i / fine
            v += 0.01 / fine * (f - 3.0 * v - 40.0 * x - force_N * v / np.hypot(v, slow_m_per_s)) / 0.5
            x += 0.01 / fine * v
    return {"t": t, "f": drive, "x": out + 2e-5 * rng.standard_normal(t.size)}


@pytest.mark.parametrize("slow", [0.0005, *(pytest.param(slow, marks=pytest.mark.long) for slow in (0.01, 0.03))])
def test_friction_that_is_smaller_at_low_speed_is_dry_friction(slow: float) -> None:
    rng = np.random.default_rng(3)
    law = {**SPRUNG, "axis": {**SPRUNG["axis"], "reads": "position", "hold": "linear"}}
    content = diagnose([dragged(rng, 0.3, slow) for _ in range(2)], law).as_dict()
    assert [effect["id"] for effect in content["effects"]] == ["coulomb_friction"]
    assert content["effects"][0]["parameters"]["force_N"]["value"] == pytest.approx(0.3, rel=0.1)


def test_a_product_of_deviations_is_found() -> None:
    """Neither factor is zero at rest: the product of the recorded signals alone is another law."""
    rng, t, runs = np.random.default_rng(5), np.arange(0.0, 25.0, 0.02), []
    for _ in range(3):
        turn, load = (
            sum(np.sin(2.0 * np.pi * f * t + rng.uniform(0.0, 6.0)) for f in hertz)
            for hertz in ((0.17, 0.41, 0.9), (0.11, 0.29, 0.67))
        )
        motor, bent = 2.0 + 0.3 * turn, 5.0 + load
        y = 0.8 * motor + 0.02 * (motor - 2.0) * (bent - 5.0) + 2e-3 * rng.standard_normal(t.size)
        runs.append({"t": t, "m": motor, "b": bent, "y": y})
    law = {
        **GEAR,
        "channels": {**GEAR["channels"], "bend": {"column": "b", "unit": "N"}},
        "link": [{**GEAR["link"][0], "load": ["bend"]}],
    }
    content = diagnose(runs, law).as_dict()
    assert [effect["id"] for effect in content["effects"]] == ["unlisted"]
    assert "(m - 2" in content["effects"][0]["equation"] and "(b - " in content["effects"][0]["equation"]
    assert content["fit"]["rmse_after"] == pytest.approx(2e-3, rel=0.1)
