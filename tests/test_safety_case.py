"""docs/safety-case.md: every barrier names tests, and every test that it names exists."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
TEXT = (ROOT / "docs" / "safety-case.md").read_text(encoding="utf-8")
NAMED = sorted(set(re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", TEXT)))
HAZARDS = re.split(r"^## ", TEXT, flags=re.MULTILINE)[1:]


@cache
def functions_of(path: str) -> set[str]:
    """Names of the tests in a file."""
    tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
    return {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


@pytest.mark.parametrize(("path", "name"), NAMED, ids=[name for _, name in NAMED])
def test_a_named_test_exists(path: str, name: str) -> None:
    assert (ROOT / path).is_file() and name in functions_of(path)


def test_every_hazard_has_barriers_with_tests_and_says_what_remains() -> None:
    assert len(HAZARDS) == 5
    for hazard in HAZARDS:
        rows = [line for line in hazard.splitlines() if line.startswith("|")][2:]
        assert len(rows) >= 5 and all("::test_" in row and row.count("|") == 4 for row in rows), hazard[:40]
        remains = hazard.partition("**Remaining risk.**")[2]
        assert re.search(r"\*\*(Wire|Driver|Person):\*\*", remains), hazard[:40]
