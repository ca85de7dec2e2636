"""A reproduction's report: sections with claim, figure and verdict, as one self-contained page and as JSON."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from host.recordings.header import software_version
from host.report.style import ReportFigure

TEMPLATES = Path(__file__).resolve().parent / "templates"
HOLDS, DOES_NOT_HOLD, NOT_REPRODUCIBLE = "holds", "does_not_hold", "not_reproducible"
WORDS = {HOLDS: "holds", DOES_NOT_HOLD: "does not hold", NOT_REPRODUCIBLE: "not reproducible"}


@dataclass(frozen=True)
class Section:
    """One reproduced figure or table. `thesis`, `ours`: one or two sentences each; `says`: the verdict with its figure.

    rows: a table, its heading first.
    """

    id: str
    title: str
    thesis: str
    ours: str
    verdict: str
    says: str
    pictures: tuple[ReportFigure, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()

    def __post_init__(self) -> None:
        if self.verdict not in WORDS:
            raise ValueError(f"{self.id}.verdict: found {self.verdict!r}, wanted one of {', '.join(WORDS)}")
        if not self.says or "\n" in self.says:
            raise ValueError(f"{self.id}.says: found {self.says!r}, wanted one line")


def verdict(holds: bool) -> str:
    """Return HOLDS or DOES_NOT_HOLD."""
    return HOLDS if holds else DOES_NOT_HOLD


def page_environment() -> Environment:
    """The templates of pages: escaping on, unknown names refused."""
    return Environment(
        loader=FileSystemLoader(TEMPLATES), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )


def write_reproduction(target: str | Path, title: str, lead: str, sections: Sequence[Section]) -> Path:
    """Write the page to `target` (HTML, its folder is made) and return its path. Raises OSError where it cannot write."""
    target = Path(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    count = Counter(section.verdict for section in sections)
    eyebrow = "seldinger reproduce · " + ", ".join(f"{count[key]} {words}" for key, words in WORDS.items() if count[key])
    text = (
        page_environment()
        .get_template("reproduction.html.j2")
        .render(
            title=title,
            lead=lead,
            eyebrow=eyebrow,
            sections=sections,
            words=WORDS,
            footer=f"Made by seldinger {software_version()}.",
        )
    )
    target.write_text(text, encoding="utf-8")
    return target


def as_json(sections: Sequence[Section], report: str | Path) -> dict[str, Any]:
    """The object of `seldinger reproduce ... --json`."""
    keys = ("id", "verdict", "thesis", "ours", "says")
    return {"sections": [{key: getattr(section, key) for key in keys} for section in sections], "report": str(report)}
