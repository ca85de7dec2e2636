"""Resonance: a mode of vibration between drive and reading, or added mass behind a spring."""

from __future__ import annotations

import numpy as np

from host.diagnosis.model.effect import FORCES, Array, Context, Effect, Parameter, Scale, in_form, spread
from host.diagnosis.model.operators import followed, second_order

DRIVES = (*FORCES, "V", "A", "mA")  # units of what drives a mass


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Frequency and damping ratio; form `shaft`: of a load behind a compliant shaft, with a damper parallel to its spring;
    form `share`: of a mode that takes part in only a share of the motion; form `drive`: of a load behind a compliant shaft,
    read at the drive that a force or torque moves.
    """
    if form == "drive" and s.unit not in DRIVES:
        return ()  # a motion that is imposed does not feel the load
    share = {
        "share": (Parameter("mode_share", "", (0.2,), 0.0, 1.0, linear=True),),
        "drive": (Parameter("load_ratio", "", (0.5,), 0.0, np.inf, linear=True),),
    }.get(form, ())
    return (
        *share,
        Parameter(
            "frequency",
            "Hz",
            spread(3.0 / s.duration_s, 0.3 / s.dt_s, 8),
            1.0 / s.duration_s,
            0.45 / s.dt_s,
            log=True,
            spectral=True,
        ),
        Parameter("damping_ratio", "", (0.03, 0.2), 1e-3, 2.0, log=True),
    )


def force(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Share of a mass behind a spring, its frequency and damping ratio."""
    return (
        Parameter("mass_share", "", (0.1,), 1e-3, 5.0, log=True),
        Parameter(
            "frequency",
            "Hz",
            spread(5.0 / s.duration_s, 0.25 / s.dt_s, 6),
            1.0 / s.duration_s,
            0.45 / s.dt_s,
            log=True,
            spectral=True,
        ),
        Parameter("damping_ratio", "", (0.05,), 1e-3, 2.0, log=True),
    )


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Second-order low pass with a peak, of all of the motion or of a share; the motion of a load behind a shaft, or its
    reaction on the drive.
    """
    if not form:
        return of_mode(signal, c, p[0], p[1], c.start, c.start_rate)
    if form == "shaft":
        return of_shaft(signal, c, p[0], p[1], c.start, c.start_rate)
    part = -p[0] if form == "drive" else p[0]  # of the mode in the signal, from which its start is read
    start, rate = (s / part if abs(part) > 1e-3 else 0.0 for s in (c.start, c.start_rate))
    moved = of_mode(signal, c, p[1], p[2], start, rate)
    if form == "drive":
        turned = moved + p[2] / (np.pi * p[1]) * np.gradient(moved, c.dt_s)  # the damper turns the load as well
        return np.asarray(signal + p[0] * (signal - turned))
    return np.asarray(signal + p[0] * (moved - signal))


def of_mode(signal: Array, c: Context, frequency_Hz: float, damping_ratio: float, start: float, rate: float) -> Array:
    """Motion behind a mode of unit gain."""
    omega = 2.0 * np.pi * frequency_Hz
    return second_order(signal, c.dt_s, 2.0 * damping_ratio / omega, 1.0 / omega**2, start, rate)


def of_shaft(signal: Array, c: Context, frequency_Hz: float, damping_ratio: float, start: float, rate: float) -> Array:
    """Motion of a load that a spring and a damper move together."""
    omega = 2.0 * np.pi * frequency_Hz
    return followed(signal, c.dt_s, 2.0 * damping_ratio / omega, 1.0 / omega**2, start, rate)


def slots(p: Array, form: str) -> dict[str, float]:
    """A second mass on a spring."""
    return {"second_mass": p[0], "second_omega": 2.0 * np.pi * p[1], "second_damping": p[2]}


def from_mode(mode: dict[str, float]) -> tuple[dict[str, float], float] | None:
    """Start values from a mode in which a share of the drive's motion takes part, or a load on the drive; and by how long
    (s) that mode is late when the motion is slow. None for a resonance of other parameters: a mass, or one with a dead time.
    """
    if "damping_ratio" not in mode:
        return None
    share, damping_ratio = mode.get("mode_share", mode.get("load_ratio", 1.0)), mode["damping_ratio"]
    late_s = share * damping_ratio / (np.pi * mode["frequency"])
    return {"mass_share": share, "frequency": mode["frequency"], "damping_ratio": damping_ratio}, late_s


def added_mass(s: Scale, form: str) -> tuple[Parameter, ...]:
    """A mass on the measured motion, in the unit of the force per acceleration."""
    return (
        Parameter(
            "mass", f"{s.unit} s2/{s.motion_unit}", (s.need / (s.speed**2 / s.motion_span),), 0.0, np.inf, linear=True
        ),
    )


def slots_of_mass(p: Array, form: str) -> dict[str, float]:
    """A force in proportion to the acceleration."""
    return {"added_mass": p[0]}


# Two masses on a spring k and damper d: the drive follows its force as the rigid pair does, times
# 1 + ratio s^2 / (s^2 + 2 z w s + w^2), ratio = load / drive mass, w^2 = k (1/m1 + 1/m2) (Ellis, Control System Design
# Guide, 2012, chapter 16).
_MODE = "m'' + 2 z w m' + w^2 m = w^2 x"
_WHOLE = tuple(
    Effect(
        "resonance",
        port,
        63,
        parameters,
        says,
        f"{_MODE},  y = m",
        apply,
        timed=True,
        contains=("rate_lag",),
        remembers=True,
        begins_with_speed=True,
        invariant=True,
    )
    for port, says in (
        ("motion", "The output oscillates at {frequency}, damping ratio {damping_ratio}."),
        (
            "mode",
            "A spring connects the drive with the measured output; it oscillates at {frequency}, damping ratio "
            "{damping_ratio}.",
        ),
    )
)
EFFECTS = (
    *(
        each
        for whole in _WHOLE
        for each in (
            whole,
            in_form(
                whole,
                "shaft",
                "A load turns on a spring and a damper; it oscillates at {frequency}, damping ratio {damping_ratio}.",
                f"{_MODE},  y = m + 2 z/w m'",
            ),
            in_form(
                whole,
                "share",
                "A mode at {frequency}, damping ratio {damping_ratio}, takes a share of {mode_share} of the motion.",
                f"{_MODE},  y = x + mode_share*(m - x)",
            ),
            in_form(
                whole,
                "drive",
                "A load, {load_ratio} of the drive's mass, oscillates on it at {frequency}, damping ratio {damping_ratio}.",
                f"{_MODE},  y = x + load_ratio*(x - m - 2 z/w m')",
            ),
        )
    ),
    Effect(
        "resonance",
        "force",
        40,
        force,
        "A part of the mass is attached by a spring and oscillates at {frequency}.",
        "m2 x2'' = k2 (x - x2) + c2 (x' - x2')",
        slots=slots,
        filters=True,
        timed=True,
        as_mode=from_mode,
    ),
    Effect(
        "resonance",
        "inertia",
        41,
        added_mass,
        "A mass of {mass} moves along.",
        "F = mass*x''",
        slots=slots_of_mass,
        filters=True,
        timed=True,
        forms=("mass",),
        of_law=True,
    ),
)
