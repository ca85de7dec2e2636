"""A Nano17 at a data acquisition card: loads it is given come out as six gauge voltages and a thermistor's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sim.sensor_faults import SensorFault, active, checked, strongest

# silent: no samples; broken: a gauge's wire is off and its amplifier at the rail (`value`: which); drift: the zero of all
# gauges moves by `value` V/s; gone: the card does not answer.
FAULT_KINDS = ("silent", "broken", "drift", "gone")
SUPPLY_V = 10.0


@dataclass(frozen=True)
class Nano17EmulatorConfig:
    """sensitivity (6, 6): V per (N, N, N, Nm, Nm, Nm), None: a typical one with cross-talk; zero_V, noise_V: of a gauge;
    the gain grows by gain_per_K and the zeros by zero_V_per_K above reference_C; thermistor: C = offset + slope V."""

    rate_hz: float = 1000.0
    sensitivity: np.ndarray | None = None
    zero_V: float = 0.3
    noise_V: float = 0.0008
    gain_per_K: float = -0.0003
    zero_V_per_K: float = 0.002
    reference_C: float = 22.0
    thermistor_offset_C: float = 22.0
    thermistor_C_per_V: float = 10.0


class Nano17Emulator:
    """The transducer, its amplifiers and the card. `sample` at each 1/rate_hz; `read` what has been sampled since."""

    def __init__(
        self, config: Nano17EmulatorConfig | None = None, seed: int = 0, faults: Sequence[SensorFault] = ()
    ) -> None:
        self.config = config or Nano17EmulatorConfig()
        self.faults = checked(faults, FAULT_KINDS)
        self._rng = np.random.default_rng(seed)
        typical = np.diag([0.5, 0.5, 0.35, 50.0, 50.0, 50.0])
        mixed = typical + 0.05 * np.abs(typical).max(axis=0) * self._rng.uniform(-1.0, 1.0, (6, 6))
        self.sensitivity = mixed if self.config.sensitivity is None else np.asarray(self.config.sensitivity, float)
        self.zeros_V = self.config.zero_V * self._rng.uniform(-1.0, 1.0, 6)
        self.temperature_C = self.config.reference_C
        self._rows: list[np.ndarray] = []
        self._now_ns = 0

    def sample(self, time_ns: int, force_N: np.ndarray, torque_Nm: np.ndarray) -> None:
        """The gauges at one instant, under this load (3,) N and (3,) Nm in the sensor's frame."""
        c, self._now_ns = self.config, time_ns
        if active(self.faults, time_ns, "silent"):
            return
        above_K = self.temperature_C - c.reference_C
        load = np.concatenate((force_N, torque_Nm))
        volts = self.sensitivity @ load / (1.0 + c.gain_per_K * above_K) + self.zeros_V + c.zero_V_per_K * above_K
        volts += c.noise_V * self._rng.standard_normal(6)
        for fault in active(self.faults, time_ns, "drift"):
            volts += fault.value * (time_ns - fault.start_ns) * 1e-9
        if active(self.faults, time_ns, "broken"):
            volts[int(strongest(self.faults, time_ns, "broken")) % 6] = SUPPLY_V
        thermistor_V = (self.temperature_C - c.thermistor_offset_C) / c.thermistor_C_per_V
        self._rows.append(np.append(np.clip(volts, -SUPPLY_V, SUPPLY_V), thermistor_V))

    def read(self) -> tuple[np.ndarray, float]:
        """All samples since the last call (n, 7) V, and the rate. Raises OSError while the card is gone."""
        if active(self.faults, self._now_ns, "gone"):
            raise OSError("card: does not answer")
        rows, self._rows = self._rows, []
        return np.array(rows).reshape(-1, 7), self.config.rate_hz

    def close(self) -> None:
        """Do nothing: the emulated card holds no resource."""
