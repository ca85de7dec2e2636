"""How an input runs between its samples is told from a delay: a held input is half a sample late too."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

import seldinger as sd
from tests.host.proof.everyday import free_nominal

DT_S, MASS, DAMPING, STIFFNESS, NOISE = 0.01, 0.5, 3.0, 400.0, 5e-5
FINE = 20  # steps of the simulation in a sample


def slide(seed: int, hold: str, delay_s: float = 0.0) -> dict[str, np.ndarray]:
    """A mass on a spring under tones of 0.2 to 6 Hz, whose force is held or straight between samples, and late."""
    rng = np.random.default_rng([57, seed])
    f = np.geomspace(0.2, 6.0, 9) * rng.uniform(0.95, 1.05, 9)
    t = DT_S * np.arange(2600)
    force = np.sin(2.0 * np.pi * np.outer(t, f) + rng.uniform(0.0, 6.28, 9)).sum(axis=1)
    fine = DT_S / FINE * (np.arange(t.size * FINE) + 0.5) - delay_s
    course = np.interp(fine, t, force) if hold == "linear" else force[np.maximum(fine // DT_S, 0).astype(int)]
    num, den, _ = cont2discrete(([1.0], [MASS, DAMPING, STIFFNESS]), DT_S / FINE, "zoh")
    x = lfilter(num[0], den, course)[::FINE]
    x += NOISE * rng.standard_normal(x.size)
    return {"t": t[:2000], "f": force[600:], "x": x[600:]}


def nominal(hold: str) -> dict[str, Any]:
    return {
        "name": "slide",
        "kind": "axis",
        "data": {"time": "t"},
        "channels": {"f": {"column": "f", "unit": "N"}, "x": {"column": "x", "unit": "m"}},
        "axis": {
            "subsystem": "slide",
            "input": "f",
            "output": "x",
            "terms": ["mass", "damping", "stiffness"],
            "hold": hold,
        },
        "parameters": {"mass": 0.45, "damping": 3.5, "stiffness": 420.0},
    }


def linear(hold: str) -> dict[str, Any]:
    """The same slide as a transfer function."""
    written = {key: value for key, value in nominal(hold).items() if key != "axis"}
    function = {"numerator": [1.0], "denominator": ["mass", "damping", "stiffness"]}
    return {
        **written,
        "kind": "linear",
        "linear": {"inputs": ["f"], "outputs": ["x"], "subsystem": "slide", "hold": hold, **function},
    }


@pytest.mark.slow
@pytest.mark.parametrize("kind", [nominal, pytest.param(linear, marks=pytest.mark.long)])
@pytest.mark.parametrize(
    ("true", "stated", "delay_s", "found"),
    [
        pytest.param("linear", "linear", 0.017, [], marks=pytest.mark.long),
        pytest.param("linear", "linear", 0.05, [], marks=pytest.mark.long),
        ("zero", "zero", 0.023, []),
        ("zero", "linear", 0.0, ["hold"]),
        pytest.param("linear", "zero", 0.0, ["hold"], marks=pytest.mark.long),
        ("zero", "linear", 0.03, None),  # a held input that is 30 ms late is nearly a straight one that is 35 ms late
    ],
)
def test_a_delay_is_not_taken_for_a_held_input(
    kind: Callable[[str], dict[str, Any]], true: str, stated: str, delay_s: float, found: list[str] | None
) -> None:
    verdict = sd.diagnose([slide(seed, true, delay_s) for seed in (1, 2, 3)], kind(stated))
    findings = [finding["id"] for finding in verdict.data_findings]
    if found is not None:
        assert findings == found
    if not delay_s:
        assert verdict.verdict == "nothing_missing"
        return
    assert [effect["id"] for effect in verdict.effects] == ["latency"]
    delay = verdict.effects[0]["parameters"]["delay_s"]["value"]
    half = DT_S / 2.0 if found is None and findings == [] else 0.0
    assert delay == pytest.approx(delay_s + half, abs=0.1 * DT_S)


def stepped(number: int, steps: int) -> dict[str, Any]:
    """A mass and a damper whose integrator moves the place with the speed of the end of each of `steps` in a sample.

    A controller reads the place with 0.2 mm of noise and holds its force.
    """
    rng, dt = np.random.default_rng([85, number]), 0.01
    t, h = np.arange(0.0, 14.0, dt), dt / steps
    wanted = 0.1 * np.sin(2.0 * np.pi * np.outer(t, [0.15, 0.4, 0.9]) + rng.uniform(0.0, 6.28, 3)).sum(axis=1)
    x = v = error = 0.0
    force, place = np.empty(t.size), np.empty(t.size)
    for i in range(t.size):
        place[i] = x + 2e-4 * rng.standard_normal()
        before, error = error, wanted[i] - place[i]
        force[i] = 40.0 * error + 6.0 * (error - before) / dt
        for _ in range(steps):
            v += h * (force[i] - 2.0 * v)
            x += h * v
    return {"t": t[:1200], "f": force[200:], "x": place[200:]}


def test_a_lead_of_an_integrator_is_no_drift_of_a_clock() -> None:
    """Half a step of 0.5 ms: a drift of the clock was named with 0.93."""
    verdict = sd.diagnose([stepped(number, 20) for number in (1, 2, 3)], free_nominal("zero"))
    assert verdict.verdict == "nothing_missing"
    assert "lead" in next(finding["says"] for finding in verdict.data_findings if finding["id"] == "within_sample")
