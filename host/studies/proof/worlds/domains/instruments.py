"""Data sets of instruments: sensors, meters, circuits."""

from __future__ import annotations

import math

import numpy as np

from host.studies.proof.worlds import signals
from host.studies.proof.worlds.domains.bench import DEG, State, between, even, exact, levels, march, motion, slow, white
from host.studies.proof.worlds.domains.dataset import DataSet, Drawn, Sheet, channel, linear, link, stated

Rng = np.random.Generator


def rlc_filter(rng: Rng) -> Drawn:
    """A filter circuit read by a converter of ten bits."""
    inductance, capacitance = between(rng, 0.2, 0.6), between(rng, 2e-5, 1e-4)
    w, step, rate = 1.0 / math.sqrt(inductance * capacitance), 5.0 / 1024.0, 1000.0
    resistance = 2.0 * rng.uniform(0.2, 0.6) * w * inductance
    law = [inductance * capacitance, resistance * capacitance, 1.0]
    sheets = []
    for _ in range(2):
        t = even(rate, 10.0)
        source = 2.5 + 1.2 * motion(rng, t, 30.0, "multisine")
        volts = exact([1.0], law, source, 1.0 / rate, "zoh")
        sheet = Sheet(t)
        sheet.drive("source_V", source)
        sheet.read("capacitor_V", volts, volts, white(rng, t.size, 0.3 * step), step)
        sheets.append(sheet)
    second, first = law[0], law[1]
    nominal = linear(
        "filter",
        "source_V",
        "capacitor_V",
        {"source_V": channel("V"), "capacitor_V": channel("V")},
        [1.0],
        ["second", "first", 1.0],
        "zero",
        second=stated(rng, second, 0.1),
        first=stated(rng, first, 0.1),
    )
    return Drawn(sheets, nominal, {"second": second, "first": first})


def ultrasonic(rng: Rng) -> Drawn:
    """A distance sensor on a stage; some echoes come from a wall behind, some are lost."""
    gain, sigma, echo = rng.uniform(0.99, 1.01), rng.uniform(0.5, 1.5), rng.uniform(200.0, 400.0)
    sheets = []
    for _ in range(3):
        t = even(40.0, 30.0)
        stage = 400.0 + rng.uniform(150.0, 250.0) * motion(rng, t, 0.5)
        plain = gain * stage + 12.0
        noise = white(rng, t.size, sigma) + echo * (rng.random(t.size) < 0.02)
        sheet = Sheet(t)
        sheet.drive("stage_mm", stage)
        sheet.read("range_mm", plain, plain, noise, 0.0, signals.lost(rng, t.size, 0.01))
        sheets.append(sheet)
    nominal = link("sensor", "stage_mm", "range_mm", {name: channel("m", 1e-3) for name in ("stage_mm", "range_mm")})
    return Drawn(sheets, nominal, {"gain": gain, "offset": 0.012})


def inclinometer(rng: Rng) -> Drawn:
    """An inclinometer on a platform that never rests; its noise is correlated over a second."""
    gain, sigma, memory, rate = rng.uniform(0.98, 1.02), rng.uniform(0.03, 0.1), rng.uniform(0.6, 1.4), 100.0
    sheets = []
    for _ in range(3):
        t = even(rate, 30.0)
        angle = 10.0 * motion(rng, t, 0.6)
        plain = gain * angle - 0.4
        sheet = Sheet(t)
        sheet.drive("platform_deg", angle)
        sheet.read("tilt_deg", plain, plain, slow(rng, t.size, sigma, memory * rate) + white(rng, t.size, 0.2 * sigma))
        sheets.append(sheet)
    nominal = link("level", "platform_deg", "tilt_deg", {name: channel("rad", DEG) for name in ("platform_deg", "tilt_deg")})
    return Drawn(sheets, nominal, {"gain": gain, "offset": -0.4 * DEG})


def lidar(rng: Rng) -> Drawn:
    """A laser scanner whose errors have heavy tails (Student, three degrees of freedom)."""
    gain, sigma = rng.uniform(0.995, 1.005), rng.uniform(3.0, 8.0)
    sheets = []
    for _ in range(3):
        t = even(30.0, 30.0)
        carriage = 5000.0 + 2000.0 * motion(rng, t, 0.3)
        plain = gain * carriage + 40.0
        sheet = Sheet(t)
        sheet.drive("carriage_mm", carriage)
        sheet.read("range_mm", plain, plain, sigma * rng.standard_t(3, t.size), 1.0)
        sheets.append(sheet)
    nominal = link("laser", "carriage_mm", "range_mm", {name: channel("m", 1e-3) for name in ("carriage_mm", "range_mm")})
    return Drawn(sheets, nominal, {"gain": gain, "offset": 0.04})


def gps_track(rng: Rng) -> Drawn:
    """A car on a test track: odometer against satellite position, with pairs of outliers while it moves fast."""
    gain, sigma = rng.uniform(0.99, 1.01), rng.uniform(0.3, 0.8)
    sheets = []
    for _ in range(3):
        t = even(10.0, 60.0)
        track = 300.0 * motion(rng, t, 0.1)
        plain = gain * track + 5.0
        noise = white(rng, t.size, sigma)
        for at in np.flatnonzero(rng.random(t.size - 1) < 0.005):
            noise[at : at + 2] += rng.choice([-1.0, 1.0]) * rng.uniform(20.0, 60.0)
        sheet = Sheet(t)
        sheet.drive("odometer_m", track)
        sheet.read("satellite_m", plain, plain, noise)
        sheets.append(sheet)
    nominal = link("receiver", "odometer_m", "satellite_m", {name: channel("m") for name in ("odometer_m", "satellite_m")})
    return Drawn(sheets, nominal, {"gain": gain, "offset": 5.0})


def load_cell(rng: Rng) -> Drawn:
    """A load cell that was tared before each of three recordings."""
    gain, sigma = between(rng, 0.004, 0.02), rng.uniform(0.001, 0.004)
    sheets = []
    for _ in range(3):
        t = even(50.0, 20.0)
        load = 100.0 * (1.0 + motion(rng, t, 1.0))
        plain = gain * load + rng.uniform(-0.3, 0.3)
        sheet = Sheet(t)
        sheet.drive("load_N", load)
        sheet.read("bridge_mV", plain, plain, white(rng, t.size, sigma))
        sheets.append(sheet)
    channels = {"load_N": channel("N"), "bridge_mV": channel("V", 1e-3, session_offset=True)}
    return Drawn(sheets, link("cell", "load_N", "bridge_mV", channels), {"gain": 1e-3 * gain})


def torque_sensor(rng: Rng) -> Drawn:
    """A torque sensor that a bending moment reaches too."""
    gain, talk, sigma = rng.uniform(0.08, 0.15), rng.choice([-1.0, 1.0]) * rng.uniform(0.05, 0.15), between(rng, 0.007, 0.02)
    sheets = []
    for _ in range(3):
        t = even(100.0, 15.0)
        torque, bending = 8.0 * motion(rng, t, 1.5), 5.0 * motion(rng, t, 1.2)
        plain = gain * torque + 0.03
        sheet = Sheet(t)
        sheet.drive("torque_Nm", torque)
        sheet.drive("bending_Nm", bending)
        sheet.read("bridge_mV", plain + gain * talk * bending, plain, white(rng, t.size, sigma))
        sheets.append(sheet)
    channels = {"torque_Nm": channel("N m"), "bending_Nm": channel("N m"), "bridge_mV": channel("V", 1e-3)}
    nominal = link("sensor", "torque_Nm", "bridge_mV", channels, others=["bending_Nm"])
    return Drawn(sheets, nominal, {"gain": 1e-3 * gain, "offset": 3e-5}, ({"gain": talk},))


def creeping_cell(rng: Rng) -> Drawn:
    """A load cell whose adhesive creeps with two time constants."""
    gain, sigma = rng.uniform(0.008, 0.015), between(rng, 0.008, 0.025)
    shares, times = rng.uniform(0.015, 0.05, 2), (rng.uniform(1.0, 3.0), rng.uniform(8.0, 20.0))
    sheets = []
    for _ in range(3):
        t = even(20.0, 60.0)
        load = 100.0 * (1.0 + 0.9 * levels(rng, t, (3.0, 10.0)))
        crept = [
            gain * share * exact([1.0], [tau, 1.0], load, 0.05, "zoh") for share, tau in zip(shares, times, strict=True)
        ]
        plain = gain * load + 0.1
        sheet = Sheet(t)
        sheet.drive("load_N", load)
        sheet.read("bridge_mV", plain + crept[0] + crept[1], plain, white(rng, t.size, sigma))
        sheets.append(sheet)
    channels = {"load_N": channel("N"), "bridge_mV": channel("V", 1e-3)}
    nominal = link("cell", "load_N", "bridge_mV", channels)
    return Drawn(sheets, nominal, {"gain": 1e-3 * gain, "offset": 1e-4}, ({"slow_share": float(np.sum(shares))},))


def hall_sensor(rng: Rng) -> Drawn:
    """A Hall sensor with hum of the mains; one clock runs through all recordings of the session."""
    gain, mains, rate = rng.uniform(0.5, 1.5), rng.uniform(49.97, 50.03), rng.choice([400.0, 500.0])
    sigma, phase = between(rng, 0.002, 0.006), rng.uniform(0.0, 6.28)
    hum, begin, sheets = sigma * rng.uniform(1.2, 5.0), 0.0, []
    for _ in range(3):
        t = even(rate, 10.0)
        angle = 60.0 * motion(rng, t, 1.0)
        plain = gain * angle * DEG + 2.5
        sheet = Sheet(t, begin)
        sheet.drive("magnet_deg", angle)
        true = plain + hum * np.sin(2.0 * np.pi * mains * (t + begin) + phase)
        sheet.read("hall_V", true, plain, white(rng, t.size, sigma))
        sheets.append(sheet)
        begin += 10.0 + round(rng.uniform(5.0, 20.0), 2)
    nominal = link("sensor", "magnet_deg", "hall_V", {"magnet_deg": channel("rad", DEG), "hall_V": channel("V")})
    planted = ({"amplitude_V": hum, "frequency_Hz": mains},)
    return Drawn(sheets, nominal, {"gain": gain, "offset": 2.5}, planted)


def piezo(rng: Rng) -> Drawn:
    """A piezo stack with the hysteresis of Bouc and Wen."""
    gain, share, sigma = rng.uniform(0.1, 0.2), rng.uniform(0.05, 0.14), between(rng, 0.3, 0.9)
    beta, gamma, stroke = rng.uniform(2.4, 3.6), rng.uniform(0.6, 0.9), 100.0

    def slope(_: float, s: State, u: State) -> State:
        """Hysteresis h with h' = 3 x' - beta |x'| h - gamma x' |h|; the input is the rate of x, the relative voltage."""
        return (3.0 * u[0] - beta * abs(u[0]) * s[0] - gamma * u[0] * abs(s[0]),)

    sheets = []
    for _ in range(3):
        t = even(100.0, 20.0)
        x = 0.95 * motion(rng, t, 0.7)
        loop = march(slope, (0.0,), t, [np.append(np.diff(x), 0.0) * 100.0], 4)[:, 0]
        plain = gain * stroke * (1.0 + x)
        sheet = Sheet(t)
        sheet.drive("drive_V", stroke * (1.0 + x))
        sheet.read("stack_um", plain - gain * stroke * share * loop, plain, white(rng, t.size, sigma))
        sheets.append(sheet)
    nominal = link("stack", "drive_V", "stack_um", {"drive_V": channel("V"), "stack_um": channel("m", 1e-6)})
    return Drawn(sheets, nominal, {"gain": 1e-6 * gain, "offset": 0.0}, ({"share": share},))


def microphone(rng: Rng) -> Drawn:
    """A microphone whose membrane limits softly."""
    gain, limit, rate = rng.uniform(0.01, 0.05), rng.uniform(1.2, 2.5), 2000.0
    sheets = []
    sigma = gain * between(rng, 0.02, 0.06)
    for _ in range(2):
        t = even(rate, 10.0)
        sound = 1.6 * motion(rng, t, 80.0, "multisine")
        plain = gain * sound
        sheet = Sheet(t)
        sheet.drive("reference_Pa", sound)
        sheet.read("microphone_V", gain * limit * np.tanh(sound / limit), plain, white(rng, t.size, sigma))
        sheets.append(sheet)
    channels = {"reference_Pa": channel("Pa"), "microphone_V": channel("V")}
    nominal = link("microphone", "reference_Pa", "microphone_V", channels)
    return Drawn(sheets, nominal, {"gain": gain, "offset": 0.0}, ({"limit_Pa": limit},))


def humidity(rng: Rng) -> Drawn:
    """A humidity sensor with a wrong zero that also drifts after each start."""
    lag, sigma = rng.uniform(2.0, 5.0), between(rng, 0.8, 1.6)
    offset, drift = rng.choice([-1.0, 1.0], 2) * rng.uniform(1.5, 4.0, 2)
    sheets = []
    for _ in range(3):
        t = even(5.0, 60.0)
        chamber = 50.0 + 25.0 * levels(rng, t, (5.0, 12.0))
        plain = exact([1.0], [lag, 1.0], chamber, 0.2, "zoh")
        ramp = 2.0 * drift * t / 60.0
        sheet = Sheet(t)
        sheet.drive("chamber_percent", chamber)
        alone = (plain + ramp, plain + offset)
        sheet.read("sensor_percent", plain + ramp + offset, plain, white(rng, t.size, sigma), 0.1, alone=alone)
        sheets.append(sheet)
    channels = {name: channel("1", 0.01) for name in ("chamber_percent", "sensor_percent")}
    nominal = linear(
        "sensor", "chamber_percent", "sensor_percent", channels, [1.0], ["lag", 1.0], "zero", lag=stated(rng, lag, 0.3)
    )
    return Drawn(sheets, nominal, {"lag": lag}, ({"rate_per_s": 0.02 * drift / 60.0}, {"offset": 0.01 * offset}))


def strain_bridge(rng: Rng) -> Drawn:
    """A bridge whose reading contains the square of the deviation of its supply."""
    gain, sigma, square = rng.uniform(1.5, 2.5), between(rng, 0.004, 0.012), rng.uniform(0.6, 1.5)
    sheets = []
    for _ in range(3):
        t = even(50.0, 25.0)
        strain = 400.0 * motion(rng, t, 0.8)
        supply = 0.25 * motion(rng, t, 0.5)
        plain = gain * 1e-3 * strain + 0.1
        sheet = Sheet(t)
        sheet.drive("strain_um_m", strain)
        sheet.drive("supply_deviation_V", supply)
        sheet.read("bridge_mV", plain + 0.3 * square * supply**2, plain, white(rng, t.size, sigma))
        sheets.append(sheet)
    channels = {"strain_um_m": channel("1", 1e-6), "supply_deviation_V": channel("V"), "bridge_mV": channel("V", 1e-3)}
    nominal = link("bridge", "strain_um_m", "bridge_mV", channels, others=["supply_deviation_V"])
    return Drawn(sheets, nominal, {"gain": gain, "offset": 1e-4}, ({"square_per_V": 3e-4 * square},))


def prism(rng: Rng) -> Drawn:
    """A laser tracker whose prism is bumped, at other moments in each recording."""
    gain, sigma = rng.uniform(0.998, 1.002), between(rng, 1.5, 3.0)
    sheets, bumps = [], ((1.0,), (-0.7, 0.9), ())
    for bumped in bumps:
        t = even(25.0, 30.0)
        stage = 300.0 * motion(rng, t, 0.4)
        plain = gain * stage + 20.0
        true = plain.copy()
        for at, size in zip(np.sort(rng.uniform(5.0, 25.0, len(bumped))), bumped, strict=True):
            true += size * rng.uniform(6.0, 10.0) * (t > at)
        sheet = Sheet(t)
        sheet.drive("stage_mm", stage)
        sheet.read("prism_mm", true, plain, white(rng, t.size, sigma))
        sheets.append(sheet)
    nominal = link("prism", "stage_mm", "prism_mm", {name: channel("m", 1e-3) for name in ("stage_mm", "prism_mm")})
    return Drawn(sheets, nominal, {"gain": gain, "offset": 0.02}, ({"bumps": 3.0},))


DATA_SETS = (
    DataSet("rlc_filter", "null", rlc_filter, says="readings of 10 bits"),
    DataSet("ultrasonic", "null", ultrasonic, says="2 % echoes of a wall, lost samples"),
    DataSet("inclinometer", "null", inclinometer, says="noise correlated over 1 s, never at rest"),
    DataSet("lidar", "null", lidar, says="noise of Student t with 3 degrees of freedom"),
    DataSet("gps_track", "null", gps_track, says="pairs of outliers while it moves fast"),
    DataSet("load_cell", "null", load_cell, says="three tares"),
    DataSet("torque_sensor", "single", torque_sensor, ("coupling@sensor",), says="cross-talk of a bending moment"),
    DataSet("creeping_cell", "single", creeping_cell, ("creep_relaxation@cell",), says="creep with two time constants"),
    DataSet(
        "hall_sensor",
        "single",
        hall_sensor,
        ("periodic_disturbance@sensor",),
        says="hum of the mains",
        compared=("frequency_Hz",),
    ),
    DataSet("piezo", "single", piezo, ("presliding_friction@stack",), says="hysteresis of Bouc and Wen"),
    DataSet(
        "microphone",
        "single",
        microphone,
        ("saturation@microphone",),
        (("saturation", "static_nonlinearity"),),
        says="a soft limit",
    ),
    DataSet("humidity", "pair", humidity, ("sensor_drift@sensor", "sensor_bias@sensor"), says="a wrong zero and a drift"),
    DataSet("strain_bridge", "outside", strain_bridge, ("unlisted@bridge",), says="the square of another channel"),
    DataSet("prism", "outside", prism, ("unlisted@prism",), finding="jump", says="the prism is bumped"),
)
