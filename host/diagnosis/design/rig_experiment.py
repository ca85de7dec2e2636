"""Motions that a running rig can make in an experiment: tip paths before the wall, forces on it; and their scripts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from host.commissioning.experiment_script import Script, check_script, write_script
from host.diagnosis.design.excitation import Excitation, Span, family
from host.diagnosis.estimation.fit import Fit, Problem
from host.diagnosis.model.rig_recording import knob_gain
from host.diagnosis.models.rig import FORCE, HANDLES
from protocol.rig_file import Rig

Array = npt.NDArray[np.float64]
SECONDS, COMMANDS_HZ = 40.0, 10.0
TOUCH_N = 0.05  # above this the recorded tip lay on the wall
CLEAR_M = 0.005  # a free path stays so far before every place where the wall was touched
BEFORE_M = 0.006  # a contact begins so far before it
SHORTEST_M = 0.010  # exposed
BENT_PER_M = (3.0, 25.0)
SWING_M, SWING_RAD = 0.006, 1.2  # of insertion and of the roll handle, either way
SHARE = 0.8  # of the speeds and accelerations that the rig file allows
FORCES_N = (0.05, 0.35)


@dataclass(frozen=True)
class Places:
    """Where the recordings were. `base` (3,): handle before the wall; `touch`: handle and tip on it, or None."""

    base: Array
    wall_m: float
    touch: tuple[Array, Array] | None


def places(model: Any, problem: Problem, best: Fit) -> Places:
    """A working point in free space, clear of the wall, and one on the wall where it was touched."""
    handle, tip, force = (
        np.hstack([np.vstack([p.recording.channels[name] for name in names]) for p in problem.segments])
        for names in (tuple(HANDLES), ("tip_x_m", "tip_y_m", "tip_z_m"), FORCE)
    )
    pressing = np.isfinite(tip).all(axis=0) & (model.normal @ np.nan_to_num(force) > TOUCH_N)
    gain, length = knob_gain(model.recorded_on), model.spec.distal_length_m
    home = float(best.values[1])
    wall_m = float(np.quantile(model.normal @ tip[:, pressing], 0.01)) if pressing.any() else np.inf
    reach = length + home + float(np.nanmax(handle[0]))
    exposed = max(min(reach, wall_m - CLEAR_M - SWING_M), SHORTEST_M + SWING_M)
    base = np.array([exposed - length - home, 0.0, 0.5 * sum(BENT_PER_M) / gain])
    touch = (np.median(handle[:, pressing], axis=1), np.median(tip[:, pressing], axis=1)) if pressing.sum() > 40 else None
    return Places(base, wall_m, touch)


def rig_excitations(model: Any, problem: Problem, best: Fit) -> list[tuple[Excitation, dict[str, Array]]]:
    """Free motions of each axis, and forces on the wall where it was touched, under the rig file's limits."""
    rig: Rig = model.recorded_on
    dt_s = 1.0 / rig.tracker.rate_hz
    time_s: Array = dt_s * np.arange(round(SECONDS / dt_s), dtype=np.float64)
    where = places(model, problem, best)
    bend = 0.5 * (BENT_PER_M[1] - BENT_PER_M[0]) / knob_gain(rig)
    reaches = (SWING_M, SWING_RAD, bend)
    out = []
    for axis, (name, reach) in enumerate(zip(HANDLES, reaches, strict=True)):
        stage = rig.stage(axis)
        span = Span("m" if axis == 0 else "rad", float(where.base[axis]), reach, 0.5 * stage.max_speed_unit_per_s)
        for excitation in family(name, span, time_s):
            handle = np.repeat(where.base[:, None], time_s.size, axis=1)
            handle[axis] = excitation.values
            tip = tip_path(model, best, handle)
            if allowed(tip, dt_s, rig, model.normal, where.wall_m) and followed(excitation):
                out.append((excitation, dict(zip(HANDLES, handle, strict=True)) | still(time_s.size)))
    if where.touch is not None:
        out += pressing(model, where.touch[0], time_s, rig)
    return out


def still(n: int) -> dict[str, Array]:
    """Return force channels (n,) that are zero."""
    return {name: np.zeros(n) for name in FORCE}


def pressing(model: Any, handle: Array, time_s: Array, rig: Rig) -> list[tuple[Excitation, dict[str, Array]]]:
    """Forces along the wall's normal, the handle as it was on the wall and the insertion as the force needs it."""
    low, high = FORCES_N[0], min(FORCES_N[1], 0.7 * rig.safety.over_force_N)
    span = Span("N", 0.5 * (low + high), 0.5 * (high - low), SHARE * rig.control.force_slew_N_per_s)
    out = []
    for excitation in family("force", span, time_s):
        along = np.outer(model.normal, excitation.values)
        moved = np.repeat(handle[:, None], time_s.size, axis=1)
        moved[0] += rig.control.tip_compliance_m_per_N * (excitation.values - span.centre)
        out.append((excitation, dict(zip(HANDLES, moved, strict=True)) | dict(zip(FORCE, along, strict=True))))
    return out


def followed(excitation: Excitation) -> bool:
    """Whether commands at COMMANDS_HZ, joined by straight lines, are the motion but for a tenth of its size."""
    step = max(1, round(1.0 / (COMMANDS_HZ * (excitation.time_s[1] - excitation.time_s[0]))))
    joined = np.interp(excitation.time_s, excitation.time_s[::step], excitation.values[::step])
    return bool(np.max(np.abs(joined[:-step] - excitation.values[:-step])) < 0.05 * np.ptp(excitation.values))


def tip_path(model: Any, best: Fit, handle: Array) -> Array:
    """Tip (3, n) of the unloaded nominal model."""
    gain, home, slope, turn, knob, bent = best.values[:6]
    exposed = np.maximum(model.spec.distal_length_m + gain * handle[0] + home, 1e-3)
    kappa = knob * handle[2] + bent
    angle, roll = kappa * exposed, slope * handle[1] + turn
    along = exposed * np.sinc(angle / np.pi)
    aside = exposed * np.sin(0.5 * angle) * np.sinc(0.5 * angle / np.pi)
    return np.vstack([aside * np.sin(roll), -aside * np.cos(roll), along])


def allowed(tip: Array, dt_s: float, rig: Rig, normal: Array, wall_m: float) -> bool:
    """Whether a tip path (3, n) stays clear of the wall, in the workspace, and under the speeds of the rig file."""
    velocity = np.diff(tip, axis=1) / dt_s
    low, high = np.array(rig.safety.workspace_min_m)[:, None], np.array(rig.safety.workspace_max_m)[:, None]
    return bool(
        np.all((tip > low + CLEAR_M) & (tip < high - CLEAR_M))
        and np.max(normal @ tip) < wall_m - CLEAR_M
        and np.max(np.linalg.norm(velocity, axis=0)) < SHARE * rig.control.move_speed_m_per_s
        and np.max(np.linalg.norm(np.diff(velocity, axis=1), axis=0)) / dt_s < SHARE * rig.control.move_accel_m_per_s2
    )


def script_of(
    model: Any, problem: Problem, best: Fit, excitation: Excitation, inputs: dict[str, Array], says: str
) -> Script:
    """The excitation as commands to the rig, checked against its limits. Raises InputError."""
    rig: Rig = model.recorded_on
    every = max(1, round(rig.tracker.rate_hz / COMMANDS_HZ))
    time_s = excitation.time_s[::every] - excitation.time_s[0]
    common: dict[str, Any] = {"says": says, "rig": rig.name, "catheter": rig.catheter.name}
    common["into"] = [float(v) for v in model.normal]
    if excitation.channel == "force":
        touch = places(model, problem, best).touch
        assert touch is not None
        rows = np.column_stack((time_s, np.round(excitation.values[::every], 4)))
        start = touch[1] - BEFORE_M * model.normal
        more: dict[str, Any] = {"motion": "contact", "touch_m": rounded(touch[1])}
    else:
        tip = tip_path(model, best, np.vstack([inputs[name] for name in HANDLES]))[:, ::every]
        rows, start, more = np.column_stack((time_s, tip.T)), tip[:, 0], {"motion": "free"}
    script = Script(**common, **more, start_m=rounded(start), rows=[rounded(row) for row in rows])
    check_script(script, rig)
    return script


def rounded(values: Array) -> list[float]:
    """Round positions (m) to 1e-6, as a script states them."""
    return [round(float(v), 6) for v in values]


__all__ = ["Places", "places", "rig_excitations", "script_of", "write_script"]
