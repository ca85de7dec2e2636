"""ATI Net F/T client without I/O: RDT requests out, UDP records in, forces in newtons out; gaps and faults are reported."""

from __future__ import annotations

import struct
from dataclasses import asdict, dataclass
from enum import IntEnum

import numpy as np

from realtime.drivers.device_events import DeviceEvent, DeviceEventKind
from realtime.drivers.frame_clock import FrameClock
from realtime.drivers.net_ft_calibration import NetFtCalibration

RDT_PORT = 49152
RECORD = struct.Struct(">IIIiiiiii")
REQUEST = struct.Struct(">HHI")
HEADER = 0x1234
_MODULUS = 1 << 32
# Error bits of a record's status; a latched monitor condition (bit 16) with only the summary bit is not a fault.
ERROR_SUMMARY, MONITOR_CONDITION = 0x80000000, 0x00010000
STATUS_TEXTS = {
    0x40000000: "CPU or RAM error",
    0x20000000: "digital board error",
    0x10000000: "analog board error",
    0x08000000: "serial link communication error",
    0x04000000: "program memory error",
    0x02000000: "halted by configuration errors",
    0x01000000: "settings not valid",
    0x00800000: "configuration does not fit the calibration",
    0x00400000: "network failure",
    0x00200000: "CAN failure",
    0x00100000: "RDT failure",
    0x00080000: "EtherNet/IP failure",
    0x00040000: "DeviceNet failure",
    0x00020000: "transducer saturated or A/D error",
    0x00010000: "monitor condition latched",
    0x00004000: "watchdog timeout",
    0x00002000: "stack error",
    0x00001000: "EEPROM failure",
    0x00000800: "flash failure",
    0x00000400: "analog board watchdog timeout",
    0x00000200: "excitation current too high",
    0x00000100: "excitation current too low",
    0x00000080: "analog ground out of range",
    0x00000040: "analog supply too high",
    0x00000020: "analog supply too low",
    0x00000010: "no data on the serial link",
    0x00000008: "reference voltage error",
    0x00000004: "temperature error",
    0x00000002: "HTTP failure",
}


class NetFtCommand(IntEnum):
    """Commands of RDT requests."""

    STOP = 0x0000
    START_REALTIME = 0x0002
    START_BUFFERED = 0x0003
    RESET_LATCH = 0x0041
    SET_BIAS = 0x0042


@dataclass(frozen=True, slots=True, eq=False)
class ForceSample:
    """One record. stamp_ns: when the gauges were read, host clock; force_N, torque_Nm: (3,) in the sensor's frame;
    status: the record's status word; lost: records missing between this one and the sample before."""

    stamp_ns: int
    arrival_ns: int
    force_N: np.ndarray
    torque_Nm: np.ndarray
    rdt_sequence: int
    status: int
    lost: int


@dataclass(frozen=True)
class NetFtConfig:
    """ft_rate_hz: the box's internal rate, at which ft_sequence counts; latency_s: from gauge to UDP at no waiting;
    wild_ratio: readings beyond this multiple of the rated range are rejected; frozen_after: records with the same six
    counts in a row after which the sensor counts as frozen (measurements have noise), 0: never."""

    calibration: NetFtCalibration
    ft_rate_hz: float = 7000.0
    latency_s: float = 0.0003
    silent_after_s: float = 0.1
    retry_s: float = 0.25
    max_gap: int = 10_000
    resync_after: int = 3
    wild_ratio: float = 10.0
    frozen_after: int = 50

    def __post_init__(self) -> None:
        if not (self.ft_rate_hz > 0 and self.latency_s >= 0 and self.max_gap > 0 and self.resync_after > 0):
            raise ValueError(
                "net_ft: found ft_rate_hz, latency_s, max_gap or resync_after out of range, "
                "wanted more than 0 (latency_s: 0 or more)"
            )


@dataclass
class NetFtCounters:
    """Counts since the client was made. `lost`: gaps in the sequence; `old`: reordered; `strays`: not of this stream."""

    requests: int = 0
    records: int = 0
    samples: int = 0
    malformed: int = 0
    duplicates: int = 0
    old: int = 0
    strays: int = 0
    lost: int = 0
    status_errors: int = 0
    wild: int = 0
    frozen: int = 0
    resyncs: int = 0
    silences: int = 0


def request(command: NetFtCommand, count: int = 0) -> bytes:
    """Return an 8-byte RDT request for `count` records, 0 for an endless stream."""
    return REQUEST.pack(HEADER, command, count)


def describe_status(status: int) -> str:
    """Describe a status word; "good" when no bit of it is set."""
    return ", ".join(text for bit, text in STATUS_TEXTS.items() if status & bit) or (
        "error" if status & ERROR_SUMMARY else "good"
    )


def is_fault(status: int) -> bool:
    """Return whether a record with this status must not be used."""
    return bool(status & ~(ERROR_SUMMARY | MONITOR_CONDITION)) or status == ERROR_SUMMARY


class NetFtClient:
    """The driver's core: send the bytes of `outgoing`, `start`, `bias` and `stop`; give every datagram to `feed`.

    Requests the stream by itself, and again when no record arrives. Never raises on what arrives.
    """

    def __init__(self, config: NetFtConfig) -> None:
        self.config = config
        self.clock = FrameClock(
            1.0 / config.ft_rate_hz, window_s=20.0, block_s=0.5, early_s=0.002, late_s=0.5, strange_in_row=200
        )
        c = config.calibration
        self._per_count = np.array([1.0 / c.counts_per_N] * 3 + [1.0 / c.counts_per_Nm] * 3)
        self._wild = np.array(c.range_N + c.range_Nm) * config.wild_ratio
        self._counters = NetFtCounters()
        self._events: list[DeviceEvent] = []
        self._streamed = False
        self._streaming = False
        self._wanted = True
        self._received_ns: int | None = None
        self._requested_ns: int | None = None
        self._status = 0
        self._restart()

    @property
    def streaming(self) -> bool:
        """Return whether records arrive."""
        return self._streaming

    @property
    def counters(self) -> NetFtCounters:
        """Return a copy of the counters."""
        return NetFtCounters(**asdict(self._counters))

    def take_events(self) -> list[DeviceEvent]:
        """Return the events since the last call."""
        events, self._events = self._events, []
        return events

    def start(self) -> bytes:
        """Return the request that starts the stream; the box counts records from 1 again."""
        self._counters.requests += 1
        self._wanted = True
        return request(NetFtCommand.START_REALTIME)

    def stop(self) -> bytes:
        """Return the request that ends the stream."""
        self._wanted = self._streaming = False
        return request(NetFtCommand.STOP)

    def bias(self) -> bytes:
        """Return the request that makes the present load the new zero (software bias); only without contact."""
        return request(NetFtCommand.SET_BIAS)

    def outgoing(self, now_ns: int) -> bytes:
        """Return a request to send now, or nothing. Also detects that no record arrives."""
        if self._streaming and now_ns - (self._received_ns or 0) > self.config.silent_after_s * 1e9:
            self._counters.silences += 1
            self.lost(now_ns, f"no record for {self.config.silent_after_s} s")
        if self._streaming or not self._wanted:
            return b""
        if self._requested_ns is not None and now_ns - self._requested_ns < self.config.retry_s * 1e9:
            return b""
        self._requested_ns = now_ns
        return self.start()

    def lost(self, now_ns: int, why: str) -> None:
        """Note that the stream has ended, or its socket is gone."""
        if self._streaming:
            self._event(DeviceEventKind.LOST, why, now_ns)
        self._streaming, self._requested_ns = False, None
        self._restart()

    def feed(self, datagram: bytes, now_ns: int) -> ForceSample | None:
        """Return the sample in one datagram that arrived at `now_ns`; None if it must not be used (see `counters`)."""
        if len(datagram) != RECORD.size:
            self._counters.malformed += 1
            return None
        sequence, ft_sequence, status, *counts = RECORD.unpack(datagram)
        self._counters.records += 1
        lost = self._follow(sequence)
        if lost is None:
            return None
        self._received_ns = now_ns
        stamp_ns = self._stamp(ft_sequence, now_ns)
        if status != self._status:
            self._status = status
            self._event(DeviceEventKind.WARNING, f"status {status:08X}: {describe_status(status)}", now_ns)
        if is_fault(status):
            self._counters.status_errors += 1
            return None
        if self._is_frozen(tuple(counts), now_ns):
            self._counters.frozen += 1
            return None
        load = np.array(counts) * self._per_count  # N, then N m
        force_N, torque_Nm = load[:3], load[3:]
        if (np.abs(load) > self._wild).any():
            self._counters.wild += 1
            return None
        if not self._streaming:
            self._streaming = True
            self._event(
                DeviceEventKind.RECONNECTED if self._streamed else DeviceEventKind.TRACKING, "records arrive", now_ns
            )
            self._streamed = True
        self._counters.samples += 1
        return ForceSample(stamp_ns, now_ns, force_N, torque_Nm, sequence, status, lost)

    def _restart(self) -> None:
        self._last: int | None = None
        self._stray: int | None = None
        self._stray_run = 0
        self._ft: int | None = None
        self._same: tuple[tuple[int, ...], int] = ((), 0)
        self.clock.reset()

    def _follow(self, sequence: int) -> int | None:
        """Return the number of records lost before this one; None if it is a duplicate, late, or of another stream."""
        if self._last is None:
            self._last = sequence
            return 0
        step = (sequence - self._last) % _MODULUS
        if 0 < step <= self.config.max_gap:
            self._last, self._stray = sequence, None
            self._counters.lost += step - 1
            return step - 1
        if step == 0:
            self._counters.duplicates += 1
            return None
        if step >= _MODULUS - self.config.max_gap:
            self._counters.old += 1
        else:
            self._counters.strays += 1
        # A stream that was started again counts from 1. It is accepted after a few records in sequence.
        self._stray_run = self._stray_run + 1 if self._stray is not None and sequence == self._stray + 1 else 1
        self._stray = sequence
        if self._stray_run < self.config.resync_after:
            return None
        self._counters.resyncs += 1
        self._restart()
        self._last = sequence
        return 0

    def _is_frozen(self, counts: tuple[int, ...], now_ns: int) -> bool:
        before, run = self._same
        run = run + 1 if counts == before else 0
        self._same = (counts, run)
        if run == self.config.frozen_after > 0:
            self._event(DeviceEventKind.WARNING, f"the same reading {run} times in a row: frozen", now_ns)
        return 0 < self.config.frozen_after <= run

    def _stamp(self, ft_sequence: int, now_ns: int) -> int:
        near = self._ft if self._ft is not None else ft_sequence
        self._ft = near + (ft_sequence - near + _MODULUS // 2) % _MODULUS - _MODULUS // 2
        return self.clock.observe(self._ft, now_ns) - round(self.config.latency_s * 1e9)

    def _event(self, kind: DeviceEventKind, text: str, now_ns: int) -> None:
        self._events.append(DeviceEvent(now_ns, "net_ft", kind, text))
