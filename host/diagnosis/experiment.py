"""The command sequence that would tell two models apart, as a small script of segments for the rig."""

from __future__ import annotations

from typing import Any

import numpy as np

from host.diagnosis.effect import Candidate

# What an effect's mark depends on; two effects are told apart by varying what only one of them depends on.
DEPENDS: dict[str, frozenset[str]] = {
    "backlash": frozenset({"reversal"}),
    "dead_zone": frozenset({"place"}),
    "coulomb_friction": frozenset({"reversal"}),
    "presliding_friction": frozenset({"reversal", "amplitude"}),
    "load_dependent_friction": frozenset({"reversal", "load"}),
    "stribeck_friction": frozenset({"reversal", "speed"}),
    "viscous_friction": frozenset({"speed"}),
    "rate_lag": frozenset({"speed", "frequency"}),
    "latency": frozenset({"speed"}),
    "clock_drift": frozenset({"speed", "time"}),
    "compliance": frozenset({"load"}),
    "nonlinear_stiffness": frozenset({"load", "amplitude"}),
    "creep_relaxation": frozenset({"hold"}),
    "plastic_set": frozenset({"overload"}),
    "softening": frozenset({"time", "amplitude"}),
    "sensor_drift": frozenset({"time"}),
    "asymmetry": frozenset({"place"}),
    "static_nonlinearity": frozenset({"place", "amplitude"}),
    "saturation": frozenset({"place"}),
    "coupling": frozenset({"other"}),
    "whip": frozenset({"turns"}),
    "periodic_disturbance": frozenset({"hold"}),
    "resonance": frozenset({"frequency"}),
    "gravity_load": frozenset({"turns"}),
    "flow_drag": frozenset({"hold"}),
    "second_contact": frozenset({"place"}),
    "contact_nonlinear": frozenset({"load", "amplitude"}),
    "contact_viscous": frozenset({"load", "speed"}),
    "contact_friction": frozenset({"load", "reversal"}),
    "base_motion": frozenset({"time", "hold"}),
    "field_distortion": frozenset({"place"}),
    "missed_steps": frozenset({"time"}),
}
SEGMENTS: dict[str, str] = {
    "reversal": "triangle, amplitudes 0.2, 0.5 and 1.0 of the range, 0.1 Hz, 3 periods each",
    "amplitude": "nested triangles: 1.0, then 0.5, 0.25 and 0.1 of the range about the same middle, 0.1 Hz",
    "place": "slow ramp over the whole range up and down, then the same amplitude 0.1 about five different middles",
    "speed": "the same triangle of 0.5 of the range at 0.02, 0.1, 0.5 and 2 Hz",
    "frequency": "sine of 0.05 of the range, swept from 0.1 Hz to a fifth of the sampling rate in 60 s",
    "load": "the same triangle with four different loads held",
    "hold": "steps of 0.5 of the range, each held 30 s, and 60 s at rest",
    "overload": "small triangle, one stroke to the end of the range, the small triangle again",
    "time": "the same triangle at the start, and again after ten minutes at rest",
    "other": "this axis at rest while each other axis runs a triangle over half its range",
    "turns": "two slow full turns of roll to either side at constant insertion and knob",
}


def experiment(model: Any, candidate: Candidate, alike: tuple[Candidate, ...], problem: Any) -> str:
    """Script, one segment a line: axis, motion. Empty where nothing is left to tell apart."""
    if not alike:
        return ""
    own = DEPENDS.get(candidate.effect.id, frozenset({"amplitude"}))
    lines: list[str] = []
    for other in alike:
        theirs = DEPENDS.get(other.effect.id, frozenset({"amplitude"}))
        for kind in sorted(own ^ theirs) or ["amplitude", "speed"]:
            axis = candidate.port.name if candidate.port.kind.startswith("motion") else model.quiet_inputs[0]
            lines.append(
                f"{axis}: {SEGMENTS.get(kind, SEGMENTS['amplitude'])}  # {candidate.effect.id} against {other.effect.id}"
            )
    return "\n".join(dict.fromkeys(lines))


def ranges(problem: Any) -> dict[str, tuple[float, float]]:
    """Range of each input over all recordings, for the amplitudes of a script."""
    out = {}
    for name in problem.model.quiet_inputs:
        values = np.concatenate([piece.inputs[name] for piece in problem.pieces])
        out[name] = (float(values.min()), float(values.max()))
    return out
