"""Finished runs of a fault campaign in a folder: a campaign that was stopped makes only its other runs."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from host.studies.faults.campaign import RunPlan, RunResult, judged
from protocol.errors import Description, InputError


class FinishedRuns:
    """The file `runs.jsonl` of a folder: a line for the campaign's settings, then one for each finished run.

    The plan of a run is not kept, because the settings decide it. Nor are broken rules: they are judged again.
    """

    def __init__(self, folder: Path, settings: dict[str, Any], plans: Iterable[RunPlan]) -> None:
        """Read what is finished. Raises InputError if the folder holds a campaign with other settings."""
        self._path = folder / "runs.jsonl"
        self.results: list[RunResult] = []
        if not self._path.exists():
            self._path.write_text(json.dumps(settings) + "\n", encoding="utf-8")
            return
        text = self._path.read_text(encoding="utf-8")
        first, *lines = text.splitlines() or [""]
        if _content(first) != settings:
            wanted = f"an empty folder, or the call that made {self._path}"
            raise InputError("--out", Description("finished runs of another campaign"), wanted)
        if not text.endswith("\n"):
            self._append("")
        by_index = {plan.index: plan for plan in plans}
        for content in map(_content, lines):
            if isinstance(content, dict) and content.get("index") in by_index:
                self.results.append(judged(by_index[content.pop("index")], content))

    def add(self, result: RunResult) -> None:
        """Append a finished run."""
        content = {"index": result.plan.index, **asdict(result)}
        del content["plan"], content["violations"]
        self._append(json.dumps(content))

    def _append(self, line: str) -> None:
        with self._path.open("a", encoding="utf-8") as file:
            file.write(line + "\n")


def _content(line: str) -> Any:
    """Content of a line; None for a line that was cut off when the campaign was stopped."""
    try:
        return json.loads(line)
    except ValueError:
        return None
