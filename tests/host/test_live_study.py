"""The live study: rows and lines, sizes of planted effects, runs that go on, and the short form without an effect."""

import math
from pathlib import Path

import numpy as np
import pytest

from host.commissioning.experiment_script import check_script
from host.studies import live_study
from host.studies.live_study import BEGIN, CASES, END, ON_S, Book, Frames, LiveRow, Task
from protocol.rig_file import SIMULATED_RIG, load_rig


def alarm(since_s: float, at_s: float, subsystem: str = "roll") -> dict[str, object]:
    words = "roll: probably whip (probability 0.80); since 25.5 s, tip_x differs; also possible: latency@roll (0.15)"
    return {"at_s": at_s, "since_s": since_s, "subsystem": subsystem, "effect": "whip", "probability": 0.8, "words": words}


def row(part: str = "planted", *alarms: dict[str, object], ratio: float = 2.0, seconds: float = 60.0) -> LiveRow:
    return LiveRow(Task(part, "whip@roll", "round", 1, 32.0), seconds, alarms, 0.9, ratio)


def test_a_row_says_when_what_and_what_else() -> None:
    told = row("default", alarm(ON_S + 0.5, ON_S + 5.5))
    assert told.line == "| whip@roll | round | 1 | 1 | 2.0 | 5.5 | roll: whip (0.80) | latency@roll (0.15) |"
    assert "no alarm; largest score 0.90 of 1" in row().line
    early = row("default", alarm(10.0, 15.0))
    assert early.delay_s is None and "no alarm" in early.line
    assert live_study.table([told]).count("\n") == 2


def test_figures_are_counted() -> None:
    late, soon, never = row("doubled", alarm(ON_S, ON_S + 5.5)), row("doubled", alarm(ON_S, ON_S + 2.0)), row("doubled")
    said = live_study.doubled_line([late, soon, never])
    assert "1 of 3 reported within 3 s, 1 not reported, median 3.8 s" in said
    wrong = row("planted", alarm(ON_S, ON_S + 5.0, "knob"))
    said = live_study.planted_line([wrong, soon, never])
    assert "3; 2 reported, 1 of them with a wrong subsystem; 2 name the planted effect." in said
    right = row("planted", alarm(ON_S, ON_S + 2.0))
    assert live_study.summary([wrong, right, soon, never]).count("| whip@roll |") == 3
    quiet = LiveRow(Task("quiet", "", "press", 1, 600.0), 1800.0, (alarm(10.0, 15.0),), 1.2, 1.0)  # type: ignore[arg-type]
    assert "press 1 alarms in 0.50 hours (1 runs)" in live_study.quiet_line([quiet])


def test_every_effect_can_be_planted_at_other_sizes() -> None:
    for name, job, _ in CASES:
        once = live_study.effect_of(Task("planted", name, job, 1, 10.0, 1.0))[0]
        twice = live_study.effect_of(Task("planted", name, job, 1, 10.0, 2.0))[0]
        assert once.start_s == ON_S and once.parameters and once.parameters != twice.parameters
    assert live_study.effect_of(Task("quiet", "", "press", 1, 10.0)) == ()


def test_a_doubled_run_is_sized_by_the_residual_of_the_default_one() -> None:
    task = live_study.doubled(row("default", ratio=2.0))
    assert task is not None and task.size == pytest.approx(1.0)
    task = live_study.doubled(row("default", ratio=4.0))
    assert task is not None and task.size == pytest.approx(math.sqrt(3.0 / 15.0), abs=1e-3)
    assert live_study.doubled(row("default", ratio=1.0)) is None


def test_the_full_form_is_five_hours_of_each_job_and_sixty_planted_runs() -> None:
    all_tasks = list(live_study.tasks(5 * 3600.0, 60, 3600.0))
    assert len({(task.file, task.noise) for task in all_tasks}) == len(all_tasks)
    for job in ("press", "round"):
        assert sum(t.seconds for t in all_tasks if t.part == "quiet" and t.job == job) == pytest.approx(5 * 3600.0)
        assert sum(t.seconds for t in all_tasks if t.part == "fresh" and t.job == job) == pytest.approx(3600.0)
    assert sum(t.part == "planted" for t in all_tasks) == 60
    assert all(t.job == "hand" for t in live_study.tasks(600.0, 5, jobs=["hand"]))


def test_recorded_runs_are_kept_and_judged_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done = []

    def fake(task: Task, board: str) -> Frames:
        done.append(task)
        return Frames(5, np.array([10, 20]), np.array([15, 25]), np.ones((2, 20)))

    monkeypatch.setattr(live_study, "record", fake)
    monkeypatch.setattr(live_study, "judge", lambda task, frames: LiveRow(task, float(frames.armed_ns), (), 0.5, 1.5))
    task = Task("quiet", "", "press", 3, 60.0)
    assert Book(tmp_path, "native", only_recorded=True).row(task) is None and not done
    first = Book(tmp_path, "native").row(task)
    assert first is not None and first.seconds == 5.0
    assert Book(tmp_path, "native", only_recorded=True).row(task) == first and done == [task]


def test_fresh_noise_changes_the_poses_by_the_noise_of_the_tracker_alone() -> None:
    rig = load_rig(SIMULATED_RIG)
    row = np.concatenate((np.zeros(3), np.tile([0.0, 0.01, 0.02, 1.0, 0.0, 0.0, 0.0], 2), np.zeros(3)))
    stamps = np.arange(100, 300) * 25_000_000
    own = live_study.with_noise(Frames(0, stamps, stamps, np.tile(row, (200, 1))), rig, 3, 4)
    back = live_study.with_noise(own, rig, 4, 3)
    assert np.allclose(back.rows, row, atol=1e-12)
    spread = np.std(own.rows - row, axis=0)
    expected = np.sqrt(2.0) * rig.tracker.position_noise_m
    assert np.allclose(spread[[3, 4, 5, 10, 11, 12]], expected, rtol=0.2) and not spread[[0, 1, 2, 17, 18, 19]].any()


def test_the_round_trip_is_allowed() -> None:
    rig = load_rig(SIMULATED_RIG)
    path = check_script(live_study.round_trip(rig, 60.0), rig)
    assert path.travel["roll"][1] - path.travel["roll"][0] > 4.0 and path.high_m[2] < 0.021


@pytest.mark.slow
@pytest.mark.parametrize("job", ["press", "hand"])
def test_half_a_minute_of_watching_without_an_effect_raises_no_alarm(job: str) -> None:
    task = Task("quiet", "", job, 1, 30.0)
    quiet = live_study.judge(task, live_study.record(task))
    assert quiet.alarms == () and quiet.seconds > 29.9 and quiet.residual_ratio > 0.0


def test_the_page_is_written_between_its_marks(tmp_path: Path) -> None:
    page = tmp_path / "p.md"
    page.write_text(f"before\n{BEGIN}\nold\n{END}\nafter\n")
    live_study.write_docs(page, "new")
    assert page.read_text() == f"before\n{BEGIN}\nnew\n{END}\nafter\n"
    page.write_text("no marks")
    with pytest.raises(ValueError, match="marks"):
        live_study.write_docs(page, "new")


def test_a_page_gets_the_text_of_all_jobs_or_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fake(task: Task, board: str) -> Frames:
        return Frames(5, np.array([10, 20]), np.array([15, 25]), np.ones((2, 20)))

    monkeypatch.setattr(live_study, "record", fake)
    monkeypatch.setattr(live_study, "judge", lambda task, frames: LiveRow(task, 120.0, (), 0.5, 1.0))
    page = tmp_path / "p.md"
    page.write_text(f"{BEGIN}\nold\n{END}\n")
    with pytest.raises(SystemExit):
        live_study.main(["--jobs", "hand", "--docs", str(page)])
    assert "old" in page.read_text()
    live_study.main(["--jobs", *live_study.JOBS, "--docs", str(page)])
    text = page.read_text()
    assert "old" not in text and text.index("**In lock step.**") < text.index("**By hand.**")
    for job in live_study.JOBS:
        assert f"{job} 0 alarms in 0.03 hours (1 runs)" in text
