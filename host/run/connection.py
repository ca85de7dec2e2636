"""A running rig from Python: read its topics and, with the lease, command it."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

from host.run.commander import Acknowledgement, Commander
from protocol.enums import JogAxis
from protocol.errors import Description, InputError
from protocol.jog_limits import fastest_jog
from protocol.local_paths import listens
from protocol.rig_file import AXES, SIMULATED_RIG, Rig, load_rig
from protocol.topics import TOPICS, Log, Message, decode
from protocol.zenoh_access import CA_FILE, CERTIFICATE_FILE, KEY_FILE
from protocol.zenoh_session import Latest, Session

READABLE = tuple(name for name, topic in TOPICS.items() if topic.kind != "query")
POLL_S = 0.002
_NOTHING = "nothing was commanded"
KEY_FILES = (CA_FILE, CERTIFICATE_FILE, KEY_FILE)


class CommandRefused(RuntimeError):
    """The rig did not carry out the command `action`. `acknowledgement` holds the result and the reason."""

    def __init__(self, action: str, acknowledgement: Acknowledgement) -> None:
        super().__init__(f"{action}: {acknowledgement.reason}")
        self.action, self.acknowledgement = action, acknowledgement


class RigConnection:
    """A connection to one rig; use it as a context.

    Reading needs nothing. `take` takes the lease, which is kept until `release` or the end of the context; with it `arm`,
    `goto`, `touch`, `force`, `jog`, `retract`, `zero`, `home`, `disarm` and `clear_fault` command the rig. `hold`, `mark`
    and `stop` need no lease.
    A command that the rig refuses raises CommandRefused with the rig's reason.
    """

    def __init__(self, rig: Rig, session: Session, name: str) -> None:
        """Read and command `rig` over `session` as commander `name`."""
        self.rig = rig
        self._session = session
        self._commander = Commander(session, name)
        self._latest: dict[str, Latest] = {}
        self._newest: dict[str, Message] = {}
        self._log: Any = None
        for topic in ("state", "commander", "board"):
            self._reader(topic)

    def first_cause(self) -> str:
        """Listen for a second; return the first cause of what holds the rig back, and its remedy; empty if nothing does."""
        from host.run.rig_status import read_status

        found = read_status(self._session, self.rig.name)
        return f"{found.cause} {found.remedy}" if found.cause else ""

    def latest(self, topic: str) -> Message | None:
        """Return the newest message of a topic, None where none has come since the connection or the first call.

        Parameters:
            topic: a name of docs/topics.md, for example "pose/tip" or "force/sensor".

        Raises:
            InputError: no such topic.
        """
        message = self._reader(topic).take()
        if message is not None:
            self._newest[topic] = message
        return self._newest.get(topic)

    def subscribe(self, topic: str, seconds: float) -> Iterator[Message]:
        """Yield the messages of a topic as they come.

        Parameters:
            topic: a name of docs/topics.md. seconds: how long to listen. The newest message counts: a reader that is
                slower than the topic misses some, and never slows the rig down.

        Raises:
            InputError: no such topic.
        """
        reader, end_s = self._reader(topic), time.monotonic() + seconds
        while time.monotonic() < end_s:
            message = reader.take()
            if message is None:
                time.sleep(POLL_S)
            else:
                yield message

    def status(self, timeout_s: float = 2.0) -> dict[str, Any]:
        """Return what the rig says of itself.

        Parameters:
            timeout_s: how long to wait for a rig from which nothing has come yet.

        Returns:
            `connected`; `phase`, `safety_action`, `cause`, `tip_m`, `force_N`, `target_force_N` (None where unknown);
            `holder`, who holds the lease; `board_fault`.
        """
        end_s = time.monotonic() + timeout_s
        while (state := self.latest("state")) is None and time.monotonic() < end_s:
            time.sleep(POLL_S)
        counts, board = self.latest("commander"), self.latest("board")
        return {
            "connected": state is not None,
            "phase": getattr(state, "mode", None),
            "safety_action": getattr(state, "safety_action", None),
            "cause": getattr(state, "cause", None),
            "tip_m": getattr(state, "tip_m", None),
            "force_N": getattr(state, "force_N", None),
            "target_force_N": getattr(state, "target_force_N", None),
            "holder": getattr(counts, "holder", None),
            "board_fault": getattr(board, "fault_name", None),
        }

    def take(self) -> None:
        """Take the lease, and keep it. Raises CommandRefused while another commander holds it."""
        self._said("take", self._commander.take())

    def release(self) -> None:
        """Release the lease. A motion in progress continues as commanded."""
        self._said("release", self._commander.release())

    def arm(self) -> None:
        """Arm the board and the loop; the rig holds its position. Raises CommandRefused."""
        self._said("arm", self._commander.arm())

    def disarm(self) -> None:
        """Bring the stages to rest and disarm the board. Raises CommandRefused."""
        self._said("disarm", self._commander.disarm())

    def goto(self, position_m: Sequence[float]) -> None:
        """Move the tip to `position_m` (3,), base frame, m. Returns at once. Raises CommandRefused."""
        self._said("goto", self._commander.target(position_m))

    def touch(self, position_m: Sequence[float], normal: Sequence[float], force_N: float) -> None:
        """Approach the tissue and hold a force on it. Returns at once.

        Parameters:
            position_m: (3,) where the tissue is, base frame, m. normal: (3,) unit vector into the tissue, base frame.
            force_N: contact force to hold, N.

        Raises:
            CommandRefused: the rig says why.
        """
        self._said("touch", self._commander.press(position_m, normal, force_N))

    def force(self, force_N: float) -> None:
        """Change the contact force, N, of the present touch. Raises CommandRefused."""
        self._said("force", self._commander.force(force_N))

    def hold(self) -> None:
        """Hold the position. Needs no lease. Raises CommandRefused."""
        self._said("hold", self._commander.hold())

    def retract(self) -> None:
        """Move away from the tissue, then stop. Raises CommandRefused."""
        self._said("retract", self._commander.retract())

    def stop(self) -> None:
        """Stop the rig; after it, it needs `disarm` and `arm`. Needs no lease. Raises CommandRefused without an answer."""
        self._said("stop", self._commander.stop())

    def jog(self, axis: str, travel: float, speed: float | None = None, direction: Sequence[float] | None = None) -> None:
        """Move one axis, or the tip, a short way, then hold. Ends early where it touches something. Returns at once.

        Parameters:
            axis: "insertion", "roll", "knob", or "tip". travel: m for tip and insertion, rad for roll and knob; the sign is
                the direction. speed: m/s or rad/s; default half of the greatest that the rig allows.
            direction: (3,) unit vector for the tip, base frame.

        Raises:
            InputError: no such axis.
            CommandRefused: the rig says which limit binds.
        """
        if axis not in JogAxis.labels():
            raise InputError("axis", axis, "one of " + ", ".join(JogAxis.labels()))
        if speed is None:
            speed = 0.5 * fastest_jog(self.rig, JogAxis[axis.upper()])
        self._said("jog", self._commander.jog(axis, travel, speed, direction))

    def zero(self) -> None:
        """Make the force sensor's present load its zero; the tip has to hang free. Raises CommandRefused."""
        self._said("zero", self._commander.zero())

    def home(self, axis: str) -> None:
        """Move one axis of the disarmed rig to its home switch. Returns at once; `logged("home")` says how it ended.

        Parameters:
            axis: "insertion", "roll" or "knob", of an axis with `home_end` in the rig file.

        Raises:
            InputError: no such axis.
            CommandRefused: the rig says why.
        """
        if axis not in AXES:
            raise InputError("axis", axis, "one of " + ", ".join(AXES))
        self.logged("home")
        self._said("home", self._commander.home(axis))

    def logged(self, source: str) -> list[str]:
        """Return the lines of `source` in the rig's log since the last call, oldest first; at most the newest 64 lines."""
        if self._log is None:
            self._log = self._session.ring("log", 64)
        lines: list[str] = []
        while (sample := self._log.try_recv()) is not None:
            with contextlib.suppress(ValueError):
                line = decode(Log, bytes(sample.payload))
                lines += [line.text] if line.source == source else []
        return lines

    def mark(self, note: str) -> None:
        """Put a note (at most 500 characters) into log and recording. Needs no lease. Raises CommandRefused."""
        self._said("mark", self._commander.mark(note))

    def clear_fault(self) -> None:
        """Clear latched faults and leave the rig disarmed. Raises CommandRefused."""
        self._said("clear_fault", self._commander.clear_fault())

    def close(self) -> None:
        """Release the lease, if it is held, and close the connection."""
        self._commander.close()
        self._session.close()

    def __enter__(self) -> RigConnection:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def _reader(self, topic: str) -> Latest:
        if topic not in READABLE:
            raise InputError("topic", topic, "one of " + ", ".join(READABLE))
        if topic not in self._latest:
            self._latest[topic] = self._session.latest(topic)
        return self._latest[topic]

    @staticmethod
    def _said(action: str, answer: Acknowledgement) -> None:
        if not answer.accepted:
            raise CommandRefused(action, answer)


def connect(
    rig: str | os.PathLike[str] | Rig,
    name: str = "python",
    *,
    endpoint: str | None = None,
    keys: str | os.PathLike[str] | None = None,
) -> RigConnection:
    """Connect to a running rig.

    Parameters:
        rig: the rig's file (TOML), "simulated" for the simulated rig, or a checked `Rig`.
        name: name under which commands are given, 1 to 32 of a-z, 0-9, - and _; across machines that of the certificate.
        endpoint: where a rig on another machine listens, `tls/HOST:PORT`; default: this machine, as the rig file says.
        keys: folder with the certificate for `endpoint`, as `seldinger keys issue` made it.

    Returns:
        RigConnection, a context: `status()`, `latest(topic)`, `subscribe(topic, seconds)`; `take()` takes the lease, with
        which `arm()`, `goto(...)`, `touch(...)`, `retract()` and others command the rig; `stop()` needs no lease.

    Raises:
        InputError: the rig file is not good, or `endpoint` and `keys` do not go together.
        OSError: no rig answers at `endpoint`, or the certificate is refused.

    Source:
        Topics and roles: docs/topics.md and docs/security.md.

    Examples:
        >>> with connect("rig.toml") as rig:  # doctest: +SKIP
        ...     print(rig.status()["phase"])
    """
    read = rig if isinstance(rig, Rig) else load_rig(SIMULATED_RIG if rig == "simulated" else os.fspath(rig))
    session = open_session(read, endpoint, keys)
    try:
        return RigConnection(read, session, name)
    except ValueError as error:
        session.close()
        raise InputError.from_sentence(str(error)) from None


def may_run(rig: Rig) -> bool:
    """Return whether a rig may run on this computer: a process listens at a socket of it, or its file connects elsewhere.

    The sockets that a killed process leaves do not count.
    """
    return bool(rig.zenoh.connect) or listens(rig.local.stop_socket) or listens(rig.local.zenoh_socket)


def not_running(rig: Rig, endpoint: str | None = None) -> InputError:
    """Return the error of a command for a rig from which nothing comes: which of its processes runs, and what to do."""
    if endpoint:
        return InputError(
            "--endpoint", Description(f"no message from rig {rig.name} at {endpoint}"), f"a rig that runs; {_NOTHING}"
        )
    here = f"rig {rig.name} at {rig.local.folder}"
    realtime, model = listens(rig.local.stop_socket), listens(rig.local.zenoh_socket)
    if realtime and not model and not rig.zenoh.connect:
        found = f"the realtime process of {here} without its model process, through which commands go"
        wanted = f"both; {_NOTHING}. Start the model process again, or the whole rig. `seldinger stop` works without it"
    elif model and not realtime:
        found = f"the model process of {here} without its realtime process"
        wanted = f"both; {_NOTHING}. Start the realtime process again, or the whole rig"
    elif realtime:
        found = f"no message from {here}, though its processes are there"
        wanted = f"a rig that runs; {_NOTHING}. It may still be starting; if not, start it again"
    else:
        found = f"no message from {here}"
        wanted = (
            f"a rig that runs; {_NOTHING}. Start it (the simulated one by `seldinger view --simulated`), or give the rig "
            "file with which it was started"
        )
    return InputError("--rig", Description(found), wanted)


def open_session(rig: Rig, endpoint: str | None = None, keys: str | os.PathLike[str] | None = None) -> Session:
    """Open a session of `rig`, on this machine or, with `endpoint` and `keys`, on another. Raises as `connect` does."""
    if (endpoint is None) != (keys is None):
        raise InputError("keys" if keys is None else "endpoint", "nothing", "endpoint and keys together, or neither")
    try:
        if endpoint is not None and keys is not None:
            missing = [name for name in KEY_FILES if not (Path(keys) / name).is_file()]
            if missing:
                raise InputError(
                    "keys", os.fspath(keys), f"a folder that `seldinger keys issue` made; {missing[0]} is missing"
                )
            return Session.remote(rig.name, endpoint, Path(keys))
        return Session.of_rig(rig)
    except ValueError as error:
        raise InputError.from_sentence(str(error)) from None
