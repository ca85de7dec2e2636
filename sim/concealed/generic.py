"""Concealed recordings of plain mechanisms: two coupled transmissions, a driven axis, a pressed material.

Transmissions reuse the rig's planted effects on a motion; axis and impedance have their own formulas here (LuGre with
steep bristles, Bouc-Wen, two Maxwell branches), integrated at ten times the recordings' rate.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.optimize import least_squares

from sim import axis_effects
from sim.concealed.rig import NoiselessRecordings
from sim.concealed.scalable_effects import ScalableEffect
from sim.concealed.signals import KINDS, signal
from sim.effects import PlantedEffect, pack
from sim.friction_effects import bouc_wen

Array = np.ndarray
Planted = tuple[ScalableEffect, dict[str, float]]
DURATION_S, PAUSE_S = 30.0, 4.0
INSIDE = 10  # integration steps a sample
CODES = (
    "coulomb_friction",
    "presliding_friction",
    "stribeck_friction",
    "nonlinear_stiffness",
    "periodic_disturbance",
    "creep_relaxation",
    "contact_nonlinear",
    "quadratic drag",
    "damping that grows with the square of the place",
    "a force with place and speed's size",
)
INPUTS = {"transmission": ("motor_a_rad", "motor_b_rad", "load_a_Nm"), "axis": ("drive_N",), "impedance": ("motion_m",)}
OUTPUTS = {"transmission": ("tip_a_rad", "tip_b_rad"), "axis": ("position_m",), "impedance": ("force_N",)}


@dataclass(frozen=True)
class GenericCase:
    """A mechanism, its noise and what it is asked to do. reference: (n, k) per recording; nominal as the kind has them."""

    kind: str
    nominal: Array
    starts_s: tuple[float, ...]
    reference: tuple[Array, ...]
    sigma: Array
    closed_loop: bool
    seed: int
    period_s: float


def draw(
    rng: np.random.Generator, kind: str, closed_loop: bool, signals: Sequence[str] | None = None, loads: bool = True
) -> GenericCase:
    """A mechanism of `kind` with three recordings; `signals` fixes the kind of excitation of each of them."""
    period = 0.02 if kind == "transmission" else 0.01
    time = np.arange(0.0, DURATION_S, period)
    width = len(INPUTS[kind])
    size = {"transmission": (1.2, 0.6, 3e-4 * loads), "axis": (2.5,), "impedance": (0.02,)}[kind]
    fastest = {"transmission": 0.8, "axis": 2.0, "impedance": 1.5}[kind]
    reference = []
    for i in range(3):
        chosen = [signals[i] if signals else KINDS[int(rng.choice(5, p=[0.3, 0.3, 0.15, 0.1, 0.15]))] for _ in range(width)]
        reference.append(
            np.column_stack(
                [rng.uniform(0.75, 1.0) * a * signal(rng, k, time, fastest) for a, k in zip(size, chosen, strict=True)]
            )
        )
    nominal, sigma = {
        "transmission": (
            np.array([rng.uniform(0.5, 1.2), 0.02, rng.uniform(0.8, 1.3), -0.01]),
            np.full(2, rng.uniform(0.004, 0.01)),
        ),
        "axis": (
            np.array([rng.uniform(0.3, 0.8), rng.uniform(3.0, 7.0), rng.uniform(60.0, 150.0), 0.05]),
            np.array([rng.uniform(3e-4, 8e-4)]),
        ),
        "impedance": (
            np.array([0.05, rng.uniform(2.0, 6.0), rng.uniform(100.0, 300.0), 0.1]),
            np.array([rng.uniform(0.05, 0.15)]),
        ),
    }[kind]
    starts = tuple(i * (DURATION_S + PAUSE_S) for i in range(3))
    return GenericCase(kind, nominal, starts, tuple(reference), sigma, closed_loop, int(rng.integers(2**31)), period)


@njit(cache=True)
def extra(code: int, q: Array, state: Array, x: float, v: float, time_s: float, dt_s: float, stiffness: float) -> float:
    """Force (N) of one planted effect against the motion; `state` (4,) is what it remembers."""
    if code == 0 or code == 2:
        full = q[0] if code == 0 else q[1] + (q[0] - q[1]) * math.exp(-((v / max(q[2], 1e-9)) ** 2))
        state[0] = (state[0] + v * dt_s / 1e-4) / (1.0 + abs(v) * dt_s / 1e-4)
        return full * state[0]
    if code == 1:
        state[0] = bouc_wen(state[0], v * dt_s / q[1])
        return q[0] * state[0]
    if code == 3:
        return q[0] * x**3
    if code == 4:
        return -q[0] * math.sin(2.0 * math.pi * q[1] * time_s)
    if code == 5:
        state[0] = x + (state[0] - x) * math.exp(-dt_s / q[1])
        state[1] = x + (state[1] - x) * math.exp(-dt_s / (5.0 * q[1]))
        return q[0] * stiffness * (x - 0.6 * state[0] - 0.4 * state[1])
    if code == 6:
        depth = max(x, 0.0) / q[1]
        return q[0] * q[1] * (math.exp(min(depth, 8.0)) - 1.0 - depth)
    if code == 7:
        return q[0] * v * abs(v)
    if code == 8:
        return q[0] * x * x * v
    if code == 9:
        return q[0] * x * abs(v)
    return 0.0


@njit(cache=True)
def move(
    p: Array,
    drive: Array,
    times: Array,
    dt_s: float,
    codes: Array,
    q: Array,
    gains: Array,
    noise: Array,
    out: Array,
    used: Array,
) -> None:
    """Axis: position out (n,) under drive (n,) N, midpoint rule; gains (2,) above zero close a loop on the late position.

    p: mass, damping, stiffness, offset. used (n,): the force that drove it; in closed loop `drive` is the wanted position.
    """
    x = v = total = 0.0
    state = np.zeros((codes.size, 4))
    x = p[3] / p[2]
    last = 0.0
    for i in range(drive.size):
        force = drive[i]
        if gains[0] > 0.0:
            error = drive[i] - (out[i - 2] + noise[i - 2] if i > 1 else x)
            total += error * dt_s
            force = p[2] * drive[i] + gains[0] * error + gains[1] * total
        used[i] = force
        for k in range(INSIDE if i > 0 else 0):
            u = last if gains[0] > 0.0 else last + (force - last) * (k + 0.5) / INSIDE
            h = dt_s / INSIDE
            against = 0.0
            for j in range(codes.size):
                against += extra(codes[j], q[j], state[j], x, v, times[i - 1] + k * h, h, p[2])
            still = 0.5 * h * p[1] / p[0] + 0.25 * h * h * p[2] / p[0]
            before = v
            v = (v * (1.0 - still) + h / p[0] * (u + p[3] - p[2] * x - against)) / (1.0 + still)
            x += 0.5 * h * (before + v)
        out[i] = x
        last = force


@njit(cache=True)
def press(p: Array, motion: Array, times: Array, dt_s: float, codes: Array, q: Array, out: Array) -> None:
    """Impedance: force out (n,) at motion (n,), which runs straight between samples for the effects with memory."""
    state = np.zeros((codes.size, 4))
    for i in range(motion.size):
        before, after = motion[max(i - 1, 0)], motion[min(i + 1, motion.size - 1)]
        v = (after - before) / (2.0 * dt_s)
        a = (after - 2.0 * motion[i] + before) / dt_s**2
        total = p[0] * a + p[1] * v + p[2] * motion[i] + p[3]
        for j in range(codes.size):
            value, h = 0.0, dt_s / INSIDE
            for k in range(INSIDE):
                x = before + (motion[i] - before) * (k + 1.0) / INSIDE
                value = extra(codes[j], q[j], state[j], x, v, times[i] - dt_s + (k + 1.0) * h, h, p[2])
            total += value
        out[i] = total


def _kernels(planted: Sequence[Planted]) -> tuple[Array, Array]:
    """Numbers and values of those planted effects that are forces."""
    forces = [
        (CODES.index(name), list(values.values()))
        for d, values in planted
        if (name := d.says if d.id == "unlisted" else d.id) in CODES
    ]
    q = np.zeros((len(forces), 4))
    for row, (_, values) in zip(q, forces, strict=True):
        row[: len(values)] = values
    return np.array([code for code, _ in forces], np.int64), q


def _value(planted: Sequence[Planted], name: str, key: str) -> float:
    return next((values[key] for d, values in planted if d.id == name), 0.0)


def _drive(drive: Array, planted: Sequence[Planted]) -> Array:
    """What reaches the axis of its command: dead zone and limit of the amplifier."""
    half, limit = _value(planted, "dead_zone", "half_width_N"), _value(planted, "saturation", "limit_N")
    out = np.sign(drive) * np.maximum(np.abs(drive) - half, 0.0)
    return np.asarray(limit * np.tanh(out / limit) if limit > 0.0 else out)


def simulate(
    case: GenericCase, planted: Sequence[Planted] = (), replay: Sequence[Array] | None = None
) -> NoiselessRecordings:
    """Run the session; `replay` gives the recorded inputs instead of the case's own excitation and control."""
    times = [start + case.period_s * np.arange(len(r)) for start, r in zip(case.starts_s, case.reference, strict=True)]
    asked = list(case.reference if replay is None else replay)
    closed = case.closed_loop and replay is None
    run = {"transmission": _transmission, "axis": _axis, "impedance": _impedance}[case.kind]
    pairs = [run(case, planted, time, wanted, closed, i) for i, (time, wanted) in enumerate(zip(times, asked, strict=True))]
    return NoiselessRecordings(tuple(times), tuple(p[0] for p in pairs), tuple(p[1] for p in pairs))


def _axis(
    case: GenericCase, planted: Sequence[Planted], time: Array, wanted: Array, closed: bool, i: int
) -> tuple[Array, Array]:
    codes, q = _kernels(planted)
    noise = np.random.default_rng([case.seed, i]).standard_normal(len(time)) * case.sigma[0]
    p, out, used = case.nominal, np.empty(len(time)), np.empty(len(time))
    late = _value(planted, "latency", "delay_s")
    command = wanted[:, 0] / p[2] if closed else wanted[:, 0]
    gains = np.array([0.3 * p[2], 1.5 * p[2]]) if closed else np.zeros(2)
    move(p, command, time, case.period_s, codes, q, gains, noise, out, used)
    if closed or late > 0.0 or any(d.id in ("dead_zone", "saturation") for d, _ in planted):
        reached = _drive(np.interp(time - late, time, used), planted)
        move(p, reached, time, case.period_s, codes, q, np.zeros(2), noise, out, np.empty(len(time)))
    drift = _value(planted, "sensor_drift", "rate_per_s") * 2e-5
    return used[:, None], (out + drift * time)[:, None]


def _impedance(
    case: GenericCase, planted: Sequence[Planted], time: Array, wanted: Array, closed: bool, i: int
) -> tuple[Array, Array]:
    codes, q = _kernels(planted)
    p, out, motion = case.nominal, np.empty(len(time)), wanted[:, 0].copy()
    press(p, motion, time, case.period_s, codes, q, out)
    if closed:
        noise = np.random.default_rng([case.seed, i]).standard_normal(len(time)) * case.sigma[0]
        error = p[2] * wanted[:, 0] + p[3] - (out + noise)
        slow = np.zeros(len(time))
        a = math.exp(-case.period_s / 0.15)
        for j in range(2, len(time)):
            slow[j] = a * slow[j - 1] + (1.0 - a) * error[j - 2] / p[2]
        motion = wanted[:, 0] + 0.6 * slow
        press(p, motion, time, case.period_s, codes, q, out)
    late = _value(planted, "latency", "delay_s")
    drift = _value(planted, "sensor_drift", "rate_per_s") * 5e-3
    return motion[:, None], (np.interp(time - late, time, out) + drift * time)[:, None]


@njit(cache=True)
def _through(effects: Array, motor: Array, load: Array, start_s: float, dt_s: float, mixed: Array, out: Array) -> None:
    """Both transmissions' motions out (n, 2) before gain: planted effects of ports roll and knob, ten steps a sample."""
    stage = np.zeros(3)
    for i in range(motor.shape[0]):
        j = max(i - 1, 0)
        for k in range(INSIDE):
            share = (k + 1.0) / INSIDE
            for a in range(2):
                stage[1 + a] = motor[j, a] + share * (motor[i, a] - motor[j, a])
            t = start_s + (i - 1 + share) * dt_s
            for a in range(2):
                x = stage[1 + a] + mixed[j, a] + share * (mixed[i, a] - mixed[j, a])
                weight = load[j] + share * (load[i] - load[j]) if a == 0 else 5.0 * x
                out[i, a] = axis_effects.apply(effects, 1 + a, x, weight, stage, 20.0 * x, max(t, 0.0), dt_s / INSIDE)


def unlisted_value(form: str, columns: dict[str, Array], dt_s: float) -> Array:
    """The form of an effect outside every library, evaluated on recorded columns."""

    def rate(x: Array) -> Array:
        return np.gradient(x, dt_s)

    def play(x: Array, width: float) -> Array:
        out, y = np.empty_like(x), x[0]
        for i, value in enumerate(x):
            y = min(max(y, value - 0.5 * width), value + 0.5 * width)
            out[i] = y
        return out

    names = {"rate": rate, "play": play, "sin": np.sin, "cos": np.cos, "abs": np.abs, **columns}
    return np.asarray(eval(compile(form, "form", "eval"), {"__builtins__": {}}, names))


def _transmission(
    case: GenericCase, planted: Sequence[Planted], time: Array, wanted: Array, closed: bool, i: int
) -> tuple[Array, Array]:
    p, dt = case.nominal, case.period_s
    records = [PlantedEffect(d.id, d.port, values) for d, values in planted if d.id != "unlisted"]
    rng = np.random.default_rng([case.seed, i])
    noise = rng.standard_normal((len(time), 2)) * case.sigma

    def forward(motor: Array) -> Array:
        mixed, out = np.zeros((len(time), 2)), np.empty((len(time), 2))
        columns = {"motor_a_rad": motor[:, 0], "motor_b_rad": motor[:, 1]}
        for d, values in planted:
            if d.id == "unlisted":
                mixed[:, 0 if d.port == "roll" else 1] += values["size"] * unlisted_value(d.form, columns, dt)
        _through(pack(records), motor, wanted[:, 2], time[0], dt, mixed, out)
        return np.asarray(p[[0, 2]] * out + p[[1, 3]])

    motor = wanted[:, :2].copy()
    if closed:
        for _ in range(2):
            error = p[[0, 2]] * wanted[:, :2] + p[[1, 3]] - (forward(motor) + noise)
            slow, a = np.zeros_like(error), math.exp(-dt / 0.2)
            for j in range(2, len(time)):
                slow[j] = a * slow[j - 1] + (1.0 - a) * error[j - 2] / p[[0, 2]]
            motor = motor + 0.5 * slow
    return np.column_stack([motor, wanted[:, 2]]), forward(motor)


def predict(kind: str, p: Array, inputs: Array, period_s: float) -> Array:
    """Nominal outputs (n, m) of `kind` for recorded inputs (n, k), each recording from rest."""
    if kind == "transmission":
        return np.asarray(p[[0, 2]] * inputs[:, :2] + p[[1, 3]])
    out, none, n = np.empty(len(inputs)), np.zeros((0, 4)), np.empty(len(inputs))
    if kind == "axis":
        move(
            p,
            np.ascontiguousarray(inputs[:, 0]),
            np.arange(len(inputs)) * period_s,
            period_s,
            np.zeros(0, np.int64),
            none,
            np.zeros(2),
            n,
            out,
            n,
        )
    else:
        press(
            p,
            np.ascontiguousarray(inputs[:, 0]),
            np.arange(len(inputs)) * period_s,
            period_s,
            np.zeros(0, np.int64),
            none,
            out,
        )
    return out[:, None]


def fit(kind: str, start: Array, inputs: Sequence[Array], outputs: Sequence[Array], sigma: Array, period_s: float) -> Array:
    """Nominal parameters that bring all recordings nearest (simulation error). NaN outputs do not count."""
    scale = np.maximum(np.abs(start), 1e-2)
    held = np.array([1e-4, 1e-3, 1e-3, -np.inf]) if kind == "axis" else np.full(len(start), -np.inf)

    def errors(z: Array) -> Array:
        p = np.maximum(start + z * scale, held)
        parts = [
            np.nan_to_num((y - predict(kind, p, u, period_s)) / sigma).ravel() for u, y in zip(inputs, outputs, strict=True)
        ]
        return np.concatenate(parts)

    found = least_squares(errors, np.zeros(len(start)), max_nfev=15)
    return np.asarray(np.maximum(start + found.x * scale, held))
