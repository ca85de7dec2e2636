"""Data sets of materials and mounts: a motion is imposed, a force is measured."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from host.studies.proof.worlds.domains.bench import between, even, flicker, motion, white
from host.studies.proof.worlds.domains.dataset import Array, DataSet, Drawn, Sheet, channel, impedance, stated

Rng = np.random.Generator
CHANNELS = {"motion_mm": channel("m", 1e-3), "force_N": channel("N")}


def _imposed(
    rng: Rng, rate_hz: float, duration_s: float, size: float, fastest_hz: float
) -> tuple[Array, Array, Array, Array]:
    """Return times (s), motion (m), velocity (m/s) and acceleration (m/s2), all (n,), of a motion of `size` (m)."""
    fine = even(8.0 * rate_hz, duration_s)
    curve = CubicSpline(fine, size * motion(rng, fine, fastest_hz, "multisine"))
    t = even(rate_hz, duration_s - 0.5) + 0.2
    return t - t[0], curve(t), curve(t, 1), curve(t, 2)


def bushing(rng: Rng) -> Drawn:
    """A rubber bushing on a shaker: 1/f noise of the force bridge, noise of the motion reading."""
    mass, damping, stiffness = rng.uniform(0.3, 0.8), rng.uniform(40.0, 120.0), rng.uniform(2e4, 6e4)
    size = rng.uniform(1.5e-3, 3e-3)
    sheets = []
    for _ in range(3):
        t, x, v, a = _imposed(rng, 200.0, 15.0, size, 4.0)
        force = mass * a + damping * v + stiffness * x + 3.0
        noise = flicker(rng, t.size, rng.uniform(0.01, 0.03) * stiffness * size)
        sheet = Sheet(t)
        sheet.drive("motion_mm", 1e3 * x, white(rng, t.size, 1e3 * 0.002 * size))
        sheet.read("force_N", force, force, noise)
        sheets.append(sheet)
    terms = ("mass", "damping", "stiffness", "offset")
    nominal = impedance(
        "bushing", "motion_mm", "force_N", CHANNELS, terms, mass=stated(rng, mass), stiffness=stated(rng, stiffness)
    )
    return Drawn(sheets, nominal, {"mass": mass, "damping": damping, "stiffness": stiffness, "offset": 3.0})


def indenter(rng: Rng) -> Drawn:
    """A soft sample under an indenter; the clock of the force amplifier is ahead."""
    damping, stiffness, ahead = rng.uniform(20.0, 60.0), rng.uniform(400.0, 1200.0), rng.uniform(0.05, 0.1)
    size, sigma = rng.uniform(3e-3, 6e-3), rng.uniform(0.005, 0.015)
    sheets = []
    for _ in range(3):
        t, x, v, _ = _imposed(rng, 100.0, 25.0, size, 1.2)
        force = CubicSpline(t, damping * v + stiffness * x + 0.5)
        keep = t < t[-1] - 0.2
        sheet = Sheet(t[keep])
        sheet.drive("motion_mm", 1e3 * x[keep])
        shifted = force(t[keep] + ahead)
        sheet.read("force_N", shifted, shifted, white(rng, int(keep.sum()), sigma))
        sheets.append(sheet)
    nominal = impedance(
        "sample", "motion_mm", "force_N", CHANNELS, ("damping", "stiffness", "offset"), stiffness=stated(rng, stiffness)
    )
    return Drawn(sheets, nominal, {"damping": damping, "stiffness": stiffness, "offset": 0.5})


def rubber_mount(rng: Rng) -> Drawn:
    """A rubber mount that becomes softer while it warms."""
    damping, stiffness, size = rng.uniform(150.0, 400.0), rng.uniform(3e4, 8e4), rng.uniform(1e-3, 2e-3)
    share, warm, sigma = rng.uniform(0.08, 0.25), rng.uniform(25.0, 60.0), between(rng, 1.0, 4.0)
    sheets = []
    for _ in range(3):
        t, x, v, _ = _imposed(rng, 50.0, 50.0, size, 2.0)
        plain = damping * v + stiffness * x
        sheet = Sheet(t)
        sheet.drive("motion_mm", 1e3 * x)
        true = plain - share * (1.0 - np.exp(-t / warm)) * stiffness * x
        sheet.read("force_N", true, plain, white(rng, t.size, sigma))
        sheets.append(sheet)
    nominal = impedance(
        "mount", "motion_mm", "force_N", CHANNELS, ("damping", "stiffness", "offset"), stiffness=stated(rng, stiffness)
    )
    planted = ({"share": share, "time_constant_s": warm},)
    return Drawn(sheets, nominal, {"damping": damping, "stiffness": stiffness, "offset": 0.0}, planted)


def leaf_spring(rng: Rng) -> Drawn:
    """A leaf spring that hardens with the third and the fifth power of its deflection."""
    damping, stiffness, size = rng.uniform(100.0, 300.0), rng.uniform(5e3, 2e4), rng.uniform(0.02, 0.04)
    third, fifth, sigma = rng.uniform(0.06, 0.15), rng.uniform(0.02, 0.06), between(rng, 3.0, 9.0)
    sheets = []
    for _ in range(2):
        t, x, v, _ = _imposed(rng, 100.0, 20.0, size, 1.5)
        plain, u = damping * v + stiffness * x, x / size
        sheet = Sheet(t)
        sheet.drive("motion_mm", 1e3 * x)
        true = plain + stiffness * size * (third * u**3 + fifth * u**5)
        sheet.read("force_N", true, plain, white(rng, t.size, sigma))
        sheets.append(sheet)
    nominal = impedance(
        "spring", "motion_mm", "force_N", CHANNELS, ("damping", "stiffness", "offset"), stiffness=stated(rng, stiffness)
    )
    planted = ({"cubic_N_per_m3": stiffness * third / size**2},)
    return Drawn(sheets, nominal, {"damping": damping, "stiffness": stiffness, "offset": 0.0}, planted)


def pneumatic_cylinder(rng: Rng) -> Drawn:
    """A closed pneumatic cylinder: two air cushions, which harden, and the dry friction of the seals."""
    stroke, area, exponent = rng.uniform(0.08, 0.12), rng.uniform(3e-4, 8e-4), rng.uniform(1.05, 1.4)
    size, damping, sigma = stroke * rng.uniform(0.28, 0.36), rng.uniform(20.0, 60.0), between(rng, 1.0, 2.5)
    friction = rng.uniform(1.2, 2.5) * sigma
    pressure = 1e5
    stiffness = 2.0 * area * pressure * exponent / stroke
    sheets = []
    for _ in range(3):
        t, x, v, _ = _imposed(rng, 100.0, 20.0, size, 1.0)
        plain = damping * v + stiffness * x
        cushions = area * pressure * ((1.0 - x / stroke) ** -exponent - (1.0 + x / stroke) ** -exponent)
        rub = friction * np.tanh(v / 5e-4)
        hard = cushions - stiffness * x
        sheet = Sheet(t)
        sheet.drive("motion_mm", 1e3 * x)
        alone = (plain + rub, plain + hard)
        sheet.read("force_N", plain + rub + hard, plain, white(rng, t.size, sigma), alone=alone)
        sheets.append(sheet)
    nominal = impedance(
        "cylinder", "motion_mm", "force_N", CHANNELS, ("damping", "stiffness", "offset"), stiffness=stated(rng, stiffness)
    )
    planted = ({"force_N": friction}, {"exponent": exponent})
    return Drawn(sheets, nominal, {"damping": damping, "stiffness": stiffness, "offset": 0.0}, planted)


DATA_SETS = (
    DataSet("bushing", "null", bushing, says="1/f noise of the force, noise of the motion"),
    DataSet("indenter", "null", indenter, finding="clock", says="the clock of the force is ahead"),
    DataSet("rubber_mount", "single", rubber_mount, ("softening@mount",), says="the rubber warms"),
    DataSet("leaf_spring", "single", leaf_spring, ("nonlinear_stiffness@spring",), says="a spring that hardens"),
    DataSet(
        "pneumatic_cylinder",
        "pair",
        pneumatic_cylinder,
        ("coulomb_friction@cylinder", "nonlinear_stiffness@cylinder"),
        says="dry seals and air cushions",
    ),
)
