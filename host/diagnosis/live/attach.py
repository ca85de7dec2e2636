"""Attach the live diagnosis to a running rig: compare it with its twin, publish and report alarms until it is stopped."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from host.diagnosis.live.watch import warm_up, watch
from protocol.end_signals import EndSignals
from protocol.rig_file import load_rig
from protocol.topics import Alarm, Log
from protocol.zenoh_session import Session

STATES = {
    "waiting": "waiting for an armed rig",
    "learning": "learning the usual difference of rig and twin",
    "watching": "watching",
}


def attach(rig_file: Path, report: Callable[[str], None], on_alarm: Callable[[Alarm], None]) -> None:
    """Watch the rig of `rig_file` until SIGINT or SIGTERM.

    Arguments: `report` gets a line for each change of state and each alarm; `on_alarm` gets each alarm once it is published.
    An alarm is published on the topic alarm, and its words on the topic log.
    Raises: InputError for a bad rig file.
    """
    os.nice(10)  # below the rig's own processes
    rig = load_rig(rig_file)
    ends = EndSignals()
    report("loading models")
    with ends.interrupting():
        warm_up(rig)
    if ends.asked.is_set():
        return
    with Session.of_rig(rig) as session:
        alarms, logs = session.publisher("alarm"), session.publisher("log")

        def publish(alarm: Alarm) -> None:
            alarms.put(alarm)
            # The same words on the page, in the rig's log and in the recording.
            logs.put(Log(stamp_ns=alarm.stamp_ns, level="warning", source="diagnosis", text=alarm.words))
            report(f"ALARM at {alarm.stamp_ns * 1e-9:.1f} s of the rig's clock: {alarm.words}")
            on_alarm(alarm)

        watch(rig, session.everything(), publish, lambda text: report(STATES.get(text, text)), ends.asked.is_set)
