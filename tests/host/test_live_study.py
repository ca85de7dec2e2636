"""The live study's table: rows, silence, the page it is written to."""

from pathlib import Path

import pytest

from host.commissioning.experiment_script import check_script
from host.studies.live_study import BEGIN, CASES, END, ON_S, Row, quiet_line, round_trip, table, write_docs
from protocol.rig_file import SIMULATED_RIG, load_rig
from protocol.topics import Alarm
from sim.effects import parse


def alarm(since_s: float, at_s: float) -> Alarm:
    words = "roll: probably whip (as well may be latency@roll); tip_x"
    return Alarm(stamp_ns=round(at_s * 1e9), subsystem="roll", effect="whip", channel="tip_x", score=2.0, explained=0.9,
                 since_ns=round(since_s * 1e9), words=words)  # fmt: skip


def test_a_row_says_when_what_and_what_else() -> None:
    row = Row("whip@roll", "round", 60.0, [alarm(ON_S + 0.5, ON_S + 5.5)], 0.9)
    assert row.line == "| whip@roll | round | 0.5 | 5.5 | roll: whip | latency@roll |"
    assert "never | never | silent; largest score 0.90 of 1" in Row("whip@roll", "round", 60.0, [], 0.9).line
    early = Row("whip@roll", "round", 60.0, [alarm(10.0, 15.0)], 0.9)
    assert "never" in early.line and "1 alarms in 0.02 hours" in quiet_line([early])
    assert table([row]).count("\n") == 2


def test_every_case_can_be_planted_and_the_round_trip_is_allowed() -> None:
    rig = load_rig(SIMULATED_RIG)
    assert all(parse(planted) for planted, _ in CASES)
    path = check_script(round_trip(rig, 60.0), rig)
    assert path.travel["roll"][1] - path.travel["roll"][0] > 4.0 and path.high_m[2] < 0.021


def test_the_page_is_written_between_its_marks(tmp_path: Path) -> None:
    page = tmp_path / "p.md"
    page.write_text(f"before\n{BEGIN}\nold\n{END}\nafter\n")
    write_docs(page, "new")
    assert page.read_text() == f"before\n{BEGIN}\nnew\n{END}\nafter\n"
    page.write_text("no marks")
    with pytest.raises(ValueError, match="marks"):
        write_docs(page, "new")
