"""The proof's table (docs/proof.md): figures of all cases by name, and as rows of text."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from host.studies.proof.scoring import Facts, mean

KEYS = (
    "null_cases",
    "false_alarms",
    "detected_rho_0.25",
    "detected_rho_0.5",
    "named_first",
    "truth_in_set",
    "confident_wrong_in_library",
    "confident_wrong_outside",
    "subsystem_right",
    "window_f1",
    "pairs_exact",
    "outside_flagged",
    "equation_form",
    "parameter_error_median",
    "coverage_95",
    "gap_closed_in_library",
    "gap_closed_outside",
    "seconds_per_case_median",
    "nulls_named",
    "confident_wrong",
    "gap_closed",
    "reliability_worst",
    "processor_s_per_60_s_median",
    "processor_s_per_60_s_worst",
    "failed",
)
TARGETS = {
    "false_alarms": "0",
    "detected_rho_0.25": "0.90",
    "detected_rho_0.5": "0.99",
    "named_first": "0.90",
    "truth_in_set": "0.97",
    "confident_wrong_in_library": "at most 0.02",
    "confident_wrong_outside": "at most 0.05",
    "subsystem_right": "0.90",
    "window_f1": "0.85",
    "pairs_exact": "0.75",
    "outside_flagged": "0.90",
    "equation_form": "0.50",
    "parameter_error_median": "at most 0.10",
    "coverage_95": "0.92-0.98",
    "gap_closed_in_library": "0.90",
    "gap_closed_outside": "0.60",
    "seconds_per_case_median": "at most 60 per 60 s",
}
# figure -> (what it must reach on the project's own world, on worlds left out of all choices)
WORLD_TARGETS = {
    "nulls_named": ("0", "0"),
    "false_alarms": ("0", "at most 2 % of nulls"),
    "named_first": ("0.92", "0.80"),
    "truth_in_set": ("0.98", "0.92"),
    "confident_wrong": ("0.02", "0.04"),
    "pairs_exact": ("0.85", "0.60"),
    "outside_flagged": ("0.97", "0.85"),
    "reliability_worst": ("0.05", "0.10"),
    "coverage_95": ("0.93-0.97", "0.90-0.98"),
    "gap_closed": ("0.99", "0.90"),
    "processor_s_per_60_s_median": ("10", "10"),
    "processor_s_per_60_s_worst": ("90", "90"),
    "failed": ("0", "0"),
}
BINS = (0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 1.0)
LEAST_IN_BIN = 5  # number of statements below which a bin's frequency is not meaningful
WIDE = 1.34  # a case counts for rho where its own is within this factor
Table = dict[str, float | int | None]


def _big(*categories: str) -> Callable[[Facts], bool]:
    return lambda f: f.category in categories and f.rho_wanted >= 0.5


def _of_library(f: Facts) -> bool:
    return f.category in ("single", "pair")


def outcomes(facts: Sequence[Facts]) -> dict[str, list[bool]]:
    """What each case, or each parameter, says to every figure that is a share of them."""

    def said(which: Callable[[Facts], bool], of: Callable[[Facts], bool | None]) -> list[bool]:
        return [bool(of(f)) for f in facts if which(f) and of(f) is not None]

    def near(rho: float) -> Callable[[Facts], bool]:
        return lambda f: f.category in ("single", "pair", "outside") and rho / WIDE <= f.rho <= rho * WIDE

    def outside(f: Facts) -> bool:
        return f.category == "outside"

    return {
        "detected_rho_0.25": said(near(0.25), lambda f: f.detected),
        "detected_rho_0.5": said(near(0.5), lambda f: f.detected),
        "named_first": said(_big("single"), lambda f: f.named_first),
        "truth_in_set": said(_big("single"), lambda f: f.in_set),
        "confident_wrong_in_library": said(_of_library, lambda f: f.wrong),
        "confident_wrong_outside": said(outside, lambda f: f.wrong),
        "subsystem_right": said(_big("single", "outside"), lambda f: f.subsystem),
        "pairs_exact": said(_big("pair"), lambda f: f.exact),
        "outside_flagged": said(outside, lambda f: f.flagged),
        "equation_form": said(_big("outside"), lambda f: f.form),
        "coverage_95": [covered for f in facts if _of_library(f) for covered in f.covered],
        "confident_wrong": said(lambda f: f.category != "null", lambda f: f.wrong),
    }


def tabulate(facts: Sequence[Facts]) -> Table:
    """The figures that `seldinger prove --json` prints as `table`. A share is None where no case has a say in it."""

    def middle(values: list[float]) -> float | None:
        return float(np.median(values)) if values else None

    library = [f for f in facts if _of_library(f)]
    shown = [f for f in facts if _big("single", "pair", "outside")(f) and f.detected and f.windows]
    table: Table = {
        "null_cases": sum(f.category == "null" for f in facts),
        "false_alarms": sum(f.category == "null" and f.detected for f in facts),
        "window_f1": mean([f.window_f1 or 0.0 for f in shown]),
        "parameter_error_median": middle([e for f in library for e in f.parameter_errors]),
        "gap_closed_in_library": middle([f.gap_closed for f in library if f.gap_closed is not None]),
        "gap_closed_outside": middle([f.gap_closed for f in facts if f.category == "outside" and f.gap_closed is not None]),
        "seconds_per_case_median": middle([f.seconds for f in facts if np.isfinite(f.seconds)]),
        "nulls_named": sum(f.category == "null" and f.named for f in facts),
        "gap_closed": middle([f.gap_closed for f in facts if f.gap_closed is not None]),
        "reliability_worst": worst_bin(reliability(facts)),
        "processor_s_per_60_s_median": middle([f.processor_s for f in facts if np.isfinite(f.processor_s)]),
        "processor_s_per_60_s_worst": max((f.processor_s for f in facts if np.isfinite(f.processor_s)), default=None),
        "failed": sum(f.failed for f in facts),
    }
    table |= {key: mean([float(yes) for yes in said]) for key, said in outcomes(facts).items()}
    return {key: table[key] for key in KEYS}


@dataclass(frozen=True)
class Share:
    """How many of `of` cases or parameters make a share, and its 95 % interval by Wilson's score."""

    count: int
    of: int
    low: float
    high: float

    @classmethod
    def counted(cls, count: int, of: int) -> Share:
        """The share of `count` in `of`, which is at least one."""
        low, high = stats.binomtest(count, of).proportion_ci(0.95, method="wilson")
        return cls(count, of, float(low), float(high))


def shares(facts: Sequence[Facts]) -> dict[str, Share]:
    """The counts of every figure that is a share, those that no case has a say in left out."""
    return {key: Share.counted(sum(said), len(said)) for key, said in outcomes(facts).items() if said}


@dataclass(frozen=True)
class Bin:
    """Statements whose probability lies between `low` and `high`."""

    low: float
    high: float
    count: int
    stated: float  # mean probability
    true: float  # share that is true


def reliability(facts: Sequence[Facts]) -> list[Bin]:
    """Bins of all statements with a probability, empty ones left out."""
    statements = [pair for f in facts for pair in f.stated]
    found = []
    for low, high in itertools.pairwise(BINS):
        inside = [(p, true) for p, true in statements if low <= p < high or (high == 1.0 and p == 1.0)]
        if inside:
            p, true = zip(*inside, strict=True)
            found.append(Bin(low, high, len(inside), float(np.mean(p)), float(np.mean(true))))
    return found


def worst_bin(bins: Sequence[Bin]) -> float | None:
    """Largest distance between stated probability and frequency, over bins with enough statements."""
    return max((abs(b.stated - b.true) for b in bins if b.count >= LEAST_IN_BIN), default=None)


def reliability_markdown(bins: dict[str, list[Bin]]) -> str:
    """Reliability of every world as markdown, with the 95 % interval (Wilson) of the share that is true."""
    lines = ["| world | stated | statements | mean stated | true |", "|---|---|---|---|---|"]
    for world, each in bins.items():
        for b in each:
            true = Share.counted(round(b.true * b.count), b.count)
            lines.append(
                f"| {world} | {b.low:.1f} to {b.high:.1f} | {b.count} | {b.stated:.2f} | {b.true:.2f} "
                f"({true.low:.2f} to {true.high:.2f}) |"
            )
    return "\n".join(lines)


def worlds_markdown(tables: dict[str, Table], counted: dict[str, dict[str, Share]], own: str) -> str:
    """The figures of all worlds, with what is to be reached on the own world and on the others.

    A share has its count and its 95 % interval (Wilson): few cases say little.
    """
    lines = [
        f"| figure | to reach, {own} / other | {' | '.join(tables)} |",
        "|---|---|" + "---|" * len(tables),
        f"| cases with nothing planted | | {' | '.join(_text(t['null_cases']) for t in tables.values())} |",
    ]
    for key, (here, there) in WORLD_TARGETS.items():
        cells = " | ".join(_of(t[key], counted[world].get(key)) for world, t in tables.items())
        lines.append(f"| {key.replace('_', ' ')} | {here} / {there} | {cells} |")
    return "\n".join(lines)


def _of(value: float | int | None, share: Share | None) -> str:
    if share is None:
        return _text(value)
    return f"{_text(value)}, {share.count} of {share.of} ({share.low:.2f} to {share.high:.2f})"


def markdown(table: Table, baselines: dict[str, dict[str, Any]]) -> str:
    """The table with its targets and the baselines, as markdown."""
    names = list(baselines)
    lines = [
        f"| figure | to reach | diagnose | {' | '.join(n.replace('_', ' ') for n in names)} |",
        "|---|---|---|" + "---|" * len(names),
    ]
    for key in KEYS:
        cells = [_text(baselines[n].get(key), n if "unavailable" in baselines[n] else "") for n in names]
        lines.append(f"| {key.replace('_', ' ')} | {TARGETS.get(key, '')} | {_text(table.get(key))} | {' | '.join(cells)} |")
    lines += [f"\n{n.replace('_', ' ')}: {row['unavailable']}" for n, row in baselines.items() if "unavailable" in row]
    return "\n".join(lines)


def _text(value: Any, unavailable: str = "") -> str:
    if unavailable:
        return "n/a"
    return "" if value is None else f"{value:.3g}" if isinstance(value, float) else str(value)
