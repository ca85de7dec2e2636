"""docs/api.md: every function of the public face has an example, and every example runs."""

from __future__ import annotations

from pathlib import Path

import pytest

import seldinger
from tests.seldinger.api_page import examples, run, write_recording

EXAMPLES = examples()


def test_every_function_has_an_example() -> None:
    functions = [name for name in seldinger.__all__ if name[0].islower()]
    assert sorted(EXAMPLES) == sorted(functions)


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_example_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_recording(tmp_path)
    monkeypatch.chdir(tmp_path)
    run(name, EXAMPLES[name])
