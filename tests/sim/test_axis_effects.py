"""Each planted effect on a motion leaves the mark that its name promises, and only its own."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from sim import axis_effects, effect_codes
from sim.effects import CATALOGUE, PlantedEffect, describe, pack

DT = 1e-3
Signal = Callable[[np.ndarray], np.ndarray]


def drive(
    effect: PlantedEffect, x: np.ndarray, load: np.ndarray | None = None, source: np.ndarray | None = None
) -> np.ndarray:
    """Outputs of an effect for inputs x sampled each millisecond."""
    records, port = pack([effect]), effect_codes.PORTS.index(effect.port)
    loads = np.zeros_like(x) if load is None else load
    stage, out = np.zeros(3), np.empty_like(x)
    for n in range(len(x)):
        if source is not None:
            stage[:] = source[n]
        out[n] = axis_effects.apply(records, port, x[n], loads[n], stage, 20.0, (n + 1) * DT, DT)
    return out


def sine(amplitude: float, frequency_Hz: float, seconds: float = 4.0) -> np.ndarray:
    return amplitude * np.sin(2 * np.pi * frequency_Hz * np.arange(0.0, seconds, DT))


def area(x: np.ndarray, y: np.ndarray, period: int) -> float:
    """Loop area over the last period."""
    return abs(float(np.trapezoid(y[-period - 1 :], x[-period - 1 :])))


def response(effect: PlantedEffect, frequency_Hz: float, amplitude: float = 0.01) -> complex:
    """Gain and phase at a frequency, over the last half of eight periods."""
    seconds = 8.0 / frequency_Hz
    x = sine(amplitude, frequency_Hz, seconds)
    y = drive(effect, x)
    kept = slice(len(x) // 2, None)
    wave = np.exp(-2j * np.pi * frequency_Hz * np.arange(len(x)) * DT)[kept]
    return complex((y[kept] @ wave) / (x[kept] @ wave))


def test_backlash_parts_two_flanks_by_its_width_at_any_amplitude_and_rate() -> None:
    for amplitude, frequency in ((0.005, 0.5), (0.010, 0.5), (0.005, 2.0)):
        lost = sine(amplitude, frequency)
        lost = lost - drive(PlantedEffect("backlash", "insertion", {"width_m": 0.002}), lost)
        later = lost[int(1.0 / frequency / DT) :]
        assert np.ptp(later) == pytest.approx(0.002, rel=1e-6)


def test_dead_zone_is_flat_at_its_place_and_has_no_memory() -> None:
    x = sine(0.005, 0.5)
    y = drive(PlantedEffect("dead_zone", "insertion", {"centre_m": 0.001, "half_width_m": 0.0007}), x)
    assert np.ptp(y[np.abs(x - 0.001) < 0.0006]) < 2e-5
    assert area(x, y, 2000) < 1e-9


def test_coulomb_friction_steps_with_the_direction_by_the_same_at_any_amplitude() -> None:
    for amplitude in (0.004, 0.010):
        for frequency in (0.5, 2.0):
            x = sine(amplitude, frequency)
            lost = x - drive(
                PlantedEffect("coulomb_friction", "insertion", {"force_N": 1.0, "stiffness_N_per_m": 2000.0}), x
            )
            moving = np.abs(np.gradient(x, DT)) > 0.8 * 2 * np.pi * frequency * amplitude
            moving[:1000] = False
            assert lost[moving] * np.sign(np.gradient(x))[moving] == pytest.approx(5e-4, rel=0.02)


def test_presliding_friction_enters_along_a_curve_and_remembers_inner_loops() -> None:
    effect = PlantedEffect(
        "presliding_friction", "insertion", {"force_N": 2.0, "distance_m": 0.001, "stiffness_N_per_m": 2000.0}
    )
    x = np.concatenate([np.linspace(0, 0.004, 1000), np.linspace(0.004, -0.002, 1500)])
    lost = x - drive(effect, x)
    after = lost[1000:]
    assert after[0] == pytest.approx(0.001, rel=0.01) and after[-1] == pytest.approx(-0.001, rel=0.01)
    halfway = int(np.argmax(after < 0))
    assert 150 < halfway < 800, "friction turns round over the distance, not at once"


def test_load_dependent_friction_opens_with_the_load() -> None:
    x = sine(0.005, 0.5)
    areas = [
        area(x, drive(PlantedEffect("load_dependent_friction", "insertion"), x, np.full_like(x, load)), 2000)
        for load in (0.0, 0.2, 0.4)
    ]
    assert areas[0] < 1e-12 and areas[2] == pytest.approx(2 * areas[1], rel=0.05)


def test_stribeck_friction_sticks_and_slips_when_slow_only() -> None:
    effect = PlantedEffect("stribeck_friction", "insertion")
    slow, fast = (drive(effect, np.arange(0.0, 6.0, DT) * speed)[2000:] for speed in (0.0005, 0.02))
    assert np.mean(np.diff(slow) == 0.0) > 0.5
    assert np.mean(np.diff(fast) == 0.0) == 0.0


def test_viscous_loop_grows_with_frequency() -> None:
    areas = [
        area(sine(0.005, f), drive(PlantedEffect("viscous_friction", "insertion"), sine(0.005, f)), round(1000 / f))
        for f in (0.5, 1.0, 2.0)
    ]
    assert areas[1] == pytest.approx(2 * areas[0], rel=0.03) and areas[2] == pytest.approx(4 * areas[0], rel=0.06)


def test_lag_levels_off_where_delay_does_not() -> None:
    lag = PlantedEffect("rate_lag", "insertion", {"time_constant_s": 0.05})
    delay = PlantedEffect("latency", "insertion", {"delay_s": 0.05})
    for frequency in (1.0, 5.0, 10.0):
        expected = 1.0 / (1.0 + 2j * np.pi * frequency * 0.05)
        assert abs(response(lag, frequency) - expected) < 0.03
        assert abs(response(delay, frequency) - np.exp(-2j * np.pi * frequency * 0.05)) < 0.02


def test_a_ramp_comes_late_by_the_whole_time_constant_however_short() -> None:
    x = np.arange(0.0, 1.0, DT)
    for constant in (0.5 * DT, 2.0 * DT, 0.05):
        lag = x - drive(PlantedEffect("rate_lag", "insertion", {"time_constant_s": constant}), x)
        assert lag[-1] == pytest.approx(constant, rel=1e-6)


def test_clock_drift_delays_more_and_more() -> None:
    x = np.arange(0.0, 20.0, DT)
    lost = x - drive(PlantedEffect("clock_drift", "insertion", {"rate": 0.01}), x)
    assert lost[5000] == pytest.approx(0.05, abs=2e-3) and lost[15000] == pytest.approx(0.15, abs=2e-3)


def test_compliance_gives_way_in_proportion_and_a_hardening_spring_by_less() -> None:
    x = np.zeros(1000)
    for port, sign in (("insertion", 1), ("roll", 1), ("knob", -1), ("shape", -1)):
        soft, hard = (
            [drive(PlantedEffect(name, port), x, np.full(1000, load))[-1] for load in (0.1, 0.2)]
            for name in ("compliance", "nonlinear_stiffness")
        )
        assert soft[1] == pytest.approx(2 * soft[0]) and np.sign(soft[0]) == sign
        assert abs(hard[1]) < 2 * abs(hard[0]) or port in ("knob", "shape")


def test_creep_leaves_a_slow_tail_after_a_step() -> None:
    x = np.where(np.arange(0, 20.0, DT) > 0.5, 0.01, 0.0)
    y = drive(PlantedEffect("creep_relaxation", "insertion", {"share": 0.2, "time_constant_s": 1.0}), x)
    assert y[502] == pytest.approx(0.008, rel=0.01)
    assert 0.0002 < y[4000] - y[1500] and y[-1] == pytest.approx(0.01, rel=0.02)


def test_plastic_set_comes_with_an_overload_and_stays() -> None:
    x = np.concatenate([sine(0.003, 1.0, 1.0), sine(0.008, 0.5, 1.0), np.zeros(500)])
    y = drive(PlantedEffect("plastic_set", "insertion", {"yield_m": 0.004, "share": 0.25}), x)
    assert np.allclose(y[:1000], x[:1000])
    assert y[-1] == pytest.approx(0.25 * 0.004, rel=1e-3)


def test_softening_shrinks_the_gain_with_time() -> None:
    y = drive(PlantedEffect("softening", "knob", {"rate_per_s": 0.02}), np.full(20000, 0.5))
    assert y[0] > y[5000] > y[19999] == pytest.approx(0.5 / 1.4, rel=1e-3)


@pytest.mark.parametrize("name", ["asymmetry", "static_nonlinearity", "saturation"])
def test_static_effects_trace_one_curve(name: str) -> None:
    x = sine(0.012, 0.5)
    y = drive(PlantedEffect(name, "insertion"), x)
    assert np.abs(y - x).max() > 3e-4
    assert area(x, y, 2000) < 1e-9


def test_asymmetry_makes_even_harmonics() -> None:
    spectrum = np.abs(np.fft.rfft(drive(PlantedEffect("asymmetry", "roll", {"centre_rad": 0.0}), sine(0.5, 1.0))))
    assert spectrum[8] > 0.02 * spectrum[4] > 50 * spectrum[12] / 100


def test_coupling_follows_the_other_axis_alone() -> None:
    source = np.zeros((3000, 3))
    source[1000:, 1] = 0.4
    y = drive(PlantedEffect("coupling", "insertion", {"gain": 0.002, "source": 1.0}), np.zeros(3000), source=source)
    assert y[999] == 0.0 and y[-1] == pytest.approx(0.0008)


def test_whip_is_periodic_in_the_angle_and_jumps_when_strong() -> None:
    x = np.linspace(0.0, 4 * np.pi, 20000)
    mild, strong = (drive(PlantedEffect("whip", "roll", {"amplitude_rad": a}), x) for a in (0.3, 1.8))
    assert (mild - x)[10000:] == pytest.approx((mild - x)[:10000], abs=0.02)
    assert np.ptp(mild - x) > 0.4
    assert np.diff(strong).max() > 20 * np.diff(mild).max()


def test_disturbance_is_a_line_in_time_or_along_the_way() -> None:
    y = drive(PlantedEffect("periodic_disturbance", "insertion", {"frequency_Hz": 5.0}), np.zeros(4000))
    assert int(np.argmax(np.abs(np.fft.rfft(y))[1:])) + 1 == 20
    x = np.linspace(0.0, 0.02, 4000)
    lead = drive(PlantedEffect("periodic_disturbance", "insertion", {"frequency_Hz": 0.0, "pitch_m": 0.002}), x) - x
    assert int(np.argmax(np.abs(np.fft.rfft(lead))[1:])) + 1 == 10


def test_resonance_peaks_at_its_frequency() -> None:
    effect = PlantedEffect("resonance", "insertion", {"frequency_Hz": 6.0, "damping_ratio": 0.1})
    gains = [abs(response(effect, f)) for f in (1.0, 6.0, 18.0)]
    assert gains[0] == pytest.approx(1.03, abs=0.02) and gains[1] == pytest.approx(5.0, rel=0.2) and gains[2] < 0.2


def test_nothing_happens_before_the_start() -> None:
    x = 0.006 + sine(0.004, 1.0, 2.0)
    for port in ("insertion", "roll", "knob", "shape"):
        for name in CATALOGUE[port]:
            y = drive(PlantedEffect(name, port, start_s=1.0), x, np.full_like(x, 0.2), np.full((len(x), 3), 0.01))
            assert np.array_equal(y[:998], x[:998]), (name, port)


def test_bad_effects_are_refused_by_name() -> None:
    for bad, says in (
        (PlantedEffect("backlash", "wrist"), "port"),
        (PlantedEffect("whip", "knob"), "whip"),
        (PlantedEffect("backlash", "insertion", {"width": 1.0}), "'width'"),
        (PlantedEffect("backlash", "insertion", {"width_m": -1.0}), "width_m"),
        (PlantedEffect("backlash", "insertion", {"width_m": float("nan")}), "width_m"),
        (PlantedEffect("backlash", "insertion", start_s=-1.0), "start_s"),
    ):
        with pytest.raises(ValueError, match=says):
            pack([bad])


def test_defaults_lie_within_their_bounds_and_fit_the_record() -> None:
    for port, table in CATALOGUE.items():
        for name in table:
            parameters = describe(name, port)
            assert len(parameters) <= effect_codes.PARAMETERS
            assert all(p.least <= p.default <= p.greatest for p in parameters), (name, port)
            assert name in effect_codes.IDS
