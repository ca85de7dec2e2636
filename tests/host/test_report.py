"""Figures of merit, verdict, contract JSON and report of recordings whose answers are known."""

from __future__ import annotations

import base64
import io
import itertools
import json
import re
from dataclasses import dataclass, field, replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import msgpack
import numpy as np
import pytest
from matplotlib.figure import Figure
from rich.console import Console

from host.recordings.header import RecordingHeader
from host.recordings.recording import RecordingFile
from host.recordings.rig_picture import Picture
from host.recordings.writer import RecordingWriter
from host.report.demo_summary import demo_result, print_summary
from host.report.run_figures import RunFigures
from host.report.run_report import lateness_of, render, verdict_of, write_report
from host.report.run_summary import BoardHealth, _refusals, missing_numbers, spans, summarize
from host.report.style import report_figure, thinned
from protocol.enums import SafetyAction
from protocol.requests import plain
from protocol.topics import (
    HISTOGRAM_BUCKETS,
    BoardCounters,
    Command,
    ForceEstimate,
    ForceSensor,
    Log,
    LoopTiming,
    Pose,
    Reply,
    RigCause,
    RigState,
    Stage,
)
from realtime.control import safety
from realtime.core.cause_watch import CauseWatch

MS = 1_000_000
CONFIGURATION = {
    "safety": {"over_force_N": 0.5},
    "stages": {"insertion": {"encoder_counts_per_step": 2.0}},
    "name": "simulated",
    "control": {"loop_hz": 1000, "odd": [1.0, 2.5]},
}


@dataclass
class Story:
    """A contact run of 20 s: 2 s position, 16 s contact from 2 s on, 2 s retract. Each field is a thing to vary."""

    force_N: float = 0.2
    swing_N: float = 0.03
    sideways_m: float = 0.001
    action: str = "none"
    cause: str = ""
    fault: int = 0
    crc_errors: int = 0
    estimate_off_N: float = 0.02
    wild_until_ms: int = 0
    log: str = "hello"
    first: RigCause | None = None
    fault_from_ms: int = 0
    contact: bool = True
    fields: dict[str, Any] = field(default_factory=dict)

    def mode(self, ms: int) -> str:
        if ms < 2000 or not self.contact:
            return "position"
        return "contact" if ms < 18000 else "retract"

    def write(self, path: Path) -> RecordingFile:
        header = RecordingHeader(
            "simulated", "virtual", CONFIGURATION, {"name": "blazer_prime_xp", "distal_length_m": 0.11}, 5
        )
        with RecordingWriter(path, header) as writer:
            for ms in range(0, 20000, 10):
                self._tick(writer, ms)
        return RecordingFile(path)

    def _tick(self, writer: RecordingWriter, ms: int) -> None:
        time_ns, mode = ms * MS, self.mode(ms)
        pressing = mode == "contact"
        force_N = self.force_N + self.swing_N * (1 if ms % 20 else -1) if pressing else 0.0
        writer.write("force/sensor", ForceSensor(stamp_ns=time_ns, arrival_ns=time_ns, force_N=(0.0, 0.0, force_N)))
        writer.write(
            "stage",
            Stage(
                stamp_ns=time_ns,
                command_insertion_m=0.01,
                command_roll_rad=0.0,
                command_knob_rad=1.0,
                encoder_insertion_m=0.01,
                encoder_roll_rad=0.0,
                encoder_knob_rad=1.0,
            ),
        )
        acting = self.action if 10000 <= ms < 11000 else "none"
        writer.write(
            "state",
            RigState(
                stamp_ns=time_ns,
                mode=mode,
                safety_action=acting,
                cause=self.cause if acting != "none" else "",
                target_m=(0.0, -0.01, 0.025),
                tip_m=(0.0, -0.01, 0.02),
                force_direction=(0.0, 0.0, 1.0),
                target_force_N=0.2 if pressing else None,
                force_N=force_N,
            ),
        )
        if ms % 30 == 0:
            pose = Pose(
                stamp_ns=time_ns,
                arrival_ns=time_ns,
                frame=1,
                missing=False,
                quaternion_wxyz=(1.0, 0.0, 0.0, 0.0),
                position_m=(self.sideways_m, -0.01, 0.02),
            )
            writer.write("pose/tip", pose)
            writer.write("pose/shaft", pose)
            writer.write(
                "force/estimate",
                ForceEstimate(
                    stamp_ns=time_ns,
                    frame="base",
                    converged=True,
                    force_N=(0.0, 0.0, 5.0 if ms < self.wild_until_ms else self.force_N + self.estimate_off_N),
                    covariance_N2=np.diag([1.0, 1.0, 0.03**2]),
                    published_ns=time_ns + 5 * MS,
                    compute_us=50.0,
                ),
            )
        if ms % 1000 == 0:
            self._slow(writer, time_ns)

    def _slow(self, writer: RecordingWriter, time_ns: int) -> None:
        histogram = [0] * HISTOGRAM_BUCKETS
        histogram[17] = 20000
        writer.write(
            "loop",
            LoopTiming(
                stamp_ns=time_ns,
                loop_hz=1000.0,
                ticks=20000,
                missed_ticks=0,
                tick_p50_us=20.0,
                tick_p99_us=30.0,
                tick_p999_us=40.0,
                tick_max_us=50.0,
                tick_histogram=tuple(histogram),
            ),
        )
        writer.write(
            "board",
            BoardCounters(
                stamp_ns=time_ns,
                mcu_time_us=0,
                state=2,
                fault=self.fault if time_ns >= self.fault_from_ms * MS else 0,
                inputs=0,
                queue_depth=2,
                last_setpoint=1,
                fault_name="deadman" if self.fault else "",
                position_steps=(100, 5, -7),
                encoder_counts=(204, 5, -7),
                crc_errors=self.crc_errors,
                underruns=0,
                rejected=0,
                boot_count=3,
                deadman_age_ms=1.0,
            ),
        )
        writer.write("log", Log(stamp_ns=time_ns, level="info", source="test", text=self.log))
        if self.first is not None and time_ns >= self.first.stamp_ns:
            writer.write("cause", self.first)
        if time_ns == 2000 * MS:
            writer.write(
                "command",
                Command(
                    stamp_ns=time_ns,
                    id="c1",
                    commander="console",
                    expires_ns=time_ns + 1,
                    action="target",
                    target="contact",
                    force_N=0.2,
                    target_m=(0.0, -0.01, 0.025),
                    normal=(0.0, 0.0, 1.0),
                ),
            )
            writer.write("reply", Reply(stamp_ns=time_ns, id="c1", result="accepted"))


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> RecordingFile:
    return Story().write(tmp_path_factory.mktemp("report") / "good.mcap")


def test_figures_are_those_that_went_in(good: RecordingFile) -> None:
    summary = summarize(good)
    assert summary.target_force_N == 0.2 and summary.force_limit_N == 0.5
    assert summary.force_mean_N == pytest.approx(0.2, abs=1e-4)
    assert summary.force_rms_error_N == pytest.approx(0.03, abs=1e-4)
    assert summary.force_peak_N == pytest.approx(0.23)
    assert summary.tip_rms_error_m == pytest.approx(0.001)
    assert summary.contact_seconds == pytest.approx(16.0, abs=0.02)
    assert [(span.name, round(span.seconds, 2)) for span in summary.modes] == [
        ("position", 2.0),
        ("contact", 16.0),
        ("retract", 1.99),
    ]
    assert summary.board.known and summary.board.resets == 0 and summary.board.encoder_gap_steps == (2, 0, 0)
    assert summary.lost == {} and summary.worst_action == "none"


def test_estimate_is_judged_along_the_force_direction(good: RecordingFile) -> None:
    quality = summarize(good).estimate
    assert quality.median_sd_N == pytest.approx(0.03) and quality.median_delay_s == pytest.approx(0.005)
    assert quality.converged_share == 1.0
    assert quality.rms_error_N == pytest.approx(np.sqrt((0.05**2 + 0.01**2) / 2), abs=2e-3)
    assert quality.within_2sd_share == 1.0 and quality.mean_error_N == pytest.approx(0.02, abs=2e-3)


@pytest.mark.parametrize(
    ("story", "level", "says"),
    [
        (Story(), "good", "0.200"),
        (Story(force_N=0.25), "fair", "by more than a tenth"),
        (Story(force_N=0.5, swing_N=0.2), "fair", "above the limit"),
        (Story(action="hold", cause="no fresh pose"), "fair", "hold, no fresh pose"),
        (Story(action="stop", cause="pose lost"), "bad", "stop, pose lost"),
        (Story(fault=2), "bad", "deadman"),
        (Story(crc_errors=3), "fair", "3 damaged frames"),
        (Story(contact=False), "fair", "No contact"),
    ],
)
def test_verdict_says_what_is_wrong(story: Story, level: str, says: str, tmp_path: Path) -> None:
    verdict = verdict_of(summarize(story.write(tmp_path / "a.mcap")))
    assert verdict.level == level
    assert says in " ".join([verdict.sentence, *verdict.remarks])


def starved(tmp_path: Path) -> RecordingFile:
    """A run that a busy computer ended: the loop was late, the dead man acted, poses were stale when it was back."""
    bits = safety.BOARD_FAULT | safety.POSE_LOST | safety.POSE_STALE
    watch = CauseWatch()
    watch.take_tick(9_820 * MS, SafetyAction.NONE, 0)
    watch.take_gap(10_000 * MS, 180 * MS, "")
    watch.take_tick(10_000 * MS, SafetyAction.STOP, bits)
    story = Story(action="stop", cause="; ".join(safety.messages(bits)), fault=1, fault_from_ms=10_000)
    return replace(story, first=watch.message(10_000 * MS)).write(tmp_path / "starved.mcap")


@pytest.mark.slow
def test_a_starved_computer_is_the_headline_and_its_symptoms_are_folded(tmp_path: Path) -> None:
    recording = starved(tmp_path)
    verdict = verdict_of(summarize(recording))
    assert "The control loop was late" in verdict.sentence and "no set-point for 180 ms" in verdict.sentence
    assert "real-time priority" in verdict.remedy and "tracker" not in verdict.sentence + verdict.remedy
    assert any("latched a fault" in line for line in verdict.followed) and any("pose" in line for line in verdict.followed)
    page = render(recording)
    assert page.index("real-time priority") < page.index("<details")
    assert page.index('<details class="rest"') < page.index("<figure>")


def test_the_page_tells_the_same_first_cause(tmp_path: Path) -> None:
    recording, picture = starved(tmp_path), Picture(CONFIGURATION, {})
    came = [
        (body["stamp_ns"], topic, body)
        for topic in ("cause", "loop", "board", "state")
        for body in recording.messages(topic)
    ]
    for stamp_ns, topic, body in sorted(came, key=lambda item: item[:2]):
        if stamp_ns < 10_500 * MS:
            picture.take(topic, {name: value for name, value in body.items() if value is not None})
    first = picture.frame()["first"]
    assert first["says"] in verdict_of(summarize(recording)).sentence and first["followed"]


def test_missing_messages_are_counted(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "a.mcap", RecordingHeader("simulated", "wall", {}, {})) as writer:
        for number in (0, 1, 2, 7, 8):
            writer._sequence["log"] = number
            writer.write("log", Log(stamp_ns=number, level="info", source="a", text="b"))
    assert summarize(RecordingFile(tmp_path / "a.mcap")).lost == {"log": 4}


@pytest.mark.parametrize(
    ("numbers", "missing"),
    [
        ([0, 1, 2, 0, 3, 4, 0, 5, 1], 0),  # three publishers of one topic
        ([0, 1, 2, 3, 0, 1, 2, 3, 4], 0),  # one that was started again
        ([0, 1, 0, 5, 1, 6], 3),
        ([7, 8, 10], 1),
        ([3], 0),
        ([], 0),
    ],
)
def test_each_publisher_of_a_topic_has_its_own_numbers(numbers: list[int], missing: int) -> None:
    assert missing_numbers(np.array(numbers)) == missing


def test_refused_set_points_are_named_with_their_reasons(tmp_path: Path) -> None:
    recording = Story().write(tmp_path / "run.mcap")
    rejected, reasons = np.array([0, 2, 2, 5, 6]), np.array(["", "overflow", "overflow", "overflow", "expired"])
    summary = replace(summarize(recording), board=BoardHealth(rejected=6, refusals=_refusals(rejected, reasons)))
    remarks = " ".join(verdict_of(summary).remarks)
    assert "refused 6 set-points: its queue was full, because they came faster than it carried them out (5); " in remarks
    assert "they came too late (1)" in remarks


def test_the_axis_shows_all_of_the_measured_force_and_not_the_first_estimates(tmp_path: Path) -> None:
    recording = Story(swing_N=0.9).write(tmp_path / "run.mcap")
    low_N, high_N, outside = RunFigures(recording, summarize(recording))._force_span()
    assert low_N < -0.7 and high_N > 1.1 and not outside
    calm = Story(swing_N=0.0, wild_until_ms=100).write(tmp_path / "calm.mcap")
    low_N, high_N, outside = RunFigures(calm, summarize(calm))._force_span()
    assert -0.1 < low_N < 0.0 and 0.5 < high_N < 0.6
    assert outside == "4 of 667 estimates, 5.00 to 5.00 N"


def test_the_forces_are_read_once_for_all_figures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recording = Story().write(tmp_path / "run.mcap")
    summary, table, read = summarize(recording), RecordingFile.table, list[str]()

    def counted(self: RecordingFile, topic: str) -> Any:
        read.append(topic)
        return table(self, topic)

    monkeypatch.setattr(RecordingFile, "table", counted)
    titles = [figure.title for figure in RunFigures(recording, summary).all()]
    assert titles[0] == "Force on the wall" and titles[1].startswith("Force in the last seconds")
    assert (read.count("force/sensor"), read.count("force/estimate")) == (1, 1)


def test_a_time_without_change_is_one_span() -> None:
    assert spans(np.array([], dtype=int), np.array([], dtype=str)) == []
    found = spans(np.arange(6) * 10, np.array(list("aabbba")))
    assert [(span.name, span.start_ns, span.end_ns) for span in found] == [("a", 0, 20), ("b", 20, 50), ("a", 50, 50)]


class Links(HTMLParser):
    """Collects what a page loads, and whether its tags close."""

    def __init__(self) -> None:
        super().__init__()
        self.loaded: list[str] = []
        self.tags: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.loaded += [value or "" for name, value in attrs if name in ("src", "href", "data", "srcset")]


def test_report_is_one_file_that_loads_nothing(good: RecordingFile, tmp_path: Path) -> None:
    page = write_report(good, tmp_path / "report.html").read_text(encoding="utf-8")
    links = Links()
    links.feed(page)
    assert links.loaded and all(address.startswith("data:image/svg+xml;base64,") for address in links.loaded)
    assert not {"script", "link", "iframe", "object"} & set(links.tags)
    assert "url(" not in page and "@import" not in page
    for address in links.loaded:
        ElementTree.fromstring(base64.b64decode(address.partition(",")[2]))
    assert links.tags.count("figure") == 7 and page.count('class="narrow"') == 7
    assert 'name="viewport"' in page and len(page) < 4_000_000


def test_report_shows_figures_and_settings(good: RecordingFile) -> None:
    page = render(good)
    for text in (
        "0.200\u00a0N",
        "30\u00a0mN",
        "0.230\u00a0N",
        "1.00\u00a0mm",
        "blazer_prime_xp",
        "encoder_counts_per_step",
        "target contact 0.20 N: accepted",
        "No fault, no damaged frame",
    ):
        assert text in page, text
    assert "nan" not in re.sub(r"base64,[^\"]*", "", page).lower()


def test_ticks_beyond_the_period_are_not_passed_over(good: RecordingFile) -> None:
    assert "virtual time: the simulation waits" in render(good) and "0 late" not in lateness_of(summarize(good))
    assert lateness_of(replace(summarize(good), virtual=False)) == "0 late"


@pytest.mark.slow
def test_same_recording_same_report(good: RecordingFile) -> None:
    assert render(good) == render(RecordingFile(good.path))


@pytest.mark.slow
def test_words_of_others_are_shown_and_not_run(tmp_path: Path) -> None:
    story = Story(log="<script>alert(1)</script> & more", action="warn", cause="<img src=x onerror=alert(1)>")
    page = render(story.write(tmp_path / "a.mcap"))
    assert "<script>" not in page and "<img src=x" not in page and "&lt;script&gt;" in page


@pytest.mark.parametrize(
    "topics",
    [
        set(),
        {"log"},
        {"state"},
        {"force/sensor"},
        {"pose/tip"},
        {"pose/tip", "state"},
        {"stage"},
        {"board", "loop"},
        {"force/estimate"},
        {"state", "force/estimate"},
    ],
)
def test_recordings_without_some_topics_are_reported_too(topics: set[str], good: RecordingFile, tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "part.mcap", RecordingHeader("simulated", "wall", {}, {})) as writer:
        for topic in sorted(topics):
            for body in itertools.islice(good.messages(topic), 50):
                writer.write_encoded(topic, msgpack.packb(body), body["stamp_ns"], 0)
    page = render(RecordingFile(tmp_path / "part.mcap"))
    assert "No contact" in page
    assert "nan" not in re.sub(r"base64,[^\"]*", "", page).lower()


def test_a_cut_recording_is_reported_as_such(good: RecordingFile, tmp_path: Path) -> None:
    content = good.path.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(content[: len(content) // 2])
    assert "The recording ended early" in render(RecordingFile(tmp_path / "cut.mcap"))


@dataclass
class Ended:
    """As much of a scenario's outcome as the summary needs."""

    steps_commanded: list[int] = field(default_factory=list)
    steps_on_pins: list[int] = field(default_factory=list)
    steps_reported: list[int] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


@dataclass
class Ran:
    """As much of a demo's run as the summary needs."""

    recording: Path
    outcome: Ended = field(default_factory=Ended)
    counts: dict[str, Any] = field(default_factory=dict)
    interrupted: str = ""


CONTRACT_KEYS = {
    "target_force_N",
    "force_rms_error_N",
    "force_peak_N",
    "tip_rms_error_m",
    "contact_seconds",
    "loop_hz",
    "tick_us",
    "missed_ticks",
    "firmware",
    "recording",
    "report",
}


def test_contract_json(good: RecordingFile) -> None:
    run = Ran(good.path, Ended([1, 2, 3], [1, 2, 3], [1, 2, 3]), {"faults": ["queue_overflow"], "crc_errors": 2})
    result = json.loads(json.dumps(plain(demo_result(good, run, Path("r.html"))), allow_nan=False))
    assert CONTRACT_KEYS <= set(result)
    assert result["tick_us"] == {"p50": 20.0, "p99": 30.0, "p999": 40.0, "max": 50.0} and result["loop_hz"] == 1000
    assert result["firmware"] == {"faults": ["queue_overflow"], "crc_errors": 2, "underruns": 0}
    assert result["steps"]["on_pins"] == [1, 2, 3]
    assert "steps" not in demo_result(good, Ran(good.path), Path("r.html"))
    assert result["force_peak_N"] == pytest.approx(0.23) and result["contact_seconds"] == pytest.approx(16, abs=0.02)


def test_table_for_people(good: RecordingFile) -> None:
    run = Ran(good.path, Ended([1, 2, 4], [1, 2, 3], [1, 2, 3]), interrupted="SIGINT")
    buffer = io.StringIO()
    print_summary(demo_result(good, run, Path("r.html")), run, Console(file=buffer, width=160))
    shown = buffer.getvalue()
    for text in ("0.200\u00a0N", "set-point 0.20\u00a0N", "no fault", "differ", "SIGINT", str(good.path), "r.html"):
        assert text in shown, text


def test_thinning_keeps_the_peaks() -> None:
    y = np.zeros(100_000)
    y[[123, 77_777]] = (5.0, -3.0)
    _, kept = thinned(np.arange(100_000.0), y)
    assert len(kept) <= 1400 and kept.max() == 5.0 and kept.min() == -3.0
    short = np.array([1.0, np.nan, 2.0])
    assert thinned(np.arange(3.0), short)[1].tolist() == [1.0, 2.0]


def test_numbers_of_a_picture_keep_their_digits() -> None:
    """Places in the picture are shortened, the numbers at its ticks are not."""

    def draw(figure: Figure, narrow: bool) -> None:
        axes = figure.add_subplot()
        axes.plot([-0.002, 0.003], [0.0, 1.0])
        axes.set_xticks([-0.002, 0.001, 0.003])

    picture = report_figure(draw, 3.0, 3.0, "", "", "")
    svg = base64.b64decode(picture.wide.split(",")[1]).decode()
    assert {"−0.002", "0.001", "0.003"} <= set(re.findall(r">([^<>\s]+)</text>", svg))
    assert not re.search(r'd="[^"]*\.\d{3}', svg)
