"""A TCP server that sends the same bytes to all its clients and never waits for one of them."""

from __future__ import annotations

import contextlib
import socket

# A client that does not read is disconnected once so much waits for it.
WAITING_BYTES = 1 << 16


class BroadcastServer:
    """Listens at `address` (host, port; port 0: a free one). Raises OSError where that is not possible."""

    def __init__(self, address: tuple[str, int]) -> None:
        family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        self._listener = socket.create_server(address, family=family)
        self._listener.setblocking(False)
        self._clients: list[socket.socket] = []

    @property
    def address(self) -> tuple[str, int]:
        """Return host and port at which the server listens."""
        host, port = self._listener.getsockname()[:2]
        return str(host), int(port)

    @property
    def clients(self) -> int:
        """Return the number of connected clients."""
        return len(self._clients)

    def accept(self) -> None:
        """Accept waiting clients; read and drop the bytes that clients send."""
        if self._listener.fileno() < 0:
            return
        with contextlib.suppress(BlockingIOError):
            while True:
                client, _ = self._listener.accept()
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, WAITING_BYTES)
                client.setblocking(False)
                self._clients.append(client)
        for client in list(self._clients):
            with contextlib.suppress(BlockingIOError):
                try:
                    gone = client.recv(4096) == b""
                except ConnectionError:
                    gone = True
                if gone:
                    self._drop(client)

    def send(self, data: bytes) -> None:
        """Send `data` to every client; disconnect a client that does not accept all of it."""
        for client in list(self._clients):
            try:
                whole = client.send(data) == len(data)
            except OSError:
                whole = False
            if not whole:
                self._drop(client)

    def close(self) -> None:
        """Disconnect all clients and stop listening; a second call does nothing."""
        for client in list(self._clients):
            self._drop(client)
        self._listener.close()

    def _drop(self, client: socket.socket) -> None:
        self._clients.remove(client)
        client.close()
