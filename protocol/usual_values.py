"""Usual ranges of the numbers in rig and catheter files: a value outside is accepted, with a warning that names a unit slip.

The bounds in `rig_file` and `catheter` refuse what no rig can mean. Between them and the usual values there is room for a
number that is wrong by 1000 (mm for m, or converted twice) or by 57.3 (degrees for rad), but also for uncommon devices.
The ranges are wide: about a factor of 30 to both sides of the devices that docs/devices.md describes. Zero switches a
function off in many keys, so it is never unusual. Of a list the largest value counts.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from typing import Any

from protocol.unit_slips import hint, reverse_hint

Range = tuple[float, float]


class UnusualValue(UserWarning):
    """A value that is accepted, but is probably in another unit."""


_TURN: dict[str, Range] = {
    "steps_per_unit": (100, 2e5),
    "encoder_counts_per_step": (0.05, 50),
    "max_speed_unit_per_s": (0.2, 60),
    "max_accel_unit_per_s2": (5, 5000),
    "min_unit": (0.2, 40),
    "max_unit": (0.2, 40),
}
# Key -> smallest and largest usual size (of the absolute value), in the key's unit.
RIG: dict[str, Range] = {
    "catheter.max_curvature_per_m": (5, 100),
    "stages.insertion.encoder_counts_per_step": (0.05, 50),
    "stages.insertion.min_unit": (0.001, 0.5),
    "stages.insertion.max_unit": (0.002, 0.5),
    **{f"stages.{axis}.{key}": limits for axis in ("roll", "knob") for key, limits in _TURN.items()},
    "transmission.insertion_at_home_m": (0.002, 0.4),
    "transmission.insertion_backlash_m": (0.0001, 0.01),
    "transmission.knob_rad": (0.2, 30),
    "transmission.curvature_per_m": (5, 100),
    "tracker.latency_s": (0.001, 0.15),
    "tracker.shaft_sensor_offset_m": (0.003, 0.15),
    "tracker.position_noise_m": (2e-5, 0.003),
    "tracker.orientation_noise_rad": (0.0002, 0.05),
    "tracker.base_from_tracker_m": (0.005, 1.5),
    "force_sensor.noise_N": (0.0002, 0.05),
    "force_sensor.range_N": (1, 300),
    "control.position_gain_per_s": (0.2, 40),
    "control.position_integral_per_s2": (0.01, 25),
    "control.force_gain_m_per_N": (1e-4, 0.05),
    "control.force_integral_m_per_N_s": (1e-4, 0.1),
    "control.approach_speed_m_per_s": (0.0005, 0.02),
    "control.reversal_threshold_m": (1e-5, 0.002),
    "control.acceleration_noise_m_per_s2": (0.001, 1),
    "control.pi_position_gain": (0.005, 2),
    "control.pi_position_integral_per_s": (0.01, 10),
    "control.pi_force_gain_m_per_N": (0.003, 0.5),
    "control.pi_force_integral_m_per_N_s": (0.005, 1),
    "control.move_speed_m_per_s": (0.001, 0.05),
    "control.move_accel_m_per_s2": (0.01, 2),
    "control.slide_speed_m_per_s": (0.0002, 0.02),
    "control.force_slew_N_per_s": (0.02, 2),
    "control.force_margin_N": (0.002, 0.1),
    "control.tip_compliance_m_per_N": (0.0005, 0.1),
    "control.stiffness_sd": (0.002, 0.5),
    "control.reversal_share": (0.05, 2),
    "control.reversal_depth_m": (5e-6, 0.002),
    "control.play_noise_m": (2e-6, 0.001),
    "control.blind_approach_share": (0.05, 1),
    "control.play_caution_m": (1e-5, 0.001),
    "control.play_sd_m": (1e-5, 0.001),
    "estimation.insertion_sd_m": (2e-5, 0.01),
    "estimation.curvature_sd_per_m": (0.02, 20),
    "estimation.roll_sd_rad": (0.003, 1),
    "estimation.stiffness_sd": (0.002, 0.5),
    "estimation.free_force_sd_N": (0.002, 2),
    "estimation.contact_force_sd_N": (0.05, 10),
    "estimation.tangential_force_sd_N": (0.001, 1),
    "estimation.insertion_walk_m": (3e-6, 0.003),
    "estimation.curvature_walk_per_m": (0.001, 1),
    "estimation.roll_walk_rad": (0.003, 1),
    "estimation.adaptation_limit": (0.01, 0.3),
    "estimation.adaptation_sd": (0.003, 0.5),
    "estimation.curvature_exponent": (0.05, 1),
    "safety.workspace_min_m": (0.01, 1),
    "safety.workspace_max_m": (0.01, 1),
}
# The counts of the box itself; other kinds of force sensor have none. Its page has N and N m, or units near them.
NET_FT: dict[str, Range] = {
    "force_sensor.counts_per_newton": (5e4, 5e7),
    "force_sensor.counts_per_newton_metre": (1e6, 5e10),
}
# From a 3 F microcatheter to a stiff 12 F sheath.
_STIFFNESS: Range = (1e-5, 1e-2)
CATHETER: dict[str, Range] = {
    "distal_length_m": (0.01, 0.3),
    "diameter_m": (0.0006, 0.006),
    "pull_wire_offset_m": (0.0001, 0.003),
    "pcar.EI_N_m2": _STIFFNESS,
    **{f"cosserat.{name}_N_m2": _STIFFNESS for name in ("EI1", "EI2", "GJ", "EbI1", "EbI2", "GbJ")},
    "constitutive.friction_coefficient": (0.005, 1),
    "constitutive.cubic_stiffening_m2": (1e-7, 0.01),
}


def unusual(content: Mapping[str, Any], ranges: Mapping[str, Range]) -> list[str]:
    """Return a line for each value of `content` outside its usual range.

    Args:
        content: sections and keys, as in the file.
        ranges: usual sizes by dotted key, such as RIG. A key that `content` lacks is left out.

    Returns:
        Lines such as "tracker.latency_s: found 2.5e-05, usual 0.001 to 0.15; 2.5e-05 s is 0.025 ms".
    """
    lines = []
    for key, (low, high) in ranges.items():
        value = _value(content, key.split("."))
        if value and not low <= abs(value) <= high:
            lines.append(f"{key}: found {value:g}, usual {low:g} to {high:g}{_slip(key, value, low, high)}")
    return lines


def _slip(key: str, value: float, low: float, high: float) -> str:
    def fits(number: float) -> bool:
        return low <= abs(number) <= high

    place = tuple(key.split("."))
    return hint(place, value, fits) or reverse_hint(place, value, fits)


def _value(content: Mapping[str, Any], keys: list[str]) -> float:
    """The number at `keys`; of a list the one with the largest size; 0 where there is none."""
    found: Any = content
    for key in keys:
        found = found.get(key) if isinstance(found, Mapping) else None
    if isinstance(found, list | tuple):
        return max((float(item) for item in found), key=abs, default=0.0)
    return float(found) if isinstance(found, int | float) and not isinstance(found, bool) else 0.0


def warn_of(lines: Iterable[str], file: str) -> None:
    """Give a Python warning (UnusualValue) for each line about `file`; each is shown once in a process."""
    for line in lines:
        warnings.warn(f"{file}: {line}", UnusualValue, stacklevel=1)
