"""Quantities in units that are easy to read: millimetres, milliradians, millinewtons where the numbers are small."""

from __future__ import annotations

import math

PREFIXED = ("m", "rad", "s", "N", "N m", "m/s", "rad/s", "V", "A")
STEPS = ((1.0, ""), (1e-3, "m"), (1e-6, "µ"))


def scaled(unit: str, largest: float) -> tuple[float, str]:
    """(size of the unit to show in SI, its name) for numbers up to `largest`."""
    if unit not in PREFIXED or not 0.0 < largest < math.inf:
        return 1.0, unit
    for size, prefix in STEPS:
        if largest >= 0.1 * size:
            return size, prefix + unit
    return STEPS[-1][0], STEPS[-1][1] + unit


def short(value: float) -> str:
    """Return `value` with three significant digits, a dash if it is not finite."""
    return f"{value:.3g}" if math.isfinite(value) else "–"


def quantity(value: float, unit: str, largest: float | None = None) -> str:
    """`value` (SI) with its unit, scaled for `largest` (its own size where that is left out)."""
    size, name = scaled(unit, abs(value) if largest is None else largest)
    return f"{short(value / size)} {name}".strip()


def interval(low: float, high: float, unit: str, value: float) -> str:
    """Both ends (SI) in the unit that shows `value`."""
    size, name = scaled(unit, max(abs(value), abs(low), abs(high)) if math.isfinite(low + high) else abs(value))
    return f"{short(low / size)} … {short(high / size)} {name}".strip()
