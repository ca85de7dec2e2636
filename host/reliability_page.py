"""docs/reliability.md: sections that commands write between their own marks, so that each figure has its command."""

from __future__ import annotations

import re
from pathlib import Path

_HEAD = """# Reliability: what was measured

Each section below is written by the command that it names; run the command to make it again.
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
