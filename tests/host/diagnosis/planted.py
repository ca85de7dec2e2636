"""Small synthetic recordings with physics planted by formulas other than the finder's (LuGre, Bouc-Wen, solve_ivp)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

CABLE = """
name = "planted"
kind = "transmission"
[data]
TIME
[channels.motor]
column = "motor"
unit = "rad"
[channels.tip]
column = "tip"
unit = "rad"
[[link]]
subsystem = "cable"
input = "motor"
output = "tip"
"""
TRANSMISSION = f"""{CABLE}load = ["load"]
[channels.load]
column = "load"
unit = "N m"
"""
AXIS = """
name = "planted"
kind = "axis"
[data]
time = "t"
[channels.force]
column = "force"
unit = "N"
[channels.position]
column = "position"
unit = "m"
[axis]
subsystem = "stage"
input = "force"
output = "position"
terms = ["mass", "damping", "stiffness", "offset"]
"""
IMPEDANCE = """
name = "planted"
kind = "impedance"
[data]
time = "t"
[channels.position]
column = "position"
unit = "m"
[channels.force]
column = "force"
unit = "N"
[impedance]
subsystem = "slide"
input = "position"
output = "force"
terms = ["stiffness", "damping", "offset"]
"""


def path_of(rng: np.random.Generator, t: np.ndarray, size: float) -> np.ndarray:
    """A motion of several slow sines with rests."""
    phase = rng.uniform(0, 6.28, 4)
    x = sum(np.sin(2 * np.pi * f * t + p) for f, p in zip((0.11, 0.23, 0.37, 0.71), phase, strict=True))
    rest = (t % 12.0) > 10.0
    x = np.where(rest, np.nan, x)
    good = np.isfinite(x)
    return size * np.interp(t, t[good], x[good], period=None) if not rest.any() else size * _hold(x)


def _hold(x: np.ndarray) -> np.ndarray:
    """Rests at the last value, and goes on from there."""
    steps = np.diff(x, prepend=x[0])
    return np.cumsum(np.where(np.isfinite(steps), steps, 0.0))


def coloured(rng: np.random.Generator, n: int, sigma: float) -> np.ndarray:
    """Noise with a memory of three samples."""
    e = rng.normal(size=n + 3)
    out = e[3:] + 0.6 * e[2:-1] + 0.3 * e[1:-2]
    return sigma * out / np.sqrt(1 + 0.36 + 0.09)


def transmission(folder: Path, effect: str, seed: int, sigma: float = 2e-3, timed: bool = True) -> tuple[Path, list[Path]]:
    """Nominal and three recordings of a cable with `effect` in it."""
    nominal = folder / "nominal.toml"
    nominal.write_text(TRANSMISSION.replace("TIME", 'time = "t"' if timed else ""))
    files = []
    for k in range(3):
        rng = np.random.default_rng(1000 * seed + k)
        t = np.arange(0, 40, 0.02)
        motor, load = path_of(rng, t, 0.3), 0.5 + 0.4 * np.sin(0.5 * t + k)
        tip = 0.9 * _transmitted(effect, motor, load, t) + 0.05
        tip = tip + (0.02 * load if effect == "compliance" else 0.0) + coloured(rng, t.size, sigma)
        table = np.column_stack((t, motor, load, tip))
        path = folder / f"r{k}.csv"
        np.savetxt(path, table, delimiter=",", header="t,motor,load,tip", comments="")
        files.append(path)
    return nominal, files


def _transmitted(effect: str, x: np.ndarray, load: np.ndarray, t: np.ndarray) -> np.ndarray:
    if effect == "backlash":
        y = np.empty_like(x)
        y[0] = x[0]
        for i in range(1, x.size):
            gap = x[i] - y[i - 1]
            y[i] = y[i - 1] + (gap - 0.01 * np.sign(gap) if abs(gap) > 0.01 else 0.0)
        return y
    if effect == "latency":
        return np.interp(t - 0.11, t, x)
    if effect == "unlisted":
        return x + 0.15 * x * (load - 0.5)
    return x


def axis(folder: Path, effect: str, seed: int, sigma: float = 2e-4) -> tuple[Path, list[Path]]:
    """Nominal and three recordings of a mass on a spring with `effect` in it."""
    nominal = folder / "nominal.toml"
    nominal.write_text(AXIS)
    files = []
    for k in range(3):
        rng = np.random.default_rng(1000 * seed + k)
        t = np.arange(0, 12, 0.01)
        phases, lines = rng.uniform(0, 6.28, 8), rng.uniform(0.2, 2.5, 8)
        force = np.sum([np.sin(2 * np.pi * f * t + p) for f, p in zip(lines, phases, strict=True)], axis=0)
        cubic, drag = (150.0 if effect == "cubic" else 0.0), (1.2 if effect == "coulomb" else 0.0)

        def rates(
            s: float, y: np.ndarray, force: np.ndarray = force, t: np.ndarray = t, cubic: float = cubic, drag: float = drag
        ) -> list[float]:
            u = np.interp(s, t, force)
            return [y[1], (u - 1.5 * y[1] - 40 * y[0] - cubic * y[0] ** 3 - drag * np.tanh(y[1] / 2e-3)) / 1.3]

        x = solve_ivp(rates, (0, t[-1]), [0, 0], t_eval=t, rtol=1e-6, atol=1e-8, max_step=0.01).y[0] + coloured(
            rng, t.size, sigma
        )
        path = folder / f"r{k}.csv"
        np.savetxt(path, np.column_stack((t, force, x)), delimiter=",", header="t,force,position", comments="")
        files.append(path)
    return nominal, files


def impedance(folder: Path, effect: str, seed: int, sigma: float = 0.02) -> tuple[Path, list[Path]]:
    """Nominal and three recordings of a slide on a spring, with a LuGre bristle in it for effect `lugre`."""
    nominal = folder / "nominal.toml"
    nominal.write_text(IMPEDANCE)
    files = []
    for k in range(3):
        rng = np.random.default_rng(1000 * seed + k)
        t = np.arange(0, 30, 0.01)
        x = path_of(rng, t, 0.02)
        v = np.gradient(x, t)
        force = 30.0 * x + 2.0 * v + 0.1 + coloured(rng, t.size, sigma)
        if effect == "lugre":
            z = 0.0
            for i in range(1, t.size):
                for _ in range(20):
                    z += 0.05 * (x[i] - x[i - 1]) * (1.0 - z / 2e-3 * np.sign(x[i] - x[i - 1]))
                force[i] += 0.3 * z / 2e-3
        path = folder / f"r{k}.csv"
        np.savetxt(path, np.column_stack((t, x, force)), delimiter=",", header="t,position,force", comments="")
        files.append(path)
    return nominal, files
