"""docs/first-day.md as a stranger reads it: its commands, in order, on a simulated rig that is not told anything else."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "first-day.md").read_text(encoding="utf-8")


def commands() -> list[list[str]]:
    """Words of each `seldinger` line of the page's code, in order, without its comment."""
    lines = re.findall(r"^    (seldinger .*?)(?:\s+#.*)?$", PAGE, re.MULTILINE)
    return [line.split()[1:] for line in lines]


def called(words: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "host.cli.main", *words], capture_output=True, text=True, cwd=ROOT, timeout=1800, check=False
    )


def test_the_page_leads_from_setup_to_a_report() -> None:
    order = [words[0] for words in commands()]
    wanted = ["--version", "rig", "view", "status", "arm", "goto", "jog", "zero", "touch", "disarm", "run", "run", "play"]
    assert [name for name in order if name in wanted] == wanted and "make setup" in PAGE


def test_what_needs_no_rig_runs_as_written(tmp_path: Path) -> None:
    for words in commands():
        if words[0] in ("--version", "rig") or "--dry-run" in words:
            done = called(words, tmp_path)
            assert done.returncode == 0, f"{words}: {done.stderr}"


@pytest.mark.slow
def test_the_line_of_six_touches_ends_with_a_report(tmp_path: Path) -> None:
    (words,) = [words for words in commands() if words[0] == "run" and "--simulated" in words]
    at = words.index("--out")
    words = [*words[:at], "--out", str(tmp_path), *words[at + 2 :], "--board", "native", "--json"]
    done = called(words, tmp_path)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["summary"]["done"] and result["summary"]["touches"] == 6
    assert Path(result["recording"]).exists() and "mean force" in Path(result["report"]).read_text(encoding="utf-8")
    assert done.stderr.count("touch ") >= 6
