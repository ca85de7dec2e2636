"""Recordings of a running rig as the nominal model of kind rig reads them: a row for each frame of the tracker."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import numpy.typing as npt

from host.recordings.recording import RecordingFile
from protocol.errors import Description, InputError
from protocol.rig_file import Rig, parse_rig

Array = npt.NDArray[np.float64]
TOPICS = ("stage", "pose/tip", "pose/shaft", "force/sensor")
FORCE_HALF_S = 0.005  # forces this near a frame are averaged into its row
LATEST_S = 0.03  # an encoder reading is never taken for older than this
POSE = ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")


def rig_of(files: list[Path]) -> Rig:
    """The rig that all `files` were recorded on, from the configuration each carries. Raises InputError."""
    found: Rig | None = None
    for path in files:
        data = _open(path).configuration
        try:
            rig = parse_rig(data, path.name)
        except InputError as error:
            raise InputError("recording", str(error), "a recording that carries the configuration of its rig") from None
        if found is not None and (rig.transmission, rig.catheter) != (found.transmission, found.catheter):
            raise InputError(
                "recording", f"{path.name} with another catheter or calibration than {files[0].name}", "one rig"
            )
        found = rig
    assert found is not None
    return found


def rig_rows(path: Path) -> dict[str, Array]:
    """Columns of kind rig (docs/nominal-models.md), a row for each frame of the tracker.

    handle_insertion_m is behind the backlash of the rig's configuration, handle_knob_rad behind its knob curve (curvature
    over `knob_gain`): what is known of the transmission is taken off before anything is compared. Raises InputError.
    """
    recording = _open(path)
    rig = rig_of([path])
    tip, shaft, force = (recording.table(name) for name in TOPICS[1:])
    stamps = _even(_seconds(tip), 1.0 / rig.tracker.rate_hz)
    stage_s, handle = _handle(recording, rig)
    stamps = stamps[(stamps >= stage_s[0]) & (stamps <= stage_s[-1])]
    if stamps.size < 50:
        raise InputError("recording", f"{path.name} with {stamps.size} frames of the tracker", "at least 50")
    columns = {"time_s": stamps}
    names = ("handle_insertion_m", "handle_roll_rad", "handle_knob_rad")
    columns |= {name: np.interp(stamps, stage_s, values) for name, values in zip(names, handle, strict=True)}
    for name, table in (("tip", tip), ("shaft", shaft)):
        columns |= {f"{name}_{key}": values for key, values in _placed(table, stamps, 1.0 / rig.tracker.rate_hz).items()}
    columns |= _forces(force, stamps)
    return columns


def _open(path: Path) -> RecordingFile:
    if not path.is_file():
        raise InputError("recording", str(path), "a file that exists")
    try:
        recording = RecordingFile(path)
    except InputError as error:
        raise InputError("recording", Description(f"{path.name}: {error.found}"), error.wanted) from None
    missing = [topic for topic in TOPICS if not recording.topics.get(topic)]
    if missing:
        raise InputError("recording", f"{path.name} without {', '.join(missing)}", "a recording of a running rig (MCAP)")
    return recording


def _seconds(table: dict[str, Array]) -> Array:
    return np.asarray(table["stamp_ns"] * 1e-9)


def _even(stamps: Array, period_s: float) -> Array:
    """The stamps of all frames, those that were lost put between."""
    stamps = np.unique(stamps)
    out = [stamps[:1]]
    for a, b in itertools.pairwise(stamps):
        steps = max(1, round((b - a) / period_s))
        out.append(a + (b - a) * np.arange(1, steps + 1) / steps)
    return np.concatenate(out)


def _handle(recording: RecordingFile, rig: Rig) -> tuple[Array, list[Array]]:
    """Times (n,), and insertion behind the known play, roll, knob behind its known curve."""
    table = recording.table("stage")
    axes = ("insertion_m", "roll_rad", "knob_rad")
    encoders = np.vstack([table[f"encoder_{axis}"] for axis in axes])
    known = np.isfinite(encoders).all(axis=0)
    if not known.any():
        raise InputError("recording", f"{recording.path.name} without encoder readings", "stages with encoders")
    time_s, encoders = _seconds(table)[known], encoders[:, known]
    commands = np.vstack([table[f"command_{axis}"] for axis in axes])[:, known]
    time_s = time_s - staleness(time_s, commands, encoders, rig.board.setpoint_lead_s)
    t = rig.transmission
    body, half = np.empty(time_s.size), 0.5 * t.insertion_backlash_m
    at = encoders[0, 0]
    for i, handle in enumerate(encoders[0]):
        at = min(max(at, handle - half), handle + half)
        body[i] = at
    return time_s, [body, encoders[1], np.interp(encoders[2], t.knob_rad, t.curvature_per_m) / knob_gain(rig)]


def knob_gain(rig: Rig) -> float:
    """Steepest slope (1/(m rad)) of the rig's knob curve: what the knob does where it has no play."""
    t = rig.transmission
    return float(np.max(np.diff(t.curvature_per_m) / np.diff(t.knob_rad)))


def staleness(time_s: Array, commands: Array, encoders: Array, lead_s: float) -> float:
    """Return the age (s) of the encoder readings at their stamps: a command is executed lead_s after its own.

    From the recorded commands and encoders (3, n) alone, by their changes; 0 where no stage has moved.
    """
    above = below = 0.0
    for command, encoder in zip(commands, encoders, strict=True):
        speed = np.gradient(command, time_s)
        size = float(np.sqrt(np.mean(speed**2)))
        if size * lead_s > 1e-9:
            lag, change = encoder - command, speed - np.mean(speed)
            above -= float(np.sum((lag - np.mean(lag)) * change)) / size**2
            below += float(np.sum(change**2)) / size**2
    return float(np.clip(above / below - lead_s, 0.0, LATEST_S)) if below else 0.0


def _placed(table: dict[str, Array], stamps: Array, period_s: float) -> dict[str, Array]:
    """Poses of one tool at `stamps`, NaN where its frame was lost."""
    seconds = _seconds(table)
    nearest = np.clip(np.searchsorted(seconds, stamps - 0.5 * period_s), 0, seconds.size - 1)
    good = (np.abs(seconds[nearest] - stamps) < 0.5 * period_s) & ~table["missing"][nearest].astype(bool)
    return {name: np.where(good, table[name][nearest], np.nan) for name in POSE}


def _forces(table: dict[str, Array], stamps: Array) -> dict[str, Array]:
    """Forces averaged about `stamps`, NaN where there was none."""
    healthy = table["status"] == 0
    seconds = _seconds(table)[healthy]
    first, last = (np.searchsorted(seconds, stamps + side) for side in (-FORCE_HALF_S, FORCE_HALF_S))
    out = {}
    for axis in "xyz":
        total = np.concatenate(([0.0], np.cumsum(table[f"f{axis}_N"][healthy])))
        count = last - first
        out[f"force_{axis}_N"] = np.where(count > 0, (total[last] - total[first]) / np.maximum(count, 1), np.nan)
    return out
