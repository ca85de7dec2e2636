"""Bad cables: nothing is touched without a fault, each kind of fault does what it says, the seed decides."""

from protocol.serial_codec import StreamDecoder, encode
from realtime.core.lines import FromRig, ToRig
from sim.line_noise import LineNoise
from sim.sensor_faults import SensorFault

FOREVER = 1 << 60


def frames(count: int) -> bytes:
    return b"".join(encode("PING", number & 0xFF) for number in range(count))


def through(kind: str, value: float, data: bytes, seed: int = 1) -> tuple[bytes, LineNoise]:
    noise = LineNoise(seed)
    noise.add(SensorFault(kind, 0, FOREVER, value=value))
    return noise.outgoing(ToRig(board=data), 1).board, noise


def test_a_good_cable_passes_all_bytes_as_they_are() -> None:
    noise, arriving, leaving = LineNoise(1), FromRig(b"\x01\x02", b"t", [b"f"]), ToRig(b"\x03")
    assert noise.incoming(arriving, 5) is arriving and noise.outgoing(leaving, 5) is leaving


def test_a_fault_ends_when_it_ends() -> None:
    noise = LineNoise(1)
    noise.add(SensorFault("cut", 10, 20))
    assert noise.outgoing(ToRig(board=frames(2)), 15).board == b""
    assert noise.outgoing(ToRig(board=frames(2)), 20).board == frames(2)


def test_dropped_duplicated_and_swapped_frames_stay_whole() -> None:
    data = frames(200)
    for kind in ("drop", "duplicate", "reorder"):
        out, noise = through(kind, 0.3, data)
        decoder = StreamDecoder()
        numbers = [message.sequence for message in decoder.feed(out)]
        assert decoder.counters.crc_errors == 0 and numbers and out != data
        assert (noise.counts.dropped > 30) == (kind == "drop")
        assert (noise.counts.doubled > 30) == (kind == "duplicate")
        assert (noise.counts.swapped > 0) == (kind == "reorder")


def test_bit_errors_come_at_their_rate_and_the_same_for_the_same_seed() -> None:
    data = frames(2000)
    out, noise = through("bit_errors", 1e-2, data)
    share = noise.counts.damaged / len(data)
    assert 0.06 < share < 0.10  # 1 - 0.99^8
    assert out == through("bit_errors", 1e-2, data)[0] != through("bit_errors", 1e-2, data, seed=2)[0]


def test_a_flood_multiplies_and_a_frame_in_parts_arrives_whole() -> None:
    noise = LineNoise(1)
    noise.add(SensorFault("flood_in", 0, FOREVER, value=10.0))
    data = frames(3)
    first = noise.incoming(FromRig(board=data[:7], force=[b"r"]), 1)
    second = noise.incoming(FromRig(board=data[7:]), 2)
    assert len(first.force) == 10
    assert first.board.count(b"\0") + second.board.count(b"\0") == 30
