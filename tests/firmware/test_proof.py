"""The proof of the firmware's arithmetic holds, and does not hold for a firmware with a check taken out."""

import shutil
import subprocess
from pathlib import Path

import pytest

from sim.board import FIRMWARE_DIR

pytestmark = pytest.mark.skipif(shutil.which("frama-c") is None, reason="frama-c is missing (Debian: frama-c-base)")


def prove(folder: Path) -> tuple[int, list[str]]:
    done = subprocess.run([str(folder / "proof" / "prove.sh")], capture_output=True, text=True, check=False)
    return done.returncode, [line for line in done.stdout.splitlines() if "NOT proved" in line]


def test_everything_is_proved() -> None:
    assert prove(FIRMWARE_DIR) == (0, [])


@pytest.mark.long
@pytest.mark.parametrize(
    ("source", "check", "instead", "what"),
    [
        ("commands.c", " || steps < -TRAVEL_MAX || steps > TRAVEL_MAX", "", "prove_commands"),
        ("setpoint_gate.c", "wanted < gate.axis[i].soft_min || ", "", "prove_setpoint"),
        ("setpoint_gate.c", "ticks >= LEAST_TICKS && ", "", "prove_setpoint"),
        ("frame_codec.c", "if (length < FRAME_MAX_RX_BODY_BYTES) ", "", "prove_parser"),
    ],
)
def test_a_check_taken_out_is_found(tmp_path: Path, source: str, check: str, instead: str, what: str) -> None:
    shutil.copytree(FIRMWARE_DIR / "src", tmp_path / "src")
    shutil.copytree(FIRMWARE_DIR / "proof", tmp_path / "proof")
    file = tmp_path / "src" / source
    text = file.read_text()
    assert text.count(check) == 1
    file.write_text(text.replace(check, instead))
    status, left = prove(tmp_path)
    assert status == 1 and any(what in line for line in left), left
