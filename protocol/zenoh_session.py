"""Zenoh, opened safely: this machine only, no scouting, newest value wins, a frozen reader never blocks a writer."""

from __future__ import annotations

import atexit
import contextlib
import ipaddress
import json
import logging
import re
import threading
import time
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import zenoh

from protocol.local_paths import SOCKET_MODE, LocalPaths
from protocol.reply_seal import is_proved
from protocol.rig_file import Rig
from protocol.topics import MAX_PAYLOAD_BYTES, TOPICS, Command, Message, Reply, decode, encode, key, request_key, topic_of
from protocol.zenoh_access import Network, check_network_endpoint, client_settings, network_settings

logger = logging.getLogger("seldinger.requests")
RECORDER_DEPTH = 4096
_REQUESTS_WAITING, _REQUESTS_A_TURN, _TURN_S = 256, 32, 0.002
_SETTINGS: dict[str, Any] = {
    # Without gossip, peers of one peer never connect to each other, and a client will not open before its router is up.
    # Routers do neither: each passes messages on along the links that exist, and keeps trying those that do not.
    "mode": "router",
    "listen/exit_on_failure": True,
    # -1: keep trying for ever, so that either side may start later or restart; and do not wait for it to open.
    "connect/timeout_ms": -1,
    "connect/exit_on_failure": False,
    "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2},
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "adminspace/enabled": False,
    "transport/shared_memory/enabled": False,
    # Zenoh would let each put wait 1 ms for a reader that has stopped: at 1 kHz that is all the time there is.
    "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 0,
    # With 16 batches (and messages sharing them) a burst of thousands to a live reader loses none; with 2, half.
    "transport/link/tx/queue/size/data": 16,
    "transport/link/tx/lease": 2000,
    "transport/link/tx/keep_alive": 4,
    # Zenoh would gather a message of 1 GiB before anyone can refuse it; and what no reader takes is not passed on.
    "transport/link/rx/max_message_size": 1_048_576,
    "low_pass_filter": [
        {
            "id": "longest",
            "flows": ["ingress"],
            "messages": ["put", "query", "reply"],
            "key_exprs": ["**"],
            "size_limit": 4 * MAX_PAYLOAD_BYTES,
        }
    ],
}
# Wait before the next attempt to end a publisher or subscriber that another thread is in a call of.
_IN_USE_S = 0.0005
_ENDED = "found a publisher or subscriber that is ended, wanted one that is declared"
_TCP = re.compile(r"tcp/(\[[0-9a-fA-F:]+\]|[^:/\[\]]+):(\d{1,5})")


def check_endpoint(endpoint: str) -> str:
    """Return `endpoint` if it stays on this machine: tcp on a loopback address, or a unix socket. Raises ValueError."""
    wanted = f"endpoint: found {endpoint!r}, wanted tcp/127.0.0.1:PORT, tcp/[::1]:PORT or unixsock-stream/PATH"
    if endpoint.startswith("unixsock-stream/") and not re.search(r"[#?;\s]", endpoint) and len(endpoint) > 16:
        return endpoint
    match = _TCP.fullmatch(endpoint)
    if not match or not 0 < int(match[2]) < 65536:
        raise ValueError(wanted)
    try:
        loopback = ipaddress.ip_address(match[1].strip("[]")).is_loopback
    except ValueError:
        raise ValueError(wanted) from None
    if not loopback:
        raise ValueError(wanted)
    return endpoint


def configuration(listen: list[str], connect: list[str], network: Network | None = None) -> zenoh.Config:
    """Return a zenoh configuration with these endpoints only. Raises ValueError for endpoints outside this machine.

    network: what it also listens on for other machines; without it nothing leaves this one.
    """
    settings = _SETTINGS | {
        "listen/endpoints": [check_endpoint(endpoint) for endpoint in listen],
        "connect/endpoints": [check_endpoint(endpoint) for endpoint in connect],
    }
    if network is not None:
        settings["listen/endpoints"] += [check_network_endpoint(endpoint) for endpoint in network.listen]
        settings |= network_settings(network)
    return _config(settings)


def _config(settings: dict[str, Any]) -> zenoh.Config:
    config = zenoh.Config()
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    return config


class _Entity:
    """A publisher or subscriber of zenoh's, for several threads: a call while another thread ends it raises ZError.

    zenoh 1.x lends its Python object to each call, so that ending one that is in use, and using one that is ended in
    the same moment, raises RuntimeError.
    """

    def __init__(self, entity: zenoh.Publisher | zenoh.Subscriber[Any]) -> None:
        self._entity: Any = entity
        self._ended = False

    def _call(self, call: Callable[..., Any], *arguments: Any) -> Any:
        """Call a method of the entity. Raises ZError once it is ended."""
        if self._ended:
            raise zenoh.ZError(_ENDED)
        try:
            return call(*arguments)
        except RuntimeError:
            raise zenoh.ZError(_ENDED) from None

    def undeclare(self) -> None:
        """End it, after the calls that are in it; later calls raise ZError, and nothing arrives."""
        self._ended = True
        while True:
            try:
                self._entity.undeclare()
                return
            except RuntimeError:
                time.sleep(_IN_USE_S)


class Publisher(_Entity):
    """Publishes one topic, numbered. `put` never blocks: a message that a reader does not read in time is dropped.

    refused, complaint: how many messages were not sent because a field was out of bounds, and the newest reason.
    """

    def __init__(self, session: zenoh.Session, rig: str, topic: str) -> None:
        self.topic = TOPICS[topic]
        self.sequence = 0
        self.refused = 0
        self.complaint = ""
        super().__init__(
            session.declare_publisher(key(rig, topic), congestion_control=zenoh.CongestionControl.DROP, express=False)
        )

    def put(self, message: Message) -> None:
        """Publish `message`, or count it as refused, so that a wrong value of a device does not end its thread.

        Raises:
            TypeError: The message is of another topic's class.
        """
        if type(message) is not self.topic.message:
            raise TypeError(f"{self.topic.name}: found {type(message).__name__}, wanted {self.topic.message.__name__}")
        try:
            payload = encode(message, self.sequence)
        except ValueError as error:
            self.refused += 1
            self.complaint = str(error)
            return
        self._call(self._entity.put, payload)
        self.sequence += 1


class RecentSamples(_Entity):
    """The newest `depth` messages of one topic, as zenoh's samples."""

    def __init__(self, session: zenoh.Session, rig: str, topic: str, depth: int) -> None:
        super().__init__(session.declare_subscriber(key(rig, topic), zenoh.handlers.RingChannel(depth)))

    def try_recv(self) -> zenoh.Sample | None:
        """Return the oldest sample that waits, None if none does."""
        sample: zenoh.Sample | None = self._call(self._entity.try_recv)
        return sample


class Latest(RecentSamples):
    """The newest value of one topic. Older ones are dropped; malformed ones are counted and not returned."""

    def __init__(self, session: zenoh.Session, rig: str, topic: str) -> None:
        self.topic = TOPICS[topic]
        self.malformed = 0
        self.complaint = ""
        super().__init__(session, rig, topic, 1)

    def take(self) -> Message | None:
        """Return the newest message since the last call, None if there is none or it is malformed."""
        sample = self.try_recv()
        if sample is None:
            return None
        try:
            return decode(self.topic.message, bytes(sample.payload))
        except ValueError as error:
            self.malformed += 1
            self.complaint = str(error)
            return None


class Everything:
    """All topics of a rig, in order, for a recorder; long queues that drop their oldest messages if it is too slow."""

    def __init__(self, session: zenoh.Session, rig: str, depth: int = RECORDER_DEPTH) -> None:
        self.malformed = 0
        self.complaint = ""
        self._depth = depth
        names = [name for name, topic in TOPICS.items() if topic.kind != "query"]
        self._subscribers = [RecentSamples(session, rig, name, depth) for name in names]

    def take(self) -> list[tuple[str, Message, bytes]]:
        """Return (topic, message, payload) of all messages since the last call, topic by topic."""
        taken = []
        for subscriber in self._subscribers:
            # No more than a ring holds: a publisher that is faster than this reader must not keep it here.
            for _ in range(self._depth):
                sample = subscriber.try_recv()
                if sample is None:
                    break
                payload = bytes(sample.payload)
                try:
                    _, topic = topic_of(str(sample.key_expr))
                    taken.append((topic.name, decode(topic.message, payload), payload))
                except ValueError as error:
                    self.malformed += 1
                    self.complaint = str(error)
        return taken

    def undeclare(self) -> None:
        """End the subscriptions."""
        for subscriber in self._subscribers:
            subscriber.undeclare()


_Declared = TypeVar("_Declared", Publisher, Latest, RecentSamples, Everything)


class RequestServer:
    """Answers requests, one at a time: answer(name, payload) -> Reply, None for no reply at all.

    prove(payload) -> proof goes with each reply, so that a client can refuse replies of other programs.

    `name` is the last part of the key that a request came on. Across machines the access control of the session that
    listens there lets a certificate ask under its own name only. Requests wait in a ring of zenoh's: what a flood puts
    there beyond what one thread takes in its turns is dropped, and costs the other threads of this process nothing.
    """

    def __init__(
        self,
        session: zenoh.Session,
        rig: str,
        answer: Callable[[str, bytes], Reply | None],
        prove: Callable[[bytes], bytes] | None = None,
    ) -> None:
        self._prefix, self._give, self._prove = f"{key(rig, 'request')}/", answer, prove
        self.failures = 0
        self._queryable = session.declare_queryable(
            request_key(rig, "*"), zenoh.handlers.RingChannel(_REQUESTS_WAITING), complete=True
        )
        self._thread = threading.Thread(target=self._serve, name="requests", daemon=True)
        self._thread.start()

    def join(self, timeout_s: float = 2.0) -> None:
        """Wait for the thread, which ends when the session is closed: one still in zenoh at interpreter's exit aborts."""
        self._thread.join(timeout_s)

    def _serve(self) -> None:
        while True:
            try:
                self._answer(self._queryable.recv())
                for _ in range(_REQUESTS_A_TURN):
                    query = self._queryable.try_recv()
                    if query is None:
                        break
                    self._answer(query)
                else:
                    time.sleep(_TURN_S)
            except zenoh.ZError:  # the session was closed
                return

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            name = str(query.key_expr).removeprefix(self._prefix)
            try:
                reply = self._give(name, b"" if query.payload is None else bytes(query.payload))
                if reply is not None and "*" not in name:
                    said = encode(reply)
                    query.reply(query.key_expr, said, attachment=None if self._prove is None else self._prove(said))
            except Exception:  # one request must not end the answering of all others, a stop among them
                self.failures += 1
                logger.exception("request from %s failed", name[:40])


def _open(config: zenoh.Config, listen: list[str]) -> zenoh.Session:
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        found = str(error).split(" at /")[0]
        if "Unable to acquire lock" in found:
            raise OSError(
                f"zenoh: found another process that listens on {', '.join(listen)}, wanted one; end it first"
            ) from None
        wanted = f"to listen on {', '.join(listen)}" if listen else "a rig that listens there and takes this certificate"
        raise OSError(f"zenoh: found {found}, wanted {wanted}") from None


class Session:
    """One open session of a rig. Use as a context, or `close` it.

    listen, connect: endpoints, as in `check_endpoint`; network: for other machines too. Normally one process
    listens and the others connect to it; those also reach each other through it. Who starts first does not matter.
    local: the rig's folder on this computer; with it only replies that the realtime process has proved are taken.
    Raises ValueError for an endpoint that leaves this machine, OSError where it cannot listen.
    """

    def __init__(
        self,
        rig: str,
        listen: list[str],
        connect: list[str],
        network: Network | None = None,
        local: LocalPaths | None = None,
    ) -> None:
        key(rig, "state")
        self.rig, self.local = rig, local
        self._servers: list[RequestServer] = []
        self._declared: weakref.WeakSet[Publisher | Latest | RecentSamples | Everything] = weakref.WeakSet()
        self.zenoh = _open(
            configuration(listen, connect, network), listen + list(network.listen if network is not None else ())
        )
        # A session that is open at the interpreter's end aborts it, with the message of a thread that is still in zenoh.
        atexit.register(self.close)

    @classmethod
    def of_rig(cls, rig: Rig) -> Session:
        """Open a session to the rig of a rig file on this computer."""
        return cls(rig.name, [], rig.connect_endpoints, local=rig.local)

    @classmethod
    def hub(cls, rig: Rig) -> Session:
        """The session at which all others of the rig meet: on the socket in its folder, and where the rig file says.

        Raises InputError for a folder that other users can write, OSError where it cannot listen.
        """
        paths = rig.local.prepare()
        session = cls(rig.name, rig.listen_endpoints, [], rig.access, paths)
        if paths.zenoh_socket.exists():  # zenoh leaves it to its user alone; the folder's group is to connect
            paths.zenoh_socket.chmod(SOCKET_MODE)
        return session

    @classmethod
    def remote(cls, rig: str, endpoint: str, keys: Path) -> Session:
        """Open a session to a rig on another machine, with the certificate in folder `keys`.

        Raises ValueError for an endpoint that is not TLS, OSError where no one answers or the certificate is refused.
        """
        key(rig, "state")
        session = cls.__new__(cls)
        session.rig, session.local, session._servers = rig, None, []
        session._declared = weakref.WeakSet()
        session.zenoh = _open(zenoh.Config.from_json5(json.dumps(client_settings(endpoint, keys))), [])
        atexit.register(session.close)
        return session

    def publisher(self, topic: str) -> Publisher:
        """Return a publisher of `topic`."""
        return self._keep(Publisher(self.zenoh, self.rig, topic))

    def latest(self, topic: str) -> Latest:
        """Return the newest value of `topic`, for a reader that needs only the newest."""
        return self._keep(Latest(self.zenoh, self.rig, topic))

    def ring(self, topic: str, depth: int) -> RecentSamples:
        """Return the newest `depth` messages of `topic`, for a reader that needs each of them."""
        return self._keep(RecentSamples(self.zenoh, self.rig, topic, depth))

    def everything(self) -> Everything:
        """Return all topics, for a recorder."""
        return self._keep(Everything(self.zenoh, self.rig))

    def _keep(self, declared: _Declared) -> _Declared:
        self._declared.add(declared)
        return declared

    def serve_requests(
        self, answer: Callable[[str, bytes], Reply | None], prove: Callable[[bytes], bytes] | None = None
    ) -> RequestServer:
        """Answer requests with `answer`; see RequestServer."""
        server = RequestServer(self.zenoh, self.rig, answer, prove)
        self._servers.append(server)
        return server

    def ask(self, command: Command, timeout_s: float = 1.0) -> Reply | None:
        """Send `command` and wait for its reply; None if no answer arrives in time. The command may still have arrived.

        Every program that says it answers requests gets the command: an impostor cannot keep it from the rig. Of the
        replies the first counts that is one to this command and, on the rig's computer, is proved.
        """
        try:
            replies = self.zenoh.get(
                request_key(self.rig, command.commander),
                payload=encode(command),
                timeout=timeout_s,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                congestion_control=zenoh.CongestionControl.DROP,
            )
            for answer in replies:
                reply = self._reply_of(answer, command)
                if reply is not None:
                    return reply
        except zenoh.ZError:
            pass
        return None

    def _reply_of(self, answer: zenoh.Reply, command: Command) -> Reply | None:
        if answer.ok is None:
            return None
        payload = bytes(answer.ok.payload)
        proof = b"" if answer.ok.attachment is None else bytes(answer.ok.attachment)
        if self.local is not None and not is_proved(self.local.reply_key, payload, proof):
            return None
        try:
            reply = decode(Reply, payload)
        except ValueError:
            return None
        # What cannot be read as a command has no id to be answered under.
        return reply if reply.id == command.id or reply.result == "malformed" else None

    def close(self) -> None:
        """Undeclare everything, close the links and end the threads that answer.

        The session that listens is closed last: one that is closed in the moment in which its link is lost can end with a
        panic of zenoh's router, which prints a Rust traceback. Where the other end answers the close by closing its link,
        that moment is this one: of zenoh 1.10, 13 of 1200 sessions with subscribers panicked, and 0 of 1650 that had
        undeclared them before.
        """
        atexit.unregister(self.close)
        for declared in list(self._declared):
            with contextlib.suppress(zenoh.ZError):
                declared.undeclare()
        self._declared.clear()
        self.zenoh.close()
        for server in self._servers:
            server.join()

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
