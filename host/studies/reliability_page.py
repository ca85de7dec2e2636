"""docs/reliability.md: each section is written by one command between two markers, so that each figure has its command.

`make fuzz` writes its own by `python -m host.studies.reliability_page PAGE < RESULT.json`.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

_HEAD = """# Reliability: what happens when something breaks

This page gives the measured behaviour under injected faults, over hours of operation, with disturbing subscribers, and under
random input to the firmware. Each section is written by the command that it names. Run the command to make it again.
"""


def write_section(page: Path, name: str, text: str) -> None:
    """Put `text` into section `name` of `page` (made if needed), in the place of what was there."""
    old = page.read_text(encoding="utf-8") if page.exists() else _HEAD
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    block = f"{begin}\n{text.strip()}\n{end}"
    pattern = re.compile(re.escape(begin) + ".*?" + re.escape(end), re.S)
    new = pattern.sub(lambda _: block, old) if pattern.search(old) else f"{old.rstrip()}\n\n{block}\n"
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text(new, encoding="utf-8")


def fuzz_section(found: dict[str, Any]) -> str:
    """The section on fuzzing the firmware; found: what firmware/fuzz prints."""
    return "\n".join(
        [
            "## Fuzzing the firmware",
            "",
            f"`make fuzz INPUTS={found['inputs']}`",
            "",
            f"{found['inputs']} inputs (raw bytes, whole frames, passing time, switches) into parser, commands, gate and",
            f"interpolator, under the address and undefined-behaviour sanitizers: **{found['findings']} findings**.",
            f"{found['edges']} edges of the code reached, {found['corpus']} inputs kept in `firmware/fuzz/corpus`.",
            "A step pin that moves without a command, or by more than one step in a tick, counts as a finding too.",
        ]
    )


if __name__ == "__main__":
    write_section(Path(sys.argv[1]), "fuzz", fuzz_section(json.loads(sys.stdin.read())))
