"""The running rig for the page: hears its topics through small rings that lose their oldest, and sends its commands."""

from __future__ import annotations

import dataclasses
import time
import uuid
from collections.abc import Callable
from typing import Any, Literal

import msgpack
import zenoh
from pydantic import Field, ValidationError

from host.cli.contract_io import Request
from host.mechanics.catheter import load_catheter
from host.view.picture import Picture
from host.view.source import refusal
from protocol.topics import TOPICS, Command, Reply, decode, key
from protocol.zenoh_session import Session
from realtime.rig_file import Rig

# Messages kept between two frames: all of the traces' topics, the newest of the others.
DEPTHS = {"stage": 1, "pose/tip": 1, "pose/shaft": 1, "force/sensor": 1, "board": 1, "loop": 1, "state": 64,
          "force/estimate": 64, "log": 32}
COMMAND_LIFE_NS = 500_000_000
ANSWER_S = 1.0
# What a button means as a command: (action, target).
BUTTONS: dict[str, tuple[str, str]] = {
    "arm": ("arm", "none"), "hold": ("target", "hold"), "stop": ("stop", "none"), "disarm": ("disarm", "none"),
    "clear": ("clear_fault", "none"),
}


class Press(Request):
    """A button pressed on the page. All but stop must have been confirmed there."""

    button: Literal["arm", "hold", "stop", "disarm", "clear"]
    confirmed: bool = Field(default=False)


def send(session: Session, button: str) -> Reply | None:
    """The command of `button` on the operator's path; None where nobody answers within ANSWER_S."""
    action, target = BUTTONS[button]
    now_ns = time.monotonic_ns()
    return session.ask(Command(stamp_ns=now_ns, id=uuid.uuid4().hex, expires_ns=now_ns + COMMAND_LIFE_NS,
                               action=action, target=target), ANSWER_S)


class LiveRig:
    """A `Source`. Never makes the rig wait: what is not taken in time is lost here."""

    def __init__(self, rig: Rig, session: Session, send_button: Callable[[Session, str], Reply | None] = send) -> None:
        self._rig, self._session, self._send = rig, session, send_button
        self._picture = Picture(rig.effective(), dataclasses.asdict(load_catheter(rig.catheter.name)))
        self._subscribers = {
            topic: session.zenoh.declare_subscriber(key(rig.name, topic), zenoh.handlers.RingChannel(depth))
            for topic, depth in DEPTHS.items()}
        self._heard_s: float | None = None
        self.malformed = 0

    def hello(self) -> dict[str, Any]:
        """Rig, limits and kind; see `Source`."""
        return {"kind": "live", "rig": self._rig.name, "catheter": self._rig.catheter.name,
                "over_force_N": self._rig.safety.over_force_N, "radius_m": _radius_m(self._rig.catheter.name),
                "past": self._picture.past()}

    def frame(self) -> dict[str, Any]:
        """The picture, and how long the rig has been silent (nil before it was heard of)."""
        for topic, subscriber in self._subscribers.items():
            while (sample := subscriber.try_recv()) is not None:
                self._take(topic, bytes(sample.payload))
        silent_s = None if self._heard_s is None else round(time.monotonic() - self._heard_s, 2)
        return {**self._picture.frame(), "silent_s": silent_s, "malformed": self.malformed}

    def _take(self, topic: str, payload: bytes) -> None:
        try:
            decode(TOPICS[topic].message, payload)
        except ValueError:
            self.malformed += 1
            return
        self._picture.hear(topic, msgpack.unpackb(payload))
        if topic == "state":
            self._heard_s = time.monotonic()

    def act(self, text: str) -> dict[str, Any]:
        """Send the command of a `Press`. What is malformed or not confirmed is never sent."""
        try:
            press = Press.model_validate_json(text)
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(map(str, first["loc"])) or "message"
            return refusal(f"{where}: found {str(first['input'])[:60]!r}, wanted: {first['msg']}")
        if press.button != "stop" and not press.confirmed:
            return {"action": press.button, "result": "refused", "text": "not confirmed"}
        asked_s = time.monotonic()
        reply = self._send(self._session, press.button)
        if reply is None:
            at_once = time.monotonic() - asked_s < 0.5 * ANSWER_S
            text = ("not sent: nothing there takes commands; is the control loop up?" if at_once
                    else f"no answer within {ANSWER_S:g} s: it may or may not have arrived")
            return {"action": press.button, "result": "unanswered", "text": text}
        return {"action": press.button, "result": reply.result, "text": reply.text}


def _radius_m(catheter: str) -> float:
    return 0.5 * load_catheter(catheter).diameter_m
