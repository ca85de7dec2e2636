"""The demo as a command: what its user is told when the disk fills up on the way."""

import json
import os
from pathlib import Path

import pytest
from typer.testing import CliRunner

from host.cli.main import build
from host.recording import Recording


def test_a_disk_that_fills_up_is_told_and_the_job_is_still_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real, room = os.write, [200_000]

    def small_disk(fd: int, data: bytes) -> int:
        if not os.readlink(f"/proc/self/fd/{fd}").endswith(".mcap"):
            return real(fd, data)
        taken = min(len(data), room[0])
        room[0] -= taken
        if taken == 0:
            raise OSError(28, "No space left on device")
        return real(fd, data[:taken])

    monkeypatch.setattr(os, "write", small_disk)
    words = ["demo", "--fast", "--board", "native", "--hold", "3", "--json", "--dir", str(tmp_path)]
    told = CliRunner().invoke(build(words), words)
    monkeypatch.undo()
    assert told.exit_code == 1 and "the disk is full" in told.stderr
    steps = json.loads(told.stdout)["steps"]
    assert steps["commanded"] == steps["on_pins"] == steps["reported"] != [0, 0, 0]
    (path,) = tmp_path.glob("*.mcap")
    assert Recording(path).truncated
