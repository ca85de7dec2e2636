"""The view of the running rig: what it publishes is on the page, what a page may send reaches it, nothing else does."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from host.run.commander import Acknowledgement, Commander
from host.view.live import ButtonPress, LiveRig
from host.view.server import ADDRESS
from protocol.rig_file import SIMULATED_RIG, Rig, load_rig
from protocol.topics import Command, ForceEstimate, ForceSensor, Pose, Reply, RigState, Stage, encode, key
from protocol.zenoh_session import Session
from realtime.core.command_gate import CommandGate
from tests.host.test_view import MS, free_port
from tests.waiting import PATIENCE_S, until


def loopback(rig: Rig) -> tuple[Session, Session]:
    endpoint = f"tcp/{ADDRESS}:{free_port()}"
    return Session(rig.name, [endpoint], []), Session(rig.name, [], [endpoint])


@pytest.fixture
def live() -> Iterator[tuple[Session, LiveRig, list[Command]]]:
    rig = load_rig(SIMULATED_RIG)
    there, here = loopback(rig)
    obeyed: list[Command] = []

    def obey(command: Command, now_ns: int) -> Reply:
        obeyed.append(command)
        return Reply(stamp_ns=now_ns, id=command.id, result="refused", text="no board")

    gate = CommandGate(time.monotonic_ns, obey)
    with there, here, closing(LiveRig(rig, here)) as view:
        server = there.serve_requests(lambda name, payload: gate.answer(name, payload)[1])
        yield there, view, obeyed
        del server


def publish_until_seen(there: Session, view: LiveRig) -> dict[str, Any]:
    rig_time = [1_000_000_000]
    messages = {
        "stage": Stage,
        "pose/tip": Pose,
        "force/sensor": ForceSensor,
        "force/estimate": ForceEstimate,
        "state": RigState,
    }
    publishers = {topic: there.publisher(topic) for topic in messages}
    contents: dict[str, dict[str, Any]] = {
        "stage": {
            "command_insertion_m": 0.0,
            "command_roll_rad": 0.0,
            "command_knob_rad": 0.0,
            "joint_insertion_m": -0.08,
            "joint_roll_rad": 0.0,
            "joint_curvature_per_m": 18.0,
        },
        "pose/tip": {
            "arrival_ns": 0,
            "frame": 1,
            "missing": False,
            "position_m": (0.0, -0.007, 0.028),
            "quaternion_wxyz": (1.0, 0.0, 0.0, 0.0),
        },
        "force/sensor": {"arrival_ns": 0, "force_N": (0.0, 0.0, 0.15)},
        "force/estimate": {
            "frame": "base",
            "converged": True,
            "force_N": (0.0, 0.0, 0.14),
            "published_ns": 0,
            "compute_us": 1.0,
            "covariance_N2": (4e-4, 0, 0, 0, 4e-4, 0, 0, 0, 4e-4),
        },
        "state": {
            "mode": "contact",
            "safety_action": "warn",
            "cause": "a pose was not used",
            "tip_m": (0.0, -0.007, 0.028),
            "force_direction": (0.0, 0.0, 1.0),
            "target_m": (0.0, -0.01, 0.025),
            "target_force_N": 0.2,
            "force_N": 0.15,
        },
    }
    frame: dict[str, Any] = {}

    def seen() -> bool:
        rig_time[0] += 10 * MS
        for topic, message in messages.items():
            publishers[topic].put(message(stamp_ns=rig_time[0], **contents[topic]))
        frame.update(view.frame())
        return bool(frame["scene"]["shape"] and frame["estimates"] and frame["scene"]["force"] and frame["mode"])

    until(seen, "the view to hear what is published")
    return frame


def test_what_the_rig_publishes_is_on_the_page(live: tuple[Session, LiveRig, list[Command]]) -> None:
    there, view, _ = live
    before = view.frame()
    assert before["silent_s"] is None and before["mode"] == ""
    frame = publish_until_seen(there, view)
    assert frame["mode"] == "contact" and frame["causes"] == ["a pose was not used"]
    assert 0.0 <= frame["silent_s"] < PATIENCE_S
    np.testing.assert_allclose(frame["scene"]["shape"][-1], [0.0, -0.007, 0.028], atol=1e-5)
    assert frame["estimates"][-1][1:] == [0.14, 0.02] and frame["rows"][-1][1:3] == [0.15, 0.2]


def test_garbage_on_the_topics_is_counted_and_not_shown(live: tuple[Session, LiveRig, list[Command]]) -> None:
    there, view, _ = live
    publish_until_seen(there, view)
    for payload in (b"", b"\xff" * 20, encode(RigState(stamp_ns=1, mode="hold", safety_action="none"))[:-3]):
        there.zenoh.put(key(there.rig, "state"), payload)
    until(lambda: view.frame()["malformed"] == 3, "three malformed messages")
    assert view.frame()["mode"] == "contact"


def test_buttons_reach_the_rig_and_its_answer_comes_back(live: tuple[Session, LiveRig, list[Command]]) -> None:
    there, view, obeyed = live
    publish_until_seen(there, view)
    for text, action, target in (
        ('{"button": "arm", "confirmed": true}', "arm", "none"),
        ('{"button": "hold", "confirmed": true}', "hold", "none"),
    ):
        until(
            lambda text=text: (answer := view.act(text))["text"] == "no board" and answer["result"] == "refused",
            f"the rig's answer to {action}",
        )
        assert (obeyed[-1].action, obeyed[-1].target) == (action, target)
    answer = view.act('{"button": "stop"}')
    assert answer["result"] == "not confirmed" and "no board" in answer["text"] and "emergency stop" in answer["text"]
    assert {command.action for command in obeyed} == {"arm", "hold", "stop"}


@given(
    text=st.one_of(
        st.text(max_size=80),
        st.builds(
            json.dumps,
            st.dictionaries(
                st.sampled_from(["button", "confirmed", "action", "target"]),
                st.sampled_from(["arm", "stop ", "hold", "ARM", "true"]) | st.booleans() | st.none() | st.integers(),
            ),
        ),
    )
)
def test_what_is_malformed_or_not_confirmed_is_never_sent(text: str) -> None:
    sent: list[str] = []
    view = LiveRig.__new__(LiveRig)
    view._command = lambda button: sent.append(button) or Acknowledgement(True, "", "accepted")
    answer = view.act(text)
    try:
        press = ButtonPress.model_validate_json(text)
        allowed = press.confirmed or press.button == "stop"
    except ValueError:
        allowed = False
    assert bool(sent) == allowed
    assert allowed or answer["result"] in ("malformed", "refused")


def test_no_answer_is_said(live: tuple[Session, LiveRig, list[Command]]) -> None:
    there, view, _ = live
    with Session(there.rig, [], []) as alone:
        view._commander = Commander(alone, "view", timeout_s=0.1)
        answer = view.act('{"button": "hold", "confirmed": true}')
        assert answer["result"] == "unanswered" and "may still be starting" in answer["text"]
        assert view.act('{"button": "stop"}')["result"] == "not confirmed"
        publish_until_seen(there, view)
        answer = view.act('{"button": "hold", "confirmed": true}')
        assert answer["result"] == "unanswered" and "may or may not have received" in answer["text"]
