"""The recorded rig's file with what a diagnosis found: the keys that twin, controller and planner read.

A rig file has keys for the calibration of the transmission, the delay and the place of the tracker, and the force sensor's
gain and axes. Every effect that changes exactly these is written there. What has no key is returned, a sentence each: the
file alone does not make the twin equal to the extended model then.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from host.diagnosis.effects.sensor_misalignment import matrix
from host.diagnosis.export.module import extended
from host.diagnosis.live.recorded_rig import RecordedRig
from host.diagnosis.model.effect import Candidate, Context
from host.diagnosis.model.model import ActiveEffect
from host.diagnosis.models.rig import KEYS
from host.diagnosis.pipeline import Diagnosis
from protocol.errors import InputError
from protocol.rig_file import parse_rig

Array = npt.NDArray[np.float64]
CURVE_POINTS = 41  # of a bent knob curve
MEMORYLESS = 1e-9  # difference between a curve passed upwards and downwards, relative to its span


@dataclass
class RigPatch:
    """A rig file's content, what was changed in it, and what has no key."""

    data: dict[str, Any]
    changed: dict[str, str] = field(default_factory=dict)  # section.key -> cause
    left_out: list[str] = field(default_factory=list)

    def set(self, key: str, value: Any, cause: str) -> None:
        """Set `section.key` to a value and note the cause."""
        section, _, name = key.partition(".")
        self.data[section][name] = value
        self.changed[key] = f"{self.changed[key]}, {cause}" if key in self.changed else cause

    def get(self, key: str) -> Any:
        """Return the value of `section.key`."""
        section, _, name = key.partition(".")
        return self.data[section][name]


def rig_patch(result: Diagnosis) -> RigPatch:
    """The recorded rig's configuration with the fitted calibration and the effects that a rig file can express.

    Raises:
        InputError: another kind than a recorded rig, nothing that a rig file can express, or a value that it refuses.
    """
    model = result.model.inner
    if not isinstance(model, RecordedRig):
        raise InputError(
            "--export", f"kind {model.kind}", "--nominal rig and recordings of a rig, for a file ending in .toml"
        )
    theta, active = extended(result)
    patch = RigPatch(model.recorded_on.effective())
    _calibration(patch, model, theta)
    in_curve = _knob_curve(patch, model, theta, active)
    for candidate, values in active:
        change = CHANGES.get((candidate.effect.id, candidate.port.name, candidate.form))
        if change is not None:
            change(patch, np.asarray(values))
        elif candidate.key not in in_curve:
            patch.left_out.append(f"{candidate.name} is not in the rig file, which has no key for it.")
    parse_rig(patch.data, "--export")
    return patch


def rig_text(patch: RigPatch) -> str:
    """The patched rig file, every change and every effect without a key as comments at its head."""
    head = ["# A recorded rig with what a diagnosis found."]
    head += [f"# {key}: {cause}" for key, cause in patch.changed.items()]
    head += [f"# {sentence}" for sentence in patch.left_out]
    return "\n".join([*head, *_lines(patch.data)]) + "\n"


def _lines(data: dict[str, Any], name: str = "") -> list[str]:
    """TOML of nested sections; scalars and lists are written alike in JSON and TOML."""
    plain = {key: value for key, value in data.items() if not isinstance(value, dict)}
    lines = ["", f"[{name}]"] if name and plain else []
    lines += [f"{key} = {json.dumps(value)}" for key, value in plain.items() if value is not None]
    for key, value in data.items():
        if isinstance(value, dict):
            lines += _lines(value, f"{name}.{key}" if name else key)
    return lines


def _calibration(patch: RigPatch, model: RecordedRig, theta: Array) -> None:
    """Write the fitted nominal parameters into the rig file."""
    fitted = dict(zip([p.name for p in model.parameters], map(float, theta), strict=True))
    known = {p.name: p.grid[0] for p in model.parameters}
    moved = {name for name, value in fitted.items() if value != known[name]}
    if "insertion_offset" in moved:
        patch.set("transmission.insertion_at_home_m", fitted["insertion_offset"], "fitted")
    if "roll_slope" in moved:
        patch.set("transmission.roll_slope", fitted["roll_slope"], "fitted")
    if {"knob_gain", "knob_offset"} & moved:
        curve = np.array(patch.get("transmission.curvature_per_m")) * fitted["knob_gain"] / known["knob_gain"]
        patch.set("transmission.curvature_per_m", (curve + fitted["knob_offset"]).tolist(), "fitted gain and offset")
    if "bending_stiffness" in moved:
        key = KEYS["bending_stiffness"]
        patch.left_out.append(
            f"The fitted {key} = {fitted['bending_stiffness']:.4g} (was {known['bending_stiffness']:.4g}) belongs in the "
            "catheter's file, under [cosserat] EI1_N_m2."
        )
    if "roll_offset" in moved:
        patch.left_out.append(f"The fitted roll_offset_rad = {fitted['roll_offset']:.4g} has no key in a rig file.")


def _backlash(patch: RigPatch, p: Array) -> None:
    """Two plays in a row are one, of the sum of both widths."""
    key = "transmission.insertion_backlash_m"
    patch.set(key, patch.get(key) + float(p[0]), "backlash@insertion, added to the known one")


def _latency(patch: RigPatch, p: Array) -> None:
    patch.set("tracker.latency_s", patch.get("tracker.latency_s") + float(p[0]), "latency@pose_sensor, added")


def _force_gain(patch: RigPatch, p: Array) -> None:
    key = "force_sensor.counts_per_newton"
    patch.set(key, patch.get(key) * (1.0 + float(p[0])), "sensor_scale@force_sensor")


def _force_axes(patch: RigPatch, p: Array) -> None:
    """A reading R f is turned back before it is used."""
    key = "force_sensor.base_from_sensor_wxyz"
    patch.set(key, _turned(matrix(p).T, patch.get(key)), "sensor_misalignment@force_sensor")


def _tracker_axes(patch: RigPatch, p: Array) -> None:
    _register(patch, matrix(p).T, np.zeros(3), "sensor_misalignment@pose_sensor")


def _tracker_offset(patch: RigPatch, p: Array) -> None:
    _register(patch, np.eye(3), -p, "sensor_bias@pose_sensor")


def _base(patch: RigPatch, p: Array) -> None:
    """Poses R (x + d) are registered so that they become x."""
    _register(patch, matrix(np.array([p[2], p[3], 0.0])).T, -np.array([p[0], p[1], 0.0]), "base_motion@base")


def _register(patch: RigPatch, turn: Array, shift: Array, cause: str) -> None:
    """Tracker poses x become turn x + shift in the base frame."""
    place = turn @ np.array(patch.get("tracker.base_from_tracker_m")) + shift
    patch.set("tracker.base_from_tracker_m", place.tolist(), cause)
    key = "tracker.base_from_tracker_wxyz"
    patch.set(key, _turned(turn, patch.get(key)), cause)


def _turned(turn: Array, wxyz: Any) -> list[float]:
    """Quaternion (w, x, y, z) of the rotation `turn` (3, 3) after that of `wxyz`."""
    from scipy.spatial.transform import Rotation

    after = Rotation.from_matrix(turn) * Rotation.from_quat(np.roll(np.array(wxyz), -1))
    return [float(value) for value in np.roll(after.as_quat(), 1)]


def _knob_curve(patch: RigPatch, model: RecordedRig, theta: Array, active: list[ActiveEffect]) -> set[str]:
    """Bend the knob's curve by the effects without memory that act on the knob; the keys of those that are in it."""
    fitted = dict(zip([p.name for p in model.parameters], map(float, theta), strict=True))
    transmission = model.recorded_on.transmission
    knots = np.array(transmission.knob_rad)
    knob = np.unique(np.concatenate((knots, np.linspace(knots[0], knots[-1], CURVE_POINTS))))
    recorded_gain = next(p.grid[0] for p in model.parameters if p.name == "knob_gain")
    signal = np.interp(knob, transmission.knob_rad, transmission.curvature_per_m) / recorded_gain
    here = sorted((one for one in active if one[0].port.name == "knob"), key=lambda one: one[0].effect.order)
    used: set[str] = set()
    for side in ("input", "output"):
        for candidate, values in here:
            bent = _passed(candidate, signal, values) if candidate.effect.side == side else None
            # A rig file needs a curve that never falls.
            if bent is not None and not np.any(np.diff(bent) < -MEMORYLESS * np.ptp(bent)):
                signal = np.maximum.accumulate(bent)
                used.add(candidate.key)
        if side == "input":
            signal = fitted["knob_gain"] * signal + fitted["knob_offset"]
    if used:
        cause = ", ".join(candidate.name for candidate, _ in here if candidate.key in used)
        patch.set("transmission.knob_rad", knob.tolist(), cause)
        patch.set("transmission.curvature_per_m", signal.tolist(), cause)
    return used


def _passed(candidate: Candidate, signal: Array, values: Array) -> Array | None:
    """`signal` after the effect; None where time, another channel or memory decides: then no curve stands for it."""
    effect = candidate.effect
    if effect.timed or effect.remembers or candidate.source or effect.apply is None:
        return None
    passes = []
    for given in (signal, signal[::-1]):
        context = Context(np.arange(given.size, dtype=np.float64), 1.0, given, 0.0)
        passes.append(np.asarray(effect.apply(given, context, np.asarray(values), candidate.form)))
    same = np.max(np.abs(passes[0] - passes[1][::-1])) <= MEMORYLESS * max(float(np.ptp(passes[0])), 1e-300)
    return passes[0] if same else None


Change = Callable[[RigPatch, Array], None]
CHANGES: dict[tuple[str, str, str], Change] = {
    ("backlash", "insertion", ""): _backlash,
    ("latency", "pose_sensor", ""): _latency,
    ("sensor_scale", "force_sensor", ""): _force_gain,
    ("sensor_misalignment", "force_sensor", ""): _force_axes,
    ("sensor_misalignment", "pose_sensor", ""): _tracker_axes,
    ("sensor_bias", "pose_sensor", ""): _tracker_offset,
    ("base_motion", "base", "constant"): _base,
}
