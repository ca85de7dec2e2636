"""The Aurora emulator as a device: modes, refusals, bytes, timing, noise and faults, without the client."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from realtime.drivers import ndi_protocol as ndi
from sim.aurora_emulator import FAULT_KINDS, AuroraEmulator, AuroraEmulatorConfig
from sim.sensor_faults import SensorFault

VECTORS = json.loads((Path(__file__).parents[1] / "realtime" / "vectors" / "aurora.json").read_text(encoding="utf-8"))
MS = 1_000_000
STILL = (np.array([0.0125, -0.04025, -0.18075]), np.array([0.5, 0.5, -0.5, 0.5]))
QUIET = {"position_noise_m": 0.0, "orientation_noise_rad": 0.0, "frame_jitter_s": 0.0, "processing_jitter_s": 0.0}


class Console:
    """Sends one command at a time and reads its whole reply."""

    def __init__(
        self, config: AuroraEmulatorConfig | None = None, faults: tuple[SensorFault, ...] = (), seed: int = 1
    ) -> None:
        self.device = AuroraEmulator(config or AuroraEmulatorConfig(**QUIET), seed, faults)
        self.now_ns = 0
        self.baud = 9600

    def wait(self, seconds: float) -> bytes:
        stop_ns, data = self.now_ns + round(seconds * 1e9), b""
        while self.now_ns < stop_ns:
            self.now_ns += MS
            while self.device.next_frame_ns <= self.now_ns:
                self.device.sample(self.device.next_frame_ns, [STILL] * len(self.device.config.handles))
            data += self.device.read(self.now_ns)
        return data

    def send(self, data: bytes, seconds: float = 0.5) -> bytes:
        self.device.feed(data, self.now_ns)
        return self.wait(seconds)

    def ask(self, name: str, parameters: str = "") -> str:
        reader = ndi.ReplyReader()
        (reply,) = reader.feed(self.send(ndi.command(name, parameters)))
        assert reader.damaged == 0
        return reply.text if reply.text is not None else "binary"

    def set_baud(self, baud: int) -> None:
        assert self.ask("COMM", f"{ndi.BAUD_CODES[baud]}0000") == "OKAY"
        self.device.set_line(baud)

    def start(self) -> None:
        assert self.ask("INIT") == "OKAY"
        for handle in self.device.config.handles:
            assert self.ask("PINIT", handle) == self.ask("PENA", f"{handle}D") == "OKAY"
        assert self.ask("TSTART") == "OKAY"

    def poll(self) -> ndi.TrackingReply:
        reader = ndi.ReplyReader()
        replies = reader.feed(self.send(ndi.command("BX", "0001"), 0.2))
        return ndi.parse_bx(replies[0].binary or b"")


def test_the_recorded_session_is_answered_byte_for_byte() -> None:
    console = Console()
    console.device.serial_break(0)
    assert console.wait(1.0) == b"RESETBE6F\r"
    for step in VECTORS["session"][1:]:
        answer = console.send(step["host"].encode("ascii"))
        if step["host"].startswith("VER"):
            assert b"emulated" in answer
            continue
        wanted = step["device"] if "WARNING" not in step["device"] else "OKAYA896\r"
        assert answer == wanted.encode("ascii"), step["meaning"]
        if step["host"].startswith("COMM"):
            console.device.set_line(921600)


def test_the_recorded_pose_is_sent_byte_for_byte() -> None:
    console = Console(AuroraEmulatorConfig(handles=("0A",), **QUIET))
    console.start()
    binary = console.send(ndi.command("BX", "0001"))
    recorded = bytes.fromhex(VECTORS["replies"][0]["hex"])
    assert binary[7:9] == recorded[7:9] and binary[9:37] == recorded[9:37]
    (number,) = struct.unpack_from("<I", binary, 45)
    text = console.send(ndi.command("TX", "0001"))
    assert text[2:47] == VECTORS["replies"][4]["text"].encode("ascii")[2:47]
    assert 0 < number <= console.device.frame_number


SETUP_ONLY = ("PHSR:00", "PHINF:0A0001", "PHF:0A", "PINIT:0A", "PENA:0AD", "PDIS:0A", "TSTART:", "INIT:")
TRACKING_ONLY = ("TSTOP:", "TX:0001", "BX:0001")


@pytest.mark.parametrize("text", [*SETUP_ONLY[:-1], *TRACKING_ONLY, "BEEP:1"])
def test_before_init_nearly_everything_is_refused(text: str) -> None:
    name, parameters = text.split(":")
    assert Console().ask(name, parameters) == "ERROR10"


@pytest.mark.parametrize("text", TRACKING_ONLY)
def test_tracking_commands_are_refused_in_setup_mode(text: str) -> None:
    console = Console()
    console.ask("INIT")
    assert console.ask(*text.split(":")) == "ERROR0C"


@pytest.mark.parametrize("text", SETUP_ONLY)
def test_setup_commands_are_refused_while_tracking(text: str) -> None:
    console = Console()
    console.start()
    assert console.ask(*text.split(":")) == "ERROR0C"
    assert console.device.tracking


@pytest.mark.parametrize(
    ("name", "parameters", "error"),
    [
        ("GX", "0001", "01"),
        ("COMM", "90000", "23"),
        ("COMM", "5", "07"),
        ("VER", "9", "23"),
        ("BEEP", "0", "23"),
        ("PHSR", "09", "23"),
        ("PINIT", "0C", "08"),
        ("PINIT", "A", "07"),
        ("PENA", "0AD", "0E"),
        ("PENA", "0AX", "09"),
        ("PDIS", "0A", "0E"),
        ("PHINF", "0A00", "07"),
        ("PHF", "0A", "08"),
    ],
)
def test_wrong_commands_get_their_error_code(name: str, parameters: str, error: str) -> None:
    console = Console()
    console.ask("INIT")
    assert console.ask(name, parameters) == f"ERROR{error}"


def test_the_crc_of_a_command_is_checked_and_may_be_left_out_with_a_space() -> None:
    console = Console()
    assert console.send(b"INIT:E3A4\r") == b"ERROR04" + b"%04X\r" % ndi.crc16(b"ERROR04")
    assert console.send(b"INIT \r") == b"OKAYA896\r"
    assert console.send(b"BEEP 1\r")[:1] == b"1"


def test_a_host_at_another_speed_is_not_understood() -> None:
    console = Console()
    console.set_baud(115200)
    console.device.set_line(9600)
    assert console.send(ndi.command("INIT")) == b""
    console.device.serial_break(console.now_ns)
    assert console.wait(1.0) == b"RESETBE6F\r" and console.device.baud == 9600


@pytest.mark.parametrize("baud", [9600, 115200, 921600])
def test_a_reply_takes_ten_bit_times_a_byte(baud: int) -> None:
    console = Console()
    console.set_baud(baud)
    sent_ns = console.now_ns
    console.device.feed(ndi.command("VER", "0"), sent_ns)
    length = len(VECTORS["session"][2]["device"])
    last_ns = round(sent_ns + 0.0002e9 + (10 + length) * 10e9 / baud)
    early, late = console.device.read(last_ns - 10**10 // baud), console.device.read(last_ns + 1000)
    assert len(early) == length - 1 and len(late) == 1


def test_replies_leave_one_after_the_other() -> None:
    console = Console()
    console.device.feed(2 * ndi.command("VER", "0"), 0)
    length = len(VECTORS["session"][2]["device"])
    whole_ns = round(0.0002e9 + (10 + 2 * (length + 12)) * 10e9 / 9600)
    data = console.device.read(whole_ns // 2) + console.device.read(10**9)
    assert len(ndi.ReplyReader().feed(data)) == 2
    assert len(console.device.read(2 * 10**9)) == 0
    again = Console()
    again.device.feed(2 * ndi.command("VER", "0"), 0)
    assert len(again.device.read(round((10 + 1.5 * length) * 10e9 / 9600))) < 1.6 * length


@pytest.mark.parametrize("late_s", [0.0, 0.1])
def test_a_frame_can_be_had_after_its_latency_and_not_before(late_s: float) -> None:
    emulator = AuroraEmulator(AuroraEmulatorConfig(**QUIET), 1, [SensorFault("late", 0, MS, value=late_s)])
    emulator.sample(0, [STILL, STILL])
    ready_ns = 25 * MS + round(late_s * 1e9)
    assert emulator._frame_at(ready_ns - 1) is None
    frame = emulator._frame_at(ready_ns)
    assert frame is not None and frame.number == 1


def test_poses_outside_the_volume_are_sent_only_when_asked_for() -> None:
    console = Console(AuroraEmulatorConfig(handles=("0A",), **QUIET), (SensorFault("out_of_volume", 0, 10**18),))
    console.start()
    for option, state in (("0001", ndi.HandleState.MISSING), ("0801", ndi.HandleState.VALID)):
        (binary,) = ndi.ReplyReader().feed(console.send(ndi.command("BX", option)))
        (text,) = ndi.ReplyReader().feed(console.send(ndi.command("TX", option)))
        for reply in (ndi.parse_bx(binary.binary or b""), ndi.parse_tx(text.text or "")):
            (tool,) = reply.tools
            assert tool.state is state and tool.status & ndi.PortStatus.OUT_OF_VOLUME


def test_a_pulled_tool_is_stale_until_freed_and_new_when_plugged() -> None:
    console = Console()
    console.start()
    assert console.ask("TSTOP") == "OKAY"
    console.device.unplug("0B")
    assert console.device._console.system_status == 0x80
    assert console.ask("PHSR", "01") == "010B000"
    assert console.ask("PINIT", "0B") == "ERROR0D"
    assert console.ask("PHINF", "0B0001") == "UNOCCUPIED"
    assert console.ask("PHF", "0B") == "OKAY"
    assert console.ask("PHSR", "00") == "010A031" and console.ask("PINIT", "0B") == "ERROR2B"
    console.device.plug("0B")
    assert console.ask("PHSR", "02") == "010B001"
    assert console.device._console.system_status == 0


def test_frozen_poses_come_under_new_frame_numbers() -> None:
    emulator = AuroraEmulator(seed=2, faults=[SensorFault("frozen", 100 * MS, 200 * MS, handle="0A")])
    seen = []
    for _ in range(12):
        emulator.sample(emulator.next_frame_ns, [STILL, STILL])
        seen.append((emulator.frame_number, emulator._last["0A"].pose, emulator._last["0B"].pose))
    numbers, tip, shaft = zip(*seen, strict=True)
    assert numbers == tuple(range(1, 13))
    assert len(set(tip)) == 8 and len(set(shaft)) == 12


def test_noise_has_the_stated_size_and_no_colour_unless_asked() -> None:
    for correlation_s, lag_one in ((0.0, 0.0), (0.1, np.exp(-0.25))):
        config = AuroraEmulatorConfig(
            handles=("0A",),
            noise_correlation_s=correlation_s,
            **{**QUIET, "position_noise_m": 0.00029, "orientation_noise_rad": 0.0035},
        )
        emulator = AuroraEmulator(config, 7)
        poses = []
        for _ in range(6000):
            emulator.sample(emulator.next_frame_ns, [(STILL[0], np.array([1.0, 0, 0, 0]))])
            poses.append(emulator._last["0A"].pose)
        table = np.array(poses)
        noise = table[:, 4:7] * 1e-3 - STILL[0]
        assert np.std(noise, axis=0) == pytest.approx([0.00029] * 3, rel=0.1)
        assert np.std(2 * table[:, 1:4], axis=0) == pytest.approx([0.0035] * 3, rel=0.1)
        assert np.mean(noise[1:] * noise[:-1]) / np.var(noise) == pytest.approx(lag_one, abs=0.06)


def test_dropouts_and_wild_poses_come_as_often_as_stated() -> None:
    config = AuroraEmulatorConfig(handles=("0A",), dropout=0.1, wild=0.05, **QUIET)
    emulator = AuroraEmulator(config, 7)
    missing = wild = 0
    for _ in range(4000):
        emulator.sample(emulator.next_frame_ns, [STILL])
        pose = emulator._last["0A"].pose
        missing += pose is None
        wild += pose is not None and bool(np.linalg.norm(np.array(pose[4:7]) - 1e3 * STILL[0]) > 1.0)
    assert missing == pytest.approx(400, abs=60)
    assert wild == pytest.approx(180, abs=45)


@pytest.mark.parametrize("kind", FAULT_KINDS)
def test_a_fault_lasts_as_long_as_it_is_asked_for(kind: str) -> None:
    fault = SensorFault(kind, 8_000 * MS, 9_000 * MS, value={"wild": 0.05, "bit_errors": 0.02, "late": 0.5}.get(kind, 0.0))
    console = Console(faults=(fault,))
    console.start()
    console.wait((fault.start_ns - console.now_ns) * 1e-9 - 0.3)
    before = console.poll()
    console.wait(0.4)
    during = console.send(ndi.command("BX", "0001"), 0.3)
    frames = console.device.frame_number
    console.wait(0.2)
    stuck = console.device.frame_number == frames
    console.wait(1.2)
    after = console.poll()
    assert before.tools[0].state is after.tools[0].state is ndi.HandleState.VALID
    assert after.tools[0].position_m == pytest.approx(STILL[0].tolist(), abs=1e-8)
    assert stuck == (kind == "stuck")
    replies = ndi.ReplyReader().feed(during)
    if kind in ("silent", "bit_errors"):
        assert replies == [] and bool(during) == (kind == "bit_errors")
        return
    tool = ndi.parse_bx(replies[0].binary or b"").tools[0]
    assert (tool.state is ndi.HandleState.MISSING) == (kind in ("missing", "out_of_volume", "broken"))
    bits = {"out_of_volume": 0x40, "partly": 0x80, "broken": 0x100}.get(kind, 0)
    assert int(tool.status) == 0x31 | bits
    if kind == "wild":
        assert tool.position_m is not None and np.linalg.norm(np.array(tool.position_m) - STILL[0]) > 0.005


def test_an_unknown_fault_and_a_wrong_number_of_poses_are_refused() -> None:
    with pytest.raises(ValueError, match="gremlin"):
        AuroraEmulator(faults=[SensorFault("gremlin", 0, 1)])
    with pytest.raises(ValueError, match="poses: found 1, wanted 2"):
        AuroraEmulator().sample(0, [STILL])
    with pytest.raises(ValueError, match="out of range"):
        AuroraEmulatorConfig(clock_error=0.5)


def conversation(seed: int, chunks: list[int], step_ns: int) -> bytes:
    """All that the device says to a fixed talk, sent in pieces of the sizes in `chunks` and read every `step_ns`."""
    device = AuroraEmulator(AuroraEmulatorConfig(), seed)
    talk = b"".join(
        ndi.command(*text.split(":"))
        for text in ("INIT:", "PHSR:02", "PINIT:0A", "PENA:0AD", "TSTART:", "BX:0001", "TX:0001", "BX:0001")
    )
    said, now_ns, at, piece = b"", 0, 0, 0
    while now_ns < 2_000 * MS:
        if at < len(talk):
            size = chunks[piece % len(chunks)]
            device.feed(talk[at : at + size], 0)
            at, piece = at + size, piece + 1
            continue
        now_ns += step_ns
        while device.next_frame_ns <= now_ns:
            device.sample(device.next_frame_ns, [STILL, None])
        said += device.read(now_ns)
    return said


@given(st.lists(st.integers(1, 30), min_size=1, max_size=6), st.sampled_from([300_000, MS, 7 * MS]))
@settings(derandomize=True, deadline=None, max_examples=15)
def test_the_same_seed_says_the_same_however_it_is_cut(chunks: list[int], step_ns: int) -> None:
    reference = conversation(5, [1000], MS)
    assert conversation(5, chunks, step_ns) == reference
    assert len(reference) > 200 and conversation(6, chunks, step_ns) != reference


@given(st.binary(max_size=300))
@settings(derandomize=True, deadline=None, max_examples=100)
def test_no_bytes_from_the_host_raise(noise: bytes) -> None:
    console = Console()
    console.ask("INIT")
    console.send(noise + b"\r", 0.5)
    assert console.ask("BEEP", "1") == "1"
