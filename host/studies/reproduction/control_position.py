"""Figs. 6.15 to 6.19: position control to three goals, and the effect of the integral gain."""

from __future__ import annotations

import math

import numpy as np

from host.report.figure_page import Section, verdict
from host.studies.reproduction.drawing import Panel, PlotLine, panels
from host.studies.reproduction.thesis_position import IntegralGains, Navigation, faster, navigate, unloaded_tip
from protocol.rig_file import SIMULATED_RIG, load_rig

# The whole distal shaft is out, as in the thesis.
_START = np.array([0.001, 0.0, math.radians(12.0)])
# Goals, as insertion (m), roll (rad), curvature (1/m).
_GOALS = ((0.014, 0.35, 11.0), (0.008, -0.5, 8.0), (0.016, 0.7, 15.0))
_LATE_S = 5.0


def sections(quick: bool) -> list[Section]:
    """All five figures as three sections."""
    rig, seconds = load_rig(SIMULATED_RIG), 25.0 if quick else 40.0
    length = rig.catheter.distal_length_m
    goals = [unloaded_tip(np.array([d, roll, 0.0]), curvature, length) for d, roll, curvature in _GOALS]
    runs = [navigate(rig, _START, goal, seconds, seed=number) for number, goal in enumerate(goals, 1)]
    factors = {
        factor: navigate(rig, _START, goals[0], seconds, faster(IntegralGains(), factor)) for factor in (0.5, 1.0, 2.0)
    }
    return [_paths(runs), _commands(runs), _gain(factors)]


def _paths(runs: list[Navigation]) -> Section:
    figure = panels(
        "Three goals",
        "Paths and coordinates for three goals.",
        "Path in the bending plane's coordinates, and each coordinate over time; dotted: goals.",
        [
            Panel(
                "along, mm",
                "across, mm",
                [
                    *(PlotLine(run.tip_m[:, 2] * 1e3, -run.tip_m[:, 1] * 1e3, f"goal {k}") for k, run in enumerate(runs, 1)),
                    *(PlotLine([run.goal_m[2] * 1e3], [-run.goal_m[1] * 1e3], "", None, "o") for run in runs),
                ],
            ),
            *(
                Panel(
                    "time, s",
                    f"{name}, mm",
                    [
                        PlotLine(run.time_s, (run.tip_m[:, axis] - run.goal_m[axis]) * 1e3, f"goal {k}")
                        for k, run in enumerate(runs, 1)
                    ],
                    level=0.0,
                )
                for axis, name in ((2, "along, from goal"), (1, "across, from goal"))
            ),
        ],
    )
    final = [float(np.mean(run.error_m[run.time_s > run.time_s[-1] - _LATE_S])) * 1e3 for run in runs]
    over = [_overshoot_mm(run) for run in runs]
    says = (
        "Distance from the goal over the last 5 s "
        + ", ".join(f"{value:.2f}" for value in final)
        + " mm; overshoot along the way "
        + ", ".join(f"{value:.2f}" for value in over)
        + " mm."
    )
    return Section(
        "fig_6.15_6.16",
        "Figs. 6.15, 6.16: three goals",
        "With K_Ik 0.005, K_Ia 0.0075, K_It 0.05 the tip "
        "comes smoothly to "
        "all three goals without significant overshoot or steady-state error.",
        "Printed gains per tracker frame "
        "(25 ms) on the simulated catheter with backlash, dead zones, tracker noise and delay.",
        verdict(max(final) < 1.0 and max(over) < 2.0),
        says,
        (figure,),
    )


def _overshoot_mm(run: Navigation) -> float:
    """Return the distance (mm) of the tip beyond the goal, along the line from its start to the goal."""
    way = run.goal_m - run.tip_m[0]
    past = (run.tip_m - run.goal_m) @ way / np.linalg.norm(way)
    return float(max(past.max(), 0.0) * 1e3)


def _commands(runs: list[Navigation]) -> Section:
    units = ((0, 1e3, "insertion, mm"), (1, math.degrees(1.0), "roll, °"), (2, math.degrees(1.0), "knob, °"))
    figure = panels(
        "Commands",
        "Stage commands over time.",
        "Stages as commanded, from their start.",
        [
            Panel(
                "time, s",
                name,
                [
                    PlotLine(run.time_s, (run.stage[:, axis] - run.stage[0, axis]) * scale, f"goal {k}")
                    for k, run in enumerate(runs, 1)
                ],
            )
            for axis, scale, name in units
        ],
    )
    jerk, travel = [], []
    for run in runs:
        step = np.diff(run.stage, axis=0)
        travel.append(np.abs(run.stage[-1] - run.stage[0]))
        jerk.append(np.max(np.abs(np.diff(step, axis=0)), axis=0))
    share = np.max(np.array(jerk) / np.maximum(np.array(travel), 1e-9), axis=0)
    back = [int(np.sum(np.abs(np.diff(run.stage[:, 0])) > 1e-3)) for run in runs]
    says = (
        f"Greatest change of a command's step from frame to frame: {share[1] * 100:.1f} % of the travel for roll, "
        f"{share[2] * 100:.1f} % for the knob; insertion jumps by the backlash width (3.1 mm) at a reversal, "
        "as compensation must."
    )
    return Section(
        "fig_6.17",
        "Fig. 6.17: commands to the steppers",
        "Smooth commands without jerky oscillation.",
        f"As commanded; {', '.join(map(str, back))} reversals of insertion, each with a jump by the backlash width.",
        verdict(bool(np.max(share[1:]) < 0.05)),
        says,
        (figure,),
    )


def _gain(runs: dict[float, Navigation]) -> Section:
    figure = panels(
        "Gain of insertion",
        "Along and across for three gains.",
        "K_Ia times 0.5, 1 and 2.",
        [
            *(
                Panel(
                    "time, s",
                    f"{name}, mm",
                    [
                        PlotLine(run.time_s, (run.tip_m[:, axis] - run.goal_m[axis]) * sign * 1e3, f"× {factor:g}")
                        for factor, run in runs.items()
                    ],
                    level=0.0,
                )
                for axis, sign, name in ((2, 1.0, "along, from goal"), (1, -1.0, "across, from goal"))
            ),
            Panel(
                "along, mm",
                "across, mm",
                [PlotLine(run.tip_m[:, 2] * 1e3, -run.tip_m[:, 1] * 1e3, f"× {factor:g}") for factor, run in runs.items()],
            ),
        ],
    )
    rise, over, across = {}, {}, {}
    for factor, run in runs.items():
        stage, along = run.stage[:, 0], run.tip_m[:, 2]
        near_m = 1e-3 + abs(stage[-1] - stage[0]) * 0.3
        rise[factor] = float(run.time_s[np.flatnonzero(np.abs(stage - stage[-1]) < near_m)[0]])
        ends = sorted((along[0], run.goal_m[2]))
        over[factor] = float(max(along.max() - ends[1], ends[0] - along.min(), 0.0)) * 1e3
        across[factor] = _within_s(run.time_s, run.tip_m[:, 1] - run.goal_m[1])
    holds = rise[2.0] < rise[0.5] and over[2.0] > over[0.5] and abs(across[2.0] - across[0.5]) < 0.1 * across[1.0]
    says = (
        "Insertion within 30 % and 1 mm of its end "
        "after "
        + ", ".join(f"{rise[f]:.1f}" for f in rise)
        + " s; tip beyond start and goal along by "
        + ", ".join(f"{over[f]:.1f}" for f in over)
        + " mm; across within 10 % after "
        + ", ".join(f"{across[f]:.1f}" for f in across)
        + " s (K_Ia × 0.5, 1, 2)."
    )
    return Section(
        "fig_6.18_6.19",
        "Figs. 6.18, 6.19: effect of the gain",
        "A higher gain of insertion converges faster along the axis with more overshoot, and changes little across.",
        "K_Ia × 0.5, 1, 2, the others as printed.",
        verdict(holds),
        says,
        (figure,),
    )


def _within_s(time_s: np.ndarray, error: np.ndarray) -> float:
    """When the error is within 10 % of its first value for good."""
    return float(time_s[np.flatnonzero(np.abs(error) > 0.1 * abs(error[0]))[-1]])
