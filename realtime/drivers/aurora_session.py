"""How an Aurora is brought up: reset, speed, ports, tools, start; a script that waits for one reply at a time."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from dataclasses import dataclass, field
from typing import Protocol

from realtime.drivers import ndi_protocol as ndi
from realtime.drivers.device_events import DeviceEventKind
from realtime.drivers.tool_definition import PAGE_BYTES

POWER_UP_BAUD = 9600
BREAK_S = 0.25
ATTEMPTS = 3
# The device changes its speed this long after it has answered COMM.
COMM_SETTLE_S = 0.1
_INFO = ndi.PHINF_BASIC | ndi.PHINF_PART_NUMBER | ndi.PHINF_LOCATION


@dataclass(frozen=True, slots=True)
class LineAction:
    """Set the line to `baud`, then, with `break_s` above 0, hold a break that long."""

    baud: int
    break_s: float = 0.0


@dataclass(frozen=True, slots=True)
class SessionStep:
    """Send these bytes and wait for a text reply at most `wait_s`; or, with `pause`, wait that long for nothing."""

    phase: str
    send: bytes
    wait_s: float
    pause: bool = False


@dataclass(frozen=True)
class AuroraConfig:
    """tools: wanted port handles, () for all; latency_s: from sampling to the first byte of a reply at no waiting;
    baud: speed after start-up; reply: "BX" (binary) or "TX" (text); poll_gap_s: pause between a reply
    without a new frame and the next poll; settle_frames: frames from which times are learned before poses are reported
    (the first frame seen may be nearly a period old); frozen_after: identical poses in a row, bit for bit, after which
    the tool counts as frozen (measurements have noise), 0: never; definitions: port handle -> content for a tool without
    a memory of its own, whole pages of 64 bytes (`tool_definition.read_definition`)."""

    tools: tuple[str, ...] = ("0A", "0B")
    rate_hz: float = 40.0
    latency_s: float = 0.025
    baud: int = 921600
    reply: str = "BX"
    beeps: int = 2
    poll_gap_s: float = 0.0005
    poll_timeout_s: float = 0.05
    reply_timeout_s: float = 3.0
    reset_timeout_s: float = 8.0
    retry_s: float = 0.5
    max_distance_m: float = 3.0
    settle_frames: int = 20
    frozen_after: int = 8
    definitions: Mapping[str, bytes] = field(default_factory=dict)

    def __post_init__(self) -> None:
        wanted = {
            "rate_hz": (self.rate_hz > 0, "more than 0"),
            "latency_s": (0 <= self.latency_s < 1, "0 to 1"),
            "baud": (self.baud in ndi.BAUD_CODES, f"one of {sorted(ndi.BAUD_CODES)}"),
            "reply": (self.reply in ("BX", "TX"), "BX or TX"),
            "beeps": (0 <= self.beeps <= 9, "0 to 9"),
            "poll_timeout_s": (self.poll_timeout_s > 0, "more than 0"),
        }
        for key, (good, text) in wanted.items():
            if not good:
                raise ValueError(f"{key}: found {getattr(self, key)!r}, wanted {text}")


class SessionClient(Protocol):
    """What the session's script needs of the client that runs it (`aurora.AuroraClient`)."""

    config: AuroraConfig
    firmware: str
    written: dict[str, int]  # bytes of the definition that each handle was given when it was last initialised

    def line(self, action: LineAction) -> None:
        """Queue a change of the line for the transport."""

    def event(self, kind: DeviceEventKind, text: str, now_ns: int | None = None) -> None:
        """Report an event of the device."""


class SessionFailed(Exception):
    """The start of the device failed; the text names the command and the reason."""


Script = Generator[SessionStep, str | None, dict[str, ndi.ToolInfo]]
_Part = Generator[SessionStep, str | None, str]


def set_up(client: SessionClient) -> Script:
    """Bring the device from an unknown state to tracking. Return the enabled tools by handle. Raises SessionFailed."""
    yield from _reset(client)
    yield from _command(client, "initialising", "INIT")
    client.firmware = (yield from _command(client, "initialising", "VER", "0")).split("\n")[0].strip()
    if client.config.baud != POWER_UP_BAUD:
        yield from _command(client, "initialising", "COMM", f"{ndi.BAUD_CODES[client.config.baud]}0000", attempts=1)
        yield SessionStep("initialising", b"", COMM_SETTLE_S, pause=True)
        client.line(LineAction(client.config.baud))
    if client.config.beeps:
        yield from _command(client, "initialising", "BEEP", str(client.config.beeps))
    return (yield from enumerate_and_start(client, stop_first=False))


def enumerate_and_start(client: SessionClient, stop_first: bool) -> Script:
    """Free unplugged tools, initialise new ones, enable the configured ones, start tracking. Raises SessionFailed."""
    if stop_first:
        yield from _command(client, "reading ports", "TSTOP")
    for handle, _ in ndi.parse_phsr((yield from _command(client, "reading ports", "PHSR", "01"))):
        yield from _command(client, "reading ports", "PHF", handle)
    yield from _initialise_tools(client)
    tools: dict[str, ndi.ToolInfo] = {}
    for handle, _ in ndi.parse_phsr((yield from _command(client, "reading ports", "PHSR", "00"))):
        if client.config.tools and handle not in client.config.tools:
            continue
        text = yield from _command(client, "reading ports", "PHINF", f"{handle}{_INFO:04X}")
        info = ndi.parse_phinf(text)
        if not info.status & ndi.PortStatus.INITIALISED:
            continue
        if not info.status & ndi.PortStatus.ENABLED:
            yield from _command(client, "enabling tools", "PENA", f"{handle}D")
        tools[handle] = info
    absent = [handle for handle in client.config.tools if handle not in tools]
    if absent:
        client.event(DeviceEventKind.ERROR, f"wanted tools not plugged in: {', '.join(absent)}")
    if not tools:
        raise SessionFailed("no tool to track")
    yield from _command(client, "starting", "TSTART")
    return tools


def _reset(client: SessionClient) -> Generator[SessionStep, str | None, None]:
    """Reset the device by a serial break, at any speed and in any mode; send RESET if the adapter ignores breaks."""
    client.line(LineAction(POWER_UP_BAUD, BREAK_S))
    if (yield SessionStep("resetting", b"", client.config.reset_timeout_s)) == "RESET":
        return
    for baud in dict.fromkeys((client.config.baud, POWER_UP_BAUD)):
        client.line(LineAction(baud))
        if (yield SessionStep("resetting", ndi.command("RESET", "0"), client.config.reply_timeout_s)) == "RESET":
            if baud != POWER_UP_BAUD:
                client.line(LineAction(POWER_UP_BAUD))
            return
    raise SessionFailed("no answer to a reset: is the Aurora switched on, and is this its port?")


def _initialise_tools(client: SessionClient) -> Generator[SessionStep, str | None, None]:
    """Send PINIT until all handles are initialised: a tool with two sensors creates a second handle."""
    refused: set[str] = set()
    while True:
        waiting = [
            handle
            for handle, _ in ndi.parse_phsr((yield from _command(client, "reading ports", "PHSR", "02")))
            if handle not in refused
        ]
        if not waiting:
            return
        for handle in waiting:
            refused.add(handle)
            try:
                yield from _write_definition(client, handle)
                yield from _command(client, "initialising tools", "PINIT", handle)
            except SessionFailed as failed:
                client.event(DeviceEventKind.ERROR, str(failed))


def _write_definition(client: SessionClient, handle: str) -> Generator[SessionStep, str | None, None]:
    """Write the tool's definition page by page, if it has one: `PVWR` with handle, address and 64 bytes in hexadecimal."""
    client.written.pop(handle, None)
    content = client.config.definitions.get(handle, b"")
    for address in range(0, len(content), PAGE_BYTES):
        page = content[address : address + PAGE_BYTES].hex().upper()
        yield from _command(client, "writing tool definitions", "PVWR", f"{handle}{address:04X}{page}")
    if content:
        client.written[handle] = len(content)


def _command(client: SessionClient, phase: str, name: str, parameters: str = "", attempts: int = ATTEMPTS) -> _Part:
    """Send one command and return its reply. Without an answer (a damaged command or reply) it is sent again."""
    for _ in range(attempts):
        reply = yield SessionStep(phase, ndi.command(name, parameters), client.config.reply_timeout_s)
        if reply is None:
            continue
        if reply.startswith("ERROR"):
            if reply[5:7] == "04":
                continue
            raise SessionFailed(f"{name} {_short(parameters)}: {ndi.describe_reply(reply)}")
        if reply.startswith("WARNING"):
            client.event(DeviceEventKind.WARNING, f"{name} {_short(parameters)}: {ndi.describe_reply(reply)}")
        return reply
    raise SessionFailed(
        f"{name} {_short(parameters)}: no answer in {attempts} attempts of {client.config.reply_timeout_s} s"
    )


def _short(parameters: str) -> str:
    """Return a command's parameters for a message, without the content of a memory page."""
    return parameters if len(parameters) <= 16 else f"{parameters[:6]}..."
