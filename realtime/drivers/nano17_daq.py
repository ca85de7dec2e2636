"""ATI Nano17 through a data acquisition card: six gauge voltages to force and torque. Needs the extra `nidaqmx`."""

from __future__ import annotations

import math
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from protocol.errors import Description, InputError, reason
from protocol.rig_file import ForceSensorSection
from realtime.drivers.device_events import DeviceEvent, DeviceEventKind
from realtime.drivers.net_ft import ForceSample
from realtime.drivers.net_ft_calibration import NEWTON_METRES_PER, NEWTONS_PER

GAUGES = 6
MAX_FILE_BYTES = 65536
# A gauge amplifier gives +-10 V. A reading this near to the rail is invalid.
RAIL_V = 9.9
BLOCK_S, SILENT_S = 0.002, 0.1


class GaugeReader(Protocol):
    """Voltages of the six gauges, and of the thermistor where one is wired."""

    def read(self) -> tuple[np.ndarray, float]:
        """Return the samples since the last call (n, 7: six gauges and the thermistor, V), rate (Hz). Raises OSError."""

    def close(self) -> None:
        """Release the data acquisition card."""


@dataclass(frozen=True)
class Nano17Calibration:
    """matrix (6, 6): N, Nm per V of (gauge voltage less zero); zero_V (6,); range_N, range_Nm: rated, of one axis.

    gain_per_K: of the whole matrix with temperature, relative to reference_C; zero_V_per_K (6,): of the zero.
    thermistor: temperature (C) = offset + slope * V. Raises ValueError for a matrix that is not finite or is singular.
    """

    matrix: np.ndarray
    zero_V: np.ndarray
    range_N: tuple[float, float, float] = (12.0, 12.0, 17.0)
    range_Nm: tuple[float, float, float] = (0.12, 0.12, 0.12)
    gain_per_K: float = 0.0
    zero_V_per_K: tuple[float, ...] = (0.0,) * GAUGES
    reference_C: float = 22.0
    thermistor_offset_C: float = 22.0
    thermistor_C_per_V: float = 0.0
    serial: str = ""

    def __post_init__(self) -> None:
        matrix, zero_V = np.asarray(self.matrix, float), np.asarray(self.zero_V, float)
        if matrix.shape != (GAUGES, GAUGES) or not np.all(np.isfinite(matrix)) or np.linalg.cond(matrix) > 1e8:
            raise ValueError(f"calibration matrix: found shape {matrix.shape}, singular or not finite, wanted regular 6 x 6")
        if zero_V.shape != (GAUGES,) or not np.all(np.isfinite(zero_V)):
            raise ValueError(f"zero_V: found shape {zero_V.shape}, wanted 6 finite voltages")

    def temperature_C(self, thermistor_V: float) -> float:
        """Return the transducer's temperature in degrees Celsius from the thermistor's voltage (V)."""
        return self.thermistor_offset_C + self.thermistor_C_per_V * thermistor_V

    def wrench(self, gauges_V: np.ndarray, thermistor_V: float = 0.0) -> np.ndarray:
        """Return (Fx, Fy, Fz, Tx, Ty, Tz) in N and Nm, sensor frame, of six voltages at the thermistor's temperature."""
        above_K = self.temperature_C(thermistor_V) - self.reference_C
        signal_V = np.asarray(gauges_V) - self.zero_V - above_K * np.asarray(self.zero_V_per_K)
        return np.asarray(self.matrix @ signal_V * (1.0 + self.gain_per_K * above_K))


def parse_calibration_file(text: bytes) -> Nano17Calibration:
    """A transducer's `.cal` file (XML: `Calibration` with one `UserAxis` a row of the matrix), converted to SI.

    Raises ValueError with what is missing.
    """
    if len(text) > MAX_FILE_BYTES or b"<!" in text:
        raise ValueError(f"calibration file: found {len(text)} bytes or a DOCTYPE, wanted XML up to {MAX_FILE_BYTES} bytes")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as bad:
        raise ValueError(f"calibration file: found no XML ({bad}), wanted a transducer's .cal file") from None
    block = root if root.tag == "Calibration" else root.find("Calibration")
    if block is None:
        raise ValueError("calibration file: found no Calibration element, wanted one")
    force = _unit(block.get("ForceUnits"), NEWTONS_PER, "ForceUnits")
    torque = _unit(block.get("TorqueUnits"), NEWTON_METRES_PER, "TorqueUnits")
    rows, ranges = [], []
    for index, name in enumerate(("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")):
        axis = next((item for item in block.iter("UserAxis") if item.get("Name") == name), None)
        if axis is None:
            raise ValueError(f"UserAxis {name}: found nothing, wanted a row of the matrix")
        unit = force if index < 3 else torque
        values = [_number(part, name) for part in (axis.get("values") or "").split()]
        if len(values) != GAUGES:
            raise ValueError(f"UserAxis {name}: found {len(values)} values, wanted {GAUGES}")
        rows.append([unit * value / _number(axis.get("scale") or "1", f"{name} scale") for value in values])
        ranges.append(unit * _number(axis.get("max") or "nan", f"{name} max"))
    return Nano17Calibration(
        np.array(rows),
        np.zeros(GAUGES),
        (ranges[0], ranges[1], ranges[2]),
        (ranges[3], ranges[4], ranges[5]),
        serial=root.get("Serial", ""),
    )


def _unit(name: str | None, known: dict[str, float], key: str) -> float:
    if name not in known:
        raise ValueError(f"{key}: found {name!r}, wanted one of {', '.join(known)}")
    return known[name]


def _number(text: str, key: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{key}: found {text!r}, wanted a finite number")
    return value


class Nano17Client:
    """Converts blocks of voltages into force samples, without I/O.

    A gauge at its rail, a broken wire, or a reading far out of range gives no sample and is reported once. `bias` makes
    the mean of the next samples the new zero.
    """

    def __init__(self, calibration: Nano17Calibration, wild_ratio: float = 10.0) -> None:
        self.calibration = calibration
        self._limit = wild_ratio * np.array(calibration.range_N + calibration.range_Nm)
        self._bias = np.zeros(GAUGES)
        self._bias_sum, self._bias_left, self._bias_of = np.zeros(GAUGES), 0, 1
        self._events: list[DeviceEvent] = []
        self._bad = ""
        self.samples = self.rejected = 0
        self.temperature_C = math.nan

    def bias(self, samples: int = 200) -> None:
        """Make the present load the new zero, as the mean of the next `samples`; only without contact."""
        self._bias_sum[:], self._bias_left, self._bias_of = 0.0, samples, samples

    def take_events(self) -> list[DeviceEvent]:
        """Return the events since the last call."""
        events, self._events = self._events, []
        return events

    def feed(self, volts: np.ndarray, rate_hz: float, now_ns: int) -> list[ForceSample]:
        """Return the samples in a block (n, 7) V whose last row was measured now, at `rate_hz`."""
        out = []
        for index, row in enumerate(volts):
            stamp_ns = now_ns - round((len(volts) - 1 - index) * 1e9 / rate_hz)
            wrench = self._checked(row, now_ns)
            if wrench is None:
                self.rejected += 1
                continue
            self.samples += 1
            out.append(ForceSample(stamp_ns, now_ns, wrench[:3], wrench[3:], self.samples & 0xFFFFFFFF, 0, 0))
        return out

    def _checked(self, row: np.ndarray, now_ns: int) -> np.ndarray | None:
        if row.shape != (GAUGES + 1,) or not np.all(np.isfinite(row)):
            self._refuse(f"found {row.shape[0]} voltages or one that is not finite, wanted 7", now_ns)
            return None
        rails = [str(gauge) for gauge in range(GAUGES) if abs(row[gauge]) >= RAIL_V]
        if rails:
            self._refuse(f"gauge {', '.join(rails)} at its rail: overload, or a broken wire", now_ns)
            return None
        self.temperature_C = self.calibration.temperature_C(float(row[GAUGES]))
        wrench = self.calibration.wrench(row[:GAUGES], float(row[GAUGES]))
        if np.any(np.abs(wrench) > self._limit):
            self._refuse("a reading beyond ten times the range", now_ns)
            return None
        if self._bad:
            self._events.append(DeviceEvent(now_ns, "nano17", DeviceEventKind.RECONNECTED, "readings are good again"))
            self._bad = ""
        if self._bias_left:
            self._bias_sum += wrench
            self._bias_left -= 1
            if not self._bias_left:
                self._bias = self._bias_sum / self._bias_of
        return wrench - self._bias

    def _refuse(self, why: str, now_ns: int) -> None:
        if why != self._bad:
            self._bad = why
            self._events.append(DeviceEvent(now_ns, "nano17", DeviceEventKind.WARNING, why))


class NidaqmxReader:
    """The card itself: channels `device`/ai0 to ai5 differential, the thermistor on ai6, sampled by the card's clock.

    Raises OSError where the extra `nidaqmx` is not installed, or the card is not there.
    """

    def __init__(self, device: str = "Dev1", rate_hz: float = 1000.0) -> None:
        try:
            import nidaqmx
            from nidaqmx.constants import AcquisitionType
        except ImportError as error:
            raise OSError("nano17: found no nidaqmx, wanted it: pip install 'seldinger[daq]' and NI's driver") from error
        self.rate_hz = rate_hz
        try:
            self._task: Any = nidaqmx.Task()
            self._task.ai_channels.add_ai_voltage_chan(f"{device}/ai0:6", min_val=-10.0, max_val=10.0)
            self._task.timing.cfg_samp_clk_timing(
                rate_hz, sample_mode=AcquisitionType.CONTINUOUS, samps_per_chan=int(rate_hz)
            )
            self._task.start()
        except Exception as error:  # the driver has its own tree of exceptions
            raise OSError(f"nano17: {device} does not start ({error})") from error

    def read(self) -> tuple[np.ndarray, float]:
        """Return all samples since the last call (n, 7) V, and the rate (Hz)."""
        try:
            block = np.array(self._task.read(number_of_samples_per_channel=-1), float).T
        except Exception as error:  # as above
            raise OSError(f"nano17: the card does not answer ({error})") from error
        return block.reshape(-1, GAUGES + 1), self.rate_hz

    def close(self) -> None:
        """Release the data acquisition card."""
        self._task.close()


class Nano17Source:
    """The card as a source of the loop: a block of samples every 2 ms.

    `read` raises OSError when the card is gone or gives nothing for 0.1 s.
    """

    def __init__(
        self, reader: GaugeReader, calibration: Nano17Calibration, now_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self.client = Nano17Client(calibration)
        self._reader, self._now_ns = reader, now_ns
        self._received_ns = now_ns()

    def read(self) -> list[ForceSample]:
        """Return the samples of the last 2 ms. Raises OSError."""
        time.sleep(BLOCK_S)
        volts, rate_hz = self._reader.read()
        now_ns = self._now_ns()
        if len(volts):
            self._received_ns = now_ns
        elif now_ns - self._received_ns > SILENT_S * 1e9:
            raise OSError(f"nano17: no sample for {SILENT_S} s")
        return self.client.feed(volts, rate_hz, now_ns)

    def take_events(self) -> list[DeviceEvent]:
        """Return the findings of the checks since the last call."""
        return self.client.take_events()

    def close(self) -> None:
        """Release the data acquisition card."""
        self._reader.close()


def open_force_sensor(sensor: ForceSensorSection) -> Nano17Source:
    """Open the card that `force_sensor.address` names, with the transducer's file `options.calibration`.

    Raises:
        OSError: the extra `daq` is not installed, or the card is not there. InputError: no good calibration file.
    """
    path = sensor.options.get("calibration")
    key = "force_sensor.options.calibration"
    if unknown := [name for name in sensor.options if name != "calibration"]:
        raise InputError(f"force_sensor.options.{unknown[0]}", sensor.options[unknown[0]], "calibration alone")
    if not isinstance(path, str):
        raise InputError(key, path, "the path of the transducer's .cal file")
    try:
        calibration = parse_calibration_file(Path(path).read_bytes())
    except (OSError, ValueError) as error:
        raise InputError(key, Description(f"{path}: {reason(error)}"), "a readable .cal file") from None
    return Nano17Source(NidaqmxReader(sensor.address, sensor.rate_hz), calibration)
