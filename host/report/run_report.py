"""The report of a run: one HTML file with everything in it, written from the recording alone."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from host.recordings.recording import RecordingFile
from host.report.run_figures import RunFigures
from host.report.run_summary import SETTLE_S, BoardHealth, RunSummary, summarize

# Keeps a number and its unit on one line.
NBSP = "\u00a0"
TEMPLATES = Path(__file__).parent / "templates"


class RunVerdict(NamedTuple):
    """Verdict on a run: `level` good, fair or bad; one sentence; remarks, one sentence each.

    Of a failed run the sentence ends in the first cause: `remedy` is what to do about it, `followed` what came after it.
    """

    level: str
    sentence: str
    remarks: tuple[str, ...]
    remedy: str = ""
    followed: tuple[str, ...] = ()


class TableRow(NamedTuple):
    """One line of the table of figures: name, value, and the limit or reference."""

    name: str
    value: str
    note: str = ""


def write_report(recording: RecordingFile, target: str | Path) -> Path:
    """Write the report of `recording` to `target` (HTML) and return its path. Raises OSError where it cannot write."""
    target = Path(target)
    target.write_text(render(recording), encoding="utf-8")
    return target


def render(recording: RecordingFile) -> str:
    """The report of `recording` as one self-contained HTML text."""
    summary = summarize(recording)
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template("run_report.html.j2").render(
        verdict=verdict_of(summary),
        lines=lines_of(summary),
        figures=RunFigures(recording, summary).all(),
        firmware=firmware_of(summary),
        safety=_safety_rows(recording, summary),
        events=_event_rows(recording),
        topics=_topic_rows(recording, summary),
        run=recording.run,
        name=recording.path.name,
        duration=f"{summary.duration_s:.1f} s",
        appendix=_appendix(recording),
    )


def quantity(value: float, unit: str, digits: int) -> str:
    """Return `value` with its unit, rounded; a dash if it is not finite."""
    return f"{value:.{digits}f}{NBSP}{unit}" if math.isfinite(value) else "–"


def duration(time_us: float) -> str:
    """Return `time_us` (µs) with its unit: in µs below 10 ms, in ms above."""
    return quantity(time_us, "µs", 1) if time_us < 1e4 else quantity(time_us * 1e-3, "ms", 0)


def signed(value: float, unit: str, digits: int) -> str:
    """Return `value` with its sign and unit, rounded as by `quantity`."""
    return f"{value:+.{digits}f}{NBSP}{unit}".replace("-", "\u2212") if math.isfinite(value) else "–"


def lateness_of(summary: RunSummary) -> str:
    """Say how many ticks were late. In virtual time none is, because the simulation waits for each tick."""
    return "virtual time: the simulation waits" if summary.virtual else f"{summary.ticks.missed} late"


def verdict_of(summary: RunSummary) -> RunVerdict:
    """Judge a run. Good: force kept, no safety action. Bad: no contact, a stop or a board fault."""
    remarks = _remarks(summary)
    stopped = summary.worst_action in ("retract", "stop") or bool(summary.board.faults)
    if summary.contact is None or summary.contact_seconds == 0:
        sentence = f"No contact in {summary.duration_s:.0f} s."
        level = "bad" if stopped or summary.target_force_N > 0 else "fair"
        return _with_first_cause(RunVerdict(level, sentence, remarks), summary)
    held = f"The wall was touched for {quantity(summary.contact_seconds, 's', 1)}"
    if stopped:
        return _with_first_cause(RunVerdict("bad", f"{held}, then the run was stopped.", remarks), summary)
    if not math.isfinite(summary.target_force_N):
        return RunVerdict("fair", held + "; no force was requested.", remarks)
    settled = summary.contact.seconds > SETTLE_S
    sentence = (
        f"Mean force {quantity(summary.force_mean_N, 'N', 3)} "
        + ("after settling" if settled else "in contact")
        + f" (set\N{NON-BREAKING HYPHEN}point {quantity(summary.target_force_N, 'N', 2)}), "
        f"RMS error {quantity(summary.force_rms_error_N * 1e3, 'mN', 0)}."
    )
    clean = summary.force_kept and not remarks
    return RunVerdict("good" if clean else "fair", sentence, remarks)


def _with_first_cause(verdict: RunVerdict, summary: RunSummary) -> RunVerdict:
    """Return a failed run's verdict with its first cause, remedy and what followed."""
    first = summary.first
    if verdict.level != "bad" or first is None or first.name == "operator_stop":
        return verdict
    followed = tuple(line.replace("-", "\u2212", 1) for line in first.followed.splitlines())
    return verdict._replace(sentence=f"{verdict.sentence} {first.says}", remedy=first.remedy, followed=followed)


# Why the board refuses a set-point (`protocol.serial_frames.Reject`).
_REFUSED_FOR = {
    "state": "it was not armed",
    "order": "their numbers or times were not in order",
    "horizon": "their times were too far ahead",
    "expired": "they came too late",
    "overflow": "its queue was full, because they came faster than it carried them out",
    "speed": "they exceeded the speed limit of an axis",
    "soft_limit": "they lay outside the travel of an axis",
    "limit_switch": "a limit switch was open",
}


def _refused(board: BoardHealth) -> str:
    """Return the sentence on refused set-points, with the reasons from the most frequent one on."""
    ordered = sorted(board.refusals.items(), key=lambda item: -item[1])
    reasons = [f"{_REFUSED_FOR[reason]} ({count})" for reason, count in ordered if reason in _REFUSED_FOR]
    return f"The board refused {board.rejected} set-points" + (f": {'; '.join(reasons)}." if reasons else ".")


def _remarks(summary: RunSummary) -> tuple[str, ...]:
    """Return a sentence for each irregularity of the run."""
    board, ticks = summary.board, summary.ticks
    said = [
        (summary.truncated, "The recording ended early or is damaged; the figures are those of its readable part."),
        (
            not summary.force_kept and math.isfinite(summary.force_mean_N),
            "The mean force differs from the set-point by more than a tenth.",
        ),
        (
            summary.force_peak_N > summary.force_limit_N,
            f"The force reached {summary.force_peak_N:.3f} N, above the limit of {summary.force_limit_N:.2f} N.",
        ),
        (bool(board.faults), "The stepper board latched: " + "; ".join(board.faults) + "."),
        (board.crc_errors > 0, f"{board.crc_errors} damaged frames on the serial line."),
        (board.underruns > 0, f"The board ran out of set-points {board.underruns} times while moving."),
        (board.rejected > 0, _refused(board)),
        (board.resets > 0, f"The board was reset {board.resets} times."),
        (ticks.missed > 0, f"{ticks.missed} ticks of the loop were late."),
        (
            bool(summary.lost),
            "Messages are missing from the recording: "
            + ", ".join(f"{count} of {topic}" for topic, count in sorted(summary.lost.items()))
            + ".",
        ),
    ]
    causes = dict.fromkeys(f"Safety: {span.name}, {span.note or 'no cause given'}." for span in summary.safety)
    return tuple([text for wrong, text in said if wrong] + list(causes))


def lines_of(summary: RunSummary) -> list[TableRow]:
    """Return the short table, in mN, mm and µs."""
    ticks, estimate = summary.ticks, summary.estimate
    limit = quantity(summary.force_limit_N, "N", 2)
    lines = [
        TableRow(
            "Mean force",
            quantity(summary.force_mean_N, "N", 3),
            f"{summary.judged_over}; set-point {quantity(summary.target_force_N, 'N', 2)}",
        ),
        TableRow("RMS force error", quantity(summary.force_rms_error_N * 1e3, "mN", 0), summary.judged_over),
        TableRow("Peak force", quantity(summary.force_peak_N, "N", 3), f"limit {limit}"),
        TableRow(
            "Tip error across the normal", quantity(summary.tip_rms_error_m * 1e3, "mm", 2), "RMS, tracker noise included"
        ),
        TableRow(
            "Time in contact",
            quantity(summary.contact_seconds, "s", 1),
            f"of {quantity(summary.contact.seconds, 's', 1)} in the phase contact" if summary.contact else "",
        ),
        TableRow("Tick, median", duration(ticks.p50_us), f"99.9 %: {duration(ticks.p999_us)}"),
        TableRow("Longest tick", duration(ticks.max_us), lateness_of(summary)),
    ]
    if estimate.count:
        lines.insert(
            3,
            TableRow(
                "Estimated minus measured force",
                quantity(estimate.rms_error_N * 1e3, "mN", 0),
                f"RMS; mean {signed(estimate.mean_error_N * 1e3, 'mN', 0)}, "
                f"stated sd {quantity(estimate.median_sd_N * 1e3, 'mN', 0)}",
            ),
        )
    if math.isfinite(ticks.lateness_p99_us):
        lines.append(
            TableRow(
                "Wake-up delay, 99 %",
                quantity(ticks.lateness_p99_us, "µs", 0),
                f"worst {quantity(ticks.lateness_max_us, 'µs', 0)}",
            )
        )
    return lines


def firmware_of(summary: RunSummary) -> list[TableRow]:
    """Return the board's counters; empty if the recording has no message of the board."""
    board, ticks = summary.board, summary.ticks
    if not board.known:
        return []
    gap = ", ".join(str(steps) for steps in board.encoder_gap_steps)
    where = f" ({ticks.longest_gap_where})" if ticks.longest_gap_where else ""
    lines = [
        TableRow("Faults", ", ".join(board.faults) or "none"),
        TableRow("Damaged frames", str(board.crc_errors)),
        TableRow("Queue underruns", str(board.underruns)),
        TableRow("Set-points refused", str(board.rejected)),
        TableRow("Resets", str(board.resets)),
        TableRow("Encoder minus steps, largest", f"{gap} steps", "insertion, roll, knob"),
    ]
    if ticks.longest_gap_ns:
        lines.append(TableRow("Longest gap between set-points", f"{ticks.longest_gap_ns * 1e-6:.1f} ms{where}"))
    return lines


def _safety_rows(recording: RecordingFile, summary: RunSummary) -> list[TableRow]:
    start_ns = recording.span_ns[0]
    return [TableRow(f"{(span.start_ns - start_ns) * 1e-9:.2f} s", span.name, span.note) for span in summary.safety[:200]]


def _event_rows(recording: RecordingFile, most: int = 200) -> list[TableRow]:
    """Return commands with their replies, and log lines, in order of time."""
    start_ns = recording.span_ns[0]
    replies = {reply["id"]: reply for reply in recording.messages("reply")}
    rows: list[tuple[int, str, str]] = []
    for command in recording.messages("command"):
        reply = replies.get(command["id"])
        words = [command["action"]] + ([command["target"]] if command["target"] != "none" else [])
        words += [f"{command['force_N']:.2f} N"] if command["target"] == "contact" else []
        answer = f"{reply['result']} {reply['text']}".strip() if reply else "no reply recorded"
        rows.append((command["stamp_ns"], "command", f"{' '.join(words)}: {answer}"))
    rows += [(line["stamp_ns"], line["source"], line["text"]) for line in recording.messages("log")]
    rows.sort(key=lambda row: row[0])
    return [TableRow(f"{(stamp_ns - start_ns) * 1e-9:.2f} s", source, text) for stamp_ns, source, text in rows[:most]]


def _topic_rows(recording: RecordingFile, summary: RunSummary) -> list[TableRow]:
    duration_s = max(summary.duration_s, 1e-9)
    rows = []
    for topic, count in sorted(recording.topics.items()):
        lost = f", {summary.lost[topic]} lost" if topic in summary.lost else ""
        rows.append(TableRow(topic, str(count), f"{count / duration_s:.1f} /s{lost}"))
    return rows


def _appendix(recording: RecordingFile) -> list[tuple[str, list[TableRow]]]:
    """Run, catheter and effective configuration as flat tables."""
    run = [TableRow(name, value) for name, value in recording.run.items() if value]
    sections: list[tuple[str, list[TableRow]]] = [("run", run)]
    flat_catheter = _flat(recording.catheter)
    if flat_catheter:
        sections.append(("catheter parameters", flat_catheter))
    general: list[TableRow] = []
    for name, value in recording.configuration.items():
        if isinstance(value, dict):
            sections.append((f"configuration: {name}", _flat(value)))
        else:
            general.append(TableRow(name, _shown(value)))
    return sections[:1] + ([("configuration", general)] if general else []) + sections[1:]


def _flat(values: dict[str, Any], prefix: str = "") -> list[TableRow]:
    lines: list[TableRow] = []
    for name, value in values.items():
        if isinstance(value, dict):
            lines += _flat(value, f"{prefix}{name}.")
        elif value is not None:
            lines.append(TableRow(prefix + name, _shown(value)))
    return lines


def _shown(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(_shown(item) for item in value)
    return f"{value:.10g}" if isinstance(value, float) else str(value)
