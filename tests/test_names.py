"""One name for one thing: a class name that is used twice makes a reader look twice."""

from __future__ import annotations

import ast
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parent.parent
PACKAGES = ("protocol", "realtime", "sim", "host", "seldinger")
# Names that are still used twice. The list may only shrink: a name that is used once again has to be taken out of it.
USED_TWICE: set[str] = {
    "Axis",
    "Calibration",
    "Drawn",
    "Listener",
    "Plan",
    "Planted",
    "Recording",
    "Result",
    "Rig",
    "Session",
    "Table",
}


def class_names() -> dict[str, list[str]]:
    """Class name -> files of product code that define a class of that name."""
    found: dict[str, list[str]] = defaultdict(list)
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.ClassDef):
                    found[node.name].append(str(path.relative_to(ROOT)))
    return found


def test_no_new_class_has_a_name_that_is_taken() -> None:
    twice = {name: files for name, files in class_names().items() if len(files) > 1}
    new = {name: files for name, files in twice.items() if name not in USED_TWICE}
    assert not new, f"found class names used twice: {new}; wanted another name for one of each"


def test_the_list_of_names_used_twice_only_shrinks() -> None:
    twice = {name for name, files in class_names().items() if len(files) > 1}
    assert twice >= USED_TWICE, f"used once now, take out of the list: {sorted(USED_TWICE - twice)}"
