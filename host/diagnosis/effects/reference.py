"""Write the table of the vocabulary: `python -m host.diagnosis.effects.reference docs/diagnosis.md`."""

from __future__ import annotations

import sys
from pathlib import Path

from host.diagnosis.effects import library
from host.diagnosis.model.effect import Effect

BEGIN, END = "<!-- effects begin -->", "<!-- effects end -->"


def table() -> str:
    """One row for each id and equation: ports, forms, traits."""
    rows: dict[tuple[str, str], list[Effect]] = {}
    for effect in sorted(library(), key=lambda e: e.id):
        rows.setdefault((effect.id, effect.equation), []).append(effect)
    lines = ["| id | ports | form | equation | traits |", "|---|---|---|---|---|"]
    for (effect_id, equation), effects in rows.items():
        ports = ", ".join(dict.fromkeys(effect.port for effect in effects))
        forms = ", ".join(dict.fromkeys(f"`{form}`" for effect in effects for form in effect.forms if form))
        shown = equation.replace("|", "\\|")
        lines.append(f"| `{effect_id}` | {ports} | {forms} | `{shown}` | {traits(effects)} |")
    return "\n".join(lines)


def traits(effects: list[Effect]) -> str:
    """Return the traits of these effects in words; an effect at several ports has the traits of all its forms."""
    known = (
        ("memory", any(e.remembers for e in effects)),
        ("needs a rate", any(e.timed for e in effects)),
        ("commutes", any(e.invariant for e in effects)),
        ("natural bounds", any(e.natural_bounds for e in effects)),
        ("wider than the vocabulary", any(e.extended for e in effects)),
        ("seen at rest", any(e.at_rest for e in effects)),
        ("named " + " or ".join(dict.fromkeys(i for e in effects for i in e.spans)), any(e.spans for e in effects)),
    )
    return ", ".join(words for words, has in known if has)


def main() -> None:
    """Write the table into the page that is named first on the command line."""
    page = Path(sys.argv[1])
    head, rest = page.read_text(encoding="utf-8").split(BEGIN)
    page.write_text(f"{head}{BEGIN}\n{table()}\n{END}{rest.split(END)[1]}", encoding="utf-8")


if __name__ == "__main__":
    main()
