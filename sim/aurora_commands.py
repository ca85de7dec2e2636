"""The Aurora's command interpreter: modes, port handles, and replies written out byte by byte."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass

from realtime.drivers.ndi_protocol import crc16

FIRMWARE = "AURORA Control Firmware (emulated)\nNDI S/N: P6-00000\nCharacterization Date: 01/01/26\nFreeze Tag: none\n"
SPEEDS = {"0": 9600, "1": 14400, "2": 19200, "3": 38400, "4": 57600, "5": 115200, "6": 921600, "7": 1228739, "A": 230400}
# Errors as the device numbers them.
UNKNOWN, BAD_CRC, PARAMETERS, NO_HANDLE, BAD_PRIORITY = "01", "04", "07", "08", "09"
WRONG_MODE, NO_TOOL, NOT_INITIALISED, SYSTEM_NOT_INITIALISED, OUT_OF_RANGE = "0C", "0D", "0E", "10", "23"
NOT_ALLOCATED, NO_MEMORY = "2B", "1D"
MEMORY_BYTES, PAGE_BYTES = 2048, 64

# Modes in which a command is allowed; before INIT nearly nothing is.
_ANY, _SETUP, _TRACKING = ("power_up", "setup", "tracking"), ("setup",), ("tracking",)
_MODES = {
    "INIT": ("power_up", "setup"),
    "RESET": _ANY,
    "COMM": _ANY,
    "VER": _ANY,
    "APIREV": _ANY,
    "ECHO": _ANY,
    "BEEP": ("setup", "tracking"),
    "PHSR": _SETUP,
    "PHINF": _SETUP,
    "PHF": _SETUP,
    "PVWR": _SETUP,
    "PINIT": _SETUP,
    "PENA": _SETUP,
    "PDIS": _SETUP,
    "TSTART": _SETUP,
    "TSTOP": _TRACKING,
    "TX": _TRACKING,
    "BX": _TRACKING,
}


@dataclass(frozen=True)
class AuroraEmulatorConfig:
    """position_noise_m, orientation_noise_rad: standard deviation per axis; noise_correlation_s: 0 is white;
    frame_jitter_s: mean of an exponential delay on top of latency_s; clock_error: rate error of the device's clock
    (ratio, positive: fast); start_ns: time of frame 0; dropout, wild: chance per tool and frame."""

    handles: tuple[str, ...] = ("0A", "0B")
    rate_hz: float = 40.0
    latency_s: float = 0.025
    frame_jitter_s: float = 0.0005
    processing_s: float = 0.0002
    processing_jitter_s: float = 0.0002
    position_noise_m: float = 0.00029
    orientation_noise_rad: float = 0.0034907
    noise_correlation_s: float = 0.0
    clock_error: float = 0.0
    start_ns: int = 0
    dropout: float = 0.0
    wild: float = 0.0
    wild_m: float = 0.05
    init_s: float = 0.3
    reset_s: float = 0.5

    def __post_init__(self) -> None:
        if not self.rate_hz > 0 or not self.latency_s >= 0 or not abs(self.clock_error) < 0.01:
            raise ValueError(
                "aurora emulator: found rate_hz, latency_s or clock_error out of range, "
                "wanted > 0, >= 0 and below 0.01 in size"
            )


@dataclass(frozen=True, slots=True)
class Tracked:
    """State of one tool in one frame: flags by name, pose None if missing. Pose in mm."""

    flags: frozenset[str]
    pose: tuple[float, ...] | None


@dataclass(frozen=True, slots=True)
class AuroraFrame:
    """One measurement frame and the time from which replies can carry it."""

    number: int
    available_ns: int
    tools: dict[str, Tracked]


class Refused(Exception):
    """A command refused with the error code that is its text."""


@dataclass
class AuroraPort:
    """A port handle and the tool behind it; `defect`: error code with which PINIT fails (an unreadable SROM: 1E).

    blank: the tool has no memory of its own, so PINIT fails until the host has written `memory`, which a plug empties.
    """

    handle: str
    serial: str
    occupied: bool = True
    initialised: bool = False
    enabled: bool = False
    stale: bool = False
    allocated: bool = True
    defect: str = ""
    blank: bool = False
    memory: bytes = bytes(MEMORY_BYTES)

    def unplug(self) -> None:
        """The tool is pulled; its handle stays, stale, until it is freed."""
        self.occupied = self.initialised = self.enabled = False
        self.stale = self.allocated
        self.memory = bytes(MEMORY_BYTES)

    def plug(self) -> None:
        """A tool is plugged in and has a handle again."""
        self.occupied = self.allocated = True
        self.initialised = self.enabled = self.stale = False

    @property
    def status(self) -> int:
        """The port's status bits, without those that only a measurement sets."""
        return 0x01 * self.occupied | 0x10 * self.initialised | 0x20 * self.enabled


@dataclass(frozen=True)
class AuroraAnswer:
    """Reply, the time that the command takes, and whether the device restarts instead of replying."""

    reply: str | bytes
    takes_s: float = 0.0
    power_cycle: bool = False


class Console:
    """The interpreter's state: mode, speed, ports, latched system status."""

    def __init__(self, ports: dict[str, AuroraPort], config: AuroraEmulatorConfig) -> None:
        self.ports, self.config = ports, config
        self.reset()

    def reset(self) -> None:
        """Return to the state after switching on."""
        self.mode, self.baud, self.system_status = "power_up", 9600, 0
        self._next_baud: int | None = None
        for port in self.ports.values():
            port.initialised = port.enabled = port.stale = False
            port.allocated = port.occupied
            port.memory = bytes(MEMORY_BYTES)

    def settle(self) -> None:
        """Take up a new speed; called once the reply to COMM has been put on the line at the old one."""
        if self._next_baud is not None:
            self.baud, self._next_baud = self._next_baud, None

    def execute(self, line: bytes, frame: AuroraFrame | None) -> AuroraAnswer:
        """Carry out one command line (without its CR). `frame` is the newest measured one, for BX and TX."""
        try:
            name, parameters = _split(line)
            if name not in _MODES:
                raise Refused(UNKNOWN)
            if self.mode not in _MODES[name]:
                raise Refused(SYSTEM_NOT_INITIALISED if self.mode == "power_up" else WRONG_MODE)
            if name in ("BX", "TX"):
                return AuroraAnswer(self._poses(name, parameters, frame))
            if name == "RESET":
                return AuroraAnswer("", power_cycle=True)
            handler: Callable[[str], str] = getattr(self, f"_{name.lower()}")
            return AuroraAnswer(handler(parameters), self.config.init_s if name == "INIT" else 0.0)
        except Refused as refused:
            return AuroraAnswer(f"ERROR{refused}")

    def _init(self, parameters: str) -> str:
        self.mode = "setup"
        return "OKAY"

    def _comm(self, parameters: str) -> str:
        if len(parameters) != 5:
            raise Refused(PARAMETERS)
        if parameters[0] not in SPEEDS or parameters[1:] != "0000":
            raise Refused(OUT_OF_RANGE)
        self._next_baud = SPEEDS[parameters[0]]
        return "OKAY"

    def _ver(self, parameters: str) -> str:
        if parameters not in ("0", "4", "5"):
            raise Refused(OUT_OF_RANGE)
        return FIRMWARE

    def _apirev(self, parameters: str) -> str:
        return "D.001.007"

    def _echo(self, parameters: str) -> str:
        return parameters

    def _beep(self, parameters: str) -> str:
        if parameters not in tuple("123456789"):
            raise Refused(OUT_OF_RANGE)
        return "1"

    def _phsr(self, parameters: str) -> str:
        chosen: dict[str, Callable[[AuroraPort], bool]] = {
            "00": lambda port: True,
            "01": lambda port: port.stale,
            "02": lambda port: port.occupied and not port.initialised,
            "03": lambda port: port.initialised and not port.enabled,
            "04": lambda port: port.enabled,
        }
        if parameters not in chosen:
            raise Refused(OUT_OF_RANGE)
        self.system_status &= ~0x00C0
        ports = [port for port in self.ports.values() if port.allocated and chosen[parameters](port)]
        return f"{len(ports):02X}" + "".join(f"{port.handle}{port.status:03X}" for port in ports)

    def _phf(self, parameters: str) -> str:
        port = self._port(parameters)
        if port.occupied:
            raise Refused(NO_HANDLE)
        port.allocated = port.stale = False
        return "OKAY"

    def _pvwr(self, parameters: str) -> str:
        port = self._port(parameters[:2])
        if len(parameters) != 2 + 4 + 2 * PAGE_BYTES:
            raise Refused(PARAMETERS)
        address, page = _number(parameters[2:6], 4), parameters[6:]
        _number(page, 2 * PAGE_BYTES)
        if address % PAGE_BYTES or address > MEMORY_BYTES - PAGE_BYTES:
            raise Refused(OUT_OF_RANGE)
        port.memory = port.memory[:address] + bytes.fromhex(page) + port.memory[address + PAGE_BYTES :]
        return "OKAY"

    def _pinit(self, parameters: str) -> str:
        port = self._port(parameters)
        if not port.occupied:
            raise Refused(NO_TOOL)
        if port.blank and not any(port.memory):
            raise Refused(NO_MEMORY)
        if port.defect:
            raise Refused(port.defect)
        port.initialised = True
        return "OKAY"

    def _pena(self, parameters: str) -> str:
        port = self._port(parameters[:2])
        if parameters[2:] not in ("S", "D", "B"):
            raise Refused(BAD_PRIORITY)
        if not port.initialised:
            raise Refused(NOT_INITIALISED)
        port.enabled = True
        return "OKAY"

    def _pdis(self, parameters: str) -> str:
        port = self._port(parameters)
        if not port.initialised:
            raise Refused(NOT_INITIALISED)
        port.enabled = False
        return "OKAY"

    def _phinf(self, parameters: str) -> str:
        port, option = self._port(parameters[:2]), _number(parameters[2:] or "0001", 4)
        if not port.occupied:
            return "UNOCCUPIED"
        text = ""
        if option & 0x0001:
            text += f"0B000000{'NDI':<12}003{port.serial}{port.status:02X}"
        if option & 0x0004:
            text += f"{'610057':<20}"
        if option & 0x0020:
            index = list(self.ports).index(port.handle)
            text += f"000000001{0}{index + 1:02d}00"
        return text

    def _tstart(self, parameters: str) -> str:
        self.mode = "tracking"
        return "OKAY"

    def _tstop(self, parameters: str) -> str:
        self.mode = "setup"
        return "OKAY"

    def _port(self, handle: str) -> AuroraPort:
        if len(handle) != 2:
            raise Refused(PARAMETERS)
        if handle not in self.ports:
            raise Refused(NO_HANDLE)
        if not self.ports[handle].allocated:
            raise Refused(NOT_ALLOCATED)
        return self.ports[handle]

    def _poses(self, name: str, parameters: str, frame: AuroraFrame | None) -> str | bytes:
        option = _number(parameters or "0001", 4)
        if not option & 0x0001 or option & ~0x0801:
            raise Refused(OUT_OF_RANGE)
        ports = [port for port in self.ports.values() if port.allocated]
        number = frame.number if frame else 0
        tools = [(port, frame.tools.get(port.handle) if frame else None) for port in ports]
        outside = bool(option & 0x0800)
        return (_bx if name == "BX" else _tx)(tools, number, outside, self.system_status)


def _split(line: bytes) -> tuple[str, str]:
    """Name and parameters of `NAME:parametersCRC4` or `NAME parameters`. Raises Refused."""
    try:
        text = line.decode("ascii")
    except UnicodeDecodeError:
        raise Refused(UNKNOWN) from None
    colon, space = text.find(":"), text.find(" ")
    if colon >= 0 and (space < 0 or colon < space):
        if len(text) < colon + 5 or text[-4:] != f"{crc16(text[:-4].encode('ascii')):04X}":
            raise Refused(BAD_CRC)
        return text[:colon], text[colon + 1 : -4]
    return (text, "") if space < 0 else (text[:space], text[space + 1 :])


def _number(text: str, digits: int) -> int:
    if len(text) != digits or not set(text) <= set("0123456789ABCDEF"):
        raise Refused(PARAMETERS)
    return int(text, 16)


_MEASURED_BITS = {"out_of_volume": 0x40, "partly": 0x80, "broken": 0x100}


def _status(port: AuroraPort, tracked: Tracked | None) -> int:
    flags = tracked.flags if tracked else frozenset()
    return port.status | sum(_MEASURED_BITS[flag] for flag in flags)


def _pose_sent(tracked: Tracked | None, outside: bool) -> tuple[float, ...] | None:
    if tracked is None or tracked.pose is None or ("out_of_volume" in tracked.flags and not outside):
        return None
    return tracked.pose


Tools = list[tuple[AuroraPort, "Tracked | None"]]


def _bx(tools: Tools, number: int, outside: bool, system_status: int) -> bytes:
    body = bytearray([len(tools)])
    for port, tracked in tools:
        pose = _pose_sent(tracked, outside)
        if not port.enabled:
            body += bytes([int(port.handle, 16), 0x04])
            continue
        if pose is not None:
            body += bytes([int(port.handle, 16), 0x01]) + struct.pack("<8f", *pose)
        else:
            body += bytes([int(port.handle, 16), 0x02])
        body += struct.pack("<II", _status(port, tracked), number)
    body += struct.pack("<H", system_status)
    header = struct.pack("<HH", 0xA5C4, len(body))
    return header + struct.pack("<H", crc16(header)) + bytes(body) + struct.pack("<H", crc16(bytes(body)))


def _tx(tools: Tools, number: int, outside: bool, system_status: int) -> str:
    text = f"{len(tools):02X}"
    for port, tracked in tools:
        text += port.handle
        pose = _pose_sent(tracked, outside)
        if not port.occupied:
            text += "UNOCCUPIED\n"
            continue
        if not port.enabled:
            text += "DISABLED\n"
            continue
        if pose is None:
            text += "MISSING"
        else:
            text += "".join(f"{round(q * 1e4):+06d}" for q in pose[:4])
            text += "".join(f"{round(p * 1e2):+07d}" for p in pose[4:7]) + f"{round(pose[7] * 1e4):+06d}"
        text += f"{_status(port, tracked):08X}{number:08X}\n"
    return text + f"{system_status:04X}"
