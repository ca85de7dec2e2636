"""Concealed cases: quotas, sizes, no trace of the truth, the same suite from the same seed."""

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lsim

from sim.concealed import generic as concealed_generic
from sim.concealed import nominal as concealed_nominal
from sim.concealed import rig as concealed_rig
from sim.concealed import suite as concealed
from sim.concealed import system as concealed_system
from sim.concealed.scalable_effects import EFFECTS, UNLISTED
from sim.concealed.signals import KINDS, QUIET_S, coloured, lost, presses, signal, windows
from sim.concealed.suite import ConcealedPlan
from sim.concealed.system import ScaledEffect
from sim.effects import PlantedEffect, pack

GENERIC = ("transmission", "axis", "impedance")


def plan(category: str, kind: str, number: int = 0, rho: float = 1.0, closed: bool = False) -> ConcealedPlan:
    return ConcealedPlan(11, number, category, kind, closed, rho, number)


@pytest.mark.parametrize("cases", [1, 10, 24, 200, 333])
def test_the_mix_is_that_of_the_contract(cases: int) -> None:
    counts = concealed.counts(cases)
    assert sum(counts.values()) == cases
    assert all(abs(counts[name] - share * cases) < 1.0 for name, share in concealed.SHARES.items())
    suite = concealed.plans(3, cases)
    assert [p.index for p in suite] == list(range(cases))
    assert abs(sum(p.closed_loop for p in suite) - cases / 2) <= 0.5
    if cases == 200:
        assert counts == {"null": 60, "single": 60, "pair": 30, "outside": 30, "unidentifiable": 20}
        assert {p.rho for p in suite if p.category == "single"} == {0.05, 0.1, 0.25, 0.5, 1.0, 2.0}


def test_another_seed_gives_another_suite() -> None:
    assert concealed.plans(1, 50) == concealed.plans(1, 50)
    assert [p.category for p in concealed.plans(1, 50)] != [p.category for p in concealed.plans(2, 50)]
    with pytest.raises(ValueError, match="cases and seed"):
        concealed.plans(1, 0)


def test_nominal_chain_is_a_cantilever_where_it_is_straight() -> None:
    p = np.array([1.0, -0.070, 0.48, 0.0, 28.6, 0.0, 3e-4, 1.0, 1000.0])
    out = concealed_nominal.predict(p, np.zeros((1, 3)), np.array([[-0.01, 0.0, 0.0]]))[0]
    length = 0.040
    assert out[0] == pytest.approx(0.01 * length**3 / (3.0 * 3e-4), rel=1e-9)
    assert out[2] == pytest.approx(length)
    assert 2.0 * np.arcsin(out[5]) == pytest.approx(0.01 * length**2 / (2.0 * 3e-4), rel=1e-9)


def test_nominal_chain_bends_towards_minus_e2_and_rolls_about_e3() -> None:
    p = np.array([1.0, -0.070, 1.0, 0.0, 1.0, 0.0, 3e-4, 1.0, 1000.0])
    flat, turned = concealed_nominal.predict(p, np.array([[0.0, 0.0, 20.0], [0.0, 1.0, 20.0]]), np.zeros((2, 3)))
    assert flat[:3] == pytest.approx([0.0, -(1.0 - np.cos(0.8)) / 20.0, np.sin(0.8) / 20.0])
    assert turned[:2] == pytest.approx([-np.sin(1.0) * flat[1], np.cos(1.0) * flat[1]])


@pytest.mark.parametrize("closed", [False, True])
def test_a_rig_without_effects_is_the_nominal_one(closed: bool) -> None:
    system = concealed_system.rig(concealed_rig.draw(np.random.default_rng(1), closed))
    session = system.run([])
    rho, _ = concealed.measure(system, session)
    assert rho < 0.1
    assert np.mean(np.vstack(session.outputs)[:, 16] > 0.005) > 0.03  # the wall is met
    assert session.time_s[1][0] > session.time_s[0][-1] + 3.0  # one clock through the session


@pytest.mark.slow
def test_feedback_hides_a_standing_effect() -> None:
    case = concealed_rig.draw(np.random.default_rng(4), True)
    shift = [
        PlantedEffect(
            "base_motion", "base", {"x_m": 0.0, "y_m": 0.001, "z_m": 0.0, "x_rad": 0.0, "frequency_Hz": 0.0, "rise_s": 0.5}
        )
    ]

    def apart(closed: bool) -> float:
        way = replace(case, closed_loop=closed)
        with_it, without = concealed_rig.simulate(way, shift), concealed_rig.simulate(way)
        return float(np.sqrt(np.mean((with_it.outputs[1][400:, 1] - without.outputs[1][400:, 1]) ** 2)))

    assert apart(True) < 0.5 * apart(False)


def test_the_handle_holds_still_before_feedback_sets_in() -> None:
    case = concealed_rig.draw(np.random.default_rng(4), True)
    session = concealed_rig.simulate(case)
    held = round(QUIET_S / concealed_rig.FRAME_S)
    for handle in session.inputs:
        assert not np.any(np.ptp(handle[:held], axis=0))
        assert np.all(np.ptp(handle[held:], axis=0) > 0.0)


def test_the_axis_is_recorded_when_it_moves_not_a_sample_later() -> None:
    period, p = 0.01, np.array([0.5, 5.0, 100.0, 0.0])
    time = np.arange(0.0, 4.0, period)
    drive = np.sin(2.0 * np.pi * time) * np.minimum(time, 1.0)
    exact = lsim(([1.0], p[:3]), drive, time)[1]
    moved = concealed_generic.predict("axis", p, drive[:, None], period)[:, 0]
    late = np.interp(time - period, time, exact)
    assert np.sqrt(np.mean((moved - exact) ** 2)) < 0.01 * np.sqrt(np.mean((late - exact) ** 2))


def test_a_mismatch_that_training_does_not_show_is_not_taught() -> None:
    system = concealed_system.generic(concealed_generic.draw(np.random.default_rng(3), "axis", False))
    hidden, shown = np.zeros((100, 1)), np.ones((100, 1))
    assert concealed.taught(system, [shown, hidden, shown])
    assert not concealed.taught(system, [0.1 * shown, hidden, shown])


def test_a_calibration_starts_with_the_wall_in_reach() -> None:
    for number in range(20):
        system = concealed_system.rig(concealed_rig.draw(np.random.default_rng(number), False))
        true, start = system.case.nominal, concealed._near(system, np.random.default_rng(number))
        assert start[7] - start[1] < true[7] - true[1] - 1e-4 and start[7] < true[7] - 1e-4


def test_a_mode_faster_than_the_recordings_is_refused() -> None:
    mode = next(d for d in EFFECTS["rig"] if (d.id, d.port) == ("resonance", "knob"))
    assert mode.make(1.0)["frequency_Hz"] == 4.0
    with pytest.raises(ValueError, match="frequency_Hz: found 40"):
        mode.make(0.1)


@pytest.mark.parametrize("kind", ["rig", "transmission"])
def test_every_dish_is_in_the_catalogue_at_every_size(kind: str) -> None:
    for effect in EFFECTS[kind]:
        for size in (0.3 if effect.id == "resonance" else 0.02, 1.0, 8.0):
            pack([PlantedEffect(effect.id, effect.port, effect.make(size))])
            assert set(effect.compared) <= set(effect.make(size))


@pytest.mark.parametrize("kind", GENERIC)
def test_every_dish_shows_and_grows(kind: str) -> None:
    case = replace(
        concealed_generic.draw(np.random.default_rng(2), kind, False),
        sigma=np.full(2 if kind == "transmission" else 1, 1e-3),
    )
    system = concealed_system.generic(case)
    for effect in [*EFFECTS[kind], *UNLISTED[kind]]:
        small, large = (concealed.measure(system, system.run([ScaledEffect(effect, s)]))[0] for s in (0.3, 2.0))
        assert 0.0 < small < large, effect


@pytest.mark.parametrize("form", [d for d in UNLISTED["rig"]], ids=lambda d: d.form)
def test_unlisted_forms_on_the_rig_follow_their_formula(form) -> None:  # type: ignore[no-untyped-def]
    warp = concealed_system.Warp([ScaledEffect(form, 1.0)])
    t = np.arange(0.0, 6.0, 0.005)
    handle = np.column_stack([0.004 * np.sin(t), 1.2 * np.sin(0.7 * t), 0.4 + 0.3 * np.sin(1.3 * t)])
    out = np.array([warp(h, 0.005) for h in handle]) - handle
    axis = ("insertion", "roll", "knob").index(form.port)
    names = dict(zip(("handle_insertion_m", "handle_roll_rad", "handle_knob_rad"), handle.T, strict=True))
    wanted = form.make(1.0)["size"] * concealed_generic.unlisted_value(form.form, names, 0.005)
    assert np.max(np.abs(out[40:, axis] - wanted[40:])) < 0.05 * np.max(np.abs(wanted))
    assert not np.any(np.delete(out, axis, axis=1))


@pytest.mark.parametrize("kind", GENERIC)
@pytest.mark.parametrize("category", ["null", "single", "pair", "outside"])
def test_a_case_has_the_size_it_was_to_have(kind: str, category: str, tmp_path: Path) -> None:
    label = concealed.make(plan(category, kind, 5, 0.0 if category == "null" else 0.5, closed=True), tmp_path)
    assert len(label["truth"]) == {"null": 0, "single": 1, "pair": 2, "outside": 1}[category]
    if category in ("single", "outside"):
        assert 0.75 < label["rho"] / 0.5 < 1.33
        assert bool(label["form"]) == (category == "outside")
    assert set(label["noise_rms_heldout"]) == set(label["mismatch_rms_heldout"])


@pytest.mark.slow
def test_a_rig_case_from_seed_to_files(tmp_path: Path) -> None:
    label = concealed.make(plan("single", "rig", 3, 1.0, closed=True), tmp_path)
    assert 0.75 < label["rho"] < 1.33
    text = (tmp_path / "nominal.toml").read_text()
    assert 'kind = "rig"' in text and "wall_stiffness_N_per_m" in text
    assert label["truth"][0].partition("@")[2] in (
        "insertion",
        "roll",
        "knob",
        "shape",
        "contact",
        "pose_sensor",
        "force_sensor",
        "base",
    )


def test_a_slow_tone_leaves_delay_and_lag_open(tmp_path: Path) -> None:
    turn = concealed.PUZZLES.index("one_slow_tone")
    label = concealed.make(ConcealedPlan(11, 4, "unidentifiable", "rig", False, 1.0, turn), tmp_path)
    assert (label["puzzle"], label["kind"]) == ("one_slow_tone", "transmission")
    assert {"latency", "rate_lag"} <= set(label["set"])


def test_no_trace_of_the_truth_in_files_or_names(tmp_path: Path) -> None:
    words = {d.id for kind in EFFECTS for d in EFFECTS[kind]} | {"rho", "truth", "null", "single", "pair", "outside", "seed"}
    seen = []
    for number, category in enumerate(("null", "single", "pair", "outside")):
        folder = tmp_path / f"{number}"
        concealed.make(replace(plan(category, "axis", number, 1.0), seed=20), folder)
        files = sorted(p.stem for p in folder.iterdir())
        content = (folder / "nominal.toml").read_text().replace(".parquet", ".csv")
        assert not [w for w in words if w in content]
        seen.append((files, content))
    assert all(entry == seen[0] for entry in seen)


def test_the_same_plan_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("one", "two"):
        concealed.make(plan("single", "impedance", 7, 0.5), tmp_path / name)
    first, second = ({p.name: p.read_bytes() for p in (tmp_path / n).iterdir()} for n in ("one", "two"))
    assert first == second


def test_the_seal_is_hashed_kept_and_not_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cheap = [plan("null", "axis", 0, 0.0), plan("single", "impedance", 1)]
    monkeypatch.setattr(concealed, "plans", lambda seed, cases: cheap)
    digest = concealed.suite(11, 2, tmp_path)
    content = (tmp_path / "sealed" / "labels.json").read_bytes()
    assert hashlib.sha256(content).hexdigest() == digest
    assert [label["id"] for label in json.loads(content)["labels"]] == ["case_0000", "case_0001"]
    monkeypatch.setattr(concealed, "make", None)
    assert concealed.suite(11, 2, tmp_path) == digest


def test_a_stopped_generator_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cheap = [plan("null", "axis", i, 0.0) for i in range(3)]
    monkeypatch.setattr(concealed, "plans", lambda seed, cases: cheap)
    made, real = [], concealed.make

    def stumbling(p: ConcealedPlan, folder: Path) -> dict:  # type: ignore[type-arg]
        made.append(p.index)
        if made == [0, 1]:
            raise KeyboardInterrupt
        return real(p, folder)

    monkeypatch.setattr(concealed, "make", stumbling)
    with pytest.raises(KeyboardInterrupt):
        concealed.suite(11, 3, tmp_path)
    concealed.suite(11, 3, tmp_path)
    assert made == [0, 1, 1, 2]


def test_rebuilding_from_a_label_gives_the_same_recording(tmp_path: Path) -> None:
    label = concealed.make(plan("pair", "transmission", 9, 1.0, closed=True), tmp_path)
    label = json.loads(json.dumps(label))
    system, planted = concealed.rebuild(label)
    rho, _ = concealed.measure(system, system.run(planted))
    assert rho == pytest.approx(label["rho"], rel=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_signals_start_and_end_still_and_stay_in_bounds(kind: str) -> None:
    t = np.arange(0.0, 30.0, 0.025)
    x = signal(np.random.default_rng(5), kind, t)
    assert not np.any(x[t < 2.5]) and abs(x[-1]) < 1e-9 and 0.3 < np.max(np.abs(x)) <= 1.0 + 1e-9


def test_presses_return_and_noise_has_its_size() -> None:
    rng = np.random.default_rng(6)
    press = presses(rng, np.arange(0.0, 30.0, 0.025))
    assert press.min() > -1e-12 and press.max() <= 1.0 and abs(press[-1]) < 1e-9
    noise = coloured(rng, (20000, 2), np.array([1.0, 3.0]), 0.4, 0.1, 0.02)
    assert noise.std(axis=0) == pytest.approx([1.0, 3.0], rel=0.05)
    assert np.corrcoef(noise[1:, 0], noise[:-1, 0])[0, 1] > 0.2
    assert np.mean(lost(rng, 50000, 0.02, 3.0)) == pytest.approx(0.02, rel=0.3)


def test_windows_are_those_of_the_definition() -> None:
    t = np.arange(0.0, 20.0, 0.02)
    burst = np.where((t > 5.0) & (t < 8.0), 1.0, 0.0)
    ((begin, end),) = windows(burst, t)
    assert begin == pytest.approx(5.0, abs=0.3) and end == pytest.approx(8.0, abs=0.3)
    assert windows(np.zeros_like(t), t) == []
