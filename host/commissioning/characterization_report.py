"""The page of a characterization: input and output loops as Figs. 6.3 to 6.8, the figures found, the calibration."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from host.commissioning.characterization import Characterization, transmission_toml
from host.commissioning.sweep_fits import Estimate, Run, dead_zone_curvature, play
from host.recordings.header import software_version
from host.report.figure_page import page_environment
from host.report.run_report import TableRow, quantity
from host.report.style import ESTIMATED, MEASURED, MUTED, TRUTH, WANTED, ReportFigure, legend_above, report_figure

_PM = "\u00b1"
_DEG = math.degrees(1.0)


def write_characterization(found: Characterization, target: Path, rig_name: str, source: str) -> Path:
    """Write the page to `target` and return its path. Raises OSError where it cannot write."""
    text = (
        page_environment()
        .get_template("characterization.html.j2")
        .render(
            title=_title(found),
            lead="Sine sweeps of each stage through the board, the catheter in free space, tracked at its tip.",
            eyebrow=f"seldinger characterize · rig {rig_name} · catheter {found.catheter}",
            lines=lines_of(found),
            pictures=pictures_of(found),
            toml=transmission_toml(found),
            footer=f"Made from {source} by seldinger {software_version()}.",
        )
    )
    target.write_text(text, encoding="utf-8")
    return target


def _title(found: Characterization) -> str:
    return (
        f"Insertion has {quantity(found.insertion.width.value * 1e3, 'mm', 2)} of backlash; "
        f"{found.roll.slope.value:.2f} of the roll arrives."
    )


def _bounded(value: Estimate, scale: float, digits: int) -> str:
    return f"{_PM} {value.half95 * scale:.{digits}f} (95 %)"


def lines_of(found: Characterization) -> list[TableRow]:
    """Return the figures in mm and degrees, each with its interval."""
    width, slope, roll, edges = found.insertion.width, found.insertion.slope, found.roll.slope, found.knob.edges_rad
    lines = [
        TableRow("Backlash of insertion", quantity(width.value * 1e3, "mm", 3), _bounded(width, 1e3, 3)),
        TableRow("Slope of insertion", f"{slope.value:.4f}", _bounded(slope, 1.0, 4)),
        TableRow(
            "Body at home",
            quantity(found.insertion_at_home_m.value * 1e3, "mm", 2),
            _bounded(found.insertion_at_home_m, 1e3, 2),
        ),
        TableRow("Slope of roll", f"{roll.value:.4f}", _bounded(roll, 1.0, 4)),
        TableRow(
            "Backlash of roll",
            quantity(found.roll_backlash_rad.value * _DEG, "°", 2),
            _bounded(found.roll_backlash_rad, _DEG, 2),
        ),
    ]
    for name, edge in zip(("Lower stop", "Slack from", "Slack to", "Upper stop"), edges, strict=True):
        lines.append(
            TableRow(f"Knob: {name[0].lower()}{name[1:]}", quantity(edge.value * _DEG, "°", 2), _bounded(edge, _DEG, 2))
        )
    return lines


def pictures_of(found: Characterization) -> list[ReportFigure]:
    """Draw Figs. 6.3 to 6.8 of this rig, and the tip's curves over the knob (6.10, 6.11)."""
    degrees = (_DEG, "°")
    return [
        _in_time(
            found.insertion_runs,
            (1e3, "mm"),
            "Insertion over time",
            "Fig. 6.3",
            found.insertion.offset.value,
            found.insertion.width.value,
            found.insertion.slope.value,
        ),
        _loops(
            found.insertion_runs,
            (1e3, "mm"),
            "Insertion: out against in",
            "Fig. 6.4",
            found.insertion.offset.value,
            found.insertion.width.value,
            found.insertion.slope.value,
        ),
        _in_time(
            found.roll_runs, degrees, "Roll over time", "Fig. 6.5", found.roll.offset.value, 0.0, found.roll.slope.value
        ),
        _loops(
            found.roll_runs,
            degrees,
            "Roll: out against in",
            "Fig. 6.6",
            found.roll.offset.value,
            found.roll.width.value,
            found.roll.slope.value,
        ),
        knob_picture(found),
        tip_picture(found),
    ]


def _model(run: Run, offset: float, width: float, slope: float) -> tuple[np.ndarray, np.ndarray]:
    given = run.encoder
    return given, slope * play(given, width, given[0]) + offset


def _in_time(
    runs: tuple[Run, ...], unit: tuple[float, str], title: str, figure_name: str, offset: float, width: float, slope: float
) -> ReportFigure:
    scale, name = unit
    shown = [runs[0], runs[-1]]

    def draw(figure: Figure, narrow: bool) -> None:
        for place, run in enumerate(shown):
            axes = figure.add_subplot(*((2, 1) if narrow else (1, 2)), place + 1)
            middle = np.mean([run.encoder.max(), run.encoder.min()])
            axes.plot(run.encoder_s, (run.encoder - middle) * scale, color=WANTED, label="stage")
            axes.plot(
                run.time_s,
                (run.output - offset - slope * middle) * scale,
                ".",
                markersize=2.0,
                color=MEASURED,
                label="tip, measured",
            )
            out = _model(run, offset, width, slope)[1]
            axes.plot(run.encoder_s, (out - offset - slope * middle) * scale, color=ESTIMATED, label="fitted")
            axes.set_xlim(0, min(run.time_s[-1], 2 * 2 * math.pi / run.rate_rad_per_s))
            axes.set_title(f"amplitude {run.amplitude * scale:.3g} {name}, {run.rate_rad_per_s} rad/s", pad=22)
            axes.set_xlabel("time, s")
            axes.set_ylabel(name)
            legend_above(axes, 3)

    return report_figure(
        draw,
        2.9,
        5.0,
        title,
        f"{title}: stage and tip.",
        f"As {figure_name} of the thesis: the stage's encoder, the tip's answer, and what the fitted transmission makes of "
        "it.",
    )


def _loops(
    runs: tuple[Run, ...], unit: tuple[float, str], title: str, figure_name: str, offset: float, width: float, slope: float
) -> ReportFigure:
    scale, name = unit
    largest = max(runs, key=lambda run: run.amplitude)
    middle = 0.5 * (largest.encoder.max() + largest.encoder.min())

    def draw(figure: Figure, narrow: bool) -> None:
        axes = figure.add_subplot()
        for run in runs:
            axes.plot(
                (run.input_at() - middle) * scale,
                (run.output - offset - slope * middle) * scale,
                ".",
                markersize=1.2,
                color=MEASURED,
                alpha=0.35,
                label="measured, all sweeps" if run is runs[0] else None,
            )
        given, out = _model(largest, offset, width, slope)
        axes.plot(
            (given - middle) * scale, (out - offset - slope * middle) * scale, color=ESTIMATED, linewidth=1.6, label="fitted"
        )
        reach = largest.amplitude * scale
        axes.plot([-reach, reach], [-reach, reach], color=MUTED, linestyle=(0, (4, 2)), label="ideal")
        axes.set_xlabel(f"stage, {name}")
        axes.set_ylabel(f"distal end, {name}")
        legend_above(axes, 2 if narrow else 3)

    return report_figure(
        draw,
        3.6,
        3.2,
        title,
        f"{title}, loop.",
        f"As {figure_name} of the thesis: all amplitudes and rates over one another, the fitted loop, and an ideal "
        "transmission.",
    )


def knob_picture(found: Characterization) -> ReportFigure:
    """Draw the curvature over the knob: by (6.1), by the tip's direction, fitted, and without dead zones (Fig. 6.8)."""
    sweep, knob = found.knob_sweep, found.knob

    def draw(figure: Figure, narrow: bool) -> None:
        axes = figure.add_subplot()
        step = max(1, len(sweep.knob_rad) // 2500)
        show = slice(None, None, step)
        axes.plot(
            sweep.knob_rad[show] * _DEG,
            sweep.chord_curvature_per_m[show],
            ".",
            markersize=1.6,
            color=MEASURED,
            alpha=0.5,
            label="measured, (6.1)",
        )
        places = np.linspace(sweep.knob_rad.min(), sweep.knob_rad.max(), 400)
        x = np.array(
            [*(e.value for e in knob.edges_rad), *(g.value for g in knob.gains_per_m_rad), knob.rest_curvature_per_m.value]
        )
        axes.plot(places * _DEG, dead_zone_curvature(places, x), color=ESTIMATED, linewidth=1.5, label="fitted")
        gain = np.ptp(knob.curvature_per_m) / np.ptp(knob.knob_rad)
        axes.plot(places * _DEG, gain * places, color=MUTED, linestyle=(0, (4, 2)), label="constant curvature, ideal")
        for edge in knob.edges_rad:
            axes.axvline(edge.value * _DEG, color=TRUTH, linewidth=0.8, linestyle=(0, (1, 2)))
        axes.set_xlabel("knob, °")
        axes.set_ylabel("curvature, 1/m")
        legend_above(axes, 2 if narrow else 3)

    return report_figure(
        draw,
        3.4,
        3.2,
        "Knob to curvature",
        "Curvature over the knob with its dead zones.",
        "As Fig. 6.8 of the thesis: dead where the shaft passes through straight and at both ends of the knob's travel; "
        "the dotted lines are the edges found.",
    )


def tip_picture(found: Characterization) -> ReportFigure:
    """Draw the tip's position over the knob, from the distal shaft's proximal end (Figs. 6.10, 6.11)."""
    sweep, length = found.knob_sweep, found.distal_length_m
    fitted = np.interp(sweep.knob_rad, found.knob.knob_rad, found.knob.curvature_per_m)
    order = np.argsort(sweep.knob_rad)
    bend = fitted[order] * length
    curves = (
        ("across, mm", sweep.lateral_m, length * 0.5 * bend * np.sinc(bend / (2 * np.pi)) ** 2),
        ("along, mm", sweep.axial_m, length * np.sinc(bend / np.pi)),
    )

    def draw(figure: Figure, narrow: bool) -> None:
        for place, (label, measured_m, model_m) in enumerate(curves):
            axes: Axes = figure.add_subplot(*((2, 1) if narrow else (1, 2)), place + 1)
            step = max(1, len(order) // 1500)
            axes.plot(
                sweep.knob_rad[::step] * _DEG,
                measured_m[::step] * 1e3,
                ".",
                markersize=1.6,
                color=MEASURED,
                alpha=0.5,
                label="measured",
            )
            axes.plot(sweep.knob_rad[order] * _DEG, model_m * 1e3, color=ESTIMATED, label="fitted knob curve, arc")
            axes.set_xlabel("knob, °")
            axes.set_ylabel(label)
            legend_above(axes, 2)

    return report_figure(
        draw,
        2.9,
        5.0,
        "Knob to tip",
        "Tip across and along the axis over the knob.",
        "As Figs. 6.10 and 6.11 of the thesis, both halves: past about 41° the tip comes back across, so two knob angles "
        "reach one place.",
    )
