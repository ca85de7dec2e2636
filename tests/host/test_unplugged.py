"""A device pulled out of the armed rig and put back: found again by itself, and the rig comes back disarmed."""

from __future__ import annotations

import os
import pty
import select
import threading
import time
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest

from host.run.demo import DemoSettings
from host.run.wall_clock import Fleet
from protocol.commander import CommandSender
from protocol.enums import Phase, SafetyAction
from protocol.rig_file import load_rig
from protocol.topics import Command, Log, Message, Reply, encode
from realtime.core.process import RealtimeProcess
from realtime.drivers.stepper_board import LinkPhase
from sim.forked_board import LibraryBoard
from sim.plant import Plant, PlantConfig
from sim.scenario import Scenario
from sim.sensor_faults import SensorFault
from sim.world import World
from tests.realtime.conftest import RIG_FILE
from tests.waiting import until

pytestmark = pytest.mark.usefixtures("rig_alone")

TARGET_M = (0.0, -0.0107, 0.025)


@pytest.mark.parametrize("device", ["tracker", "force_box"])
def test_a_sensor_unplugged_in_contact_and_back_leaves_the_rig_disarmed(device: str) -> None:
    rig, logs = load_rig(RIG_FILE), list[str]()

    def publish(topic: str, message: Message) -> None:
        if isinstance(message, Log):
            logs.append(message.text)

    with LibraryBoard() as board:
        plant = Plant(PlantConfig(tool_offsets_m=(0.0, rig.tracker.shaft_sensor_offset_m)), 1)
        run = Scenario(rig, World(rig, plant, board, 1), publish)
        assert run.arm()
        run.command("target", "position", target_m=(TARGET_M[0], TARGET_M[1], TARGET_M[2] - 0.004))
        run.run(4.0)
        run.command("target", "contact", target_m=TARGET_M, normal=(0.0, 0.0, 1.0), force_N=0.2)
        assert run.run(10.0, lambda: run.phase == Phase.CONTACT)
        run.run(0.5)
        begin_ns = run.now_ns
        getattr(run.world, device).faults.append(SensorFault("silent", begin_ns, begin_ns + 1_500_000_000))
        assert run.run(0.2, lambda: run.loop.outputs[0].action >= SafetyAction.HOLD)
        run.run(1.0)
        at_rest = run.world.edges.copy()
        run.run(6.0, lambda: run.phase == Phase.DISARMED)
        assert run.phase == Phase.DISARMED and any("is back: disarmed" in text for text in logs)
        run.run(1.0)
        assert (run.world.edges == at_rest).all() and run.phase == Phase.DISARMED
        assert not run.command("target", "position", target_m=TARGET_M).accepted
        assert run.world.peak_force_N < 0.55
        assert run.command("clear_fault").accepted
        run.run(0.5)
        assert run.command("arm").accepted and run.run(1.0, lambda: run.phase == Phase.HOLD)


class Cable:
    """A serial cable between `port` and whoever opens `link`, which can be pulled out and put back."""

    def __init__(self, port: str, link: Path) -> None:
        self._port, self.link = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK), link
        self._lock, self._ending = threading.Lock(), threading.Event()
        self._far = -1
        self.plug()
        self._thread = threading.Thread(target=self._carry, daemon=True)
        self._thread.start()

    def plug(self) -> None:
        far, near = pty.openpty()
        tty.setraw(near)
        os.set_blocking(far, False)
        path = os.ttyname(near)
        self._near = near
        with self._lock:
            self._far = far
        self.link.symlink_to(path)

    def unplug(self) -> None:
        self.link.unlink()
        with self._lock:
            os.close(self._far)
            os.close(self._near)
            self._far = -1

    def close(self) -> None:
        self._ending.set()
        self._thread.join()
        os.close(self._port)

    def _carry(self) -> None:
        while not self._ending.wait(0.0005):
            with self._lock:
                ends = [self._port] + ([self._far] if self._far >= 0 else [])
                for end in select.select(ends, [], [], 0.0)[0]:
                    try:
                        data = os.read(end, 4096)
                        other = self._far if end == self._port else self._port
                        if data and other >= 0:
                            os.write(other, data)
                    except (BlockingIOError, OSError):
                        continue


class Door:
    """Commands to a process in this one, without a network between."""

    def __init__(self, process: RealtimeProcess) -> None:
        self._process = process

    def ask(self, command: Command, timeout_s: float = 1.0) -> Reply | None:
        return self._process.request(command.commander, encode(command))


@pytest.fixture
def process_and_cable(tmp_path: Path) -> Iterator[tuple[RealtimeProcess, Cable]]:
    settings = DemoSettings(board="native", directory=tmp_path, estimator="tests.host.no_estimator:make")
    with Fleet(settings, tmp_path / "unplugged.mcap", loop=False) as fleet:
        cable = Cable(fleet.ports["board"], tmp_path / "board")
        process = RealtimeProcess(
            load_rig(fleet.rig_file),
            board_port=str(cable.link),
            tracker_port=fleet.ports["tracker"],
            force_port=fleet.ports["force_port"],
        )
        process.start()
        yield process, cable
        process.stop()
        cable.close()


@pytest.mark.slow
def test_a_board_unplugged_while_armed_is_found_again_and_disarmed(process_and_cable: tuple[RealtimeProcess, Cable]) -> None:
    process, cable = process_and_cable
    commander = CommandSender(Door(process), "test")

    def armed_and_holding() -> bool:
        commander.take()
        if not commander.arm().accepted:
            commander.clear_fault()
            time.sleep(0.5)
            return False
        return until(lambda: process.core.phase == Phase.HOLD, patience_s=5.0)

    until(armed_and_holding, "the rig to be armed")
    cable.unplug()
    until(lambda: process.core.phase in (Phase.DISARMED, Phase.STOPPED), "the loop to notice")
    until(lambda: not process.core.commands.armed, "the rig to be disarmed")
    assert process.alive and not commander.arm().accepted
    cable.plug()
    until(lambda: process.core.link.status is not None, "the board to be found again")
    until(lambda: process.core.phase == Phase.DISARMED, "the loop to say that it is disarmed")
    for _ in range(20):
        time.sleep(0.02)
        assert process.core.phase == Phase.DISARMED
    assert process.core.link.phase in (LinkPhase.CONFIGURE, LinkPhase.READY)
    until(armed_and_holding, "the rig to be armed again by its operator")
    assert process.alive
