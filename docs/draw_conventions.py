"""Draws docs/pictures/conventions.svg: frames, signs and lengths of the planar and the spatial model, from a solved shape.

Run: python docs/draw_conventions.py
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from host.mechanics.cosserat import solve_cosserat
from host.mechanics.rotations import rotation_matrix
from protocol.catheter import load_catheter

TARGET = Path(__file__).parent / "pictures" / "conventions.svg"
INSERTION_m, CURVATURE_per_m, FORCE_N = 0.03, 18.0, np.array([0.06, 0.02, -0.05])
SENSOR_OFFSETS_m = [0.0, 0.03, 0.05]
COLOURS = ("tab:red", "tab:green", "tab:blue")
MM = 1e3


def triad(axes: Any, origin: np.ndarray, R: np.ndarray, names: tuple[str, str, str], size: float) -> None:
    """Three arrows with names, at `origin` in mm."""
    for i in range(3):
        end = origin + size * R[:, i]
        axes.quiver(*origin, *(size * R[:, i]), color=COLOURS[i], arrow_length_ratio=0.15, linewidth=1.6)
        axes.text(*(end + 2.0 * R[:, i]), names[i], color=COLOURS[i], fontsize=10)


def space(axes: Any) -> None:
    """The spatial model: base frame, tip frame, body, shaft, sensors and a force."""
    catheter = load_catheter("steerocath_t")
    total = catheter.distal_length_m + INSERTION_m
    back = np.linspace(total, 0.0, 120)
    found = solve_cosserat(catheter, INSERTION_m, CURVATURE_per_m, FORCE_N, stations_m=[*back, *SENSOR_OFFSETS_m])
    unloaded = solve_cosserat(catheter, INSERTION_m, CURVATURE_per_m, stations_m=back).station_positions_m * MM
    shape, sensors = found.station_positions_m[:120] * MM, found.station_positions_m[120:] * MM
    body = back >= catheter.distal_length_m
    axes.plot(*unloaded.T, color="0.75", linewidth=1.5, linestyle="--", label="unloaded: an arc, towards -e2")
    axes.plot(*shape[body].T, color="0.25", linewidth=5, label="body: length d = insertion_m, straight without load")
    axes.plot(*shape[~body].T, color="tab:orange", linewidth=5, label="distal shaft: pre-curvature about d1")
    axes.plot([0, 0], [0, 0], [-18, 0], color="0.6", linewidth=10, solid_capstyle="butt", label="sheath")
    axes.scatter(*sensors.T, color="black", s=28, label="sensors: offset_m back from the tip", depthshade=False)
    triad(axes, np.zeros(3), np.eye(3), ("e1", "e2", "e3"), 22.0)
    triad(axes, shape[-1], rotation_matrix(found.tip_quaternion_wxyz), ("d1", "d2", "d3"), 16.0)
    arrow = 45.0 * FORCE_N / np.linalg.norm(FORCE_N)
    axes.quiver(*(shape[-1] - arrow), *arrow, color="purple", arrow_length_ratio=0.15, linewidth=2)
    axes.text(*(shape[-1] - arrow), "force on the catheter", color="purple", fontsize=9)
    axes.set_box_aspect((60, 80, 120))
    axes.set_xlim(-25, 35), axes.set_ylim(-60, 20), axes.set_zlim(-20, 100)
    axes.set_xlabel("e1, mm"), axes.set_ylabel("e2, mm"), axes.set_zlabel("e3, mm")
    axes.view_init(elev=18, azim=-28)
    axes.legend(loc="upper left", fontsize=8, framealpha=0.9)
    axes.set_title("Spatial model", fontsize=11)


def plane(axes: Any) -> None:
    """The planar model: x along e3, y = -e2, angle from x to y; positive curvature turns towards +y."""
    s = np.linspace(0.0, 70.0, 60)
    k = CURVATURE_per_m / MM
    x, y = np.append([0.0], 30.0 + np.sin(k * s) / k), np.append([0.0], (1.0 - np.cos(k * s)) / k)
    axes.plot(x[:2], y[:2], color="0.25", linewidth=5)
    axes.plot(x[1:], y[1:], color="tab:orange", linewidth=5)
    axes.plot([-18, 0], [0, 0], color="0.6", linewidth=10, solid_capstyle="butt")
    angle = k * 70.0
    for name, direction, colour in (("x = e3", (1, 0), COLOURS[2]), ("y = -e2", (0, 1), COLOURS[1])):
        axes.annotate(
            "",
            xy=(22 * direction[0], 22 * direction[1]),
            xytext=(0, 0),
            arrowprops={"arrowstyle": "->", "color": colour, "linewidth": 1.8},
        )
        axes.text(22 * direction[0] + 1, 22 * direction[1] + 2, name, color=colour, fontsize=10)
    axes.plot([x[-1], x[-1] + 22], [y[-1], y[-1]], color="0.6", linestyle=":")
    axes.annotate(
        "",
        xy=(x[-1] + 18 * np.cos(angle), y[-1] + 18 * np.sin(angle)),
        xytext=(x[-1], y[-1]),
        arrowprops={"arrowstyle": "->", "color": "black"},
    )
    sweep = np.linspace(0.0, angle, 30)
    axes.plot(x[-1] + 12 * np.cos(sweep), y[-1] + 12 * np.sin(sweep), color="black", linewidth=1)
    axes.text(x[-1] + 12, y[-1] + 8, "angle_rad", fontsize=9)
    axes.text(78, 4, "positive curvature", fontsize=9, color="tab:orange")
    axes.set_aspect("equal"), axes.set_xlim(-20, 115), axes.set_ylim(-12, 75)
    axes.set_xlabel("x, mm"), axes.set_ylabel("y, mm")
    axes.set_title("Planar model: the same bending plane, roll 0", fontsize=11)


def main() -> None:
    """Draw both frames and write the picture next to this file."""
    plt.rcParams["svg.hashsalt"] = "conventions"
    figure = plt.figure(figsize=(13, 6.5))
    space(figure.add_subplot(1, 2, 1, projection="3d"))
    plane(figure.add_subplot(1, 2, 2))
    figure.tight_layout()
    figure.savefig(TARGET, metadata={"Date": None})


if __name__ == "__main__":
    main()
