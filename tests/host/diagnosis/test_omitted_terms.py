"""A nominal law without one of its terms: damper, spring or constant force, alone and next to another missing effect."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import seldinger as sd
from host.diagnosis.model.nominal import effect_of, nominal_of
from host.diagnosis.model.tables import table_of
from host.diagnosis.problems import candidates_of, prepare
from host.diagnosis.selection.refits import fit_nominal
from host.diagnosis.selection.restart import along_motion
from tests.host.diagnosis.shaken import shaken
from tests.host.proof.everyday import axis_nominal

LONG = pytest.mark.long
SLOW = pytest.mark.slow
MASS, DAMPER, SPRING, OFFSET = "mass", "damping", "stiffness", "offset"
VISCOUS = ("viscous_friction", "coefficient_N_s_per_m")
ELASTIC = ("compliance", "stiffness_N_per_m")
CONSTANT = ("gravity_load", "force_N")
COULOMB = ("coulomb_friction", "force_N")
CUBIC = ("nonlinear_stiffness", "cubic_N_per_m3")


def found(terms: tuple[str, ...], reads: str = "position", **law: Any) -> dict[str, Any]:
    """The verdict on three recordings of `law` by a nominal model of these `terms`."""
    noise = 2e-4 if reads == "position" else 2e-3
    verdict = sd.diagnose(shaken(831, reads=reads, noise=noise, **law), axis_nominal(terms=terms, reads=reads))
    return verdict.as_dict()


def sizes(content: dict[str, Any]) -> dict[str, dict[str, float]]:
    """Values of the parameters of each effect that is named."""
    return {e["id"]: {key: p["value"] for key, p in e["parameters"].items()} for e in content["effects"]}


@pytest.mark.parametrize(
    ("terms", "reads", "law", "wanted"),
    [
        pytest.param((MASS, SPRING, OFFSET), "position", {}, [(*VISCOUS, 15.0)], marks=SLOW),
        ((MASS, DAMPER, OFFSET), "position", {}, [(*ELASTIC, 900.0)]),
        pytest.param((MASS, DAMPER), "position", {"stiffness": 0.0, "constant": -2.0}, [(*CONSTANT, 2.0)], marks=SLOW),
        pytest.param((MASS,), "velocity", {"stiffness": 0.0}, [(*VISCOUS, 15.0)], marks=SLOW),
        pytest.param((MASS, SPRING, OFFSET), "position", {"friction": 4.0}, [(*VISCOUS, 15.0), (*COULOMB, 4.0)], marks=LONG),
        pytest.param((MASS, SPRING, OFFSET), "position", {"cubic": 3e4}, [(*VISCOUS, 15.0), (*CUBIC, 3e4)], marks=LONG),
        pytest.param(
            (MASS, DAMPER, OFFSET), "position", {"friction": 4.0}, [(*ELASTIC, 900.0), (*COULOMB, 4.0)], marks=LONG
        ),
        pytest.param(
            (MASS, DAMPER, SPRING),
            "position",
            {"cubic": 3e4, "constant": -6.0},
            [(*CUBIC, 3e4), (*CONSTANT, 6.0)],
            marks=LONG,
        ),
    ],
)
def test_the_term_that_a_law_lacks_is_named_with_its_size(
    terms: tuple[str, ...], reads: str, law: dict[str, float], wanted: list[tuple[str, str, float]]
) -> None:
    """A fit without the term went astray, and several effects that do not exist were named from there."""
    named = sizes(found(terms, reads, **law))
    assert set(named) == {effect for effect, _, _ in wanted}
    for effect, key, size in wanted:
        assert named[effect][key] == pytest.approx(size, rel=0.02)


@pytest.mark.long
def test_a_constant_force_on_a_spring_is_as_well_an_offset_of_the_reading() -> None:
    """They are the same on a linear spring, next to dry friction too, and are said to be; a one-sided spring was named."""
    content = found((MASS, DAMPER, SPRING), constant=-2.0, friction=4.0)
    named = {e["id"]: e for e in content["effects"]}
    assert set(named) == {"sensor_bias", "coulomb_friction"}
    assert "gravity_load@slide" in named["sensor_bias"]["indistinguishable_from"]
    assert named["sensor_bias"]["parameters"]["offset_m"]["value"] == pytest.approx(-2.0 / 900.0, rel=0.02)
    assert named["coulomb_friction"]["parameters"]["force_N"]["value"] == pytest.approx(4.0, rel=0.02)
    assert np.isclose(content["fit"]["nominal_parameters"]["stiffness_N_per_m"]["value"], 900.0, rtol=0.01)


def test_starts_along_the_motion_leave_the_time_constant_of_a_known_lag_alone() -> None:
    """The error is not linear in it: it was set to zero for a column of the least squares, and divided by."""
    spec = nominal_of(axis_nominal(terms=(MASS, DAMPER, OFFSET)))
    spec.effect += [effect_of("rate_lag@slide:time_constant_s=0.002")]
    tables = [table_of(columns, number) for number, columns in enumerate(shaken(832))]
    problem = prepare(spec, tables)[1]
    springs = [c for c in candidates_of(problem, frozenset()) if c.key == "compliance@slide(spring)"]
    (start,) = along_motion(problem, fit_nominal(problem), springs, [], lambda what, part: None)
    assert start.begin[0] == pytest.approx(900.0, rel=0.02) and start.nominal[0][0] == pytest.approx(2.0, rel=0.02)
    assert np.all(np.isfinite(start.nominal[0]))
