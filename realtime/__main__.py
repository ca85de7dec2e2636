"""`python -m realtime`: the realtime process as a service; ends in order on SIGTERM and SIGINT."""

from __future__ import annotations

import argparse
import logging
import sys
import warnings
from pathlib import Path

from protocol.end_signals import EndSignals
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
    ends, manager = EndSignals(), ServiceNotifier()
    process: RealtimeProcess | None = None
    try:
        with warnings.catch_warnings(record=True) as unusual:
            rig = load_rig(options.rig)
        for warning in unusual:
            logging.getLogger("rig").warning(str(warning.message))
        with ends.interrupting():
            process = RealtimeProcess(
                rig,
                board_port=options.board_port,
                tracker_port=options.tracker_port,
                force_port=options.force_port,
                force_source=options.force_source,
            )
            process.start()
    except InputError as error:
        print(f"seldinger: {error}", file=sys.stderr)
        return 2
    except (OSError, ValueError) as error:
        print(f"seldinger: {error}", file=sys.stderr)
        return 1
    if process is None:  # ended before its ports were open
        return 0
    if not ends.asked.is_set():
        manager.ready("disarmed: waits for an operator")
    while not ends.asked.wait(0.1) and process.alive:
        manager.beat(process.loop.heartbeat)
    failed = not ends.asked.is_set() and not process.alive
    manager.stopping()
    process.stop()
    if failed:
        print(f"seldinger: realtime: {process.error}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
