"""What a name needs to stand: evidence enough, weight beside others, and readings in steps told by their saw tooth."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from host.diagnosis.effects import candidates, library
from host.diagnosis.effects.quantization import MOST_STEPS, from_saw_tooth, stepped
from host.diagnosis.estimation.evidence import Gain
from host.diagnosis.estimation.fit import Fit, Term, finish
from host.diagnosis.estimation.rules import RULES
from host.diagnosis.model.effect import Candidate, Evidence, Parameter, Port, Reading, Scale
from host.diagnosis.model.nominal import nominal_of
from host.diagnosis.model.tables import Table
from host.diagnosis.problems import candidate_ports, prepare
from host.diagnosis.report.verdict import at_bound, likelier
from host.diagnosis.selection import equivalence
from host.diagnosis.selection.equivalence import Standing, _rests_on, with_unlisted_rival, without_improbable
from host.diagnosis.selection.found import Found, SearchMove, Step
from host.diagnosis.selection.posterior import ahead_of_rival, calibrated, posterior
from host.diagnosis.selection.refits import fit_nominal
from host.diagnosis.selection.screening import Screened, term_of
from host.diagnosis.selection.search import _varied
from host.diagnosis.selection.trial import Trial, good_enough, only_sampling, weighty
from host.diagnosis.selection.unlisted import Remainder
from host.diagnosis.symbolic.dictionary import Form, PredictedPart, equation_at
from tests.host.diagnosis.test_export import COMMON, KINDS

BACKLASH = Candidate(next(e for e in library() if e.id == "backlash"), Port("cable", "motion", "cable", ("angle",)))
PORT = Port("cable", "motion+limit", "cable", ("angle",))
NOTHING = Gain(0.0, 1.0, 0.0)
WHOLE = Gain(200.0, 1e-9, 1.0, independent=np.array([60.0]), log_ratio=np.array([40.0]))  # removes all of the error


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
    assert _rests_on(problem, less, Fit((), np.zeros(0), noise), 1) == rests_on


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
    asis = posterior(gain, gain, 1, [(BACKLASH, 2.0)], 0.1, replace(RULES, effect_a=1.0, effect_b=1.0, effect_c=0.0))
    lower = posterior(gain, gain, 1, [(BACKLASH, 2.0)], 0.1, replace(RULES, effect_a=0.5, effect_b=0.5, effect_c=-0.3))
    assert asis.raw == asis.effect == lower.raw and lower.effect < asis.effect
    for each in (asis, lower):
        assert each.effect + each.rivals[0][1] + each.nothing + each.none == pytest.approx(1.0)
    assert calibrated(0.8, 0.5, 0.5, -0.3) == pytest.approx(1.0 / (1.0 + np.exp(-(0.5 * np.log(4.0) - 0.3))))
    assert calibrated(0.8, 0.2, 0.9, 0.1) == pytest.approx(1.0 / (1.0 + 0.8**-0.2 * 0.2**0.9 * np.exp(-0.1)))


def test_an_effect_is_as_probable_as_all_forms_of_its_name() -> None:
    """A limit with a knee outdoes a polynomial; an equation of a curve outdoes both. Curves together are likelier."""
    curve, limit = (
        next(c for c in candidates((PORT,), True) if c.effect.id == name) for name in ("static_nonlinearity", "saturation")
    )
    exact = equation_at(PORT, Form("tanh(angle)", lambda segment: np.tanh(segment.y[0]), 2, curve=True))
    assert exact.name == curve.name != limit.name
    gain = Gain(400.0, 1e-9, 0.9, independent=np.array([400.0]), log_ratio=np.array([2.0]), excesses=np.array([0.1]))
    rules = replace(RULES, effect_a=1.0, effect_b=1.0, effect_c=0.0)
    alone = posterior(gain, gain, 2, [(limit, -2.0)], 0.0, rules, name=curve.name)
    found = posterior(gain, gain, 2, [(limit, -2.0), (exact, -5.0)], 0.0, rules, name=curve.name)
    other = posterior(gain, gain, 3, [(curve, 2.0), (exact, -3.0)], 0.0, rules, name=limit.name)
    assert alone.effect < 0.15 < 0.9 < found.effect
    assert found.effect == pytest.approx(sum(p for _, p in other.rivals), abs=0.01)
    assert [rival for rival, _ in found.rivals] == [limit]


def test_an_equation_chosen_among_hundreds_is_no_simpler_than_an_effect(monkeypatch: pytest.MonkeyPatch) -> None:
    """It outdoes a limit by what it leaves alone, not by the two parameters that the limit has more."""
    limit = next(c for c in candidates((PORT,), True) if (c.effect.id, c.form) == ("saturation", "both"))
    scale = Scale("rad", 2.0, -1.0, 1.0, 1.0, 1e-6, 0.1, 0.01, 10.0, True)
    best = Fit((Term(limit, limit.effect.parameters(scale, "both")),), np.zeros(3))
    equation = equation_at(PORT, Form("angle^2", lambda segment: segment.y[0] ** 2, 2))
    found = replace(trial(0.0, 0.0), candidate=equation)
    found.fit = Fit((Term(equation, equation.effect.parameters(scale, "")),), np.zeros(1))
    ahead = Gain(6.0, 1e-3, 0.1, independent=np.array([60.0]))
    monkeypatch.setattr(equivalence, "equations_for", lambda *_: [found])
    problem: Any = SimpleNamespace(rules=RULES, segments=[], gain=lambda *_: ahead)
    ((rival, difference),) = equivalence._better_said(problem, Found(best, best, []), limit, best, WHOLE)
    assert rival is equation and difference == pytest.approx(-6.0 * RULES.coarsening / (60.0 + RULES.coarsening))


def test_a_rival_with_few_parameters_has_to_outdo_the_form_with_few_parameters() -> None:
    """The simple form of the named effect is fitted together with its rivals; a form with as many parameters is not."""
    every = candidates((Port("pad", "force", "pad", ("force",)),), True)
    scale = Scale("N", 2.0, -1.0, 1.0, 1.0, 1e-6, 0.1, 0.01, 10.0, True, motion_unit="m")

    def tried(effect: str, form: str, score: float) -> Trial:
        candidate = next(c for c in every if (c.effect.id, c.form) == (effect, form))
        term = Term(candidate, candidate.effect.parameters(scale, form))
        return Trial(candidate, Fit((term,), np.zeros(len(term.parameters))), NOTHING, NOTHING, NOTHING, score)

    smooth, plain = tried("coulomb_friction", "smooth", 148.0), tried("coulomb_friction", "", 135.0)
    bristles, drag = tried("coulomb_friction", "bristles", 127.0), tried("viscous_friction", "quadratic", 86.0)
    assert plain.fit.fitted < smooth.fit.fitted == bristles.fit.fitted
    found = Found(Fit((), np.zeros(0)), smooth.fit, [Step(SearchMove.FORWARD, "", NOTHING, [smooth, bristles, plain, drag])])
    assert equivalence._rivals(found, smooth.candidate, RULES) == [plain, drag]


@pytest.mark.parametrize(
    ("likelihood", "share", "stays"),
    [
        (765.0, 0.15, True),  # the base moved at one time; a constant offset has four parameters fewer
        (765.0, 0.02, False),  # no more than an idealized formula leaves
        (7.0, 0.15, False),  # less than four parameters cost
    ],
)
def test_parameters_that_have_earned_their_cost_are_no_case_for_a_simpler_rival(
    likelihood: float, share: float, stays: bool
) -> None:
    """Each cost its full penalty against a likelihood that is coarsened to a thousandth."""
    ahead = Gain(likelihood, 1e-9, share, independent=np.array([40000.0]), log_ratio=np.array([-np.log(1.0 - share)]))
    earned = Gain(140000.0, 1e-9, 0.999, independent=np.array([40000.0]), log_ratio=np.array([7.0]))
    assert (ahead_of_rival(ahead, 4, earned, RULES) > 0.0) is stays
    assert ahead_of_rival(ahead, -4, earned, RULES) > 4 * RULES.parameter_penalty


def test_noise_hides_what_a_formula_idealizes() -> None:
    """A lead of 12 over a rival with two parameters fewer counts behind noise, and not where formulas show."""
    n = np.array([17000.0])
    ahead = Gain(12.0, 1e-9, 0.026, independent=n, log_ratio=np.array([0.0014]))
    small = Gain(103.0, 1e-9, 0.012, independent=n, log_ratio=np.array([0.012]))
    large = Gain(60000.0, 1e-9, 0.999, independent=n, log_ratio=np.array([7.0]))
    assert ahead_of_rival(ahead, 2, small, RULES) > 1.0
    assert ahead_of_rival(ahead, 2, large, RULES) < -3.0
    behind = Gain(-12.0, 0.9, -0.001, independent=n, log_ratio=np.array([-0.0014]))
    assert ahead_of_rival(behind, -2, small, RULES) == pytest.approx(-ahead_of_rival(ahead, 2, small, RULES))


def test_further_forms_do_not_fill_the_places_of_other_effects() -> None:
    """Five forms of two effects promise most at one port; the third effect there is fitted all the same."""
    every = candidates((PORT,), True)
    promised = [
        ("presliding_friction", "general"),
        ("presliding_friction", "dahl"),
        ("static_nonlinearity", ""),
        ("static_nonlinearity", "fine"),
        ("presliding_friction", "reversal"),
        ("presliding_friction", "maxwell"),
        ("creep_relaxation", ""),
    ]
    items = [
        Screened(next(c for c in every if (c.effect.id, c.form) == key), Term(BACKLASH, ()), (), 90.0 - k, [])
        for k, key in enumerate(promised)
    ]
    kept = [(item.candidate.effect.id, item.candidate.form) for item in _varied(items, RULES)]
    assert kept[:3] == [promised[0], promised[2], promised[6]]
    assert set(promised) - set(kept) == {("presliding_friction", "maxwell")}
    assert [item.candidate.effect.id for item in _varied(items, RULES, here=1)] == ["presliding_friction"] * 3


@pytest.mark.parametrize(("lead", "named"), [(0.5, True), (30.0, False)])
def test_a_pair_that_does_as_well_shares_the_probability(lead: float, named: bool) -> None:
    """A loop with a dead band is as late as a delay and rests like a gap: data may not separate them."""
    loop, gap, late = (
        next(c for c in candidates((PORT,), True) if (c.effect.id, c.form) == key)
        for key in (("dead_zone", "loop"), ("backlash", ""), ("latency", ""))
    )
    scale = Scale("rad", 2.0, -1.0, 1.0, 1.0, 1e-6, 0.1, 0.01, 10.0, True)
    best, pair = (
        Fit(tuple(Term(c, c.effect.parameters(scale, c.form)) for c in given), np.zeros(2))
        for given in ((loop,), (gap, late))
    )
    ahead = Gain(lead, 0.2, 0.01, independent=np.array([60.0]))
    problem: Any = SimpleNamespace(rules=RULES, segments=[], gain=lambda *_: ahead)
    parts = equivalence._pairs(problem, Found(best, best, [], pairs=[pair]), loop, WHOLE)
    assert [part for part, _ in parts] == ([gap, late] if named else [])
    if named:
        gain = Gain(400.0, 1e-9, 0.9, independent=np.array([400.0]), log_ratio=np.array([2.0]), excesses=np.array([0.1]))
        found = posterior(
            gain, gain, 2, parts, 0.0, replace(RULES, effect_a=1.0, effect_b=1.0, effect_c=0.0), name=loop.name
        )
        assert 0.4 < found.effect < 0.6 and sum(p for _, p in found.rivals) == pytest.approx(1.0 - found.effect, abs=0.06)


@pytest.mark.parametrize(("form", "fitted"), [("", 2), ("fine", 5)])
def test_what_the_recordings_give_is_no_fitted_parameter(form: str, fitted: int) -> None:
    """Middle and half range of a curve are those of the recorded motion: a limit with as many parameters is no simpler."""
    scale = Scale("rad", 2.0, -1.0, 1.0, 1.0, 1e-6, 0.1, 0.01, 10.0, True)
    curve = next(c for c in candidates((PORT,), True) if (c.effect.id, c.form) == ("static_nonlinearity", form))
    term = Term(curve, curve.effect.parameters(scale, form))
    assert len(term.parameters) == fitted + 2
    assert Fit((term,), np.zeros(fitted + 3)).fitted == term.fitted == fitted


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


def test_a_coarser_step_that_follows_the_noise_is_not_preferred() -> None:
    """Six readings of a tracker with steps of 0.26 to 0.4 mm got starts at twice the step or more, and no quantization."""
    rng = np.random.default_rng(3)
    for step_m in (2.6e-4, 4e-4):
        readings = []
        for size, middle in ((5e-3, 0.0), (8e-3, 2e-3), (1.6e-2, 2e-2), (1.2e-4, 0.0), (3e-4, 0.0), (6e-3, 4e-3)):
            for _ in range(2):
                place = middle + size * np.sin(0.017 * np.arange(1200) * rng.uniform(0.8, 1.2))
                told = place + 3e-5 * rng.standard_normal() + 2e-5 * np.sin(0.005 * np.arange(1200))
                residual = step_m * np.round(place / step_m) + 1.26e-4 * rng.standard_normal(1200) - told
                readings.append(Reading("m", told, residual, float(np.std(residual))))
        (step,) = from_saw_tooth(Evidence((), (), tuple(readings), True), (Parameter("step", "m", (1.0,), 0.0, 1.0),), "m")
        assert min(abs(size / step_m - 1.0) for size in step.grid) < 0.01


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


LAG = next(e for e in library() if e.id == "latency")
LINK = Port("axis_drive", "motion", "axis", ("drive",), held=True)


@pytest.mark.parametrize(
    ("place", "lead", "refused"),
    [
        ("axis_drive", 3.0, True),  # at the port of the delay: it does as well
        ("axis_drive", 8.0, False),
        ("axis", -1.0, True),  # elsewhere in the subsystem: the delay does better
        ("axis", 3.0, False),
    ],
)
def test_what_a_delay_within_a_sample_explains_has_no_other_name(place: str, lead: float, refused: bool) -> None:
    delay = Term(Candidate(LAG, LINK), (Parameter("delay", "s", (0.01,), 0.0, 1.0),))
    held = Trial(delay.candidate, Fit((delay,), np.array([0.003]), [np.zeros((1, 500))]), NOTHING, NOTHING, NOTHING, 30.0)
    held.period_s = 0.01
    other = Candidate(BACKLASH.effect, replace(LINK, name=place))
    term = Term(other, (Parameter("width", "m", (0.1,), 0.0, 1.0),))
    named = Trial(other, Fit((term,), np.array([0.1]), [np.zeros((1, 500))]), NOTHING, NOTHING, NOTHING, 30.0 + lead)
    assert only_sampling(named, [held, named]) is refused


@pytest.mark.parametrize(
    ("left", "share", "ahead", "removed"),
    [
        (0.0, 0.05, -1.0, True),
        (0.6, 0.05, -1.0, False),
        (0.0, 0.4, -1.0, False),  # a rival is likelier, but one of the two is there
        (0.0, 0.4, 9.0, False),  # probable itself
    ],
)
def test_an_improbable_effect_stays_if_no_other_is_probable_without_it(
    monkeypatch: pytest.MonkeyPatch, left: float, share: float, ahead: float, removed: bool
) -> None:
    """left, share: of the mismatch, after the removal, and by the weak effect; ahead: of its rival."""
    rng, t = np.random.default_rng(5), np.arange(900) * 0.02
    u = np.sin(2.0 * np.pi * 0.3 * t)
    y = u + 0.2 * np.cos(2.0 * np.pi * 0.11 * t) + 1e-2 * rng.standard_normal(900)
    tables = [Table(f"r{k}", {"t": t, "u": u, "y": y, "w": np.cos(2.0 * np.pi * 0.11 * t)}) for k in range(2)]
    _, problem, _ = prepare(nominal_of({**COMMON, "kind": "transmission", **KINDS["transmission"]}), tables)
    nominal = fit_nominal(problem)
    offered = candidates(candidate_ports(problem), timed=True)
    terms = tuple(
        term_of(problem, next(c for c in offered if c.effect.id == name), nominal) for name in ("backlash", "compliance")
    )
    values = np.concatenate((nominal.values, [1e-3], [0.2]))
    found = Found(nominal, finish(problem, Fit(terms, values)), [])
    gain, equal = Gain(80.0, 1e-9, 0.5), ((BACKLASH, ahead),)
    strong = Standing(terms[0].candidate, gain, gain, ())
    weak = Standing(terms[1].candidate, gain, gain, (), equal, share=share)
    monkeypatch.setattr(equivalence, "standings", lambda *_: [strong])
    monkeypatch.setattr(equivalence, "remainder_of", lambda *_: Remainder(None, left))
    before = found.best
    fewer = without_improbable(problem, found, [strong, weak], Remainder(None, 0.0))
    assert (fewer is not None) is removed
    assert (found.best is before) is not removed
