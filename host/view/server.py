"""The page's server: loopback only, for pages of its own only, and no reader can slow it or the rig."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections import deque
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import orjson
import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from host.view.connections import LimitedHttp
from host.view.source import Source, refusal

ADDRESS = "127.0.0.1"
FRAMES_PER_S = 30
# Frames that wait for one page: what it has not read in an eighth of a second is old, the oldest goes first.
WAITING_FRAMES = 4
MAX_PAGES, MAX_ASKED_AT_ONCE, MAX_MESSAGE_BYTES = 8, 4, 1024
# A page that takes nothing for so long is gone: its connection is given up.
STUCK_S = 10.0
# The web socket's own pings: a client that answers none in this time is disconnected.
PING_S = 5.0
# A page that has not answered a ping for this long is gone. A browser on a busy computer needs some seconds.
GONE_S = 20.0
# What a page sends every second, so that pages in use and idle connections are distinguished.
PRESENT = '"present"'
REPLACED = "closed, because newer pages were opened; reload to open it again"
STATIC = Path(__file__).parent / "static"
_POLICY = (
    "default-src 'self'; style-src 'self'; script-src 'self'; img-src 'self' data:; connect-src 'self'; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)


class Guard:
    """Lets through only requests to this address by its own names, and web sockets only from its own pages.

    A page of another site can neither read (its Host is another: DNS rebinding) nor command (its Origin is another).
    """

    def __init__(self, app: ASGIApp, port: int) -> None:
        self._app = app
        self._hosts = {f"{name}:{port}".encode() for name in (ADDRESS, "localhost")}
        self._origins = {b"http://" + host for host in self._hosts}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or refuse it with status 403 or by closing the web socket."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        problem = self._problem(scope)
        if not problem:
            await self._app(scope, receive, _with_policy(send))
        elif scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 1008, "reason": problem})
        else:
            await PlainTextResponse(f"seldinger: {problem}\n", 403)(scope, receive, send)

    def _problem(self, scope: Scope) -> str:
        hosts = [value for name, value in scope["headers"] if name == b"host"]
        origins = [value for name, value in scope["headers"] if name == b"origin"]
        if len(hosts) != 1 or hosts[0] not in self._hosts:
            return "a Host that is not this machine's loopback address"
        if any(origin not in self._origins for origin in origins) or (scope["type"] == "websocket" and len(origins) != 1):
            return "an Origin that is not this page's"
        if scope["type"] == "http" and scope["method"] not in ("GET", "HEAD"):
            return "HTTP is read-only here"
        return ""


def _with_policy(send: Send) -> Send:
    async def answer(message: Message) -> None:
        if message["type"] == "http.response.start":
            message["headers"] = [
                *message["headers"],
                (b"content-security-policy", _POLICY.encode()),
                (b"x-content-type-options", b"nosniff"),
                (b"referrer-policy", b"no-referrer"),
                (b"cache-control", b"no-cache"),
            ]
        await send(message)

    return answer


class Page:
    """One open page: a short queue that drops its oldest frame, and the task that sends it at the page's speed."""

    def __init__(self, socket: WebSocket) -> None:
        self._socket = socket
        self._frames: deque[bytes] = deque(maxlen=WAITING_FRAMES)
        self._answers: deque[bytes] = deque(maxlen=2 * MAX_ASKED_AT_ONCE)
        self._something = asyncio.Event()
        self.replaced = asyncio.Event()
        self.dropped = 0
        # Loop time of the newest message; minus infinity before the first: an idle client gives way before a page in use.
        self.received_s = -math.inf

    def offer(self, frame: bytes) -> None:
        """Queue a frame without waiting; the oldest waiting frame is dropped when the queue is full."""
        self.dropped += len(self._frames) == WAITING_FRAMES
        self._frames.append(frame)
        self._something.set()

    def answer(self, content: dict[str, Any]) -> None:
        """Queue an answer before all waiting frames."""
        self._answers.append(orjson.dumps({"answer": content}))
        self._something.set()

    async def send_on(self) -> None:
        """Send frames as they come. Raises TimeoutError when the page has taken nothing for STUCK_S."""
        while True:
            await self._something.wait()
            self._something.clear()
            while self._answers or self._frames:
                message = (self._answers or self._frames).popleft()
                await asyncio.wait_for(self._socket.send_text(message.decode()), STUCK_S)


class ViewServer:
    """Serves `source` on loopback. `app` is the ASGI application; `serve` runs it."""

    def __init__(self, source: Source, port: int) -> None:
        self._source, self.port = source, port
        self.pages: dict[Page, None] = {}  # in the order of their opening
        self.app = Guard(
            Starlette(
                lifespan=self._lifespan,
                routes=[
                    Route("/", lambda request: FileResponse(STATIC / "index.html")),
                    Route("/favicon.ico", _nothing),
                    WebSocketRoute("/rig", self._rig),
                    Mount("/static", StaticFiles(directory=STATIC)),
                ],
            ),
            port,
        )

    @contextlib.asynccontextmanager
    async def _lifespan(self, app: Starlette) -> AsyncIterator[None]:
        # The first frame loads and compiles the models: on another thread than the loop, so that nothing waits for it.
        await asyncio.to_thread(self._source.frame)
        beat = asyncio.create_task(self._beat())
        yield
        beat.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await beat

    async def _beat(self) -> None:
        """One frame for all pages, thirty times a second; frames that are late are not made up for."""
        clock = asyncio.get_running_loop().time
        due_s = clock()
        while True:
            frame = self._source.frame()
            if self.pages:
                packed = orjson.dumps({"frame": frame})
                for page in self.pages:
                    page.offer(packed)
            due_s = max(due_s + 1.0 / FRAMES_PER_S, clock())
            await asyncio.sleep(due_s - clock())

    async def _rig(self, socket: WebSocket) -> None:
        await socket.accept()
        page = Page(socket)
        await asyncio.wait_for(socket.send_text(orjson.dumps({"hello": self._source.hello()}).decode()), STUCK_S)
        # A new page always gets in, so that a stop button can always be opened; the one without use for longest goes.
        if len(self.pages) >= MAX_PAGES:
            oldest = min(self.pages, key=lambda other: other.received_s)
            self.pages.pop(oldest, None)
            oldest.replaced.set()
        self.pages[page] = None
        tasks = [
            asyncio.create_task(page.send_on()),
            asyncio.create_task(self._listen(socket, page)),
            asyncio.create_task(page.replaced.wait()),
        ]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                with contextlib.suppress(WebSocketDisconnect, TimeoutError):
                    task.result()
        finally:
            self.pages.pop(page, None)
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            if socket.application_state is not WebSocketState.DISCONNECTED:
                code, reason = (1013, REPLACED) if page.replaced.is_set() else (1000, "")
                with contextlib.suppress(RuntimeError, OSError, WebSocketDisconnect):
                    await asyncio.wait_for(socket.close(code, reason), 1.0)

    async def _listen(self, socket: WebSocket, page: Page) -> None:
        """Take in what the page asks; each is answered, none waits for another."""
        asked: set[asyncio.Task[None]] = set()
        while True:
            message = await socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            page.received_s = asyncio.get_running_loop().time()
            text = message.get("text")
            if text == PRESENT:
                continue
            if text is None or len(text.encode()) > MAX_MESSAGE_BYTES:
                page.answer(refusal(f"message: found no text of at most {MAX_MESSAGE_BYTES} bytes, wanted one"))
                continue
            if len(asked) >= MAX_ASKED_AT_ONCE and "stop" not in text:
                page.answer(refusal("too many questions at once", "refused"))
                continue
            task = asyncio.create_task(self._act(text, page))
            asked.add(task)
            task.add_done_callback(asked.discard)

    async def _act(self, text: str, page: Page) -> None:
        page.answer(await asyncio.to_thread(self._source.act, text))

    def configuration(self) -> uvicorn.Config:
        """How `app` is served: on loopback, with small messages in."""
        return uvicorn.Config(
            self.app,
            host=ADDRESS,
            port=self.port,
            log_level="warning",
            ws_max_size=4 * MAX_MESSAGE_BYTES,
            ws_max_queue=8,
            http=LimitedHttp,
            ws="websockets-sansio",
            ws_ping_interval=PING_S,
            ws_ping_timeout=GONE_S,
            server_header=False,
            timeout_graceful_shutdown=1,
        )

    def serve(self) -> None:
        """Serve until SIGINT or SIGTERM. Raises SystemExit where the port is taken."""
        server = uvicorn.Server(self.configuration())
        # The server takes signals only once its event loop runs; an exception before that would leave the loop half made.
        with server.capture_signals():
            server.run()


async def _nothing(request: Request) -> Response:
    return Response(status_code=204)
