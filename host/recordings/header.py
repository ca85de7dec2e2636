"""What a recording says of its origin: rig, clock, configuration, catheter, seed, software and start."""

from __future__ import annotations

import dataclasses
import json
import subprocess
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

from protocol.catheter import load_catheter
from protocol.rig_file import Rig


def software_version() -> str:
    """The installed version of this software, `unknown` when it is not installed."""
    try:
        return version("seldinger")
    except PackageNotFoundError:
        return "unknown"


def git_revision() -> str:
    """Return the revision of this code, with `+changes` if files differ from it; `unknown` outside git."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return "unknown"
    command = ["git", "-C", str(root), "describe", "--always", "--abbrev=40", "--dirty=+changes", "--exclude=*"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=5, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return "unknown"
    return done.stdout.strip() or "unknown"


class RecordingHeader(NamedTuple):
    """Everything that is needed to understand a recording, apart from its messages."""

    rig: str
    clock: str
    configuration: dict[str, Any]
    catheter: dict[str, Any]
    seed: int | None = None
    notes: dict[str, str] = {}  # noqa: RUF012 - a NamedTuple's default, never written to

    def sections(self) -> dict[str, dict[str, str]]:
        """The MCAP metadata records: name -> texts."""
        run = {
            "rig": self.rig,
            "clock": self.clock,
            "seed": "" if self.seed is None else str(self.seed),
            "software_version": software_version(),
            "git_revision": git_revision(),
            "started_utc": datetime.now(UTC).isoformat(timespec="seconds"),
            **self.notes,
        }
        return {
            "run": run,
            "configuration": {"json": json.dumps(self.configuration)},
            "catheter": {"json": json.dumps(self.catheter)},
        }


def header_of(rig: Rig, clock: str, seed: int | None = None, notes: dict[str, str] | None = None) -> RecordingHeader:
    """The recording's header for `rig`. clock: `virtual` or `wall`."""
    return RecordingHeader(
        rig=rig.name,
        clock=clock,
        configuration=rig.effective(),
        catheter=dataclasses.asdict(load_catheter(rig.catheter.name)),
        seed=seed,
        notes=notes or {},
    )
