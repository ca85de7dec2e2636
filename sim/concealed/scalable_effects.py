"""What can be planted in a concealed case: for every family of cases the effects, how each grows with its size, its label.

A size of 1 is middling; the generator scales it until the mismatch has the wanted rho. `parameters` are the planted ones;
`compared` names those whose meaning does not depend on the formula, so that a finder's values can be held against them;
`equivalents` are what other words than the generator's would say.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

Make = Callable[[float], dict[str, float]]
FASTEST_MODE_HZ = 15.0


@dataclass(frozen=True)
class ScalableEffect:
    """One effect at one place. `same`: ids that denote the same equation there; `form`: for what no library lists.

    signed: the size may be negative; late: it may begin within the first recording.
    """

    id: str
    port: str
    make: Make
    compared: tuple[str, ...] = ()
    same: tuple[str, ...] = ()
    signed: bool = False
    late: bool = False
    form: str = ""
    says: str = ""

    def names(self) -> tuple[str, ...]:
        """All ids that say the truth."""
        return (self.id, *self.same)


def equivalents(effect: ScalableEffect, planted: Mapping[str, float], gain: float, start_s: float) -> dict[str, float]:
    """Planted values in the words of docs/diagnosis.md where those are not the generator's. `gain`: of the place's link."""
    if effect.id == "compliance":
        return {"compliance_rad_per_Nm": gain * planted["compliance_rad_per_Nm"]}
    if effect.id == "sensor_scale":
        return {"gain_error": planted["gain"] - 1.0}
    if effect.id == "stribeck_friction" and "static_force_N" in planted:
        return {"static_excess_N": planted["static_force_N"] - planted["kinetic_force_N"]}
    if effect.id == "sensor_bias" and start_s == 0.0:
        return {f"offset_{name}": value for name, value in planted.items()}
    return {}


def _one(name: str, size: float, **fixed: float) -> Make:
    """A maker whose parameter `name` is proportional to the size."""
    return lambda s: {name: size * s, **fixed}


def _mode(s: float) -> dict[str, float]:
    """A mode of vibration, slower with its size. Raises ValueError for one that 40 Hz recordings cannot show."""
    if 4.0 / s > FASTEST_MODE_HZ:
        raise ValueError(f"frequency_Hz: found {4.0 / s:.3g}, wanted at most {FASTEST_MODE_HZ}")
    return {"frequency_Hz": 4.0 / s, "damping_ratio": 0.12}


def _axis(port: str, unit: str, load: str, stiffness: tuple[str, float], size: float, reach: float) -> list[ScalableEffect]:
    """Effects on one motion; `size` a middling effect, `reach` the usual amplitude, both in `unit`."""
    k_name, k = f"stiffness_{stiffness[0]}", stiffness[1]
    return [
        ScalableEffect("backlash", port, _one(f"width_{unit}", size), (f"width_{unit}",)),
        ScalableEffect(
            "presliding_friction",
            port,
            lambda s: {load: k * size * s, f"distance_{unit}": max(1.2 * size * s, 1e-6), k_name: k},
        ),
        ScalableEffect("rate_lag", port, _one("time_constant_s", 0.05), ("time_constant_s",), ("viscous_friction",)),
        ScalableEffect("latency", port, lambda s: {"delay_s": min(0.04 * s, 1.0)}, ("delay_s",)),
        ScalableEffect("clock_drift", port, lambda s: {"rate": min(5e-4 * s, 0.1)}, ("rate",), late=True),
        ScalableEffect("creep_relaxation", port, lambda s: {"share": min(0.08 * s, 0.9), "time_constant_s": 1.5}, (), ()),
        ScalableEffect("softening", port, lambda s: {"rate_per_s": min(5e-4 * s, 1.0)}, (), ()),
        ScalableEffect("asymmetry", port, lambda s: {"ratio": 1.0 - min(0.12 * s, 0.8), f"centre_{unit}": 0.0}),
        ScalableEffect(
            "static_nonlinearity",
            port,
            lambda s: {f"scale_{unit}": 0.6 * reach, "share": float(np.clip(0.06 * s, -0.5, 0.5))},
            signed=True,
        ),
        ScalableEffect("saturation", port, lambda s: {f"limit_{unit}": reach * 1.15 / (1.0 + 0.35 * s)}),
        ScalableEffect(
            "periodic_disturbance",
            port,
            _one(f"amplitude_{unit}", 0.3 * size, **{"frequency_Hz": 0.0, f"pitch_{unit}": 0.35 * reach}),
            (f"amplitude_{unit}",),
        ),
        ScalableEffect("resonance", port, _mode, ("frequency_Hz",)),
    ]


_INSERTION = _axis("insertion", "m", "force_N", ("N_per_m", 2000.0), 1e-3, 4e-3)
_ROLL = _axis("roll", "rad", "torque_Nm", ("Nm_per_rad", 1.25e-3), 0.1, 1.2)
_KNOB = _axis("knob", "rad", "force_N", ("N_per_rad", 8.0), 0.05, 0.6)
_ROLL_ONLY = [
    ScalableEffect("whip", "roll", lambda s: {"amplitude_rad": min(0.2 * s, 0.9), "phase_rad": 0.7}, ("amplitude_rad",))
]
_KNOB_ONLY = [
    ScalableEffect("dead_zone", "knob", _one("half_width_rad", 0.04, centre_rad=0.0), ("half_width_rad",)),
    ScalableEffect("load_dependent_friction", "knob", lambda s: {"coefficient": min(0.03 * s, 2.0)}),
]
_COUPLED = [
    ScalableEffect("coupling", "insertion", _one("gain", 5e-4, source=1.0), ("gain",), signed=True),
    ScalableEffect("coupling", "roll", _one("gain", 20.0, source=0.0), ("gain",), signed=True),
    ScalableEffect("coupling", "knob", _one("gain", 8.0, source=0.0), ("gain",), signed=True),
]
_LOADS = [
    ScalableEffect(
        "gravity_load",
        "shape",
        lambda s: {"weight_N_per_m": 0.1 * s, "tip_weight_N": 0.002 * s, "x": 0.6, "y": -0.8, "z": 0.0},
    ),
    ScalableEffect(
        "second_contact",
        "shape",
        lambda s: {"place_m": 0.02, "clearance_m": 0.0028, "stiffness_N_per_m": 30.0 * s, "x": 0.0, "y": -1.0, "z": 0.0},
    ),
    ScalableEffect(
        "flow_drag",
        "shape",
        lambda s: {
            "speed_m_per_s": min(0.35 * np.sqrt(s), 4.9),
            "pulsatility": 0.5,
            "frequency_Hz": 1.1,
            "x": 1.0,
            "y": 0.2,
            "z": 0.0,
        },
        ("frequency_Hz",),
    ),
    ScalableEffect("creep_relaxation", "shape", lambda s: {"share": min(0.3 * s, 5.0), "time_constant_s": 2.0}),
]
_CONTACT = [
    ScalableEffect(
        "contact_nonlinear", "contact", lambda s: {"exponent": 1.0 + min(0.4 * s, 3.0), "exponential_depth_m": 0.0}
    ),
    ScalableEffect(
        "contact_viscous",
        "contact",
        lambda s: {"hunt_crossley_s_per_m": 30.0 * s, "relaxing_N_per_m": 200.0 * s, "relaxation_s": 0.4},
    ),
    ScalableEffect(
        "contact_friction",
        "contact",
        lambda s: {"coefficient": min(0.15 * s, 3.0), "bristle_N_per_m": 2000.0},
        ("coefficient",),
    ),
    ScalableEffect(
        "periodic_disturbance",
        "contact",
        lambda s: {"amplitude_m": min(2e-4 * s, 0.01), "frequency_Hz": 1.9, "phase_rad": 0.0},
        ("frequency_Hz",),
        late=True,
    ),
]
_SENSORS = [
    ScalableEffect("latency", "pose_sensor", lambda s: {"delay_s": min(0.04 * s, 0.8)}, ("delay_s",)),
    ScalableEffect("rate_lag", "pose_sensor", _one("time_constant_s", 0.04), ("time_constant_s",)),
    ScalableEffect("clock_drift", "pose_sensor", lambda s: {"rate": min(4e-4 * s, 0.1)}, ("rate",)),
    ScalableEffect(
        "sensor_drift",
        "pose_sensor",
        lambda s: {"x_m_per_s": 1e-5 * s, "y_m_per_s": 1.5e-5 * s, "z_m_per_s": 0.0, "time_constant_s": 400.0},
        signed=True,
        late=True,
    ),
    ScalableEffect(
        "field_distortion",
        "pose_sensor",
        lambda s: {"amplitude_m": min(1.5e-3 * s, 0.1), "x_m": 0.02, "y_m": 0.01, "z_m": 0.05, "reach_m": 0.025},
    ),
    ScalableEffect("sensor_scale", "pose_sensor", lambda s: {"gain": 1.0 + 0.03 * s}, signed=True),
    ScalableEffect(
        "periodic_disturbance",
        "pose_sensor",
        lambda s: {"amplitude_m": 3e-4 * s, "frequency_Hz": 3.1, "axis": 0.0},
        ("frequency_Hz", "amplitude_m"),
        late=True,
    ),
    ScalableEffect("quantization", "pose_sensor", lambda s: {"step_m": max(4e-4 * s, 1e-9)}, ("step_m",)),
    ScalableEffect(
        "sensor_bias",
        "force_sensor",
        lambda s: {"x_N": 2e-3 * s, "y_N": 1e-3 * s, "z_N": 3e-3 * s},
        signed=True,
        late=True,
    ),
    ScalableEffect(
        "sensor_drift",
        "force_sensor",
        lambda s: {"x_N_per_s": 0.0, "y_N_per_s": 2e-5 * s, "z_N_per_s": 1e-4 * s, "time_constant_s": 400.0},
        signed=True,
        late=True,
    ),
    ScalableEffect(
        "sensor_misalignment", "force_sensor", lambda s: {"x_rad": 0.12 * s, "y_rad": -0.08 * s, "z_rad": 0.0}, signed=True
    ),
    ScalableEffect("latency", "force_sensor", lambda s: {"delay_s": min(0.08 * s, 0.8)}, ("delay_s",)),
    ScalableEffect("creep_relaxation", "force_sensor", lambda s: {"share": min(0.2 * s, 0.94), "time_constant_s": 1.5}),
    ScalableEffect(
        "base_motion",
        "base",
        lambda s: {
            "x_m": 3e-4 * s,
            "y_m": -2e-4 * s,
            "z_m": 2e-4 * s,
            "x_rad": 0.01 * s,
            "y_rad": 0.004 * s,
            "z_rad": 0.0,
            "frequency_Hz": 0.31,
            "rise_s": 2.0,
        },
        ("frequency_Hz",),
    ),
    ScalableEffect(
        "base_motion",
        "base",
        lambda s: {
            "x_m": 3e-4 * s,
            "y_m": 4e-4 * s,
            "z_m": 2e-4 * s,
            "x_rad": 0.008 * s,
            "y_rad": 0.01 * s,
            "z_rad": 0.0,
            "frequency_Hz": 0.0,
            "rise_s": 1.5,
        },
        signed=True,
        late=True,
    ),
]
RIG = [*_INSERTION, *_ROLL, *_ROLL_ONLY, *_KNOB, *_KNOB_ONLY, *_COUPLED, *_LOADS, *_CONTACT, *_SENSORS]

_LOADED = [
    ScalableEffect("compliance", "roll", _one("compliance_rad_per_Nm", 100.0)),
    ScalableEffect(
        "load_dependent_friction", "roll", lambda s: {"coefficient": min(0.2 * s, 5.0), "stiffness_Nm_per_rad": 1.25e-3}
    ),
]
TRANSMISSION = [
    *_ROLL,
    *_ROLL_ONLY,
    *_KNOB,
    *_KNOB_ONLY,
    *_LOADED,
    ScalableEffect("coupling", "roll", _one("gain", 0.1, source=2.0), ("gain",), signed=True),
    ScalableEffect("coupling", "knob", _one("gain", 0.05, source=1.0), ("gain",), signed=True),
]

_DRY = [
    ScalableEffect("coulomb_friction", "", _one("force_N", 0.3), ("force_N",)),
    ScalableEffect("presliding_friction", "", _one("force_N", 0.4, distance_m=4e-3)),
    ScalableEffect(
        "stribeck_friction",
        "",
        lambda s: {"static_force_N": 0.5 * s, "kinetic_force_N": 0.25 * s, "speed_m_per_s": 0.01},
        ("kinetic_force_N",),
    ),
]
_PLAIN = [
    ScalableEffect("periodic_disturbance", "", _one("amplitude_N", 0.15, frequency_Hz=1.7), ("frequency_Hz", "amplitude_N")),
    ScalableEffect("latency", "", lambda s: {"delay_s": min(0.02 * s, 0.5)}, ("delay_s",)),
    ScalableEffect("sensor_drift", "", _one("rate_per_s", 1.0), signed=True),
]
AXIS = [
    *_DRY,
    *_PLAIN,
    ScalableEffect(
        "nonlinear_stiffness", "", _one("cubic_N_per_m3", 6e3), ("cubic_N_per_m3",), ("static_nonlinearity",), signed=True
    ),
    ScalableEffect("dead_zone", "", _one("half_width_N", 0.2), ("half_width_N",)),
    ScalableEffect("saturation", "", lambda s: {"limit_N": 2.6 / (1.0 + 0.4 * s)}),
]
IMPEDANCE = [
    *_DRY,
    *_PLAIN,
    ScalableEffect(
        "contact_nonlinear",
        "",
        _one("stiffness_N_per_m", 40.0, depth_m=0.012),
        (),
        ("nonlinear_stiffness", "static_nonlinearity"),
    ),
    ScalableEffect("creep_relaxation", "", _one("share", 0.3, time_constant_s=0.9), (), ("contact_viscous",)),
]


def _unlisted(port: str, says: str, form: str, size: float) -> ScalableEffect:
    return ScalableEffect("unlisted", port, _one("size", size), form=form, says=says)


_ROLL_COLUMN, _KNOB_COLUMN, _INSERTION_COLUMN = "handle_roll_rad", "handle_knob_rad", "handle_insertion_m"
RIG_UNLISTED = [
    _unlisted("insertion", "insertion moves with the product of roll and knob", f"{_ROLL_COLUMN} * {_KNOB_COLUMN}", 1e-3),
    _unlisted("insertion", "insertion goes up and down with the knob", f"sin({_KNOB_COLUMN} / 0.15)", 4e-4),
    _unlisted("knob", "the knob's gain depends on the roll angle", f"{_KNOB_COLUMN} * cos({_ROLL_COLUMN})", 0.08),
    _unlisted("knob", "the knob's gain depends on insertion", f"{_KNOB_COLUMN} * {_INSERTION_COLUMN}", 20.0),
    _unlisted(
        "roll",
        "roll is carried along by the square of the knob's speed",
        f"rate({_KNOB_COLUMN}) * abs(rate({_KNOB_COLUMN}))",
        0.15,
    ),
    _unlisted("knob", "the knob follows the roll through a gap", f"play({_ROLL_COLUMN}, 0.5)", 0.03),
]
TRANSMISSION_UNLISTED = [
    _unlisted("roll", "output moves with the product of both inputs", "motor_a_rad * motor_b_rad", 0.15),
    _unlisted("knob", "gain depends on the other angle", "motor_b_rad * cos(2 * motor_a_rad)", 0.06),
    _unlisted(
        "knob",
        "output is carried along by the square of the other's speed",
        "rate(motor_a_rad) * abs(rate(motor_a_rad))",
        0.02,
    ),
]
_FORMS = {
    "quadratic drag": "{v} * abs({v})",
    "damping that grows with the square of the place": "{x} ** 2 * {v}",
    "a force with place and speed's size": "{x} * abs({v})",
}
AXIS_UNLISTED = [
    _unlisted("", says, form.format(x="position_m", v="rate(position_m)"), size)
    for (says, form), size in zip(_FORMS.items(), (10.0, 4e3, 100.0), strict=True)
]
IMPEDANCE_UNLISTED = [
    _unlisted("", says, form.format(x="motion_m", v="rate(motion_m)"), size)
    for (says, form), size in zip(_FORMS.items(), (10.0, 4e3, 100.0), strict=True)
]

EFFECTS: Mapping[str, list[ScalableEffect]] = {
    "rig": RIG,
    "transmission": TRANSMISSION,
    "axis": AXIS,
    "impedance": IMPEDANCE,
}
UNLISTED: Mapping[str, list[ScalableEffect]] = {
    "rig": RIG_UNLISTED,
    "transmission": TRANSMISSION_UNLISTED,
    "axis": AXIS_UNLISTED,
    "impedance": IMPEDANCE_UNLISTED,
}
