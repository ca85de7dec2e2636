"""Homing one axis: creep to its switch, which the board stops at by itself, again slowly, and call that place by its name.

No I/O: feed the link, send what `advance` returns, until `done`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from protocol.enums import BoardState
from protocol.serial_frames import AXES, Fault
from realtime.drivers.stepper_board import FAULT_ADVICE, AxisLimits, LinkPhase, StepperBoardLink

# The second touch is slow: what the switch's 2 ms of settling and the braking add is less than a step.
SLOW_STEPS_PER_S, RAMP_S = 200.0, 0.2
CLEAR_OF_SWITCH_STEPS = 200
# How far it looks, in units of the axis' whole travel.
FARTHEST = 1.2
_EVERY_NS, _LEAD_US, _EXPIRY_US = 4_000_000, 8_000, 20_000
_BRING_UP_S, _ANSWER_S = 5.0, 2.0


class HomingFailed(RuntimeError):
    """Why the axis is not homed, in one line; it is disarmed."""


@dataclass(frozen=True)
class Home:
    """What to look for. end: -1 the lower switch, 1 the upper; at_steps: position there; travel_steps: the whole travel."""

    axis: int
    end: int
    at_steps: int
    travel_steps: int
    speed_steps_per_s: float


def homing_limits(limits: tuple[AxisLimits, ...], home: Home) -> tuple[AxisLimits, ...]:
    """`limits` with the soft limits of the axis out of the way: until it is homed they mean nothing."""
    far = 4 * home.travel_steps
    return tuple(
        one._replace(soft_min_steps=-far, soft_max_steps=far) if axis == home.axis else one
        for axis, one in enumerate(limits)
    )


class Homing:
    """One run. link: made with `homing_limits`, fed by the caller. Afterwards `difference_steps` is between both touches."""

    def __init__(self, link: StepperBoardLink, home: Home) -> None:
        self._link, self._home = link, home
        self._name = AXES[home.axis]
        self._now_ns, self._number = 0, 0
        self._run = self._sequence()
        self.done = False
        self.difference_steps = 0

    def advance(self, now_ns: int) -> bytes:
        """What to send now; to be called every millisecond or so, after `link.feed`. Raises HomingFailed."""
        self._now_ns = now_ns
        if self.done:
            return b""
        try:
            return next(self._run)
        except StopIteration:
            self.done = True
            return b""

    def _sequence(self) -> Iterator[bytes]:
        home = self._home
        yield from self._until(lambda: self._link.phase is LinkPhase.READY, _BRING_UP_S, "bring-up", self._bring_up)
        ready_ns = self._now_ns
        yield from self._until(lambda: self._received_ns() > ready_ns, _ANSWER_S, "a status")
        if self._link.status is not None and self._link.status.fault != Fault.NONE:
            raise HomingFailed(f"{self._name}: found the board {self._said()}, wanted none; clear it first")
        if self._touched():
            yield from self._leave(home.speed_steps_per_s)
        yield from self._touch(home.speed_steps_per_s)
        first = self._steps()
        yield from self._leave(home.speed_steps_per_s)
        yield from self._touch(SLOW_STEPS_PER_S)
        second = self._steps()
        yield self._link.set_position(home.axis, home.at_steps)
        yield from self._until(lambda: self._steps() == home.at_steps, _ANSWER_S, "the position to be taken")
        yield from self._leave(SLOW_STEPS_PER_S)
        self.difference_steps = abs(first - second)

    def _touch(self, speed: float) -> Iterator[bytes]:
        """Towards the switch until the board has stopped at it; its fault, which is what was wanted, is cleared."""
        yield from self._move(self._home.end * speed, lambda: self._state() in (BoardState.STOPPING, BoardState.FAULT))
        yield from self._until(lambda: self._state() is BoardState.FAULT, _ANSWER_S, "the board at rest")
        fault = Fault(self._link.status.fault) if self._link.status else Fault.NONE
        if fault is not Fault.LIMIT:
            raise HomingFailed(f"{self._name}: found {fault.name}, wanted its switch: {FAULT_ADVICE[fault]}")
        touched = self._touched()
        yield self._link.clear_fault(fault)
        yield from self._until(lambda: self._state() is BoardState.DISARMED, _ANSWER_S, "the fault cleared")
        if not touched:
            raise HomingFailed(
                f"{self._name}: found another switch than the {self._end()} one, wanted that: wiring or direction?"
            )

    def _leave(self, speed: float) -> Iterator[bytes]:
        """Off the switch and some steps beyond, then disarmed and at rest."""
        left: list[int] = []

        def clear() -> bool:
            if not self._touched() and not left:
                left.append(self._steps())
            return bool(left) and abs(self._steps() - left[0]) >= CLEAR_OF_SWITCH_STEPS

        yield from self._move(-self._home.end * speed, clear)
        yield self._link.disarm()
        yield from self._until(lambda: self._state() is BoardState.DISARMED, _ANSWER_S, "rest")

    def _move(self, speed: float, reached: Callable[[], bool]) -> Iterator[bytes]:
        """Arm, and move at `speed` (steps/s, signed) until `reached`. Raises HomingFailed beyond the travel."""
        yield self._link.arm()
        yield from self._until(lambda: self._link.armed, _ANSWER_S, "the board armed")
        assert self._link.status is not None
        start, begin_ns, sent_ns = list(self._link.status.position_steps), self._now_ns, -_EVERY_NS
        while not reached():
            if self._state() not in (BoardState.ARMED, BoardState.RUNNING, BoardState.STOPPING):
                raise HomingFailed(f"{self._name}: found the board {self._said()}, wanted it to move")
            gone_s = (self._now_ns - begin_ns) * 1e-9
            gone = speed * (0.5 * gone_s**2 / RAMP_S if gone_s < RAMP_S else gone_s - 0.5 * RAMP_S)
            if abs(gone) > FARTHEST * self._home.travel_steps:
                yield self._link.disarm()
                raise HomingFailed(
                    f"{self._name}: found no change of the {self._end()} switch after {abs(gone):.0f} steps, "
                    "wanted one: wiring, motor or direction?"
                )
            if self._now_ns - sent_ns >= _EVERY_NS:
                sent_ns = self._now_ns
                self._number += 1
                position = [steps + round(gone) * (axis == self._home.axis) for axis, steps in enumerate(start)]
                execute_us = self._link.clock.to_mcu_us(self._now_ns, self._now_ns) + _LEAD_US
                yield self._link.setpoint(self._number, execute_us, _EXPIRY_US, position)
            else:
                yield b""

    def _until(
        self, condition: Callable[[], bool], seconds: float, what: str, sending: Callable[[], bytes] = lambda: b""
    ) -> Iterator[bytes]:
        begin_ns = self._now_ns
        while not condition():
            if self._now_ns - begin_ns > seconds * 1e9:
                raise HomingFailed(f"{self._name}: found the board {self._said()} after {seconds:g} s, wanted {what}")
            yield sending()

    def _bring_up(self) -> bytes:
        return self._link.advance(self._now_ns)

    def _touched(self) -> bool:
        bit = 2 * self._home.axis + (self._home.end > 0)
        return self._link.status is not None and bool(self._link.status.inputs >> bit & 1)

    def _received_ns(self) -> int:
        return 0 if self._link.status is None else self._link.status.arrival_ns

    def _steps(self) -> int:
        return 0 if self._link.status is None else int(self._link.status.position_steps[self._home.axis])

    def _state(self) -> BoardState | None:
        return None if self._link.status is None else BoardState(self._link.status.state)

    def _said(self) -> str:
        status = self._link.status
        return "silent" if status is None else f"{BoardState(status.state).name}, fault {Fault(status.fault).name}"

    def _end(self) -> str:
        return "upper" if self._home.end > 0 else "lower"
