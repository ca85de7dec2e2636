"""Figs. 7.5 to 7.8: workspace and its singular points, polynomials for the inverse, and control near a singularity."""

from __future__ import annotations

import math

import numpy as np

from host.report.figure_page import Section, verdict
from host.report.style import MEASURED, MUTED, TRUTH
from host.studies.control import baselines
from host.studies.reproduction.drawing import Panel, PlotLine, panels
from host.studies.reproduction.thesis_inverse import branch_bends, fitted_polynomials, unit_tip
from realtime.control.inverse_kinematics import FOLD_BEND, FOLD_REACH

LENGTH_M = 0.070
PRINTED_ERROR = 0.26
GAIN, NOISE_M = 0.3, 0.00029


def sections() -> list[Section]:
    """Return the four sections on kinematics."""
    return [_workspace(), *_polynomials(), _near_singularity()]


def _along_across(bend: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    along, across = unit_tip(bend)
    return LENGTH_M * along, LENGTH_M * across


def _workspace() -> Section:
    bend = np.linspace(-2 * math.pi, 2 * math.pi, 1601)
    along, across = _along_across(bend)
    determinant = np.array([np.linalg.det(baselines.jacobian(np.array([b / LENGTH_M, 0.0]), LENGTH_M)) for b in bend])
    crossing = bend[np.flatnonzero(np.diff(np.sign(determinant)))]
    folds = _along_across(crossing)
    at_fold = np.min(np.abs(np.abs(crossing) - FOLD_BEND)) < 0.01
    figure = panels(
        "Workspace",
        "Tip of the distal shaft over its curvature.",
        "Tip for body insertion zero; the dots are where the determinant of (7.3) is zero: the tip is furthest across.",
        [
            Panel(
                "x, mm",
                "y, mm",
                [
                    PlotLine(along * 1e3, across * 1e3, "tip"),
                    PlotLine(folds[0] * 1e3, folds[1] * 1e3, "singular", TRUTH, "o"),
                ],
                equal=True,
            ),
            Panel("bend, rad", "det J, m²", [PlotLine(bend, determinant, "")], level=0.0),
        ],
    )
    says = (
        f"det J is zero at bends of {', '.join(f'{b:+.2f}' for b in crossing)} rad: extremes of y, across "
        f"{FOLD_REACH * LENGTH_M * 1e3:.1f} mm; straight is not a singular point of (7.3)."
    )
    return Section(
        "fig_7.5",
        "Fig. 7.5: workspace",
        "The Jacobian is singular at several points, the extremes of the tip's place.",
        "Determinant of (7.3), smooth through straight, over one turn of bend either way.",
        verdict(bool(at_fold) and crossing.size >= 2),
        says,
        (figure,),
    )


def _polynomials() -> list[Section]:
    """Three 9th-order polynomials for curvature over y, and the tip that they lead to."""
    coefficients = fitted_polynomials()
    bends = [branch_bends(branch) for branch in range(3)]
    reaches = [unit_tip(bend)[1] for bend in bends]
    fitted = [np.polynomial.polynomial.polyval(reach, row) for reach, row in zip(reaches, coefficients, strict=True)]
    errors = [(found - bend) / LENGTH_M for found, bend in zip(fitted, bends, strict=True)]
    gap = abs(fitted[1][-1] - fitted[2][0]) / LENGTH_M
    middle, rms = (float(np.sqrt(np.mean(part**2))) for part in (errors[1], np.concatenate(errors)))
    curves = [
        PlotLine(reach * LENGTH_M * 1e3, values / LENGTH_M, label if branch == 1 else "", colour, style)
        for values_of, label, colour, style in (
            (bends, "inverse of (7.2)", MUTED, "-"),
            (fitted, "polynomials, 9th order", TRUTH, "--"),
        )
        for branch, (reach, values) in enumerate(zip(reaches, values_of, strict=True))
    ]
    first = panels(
        "Polynomials",
        "Curvature over the tip's place across.",
        "Three branches, connected at the folds.",
        [Panel("y, mm", "curvature, 1/m", curves)],
        3.2,
    )
    off = np.concatenate(
        [
            LENGTH_M * np.hypot(*np.subtract(unit_tip(found), unit_tip(bend)))
            for found, bend in zip(fitted, bends, strict=True)
        ]
    )
    exact, by_polynomial = _along_across(bends[1]), _along_across(fitted[1])
    second = panels(
        "Tip by the polynomials",
        "Tip wanted, and as the polynomials lead it.",
        "The middle branch: tip wanted and the tip that its polynomial's curvature gives.",
        [
            Panel(
                "x, mm",
                "y, mm",
                [
                    PlotLine(exact[0] * 1e3, exact[1] * 1e3, "wanted", MEASURED),
                    PlotLine(by_polynomial[0] * 1e3, by_polynomial[1] * 1e3, "by polynomial", TRUTH, "--"),
                ],
                equal=True,
            )
        ],
    )
    return [
        Section(
            "fig_7.6",
            "Fig. 7.6: polynomials for the inverse",
            "Three connected 9th-order polynomials approximate the inverse of (7.2) with a root square error of 0.26.",
            "The same three branches and order, fitted at equal steps of curvature to bends of 5.2 rad; shaft of 70 mm.",
            verdict(round(middle, 2) <= PRINTED_ERROR),
            f"Error {middle:.3f} 1/m RMS over the middle polynomial, {rms:.3f} 1/m over all three (thesis 0.26; "
            "unit and range not stated). At the folds the slope of the inverse is infinite; there the polynomials are "
            f"{gap:.1f} 1/m apart.",
            (first,),
        ),
        Section(
            "fig_7.7",
            "Fig. 7.7: tip by the approximate inverse",
            "Tip positions by the approximate inverse agree with the real ones along a trajectory.",
            "The same, over all three branches.",
            verdict(float(np.median(off)) < 1e-3),
            f"Tip off by {np.median(off) * 1e3:.2f} mm (median) and {off.max() * 1e3:.1f} mm (greatest, at the folds). "
            "The controller of the simulations uses these polynomials; that of the rig uses the exact inverse of (7.2).",
            (second,),
        ),
    ]


def _near_singularity() -> Section:
    """Track a path along the workspace's edge and back, by three inverses, same gain and noise."""
    start_bend, edge = 1.9, FOLD_BEND - 0.04
    bends = np.concatenate([np.linspace(start_bend, edge, 160), np.full(160, edge), np.linspace(edge, start_bend, 80)])
    goals = np.column_stack(_along_across(bends))
    steps = {
        "Jacobian inverse": baselines.jacobian_inverse_step(LENGTH_M),
        "damped least squares": baselines.damped_step(LENGTH_M),
        "fitted curve (ours)": baselines.fitted_curve_step(LENGTH_M),
    }
    start = np.array([start_bend / LENGTH_M, 0.0])
    paths = {name: baselines.run(step, start, goals, LENGTH_M, GAIN, NOISE_M, seed=3) for name, step in steps.items()}
    errors = {name: float(np.sqrt(np.mean(np.sum((path.tip_m - goals)[20:] ** 2, axis=1)))) for name, path in paths.items()}
    t = np.arange(len(goals))
    figure = panels(
        "Near the fold",
        "Tip under control by three inverses.",
        "The goal runs along the edge of the "
        "workspace; "
        f"loop gain {GAIN} an iteration, tracker noise {NOISE_M * 1e3} mm, the same for all.",
        [
            Panel(
                "x, mm",
                "y, mm",
                [PlotLine(path.tip_m[:, 0] * 1e3, path.tip_m[:, 1] * 1e3, name) for name, path in paths.items()],
            ),
            Panel("iteration", "curvature, 1/m", [PlotLine(t, path.joint[:, 0], name) for name, path in paths.items()]),
        ],
        3.3,
    )
    jacobian, damped, ours = (paths[name] for name in steps)
    ratio = jacobian.jitter_m / ours.jitter_m
    names = list(steps)
    says = (
        f"Jitter of the tip {jacobian.jitter_m * 1e3:.3f} mm (Jacobian), {damped.jitter_m * 1e3:.3f} (damped), "
        f"{ours.jitter_m * 1e3:.3f} (ours): {ratio:.1f} times; tracking error {errors[names[0]] * 1e3:.2f}, "
        f"{errors[names[1]] * 1e3:.2f}, {errors[names[2]] * 1e3:.2f} mm."
    )
    return Section(
        "fig_7.8",
        "Fig. 7.8: control near a singular posture",
        "The fitted curves guide the tip smoothly; the Jacobian's inverse jitters.",
        "Both, and damped least squares, on the same noisy path past the fold.",
        verdict(ratio > 1.5 and errors[names[2]] <= errors[names[0]] * 1.05),
        says,
        (figure,),
    )
