"""One name for one thing: a class name that is used twice makes a reader look twice."""

from __future__ import annotations

import ast
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parent.parent
PACKAGES = ("protocol", "realtime", "sim", "host", "seldinger")


def class_names() -> dict[str, list[str]]:
    """Class name -> files of product code that define a class of that name."""
    found: dict[str, list[str]] = defaultdict(list)
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.ClassDef):
                    found[node.name].append(str(path.relative_to(ROOT)))
    return found


def test_every_class_name_is_used_once() -> None:
    twice = {name: files for name, files in class_names().items() if len(files) > 1}
    assert not twice, f"found class names used twice: {twice}; wanted another name for one of each"
