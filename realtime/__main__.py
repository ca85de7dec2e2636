"""`python -m realtime`: the realtime process as a service; ends in order on SIGTERM and SIGINT."""

from __future__ import annotations

import argparse
import logging
import signal
import sys
import threading
import warnings
from pathlib import Path
from types import FrameType

from protocol.errors import InputError
from protocol.rig_file import load_rig
from realtime.core.process import RealtimeProcess
from realtime.loop.service_notify import ServiceNotifier, log_handler


def main(arguments: list[str] | None = None) -> int:
    """Exit status 0 after an ordered stop, 1 when something failed, 2 for a bad rig file."""
    parser = argparse.ArgumentParser(prog="python -m realtime", description=__doc__)
    parser.add_argument("--rig", type=Path, required=True)
    parser.add_argument("--board-port")
    parser.add_argument("--tracker-port")
    parser.add_argument("--force-port", type=int, default=49152)
    parser.add_argument("--force-source", choices=("sensor", "estimate"), default="sensor")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, handlers=[log_handler()])
    stop, manager = threading.Event(), ServiceNotifier()

    def on_signal(number: int, frame: FrameType | None) -> None:
        stop.set()

    signal.signal(signal.SIGTERM, on_signal)
    signal.signal(signal.SIGINT, on_signal)
    try:
        with warnings.catch_warnings(record=True) as unusual:
            rig = load_rig(options.rig)
        for warning in unusual:
            logging.getLogger("rig").warning(str(warning.message))
        process = RealtimeProcess(
            rig,
            board_port=options.board_port,
            tracker_port=options.tracker_port,
            force_port=options.force_port,
            force_source=options.force_source,
        )
    except InputError as error:
        print(f"seldinger: {error}", file=sys.stderr)
        return 2
    except (OSError, ValueError) as error:
        print(f"seldinger: {error}", file=sys.stderr)
        return 1
    process.start()
    manager.ready("disarmed: waits for an operator")
    while not stop.wait(0.1) and process.alive:
        manager.beat(process.loop.heartbeat)
    failed = not process.alive
    manager.stopping()
    process.stop()
    if failed:
        print(f"seldinger: realtime: {process.error}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
