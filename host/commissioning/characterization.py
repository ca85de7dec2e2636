"""Characterization of a rig (thesis 6.2): sine sweeps of each stage, what they say of the transmission, the calibration."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from host.commissioning.sweep_fits import Estimate, KnobFit, PlayFit, Run, fit_knob, fit_play
from host.recordings.header import header_of
from host.recordings.recording import RecordingFile
from host.recordings.writer import RecordingWriter
from protocol.errors import InputError
from protocol.rig_file import Rig, load_rig, parse_rig, unusual_values
from protocol.text_files import read_toml
from protocol.topics import Message
from protocol.usual_values import warn_of
from realtime.core.lines import FromRig
from realtime.core.sweep import Sweep, SweepLoop, check_sweeps
from sim.board import SimulatedBoard
from sim.tissue import TissueConfig
from sim.world import World, simulated_plant

Array = NDArray[np.float64]
RATES_RAD_PER_S = (0.5, 1.0, 1.5)
INSERTION_AMPLITUDES_M = (0.0075, 0.010)
ROLL_AMPLITUDES_RAD = tuple(math.radians(degrees) for degrees in (20.0, 40.0, 60.0))
KNOB_AMPLITUDE_RAD = math.radians(95.0)
# How far out (m, of the tip) the catheter is for the sweeps of insertion and roll, and how far it is bent for roll.
INSERTION_OUT_M, ROLL_OUT_M, ROLL_KNOB_RAD = 0.050, 0.060, math.radians(45.0)
# Body outside the sheath for the knob's sweep (m), so that the whole distal shaft bends.
KNOB_BODY_OUT_M = 0.006
MAX_BACKLASH_M = 0.012
MAX_ROLL_BACKLASH_RAD = math.radians(20.0)
# The simulated wall stands here (m) for the sweeps: free space.
_NO_WALL = TissueConfig(point_m=(0.0, 0.0, 10.0))


class KnobSweep(NamedTuple):
    """All samples of the knob's sweeps: knob (rad), tip from the distal shaft's proximal end, across and along (m), (6.1)'s
    curvature and the one by the tip's direction (1/m), and the number of the sweep."""

    knob_rad: Array
    lateral_m: Array
    axial_m: Array
    chord_curvature_per_m: Array
    curvature_per_m: Array
    number: NDArray[np.int64]


@dataclass(frozen=True)
class Characterization:
    """What the sweeps of one rig say. Runs are kept for the plots."""

    catheter: str
    distal_length_m: float
    insertion: PlayFit
    roll: PlayFit
    roll_backlash_rad: Estimate
    knob: KnobFit
    insertion_runs: tuple[Run, ...]
    roll_runs: tuple[Run, ...]
    knob_sweep: KnobSweep

    @property
    def insertion_at_home_m(self) -> Estimate:
        """Return the body insertion (m) at stage position zero, in the middle of the backlash."""
        return Estimate(self.insertion.offset.value - self.distal_length_m, self.insertion.offset.half95)


def standard_sweeps(rig: Rig, repeats: int = 5, rates_rad_per_s: Sequence[float] = RATES_RAD_PER_S) -> list[Sweep]:
    """Return the thesis' sweeps for `rig`: two amplitudes of insertion, three of roll, the whole knob; each at all rates.

    Raises ValueError where the rig's travel has no room for them.
    """
    home, length = rig.transmission.insertion_at_home_m, rig.catheter.distal_length_m

    def handle(out_m: float) -> float:
        return (out_m - length - home) / rig.transmission.insertion_slope

    knob_m = min(
        handle(length + KNOB_BODY_OUT_M) + 0.5 * rig.transmission.insertion_backlash_m, rig.stages.insertion.max_unit
    )
    knob_rad = min(KNOB_AMPLITUDE_RAD, 0.97 * rig.stages.knob.max_unit, -0.97 * rig.stages.knob.min_unit)
    kinds = [
        (0, (handle(INSERTION_OUT_M), 0.0, 0.0), INSERTION_AMPLITUDES_M),
        (1, (handle(ROLL_OUT_M), 0.0, ROLL_KNOB_RAD), ROLL_AMPLITUDES_RAD),
        (2, (knob_m, 0.0, 0.0), (knob_rad,)),
    ]
    sweeps = [
        Sweep(axis, centre, amplitude, rate, repeats)
        for axis, centre, amplitudes in kinds
        for amplitude in amplitudes
        for rate in rates_rad_per_s
    ]
    check_sweeps(rig, sweeps)
    return sweeps


def record_simulated(
    rig: Rig,
    sweeps: Sequence[Sweep],
    path: Path,
    seed: int = 1,
    board: str = "auto",
    progress: Callable[[float], None] = lambda share: None,
    **plant_changes: Any,
) -> Path:
    """Drive `sweeps` on the simulated rig in free space, in lock step, into the recording `path`.

    `plant_changes` go to the plant (another truth to be found). Raises BoardUnavailable, ValueError before anything moves,
    RuntimeError where the sweeps were ended early.
    """
    plant = simulated_plant(rig, seed, tissue=_NO_WALL, **plant_changes)
    with (
        SimulatedBoard(board) as made,
        RecordingWriter(path, header_of(rig, "virtual", seed, {"job": "characterize"})) as recording,
    ):
        world = World(rig, plant, made, seed)

        def publish(topic: str, message: Message) -> None:
            recording.write(topic, message, world.now_ns)

        loop = SweepLoop(rig, sweeps, publish)
        leaving, ticks = loop.step(0, FromRig()), 0
        while not loop.done:
            now_ns = world.now_ns + loop.period_ns
            leaving = loop.step(now_ns, world.exchange(now_ns, leaving))
            ticks += 1
            if ticks % 1000 == 0:
                progress(loop.progress)
    if loop.problem:
        raise RuntimeError(f"characterize: {loop.problem}; the sweeps were ended early")
    return path


def characterize(recording: RecordingFile, rig: Rig) -> Characterization:
    """Identify the transmission from a recording of sweeps of `rig`. Raises ValueError where a sweep is missing or of
    another catheter."""
    name = recording.catheter.get("name")
    if name != rig.catheter.name:
        raise InputError.from_sentence(f"recording: found sweeps of catheter {name}, wanted {rig.catheter.name}, the rig's")
    cuts = _Cuts(recording)
    length, tracker = rig.catheter.distal_length_m, rig.tracker
    insertion_runs = tuple(cuts.run(span, 0, _exposed_m(cuts.poses(span).position)) for span in cuts.spans(0))
    insertion = fit_play(insertion_runs, MAX_BACKLASH_M, tracker.position_noise_m)
    roll_runs = []
    for span in cuts.spans(1):
        poses = cuts.poses(span)
        roll_runs.append(cuts.run(span, 1, _roll_rad(poses, tracker.position_noise_m, tracker.orientation_noise_rad)))
    roll, roll_backlash = _fit_roll(roll_runs, tracker.orientation_noise_rad)
    plane_rad = roll.offset.value
    segments: list[KnobSweep] = []
    knob_runs: list[Run] = []
    for span in cuts.spans(2):
        poses = cuts.poses(span)
        handle_m = span.sweep["centre"][0] - 0.5 * insertion.width.value
        body_m = insertion.slope.value * handle_m + insertion.offset.value - length
        segment = _knob_samples(poses, plane_rad, body_m, length, len(segments))
        run = cuts.run(span, 2, segment.curvature_per_m)
        segments.append(segment._replace(knob_rad=run.input_at()))
        knob_runs.append(run)
    knob = fit_knob(knob_runs, tracker.orientation_noise_rad / length)
    sweep = KnobSweep(*(np.concatenate(column) for column in zip(*segments, strict=True)))
    return Characterization(
        rig.catheter.name, length, insertion, roll, roll_backlash, knob, insertion_runs, tuple(roll_runs), sweep
    )


class _Span(NamedTuple):
    start_s: float
    end_s: float
    sweep: dict[str, Any]


class _Poses(NamedTuple):
    time_s: Array
    position: Array
    axis: Array


class _Cuts:
    """The recording's tables, cut at the sweeps' begins and ends."""

    def __init__(self, recording: RecordingFile) -> None:
        self._stage, self._pose = recording.table("stage"), recording.table("pose/tip")
        self._spans: list[_Span] = []
        begun: dict[str, Any] | None = None
        for line in recording.messages("log"):
            if line["source"] != "sweep":
                continue
            event = json.loads(line["text"])
            if event["event"] == "begin":
                begun = {**event, "stamp_ns": line["stamp_ns"]}
            elif begun is not None:
                self._spans.append(_Span(begun["stamp_ns"] * 1e-9, line["stamp_ns"] * 1e-9, begun))

    def spans(self, axis: int) -> list[_Span]:
        found = [span for span in self._spans if span.sweep["axis"] == axis]
        if not found:
            raise InputError.from_sentence(
                f"recording: found no whole sweep of axis {axis}, wanted sweeps of all three stages"
            )
        return found

    def poses(self, span: _Span) -> _Poses:
        t = self._pose["stamp_ns"] * 1e-9
        keep = (t >= span.start_s) & (t <= span.end_s) & np.isfinite(self._pose["x_m"])
        column = self._pose
        w, x, y, z = (column[name][keep] for name in ("qw", "qx", "qy", "qz"))
        axis = np.column_stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
        return _Poses(t[keep] - span.start_s, np.column_stack([column[name][keep] for name in ("x_m", "y_m", "z_m")]), axis)

    def run(self, span: _Span, axis: int, output: Array) -> Run:
        """Return the encoder of `axis` around the sweep, and `output` at the poses of the sweep."""
        t = self._stage["stamp_ns"] * 1e-9
        keep = (t >= span.start_s - 0.1) & (t <= span.end_s + 0.1)
        name = ("encoder_insertion_m", "encoder_roll_rad", "encoder_knob_rad")[axis]
        return Run(
            t[keep] - span.start_s,
            self._stage[name][keep],
            self.poses(span).time_s,
            output,
            float(span.sweep["amplitude"]),
            float(span.sweep["rate_rad_per_s"]),
        )


def _exposed_m(position: Array) -> Array:
    """Arc length (n,) outside the sheath of an arc that ends at `position` (n, 3): (6.1) corrected, straight included."""
    lateral, axial = np.hypot(position[:, 0], position[:, 1]), position[:, 2]
    half = np.arctan2(lateral, axial)
    return np.hypot(lateral, axial) / np.sinc(half / np.pi)


def _roll_rad(poses: _Poses, position_noise_m: float, orientation_noise_rad: float) -> Array:
    """Roll (n,) of the bending plane, unwrapped: from the tip's place and direction across the axis, each by its accuracy.

    At roll zero positive curvature bends towards -e2.
    """
    across = [
        (part[:, 0] * 1j - part[:, 1], noise)
        for part, noise in ((poses.position, position_noise_m), (poses.axis, orientation_noise_rad))
    ]
    total = sum(np.median(np.abs(z)) / noise**2 * z for z, noise in across)
    return np.unwrap(np.angle(total))


def _fit_roll(runs: Sequence[Run], sigma: float) -> tuple[PlayFit, Estimate]:
    """The slope without a gap where the gap is not significant (thesis 6.2.2), with it where it is; and the gap itself."""
    with_gap = fit_play(runs, MAX_ROLL_BACKLASH_RAD, sigma)
    gap = with_gap.width
    if gap.low > 0.0 and gap.value > math.radians(0.5):
        return with_gap, gap
    return fit_play(runs, MAX_ROLL_BACKLASH_RAD, sigma, with_width=False), gap


def _knob_samples(poses: _Poses, plane_rad: float, body_m: float, length_m: float, number: int) -> KnobSweep:
    """Tip and curvature of each pose in the bending plane, from the distal shaft's proximal end, `body_m` out of the
    sheath."""
    across = np.array([math.sin(plane_rad), -math.cos(plane_rad)])
    lateral, axial = poses.position[:, :2] @ across, poses.position[:, 2] - body_m
    bend = np.unwrap(np.arctan2(poses.axis[:, :2] @ across, poses.axis[:, 2]))
    bend -= 2 * np.pi * np.round(np.median(bend) / (2 * np.pi))
    return KnobSweep(
        np.zeros_like(bend),
        lateral,
        axial,
        2 * lateral / (lateral**2 + axial**2),
        bend / length_m,
        np.full(bend.size, number),
    )


def transmission_toml(found: Characterization) -> str:
    """The [transmission] section of a rig file, each value with its 95 % interval as a comment."""

    def line(key: str, value: Estimate, digits: int) -> str:
        return f"{key} = {value.value:.{digits}f}  # 95 %: {value.low:.{digits}f} to {value.high:.{digits}f}"

    knob, edges = found.knob, found.knob.edges_rad
    places, curve = ([round(float(v), 5) for v in column] for column in (knob.knob_rad, knob.curvature_per_m))
    dead = ", ".join(f"{math.degrees(e.value):.2f} +- {math.degrees(e.half95):.2f}" for e in edges)
    return "\n".join(
        [
            "[transmission]                     # characterized by sine sweeps (thesis 6.2)",
            f"catheter = {json.dumps(found.catheter)}",
            line("insertion_at_home_m", found.insertion_at_home_m, 6),
            line("insertion_backlash_m", found.insertion.width, 6),
            line("insertion_slope", found.insertion.slope, 5),
            line("roll_slope", found.roll.slope, 5),
            f"# knob: lower stop, slack from, slack to, upper stop (deg): {dead}",
            f"knob_rad =        {places}",
            f"curvature_per_m = {np.maximum.accumulate(curve).tolist()}",
            "",
        ]
    )


def calibrated_rig_text(rig_text: str, section: str) -> str:
    """Return `rig_text` (a rig file) with `section` in the place of its [transmission] section."""
    pattern = re.compile(r"^\[transmission\].*?(?=^\[|\Z)", re.MULTILINE | re.DOTALL)
    if not pattern.search(rig_text):
        raise InputError.from_sentence("rig file: found no [transmission] section, wanted one to replace")
    return pattern.sub(lambda _: section + "\n", rig_text, count=1)


def load_calibrated_rig(rig_file: str | Path, calibration_file: str | Path | None) -> Rig:
    """The rig of `rig_file` with the transmission of `calibration_file` (a TOML with [transmission]), or as it is.

    Raises InputError: unreadable, out of bounds, or characterized with another catheter.
    """
    if calibration_file is None:
        return load_rig(rig_file)
    load_rig(rig_file)
    data, found = read_toml(rig_file), read_toml(calibration_file)
    if set(found) != {"transmission"}:
        raise InputError.from_sentence(
            f"{calibration_file}: found sections {', '.join(found) or 'none'}, wanted [transmission] alone"
        )
    rig = parse_rig({**data, **found, "catheter": {**data["catheter"], **_named(found)}}, str(calibration_file))
    of, wanted = rig.transmission.catheter, data["catheter"]["name"]
    if of != wanted:
        raise InputError.from_sentence(
            f"{calibration_file}: transmission.catheter: found {of!r}, wanted {wanted!r}, the rig's: "
            "it was calibrated with another catheter"
        )
    warn_of((line for line in unusual_values(rig) if line.startswith("transmission.")), str(calibration_file))
    return rig


def _named(calibration: dict[str, Any]) -> dict[str, Any]:
    """The catheter of a calibration, so that its keys are checked before its catheter is compared."""
    section = calibration["transmission"]
    return {"name": section["catheter"]} if isinstance(section, dict) and "catheter" in section else {}
