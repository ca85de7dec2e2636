"""Quantities as people type them: a number in SI, or with a unit after it, such as 2mm, 5deg or 150mN."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence

import numpy as np

from protocol.errors import Description, InputError

# Unit -> (SI unit, factor).
UNITS = {
    "m": ("m", 1.0),
    "mm": ("m", 1e-3),
    "cm": ("m", 1e-2),
    "um": ("m", 1e-6),
    "rad": ("rad", 1.0),
    "deg": ("rad", math.pi / 180.0),
    "N": ("N", 1.0),
    "mN": ("N", 1e-3),
    "g": ("N", 9.80665e-3),
    "s": ("s", 1.0),
    "min": ("s", 60.0),
}
# No catheter reaches further: such a number is in another unit.
FARTHEST_M = 1.0
_NUMBER = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*([a-zA-Z]*)\s*")
# Spaces before a number: those before a unit separate nothing.
_QUANTITIES = re.compile(r"\s+(?=[-+.\d])")


def quantity(key: str, text: str, unit: str) -> float:
    """Return the quantity in `text` in the SI unit `unit` ("m", "rad", "N" or "s").

    Raises:
        InputError: named `key`; it is not a number, or its unit is of another kind.
    """
    match = _NUMBER.fullmatch(text)
    known = [name for name, (si, _) in UNITS.items() if si == unit]
    wanted = f"a number in {unit}, or with a unit after it ({', '.join(known)})"
    if match is None:
        raise InputError(key, text, wanted)
    number, name = float(match[1]), match[2] or unit
    if name not in known or not math.isfinite(number):
        raise InputError(key, text, wanted)
    return number * UNITS[name][1]


def positive(key: str, text: str, unit: str, most: float, what: str = "") -> float:
    """Return the quantity in `text` in the SI unit `unit`, above 0 and at most `most`.

    Raises:
        InputError: named `key`; `what` says whose limit `most` is.
    """
    value = quantity(key, text, unit)
    if not 0.0 < value <= most:
        wanted = f"more than 0, at most {most:.4g} {unit}{f' ({what})' if what else ''}"
        raise InputError(key, text, wanted + meant(text, unit, lambda number: 0.0 < number <= most))
    return value


def meant(text: str, unit: str, fits: Callable[[float], bool]) -> str:
    """Return "; did you mean 5deg?" for a number without a unit that would fit in a smaller one, nothing for any other."""
    match = _NUMBER.fullmatch(text)
    if match is None or match[2]:
        return ""
    smaller = [name for name, (si, size) in UNITS.items() if si == unit and size < 1.0 and fits(float(match[1]) * size)]
    return f"; did you mean {match[1]}{smaller[0]}?" if smaller else ""


def point(key: str, words: Sequence[str]) -> tuple[float, float, float]:
    """Return the point in `words`, m: three quantities with commas or spaces between them. Raises InputError."""
    text = " ".join(words)
    parts = text.split(",") if "," in text else _QUANTITIES.split(text.strip())
    if len(parts) != 3:
        raise InputError(key, text, "three numbers with commas between them, such as 0,-10.7mm,21mm")
    x, y, z = (quantity(key, part, "m") for part in parts)
    if max(abs(x), abs(y), abs(z)) > FARTHEST_M:
        raise InputError(key, text, f"a point within {FARTHEST_M:g} m; mm need their unit, such as -10.7mm")
    return x, y, z


def direction(key: str, text: str) -> tuple[float, float, float]:
    """Return the direction X,Y,Z in `text` as a unit vector. Raises InputError."""
    parts = text.split(",")
    try:
        vector = np.array([float(part) for part in parts])
    except ValueError:
        vector = np.zeros(0)
    size = float(np.linalg.norm(vector)) if vector.shape == (3,) else 0.0
    if not (math.isfinite(size) and size > 1e-9):
        raise InputError(
            key, Description(f'"{text}"'), "three numbers with commas between them, not all zero, such as 0,0,1"
        )
    x, y, z = vector / size
    return float(x), float(y), float(z)
