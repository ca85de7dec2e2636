"""Draws a catheter's shape, its unloaded shape, forces and measured poses into a PNG."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from protocol.errors import InputError

Array = NDArray[np.float64]
ARROW_m_PER_N = 0.2  # the scale of the thesis' Fig. 4.6: 200 mm to 1 N
VIEWS = {2: [(0, 1)], 3: [(2, 1), (2, 0)]}
LABELS = {2: ("x", "y"), 3: ("e1", "e2", "e3")}


def plot_shape(path: str, title: str, loaded: Array, unloaded: Array, force_N: Array, measured: Array) -> None:
    """Draw a solution into a PNG file.

    Arguments: `loaded`, `unloaded` (points, 2 or 3) in m, sheath to tip; `force_N` on the tip, base frame;
    `measured` (k, 2 or 3), tracked positions, k may be 0. Raises: InputError where the file cannot be written.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    views = VIEWS[loaded.shape[1]]
    figure, axes = pyplot.subplots(1, len(views), figsize=(6.0 * len(views), 5.6), squeeze=False)
    for axis, (across, up) in zip(axes[0], views, strict=True):
        _draw_view(axis, loaded, unloaded, force_N, measured, across, up)
    figure.suptitle(title)
    figure.legend(*axes[0][0].get_legend_handles_labels(), loc="lower center", ncols=3, fontsize=8)
    figure.tight_layout(rect=(0.0, 0.08, 1.0, 1.0))
    try:
        figure.savefig(path, dpi=120)
    except OSError as error:
        raise InputError("--plot", path, error.strerror or "a file that can be written") from None
    finally:
        pyplot.close(figure)


def _draw_view(axis, loaded: Array, unloaded: Array, force_N: Array, measured: Array, across: int, up: int) -> None:  # type: ignore[no-untyped-def]
    mm = 1e3
    tip, head = mm * loaded[-1], mm * (loaded[-1] + force_N * ARROW_m_PER_N)
    axis.plot(mm * unloaded[:, across], mm * unloaded[:, up], "--", color="0.6", label="unloaded")
    axis.plot(mm * loaded[:, across], mm * loaded[:, up], "-", color="tab:blue", lw=2.5, label="loaded")
    axis.plot(0.0, 0.0, "s", color="black", ms=7, label="sheath's exit")
    axis.plot(
        [],
        [],
        "-",
        color="tab:red",
        label=f"force on the tip, {np.linalg.norm(force_N) * 1e3:.1f} mN ({ARROW_m_PER_N * 1e3:.0f} mm : 1 N)",
    )
    if np.hypot(head[across] - tip[across], head[up] - tip[up]) > 0.1:
        axis.annotate(
            "",
            xy=(head[across], head[up]),
            xytext=(tip[across], tip[up]),
            arrowprops={"arrowstyle": "-|>", "color": "tab:red", "lw": 2},
        )
    if len(measured):
        axis.plot(mm * measured[:, across], mm * measured[:, up], "o", mfc="none", color="tab:green", label="measured")
    drawn = np.vstack([mm * loaded, mm * unloaded, head[None, :], mm * measured.reshape(-1, head.size), np.zeros(head.size)])
    # one scale for all views, so that a view seen edge-on stays a line in a square
    half = 0.55 * float(np.ptp(drawn, axis=0).max())
    middle = 0.5 * (drawn.min(axis=0) + drawn.max(axis=0))
    names = LABELS[loaded.shape[1]]
    axis.set(
        xlabel=f"{names[across]} (mm)",
        ylabel=f"{names[up]} (mm)",
        aspect="equal",
        xlim=(middle[across] - half, middle[across] + half),
        ylim=(middle[up] - half, middle[up] + half),
    )
    axis.grid(alpha=0.3)
