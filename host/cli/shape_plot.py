"""Draws a catheter's shape, its unloaded shape, forces and measured poses into a PNG."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from host.cli.contract_io import BadInput

Array = NDArray[np.float64]
ARROW_m_PER_N = 0.2     # the scale of the thesis' Fig. 4.6: 200 mm to 1 N
VIEWS = {2: [(0, 1)], 3: [(2, 1), (2, 0)]}
LABELS = {2: ("x", "y"), 3: ("e1", "e2", "e3")}


def check_plot_path(path: str | None) -> None:
    """Refuses a plot that could not be written, before anything is computed. Raises BadInput."""
    if path is None:
        return
    if Path(path).suffix.lower() != ".png":
        raise BadInput("plot", path, "a file name that ends in .png")
    if not Path(path).resolve().parent.is_dir():
        raise BadInput("plot", path, "a file in a folder that exists")


def plot_shape(path: str, title: str, loaded: Array, unloaded: Array, force_N: Array, measured: Array) -> None:
    """Writes the picture.

    Arguments: `loaded`, `unloaded` (points, 2 or 3) in m, sheath to tip; `force_N` on the tip, base frame;
    `measured` (k, 2 or 3), tracked positions, k may be 0. Raises: BadInput where the file cannot be written.
    """
    import matplotlib
    matplotlib.use("Agg")
    from matplotlib import pyplot
    views = VIEWS[loaded.shape[1]]
    figure, axes = pyplot.subplots(1, len(views), figsize=(7.0 * len(views), 5.0), squeeze=False)
    for axis, (across, up) in zip(axes[0], views, strict=True):
        _draw_view(axis, loaded, unloaded, force_N, measured, across, up)
    figure.suptitle(title)
    figure.tight_layout()
    try:
        figure.savefig(path, dpi=120)
    except OSError as error:
        raise BadInput("plot", path, error.strerror or "a file that can be written") from None
    finally:
        pyplot.close(figure)


def _draw_view(axis, loaded: Array, unloaded: Array, force_N: Array, measured: Array, across: int, up: int) -> None:  # type: ignore[no-untyped-def]
    mm = 1e3
    axis.plot(mm * unloaded[:, across], mm * unloaded[:, up], "--", color="0.6", label="unloaded")
    axis.plot(mm * loaded[:, across], mm * loaded[:, up], "-", color="tab:blue", lw=2.5, label="loaded")
    axis.plot(0.0, 0.0, "s", color="black", ms=7, label="sheath's exit")
    tip = loaded[-1]
    arrow = force_N * ARROW_m_PER_N
    if np.hypot(arrow[across], arrow[up]) > 0.0:
        axis.annotate("", xy=(mm * (tip + arrow)[across], mm * (tip + arrow)[up]),
                      xytext=(mm * tip[across], mm * tip[up]),
                      arrowprops={"arrowstyle": "-|>", "color": "tab:red", "lw": 2})
        axis.plot([], [], "-", color="tab:red", label=f"force on the tip, {np.linalg.norm(force_N) * 1e3:.1f} mN "
                  f"({ARROW_m_PER_N * 1e3:.0f} mm : 1 N)")
        axis.plot(mm * (tip + arrow)[across], mm * (tip + arrow)[up], alpha=0.0)
    if len(measured):
        axis.plot(mm * measured[:, across], mm * measured[:, up], "o", mfc="none", color="tab:green", label="measured")
    names = LABELS[loaded.shape[1]]
    axis.set(xlabel=f"{names[across]} (mm)", ylabel=f"{names[up]} (mm)", aspect="equal")
    axis.margins(0.1)
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8)
