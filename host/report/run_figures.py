"""The figures of a run's report: force, tip and wall, path, stages, timeline, tick times."""

from __future__ import annotations

import math
from functools import cached_property
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from host.recordings.recording import RecordingFile
from host.report.run_summary import RunSummary, estimate_along, stack, table_or_none
from host.report.style import (
    ACTION_COLOURS,
    ENCODER,
    ESTIMATED,
    FAINT,
    INK,
    MEASURED,
    MODE_COLOURS,
    MUTED,
    NARROW_IN,
    TRUTH,
    WANTED,
    WIDE_IN,
    ReportFigure,
    legend_above,
    report_figure,
    thinned,
)
from protocol.topics import HISTOGRAM_EDGES_US

Array = np.ndarray
DETAIL_S = 6.0


class _Forces(NamedTuple):
    """Measured and estimated force along the wall's normal: times (n,) in s, forces and standard deviation (n,) in N.

    Empty arrays where the recording has none; has_force, has_estimate: whether it has the topic.
    """

    has_force: bool
    time_s: Array
    pressing_N: Array
    has_estimate: bool
    estimate_s: Array
    along_N: Array
    sd_N: Array


class RunFigures:
    """Draws the figures of one recording. Times are in seconds from its start."""

    def __init__(self, recording: RecordingFile, summary: RunSummary) -> None:
        self.recording, self.summary = recording, summary
        self.start_ns = recording.span_ns[0]
        self.end_s = max(summary.duration_s, 1e-3)

    def all(self) -> list[ReportFigure]:
        """Return the figures for which the recording has data, in the order of the report."""
        made = [self.force(), self.force_detail(), self.tip(), self.path(), self.stages(), self.timeline(), self.ticks()]
        return [figure for figure in made if figure is not None]

    def _seconds(self, stamp_ns: Array) -> Array:
        return (stamp_ns - self.start_ns) * 1e-9

    def _bands(self, axes: Axes) -> None:
        for span in self.summary.modes:
            axes.axvspan(
                *self._seconds(np.array([span.start_ns, span.end_ns])),
                color=MODE_COLOURS.get(span.name, FAINT),
                alpha=0.55,
                linewidth=0,
                zorder=0,
            )

    @cached_property
    def _forces(self) -> _Forces:
        """The forces along the wall's normal, computed once for both force figures and their axis."""
        force, estimate = table_or_none(self.recording, "force/sensor"), table_or_none(self.recording, "force/estimate")
        none, direction = np.empty(0), self.summary.direction
        pressing_N = none if force is None else stack(force, "fx_N", "fy_N", "fz_N") @ direction
        along_N, sd_N = (none, none) if estimate is None else estimate_along(estimate, direction)
        return _Forces(
            force is not None,
            none if force is None else self._seconds(force["stamp_ns"]),
            pressing_N,
            estimate is not None,
            none if estimate is None else self._seconds(estimate["stamp_ns"]),
            along_N,
            sd_N,
        )

    def _force_lines(self, axes: Axes, from_s: float, to_s: float) -> None:
        forces = self._forces
        state = table_or_none(self.recording, "state")
        if forces.has_estimate:
            time_s, along_N, sd_N = forces.estimate_s, forces.along_N, forces.sd_N
            show = (time_s >= from_s) & (time_s <= to_s) & np.isfinite(along_N)
            time_s, along_N, sd_N = time_s[show], along_N[show], sd_N[show]
            step = 1 + len(time_s) // 700
            axes.fill_between(
                time_s[::step],
                (along_N - 2 * sd_N)[::step],
                (along_N + 2 * sd_N)[::step],
                color=ESTIMATED,
                alpha=0.20,
                linewidth=0,
                label="estimate ± 2 sd",
            )
            axes.plot(*thinned(time_s, along_N), color=ESTIMATED, linewidth=1.0, label="estimated")
        if forces.has_force:
            show = (forces.time_s >= from_s) & (forces.time_s <= to_s)
            axes.plot(
                *thinned(forces.time_s[show], forces.pressing_N[show]), color=MEASURED, linewidth=1.0, label="measured"
            )
        if state is not None:
            time_s, wanted_N = self._seconds(state["stamp_ns"]), state["target_force_N"]
            show = (time_s >= from_s) & (time_s <= to_s)
            axes.plot(time_s[show], wanted_N[show], color=WANTED, linewidth=1.3, linestyle=(0, (4, 2)), label="set-point")
        axes.set_xlim(from_s, max(to_s, from_s + 1e-3))  # a contact of a single message has no length
        axes.set_xlabel("time, s")
        axes.set_ylabel("force into the wall, N")

    def force(self) -> ReportFigure | None:
        """Draw the force of the whole run; None without force data."""
        if not self.recording.topics.get("force/sensor") and not self.recording.topics.get("force/estimate"):
            return None

        def draw(figure: Figure, narrow: bool) -> None:
            axes = figure.add_subplot()
            self._bands(axes)
            self._force_lines(axes, 0.0, self.end_s)
            if np.isfinite(self.summary.force_limit_N):
                axes.axhline(self.summary.force_limit_N, color=TRUTH, linewidth=0.9, linestyle=(0, (1, 2)))
                axes.annotate(
                    "limit", (0, self.summary.force_limit_N), (4, 3), textcoords="offset points", color=TRUTH, fontsize=8
                )
            axes.set_ylim(low_N, high_N)
            legend_above(axes, 2 if narrow else 4)

        low_N, high_N, outside = self._force_span()
        return report_figure(
            draw,
            3.0,
            3.1,
            "Force on the wall",
            "Set-point, measured and estimated force over the run.",
            "Force along the wall's normal. Coloured bands are the phases of the timeline. The estimate comes from "
            "the tracked poses alone; its band is two standard deviations."
            + (f" The axis does not show {outside}." if outside else ""),
        )

    def _force_span(self) -> tuple[float, float, str]:
        """Return the ends of the force axis (N), and which estimates lie outside; empty if none does.

        The axis shows all of the measured force, the set-point and the limit. Of the estimate it shows what lies between
        the 1st and the 99th percentile: the first estimates after the start may be far off.
        """
        shown = [0.0, self.summary.force_limit_N, self.summary.target_force_N]
        forces = self._forces
        if forces.has_force:
            shown += [np.nanmin(forces.pressing_N, initial=0.0), np.nanmax(forces.pressing_N, initial=0.0)]
        along_N = forces.along_N[np.isfinite(forces.along_N)]
        if len(along_N):
            shown += list(np.percentile(along_N, (1.0, 99.0)))
        finite = [value for value in shown if math.isfinite(value)]
        margin_N = 0.05 * max(max(finite) - min(finite), 0.1)
        low_N, high_N = min(finite) - margin_N, max(finite) + 2.0 * margin_N  # above: the word "limit"
        beyond_N = along_N[(along_N < low_N) | (along_N > high_N)]
        if not len(beyond_N):
            return low_N, high_N, ""
        return (
            low_N,
            high_N,
            (f"{len(beyond_N)} of {len(along_N)} estimates, {beyond_N.min():.2f} to {beyond_N.max():.2f} N"),
        )

    def force_detail(self) -> ReportFigure | None:
        """Draw the force of the last seconds of contact, large enough to show the heart beat."""
        contact = self.summary.contact
        if contact is None or not self.recording.topics.get("force/sensor"):
            return None
        to_s = float(self._seconds(np.array([contact.end_ns]))[0])
        from_s = max(to_s - DETAIL_S, float(self._seconds(np.array([contact.start_ns]))[0]))

        def draw(figure: Figure, narrow: bool) -> None:
            axes = figure.add_subplot()
            self._force_lines(axes, from_s, to_s)
            legend_above(axes, 2 if narrow else 4)

        return report_figure(
            draw,
            2.7,
            3.0,
            "Force in the last seconds of contact",
            f"Force over the last {to_s - from_s:.0f} seconds of contact.",
            f"The last {to_s - from_s:.0f} s of contact. Variation with the heart beat is control error.",
        )

    def tip(self) -> ReportFigure | None:
        """Draw tip and target (and the wall, in a simulation), along and across the force direction."""
        pose, state = table_or_none(self.recording, "pose/tip"), table_or_none(self.recording, "state")
        if pose is None or state is None:
            return None
        truth, normal = table_or_none(self.recording, "sim/truth"), self.summary.direction
        tip_m = stack(pose, "x_m", "y_m", "z_m")
        target_m = stack(state, "target_x_m", "target_y_m", "target_z_m")
        aimed = np.isfinite(target_m).all(axis=1) & ~np.isin(state["mode"], ("disarmed", "homing"))
        target_m = np.where(aimed[:, None], target_m, np.nan)
        at = np.maximum(np.searchsorted(state["stamp_ns"], pose["stamp_ns"], side="right") - 1, 0)
        off_m = tip_m - target_m[at]
        across_m = np.linalg.norm(off_m - np.outer(off_m @ normal, normal), axis=1)

        def draw(figure: Figure, narrow: bool) -> None:
            along, across = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
            for axes in (along, across):
                self._bands(axes)
            time_s = self._seconds(pose["stamp_ns"])
            if truth is not None:
                wall_mm = stack(truth, "wall_x_m", "wall_y_m", "wall_z_m") @ normal * 1e3
                along.plot(
                    *thinned(self._seconds(truth["stamp_ns"]), wall_mm),
                    color=TRUTH,
                    linewidth=0.9,
                    label="wall without contact (simulator)",
                )
            along.plot(*thinned(time_s, tip_m @ normal * 1e3), color=MEASURED, linewidth=0.9, label="tip, tracked")
            along.plot(
                self._seconds(state["stamp_ns"]),
                target_m @ normal * 1e3,
                color=WANTED,
                linewidth=1.3,
                linestyle=(0, (4, 2)),
                label="target",
            )
            along.set_ylabel("towards the wall, mm")
            legend_above(along, 2 if narrow else 3)
            across.plot(*thinned(time_s, across_m * 1e3), color=MEASURED, linewidth=0.9)
            across.set_ylabel("error across, mm")
            across.set_ylim(bottom=0)
            across.set_xlabel("time, s")
            across.set_xlim(0, self.end_s)

        return report_figure(
            draw,
            3.7,
            4.2,
            "Tip, target and wall",
            "Tip position against target and wall over the run.",
            "Above: along the wall's normal. In contact the force is controlled there, and the target only limits "
            "the search for the wall. Below: distance from the target across the normal, where the position is "
            "controlled. Tracker readings include noise.",
        )

    def path(self) -> ReportFigure | None:
        """Draw the path of the tip from the side and from above, with the catheter's shape at its start and its end."""
        tip, shaft = table_or_none(self.recording, "pose/tip"), table_or_none(self.recording, "pose/shaft")
        if tip is None:
            return None
        target = _last_target_mm(table_or_none(self.recording, "state"))
        moments = _moments(self.summary, tip["stamp_ns"])

        limits = _view_limits(tip, shaft, moments, target)
        rise = [(high - low) / (limits["z_m"][1] - limits["z_m"][0]) for low, high in (limits["y_m"], limits["x_m"])]

        def draw(figure: Figure, narrow: bool) -> None:
            side, above = figure.subplots(2, 1, sharex=True, height_ratios=rise)
            for axes, row, name in ((side, "y_m", "seen from the side"), (above, "x_m", "seen from above")):
                self._one_view(axes, tip, shaft, row, moments, target)
                axes.set_title(name)
                axes.set_ylim(*limits[row])
            side.set_xlim(*limits["z_m"])
            above.set_xlabel("along the sheath's axis, mm")
            side.legend(loc="lower left", bbox_to_anchor=(0.01, 0.02))

        high_in, narrow_high_in = ((width - 0.7) * sum(rise) + 1.15 for width in (WIDE_IN, NARROW_IN))
        return report_figure(
            draw,
            high_in,
            narrow_high_in,
            "Path of the tip",
            "Path of the tip in two projections with the catheter's shape.",
            "The sheath ends at 0, its axis to the right. Lines are the catheter between its two tracked "
            "sensors, a cubic through both poses.",
        )

    def _one_view(
        self,
        axes: Axes,
        tip: dict[str, Array],
        shaft: dict[str, Array] | None,
        row: str,
        moments: list[tuple[str, int, str]],
        target: Array | None,
    ) -> None:
        axes.plot(tip["z_m"] * 1e3, tip[row] * 1e3, color=MEASURED, linewidth=0.6, alpha=0.5, label="tip")
        axes.plot([-8, 0], [0, 0], color=FAINT, linewidth=6, solid_capstyle="butt", zorder=0)
        for label, index, colour in moments:
            if shaft is not None and len(shaft["stamp_ns"]):
                other = int(np.argmin(np.abs(shaft["stamp_ns"] - tip["stamp_ns"][index])))
                curve_mm = _between(shaft, other, tip, index, row)
                axes.plot(curve_mm[:, 0], curve_mm[:, 1], color=colour, linewidth=2.0, label=label)
            axes.plot(tip["z_m"][index] * 1e3, tip[row][index] * 1e3, "o", color=colour, markersize=4)
        if target is not None:
            axes.plot(
                target[2],
                target[0 if row == "x_m" else 1],
                "+",
                color=INK,
                markersize=9,
                markeredgewidth=1.4,
                label="target",
            )
        axes.set_aspect("equal", adjustable="box", anchor="W")
        axes.set_ylabel(f"{row[0]}, mm")

    def stages(self) -> ReportFigure | None:
        """Draw commands and encoders of the three axes."""
        stage = table_or_none(self.recording, "stage")
        if stage is None:
            return None
        rows = (
            ("insertion", "insertion_m", 1e3, "mm"),
            ("roll", "roll_rad", 180 / np.pi, "°"),
            ("knob", "knob_rad", 180 / np.pi, "°"),
        )

        def draw(figure: Figure, narrow: bool) -> None:
            time_s = self._seconds(stage["stamp_ns"])
            for axes, (name, column, scale, unit) in zip(figure.subplots(3, 1, sharex=True), rows, strict=True):
                self._bands(axes)
                axes.plot(
                    *thinned(time_s, stage[f"encoder_{column}"] * scale), color=ENCODER, linewidth=3.0, label="encoder"
                )
                axes.plot(
                    *thinned(time_s, stage[f"command_{column}"] * scale), color=MEASURED, linewidth=0.9, label="command"
                )
                axes.set_ylabel(f"{name}, {unit}")
                axes.yaxis.set_major_locator(MaxNLocator(4))
            figure.axes[0].set_xlim(0, self.end_s)
            figure.axes[-1].set_xlabel("time, s")
            legend_above(figure.axes[0], 2)

        return report_figure(
            draw,
            3.9,
            4.4,
            "Stages",
            "Commands and encoders of insertion, roll and knob over the run.",
            "Axes of the handle: commanded positions and encoder readings.",
        )

    def timeline(self) -> ReportFigure | None:
        """Draw phases and safety actions as bars."""
        if not self.summary.modes:
            return None

        def draw(figure: Figure, narrow: bool) -> None:
            axes = figure.add_subplot()
            seen: set[str] = set()
            for spans, y, colours in ((self.summary.modes, 1.0, MODE_COLOURS), (self.summary.safety, 0.0, ACTION_COLOURS)):
                for span in spans:
                    start_s, end_s = self._seconds(np.array([span.start_ns, span.end_ns]))
                    axes.barh(
                        y,
                        end_s - start_s,
                        left=start_s,
                        height=0.62,
                        color=colours.get(span.name, FAINT),
                        edgecolor="white",
                        linewidth=0.8,
                        label=span.name if span.name not in seen else None,
                    )
                    seen.add(span.name)
                    if (end_s - start_s) / self.end_s > (0.22 if narrow else 0.1):
                        axes.text((start_s + end_s) / 2, y, span.name, ha="center", va="center", fontsize=8)
            axes.set_yticks([1, 0], ["phase", "safety"])
            axes.tick_params(length=0)
            axes.grid(False)
            if not self.summary.safety:
                axes.text(self.end_s / 2, 0, "no safety action", ha="center", va="center", color=MUTED, fontsize=8)
            axes.set_ylim(-0.6, 1.6)
            axes.set_xlim(0, self.end_s)
            axes.set_xlabel("time, s")
            legend_above(axes, 3 if narrow else 7)

        return report_figure(
            draw,
            1.6,
            2.1,
            "Timeline",
            "Phases of the loop and safety actions over the run.",
            "Phases of the control loop, and safety actions.",
        )

    def ticks(self) -> ReportFigure | None:
        """Draw the time of the loop's work, on a logarithmic scale."""
        times = self.summary.ticks
        if not times.histogram.any():
            return None
        edges_us = np.array(HISTOGRAM_EDGES_US)
        filled = np.flatnonzero(times.histogram)
        period_us = 1e6 / times.loop_hz
        beyond = (
            "In virtual time the simulation waits for a tick that takes longer than its period. On a rig it would be late."
            if self.summary.virtual
            else "Ticks to the right of “period” were late."
        )

        def draw(figure: Figure, narrow: bool) -> None:
            axes = figure.add_subplot()
            axes.bar(
                edges_us[:-1],
                times.histogram,
                width=np.diff(edges_us),
                align="edge",
                color=MEASURED,
                alpha=0.85,
                linewidth=0,
            )
            axes.set_xscale("log")
            axes.set_yscale("log")
            axes.set_xlim(edges_us[max(filled[0] - 2, 0)], max(edges_us[filled[-1] + 1] * 1.3, period_us * 1.6))
            top = float(times.histogram.max())
            axes.set_ylim(0.7, top * 8)
            marks = ((times.p50_us, "p50", 5), (times.p999_us, "p99.9", 1.6), (period_us, "period", 5))
            for value_us, label, height in marks:
                axes.axvline(value_us, color=TRUTH if label == "period" else INK, linewidth=0.9, linestyle=(0, (4, 2)))
                axes.annotate(
                    label,
                    (value_us, top * height),
                    (3, 0),
                    textcoords="offset points",
                    fontsize=8,
                    va="top",
                    color=TRUTH if label == "period" else INK,
                )
            axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axes.set_xlabel("time of one tick's work, µs")
            axes.set_ylabel("ticks")

        return report_figure(
            draw,
            2.5,
            2.8,
            "Tick times",
            "Histogram of the control loop's tick times.",
            f"{times.ticks} ticks at {times.loop_hz:g} Hz, both scales logarithmic. {beyond}",
        )


def _last_target_mm(state: dict[str, Array] | None) -> Array | None:
    if state is None:
        return None
    targets = stack(state, "target_x_m", "target_y_m", "target_z_m")[state["mode"] == "contact"]
    targets = targets[np.isfinite(targets).all(axis=1)]
    return targets[-1] * 1e3 if len(targets) else None


def _moments(summary: RunSummary, stamp_ns: Array) -> list[tuple[str, int, str]]:
    """(name, index of the pose, colour) of the shapes to draw."""
    wanted = [("start", int(stamp_ns[0]), MUTED)]
    if summary.contact is not None:
        wanted.append(("at contact", summary.contact.start_ns, MEASURED))
        wanted.append(("end of contact", summary.contact.end_ns, ESTIMATED))
    else:
        wanted.append(("end", int(stamp_ns[-1]), MEASURED))
    return [(name, int(np.argmin(np.abs(stamp_ns - at_ns))), colour) for name, at_ns, colour in wanted]


def _view_limits(
    tip: dict[str, Array], shaft: dict[str, Array] | None, moments: list[tuple[str, int, str]], target: Array | None
) -> dict[str, tuple[float, float]]:
    """(low, high) in mm of what has to be seen along each axis, none much narrower than the view is long."""
    limits = {}
    for column, name in enumerate(("x_m", "y_m", "z_m")):
        values = [0.0, *(tip[name][np.isfinite(tip[name])] * 1e3)] + ([-8.0] if name == "z_m" else [])
        values += [] if target is None else [float(target[column])]
        if shaft is not None and name != "z_m":
            for _, index, _ in moments:
                other = int(np.argmin(np.abs(shaft["stamp_ns"] - tip["stamp_ns"][index])))
                values += list(_between(shaft, other, tip, index, name)[:, 1])
        values = [value for value in values if np.isfinite(value)]
        limits[name] = (min(values) - 1.0, max(values) + 1.0)
    shortest = 0.16 * (limits["z_m"][1] - limits["z_m"][0])
    for name in ("x_m", "y_m"):
        middle, half = sum(limits[name]) / 2, max((limits[name][1] - limits[name][0]), shortest) / 2
        limits[name] = (middle - half, middle + half)
    return limits


def _between(shaft: dict[str, Array], i: int, tip: dict[str, Array], j: int, row: str) -> Array:
    """Points (n, 2) mm of the cubic from one pose to the other, tangent to both: along the sheath's axis, and `row`."""
    ends, tangents = [], []
    for table, index in ((shaft, i), (tip, j)):
        w, x, y, z = (table[name][index] for name in ("qw", "qx", "qy", "qz"))
        axis = {"x_m": 2 * (x * z + w * y), "y_m": 2 * (y * z - w * x), "z_m": 1 - 2 * (x * x + y * y)}
        ends.append(np.array([table["z_m"][index], table[row][index]]))
        tangents.append(np.array([axis["z_m"], axis[row]]))
    length = float(np.linalg.norm([tip[n][j] - shaft[n][i] for n in ("x_m", "y_m", "z_m")]))
    s = np.linspace(0, 1, 40)[:, None]
    curve = (
        (2 * s**3 - 3 * s**2 + 1) * ends[0]
        + (s**3 - 2 * s**2 + s) * length * tangents[0]
        + (-2 * s**3 + 3 * s**2) * ends[1]
        + (s**3 - s**2) * length * tangents[1]
    )
    return curve * 1e3
