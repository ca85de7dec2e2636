"""Figs. 7.11 and 7.12: what each gain of the hybrid controller does, in both forms, at every setting of the other gains.

The thesis prints no gains for these figures, and no start. Each statement is about one gain, the others held: it is tried
at a grid of the others and from several starts, in both forms of the law, on the rod and on the circular arcs. A setting is
admissible where the force comes to rest in contact. A gain is compared with less of it (`LESS`).
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from host.report.figure_page import Section, verdict
from host.report.style import ReportFigure
from host.studies.reproduction.drawing import Panel, PlotLine, panels
from host.studies.reproduction.thesis_control import (
    INCREMENTAL,
    PERIOD_S,
    PI,
    STARTS,
    Gains,
    LawForm,
    Setting,
    ThesisStep,
    hybrid,
    step_figures,
)

FORCE_N = 0.25
# The force is at rest where it varies by less than this at the end (N). Differences below the second are not counted (N).
AT_REST_N, SAME_N = 0.0025, 1e-5
# What a gain is compared with: a quarter of it; or none of an integral or differential gain.
QUARTER, NONE = "a quarter", "a quarter (P), none (I, D)"
LESS = {
    QUARTER: {"K_pp": 0.25, "K_ip": 0.25, "K_dp": 0.25, "K_pf": 0.25, "K_if": 0.25, "K_df": 0.25},
    NONE: {"K_pp": 0.25, "K_ip": 0.0, "K_dp": 0.0, "K_pf": 0.25, "K_if": 0.0, "K_df": 0.0},
}
TOO_MUCH = (2.5, 6.0, 16.0)
# Statements on the gains of the position (7.11) and of the force controller (7.12).
STATEMENTS = {
    "7.11": (
        "K_pp lowers overshoot",
        "too much K_pp is unstable",
        "K_ip lowers overshoot",
        "K_ip lowers the steady error",
        "K_dp lowers overshoot",
    ),
    "7.12": ("K_pf lowers overshoot", "K_if lowers the steady error", "K_df lowers overshoot"),
}


class Grid(NamedTuple):
    """The other gains that are tried in one form, and iterations (the PI form is slower)."""

    form: LawForm
    iterations: int
    K_pp: tuple[float, ...]
    K_pf: tuple[float, ...]
    K_ip: tuple[float, ...]
    K_if: tuple[float, ...]


# Around the printed optimum; in the PI form from the gains of the experiments, (7.6), to the greatest K_pp that is stable.
GRIDS = (
    Grid(INCREMENTAL, 120, (0.137, 0.343, 0.685, 1.37), (0.0136, 0.0272, 0.0545), (0.001, 0.01, 0.04), (1e-4, 1e-3, 4e-3)),
    Grid(PI, 600, (0.083, 0.25, 0.5, 0.8), (0.0272, 0.0545, 0.1), (0.006, 0.02, 0.06), (1e-4, 1e-3, 3e-3)),
)


class TriedGains(NamedTuple):
    """One admissible setting of the gains, and what holds there by comparison (a key of `LESS`) and figure."""

    gains: Gains
    holds: dict[str, dict[str, tuple[bool, ...]]]


class Scan(NamedTuple):
    """The admissible settings of the gains for one plant, start and form of the law."""

    setting: Setting
    tried: list[TriedGains]


def scan(setting: Setting, grid: Grid) -> Scan:
    """Return every admissible setting of `grid` with what holds there, for one plant and start."""
    here = replace(setting, form=grid.form)
    listed = [
        Gains(K_pp, K_ip, Gains.K_dp * K_pp / Gains.K_pp, K_pf, K_if, Gains.K_df)
        for K_pp, K_pf, K_ip, K_if in itertools.product(grid.K_pp, grid.K_pf, grid.K_ip, grid.K_if)
    ]
    # The simulation is compiled and leaves the interpreter to other threads.
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        found = pool.map(lambda gains: _statements(gains, grid.iterations, here), listed)
    return Scan(here, [TriedGains(gains, holds) for gains, holds in zip(listed, found, strict=True) if holds])


def _statements(gains: Gains, iterations: int, setting: Setting) -> dict[str, dict[str, tuple[bool, ...]]] | None:
    """Return what holds around `gains`; None where the force does not come to rest in contact."""

    def step(**factors: float) -> ThesisStep:
        return step_figures(hybrid(FORCE_N, iterations, gains.scaled(**factors), setting), FORCE_N)

    here = step()
    if here.ringing_N > AT_REST_N or here.steady_error_N >= FORCE_N:
        return None
    unstable = any(one.ringing_N > AT_REST_N or one.settling >= iterations for one in (step(K_pp=f) for f in TOO_MUCH))
    out: dict[str, dict[str, tuple[bool, ...]]] = {}
    steps: dict[tuple[str, float], ThesisStep] = {}
    for comparison, factors in LESS.items():
        for name, factor in factors.items():
            if (name, factor) not in steps:
                steps[name, factor] = step(**{name: factor})
        overshoot = {n: here.overshoot_N < steps[n, f].overshoot_N - SAME_N for n, f in factors.items()}
        steady = {n: here.steady_error_N < steps[n, f].steady_error_N - SAME_N for n, f in factors.items()}
        out[comparison] = {
            "7.11": (overshoot["K_pp"], unstable, overshoot["K_ip"], steady["K_ip"], overshoot["K_dp"]),
            "7.12": (overshoot["K_pf"], steady["K_if"], overshoot["K_df"]),
        }
    return out


def sections(quick: bool) -> list[Section]:
    """Return the sections for figures 7.11 and 7.12. quick: fewer of the other gains, one start, the rod only."""
    grids, starts = list(GRIDS), STARTS
    plants: tuple[bool, ...] = (True, False)
    if quick:
        grids = [one._replace(K_pp=one.K_pp[1:3], K_pf=one.K_pf[1:2], K_ip=one.K_ip[:2], K_if=one.K_if[:2]) for one in GRIDS]
        starts, plants = STARTS[:1], (True,)
    scans = [scan(replace(start, rod=rod), grid) for rod in plants for grid in grids for start in starts]
    return [
        _section(
            "7.11",
            "position",
            ("K_pp", "K_ip", "K_dp"),
            "The proportional gain lowers overshoot but is bounded by instability; a higher integral gain lowers overshoot "
            "and steady error; the differential gain lowers overshoot slightly.",
            scans,
        ),
        _section(
            "7.12",
            "force",
            ("K_pf", "K_if", "K_df"),
            "The proportional gain lowers overshoot, the integral gain the steady error, the differential gain the "
            "overshoot slightly.",
            scans,
        ),
    ]


def _section(number: str, title: str, names: Sequence[str], thesis: str, scans: Sequence[Scan]) -> Section:
    statements = STATEMENTS[number]
    rows: list[tuple[str, ...]] = [
        ("plant", "form", "start", "settings at rest", *statements, "all", f"all, compared with {NONE}", "all hold with")
    ]
    counts: dict[tuple[str, str], list[int]] = {}
    for one in scans:
        plant, form = "rod" if one.setting.rod else "arcs", one.setting.form.name
        judged = [tried.holds[QUARTER][number] for tried in one.tried]
        good = [tried.gains for tried, holds in zip(one.tried, judged, strict=True) if all(holds)]
        with_none = sum(all(tried.holds[NONE][number]) for tried in one.tried)
        count = [len(judged), *(sum(holds[k] for holds in judged) for k in range(len(statements))), len(good), with_none]
        rows.append((plant, form, one.setting.name, *map(str, count), _ranges(good)))
        counts[plant, form] = [a + b for a, b in zip(counts.get((plant, form), [0] * len(count)), count, strict=True)]
    return Section(
        f"fig_{number}",
        f"Fig. {number}: gains of the {title} controller",
        thesis,
        "The thesis gives neither the other gains, nor the start, nor the form of the law. Each statement is tried in both "
        "forms at a grid of them, and compared with a quarter of the gain; the table counts the settings at which it holds.",
        verdict(any(count[-2] for (plant, _), count in counts.items() if plant == "rod")),
        "; ".join(_summary(plant, form, count, statements) for (plant, form), count in counts.items()) + ".",
        (_figure(title, names),),
        tuple(rows),
    )


def _summary(plant: str, form: str, count: Sequence[int], statements: Sequence[str]) -> str:
    """Say for one plant and form how often all statements hold, and which holds least."""
    at_rest, *each, good, with_none = count
    least = int(np.argmin(each))
    return (
        f"{plant}, {form}: all statements at {good} of {at_rest} settings ({with_none} compared with none of it; "
        f'"{statements[least]}" at {each[least]})'
    )


def _ranges(good: Sequence[Gains]) -> str:
    """Return the range of each of the four gains that are varied."""
    if not good:
        return ""
    parts = []
    for name in ("K_pp", "K_ip", "K_pf", "K_if"):
        values = sorted({getattr(gains, name) for gains in good})
        parts.append(f"{name} {values[0]:g}" + (f" to {values[-1]:g}" if len(values) > 1 else ""))
    return ", ".join(parts)


def _figure(title: str, names: Sequence[str]) -> ReportFigure:
    base = {INCREMENTAL.name: Gains().scaled(K_pp=0.5), PI.name: Gains(0.5, 0.02, 0.08, 0.0545, 1e-3, Gains.K_df)}
    parts = []
    for form in (INCREMENTAL, PI):
        for name in names:
            lines = []
            for factor in (LESS[NONE][name], 1.0, TOO_MUCH[0]):
                run = hybrid(FORCE_N, 60, base[form.name].scaled(**{name: factor}), Setting(form=form))
                lines.append(PlotLine(np.arange(60), np.minimum(run.force_N, 0.6), f"{name} × {factor:g}"))
            parts.append(Panel("iteration", "force, N", lines, title=form.name, level=FORCE_N))
    return panels(
        f"Gains of the {title} controller",
        "Force responses for several gains.",
        f"Each gain alone times the factor, {FORCE_N} N wanted, {PERIOD_S * 1e3:.0f} ms an iteration. Above the incremental "
        "form at the printed optimum with K_pp halved, below the PI form with K_pp 0.5, K_ip 0.02, K_pf 0.0545, K_if 0.001.",
        parts,
        3.0,
    )
