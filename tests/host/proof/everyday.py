"""Small recordings as people bring them: a mass on a damper, a gear, a pressed spring, and the usual mistakes with them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.signal import cont2discrete, lfilter

Array = np.ndarray
Columns = dict[str, Array]
RATE_HZ = 100.0
MASS_kg, DAMPING, STIFFNESS = 0.5, 3.0, 120.0


def stream(number: int) -> np.random.Generator:
    return np.random.default_rng([20261, number])


def tones(rng: np.random.Generator, t: Array, fastest_Hz: float = 3.0, count: int = 6) -> Array:
    """Sines of random phase, RMS about 1."""
    f = np.geomspace(0.15, fastest_Hz, count) * rng.uniform(0.95, 1.05, count)
    return np.asarray(
        np.sin(2 * np.pi * np.outer(t, f) + rng.uniform(0, 6.28, count)) @ np.full(count, (2.0 / count) ** 0.5)
    )


def _steady(rng: np.random.Generator, t: Array) -> tuple[Array, Array, Array, Array]:
    """Force of eight tones and the exact steady motion of the sprung mass under it: force, position, speed, acceleration."""
    f = np.geomspace(0.15, 6.0, 8) * rng.uniform(0.95, 1.05, 8)
    w, phase = 2 * np.pi * f, rng.uniform(0, 6.28, 8)
    force = np.exp(1j * (np.outer(t, w) + phase))
    x = force / (STIFFNESS - MASS_kg * w**2 + 1j * DAMPING * w)
    return tuple(np.real(z.sum(axis=1)) for z in (force, x, 1j * w * x, -(w**2) * x))  # type: ignore[return-value]


def sprung(
    number: int,
    hold: str = "linear",
    reads: str = "position",
    seconds: float = 20.0,
    coulomb_N: float = 0.0,
    noise: float = 5e-3,
) -> Columns:
    """A recording of a sprung mass, exact for its `hold`, cut from motion. noise: share of the output's RMS."""
    rng = stream(number)
    lead, n = 600, round(seconds * RATE_HZ)
    t = np.arange(lead + n) / RATE_HZ
    if hold == "band_limited":
        f, x, v, a = _steady(rng, t)
    else:
        f = tones(rng, t)
        every = 40 if coulomb_N else 1
        fine = np.interp(np.arange(t.size * every) / (RATE_HZ * every), t, f) if hold == "linear" else np.repeat(f, every)
        x, v = _driven(fine, hold, 1.0 / (RATE_HZ * every), coulomb_N)
        x, v = x[::every], v[::every]
        a = (f - DAMPING * v - STIFFNESS * x - coulomb_N * np.tanh(v / 1e-3)) / MASS_kg
    y = {"position": x, "velocity": v, "acceleration": a}[reads][lead:]
    y = y + noise * np.std(y) * rng.standard_normal(n)
    return {"t": np.arange(n) / RATE_HZ, "f": f[lead:], "x": y}


def _driven(f: Array, hold: str, dt: float, coulomb_N: float) -> tuple[Array, Array]:
    """Position and speed under the force f (n,), exactly for the linear law, friction taken as held over a step."""
    A = np.array([[0.0, 1.0], [-STIFFNESS / MASS_kg, -DAMPING / MASS_kg]])
    B = np.array([[0.0], [1.0 / MASS_kg]])
    Ad, Bd, Cd, Dd, _ = cont2discrete((A, B, np.eye(2), np.zeros((2, 1))), dt, "foh" if hold == "linear" else "zoh")
    out, s = np.zeros((f.size, 2)), np.zeros(2)
    _, Bz, *_ = cont2discrete((A, B, np.eye(2), np.zeros((2, 1))), dt, "zoh")
    for i, u in enumerate(f):
        out[i] = Cd @ s + Dd[:, 0] * u
        grip = coulomb_N * np.tanh(out[i, 1] / 1e-3)
        s = Ad @ s + Bd[:, 0] * u - Bz[:, 0] * grip
    return out[:, 0], out[:, 1]


def free_mass(number: int, coulomb_N: float = 0.0, seconds: float = 20.0, by_place: float = 0.0) -> Columns:
    """The plain case: position of four sines, force = mass a + damping v (+ friction), noise 2 um and 2 mN.

    by_place: further damping that grows with the place squared, N s/m3.
    """
    rng, t = stream(number), np.arange(0.0, seconds, 1.0 / RATE_HZ)
    w = 2 * np.pi * np.array([0.31, 0.73, 1.37, 2.11])
    p, size = rng.uniform(0, 6.28, 4), 0.02 * 2 * np.pi / w
    x = np.sin(np.outer(t, w) + p) @ size
    v = np.cos(np.outer(t, w) + p) @ (size * w)
    a = -np.sin(np.outer(t, w) + p) @ (size * w**2)
    f = MASS_kg * a + (DAMPING + by_place * x**2) * v + coulomb_N * np.tanh(v / 1e-3)
    return {"t": t, "f": f + 2e-3 * rng.standard_normal(t.size), "x": x + 2e-6 * rng.standard_normal(t.size)}


def gear(number: int, seconds: float = 20.0, rate_Hz: float = RATE_HZ, fastest_Hz: float = 1.5, count: int = 6) -> Columns:
    """Motor angle and load angle, ratio 0.4, noise 2 mrad."""
    rng, t = stream(number), np.arange(0.0, seconds, 1.0 / rate_Hz)
    motor = 1.5 * tones(rng, t, fastest_Hz, count)
    return {"t": t, "motor": motor, "load": 0.4 * motor + 0.1 + 2e-3 * rng.standard_normal(t.size)}


def with_play(columns: Columns, width: float) -> Columns:
    """The gear with an ideal gap of `width` (motor angle)."""
    out, y = np.empty_like(columns["motor"]), float(columns["motor"][0])
    for i, m in enumerate(columns["motor"]):
        y = min(max(y, m - 0.5 * width), m + 0.5 * width)
        out[i] = y
    return {**columns, "load": columns["load"] + 0.4 * (out - columns["motor"])}


def with_lag(columns: Columns, tau_s: float) -> Columns:
    """The gear behind a first-order lag."""
    a = float(np.exp(-1.0 / (RATE_HZ * tau_s)))
    slow = lfilter([1 - a], [1, -a], columns["motor"], zi=[a * columns["motor"][0]])[0]
    return {**columns, "load": columns["load"] + 0.4 * (slow - columns["motor"])}


def with_delay(columns: Columns, delay_s: float) -> Columns:
    """The gear behind a dead time."""
    late = np.interp(columns["t"] - delay_s, columns["t"], columns["motor"])
    return {**columns, "load": columns["load"] + 0.4 * (late - columns["motor"])}


def spring(number: int, coulomb_N: float = 0.0, mass_kg: float = 0.0) -> Columns:
    """A pressed spring and damper: motion in, force out, noise 20 mN."""
    rng, t = stream(number), np.arange(0.0, 20.0, 1.0 / RATE_HZ)
    f = np.geomspace(0.15, 2.5, 6) * rng.uniform(0.95, 1.05, 6)
    w, p = 2 * np.pi * f, rng.uniform(0, 6.28, 6)
    x = np.sin(np.outer(t, w) + p) @ np.full(6, 0.01)
    v = np.cos(np.outer(t, w) + p) @ (0.01 * w)
    a = -np.sin(np.outer(t, w) + p) @ (0.01 * w**2)
    force = mass_kg * a + 4.0 * v + 200.0 * x + 0.3 + coulomb_N * np.tanh(v / 1e-3)
    return {"t": t, "x": x, "f": force + 0.02 * rng.standard_normal(t.size)}


def wander(rng: np.random.Generator, n: int, samples: float) -> Array:
    """First-order noise (n,) of unit standard deviation, correlated over so many samples."""
    kicks, keep = rng.standard_normal(n + int(10 * samples)), np.exp(-1.0 / samples)
    return np.asarray(lfilter([np.sqrt(1.0 - keep**2)], [1.0, -keep], kicks)[-n:])


def oven(number: int) -> Columns:
    """Heater power in steps (W), and the temperature behind a first-order lag of 180 s, every 5 s for an hour."""
    rng, t = stream(number), np.arange(0.0, 3600.0, 5.0)
    power = np.repeat(rng.uniform(0.0, 100.0, 30), 24)
    keep = float(np.exp(-5.0 / 180.0))
    warm = lfilter([0.0, 1.0 - keep], [1.0, -keep], power, zi=[power[0]])[0]
    return {"t": t, "W": power, "C": 25.0 + 0.6 * warm + 0.05 * rng.standard_normal(t.size)}


def oven_nominal() -> dict[str, Any]:
    """Nominal model of the oven: a gain."""
    return {
        "name": "oven",
        "kind": "transmission",
        "data": {"time": "t"},
        "channels": {"W": {"column": "W", "unit": "W"}, "C": {"column": "C", "unit": "K"}},
        "link": [{"subsystem": "oven", "input": "W", "output": "C"}],
    }


def pressed_in_a_loop(number: int) -> Columns:
    """A spring whose set-point a servo corrects by the noisy force, two samples late: every 5 ms for 20 s."""
    rng, t = stream(number), np.arange(0.0, 20.0, 0.005)
    wanted, noise = 0.01 * tones(rng, t, 1.0, 5), 0.02 * rng.standard_normal(t.size)
    x, slow = np.zeros(t.size), 0.0
    for k in range(t.size):
        if k > 2:
            slow += 0.05 * (wanted[k] - (150.0 * x[k - 2] + noise[k - 2]) / 150.0)
        x[k] = wanted[k] + 0.3 * slow
    return {"t": t, "x": x, "f": 150.0 * x + noise}


def axis_nominal(
    hold: str = "linear", reads: str = "position", terms: Sequence[str] = (), **parameters: Any
) -> dict[str, Any]:
    """Nominal model of the sprung mass."""
    unit = {"position": "m", "velocity": "m/s", "acceleration": "m/s2"}[reads]
    return {
        "name": "mass",
        "kind": "axis",
        "data": {"time": "t"},
        "channels": {"f": {"column": "f", "unit": "N"}, "x": {"column": "x", "unit": unit}},
        "axis": {
            "subsystem": "slide",
            "input": "f",
            "output": "x",
            "terms": list(terms or ("mass", "damping", "stiffness", "offset")),
            "hold": hold,
            "reads": reads,
        },
        "parameters": parameters,
    }


def free_nominal(hold: str = "linear") -> dict[str, Any]:
    """Nominal model of the free mass."""
    return axis_nominal(hold, terms=("mass", "damping", "offset"))


def gear_nominal(**parameters: Any) -> dict[str, Any]:
    """Nominal model of the gear."""
    return {
        "name": "gear",
        "kind": "transmission",
        "data": {"time": "t"},
        "channels": {"motor": {"column": "motor", "unit": "rad"}, "load": {"column": "load", "unit": "rad"}},
        "link": [{"subsystem": "gear", "input": "motor", "output": "load"}],
        "parameters": parameters,
    }


def first_order_nominal(input_unit: str, output_unit: str, gain: float, tau: float) -> dict[str, Any]:
    """Nominal model of a plant of first order (gain, time constant in s) whose input is held."""
    return {
        "name": "plant",
        "kind": "linear",
        "data": {"time": "t"},
        "channels": {"u": {"column": "u", "unit": input_unit}, "y": {"column": "y", "unit": output_unit}},
        "linear": {
            "subsystem": "plant",
            "inputs": ["u"],
            "outputs": ["y"],
            "numerator": ["gain"],
            "denominator": ["tau", 1.0],
            "hold": "zero",
        },
        "parameters": {"gain": gain, "tau": tau},
    }


def spring_nominal(*terms: str) -> dict[str, Any]:
    """Nominal model of the pressed spring."""
    return {
        "name": "spring",
        "kind": "impedance",
        "data": {"time": "t"},
        "channels": {"x": {"column": "x", "unit": "m"}, "f": {"column": "f", "unit": "N"}},
        "impedance": {
            "subsystem": "pad",
            "input": "x",
            "output": "f",
            "terms": list(terms or ("damping", "stiffness", "offset")),
        },
    }
