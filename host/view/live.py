"""The running rig for the page: receives its topics through small rings that lose their oldest, and sends its commands."""

from __future__ import annotations

import dataclasses
import os
import time
from typing import Any, Literal

import msgpack
from pydantic import Field, ValidationError

from host.recordings.rig_picture import Picture
from host.run.commander import Acknowledgement, Commander
from host.view.source import refusal
from protocol.catheter import load_catheter
from protocol.enums import JogAxis
from protocol.jog_limits import fastest_jog
from protocol.requests import Request, wanted_of
from protocol.rig_file import AXES, Rig
from protocol.topics import TOPICS, decode
from protocol.zenoh_session import Session

# Messages kept between two frames: all of the traces' topics, the newest of the others.
DEPTHS = {
    "stage": 1,
    "pose/tip": 1,
    "pose/shaft": 1,
    "pose/rear": 1,
    "force/sensor": 1,
    "board": 1,
    "cause": 1,
    "loop": 1,
    "stiffness": 1,
    "contact": 1,
    "state": 64,
    "force/estimate": 64,
    "log": 32,
    "plan": 64,
}


# Buttons that act without a second press: a jog is held, a note moves nothing.
UNCONFIRMED = ("stop", "jog", "mark")
# A page repeats a jog ten times a second while its button is held. One command moves for this long: without its page the
# motion ends by itself.
JOG_S = 0.3

Vector3 = tuple[float, float, float]


class ButtonPress(Request):
    """A button pressed on the page. All but UNCONFIRMED must have been confirmed there.

    axis, direction, forwards, share (of the greatest speed): of a jog; axis: of home, too. point_m, normal, force_N: of
    goto, touch, force.
    """

    button: Literal[
        "arm", "hold", "stop", "disarm", "clear", "jog", "goto", "touch", "force", "retract", "zero", "home", "mark"
    ]
    confirmed: bool = Field(default=False)
    axis: Literal["tip", "insertion", "roll", "knob"] = "tip"
    direction: Vector3 | None = None
    forwards: bool = True
    share: float = Field(default=0.5, gt=0.0, le=1.0)
    point_m: Vector3 | None = None
    normal: Vector3 | None = None
    force_N: float | None = None
    note: str = Field(default="", max_length=500)


class LiveRig:
    """Source of the running rig. The rig never waits for it: messages that are not read in time are lost here."""

    def __init__(self, rig: Rig, session: Session) -> None:
        self._rig, self._session = rig, session
        self._commander = Commander(session, f"view-{os.getpid()}")
        self._picture = Picture(rig.effective(), dataclasses.asdict(load_catheter(rig.catheter.name)))
        self._subscribers = {topic: session.ring(topic, depth) for topic, depth in DEPTHS.items()}
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
            "homes": [axis for number, axis in enumerate(AXES) if self._rig.stage(number).home_end],
            "past": self._picture.past(),
        }

    def frame(self) -> dict[str, Any]:
        """Return the picture, and the time since the rig's last message (nil before the first)."""
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
        """Send the command of a `Press`. A malformed or unconfirmed one is not sent."""
        try:
            press = ButtonPress.model_validate_json(text)
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(map(str, first["loc"])) or "message"
            return refusal(f"{where}: found {str(first['input'])[:60]!r}, wanted {wanted_of(first)}")
        if press.button not in UNCONFIRMED and not press.confirmed:
            return {"action": press.button, "result": "refused", "text": "not confirmed"}
        answer = self._command(press)
        text = answer.reason.removeprefix(f"{answer.result}: ")
        if press.button == "stop" and answer.accepted:
            text = "confirmed by " + ", ".join(f"{path.path} ({path.text})" for path in answer.paths if path.confirmed)
        if press.button == "home" and answer.accepted:
            text = f"{press.axis} moves slowly to its switch; the log reports the end. Stop, Hold and Disarm interrupt it"
        if answer.result == "unanswered" and self._received_s is None:
            text = "no answer: no message of the rig yet; it may still be starting"
        return {"action": press.button, "result": answer.result, "text": text}

    def _command(self, press: ButtonPress) -> Acknowledgement:
        """Give the command of a button.

        Hold, mark and stop need no lease. Arming and moving take and keep it, until the rig is disarmed from here or the
        page's process ends; other commands give it back where it was not held before.
        """
        commander, button = self._commander, press.button
        if button == "hold":
            return commander.hold()
        if button == "stop":
            return commander.stop()
        if button == "mark":
            return commander.mark(press.note)
        held = commander.lease_left_s > 0.0
        if not held:
            taken = commander.take()
            if not taken.accepted:
                return taken
        answer = self._under_lease(press)
        keeps = button not in ("disarm", "clear") and (held or (answer.accepted and button not in ("zero", "home")))
        if not keeps:
            commander.release()
        return answer

    def _under_lease(self, press: ButtonPress) -> Acknowledgement:
        commander = self._commander
        if press.button == "jog":
            speed = press.share * fastest_jog(self._rig, JogAxis[press.axis.upper()])
            travel = speed * JOG_S * (1.0 if press.forwards else -1.0)
            return commander.jog(press.axis, travel, speed, press.direction if press.axis == "tip" else None)
        if press.button == "goto":
            return commander.give("target", "position", target_m=press.point_m)
        if press.button == "touch":
            return commander.give("target", "contact", target_m=press.point_m, normal=press.normal, force_N=press.force_N)
        if press.button == "home":
            return commander.home(press.axis)
        if press.button == "force":
            return commander.give("force", force_N=press.force_N)
        simple = {
            "arm": commander.arm,
            "disarm": commander.disarm,
            "clear": commander.clear_fault,
            "retract": commander.retract,
            "zero": commander.zero,
        }
        return simple[press.button]()

    def close(self) -> None:
        """Return the lease and close the commander."""
        self._commander.close()


def _radius_m(catheter: str) -> float:
    return 0.5 * load_catheter(catheter).diameter_m
