"""Stated probabilities turned into those that held on other suites: a slope and a shift of the log-odds (Platt 1999).

With slope 1 / T and no shift this is temperature scaling (Guo et al. 2017). It is fitted on worlds and seeds apart from
those that judge it:

    python -m host.studies.proof.calibrate --dir runs/prove_7 --leave-out ode --out calibration.json

A finder applies the file with `Calibration.read(path)` to the raw probabilities of its effects (`effect`) and of an adequate
model (`none`), and keeps the raw ones as `probability_raw` and `probability_none_raw`.
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
_KEYS = {"effect": ("probability_raw", "probability"), "none": ("probability_none_raw", "probability_none")}


def as_stated(kind: str, source: Mapping[str, Any]) -> float:
    """Return the probability that the verdict itself states, of `kind` effect or none."""
    return float(source[_KEYS[kind][1]])


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
    """Curves of both kinds of statements, and what they were fitted on."""

    effect: Curve
    none: Curve
    source: dict[str, Any]

    def __call__(self, kind: str, source: Mapping[str, Any]) -> float:
        """Return the calibrated probability of an effect's or a verdict's raw one (the stated one where there is no raw)."""
        raw, stated = _KEYS[kind]
        p = source.get(raw, source.get(stated))
        return (self.effect if kind == "effect" else self.none)(float(p if p is not None else 1.0))

    def write(self, path: Path) -> None:
        """Write the table as JSON."""
        content = {"effect": asdict(self.effect), "none": asdict(self.none), "source": self.source}
        path.write_text(json.dumps(content, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def read(path: Path) -> CalibrationTable:
    """Return the table that `Table.write` wrote. Raises OSError, KeyError, ValueError for a file that is none."""
    content = json.loads(path.read_text(encoding="utf-8"))
    return CalibrationTable(Curve(**content["effect"]), Curve(**content["none"]), content["source"])


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
