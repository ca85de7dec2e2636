"""Gauge voltages to force: the emulator's loads come back, temperature and zero included; what is no reading gives none."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from realtime.core.device_sources import SourceThread
from realtime.drivers.device_events import DeviceEventKind
from realtime.drivers.nano17_daq import (
    Nano17Calibration,
    Nano17Client,
    Nano17Source,
    NidaqmxReader,
    parse_calibration_file,
)
from sim.nano17_emulator import Nano17Emulator, Nano17EmulatorConfig
from sim.sensor_faults import SensorFault

MS = 1_000_000
VECTORS = json.loads((Path(__file__).parent / "vectors" / "nano17_daq.json").read_text(encoding="utf-8"))


def pair(noise_V: float = 0.0, **faults: SensorFault) -> tuple[Nano17Client, Nano17Emulator]:
    emulator = Nano17Emulator(Nano17EmulatorConfig(noise_V=noise_V), seed=3, faults=list(faults.values()))
    c = emulator.config
    calibration = Nano17Calibration(
        np.linalg.inv(emulator.sensitivity),
        emulator.zeros_V,
        gain_per_K=c.gain_per_K,
        zero_V_per_K=(c.zero_V_per_K,) * 6,
        reference_C=c.reference_C,
        thermistor_offset_C=c.thermistor_offset_C,
        thermistor_C_per_V=c.thermistor_C_per_V,
    )
    return Nano17Client(calibration), emulator


def read(
    client: Nano17Client, emulator: Nano17Emulator, count: int, force: object = (0.1, -0.2, 0.3), start: int = 1
) -> list:
    for index in range(start, start + count):
        emulator.sample(index * MS, np.array(force, float), np.array([1e-3, -2e-3, 3e-3]))
    volts, rate = emulator.read()
    return client.feed(volts, rate, (start + count - 1) * MS)


def test_a_load_comes_back_at_its_time_cold_and_warm() -> None:
    client, emulator = pair()
    for temperature_C in (22.0, 37.0):
        emulator.temperature_C = temperature_C
        samples = read(client, emulator, 5)
        assert [sample.stamp_ns for sample in samples] == [MS * n for n in range(1, 6)]
        np.testing.assert_allclose(samples[-1].force_N, (0.1, -0.2, 0.3), atol=1e-9)
        np.testing.assert_allclose(samples[-1].torque_Nm, (1e-3, -2e-3, 3e-3), atol=1e-11)
        assert client.temperature_C == pytest.approx(temperature_C)


def test_bias_makes_the_present_load_the_zero() -> None:
    client, emulator = pair(noise_V=0.0008)
    client.bias(200)
    read(client, emulator, 200, (0.0, 0.0, 0.5))
    mean = np.mean([sample.force_N for sample in read(client, emulator, 200, (0.0, 0.0, 0.7), 201)], axis=0)
    np.testing.assert_allclose(mean, (0.0, 0.0, 0.2), atol=2e-3)


def test_a_wire_that_is_off_gives_no_sample_and_is_told_once() -> None:
    client, emulator = pair(wire=SensorFault("broken", 3 * MS, 6 * MS, value=2))
    assert len(read(client, emulator, 8)) == 5
    events = client.take_events()
    assert [event.kind for event in events] == [
        DeviceEventKind.WARNING,
        DeviceEventKind.RECONNECTED,
    ] and "gauge 2" in events[0].text
    assert client.rejected == 3


@pytest.mark.parametrize("row", [[np.nan] * 7, [np.inf, 0, 0, 0, 0, 0, 0], [9.8, -9.8, 9.8, -9.8, 9.8, -9.8, 0.0]])
def test_what_is_no_reading_gives_no_sample(row: list[float]) -> None:
    client = Nano17Client(Nano17Calibration(np.diag([100.0] * 3 + [1.0] * 3), np.zeros(6)))
    assert client.feed(np.array([row]), 1000.0, 0) == [] and client.rejected == 1


@pytest.mark.parametrize("matrix", [np.zeros((6, 6)), np.eye(5), np.full((6, 6), np.nan)])
def test_a_matrix_that_is_none_is_refused(matrix: np.ndarray) -> None:
    with pytest.raises(ValueError, match="calibration matrix"):
        Nano17Calibration(matrix, np.zeros(6))


def cal_file(units: str = "N", rows: int = 6, values: str = "1 0 0 0 0 0") -> bytes:
    axes = "".join(
        f'<UserAxis Name="{name}" values="{values}" scale="2" max="12"/>'
        for name in ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")[:rows]
    )
    units = f'ForceUnits="{units}" TorqueUnits="N-mm"'
    return f'<FTSensor Serial="FT1"><Calibration {units}>{axes}</Calibration></FTSensor>'.encode()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (b"not xml", "found no XML"),
        (b"<FTSensor/>", "found no Calibration"),
        (cal_file(units="stone"), "ForceUnits"),
        (cal_file(rows=5), "UserAxis Tz"),
        (cal_file(values="1 2 3"), "found 3 values"),
        (cal_file(values="1 2 3 4 5 nan"), "finite"),
        (b"<!DOCTYPE x>", "DOCTYPE"),
        (cal_file(), "calibration matrix"),
    ],
)
def test_a_bad_calibration_file_is_refused_in_words(text: bytes, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        parse_calibration_file(text)


def test_a_calibration_file_is_read_in_si() -> None:
    rows = [" ".join("3" if row == column else "0" for column in range(6)) for row in range(6)]
    axes = "".join(
        f'<UserAxis Name="{name}" values="{row}" scale="2" max="12"/>'
        for name, row in zip(("Fx", "Fy", "Fz", "Tx", "Ty", "Tz"), rows, strict=True)
    )
    text = f'<FTSensor Serial="FT1"><Calibration ForceUnits="lbf" TorqueUnits="N-mm">{axes}</Calibration></FTSensor>'
    calibration = parse_calibration_file(text.encode())
    np.testing.assert_allclose(np.diag(calibration.matrix), [1.5 * 4.4482216152605] * 3 + [1.5e-3] * 3)
    assert calibration.serial == "FT1" and calibration.range_Nm == (0.012,) * 3


def test_the_vectors_mean_what_they_say() -> None:
    parsed = parse_calibration_file(VECTORS["cal"].encode())
    keys = ("gain_per_K", "reference_C", "thermistor_offset_C", "thermistor_C_per_V")
    client = Nano17Client(
        dataclasses.replace(
            parsed,
            zero_V=np.array(VECTORS["zero_V"]),
            zero_V_per_K=tuple(VECTORS["zero_V_per_K"]),
            **{key: VECTORS[key] for key in keys},
        )
    )
    for number, row in enumerate(VECTORS["rows"], 1):
        samples = client.feed(np.array([row["V"]], float), 1000.0, number * MS)
        if row["force_N"] is None:
            assert samples == [], row["meaning"]
            continue
        assert client.temperature_C == pytest.approx(row["temperature_C"]), row["meaning"]
        np.testing.assert_allclose(samples[0].force_N, row["force_N"], atol=1e-12, err_msg=row["meaning"])
        np.testing.assert_allclose(samples[0].torque_Nm, row["torque_Nm"], atol=1e-12, err_msg=row["meaning"])


def test_without_the_extra_the_card_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "nidaqmx", None)
    with pytest.raises(OSError, match="pip install"):
        NidaqmxReader()


def test_the_thread_opens_a_card_that_was_gone_again() -> None:
    client, emulator = pair()
    opened: list[int] = []
    told: list = []
    samples: list = []

    def open_reader() -> Nano17Emulator:
        opened.append(1)
        if len(opened) == 1:
            raise OSError("card: not there")
        emulator.sample(MS, np.array([0.0, 0.0, 0.1]), np.zeros(3))
        return emulator

    thread = SourceThread("nano17", lambda: Nano17Source(open_reader(), client.calibration), samples.append, told.append)
    thread.start()
    for _ in range(1000):
        if samples:
            break
        thread.join(0.01)
    thread.stop()
    assert samples and len(opened) >= 2 and told[0].kind is DeviceEventKind.ERROR
