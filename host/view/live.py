"""The running rig for the page: receives its topics through small rings that lose their oldest, and sends its commands."""

from __future__ import annotations

import dataclasses
import os
import time
from typing import Any, Literal

import msgpack
import zenoh
from pydantic import Field, ValidationError

from host.recordings.rig_picture import Picture
from host.run.commander import Acknowledgement, Commander
from host.view.source import refusal
from protocol.catheter import load_catheter
from protocol.requests import Request, wanted_of
from protocol.rig_file import Rig
from protocol.topics import TOPICS, decode, key
from protocol.zenoh_session import Session

# Messages kept between two frames: all of the traces' topics, the newest of the others.
DEPTHS = {
    "stage": 1,
    "pose/tip": 1,
    "pose/shaft": 1,
    "force/sensor": 1,
    "board": 1,
    "loop": 1,
    "state": 64,
    "force/estimate": 64,
    "log": 32,
}


class ButtonPress(Request):
    """A button pressed on the page. All but stop must have been confirmed there."""

    button: Literal["arm", "hold", "stop", "disarm", "clear"]
    confirmed: bool = Field(default=False)


class LiveRig:
    """A `Source`. Never makes the rig wait: what is not taken in time is lost here."""

    def __init__(self, rig: Rig, session: Session) -> None:
        self._rig, self._session = rig, session
        self._commander = Commander(session, f"view-{os.getpid()}")
        self._picture = Picture(rig.effective(), dataclasses.asdict(load_catheter(rig.catheter.name)))
        self._subscribers = {
            topic: session.zenoh.declare_subscriber(key(rig.name, topic), zenoh.handlers.RingChannel(depth))
            for topic, depth in DEPTHS.items()
        }
        self._received_s: float | None = None
        self.malformed = 0

    def hello(self) -> dict[str, Any]:
        """Rig, limits and kind; see `Source`."""
        return {
            "kind": "live",
            "rig": self._rig.name,
            "catheter": self._rig.catheter.name,
            "over_force_N": self._rig.safety.over_force_N,
            "radius_m": _radius_m(self._rig.catheter.name),
            "past": self._picture.past(),
        }

    def frame(self) -> dict[str, Any]:
        """The picture, and the time since the rig's last message (nil before the first)."""
        for topic, subscriber in self._subscribers.items():
            while (sample := subscriber.try_recv()) is not None:
                self._take(topic, bytes(sample.payload))
        silent_s = None if self._received_s is None else round(time.monotonic() - self._received_s, 2)
        return {**self._picture.frame(), "silent_s": silent_s, "malformed": self.malformed}

    def _take(self, topic: str, payload: bytes) -> None:
        try:
            decode(TOPICS[topic].message, payload)
        except ValueError:
            self.malformed += 1
            return
        self._picture.take(topic, msgpack.unpackb(payload))
        if topic == "state":
            self._received_s = time.monotonic()

    def act(self, text: str) -> dict[str, Any]:
        """Send the command of a `Press`. What is malformed or not confirmed is never sent."""
        try:
            press = ButtonPress.model_validate_json(text)
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(map(str, first["loc"])) or "message"
            return refusal(f"{where}: found {str(first['input'])[:60]!r}, wanted {wanted_of(first)}")
        if press.button != "stop" and not press.confirmed:
            return {"action": press.button, "result": "refused", "text": "not confirmed"}
        answer = self._command(press.button)
        text = answer.reason.removeprefix(f"{answer.result}: ")
        if press.button == "stop" and answer.accepted:
            text = "confirmed by " + ", ".join(f"{path.path} ({path.text})" for path in answer.paths if path.confirmed)
        if answer.result == "unanswered" and self._received_s is None:
            text = "no answer: no message of the rig yet; it may still be starting"
        return {"action": press.button, "result": answer.result, "text": text}

    def _command(self, button: str) -> Acknowledgement:
        """Hold and stop need no lease. Arming takes and keeps it, until the rig is disarmed from here or the page ends."""
        commander = self._commander
        if button in ("hold", "stop"):
            return commander.hold() if button == "hold" else commander.stop()
        taken = commander.take()
        if not taken.accepted:
            return taken
        answer = {"arm": commander.arm, "disarm": commander.disarm, "clear": commander.clear_fault}[button]()
        if button != "arm" or not answer.accepted:
            commander.release()
        return answer

    def close(self) -> None:
        """Return the lease and close the commander."""
        self._commander.close()


def _radius_m(catheter: str) -> float:
    return 0.5 * load_catheter(catheter).diameter_m
