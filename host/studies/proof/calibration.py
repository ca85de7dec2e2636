"""Stated probabilities turned into those that held on other suites: beta calibration (Kull, Silva Filho and Flach 2017).

The log-odds become a log p - b log(1 - p) + c. With a = b this is a slope and a shift of the log-odds (Platt 1999). The
curve is fitted on worlds and seeds apart from those that judge it:

    python -m host.studies.proof.calibrate --dir runs/prove_7 --leave-out ode --out calibration.json

There are three kinds of statements with a curve each: a named effect is there (`effect`); none of the vocabulary is
missing, where an effect of it is named (`none`) and where nothing is named (`absent`). Where an equation is named, the
verdict's statement on the vocabulary is that the equation is right, so it has the curve of effects. A finder keeps the
values before calibration as `probability_raw` and `probability_none_raw`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

from host.diagnosis.selection.posterior import EDGE, calibrated

PRIOR = 2.0  # standard deviation of log a, log b and c about 0: a handful of statements moves none far
Calibration = Callable[[str, Mapping[str, Any]], float]
KINDS = ("effect", "none", "absent")
_NONE = ("probability_none_raw", "probability_none")
_KEYS = {"effect": ("probability_raw", "probability"), "none": _NONE, "absent": _NONE, "equation": _NONE}
_CURVE = {"equation": "effect"}


def as_stated(kind: str, source: Mapping[str, Any]) -> float:
    """Return the probability that the verdict itself states, of `kind` effect, none, absent or equation."""
    return float(source[_KEYS[kind][1]])


def kind_of_none(verdict: Mapping[str, Any]) -> str:
    """Return the kind of a verdict's statement that no effect of the vocabulary is missing: none, absent or equation."""
    if verdict.get("verdict") != "missing_physics":
        return "absent"
    return "equation" if (verdict.get("effects") or [{}])[0].get("id") == "unlisted" else "none"


def raw_probability(kind: str, source: Mapping[str, Any]) -> float | None:
    """Return the probability before calibration that an effect or a verdict states, or the stated one, or None."""
    raw, stated = _KEYS[kind]
    p = source.get(raw, source.get(stated))
    return float(p) if isinstance(p, (int, float)) else None


@dataclass(frozen=True)
class Curve:
    """p' = 1 / (1 + exp(-(a log p - b log(1 - p) + c))), a and b positive."""

    a: float = 1.0
    b: float = 1.0
    c: float = 0.0

    def __call__(self, p: float) -> float:
        """Return the calibrated probability of a stated one."""
        return calibrated(p, self.a, self.b, self.c)


@dataclass(frozen=True)
class CalibrationTable:
    """A curve for each of KINDS, and what they were fitted on."""

    curves: dict[str, Curve]
    source: dict[str, Any]

    def __call__(self, kind: str, source: Mapping[str, Any]) -> float:
        """Return the calibrated probability of an effect's or a verdict's raw one (the stated one where there is no raw)."""
        p = raw_probability(kind, source)
        return self.curves[_CURVE.get(kind, kind)](1.0 if p is None else p)

    def write(self, path: Path) -> None:
        """Write the table as JSON."""
        content = {**{kind: asdict(self.curves[kind]) for kind in KINDS}, "source": self.source}
        path.write_text(json.dumps(content, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def read(path: Path) -> CalibrationTable:
    """Return the table that `Table.write` wrote. Raises OSError, KeyError, ValueError for a file that is none."""
    content = json.loads(path.read_text(encoding="utf-8"))
    return CalibrationTable({kind: Curve(**content[kind]) for kind in KINDS}, content["source"])


def fit(statements: Sequence[tuple[float, bool]]) -> Curve:
    """Return the curve that makes `statements` (raw probability, whether true) likeliest; the identity of none."""
    if not statements:
        return Curve()
    p = np.clip([stated for stated, _ in statements], EDGE, 1.0 - EDGE)
    y = np.array([float(true) for _, true in statements])

    def cost(z: np.ndarray) -> float:
        odds = math.exp(z[0]) * np.log(p) - math.exp(z[1]) * np.log1p(-p) + z[2]
        return float(np.sum(np.logaddexp(0.0, odds) - y * odds) + 0.5 * np.sum((z / PRIOR) ** 2))

    found = minimize(cost, np.zeros(3), method="BFGS").x
    return Curve(float(math.exp(found[0])), float(math.exp(found[1])), float(found[2]))
