"""Benchmarks of the control loop's kernels: the whole tick in contact, and the tip's predictor."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from numba import njit
from numpy.typing import NDArray

from host.studies.benchmarks.runner import PairedTimes, Report, Row, alternate, row_of
from protocol.enums import CommandKind, Phase
from protocol.rig_file import SIMULATED_RIG, load_rig
from realtime.control import predictor
from realtime.control.configure import tick_parameters
from realtime.control.records import INPUTS, OUTPUTS, POSE, PREDICTOR_PARAMS, PREDICTOR_STATE, STATE, new
from realtime.control.tick import tick

Array = NDArray[np.float64]

RIG = SIMULATED_RIG
START_NS, PERIOD_NS, POSE_NS = 1_000_000_000, 1_000_000, 25_000_000
READINGS = 40
APPROACH_TICKS, TICKS = 600, 50  # before the clock runs; in one reading of it
POSES = 200
NOISE_m = 0.29e-3


@njit(cache=True)
def _feed(inputs: Any, force: Any, count: int) -> None:
    """Advance by `count` periods: a fresh force and board status at every one, a fresh pose at 40 Hz."""
    inputs.now_ns += PERIOD_NS
    if count % (POSE_NS // PERIOD_NS) == 0:
        inputs.tip.count += 1
        inputs.tip.stamp_ns, inputs.tip.arrival_ns = inputs.now_ns - POSE_NS, inputs.now_ns
    inputs.sensor.count += 1
    inputs.sensor.arrival_ns = inputs.now_ns
    for i in range(3):
        inputs.sensor.force_N[i] = force[i]
    inputs.board.arrival_ns = inputs.now_ns


@njit(cache=True)
def _ticks(params: Any, state: Any, inputs: Any, outputs: Any, force: Any, first: int, count: int) -> None:
    for i in range(first, first + count):
        _feed(inputs[0], force, i)
        tick(params, state, inputs, outputs)


class BenchedLoop:
    """A tick with hand-fed inputs, brought into contact; `run` makes some periods pass."""

    def __init__(self, run: Callable[..., None]) -> None:
        self.params, self.state = tick_parameters(load_rig(RIG)), new(STATE)
        self.inputs, self.outputs = new(INPUTS), new(OUTPUTS)
        self.force, self.passed, self._run = np.zeros(3), 0, run
        u = self.inputs[0]
        u.now_ns, u.board.ready = START_NS, 1
        u.command.normal[:] = (0.0, 0.0, -1.0)
        u.tip.position_m[:], u.tip.quaternion_wxyz[:] = (0.0, -0.006, 0.034), (1.0, 0.0, 0.0, 0.0)
        self.run(APPROACH_TICKS // 3)
        u.command.count, u.command.armed = 1, 1
        self.run(APPROACH_TICKS // 3)
        u.command.count, u.command.kind, u.command.force_N = 2, CommandKind.CONTACT, 0.2
        u.command.target_m[:] = (0.0, -0.006, 0.040)
        self.force[2] = 0.15
        self.run(APPROACH_TICKS // 3)

    def run(self, count: int) -> None:
        """Run `count` periods of the loop."""
        self._run(self.params, self.state, self.inputs, self.outputs, self.force, self.passed, count)
        self.passed += count


def plain_tick() -> Callable[..., None]:
    """`realtime.control.tick` once more, as plain Python: its modules loaded afresh with the compiler switched off."""
    names = [name for name in sys.modules if name == "realtime" or name.startswith("realtime.")]
    kept = {name: sys.modules.pop(name) for name in names}
    settings: Any = numba.config
    switch, settings.DISABLE_JIT = settings.DISABLE_JIT, True
    try:
        function: Callable[..., None] = importlib.import_module("realtime.control.tick").tick
    finally:
        settings.DISABLE_JIT = switch
        for name in [name for name in sys.modules if name == "realtime" or name.startswith("realtime.")]:
            del sys.modules[name]
        sys.modules.update(kept)
    return function


def control_tick(seed: int, _report: Report) -> list[Row]:
    """One period in contact, poses, force and board status coming in, compared with the same code as plain Python."""
    plain = plain_tick()

    def plain_ticks(params: Any, state: Any, inputs: Any, outputs: Any, force: Array, first: int, count: int) -> None:
        for i in range(first, first + count):
            _feed.py_func(inputs[0], force, i)  # type: ignore[attr-defined]
            plain(params, state, inputs, outputs)

    ours, peer = BenchedLoop(_ticks), BenchedLoop(plain_ticks)
    phases = [int(loop.outputs[0].phase) for loop in (ours, peer)]
    assert phases == [Phase.CONTACT, Phase.CONTACT], phases
    apart = float(np.abs(ours.outputs[0].joint - peer.outputs[0].joint).max())
    timed: PairedTimes = alternate([ours.run] * READINGS, [lambda: peer.run(TICKS)] * READINGS)
    timed.peer_s = [seconds / TICKS for seconds in timed.peer_s]
    return [row_of("control_tick", "in contact", "the same as plain Python", timed, seed, joint_difference=apart)]


@njit(cache=True)
def _filter(config: Any, state: Any, poses: Any, out: Any, repeats: int) -> None:
    """`repeats` poses taken in and predicted one pose period ahead: what the tick does with each."""
    state[0].started, state[0].seen = 0, 0
    for i in range(repeats):
        pose = poses[i % poses.shape[0]]
        pose.count = i + 1
        pose.stamp_ns = (i + 1) * POSE_NS
        predictor.apply(config[0], state[0], pose)
        predictor.predict(state[0], pose.stamp_ns + POSE_NS, out)


class TextbookFilter:
    """The same filter as a textbook writes it: six states, matrices, numpy."""

    def __init__(self, config: Any) -> None:
        dt, one = POSE_NS * 1e-9, np.eye(3)
        self.F = np.block([[one, dt * one], [0.0 * one, one]])
        self.H = np.hstack([one, 0.0 * one])
        q = config.acceleration_noise_m_per_s2**2
        self.Q = q * np.block([[dt**3 / 3.0 * one, dt**2 / 2.0 * one], [dt**2 / 2.0 * one, dt * one]])
        self.R = config.position_noise_m**2 * one
        self.P = np.diag([config.position_noise_m**2] * 3 + [config.max_speed_m_per_s**2] * 3)
        self.x: Array | None = None

    def step(self, position: Array) -> Array:
        """Tip position (3,) one pose period after this one."""
        if self.x is None:
            self.x = np.append(position, np.zeros(3))
        else:
            x, P = self.F @ self.x, self.F @ self.P @ self.F.T + self.Q
            K = P @ self.H.T @ np.linalg.inv(self.H @ P @ self.H.T + self.R)
            self.x, self.P = x + K @ (position - self.H @ x), (np.eye(6) - K @ self.H) @ P
        return np.asarray((self.F @ self.x)[:3])


def kalman_predict(seed: int, _report: Report) -> list[Row]:
    """A pose taken in and the tip predicted 25 ms ahead, compared with the textbook's matrices in numpy."""
    config = new(PREDICTOR_PARAMS)
    config[0] = tick_parameters(load_rig(RIG))[0].predictor
    poses = np.recarray(POSES, dtype=POSE)
    poses[:] = new(POSE)[0]
    t = np.arange(POSES)[:, None] * POSE_NS * 1e-9
    beat = 1e-3 * np.sin(4.0 * np.pi * t) * np.array([0.0, 0.3, 1.0]) + np.array([0.0, -0.006, 0.034])
    poses.position_m[:] = beat + NOISE_m * np.random.default_rng(seed).normal(size=(POSES, 3))
    poses.quaternion_wxyz[:] = (1.0, 0.0, 0.0, 0.0)
    state, out, theirs = new(PREDICTOR_STATE), np.empty(3), np.empty(3)

    def ours(repeats: int) -> None:
        _filter(config, state, poses, out, repeats)

    def peer() -> None:
        textbook = TextbookFilter(config[0])
        for position in poses.position_m:
            theirs[:] = textbook.step(position)

    ours(POSES)
    peer()
    apart = float(np.abs(out - theirs).max())
    timed: PairedTimes = alternate([ours] * READINGS, [peer] * READINGS)
    timed.peer_s = [seconds / POSES for seconds in timed.peer_s]
    return [row_of("kalman_predict", "", "textbook matrices in numpy", timed, seed, position_difference_m=apart)]
