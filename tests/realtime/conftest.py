"""A rig and a tick ready to run."""

import numpy as np
import pytest

from protocol.rig_file import SIMULATED_RIG, Rig, load_rig
from realtime.control.configure import tick_parameters
from realtime.control.records import INPUTS, OUTPUTS, STATE, new

RIG_FILE = SIMULATED_RIG
START_NS = 1_000_000_000


@pytest.fixture(scope="session")
def rig() -> Rig:
    return load_rig(RIG_FILE)


class Bench:
    """The tick with hand-fed inputs: fresh pose at 40 Hz, fresh force and board status at every tick, unless withheld."""

    def __init__(self, rig: Rig) -> None:
        self.params, self.state = tick_parameters(rig), new(STATE)
        self.inputs, self.outputs = new(INPUTS), new(OUTPUTS)
        self.now_ns = START_NS
        self.tip = np.array([0.0, -0.006, 0.034])
        self.force = np.zeros(3)
        self.with_pose = self.with_force = self.with_board = True
        u = self.inputs[0]
        u.board.ready = 1
        u.command.normal[:] = (0.0, 0.0, -1.0)

    def command(self, kind: int, **fields: object) -> None:
        command = self.inputs[0].command
        command.count += 1
        command.kind, command.armed = kind, 1
        for name, value in fields.items():
            command[name] = value

    def run(self, seconds: float) -> np.record:
        from realtime.control.tick import tick

        u = self.inputs[0]
        for _ in range(round(seconds * 1000)):
            self.now_ns += 1_000_000
            u.now_ns = self.now_ns
            if self.with_pose and (self.now_ns // 1_000_000) % 25 == 0:
                u.tip.count += 1
                u.tip.stamp_ns, u.tip.arrival_ns = self.now_ns - 25_000_000, self.now_ns
                u.tip.position_m[:] = self.tip
                u.tip.quaternion_wxyz[:] = (1.0, 0.0, 0.0, 0.0)
            if self.with_force:
                u.sensor.count += 1
                u.sensor.arrival_ns = self.now_ns
                u.sensor.force_N[:] = self.force
            if self.with_board:
                u.board.arrival_ns = self.now_ns
            tick(self.params, self.state, self.inputs, self.outputs)
        return self.outputs[0]


@pytest.fixture
def bench(rig: Rig) -> Bench:
    return Bench(rig)
