"""World `ode`: driven axes, motion links and pressed materials by differential equations and hysteresis operators.

Controllers act on noisy readings with milliseconds of delay. How recordings are sampled and cut: `windows`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from host.studies.proof.worlds import drive
from host.studies.proof.worlds import operators as op
from host.studies.proof.worlds.case import Columns, Mechanism, Plantable, Planted, Scales, SeparateRecordings, Setup, Trace
from host.studies.proof.worlds.windows import channels, command, fine_grid, sampling, split, times, without

Array = np.ndarray


def motion_effects(place: str, others: bool, loads: bool) -> tuple[Plantable, ...]:
    """Return effects on a motion between an input and an output."""
    found = [
        Plantable("backlash", place, lambda s, c: {"width": 0.06 * c.motion * s}, compared=("width",)),
        Plantable("presliding_friction", place, lambda s, c: {"share": min(0.3 * s, 0.9), "distance": 0.25 * c.motion}),
        Plantable(
            "rate_lag",
            place,
            lambda s, c: {"time_constant_s": 0.15 * c.slow_s * s},
            same=("viscous_friction",),
            compared=("time_constant_s",),
        ),
        Plantable(
            "latency", place, lambda s, c: {"delay_s": min(0.15 * c.slow_s * s, c.duration_s / 4)}, compared=("delay_s",)
        ),
        Plantable(
            "creep_relaxation", place, lambda s, c: {"share": min(0.1 * s, 0.7), "time_constant_s": c.duration_s / 8.0}
        ),
        Plantable("saturation", place, lambda s, c: {"limit": 1.1 * c.motion / (1.0 + 0.3 * s)}),
        Plantable(
            "static_nonlinearity",
            place,
            lambda s, c: {"share": float(np.clip(0.2 * s, -0.8, 0.8)), "scale": c.motion / 3.0},
            signed=True,
        ),
        Plantable("dead_zone", place, lambda s, c: {"half_width": 0.05 * c.motion * s}, compared=("half_width",)),
        Plantable(
            "asymmetry",
            place,
            lambda s, c: {"ratio": float(np.clip(0.1 * s, -0.8, 0.8))},
            same=("static_nonlinearity",),
            signed=True,
        ),
        Plantable("periodic_disturbance", place, lambda s, c: {"amplitude": 0.03 * c.motion * s, "pitch": 0.45 * c.motion}),
        Plantable(
            "resonance",
            place,
            lambda s, c: {"frequency_Hz": 1.2 / (c.slow_s * max(s, 0.05) ** 0.5), "damping_ratio": 0.15},
            compared=("frequency_Hz",),
        ),
        Plantable("softening", place, lambda s, c: {"rate_per_s": min(0.05 * s, 3.0) / c.duration_s}),
        Plantable(
            "missed_steps", place, lambda s, c: {"step": 0.05 * c.motion * s, "times": float(1 + round(2 * min(s, 1.0)))}
        ),
        Plantable("sensor_drift", place, lambda s, c: {"drift": 0.1 * c.motion * s}, signed=True),
    ]
    if others:
        found.append(Plantable("coupling", place, lambda s, c: {"gain": 0.05 * s}, signed=True))
    if loads:
        found.append(Plantable("compliance", place, lambda s, c: {"deflection": 0.1 * c.motion * s}))
    return tuple(found)


def _unlisted(place: str) -> tuple[Plantable, ...]:
    """Return effects that no entry of the vocabulary says."""
    words = (
        ("product", "the motion is modulated by the other input"),
        ("fractional", "a share of the motion is its derivative of order one half"),
        ("other_squared", "the other input's speed, squared, carries the output along"),
    )
    return tuple(
        Plantable("unlisted", place, lambda s, c, key=key: {key: 0.08 * s}, signed=True, says=says)  # type: ignore[misc]
        for key, says in words
    )


def moved(x: Array, other: Array, load: Array, h: float, time_s: Array, planted: Sequence[Planted], c: Scales) -> Array:
    """Return the motion x (n,) on an even grid after all planted effects, in their order of planting."""
    for one in planted:
        x = _move(x, other, load, h, time_s, one, c)
    return x


def _move(x: Array, other: Array, load: Array, h: float, time_s: Array, one: Planted, c: Scales) -> Array:
    q, name = one.parameters, one.effect.id
    simple = {
        "backlash": lambda: op.play(x, q["width"]),
        "presliding_friction": lambda: op.prandtl_ishlinskii(x, q["share"], q["distance"]),
        "rate_lag": lambda: op.lag(x, h, q["time_constant_s"]),
        "latency": lambda: op.delayed(x, h, q["delay_s"]),
        "creep_relaxation": lambda: op.creep(x, h, q["share"], q["time_constant_s"]),
        "saturation": lambda: op.saturated(x, q["limit"]),
        "static_nonlinearity": lambda: x + q["share"] * (q["scale"] * np.arcsinh(x / q["scale"]) - x),
        "dead_zone": lambda: op.dead_zone(x, q["half_width"]),
        "asymmetry": lambda: x * (1.0 + q["ratio"] * (x > 0.0)),
        "periodic_disturbance": lambda: x + q["amplitude"] * np.sin(2.0 * np.pi * x / q["pitch"] + 0.7),
        "resonance": lambda: op.mode(x, h, q["frequency_Hz"], q["damping_ratio"]),
        "softening": lambda: x / (1.0 + q["rate_per_s"] * np.maximum(time_s, 0.0)),
        "missed_steps": lambda: x + q["step"] * _lost_steps(time_s, int(q["times"]), c.duration_s),
        "sensor_drift": lambda: x + q["drift"] * (1.0 - np.exp(-np.maximum(time_s, 0.0) / (0.7 * c.duration_s))),
        "coupling": lambda: x + q["gain"] * other,
        "compliance": lambda: x + q["deflection"] * load,
    }
    if name in simple:
        return np.asarray(simple[name]())
    if "product" in q:
        return np.asarray(x * (1.0 + q["product"] * other / c.motion))
    if "fractional" in q:
        return x + q["fractional"] * _half_derivative(x, h, c)
    rate = np.gradient(other, h) * c.slow_s
    return np.asarray(x + q["other_squared"] * rate * np.abs(rate) / c.motion)


def _lost_steps(time_s: Array, times: int, duration_s: float) -> Array:
    at = duration_s * (np.arange(times) + 0.6) / (times + 0.5)
    return np.asarray(np.sum(np.greater.outer(time_s, at), axis=1).astype(float))


def _half_derivative(x: Array, h: float, c: Scales) -> Array:
    """Return the derivative of order 1/2 over five decades, by lags in geometric spacing, in units of x."""
    total = np.zeros_like(x)
    for tau in c.slow_s * np.geomspace(0.1, 30.0, 8):
        total += (x - op.lag(x, h, tau)) / np.sqrt(tau / c.slow_s)
    return total / 8.0


class Link(SeparateRecordings):
    """Motion in, motion out: output = gain * input + offset."""

    name: str = "link"
    outputs: tuple[str, ...] = ("output_m",)
    effects: tuple[Plantable, ...] = motion_effects("link", others=True, loads=True)
    outside: tuple[Plantable, ...] = _unlisted("link")

    def draw(self, rng: np.random.Generator, closed_loop: bool) -> Setup:
        """Draw gain, offset, sampling and noise."""
        scales, stamps, fastest = sampling(rng)
        motion = float(np.exp(rng.uniform(np.log(1e-3), np.log(0.3))))
        scales = Scales(motion, float(rng.uniform(1.0, 30.0)), motion / scales.slow_s, *times(scales))
        gain = float(rng.uniform(0.3, 3.0)) * (1 if rng.random() < 0.7 else -1)
        sigma = {"output_m": abs(gain) * motion * float(np.exp(rng.uniform(np.log(1e-3), np.log(1e-2))))}
        parameters = {"gain": gain, "offset": 0.1 * motion * float(rng.standard_normal())}
        style = {"fastest_Hz": fastest, "late_s": float(rng.uniform(1e-3, 8e-3)), "begin_s": float(rng.uniform(0.0, 100.0))}
        lost = float(rng.uniform(0.002, 0.02)) if rng.random() < 0.4 else 0.0
        return Setup.drawn(rng, scales, stamps, closed_loop, sigma, parameters, style, lost=lost)

    def _one(self, setup: Setup, planted: Sequence[Planted], i: int) -> Trace:
        grid, h = fine_grid(setup, i)
        c, p, stamps = setup.scales, setup.parameters, setup.stamps[i]
        wanted, other = (c.motion * command(setup, i, k)(grid) for k in (0, 1))
        load = command(setup, i, 2)(grid)

        def forward(x: Array) -> Array:
            return np.asarray(p["gain"] * moved(x, other, load, h, grid, planted, c) + p["offset"])

        x = wanted
        if setup.closed_loop:
            x = looped(wanted, forward, setup, i, grid, h, "output_m")
        columns = {"input_m": x, "other_m": other, "load_N": c.force * load, "output_m": forward(x)}
        return Trace({name: np.interp(stamps, grid, values) for name, values in columns.items()})

    def left(self, setup: Setup, traces: Sequence[Trace]) -> list[Columns]:
        """Return what gain and offset leave."""
        x, y = ([t.channels[name] for t in traces] for name in ("input_m", "output_m"))
        columns = np.column_stack([np.concatenate(x), np.ones(sum(a.size for a in x))])
        rest = without(columns, np.concatenate(y), sum(a.size for a in x[:-1]))
        return [{"output_m": part} for part in split(rest, x)]

    def nominal(self, setup: Setup) -> dict[str, Any]:
        """Return the nominal file's content."""
        return {
            "name": "link",
            "kind": "transmission",
            "channels": channels("input_m", "other_m", "load_N", "output_m"),
            "link": [
                {"subsystem": "link", "input": "input_m", "output": "output_m", "load": ["load_N"], "others": ["other_m"]}
            ],
        }


def looped(wanted: Array, forward: Any, setup: Setup, i: int, grid: Array, h: float, channel: str) -> Array:
    """Return the input under a controller that corrects by the delayed, noisy error. Raises ValueError if unstable.

    The loop is solved by iterating over the whole window; the correction only looks back, so the limit is the loop's.
    """
    gain = setup.parameters["gain"]
    target = gain * wanted + setup.parameters.get("offset", 0.0)
    noise = np.interp(grid, setup.stamps[i], setup.noise(i, channel), left=0.0)
    x, last = wanted, np.inf
    for _ in range(12):
        error = op.delayed(target - forward(x) - noise, h, setup.style["late_s"])
        now = wanted + 0.5 * op.lag(error / gain, h, max(0.5 * setup.scales.slow_s, 2.0 * h))
        change = float(np.sqrt(np.mean((now - x) ** 2)))
        x = now
        if change < 0.02 * setup.sigma[channel] / abs(gain):
            return x
        if change > 3.0 * last:
            break
        last = change
    raise ValueError("loop: found no stable correction, wanted one that settles")


_PRESS_PLACE = "material"
_PRESS_EFFECTS = (
    Plantable("coulomb_friction", _PRESS_PLACE, lambda s, c: {"force_N": 0.05 * c.force * s}, compared=("force_N",)),
    Plantable(
        "presliding_friction", _PRESS_PLACE, lambda s, c: {"force_N": 0.08 * c.force * s, "distance": 0.25 * c.motion}
    ),
    Plantable(
        "stribeck_friction",
        _PRESS_PLACE,
        lambda s, c: {"static_N": 0.1 * c.force * s, "kinetic_N": 0.04 * c.force * s, "speed": 0.15 * c.speed},
    ),
    Plantable(
        "contact_nonlinear",
        _PRESS_PLACE,
        lambda s, c: {"force_N": 0.03 * c.force * s, "depth": 0.4 * c.motion},
        same=("nonlinear_stiffness", "static_nonlinearity"),
    ),
    Plantable(
        "creep_relaxation",
        _PRESS_PLACE,
        lambda s, c: {"share": 0.15 * s, "time_constant_s": c.duration_s / 8.0},
        same=("contact_viscous",),
    ),
    Plantable("load_dependent_friction", _PRESS_PLACE, lambda s, c: {"coefficient": 0.05 * s}, compared=("coefficient",)),
    Plantable("latency", _PRESS_PLACE, lambda s, c: {"delay_s": 0.2 * c.slow_s * s}, compared=("delay_s",)),
    Plantable("sensor_drift", _PRESS_PLACE, lambda s, c: {"drift": 0.1 * c.force * s}, signed=True),
    Plantable("saturation", _PRESS_PLACE, lambda s, c: {"limit": 1.1 * c.force / (1.0 + 0.3 * s)}),
    Plantable(
        "periodic_disturbance",
        _PRESS_PLACE,
        lambda s, c: {"amplitude": 0.03 * c.force * s, "frequency_Hz": 0.4 / c.slow_s},
        compared=("frequency_Hz",),
    ),
)
_PRESS_OUTSIDE = (
    Plantable(
        "unlisted", _PRESS_PLACE, lambda s, c: {"place_speed": 0.2 * s}, says="force goes with place and speed's size"
    ),
    Plantable(
        "unlisted", _PRESS_PLACE, lambda s, c: {"place_damping": 0.3 * s}, says="damping grows with the place squared"
    ),
    Plantable(
        "unlisted", _PRESS_PLACE, lambda s, c: {"load_place": 0.1 * s}, signed=True, says="stiffness goes with the load"
    ),
)


class Press(SeparateRecordings):
    """Motion in, force out: force = damping * speed + stiffness * motion + offset."""

    name: str = "press"
    outputs: tuple[str, ...] = ("force_N",)
    effects: tuple[Plantable, ...] = _PRESS_EFFECTS
    outside: tuple[Plantable, ...] = _PRESS_OUTSIDE

    def draw(self, rng: np.random.Generator, closed_loop: bool) -> Setup:
        """Draw stiffness, damping, sampling and noise."""
        scales, stamps, fastest = sampling(rng)
        motion, force = (float(np.exp(rng.uniform(np.log(a), np.log(b)))) for a, b in ((5e-4, 0.05), (0.1, 100.0)))
        scales = Scales(motion, force, motion / scales.slow_s, *times(scales))
        sigma = {"force_N": force * float(np.exp(rng.uniform(np.log(1.5e-3), np.log(1e-2)))), "motion_m": 1e-5 * motion}
        parameters = {
            "stiffness": force / motion,
            "damping": force / scales.speed * float(rng.uniform(0.02, 0.4)),
            "offset": 0.2 * force * float(rng.standard_normal()),
            "gain": force / motion,
        }
        style = {"fastest_Hz": fastest, "late_s": float(rng.uniform(1e-3, 8e-3))}
        lost = float(rng.uniform(0.002, 0.02)) if rng.random() < 0.4 else 0.0
        return Setup.drawn(rng, scales, stamps, closed_loop, sigma, parameters, style, lost=lost)

    def _one(self, setup: Setup, planted: Sequence[Planted], i: int) -> Trace:
        grid, h = fine_grid(setup, i)
        c, p = setup.scales, setup.parameters
        wanted = c.motion * command(setup, i, 0)(grid)
        load = 0.6 * c.force * (1.0 + 0.7 * command(setup, i, 2)(grid))

        def forward(x: Array) -> Array:
            v = np.gradient(x, h)
            total = p["stiffness"] * x + p["damping"] * v + p["offset"]
            for one in planted:
                total = total + _pressed(x, v, load, h, grid, one, setup)
            for one in planted:
                total = _read(total, h, grid, one, c)
            return np.asarray(total)

        x = looped(wanted, forward, setup, i, grid, h, "force_N") if setup.closed_loop else wanted
        columns = {"motion_m": x, "load_N": load, "force_N": forward(x)}
        stamps = setup.stamps[i]
        return Trace(
            {name: np.interp(stamps, grid, values) for name, values in columns.items()},
            {"v": np.interp(stamps, grid, np.gradient(x, h))},
        )

    def left(self, setup: Setup, traces: Sequence[Trace]) -> list[Columns]:
        """Return what stiffness, damping and offset leave."""
        x = [t.channels["motion_m"] for t in traces]
        columns = np.column_stack(
            [np.concatenate(x), np.concatenate([t.hidden["v"] for t in traces]), np.ones(sum(a.size for a in x))]
        )
        force = np.concatenate([t.channels["force_N"] for t in traces])
        rest = without(columns, force, sum(a.size for a in x[:-1]))
        return [{"force_N": part} for part in split(rest, x)]

    def nominal(self, setup: Setup) -> dict[str, Any]:
        """Return the nominal file's content."""
        return {
            "name": "pressed material",
            "kind": "impedance",
            "channels": channels("motion_m", "load_N", "force_N"),
            "impedance": {
                "subsystem": _PRESS_PLACE,
                "input": "motion_m",
                "output": "force_N",
                "others": ["load_N"],
                "load": [],
                "terms": ["damping", "stiffness", "offset"],
            }
            | ({"load": ["load_N"], "others": []} if setup.seed % 2 else {}),
        }


def _pressed(x: Array, v: Array, load: Array, h: float, time_s: Array, one: Planted, setup: Setup) -> Array:
    """Return the force (n,) that one effect adds."""
    q, c, name = one.parameters, setup.scales, one.effect.id
    sign = np.tanh(v / (0.004 * c.speed))
    forces = {
        "coulomb_friction": lambda: q["force_N"] * sign,
        "presliding_friction": lambda: q["force_N"] * op.maxwell_slip(x, q["distance"]),
        "stribeck_friction": lambda: (
            (q["kinetic_N"] + (q["static_N"] - q["kinetic_N"]) / (1.0 + (v / q["speed"]) ** 2)) * sign
        ),
        "contact_nonlinear": lambda: (
            q["force_N"] * (np.exp(np.maximum(x, 0.0) / q["depth"]) - 1.0 - np.maximum(x, 0.0) / q["depth"])
        ),
        "creep_relaxation": lambda: q["share"] * c.force / c.motion * (x - op.creep(x, h, 1.0, q["time_constant_s"])),
        "load_dependent_friction": lambda: q["coefficient"] * load * sign,
        "periodic_disturbance": lambda: q["amplitude"] * np.sin(2.0 * np.pi * q["frequency_Hz"] * time_s),
        "sensor_drift": lambda: q["drift"] * (1.0 - np.exp(-np.maximum(time_s, 0.0) / (0.7 * c.duration_s))),
    }
    if name in forces:
        return np.asarray(forces[name]())
    size = c.force * x / c.motion
    for key, shape in (("place_speed", np.abs(v) / c.speed), ("place_damping", x * v / (c.motion * c.speed))):
        if key in q:
            return np.asarray(q[key] * size * shape)
    return q["load_place"] * size * load / c.force if "load_place" in q else np.zeros_like(x)


def _read(force: Array, h: float, time_s: Array, one: Planted, c: Scales) -> Array:
    """Return the force as the sensor gives it."""
    if one.effect.id == "latency":
        return op.delayed(force, h, one.parameters["delay_s"])
    return op.saturated(force, one.parameters["limit"]) if one.effect.id == "saturation" else force


_AXIS_PLACE = "axis"
_SLIP = 3e-3  # share of the usual speed below which dry friction is not yet full
_DRY = (
    Plantable(
        "coulomb_friction",
        _AXIS_PLACE,
        lambda s, c: {"force_N": 0.05 * c.force * s, "v0": _SLIP * c.speed},
        compared=("force_N",),
    ),
    Plantable("presliding_friction", _AXIS_PLACE, lambda s, c: {"force_N": 0.08 * c.force * s, "distance": 0.2 * c.motion}),
    Plantable(
        "stribeck_friction",
        _AXIS_PLACE,
        lambda s, c: {
            "static_N": 0.12 * c.force * s,
            "kinetic_N": 0.05 * c.force * s,
            "speed": 0.12 * c.speed,
            "v0": _SLIP * c.speed,
        },
    ),
    Plantable(
        "periodic_disturbance",
        _AXIS_PLACE,
        lambda s, c: {"amplitude_N": 0.05 * c.force * s, "frequency_Hz": 0.35 / (2.0 * np.pi * c.slow_s)},
        compared=("frequency_Hz", "amplitude_N"),
    ),
    Plantable("latency", _AXIS_PLACE, lambda s, c: {"delay_s": 0.1 * c.slow_s * s}, compared=("delay_s",)),
    Plantable("rate_lag", _AXIS_PLACE, lambda s, c: {"time_constant_s": 0.1 * c.slow_s * s}, compared=("time_constant_s",)),
    Plantable("dead_zone", _AXIS_PLACE, lambda s, c: {"half_width_N": 0.05 * c.force * s}, compared=("half_width_N",)),
    Plantable("saturation", _AXIS_PLACE, lambda s, c: {"limit_N": 1.1 * c.force / (1.0 + 0.3 * s)}),
    Plantable(
        "resonance",
        _AXIS_PLACE,
        lambda s, c: {"share": min(0.1 * s, 1.0), "frequency_Hz": 1.5 / (2.0 * np.pi * c.slow_s), "damping_ratio": 0.1},
    ),
)
_SPRUNG = (
    Plantable(
        "nonlinear_stiffness",
        _AXIS_PLACE,
        lambda s, c: {"force_N": 0.05 * c.force * s, "scale": 0.4 * c.motion},
        same=("static_nonlinearity",),
    ),
    Plantable("creep_relaxation", _AXIS_PLACE, lambda s, c: {"share": 0.15 * s, "time_constant_s": c.duration_s / 8.0}),
)
_CODES = {
    "coulomb_friction": drive.COULOMB,
    "presliding_friction": drive.MAXWELL,
    "stribeck_friction": drive.STRIBECK,
    "nonlinear_stiffness": drive.HARDENING,
    "periodic_disturbance": drive.LINE,
    "creep_relaxation": drive.CREEP,
}
_AXIS_OUTSIDE = (
    Plantable("unlisted", _AXIS_PLACE, lambda s, c: {"place_speed": 0.3 * s}, says="force goes with place and speed's size"),
    Plantable("unlisted", _AXIS_PLACE, lambda s, c: {"place_damping": 0.6 * s}, says="damping grows with the place squared"),
)


class Axis(SeparateRecordings):
    """Force in, motion out: mass, damping, with or without a spring."""

    outputs: tuple[str, ...] = ("position_m",)
    effects: tuple[Plantable, ...]
    outside: tuple[Plantable, ...] = _AXIS_OUTSIDE

    def __init__(self, sprung: bool) -> None:
        """Choose between an axis with a spring and a free one."""
        self.sprung = sprung
        self.name = "axis" if sprung else "free_axis"
        self.effects = _DRY + (_SPRUNG if sprung else ())

    def draw(self, rng: np.random.Generator, closed_loop: bool) -> Setup:
        """Draw mass, damping, stiffness, sampling and noise."""
        closed_loop = closed_loop or not self.sprung  # a free axis without a controller leaves its bench
        scales, stamps, fastest = sampling(rng, jitter_allowed=not closed_loop)
        w = 1.0 / scales.slow_s
        mass, motion = (
            float(np.exp(rng.uniform(np.log(0.05), np.log(20.0)))),
            float(np.exp(rng.uniform(np.log(1e-3), np.log(0.1)))),
        )
        own = float(rng.uniform(0.5, 1.5)) * w
        stiffness = mass * own**2 if self.sprung else 0.0
        damping = 2.0 * float(rng.uniform(0.15, 0.7)) * mass * own * (1.0 if self.sprung else 0.3)
        force = 0.5 * motion * mass * (own**2 + (0.0 if self.sprung else w**2))
        scales = Scales(motion, force, motion * w, *times(scales))
        sigma = {"position_m": motion * float(np.exp(rng.uniform(np.log(1e-3), np.log(6e-3))))}
        if not self.sprung:
            sigma = {"position_m": 2e-6 * motion, "drive_N": force * float(np.exp(rng.uniform(np.log(2e-3), np.log(1e-2))))}
        parameters = {
            "mass": mass,
            "damping": damping,
            "stiffness": stiffness,
            "offset": 0.05 * force * float(rng.standard_normal()),
        }
        late = max(1, round(float(rng.uniform(1e-3, 6e-3)) / scales.period_s))
        style = {"fastest_Hz": fastest, "held": bool(closed_loop or rng.random() < 0.5), "late": late}
        lost = float(rng.uniform(0.002, 0.02)) if rng.random() < 0.3 and self.sprung else 0.0
        return Setup.drawn(rng, scales, stamps, closed_loop, sigma, parameters, style, lost=lost)

    def _one(self, setup: Setup, planted: Sequence[Planted], i: int, p: Array | None = None) -> Trace:
        c, stamps, own = setup.scales, setup.stamps[i], setup.parameters
        lead = round(min(2.0 * c.duration_s, 20.0 * c.slow_s) / c.period_s)
        time_s = np.concatenate([stamps[0] - c.period_s * np.arange(lead, 0, -1), stamps])
        law = np.array([own["mass"], own["damping"], own["stiffness"], own["offset"]]) if p is None else p
        wanted = command(setup, i, 0)(time_s) * (c.motion if setup.closed_loop else c.force)
        channel = "position_m"
        noise = np.concatenate([np.zeros(lead), setup.noise(i, channel)])
        actuator, effects = _planted_forces(planted, setup)
        out, used = drive.run(law, time_s, wanted, setup.style["held"], actuator, effects, axis_loop(setup), noise)
        if not np.all(np.isfinite(out)) or np.max(np.abs(out[:, 0])) > 20.0 * c.motion:
            raise ValueError("axis: found a motion that runs away, wanted one that stays")
        cut = out[lead:]
        return Trace({"drive_N": used[lead:], "position_m": cut[:, 0]}, {"v": cut[:, 1], "a": cut[:, 2]})

    def left(self, setup: Setup, traces: Sequence[Trace]) -> list[Columns]:
        """Return what the refitted nominal law leaves: of the force for a free axis, else of the position."""
        if not self.sprung:
            rows, force = zip(*(_over_intervals(setup, i, t) for i, t in enumerate(traces)), strict=True)
            rest = without(np.vstack(rows), np.concatenate(force), sum(len(r) for r in rows[:-1]))
            return [{"drive_N": part} for part in split(rest, [r[:, 0] for r in rows])]
        law = np.array([setup.parameters[k] for k in ("mass", "damping", "stiffness", "offset")])
        fitted = sum(t.channels["drive_N"].size for t in traces[:-1])
        for last in (False, True):
            runs = [replayed(setup, i, law, t) for i, t in enumerate(traces)]
            slopes = []
            for k in range(4):
                step = np.zeros(4)
                step[k] = 1e-4 * max(abs(law[k]), 0.05 * setup.scales.force if k == 3 else 0.0)
                ahead = [replayed(setup, i, law + step, t) for i, t in enumerate(traces)]
                slopes.append(np.concatenate([a - b for a, b in zip(ahead, runs, strict=True)]) / step[k])
            begins = _begins(setup, law, traces)
            columns = np.column_stack([*slopes, begins])
            apart = np.concatenate([t.channels["position_m"] - r for t, r in zip(traces, runs, strict=True)])
            size = np.linalg.norm(columns, axis=0) + 1e-300
            used = np.concatenate([np.ones(fitted, bool), np.zeros(apart.size - fitted, bool)])
            found = np.linalg.lstsq(columns[used] / size, apart[used], rcond=1e-10)[0] / size
            if last:
                rest = apart - columns @ found
                held = begins[~used][:, -2:]  # the held-out recording's own begin
                rest[~used] -= held @ np.linalg.lstsq(held, rest[~used], rcond=1e-10)[0]
                return [{"position_m": part} for part in split(rest, [t.channels["drive_N"] for t in traces])]
            law = law * np.clip(1.0 + found[:4] / np.where(law == 0.0, 1.0, law), 0.3, 3.0)
        raise AssertionError

    def nominal(self, setup: Setup) -> dict[str, Any]:
        """Return the nominal file's content."""
        return {
            "name": "driven axis",
            "kind": "axis",
            "channels": channels("drive_N", "position_m"),
            "axis": {
                "subsystem": _AXIS_PLACE,
                "input": "drive_N",
                "output": "position_m",
                "terms": ["mass", "damping", *(["stiffness"] if self.sprung else []), "offset"],
                "hold": "zero" if setup.style["held"] else "linear",
                "reads": "position",
            },
        }


def axis_loop(setup: Setup) -> drive.Loop:
    """Return the controller's gains: bandwidth about the fastest excitation, less where the delay would make it unstable."""
    if not setup.closed_loop:
        return drive.Loop()
    p, late_s = setup.parameters, setup.style["late"] * setup.scales.period_s
    w = min(1.0 / setup.scales.slow_s, 0.15 / max(late_s, setup.scales.period_s))
    inertia = p["mass"]
    return drive.Loop(0.5 * inertia * w * w, 0.1 * inertia * w**3, 0.8 * inertia * w, setup.style["late"])


def _planted_forces(planted: Sequence[Planted], setup: Setup) -> tuple[drive.Actuator, tuple[Array, Array]]:
    """Return the actuator, and codes and parameters of the forces."""
    c, p = setup.scales, setup.parameters
    rows: list[tuple[int, list[float]]] = []
    actuator = drive.Actuator()
    for one in planted:
        q, name = one.parameters, one.effect.id
        if name in _CODES:
            values = list(q.values())
            if name == "coulomb_friction":
                values = [q["force_N"], 0.0, 0.0, q["v0"]]
            rows.append((_CODES[name], values))
        elif name == "resonance":
            mass, w = q["share"] * p["mass"], 2.0 * np.pi * q["frequency_Hz"]
            rows.append((drive.SECOND_MASS, [mass, mass * w * w, 2.0 * q["damping_ratio"] * mass * w]))
        elif name == "unlisted":
            speed = "place_speed" in q
            value = (
                q["place_speed"] * c.force / (c.motion * c.speed)
                if speed
                else q["place_damping"] * c.force / (c.motion**2 * c.speed)
            )
            rows.append((drive.PLACE_SPEED if speed else drive.PLACE_DAMPING, [value]))
        else:
            key = {"latency": "delay_s", "rate_lag": "lag_s", "dead_zone": "dead_N", "saturation": "limit_N"}[name]
            actuator = actuator._replace(**{key: next(iter(q.values()))})
    q4 = np.zeros((len(rows), 4))
    for row, (_, values) in zip(q4, rows, strict=True):
        row[: len(values)] = values
    return actuator, (np.array([code for code, _ in rows], np.int64), q4)


_NO_EFFECTS = (np.zeros(0, np.int64), np.zeros((0, 4)))


def _over_intervals(setup: Setup, i: int, trace: Trace) -> tuple[Array, Array]:
    """Return columns (n - 1, 3) of mass, damping and offset, and the force (n - 1,), each the mean over a sampling interval.

    At the samples themselves a held force jumps: there, the shortest delay would look like one of a whole sample.
    """
    span, force = np.diff(setup.stamps[i]), trace.channels["drive_N"]
    columns = [np.diff(trace.hidden["v"]) / span, np.diff(trace.channels["position_m"]) / span, np.ones(span.size)]
    return np.column_stack(columns), force[:-1] if setup.style["held"] else 0.5 * (force[1:] + force[:-1])


def replayed(setup: Setup, i: int, law: Array, trace: Trace) -> Array:
    """Return the position (n,) of the nominal law under the recorded force, begun where the recording begins."""
    stamps, x0, v0 = setup.stamps[i], trace.channels["position_m"][0], trace.hidden["v"][0]
    force, nothing = trace.channels["drive_N"], np.zeros(stamps.size)
    out, _ = drive.run(law, stamps, force, setup.style["held"], drive.Actuator(), _NO_EFFECTS, drive.Loop(), nothing)
    rest = out[0, 0]
    free = _free(law, stamps, x0 - rest, v0 - out[0, 1])
    return np.asarray(out[:, 0] + free)


def _free(law: Array, time_s: Array, x0: float, v0: float) -> Array:
    """Return the motion (n,) of the undriven law from x0 (m) and v0 (m/s)."""
    matrix = np.array([[0.0, 1.0], [-law[2] / law[0], -law[1] / law[0]]])
    values, vectors = np.linalg.eig(matrix.astype(complex))
    weights = np.linalg.solve(vectors, np.array([x0, v0], complex))
    t = time_s - time_s[0]
    return np.asarray(np.real(np.exp(np.multiply.outer(t, values)) @ (weights * vectors[0])))


def _begins(setup: Setup, law: Array, traces: Sequence[Trace]) -> Array:
    """Return columns (n, 2 recordings): what a change of each recording's first place and speed would do."""
    total = sum(t.channels["drive_N"].size for t in traces)
    columns, at = np.zeros((total, 2 * len(traces))), 0
    for i, trace in enumerate(traces):
        n = trace.channels["drive_N"].size
        columns[at : at + n, 2 * i] = _free(law, setup.stamps[i], 1.0, 0.0)
        columns[at : at + n, 2 * i + 1] = _free(law, setup.stamps[i], 0.0, 1.0 / setup.scales.slow_s)
        at += n
    return columns


MECHANISMS: tuple[Mechanism, ...] = (Link(), Axis(sprung=True), Press(), Axis(sprung=False))
