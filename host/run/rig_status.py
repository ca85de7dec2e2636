"""What a running rig says of itself, gathered over a second: one screen, the first cause first."""

from __future__ import annotations

import time
from typing import Any

import msgspec

from protocol.enums import BoardState
from protocol.topics import Message, RigCause
from protocol.zenoh_session import Session

TOPICS = ("state", "cause", "board", "loop", "commander", "force/sensor", "pose/tip", "force/estimate", "log")
_LOOK_S = 0.02


class RigStatus(msgspec.Struct, frozen=True, kw_only=True):
    """A rig's newest messages by topic, and the first cause with its remedy and consequences."""

    rig: str
    newest: dict[str, Message]
    cause: str = ""
    remedy: str = ""
    followed: tuple[str, ...] = ()

    @property
    def connected(self) -> bool:
        """Whether the loop sent its state."""
        return "state" in self.newest

    def as_json(self) -> dict[str, Any]:
        """Return the status as one JSON object: the messages by topic, and the cause."""
        newest = {topic: msgspec.to_builtins(message) for topic, message in self.newest.items()}
        return {
            "rig": self.rig,
            "connected": self.connected,
            "first_cause": self.cause,
            "remedy": self.remedy,
            "followed": list(self.followed),
            "topics": newest,
        }

    def lines(self) -> list[str]:
        """Return the status in lines for a terminal."""
        if not self.connected:
            return [f"{self.rig}: no message from the control loop"]
        state, get = self.newest["state"], self.newest.get
        rows = [f"{self.rig}: {getattr(state, 'mode', '')}, safety action {getattr(state, 'safety_action', '')}"]
        if self.cause:
            rows += [f"first cause: {self.cause}", f"remedy:      {self.remedy}"]
            rows += [f"then:        {text}" for text in self.followed]
        force_N, wanted_N = getattr(state, "force_N", None), getattr(state, "target_force_N", None)
        rows += [
            f"tip          {_mm(getattr(state, 'tip_m', None))}",
            f"target       {_mm(getattr(state, 'target_m', None))}",
            f"force        {_number(force_N, '{:.3f} N')}" + ("" if wanted_N is None else f" of {wanted_N:.3f} N"),
            f"tracker      newest accepted pose {getattr(state, 'pose_age_ns', 0) * 1e-6:.0f} ms old"
            + ("" if get("pose/tip") is not None else "; no pose of the tip in the last second"),
            "force sensor " + ("sends" if get("force/sensor") is not None else "sends nothing"),
            "model        " + ("sends estimates" if get("force/estimate") is not None else "sends no estimates"),
            f"board        {_board(get('board'))}",
            f"loop         {_loop(get('loop'))}",
            f"lease        {getattr(get('commander'), 'holder', '') or 'free'}",
        ]
        return rows


def _number(value: float | None, form: str) -> str:
    return "unknown" if value is None else form.format(value)


def _mm(point_m: tuple[float, ...] | None) -> str:
    return "unknown" if point_m is None else ", ".join(f"{1e3 * value:.2f}" for value in point_m) + " mm"


def _board(board: Any) -> str:
    if board is None:
        return "sends nothing"
    fault = f"fault {board.fault_name}" if board.fault else "no fault"
    return (
        f"{BoardState.label_of(board.state)}, {fault}, {board.underruns} queue underruns, {board.crc_errors} damaged frames"
    )


def _loop(loop: Any) -> str:
    if loop is None:
        return "no timing yet"
    return f"{loop.loop_hz:g} Hz, {loop.missed_ticks} missed ticks, longest gap {loop.longest_gap_ns * 1e-6:.1f} ms"


def read_status(session: Session, rig: str, listen_s: float = 1.2, wait_s: float = 3.0) -> RigStatus:
    """Listen to a rig and return its status.

    Parameters:
        session: an open session of the rig. rig: its name.
        listen_s: how long to listen once the loop's state has come. wait_s: how long to wait for that.
    """
    readers = {topic: session.latest(topic) for topic in TOPICS}
    newest: dict[str, Message] = {}
    end_s = time.monotonic() + wait_s
    while time.monotonic() < end_s:
        for topic, reader in readers.items():
            message = reader.take()
            if message is None:
                continue
            if topic == "state" and topic not in newest:
                end_s = time.monotonic() + listen_s
            newest[topic] = message
        time.sleep(_LOOK_S)
    first = newest.get("cause")
    if not isinstance(first, RigCause) or not first.name:
        return RigStatus(rig=rig, newest=newest)
    followed = tuple(first.followed.splitlines())
    return RigStatus(rig=rig, newest=newest, cause=first.says, remedy=first.remedy, followed=followed)
