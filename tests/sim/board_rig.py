"""A host and a world around a simulated board, for tests: link, edges, encoders that follow the steps."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
import pytest

from protocol.board_pins import Build
from realtime.drivers.stepper_board import AxisLimits, BoardEventKind, BoardStatus, LinkPhase, StepperBoardLink
from sim.board import USUAL_BUILD, BoardSlice, SimulatedBoard

LIMITS = (
    AxisLimits(16_000, 640_000, -(10**6), 10**6),
    AxisLimits(12_223, 244_462, -(10**6), 10**6),
    AxisLimits(12_223, 244_462, -(10**6), 10**6),
)
LEAD_US = 3000
MILLISECOND_US = 1000

EVERY_BOARD = (
    pytest.param(("native", "atmega2560"), id="native"),
    pytest.param(("avr", "atmega2560"), id="atmega2560", marks=pytest.mark.avr),
    pytest.param(("avr", "atmega328p"), id="atmega328p", marks=pytest.mark.avr),
)


class BoardRig:
    """Runs a Board in slices of 1 ms with a StepperBoardLink on its UART."""

    def __init__(self, kind: str, mcu: str = "atmega2560", build: Build = USUAL_BUILD) -> None:
        self.board = SimulatedBoard(kind, mcu, build)
        self.link = StepperBoardLink(LIMITS)
        self.time_us = 0
        self.position = np.zeros(3, np.int64)  # by the edges
        self.edge_us: list[list[int]] = [[], [], []]
        self.events: list[str] = []
        self.inputs: dict[str, Any] = {}
        self.number = 0
        self.accepted: set[int] = set()
        self.last: BoardSlice | None = None
        self._digest = hashlib.sha256()

    def slice(self, data: bytes = b"", slice_us: int = MILLISECOND_US) -> BoardSlice:
        self.time_us += slice_us
        result = self.board.exchange(self.time_us, data, encoder_counts=self.position, **self.inputs)
        for axis in range(3):
            mine = result.edge_axis == axis
            self.position[axis] += int(result.edge_sign[mine].sum())
            self.edge_us[axis] += result.edge_time_us[mine].tolist()
        for array in (result.edge_cycle, result.edge_axis, result.edge_sign):
            self._digest.update(array.tobytes())
        self._digest.update(result.uart_out)
        for piece, done_us in result.timed_frames():
            self._take(piece, done_us * 1000)
        self.last = result
        return result

    def _take(self, piece: bytes, arrival_ns: int) -> None:
        for event in self.link.feed(piece, arrival_ns):
            if event.kind is not BoardEventKind.STATUS:
                self.events.append(event.message)
            elif self.link.status is not None:
                self.accepted.add(self.link.status.last_setpoint)

    def run_ms(self, milliseconds: int, data: bytes = b"") -> None:
        for _ in range(milliseconds):
            self.slice(data)
            data = b""

    @property
    def now_ns(self) -> int:
        return self.time_us * 1000

    @property
    def status(self) -> BoardStatus:
        assert self.link.status is not None
        return self.link.status

    @property
    def digest(self) -> str:
        return self._digest.hexdigest()

    def bring_up(self) -> None:
        for _ in range(400):
            self.slice(self.link.advance(self.now_ns))
            if self.link.phase is LinkPhase.READY:
                return
        raise AssertionError(f"board not ready: {self.events}")

    def arm(self) -> None:
        self.run_ms(8, self.link.arm())
        assert self.link.armed, self.events

    def setpoint(self, position: np.ndarray, lead_us: int = LEAD_US, expiry_us: int = 5000) -> bytes:
        self.number += 1
        execute_us = self.link.clock.to_mcu_us(self.now_ns, self.now_ns) + lead_us
        return self.link.setpoint(self.number, execute_us, expiry_us, position)

    def follow(self, path: np.ndarray, traffic: bool = False) -> None:
        """One set-point a ms along path (n, 3), then 10 ms of rest at its end."""
        for i, position in enumerate(np.vstack([path, np.repeat(path[-1:], 10, axis=0)])):
            data = self.setpoint(position)
            if traffic and i % 3 == 0:
                data += self.link.ping()
            self.slice(data)

    def close(self) -> None:
        self.board.close()


def ramped_moves(n_moves: int, seed: int, top_steps_per_ms: tuple[float, float, float] = (15.0, 11.5, 11.5)) -> np.ndarray:
    """Path (n, 3) in steps, a row a ms: moves with random speeds of up to the top, each accelerated and braked."""
    rng = np.random.default_rng(seed)
    speeds = []
    for _ in range(n_moves):
        n = int(rng.integers(4, 24))
        shape = np.minimum(1.0, np.minimum(np.arange(1, n + 1), np.arange(n, 0, -1)) / 4)
        speeds.append(shape[:, None] * rng.uniform(-1, 1, 3) * np.array(top_steps_per_ms))
    return np.round(np.cumsum(np.vstack(speeds), axis=0)).astype(np.int64)
