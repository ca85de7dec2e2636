"""`seldinger stop --rig FILE`: stop the rig over every path at once, and say whether its own state confirms it."""

from __future__ import annotations

import contextlib
import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from host.cli.options import Json, RigFile
from protocol.errors import InputError
from protocol.rig_file import Rig, load_rig
from protocol.stop_client import PathAnswer, stop_by_socket, stop_over

# A session that was opened for the stop needs this long at most to reach the model process.
_OPENING_S, _AGAIN_S = 2.0, 0.02


def stop(
    rig: RigFile,
    endpoint: Annotated[str, typer.Option(help="Address of a rig on another machine: tls/HOST:PORT.")] = "",
    keys: Annotated[Path | None, typer.Option(help="Folder of the certificate for --endpoint.")] = None,
    name: Annotated[str, typer.Option(help="Name of the commander; with --endpoint the name in the certificate.")] = "stop",
    json: Json = False,
) -> None:
    """Stop the rig over its socket and over zenoh at once; print each answer.

    Exit status 0 if the rig's own state shows the stop within 100 ms, 1 if it is not confirmed: use the emergency stop.
    """
    if bool(endpoint) != (keys is not None):
        raise InputError("keys" if endpoint else "endpoint", "nothing", "--endpoint and --keys together, or neither")
    found = load_rig(rig)
    paths = {"zenoh": lambda: _stop_by_zenoh(found, name, endpoint, keys)}
    if not endpoint:
        paths = {"socket": lambda: stop_by_socket(found.local), **paths}
    answers = stop_over(paths, others_s=_OPENING_S, each=_print_answer)
    confirmed = any(answer.confirmed for answer in answers)
    if json:
        from dataclasses import asdict

        from host.cli.contract_io import write_json

        write_json({"confirmed": confirmed, "paths": [asdict(answer) for answer in answers]})
    verdict = "stop confirmed" if confirmed else "stop NOT CONFIRMED: use the emergency stop"
    print(f"seldinger: {verdict}", file=sys.stderr, flush=True)
    if not confirmed:
        raise typer.Exit(1)


def _print_answer(answer: PathAnswer) -> None:
    said = "confirmed" if answer.confirmed else "not confirmed" if answer.answered else "no answer"
    print(f"seldinger: {answer.path}: {said}: {answer.text}", file=sys.stderr, flush=True)


def _stop_by_zenoh(rig: Rig, name: str, endpoint: str, keys: Path | None) -> PathAnswer:
    """Stop over a new session, and repeat the request until it has reached the model process."""
    from host.run.commander import Commander
    from protocol.zenoh_session import Session

    try:
        session = Session.remote(rig.name, endpoint, keys) if keys is not None else Session.of_rig(rig)
        with session, contextlib.closing(Commander(session, name)) as commander:
            until_s = time.monotonic() + _OPENING_S
            while True:
                answer = commander.stop_by_zenoh()
                if answer.answered or time.monotonic() > until_s:
                    return answer
                time.sleep(_AGAIN_S)
    except (OSError, ValueError) as error:
        return PathAnswer("zenoh", False, False, str(error))
