"""Files of a characterization: the calibration, the rig file with it, and the page; next to one another."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from host.commissioning.characterization import Characterization, calibrated_rig_text, transmission_toml
from host.commissioning.characterization_report import TableRow, lines_of, write_characterization
from host.commissioning.sweep_fits import Estimate
from protocol.rig_file import Rig, parse_rig
from protocol.text_files import read_text, toml_of


@dataclass(frozen=True)
class CalibrationFiles:
    """Paths of what was written, and the characterization's figures as text lines and as JSON's types."""

    calibration: Path
    rig_file: Path
    page: Path
    lines: Sequence[TableRow]
    report: dict[str, Any]


def write_calibration(
    found: Characterization, rig: Rig, rig_file: Path, recording: Path, directory: Path
) -> CalibrationFiles:
    """Write calibration, rig file with it (checked by reading it back) and page into `directory`, named as the recording.

    Arguments: `rig_file`, whose [transmission] is replaced in the copy.
    Raises: InputError where the result is not a valid rig file; OSError where the folder cannot be written.
    """
    directory.mkdir(parents=True, exist_ok=True)
    section = transmission_toml(found)
    text = calibrated_rig_text(read_text(rig_file), section)
    parse_rig(toml_of(text, "calibrated rig"), "calibrated rig")
    stem = directory / recording.stem
    calibration, whole = stem.with_suffix(".calibration.toml"), stem.with_suffix(".rig.toml")
    calibration.write_text(section, encoding="utf-8")
    whole.write_text(text, encoding="utf-8")
    page = write_characterization(found, stem.with_suffix(".html"), rig.name, recording.name)
    paths = {"calibration": calibration, "rig_file": whole, "report": page, "recording": recording}
    report = {**_figures(found), **{key: str(path) for key, path in paths.items()}}
    return CalibrationFiles(calibration, whole, page, lines_of(found), report)


def _figures(found: Characterization) -> dict[str, Any]:
    def interval(estimate: Estimate) -> dict[str, Any]:
        return {"value": estimate.value, "ci95": [estimate.low, estimate.high]}

    names = ("knob_lower_stop_rad", "knob_slack_from_rad", "knob_slack_to_rad", "knob_upper_stop_rad")
    return {
        "catheter": found.catheter,
        "insertion_backlash_m": interval(found.insertion.width),
        "insertion_slope": interval(found.insertion.slope),
        "insertion_at_home_m": interval(found.insertion_at_home_m),
        "roll_slope": interval(found.roll.slope),
        "roll_backlash_rad": interval(found.roll_backlash_rad),
        **{name: interval(edge) for name, edge in zip(names, found.knob.edges_rad, strict=True)},
        "knob_gain_per_m_rad": [interval(gain) for gain in found.knob.gains_per_m_rad],
        "tracker_noise_m": found.insertion.noise,
        "roll_noise_deg": math.degrees(found.roll.noise),
    }
