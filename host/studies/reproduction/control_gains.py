"""Figs. 7.11 and 7.12: what each gain of the hybrid controller does, in both forms, at every setting of the other gains.

The thesis prints no gains for these figures. Each statement is about one gain, the others held: it is tried at a grid of the
others, in both forms of the law. A setting is admissible where the force comes to rest. A gain is compared with less of it:
a quarter of a proportional gain, no integral or differential gain.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from host.report.figure_page import Section, verdict
from host.report.style import ReportFigure
from host.studies.reproduction.drawing import Panel, PlotLine, panels
from host.studies.reproduction.thesis_control import (
    INCREMENTAL,
    PERIOD_S,
    PI,
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
LESS = {"K_pp": 0.25, "K_ip": 0.0, "K_dp": 0.0, "K_pf": 0.25, "K_if": 0.0, "K_df": 0.0}
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
    """One admissible setting: its form and gains, and by figure which statements hold."""

    form: LawForm
    gains: Gains
    holds: dict[str, tuple[bool, ...]]


def tried(grid: Grid) -> list[TriedGains]:
    """Return every admissible setting of `grid` with what holds there."""
    out = []
    for K_pp, K_pf, K_ip, K_if in itertools.product(grid.K_pp, grid.K_pf, grid.K_ip, grid.K_if):
        gains = Gains(K_pp, K_ip, Gains.K_dp * K_pp / Gains.K_pp, K_pf, K_if, Gains.K_df)
        holds = _statements(gains, grid)
        if holds is not None:
            out.append(TriedGains(grid.form, gains, holds))
    return out


def _step(gains: Gains, grid: Grid) -> ThesisStep:
    return step_figures(hybrid(FORCE_N, grid.iterations, gains, Setting(form=grid.form)), FORCE_N)


def _statements(gains: Gains, grid: Grid) -> dict[str, tuple[bool, ...]] | None:
    """Return what holds around `gains`; None where the force does not come to rest."""
    here = _step(gains, grid)
    if here.ringing_N > AT_REST_N:
        return None
    less = {name: _step(gains.scaled(**{name: factor}), grid) for name, factor in LESS.items()}
    much = [_step(gains.scaled(K_pp=factor), grid) for factor in TOO_MUCH]

    def overshoot(name: str) -> bool:
        return here.overshoot_N < less[name].overshoot_N - SAME_N

    def steady(name: str) -> bool:
        return here.steady_error_N < less[name].steady_error_N - SAME_N

    unstable = any(step.ringing_N > AT_REST_N or step.settling >= grid.iterations for step in much)
    return {
        "7.11": (overshoot("K_pp"), unstable, overshoot("K_ip"), steady("K_ip"), overshoot("K_dp")),
        "7.12": (overshoot("K_pf"), steady("K_if"), overshoot("K_df")),
    }


def sections(quick: bool) -> list[Section]:
    """Return the sections for figures 7.11 and 7.12. quick: fewer of the other gains."""
    grids = list(GRIDS)
    if quick:
        grids = [grid._replace(K_pp=grid.K_pp[1:3], K_pf=grid.K_pf[1:2], K_if=grid.K_if[:2]) for grid in GRIDS]
    settings = {grid.form.name: tried(grid) for grid in grids}
    return [
        _section(
            "7.11",
            "position",
            ("K_pp", "K_ip", "K_dp"),
            "The proportional gain lowers overshoot but is bounded by instability; a higher integral gain lowers overshoot "
            "and steady error; the differential gain lowers overshoot slightly.",
            settings,
        ),
        _section(
            "7.12",
            "force",
            ("K_pf", "K_if", "K_df"),
            "The proportional gain lowers overshoot, the integral gain the steady error, the differential gain the "
            "overshoot slightly.",
            settings,
        ),
    ]


def _section(number: str, title: str, names: Sequence[str], thesis: str, settings: dict[str, list[TriedGains]]) -> Section:
    said, holds = [], False
    rows: list[tuple[str, ...]] = [("form", "K_pp", "K_pf", "settings at rest", *STATEMENTS[number], "all")]
    for form, there in settings.items():
        good = [one for one in there if all(one.holds[number])]
        holds |= bool(good)
        said.append(f"{form}: all statements at {len(good)} of {len(there)} admissible settings")
        for (K_pp, K_pf), part in itertools.groupby(there, lambda one: (one.gains.K_pp, one.gains.K_pf)):
            judged = [one.holds[number] for one in part]
            count = [sum(column) for column in zip(*judged, strict=True)]
            all_of_them = sum(map(all, judged))
            rows.append((form, f"{K_pp:g}", f"{K_pf:g}", f"{len(judged)}", *map(str, count), f"{all_of_them}"))
        if not good and there:
            least = [sum(one.holds[number][k] for one in there) for k in range(len(STATEMENTS[number]))]
            rare = STATEMENTS[number][int(np.argmin(least))]
            said[-1] += f' ("{rare}" at {min(least)}, the others at {min(sorted(least)[1:])} or more)'
    return Section(
        f"fig_{number}",
        f"Fig. {number}: gains of the {title} controller",
        thesis,
        "The thesis does not give the other gains, nor the form of the law. Each statement is tried in both forms at a grid "
        "of them; the table counts the settings of the integral gains at which it holds.",
        verdict(holds),
        "; ".join(said) + ".",
        (_figure(title, names),),
        tuple(rows),
    )


def _figure(title: str, names: Sequence[str]) -> ReportFigure:
    base = {INCREMENTAL.name: Gains().scaled(K_pp=0.5), PI.name: Gains(0.5, 0.02, 0.08, 0.0545, 1e-3, Gains.K_df)}
    parts = []
    for form in (INCREMENTAL, PI):
        for name in names:
            lines = []
            for factor in (LESS[name], 1.0, TOO_MUCH[0]):
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
