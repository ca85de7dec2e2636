"""The demo on the wall clock: simulated rig, realtime and model process as processes, and an operator in this one."""

from __future__ import annotations

import contextlib
import json
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from host.recordings.writer import new_recording_path
from host.run.commander import Commander
from host.run.demo import DemoRun, DemoSettings, Progress
from protocol import compile_notice
from protocol.local_paths import LocalPaths, listens
from protocol.rig_file import load_rig
from protocol.text_files import read_text
from protocol.topics import LoopTiming, RigState
from protocol.zenoh_session import Session
from realtime.core.device_sources import check_kinds
from sim.scenario import TARGET_M, ContactJob, Outcome

_BEFORE_S = 6.0  # to come before the tissue
_TOUCH_TIMEOUT_S = 60.0  # for all attempts to touch it
_START_TIMEOUT_S = 120.0  # a first start compiles the loop, on a machine that may be busy
# For each to end of itself, on a machine that may be busy. A recorder that is killed leaves a truncated recording.
_STOP_TIMEOUT_S = {"realtime": 20.0, "host": 60.0, "rig": 20.0}


class Fleet:
    """The three processes. Use as a context: leaving it stops everything in order.

    loop: with the realtime process; without it the caller runs the loop, on `ports`. own_folder: use the folder of the rig
    file, so that commands find the rig without being told, unless a rig runs there; otherwise a folder of its own, so that
    fleets do not meet. endpoint: where it listens.
    """

    def __init__(self, settings: DemoSettings, recording: Path, loop: bool = True, own_folder: bool = False) -> None:
        self._settings, self._recording, self._loop = settings, recording, loop
        self.ports: dict[str, Any] = {}
        self._folder = tempfile.TemporaryDirectory(prefix="seldinger-")
        self.rig_file = Path(self._folder.name) / "rig.toml"
        own = load_rig(settings.rig_file).local
        self._sockets = own if own_folder and not _in_use(own) else LocalPaths(Path(self._folder.name))
        self.endpoint = self._sockets.endpoint
        self.processes: dict[str, subprocess.Popen[str]] = {}
        self.rig_summary: dict[str, Any] = {}

    def __enter__(self) -> Fleet:
        try:
            self._start()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _start(self) -> None:
        check_kinds(load_rig(self._settings.rig_file))
        text = read_text(self._settings.rig_file)
        self.rig_file.write_text(with_folder(text, self._sockets.folder), encoding="utf-8")
        rig = str(self.rig_file)
        planted = [word for text in self._settings.effects for word in ("--effect", text)]
        self.ports = ports = json.loads(
            self._spawn(
                "rig",
                "sim.rig_server",
                "--rig",
                rig,
                "--board",
                self._settings.board,
                "--seed",
                str(self._settings.seed),
                "--commands",
                *planted,
                commands=True,
            )
        )
        print(f"watch with: seldinger diagnose --live --rig {rig}", file=sys.stderr, flush=True)
        self._spawn(
            "host",
            "host.run.model_process",
            rig,
            "--record",
            str(self._recording),
            "--estimator",
            self._settings.estimator,
            "--seed",
            str(self._settings.seed),
        )
        if self._loop:
            self._spawn(
                "realtime",
                "realtime",
                "--rig",
                rig,
                "--board-port",
                ports["board"],
                "--tracker-port",
                ports["tracker"],
                "--force-port",
                str(ports["force_port"]),
                "--force-source",
                self._settings.force_source,
                answers=False,
            )

    def send_line(self, line: str) -> None:
        """Send a line to the simulated rig: `unplug board`, `unplug tracker` or `mark NAME` (`sim.rig_server`)."""
        commands = self.processes["rig"].stdin
        assert commands is not None
        commands.write(f"{line}\n")
        commands.flush()

    def _spawn(self, name: str, module: str, *arguments: str, answers: bool = True, commands: bool = False) -> str:
        log = open(Path(self._folder.name) / f"{name}.log", "w", encoding="utf-8")
        process = subprocess.Popen(
            [sys.executable, "-m", module, *arguments],
            stdin=subprocess.PIPE if commands else subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            # Ctrl-C ends this process alone, which then ends the others one after another: sessions that close at once, the
            # one that listens among them, can end with a panic of zenoh's router.
            process_group=0,
        )
        self.processes[name] = process
        assert process.stdout is not None
        line = process.stdout.readline() if answers else ""
        if line and "compiling" in json.loads(line):
            print(compile_notice.WORDS, file=sys.stderr, flush=True)
            line = process.stdout.readline()
        if answers and not line:
            process.wait()
            raise OSError(f"{name}: found that it ended at its start, wanted it to run: {self.last_log_line(name)}")
        return line

    def wait_for_state(self, seconds: float = _START_TIMEOUT_S) -> None:
        """Wait for the loop's first state. Raises OSError where a process ends, or none comes in time."""
        rig, until = load_rig(self.rig_file), time.monotonic() + seconds
        with Session.of_rig(rig) as session:
            states = session.latest("state")
            while states.take() is None:
                if self.dead():
                    raise OSError(
                        f"{self.dead()[0]}: found that it ended at its start, wanted it to run: "
                        f"{self.last_log_line(self.dead()[0])}"
                    )
                if time.monotonic() > until:
                    raise OSError(
                        f"realtime: found no state after {seconds:g} s, wanted one: {self.last_log_line('realtime')}"
                    )
                time.sleep(0.02)

    def last_log_line(self, name: str) -> str:
        """Return the last line of the log of process `name`."""
        lines = (Path(self._folder.name) / f"{name}.log").read_text(encoding="utf-8").strip().splitlines()
        return lines[-1] if lines else "no message"

    def dead(self) -> list[str]:
        """Return the names of processes that have ended."""
        return [name for name, process in self.processes.items() if process.poll() is not None]

    def close(self) -> None:
        """End the processes: realtime first (it disarms), then the recorder, then the rig."""
        with _undisturbed():
            self._end_processes()
        self._folder.cleanup()

    def _end_processes(self) -> None:
        for name, timeout_s in _STOP_TIMEOUT_S.items():
            process = self.processes.get(name)
            if process is None:
                continue
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
            try:
                out, _ = process.communicate(timeout=timeout_s)
            except subprocess.TimeoutExpired:
                process.kill()
                out, _ = process.communicate()
            if name == "rig" and out.strip():
                self.rig_summary = json.loads(out.strip().splitlines()[-1])


class Operator:
    """An operator over zenoh: gives commands and reads the rig's state."""

    def __init__(self, fleet: Fleet) -> None:
        rig = load_rig(fleet.rig_file)
        self._fleet, self.session = fleet, Session.of_rig(rig)
        self.commander = Commander(self.session, "demo")
        self._states, self._loops = self.session.latest("state"), self.session.latest("loop")
        self.state: RigState | None = None
        self.timing: LoopTiming | None = None
        self.causes: list[str] = []

    def look(self) -> None:
        """Take in the newest state and timing."""
        state, timing = self._states.take(), self._loops.take()
        if isinstance(state, RigState):
            self.state = state
            if state.safety_action in ("retract", "stop") and state.cause not in self.causes:
                self.causes.append(state.cause)
        if isinstance(timing, LoopTiming):
            self.timing = timing

    def wait(self, seconds: float, done: Callable[[], bool], each: Callable[[float], None] = lambda share: None) -> bool:
        """Look every 10 ms until `done`, a process has died, or `seconds` are over."""
        begin = time.monotonic()
        while time.monotonic() - begin < seconds and not self._fleet.dead():
            self.look()
            each((time.monotonic() - begin) / seconds)
            if done():
                return True
            time.sleep(0.01)
        return False

    def arm(self, each: Callable[[float], None] = lambda share: None) -> bool:
        """Arm when the devices are there. What a stall latched before anything moved is cleared, and arming tried again."""

        def armed() -> bool:
            time.sleep(0.1)
            if not self.commander.take().accepted:
                return False
            if self.commander.arm().accepted and self.wait(3.0, lambda: self.mode() == "hold"):
                return True
            self.commander.clear_fault()
            return False

        return self.wait(_START_TIMEOUT_S, armed, each)

    def touch(self, job: ContactJob, seconds: float, each: Callable[[str, float], None] = lambda part, share: None) -> bool:
        """Arm, go before the tissue, press, until the rig says that it is in contact.

        Tried again while nothing was touched and `seconds` are not over: where the machine stands still for a moment,
        the board's dead-man switch stops the rig, and the next command finds it disarmed.
        """
        until = time.monotonic() + seconds
        before = np.array(job.target_m) - job.clearance_m * np.array(job.into)

        def there() -> bool:
            return self.stands() or bool(
                self.state and self.state.tip_m and np.linalg.norm(np.array(self.state.tip_m) - before) < 5e-4
            )

        while time.monotonic() < until:
            if not self.arm(lambda share: each("start", share)):
                continue
            self.commander.target(tuple(map(float, before)))
            self.wait(_BEFORE_S, there)
            if self.commander.press(job.target_m, job.into, job.force_N).accepted:
                self.wait(
                    job.approach_s, lambda: self.mode() == "contact" or self.stands(), lambda share: each("approach", share)
                )
                if not self.stands():
                    return self.mode() == "contact"
            self.commander.clear_fault()
        return False

    def stands(self) -> bool:
        """Return whether the rig is stopped or disarmed."""
        return self.mode() in ("stopped", "disarmed")

    def mode(self) -> str:
        """Return the loop's phase, empty before the first message."""
        return self.state.mode if self.state else ""


def run_wall_clock(settings: DemoSettings, progress: Progress) -> DemoRun:
    """The job of `run_lockstep` with processes, ptys and CLOCK_MONOTONIC. Raises as that does, and OSError."""
    path = new_recording_path(settings.directory, "demo-wall-clock")
    run = DemoRun(path, Outcome(), settings.board)
    with Fleet(settings, path) as fleet:
        print(f"topics at {fleet.endpoint}", file=sys.stderr)
        operator = Operator(fleet)
        try:
            _press(operator, run.outcome, ContactJob(TARGET_M, force_N=settings.force_N, hold_s=settings.hold_s), progress)
        except KeyboardInterrupt:
            run.interrupted = "SIGINT"
        operator.look()
        timing = operator.timing
        run.outcome.notes += [f"{name} ended: {fleet.last_log_line(name)}" for name in fleet.dead()] + operator.causes
        operator.commander.close()
        operator.session.close()
    run.counts = {
        "tick_us": None
        if timing is None
        else {"p50": timing.tick_p50_us, "p99": timing.tick_p99_us, "p999": timing.tick_p999_us, "max": timing.tick_max_us},
        "missed_ticks": 0 if timing is None else timing.missed_ticks,
        "faults": operator.causes,
        "longest_gap_ms": None if timing is None else timing.longest_gap_ns * 1e-6,
        "longest_gap_where": "" if timing is None else timing.longest_gap_where,
        "rig": fleet.rig_summary,
    }
    run.board_kind = str(fleet.rig_summary.get("board", settings.board))
    return run


def _press(operator: Operator, outcome: Outcome, job: ContactJob, progress: Progress) -> None:
    def force() -> float:
        return operator.state.force_N or 0.0 if operator.state else 0.0

    outcome.contact = operator.touch(job, _TOUCH_TIMEOUT_S, lambda part, share: progress(part, share, force()))
    if outcome.contact:
        operator.wait(job.hold_s, lambda: operator.mode() == "stopped", lambda share: progress("hold", share, force()))
    else:
        outcome.notes.append(f"no contact; the phase of the rig is {operator.mode() or 'unknown'}")
    outcome.stopped = operator.mode() == "stopped"
    operator.commander.retract()
    operator.wait(2.0, lambda: operator.mode() == "stopped", lambda share: progress("retract", share, force()))
    operator.commander.disarm()


@contextlib.contextmanager
def _undisturbed() -> Iterator[None]:
    """Ignore a second Ctrl-C: processes that are not waited for would go on."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, signal.SIG_IGN) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _in_use(paths: LocalPaths) -> bool:
    """Return whether a realtime process listens in this folder; the socket of a killed process does not count."""
    return listens(paths.stop_socket)


def with_folder(text: str, folder: Path) -> str:
    """The rig file's text with a section [zenoh] that keeps its sockets in `folder`, so that two runs do not meet."""
    without = re.sub(r"^\[zenoh\].*?(?=^\[|\Z)", "", text, flags=re.M | re.S)
    return f'{without.rstrip()}\n\n[zenoh]\nfolder = "{folder}"\n'
