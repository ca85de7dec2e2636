"""The Aurora client: a recorded exchange byte for byte, bring-up, flags, times, damage, and being found again."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from realtime.drivers.aurora import AuroraClient, AuroraConfig
from realtime.drivers.device_events import DeviceEventKind
from realtime.drivers.pose_sample import PoseFlag, PoseSample
from sim.aurora_emulator import AuroraEmulator, AuroraEmulatorConfig, exchange
from sim.sensor_faults import SensorFault

VECTORS = json.loads((Path(__file__).parent / "vectors" / "aurora.json").read_text(encoding="utf-8"))
MS = 1_000_000
QUIET = AuroraEmulatorConfig(position_noise_m=0.0, orientation_noise_rad=0.0)


class Bench:
    """Client and emulator in virtual time, in steps of `step_ns`; the tip moves so that its position tells the frame."""

    def __init__(
        self,
        client: AuroraConfig | None = None,
        device: AuroraEmulatorConfig = QUIET,
        faults: tuple[SensorFault, ...] = (),
        step_ns: int = MS,
        seed: int = 3,
    ) -> None:
        self.client = AuroraClient(client)
        self.emulator = AuroraEmulator(device, seed, faults)
        self.now_ns, self.step_ns = 0, step_ns
        self.frame_time_ns: dict[int, int] = {}
        self.samples: list[PoseSample] = []
        self.mangle: Callable[[bytes], bytes] | None = None

    def run(self, seconds: float) -> list[PoseSample]:
        """Samples of the next `seconds`."""
        first = len(self.samples)
        stop_ns = self.now_ns + round(seconds * 1e9)
        while self.now_ns < stop_ns:
            self.now_ns += self.step_ns
            while (time_ns := self.emulator.next_frame_ns) <= self.now_ns:
                self.emulator.sample(time_ns, [pose_at(time_ns)] * len(self.emulator.config.handles))
                self.frame_time_ns[self.emulator.frame_number] = time_ns
            self.samples += exchange(self.client, self.emulator, self.now_ns)
        return self.samples[first:]

    def kinds(self) -> list[DeviceEventKind]:
        return [event.kind for event in self.client.take_events()]


def pose_at(time_ns: int) -> tuple[np.ndarray, np.ndarray]:
    s = time_ns * 1e-9
    half = 0.3 * np.sin(s)
    return np.array([0.01 * s, -0.02, -0.15]), np.array([np.cos(half), 0.0, np.sin(half), 0.0])


# The recorded exchange.


def replay(config: AuroraConfig) -> tuple[AuroraClient, int]:
    """A client brought up by the session of the vectors; asserts every byte that it sends."""
    client, now_ns = AuroraClient(config), 0
    for step in VECTORS["session"]:
        sent = b""
        for _ in range(500):
            now_ns += MS
            sent += client.outgoing(now_ns)
            if sent.endswith(b"\r") or not step["host"]:
                break
        assert sent == step["host"].encode("ascii"), step["meaning"]
        assert client.feed(step["device"].encode("ascii"), now_ns) == []
    return client, now_ns


def test_the_recorded_session_brings_the_client_up_byte_for_byte() -> None:
    client, now_ns = replay(AuroraConfig())
    assert client.tracking and list(client.tools) == ["0A", "0B"]
    assert client.tools["0B"].serial == "34801001" and client.tools["0B"].port == "02"
    actions = client.line_actions()
    assert [(action.baud, action.break_s > 0) for action in actions] == [(9600, True), (921600, False)]
    assert client.outgoing(now_ns + MS) == VECTORS["poll"].encode("ascii")
    events = client.take_events()
    assert [event.kind for event in events] == [DeviceEventKind.WARNING, DeviceEventKind.TRACKING]
    assert events[0].text == "PINIT 0B: warning 01: possible hardware fault"


def reply_bytes(number: int) -> bytes:
    return bytes.fromhex(VECTORS["replies"][number]["hex"])


def answer_poll(client: AuroraClient, reply: bytes, now_ns: int) -> list[PoseSample]:
    assert client.outgoing(now_ns) == VECTORS["poll"].encode("ascii")
    return client.feed(reply, now_ns + 2 * MS)


def test_the_recorded_poses_come_out_in_si() -> None:
    client, now_ns = replay(AuroraConfig(settle_frames=0))
    client.line_actions()
    tip, shaft = answer_poll(client, reply_bytes(0), now_ns + 25 * MS)
    assert (tip.tool, shaft.tool, tip.frame, shaft.frame) == ("0A", "0B", 0xF42, 0xF42)
    assert tip.position_m == pytest.approx([0.0125, -0.04025, -0.18075])
    assert tip.quaternion_wxyz == pytest.approx([0.5, 0.5, -0.5, 0.5])
    assert tip.quality_m == pytest.approx(0.000125)
    assert not tip.missing and tip.flags == 0
    wire_ns = len(reply_bytes(0)) * 10 * 10**9 // 921600
    assert tip.arrival_ns - tip.stamp_ns == pytest.approx(25 * MS + wire_ns, abs=1)


def test_the_recorded_flags_make_poses_missing() -> None:
    client, now_ns = replay(AuroraConfig(settle_frames=0))
    answer_poll(client, reply_bytes(0), now_ns + 25 * MS)
    tip, shaft = answer_poll(client, reply_bytes(2), now_ns + 75 * MS)
    assert tip.missing and tip.flags == PoseFlag.DISABLED and tip.frame == 0xF44
    assert shaft.missing and shaft.flags == PoseFlag.MISSING | PoseFlag.SENSOR_BROKEN
    assert np.isnan(tip.position_m).all() and np.isnan(shaft.quaternion_wxyz).all()
    assert client.counters.frames_missed == 2
    not_a_number = bytes.fromhex(VECTORS["not_a_pose"]["hex"])
    client, now_ns = replay(AuroraConfig(settle_frames=0))
    (sample,) = answer_poll(client, not_a_number, now_ns + 25 * MS)
    assert sample.missing and sample.flags == PoseFlag.NOT_A_POSE and client.counters.not_a_pose == 1


def test_a_port_that_becomes_occupied_stops_tracking_and_reads_the_ports() -> None:
    client, now_ns = replay(AuroraConfig(settle_frames=0))
    answer_poll(client, reply_bytes(0), now_ns + 25 * MS)
    (tip, shaft) = answer_poll(client, reply_bytes(1), now_ns + 50 * MS)
    assert tip.flags == PoseFlag.PARTLY_OUT_OF_VOLUME and not tip.missing
    assert shaft.flags == PoseFlag.MISSING | PoseFlag.OUT_OF_VOLUME
    assert client.outgoing(now_ns + 60 * MS).startswith(b"TSTOP:")
    assert not client.tracking


def test_what_stands_since_before_the_ports_were_read_is_no_change() -> None:
    client, now_ns = replay(AuroraConfig(settle_frames=0))
    answer_poll(client, reply_bytes(1), now_ns + 25 * MS)
    assert client.tracking and "occupied" in client.take_events()[-1].text


@pytest.mark.parametrize("vector", VECTORS["refused"][:3], ids=lambda vector: vector["meaning"])
def test_a_reply_that_does_not_add_up_gives_no_pose(vector: dict) -> None:
    client, now_ns = replay(AuroraConfig(settle_frames=0))
    assert answer_poll(client, bytes.fromhex(vector["hex"]), now_ns + 25 * MS) == []
    assert client.counters.unexpected == 1 and client.tracking


@pytest.mark.parametrize("code", [0x01, 0x0C, 0x10, 0xF6])
def test_an_error_to_a_poll_is_told_in_words_and_starts_anew(code: int) -> None:
    from realtime.drivers.ndi_protocol import ERROR_TEXTS, crc16

    client, now_ns = replay(AuroraConfig())
    client.take_events()
    text = b"ERROR%02X" % code
    assert answer_poll(client, text + b"%04X\r" % crc16(text), now_ns + 25 * MS) == []
    (event,) = client.take_events()
    assert event.kind is DeviceEventKind.LOST and ERROR_TEXTS[code] in event.text
    client.outgoing(now_ns + 2000 * MS)
    assert client.phase == "resetting"


# Bring-up against the emulator.


@pytest.mark.parametrize("reply", ["BX", "TX"])
@pytest.mark.parametrize("baud", [9600, 115200, 230400, 921600])
def test_every_speed_and_reply_brings_poses(baud: int, reply: str) -> None:
    bench = Bench(AuroraConfig(baud=baud, reply=reply))
    samples = bench.run(5.0)
    assert bench.kinds() == [DeviceEventKind.TRACKING]
    assert bench.emulator.baud == baud and bench.client.firmware.startswith("AURORA")
    assert {sample.tool for sample in samples} == {"0A", "0B"}
    for sample in samples:
        position, quaternion = pose_at(bench.frame_time_ns[sample.frame])
        assert sample.position_m == pytest.approx(position, abs=6e-6 if reply == "TX" else 1e-8)
        assert sample.quaternion_wxyz == pytest.approx(quaternion, abs=2e-4 if reply == "TX" else 1e-6)
        assert sample.stamp_ns <= sample.arrival_ns <= bench.now_ns
    counters = bench.client.counters
    assert (counters.damaged, counters.unexpected, counters.poll_timeouts, counters.errors) == (0, 0, 0, 0)
    assert baud < 115200 or counters.frames_missed == 0


def test_only_the_wanted_tools_are_enabled_and_absent_ones_are_named() -> None:
    bench = Bench(AuroraConfig(tools=("0B", "0C")))
    assert {sample.tool for sample in bench.run(2.5)} == {"0B"}
    assert not bench.emulator.ports["0A"].enabled
    assert any("0C" in event.text and event.kind is DeviceEventKind.ERROR for event in bench.client.take_events())


def test_an_adapter_that_swallows_breaks_is_reset_in_words_whatever_the_speed() -> None:
    bench = Bench(AuroraConfig(reset_timeout_s=0.5, reply_timeout_s=0.7))
    bench.run(2.5)
    bench.emulator.serial_break = lambda now_ns: None  # type: ignore[method-assign]
    bench.client.lost(bench.now_ns, "the program was started anew while the device tracks at 921600 baud")
    assert bench.run(5.0)
    assert bench.kinds()[-1] is DeviceEventKind.RECONNECTED


def test_a_device_that_is_not_there_is_asked_for_ever() -> None:
    bench = Bench(
        AuroraConfig(reset_timeout_s=0.2, reply_timeout_s=0.2, retry_s=0.2), faults=(SensorFault("silent", 0, 10**18),)
    )
    bench.emulator.serial_break = lambda now_ns: None  # type: ignore[method-assign]
    assert bench.run(20.0) == []
    assert bench.client.counters.sessions > 10
    assert all("switched on" in event.text for event in bench.client.take_events())
    bench.emulator.faults.clear()
    assert bench.run(5.0)


def test_a_command_damaged_on_its_way_is_sent_again() -> None:
    client, now_ns = AuroraClient(), MS
    client.outgoing(now_ns)
    client.feed(b"RESETBE6F\r", now_ns)
    assert client.outgoing(now_ns) == b"INIT:E3A5\r"
    assert client.feed(VECTORS["words"][1]["text"].encode("ascii"), now_ns) == []
    assert client.outgoing(now_ns) == b"INIT:E3A5\r"


def test_a_tool_that_cannot_be_initialised_is_named_and_the_other_tracked() -> None:
    bench = Bench()
    bench.emulator.ports["0B"].defect = "1E"
    assert {sample.tool for sample in bench.run(3.0)} == {"0A"}
    texts = [event.text for event in bench.client.take_events() if event.kind is DeviceEventKind.ERROR]
    assert texts == ["PINIT 0B: error 1E: SROM of the tool could not be read", "wanted tools not plugged in: 0B"]


def test_bring_up_survives_damaged_replies() -> None:
    bench = Bench(AuroraConfig(reply_timeout_s=0.3), faults=(SensorFault("bit_errors", 0, 10**18, value=3e-4),))
    assert bench.run(10.0)
    assert bench.client.counters.damaged > 0


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("rate_hz", 0.0),
        ("baud", 12345),
        ("reply", "GX"),
        ("latency_s", -1.0),
        ("beeps", 10),
        ("poll_timeout_s", float("nan")),
    ],
)
def test_a_configuration_out_of_bounds_is_refused_by_its_key(key: str, value: object) -> None:
    with pytest.raises(ValueError, match=key):
        AuroraConfig(**{key: value})  # type: ignore[arg-type]


# Times.


@pytest.mark.parametrize("drift", [-50e-6, 50e-6])
@pytest.mark.parametrize(
    ("baud", "jitter_s", "rms_ms"), [(921600, 0.0005, 0.25), (921600, 0.003, 0.6), (115200, 0.0005, 0.8)]
)
def test_stamps_are_the_sampling_times(baud: int, jitter_s: float, rms_ms: float, drift: float) -> None:
    device = AuroraEmulatorConfig(frame_jitter_s=jitter_s, clock_error=drift)
    bench = Bench(AuroraConfig(baud=baud), device, step_ns=200_000)
    samples = bench.run(40.0)
    errors_ms = np.array([sample.stamp_ns - bench.frame_time_ns[sample.frame] for sample in samples]) / MS
    rms = float(np.sqrt(np.mean(errors_ms**2)))
    age_ms = float(np.mean([sample.arrival_ns - sample.stamp_ns for sample in samples])) / MS
    print(
        f"{baud} baud, jitter {1e3 * jitter_s} ms, drift {1e6 * drift:+.0f} ppm: "
        f"RMS {rms:.2f} ms, largest {np.max(np.abs(errors_ms)):.2f} ms, mean age on arrival {age_ms:.1f} ms"
    )
    assert len(samples) > 2900
    assert rms < rms_ms
    assert bench.client.clock.drift == pytest.approx(-drift, abs=40e-6)


def test_each_frame_is_told_once_and_in_order() -> None:
    bench = Bench()
    frames = [sample.frame for sample in bench.run(10.0) if sample.tool == "0A"]
    assert np.array_equal(np.diff(frames), np.ones(len(frames) - 1))
    assert bench.client.counters.repeats > 0


def test_the_frame_counter_wraps_without_a_gap() -> None:
    bench = Bench()
    bench.emulator.frame_number = 2**32 - 100
    frames = [sample.frame for sample in bench.run(6.0) if sample.tool == "0A"]
    assert np.array_equal(np.diff(frames), np.ones(len(frames) - 1))
    assert frames[0] < 2**32 < frames[-1]


@pytest.mark.parametrize("number", [5, 1_000_000])
def test_a_counter_that_jumps_is_learnt_anew(number: int) -> None:
    bench = Bench()
    bench.run(3.0)
    bench.emulator.frame_number = number
    bench.emulator._frames.clear()
    later = bench.run(3.0)
    assert any("frame counter went" in event.text for event in bench.client.take_events())
    errors = [sample.stamp_ns - bench.frame_time_ns[sample.frame] for sample in later[-40:]]
    assert np.max(np.abs(errors)) < 3 * MS


@pytest.mark.parametrize("key", ["not_a_pose", "ahead"])  # frames 7 and 15 million, after 3906
def test_one_strange_frame_number_is_not_believed(key: str) -> None:
    client, now_ns = replay(AuroraConfig(settle_frames=0))
    answer_poll(client, reply_bytes(0), now_ns + 25 * MS)
    assert answer_poll(client, bytes.fromhex(VECTORS[key]["hex"]), now_ns + 50 * MS) == []
    assert client.counters.frames_strange == 1
    assert len(answer_poll(client, reply_bytes(2), now_ns + 75 * MS)) == 2


# What the device may do.


@pytest.mark.parametrize(
    ("kind", "flags"),
    [
        ("missing", PoseFlag.MISSING),
        ("out_of_volume", PoseFlag.MISSING | PoseFlag.OUT_OF_VOLUME),
        ("broken", PoseFlag.MISSING | PoseFlag.SENSOR_BROKEN),
        ("partly", PoseFlag.PARTLY_OUT_OF_VOLUME),
    ],
)
def test_flags_reach_the_samples_and_are_told_once(kind: str, flags: PoseFlag) -> None:
    fault = SensorFault(kind, 4_000 * MS, 5_000 * MS, handle="0A")
    bench = Bench(faults=(fault,))
    samples = bench.run(6.0)
    for sample in samples:
        inside = fault.start_ns <= bench.frame_time_ns[sample.frame] < fault.stop_ns and sample.tool == "0A"
        assert sample.flags == (flags if inside else 0)
        assert sample.missing == (inside and kind != "partly")
        assert np.isnan(sample.position_m).all() == sample.missing
    texts = [event.text for event in bench.client.take_events() if event.kind is DeviceEventKind.WARNING]
    assert len(texts) == 2 and texts[0].startswith("tool 0A: ") and texts[1] == "tool 0A: in view"


def test_a_frozen_pose_under_new_frame_numbers_is_found_and_passes_no_more() -> None:
    fault = SensorFault("frozen", 4_000 * MS, 6_000 * MS, handle="0A")
    bench = Bench(faults=(fault,))
    samples = [sample for sample in bench.run(8.0) if sample.tool == "0A"]
    frozen = [sample for sample in samples if sample.flags & PoseFlag.FROZEN]
    times = [bench.frame_time_ns[sample.frame] for sample in frozen]
    assert min(times) - fault.start_ns == pytest.approx(7 * 25 * MS, abs=26 * MS)
    assert max(times) < fault.stop_ns and len(frozen) == 80 - 7
    assert all(sample.missing for sample in frozen) and not samples[-1].missing
    assert Bench(AuroraConfig(frozen_after=0), faults=(fault,)).run(8.0)[-1].flags == 0


def test_silence_is_noticed_and_the_device_found_again() -> None:
    bench = Bench(faults=(SensorFault("silent", 4_000 * MS, 6_000 * MS),))
    samples = bench.run(10.0)
    assert bench.kinds() == [DeviceEventKind.TRACKING, DeviceEventKind.LOST, DeviceEventKind.RECONNECTED]
    gap = np.diff([sample.arrival_ns for sample in samples])
    assert np.sum(gap > 100 * MS) == 1
    assert samples[-1].arrival_ns > 9_900 * MS


def test_a_device_switched_off_and_on_is_found_again() -> None:
    bench = Bench()
    bench.run(4.0)
    bench.emulator.power_cycle(bench.now_ns)
    assert bench.run(4.0)
    assert bench.kinds() == [DeviceEventKind.TRACKING, DeviceEventKind.LOST, DeviceEventKind.RECONNECTED]


def test_a_tool_pulled_leaves_the_other_and_comes_back() -> None:
    bench = Bench()
    bench.run(3.0)
    bench.emulator.unplug("0B")
    assert {sample.tool for sample in bench.run(2.0)[10:]} == {"0A"}
    bench.emulator.plug("0B")
    assert {sample.tool for sample in bench.run(2.0)[10:]} == {"0A", "0B"}
    texts = [event.text for event in bench.client.take_events()]
    assert any("unoccupied" in text for text in texts) and any("become occupied" in text for text in texts)


def test_the_last_tool_pulled_is_waited_for() -> None:
    bench = Bench(AuroraConfig(tools=("0A",)))
    bench.run(3.0)
    bench.emulator.unplug("0A")
    assert not bench.run(2.0)
    bench.emulator.plug("0A")
    assert bench.run(4.0)
    assert bench.kinds()[-1] is DeviceEventKind.RECONNECTED


# Damage.


def mangled_run(mangle: Callable[[bytes], bytes], seconds: float = 1.0) -> Bench:
    """A tracking bench whose device bytes then pass through `mangle`, then not; every sample is checked."""
    bench = Bench(AuroraConfig(reply_timeout_s=0.3, reset_timeout_s=1.0))
    bench.run(2.0)
    read = bench.emulator.read
    stop_ns = bench.now_ns + round(seconds * 1e9)
    bench.emulator.read = lambda now_ns: (  # type: ignore[method-assign]
        mangle(read(now_ns)) if now_ns < stop_ns else read(now_ns)
    )
    bench.run(seconds)
    assert any(bench.run(1.0) for _ in range(8)), "the client did not find the device again"
    for sample in bench.samples:
        if not sample.missing:
            position, quaternion = pose_at(bench.frame_time_ns[sample.frame])
            assert sample.position_m == pytest.approx(position, abs=1e-8)
            assert sample.quaternion_wxyz == pytest.approx(quaternion, abs=1e-6)
    return bench


@given(st.integers(0, 2**32), st.sampled_from([1e-4, 1e-3, 1e-2, 0.2]))
@settings(derandomize=True, deadline=None, max_examples=15)
def test_flipped_bits_never_become_a_pose(seed: int, rate: float) -> None:
    rng = np.random.default_rng(seed)

    def flip(data: bytes) -> bytes:
        flips = np.packbits(rng.random((len(data), 8)) < rate, axis=1)
        return bytes(np.frombuffer(data, np.uint8) ^ flips[:, 0]) if data else data

    mangled_run(flip)


@given(st.integers(0, 2**32), st.sampled_from(["cut", "twice", "swap", "noise"]), st.floats(0.02, 0.9))
@settings(derandomize=True, deadline=None, max_examples=20)
def test_lost_doubled_swapped_and_strange_bytes_never_become_a_pose(seed: int, how: str, chance: float) -> None:
    rng = np.random.default_rng(seed)
    held: list[bytes] = []

    def mangle(data: bytes) -> bytes:
        if not data or rng.random() > chance:
            return data
        if how == "cut":
            return data[: rng.integers(0, len(data))]
        if how == "twice":
            return data + data
        if how == "noise":
            return data + rng.bytes(int(rng.integers(1, 40)))
        held.append(data)
        return b"".join(reversed([held.pop(0) for _ in range(len(held))])) if len(held) > 1 else b""

    mangled_run(mangle)


@given(st.lists(st.binary(max_size=200), max_size=20), st.booleans())
@settings(derandomize=True, deadline=None, max_examples=150)
def test_no_bytes_raise_in_any_phase(chunks: list[bytes], tracking: bool) -> None:
    client, now_ns = replay(AuroraConfig(settle_frames=0)) if tracking else (AuroraClient(), 0)
    for chunk in chunks:
        now_ns += 20 * MS
        client.outgoing(now_ns)
        assert client.feed(chunk, now_ns) == []
