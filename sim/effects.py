"""Planted effects: physics that the nominal plant leaves out, switched on by id and port with size and start time.

Ids are those of the vocabulary; the formulas here are chosen to differ from the models that look for them (distributed
play, LuGre and Bouc-Wen friction, Prony series, return mapping, exponential tissue, dipole fields).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from sim.effect_codes import EFFECT, IDS, PARAMETERS, PORTS

_UNIT = {"insertion": "m", "roll": "rad", "knob": "rad", "shape": "per_m"}
_LOAD = {"insertion": "force_N", "roll": "torque_Nm", "knob": "force_N", "shape": "force_N"}
_STIFFNESS = {
    "insertion": ("N_per_m", 2000.0),
    "roll": ("Nm_per_rad", 1.25e-3),
    "knob": ("N_per_rad", 8.0),
    "shape": ("N_m", 0.25),
}
_SIZE = {"insertion": 1e-3, "roll": 0.1, "knob": 0.07, "shape": 1.5}  # a middling effect in the port's unit
_BIG = 1e9


class PlantedParameter(NamedTuple):
    """One number of an effect: name with unit, default, least and greatest value."""

    name: str
    default: float
    least: float
    greatest: float


@dataclass(frozen=True)
class PlantedEffect:
    """One planted effect. Parameters left out take the catalogue's default; before `start_s` nothing happens."""

    id: str
    port: str
    parameters: Mapping[str, float] = field(default_factory=dict)
    start_s: float = 0.0

    def says(self) -> dict[str, object]:
        """The label of this effect: id, subsystem, start and the full set of parameters."""
        values = dict(zip((p.name for p in describe(self.id, self.port)), _values(self), strict=True))
        return {"id": self.id, "subsystem": self.port, "start_s": self.start_s, "parameters": values}


def _axis_parameters(port: str) -> dict[str, tuple[PlantedParameter, ...]]:
    """Effects that act on a motion: on a stage's way to the catheter, or on the curvature the wires ask for."""
    unit, load, size = _UNIT[port], _LOAD[port], _SIZE[port]
    stiffness_unit, k = _STIFFNESS[port]
    gain, source = {"insertion": (1e-3, 1.0), "roll": (20.0, 0.0), "knob": (15.0, 0.0), "shape": (300.0, 0.0)}[port]
    stiffness = PlantedParameter(f"stiffness_{stiffness_unit}", k, 1e-6, _BIG)
    force = PlantedParameter(load, k * size, 0.0, _BIG)
    time_constant = PlantedParameter("time_constant_s", 0.05, 1e-4, 1e3)

    def length(name: str, times: float, least: float = 0.0) -> PlantedParameter:
        return PlantedParameter(f"{name}_{unit}", times * size, least, _BIG)

    return {
        "backlash": (length("width", 1.0),),
        "dead_zone": (length("centre", 0.0, -_BIG), length("half_width", 0.7)),
        "coulomb_friction": (force, stiffness),
        "presliding_friction": (force, length("distance", 1.0, 1e-9), stiffness),
        "load_dependent_friction": (PlantedParameter("coefficient", 0.03, 0.0, 2.0),)
        if port == "knob"
        else (PlantedParameter("coefficient", 0.5, 0.0, 5.0), stiffness),
        "stribeck_friction": (
            PlantedParameter(f"static_{load}", k * size, 0.0, _BIG),
            PlantedParameter(f"kinetic_{load}", 0.5 * k * size, 0.0, _BIG),
            PlantedParameter(f"speed_{unit}_per_s", 3.0 * size, 1e-9, _BIG),
            stiffness,
        ),
        "viscous_friction": (PlantedParameter(f"{load}_s_per_{unit}", 0.05 * k, 0.0, _BIG), stiffness),
        "rate_lag": (time_constant,),
        "latency": (PlantedParameter("delay_s", 0.03, 0.0, 1.0),),
        "clock_drift": (PlantedParameter("rate", 0.001, 0.0, 0.1),),
        "compliance": (
            PlantedParameter(
                f"compliance_{unit}_per_{load.rpartition('_')[2]}",
                size / {"insertion": 0.2, "roll": 1e-3, "knob": 5.0, "shape": 0.2}[port],
                0.0,
                _BIG,
            ),
        ),
        "nonlinear_stiffness": (stiffness, PlantedParameter("cubic_per_square", 1.0 / size**2, 0.0, _BIG)),
        "creep_relaxation": (PlantedParameter("share", 0.1, 0.0, 0.95), PlantedParameter("time_constant_s", 1.0, 1e-3, 1e4)),
        "plastic_set": (length("yield", 4.0), PlantedParameter("share", 0.2, 0.0, 1.0)),
        "softening": (PlantedParameter("rate_per_s", 0.003, 0.0, 1.0),),
        "asymmetry": (
            PlantedParameter("ratio", 0.85, 0.0, 5.0),
            length("centre", {"insertion": 6.0, "knob": 8.0}.get(port, 0.0), -_BIG),
        ),
        "static_nonlinearity": (length("scale", 8.0, 1e-9), PlantedParameter("share", 0.15, -0.5, 0.5)),
        "saturation": (length("limit", 9.0, 1e-9),),
        "coupling": (PlantedParameter("gain", gain, -_BIG, _BIG), PlantedParameter("source", source, 0.0, 2.0)),
        "periodic_disturbance": (
            length("amplitude", 0.3),
            PlantedParameter("frequency_Hz", 1.3, 0.0, 200.0),
            PlantedParameter(f"pitch_{unit}", 2.0 * size, 1e-9, _BIG),
            PlantedParameter("phase_rad", 0.0, -_BIG, _BIG),
        ),
        "resonance": (
            PlantedParameter("frequency_Hz", 6.0, 0.1, 200.0),
            PlantedParameter("damping_ratio", 0.15, 0.001, 2.0),
        ),
    }


_DIRECTION = (
    PlantedParameter("x", 0.0, -_BIG, _BIG),
    PlantedParameter("y", -1.0, -_BIG, _BIG),
    PlantedParameter("z", 0.0, -_BIG, _BIG),
)
_ON_SHAPE = {
    "coulomb_friction": (PlantedParameter("moment_Nm", 2e-4, 0.0, 1.0),),
    "presliding_friction": (
        PlantedParameter("moment_Nm", 3e-4, 0.0, 1.0),
        PlantedParameter("curvature_per_m", 3.0, 1e-6, 1e3),
    ),
    "viscous_friction": (PlantedParameter("time_constant_s", 0.05, 0.0, 10.0),),
    "nonlinear_stiffness": (PlantedParameter("cubic_m2", 0.002, 0.0, 10.0),),
    "creep_relaxation": (PlantedParameter("share", 0.15, 0.0, 5.0), PlantedParameter("time_constant_s", 2.0, 1e-3, 1e4)),
    "plastic_set": (PlantedParameter("yield_per_m", 8.0, 0.0, 1e3), PlantedParameter("share", 0.3, 0.0, 1.0)),
    "softening": (PlantedParameter("rate_per_s", 0.005, 0.0, 1.0), PlantedParameter("floor", 0.5, 0.05, 1.0)),
    "asymmetry": (PlantedParameter("ratio", 0.8, 0.1, 10.0),),
    "gravity_load": (
        PlantedParameter("weight_N_per_m", 0.05, 0.0, 100.0),
        PlantedParameter("tip_weight_N", 0.01, 0.0, 10.0),
        *_DIRECTION,
    ),
    "flow_drag": (
        PlantedParameter("speed_m_per_s", 0.4, 0.0, 5.0),
        PlantedParameter("pulsatility", 0.6, 0.0, 2.0),
        PlantedParameter("frequency_Hz", 1.2, 0.0, 20.0),
        *_DIRECTION,
    ),
    "second_contact": (
        PlantedParameter("place_m", 0.012, 0.0, 0.3),
        PlantedParameter("clearance_m", 0.0008, -_BIG, _BIG),
        PlantedParameter("stiffness_N_per_m", 100.0, 0.0, 1e5),
        *_DIRECTION,
    ),
}
_ON_CONTACT = {
    "contact_nonlinear": (
        PlantedParameter("exponent", 1.5, 1.0, 4.0),
        PlantedParameter("exponential_depth_m", 0.0, 0.0, 1.0),
    ),
    "contact_viscous": (
        PlantedParameter("hunt_crossley_s_per_m", 20.0, 0.0, 1e4),
        PlantedParameter("relaxing_N_per_m", 300.0, 0.0, 1e5),
        PlantedParameter("relaxation_s", 0.3, 1e-3, 100.0),
    ),
    "contact_friction": (
        PlantedParameter("coefficient", 0.2, 0.0, 3.0),
        PlantedParameter("bristle_N_per_m", 2000.0, 1.0, 1e6),
    ),
    "softening": (PlantedParameter("rate_per_s", 0.01, 0.0, 1.0), PlantedParameter("floor", 0.3, 0.05, 1.0)),
    "periodic_disturbance": (
        PlantedParameter("amplitude_m", 0.0003, 0.0, 0.01),
        PlantedParameter("frequency_Hz", 5.0, 0.0, 100.0),
        PlantedParameter("phase_rad", 0.0, -_BIG, _BIG),
    ),
}


def _vector(unit: str, x: float, y: float, z: float) -> tuple[PlantedParameter, ...]:
    return tuple(
        PlantedParameter(f"{axis}_{unit}", value, -_BIG, _BIG) for axis, value in zip("xyz", (x, y, z), strict=True)
    )


def _sensor_parameters(unit: str, size: float) -> dict[str, tuple[PlantedParameter, ...]]:
    """Effects on a reading; `size` is a middling error in `unit` (m for poses, N for forces)."""
    axis = PlantedParameter("axis", 0.0, 0.0, 2.0)
    return {
        "rate_lag": (PlantedParameter("time_constant_s", 0.05, 1e-4, 100.0),),
        "latency": (PlantedParameter("delay_s", 0.05, 0.0, 0.8),),
        "clock_drift": (PlantedParameter("rate", 0.002, 0.0, 0.1),),
        "creep_relaxation": (PlantedParameter("share", 0.1, 0.0, 0.95), PlantedParameter("time_constant_s", 3.0, 1e-3, 1e4)),
        "sensor_drift": (
            *_vector(f"{unit}_per_s", 0.02 * size, 0.0, 0.0),
            PlantedParameter("time_constant_s", 120.0, 0.1, 1e6),
        ),
        "periodic_disturbance": (
            PlantedParameter(f"amplitude_{unit}", 0.5 * size, 0.0, _BIG),
            PlantedParameter("frequency_Hz", 3.1, 0.0, 500.0),
            axis,
        ),
        "sensor_scale": (PlantedParameter("gain", 1.05, -10.0, 10.0),),
        "sensor_bias": _vector(unit, size, 0.0, 0.0),
        "sensor_misalignment": _vector("rad", 0.0, 0.05, 0.0),
        "rectified_sensor": (axis,),
        "saturation": (PlantedParameter(f"limit_{unit}", 10.0 * size, 0.0, _BIG),),
        "quantization": (PlantedParameter(f"step_{unit}", size, 1e-12, _BIG),),
        "dropout": (PlantedParameter("share", 0.05, 0.0, 1.0), PlantedParameter("burst", 3.0, 1.0, 1000.0)),
        "outlier": (PlantedParameter("share", 0.01, 0.0, 1.0), PlantedParameter(f"size_{unit}", 10.0 * size, 0.0, _BIG)),
    }


_ON_POSE = _sensor_parameters("m", 1e-3) | {
    "field_distortion": (
        PlantedParameter("amplitude_m", 0.002, 0.0, 0.1),
        *_vector("m", 0.03, 0.0, 0.03),
        PlantedParameter("reach_m", 0.03, 1e-4, 1.0),
    )
}
_ON_BASE = {
    "base_motion": (
        *_vector("m", 0.0, 0.001, 0.0),
        *_vector("rad", 0.02, 0.0, 0.0),
        PlantedParameter("frequency_Hz", 0.0, 0.0, 20.0),
        PlantedParameter("rise_s", 2.0, 1e-3, 1e4),
    )
}
_MISSED = {"missed_steps": (PlantedParameter("steps", 200.0, -1e6, 1e6), PlantedParameter("every_s", 0.0, 0.0, 1e6))}

CATALOGUE: dict[str, dict[str, tuple[PlantedParameter, ...]]] = {
    "insertion": _axis_parameters("insertion") | _MISSED,
    "roll": _axis_parameters("roll")
    | _MISSED
    | {"whip": (PlantedParameter("amplitude_rad", 0.35, 0.0, 3.0), PlantedParameter("phase_rad", 0.0, -_BIG, _BIG))},
    "knob": _axis_parameters("knob") | _MISSED,
    "shape": {
        name: parameters
        for name, parameters in _axis_parameters("shape").items()
        if name not in ("load_dependent_friction", "stribeck_friction")
    }
    | _ON_SHAPE,
    "contact": _ON_CONTACT,
    "pose_sensor": _ON_POSE,
    "force_sensor": _sensor_parameters("N", 0.02),
    "base": _ON_BASE,
}


def describe(effect_id: str, port: str) -> tuple[PlantedParameter, ...]:
    """Parameters of an effect at a port. Raises ValueError where there is no such pair."""
    if port not in CATALOGUE:
        raise ValueError(f"effect port: found {port!r}, wanted one of {', '.join(PORTS)}")
    if effect_id not in CATALOGUE[port]:
        raise ValueError(f"effect id at {port}: found {effect_id!r}, wanted one of {', '.join(CATALOGUE[port])}")
    return CATALOGUE[port][effect_id]


def _values(effect: PlantedEffect) -> list[float]:
    """Parameters in the catalogue's order, defaults filled in. Raises ValueError for unknown names and bad values."""
    known = describe(effect.id, effect.port)
    where = f"effect {effect.id}@{effect.port}"
    for name in effect.parameters:
        if name not in (p.name for p in known):
            raise ValueError(f"{where}: found parameter {name!r}, wanted one of {', '.join(p.name for p in known)}")
    values = []
    for p in known:
        value = float(effect.parameters.get(p.name, p.default))
        if not (math.isfinite(value) and p.least <= value <= p.greatest):
            raise ValueError(f"{where}.{p.name}: found {value}, wanted {p.least} to {p.greatest}")
        values.append(value)
    if not (math.isfinite(effect.start_s) and effect.start_s >= 0.0):
        raise ValueError(f"{where}.start_s: found {effect.start_s}, wanted 0 or more")
    return values


def parse(text: str) -> PlantedEffect:
    """The effect of a command line: ID@PORT, then maybe : and NAME=VALUE joined by commas; start_s is one of the names.

    `backlash@insertion:width_m=0.002,start_s=25`. Raises ValueError for what is not in the catalogue.
    """
    name, _, given = text.partition(":")
    effect_id, _, port = name.partition("@")
    values = {}
    for item in filter(None, given.split(",")):
        key, _, value = item.partition("=")
        try:
            values[key.strip()] = float(value)
        except ValueError:
            raise ValueError(f"effect {name}: found {item!r}, wanted NAME=NUMBER") from None
    effect = PlantedEffect(effect_id, port, {k: v for k, v in values.items() if k != "start_s"}, values.get("start_s", 0.0))
    pack([effect])
    return effect


def pack(effects: Sequence[PlantedEffect]) -> np.ndarray:
    """Effects as the kernels' records, fresh states. Raises ValueError as `describe` and for parameters out of bounds."""
    records = np.zeros(len(effects), EFFECT).view(np.recarray)
    for record, effect in zip(records, effects, strict=True):
        values = _values(effect)
        record["code"], record["port"], record["start_s"] = IDS.index(effect.id), PORTS.index(effect.port), effect.start_s
        record["p"][: len(values)] = values
        assert len(values) <= PARAMETERS
    return records
