"""Units that a value may have been typed in by mistake: 50 for 50 mm where metres are wanted."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

# Ending of a key -> (SI unit, {unit that people write: its size in that SI unit}). The first ending that fits counts.
_ENDINGS: tuple[tuple[str, str, dict[str, float]], ...] = (
    ("_m_per_s2", "m/s2", {"mm/s2": 1e-3}),
    ("_m_per_s", "m/s", {"mm/s": 1e-3}),
    ("_m_per_N_s", "m/(N s)", {"mm/(N s)": 1e-3}),
    ("_m_per_N", "m/N", {"mm/N": 1e-3}),
    ("_N_per_s", "N/s", {"mN/s": 1e-3}),
    ("_N_m2", "N m2", {"N mm2": 1e-6}),
    ("_per_m", "1/m", {"1/mm": 1e3}),
    ("_hz", "Hz", {"kHz": 1e3}),
    ("_rad", "rad", {"degrees": math.pi / 180.0}),
    ("_N", "N", {"mN": 1e-3, "g": 9.80665e-3}),
    ("_s", "s", {"ms": 1e-3, "us": 1e-6}),
    ("_m", "m", {"mm": 1e-3, "um": 1e-6}),
)
# Of the sections of a rig file whose keys end in `unit`: m for insertion, rad for the others.
_STAGE_UNITS = {
    "insertion": ("m", {"mm": 1e-3}),
    "roll": ("rad", {"degrees": math.pi / 180.0}),
    "knob": ("rad", {"degrees": math.pi / 180.0}),
}


def hint(place: tuple[Any, ...], value: object, fits: Callable[[float], bool]) -> str:
    """Say that `value` looks like one in another unit.

    Args:
        place: keys from the top to the value; a position in a list counts as part of the key before it.
        value: what was found.
        fits: whether a number in the key's SI unit is accepted.

    Returns:
        "; in m: 50 mm is 0.05", or nothing where no unit explains the value.
    """
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value) or fits(float(value)):
        return ""
    si, sizes = _units(place)
    for unit, size in sizes.items():
        if fits(value * size):
            return f"; in {si}: {value:g} {unit} is {value * size:.6g}"
    return ""


def reverse_hint(place: tuple[Any, ...], value: float, fits: Callable[[float], bool]) -> str:
    """Say that `value` looks like one that was converted twice, or that a smaller unit would explain it.

    Args and fits as in `hint`.

    Returns:
        "; 2.5e-05 s is 0.025 ms", or nothing where no unit explains the value.
    """
    si, sizes = _units(place)
    for unit, size in sizes.items():
        if fits(value / size):
            return f"; {value:g} {si} is {value / size:.6g} {unit}"
    return ""


def hint_of(error: Mapping[str, Any]) -> str:
    """The hint for one of pydantic's errors about a bound of a number; nothing for any other."""
    context = error.get("ctx") or {}
    bounds = {key: context[key] for key in ("gt", "ge", "lt", "le") if isinstance(context.get(key), int | float)}
    return hint(tuple(error["loc"]), error.get("input"), lambda number: _within(number, bounds)) if bounds else ""


def _within(number: float, bounds: Mapping[str, float]) -> bool:
    return (
        number > bounds.get("gt", -math.inf)
        and number >= bounds.get("ge", -math.inf)
        and number < bounds.get("lt", math.inf)
        and number <= bounds.get("le", math.inf)
    )


def _units(place: tuple[Any, ...]) -> tuple[str, dict[str, float]]:
    names = [str(part) for part in place if not isinstance(part, int)]
    if not names:
        return "", {}
    key, section = names[-1], names[-2] if len(names) > 1 else ""
    if section in _STAGE_UNITS:
        si, sizes = _STAGE_UNITS[section]
        if key == "steps_per_unit":
            return f"steps/{si}", {f"steps/{unit}": 1.0 / size for unit, size in sizes.items()}
        for ending, over in (("unit_per_s2", "/s2"), ("unit_per_s", "/s"), ("unit", "")):
            if key.endswith(ending):
                return si + over, {unit + over: size for unit, size in sizes.items()}
    for ending, si, sizes in _ENDINGS:
        if key.endswith(ending):
            return si, sizes
    return "", {}
