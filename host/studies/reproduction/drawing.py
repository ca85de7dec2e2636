"""Panels of curves for reproductions: one call a figure, page and phone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from host.report.style import ESTIMATED, MEASURED, MUTED, TRUTH, WANTED, ReportFigure, legend_above, report_figure, thinned

CYCLE = (MEASURED, ESTIMATED, TRUTH, "#5b8c5a", "#7d5ba6", MUTED)


class PlotLine(NamedTuple):
    """One line (or points, `style` "."); colour None takes the next of the cycle."""

    x: Any
    y: Any
    label: str = ""
    colour: str | None = None
    style: str = "-"


class Panel(NamedTuple):
    """One pair of axes with labels and curves."""

    x_label: str
    y_label: str
    curves: Sequence[PlotLine]
    title: str = ""
    equal: bool = False
    log_x: bool = False
    log_y: bool = False
    level: float | None = None


def panels(title: str, alt: str, caption: str, parts: Sequence[Panel], height_in: float = 2.9) -> ReportFigure:
    """The panels side by side, on a narrow screen below each other."""
    across = min(len(parts), 3)
    rows = -(-len(parts) // across)

    def draw(figure: Figure, narrow: bool) -> None:
        for place, part in enumerate(parts):
            axes = figure.add_subplot(*((len(parts), 1) if narrow else (rows, across)), place + 1)
            _draw(axes, part, narrow, len(parts) == 1)

    return report_figure(draw, height_in * rows, height_in * len(parts), title, alt, caption)


def _draw(axes: Any, part: Panel, narrow: bool, alone: bool) -> None:
    named = 0
    for number, curve in enumerate(part.curves):
        x, y = np.asarray(curve.x, float), np.asarray(curve.y, float)
        if curve.style in ("-", "--") and x.size > 3000 and np.all(np.diff(x) > 0):
            x, y = thinned(x, y)
        colour = curve.colour or CYCLE[number % len(CYCLE)]
        style: dict[str, Any] = {"linestyle": (0, (4, 2))} if curve.style == "--" else {}
        if curve.style in (".", "o"):
            style = {"linestyle": "", "marker": ".", "markersize": 1.8 if curve.style == "." else 7, "alpha": 0.8}
        axes.plot(x, y, color=colour, label=curve.label or None, **style)
        named += bool(curve.label)
    if part.level is not None:
        axes.axhline(part.level, color=WANTED, linewidth=0.9, linestyle=(0, (1, 2)))
    if part.log_x:
        axes.set_xscale("log")
    if part.log_y:
        axes.set_yscale("log")
    if part.equal:
        axes.set_aspect("equal", "datalim")
        axes.margins(0.08)
    axes.set_xlabel(part.x_label)
    axes.set_ylabel(part.y_label)
    columns = _columns([curve.label for curve in part.curves if curve.label], narrow or alone)
    if named:
        legend_above(axes, columns)
    if part.title:
        axes.set_title(part.title, pad=10 + 13 * -(-named // columns))


def _columns(labels: Sequence[str], wide: bool) -> int:
    """Return the number of legend columns that fit over the axes."""
    longest = max((len(label) for label in labels), default=0)
    return max(1, min(len(labels), (44 if wide else 26) // (longest + 6)))
