"""Pictures of a diagnosis: the chain with its faulty link, recording against both models, the loop, the fit."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from host.diagnosis.model.effect import Port
from host.diagnosis.model.model import Segment
from host.diagnosis.pipeline import Diagnosis
from host.diagnosis.report.quantities import scaled
from host.diagnosis.selection.locate import joined
from host.report.style import (
    ESTIMATED,
    FAINT,
    INK,
    MEASURED,
    MUTED,
    TRUTH,
    ReportFigure,
    legend_above,
    report_figure,
    thinned,
)

Array = npt.NDArray[np.float64]
FAULT, SHADE = "#b03a32", "#f6e3da"
ORDER = ("base", "insertion", "roll", "knob", "shape", "contact", "pose_sensor", "force_sensor")  # along the rig
# Arrows go from box to box; the gap at both ends is in points.
ARROW = {"arrowstyle": "->", "color": MUTED, "lw": 0.9, "shrinkA": 4.0, "shrinkB": 4.0}
LINEAR_UP_TO = 5.0  # ratio of the largest and the smallest error: up to it a logarithmic axis would have one or two ticks
SIDE_BY_SIDE = ("pose_sensor", "force_sensor")


def shown(result: Diagnosis) -> tuple[Segment, int, int]:
    """The held-out recording (segment, its index) and output that show the mismatch best."""
    row = result.figures.primary

    def gain(index: int) -> float:
        segment = result.full.segments[index]
        mask = segment.heldout
        if not mask.any():
            return -1.0
        change = result.full_rate.nominal.residuals[index][row][mask] - result.full_rate.best.residuals[index][row][mask]
        return float(np.nanmean(change**2)) if np.isfinite(change).any() else 0.0

    index = max(range(len(result.full.segments)), key=gain)
    return result.full.segments[index], index, row


def chain(result: Diagnosis) -> ReportFigure:
    """The links from input to output; those at fault in red."""
    names = list(dict.fromkeys(port.subsystem for port in result.model.ports))
    names.sort(key=lambda name: ORDER.index(name) if name in ORDER else len(ORDER))
    if len(names) == 1:
        names = [result.model.quiet_inputs[0], *names, result.model.outputs[0].channel]
    bad = {location.subsystem for location in result.located}

    def draw(figure: Figure, narrow: bool) -> None:
        axes = figure.add_subplot()
        axes.set_axis_off()
        per_row = 3 if narrow else 4
        rows = int(np.ceil(len(names) / per_row))
        axes.set(xlim=(-0.5, per_row - 0.5), ylim=(-rows + 0.45, 0.55))
        boxes = []
        for k, name in enumerate(names):
            x, y = k % per_row, -(k // per_row)
            colour = FAULT if name in bad else INK
            box = axes.text(
                x,
                y,
                name.replace("_", " "),
                ha="center",
                va="center",
                color=colour,
                fontsize=9.5,
                fontweight="bold" if name in bad else "normal",
                bbox={
                    "boxstyle": "round,pad=0.45",
                    "fc": SHADE if name in bad else "#ffffff",
                    "ec": colour if name in bad else FAINT,
                },
            )
            boxes.append(box)
        for k, box in enumerate(boxes):
            x, y = k % per_row, -(k // per_row)
            if x == 0 and k > 0:  # the arrow from the row above goes on here
                axes.annotate("", (x, y), (x - 0.5, y), arrowprops=ARROW | {"patchB": box.get_bbox_patch()})
            if k + 1 < len(names) and (names[k], names[k + 1]) != SIDE_BY_SIDE:
                last = x == per_row - 1
                to = {} if last else {"patchB": boxes[k + 1].get_bbox_patch()}
                axes.annotate(
                    "", (x + (0.5 if last else 1.0), y), (x, y), arrowprops=ARROW | {"patchA": box.get_bbox_patch()} | to
                )

    words = f"Links: {', '.join(names)}. At fault: {', '.join(sorted(bad)) or 'none'}."
    height = 0.55 * np.ceil(len(names) / 4) + 0.1
    return report_figure(draw, float(height), float(0.55 * np.ceil(len(names) / 3) + 0.1), "The links", words, "")


def over_time(result: Diagnosis) -> ReportFigure:
    """Recording and both models, and below what each leaves; windows of the mismatch shaded."""
    segment, index, row = shown(result)
    output = result.model.outputs[row]
    t = segment.recording.time_s + segment.recording.begin_s
    size, unit = scaled(output.unit, float(np.nanmax(np.abs(segment.y[row]), initial=0.0)))
    y = segment.y[row] / size
    nominal = y - result.full_rate.nominal.residuals[index][row] / size
    best = y - result.full_rate.best.residuals[index][row] / size
    spans = joined(
        [span for place in result.located for span in place.windows_s[segment.recording.name]], result.problem.rules
    )
    noise_sd = result.figures.noise_sd[row] / size

    def draw(figure: Figure, narrow: bool) -> None:
        top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(1.0, 1.0))
        for axes in (top, bottom):
            for a, b in spans:
                axes.axvspan(a, b, color=SHADE, lw=0)
        bins = 300 if narrow else 700
        for values, colour, label, width in (
            (y, MEASURED, "recorded", 1.6),
            (nominal, FAULT, "nominal, refitted", 1.0),
            (best, INK, "extended", 1.0),
        ):
            if label != "extended" or result.found.best.terms:
                top.plot(*thinned(t, values, bins), color=colour, lw=width, label=label)
        bottom.axhspan(-noise_sd, noise_sd, color="#e6edf3", lw=0)
        bottom.plot(*thinned(t, y - nominal, bins), color=FAULT, lw=0.9)
        if result.found.best.terms:
            bottom.plot(*thinned(t, y - best, bins), color=INK, lw=0.9)
        top.set_ylabel(f"{output.channel.replace('_', ' ')} ({unit})")
        bottom.set_ylabel(f"residual ({unit})")
        bottom.set_xlabel("time (s)" if segment.recording.timed else "sample")
        legend_above(top, 2 if narrow else 3)

    unused = "" if segment.fit.any() else ", not used to fit"
    name = segment.recording.name
    named = name.capitalize() if name.startswith("recording ") else f"Recording {name}"
    caption = f"{named}{unused}. Below: recording minus model; the grey band is the noise."
    return report_figure(
        draw,
        4.3,
        4.6,
        "Recording and models over time",
        f"{output.channel} over time: recorded, nominal and extended model.",
        caption,
    )


def loop(result: Diagnosis) -> ReportFigure | None:
    """Input against what the nominal model leaves: memory shows as a loop."""
    ports = {port.name: port for port in result.model.ports}
    name = next(
        (
            term.candidate.port.name
            for term in result.found.best.terms
            if term.candidate.port.kind.split("+")[0] in ("motion", "force")
        ),
        None,
    )
    if name is None:
        return None
    port: Port = ports[name]
    segment, index, _ = shown(result)
    row = most_moved(result, index, port.subsystem)
    size, unit = scaled(result.model.outputs[row].unit, float(np.nanmax(np.abs(segment.y[row]), initial=0.0)))
    x = result.model.motion(segment, port)
    left = result.full_rate.nominal.residuals[index][row] / size
    extra = left - result.full_rate.best.residuals[index][row] / size
    seen = [travel for travel in result.model.travel if np.array_equal(segment.inputs.get(travel[1], ()), x)]
    words, _, moved_unit = seen[0] if seen else (f"signal at {port.name.replace('_', ' ')}", "", "")
    moved_size, moved_unit = scaled(moved_unit, float(np.nanmax(np.abs(x), initial=0.0)))
    x = x / moved_size

    def draw(figure: Figure, narrow: bool) -> None:
        axes: Axes = figure.add_subplot()
        step = max(1, x.size // 6000)
        axes.plot(x[::step], left[::step], ".", color=ESTIMATED, ms=2.0, label="recording minus nominal")
        axes.plot(x[::step], extra[::step], color=INK, lw=1.0, label="response of the effects")
        axes.set(
            xlabel=f"{words} ({moved_unit})" if moved_unit else words,
            ylabel=f"{result.model.outputs[row].channel.replace('_', ' ')} ({unit})",
        )
        legend_above(axes, 1 if narrow else 2)

    return report_figure(
        draw,
        3.3,
        3.0,
        "Loop",
        "Residual of the nominal model against the input, and the response of the effects.",
        "A loop indicates memory or rate dependence; a single curve indicates neither.",
    )


def most_moved(result: Diagnosis, index: int, subsystem: str) -> int:
    """The output in which the effects at `subsystem` show most, over the noise."""
    channels = [channel for place in result.located if place.subsystem == subsystem for channel in place.channels]
    rows = [row for row, output in enumerate(result.model.outputs) if output.channel in channels]

    def weight(row: int) -> float:
        fits = result.full_rate
        change = fits.nominal.residuals[index][row] - fits.best.residuals[index][row]
        good = change[np.isfinite(change)]
        return float(np.std(good)) / max(result.figures.noise_sd[row], 1e-300) if good.size else 0.0

    return max(rows, key=weight) if rows else result.figures.primary


def before_after(result: Diagnosis) -> ReportFigure:
    """RMS error on held-out samples of every output, before and after, over the noise."""
    figures = result.figures
    rows = [row for row in range(len(figures.before)) if np.isfinite(figures.before[row])]
    names = [result.model.outputs[row].channel.replace("_", " ") for row in rows]

    def draw(figure: Figure, narrow: bool) -> None:
        axes = figure.add_subplot()
        place = np.arange(len(rows))[::-1]
        before, after = figures.before[rows] / figures.noise_sd[rows], figures.after[rows] / figures.noise_sd[rows]
        axes.hlines(place, after, before, color=FAINT, lw=4)
        axes.plot(before, place, "o", color=FAULT, ms=5, label="nominal, refitted")
        axes.plot(after, place, "o", color=INK, ms=5, label="extended")
        axes.axvline(1.0, color=TRUTH, lw=0.9, ls=":")
        axes.set_yticks(place, names)
        if max(np.max(before), np.max(after)) > LINEAR_UP_TO * min(np.min(before), np.min(after)):
            axes.set_xscale("log")
            axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.xaxis.set_minor_formatter(NullFormatter())
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.set(
            xlabel="RMS error on held-out samples, in units of the noise (dotted: the noise itself)",
            ylim=(-0.6, len(rows) - 0.4),
        )
        if narrow:
            axes.set_xlabel("held-out error / noise")
        axes.margins(x=0.08)
        legend_above(axes, 2)

    height = 0.24 * len(rows) + 0.95
    return report_figure(
        draw, height, height + 0.1, "Fit before and after", "Held-out error of each output before and after.", ""
    )


def pictures(result: Diagnosis) -> dict[str, Any]:
    """All pictures of the report by name."""
    return {"chain": chain(result), "time": over_time(result), "loop": loop(result), "fit": before_after(result)}
