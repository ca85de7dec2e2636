"""The processes of a rig, ended while they still compile: each ends at once, and what it has opened is closed."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import host.diagnosis.live.attach as attach
import host.run.model_process as model_process
import host.run.wall_clock as wall_clock
import host.view.serve as serve
import realtime.__main__ as realtime_process
from host.run.demo import DemoSettings
from protocol.rig_file import SIMULATED_RIG
from tests.waiting import until

pytestmark = pytest.mark.usefixtures("signal_handlers")


class Compiling:
    """A compilation that a signal meets; `ended` if the signal did not interrupt it."""

    def __init__(self) -> None:
        self.began = self.ended = False

    def __call__(self, *arguments: Any) -> Any:
        self.began = True
        os.kill(os.getpid(), signal.SIGTERM)
        self.ended = True
        return SimpleNamespace()


@pytest.fixture
def compiling() -> Compiling:
    return Compiling()


def test_the_realtime_process(compiling: Compiling, monkeypatch: pytest.MonkeyPatch) -> None:
    stopped: list[bool] = []
    loop = SimpleNamespace(heartbeat=0)

    def opened(rig: Any, **ports: Any) -> SimpleNamespace:
        return SimpleNamespace(start=compiling, stop=lambda: stopped.append(True), alive=False, loop=loop, error=None)

    monkeypatch.setattr(realtime_process, "RealtimeProcess", opened)
    assert realtime_process.main(["--rig", str(SIMULATED_RIG)]) == 0
    assert compiling.began and not compiling.ended and stopped == [True]


def test_the_realtime_process_while_it_waits_for_the_boards_port(
    compiling: Compiling, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(realtime_process, "RealtimeProcess", lambda rig, **ports: compiling())
    assert realtime_process.main(["--rig", str(SIMULATED_RIG)]) == 0
    assert compiling.began and not compiling.ended


@pytest.mark.parametrize("part", ["load_estimator", "rehearse"])
def test_the_model_process(part: str, compiling: Compiling, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(model_process, part, compiling)
    monkeypatch.setattr(model_process, "Session", SimpleNamespace(hub=lambda rig: pytest.fail("a session was opened")))
    assert model_process.main([str(SIMULATED_RIG)]) == 0
    assert compiling.began and not compiling.ended


def test_the_live_diagnosis(compiling: Compiling, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attach, "warm_up", compiling)
    monkeypatch.setattr(attach, "Session", SimpleNamespace(of_rig=lambda rig: pytest.fail("a session was opened")))
    monkeypatch.setattr(os, "nice", lambda by: 0)
    attach.attach(SIMULATED_RIG, lambda line: None, lambda alarm: None)
    assert compiling.began and not compiling.ended


def test_the_page_compiles_before_its_server_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """A server ends only after its first frame; outside it Ctrl-C ends the compiling at once."""
    order: list[str] = []
    server = SimpleNamespace(serve=lambda: order.append("server"))
    monkeypatch.setattr(serve, "ViewServer", lambda source, port: server)
    monkeypatch.setattr(serve, "check_port", lambda port: None)
    source: Any = SimpleNamespace(frame=lambda: order.append("frame"))
    serve.serve(source, 8447, "rig", lambda line: order.append("address"))
    assert order == ["frame", "address", "server"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_second_ctrl_c_leaves_no_process_behind(number: signal.Signals, tmp_path: Path) -> None:
    fleet = wall_clock.Fleet(DemoSettings(), tmp_path / "none.mcap")
    stubborn = "import signal, time; signal.signal(signal.SIGTERM, lambda *_: None); print(1, flush=True); time.sleep(600)"
    child = subprocess.Popen([sys.executable, "-c", stubborn], stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None and child.stdout.readline()
    fleet.processes["host"] = child
    communicate = child.communicate
    signal.signal(number, signal.default_int_handler)

    def interrupted(timeout: float | None = None) -> tuple[str, str]:
        os.kill(os.getpid(), number)  # the operator is impatient
        return communicate(timeout=None if timeout is None else 0.2)

    child.communicate = interrupted  # type: ignore[method-assign,assignment]
    with contextlib.suppress(KeyboardInterrupt):
        fleet.close()
    left, _ = child.poll(), child.kill()
    assert left == -signal.SIGKILL and not Path(fleet.rig_file).parent.exists()


def test_a_process_of_the_simulated_rig_that_ends_by_itself_is_said_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A model process that was killed left `view` without a word, and without a recording."""
    fleet: Any = SimpleNamespace(dead=lambda: ["host"], last_log_line=lambda name: "Killed")
    monkeypatch.setattr(serve, "WATCH_S", 0.01)
    lines: list[str] = []
    with serve._watched(fleet, lines.append):
        until(lambda: bool(lines), "the line")
        time.sleep(0.05)
    assert lines == ["the model process, which records, has ended by itself (Killed); Ctrl-C, then start again"]
