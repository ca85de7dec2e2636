"""Units as people write them in a nominal model: read, checked, and brought into one spelling.

The diagnosis decides by units: a channel in N or N m is a force, one in rad is an angle. A unit that is not understood would
silently be none of these.
"""

from __future__ import annotations

import math
import re

# Symbol -> its size in SI. Prefixes apply to those of the first group.
_PREFIXABLE = {
    **dict.fromkeys(("m", "s", "A", "K", "mol", "cd", "rad", "sr", "Hz", "N", "Pa", "J", "W", "C", "V", "F", "S"), 1.0),
    **dict.fromkeys(("Wb", "T", "H", "lm", "lx", "ohm"), 1.0),
    "g": 1e-3,
    "l": 1e-3,
    "L": 1e-3,
    "bar": 1e5,
}
_PLAIN = {
    **dict.fromkeys(("1", "count", "counts", "step", "steps", "px", "degC"), 1.0),
    "deg": math.pi / 180.0,
    "rev": 2.0 * math.pi,
    "rpm": 2.0 * math.pi / 60.0,
    "min": 60.0,
    "h": 3600.0,
    "in": 0.0254,
    "mmHg": 133.322,
    "psi": 6894.757,
    "%": 0.01,
}
_BASES = {
    "g": "kg",
    "deg": "rad",
    "rev": "rad",
    "min": "s",
    "h": "s",
    "in": "m",
    "bar": "Pa",
    "mmHg": "Pa",
    "psi": "Pa",
    "%": "1",
}
_PREFIXES = {"G": 1e9, "M": 1e6, "k": 1e3, "d": 1e-1, "c": 1e-2, "m": 1e-3, "u": 1e-6, "n": 1e-9, "p": 1e-12}
_SYMBOLS = {prefix + symbol: factor * size for symbol, size in _PREFIXABLE.items() for prefix, factor in _PREFIXES.items()}
# `min` is a minute and `cd` a candela, whatever a prefix would make of them.
_SYMBOLS |= _PREFIXABLE | _PLAIN
_SPELLINGS = {"°C": "degC", "°": "deg", "Ω": "ohm", "µ": "u", "μ": "u", "²": "2", "³": "3", "**": "^", "·": " ", "*": " "}
_JOINED = {"Nm": "N m", "mNm": "mN m", "kNm": "kN m", "Nms": "N m s", "Nmm": "N mm", "gf": "g"}
_FACTOR = re.compile(r"(%|[A-Za-z]+|1)\^?(-?\d)?")
_WORDS = {
    "newton": "N",
    "metre": "m",
    "meter": "m",
    "radian": "rad",
    "degree": "deg",
    "second": "s",
    "sec": "s",
    "gram": "g",
    "gramme": "g",
    "volt": "V",
    "ampere": "A",
    "amp": "A",
    "watt": "W",
    "joule": "J",
    "kelvin": "K",
    "celsius": "degC",
    "pascal": "Pa",
    "hertz": "Hz",
    "minute": "min",
    "hour": "h",
    "percent": "%",
    "inch": "in",
    "inches": "in",
    "revolution": "rev",
    "turn": "rev",
    "tick": "counts",
    "pixel": "px",
    "-": "1",
    "dimensionless": "1",
    "unitless": "1",
}
_PREFIX_WORDS = {"micro": "u", "milli": "m", "centi": "c", "kilo": "k", "mega": "M", "nano": "n"}


def unit(text: str) -> str:
    """Return the unit in `text` in one spelling: symbols with spaces between them and one "/", such as "N m" or "m/s2".

    Raises ValueError with what is wanted, as pydantic's validators do.
    """
    if not text.strip():
        return ""
    read = _read(text)
    if read is not None:
        return read[0]
    meant = _meant(text)
    wanted = "the symbols of a unit, such as N, m, rad, s, N m, m/s, kg m2 or counts"
    raise ValueError(f"{wanted}; {text} is {meant}" if meant else wanted)


def size(text: str) -> float:
    """Return the size of a unit in SI; 1 for an empty text. Raises ValueError for one that is not known."""
    read = _read(unit(text)) if text.strip() else None
    return 1.0 if read is None else read[1]


def coherent(text: str) -> str:
    """Return the SI unit of the quantity that the unit `text` measures: "m/s" for "mm/s", "rad" for "deg".

    Raises ValueError for one that is not known.
    """
    return re.sub(r"[A-Za-z%]+", lambda symbol: _base(symbol[0]), unit(text))


def _base(symbol: str) -> str:
    """The SI unit of one symbol; itself where SI has none of its own."""
    if symbol in _BASES or symbol in _PREFIXABLE or symbol in _PLAIN:
        return _BASES.get(symbol, symbol)
    base = next(name for name in _PREFIXABLE if symbol.endswith(name) and symbol.removesuffix(name) in _PREFIXES)
    return _BASES.get(base, base)


def _read(text: str) -> tuple[str, float] | None:
    """Spelling and size in SI of a unit; None where it is not known."""
    for odd, plain in _SPELLINGS.items():
        text = text.replace(odd, plain)
    parts = [part.strip() for part in text.strip().split("/")]
    if len(parts) > 2 or not all(parts):
        return None
    if len(parts) == 2:
        parts[1] = parts[1].removeprefix("(").removesuffix(")")
    spelled, total = [], 1.0
    for part, sign in zip(parts, (1, -1), strict=False):
        factors = " ".join(_JOINED.get(word, word) for word in part.split()).split()
        for factor in factors:
            match = _FACTOR.fullmatch(factor)
            if match is None or match[1] not in _SYMBOLS:
                return None
            total *= _SYMBOLS[match[1]] ** (sign * int(match[2] or 1))
        spelled.append(" ".join(factor.replace("^", "") for factor in factors))
    if len(spelled) == 2 and " " in spelled[1]:
        spelled[1] = f"({spelled[1]})"
    return "/".join(spelled), total


def _meant(text: str) -> str:
    """The symbols of a unit that was written in words or in another case; empty where none is known."""
    words = re.split(r"(\s+per\s+|[\s*/]+)", text.strip().lower())
    symbols = []
    for place, word in enumerate(words):
        if place % 2:
            symbols.append("/" if "per" in word or "/" in word else " ")
            continue
        found = _symbol(word)
        if not found:
            return ""
        symbols.append(found)
    return "".join(symbols)


def _symbol(word: str) -> str:
    for name in (word, word.removesuffix("s")):
        if name in _WORDS:
            return _WORDS[name]
        for prefix, short in _PREFIX_WORDS.items():
            if name.removeprefix(prefix) in _WORDS and name.startswith(prefix):
                return short + _WORDS[name.removeprefix(prefix)]
    same = [symbol for symbol in (*_PREFIXABLE, *_PLAIN, "kg", "mm", "um", "ms", "mN") if symbol.lower() == word]
    return same[0] if len(same) == 1 else ""
