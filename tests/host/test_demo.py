"""The demo as a command: what its user is told when the disk fills up on the way."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from host.cli.main import build
from host.recordings.recording import RecordingFile
from tests.small_disk import fill_up


def test_a_disk_that_fills_up_is_told_and_the_job_is_still_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fill_up(monkeypatch, 200_000)
    words = ["demo", "--fast", "--board", "native", "--hold", "3", "--json", "--out", str(tmp_path)]
    told = CliRunner().invoke(build(words), words)
    monkeypatch.undo()
    assert told.exit_code == 1 and "the disk is full" in told.stderr
    steps = json.loads(told.stdout)["steps"]
    assert steps["commanded"] == steps["on_pins"] == steps["reported"] != [0, 0, 0]
    (path,) = tmp_path.glob("*.mcap")
    assert RecordingFile(path).truncated
