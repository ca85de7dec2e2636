"""Sweeps on a rig's ports: the same bytes as in lock step; what is missing, held or in the way keeps the stages still."""

import os
import subprocess
import sys
import tty
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from host.commissioning.characterization import record_simulated, standard_sweeps
from host.commissioning.rig_sweeps import describe, duration_s
from host.recordings.recording import RecordingFile
from protocol.errors import InputError
from protocol.rig_file import SIMULATED_RIG, Rig, load_rig, parse_rig, read_rig_data
from protocol.topics import Message
from realtime.core.lines import FromRig, ToRig
from realtime.core.sweep import Sweep, SweepLoop
from realtime.core.sweep_ports import RigPorts, check_served, run_sweeps
from sim.board import SimulatedBoard
from sim.tissue import TissueConfig
from sim.world import World, simulated_plant

SHORT = [Sweep(0, (0.006, 0.0, 0.0), 0.004, 1.5, 1)]
FREE = TissueConfig(point_m=(0.0, 0.0, 10.0))


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig(SIMULATED_RIG)


class WorldPorts:
    """A world as the ports and the clock of a rig: what is sent goes in, time runs, what arrives by then comes out."""

    def __init__(self, world: World) -> None:
        self.world, self.mute = world, ""
        self._leaving, self._arriving = ToRig(), FromRig()

    def now_ns(self) -> int:
        return self.world.now_ns

    def sleep_until(self, deadline_ns: int) -> bool:
        self._arriving = self.world.exchange(deadline_ns, self._leaving)
        return True

    def send(self, leaving: ToRig) -> None:
        self._leaving = leaving

    def receive(self) -> FromRig:
        if self.mute:
            setattr(self._arriving, self.mute, [] if self.mute == "force" else b"")
        return self._arriving


class Bench:
    """Sweeps over `WorldPorts`, until `stop` or the end."""

    def __init__(self, rig: Rig, wall: TissueConfig = FREE) -> None:
        self.heard: list[str] = []
        self.board = SimulatedBoard("native")
        self.world = World(rig, simulated_plant(rig, 1, tissue=wall), self.board, 1)
        self.ports, self.loop = WorldPorts(self.world), SweepLoop(rig, SHORT, self._publish)

    def _publish(self, topic: str, message: Message) -> None:
        self.heard.append(topic)

    def run(self, **options: object) -> None:
        run_sweeps(self.loop, self.ports, self.ports, **options)  # type: ignore[arg-type]
        arriving = self.world.exchange(self.world.now_ns + 200_000_000, self.ports._leaving)
        self.loop.link.feed(arriving.board, self.world.now_ns)
        self.board.close()

    @property
    def still(self) -> bool:
        """Whether no pulse left the board."""
        return not self.world.edges.any()


def test_the_same_bytes_as_in_lock_step(rig: Rig, tmp_path: Path) -> None:
    bench = Bench(rig)
    bench.run()
    assert bench.loop.finished and not bench.loop.problem
    other = RecordingFile(record_simulated(rig, SHORT, tmp_path / "lock.mcap", 1, "native"))
    assert bench.heard.count("stage") == pytest.approx(len(other.table("stage")["stamp_ns"]), abs=2)
    assert bench.heard.count("pose/tip") == len(other.table("pose/tip")["stamp_ns"])
    assert bench.world.edges[0] > 2 * 0.008 * rig.stages.insertion.steps_per_unit


@pytest.mark.parametrize("device", ["tracker", "force", "board"])
def test_a_device_that_never_answers_keeps_the_stages_still(rig: Rig, device: str) -> None:
    bench = Bench(rig)
    bench.ports.mute = device
    bench.run()
    assert bench.still and "wanted all ready" in bench.loop.problem


@pytest.mark.parametrize("device", ["tracker", "force", "board"])
def test_a_device_that_falls_silent_ends_the_sweeps_at_rest(rig: Rig, device: str) -> None:
    bench, steps = Bench(rig), []

    def each() -> None:
        steps.append(bench.world.steps[0])
        if bench.world.now_ns > 2_500_000_000:
            bench.ports.mute = device

    bench.run(each=each)
    assert "found no data for" in bench.loop.problem and not bench.loop.finished
    assert 0 < bench.world.edges[0]
    at_rest = bench.world.steps.copy()
    assert abs(at_rest[0] - steps[-1]) < 0.0005 * rig.stages.insertion.steps_per_unit


def test_a_wish_to_stop_brakes_and_disarms(rig: Rig) -> None:
    bench = Bench(rig)
    bench.run(stop=lambda: bench.world.now_ns > 2_000_000_000)
    assert bench.loop.problem.startswith("operator") and not bench.loop.link.armed


def test_a_computer_that_stood_still_is_blamed_itself(rig: Rig) -> None:
    bench = Bench(rig)
    turns = iter(range(10_000_000))

    def pause_once() -> None:
        if bench.loop.link.armed and next(turns) == 500:
            bench.ports.sleep_until(bench.world.now_ns + 700_000_000)

    bench.run(each=pause_once)
    assert bench.loop.problem.startswith("computer: found that the loop of the sweeps stalled for 0.7")
    assert not bench.loop.finished


def test_an_emergency_stop_ends_the_sweeps(rig: Rig) -> None:
    bench = Bench(rig)

    def each() -> None:
        bench.world.estop = bench.world.now_ns > 2_000_000_000

    bench.run(each=each)
    assert bench.loop.problem and not bench.loop.finished and not bench.loop.link.armed


def test_a_rig_that_is_pressed_on_does_not_begin(rig: Rig) -> None:
    bench = Bench(rig)
    push = bench.world.plant.measured_wrench
    bench.world.plant.measured_wrench = lambda: (np.array([0.0, 0.0, 0.8]), push()[1])  # type: ignore[method-assign]
    bench.run()
    assert bench.still and "wanted free space" in bench.loop.problem


def test_what_will_move_is_said_before(rig: Rig) -> None:
    sweeps = standard_sweeps(rig)
    words = describe(sweeps)
    assert "knob -95 to 95 deg" in words and "roll -60 to 60 deg" in words
    assert duration_s(SHORT) == pytest.approx(0.6 + 0.5 + SHORT[0].seconds)
    assert duration_s(sweeps) > sum(sweep.seconds for sweep in sweeps)


@pytest.fixture
def lines() -> Iterator[tuple[str, str]]:
    """Two ptys that nobody answers at."""
    ends = [os.openpty() for _ in range(2)]
    for _, end in ends:
        tty.setraw(end)
    yield os.ttyname(ends[0][1]), os.ttyname(ends[1][1])
    for pair in ends:
        for descriptor in pair:
            os.close(descriptor)


def test_a_port_that_is_held_is_refused(rig: Rig, lines: tuple[str, str]) -> None:
    with RigPorts(rig, *lines), pytest.raises(OSError, match=r"board\.port: found .* wanted a device that no other process"):
        RigPorts(rig, *lines)


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        (["--real"], 2, "--yes: found nothing, wanted a terminal, or --yes"),
        (["--real", "--yes"], 1, "board.port: found pty:board that does not open"),
        (["--real", "--recording", "x.mcap"], 2, '--real: found "with --recording"'),
        (["--real", "--yes", "--force-port", "0"], 2, "--force-port: found 0"),
    ],
)
def test_bad_requests_for_a_real_rig(arguments: list[str], status: int, words: str, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "host.cli.main", "characterize", "--out", str(tmp_path), *arguments],
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
        timeout=60,
    )
    assert done.returncode == status and words in done.stderr and "Traceback" not in done.stderr
    assert "Errno" not in done.stderr and not list(tmp_path.glob("*.mcap"))


@pytest.mark.parametrize(("section", "was", "kind"), [("tracker", "aurora", "mine"), ("force_sensor", "net_ft", "mine")])
def test_sweeps_with_a_device_that_they_cannot_read_move_nothing(section: str, was: str, kind: str, tmp_path: Path) -> None:
    """The sweeps would send the bytes of an Aurora to whatever has the plug-in's port."""
    data = read_rig_data(SIMULATED_RIG)
    data[section]["kind"] = kind
    check_served(load_rig(SIMULATED_RIG))
    with pytest.raises(InputError, match=rf"^{section}\.kind: found \"{kind}\", wanted {was}, .*nothing has moved"):
        check_served(parse_rig(data))
