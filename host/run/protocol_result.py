"""The result of a protocol: figures of each touch and action, the summary, and the JSON file that a run can continue."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from host.recordings.writer import new_recording_path
from host.run.protocol_file import ScriptedProtocol
from protocol.errors import Description, InputError
from protocol.requests import plain
from protocol.text_files import json_of, read_text

OK, OUT_OF_TOLERANCE, FAILED = "ok", "out_of_tolerance", "failed"


class TouchResult(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of one touch. Mean, RMS error and tip error are those after `settle_s`; the others of the whole touch.

    force_time_integral: of the measured force over the time of the touch. contact_loss: force below the rig's threshold
    of contact. tip_error_m: of the tracker's mean position of the tip from the wanted point, across the normal; None
    without poses. It is not taken from the loop's predicted tip, which the loop itself brings to the point.
    """

    force_N: float
    mean_force_N: float
    rms_error_N: float
    peak_force_N: float
    seconds: float
    force_time_integral_Ns: float
    force_time_integral_gs: float
    contact_loss_s: float
    contact_loss_share: float
    longest_loss_s: float
    tip_error_m: float | None
    contact_after_s: float
    trace_time_s: tuple[float, ...] = ()
    trace_force_N: tuple[float, ...] = ()


class ActionResult(msgspec.Struct, frozen=True, kw_only=True):
    """Result of one action: verdict (ok, out_of_tolerance, failed), reason in words, and its figures.

    recording: the file in which started_s is a time; empty on a real rig. A run that continues another has a new one.
    """

    id: str
    kind: str
    verdict: str
    says: str
    started_s: float
    seconds: float
    point_m: tuple[float, float, float] | None = None
    error_m: float | None = None
    touch: TouchResult | None = None
    recording: str = ""


class ProtocolResult(msgspec.Struct, frozen=True, kw_only=True):
    """A run of a protocol. done: every action has a result and none failed. recording: its file, empty on a real rig."""

    protocol: str
    sha256: str
    rig: str
    simulated: bool
    actions_planned: int
    results: tuple[ActionResult, ...] = ()
    ended: str = ""
    recording: str = ""

    @property
    def done(self) -> bool:
        """Whether every action was carried out."""
        return len(self.results) == self.actions_planned and all(item.verdict != FAILED for item in self.results)

    @property
    def good(self) -> bool:
        """Whether every action was carried out within its tolerances."""
        return self.done and all(item.verdict == OK for item in self.results)

    @property
    def recordings(self) -> list[str]:
        """Return the recordings of this run and of those that it continues, oldest first."""
        return list(dict.fromkeys(name for name in (*(item.recording for item in self.results), self.recording) if name))

    def as_json(self) -> dict[str, Any]:
        """Return the result as one JSON object."""
        touches = [item.touch for item in self.results if item.touch is not None]
        counts = {
            verdict: sum(item.verdict == verdict for item in self.results) for verdict in (OK, OUT_OF_TOLERANCE, FAILED)
        }
        summary: dict[str, Any] = {"done": self.done, **counts, "touches": len(touches)}
        errors_m = [touch.tip_error_m for touch in touches if touch.tip_error_m is not None]
        if touches:
            summary |= {
                "mean_force_N": float(np.mean([touch.mean_force_N for touch in touches])),
                "force_time_integral_Ns": float(np.sum([touch.force_time_integral_Ns for touch in touches])),
                "contact_loss_share": float(np.mean([touch.contact_loss_share for touch in touches])),
                "tip_error_m": float(np.mean(errors_m)) if errors_m else None,
            }
        return {**msgspec.to_builtins(self), "recordings": self.recordings, "summary": summary}


def new_result_path(directory: Path) -> Path:
    """Return a file name for a result in `directory` that is not taken."""
    return new_recording_path(directory, "protocol-result").with_suffix(".json")


def write_result(result: ProtocolResult, target: Path) -> None:
    """Write the result as JSON, so that a crash or a full disk leaves the one before it. Raises OSError with the path."""
    part = target.with_suffix(".part")
    try:
        part.write_text(json.dumps(plain(result.as_json()), allow_nan=False) + "\n", encoding="utf-8")
        os.replace(part, target)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise OSError(error.errno, error.strerror, str(target)) from None


def read_result(path: Path, protocol: ScriptedProtocol, rig: str, simulated: bool) -> tuple[ActionResult, ...]:
    """Return the results of an earlier run of the same protocol on the same rig, named `rig`, or in its simulation.

    Raises InputError where it is none, of another protocol, or of another rig: a touch in the simulator is none on the rig.
    """
    wanted = "the JSON file of an earlier run of this protocol"
    data = json_of(read_text(path, "--resume", wanted), path, "--resume", wanted)
    try:
        for derived in ("summary", "recordings"):
            data.pop(derived, None)
        result = msgspec.convert(data, ProtocolResult)
    except (ValueError, TypeError):
        raise InputError("--resume", str(path), wanted) from None
    if result.sha256 != protocol.sha256:
        raise InputError("--resume", Description(f"{path}, of another protocol or another version of it"), wanted)
    if (result.rig, result.simulated) != (rig, simulated):
        found = Description(f"{path}, {_carried_out(result.rig, result.simulated)}")
        raise InputError("--resume", found, f"the result of an earlier run {_carried_out(rig, simulated)}")
    return result.results


def _carried_out(rig: str, simulated: bool) -> str:
    return f"in the simulation of rig {rig}" if simulated else f"on the running rig {rig}"
