"""An alarm of the live diagnosis: the same words in the terminal, in the rig's log, on the page and in the recording."""

from __future__ import annotations

import os
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

import host.diagnosis.live.attach as attach
from host.recordings.rig_picture import Picture
from protocol.rig_file import SIMULATED_RIG
from protocol.topics import Alarm, Log, Message

ALARM = Alarm(
    stamp_ns=20_000_000_000,
    subsystem="insertion",
    effect="backlash",
    channel="tip_turn_x",
    score=1.2,
    explained=1.0,
    probability=0.84,
    since_ns=18_000_000_000,
    words="insertion: probably backlash (probability 0.84, explains 100% of the mismatch); since 18.0 s",
)


class Session:
    """Takes what is published."""

    def __init__(self) -> None:
        self.published: list[tuple[str, Message]] = []

    def publisher(self, topic: str) -> Any:
        return SimpleNamespace(put=lambda message: self.published.append((topic, message)))

    def everything(self) -> None:
        """Nothing arrives."""

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *_: object) -> None:
        """It stays open."""


def test_an_alarm_has_the_same_words_everywhere(monkeypatch: pytest.MonkeyPatch) -> None:
    session, lines, alarms = Session(), list[str](), list[Alarm]()

    def watching(rig: Any, source: Any, publish: Callable[[Alarm], None], *rest: Any) -> None:
        publish(ALARM)

    monkeypatch.setattr(attach, "warm_up", lambda rig: None)
    monkeypatch.setattr(attach, "watch", watching)
    monkeypatch.setattr(attach, "Session", SimpleNamespace(of_rig=lambda rig: session))
    monkeypatch.setattr(os, "nice", lambda by: 0)
    attach.attach(SIMULATED_RIG, lines.append, alarms.append)
    assert lines[-1].endswith(ALARM.words) and alarms == [ALARM]
    topics = dict(session.published)
    assert topics["alarm"] == ALARM
    log = topics["log"]
    assert isinstance(log, Log) and (log.text, log.source, log.level) == (ALARM.words, "diagnosis", "warning")
    page = Picture({}, {})
    page.take("log", msgspec.to_builtins(log))
    assert ALARM.words in str(page.frame()["log"])
