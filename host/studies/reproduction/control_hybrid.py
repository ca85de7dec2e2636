"""Figs. 7.9 to 7.17: the hybrid controller simulated as the thesis did, planar, with its printed gains."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.optimize import minimize

from host.mechanics import pcar
from host.report.figure_page import Section, verdict
from host.report.style import MUTED
from host.studies.reproduction import control_gains
from host.studies.reproduction.drawing import Panel, PlotLine, panels
from host.studies.reproduction.thesis_control import PERIOD_S, Gains, Setting, ThesisRun, cost, heart, hybrid, step_figures
from protocol.catheter import load_catheter

FORCE_N = 0.25


def sections(quick: bool) -> list[Section]:
    """Return the sections for figures 7.9 to 7.17."""
    optimum = best_gains(60 if quick else 400)
    return [
        _convergence(),
        *control_gains.sections(quick),
        _optimum(optimum),
        _stiffness(optimum),
        *_heart(),
        _bode(8 if quick else 24),
    ]


def best_gains(evaluations: int) -> Gains:
    """Minimum of (7.4) by the simplex method, from the printed gains; a law that fails costs what its error is."""
    names = [field.name for field in dataclasses.fields(Gains)]
    start = np.log([getattr(Gains(), name) for name in names])

    def value(x: np.ndarray) -> float:
        return cost(Gains(*np.exp(x)))

    simplex = np.vstack([start, start + 0.4 * np.eye(start.size)])
    found = minimize(
        value,
        start,
        method="Nelder-Mead",
        options={"maxfev": evaluations, "initial_simplex": simplex, "xatol": 1e-3, "fatol": 1e-5},
    )
    return Gains(*map(float, np.exp(found.x)))


def _convergence() -> Section:
    run = hybrid(FORCE_N, 60)
    catheter, setting = load_catheter("steerocath_t"), Setting()
    shapes = []
    for label, index in (("start", 0), ("end", -1)):
        curvature, insertion = run.joint[index]
        arcs = pcar.arcs_of(catheter, float(insertion), float(curvature))
        found = pcar.solve(arcs, (0.0, -float(run.force_N[index])))
        line = pcar.shape(arcs, found.curvature_per_m)
        shapes.append(PlotLine(line[:, 0] * 1e3, line[:, 1] * 1e3, label))
    t = np.arange(60)
    wall = PlotLine([shapes[0].x.max() - 12, shapes[0].x.max() + 12], [run.wall_m[0] * 1e3] * 2, "wall", MUTED)
    figure = panels(
        "Shape, force and position",
        "Shapes and responses.",
        "Start and end shape; force across, place along, and the commands.",
        [
            Panel("x, mm", "y, mm", [*shapes, wall], equal=True),
            Panel("iteration", "force, N", [PlotLine(t, run.force_N, "force")], level=FORCE_N),
            Panel("iteration", "x, mm", [PlotLine(t, run.tip_m[:, 0] * 1e3, "tip along the wall")]),
            Panel("iteration", "insertion, mm", [PlotLine(t, run.joint[:, 1] * 1e3, "insertion")]),
            Panel("iteration", "curvature, 1/m", [PlotLine(t, run.joint[:, 0], "curvature")]),
        ],
    )
    figures = step_figures(run, FORCE_N)
    off_mm = abs(run.tip_m[-1, 0] - run.tip_m[0, 0]) * 1e3
    longer_mm = (run.joint[-1, 1] - run.joint[0, 1]) * 1e3
    holds = figures.steady_error_N < 0.05 * FORCE_N and off_mm < 0.5 and longer_mm > 0
    says = (
        f"Force within 5 % after {figures.settling} iterations, error at the end {figures.steady_error_N * 1e3:.1f} "
        "mN, place "
        f"{off_mm:.3f} mm off, {longer_mm:+.2f} mm of catheter more outside."
    )
    return Section(
        "fig_7.9_7.10",
        "Figs. 7.9, 7.10: force and position together",
        "Force across and position along the wall come to their goals together; more catheter is outside in the end.",
        f"Printed gains, {PERIOD_S * 1e3:.0f} ms an iteration, steerocath_t with "
        f"{70 + setting.insertion_m * 1e3:.0f} mm "
        "outside: the thesis gives no start, and a whole distal shaft buckles below 0.2 N.",
        verdict(holds),
        says,
        (figure,),
    )


def _optimum(best: Gains) -> Section:
    """7.13: our minimum of (7.4) compared with the printed gains."""
    forces = (0.1, 0.2, 0.3)
    t = np.arange(40)
    runs = {force: (hybrid(force, 40, best), hybrid(force, 40)) for force in forces}
    figure = panels(
        "Steps with optimal gains",
        "Step responses for three forces.",
        "Left our minimum of (7.4), right the printed gains.",
        [
            Panel(
                "iteration",
                "force, N",
                [PlotLine(t, runs[force][k].force_N, f"{force} N") for force in forces],
                title=title,
            )
            for k, title in enumerate(("our minimum", "printed gains"))
        ],
        3.1,
    )
    ours, printed = cost(best), cost(Gains())
    worst = max(step_figures(runs[force][0], force).overshoot_N for force in forces)
    listed = ", ".join(f"{field.name} {getattr(best, field.name):.3g}" for field in dataclasses.fields(best))
    return Section(
        "fig_7.13",
        "Fig. 7.13: optimal gains",
        "Simplex search of (7.4): K_pp 1.3704, K_ip 0.001, K_dp 0.2122, "
        "K_pf 0.0545, "
        "K_if 1e-4, K_df 0.0062; fast steps with little overshoot.",
        f"Simplex from the printed gains: {listed}.",
        verdict(ours <= printed * 1.001 and worst < 0.06),
        f"J = {ours:.3f} N (printed gains {printed:.3f} N), greatest overshoot {worst * 1e3:.0f} mN.",
        (figure,),
    )


def _stiffness(best: Gains) -> Section:
    """7.14: +10 % of bending stiffness each 100 iterations."""
    growing = {
        name: hybrid(0.2, 600, gains, stiffness=lambda k: 1.0 + 0.1 * (k // 100))
        for name, gains in (
            ("our minimum of (7.4)", best),
            ("printed gains", Gains()),
            ("printed, K_pf halved", Gains().scaled(K_pf=0.5)),
        )
    }
    worst = {}
    for name, run in growing.items():
        settled = [run.force_N[100 * block + 60 : 100 * block + 100] for block in range(6)]
        worst[name] = [float(np.max(np.abs(part - 0.2))) * 1e3 for part in settled]
    figure = panels(
        "Stiffness that grows",
        "Force while the stiffness grows.",
        "+10 % each 100 iterations.",
        [
            Panel(
                "iteration",
                "force, N",
                [PlotLine(np.arange(600), np.minimum(run.force_N, 0.5), name) for name, run in growing.items()],
                level=0.2,
            )
        ],
    )
    said = "; ".join(f"{name}: " + ", ".join(f"{value:.1f}" for value in values) for name, values in worst.items())
    return Section(
        "fig_7.14",
        "Fig. 7.14: stiffness uncertain",
        "With +10 % of stiffness each 100 iterations the controller returns to the desired force.",
        "The same, 0.2 N, five steps to +50 %. In our setting the printed gains leave little "
        "margin; halving "
        "one of them restores it.",
        verdict(max(worst["our minimum of (7.4)"]) < 10.0),
        f"Greatest error (mN) from 60 iterations after each step on, 0 to +50 %: {said}.",
        (figure,),
    )


def _heart() -> list[Section]:
    """7.15 and 7.16: the beating wall, three forces, compared with a catheter that does not move."""
    forces, n = (0.1, 0.2, 0.3), 600
    shown = slice(n - 160, n)
    stiller: dict[float, tuple[ThesisRun, ThesisRun]] = {}
    for force in forces:
        rest = hybrid(force, 200).joint[-1]
        stiller[force] = (
            hybrid(force, n, wall_motion=heart, start_joint=rest),
            hybrid(force, n, wall_motion=heart, start_joint=rest, still=True),
        )
    run = stiller[0.2][0]
    first = panels(
        "Tip and wall",
        "Tip and wall over time.",
        "0.2 N wanted; wall after (7.5), 2 Hz 1 mm and 0.33 Hz 0.4 mm.",
        [
            Panel(
                "time, s",
                "across, mm",
                [
                    PlotLine(run.time_s[shown], run.wall_m[shown] * 1e3, "wall"),
                    PlotLine(run.time_s[shown], run.tip_m[shown, 1] * 1e3, "tip"),
                ],
            )
        ],
    )
    second = panels(
        "Force on the beating wall",
        "Force for three desired forces.",
        "Lines: controlled; dashed: catheter left alone.",
        [
            Panel(
                "time, s",
                "force, N",
                [
                    curve
                    for force in forces
                    for curve in (
                        PlotLine(run.time_s[shown], stiller[force][0].force_N[shown], f"{force} N"),
                        PlotLine(run.time_s[shown], stiller[force][1].force_N[shown], "", MUTED, "--"),
                    )
                ],
            )
        ],
        3.1,
    )
    follow_mm = float(np.std((run.tip_m[100:, 1] - run.wall_m[100:]) * 1e3))
    rms = {
        force: [float(np.sqrt(np.mean((r.force_N[100:] - force) ** 2))) * 1e3 for r in stiller[force]] for force in forces
    }
    touched = min(float(pair[0].force_N[100:].min()) for pair in stiller.values())
    said = "; ".join(f"{force} N: {pair[0]:.1f} mN RMS, left alone {pair[1]:.1f}" for force, pair in rms.items())
    better = all(pair[0] < pair[1] for pair in rms.values())
    return [
        Section(
            "fig_7.15",
            "Fig. 7.15: tip follows the heart",
            "The tip closely tracks the rapid motion of the heart.",
            "Printed gains; the compliant shaft alone follows the wall as well, see the next section.",
            verdict(follow_mm < 0.2 and touched > 0),
            f"Tip and wall apart by {follow_mm:.4f} mm RMS about the mean depth; contact never lost.",
            (first,),
        ),
        Section(
            "fig_7.16",
            "Fig. 7.16: force on the beating heart",
            "Force oscillates little about 0.1, 0.2 and 0.3 N.",
            "The same three forces, compared with a catheter that does not move: most of the steadiness comes from "
            "the lateral compliance of the shaft.",
            verdict(better),
            said + ".",
            (second,),
        ),
    ]


def _bode(points: int) -> Section:
    """7.17: force amplitude over the wall's frequency, 0.1 to 10 Hz, 1 mm, for three proportional force gains."""
    frequencies = np.geomspace(0.1, 10.0, points)
    factors = (0.25, 0.5, 1.0)
    curves, table = [], {}
    for factor in factors:
        gains, row = Gains().scaled(K_pf=factor), []
        rest = hybrid(0.2, 200, gains).joint[-1]
        for frequency in frequencies:
            n = int(max(200, 4.0 / frequency / PERIOD_S))
            run = hybrid(
                0.2,
                n,
                gains,
                start_joint=rest,
                wall_motion=lambda t, f=frequency: 0.001 * np.sin(2 * np.pi * f * t),  # type: ignore[misc]
            )
            late = run.force_N[n // 2 :]
            row.append(float(np.sqrt(2.0) * np.std(late)))
        table[factor] = np.array(row)
        curves.append(PlotLine(frequencies, 20 * np.log10(table[factor] / 0.001), f"K_pf × {factor:g}"))
    figure = panels(
        "Magnitude over frequency",
        "Force amplitude over the frequency of the wall.",
        "Amplitude of the force "
        "for 1 mm of "
        f"wall, dB re 1 N/m; {PERIOD_S * 1e3:.0f} ms an iteration, so 20 Hz is the most that could be followed.",
        [Panel("frequency, Hz", "force per wall motion, dB(N/m)", curves, log_x=True)],
        3.2,
    )
    low, high = frequencies < 1.0, frequencies >= 4.0
    less_low = float(np.mean(table[1.0][low] / table[0.25][low]))
    less_high = float(np.mean(table[1.0][high] / table[0.25][high]))
    return Section(
        "fig_7.17",
        "Fig. 7.17: magnitude over frequency",
        "Higher proportional gains damp the contact force better at high frequencies of the heart.",
        "Sine motion of 1 mm, 0.1 to 10 Hz, printed gains with K_pf × 0.25, 0.5, 1.",
        verdict(less_high < 1.0),
        f"From × 0.25 to × 1 the force amplitude changes to {less_low:.2f} times below 1 Hz and {less_high:.2f} "
        "times from "
        "4 to 10 Hz.",
        (figure,),
    )
