"""Figs. 6.3 to 6.11: loops of insertion and roll, the knob's curvature, and the inverse curves, from one
characterization."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from host.commissioning.characterization import Characterization, KnobSweep, characterize, record_simulated, standard_sweeps
from host.commissioning.characterization_report import knob_picture, pictures_of
from host.commissioning.sine_kinematics import CurveErrors, SineKinematics, compare, fit_sine_kinematics
from host.commissioning.sweep_fits import Run, fit_knob
from host.recordings.recording import RecordingFile
from host.recordings.writer import new_recording_path
from host.report.figure_page import Section, verdict
from host.report.style import ESTIMATED, MEASURED, TRUTH, ReportFigure
from host.studies.reproduction.drawing import Panel, PlotLine, panels
from protocol.rig_file import SIMULATED_RIG, load_rig
from realtime.control.inverse_kinematics import FOLD_BEND

_DEG = math.degrees(1.0)
HELD_OUT = 1  # the knob's sweep at the middle rate is kept for the errors


def sections(directory: Path, quick: bool, board: str = "native") -> tuple[list[Section], Characterization]:
    """Drive the sweeps on the simulated rig, identify, compare with the thesis. The recording stays in `directory`."""
    rig = load_rig(SIMULATED_RIG)
    path = record_simulated(rig, standard_sweeps(rig, 1 if quick else 3), new_recording_path(directory, "sweeps"), 1, board)
    found = characterize(RecordingFile(path), rig)
    loops = pictures_of(found)
    return [_insertion(found, loops[:2]), _roll(found, loops[2:4]), _knob(found), *_curves(found)], found


def _insertion(found: Characterization, loops: list[ReportFigure]) -> Section:
    width, slope = found.insertion.width, found.insertion.slope
    spread = found.insertion.per_run.std(axis=0, ddof=1)
    holds = abs(width.value - 0.0031) < 6e-4 and abs(slope.value - 1.0) < 0.1
    says = (
        f"Width {width.value * 1e3:.3f} ± {spread[0] * 1e3:.3f} mm and slope {slope.value:.4f} ± {spread[1]:.4f} over "
        f"{len(found.insertion.per_run)} sweeps (planted 3.100 mm, 1)."
    )
    return Section(
        "fig_6.3_6.4",
        "Figs. 6.3, 6.4: backlash of insertion",
        "Width 3.1 ± 0.6 mm and slope 1 ± 0.1, nearly the same for all amplitudes and frequencies.",
        "The same sweeps through the board on the simulated vessel, a play operator fitted.",
        verdict(holds and bool(spread[0] < 6e-4)),
        says,
        tuple(loops),
    )


def _roll(found: Characterization, loops: list[ReportFigure]) -> Section:
    slope, gap = found.roll.slope, found.roll_backlash_rad
    spread = float(found.roll.per_run[:, 1].std(ddof=1))
    says = (
        f"Slope {slope.value:.4f} ± {spread:.4f} over {len(found.roll.per_run)} sweeps (planted 0.48); play "
        f"{gap.value * _DEG:.2f} ± {gap.half95 * _DEG:.2f}°."
    )
    return Section(
        "fig_6.5_6.6",
        "Figs. 6.5, 6.6: roll",
        "Slope 0.48 ± 0.05 for all amplitudes and frequencies, no significant backlash width.",
        "The same sweeps with the tip bent, so that roll is seen.",
        verdict(abs(slope.value - 0.48) < 0.05 and gap.value < math.radians(1.0)),
        says,
        tuple(loops),
    )


def _knob(found: Characterization) -> Section:
    edges = [edge.value * _DEG for edge in found.knob.edges_rad]
    planted = (-84.0, -4.0, 4.0, 84.0)
    worst = max(abs(a - b) for a, b in zip(edges, planted, strict=True))
    says = (
        f"Dead from {edges[1]:.2f}° to {edges[2]:.2f}° and beyond {edges[0]:.2f}°, {edges[3]:.2f}°: {worst:.2f}° from "
        "what is "
        "planted, at the worst."
    )
    return Section(
        "fig_6.8",
        "Fig. 6.8: curvature over the knob",
        "Two dead zones: at zero curvature, and at the ends where tension passes to the other wire.",
        "Curvature by (6.1) corrected and by the tip's direction; dead zones fitted.",
        verdict(worst < 1.0),
        says,
        (knob_picture(found),),
    )


def _curves(found: Characterization) -> list[Section]:
    sweep, length = found.knob_sweep, found.distal_length_m
    train = KnobSweep(*(column[sweep.number != HELD_OUT] for column in sweep))
    held = KnobSweep(*(column[sweep.number == HELD_OUT] for column in sweep))
    curve, held_curve = _knob_curve(train), _knob_curve(held)
    fold_rad = float(np.interp(FOLD_BEND / length, curve[1], curve[0]))
    sines = fit_sine_kinematics(train, fold_rad)
    errors = compare(held, held_curve, length, sines, curve)
    across, along = _curve_pictures(train, sines, curve, length, fold_rad)
    squares = f"R² {sines.past_fold.r_square:.3f}, {sines.below_fold.r_square:.3f}, {sines.along.r_square:.3f}"
    thesis = (
        "Sums of two sines fit the tip's place over the knob: R² 0.986, 0.982 across (curves 1, 2), 0.999 along (curve 3)."
    )
    better = errors["monotone"].tip_rms_m < errors["sines"].tip_rms_m
    return [
        Section(
            "fig_6.10",
            "Fig. 6.10: tip across over the knob",
            thesis,
            f"Fitted to our sweep: {squares}. Default: the monotone curve with the arc's geometry, as it keeps the dead "
            "zones and holds while part of the shaft is in the sheath.",
            verdict(min(sines.past_fold.r_square, sines.below_fold.r_square) > 0.97),
            f"On a sweep not used for the fits: {_said(errors)}.",
            (across,),
        ),
        Section(
            "fig_6.11",
            "Fig. 6.11: tip along over the knob",
            thesis,
            f"Curve 3 of our sweep: R² {sines.along.r_square:.4f}. The printed coefficients of curve 3 have lost digits "
            "and are not used.",
            verdict(sines.along.r_square > 0.99 and better),
            f"R² {sines.along.r_square:.4f} (thesis 0.999); monotone curve better on held-out data: "
            f"{'yes' if better else 'no'}.",
            (along,),
        ),
    ]


def _knob_curve(part: KnobSweep) -> tuple[np.ndarray, np.ndarray]:
    """The monotone curve (knob rad, curvature 1/m) of some of the samples."""
    time_s = np.asarray(np.arange(part.knob_rad.size) * 0.025, np.float64)
    fit = fit_knob([Run(time_s, part.knob_rad, time_s, part.curvature_per_m, 1.0, 1.0)], 0.03)
    return fit.knob_rad, fit.curvature_per_m


def _said(errors: dict[str, CurveErrors]) -> str:
    return "; ".join(
        f"{name} {item.knob_rms_rad * _DEG:.2f}° RMS of knob, tip {item.tip_rms_m * 1e3:.2f} mm RMS, "
        f"{item.tip_p99_m * 1e3:.2f} mm at 99 %"
        for name, item in errors.items()
    )


def _curve_pictures(
    train: KnobSweep, sines: SineKinematics, curve: tuple[np.ndarray, np.ndarray], length: float, fold_rad: float
) -> tuple[ReportFigure, ReportFigure]:
    half = train.knob_rad > 0
    step = max(1, int(half.sum()) // 900)
    knob, lateral, axial = (column[half][::step] for column in (train.knob_rad, train.lateral_m, train.axial_m))
    places = np.linspace(0.0, knob.max(), 300)
    bend = np.interp(places, *curve) * length
    reach = np.linspace(0.0, lateral.max(), 200)
    past = np.linspace(float(np.percentile(lateral[knob > fold_rad], 1)), lateral.max(), 200)
    across = panels(
        "Tip across",
        "Tip across over the knob, with both kinds of fit.",
        "One half of the knob's travel.",
        [
            Panel(
                "knob, °",
                "across, mm",
                [
                    PlotLine(knob * _DEG, lateral * 1e3, "measured", MEASURED, "."),
                    PlotLine(sines.below_fold(reach) * _DEG, reach * 1e3, "curve 2", TRUTH),
                    PlotLine(sines.past_fold(past) * _DEG, past * 1e3, "curve 1", "#5b8c5a"),
                    PlotLine(
                        places * _DEG,
                        length * 0.5 * bend * np.sinc(bend / (2 * np.pi)) ** 2 * 1e3,
                        "monotone",
                        ESTIMATED,
                        "--",
                    ),
                ],
            )
        ],
        3.3,
    )
    along = panels(
        "Tip along",
        "Tip along the axis over the knob.",
        "One half of the knob's travel.",
        [
            Panel(
                "knob, °",
                "along, mm",
                [
                    PlotLine(knob * _DEG, axial * 1e3, "measured", MEASURED, "."),
                    PlotLine(places * _DEG, sines.along(places) * 1e3, "curve 3", TRUTH),
                    PlotLine(places * _DEG, length * np.sinc(bend / np.pi) * 1e3, "monotone", ESTIMATED, "--"),
                ],
            )
        ],
        3.3,
    )
    return across, along
