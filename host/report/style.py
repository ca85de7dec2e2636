"""How figures in reports look: one palette, one type size, each drawn twice - for a page and for a phone."""

from __future__ import annotations

import base64
import io
import itertools
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

Array = np.ndarray

INK, MUTED, FAINT = "#1d2530", "#6b7683", "#d9dee4"
MEASURED, WANTED, ESTIMATED, TRUTH, ENCODER = "#1f5f8b", "#1d2530", "#d17a1d", "#a8443c", "#f3c890"
MODE_COLOURS = {
    "disarmed": "#eceef1",
    "hold": "#e3e9f0",
    "position": "#d5e3f1",
    "approach": "#fbe6c6",
    "contact": "#d3ead9",
    "jog": "#d5e3f1",
    "homing": "#d5e3f1",
    "retract": "#f6d9cf",
    "stopped": "#e8b9b3",
}
ACTION_COLOURS = {"warn": "#f2d479", "hold": "#eda94f", "retract": "#dd7a4b", "stop": "#c14b44"}
_FONTS = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif"
_STYLE: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": MUTED,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.8,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "axes.grid": True,
    "grid.color": "#edf0f3",
    "grid.linewidth": 0.8,
    "axes.axisbelow": True,
    "lines.linewidth": 1.2,
    "lines.solid_capstyle": "round",
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "legend.handlelength": 1.4,
    "legend.borderaxespad": 0.0,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.titlecolor": INK,
    "text.color": INK,
    "svg.fonttype": "none",
    "svg.hashsalt": "seldinger",
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
    "axes.xmargin": 0.0,
    "text.parse_math": False,
}
WIDE_IN, NARROW_IN = 7.4, 3.5


class ReportFigure(NamedTuple):
    """One figure as two SVG data addresses, with a text for readers who cannot see it, and a caption."""

    wide: str
    narrow: str
    title: str
    alt: str
    caption: str


def _as_address(figure: Figure) -> str:
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    svg = re.sub(r"font: ([^;\"]*?)'?DejaVu Sans'?[^;\"]*", lambda match: f"font: {match[1]}{_FONTS}", buffer.getvalue())
    # Hundredths of a point are enough for places, and only for them: numbers of the text stay as they are.
    svg = re.sub(r"<[^>]*>", lambda tag: re.sub(r"(\d+\.\d{2})\d+", r"\1", tag[0]), svg)
    return "data:image/svg+xml;base64," + base64.b64encode(svg.encode()).decode()


def report_figure(
    draw: Callable[[Figure, bool], None], height_in: float, narrow_height_in: float, title: str, alt: str, caption: str
) -> ReportFigure:
    """`draw(figure, narrow)` on a page's width and on a phone's."""
    addresses = []
    with matplotlib.rc_context(_STYLE):
        for narrow in (False, True):
            size = (NARROW_IN, narrow_height_in) if narrow else (WIDE_IN, height_in)
            figure = Figure(figsize=size, layout=ConstrainedLayoutEngine(w_pad=0.03, h_pad=0.05))
            draw(figure, narrow)
            addresses.append(_as_address(figure))
    return ReportFigure(addresses[0], addresses[1], title, alt, caption)


def thinned(x: Array, y: Array, bins: int = 700) -> tuple[Array, Array]:
    """(x, y) with at most 2 * `bins` points: the lowest and the highest of each stretch, so that no peak is lost."""
    finite = np.isfinite(y)
    x, y = x[finite], y[finite]
    if len(x) <= 2 * bins:
        return x, y
    edges = np.linspace(0, len(x), bins + 1).astype(int)
    keep = set()
    for start, end in itertools.pairwise(edges):
        if end > start:
            keep |= {start + int(np.argmin(y[start:end])), start + int(np.argmax(y[start:end]))}
    index = np.array(sorted(keep))
    return x[index], y[index]


def legend_above(axes: Axes, columns: int) -> None:
    """The legend over the axes, left, in `columns`, so that it never covers data."""
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.01), ncols=columns, columnspacing=1.4, handletextpad=0.5)
