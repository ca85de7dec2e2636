"""An NDI Aurora without I/O: answers the real bytes about poses it is given, with noise, delays and faults."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from realtime.drivers.ndi_protocol import crc16
from sim.aurora_commands import AuroraEmulatorConfig, AuroraFrame, AuroraPort, Console, Tracked
from sim.rotation import quaternion_of_vector, quaternion_product
from sim.sensor_faults import SensorFault, active, checked, strongest
from sim.sensor_noise import MarkovNoise, generators

if TYPE_CHECKING:
    from realtime.drivers.aurora import AuroraClient, PoseSample

Pose = tuple[np.ndarray, np.ndarray]
FRAMES_KEPT = 64
_MAX_COMMAND = 4096
# missing, out_of_volume, partly (partially out of volume), broken (sensor coil); wild: the pose jumps about by `value`
# (m, standard deviation per axis); frozen: last pose repeated under new frame numbers; stuck: frame counter and poses
# stand still; late: `value` (s) more latency; silent: no replies; bit_errors: `value` is the error rate per bit sent.
FAULT_KINDS = ("missing", "out_of_volume", "partly", "wild", "frozen", "broken", "silent", "bit_errors", "late", "stuck")


class AuroraEmulator:
    """The device. `sample` is due at each `next_frame_ns`; `feed` what the host sent; `read` what has left by now.

    Times only go forward from call to call. The same seed and calls give the same bytes.
    """

    def __init__(
        self, config: AuroraEmulatorConfig | None = None, seed: int = 0, faults: Sequence[SensorFault] = ()
    ) -> None:
        self.config = config or AuroraEmulatorConfig()
        self.faults = checked(faults, FAULT_KINDS)
        self.ports = {
            handle: AuroraPort(handle, serial=f"{0x34801000 + i:08X}") for i, handle in enumerate(self.config.handles)
        }
        self.frame_number = 0
        noise_rng, self._delay_rng, self._fault_rng, self._bit_rng = generators(seed, 4)
        size = 3 * len(self.config.handles)
        c = self.config
        self._position_noise = MarkovNoise(noise_rng, size, c.position_noise_m, c.noise_correlation_s)
        self._turn_noise = MarkovNoise(noise_rng, size, c.orientation_noise_rad, c.noise_correlation_s)
        self._quality_rng = noise_rng
        self._samples = 0
        self._frames: deque[AuroraFrame] = deque(maxlen=FRAMES_KEPT)
        self._last: dict[str, Tracked] = {}
        self._console = Console(self.ports, c)
        self._host_baud = 9600
        self._in = bytearray()
        self._due: deque[tuple[int, bytes]] = deque()
        self._wire: deque[tuple[int, bytes, int]] = deque()
        self._wire_free_ns = 0
        self._line_free_ns = 0
        self._dead_until_ns = -1
        # Loads the compiled kernels now: the first frame on the wall clock must not wait for it.
        _turned(np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3))

    @property
    def next_frame_ns(self) -> int:
        """When the next frame is measured."""
        return self.config.start_ns + round(self._samples * 1e9 / (self.config.rate_hz * (1 + self.config.clock_error)))

    @property
    def tracking(self) -> bool:
        """Return whether the device is in tracking mode."""
        return self._console.mode == "tracking"

    @property
    def baud(self) -> int:
        """Return the device's present serial speed, baud."""
        return self._console.baud

    def set_line(self, baud: int) -> None:
        """The host's speed; where it differs from the device's, nothing is understood either way."""
        self._host_baud = baud

    def serial_break(self, now_ns: int) -> None:
        """The host holds the line low: the device restarts at 9600 baud."""
        self._run(now_ns)
        self.power_cycle(now_ns)

    def power_cycle(self, now_ns: int) -> None:
        """Off and on again; answers RESET when up."""
        self._in.clear()
        self._due.clear()
        self._wire.clear()
        self._console.reset()
        self._wire_free_ns = self._dead_until_ns = now_ns + round(self.config.reset_s * 1e9)
        self._send("RESET", self._dead_until_ns)

    def unplug(self, handle: str) -> None:
        """Pull a tool out of its port."""
        self.ports[handle].unplug()
        self._console.system_status |= 0x0080

    def plug(self, handle: str) -> None:
        """Plug the tool in again; it needs PINIT and PENA."""
        self.ports[handle].plug()
        self._console.system_status |= 0x0040

    # Measuring.

    def sample(self, frame_time_ns: int, poses: Sequence[Pose | None]) -> None:
        """Measure a frame: one pose (position_m (3,), quaternion_wxyz (4,), tool -> tracker) per handle, None: missing.

        Raises ValueError when the number of poses is not that of the handles.
        """
        handles, c = self.config.handles, self.config
        if len(poses) != len(handles):
            raise ValueError(f"poses: found {len(poses)}, wanted {len(handles)} (one per handle)")
        dt_s = 1.0 / c.rate_hz
        shift = self._position_noise.step(dt_s).reshape(-1, 3)
        turn = self._turn_noise.step(dt_s).reshape(-1, 3)
        quality = self._quality_rng.rayleigh(0.1, len(handles))
        draws = self._fault_rng.random((len(handles), 2))
        jumps = self._fault_rng.standard_normal((len(handles), 3))
        jitter_s = self._delay_rng.exponential(c.frame_jitter_s) if c.frame_jitter_s > 0 else 0.0
        self._samples += 1
        if active(self.faults, frame_time_ns, "stuck"):
            return
        tools = {}
        for i, handle in enumerate(handles):
            measured = _measured(poses[i], shift[i], turn[i], quality[i])
            tools[handle] = self._spoilt(handle, measured, frame_time_ns, draws[i], jumps[i])
        self.frame_number = (self.frame_number + 1) & 0xFFFFFFFF
        late_s = sum(fault.value for fault in active(self.faults, frame_time_ns, "late"))
        available_ns = frame_time_ns + round((c.latency_s + jitter_s + late_s) * 1e9)
        if self._frames:
            available_ns = max(available_ns, self._frames[-1].available_ns)
        self._frames.append(AuroraFrame(self.frame_number, available_ns, tools))
        self._last = tools

    def _spoilt(
        self, handle: str, pose: tuple[float, ...] | None, time_ns: int, draws: np.ndarray, jump: np.ndarray
    ) -> Tracked:
        now = {fault.kind: fault for fault in active(self.faults, time_ns) if fault.handle in (None, handle)}
        if "frozen" in now and handle in self._last:
            return self._last[handle]
        flags = {kind for kind in ("out_of_volume", "partly", "broken") if kind in now}
        if pose is None or "missing" in now or "broken" in now or draws[0] < self.config.dropout:
            return Tracked(frozenset(flags), None)
        jump_m = now["wild"].value if "wild" in now else 0.0
        if draws[1] < self.config.wild:
            jump_m = self.config.wild_m
        if jump_m:
            pose = (*pose[:4], *(np.array(pose[4:7]) + 1e3 * jump_m * jump).tolist(), pose[7])
        return Tracked(frozenset(flags), pose)

    # Talking.

    def feed(self, data: bytes, now_ns: int) -> None:
        """Bytes that the host begins to send at `now_ns`."""
        self._run(now_ns)
        if self._host_baud != self._console.baud:
            return
        self._line_free_ns = max(self._line_free_ns, now_ns)
        for byte in data:
            self._line_free_ns += 10 * 10**9 // self._host_baud
            if byte != 0x0D:
                if len(self._in) < _MAX_COMMAND:
                    self._in.append(byte)
                continue
            command, self._in = bytes(self._in), bytearray()
            jitter_s = self._delay_rng.exponential(self.config.processing_jitter_s)
            due_ns = self._line_free_ns + round((self.config.processing_s + jitter_s) * 1e9)
            self._due.append((max(due_ns, self._due[-1][0] if self._due else 0), command))

    def read(self, now_ns: int) -> bytes:
        """Bytes of replies that have left the device's line by `now_ns`, each taking 10 bit times."""
        self._run(now_ns)
        out = bytearray()
        while self._wire:
            start_ns, data, baud = self._wire[0]
            count = min(len(data), (now_ns - start_ns) * baud // (10 * 10**9))
            if count <= 0:
                break
            out += self._garbled(data[:count], start_ns) if baud == self._host_baud else b""
            self._wire.popleft()
            if count < len(data):
                self._wire.appendleft((start_ns + count * 10 * 10**9 // baud, data[count:], baud))
                break
        return bytes(out)

    def _run(self, now_ns: int) -> None:
        """Carry out the commands that are due by now, in order."""
        while self._due and self._due[0][0] <= now_ns:
            due_ns, command = self._due.popleft()
            if due_ns < self._dead_until_ns or active(self.faults, due_ns, "silent"):
                continue
            answer = self._console.execute(command, self._frame_at(due_ns))
            if answer.power_cycle:
                self.power_cycle(due_ns)
                continue
            self._send(answer.reply, due_ns + round(answer.takes_s * 1e9))
            self._console.settle()

    def _frame_at(self, time_ns: int) -> AuroraFrame | None:
        """The newest frame whose data are ready at that time."""
        for frame in reversed(self._frames):
            if frame.available_ns <= time_ns:
                return frame
        return None

    def frames_until(self, now_ns: int) -> list[AuroraFrame]:
        """The frames that are kept and were ready by `now_ns`, oldest first: for a server that sends them unasked."""
        return [frame for frame in self._frames if frame.available_ns <= now_ns]

    def _send(self, reply: str | bytes, from_ns: int) -> None:
        if isinstance(reply, str):
            body = reply.encode("ascii")
            reply = body + b"%04X\r" % crc16(body)
        start_ns = max(from_ns, self._wire_free_ns)
        self._wire_free_ns = start_ns + len(reply) * 10 * 10**9 // self._console.baud
        self._wire.append((start_ns, reply, self._console.baud))

    def _garbled(self, data: bytes, time_ns: int) -> bytes:
        rate = strongest(self.faults, time_ns, "bit_errors")
        if rate <= 0:
            return data
        flips = np.packbits(self._bit_rng.random((len(data), 8)) < rate, axis=1)[:, 0]
        return bytes(np.bitwise_xor(np.frombuffer(data, np.uint8), flips))


def _measured(
    pose: Pose | None,
    shift_m: np.ndarray,
    turn_rad: np.ndarray,
    quality_mm: float,
) -> tuple[float, ...] | None:
    """Quaternion, position in mm and indicator value in mm, with the noise; None stays None."""
    if pose is None:
        return None
    position_mm = 1e3 * (np.asarray(pose[0], float) + shift_m)
    return (*_turned(np.asarray(pose[1], float), turn_rad), *position_mm.tolist(), float(min(quality_mm, 9.9999)))


def _turned(quaternion: np.ndarray, turn_rad: np.ndarray) -> tuple[float, ...]:
    """Quaternion (w, x, y, z) after a small rotation vector in the tool's frame, unit."""
    small, turned = np.empty(4), np.empty(4)
    quaternion_of_vector(turn_rad[0], turn_rad[1], turn_rad[2], small)
    quaternion_product(quaternion / np.linalg.norm(quaternion), small, turned)
    return tuple(turned.tolist())


def exchange(client: AuroraClient, emulator: AuroraEmulator, now_ns: int) -> list[PoseSample]:
    """One lock-step turn at `now_ns`: the device's bytes to the client, its line actions and bytes to the device."""
    samples = client.feed(emulator.read(now_ns), now_ns)
    sending = client.outgoing(now_ns)
    for action in client.line_actions():
        emulator.set_line(action.baud)
        if action.break_s > 0:
            emulator.serial_break(now_ns)
    emulator.feed(sending, now_ns)
    return samples
