"""Data sets of heat and flow: heaters, pumps, tanks, pipes."""

from __future__ import annotations

import numpy as np

from host.studies.proof.worlds.domains.bench import (
    DEG,
    RPM,
    Rate,
    Regulator,
    between,
    even,
    levels,
    march,
    motion,
    slow,
    under_control,
    white,
)
from host.studies.proof.worlds.domains.dataset import (
    Array,
    DataSet,
    Drawn,
    Sheet,
    channel,
    first_order,
    linear,
    link,
    stated,
)

Rng = np.random.Generator
BAR = 1e5  # Pa
LITRE_MIN = 1e-3 / 60.0  # m3/s


def _first_order(gain: float, lag: float, start: float, t: Array, control: Regulator, forward: Array) -> tuple[Array, Array]:
    """Return output and input (n,) of lag y' + y = gain u under `control`, which adds to `forward` (n,)."""
    states, used = under_control(
        lambda _, s, u: ((gain * u[0] - s[0]) / lag,),
        (start,),
        t,
        lambda i, s: (control.command(i, s[0], float(forward[i])),),
        2,
    )
    return states[:, 0], used[:, 0]


def soldering_iron(rng: Rng) -> Drawn:
    """An iron whose temperature is controlled; the thermocouple's noise is correlated."""
    gain, lag, ambient = rng.uniform(5.0, 7.0), rng.uniform(8.0, 15.0), rng.uniform(19.0, 26.0)
    sigma, rate, memory = rng.uniform(0.3, 0.9), 20.0, rng.uniform(0.2, 0.4)
    sheets = []
    for _ in range(3):
        t = even(rate, 60.0)
        wanted = 250.0 + 30.0 * levels(rng, t, (8.0, 15.0))
        noise = slow(rng, t.size, sigma, memory * rate)
        loop = Regulator(wanted, noise, 1.0 / rate, (0.25, 0.02), late=1)
        rise, power = _first_order(gain, lag, wanted[0] * rng.uniform(0.95, 1.0), t, loop, np.full(t.size, 250.0 / gain))
        sheet = Sheet(t)
        sheet.drive("power_W", power)
        sheet.read("tip_degC", rise + ambient, rise + ambient, noise)
        sheets.append(sheet)
    channels = {"power_W": channel("W"), "tip_degC": channel("K", offset=-float(f"{ambient:.6g}"))}
    nominal = first_order(rng, "iron", "power_W", "tip_degC", channels, gain, lag)
    return Drawn(sheets, nominal, {"gain": gain, "lag": lag})


def fan_loop(rng: Rng) -> Drawn:
    """A fan under control; the voltage is computed from the noisy tachometer reading in the same row."""
    gain, lag, rate = rng.uniform(15.0, 25.0), rng.uniform(0.3, 0.7), 100.0
    sigma = rng.uniform(0.5, 2.0)
    sheets = []
    for _ in range(3):
        t = even(rate, 20.0)
        wanted = 150.0 + 50.0 * levels(rng, t, (2.0, 5.0))
        noise = white(rng, t.size, sigma)
        loop = Regulator(wanted, noise, 1.0 / rate, (2.0 / gain, 3.0 / gain))
        speed, voltage = _first_order(gain, lag, wanted[0], t, loop, wanted / gain)
        sheet = Sheet(t)
        sheet.drive("voltage_V", voltage)
        sheet.read("fan_rpm", speed / RPM, speed / RPM, noise / RPM)
        sheets.append(sheet)
    channels = {"voltage_V": channel("V"), "fan_rpm": channel("rad/s", RPM)}
    nominal = first_order(rng, "fan", "voltage_V", "fan_rpm", channels, gain, lag)
    return Drawn(sheets, nominal, {"gain": gain, "lag": lag})


def pressure_loop(rng: Rng) -> Drawn:
    """A pressure under control; turbulence at the tap makes noise that is correlated over a fifth of a second."""
    gain, lag, rate = rng.uniform(0.06, 0.12), rng.uniform(0.8, 2.0), 50.0
    sigma, memory = rng.uniform(0.01, 0.04), rng.uniform(0.15, 0.3)
    sheets = []
    for _ in range(3):
        t = even(rate, 30.0)
        wanted = 4.0 + 1.5 * levels(rng, t, (2.0, 6.0))
        noise = slow(rng, t.size, sigma, memory * rate)
        loop = Regulator(wanted, noise, 1.0 / rate, (1.5 / gain, 1.5 / gain))
        pressure, valve = _first_order(gain, lag, wanted[0], t, loop, wanted / gain)
        sheet = Sheet(t)
        sheet.drive("valve_percent", valve)
        sheet.read("pressure_bar", pressure, pressure, noise)
        sheets.append(sheet)
    channels = {"valve_percent": channel("1", 0.01), "pressure_bar": channel("Pa", BAR)}
    nominal = first_order(rng, "line", "valve_percent", "pressure_bar", channels, 100.0 * BAR * gain, lag)
    return Drawn(sheets, nominal, {"gain": 100.0 * BAR * gain, "lag": lag})


def tank_level(rng: Rng) -> Drawn:
    """A tank with a drain; waves from one end to the other make noise that is correlated over long times."""
    gain, lag, rate = rng.uniform(8.0, 14.0), rng.uniform(6.0, 12.0), rng.choice([5.0, 10.0])
    sigma, memory = rng.uniform(4.0, 10.0), rng.uniform(5.0, 9.0)
    sheets = []
    for _ in range(3):
        t = even(rate, 60.0)
        inflow = 40.0 + 20.0 * levels(rng, t, (6.0, 15.0))
        start = (gain * float(inflow[0]) * rng.uniform(0.8, 1.2),)
        level = march(lambda _, s, u: ((gain * u[0] - s[0]) / lag,), start, t, [inflow], 2)[:, 0]
        sheet = Sheet(t)
        sheet.drive("inflow_l_min", inflow)
        sheet.read("level_mm", level, level, slow(rng, t.size, sigma, memory * rate) + white(rng, t.size, 0.5))
        sheets.append(sheet)
    scaled = gain * 1e-3 / LITRE_MIN
    channels = {"inflow_l_min": channel("m3/s", LITRE_MIN), "level_mm": channel("m", 1e-3)}
    nominal = first_order(rng, "tank", "inflow_l_min", "level_mm", channels, scaled, lag)
    return Drawn(sheets, nominal, {"gain": scaled, "lag": lag})


def heat_exchanger(rng: Rng) -> Drawn:
    """A heat exchanger whose outlet is measured some metres down the pipe; the nominal model is a Python function."""
    gain, lag, pipe = rng.uniform(0.7, 0.95), rng.uniform(3.0, 6.0), rng.uniform(1.5, 4.0)
    sigma, rate, before = between(rng, 0.6, 1.6), 2.0, 20.0
    sheets = []
    for _ in range(3):
        lead = even(rate, 60.0 + before)
        inlet = 60.0 + 12.0 * levels(rng, lead, (5.0, 14.0))
        outlet = march(lambda _, s, u: ((gain * u[0] - s[0]) / lag,), (gain * float(inlet[0]),), lead, [inlet], 4)[:, 0]
        # between samples the outlet is an exponential curve, so the delayed reading comes from a finer grid
        fine = even(20.0 * rate, 60.0 + before)
        held = inlet[np.minimum((fine * rate + 1e-9).astype(int), inlet.size - 1)]
        smooth = march(lambda _, s, u: ((gain * u[0] - s[0]) / lag,), (gain * float(inlet[0]),), fine, [held], 1)[:, 0]
        late = np.interp(lead - pipe, fine, smooth)
        keep = lead >= before
        noise = slow(rng, int(keep.sum()), 0.7 * sigma, 4.0) + white(rng, int(keep.sum()), 0.7 * sigma)
        sheet = Sheet(lead[keep] - before)
        sheet.drive("inlet_degC", inlet[keep])
        sheet.read("outlet_degC", late[keep], outlet[keep], noise)
        sheets.append(sheet)
    nominal = {
        "name": "heat exchanger",
        "kind": "callable",
        "data": {"time": "time_s"},
        "channels": {name: {"column": name, "unit": "K"} for name in ("inlet_degC", "outlet_degC")},
        "callable": {
            "function": "host.studies.proof.worlds.domains.nominal_laws:outlet",
            "inputs": ["inlet_degC"],
            "outputs": ["outlet_degC"],
            "subsystem": "exchanger",
        },
        "parameters": {
            "gain": {"value": stated(rng, gain, 0.1), "low": 0.1, "high": 2.0},
            "lag": {"value": stated(rng, lag, 0.2), "low": 0.2, "high": 60.0, "unit": "s"},
        },
    }
    return Drawn(sheets, nominal, {"gain": gain, "lag": lag}, ({"delay_s": pipe},))


def flow_meters(rng: Rng) -> Drawn:
    """Two flow meters in one pipe, of which one reads a few percent too much."""
    error, sigma = rng.choice([-1.0, 1.0]) * rng.uniform(0.02, 0.06), between(rng, 0.2, 0.8)
    sheets = []
    for _ in range(2):
        t = even(20.0, 40.0)
        flow = 25.0 + 12.0 * motion(rng, t, 0.5)
        sheet = Sheet(t)
        sheet.drive("reference_l_min", flow)
        sheet.read("meter_l_min", (1.0 + error) * flow - 0.2, flow - 0.2, white(rng, t.size, sigma))
        sheets.append(sheet)
    channels = {name: channel("m3/s", LITRE_MIN) for name in ("reference_l_min", "meter_l_min")}
    nominal = link("meter", "reference_l_min", "meter_l_min", channels, gain={"value": 1.0, "free": False})
    return Drawn(sheets, nominal, {"gain": 1.0, "offset": -0.2 * LITRE_MIN}, ({"gain_error": error},))


def hot_plate(rng: Rng) -> Drawn:
    """A plate that loses a constant power that is not metered."""
    gain, lag, ambient = rng.uniform(0.25, 0.5), rng.uniform(8.0, 15.0), rng.uniform(19.0, 26.0)
    loss, sigma = rng.uniform(6.0, 16.0), between(rng, 1.0, 3.5)

    def slope(lost: float) -> Rate:
        return lambda _, s, u: ((gain * (u[0] - lost) - s[0]) / lag,)

    sheets = []
    for _ in range(3):
        t = even(10.0, 60.0)
        power = 300.0 + 200.0 * levels(rng, t, (5.0, 12.0))
        share = rng.uniform(0.8, 1.1)
        true, plain = (
            ambient + march(slope(lost), (gain * (300.0 * share - lost),), t, [power], 2)[:, 0] for lost in (loss, 0.0)
        )
        sheet = Sheet(t)
        sheet.drive("power_W", power)
        sheet.read("plate_degC", true, plain, white(rng, t.size, sigma))
        sheets.append(sheet)
    channels = {"power_W": channel("W"), "plate_degC": channel("K", offset=-float(f"{ambient:.6g}"))}
    nominal = first_order(rng, "plate", "power_W", "plate_degC", channels, gain, lag)
    return Drawn(sheets, nominal, {"gain": gain, "lag": lag}, ({"offset_K": -gain * loss},))


def tyre_pump(rng: Rng) -> Drawn:
    """A tyre that is filled and emptied, and leaks in proportion to its pressure."""
    gain, leak, sigma = rng.uniform(0.02, 0.04), between(rng, 0.004, 0.012), between(rng, 0.05, 0.12)

    def slope(share: float) -> Rate:
        return lambda _, s, u: (gain * u[0] - share * s[0],)

    sheets = []
    for _ in range(3):
        t = even(20.0, 50.0)
        flow = 12.0 * motion(rng, t, 0.1, "multisine", begins_at_rest=True)
        flow -= float(np.mean(flow))
        start = rng.uniform(1.0, 2.5)
        true, plain = (march(slope(share), (start,), t, [flow], 1)[:, 0] for share in (leak, 0.0))
        sheet = Sheet(t)
        sheet.drive("flow_l_min", flow)
        sheet.read("pressure_bar", true, plain, white(rng, t.size, sigma))
        sheets.append(sheet)
    scaled = gain * BAR / LITRE_MIN
    channels = {"flow_l_min": channel("m3/s", LITRE_MIN), "pressure_bar": channel("Pa", BAR)}
    nominal = linear("tyre", "flow_l_min", "pressure_bar", channels, ["gain"], [1.0, 0.0], "zero", gain=stated(rng, scaled))
    return Drawn(sheets, nominal, {"gain": scaled}, ({"leak_per_s": leak},))


def wind_tunnel(rng: Rng) -> Drawn:
    """A wing whose lift is its angle times the dynamic pressure, which changes a little."""
    slope, pressure, sigma = rng.uniform(1.5, 4.0), rng.uniform(400.0, 900.0), between(rng, 0.4, 1.0)
    spread = rng.uniform(0.08, 0.2)
    sheets = []
    for _ in range(3):
        t = even(50.0, 25.0)
        angle = rng.uniform(5.0, 8.0) * motion(rng, t, 0.6)
        tunnel = pressure * (1.0 + spread * motion(rng, t, 0.3))
        plain = slope * angle + 1.0
        sheet = Sheet(t)
        sheet.drive("alpha_deg", angle)
        sheet.drive("dynamic_pressure_Pa", tunnel)
        sheet.read("lift_N", slope * angle * tunnel / pressure + 1.0, plain, white(rng, t.size, sigma))
        sheets.append(sheet)
    channels = {"alpha_deg": channel("rad", DEG), "dynamic_pressure_Pa": channel("Pa"), "lift_N": channel("N")}
    nominal = link("wing", "alpha_deg", "lift_N", channels, others=["dynamic_pressure_Pa"])
    return Drawn(sheets, nominal, {"gain": slope / DEG, "offset": 1.0}, ({"per_Pa": 1.0 / pressure},))


def gas_meter(rng: Rng) -> Drawn:
    """A gas meter whose reading wanders with the logarithm of the time since it was switched on."""
    gain, sigma, rate = rng.uniform(0.97, 1.03), between(rng, 0.1, 0.3), rng.choice([1.0, 2.0, 5.0])
    drift, begin = rng.choice([-1.0, 1.0]) * sigma * rng.uniform(0.4, 1.4), rng.uniform(0.5, 3.0)
    sheets = []
    for _ in range(3):
        t = even(rate, 60.0)
        flow = 20.0 + 8.0 * motion(rng, t, 0.1)
        plain = gain * flow - drift
        sheet = Sheet(t)
        sheet.drive("reference_l_min", flow)
        sheet.read("meter_l_min", plain + drift * np.log1p(t / begin), plain, white(rng, t.size, sigma))
        sheets.append(sheet)
    channels = {name: channel("m3/s", LITRE_MIN) for name in ("reference_l_min", "meter_l_min")}
    nominal = link("meter", "reference_l_min", "meter_l_min", channels)
    return Drawn(sheets, nominal, {"gain": gain, "offset": -drift * LITRE_MIN}, ({"per_decade": drift * np.log(10.0)},))


DATA_SETS = (
    DataSet("soldering_iron", "null", soldering_iron, closed_loop=True, says="noise correlated over 0.3 s"),
    DataSet("fan_loop", "null", fan_loop, closed_loop=True, says="controller in the same row"),
    DataSet("pressure_loop", "null", pressure_loop, closed_loop=True, says="noise correlated over 0.2 s"),
    DataSet("tank_level", "null", tank_level, says="noise correlated over 5 to 9 s of 60 s"),
    DataSet(
        "heat_exchanger",
        "single",
        heat_exchanger,
        ("latency@exchanger",),
        says="sensor down the pipe",
        compared=("delay_s",),
    ),
    DataSet(
        "flow_meters",
        "single",
        flow_meters,
        ("sensor_scale@meter",),
        says="a gain that is stated as 1 is not",
        compared=("gain_error",),
    ),
    DataSet("hot_plate", "single", hot_plate, ("sensor_bias@plate",), says="a constant loss that is not metered"),
    DataSet("tyre_pump", "outside", tyre_pump, ("unlisted@tyre",), says="a leak"),
    DataSet("wind_tunnel", "outside", wind_tunnel, ("unlisted@wing",), says="product with another channel"),
    DataSet(
        "gas_meter", "outside", gas_meter, ("unlisted@meter",), (("unlisted", "sensor_drift"),), says="logarithmic drift"
    ),
)
