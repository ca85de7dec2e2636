"""Homing of one axis by the running rig: the core moves it over the board's link while the control loop is disarmed."""

from __future__ import annotations

from protocol.enums import BoardState
from protocol.errors import InputError
from protocol.rig_file import AXES, Rig
from realtime.core.board_intake import axis_limits
from realtime.drivers.homing import Home, Homing, HomingFailed, homing_limits
from realtime.drivers.stepper_board import LinkPhase, StepperBoardLink

# A board without messages for so long has stopped by its own dead man; the board sends STATUS every 5 ms.
_SILENT_NS = 500_000_000
# Within this time the stages are at rest after DISARM (an axis stops from full speed within 50 ms).
_REST_NS = 2_000_000_000


def home_of(rig: Rig, axis: int) -> Home:
    """Read the home of `axis` from the rig file, in steps. Raises InputError where the axis has no switch."""
    stage = rig.stage(axis)
    if not stage.home_end:
        raise InputError(
            f"stages.{AXES[axis]}.home_end", stage.home_end, "min or max; only an axis with a home switch can be homed"
        )
    return Home(
        axis,
        -1 if stage.home_end == "min" else 1,
        round(stage.home_unit * stage.steps_per_unit),
        round((stage.max_unit - stage.min_unit) * stage.steps_per_unit),
        stage.home_speed_unit_per_s * stage.steps_per_unit,
    )


class HomeRun:
    """One homing on the link that the control loop uses otherwise. The board ends disarmed, with the rig file's limits.

    Feed the link, call `advance` at every step of the core and send what it returns, until `done`. Then `problem` says
    why the axis is not homed, empty where it is.

    Args:
        rig: the rig file. link: link to the board, ready and disarmed. axis: 0 to 2, in the order of AXES.

    Raises:
        InputError: the axis has no home switch.
    """

    def __init__(self, rig: Rig, link: StepperBoardLink, axis: int) -> None:
        home = home_of(rig, axis)
        self.axis, self.problem, self.done = AXES[axis], "", False
        self._rig, self._link, self._unit = rig, link, "m" if axis == 0 else "rad"
        self._home_unit = rig.stage(axis).home_unit
        self._end_ns: int | None = None
        self._ending = False
        link.reconfigure(homing_limits(axis_limits(rig), home))
        self._homing = Homing(link, home)

    @property
    def text(self) -> str:
        """Return the result of the homing as one line."""
        if self.problem:
            return f"{self.problem}; not homed, the rig is disarmed"
        return (
            f"{self.axis}: switch found, its position is {self._home_unit:g} {self._unit}; two touches differ by "
            f"{self._homing.difference_steps} steps; the rig is disarmed, the stage is next to the switch"
        )

    def end(self, why: str) -> None:
        """Bring the axis to rest; `why` becomes the problem."""
        if not self._ending:
            self.problem, self._ending = f"{self.axis}: {why}", True

    def advance(self, now_ns: int, force_N: float) -> bytes:
        """Return what to send to the board at `now_ns` (ns). force_N: size of the force on the tip, N."""
        if self.done:
            return b""
        if not self._ending:
            self._check(now_ns, force_N)
        if not self._ending:
            try:
                data = self._homing.advance(now_ns)
            except HomingFailed as failed:
                self.problem, self._ending = str(failed), True
            else:
                self._ending = self._homing.done
                return data
        return self._come_to_rest(now_ns)

    def _check(self, now_ns: int, force_N: float) -> None:
        """End the homing if the board is lost or the tip presses."""
        status, limit_N = self._link.status, self._rig.safety.over_force_N
        if self._link.phase not in (LinkPhase.READY, LinkPhase.CONFIGURE):
            self.end(f"found the board link in phase {self._link.phase.value}, wanted ready")
        elif status is not None and now_ns - status.arrival_ns > _SILENT_NS:
            self.end(f"found no status of the board for {(now_ns - status.arrival_ns) * 1e-9:.1f} s, wanted one")
        elif not force_N <= limit_N:
            self.end(f"found a force of {force_N:.2f} N, wanted at most safety.over_force_N {limit_N}")

    def _come_to_rest(self, now_ns: int) -> bytes:
        """Disarm, wait for rest, and send the rig file's limits to the board again."""
        if self._end_ns is None:
            self._end_ns = now_ns
            return self._link.disarm()
        status = self._link.status
        rests = (
            status is not None
            and status.arrival_ns > self._end_ns
            and status.state in (BoardState.DISARMED, BoardState.FAULT)
        )
        if rests or now_ns - self._end_ns > _REST_NS:
            self._link.reconfigure(axis_limits(self._rig))
            self.done = True
        return b""
