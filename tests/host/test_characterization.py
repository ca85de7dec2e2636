"""Characterization: fits on made-up sweeps, the simulated rig's truth found through the board, calibrations checked."""

import math
import tomllib
from pathlib import Path

import numpy as np
import pytest

from host.commissioning.characterization import (
    calibrated_rig_text,
    characterize,
    load_calibrated_rig,
    record_simulated,
    standard_sweeps,
    transmission_toml,
)
from host.commissioning.characterization_report import write_characterization
from host.commissioning.sine_kinematics import fit_sines
from host.commissioning.sweep_fits import Run, dead_zone_curvature, fit_knob, fit_play, play
from host.recordings.recording import RecordingFile
from protocol.errors import InputError
from protocol.rig_file import SIMULATED_RIG, Rig, load_rig, parse_rig
from realtime.core.sweep import Sweep, SweepLoop, check_sweeps
from sim.knob import KnobConfig
from sim.vessel import VesselConfig

DEGREE = math.pi / 180.0


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig(SIMULATED_RIG)


def made_up(amplitude: float, rate: float, width: float, slope: float, noise: float, seed: int) -> Run:
    random = np.random.default_rng(seed)
    t = np.arange(0.0, 3 * 2 * math.pi / rate, 0.005)
    u = amplitude * np.sin(rate * t)
    y = slope * play(u, width, 0.0) + 0.02
    frames = np.arange(5, t.size - 1, 5)
    output = y[frames] + noise * random.standard_normal(frames.size)
    output[::50] += 20 * noise
    return Run(t, u, t[frames], output, amplitude, rate)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_play_and_slope_are_found_beside_outliers(seed: int) -> None:
    runs = [made_up(a, w, 0.0031, 0.97, 2.9e-4, seed) for a in (0.0075, 0.010) for w in (0.5, 1.5)]
    found = fit_play(runs, 0.012, 2.9e-4)
    assert found.width.value == pytest.approx(0.0031, abs=1e-4)
    assert found.slope.value == pytest.approx(0.97, abs=0.01)
    assert found.offset.value == pytest.approx(0.02, abs=1e-4)
    assert found.noise == pytest.approx(2.9e-4, rel=0.15)
    assert len(found.per_run) == 4 and 0 < found.width.half95 < 2e-4


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_dead_zones_are_found_where_they_are_not_symmetric(seed: int) -> None:
    random, truth = np.random.default_rng(seed), np.array([-80, -3, 6, 86, 0, 0, 0]) * DEGREE
    truth[4:] = 31.0, 33.0, 1.0
    t = np.arange(0.0, 12.6, 0.005)
    knob = 95 * DEGREE * np.sin(t)
    frames = np.arange(0, t.size, 5)
    curvature = dead_zone_curvature(knob, truth)[frames] + 0.25 * random.standard_normal(frames.size)
    found = fit_knob([Run(t, knob, t[frames], curvature, 95 * DEGREE, 1.0)], 0.25)
    assert [e.value / DEGREE for e in found.edges_rad] == pytest.approx([-80, -3, 6, 86], abs=1.0)
    assert [g.value for g in found.gains_per_m_rad] == pytest.approx([31, 33], rel=0.02)
    assert np.all(np.diff(found.curvature_per_m) >= 0) and np.all(np.diff(found.knob_rad) > 0)


def test_a_knob_that_bends_nothing_is_refused() -> None:
    t = np.arange(0.0, 6.3, 0.025)
    with pytest.raises(ValueError, match="wanted a catheter that bends"):
        fit_knob([Run(t, np.sin(t), t, np.zeros_like(t), 1.0, 1.0)], 0.1)


def test_sums_of_sines_fit_a_curve_of_their_kind() -> None:
    x = np.linspace(0, 1.5, 200)
    assert fit_sines(x, 0.08 * np.sin(2 * x + 0.1) + 0.01 * np.sin(5 * x)).r_square > 0.999


@pytest.fixture(scope="module")
def sweeps_recorded(rig: Rig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short set of sweeps of a rig whose truth differs from its rig file."""
    sweeps = [
        sweep
        for sweep in standard_sweeps(rig, 1, (1.0, 1.5))
        if sweep.axis != 1 or (sweep.amplitude > 0.6 and sweep.rate_rad_per_s > 1.2)
    ]
    vessel = VesselConfig(play_width_m=0.0024, roll_slope=0.55)
    return record_simulated(
        rig,
        sweeps,
        tmp_path_factory.mktemp("sweeps") / "sweeps.mcap",
        4,
        "native",
        vessel=vessel,
        knob=KnobConfig(slack_rad=6 * DEGREE, stop_rad=80 * DEGREE),
    )


@pytest.mark.slow
def test_the_rigs_truth_is_found_through_the_board(rig: Rig, sweeps_recorded: Path, tmp_path: Path) -> None:
    found = characterize(RecordingFile(sweeps_recorded), rig)
    assert found.insertion.width.value == pytest.approx(0.0024, abs=1e-4)
    assert found.insertion.slope.value == pytest.approx(1.0, abs=0.01)
    assert found.insertion_at_home_m.value == pytest.approx(-0.089, abs=2e-4)
    assert found.roll.slope.value == pytest.approx(0.55, abs=0.01)
    assert [e.value / DEGREE for e in found.knob.edges_rad] == pytest.approx([-80, -6, 6, 80], abs=1.0)
    text = calibrated_rig_text(SIMULATED_RIG.read_text(), transmission_toml(found))
    again = parse_rig(tomllib.loads(text))
    assert again.transmission.insertion_backlash_m == pytest.approx(found.insertion.width.value, abs=1e-6)
    page = write_characterization(found, tmp_path / "page.html", rig.name, "sweeps.mcap").read_text()
    assert "Knob to curvature" in page and "http" not in page.split("</style>")[1].replace("http://www.w3.org", "")


@pytest.mark.slow
def test_sweeps_of_another_catheter_are_refused(rig: Rig, sweeps_recorded: Path) -> None:
    data = rig.effective()
    data["catheter"]["name"] = data["transmission"]["catheter"] = "livewire"
    with pytest.raises(ValueError, match="found sweeps of catheter blazer_prime_xp, wanted livewire"):
        characterize(RecordingFile(sweeps_recorded), parse_rig(data))


def test_a_calibration_of_another_catheter_is_refused(tmp_path: Path) -> None:
    other = tmp_path / "other.toml"
    rig_text = SIMULATED_RIG.read_text()
    section = rig_text[rig_text.index("[transmission]") : rig_text.index("[tracker]")]
    other.write_text(section)
    assert load_calibrated_rig(SIMULATED_RIG, other).transmission == load_rig(SIMULATED_RIG).transmission
    other.write_text(section.replace("blazer_prime_xp", "livewire"))
    with pytest.raises(InputError, match="calibrated with another catheter"):
        load_calibrated_rig(SIMULATED_RIG, other)
    other.write_text(section + "\n[control]\nloop_hz = 1\n")
    with pytest.raises(InputError, match=r"wanted \[transmission\] alone"):
        load_calibrated_rig(SIMULATED_RIG, other)


@pytest.mark.parametrize(
    "sweep",
    [
        Sweep(0, (0.105, 0.0, 0.0), 0.010, 1.0, 1),
        Sweep(0, (0.03, 0.0, 0.0), 0.010, 20.0, 1),
        Sweep(2, (0.03, 0.0, 0.0), 0.5, 1.0, 0),
        Sweep(1, (0.03, 0.0, 0.0), 1.0, -1.0, 1),
    ],
)
def test_sweeps_beyond_the_stages_are_refused_before_anything_moves(rig: Rig, sweep: Sweep) -> None:
    with pytest.raises(ValueError, match=r"^sweeps\.0"):
        SweepLoop(rig, [sweep], lambda topic, message: None)


def test_the_standard_sweeps_are_the_thesis_ones(rig: Rig) -> None:
    sweeps = standard_sweeps(rig)
    check_sweeps(rig, sweeps)
    assert {round(s.amplitude, 4) for s in sweeps if s.axis == 0} == {0.0075, 0.01}
    assert {round(s.amplitude / DEGREE) for s in sweeps if s.axis == 1} == {20, 40, 60}
    assert {s.rate_rad_per_s for s in sweeps} == {0.5, 1.0, 1.5} and {s.cycles for s in sweeps} == {5}
