"""What each recording begins with (a phase, a relaxed branch), and readings filtered, timed or noisy in odd ways."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from host.diagnosis import diagnose
from host.diagnosis.effects import candidates
from host.diagnosis.estimation.fit import minimize
from host.diagnosis.estimation.jumps import jumps_of
from host.diagnosis.estimation.noise import NoiseSource, estimate
from host.diagnosis.estimation.rules import RULES
from host.diagnosis.model.nominal import nominal_of
from host.diagnosis.model.tables import Table
from host.diagnosis.problems import prepare
from host.diagnosis.selection.found import Found
from host.diagnosis.selection.refits import fit_nominal, refined
from host.diagnosis.selection.removal import drop_unsure
from host.diagnosis.selection.screening import term_of
from tests.host.proof import everyday as make

Columns = dict[str, np.ndarray]


def hummed(columns: Columns, phase: float, frequency_Hz: float = 8.13) -> Columns:
    hum = 0.01 * np.sin(2.0 * np.pi * frequency_Hz * columns["t"] + phase)
    return {**columns, "load": columns["load"] + hum}


def named(verdict: Any) -> list[str]:
    return sorted(effect["id"] for effect in verdict.as_dict()["effects"])


@pytest.mark.parametrize(
    ("change", "names"),
    [
        (lambda c: c, []),
        (lambda c: make.with_play(c, 0.15), ["backlash"]),
        (lambda c: make.with_delay(c, 0.1), ["latency"]),
        (lambda c: make.with_lag(c, 0.1), ["rate_lag"]),
    ],
    ids=["alone", "play", "delay", "lag"],
)
def test_a_hum_of_another_phase_in_each_recording_is_named(change: Any, names: list[str]) -> None:
    recordings = [hummed(change(make.gear(k)), 1.7 * k) for k in (201, 202)]
    verdict = diagnose(recordings, make.gear_nominal())
    assert named(verdict) == sorted([*names, "periodic_disturbance"])
    hum = next(e for e in verdict.as_dict()["effects"] if e["id"] == "periodic_disturbance")
    assert hum["parameters"]["frequency_Hz"]["value"] == pytest.approx(8.13, abs=2e-3)


def test_a_rhythm_that_differs_from_recording_to_recording_is_no_hum() -> None:
    recordings = [hummed(make.gear(k), 1.7 * k, 1.1 + 0.15 * (k - 214)) for k in (214, 215)]
    assert "periodic_disturbance" not in named(diagnose(recordings, make.gear_nominal()))


def foam(number: int) -> Columns:
    """A spring with a branch that relaxes in 1.5 s and begins relaxed, noise 10 mN."""
    rng, t = make.stream(number), np.arange(0.0, 20.0, 0.01)
    x = 0.01 * make.tones(rng, t, 2.0)
    keep = np.exp(-0.01 / 1.5)
    branch = lfilter([120.0 * (1.0 - keep) * 1.5 / 0.01], [1.0, -keep], np.diff(x, prepend=x[0]))
    return {"t": t, "x": x, "f": 200.0 * x + branch + 0.3 + 0.01 * rng.standard_normal(t.size)}


def test_a_branch_that_began_relaxed_needs_no_friction() -> None:
    """The start of the memory and the stiffness of the branch were fitted in turn, and friction took what that left."""
    verdict = diagnose([foam(64), foam(65)], make.spring_nominal())
    assert named(verdict) == ["creep_relaxation"]
    values = verdict.as_dict()["effects"][0]["parameters"]
    assert values["stiffness_N_per_m"]["value"] == pytest.approx(120.0, rel=0.01)
    assert values["time_constant_s"]["value"] == pytest.approx(1.5, rel=0.01)


def test_a_digital_low_pass_is_a_lag_and_nothing_else() -> None:
    """It is half a sample ahead of the analogue one: with motions of 4 Hz that is five times the noise."""

    def filtered(number: int) -> Columns:
        columns = make.gear(number, fastest_Hz=4.0)
        return make.with_lag(columns, 0.04)

    verdict = diagnose([filtered(52), filtered(53)], make.gear_nominal())
    assert named(verdict) == ["rate_lag"]
    assert verdict.as_dict()["effects"][0]["parameters"]["time_constant_s"]["value"] == pytest.approx(0.04, rel=0.01)


def test_a_clock_that_runs_faster_and_agrees_in_the_middle() -> None:
    def two_clocks(number: int) -> Columns:
        rng, fine = make.stream(number), np.arange(-1.0, 40.0, 1e-3)
        motor, t = 1.5 * make.tones(rng, fine, 1.5), np.arange(0.0, 30.0, 0.01)
        load = 0.4 * np.interp(t + 3e-3 * (t - 12.0), fine, motor) + 1e-3 * rng.standard_normal(t.size)
        return {"t": t, "motor": np.interp(t, fine, motor), "load": load}

    verdict = diagnose([two_clocks(58), two_clocks(59)], make.gear_nominal())
    assert named(verdict) == ["clock_drift"]
    assert verdict.as_dict()["effects"][0]["parameters"]["rate_s_per_s"]["value"] == pytest.approx(-3e-3, rel=0.01)


def test_noise_that_grows_with_the_motion_does_not_jump() -> None:
    recordings = []
    for number in (18, 19):
        columns = make.gear(number)
        noise = make.stream(900 + number).standard_normal(columns["t"].size)
        recordings.append({**columns, "load": 0.4 * columns["motor"] * (1.0 + 0.01 * noise)})
    assert diagnose(recordings, make.gear_nominal()).as_dict()["verdict"] == "nothing_missing"


def test_a_slow_plant_is_on_its_way_while_its_input_rests() -> None:
    """The noise of such stretches is that of the spectrum; a wander of the output itself is noise."""
    rng, n = np.random.default_rng(7), 600
    held = np.repeat(rng.uniform(0.0, 1.0, n // 40), 40)
    slow = lfilter([0.02], [1.0, -0.98], held)
    still = [np.tile(np.arange(40) >= 5, n // 40)]
    sure = estimate([slow + 2e-4 * rng.standard_normal(n)], still, simulated=True)
    assert sure.source is NoiseSource.SPECTRUM and sure.sigma == pytest.approx(2e-4, rel=0.3)
    wander = 2e-4 * lfilter([1.0], [1.0, -0.6], rng.standard_normal(n))
    assert estimate([wander], still, simulated=True).source is NoiseSource.QUIESCENT


def test_an_amplitude_whose_interval_contains_zero_is_dropped() -> None:
    recordings = [make.gear(k) for k in (31, 32)]
    model, problem, _ = prepare(nominal_of(make.gear_nominal()), [Table(f"r{k}", r) for k, r in enumerate(recordings)])
    drift = next(c for c in candidates(model.ports, True) if c.key == "sensor_drift@gear_reading")
    found = Found(fit_nominal(problem), fit_nominal(problem), [])
    term = term_of(problem, drift, found.nominal)
    found.best = refined(problem, minimize(problem, (term,), np.append(found.nominal.values, 1e-4)))
    drop_unsure(problem, found)
    assert found.best.terms == () and found.steps[-1].key == drift.key


def test_a_jump_above_the_noise_around_it_is_found() -> None:
    rng = np.random.default_rng(4)
    size = 0.1 + np.abs(np.sin(np.arange(3000) / 200.0))
    residual = size * rng.standard_normal(3000)
    assert not jumps_of([residual], RULES)
    residual[1900:] += 6.0
    (jump,) = jumps_of([residual], RULES)
    assert abs(jump.sample - 1900) <= 2 and jump.size == pytest.approx(6.0, abs=1.0)


@pytest.mark.parametrize("top_Hz", [10.0, 150.0, 300.0])
def test_the_first_speed_of_a_fast_axis_is_read_from_its_recording(top_Hz: float) -> None:
    rng, t = np.random.default_rng(7), np.arange(4000) / 2000.0
    w = 2.0 * np.pi * np.geomspace(3.0, top_Hz, 7) * rng.uniform(0.93, 1.07, 7)
    response = 1.0 / (2e4 - 0.05 * w**2 + 12j * w)
    modes = np.exp(1j * (np.outer(t, w) + rng.uniform(0.0, 6.28, 7)))
    x, v = ((modes @ (factor * response)).real for factor in (1.0, 1j * w))
    columns = {"t": t, "f": modes.sum(axis=1).real, "x": x + 2e-7 * rng.standard_normal(t.size)}
    _, problem, _ = prepare(nominal_of(make.axis_nominal()), [Table("r", columns)])
    begin = problem.segments[0].begin
    assert begin is not None and abs(begin.measured[1] - v[0]) < 0.1 * np.std(v)
    assert abs(begin.measured[1] - v[0]) < 2.0 * begin.spread[1]
