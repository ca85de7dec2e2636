"""Compiled kernels are kept apart for each state of the sources they depend on."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from protocol.kernel_cache import ROOT, folder_of, sources_state

TICK = "realtime/control/tick.py"


def write(root: Path, name: str, text: str) -> Path:
    path = root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def test_an_edited_kernel_is_another_state(tmp_path: Path) -> None:
    tick = write(tmp_path, TICK, "from numba import njit\na = 1\n")
    first = sources_state(tick, tmp_path)
    assert sources_state(tick, tmp_path) == first
    write(tmp_path, TICK, "from numba import njit\na = 2\n")
    assert sources_state(tick, tmp_path) != first


@pytest.mark.parametrize(
    "line",
    [
        "from protocol.gains import GAIN",
        "from protocol import gains",
        "import protocol.gains",
        "from protocol import (\n    frames,\n    gains,\n)",
        "from protocol import GAIN_OF_THE_PACKAGE",
        "from protocol import gains as g",
        "from protocol.gains import GAIN as G",
        "import protocol.gains as g",
        "import protocol.frames, protocol.gains",
        "import numpy, protocol.gains as g",
        "import protocol",
        "from protocol import (  # noqa\n    frames as f,  # one, two\n    gains as g,\n)",
    ],
)
def test_what_a_kernel_imports_counts_and_what_it_does_not_import_does_not(tmp_path: Path, line: str) -> None:
    tick = write(tmp_path, TICK, f"from numba import njit\n{line}\n")
    write(tmp_path, "protocol/__init__.py", "from protocol.limits import LIMIT\n")
    write(tmp_path, "protocol/gains.py", "from protocol.limits import LIMIT\nGAIN = 1\n")
    write(tmp_path, "protocol/limits.py", "LIMIT = 1\n")
    write(tmp_path, "host/report/run_report.py", "PAGE = 1\n")
    first = sources_state(tick, tmp_path)
    write(tmp_path, "host/report/run_report.py", "PAGE = 2\n")
    assert sources_state(tick, tmp_path) == first
    write(tmp_path, "protocol/limits.py", "LIMIT = 2\n")
    assert sources_state(tick, tmp_path) != first


@pytest.mark.parametrize("line", ["from protocol import gains as g", "import protocol.gains as limits"])
def test_the_name_after_as_is_no_import(tmp_path: Path, line: str) -> None:
    """It was read as a name in the package, whose own code then counted."""
    tick = write(tmp_path, TICK, f"{line}\n")
    write(tmp_path, "protocol/gains.py", "GAIN = 1\n")
    write(tmp_path, "protocol/__init__.py", "A = 1\n")
    write(tmp_path, "protocol/limits.py", "LIMIT = 1\n")
    first = sources_state(tick, tmp_path)
    write(tmp_path, "protocol/__init__.py", "A = 2\n")
    write(tmp_path, "protocol/limits.py", "LIMIT = 2\n")
    assert sources_state(tick, tmp_path) == first


def test_the_state_holds_no_path_of_the_checkout(tmp_path: Path) -> None:
    states = set()
    for checkout in ("one", "two"):
        tick = write(tmp_path / checkout, TICK, "import protocol.gains\n")
        write(tmp_path / checkout, "protocol/gains.py", "GAIN = 1\n")
        states.add(sources_state(tick, tmp_path / checkout))
    assert len(states) == 1


def test_kernels_of_this_project_go_to_the_folder_of_their_module(tmp_path: Path) -> None:
    script = (
        "import sys, protocol; assert 'numba' not in sys.modules\n"
        "from realtime.control import backlash\n"
        "print(backlash.narrow._cache.cache_path)"
    )
    environment = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    done = subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
        env=environment | {"XDG_CACHE_HOME": str(tmp_path)},
    )
    folder = Path(done.stdout.strip())
    assert folder.parent == tmp_path / "seldinger" / "kernels"
    assert folder.name.startswith("realtime.control.backlash-")
    assert folder.name == folder_of(ROOT / "realtime" / "control" / "backlash.py").name
