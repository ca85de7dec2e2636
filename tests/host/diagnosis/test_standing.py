"""What a name needs to stand: evidence enough, weight beside others, and readings in steps told by their saw tooth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from host.diagnosis.effects import library
from host.diagnosis.effects.quantization import MOST_STEPS, from_saw_tooth, stepped
from host.diagnosis.estimation.evidence import Gain
from host.diagnosis.estimation.fit import Fit, Term
from host.diagnosis.estimation.rules import RULES
from host.diagnosis.model.effect import Candidate, Evidence, Parameter, Port, Reading
from host.diagnosis.model.nominal import nominal_of
from host.diagnosis.model.tables import Table
from host.diagnosis.pipeline import prepare
from host.diagnosis.report.verdict import at_bound, likelier
from host.diagnosis.selection.equivalence import Standing, _rests_on, with_unlisted_rival
from host.diagnosis.selection.posterior import calibrated, posterior
from host.diagnosis.selection.trial import Trial, good_enough, weighty
from host.diagnosis.selection.unlisted import Remainder
from host.diagnosis.symbolic.dictionary import Form, PredictedPart
from tests.host.diagnosis.test_export import COMMON, KINDS

BACKLASH = Candidate(next(e for e in library() if e.id == "backlash"), Port("cable", "motion", "cable", ("angle",)))
NOTHING = Gain(0.0, 1.0, 0.0)


def trial(likelihood: float, share: float) -> Trial:
    return Trial(BACKLASH, Fit((), np.zeros(0)), NOTHING, NOTHING, Gain(likelihood, 1e-9, share), likelihood)


@pytest.mark.parametrize(
    ("held", "both", "taken"),
    [
        (Gain(100.0, 0.07, 0.2), Gain(700.0, 1e-3, 0.4), True),  # one episode held out: no block test can be sure
        (Gain(10.0, 0.07, 0.2), Gain(20.0, 1e-3, 0.4), False),  # what chance may bring about
        (Gain(1.0, 0.07, 0.2), Gain(700.0, 1e-3, 0.4), False),  # not seen held out
        (Gain(10.0, 1e-4, 0.2), Gain(20.0, 1e-6, 0.4), True),  # many episodes agree
    ],
)
def test_evidence_is_likelihood_or_agreement_of_blocks(held: Gain, both: Gain, taken: bool) -> None:
    term = Term(BACKLASH, (Parameter("width", "rad", (0.1,), 0.0, 1.0),))
    alone = Trial(BACKLASH, Fit((term,), np.array([0.1])), held, Gain(15.0, 1e-3, 0.2), both, 0.0)
    assert good_enough(alone, Fit((), np.zeros(0))) is taken


def test_what_leaves_a_rest_may_stand_for_what_is_in_no_list() -> None:
    form = Form("angle^2", lambda segment: segment.y[0] ** 2, 2)
    remainder = Remainder(PredictedPart("cable", BACKLASH.port, 20.0, 1e-3, 0.2, 30.0, ((form, 1.0),)), 0.4, doubtful=True)
    weak, strong = (Standing(BACKLASH, Gain(gain, 1e-9, 0.2), Gain(gain, 1e-9, 0.2), ()) for gain in (10.0, 80.0))
    assert [[c.name for c in s.alike] for s in with_unlisted_rival([weak, strong], remainder)] == [[], ["unlisted@cable"]]
    assert with_unlisted_rival([weak, strong], replace(remainder, doubtful=False)) == [weak, strong]


@pytest.mark.parametrize(("shown_in", "rests_on"), [((0,), "r0"), ((0, 2), ""), ((0, 1, 2), "")])
def test_evidence_that_one_recording_carries_is_named(shown_in: tuple[int, ...], rests_on: str) -> None:
    rng, t = np.random.default_rng(1), np.arange(600) * 0.01
    tables = [
        Table(f"r{k}", {"t": t, "u": np.sin(t), "y": np.sin(t) + 1e-3 * rng.standard_normal(600), "w": np.cos(t)})
        for k in range(3)
    ]
    _, problem, _ = prepare(nominal_of({**COMMON, "kind": "transmission", **KINDS["transmission"]}), tables)
    noise = [1e-3 * rng.standard_normal((1, 600)) for _ in range(3)]
    removed = [np.sin(8.0 * t)[None, :] * (5e-3 if k in shown_in else 0.0) for k in range(3)]
    less = Fit((), np.zeros(0), [e + r for e, r in zip(noise, removed, strict=True)])
    assert _rests_on(problem, less, Fit((), np.zeros(0), noise), np.array([1e-3]), 1) == rests_on


@pytest.mark.parametrize(("value", "reached"), [(0.0, True), (0.5, False), (1.0, True)])
def test_a_value_at_a_bound_is_marked(value: float, reached: bool) -> None:
    assert at_bound(Parameter("share", "", (0.1,), 0.0, 1.0), value) is reached
    assert not at_bound(Parameter("offset", "N", (0.1,)), value)


@pytest.mark.parametrize(
    ("likelihood", "share", "part", "enough"),
    [
        (150.0, 0.2, 75.0, False),  # less than a fifth of what is named
        (150.0, 0.4, 75.0, True),  # but a third of what is left, fitted and held out alike: its own evidence
        (150.0, 0.4, 20.0, False),  # in one of the two parts dimly
        (250.0, 0.2, 75.0, True),
        (250.0, 0.03, 75.0, False),  # hardly anything of any output
    ],
)
def test_a_further_effect_outdoes_what_modules_lack(likelihood: float, share: float, part: float, enough: bool) -> None:
    held, trained = Gain(part, 1e-3, share), Gain(75.0, 1e-3, share)
    tried = replace(trial(likelihood, share), heldout=held, trained=trained)
    assert weighty(tried, 1000.0) is enough
    assert weighty(tried, 0.0)


def test_steps_by_their_saw_tooth() -> None:
    x = np.linspace(-0.02, 0.03, 5000)
    step = 1.7e-3
    assert np.corrcoef(stepped(x, step) - x, step * np.round(x / step) - x)[0, 1] > 0.92


def test_a_calibrated_probability_takes_its_share_from_all_others() -> None:
    gain = Gain(40.0, 1e-6, 0.9, independent=np.array([400.0]), log_ratio=np.array([0.2]), excesses=np.array([0.1]))
    asis = posterior(gain, gain, 1, [(BACKLASH, 2.0)], 0.1, RULES)
    lower = posterior(gain, gain, 1, [(BACKLASH, 2.0)], 0.1, replace(RULES, effect_slope=0.5, effect_shift=-0.3))
    assert asis.raw == asis.effect == lower.raw and lower.effect < asis.effect
    for each in (asis, lower):
        assert each.effect + each.rivals[0][1] + each.nothing + each.none == pytest.approx(1.0)
    assert calibrated(0.8, 0.5, -0.3) == pytest.approx(1.0 / (1.0 + np.exp(-(0.5 * np.log(4.0) - 0.3))))


@pytest.mark.parametrize(("step_m", "found"), [(5e-4, True), (1e-16, False)])
def test_steps_of_recordings_without_noise_are_searched_in_bounded_time(step_m: float, found: bool) -> None:
    """Where only rounding is left, the range holds 1e14 steps: the search ends, and proposes none."""
    place = 0.02 * np.sin(0.01 * np.arange(1000))
    residual = step_m * np.round(place / step_m) - place if found else 1e-16 * np.sin(np.arange(1000.0))
    reading = Reading("m", place, residual, float(np.std(residual)))
    (step,) = from_saw_tooth(Evidence((), (), (reading,), True), (Parameter("step", "m", (1.0,), 0.0, 1.0),), "m")
    assert bool(step.grid) is found and all(size > place.max() / MOST_STEPS for size in step.grid)
    if found:
        assert min(abs(size / step_m - 1.0) for size in step.grid) < 0.02


@pytest.mark.parametrize(
    ("probability", "alternatives", "says"),
    [
        (0.6, [("rate_lag@link", 0.3)], ""),
        (0.6, [], ""),
        (0.1, [("rate_lag@link", 0.2), ("unlisted@link", 0.7)], "an equation of the recorded signals at link"),
        (0.2, [("rate_lag@pose_sensor", 0.5)], "rate lag at pose sensor is more probable in its place (0.50)"),
    ],
)
def test_a_more_probable_alternative_is_stated(probability: float, alternatives: list[tuple[str, float]], says: str) -> None:
    others = [{"name": name, "probability": p} for name, p in alternatives]
    found = likelier({"probability": probability, "alternatives": others})
    assert says in found and bool(says) == bool(found)
