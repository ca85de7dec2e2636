"""Compiled kernels are kept apart for each state of the sources."""

import os
from pathlib import Path

import pytest

from protocol.kernel_cache import sources_state


def write(root: Path, name: str, text: str) -> None:
    path = root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def test_an_edited_kernel_is_another_state(tmp_path: Path) -> None:
    write(tmp_path, "realtime/control/tick.py", "from numba import njit\na = 1\n")
    first = sources_state(tmp_path)
    assert sources_state(tmp_path) == first
    write(tmp_path, "realtime/control/tick.py", "from numba import njit\na = 2\n")
    assert sources_state(tmp_path) != first


@pytest.mark.parametrize(
    "line",
    [
        "from protocol.gains import GAIN",
        "from protocol import gains",
        "import protocol.gains",
        "from protocol import (\n    frames,\n    gains,\n)",
    ],
)
def test_what_a_kernel_imports_counts_and_what_it_does_not_import_does_not(tmp_path: Path, line: str) -> None:
    write(tmp_path, "realtime/control/tick.py", f"from numba import njit\n{line}\n")
    write(tmp_path, "protocol/gains.py", "from protocol.limits import LIMIT\nGAIN = 1\n")
    write(tmp_path, "protocol/limits.py", "LIMIT = 1\n")
    write(tmp_path, "host/report/run_report.py", "PAGE = 1\n")
    first = sources_state(tmp_path)
    write(tmp_path, "host/report/run_report.py", "PAGE = 2\n")
    assert sources_state(tmp_path) == first
    write(tmp_path, "protocol/limits.py", "LIMIT = 2\n")
    assert sources_state(tmp_path) != first


def test_the_rooms_have_chosen_a_folder() -> None:
    import realtime

    assert realtime.__doc__ and os.environ["NUMBA_CACHE_DIR"]
