"""`seldinger warm`: afterwards a fresh process compiles nothing; a command that compiles says so."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from host.cli import main as command_line
from host.cli import warm as command
from host.cli.warm_workloads import WORKLOADS, Workload

ROOT = Path(__file__).resolve().parents[2]
# Commands without kernels, or whose kernels are those of studies: they repeat what is warmed, or compile and say so.
NOT_WARMED = {"bench", "check-device", "control-study", "export", "faults", "flash", "home", "install-services", "keys"}
NOT_WARMED |= {"prove", "reproduce", "rig", "soak", "warm"}
NOT_WARMED |= {
    "arm",
    "bridge",
    "clear",
    "disarm",
    "force",
    "goto",
    "hold",
    "jog",
    "mark",
    "retract",
    "run",
    "status",
    "stop",
    "touch",
    "zero",
}
WARMED = {
    "solve": ("planar", "rod"),
    "estimate": ("planar", "estimates"),
    "calibrate": ("calibration",),
    "demo": ("rig", "processes"),
    "view": ("processes", "page"),
    "play": ("page",),
    "diagnose": ("tables", "rig diagnosis", "live"),
    "experiment": ("rig",),
    "characterize": ("rig", "commissioning"),
    "tune": ("commissioning",),
    "plan": ("rig",),
    "latency-check": ("loop",),
}
COUNT = """
import sys
from numba.core import event
from host.cli.warm_workloads import WORKLOADS
from pathlib import Path
names = []
class Listener(event.Listener):
    def on_start(self, e): names.append(e.data["dispatcher"].py_func.__qualname__)
    def on_end(self, e): pass
event.register("numba:compile", Listener())
for name in sys.argv[2:]:
    WORKLOADS[name].run(Path(sys.argv[1]))
print("compiled:", *names)
"""


def test_every_command_is_warmed_or_listed_as_one_without_kernels() -> None:
    assert set(command_line.COMMANDS) == NOT_WARMED | set(WARMED) and not NOT_WARMED & set(WARMED)
    assert {name for names in WARMED.values() for name in names} <= set(WORKLOADS)


def test_workloads_start_after_those_they_need() -> None:
    order = list(WORKLOADS)
    for name, workload in WORKLOADS.items():
        assert all(order.index(needed) < order.index(name) for needed in workload.after)
    assert command._with_needed(["estimates"]) == ["rod", "estimates"]


@pytest.mark.slow
def test_after_warm_a_fresh_process_compiles_nothing(tmp_path: Path) -> None:
    names = ["planar", "rod", "estimates", "rig", "loop"]
    wanted = [word for name in names for word in ("--only", name)]
    warmed = subprocess.run(
        [sys.executable, "-m", "host.cli.main", "warm", "--json", *wanted], capture_output=True, text=True, cwd=ROOT
    )
    assert warmed.returncode == 0 and json.loads(warmed.stdout)["failed"] == {}, warmed.stderr
    again = subprocess.run(
        [sys.executable, "-c", COUNT, str(tmp_path), *names], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert again.stdout.splitlines()[-1] == "compiled:"


def test_a_part_that_fails_is_named_and_the_others_run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    parts = {
        "good": Workload("the good part", lambda folder: None),
        "bad": Workload("the bad part", lambda folder: None, ("good",)),
        "last": Workload("the last part", lambda folder: None, ("bad",)),
    }
    programs = {"good": "pass", "bad": "raise SystemExit('gone wrong')", "last": "pass"}
    started = []

    def start(name: str, folder: Path) -> subprocess.Popen[bytes]:
        started.append(name)
        with (folder / f"{name}.txt").open("wb") as messages:
            return subprocess.Popen([sys.executable, "-c", programs[name]], stderr=messages)

    monkeypatch.setattr(command, "WORKLOADS", parts)
    monkeypatch.setattr(command, "_start", start)
    assert command._run_all(["good", "bad", "last"], 2) == {"bad": "gone wrong"}
    assert started == ["good", "bad", "last"] and "the bad part" in capsys.readouterr().err


def test_a_process_that_compiles_says_so_once() -> None:
    program = (
        "from protocol import compile_notice\n"
        "compile_notice.on_first(lambda: print('compiling'))\n"
        "import numpy as np, protocol.setpoint_encoder\n"
        "from numba import njit\n"
        "f, g = njit(lambda x: x + 1), njit(lambda x: x + 2)\n"
        "print(f(1), g(1))\n"
    )
    environment = os.environ | {"NUMBA_DISABLE_JIT": "0"}
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=ROOT, env=environment
    )
    assert done.stdout.splitlines() == ["compiling", "2 3"]
