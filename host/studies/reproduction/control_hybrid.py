"""Figs. 7.9 to 7.17: the hybrid controller simulated as the thesis did: rod, Newton's method, polynomials for the inverse.

The thesis gives neither the start nor the form of the law. Each statement is tried from every start of `STARTS`, with the
printed gains and with our minimum of (7.4) in both forms. The circular arcs as the plant stand next to the rod.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from host.mechanics.cosserat import solve_cosserat
from host.report.figure_page import Section, verdict
from host.report.style import MUTED, ReportFigure
from host.studies.reproduction import control_gains
from host.studies.reproduction.drawing import Panel, PlotLine, panels
from host.studies.reproduction.thesis_control import (
    CATHETER,
    INCREMENTAL,
    PERIOD_S,
    PI,
    STARTS,
    Gains,
    Setting,
    ThesisRun,
    cost,
    heart,
    hybrid,
    step_figures,
)
from host.studies.reproduction.thesis_plant import Instant, contact_by_algorithm_3_1, plant_model, rest
from protocol.catheter import load_catheter

FORCE_N = 0.25
FORCES_N = (0.1, 0.2, 0.3)
# Where the search of gains begins in the PI form, in which the printed ones are unstable.
PI_START = Gains(0.5, 0.02, 0.08, 0.0545, 1e-3, Gains.K_df)
# Iterations until a step is judged; the PI form is slower.
ITERATIONS = {INCREMENTAL: 60, PI: 600}
# A step has little overshoot below this share of the desired force (20 %).
LITTLE_OVERSHOOT = 0.2


class AdmissibleCase(NamedTuple):
    """One admissible setting: plant, start and form of the law, and the gains with their name."""

    setting: Setting
    gains: Gains
    gains_name: str

    @property
    def group(self) -> str:
        """Return form and gains in words."""
        return f"{self.setting.form.name}, {self.gains_name}"

    def on_arcs(self) -> AdmissibleCase:
        """Return the same with the circular arcs as the plant."""
        return self._replace(setting=replace(self.setting, rod=False))


class JudgedCase(NamedTuple):
    """Whether a statement holds in one case, and what was found."""

    holds: bool
    found: str


class Statement(NamedTuple):
    """One figure: its texts, how a case is judged, and the picture."""

    number: str
    title: str
    thesis: str
    ours: str
    judge: Callable[[AdmissibleCase], JudgedCase]
    picture: Callable[[AdmissibleCase], ReportFigure]


def sections(quick: bool) -> list[Section]:
    """Return the sections for figures 7.9 to 7.17. quick: one start, a short search of gains."""
    cases = admissible_cases(STARTS[:1] if quick else STARTS, 40 if quick else 400)
    first, *others = [_section(statement, cases) for statement in STATEMENTS]
    return [plant_section(), first, *control_gains.sections(quick), *others]


def admissible_cases(starts: Sequence[Setting], evaluations: int) -> list[AdmissibleCase]:
    """Return the cases: printed gains in both forms, and the minimum of (7.4) in both forms, from each start."""
    out = []
    for start in starts:
        for form in (INCREMENTAL, PI):
            setting = replace(start, form=form)
            out.append(AdmissibleCase(setting, Gains(), "printed gains"))
            out.append(AdmissibleCase(setting, best_gains(setting, evaluations), "our minimum of (7.4)"))
    return out


def best_gains(setting: Setting, evaluations: int) -> Gains:
    """Minimum of (7.4) by the simplex method, from the printed gains (PI form: `PI_START`); no equilibrium costs 1000 N."""
    names = [field.name for field in dataclasses.fields(Gains)]
    start = np.log([getattr(PI_START if setting.form.pi else Gains(), name) for name in names])

    def value(x: np.ndarray) -> float:
        return min(cost(Gains(*np.exp(x)), setting), 1000.0)

    simplex = np.vstack([start, start + 0.4 * np.eye(start.size)])
    found = minimize(
        value,
        start,
        method="Nelder-Mead",
        options={"maxfev": evaluations, "initial_simplex": simplex, "xatol": 1e-3, "fatol": 1e-5},
    )
    return Gains(*map(float, np.exp(found.x)))


def _section(statement: Statement, cases: Sequence[AdmissibleCase]) -> Section:
    """One figure: where its statement holds on the rod, and the map of the settings with the arcs next to it."""
    rod = [(case, statement.judge(case)) for case in cases]
    arcs = [statement.judge(case.on_arcs()) for case in cases]
    groups = dict.fromkeys(case.group for case, _ in rod)
    counts = []
    for group in groups:
        here = [judged.holds for case, judged in rod if case.group == group]
        counts.append(f"{group}: {sum(here)} of {len(here)} starts")
    shown = next((pair for pair in rod if pair[1].holds), rod[0])
    rows = [
        (case.setting.name, case.group, judged.found, *("yes" if one.holds else "no" for one in (judged, flat)))
        for (case, judged), flat in zip(rod, arcs, strict=True)
    ]
    return Section(
        f"fig_{statement.number}",
        statement.title,
        statement.thesis,
        statement.ours,
        verdict(any(judged.holds for _, judged in rod)),
        f"Holds with {'; '.join(counts)}. {shown[0].setting.name}, {shown[0].group}: {shown[1].found}.",
        (statement.picture(shown[0]),),
        (("start", "form and gains", "found on the rod", "holds on the rod", "on the arcs"), *rows),
    )


def plant_section() -> Section:
    """7.3: the contact of the sweeps compared with the thesis' own numerical method, on instants of one run."""
    run, setting = hybrid(FORCE_N, 60), Setting()
    model, rows, off_N, off_m = plant_model(CATHETER, True), [], [], []
    for k in (1, 2, 3, 5, 10, 59):
        at = Instant(float(run.joint[k, 0]), float(run.joint[k, 1]), float(run.wall_m[k]), 1.0)
        fast, coarse = rest(model, at, at, np.zeros(3)), contact_by_algorithm_3_1(model, at)
        fine = contact_by_algorithm_3_1(model, at, 8000, 1e-9)
        off_N.append([abs(one.force_N - fast.force_N) for one in (coarse, fine)])
        off_m.append([math.hypot(one.x - fast.x, one.y - fast.y) for one in (coarse, fine)])
        rows.append((f"{k}", *(f"{one.force_N * 1e3:.3f}" for one in (fast, coarse, fine))))
    coarse_N, fine_N = np.max(off_N, axis=0)
    coarse_m, fine_m = np.max(off_m, axis=0)
    t = np.arange(run.force_N.size)
    picture = panels(
        "Contact force by two methods",
        "Force over iterations by two methods.",
        "Line: one Newton's method for rod and contact; dots: Algorithm 3.1 inside Newton's method, 500 elements.",
        [
            Panel(
                "iteration",
                "force, N",
                [
                    PlotLine(t, run.force_N, "one Newton's method"),
                    PlotLine(
                        [int(row[0]) for row in rows], [float(row[2]) * 1e-3 for row in rows], "Algorithm 3.1", None, "o"
                    ),
                ],
            )
        ],
    )
    return Section(
        "fig_7.3",
        "Fig. 7.3: contact of catheter and tissue",
        "Algorithm 3.1 gives the rod's shape, Newton-Raphson the force at which the tip lies on the tissue (a spring).",
        f"One Newton's method for both, {setting.name}, compared with Algorithm 3.1 (500 elements; 8000 elements and a "
        "threshold of 1e-9) at instants of one run. The sweeps below use the former.",
        verdict(bool(fine_N < coarse_N and coarse_N < 0.01 * FORCE_N)),
        f"Largest difference from Algorithm 3.1 with 500 elements {coarse_N * 1e3:.2f} mN and {coarse_m * 1e6:.0f} um, "
        f"with 8000 {fine_N * 1e3:.3f} mN and {fine_m * 1e6:.1f} um.",
        (picture,),
        (("iteration", "one Newton's method, mN", "Algorithm 3.1, 500 elements, mN", "8000 elements, mN"), *rows),
    )


def _lost(*runs: ThesisRun) -> JudgedCase | None:
    """Return the verdict where a run has no equilibrium; None where all have one."""
    return JudgedCase(False, "no equilibrium at some iteration") if any(run.failed for run in runs) else None


def _judge_convergence(case: AdmissibleCase) -> JudgedCase:
    """7.9, 7.10: the step to 0.25 N."""
    run = hybrid(FORCE_N, ITERATIONS[case.setting.form], case.gains, case.setting)
    lost = _lost(run)
    if lost:
        return lost
    figures = step_figures(run, FORCE_N)
    off_mm = abs(run.tip_m[-1, 0] - case.setting.tip_m[0]) * 1e3
    longer_mm = (run.joint[-1, 1] - run.joint[0, 1]) * 1e3
    holds = figures.steady_error_N < 0.05 * FORCE_N and figures.ringing_N < 0.05 * FORCE_N and off_mm < 0.5 and longer_mm > 0
    return JudgedCase(
        bool(holds),
        f"error at the end {figures.steady_error_N * 1e3:.1f} mN, within 5 % after {figures.settling} iterations, "
        f"position {off_mm:.3f} mm off, {longer_mm:+.2f} mm of catheter more outside",
    )


def _draw_convergence(case: AdmissibleCase) -> ReportFigure:
    run = hybrid(FORCE_N, 60, case.gains, case.setting)
    catheter, shapes = load_catheter(CATHETER), []
    for label, index in (("start", 0), ("end", -1)):
        curvature, insertion = map(float, run.joint[index])
        back = np.linspace(0.0, case.setting.length_m + 0.01, 80)
        found = solve_cosserat(catheter, insertion, curvature, (0.0, float(run.force_N[index]), 0.0), stations_m=back)
        line = found.station_positions_m
        shapes.append(PlotLine(line[:, 2] * 1e3, -line[:, 1] * 1e3, label))
    t, ends = np.arange(60), [shapes[0].x.max() - 12, shapes[0].x.max() + 12]
    wall = PlotLine(ends, [run.wall_m[0] * 1e3] * 2, "wall", MUTED)
    return panels(
        "Shape, force and position",
        "Shapes and responses.",
        "Start and end shape; force across, position along, and the commands.",
        [
            Panel("x, mm", "y, mm", [*shapes, wall], equal=True),
            Panel("iteration", "force, N", [PlotLine(t, run.force_N, "force")], level=FORCE_N),
            Panel("iteration", "x, mm", [PlotLine(t, run.tip_m[:, 0] * 1e3, "tip along the wall")]),
            Panel("iteration", "insertion, mm", [PlotLine(t, run.joint[:, 1] * 1e3, "insertion")]),
            Panel("iteration", "curvature, 1/m", [PlotLine(t, run.joint[:, 0], "curvature")]),
        ],
    )


def _judge_steps(case: AdmissibleCase) -> JudgedCase:
    """7.13: the three steps of (7.4)."""
    runs = [hybrid(force, 40, case.gains, case.setting) for force in FORCES_N]
    lost = _lost(*runs)
    if lost:
        return lost
    steps = [step_figures(run, force) for run, force in zip(runs, FORCES_N, strict=True)]
    little = all(step.overshoot_N < LITTLE_OVERSHOOT * force for step, force in zip(steps, FORCES_N, strict=True))
    listed = ""
    if case.gains != Gains():
        listed = "; " + ", ".join(
            f"{field.name} {getattr(case.gains, field.name):.3g}" for field in dataclasses.fields(Gains)
        )
    return JudgedCase(
        little and all(step.settling < 40 for step in steps),
        f"J = {cost(case.gains, case.setting):.3f} N, within 5 % after {', '.join(f'{step.settling}' for step in steps)} "
        f"iterations, overshoot {', '.join(f'{step.overshoot_N * 1e3:.0f}' for step in steps)} mN{listed}",
    )


def _draw_steps(case: AdmissibleCase) -> ReportFigure:
    t = np.arange(40)
    lines = [PlotLine(t, hybrid(force, 40, case.gains, case.setting).force_N, f"{force} N") for force in FORCES_N]
    return panels(
        "Steps with optimal gains",
        "Step responses for three forces.",
        f"Rod, {case.setting.name}, {case.group}.",
        [Panel("iteration", "force, N", lines)],
        3.1,
    )


def _growing(case: AdmissibleCase) -> ThesisRun:
    return hybrid(0.2, 600, case.gains, case.setting, stiffness=lambda k: 1.0 + 0.1 * (k // 100))


def _judge_stiffness(case: AdmissibleCase) -> JudgedCase:
    """7.14: +10 % of bending stiffness each 100 iterations."""
    run = _growing(case)
    lost = _lost(run)
    if lost:
        return lost
    parts = [run.force_N[100 * block + 60 : 100 * block + 100] for block in range(6)]
    worst = [float(np.max(np.abs(part - 0.2))) * 1e3 for part in parts]
    return JudgedCase(max(worst) < 10.0, f"greatest error {', '.join(f'{value:.1f}' for value in worst)} mN")


def _draw_stiffness(case: AdmissibleCase) -> ReportFigure:
    lines = [PlotLine(np.arange(600), np.minimum(_growing(case).force_N, 0.5), "force")]
    return panels(
        "Stiffness that grows",
        "Force while the stiffness grows.",
        f"+10 % each 100 iterations. Rod, {case.setting.name}, {case.group}.",
        [Panel("iteration", "force, N", lines, level=0.2)],
    )


class Beating(NamedTuple):
    """Runs on the beating wall for one desired force: controlled, and with the joints left where they rest."""

    controlled: ThesisRun
    left_alone: ThesisRun


HEART_ITERATIONS, HEART_FROM = 600, 100


def _beating(case: AdmissibleCase, force_N: float) -> Beating:
    joint = hybrid(force_N, ITERATIONS[case.setting.form], case.gains, case.setting).joint[-1]
    controlled, left = (
        hybrid(force_N, HEART_ITERATIONS, case.gains, case.setting, heart, still=still, start_joint=joint)
        for still in (False, True)
    )
    return Beating(controlled, left)


def _judge_tracking(case: AdmissibleCase) -> JudgedCase:
    """7.15: the tip stays on the moving tissue."""
    runs = [_beating(case, force).controlled for force in FORCES_N]
    lost = _lost(*runs)
    if lost:
        return lost
    run = runs[1]
    follow_mm = float(np.std((run.tip_m[HEART_FROM:, 1] - run.wall_m[HEART_FROM:]) * 1e3))
    touched = min(float(one.force_N[HEART_FROM:].min()) for one in runs)
    kept = "contact kept" if touched > 0 else "contact lost"
    return JudgedCase(follow_mm < 0.2 and touched > 0, f"distance of tip and wall varies by {follow_mm:.4f} mm, {kept}")


def _draw_tracking(case: AdmissibleCase) -> ReportFigure:
    run, shown = _beating(case, 0.2).controlled, slice(HEART_ITERATIONS - 160, HEART_ITERATIONS)
    lines = [
        PlotLine(run.time_s[shown], values[shown] * 1e3, label)
        for values, label in ((run.wall_m, "wall"), (run.tip_m[:, 1], "tip"))
    ]
    return panels(
        "Tip and wall",
        "Tip and wall over time.",
        "0.2 N desired; wall after (7.5), 2 Hz 1 mm and 0.33 Hz 0.4 mm.",
        [Panel("time, s", "across, mm", lines)],
    )


def _judge_beating(case: AdmissibleCase) -> JudgedCase:
    """7.16: three forces, compared with a catheter that does not move."""
    runs = {force: _beating(case, force) for force in FORCES_N}
    lost = _lost(*(run for pair in runs.values() for run in pair))
    if lost:
        return lost
    rms = {
        force: [float(np.sqrt(np.mean((run.force_N[HEART_FROM:] - force) ** 2))) * 1e3 for run in pair]
        for force, pair in runs.items()
    }
    said = ", ".join(f"{force} N: {pair[0]:.1f} mN RMS, left alone {pair[1]:.1f}" for force, pair in rms.items())
    return JudgedCase(all(pair[0] < pair[1] for pair in rms.values()), said)


def _draw_beating(case: AdmissibleCase) -> ReportFigure:
    shown, lines = slice(HEART_ITERATIONS - 160, HEART_ITERATIONS), []
    for force in FORCES_N:
        pair = _beating(case, force)
        t = pair.controlled.time_s[shown]
        lines.append(PlotLine(t, pair.controlled.force_N[shown], f"{force} N"))
        lines.append(PlotLine(t, pair.left_alone.force_N[shown], "", MUTED, "--"))
    return panels(
        "Force on the beating wall",
        "Force for three desired forces.",
        "Lines: controlled; dashed: catheter left alone.",
        [Panel("time, s", "force, N", lines)],
        3.1,
    )


def _amplitudes_N(case: AdmissibleCase, frequencies: np.ndarray) -> np.ndarray:
    """Amplitudes of the force (n,) N on a wall that moves by 1 mm as a sine of each frequency (Hz); NaN without contact."""
    joint, out = hybrid(0.2, ITERATIONS[case.setting.form], case.gains, case.setting).joint[-1], []
    for frequency in frequencies:
        count = int(max(200, 4.0 / frequency / PERIOD_S))

        def motion(t: np.ndarray, frequency: float = frequency) -> np.ndarray:
            return np.asarray(0.001 * np.sin(2 * np.pi * frequency * t))

        run = hybrid(0.2, count, case.gains, case.setting, motion, start_joint=joint)
        late = run.force_N[count // 2 :]
        out.append(math.nan if run.failed or late.min() <= 0.0 else float(np.sqrt(2.0) * np.std(late)))
    return np.array(out)


FACTORS = (0.25, 0.5, 1.0)


def _judge_frequencies(case: AdmissibleCase) -> JudgedCase:
    """7.17: K_pf × 1 compared with × 0.25, from 4 to 10 Hz and below 1 Hz."""
    step = step_figures(hybrid(0.2, ITERATIONS[case.setting.form], case.gains, case.setting), 0.2)
    if step.ringing_N > control_gains.AT_REST_N or step.steady_error_N > 0.05 * 0.2:
        return JudgedCase(False, "0.2 N is not held on a wall at rest")

    frequencies = np.array([0.2, 0.5, 4.1, 5.3, 6.7, 8.3, 9.7])
    low, high = (
        _amplitudes_N(case._replace(gains=case.gains.scaled(K_pf=f)), frequencies) for f in (FACTORS[0], FACTORS[-1])
    )
    ratio = high / low
    slow, fast = float(np.mean(ratio[frequencies < 1.0])), float(np.mean(ratio[frequencies > 4.0]))
    if not math.isfinite(slow + fast):
        return JudgedCase(False, "contact lost at some frequency")
    return JudgedCase(
        fast < 1.0, f"amplitude with K_pf × 1 {fast:.2f} of that with × 0.25 from 4 to 10 Hz, {slow:.2f} below 1 Hz"
    )


def _draw_frequencies(case: AdmissibleCase) -> ReportFigure:
    frequencies = np.geomspace(0.1, 10.0, 16)
    lines = []
    for factor in FACTORS:
        changed = case._replace(gains=case.gains.scaled(K_pf=factor))
        amplitude = _amplitudes_N(changed, frequencies)
        lines.append(PlotLine(frequencies, 20 * np.log10(amplitude / 0.001), f"K_pf × {factor:g}"))
    return panels(
        "Magnitude over frequency",
        "Force amplitude over the frequency of the wall.",
        f"Amplitude of the force for 1 mm of wall, dB re 1 N/m; {PERIOD_S * 1e3:.0f} ms an iteration: 20 Hz is the limit.",
        [Panel("frequency, Hz", "force per wall motion, dB(N/m)", lines, log_x=True)],
        3.2,
    )


STATEMENTS = (
    Statement(
        "7.9_7.10",
        "Figs. 7.9, 7.10: force and position together",
        "Force across and position along the wall come to their goals together; more catheter is outside in the end.",
        f"Step to {FORCE_N} N, {PERIOD_S * 1e3:.0f} ms an iteration.",
        _judge_convergence,
        _draw_convergence,
    ),
    Statement(
        "7.13",
        "Fig. 7.13: optimal gains",
        "Simplex search of (7.4): K_pp 1.3704, K_ip 0.001, K_dp 0.2122, K_pf 0.0545, K_if 1e-4, K_df 0.0062; fast steps "
        "with little overshoot.",
        "The printed gains and our minimum by the simplex method; 0.1, 0.2 and 0.3 N within 5 % in 40 iterations, with an "
        "overshoot below 20 %.",
        _judge_steps,
        _draw_steps,
    ),
    Statement(
        "7.14",
        "Fig. 7.14: stiffness uncertain",
        "With +10 % of stiffness each 100 iterations the controller returns to the desired force.",
        "The same, 0.2 N, five steps to +50 %; error from 60 iterations after each step on, below 10 mN.",
        _judge_stiffness,
        _draw_stiffness,
    ),
    Statement(
        "7.15",
        "Fig. 7.15: tip follows the heart",
        "The tip closely tracks the rapid motion of the heart.",
        "Depth in the tissue at 0.2 N; contact at 0.1, 0.2 and 0.3 N.",
        _judge_tracking,
        _draw_tracking,
    ),
    Statement(
        "7.16",
        "Fig. 7.16: force on the beating heart",
        "Force oscillates little about 0.1, 0.2 and 0.3 N.",
        "The same three forces, compared with a catheter that does not move, whose lateral compliance alone keeps the force "
        "steady to some degree.",
        _judge_beating,
        _draw_beating,
    ),
    Statement(
        "7.17",
        "Fig. 7.17: magnitude over frequency",
        "Higher proportional gains damp the contact force better at high frequencies of the heart.",
        "Sine motion of 1 mm, with K_pf × 0.25 and × 1.",
        _judge_frequencies,
        _draw_frequencies,
    ),
)
