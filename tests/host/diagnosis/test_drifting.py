"""A parameter that drifts while a recording runs is stated with its course, and not as effects that pass for it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

import seldinger as sd
from host.diagnosis.model.nominal import nominal_of
from host.diagnosis.model.tables import Table
from host.diagnosis.problems import prepare
from host.diagnosis.selection.drifting import drifting
from host.diagnosis.selection.found import Found
from host.diagnosis.selection.refits import fit_nominal
from tests.host.proof.everyday import axis_nominal

Array = npt.NDArray[np.float64]
DT_S, STEPS = 0.01, 40
STAGE = axis_nominal("zero", "velocity", ("mass", "damping", "offset"), mass=1.5, damping=6.0)


def emptied(seed: int, last_kg: float) -> dict[str, Array]:
    """A hopper of 2 kg and 5 N s/m, driven for 15 s; its mass falls to `last_kg` on the way. Steps of 0.25 ms."""
    rng, t = np.random.default_rng(seed), DT_S * np.arange(1500)
    phase = rng.uniform(0.0, 6.3, 4)
    f = 6.0 * np.sin(2.0 * np.pi * np.outer(t, [0.3, 0.7, 1.6, 2.9]) + phase).sum(axis=1)
    v, speed, h = 0.0, np.empty(t.size), DT_S / STEPS
    for i in range(t.size):
        speed[i] = v
        for step in range(STEPS):
            mass = 2.0 + (last_kg - 2.0) * (i + step / STEPS) / t.size
            half = v + 0.5 * h * (f[i] - 5.0 * v) / mass
            v += h * (f[i] - 5.0 * half) / mass
    return {"t": t, "f": f, "x": speed + 0.02 * rng.standard_normal(t.size)}


def test_a_mass_that_falls_is_stated_with_its_course() -> None:
    """Two effects that do not exist, a drifting clock and a weakly damped load, explained a quarter of it."""
    content = sd.diagnose([emptied(seed, 0.8) for seed in (1, 2, 3)], STAGE).as_dict()
    assert content["verdict"] == "mismatch_not_identified" and content["effects"] == []
    (says,) = [finding["says"] for finding in content["data_findings"] if finding["id"] == "drifting"]
    course = [float(value) for value in says.partition("mass is ")[2].partition(" N s2/m")[0].split(",")]
    assert course == pytest.approx(np.linspace(2.0, 0.8, 7), abs=0.05)
    assert "at the begin" in content["next"]


def test_nothing_drifts_where_the_effects_explain_the_motion() -> None:
    """Nothing is named, and the nominal model leaves noise."""
    tables = [Table(str(seed), emptied(seed, 2.0)) for seed in (1, 2, 3)]
    problem = prepare(nominal_of(STAGE), tables)[1]
    nominal = fit_nominal(problem)
    assert drifting(problem, Found(nominal, nominal, [])) == []
