"""The report of a protocol: one page with a row and a trace of the force for each touch."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from host.recordings.header import software_version
from host.report.figure_page import page_environment
from host.report.style import INK, MEASURED, MUTED, WANTED, ReportFigure, report_figure

VERDICTS = {"ok": "ok", "out_of_tolerance": "out of tolerance", "failed": "failed"}
_COLOURS = {"ok": "#2f7d4f", "out_of_tolerance": "#b7791f", "failed": "#b03a32"}


def write_protocol_report(result: dict[str, Any], target: Path) -> Path:
    """Write the page of `result` (the JSON of a protocol's run) to `target` and return it. Raises OSError."""
    touches = [item for item in result["results"] if item["touch"]]
    text = (
        page_environment()
        .get_template("protocol.html.j2")
        .render(
            title=result["protocol"],
            lead=_lead(result),
            eyebrow=f"seldinger run · rig {result['rig']}{', in the simulator' if result['simulated'] else ''}",
            lines=_lines(result),
            pictures=[_places(touches), _traces(touches)] if touches else [],
            touches=[_row(item) for item in touches],
            others=[_other(item) for item in result["results"] if not item["touch"]],
            ended=result["ended"],
            footer=f"Made by seldinger {software_version()}. {_recordings(result)}",
        )
    )
    target.write_text(text, encoding="utf-8")
    return target


def _recordings(result: dict[str, Any]) -> str:
    names = result["recordings"]
    if not names:
        return "Recording: of the rig itself."
    return f"Recording: {names[0]}." if len(names) == 1 else f"Recordings, one of each run: {', '.join(names)}."


def _lead(result: dict[str, Any]) -> str:
    summary = result["summary"]
    count = f"{len(result['results'])} of {result['actions_planned']} actions"
    words = ", ".join(f"{summary[key]} {said}" for key, said in VERDICTS.items() if summary[key])
    return f"{count}: {words}."


def _lines(result: dict[str, Any]) -> list[dict[str, str]]:
    summary = result["summary"]
    if not summary["touches"]:
        return []
    rows = (
        ("touches", str(summary["touches"]), ""),
        ("mean force", f"{summary['mean_force_N']:.3f} N", "mean over the touches, settled"),
        ("force-time integral", f"{summary['force_time_integral_Ns']:.2f} N s", "sum of all touches"),
        ("contact loss", f"{100 * summary['contact_loss_share']:.1f} %", "of the time in touches"),
        ("tip error", _mm(summary["tip_error_m"], " mm"), "across the wall, by the tracker"),
    )
    return [{"name": name, "value": value, "note": note} for name, value, note in rows]


def _row(item: dict[str, Any]) -> dict[str, str]:
    touch = item["touch"]
    return {
        "id": item["id"],
        "verdict": item["verdict"],
        "words": VERDICTS[item["verdict"]],
        "place": ", ".join(f"{1e3 * value:.1f}" for value in item["point_m"]),
        "force": f"{touch['mean_force_N']:.3f} of {touch['force_N']:.3g}",
        "rms": f"{touch['rms_error_N']:.3f}",
        "peak": f"{touch['peak_force_N']:.3f}",
        "integral": f"{touch['force_time_integral_Ns']:.2f} ({touch['force_time_integral_gs']:.0f})",
        "loss": f"{100 * touch['contact_loss_share']:.1f} ({touch['longest_loss_s']:.2f})",
        "tip": _mm(touch["tip_error_m"]),
        "says": item["says"],
    }


def _mm(length_m: float | None, unit: str = "") -> str:
    return "unknown" if length_m is None else f"{1e3 * length_m:.2f}{unit}"


def _other(item: dict[str, Any]) -> dict[str, str]:
    return {"id": item["id"], "kind": item["kind"], "words": VERDICTS[item["verdict"]], "says": item["says"]}


def _traces(touches: list[dict[str, Any]]) -> ReportFigure:
    """Force over time of each touch, small multiples with one scale."""
    top = max(max(item["touch"]["trace_force_N"], default=0.1) for item in touches) * 1.1

    def draw(figure: Figure, narrow: bool) -> None:
        columns = 2 if narrow else 3
        axes = figure.subplots(math.ceil(len(touches) / columns), columns, sharex=True, sharey=True, squeeze=False)
        for place, item in zip(axes.flat, touches, strict=False):
            touch = item["touch"]
            place.axhline(touch["force_N"], color=WANTED, linewidth=0.8, linestyle=(0, (4, 3)))
            place.plot(touch["trace_time_s"], touch["trace_force_N"], color=MEASURED)
            place.set_title(item["id"], color=_COLOURS[item["verdict"]])
            place.set_ylim(min(0.0, *touch["trace_force_N"]), top)
        for place in axes.flat[len(touches) :]:
            place.set_visible(False)
        figure.supxlabel("time after contact, s", color=MUTED, fontsize=9)
        figure.supylabel("force, N", color=MUTED, fontsize=9)

    rows = math.ceil(len(touches) / 3)
    alt = f"Force over time of {len(touches)} touches; the dashed line is the requested force."
    caption = "Measured force along the normal, 20 samples a second. Dashed: requested force."
    return report_figure(draw, 0.6 + 1.5 * rows, 0.6 + 1.4 * math.ceil(len(touches) / 2), "Force", alt, caption)


def _places(touches: list[dict[str, Any]]) -> ReportFigure:
    """Mean force at each point, in the order of the touches."""

    def draw(figure: Figure, narrow: bool) -> None:
        axes = figure.subplots()
        numbers = np.arange(len(touches))
        for number, item in zip(numbers, touches, strict=True):
            touch = item["touch"]
            axes.errorbar(
                number, touch["mean_force_N"], yerr=touch["rms_error_N"], fmt="o", color=_COLOURS[item["verdict"]], capsize=3
            )
            axes.plot([number - 0.3, number + 0.3], [touch["force_N"]] * 2, color=INK, linewidth=0.9)
        axes.set_xticks(numbers, [item["id"] for item in touches])
        axes.set_xlim(-0.6, len(touches) - 0.4)
        axes.set_ylim(0.0, None)
        axes.set_xlabel("touch")
        axes.set_ylabel("mean force, N")

    alt = "Mean force of each touch with its RMS error."
    caption = "Mean force of each touch, settled; bars: RMS error; black: requested force."
    return report_figure(draw, 2.4, 2.4, "Touches", alt, caption)
