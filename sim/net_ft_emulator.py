"""An ATI Net F/T box without I/O: answers RDT requests with the real records of loads it is given, and its page."""

from __future__ import annotations

import heapq
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sim.sensor_faults import SensorFault, active, checked, strongest
from sim.sensor_noise import MarkovNoise, generators

if TYPE_CHECKING:
    from realtime.drivers.net_ft import ForceSample, NetFtClient

INTERNAL_RATE_HZ = 7000
_SATURATED, _ERROR, _BRIDGE = 0x00020000, 0x80000000, 0x00000100
# drop, duplicate, reorder: `value` is the chance per record; silent: nothing leaves (unplugged); saturated: load beyond
# the gauges; broken: gauge excitation failed; drift: `value` N/s on every force axis; frozen: the same counts under new
# sequence numbers; bit_errors: `value` is the rate per bit (as if the UDP checksum were off).
FAULT_KINDS = (
    "drop",
    "duplicate",
    "reorder",
    "silent",
    "saturated",
    "broken",
    "drift",
    "frozen",
    "bit_errors",
    "scale",
    "offset",
)


@dataclass(frozen=True)
class NetFtEmulatorConfig:
    """rate_hz: RDT records a second, 7000/n; force_noise_N, torque_noise_Nm: standard deviation per axis;
    saturation: multiple of the range at which the gauges saturate; clock_error: rate error (ratio, positive: fast);
    jitter_s: mean of an exponential delay of the network on top of latency_s."""

    rate_hz: float = 1000.0
    counts_per_N: float = 1e6
    counts_per_Nm: float = 1e6
    range_N: tuple[float, float, float] = (12.0, 12.0, 17.0)
    range_Nm: tuple[float, float, float] = (0.12, 0.12, 0.12)
    saturation: float = 1.5
    force_noise_N: float = 0.003
    torque_noise_Nm: float = 2e-5
    noise_correlation_s: float = 0.0
    zero_offset_N: tuple[float, float, float] = (0.0, 0.0, 0.0)
    latency_s: float = 0.0003
    jitter_s: float = 0.00005
    clock_error: float = 0.0
    start_ns: int = 0
    force_unit: str = "N"
    torque_unit: str = "Nm"
    serial: str = "FT00000"

    def __post_init__(self) -> None:
        steps = INTERNAL_RATE_HZ / self.rate_hz if self.rate_hz > 0 else 0.0
        if steps < 1 or abs(steps - round(steps)) > 1e-6:
            raise ValueError(f"rate_hz: found {self.rate_hz}, wanted {INTERNAL_RATE_HZ} over a whole number")


class NetFtEmulator:
    """The box. `sample` is due at each `next_sample_ns`; `feed` each datagram; `read` the datagrams arrived by now."""

    def __init__(self, config: NetFtEmulatorConfig | None = None, seed: int = 0, faults: Sequence[SensorFault] = ()) -> None:
        self.config = c = config or NetFtEmulatorConfig()
        self.faults = checked(faults, FAULT_KINDS)
        self.streaming = False
        self.malformed_requests = 0
        noise_rng, self._delay_rng, self._fault_rng, self._bit_rng = generators(seed, 4)
        self._force_noise = MarkovNoise(noise_rng, 3, c.force_noise_N, c.noise_correlation_s)
        self._torque_noise = MarkovNoise(noise_rng, 3, c.torque_noise_Nm, c.noise_correlation_s)
        self._scale = np.array([c.counts_per_N] * 3 + [c.counts_per_Nm] * 3)
        self._limit = np.array(c.range_N + c.range_Nm) * c.saturation
        self._zero_offset_N = np.array(c.zero_offset_N)
        self._samples = 0
        self._ft_step = round(INTERNAL_RATE_HZ / c.rate_hz)
        self._ft_sequence = self._rdt_sequence = 0
        self._left: int | None = None
        self._bias = np.zeros(6)
        self._load = np.zeros(6)
        self._counts = [0] * 6
        self._queue: list[tuple[int, int, bytes]] = []
        self._order = 0
        self._last_arrival_ns = 0

    @property
    def next_sample_ns(self) -> int:
        """When the gauges are read next."""
        return self.config.start_ns + round(self._samples * 1e9 / (self.config.rate_hz * (1 + self.config.clock_error)))

    def start_sequences_at(self, rdt_sequence: int, ft_sequence: int) -> None:
        """Set the counters, to reach their wrap-around quickly."""
        self._rdt_sequence, self._ft_sequence = rdt_sequence, ft_sequence

    def power_cycle(self) -> None:
        """Off and on again: the stream has ended, counters and bias are gone."""
        self.streaming, self._left = False, None
        self._ft_sequence = self._rdt_sequence = 0
        self._bias = np.zeros(6)
        self._queue.clear()

    def feed(self, datagram: bytes, now_ns: int) -> None:
        """One request of the host. Anything else than a known 8-byte request is ignored, as by the box."""
        if len(datagram) != 8:
            self.malformed_requests += 1
            return
        header, command, count = struct.unpack(">HHI", datagram)
        if header != 0x1234 or command not in (0x0000, 0x0002, 0x0003, 0x0041, 0x0042):
            self.malformed_requests += 1
            return
        if active(self.faults, now_ns, "silent"):
            return
        if command == 0x0042:
            self._bias = self._load.copy()
        elif command == 0x0000:
            self.streaming = False
        elif command != 0x0041:
            self.streaming, self._left = True, count or None
            self._rdt_sequence = 0

    def sample(self, time_ns: int, force_N: np.ndarray, torque_Nm: np.ndarray) -> None:
        """Read the gauges: true force (3,) and torque (3,) in the sensor's frame; a record leaves while streaming."""
        c = self.config
        dt_s = 1.0 / c.rate_hz
        noise = np.concatenate((self._force_noise.step(dt_s), self._torque_noise.step(dt_s)))
        draws = self._fault_rng.random(3)
        delay_s = c.latency_s + (self._delay_rng.exponential(c.jitter_s) if c.jitter_s > 0 else 0.0)
        self._samples += 1
        self._ft_sequence = (self._ft_sequence + self._ft_step) & 0xFFFFFFFF
        self._load = np.concatenate((force_N + self._zero_offset_N, torque_Nm))
        for fault in active(self.faults, time_ns, "scale"):
            self._load[:3] *= fault.value
        for fault in active(self.faults, time_ns, "offset"):
            self._load[2] += fault.value
        for fault in active(self.faults, time_ns, "drift"):
            self._load[:3] += fault.value * (time_ns - fault.start_ns) * 1e-9
        self._load += noise
        status = self._status(time_ns)
        if not active(self.faults, time_ns, "frozen"):
            shown = self._load.clip(-self._limit, self._limit) - self._bias
            self._counts = [
                min(max(count, -(2**31)), 2**31 - 1) for count in map(int, np.rint(shown * self._scale).tolist())
            ]
        if not self.streaming:
            return
        self._rdt_sequence = (self._rdt_sequence + 1) & 0xFFFFFFFF
        record = struct.pack(">IIIiiiiii", self._rdt_sequence, self._ft_sequence, status, *self._counts)
        if self._left is not None:
            self._left -= 1
            self.streaming = self._left > 0
        self._send(record, time_ns, delay_s, draws)

    def _status(self, time_ns: int) -> int:
        status = 0
        if active(self.faults, time_ns, "saturated"):
            self._load[:3] = 4.0 * self._limit[:3]
        if (np.abs(self._load) >= self._limit).any():
            status |= _ERROR | _SATURATED
        if active(self.faults, time_ns, "broken"):
            status |= _ERROR | _BRIDGE
        return status

    def _send(self, record: bytes, time_ns: int, delay_s: float, draws: np.ndarray) -> None:
        if active(self.faults, time_ns, "silent") or draws[0] < strongest(self.faults, time_ns, "drop"):
            return
        arrival_ns = max(time_ns + round(delay_s * 1e9), self._last_arrival_ns)
        self._last_arrival_ns = arrival_ns
        if draws[1] < strongest(self.faults, time_ns, "reorder"):
            arrival_ns += round(2.5e9 / self.config.rate_hz)
        for _ in range(2 if draws[2] < strongest(self.faults, time_ns, "duplicate") else 1):
            self._order += 1
            heapq.heappush(self._queue, (arrival_ns, self._order, self._damaged(record, time_ns)))

    def _damaged(self, record: bytes, time_ns: int) -> bytes:
        rate = strongest(self.faults, time_ns, "bit_errors")
        if rate <= 0:
            return record
        flips = np.packbits(self._bit_rng.random((len(record), 8)) < rate, axis=1)[:, 0]
        return bytes(np.bitwise_xor(np.frombuffer(record, np.uint8), flips))

    def read(self, now_ns: int) -> list[bytes]:
        """Datagrams that have reached the host by `now_ns`, in order of arrival."""
        out = []
        while self._queue and self._queue[0][0] <= now_ns:
            out.append(heapq.heappop(self._queue)[2])
        return out

    def page(self) -> bytes:
        """The box's netftapi2.xml, with the elements that clients read."""
        c = self.config
        newtons, newton_metres = _UNITS[c.force_unit], _UNITS[c.torque_unit]
        ratings = [value / newtons for value in c.range_N] + [value / newton_metres for value in c.range_Nm]
        fields = {
            "runstat": "0x00000000",
            "runrate": str(INTERNAL_RATE_HZ),
            "cfgnam": "emulated",
            "cfgcalsel": "0",
            "cfgcalsn": c.serial,
            "scfgfu": c.force_unit,
            "scfgtu": c.torque_unit,
            "cfgcpf": f"{c.counts_per_N * newtons:.10g}",
            "cfgcpt": f"{c.counts_per_Nm * newton_metres:.10g}",
            "cfgmr": ";".join(f"{value:.6g}" for value in ratings),
            "setcfgsel": "0",
            "comrdte": "Enabled",
            "comrdtrate": f"{c.rate_hz:.10g}",
            "comrdtbsiz": "1",
        }
        lines = "\n".join(f"<{key}>{value}</{key}>" for key, value in fields.items())
        return f'<?xml version="1.0" encoding="ISO-8859-1"?>\n<netft>\n{lines}\n</netft>\n'.encode("ascii")


_UNITS = {"N": 1.0, "kN": 1e3, "lbf": 4.4482216152605, "Nm": 1.0, "N-m": 1.0, "N-mm": 1e-3, "lbf-in": 0.1129848290276167}


def exchange(client: NetFtClient, emulator: NetFtEmulator, now_ns: int) -> list[ForceSample]:
    """One lock-step turn at `now_ns`: datagrams to the client, its request to the box."""
    samples = [client.feed(datagram, now_ns) for datagram in emulator.read(now_ns)]
    sending = client.outgoing(now_ns)
    if sending:
        emulator.feed(sending, now_ns)
    return [sample for sample in samples if sample is not None]
