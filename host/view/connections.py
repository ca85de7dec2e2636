"""HTTP connections of the page's server: half-open ones time out, and idle ones give way to new ones."""

from __future__ import annotations

import asyncio
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

# A connection without a whole request in this time is closed: idle, half a request, or kept alive without use.
REQUEST_S = 5.0
# With so many connections the one that has been idle longest is closed, so that a new page always gets in.
MAX_CONNECTIONS = 64


class LimitedHttp(H11Protocol):
    """HTTP/1.1 of uvicorn with these limits. A connection that became a web socket is not counted."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.idle_since_s = 0.0
        self._watch: asyncio.TimerHandle | None = None

    @property
    def idle(self) -> bool:
        """Return whether no request is being answered."""
        return self.cycle is None or self.cycle.response_complete

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Accept the connection; if there are too many, close the one that has been idle longest."""
        super().connection_made(transport)
        self.idle_since_s = self.loop.time()
        self._watch = self.loop.call_later(REQUEST_S, self._close_if_idle)
        idle = [other for other in self.connections if isinstance(other, LimitedHttp) and other.idle and other is not self]
        if len(self.connections) > MAX_CONNECTIONS and idle:
            min(idle, key=lambda other: other.idle_since_s).transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the idle timer of a closed connection."""
        self._end_watch()
        super().connection_lost(exc)

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        """Hand the connection over to the web socket, which has limits of its own."""
        self._end_watch()
        super().handle_websocket_upgrade(event)

    def on_response_complete(self) -> None:
        """Count the connection as idle from now on."""
        self.idle_since_s = self.loop.time()
        super().on_response_complete()

    def _close_if_idle(self) -> None:
        left_s = self.idle_since_s + REQUEST_S - self.loop.time()
        if self.idle and left_s <= 0.0:
            self.transport.abort()
            return
        self._watch = self.loop.call_later(max(left_s, 0.1) if self.idle else REQUEST_S, self._close_if_idle)

    def _end_watch(self) -> None:
        if self._watch is not None:
            self._watch.cancel()
            self._watch = None
