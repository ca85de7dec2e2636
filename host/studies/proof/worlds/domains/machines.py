"""Data sets of machines: drives, gears, vehicles."""

from __future__ import annotations

import math

import numpy as np

from host.studies.proof.worlds import signals
from host.studies.proof.worlds.domains.bench import (
    DEG,
    RPM,
    Array,
    Control,
    Rate,
    Regulator,
    State,
    between,
    even,
    exact,
    gap,
    levels,
    march,
    motion,
    slow,
    under_control,
    vibration,
    white,
)
from host.studies.proof.worlds.domains.dataset import (
    DataSet,
    Drawn,
    Sheet,
    axis,
    channel,
    linear,
    link,
    sprung_slide,
    stated,
)

Rng = np.random.Generator
KM_H = 1.0 / 3.6  # m/s


def dynamometer(rng: Rng) -> Drawn:
    """A rotor under torque steps, read in rpm with irregular stamps and lost samples."""
    inertia, damping, rate = between(rng, 0.02, 0.08), between(rng, 0.02, 0.08), between(rng, 80, 200)
    drag, sigma, size = rng.uniform(0.1, 0.4), between(rng, 1.5, 6.0), between(rng, 3.0, 8.0)
    sheets = []
    for _ in range(3):
        t = signals.stamps(rng, rate, 20.0, 0.25)
        torque = size * (0.3 + levels(rng, t, (0.5, 2.5)))
        speed = march(lambda _, s, u: ((u[0] - drag - damping * s[0]) / inertia,), (0.0,), t, [torque], 2)[:, 0] / RPM
        sheet = Sheet(t)
        sheet.drive("torque_Nm", torque)
        sheet.read("speed_rpm", speed, speed, white(rng, t.size, sigma), 0.0, signals.lost(rng, t.size, 0.01))
        sheets.append(sheet)
    channels = {"torque_Nm": channel("N m"), "speed_rpm": channel("rad/s", RPM)}
    nominal = axis(
        "rotor",
        "torque_Nm",
        "speed_rpm",
        channels,
        ("mass", "damping", "offset"),
        "velocity",
        "zero",
        mass=stated(rng, inertia),
        damping=stated(rng, damping),
    )
    return Drawn(sheets, nominal, {"mass": inertia, "damping": damping, "offset": -drag})


def cyclist(rng: Rng) -> Drawn:
    """A rider on a level road: force of a crank meter, speed of a wheel counter in steps, irregular stamps."""
    mass, damping, sigma = rng.uniform(70.0, 95.0), rng.uniform(5.0, 12.0), rng.uniform(0.02, 0.05)
    sheets = []
    for _ in range(3):
        t = signals.stamps(rng, rng.uniform(8.0, 12.0), 60.0, 0.3)
        force = 45.0 * (1.0 + 0.9 * motion(rng, t, 0.15))
        start = (float(force[0]) / damping * rng.uniform(0.8, 1.2),)
        speed = march(lambda _, s, u: ((u[0] - damping * s[0]) / mass,), start, t, [force], 2, False)[:, 0] / KM_H
        sheet = Sheet(t)
        sheet.drive("pedal_N", force)
        sheet.read("speed_km_h", speed, speed, white(rng, t.size, sigma / KM_H), 0.1 / KM_H)
        sheets.append(sheet)
    channels = {"pedal_N": channel("N"), "speed_km_h": channel("m/s", KM_H)}
    nominal = axis(
        "bicycle", "pedal_N", "speed_km_h", channels, ("mass", "damping"), "velocity", "linear", mass=stated(rng, mass)
    )
    return Drawn(sheets, nominal, {"mass": mass, "damping": damping})


def quarter_car(rng: Rng) -> Drawn:
    """A wheel on a road simulator; the running engine shakes the body."""
    mass, damping, stiffness = rng.uniform(250.0, 400.0), rng.uniform(900.0, 2000.0), rng.uniform(14e3, 26e3)
    rate, share = rng.choice([100.0, 200.0]), rng.uniform(0.02, 0.05)
    frequency, quality = rng.uniform(10.0, 14.0), rng.uniform(4.0, 8.0)
    sheets = []
    for _ in range(3):
        t = even(rate, 20.0)
        road = rng.uniform(15.0, 25.0) * motion(rng, t, 4.0, begins_at_rest=True)
        body = exact([damping, stiffness], [mass, damping, stiffness], road, 1.0 / rate, "foh")
        noise = vibration(rng, t.size, rate, share * float(np.std(body)), frequency, quality)
        sheet = Sheet(t)
        sheet.drive("road_mm", road)
        sheet.read("body_mm", body, body, noise + white(rng, t.size, 0.05))
        sheets.append(sheet)
    nominal = linear(
        "suspension",
        "road_mm",
        "body_mm",
        {"road_mm": channel("m", 1e-3), "body_mm": channel("m", 1e-3)},
        ["damping", "stiffness"],
        ["mass", "damping", "stiffness"],
        "linear",
        mass={"value": mass, "free": False},
        damping=stated(rng, damping),
        stiffness=stated(rng, stiffness),
    )
    return Drawn(sheets, nominal, {"mass": mass, "damping": damping, "stiffness": stiffness})


def hydraulic_cylinder(rng: Rng) -> Drawn:
    """A valve moves a cylinder whose position sensor loses samples."""
    gain, lag, sigma = rng.uniform(1.0, 3.0), rng.uniform(0.03, 0.1), rng.uniform(0.2, 0.6)
    sheets = []
    for _ in range(3):
        t = even(100.0, 25.0)
        valve = 60.0 * motion(rng, t, 2.0, "multisine", begins_at_rest=True)
        valve -= float(np.mean(valve))
        place = march(lambda _, s, u: (s[1], (gain * u[0] - s[1]) / lag), (0.0, 0.0), t, [valve], 2)[:, 0]
        sheet = Sheet(t)
        sheet.drive("valve_percent", valve)
        sheet.read("position_mm", place, place, white(rng, t.size, sigma), 0.0, signals.lost(rng, t.size, 0.02))
        sheets.append(sheet)
    nominal = linear(
        "cylinder",
        "valve_percent",
        "position_mm",
        {"valve_percent": channel("1", 0.01), "position_mm": channel("m", 1e-3)},
        ["gain"],
        ["lag", 1.0, 0.0],
        "zero",
        gain=stated(rng, 0.1 * gain),
        lag=stated(rng, lag, 0.3),
    )
    return Drawn(sheets, nominal, {"gain": 0.1 * gain, "lag": lag})


def steering(rng: Rng) -> Drawn:
    """A steering wheel whose angle is stored in degrees; the user states radians."""
    gain, sigma = 1.0 / rng.uniform(12.0, 20.0), rng.uniform(3e-4, 1e-3)
    sheets = []
    for _ in range(3):
        t = even(50.0, 30.0)
        wheel = rng.uniform(1.0, 2.5) * motion(rng, t, 0.8)
        rack = gain * wheel + 0.01
        sheet = Sheet(t)
        sheet.drive("wheel", wheel / DEG)
        sheet.read("road_wheel_rad", rack, rack, white(rng, t.size, sigma))
        sheets.append(sheet)
    channels = {"wheel": channel("rad"), "road_wheel_rad": channel("rad")}
    nominal = link("steering", "wheel", "road_wheel_rad", channels, gain=stated(rng, gain, 0.05))
    return Drawn(sheets, nominal, {"gain": gain * DEG, "offset": 0.01})


def seat_shaker(rng: Rng) -> Drawn:
    """A sprung seat under a shaker; the accelerometer is mounted upside down."""
    mass, stiffness = rng.uniform(40.0, 80.0), rng.uniform(8e3, 20e3)
    damping = 2.0 * rng.uniform(0.15, 0.35) * math.sqrt(mass * stiffness)
    sheets = []
    for _ in range(2):
        t = even(200.0, 20.0)
        force = rng.uniform(150.0, 250.0) * motion(rng, t, 6.0, "multisine", begins_at_rest=True, slowest_hz=0.8)
        up = exact([1.0, 0.0, 0.0], [mass, damping, stiffness], force, 1.0 / 200.0, "foh")
        sheet = Sheet(t)
        sheet.drive("force_N", force)
        sheet.read("acceleration_m_s2", -up, -up, white(rng, t.size, rng.uniform(0.02, 0.06)))
        sheets.append(sheet)
    channels = {"force_N": channel("N"), "acceleration_m_s2": channel("m/s2")}
    nominal = axis(
        "seat",
        "force_N",
        "acceleration_m_s2",
        channels,
        ("mass", "damping", "stiffness"),
        "acceleration",
        "linear",
        mass=stated(rng, mass, 0.1),
        damping=stated(rng, damping),
        stiffness=stated(rng, stiffness, 0.1),
    )
    return Drawn(sheets, nominal, {"mass": -mass, "damping": -damping, "stiffness": -stiffness})


def pan_tilt(rng: Rng) -> Drawn:
    """A pan-tilt head of a camera; the columns of both encoders are exchanged."""
    gains, sigma = rng.uniform(0.97, 1.03, 2), rng.uniform(0.05, 0.15)
    sheets = []
    for _ in range(3):
        t = even(60.0, 25.0)
        pan, tilt = 60.0 * motion(rng, t, 0.7), 25.0 * motion(rng, t, 0.9)
        sheet = Sheet(t)
        sheet.drive("pan_command_deg", pan)
        sheet.drive("tilt_command_deg", tilt)
        sheet.read("tilt_deg", gains[0] * pan, gains[0] * pan, white(rng, t.size, sigma))
        sheet.read("pan_deg", gains[1] * tilt, gains[1] * tilt, white(rng, t.size, sigma))
        sheets.append(sheet)
    names = ("pan_command_deg", "pan_deg", "tilt_command_deg", "tilt_deg")
    nominal = link("pan", names[0], names[1], {name: channel("rad", DEG) for name in names})
    nominal["name"] = "pan-tilt head"
    nominal["link"].append({"subsystem": "tilt", "input": names[2], "output": names[3]})
    return Drawn(sheets, nominal)


def _speed_loop(loop: Regulator, forward: float) -> Control:
    """Return a speed loop that adds `forward` times the set-point."""
    return lambda row, s: (loop.command(row, s[0], forward * loop.wanted[row]),)


def geared_motor(rng: Rng) -> Drawn:
    """A motor with gear and tachometer in a speed loop at the sample rate; the gear rubs."""
    constant, inertia, damping = rng.uniform(0.05, 0.15), between(rng, 4e-4, 1.5e-3), between(rng, 2e-3, 5e-3)
    sigma, rate = between(rng, 0.8, 2.0), 200.0
    torque = rng.uniform(1.2, 3.0) * sigma * damping

    def slope(friction: float) -> Rate:
        return lambda _, s, u: ((constant * u[0] - damping * s[0] - friction * math.tanh(s[0] / 0.3)) / inertia,)

    sheets = []
    for _ in range(3):
        t = even(rate, 15.0)
        wanted = 40.0 * motion(rng, t, 1.0, begins_at_rest=True)
        noise = white(rng, t.size, sigma)
        loop = Regulator(wanted, noise, 1.0 / rate, (6.0 * inertia / constant, 2.0 * inertia / constant), late=1)
        states, used = under_control(slope(torque), (0.0,), t, _speed_loop(loop, damping / constant), 4)
        plain = march(slope(0.0), (0.0,), t, [used[:, 0]], 4)
        sheet = Sheet(t)
        sheet.drive("current_A", used[:, 0])
        sheet.read("speed_rpm", states[:, 0] / RPM, plain[:, 0] / RPM, noise / RPM)
        sheets.append(sheet)
    channels = {"current_A": channel("N m", constant), "speed_rpm": channel("rad/s", RPM)}
    nominal = axis(
        "motor", "current_A", "speed_rpm", channels, ("mass", "damping"), "velocity", "zero", mass=stated(rng, inertia)
    )
    return Drawn(sheets, nominal, {"mass": inertia, "damping": damping}, ({"force_Nm": torque},))


def belt_stage(rng: Rng) -> Drawn:
    """A stage behind a belt that stretches under the force of a tool."""
    gain, stiffness, sigma = rng.uniform(0.98, 1.02), between(rng, 8e5, 2.5e6), between(rng, 0.01, 0.03)
    sheets = []
    for _ in range(3):
        t = even(100.0, 20.0)
        motor, tool = rng.uniform(60.0, 120.0) * motion(rng, t, 1.0), 90.0 * motion(rng, t, 1.5)
        plain = gain * motor + 2.0
        sheet = Sheet(t)
        sheet.drive("motor_mm", motor)
        sheet.drive("tool_N", tool)
        sheet.read("stage_mm", plain - 1e3 * tool / stiffness, plain, white(rng, t.size, sigma))
        sheets.append(sheet)
    channels = {"motor_mm": channel("m", 1e-3), "tool_N": channel("N"), "stage_mm": channel("m", 1e-3)}
    nominal = link("belt", "motor_mm", "stage_mm", channels, load=["tool_N"], gain=1.0)
    return Drawn(sheets, nominal, {"gain": gain, "offset": 2e-3}, ({"compliance": 1.0 / stiffness},))


def grating(rng: Rng) -> Drawn:
    """A grating on a spindle whose encoder disc is eccentric."""
    gain, eccentric, phase = rng.uniform(0.995, 1.005), between(rng, 0.1, 0.5), rng.uniform(0.0, 6.28)
    sigma = between(rng, 0.06, 0.2)
    sheets = []
    for _ in range(2):
        t = even(100.0, 20.0)
        spindle = 400.0 * motion(rng, t, 0.4)
        plain = gain * spindle - 7.0
        sheet = Sheet(t)
        sheet.drive("spindle_deg", spindle)
        sheet.read("encoder_deg", plain + eccentric * np.sin(spindle * DEG + phase), plain, white(rng, t.size, sigma))
        sheets.append(sheet)
    channels = {"spindle_deg": channel("rad", DEG), "encoder_deg": channel("rad", DEG)}
    nominal = link("spindle", "spindle_deg", "encoder_deg", channels)
    return Drawn(sheets, nominal, {"gain": gain, "offset": -7.0 * DEG}, ({"amplitude_rad": eccentric * DEG},))


def syringe_pump(rng: Rng) -> Drawn:
    """A plunger drives liquid through a soft tube, which stores some of it."""
    area, lag, sigma = rng.uniform(2.0, 4.0), rng.uniform(0.15, 0.6), between(rng, 0.15, 0.5)
    sheets = []
    for _ in range(3):
        t = even(25.0, 40.0)
        plunger = 2.0 + 1.5 * motion(rng, t, 0.25)
        plain = area * plunger
        flow = march(lambda _, s, u: ((area * u[0] - s[0]) / lag,), (float(plain[0]),), t, [plunger], 2, False)[:, 0]
        sheet = Sheet(t)
        sheet.drive("plunger_mm_s", plunger)
        sheet.read("flow_ml_min", flow, plain, white(rng, t.size, sigma))
        sheets.append(sheet)
    channels = {"plunger_mm_s": channel("m/s", 1e-3), "flow_ml_min": channel("m3/s", 1e-6 / 60.0)}
    nominal = link("tube", "plunger_mm_s", "flow_ml_min", channels)
    return Drawn(sheets, nominal, {"gain": area * 1e-3 / 60.0, "offset": 0.0}, ({"time_constant_s": lag},))


def voice_coil(rng: Rng) -> Drawn:
    """A sprung coil; its amplifier limits the current below what is commanded."""
    force, mass = rng.uniform(4.0, 9.0), rng.uniform(0.05, 0.12)
    w, rate = 2.0 * math.pi * rng.uniform(12.0, 25.0), rng.choice([1000.0, 2000.0])
    damping, stiffness, limit = 2.0 * rng.uniform(0.1, 0.4) * w * mass, w * w * mass, rng.uniform(0.75, 0.95)
    sigma = force / stiffness * 1e3 * between(rng, 0.02, 0.06)
    sheets = []
    for _ in range(2):
        t = even(rate, 10.0)
        current = motion(rng, t, 20.0, "multisine")
        current /= float(np.std(current)) * 2.0
        plain, true = (
            1e3 * exact([force], [mass, damping, stiffness], u, 1.0 / rate, "zoh")
            for u in (current, np.clip(current, -limit, limit))
        )
        sheet = Sheet(t)
        sheet.drive("current_A", current)
        sheet.read("position_mm", true, plain, white(rng, t.size, sigma))
        sheets.append(sheet)
    nominal = linear(
        "coil",
        "current_A",
        "position_mm",
        {"current_A": channel("A"), "position_mm": channel("m", 1e-3)},
        ["force"],
        ["mass", "damping", "stiffness"],
        "zero",
        force=stated(rng, force),
        damping=stated(rng, damping),
        mass={"value": mass, "free": False},
        stiffness=stated(rng, stiffness),
    )
    values = {"force": force, "mass": mass, "damping": damping, "stiffness": stiffness}
    return Drawn(sheets, nominal, values, ({"limit_A": limit},))


def camera_slider(rng: Rng) -> Drawn:
    """A carriage on a dry rail, held by a spring and tracked by a camera: LuGre friction with a Stribeck dip."""
    mass, damping, stiffness = rng.uniform(1.5, 3.0), rng.uniform(3.0, 7.0), rng.uniform(40.0, 80.0)
    sigma = between(rng, 1e-3, 2.5e-3)
    kinetic = rng.uniform(1.2, 2.5) * sigma * stiffness
    static, sweep, bristle = kinetic * rng.uniform(1.6, 2.4), rng.uniform(0.02, 0.05), 600.0 * kinetic

    def slope(_: float, s: State, u: State) -> State:
        steady = kinetic + (static - kinetic) * math.exp(-((s[1] / sweep) ** 2))
        z = s[1] - abs(s[1]) * bristle * s[2] / steady
        rub = bristle * s[2] + 0.3 * math.sqrt(bristle) * z
        return (s[1], (u[0] - damping * s[1] - stiffness * s[0] - rub) / mass, z)

    def smooth(_: float, s: State, u: State) -> State:
        return (s[1], (u[0] - damping * s[1] - stiffness * s[0]) / mass)

    sheets = []
    for _ in range(3):
        t = even(100.0, 20.0)
        force = rng.uniform(3.0, 5.0) * motion(rng, t, 1.2, begins_at_rest=True)
        true, plain = march(slope, (0.0, 0.0, 0.0), t, [force], 8)[:, 0], march(smooth, (0.0, 0.0), t, [force], 4)[:, 0]
        sheet = Sheet(t)
        sheet.drive("pull_N", force)
        sheet.read("carriage_mm", 1e3 * true, 1e3 * plain, white(rng, t.size, 1e3 * sigma))
        sheets.append(sheet)
    channels = {"pull_N": channel("N"), "carriage_mm": channel("m", 1e-3)}
    nominal = sprung_slide(rng, "slider", "pull_N", "carriage_mm", channels, mass, stiffness)
    values = {"mass": mass, "damping": damping, "stiffness": stiffness}
    return Drawn(sheets, nominal, values, ({"kinetic_N": kinetic, "static_N": static, "speed_m_s": sweep},))


def model_boat(rng: Rng) -> Drawn:
    """A boat whose drag grows with the square of its speed as well."""
    mass, damping, square = rng.uniform(2.0, 5.0), rng.uniform(0.6, 1.5), rng.uniform(0.4, 1.2)
    sigma = between(rng, 0.04, 0.12)

    def slope(drag: float) -> Rate:
        return lambda _, s, u: ((u[0] - damping * s[0] - drag * s[0] * abs(s[0])) / mass,)

    sheets = []
    for _ in range(3):
        t = even(20.0, 50.0)
        thrust = rng.uniform(1.5, 3.0) * motion(rng, t, 0.2, begins_at_rest=True)
        true, plain = (march(slope(drag), (0.0,), t, [thrust], 2)[:, 0] for drag in (square, 0.0))
        sheet = Sheet(t)
        sheet.drive("thrust_N", thrust)
        sheet.read("speed_m_s", true, plain, white(rng, t.size, sigma))
        sheets.append(sheet)
    channels = {"thrust_N": channel("N"), "speed_m_s": channel("m/s")}
    nominal = axis(
        "hull", "thrust_N", "speed_m_s", channels, ("mass", "damping"), "velocity", "zero", mass=stated(rng, mass)
    )
    return Drawn(sheets, nominal, {"mass": mass, "damping": damping}, ({"square_N_s2_m2": square},))


def ship_wheel(rng: Rng) -> Drawn:
    """A ship's wheel with a gap in its gear."""
    gain, width, sigma = rng.uniform(0.2, 0.35), rng.uniform(2.0, 5.0), between(rng, 0.15, 0.5)
    sheets = []
    for _ in range(3):
        t = even(50.0, 30.0)
        wheel = rng.uniform(50.0, 90.0) * motion(rng, t, 0.5)
        sheet = Sheet(t)
        sheet.drive("wheel_deg", wheel)
        sheet.read("rudder_deg", gain * gap(wheel, width) + 1.0, gain * wheel + 1.0, white(rng, t.size, sigma))
        sheets.append(sheet)
    channels = {"wheel_deg": channel("rad", DEG), "rudder_deg": channel("rad", DEG)}
    nominal = link("rudder", "wheel_deg", "rudder_deg", channels, gain=stated(rng, gain))
    return Drawn(sheets, nominal, {"gain": gain, "offset": DEG}, ({"width_rad": width * DEG},))


def telescope(rng: Rng) -> Drawn:
    """A telescope behind a shaft that twists: three tones at the motor."""
    frequency, ratio, sigma = rng.uniform(4.0, 8.0), rng.uniform(0.02, 0.08), between(rng, 0.01, 0.03)
    w = 2.0 * math.pi * frequency
    sheets = []
    for _ in range(2):
        t = even(100.0, 20.0)
        tones = np.array([0.2, 0.9, 2.6]) * rng.uniform(0.9, 1.1, 3)
        motor = np.sin(2.0 * np.pi * np.outer(t, tones) + rng.uniform(0.0, 6.28, 3)) @ np.array([2.0, 0.5, 0.15])
        true = exact([2.0 * ratio * w, w * w], [1.0, 2.0 * ratio * w, w * w], motor, 0.01, "foh")
        sheet = Sheet(t)
        sheet.drive("motor_deg", motor)
        sheet.read("tube_deg", true, motor, white(rng, t.size, sigma))
        sheets.append(sheet)
    channels = {"motor_deg": channel("rad", DEG), "tube_deg": channel("rad", DEG)}
    nominal = link("mount", "motor_deg", "tube_deg", channels)
    return Drawn(sheets, nominal, {"gain": 1.0, "offset": 0.0}, ({"frequency_Hz": frequency, "damping_ratio": ratio},))


def turntable(rng: Rng) -> Drawn:
    """A table on a stepper that loses steps where a brake of the line grips, at one moment of every cycle."""
    gain, sigma = 1.0 / rng.integers(3, 9), between(rng, 0.02, 0.06)
    at, jump = rng.uniform(8.0, 20.0), rng.choice([-1.0, 1.0]) * sigma * rng.uniform(1.5, 5.0)
    sheets = []
    for _ in range(3):
        t = even(40.0, 30.0)
        stepper = 360.0 * motion(rng, t, 0.5)
        plain = gain * stepper + 3.0
        sheet = Sheet(t)
        sheet.drive("stepper_deg", stepper)
        sheet.read("table_deg", plain + jump * (t > at), plain, white(rng, t.size, sigma))
        sheets.append(sheet)
    channels = {"stepper_deg": channel("rad", DEG), "table_deg": channel("rad", DEG)}
    nominal = link("table", "stepper_deg", "table_deg", channels)
    return Drawn(sheets, nominal, {"gain": gain, "offset": 3.0 * DEG}, ({"jump_rad": jump * DEG, "at_s": at},))


def roller_blind(rng: Rng) -> Drawn:
    """A blind on a spring shaft with dry guides; the distance sensor answers late."""
    mass, damping, stiffness = rng.uniform(2.0, 4.0), rng.uniform(20.0, 35.0), rng.uniform(60.0, 120.0)
    sigma, late = between(rng, 5.0, 9.0), rng.uniform(0.05, 0.12)
    friction = rng.uniform(1.2, 2.5) * sigma * 1e-3 * stiffness

    def slope(rub: float) -> Rate:
        return lambda _, s, u: (s[1], (u[0] - damping * s[1] - stiffness * s[0] - rub * math.tanh(s[1] / 2e-3)) / mass)

    sheets = []
    for _ in range(3):
        t = even(50.0, 25.0)
        pull = rng.uniform(25.0, 40.0) * motion(rng, t, 1.2, begins_at_rest=True)
        rubbing, free = (1e3 * march(slope(rub), (0.0, 0.0), t, [pull], 6)[:, 0] for rub in (friction, 0.0))
        sheet = Sheet(t)
        sheet.drive("pull_N", pull)
        sheet.read(
            "travel_mm", _late(t, rubbing, late), free, white(rng, t.size, sigma), alone=(rubbing, _late(t, free, late))
        )
        sheets.append(sheet)
    channels = {"pull_N": channel("N"), "travel_mm": channel("m", 1e-3)}
    nominal = sprung_slide(rng, "blind", "pull_N", "travel_mm", channels, mass, stiffness)
    values = {"mass": mass, "damping": damping, "stiffness": stiffness}
    return Drawn(sheets, nominal, values, ({"force_N": friction}, {"delay_s": late}))


def _late(time_s: Array, values: Array, delay_s: float) -> Array:
    """Return values (n,) of delay_s (s) ago."""
    return np.asarray(np.interp(time_s - delay_s, time_s, values))


def capstan(rng: Rng) -> Drawn:
    """A capstan drive with a gap and an eccentric drum."""
    gain, width, phase = rng.uniform(0.95, 1.05), rng.uniform(0.03, 0.08), rng.uniform(0.0, 6.28)
    eccentric, sigma = rng.uniform(0.02, 0.05), between(rng, 0.010, 0.025)
    sheets = []
    for _ in range(3):
        t = even(60.0, 25.0)
        drum = rng.uniform(6.0, 10.0) * motion(rng, t, 0.5)
        plain, behind = gain * drum, gain * gap(drum, width)
        both = behind + eccentric * np.sin(behind / gain + phase)
        sheet = Sheet(t)
        sheet.drive("drum_rad", drum)
        sheet.read(
            "joint_rad", both, plain, white(rng, t.size, sigma), alone=(behind, plain + eccentric * np.sin(drum + phase))
        )
        sheets.append(sheet)
    channels = {"drum_rad": channel("rad"), "joint_rad": channel("rad")}
    nominal = link("capstan", "drum_rad", "joint_rad", channels)
    planted = ({"width_rad": width}, {"amplitude_rad": eccentric})
    return Drawn(sheets, nominal, {"gain": gain, "offset": 0.0}, planted)


def air_muscle(rng: Rng) -> Drawn:
    """A muscle with a gap in its linkage; its contraction follows with a lag."""
    gain, width, lag = rng.uniform(0.6, 1.4), rng.uniform(2.0, 5.0), rng.uniform(0.06, 0.15)
    sigma = between(rng, 0.8, 2.2)
    sheets = []
    for _ in range(3):
        t = even(100.0, 20.0)
        command = rng.uniform(30.0, 45.0) * motion(rng, t, 0.8)
        behind = gap(command, width)
        plain = gain * command
        both, lagging = (gain * exact([1.0], [lag, 1.0], x, 0.01, "foh") for x in (behind, command))
        sheet = Sheet(t)
        sheet.drive("command_mm", command)
        sheet.read("joint_mm", both, plain, white(rng, t.size, sigma), alone=(gain * behind, lagging))
        sheets.append(sheet)
    channels = {"command_mm": channel("m", 1e-3), "joint_mm": channel("m", 1e-3)}
    nominal = link("muscle", "command_mm", "joint_mm", channels)
    return Drawn(sheets, nominal, {"gain": gain, "offset": 0.0}, ({"width_m": 1e-3 * width}, {"time_constant_s": lag}))


def hopper(rng: Rng) -> Drawn:
    """A hopper on a rail that empties while it is driven, so its mass falls."""
    full, end, damping = rng.uniform(18.0, 24.0), rng.uniform(9.0, 13.0), rng.uniform(3.0, 8.0)
    sigma, last = between(rng, 0.1, 0.3), 30.0

    def slope(lost: float) -> Rate:
        return lambda now, s, u: ((u[0] - damping * s[0]) / (full - lost * now / last),)

    sheets = []
    for _ in range(3):
        t = even(50.0, last)
        force = rng.uniform(25.0, 40.0) * motion(rng, t, 0.8, begins_at_rest=True)
        true, plain = (march(slope(lost), (0.0,), t, [force], 2)[:, 0] for lost in (full - end, 0.0))
        sheet = Sheet(t)
        sheet.drive("force_N", force)
        sheet.read("speed_m_s", true, plain, white(rng, t.size, sigma) + slow(rng, t.size, 0.3 * sigma, 10.0))
        sheets.append(sheet)
    channels = {"force_N": channel("N"), "speed_m_s": channel("m/s")}
    nominal = axis(
        "hopper", "force_N", "speed_m_s", channels, ("mass", "damping"), "velocity", "zero", mass=stated(rng, full)
    )
    return Drawn(sheets, nominal, {"mass": full, "damping": damping}, ({"loss_kg_s": (full - end) / last},))


DATA_SETS = (
    DataSet("dynamometer", "null", dynamometer, says="jittered stamps, lost samples"),
    DataSet("cyclist", "null", cyclist, says="readings in steps of 0.1 m/s, irregular stamps"),
    DataSet("quarter_car", "null", quarter_car, says="vibration of the engine as noise"),
    DataSet("hydraulic_cylinder", "null", hydraulic_cylinder, says="lost samples, an integrating plant"),
    DataSet("steering", "null", steering, finding="unit", says="an angle in degrees is stated in radians"),
    DataSet("seat_shaker", "null", seat_shaker, finding="sign", says="the accelerometer is mounted upside down"),
    DataSet("pan_tilt", "null", pan_tilt, finding="swapped", says="two measured columns are exchanged"),
    DataSet("geared_motor", "single", geared_motor, ("coulomb_friction@motor",), closed_loop=True, says="the gear rubs"),
    DataSet("belt_stage", "single", belt_stage, ("compliance@belt",), says="the belt stretches"),
    DataSet(
        "grating", "single", grating, ("whip@spindle",), (("whip", "periodic_disturbance"),), says="an eccentric encoder"
    ),
    DataSet(
        "syringe_pump",
        "single",
        syringe_pump,
        ("rate_lag@tube",),
        (("rate_lag", "viscous_friction"),),
        says="a soft tube",
        compared=("time_constant_s",),
    ),
    DataSet("voice_coil", "single", voice_coil, ("saturation@coil",), says="the current is limited"),
    DataSet(
        "camera_slider",
        "single",
        camera_slider,
        ("stribeck_friction@slider",),
        (("stribeck_friction", "presliding_friction"),),
        says="LuGre friction with a Stribeck dip",
    ),
    DataSet("model_boat", "single", model_boat, ("viscous_friction@hull",), says="drag with the square of the speed"),
    DataSet("ship_wheel", "single", ship_wheel, ("backlash@rudder",), says="a gap in the gear", compared=("width_rad",)),
    DataSet("telescope", "single", telescope, ("resonance@mount",), says="a shaft that twists", compared=("frequency_Hz",)),
    DataSet("turntable", "single", turntable, ("missed_steps@table",), says="steps are lost at one moment of every cycle"),
    DataSet(
        "roller_blind",
        "pair",
        roller_blind,
        ("coulomb_friction@blind", "latency@blind"),
        says="dry guides and a late sensor",
        compared=("delay_s",),
    ),
    DataSet(
        "capstan",
        "pair",
        capstan,
        ("backlash@capstan", "whip@capstan"),
        (("backlash",), ("whip", "periodic_disturbance")),
        says="a gap and an eccentric drum",
        compared=("width_rad",),
    ),
    DataSet(
        "air_muscle",
        "pair",
        air_muscle,
        ("backlash@muscle", "rate_lag@muscle"),
        (("backlash",), ("rate_lag", "viscous_friction")),
        says="a gap and a lag",
        compared=("width_m", "time_constant_s"),
    ),
    DataSet("hopper", "outside", hopper, ("unlisted@hopper",), says="the mass falls during the recording"),
)
