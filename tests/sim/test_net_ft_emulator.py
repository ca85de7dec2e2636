"""The Net F/T emulator as a device: requests, records, noise, faults and its page, without the client."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from realtime.drivers.net_ft_calibration import parse_calibration
from sim.net_ft_emulator import NetFtEmulator, NetFtEmulatorConfig
from sim.sensor_faults import SensorFault

VECTORS = json.loads((Path(__file__).parents[1] / "realtime" / "vectors" / "net_ft.json").read_text(encoding="utf-8"))
MS = 1_000_000
START, STOP, BIAS = (bytes.fromhex(VECTORS["requests"][k]["hex"]) for k in (1, 0, 4))
STILL = NetFtEmulatorConfig(force_noise_N=0.0, torque_noise_Nm=0.0, jitter_s=0.0)


def run(
    device: NetFtEmulator, seconds: float, force_N: tuple[float, float, float] = (0.0, 0.0, 0.2), start_ns: int | None = None
) -> list[tuple[int, ...]]:
    """Records that arrive while the load stands for `seconds`."""
    first_ns = device.next_sample_ns if start_ns is None else start_ns
    while device.next_sample_ns < first_ns + seconds * 1e9:
        device.sample(device.next_sample_ns, np.array(force_N), np.zeros(3))
    return [struct.unpack(">IIIiiiiii", datagram) for datagram in device.read(first_ns + round((seconds + 1) * 1e9))]


def test_nothing_is_sent_before_it_is_asked_for_and_after_it_is_stopped() -> None:
    device = NetFtEmulator(STILL)
    assert run(device, 0.1) == []
    device.feed(START, device.next_sample_ns)
    assert len(run(device, 0.1)) == 100
    device.feed(STOP, device.next_sample_ns)
    assert run(device, 0.1) == []


def test_records_have_the_bytes_of_the_vectors() -> None:
    device = NetFtEmulator(STILL)
    device.feed(START, 0)
    device.start_sequences_at(0, 7000 - 7)
    device.sample(0, np.array([0.0, 0.0, 0.2]), np.zeros(3))
    assert device.read(MS)[0].hex() == VECTORS["records"][0]["hex"]
    device.sample(MS, np.array([-0.015, 0.00025, -1e-6]), np.array([0.001, -0.002, 3e-6]))
    assert device.read(2 * MS)[0].hex() == VECTORS["records"][1]["hex"]


def test_a_counted_request_gives_that_many_records() -> None:
    device = NetFtEmulator(STILL)
    device.feed(struct.pack(">HHI", 0x1234, 2, 7), 0)
    records = run(device, 0.1)
    assert [record[0] for record in records] == [1, 2, 3, 4, 5, 6, 7]
    assert set(np.diff([record[1] for record in records])) == {7}


@given(st.binary(max_size=20).filter(lambda data: data[:2] != b"\x12\x34" or len(data) != 8))
@settings(derandomize=True, deadline=None, max_examples=100)
def test_anything_but_a_request_is_ignored(data: bytes) -> None:
    device = NetFtEmulator(STILL)
    device.feed(data, 0)
    assert device.malformed_requests == 1 and run(device, 0.01) == []


def test_an_unknown_command_is_ignored() -> None:
    device = NetFtEmulator(STILL)
    device.feed(bytes.fromhex("1234000700000000"), 0)
    assert device.malformed_requests == 1 and not device.streaming


def test_records_arrive_after_the_latency() -> None:
    device = NetFtEmulator(STILL)
    device.feed(START, 0)
    device.sample(0, np.zeros(3), np.zeros(3))
    assert device.read(299_999) == [] and len(device.read(300_000)) == 1


@pytest.mark.parametrize(("correlation_s", "lag_one"), [(0.0, 0.0), (0.01, np.exp(-0.1))])
def test_noise_has_the_stated_size_and_colour(correlation_s: float, lag_one: float) -> None:
    device = NetFtEmulator(NetFtEmulatorConfig(force_noise_N=0.003, noise_correlation_s=correlation_s), 3)
    device.feed(START, 0)
    force = np.array(run(device, 10.0))[:, 3:6] * 1e-6 - [0.0, 0.0, 0.2]
    assert np.std(force, axis=0) == pytest.approx([0.003] * 3, rel=0.1)
    assert np.mean(force[1:] * force[:-1]) / np.var(force) == pytest.approx(lag_one, abs=0.05)


def test_bias_takes_the_load_and_a_power_cycle_forgets_it() -> None:
    device = NetFtEmulator(STILL)
    device.feed(START, 0)
    run(device, 0.01)
    device.feed(BIAS, device.next_sample_ns)
    assert run(device, 0.01)[-1][5] == 0
    device.power_cycle()
    device.feed(START, device.next_sample_ns)
    assert run(device, 0.01)[-1][5] == 200_000


def test_beyond_the_range_the_gauges_saturate_and_the_status_says_so() -> None:
    device = NetFtEmulator(STILL)
    device.feed(START, 0)
    within, beyond = run(device, 0.01, (0.0, 0.0, 20.0))[-1], run(device, 0.01, (0.0, 0.0, 40.0))[-1]
    assert within[2] == 0 and within[5] == 20_000_000
    assert beyond[2] == 0x80020000 and beyond[5] == pytest.approx(25_500_000)


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        ("drop", 0.2),
        ("duplicate", 0.2),
        ("reorder", 0.2),
        ("silent", 0.0),
        ("saturated", 0.0),
        ("broken", 0.0),
        ("drift", 0.5),
        ("frozen", 0.0),
        ("bit_errors", 0.01),
    ],
)
def test_a_fault_lasts_as_long_as_it_is_asked_for(kind: str, value: float) -> None:
    config = NetFtEmulatorConfig(force_noise_N=0.001)
    device = NetFtEmulator(config, 5, [SensorFault(kind, 1_000 * MS, 2_000 * MS, value=value)])
    device.feed(START, 0)
    before, during, after = run(device, 1.0), run(device, 1.0), run(device, 1.0)
    for calm in (before, after):
        sequences = np.array([record[0] for record in calm])
        forces = np.array([record[5] for record in calm]) * 1e-6
        assert len(calm) == 1000 and np.all(np.diff(sequences) == 1) and np.all(np.abs(forces - 0.2) < 0.01)
        assert {record[2] for record in calm} == {0}
    sequences = np.array([record[0] for record in during])
    forces = np.array([record[5] for record in during]) * 1e-6
    seen = {
        "drop": abs(len(during) - 800) < 60,
        "duplicate": abs(len(during) - 1200) < 60,
        "reorder": bool(np.any(np.diff(sequences) < 0)),
        "silent": len(during) == 0,
        "saturated": {record[2] for record in during} == {0x80020000},
        "broken": {record[2] for record in during} == {0x80000100},
        "drift": bool(len(forces)) and abs(float(forces[-1:].sum()) - 0.7) < 0.01,
        "frozen": len({record[3:] for record in during}) == 1,
        "bit_errors": len({record[2] for record in during}) > 3,
    }
    assert seen[kind]


def test_the_same_seed_gives_the_same_datagrams() -> None:
    def datagrams(seed: int) -> list[tuple[int, ...]]:
        device = NetFtEmulator(NetFtEmulatorConfig(), seed, [SensorFault("reorder", 0, 10**9, value=0.1)])
        device.feed(START, 0)
        return run(device, 0.5)

    assert datagrams(1) == datagrams(1) != datagrams(2)


@pytest.mark.parametrize("units", [("N", "Nm"), ("lbf", "lbf-in"), ("kN", "N-mm")])
def test_the_page_says_the_same_scale_in_every_unit(units: tuple[str, str]) -> None:
    page = NetFtEmulator(NetFtEmulatorConfig(force_unit=units[0], torque_unit=units[1])).page()
    calibration = parse_calibration(page)
    assert calibration.counts_per_N == pytest.approx(1e6) and calibration.counts_per_Nm == pytest.approx(1e6)
    assert calibration.range_N == pytest.approx((12, 12, 17), rel=1e-5)


def test_an_impossible_rate_or_fault_is_refused() -> None:
    with pytest.raises(ValueError, match="rate_hz"):
        NetFtEmulatorConfig(rate_hz=999.0)
    with pytest.raises(ValueError, match="gremlin"):
        NetFtEmulator(faults=[SensorFault("gremlin", 0, 1)])
