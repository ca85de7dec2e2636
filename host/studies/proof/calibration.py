"""Stated probabilities turned into those that held on other suites: a slope and a shift of the log-odds (Platt 1999).

With slope 1 / T and no shift this is temperature scaling (Guo et al. 2017). It is fitted on worlds and seeds apart from
those that judge it:

    python -m host.studies.proof.calibrate --dir runs/prove_7 --leave-out ode --out calibration.json

There are three kinds of statements: a named effect is there (`effect`); none of the vocabulary is missing, where an effect
is named (`none`); the same, where nothing is named (`absent`). A finder keeps the values before calibration as
`probability_raw` and `probability_none_raw`.
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

PRIOR = 2.0  # standard deviation of log slope and shift about 0: a handful of statements moves neither far
EDGE = 1e-4  # probabilities are kept this far from 0 and 1
Calibration = Callable[[str, Mapping[str, Any]], float]
KINDS = ("effect", "none", "absent")
_NONE = ("probability_none_raw", "probability_none")
_KEYS = {"effect": ("probability_raw", "probability"), "none": _NONE, "absent": _NONE}


def as_stated(kind: str, source: Mapping[str, Any]) -> float:
    """Return the probability that the verdict itself states, of `kind` effect, none or absent."""
    return float(source[_KEYS[kind][1]])


def kind_of_none(verdict: Mapping[str, Any]) -> str:
    """Return the kind of a verdict's statement on "none of the vocabulary": `none` next to a named effect, else `absent`."""
    return "none" if verdict.get("verdict") == "missing_physics" else "absent"


def raw_probability(kind: str, source: Mapping[str, Any]) -> float | None:
    """Return the probability before calibration that an effect or a verdict states, or the stated one, or None."""
    raw, stated = _KEYS[kind]
    p = source.get(raw, source.get(stated))
    return float(p) if isinstance(p, (int, float)) else None


@dataclass(frozen=True)
class Curve:
    """p' = 1 / (1 + exp(-(slope * logit(p) + shift)))."""

    slope: float = 1.0
    shift: float = 0.0

    def __call__(self, p: float) -> float:
        """Return the calibrated probability of a stated one."""
        return 1.0 / (1.0 + math.exp(-(self.slope * _logit(p) + self.shift)))


@dataclass(frozen=True)
class CalibrationTable:
    """A curve for each of KINDS, and what they were fitted on."""

    curves: dict[str, Curve]
    source: dict[str, Any]

    def __call__(self, kind: str, source: Mapping[str, Any]) -> float:
        """Return the calibrated probability of an effect's or a verdict's raw one (the stated one where there is no raw)."""
        p = raw_probability(kind, source)
        return self.curves[kind](1.0 if p is None else p)

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
    x = np.array([_logit(p) for p, _ in statements])
    y = np.array([float(true) for _, true in statements])

    def cost(z: np.ndarray) -> float:
        odds = math.exp(z[0]) * x + z[1]
        return float(np.sum(np.logaddexp(0.0, odds) - y * odds) + 0.5 * np.sum((z / PRIOR) ** 2))

    found = minimize(cost, np.zeros(2), method="BFGS").x
    return Curve(float(math.exp(found[0])), float(found[1]))


def _logit(p: float) -> float:
    q = min(max(p, EDGE), 1.0 - EDGE)
    return math.log(q / (1.0 - q))
