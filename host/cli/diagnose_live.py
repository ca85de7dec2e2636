"""`seldinger diagnose --live`: holds a running rig against its twin, prints and publishes alarms until it is stopped."""

from __future__ import annotations

import json as json_text
import os
import signal
import sys
import threading
from pathlib import Path
from types import FrameType

from protocol.messages import body_of
from protocol.rig_file import SIMULATED_RIG, load_rig
from protocol.topics import Alarm
from protocol.zenoh_session import Session

SAYS = {"waiting": "waiting for an armed rig", "learning": "learning how rig and twin agree", "watching": "watching"}


def watch_rig(rig_file: str | None, json: bool) -> None:
    """Watch the rig of `rig_file` until SIGINT or SIGTERM. With `json`, one JSON object a line for each alarm.

    Raises InputError for a bad rig file.
    """
    from host.diagnosis.live.watch import warm_up, watch

    os.nice(10)  # behind the rig's own processes
    rig = load_rig(Path(rig_file) if rig_file else SIMULATED_RIG)
    stopped = threading.Event()

    def on_signal(number: int, frame: FrameType | None) -> None:
        stopped.set()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, on_signal)

    def tell(text: str) -> None:
        print(f"seldinger diagnose: {SAYS.get(text, text)}", file=sys.stderr, flush=True)

    tell("getting ready")
    warm_up(rig)
    with Session(rig.name, [], rig.zenoh.connect) as session:
        alarms = session.publisher("alarm")

        def publish(alarm: Alarm) -> None:
            alarms.put(alarm)
            tell(f"ALARM at {alarm.stamp_ns * 1e-9:.1f} s of the rig's clock: {alarm.words}")
            if json:
                print(json_text.dumps(body_of(alarm)), flush=True)

        watch(rig, session.everything(), publish, tell, stopped.is_set)
