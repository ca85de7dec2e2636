"""Arrays as people have them, through the public function: the truth is stated, or what cannot be told."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from host.diagnosis import diagnose
from host.diagnosis.effects import library
from host.diagnosis.estimation.evidence import Gain
from host.diagnosis.estimation.fit import Fit, Term
from host.diagnosis.estimation.noise import estimate
from host.diagnosis.estimation.rules import RULES
from host.diagnosis.model.effect import Candidate, Port, Scale
from host.diagnosis.model.nominal import nominal_of
from host.diagnosis.model.operators import lag, quantum, shift
from host.diagnosis.model.tables import Table
from host.diagnosis.problems import inspected
from host.diagnosis.selection.posterior import posterior
from host.diagnosis.selection.trial import vanished
from tests.host.proof.everyday import first_order_nominal

Array = np.ndarray
GEAR = {
    "name": "gear",
    "kind": "transmission",
    "data": {"time": "t"},
    "channels": {"motor": {"column": "m", "unit": "rad"}, "tip": {"column": "y", "unit": "rad"}},
    "link": [{"subsystem": "gear", "input": "motor", "output": "tip"}],
}
STAGE = {
    "name": "stage",
    "kind": "axis",
    "data": {"time": "t"},
    "channels": {"force": {"column": "f", "unit": "N"}, "position": {"column": "x", "unit": "m"}},
    "axis": {"subsystem": "stage", "input": "force", "output": "position", "terms": ["mass", "damping", "offset"]},
}


SPRUNG = {**STAGE, "axis": {**STAGE["axis"], "terms": ["mass", "damping", "stiffness", "offset"]}}


def sines(rng: np.random.Generator, t: Array, hertz: tuple[float, ...], size: float) -> tuple[Array, Array, Array]:
    """Sum of sines of amplitude size / f: position, speed, acceleration."""
    out = np.zeros((3, t.size))
    for f in hertz:
        angle, w = 2.0 * np.pi * f * t + rng.uniform(0.0, 2.0 * np.pi), 2.0 * np.pi * f
        out += size / f * np.array([np.sin(angle), w * np.cos(angle), -(w**2) * np.sin(angle)])
    return out[0], out[1], out[2]


def stage(rng: np.random.Generator, seconds: float = 20.0) -> dict[str, Array]:
    """0.5 kg and 3 N s/m, cut from motion; 2 um and 2 mN of noise."""
    t = np.arange(0.0, seconds, 0.01)
    x, v, a = sines(rng, t, (0.31, 0.73, 1.37, 2.11), 0.02)
    return {"t": t, "x": x + 2e-6 * rng.normal(size=t.size), "f": 0.5 * a + 3.0 * v + 2e-3 * rng.normal(size=t.size)}


def gear(rng: np.random.Generator, change: Any = lambda x, t: x, gain: float = 1.0, noise: float = 1e-3) -> dict[str, Array]:
    """A gear recorded for 30 s at 50 Hz."""
    t = np.arange(0.0, 30.0, 0.02)
    x, _, _ = sines(rng, t, (0.11, 0.23, 0.37, 0.71), 0.1)
    return {"t": t, "m": x, "y": gain * change(x, t) + 0.02 + noise * rng.normal(size=t.size)}


def ids(content: dict[str, Any]) -> set[str]:
    return {finding["id"] for finding in content["data_findings"]}


@pytest.mark.parametrize("seconds", [20.0, 7.0])
def test_a_mass_and_a_damper_are_a_mass_and_a_damper(seconds: float) -> None:
    rng = np.random.default_rng(1)
    content = diagnose([stage(rng, seconds), stage(rng, seconds)], STAGE).as_dict()
    found = content["fit"]["nominal_parameters"]
    assert content["verdict"] == "nothing_missing" and content["effects"] == [] and content["data_findings"] == []
    assert found["mass_N_s2_per_m"]["value"] == pytest.approx(0.5, rel=0.003)
    assert found["damping_N_s_per_m"]["value"] == pytest.approx(3.0, rel=0.003)


def test_a_reversed_force_is_a_sign_not_physics() -> None:
    rng = np.random.default_rng(2)
    runs = [{**run, "f": -run["f"]} for run in (stage(rng), stage(rng))]
    content = diagnose(runs, STAGE).as_dict()
    assert ids(content) == {"sign"} and content["verdict"] == "nothing_missing"
    assert content["fit"]["nominal_parameters"]["mass_N_s2_per_m"]["value"] == pytest.approx(0.5, rel=0.01)


def test_exchanged_columns_are_said_to_be() -> None:
    rng = np.random.default_rng(3)
    runs = [{**run, "f": run["x"], "x": run["f"]} for run in (stage(rng), stage(rng))]
    assert "swapped" in ids(diagnose(runs, STAGE).as_dict())


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_sign_of_an_accelerometer_is_found(sign: float) -> None:
    """A seat on a spring, shaken; the readings have an offset, whose integral drifts."""
    runs = []
    for seed in (41, 42):
        rng, t = np.random.default_rng(seed), 0.005 * np.arange(4000)
        turn, phase = 2.0 * np.pi * rng.uniform(0.5, 8.0, 12), rng.uniform(0.0, 6.3, 12)
        tones = rng.uniform(0.2, 1.0, 12) * np.exp(1j * (np.outer(t, turn) + phase))
        force = (tones * (40.0 + 500.0 / (1j * turn) - 15e3 / turn**2)).imag.sum(axis=1)
        reading = sign * tones.imag.sum(axis=1) + 0.3 + 0.05 * rng.standard_normal(t.size)
        runs.append({"t": t, "f": force, "x": reading})
    seat = {**SPRUNG, "axis": {**SPRUNG["axis"], "reads": "acceleration", "terms": ["mass", "damping", "stiffness"]}}
    findings = inspected(nominal_of(seat), [Table(f"r{k}", run) for k, run in enumerate(runs)]).findings
    assert {finding.id for finding in findings} == ({"sign"} if sign < 0.0 else set())


@pytest.mark.parametrize(("rest", "found"), [(0.0, {"noise_unseen"}), (6.0, set())])
def test_noise_that_was_never_recorded_alone_is_said_to_be_unknown(rest: float, found: set[str]) -> None:
    """Noise that is correlated over 0.3 s, under a motion without and with a rest before it."""
    runs = []
    for seed in (61, 62):
        rng, t = np.random.default_rng(seed), np.arange(0.0, 40.0, 0.02)
        x = np.where(t >= rest, sines(rng, t, (0.11, 0.23, 0.37, 0.71), 0.1)[0], 0.0)
        noise = lag(rng.standard_normal(t.size), 0.02, 0.3, 0.0)
        runs.append({"t": t, "m": x, "y": x + 0.02 + 0.02 * noise})
    content = diagnose(runs, GEAR).as_dict()
    assert content["verdict"] == "nothing_missing" and ids(content) == found
    assert content["next"].startswith("The residual of column y") is bool(found)


def late_force(late_steps: int) -> list[dict[str, Array]]:
    """Recordings of 30 s at 50 Hz of a mass and a damper: a held force that acts some steps of 2 ms late."""
    runs = []
    for seed in (31, 32):
        rng, t = np.random.default_rng(seed), 0.02 * np.arange(1500)
        force = np.repeat(rng.uniform(-1.0, 1.0, t.size // 5), 5)
        fine = np.concatenate((np.zeros(late_steps), np.repeat(force, 10)))[: 10 * t.size]
        speed, place, keep = 0.0, 0.0, np.exp(-3.0 * 0.002 / 0.5)
        x = np.empty(fine.size)
        for k, f in enumerate(fine):
            x[k], ahead = place, keep * speed + (1.0 - keep) * f / 3.0
            place, speed = place + 0.001 * (speed + ahead), ahead
        runs.append({"t": t, "f": force, "x": x[::10] + 2e-5 * rng.standard_normal(t.size)})
    return runs


HELD = {**STAGE, "axis": {**STAGE["axis"], "hold": "zero", "reads": "position"}}


@pytest.mark.parametrize("late_steps", [5, 10])
def test_a_delay_that_a_recording_may_have_is_stated_and_not_named(late_steps: int) -> None:
    """A half or a whole sample: no effect is named for it, and the finding says what it may be."""
    content = diagnose(late_force(late_steps), HELD).as_dict()
    assert content["verdict"] == "nothing_missing" and ids(content) == {"within_sample"}
    assert content["next"].startswith("A delay of up to one sample (0.02 s)")


def test_a_delay_within_a_sample_that_no_recording_has_is_named() -> None:
    """0.7 of a sample: neither a held input nor one that is recorded late."""
    content = diagnose(late_force(7), HELD).as_dict()
    (effect,) = content["effects"]
    assert effect["id"] == "latency" and "within_sample" not in ids(content)
    assert effect["parameters"]["delay_s"]["value"] == pytest.approx(0.014, abs=0.0005)


@pytest.mark.parametrize(("damping", "found"), [(-1.7e-5, False), (1.7e-5, True)])
def test_columns_whose_exchange_needs_a_negative_damping_are_not_exchanged(damping: float, found: bool) -> None:
    """The position is a law of force, its rate and its acceleration; only passive coefficients make it a force."""
    t, runs = 0.002 * np.arange(3000), []
    for seed in (8, 9):
        rng = np.random.default_rng(seed)
        amplitude, turn, phase = rng.uniform(0.3, 1.0, 6), 2.0 * np.pi * rng.uniform(0.1, 4.0, 6), rng.uniform(0.0, 6.3, 6)
        tones = amplitude * np.exp(1j * (np.outer(t, turn) + phase))
        position = (tones * (2.7e-4 + 1j * turn * damping - 5.4e-7 * turn**2)).imag.sum(axis=1)
        runs.append({"t": t, "f": tones.imag.sum(axis=1) + 1e-3 * rng.standard_normal(t.size), "x": position})
    findings = inspected(nominal_of(SPRUNG), [Table(f"r{k}", run) for k, run in enumerate(runs)]).findings
    assert ("swapped" in {finding.id for finding in findings}) is found


@pytest.mark.parametrize(
    ("spoil", "wanted"),
    [
        (lambda run: {**run, "y": np.full_like(run["y"], np.nan)}, "missing"),
        (lambda run: {**run, "y": np.full_like(run["y"], 3.0)}, "constant"),
        (lambda run: {**run, "y": 2.0 * run["m"]}, "alias"),
    ],
)
def test_a_channel_that_says_nothing_gives_no_verdict_on_physics(spoil: Any, wanted: str) -> None:
    rng = np.random.default_rng(4)
    runs = [gear(rng) for _ in range(2)]
    for run in runs:
        run["m"] = run["m"] + 1e-4 * rng.normal(size=run["m"].size)
    content = diagnose([spoil(run) for run in runs], GEAR).as_dict()
    assert ids(content) == {wanted} and content["verdict"] == "mismatch_not_identified" and content["effects"] == []


@pytest.mark.parametrize(("gain", "wanted"), [(-1.0, {"sign"}), (180.0 / np.pi, {"unit"}), (1e-3, {"unit"}), (1.0, set())])
def test_sign_and_unit_of_a_gear(gain: float, wanted: set[str]) -> None:
    rng = np.random.default_rng(5)
    runs = [gear(rng, gain=gain, noise=1e-3 * abs(gain)) for _ in range(2)]
    content = diagnose(runs, GEAR).as_dict()
    assert ids(content) == wanted and content["verdict"] == "nothing_missing"


def test_an_output_that_comes_first_is_a_clock() -> None:
    rng = np.random.default_rng(6)
    runs = [gear(rng, lambda x, t: np.interp(t + 0.2, t, x)) for _ in range(2)]
    assert ids(diagnose(runs, GEAR).as_dict()) == {"clock"}


def delayed(x: Array, t: Array) -> Array:
    return np.interp(t - 0.09, t, x)


def lagged(x: Array, t: Array) -> Array:
    return lag(x, 0.02, 0.2, -0.02)


@pytest.mark.parametrize(
    ("change", "effect", "key", "value"),
    [(delayed, "latency", "delay_s", 0.09), (lagged, "rate_lag", "time_constant_s", 0.2)],
)
def test_effects_with_memory_begin_in_motion(change: Any, effect: str, key: str, value: float) -> None:
    rng = np.random.default_rng(7)
    (found,) = diagnose([gear(rng, change) for _ in range(3)], GEAR).effects
    assert found["id"] == effect and found["probability"] > 0.5
    assert found["parameters"][key]["value"] == pytest.approx(value, rel=0.02)


def test_a_delay_line_begins_where_the_recording_does() -> None:
    x = np.sin(np.arange(200) * 0.05)
    known = np.sin((np.arange(200) - 4.0) * 0.05)
    late = shift(x, 0.01, np.full(200, 0.04), known[0] - x[0])
    assert late[0] == pytest.approx(known[0]) and np.max(np.abs(late - known)) < 1e-3


def gain(log_likelihood: float, p_value: float = 1e-6) -> Gain:
    return Gain(log_likelihood, p_value, 0.5, independent=np.array([500.0]), log_ratio=np.array([log_likelihood / 250.0]))


def test_probabilities_add_up_and_follow_the_evidence() -> None:
    sure = posterior(gain(200.0), gain(100.0), 2, [], 0.0, RULES)
    assert sure.effect + sure.nothing + sure.none == pytest.approx(1.0) and sure.effect > RULES.confident
    weak = posterior(gain(5.0, 0.1), gain(2.0, 0.1), 2, [], 0.0, RULES)
    assert weak.effect < RULES.confident < sure.effect
    stand_in = posterior(gain(200.0), gain(100.0), 2, [], 0.6, RULES)
    assert stand_in.raw < 0.1 and stand_in.none > stand_in.effect


def looped(number: int) -> dict[str, Array]:
    """A first-order motor under a PI controller that reads the noisy speed of the same row; steps of the set-point."""
    rng, period_s, n = np.random.default_rng([88, number]), 0.01, 1500
    keep, speed, integral = float(np.exp(-period_s / 0.15)), 0.0, 0.0
    wanted = np.repeat(rng.uniform(-1.0, 1.0, n // 50), 50)
    u, y = np.zeros(n), np.zeros(n)
    for k in range(n):
        y[k] = speed + 0.02 * rng.standard_normal()
        error = wanted[k] - y[k]
        integral += 4.0 * error * period_s
        u[k] = 1.2 * error + integral
        speed = keep * speed + (1.0 - keep) * 2.0 * u[k]
    return {"t": period_s * np.arange(n), "u": u, "y": y}


def test_noise_that_a_controller_answers_in_the_same_row_is_no_coupling() -> None:
    nominal = first_order_nominal("V", "rad/s", gain=1.5, tau=0.2)
    content = diagnose([looped(k) for k in (1, 2)], nominal).as_dict()
    assert content["verdict"] == "nothing_missing" and content["effects"] == []


def test_a_triangle_wave_in_equal_steps_is_no_coarse_sensor() -> None:
    rng, k = np.random.default_rng(8), np.arange(2000)
    x = 1e-3 * np.abs((k + 300) % 600 - 300)
    coarse = 1e-3 * np.round(0.2 * np.sin(0.01 * k) / 1e-3)
    assert quantum(x) == 0.0 and quantum(coarse) == pytest.approx(1e-3)
    runs = [{"t": 0.01 * k, "m": x, "y": 1.2 * x + 5e-4 * rng.normal(size=k.size)} for _ in range(2)]
    assert ids(diagnose(runs, GEAR).as_dict()) == set()


def test_an_encoder_disk_off_its_centre_turns_unevenly() -> None:
    """The mismatch, 14 mrad, is a small part of a turn; the first amplitudes that were tried are ten times larger."""
    rng, t = np.random.default_rng(9), np.arange(0.0, 20.0, 0.02)
    runs = []
    for phase in (0.3, 1.9):
        angle = 7.0 * np.sin(0.4 * t + phase) + 2.0 * np.sin(0.9 * t)
        seen = np.unwrap(np.arctan2(np.sin(angle) - 0.007, np.cos(angle) - 0.012))
        seen += 2.0 * np.pi * np.round((angle[0] - seen[0]) / (2.0 * np.pi))
        runs.append({"t": t, "m": angle, "y": seen + 2e-3 * rng.normal(size=t.size)})
    (found,) = diagnose(runs, GEAR).effects
    assert found["id"] == "whip" and found["parameters"]["amplitude_rad"]["value"] == pytest.approx(0.0139, rel=0.05)


@pytest.mark.parametrize("shape", ["cubic", "sine"])
def test_a_curve_and_a_turn_of_which_less_than_half_is_seen_are_both_listed(shape: str) -> None:
    """Over 1.4 rad a sine once a turn bends as a polynomial does: no verdict may be sure of one of them."""
    rng, t = np.random.default_rng(3), np.arange(0.0, 20.0, 0.02)
    runs = []
    for phase in (0.3, 1.9):
        angle = 0.7 * (0.8 * np.sin(0.4 * t + phase) + 0.2 * np.sin(1.9 * t + phase))
        turned = angle - 0.1 * angle**3 if shape == "cubic" else angle + 0.1 * np.sin(angle + 0.7)
        runs.append({"t": t, "m": angle, "y": turned + 1.4e-3 * rng.normal(size=t.size)})
    (found,) = diagnose(runs, GEAR).effects
    assert {found["id"], *(other.split("@")[0] for other in found["indistinguishable_from"])} == {
        "static_nonlinearity",
        "whip",
    }
    assert found["probability_raw"] < 0.8 and found["probability"] < 0.9


def test_a_universal_joint_turns_unevenly_twice_a_turn() -> None:
    rng, t = np.random.default_rng(12), np.arange(0.0, 20.0, 0.02)
    runs = []
    for phase in (0.2, 1.4):
        angle = 7.0 * np.sin(0.4 * t + phase) + 2.0 * np.sin(0.9 * t)
        bent = np.arctan2(np.sin(angle) * np.cos(0.2), np.cos(angle))
        turned = angle + np.angle(np.exp(1j * (bent - angle)))
        runs.append({"t": t, "m": angle, "y": turned + 2e-3 * rng.normal(size=t.size)})
    (found,) = diagnose(runs, GEAR).effects
    assert found["id"] == "periodic_disturbance" and found["parameters"]["pitch_rad"]["value"] == pytest.approx(
        np.pi, rel=0.01
    )


def test_a_force_is_not_deflected_by_another_force() -> None:
    """Cross-talk of a force sensor is a coupling: a compliance is a motion under a load."""
    force, motion = (scale(unit) for unit in ("N", "m"))
    for effect in library():
        if effect.id in ("compliance", "nonlinear_stiffness") and effect.source == "load":
            assert effect.parameters(force, effect.forms[0]) == () and effect.parameters(motion, effect.forms[0])


def scale(unit: str) -> Scale:
    return Scale(unit, 1.0, 0.0, 1.0, 1.0, 1e-3, 0.1, 0.01, 10.0, True, source_unit="N m")


def test_a_delay_of_nothing_is_the_state_that_a_recording_begins_from() -> None:
    late = next(effect for effect in library() if effect.id == "latency" and effect.port == "motion")
    port = Port("oven", "motion", "oven", ("temperature",))
    term = Term(Candidate(late, port), late.parameters(scale("m"), ""))
    assert [vanished(Fit((term,), np.array([delay_s])), term, RULES) for delay_s in (1e-6, 5e-3)] == [True, False]


def test_jumps_of_dry_friction_do_not_count_as_noise() -> None:
    """Stretches at rest are missing, so the noise has to be read from the spectrum: jumps fill all of it."""
    rng, t = np.random.default_rng(10), np.arange(0.0, 20.0, 0.01)
    speed = np.cos(2.0 * np.pi * 0.4 * t) + np.cos(2.0 * np.pi * 1.1 * t + 1.0)
    force = speed + 2.2 * np.sign(speed) + 0.05 * rng.standard_normal(t.size)
    assert estimate([force], [np.zeros(t.size, dtype=bool)]).sigma == pytest.approx(0.05, rel=0.15)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lag_s", "named"),
    [pytest.param(0.004, {"saturation", "rate_lag"}, marks=pytest.mark.long), (0.005, {"saturation"})],
)
def test_what_a_delay_within_a_sample_hides_is_named_with_its_true_size(lag_s: float, named: set[str]) -> None:
    """A force of +-1 N that reaches 0.8 N only and lags by four fifths of a sample, or by a whole one."""
    runs = []
    for seed in (41, 42):
        rng, n, step = np.random.default_rng(seed), 500, 1e-4
        force = np.repeat(rng.uniform(-1.0, 1.0, n // 12 + 1), 12)[:n]
        lagged = place = speed = 0.0
        x = np.empty(n)
        for k, f in enumerate(np.repeat(np.clip(force, -0.8, 0.8), 50)):
            if k % 50 == 0:
                x[k // 50] = place
            lagged += (f - lagged) * (1.0 - np.exp(-step / lag_s))
            speed += step * (lagged - 4.0 * speed - 250.0 * place) / 0.3
            place += step * speed
        runs.append({"t": 0.005 * np.arange(n), "f": force, "x": x + 1e-5 * rng.standard_normal(n)})
    held = {**SPRUNG, "axis": {**SPRUNG["axis"], "hold": "zero", "reads": "position"}}
    content = diagnose(runs, held).as_dict()
    assert {effect["id"] for effect in content["effects"]} == named and content["effects"][0]["id"] == "saturation"
    assert ("within_sample" in ids(content)) is ("rate_lag" not in named)
    assert content["effects"][0]["parameters"]["limit_N"]["value"] == pytest.approx(0.8, abs=0.004)
