"""Experiment scripts: timed tip positions, or timed forces on the wall, that any rig's commander can give; checked first."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import numpy.typing as npt
from pydantic import Field

from protocol.commander import Acknowledgement
from protocol.errors import InputError
from protocol.requests import Request, validate
from protocol.rig_file import AXES, Rig
from protocol.text_files import read_toml
from realtime.control import inverse_kinematics
from realtime.control.configure import tick_parameters

Array = npt.NDArray[np.float64]
LONGEST_S = 600.0
FASTEST_HZ = 20.0  # of commands: half of what the rig's gate lets through
LEAST_FORCE_N = 0.02
FORCE_SHARE = 0.8  # of safety.over_force_N
THERE_M = 1.5e-3  # of the start, which has to be reached before the clock begins
WITHIN_S, REST_S = 15.0, 2.0


class Script(Request):
    """One experiment. motion `free`: rows of time_s, x_m, y_m, z_m; `contact`: rows of time_s, force_N along `into`."""

    says: str
    rig: str
    catheter: str
    motion: Literal["free", "contact"]
    start_m: list[float] = Field(min_length=3, max_length=3)
    touch_m: list[float] = Field(default=[], max_length=3)
    into: list[float] = Field(default=[0.0, 0.0, 1.0], min_length=3, max_length=3)
    rows: list[list[float]] = Field(min_length=2)

    @property
    def table(self) -> Array:
        """Rows as an array (n, 4) or (n, 2)."""
        return np.array(self.rows)


@dataclass(frozen=True)
class Path3D:
    """Motion of a script: seconds, box of the tip (m), its speed (m/s), travel of each stage (its unit), forces (N)."""

    seconds: float
    low_m: Array
    high_m: Array
    fastest_m_per_s: float
    travel: dict[str, tuple[float, float]]
    forces_N: tuple[float, float]


def read_script(path: Path) -> Script:
    """Read the script in TOML file `path`. Raises InputError with the key."""
    content = read_toml(path, "script")
    rows = content.get("rows")
    if isinstance(rows, list):
        content["rows"] = [_floats(row) if isinstance(row, list) else row for row in rows]
    try:
        script = validate(Script, content)
    except InputError as error:
        raise error.in_file(path) from None
    width = 4 if script.motion == "free" else 2
    for number, row in enumerate(script.rows):
        if len(row) != width:
            raise InputError(f"rows.{number}", row, f"{width} numbers for motion {script.motion}")
    return script


def _floats(row: list[Any]) -> list[Any]:
    return [float(value) if type(value) is int else value for value in row]


def write_script(script: Script, path: Path) -> Path:
    """Write `script` as TOML to `path`; reading it back gives equal values."""
    head = "# seldinger experiment FILE --rig RIG.toml checks and shows it; nothing moves without --go."
    fields = script.model_dump(exclude={"rows"})
    lines = [f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in fields.items()]
    columns = "time_s, x_m, y_m, z_m" if script.motion == "free" else "time_s, force_N"
    rows = [f"    [{', '.join([f'{row[0]:.3f}', *(f'{value:.6f}' for value in row[1:])])}]," for row in script.rows]
    path.write_text("\n".join([head, *lines, f"rows = [  # {columns}", *rows, "]", ""]), encoding="utf-8")
    return path


def check_script(script: Script, rig: Rig) -> Path3D:
    """Return the motion of `script` on `rig`. Raises InputError if it exceeds a limit; no command is sent."""
    if script.rig != rig.name:
        raise InputError("rig", script.rig, f"{rig.name}, the rig's name")
    if script.catheter != rig.catheter.name:
        raise InputError("catheter", script.catheter, f"{rig.catheter.name}, the rig's")
    time_s = script.table[:, 0]
    gaps = np.diff(time_s)
    if time_s[0] < 0.0 or np.any(gaps <= 0.0) or time_s[-1] > LONGEST_S:
        found = f"times {time_s[0]:g} to {time_s[-1]:g} s"
        raise InputError("rows", found, f"times that rise from 0 to at most {LONGEST_S:g} s")
    if np.min(gaps) < 0.999 / FASTEST_HZ:
        raise InputError("rows", f"{1.0 / np.min(gaps):.3g} commands a second", f"at most {FASTEST_HZ:g}")
    if script.motion == "contact":
        return _check_contact(script, rig)
    points = np.vstack([np.array(script.start_m), script.table[:, 1:]])
    _inside(points, rig)
    speed = float(np.max(np.linalg.norm(np.diff(points[1:], axis=0), axis=1) / gaps))
    if speed > rig.control.move_speed_m_per_s:
        raise InputError("rows", f"{speed:.4g} m/s", f"at most control.move_speed_m_per_s {rig.control.move_speed_m_per_s}")
    return Path3D(float(time_s[-1]), points.min(axis=0), points.max(axis=0), speed, travel_of(points, rig), (0.0, 0.0))


def _check_contact(script: Script, rig: Rig) -> Path3D:
    if len(script.touch_m) != 3:
        raise InputError("touch_m", script.touch_m, "three numbers for motion contact")
    if abs(math.hypot(*script.into) - 1.0) > 1e-3:
        raise InputError("into", script.into, "a unit vector into the tissue")
    force = script.table[:, 1]
    most = FORCE_SHARE * rig.safety.over_force_N
    if not (np.min(force) >= LEAST_FORCE_N and np.max(force) <= most):
        raise InputError(
            "rows", f"{np.min(force):.3g} to {np.max(force):.3g} N", f"forces of {LEAST_FORCE_N} to {most:.3g} N"
        )
    points = np.array([script.start_m, script.touch_m])
    _inside(points, rig)
    span = (float(np.min(force)), float(np.max(force)))
    seconds = float(script.table[-1, 0])
    return Path3D(seconds, points.min(axis=0), points.max(axis=0), rig.control.approach_speed_m_per_s,
                  travel_of(points, rig), span)  # fmt: skip


def _inside(points: Array, rig: Rig) -> None:
    low, high = np.array(rig.safety.workspace_min_m), np.array(rig.safety.workspace_max_m)
    bad = np.flatnonzero(~np.all((points >= low) & (points <= high), axis=1))
    if bad.size:
        where = "start_m" if bad[0] == 0 else f"rows.{bad[0] - 1}"
        raise InputError(where, [round(float(v), 4) for v in points[bad[0]]], "a place inside safety.workspace")


def travel_of(points: Array, rig: Rig) -> dict[str, tuple[float, float]]:
    """Return the range of each stage over tip positions (n, 3) with the backlash. Raises InputError beyond the travel."""
    config, known = tick_parameters(rig)[0].kinematics, rig.transmission
    joint, stages = np.array([known.insertion_at_home_m, 0.0, 0.0]), []
    for point in points:
        joint[:] = inverse_kinematics.apply_nearest(config, np.ascontiguousarray(point), joint)
        insertion = (joint[0] - known.insertion_at_home_m) / known.insertion_slope
        stages.append([insertion, joint[1] / known.roll_slope, joint[2]])
    table, out = np.array(stages), {}
    for axis, name in enumerate(AXES):
        spare = 0.5 * known.insertion_backlash_m if axis == 0 else 0.0
        low, high = float(table[:, axis].min()) - spare, float(table[:, axis].max()) + spare
        stage = rig.stage(axis)
        if not (stage.min_unit <= low and high <= stage.max_unit):
            wanted = f"travel within {stage.min_unit} to {stage.max_unit}"
            raise InputError(f"rows ({name})", f"{low:.4g} to {high:.4g}", wanted)
        out[name] = (low, high)
    return out


class RigControl(Protocol):
    """A rig as a script needs it, in virtual time or on the wall clock."""

    def give(self, action: str, target: str = "none", **fields: Any) -> Acknowledgement:
        """Give one command under the lease and return its result."""
        ...

    def wait(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Let time pass; True if `until` ended it."""
        ...

    def now_s(self) -> float:
        """Return the rig's clock, virtual or CLOCK_MONOTONIC (s)."""
        ...

    def mode(self) -> str:
        """Return the label of the loop's phase (`protocol.enums.Phase`)."""
        ...

    def tip_m(self) -> Sequence[float] | None:
        """Return the tip's position in the base frame (3,) in m; None before the first pose."""
        ...


def perform(script: Script, control: RigControl, progress: Callable[[float], None] = lambda share: None) -> None:
    """Give `script` (checked before) to an armed rig: to the start, then row by row; at the end hold, or retract.

    Raises RuntimeError where a command is refused or the rig leaves its mode; it then gets the command to hold.
    """
    try:
        _ask(control, "target", "position", target_m=tuple(script.start_m))
        if not control.wait(WITHIN_S, lambda: _near(control.tip_m(), script.start_m)):
            raise RuntimeError(f"start not reached within {WITHIN_S:g} s")
        if script.motion == "contact":
            _ask(control, "target", "contact", target_m=tuple(script.touch_m), normal=tuple(script.into),
                 force_N=script.rows[0][1])  # fmt: skip
            if not control.wait(WITHIN_S, lambda: control.mode() == "contact"):
                raise RuntimeError(f"no contact within {WITHIN_S:g} s")
        control.wait(REST_S)
        begin_s, wanted = control.now_s(), "contact" if script.motion == "contact" else "position"
        for row in script.rows:
            control.wait(max(begin_s + row[0] - control.now_s(), 0.0))
            if script.motion == "contact" and control.mode() == "approach":
                continue  # the wall went away for a moment; it is being followed
            if control.mode() != wanted:
                raise RuntimeError(f"ended at {row[0]:.1f} s: found the rig in mode {control.mode()}, wanted {wanted}")
            if script.motion == "free":
                _ask(control, "target", "position", target_m=tuple(row[1:]))
            else:
                _ask(control, "force", force_N=row[1])
            progress(row[0] / script.rows[-1][0])
        control.wait(REST_S)
    except RuntimeError:
        control.give("hold")
        raise
    if script.motion == "contact":
        _ask(control, "target", "retract")
        control.wait(REST_S)


def _ask(control: RigControl, action: str, target: str = "none", **fields: Any) -> None:
    answer = control.give(action, target, **fields)
    if not answer.accepted:
        raise RuntimeError(f"{action} {target}: {answer.reason}")


def _near(tip_m: Sequence[float] | None, point: Sequence[float]) -> bool:
    return tip_m is not None and math.dist(tip_m, point) < THERE_M
