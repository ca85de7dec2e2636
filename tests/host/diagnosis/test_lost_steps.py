"""Steps that an axis loses at instants of its own in each recording."""

import numpy as np
import pytest

from host.diagnosis import diagnose
from host.diagnosis.export.module import module_of
from protocol.errors import InputError
from tests.host.proof.everyday import gear_nominal

PERIOD_S, SAMPLES, LOST_RAD = 0.01, 3000, 0.08
NOMINAL = gear_nominal()


def recordings(losing, law=lambda turned: turned, seed=5, motion=None):
    """Three recordings of a gear, of which those in `losing` lose steps, each at an instant of its own; and the instants."""
    rng, sets, instants = np.random.default_rng([78, seed]), [], []
    for number in range(3):
        time_s = np.arange(SAMPLES) * PERIOD_S
        turned = sum(rng.uniform(0.2, 0.6) * np.sin(2 * np.pi * f * time_s + rng.uniform(0, 6)) for f in (0.13, 0.37, 0.7))
        turned = turned if motion is None else motion(rng)
        instants.append(time_s[rng.integers(SAMPLES // 4, 3 * SAMPLES // 4)])
        arrived = law(turned - LOST_RAD * (time_s >= instants[-1]) if number in losing else turned)
        sets.append({"t": time_s, "motor": turned, "load": 0.6 * arrived + 0.02 + 0.002 * rng.standard_normal(SAMPLES)})
    return sets, instants


def gap(turned, width=0.04):
    """Play by its definition: the load moves when a flank touches. It is narrower than the steps that are lost."""
    out, at = np.empty_like(turned), turned[0]
    for i, x in enumerate(turned):
        at = min(max(at, x - 0.5 * width), x + 0.5 * width)
        out[i] = at
    return out


@pytest.mark.parametrize("losing", [{0}, {2}, {0, 1, 2}])
def test_steps_that_recordings_lose_at_instants_of_their_own(losing):
    sets, instants = recordings(losing)
    result = diagnose(sets, NOMINAL).as_dict()
    assert result["verdict"] == "missing_physics"
    (effect,) = result["effects"]
    assert effect["id"] == "missed_steps" and effect["subsystem"] == "gear"
    assert 0.4 < effect["probability"] < 0.9 and effect["indistinguishable_from"] == ["unlisted@gear"]  # or a moved sensor
    for number in losing:
        assert f"at {instants[number]:.4g} s of recording {number + 1}" in effect["says"]
    sizes = [entry["value"] for name, entry in effect["parameters"].items() if name.startswith("jump")]
    assert np.allclose(sizes, -LOST_RAD, atol=2e-3)  # none where only samples that are held out have a step
    errors = [entry["load"]["rmse_after"] for entry in result["fit"]["per_recording"].values()]
    assert errors and max(errors) < 0.0022  # noise: 0.002
    assert "Home the axis" in result["next"]


@pytest.mark.parametrize(
    "law, other",
    [(gap, "backlash"), (lambda turned: turned * (1.0 + 0.3 * turned**2), "static_nonlinearity")],
)
def test_what_else_is_missing_is_found_past_lost_steps(law, other):
    sets, _ = recordings({0, 1, 2}, law)
    result = diagnose(sets, NOMINAL).as_dict()
    assert [effect["id"] for effect in result["effects"]] == ["missed_steps", other]


def _staircase(rng):
    return np.repeat(rng.uniform(-1.0, 1.0, 5), SAMPLES // 5)


@pytest.mark.parametrize("law", [gap, lambda turned: turned + 0.1 * turned * np.sin(7.0 * turned)])
def test_levels_of_a_staircase_are_not_taken_for_lost_steps(law):
    """Every law that is not linear leaves a residual that jumps where its input does."""
    sets, _ = recordings(set(), law, motion=_staircase)
    assert "missed_steps" not in [effect["id"] for effect in diagnose(sets, NOMINAL).as_dict()["effects"]]


def test_the_report_says_where_steps_were_lost(tmp_path):
    sets, instants = recordings({0, 1, 2})
    verdict = diagnose(sets, NOMINAL)
    page = verdict.write(tmp_path).read_text(encoding="utf-8")
    for number, instant_s in enumerate(instants, 1):
        assert f"at {instant_s:.4g} s of recording {number}" in page
    with pytest.raises(InputError, match="events at instants of these recordings"):
        module_of(verdict.diagnosis)
