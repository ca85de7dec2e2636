"""The firmware's core, compiled for the host with the address and undefined-behaviour sanitizers, passes its C tests."""

import fcntl
import json
import shutil
import subprocess
from pathlib import Path

import pytest

from sim.board import BUILD_DIR, FIRMWARE_DIR

pytestmark = pytest.mark.slow  # gcc with the sanitizers
TESTS = sorted(path.stem for path in (FIRMWARE_DIR / "tests").glob("test_*.c"))


@pytest.fixture(scope="module")
def programs() -> Path:
    if shutil.which("gcc") is None or shutil.which("make") is None:
        pytest.skip("gcc or make is missing")
    BUILD_DIR.mkdir(parents=True, exist_ok=True)
    with open(BUILD_DIR / ".lock", "w", encoding="ascii") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        result = subprocess.run(["make", "--silent", "-C", str(FIRMWARE_DIR), "host-tests"], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return BUILD_DIR


def test_there_are_tests() -> None:
    assert {"test_frame_codec", "test_limits", "test_motion", "test_safety", "test_storm"} <= set(TESTS)


@pytest.mark.parametrize("name", TESTS)
def test_core(programs: Path, name: str) -> None:
    result = subprocess.run([str(programs / name)], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert result.stdout.endswith("\n") and "ok" in result.stdout


def test_valid_but_hostile_sequences_break_no_invariant() -> None:
    """The short form of `make fuzz`: every frame whole, extreme arguments, every state."""
    fuzz = FIRMWARE_DIR / "fuzz"
    if shutil.which("gcc") is None or shutil.which("make") is None:
        pytest.skip("gcc or make is missing")
    command = ["make", "--silent", "-C", str(fuzz), "frames", "SEED=7", "SEQUENCES=20000"]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    told = json.loads(result.stdout)
    assert told["findings"] == 0 and told["setpoints_accepted"] > 10_000 and told["steps"] > 100_000
    assert min(told["ticks_by_state"]) > 10_000, "every state is reached"


def test_the_sanitizers_are_on(programs: Path) -> None:
    assert b"__asan_init" in (programs / "test_storm").read_bytes()
