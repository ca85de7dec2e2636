"""`stop` and `status` over the realtime process's own socket: no zenoh, no model process, no library but Python's own."""

from __future__ import annotations

import json
import os
import queue
import socket
import struct
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from protocol.local_paths import LocalPaths

LONGEST_ANSWER = 4096
# In this time the rig's own state must show a stop; otherwise it is reported as not confirmed.
CONFIRM_S = 0.1
# The realtime process needs CONFIRM_S to detect its own change of state, and a busy machine some time to answer.
ANSWER_S = 1.0
# After the rig has confirmed a stop on one path, the others have so long to answer.
OTHERS_S = 0.2
# Name of the threads of `stop_over`, before that of the path.
_ASKING = "stop by "
_CREDENTIALS = struct.Struct("3i")


@dataclass(frozen=True)
class PathAnswer:
    """What one path to the rig answered to a stop.

    Attributes:
        path: `socket` or `zenoh`.
        answered: whether the rig answered on it.
        confirmed: whether the rig's own state showed the stop in time.
        text: what the rig did, or why there is no answer.
    """

    path: str
    answered: bool
    confirmed: bool
    text: str


def shows_stop(mode: str, safety_action: str) -> bool:
    """Return whether a rig in phase `mode` has obeyed a stop: at rest, or moving out of contact because of the stop.

    A retraction that the failsafe demands by itself has the action `retract`, not `stop`.
    """
    return mode in ("stopped", "disarmed") or (mode == "retract" and safety_action == "stop")


def peer_credentials(connection: socket.socket) -> tuple[int, int, int]:
    """Return process, user and group id of the program at the other end, as the kernel states them (SO_PEERCRED)."""
    pid, uid, gid = _CREDENTIALS.unpack(connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))
    return pid, uid, gid


def ask_socket(paths: LocalPaths, word: str, timeout_s: float = ANSWER_S) -> dict[str, Any]:
    """Send `word` (`stop` or `status`) and return the answer.

    Raises:
        OSError: no answer within `timeout_s`, or the program that answers is of another user than the folder's.
        ValueError: the answer is not one of the realtime process.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(timeout_s)
        connection.connect(os.fspath(paths.stop_socket))
        _, uid, _ = peer_credentials(connection)
        owner = paths.folder.stat().st_uid
        if uid not in (owner, 0):
            raise OSError(f"found a program of user {uid} at the socket, wanted one of user {owner}")
        connection.sendall(f"{word}\n".encode())
        received = b""
        while not received.endswith(b"\n") and len(received) < LONGEST_ANSWER:
            data = connection.recv(LONGEST_ANSWER)
            if not data:
                break
            received += data
    answer = json.loads(received)
    if not isinstance(answer, dict):
        raise ValueError("found no JSON object")
    return answer


def stop_by_socket(paths: LocalPaths, timeout_s: float = ANSWER_S) -> PathAnswer:
    """Stop the rig over its socket. Never raises: a path that fails must not keep the others from being used."""
    try:
        answer = ask_socket(paths, "stop", timeout_s)
    except TimeoutError:
        return PathAnswer("socket", False, False, f"no answer within {timeout_s:g} s: the realtime process is stalled")
    except FileNotFoundError:
        return PathAnswer("socket", False, False, f"no {paths.stop_socket}: the realtime process does not run")
    except ConnectionRefusedError:
        return PathAnswer("socket", False, False, f"no program listens at {paths.stop_socket}: the realtime process is dead")
    except (OSError, ValueError, RecursionError) as error:
        return PathAnswer("socket", False, False, str(getattr(error, "strerror", None) or error))
    return PathAnswer("socket", True, answer.get("confirmed") is True, str(answer.get("text", ""))[:500])


def stop_over(
    paths: Mapping[str, Callable[[], PathAnswer]],
    others_s: float = OTHERS_S,
    each: Callable[[PathAnswer], None] = lambda answer: None,
) -> tuple[PathAnswer, ...]:
    """Use all `paths` at the same time, each on a thread of its own. Return what each answered, in the order of `paths`.

    others_s: wait so long for the others once one has confirmed the stop. each: called with every answer as it arrives.
    """
    arriving: queue.SimpleQueue[PathAnswer] = queue.SimpleQueue()
    for name, path in paths.items():
        threading.Thread(target=lambda path=path: arriving.put(path()), name=f"{_ASKING}{name}", daemon=True).start()
    answers: dict[str, PathAnswer] = {}
    until_s: float | None = None
    while len(answers) < len(paths):
        try:
            answer = arriving.get(timeout=None if until_s is None else max(until_s - time.monotonic(), 0.0))
        except queue.Empty:
            break
        answers[answer.path] = answer
        each(answer)
        if answer.confirmed and until_s is None:
            until_s = time.monotonic() + others_s
    return tuple(answers.get(name) or PathAnswer(name, False, False, "no answer yet") for name in paths)


def still_asking() -> bool:
    """Return whether a path of `stop_over` in this process is still waiting."""
    return any(thread.name.startswith(_ASKING) for thread in threading.enumerate())
