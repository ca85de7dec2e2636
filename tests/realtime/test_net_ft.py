"""The Net F/T client: recorded bytes, gaps and wrap-around, faults, times, silence, and damaged or shuffled datagrams."""

import json
import struct
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from realtime.drivers.device_events import DeviceEventKind
from realtime.drivers.net_ft import (
    STATUS_TEXTS,
    ForceSample,
    NetFtClient,
    NetFtCommand,
    NetFtConfig,
    describe_status,
    is_fault,
    request,
)
from realtime.drivers.net_ft_calibration import NetFtCalibration, parse_calibration
from sim.net_ft_emulator import NetFtEmulator, NetFtEmulatorConfig, exchange
from sim.sensor_faults import SensorFault

VECTORS = json.loads((Path(__file__).parent / "vectors" / "net_ft.json").read_text(encoding="utf-8"))
MS = 1_000_000
CONFIG = NetFtConfig(NetFtCalibration())


def record(sequence: int, status: int = 0, fz: int = 1000, ft_sequence: int | None = None) -> bytes:
    ft = 7 * sequence if ft_sequence is None else ft_sequence
    return struct.pack(">IIIiiiiii", sequence % 2**32, ft % 2**32, status, 0, 0, fz, 0, 0, 0)


class Bench:
    """Client and emulator in virtual time; Fz tells the time of sampling in units of 1 N/s."""

    def __init__(
        self, device: NetFtEmulatorConfig | None = None, faults: tuple[SensorFault, ...] = (), seed: int = 4
    ) -> None:
        self.emulator = NetFtEmulator(device or NetFtEmulatorConfig(force_noise_N=0.0, torque_noise_Nm=0.0), seed, faults)
        self.client = NetFtClient(NetFtConfig(parse_calibration(self.emulator.page())))
        self.now_ns = 0
        self.samples: list[ForceSample] = []

    def run(self, seconds: float, step_ns: int = 500_000) -> list[ForceSample]:
        first, stop_ns = len(self.samples), self.now_ns + round(seconds * 1e9)
        while self.now_ns < stop_ns:
            self.now_ns += step_ns
            while (time_ns := self.emulator.next_sample_ns) <= self.now_ns:
                self.emulator.sample(time_ns, force_at(time_ns), np.zeros(3))
            self.samples += exchange(self.client, self.emulator, self.now_ns)
        return self.samples[first:]

    def kinds(self) -> list[DeviceEventKind]:
        return [event.kind for event in self.client.take_events()]


def force_at(time_ns: int) -> np.ndarray:
    """0.1 N/s along z and its share of a slower axis: the reading tells when it was taken."""
    return np.array([0.01, -0.02, 1e-10 * time_ns])


@pytest.mark.parametrize("vector", VECTORS["requests"], ids=lambda vector: vector["command"])
def test_requests_have_the_bytes_of_the_vectors(vector: dict) -> None:
    assert request(NetFtCommand[vector["command"]]).hex() == vector["hex"]


def test_the_recorded_datagrams_mean_what_the_vectors_say() -> None:
    client = NetFtClient(CONFIG)
    assert client.outgoing(0).hex() == VECTORS["requests"][1]["hex"]
    for k, vector in enumerate(VECTORS["records"]):
        sample = client.feed(bytes.fromhex(vector["hex"]), k * MS)
        if vector["sequence"] is None:
            assert sample is None, vector["meaning"]
            continue
        assert sample is not None, vector["meaning"]
        assert (sample.rdt_sequence, sample.status, sample.lost) == (vector["sequence"], vector["status"], vector["lost"])
        assert sample.force_N == pytest.approx(vector["force_N"]) and sample.torque_Nm == pytest.approx(vector["torque_Nm"])
    c = client.counters
    assert (c.malformed, c.old, c.duplicates, c.status_errors, c.wild, c.lost, c.samples) == (2, 1, 1, 2, 1, 2, 5)


@pytest.mark.parametrize("vector", VECTORS["pages"], ids=lambda vector: vector["meaning"])
def test_the_calibration_page_is_read_in_si_whatever_its_units(vector: dict) -> None:
    calibration = parse_calibration(vector["xml"].encode("ascii"))
    assert calibration.counts_per_N == pytest.approx(vector["counts_per_N"])
    assert calibration.counts_per_Nm == pytest.approx(vector["counts_per_Nm"])
    assert calibration.range_N == pytest.approx(vector["range_N"], rel=1e-6)
    assert calibration.range_Nm == pytest.approx(vector["range_Nm"], rel=1e-6)
    assert calibration.rdt_rate_hz == 1000 and calibration.serial == "FT12345"


@pytest.mark.parametrize("vector", VECTORS["bad_pages"], ids=lambda vector: vector["key"])
def test_a_bad_page_is_refused_by_the_name_of_what_is_wrong(vector: dict) -> None:
    with pytest.raises(ValueError, match=vector["key"]):
        parse_calibration(vector["xml"].encode("ascii"))


@given(st.binary(max_size=300))
@settings(derandomize=True, deadline=None, max_examples=100)
def test_no_page_raises_anything_else(page: bytes) -> None:
    with pytest.raises(ValueError, match="found"):
        parse_calibration(page)


def test_a_calibration_that_cannot_be_is_refused() -> None:
    with pytest.raises(ValueError, match="counts_per_N"):
        NetFtCalibration(counts_per_N=float("nan"))


# Sequence.


def test_gaps_are_counted_across_the_wrap_around() -> None:
    client = NetFtClient(CONFIG)
    sequences = [2**32 - 3, 2**32 - 2, 1, 2, 5]
    samples = [client.feed(record(sequence), k * MS) for k, sequence in enumerate(sequences)]
    assert [sample.lost for sample in samples if sample] == [0, 0, 2, 0, 2]
    assert client.counters.lost == 4 and client.counters.old == 0


def test_both_counters_wrap_without_a_gap_or_a_jump_in_time() -> None:
    bench = Bench()
    bench.run(0.2)
    bench.emulator.start_sequences_at(2**32 - 500, 2**32 - 3500)
    bench.run(0.1)
    samples = bench.run(1.0)
    stamps = np.diff([sample.stamp_ns for sample in samples])
    assert samples[0].rdt_sequence > 2**31 > samples[-1].rdt_sequence
    assert bench.client.counters.lost == 0 and len(samples) > 990
    assert np.all(np.abs(stamps - MS) < 0.2 * MS)


def test_a_stream_started_anew_is_believed_once_it_counts_on() -> None:
    client = NetFtClient(CONFIG)
    for k in range(100):
        client.feed(record(5_000_000 + k), k * MS)
    accepted = [client.feed(record(k), (100 + k) * MS) is not None for k in range(1, 8)]
    assert accepted == [False, False, True, True, True, True, True]
    assert client.counters.strays == 3 and client.counters.resyncs == 1


def test_one_record_with_a_strange_sequence_is_not_believed() -> None:
    client = NetFtClient(CONFIG)
    for k in range(10):
        client.feed(record(k), k * MS)
    assert client.feed(record(3_000_000_000), 10 * MS) is None
    sample = client.feed(record(10), 11 * MS)
    assert sample is not None and sample.lost == 0


# Faults of the device.


def test_every_status_bit_has_words_and_only_a_latched_monitor_is_no_fault() -> None:
    for bit, text in STATUS_TEXTS.items():
        assert text in describe_status(0x80000000 | bit)
        assert is_fault(0x80000000 | bit) == is_fault(bit) == (bit != 0x00010000)
    assert describe_status(0) == "good" and not is_fault(0) and is_fault(0x80000000)


@pytest.mark.parametrize(("kind", "words"), [("saturated", "saturated"), ("broken", "excitation")])
def test_faulty_records_are_not_used_and_told_in_words(kind: str, words: str) -> None:
    bench = Bench(faults=(SensorFault(kind, 500 * MS, 700 * MS),))
    stamps = np.array([sample.stamp_ns for sample in bench.run(1.0)])
    assert not np.any((stamps > 501 * MS) & (stamps < 699 * MS))
    assert bench.client.counters.status_errors == pytest.approx(200, abs=2)
    texts = [event.text for event in bench.client.take_events() if event.kind is DeviceEventKind.WARNING]
    assert len(texts) == 2 and words in texts[0] and "good" in texts[1]


def test_a_load_over_the_range_that_does_not_saturate_is_still_told() -> None:
    client = NetFtClient(CONFIG)
    sample = client.feed(record(1, fz=20_000_000), 0)
    assert sample is not None and sample.force_N[2] == pytest.approx(20.0)


def test_a_frozen_reading_under_new_sequence_numbers_is_found_and_passes_no_more() -> None:
    bench = Bench(faults=(SensorFault("frozen", 500 * MS, 700 * MS),))
    stamps = np.array([sample.stamp_ns for sample in bench.run(1.0)])
    assert not np.any((stamps > 552 * MS) & (stamps < 699 * MS)) and np.any(stamps > 900 * MS)
    assert bench.client.counters.frozen == pytest.approx(150, abs=15)
    assert any("frozen" in event.text for event in bench.client.take_events())


def test_bias_makes_the_present_load_zero() -> None:
    bench = Bench(NetFtEmulatorConfig(zero_offset_N=(0.5, -0.3, 2.0), force_noise_N=0.0, torque_noise_Nm=0.0))
    before = bench.run(0.1)[-1]
    bench.emulator.feed(bench.client.bias(), bench.now_ns)
    after = bench.run(0.1)
    assert before.force_N[:2] == pytest.approx([0.51, -0.32])
    assert after[-1].force_N[:2] == pytest.approx([0.0, 0.0], abs=1e-6)


def test_silence_is_told_once_and_the_stream_asked_for_until_it_comes() -> None:
    bench = Bench(faults=(SensorFault("silent", 1_000 * MS, 3_000 * MS),))
    samples = bench.run(5.0)
    assert bench.kinds() == [DeviceEventKind.TRACKING, DeviceEventKind.LOST, DeviceEventKind.RECONNECTED]
    assert bench.client.counters.silences == 1 and bench.client.counters.requests > 5
    assert samples[-1].stamp_ns > 4_990 * MS


def test_a_box_switched_off_and_on_is_found_again() -> None:
    bench = Bench()
    bench.run(1.0)
    bench.emulator.power_cycle()
    assert len(bench.run(2.0)) > 1500
    assert bench.kinds() == [DeviceEventKind.TRACKING, DeviceEventKind.LOST, DeviceEventKind.RECONNECTED]


def test_stop_ends_the_stream_and_start_begins_it() -> None:
    bench = Bench()
    bench.run(0.5)
    bench.emulator.feed(bench.client.stop(), bench.now_ns)
    assert len(bench.run(1.0)) <= 2
    bench.emulator.feed(bench.client.start(), bench.now_ns)
    assert len(bench.run(0.5)) > 400


# Times.


@pytest.mark.parametrize("drift", [-100e-6, 100e-6])
@pytest.mark.parametrize(("jitter_s", "rms_us"), [(0.00005, 100), (0.0005, 150)])
def test_stamps_are_the_sampling_times(jitter_s: float, rms_us: float, drift: float) -> None:
    bench = Bench(NetFtEmulatorConfig(force_noise_N=0.0, jitter_s=jitter_s, clock_error=drift))
    samples = bench.run(12.0, step_ns=50_000)
    errors_us = np.array([sample.stamp_ns - sample.force_N[2] * 1e10 for sample in samples]) * 1e-3
    assert len(samples) > 11_900
    rms = float(np.sqrt(np.mean(errors_us[2000:] ** 2)))
    print(f"jitter {1e6 * jitter_s:.0f} us, drift {1e6 * drift:+.0f} ppm: RMS {rms:.0f} us")
    assert rms < rms_us


# Damage.


def truth(sequence: int) -> int:
    return 100 * sequence


@given(st.lists(st.tuples(st.integers(1, 60), st.sampled_from(["good", "cut", "long", "empty"])), max_size=150))
@settings(derandomize=True, deadline=None, max_examples=150)
def test_shuffled_doubled_and_cut_datagrams_never_go_back_or_lie(arrivals: list[tuple[int, str]]) -> None:
    client = NetFtClient(CONFIG)
    seen: list[ForceSample] = []
    for k, (sequence, kind) in enumerate(arrivals):
        datagram = record(sequence, fz=truth(sequence))
        datagram = {"good": datagram, "cut": datagram[:-1], "long": datagram + b"\x00", "empty": b""}[kind]
        sample = client.feed(datagram, k * MS)
        if sample is not None:
            assert kind == "good" and sample.force_N[2] == pytest.approx(truth(sample.rdt_sequence) * 1e-6)
            seen.append(sample)
    counters = client.counters
    assert counters.samples == len(seen)
    if counters.resyncs == 0:
        assert all(a.rdt_sequence < b.rdt_sequence for a, b in pairwise(seen))
        if seen:
            span = seen[-1].rdt_sequence - seen[0].rdt_sequence + 1
            assert counters.lost == sum(sample.lost for sample in seen) == span - len(seen)


@given(st.integers(0, 2**32), st.sampled_from([1e-4, 1e-3, 1e-2]))
@settings(derandomize=True, deadline=None, max_examples=15)
def test_flipped_bits_do_not_upset_the_stream(seed: int, rate: float) -> None:
    bench = Bench(faults=(SensorFault("bit_errors", 500 * MS, 1_500 * MS, value=rate),), seed=seed)
    samples = bench.run(2.5)
    limit = CONFIG.wild_ratio * np.array([12.0, 12.0, 17.0])
    assert all(np.all(np.abs(sample.force_N) <= limit) for sample in samples)
    after = [sample for sample in samples if sample.arrival_ns > 1_600 * MS]
    assert len(after) > 850
    for sample in after:
        assert sample.force_N[:2] == pytest.approx([0.01, -0.02], abs=1e-6)


@given(st.lists(st.binary(max_size=80), max_size=40))
@settings(derandomize=True, deadline=None, max_examples=100)
def test_no_datagram_raises(datagrams: list[bytes]) -> None:
    client = NetFtClient(CONFIG)
    for k, datagram in enumerate(datagrams):
        client.outgoing(k * 100 * MS)
        client.feed(datagram, k * 100 * MS)
