"""The tester tested: every figure of the table on verdicts whose score is known."""

import numpy as np
import pytest

from host.studies.proof.equation_form import right_form
from host.studies.proof.scoring import gap_closed, judge, parameters, window_f1
from host.studies.proof.table import KEYS, shares, tabulate, worlds_markdown
from tests.host.proof.suite import answer

PLANTED = {
    "id": "backlash",
    "port": "roll",
    "size": 1.0,
    "start_s": 0.0,
    "parameters": {"width_rad": 0.1},
    "compared": ["width_rad"],
}
LABEL = {
    "id": "case_0000",
    "category": "single",
    "puzzle": "",
    "kind": "rig",
    "closed_loop": False,
    "truth": ["backlash@roll"],
    "names": [["backlash"]],
    "set": [],
    "form": "",
    "says": [""],
    "rho": 1.0,
    "rho_wanted": 1.0,
    "planted": [PLANTED],
    "windows_s": [[5.0, 10.0], [40.0, 50.0]],
    "channels": ["tip_turn_z"],
    "mismatch_rms_heldout": {"tip_turn_z": 0.003},
    "noise_rms_heldout": {"tip_turn_z": 0.004},
    "plan": {},
}
NULL = LABEL | {
    "category": "null",
    "truth": [],
    "names": [],
    "planted": [],
    "set": ["nothing_missing"],
    "windows_s": [],
    "rho": 0.01,
    "rho_wanted": 0.0,
}
OUTSIDE = LABEL | {
    "category": "outside",
    "truth": ["unlisted@roll"],
    "names": [["unlisted"]],
    "form": "a_m * b_rad",
    "planted": [PLANTED | {"id": "unlisted", "compared": []}],
}
PAIR = LABEL | {
    "category": "pair",
    "truth": ["backlash@roll", "latency@knob"],
    "names": [["backlash"], ["latency"]],
    "planted": [PLANTED, PLANTED | {"id": "latency", "port": "knob", "compared": []}],
    "says": ["", ""],
}
OPEN = LABEL | {
    "category": "unidentifiable",
    "set": ["latency", "rate_lag"],
    "names": [["latency"]],
    "truth": ["latency@roll"],
}


def says(*ids: str, among: tuple[str, ...] = (), place: str = "roll", **more: object) -> dict:  # type: ignore[type-arg]
    effects = [{"id": i, "subsystem": place, "indistinguishable_from": list(among), "parameters": {}, **more} for i in ids]
    return {"verdict": "missing_physics", "effects": effects, "located": [], "fit": {}}


SILENT, DOUBT = {"verdict": "nothing_missing", "effects": []}, {"verdict": "mismatch_not_identified", "effects": []}


@pytest.mark.parametrize(
    ("label", "verdict", "right", "wrong"),
    [
        (NULL, SILENT, True, False),
        (NULL, DOUBT, False, False),
        (NULL, says("backlash"), False, True),
        (LABEL, says("backlash"), True, False),
        (LABEL, SILENT, False, False),
        (LABEL, DOUBT, False, False),
        (LABEL, says("latency"), False, True),
        (LABEL, says("latency", among=("backlash@roll",)), False, False),
        (LABEL, says("backlash", "whip"), False, True),
        (LABEL | {"rho": 0.1}, SILENT, True, False),
        (LABEL | {"rho": 0.1}, says("latency"), False, True),
        (PAIR, says("latency", "backlash"), True, False),
        (PAIR, says("backlash"), False, False),
        (OUTSIDE, says("unlisted"), True, False),
        (OUTSIDE, DOUBT, True, False),
        (OUTSIDE, says("backlash"), False, True),
        (OUTSIDE, says("backlash", among=("unlisted",)), True, False),
        (OUTSIDE, SILENT, False, False),
        (OPEN, says("latency", among=("rate_lag",)), True, False),
        (OPEN, says("latency"), False, False),
        (OPEN, DOUBT, True, False),
        (OPEN, SILENT, False, False),
        (OPEN | {"set": ["nothing_missing", "latency"], "rho": 0.02}, SILENT, True, False),
        (LABEL, {"verdict": "failed", "error": "x"}, False, False),
        (NULL, {"verdict": "failed", "error": "x"}, False, False),
    ],
)
def test_right_and_confidently_wrong(label: dict, verdict: dict, right: bool, wrong: bool) -> None:  # type: ignore[type-arg]
    facts = judge(label, verdict)
    assert (facts.right, facts.wrong) == (right, wrong)


def test_synonyms_of_the_same_equation_count() -> None:
    label = LABEL | {"names": [["rate_lag", "viscous_friction"]]}
    assert judge(label, says("viscous_friction")).named_first


def test_subsystem_counts_only_where_there_is_a_choice() -> None:
    assert judge(LABEL, says("backlash", place="knob")).subsystem is False
    assert judge(LABEL, says("latency")).subsystem is True
    assert judge(LABEL | {"kind": "axis"}, says("backlash")).subsystem is None


def test_windows_are_scored_in_the_recordings_that_the_verdict_speaks_of() -> None:
    def f1(*windows: list[float]) -> float | None:
        return window_f1(LABEL, {"located": [{"windows_s": [w]} for w in windows]})

    assert f1([5.0, 10.0], [40.0, 50.0]) == pytest.approx(1.0)
    assert f1([5.0, 10.0]) == pytest.approx(1.0)
    assert f1([7.5, 12.5]) == pytest.approx(0.5)
    assert f1([20.0, 30.0]) == 0.0
    assert f1() is None


def test_parameters_by_meaning_and_intervals() -> None:
    effect = {
        "id": "backlash",
        "parameters": {"width_rad": {"value": 0.11, "ci95": [0.105, 0.115]}, "other_m": {"value": 3.0}},
    }
    errors, covered = parameters(LABEL, [effect])
    assert errors == pytest.approx((0.1,)) and covered == (False,)
    assert parameters(LABEL, [effect | {"id": "whip"}]) == ((), ())


def held(planted: dict, equation: str, **found: float) -> tuple[bool, ...]:  # type: ignore[type-arg]
    """Whether intervals of a hundredth about what was found hold what was planted."""
    parts = {k: {"value": v, "ci95": sorted((0.99 * v, 1.01 * v))} for k, v in found.items()}
    label = LABEL | {"planted": [PLANTED | planted], "names": [[planted["id"]]]}
    return parameters(label, [{"id": planted["id"], "equation": equation, "parameters": parts}])[1]


def test_values_are_compared_in_the_words_that_the_finder_has_for_them() -> None:
    whip = {"id": "whip", "parameters": {"amplitude_rad": 0.2}, "compared": ["amplitude_rad"], "gain": 0.5}
    assert held(whip, "y + amplitude*sin(y + phase) = x", amplitude_rad=0.2) == (True,)
    assert held(whip, "y + amplitude*sin(y + phase) = x, behind the gain", amplitude_rad=0.1) == (True,)
    assert held(whip, "y + amplitude*sin(y + phase) = x, behind the gain", amplitude_rad=0.2) == (False,)
    scale = {"id": "sensor_scale", "parameters": {"gain": 1.1}, "compared": [], "equivalent": {"gain_error": 0.1}}
    assert held(scale, "", gain_error=0.1) == (True,)
    limit = {"id": "saturation", "parameters": {"limit_N": 0.2}, "compared": ["limit_N"], "gain": 1.0}
    assert held(limit, "y = max(x, limit)", limit_N=-0.2) == (True,)
    assert held(limit, "y = min(x, limit)", limit_N=-0.2) == (False,)


def test_a_drift_that_begins_late_has_no_rate_since_the_begin() -> None:
    drift = {"id": "clock_drift", "parameters": {"rate": 1e-4}, "compared": ["rate"]}
    assert held(drift, "", rate=1e-4) == (True,)
    assert held(drift | {"start_s": 9.0}, "", rate=1e-4) == ()


def test_gap_closed_between_nominal_and_noise() -> None:
    def fit(before: float, after: float) -> dict:  # type: ignore[type-arg]
        return {"fit": {"per_channel": {"tip_turn_z": {"rmse_before": before, "rmse_after": after}}}}

    assert gap_closed(LABEL, fit(0.005, 0.004)) == pytest.approx(1.0)
    assert gap_closed(LABEL, fit(0.005, 0.0045)) == pytest.approx(0.5)
    assert gap_closed(LABEL, fit(0.003, 0.003)) is None
    assert gap_closed(NULL, fit(0.005, 0.005)) is None


def test_table_of_a_finder_that_knows_all() -> None:
    table = tabulate([judge(label, answer(label)) for label in (NULL, LABEL, PAIR, OUTSIDE)])
    assert tuple(table) == KEYS
    assert table["false_alarms"] == 0 and table["null_cases"] == 1
    assert table["named_first"] == table["truth_in_set"] == table["pairs_exact"] == table["outside_flagged"] == 1.0
    assert table["confident_wrong_in_library"] == table["confident_wrong_outside"] == 0.0
    assert (
        table["parameter_error_median"] == 0.0 and table["coverage_95"] == 1.0 and table["window_f1"] == pytest.approx(1.0)
    )
    assert table["detected_rho_0.25"] is None


def test_a_share_states_how_many_cases_it_rests_on() -> None:
    facts = [judge(LABEL, answer(LABEL)), judge(LABEL, answer(LABEL)), judge(LABEL, SILENT), judge(NULL, SILENT)]
    first = shares(facts)["named_first"]
    # Wilson (1927): (p + z^2/2n -+ z sqrt(p (1 - p) / n + z^2 / 4n^2)) / (1 + z^2/n) with p = 2/3, n = 3, z = 1.96
    assert (first.count, first.of) == (2, 3)
    assert (first.low, first.high) == (pytest.approx(0.2077, abs=1e-3), pytest.approx(0.9385, abs=1e-3))
    assert "pairs_exact" not in shares(facts)
    text = worlds_markdown({"own": tabulate(facts)}, {"own": shares(facts)}, "own")
    assert "| named first | 0.92 / 0.80 | 0.667, 2 of 3 (0.21 to 0.94) |" in text
    assert "| pairs exact | 0.85 / 0.60 |  |" in text


@pytest.mark.parametrize(("label", "true"), [(LABEL, False), (NULL, True), (OUTSIDE, True)])
def test_none_of_the_vocabulary_is_true_outside_it(label: dict, true: bool) -> None:  # type: ignore[type-arg]
    verdict = {"verdict": "mismatch_not_identified", "effects": [], "probability_none": 0.8}
    assert judge(label, verdict).stated == ((0.8, true),)


def test_detection_is_counted_at_its_own_rho() -> None:
    near = [
        judge(LABEL | {"rho": rho}, verdict) for rho, verdict in ((0.2, SILENT), (0.3, DOUBT), (0.45, DOUBT), (2.0, SILENT))
    ]
    table = tabulate(near)
    assert table["detected_rho_0.25"] == 0.5 and table["detected_rho_0.5"] == 1.0


COLUMNS = {"time_s": np.arange(0.0, 20.0, 0.02)}
COLUMNS |= {
    "a_m": np.sin(COLUMNS["time_s"]),
    "b_rad": 0.5 + np.cos(0.37 * COLUMNS["time_s"]),
    "c_N": np.sin(2.1 * COLUMNS["time_s"]),
}


@pytest.mark.parametrize(
    ("equation", "truth", "right"),
    [
        ("y = 0.3*a_m*b_rad", "a_m * b_rad", True),
        ("y = 2·a·b + 0.01", "a_m * b_rad", True),
        ("y = a_m + b_rad", "a_m * b_rad", False),
        ("0.2 * c_N * a_m", "a_m * b_rad", False),
        ("F = 3*v_a*|v_a|", "rate(a_m) * abs(rate(a_m))", True),
        ("F = 3*a_rate", "rate(a_m) * abs(rate(a_m))", True),
        ("F = a_rate^2", "rate(a_m) * abs(rate(a_m))", False),
        ("y = play(b, 0.52)", "play(b_rad, 0.5)", True),
        ("x = lag(c_N, 0.2)", "play(b_rad, 0.5)", False),
        ("y = unknown(a)", "a_m * b_rad", False),
        ("", "a_m", False),
        ("__import__('os')", "a_m", False),
    ],
)
def test_equations_are_compared_by_their_values(equation: str, truth: str, right: bool) -> None:
    assert right_form(equation, truth, COLUMNS, []) == right


def test_what_the_nominal_model_absorbs_is_no_form() -> None:
    assert right_form("y = a + 0.5*a*b", "a_m * b_rad", COLUMNS, ["a_m"])
    assert not right_form("y = 2*a", "2 * a_m + 0.1 * c_N", COLUMNS, ["a_m"])
