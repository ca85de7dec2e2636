"""The model process: receives the rig's messages, estimates the tip force, publishes it, and records everything."""

from __future__ import annotations

import argparse
import json
import sys
import threading
import time
import warnings
from pathlib import Path

from host.estimation.interface import Estimator
from host.estimation.service import DEFAULT_ESTIMATOR, EstimationService, load_estimator, rehearse
from host.recordings.header import header_of
from host.recordings.writer import RecordingWriter
from protocol import compile_notice
from protocol.end_signals import EndSignals
from protocol.rig_file import load_rig
from protocol.topics import Log
from protocol.usual_values import UnusualValue
from protocol.zenoh_session import Session
from realtime.loop.service_notify import ServiceNotifier

POLL_S = 0.002
QUIET_S = 1.0
# What an estimator may report in addition to the force.
REPORTED = ("stiffness", "contact")


class EstimatorProcess:
    """Everything of the process between its start and its end; `run` until `stop` is set.

    recording: where to write, None to record nothing. clock: `wall` is CLOCK_MONOTONIC, as in all processes of a rig;
    `virtual` is handed out by the simulated rig, and known here as the newest stamp received.
    """

    def __init__(
        self, session: Session, estimator: Estimator, recording: RecordingWriter | None, clock: str = "wall"
    ) -> None:
        self.service = EstimationService(estimator)
        self._recording = recording
        self._newest_ns = 0
        self._now_ns = time.monotonic_ns if clock == "wall" else lambda: self._newest_ns
        self._everything = session.everything()
        self._forces = session.publisher("force/estimate")
        self._reports = {topic: session.publisher(topic) for topic in REPORTED}
        self._logs = session.publisher("log")
        self._received_s = self._logged_s = time.monotonic()
        self._logged = ""
        self._steps = 0

    def step(self) -> bool:
        """Process the messages that have arrived: record them, and answer the newest pose. Return whether there were any."""
        self._steps += 1
        taken = self._everything.take()
        self._newest_ns = max([self._newest_ns, *(message.stamp_ns for _, message, _ in taken)])
        now_ns = self._now_ns()
        for topic, message, payload in taken:
            self.service.receive(topic, message)
            if self._recording is not None:
                self._recording.write_encoded(topic, payload, message.stamp_ns, message.sequence, now_ns)
        estimate = self.service.answer(self._now_ns())
        if estimate is not None:
            self._forces.put(estimate)
        for topic, report in self.service.reports():
            self._reports[topic].put(report)
        self._log_once(self._everything.complaint or self.service.last_failure)
        self._flush_when_quiet(bool(taken))
        return bool(taken)

    def _flush_when_quiet(self, received: bool) -> None:
        now_s = time.monotonic()
        if not received and self._recording is not None and now_s - self._received_s > QUIET_S:
            self._recording.flush()
        if received or now_s - self._received_s > QUIET_S:
            self._received_s = now_s

    def log(self, level: str, text: str) -> None:
        """Write `text` to the log topic and to standard error."""
        print(f"seldinger estimator: {text}", file=sys.stderr, flush=True)
        self._logs.put(Log(stamp_ns=max(self._now_ns(), 0), level=level, source="estimator", text=text))

    def _log_once(self, text: str) -> None:
        """Log `text` when it is new, at most once in QUIET_S, so that many bad messages do not become many log lines."""
        now_s = time.monotonic()
        if text and text != self._logged and now_s - self._logged_s > QUIET_S:
            self._logged, self._logged_s = text, now_s
            self.log("warning", text)

    def run(self, stop: threading.Event) -> None:
        """Steps until `stop`, then takes in what has arrived. Steps feed the service manager's watchdog."""
        manager = ServiceNotifier()
        manager.ready("waits for poses")
        while not stop.is_set():
            manager.beat(self._steps)
            if not self.step():
                stop.wait(POLL_S)
        self.step()


def main(arguments: list[str] | None = None) -> int:
    """`python -m host.run.model_process RIG.toml`. Exit status 0 after SIGTERM or SIGINT, 1 where it cannot start."""
    parser = argparse.ArgumentParser(prog="seldinger estimator", description=__doc__)
    parser.add_argument("rig", type=Path, help="rig file")
    parser.add_argument("--record", type=Path, help="recording to write (a file that does not exist yet)")
    parser.add_argument("--estimator", default=DEFAULT_ESTIMATOR, help="module:function that makes the estimator of a rig")
    parser.add_argument("--clock", choices=("wall", "virtual"), default="wall")
    parser.add_argument("--seed", type=int)
    options = parser.parse_args(arguments)
    ends = EndSignals()
    compile_notice.on_first(lambda: print(json.dumps({"compiling": True}), flush=True))
    session: Session | None = None
    warnings.simplefilter("ignore", UnusualValue)  # the realtime process reports them
    try:
        rig = load_rig(options.rig)
        with ends.interrupting():
            # Compiled now: at the first pose it would keep this process from its watchdog, and from an end in order.
            rehearse(load_estimator(options.estimator, rig), rig)
            estimator = load_estimator(options.estimator, rig)
            session = Session.hub(rig)
    except (ValueError, OSError) as error:
        print(f"seldinger estimator: {error}", file=sys.stderr)
        return 1
    if session is None:  # ended while its models were compiled
        return 0
    with session:
        recording = None
        process: EstimatorProcess | None = None

        def on_failure(text: str) -> None:
            if process is not None:
                process.log("error", text)

        try:
            if options.record is not None:
                header = header_of(rig, options.clock, options.seed, {"estimator": options.estimator})
                recording = RecordingWriter(options.record, header, on_failure)
            process = EstimatorProcess(session, estimator, recording, options.clock)
            print(json.dumps({"ready": True, "recording": str(options.record or "")}), flush=True)
            process.run(ends.asked)
        except OSError as error:
            print(f"seldinger estimator: {error}", file=sys.stderr)
            return 1
        finally:
            if recording is not None:
                recording.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
