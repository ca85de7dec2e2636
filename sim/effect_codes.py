"""Numbers of effects and ports, and the record in which kernels see one planted effect."""

from __future__ import annotations

import numpy as np

PORTS = ("insertion", "roll", "knob", "shape", "contact", "pose_sensor", "force_sensor", "base")
INSERTION, ROLL, KNOB, SHAPE, CONTACT, POSE_SENSOR, FORCE_SENSOR, BASE = range(8)

IDS = (
    "backlash",
    "dead_zone",
    "coulomb_friction",
    "presliding_friction",
    "load_dependent_friction",
    "stribeck_friction",
    "viscous_friction",
    "rate_lag",
    "latency",
    "clock_drift",
    "compliance",
    "nonlinear_stiffness",
    "creep_relaxation",
    "plastic_set",
    "softening",
    "sensor_drift",
    "asymmetry",
    "static_nonlinearity",
    "saturation",
    "coupling",
    "whip",
    "periodic_disturbance",
    "resonance",
    "gravity_load",
    "flow_drag",
    "second_contact",
    "contact_nonlinear",
    "contact_viscous",
    "contact_friction",
    "base_motion",
    "field_distortion",
    "sensor_scale",
    "sensor_bias",
    "sensor_misalignment",
    "rectified_sensor",
    "quantization",
    "dropout",
    "outlier",
    "missed_steps",
)
(
    BACKLASH,
    DEAD_ZONE,
    COULOMB_FRICTION,
    PRESLIDING_FRICTION,
    LOAD_DEPENDENT_FRICTION,
    STRIBECK_FRICTION,
    VISCOUS_FRICTION,
    RATE_LAG,
    LATENCY,
    CLOCK_DRIFT,
    COMPLIANCE,
    NONLINEAR_STIFFNESS,
    CREEP_RELAXATION,
    PLASTIC_SET,
    SOFTENING,
    SENSOR_DRIFT,
    ASYMMETRY,
    STATIC_NONLINEARITY,
    SATURATION,
    COUPLING,
    WHIP,
    PERIODIC_DISTURBANCE,
    RESONANCE,
    GRAVITY_LOAD,
    FLOW_DRAG,
    SECOND_CONTACT,
    CONTACT_NONLINEAR,
    CONTACT_VISCOUS,
    CONTACT_FRICTION,
    BASE_MOTION,
    FIELD_DISTORTION,
    SENSOR_SCALE,
    SENSOR_BIAS,
    SENSOR_MISALIGNMENT,
    RECTIFIED_SENSOR,
    QUANTIZATION,
    DROPOUT,
    OUTLIER,
    MISSED_STEPS,
) = range(len(IDS))

PARAMETERS = 8  # numbers an effect may have
STATES = 512  # numbers it may remember (three per cell of the catheter are the most)
RING = 2048  # samples that a delay line keeps

EFFECT = np.dtype(
    [
        ("code", "i8"),
        ("port", "i8"),
        ("start_s", "f8"),
        ("p", "f8", (PARAMETERS,)),
        ("began", "i8"),
        ("s", "f8", (STATES,)),
        ("ring", "f8", (RING,)),
    ],
    align=True,
)
