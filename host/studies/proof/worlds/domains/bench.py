"""The laboratory's bench: time stamps, excitation, noise, and integration of a device sample by sample."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.signal import cont2discrete, lfilter, lfilter_zi

from host.studies.proof.worlds import signals

Array = np.ndarray
State = tuple[float, ...]
Rate = Callable[[float, State, State], State]  # time (s), state, inputs -> rate of the state
Control = Callable[[int, State], State]  # row, state -> inputs held until the next row
RPM = 2.0 * np.pi / 60.0  # rad/s
DEG = np.pi / 180.0  # rad


def between(rng: np.random.Generator, low: float, high: float) -> float:
    """Return a positive number, uniform on a logarithmic scale."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def even(rate_hz: float, duration_s: float) -> Array:
    """Return sample times (n,) s of an even grid from 0."""
    return np.arange(round(rate_hz * duration_s)) / rate_hz


def motion(
    rng: np.random.Generator,
    time_s: Array,
    fastest_hz: float,
    kind: str = "",
    begins_at_rest: bool = False,
    slowest_hz: float = 0.0,
) -> Array:
    """Return a smooth command (n,) within about -1..1 without energy above fastest_hz (Hz).

    Args:
        rng: stream of chance.
        time_s: sample times (n,) s.
        fastest_hz: highest frequency, Hz.
        kind: of `signals.KINDS`; empty: drawn.
        begins_at_rest: whether it grows from zero in the first tenth of the recording.
        slowest_hz: lowest frequency, Hz; 0: one and a half periods in the recording.
    """
    kind = kind or str(rng.choice(signals.KINDS[:2]))
    slowest = slowest_hz or min(1.5 / float(time_s[-1]), 0.3 * fastest_hz)
    lead = rng.uniform(0.0, 2.0) / slowest
    values = signals.command(rng, kind, slowest, fastest_hz, (0.0, float(time_s[-1]) + lead))(time_s + lead)
    if begins_at_rest:
        values = values * np.clip(time_s / (0.1 * time_s[-1]) - 0.3, 0.0, 1.0)
    return np.asarray(values)


def levels(rng: np.random.Generator, time_s: Array, dwell_s: tuple[float, float]) -> Array:
    """Return random levels (n,) within -1..1, each held for a time within dwell_s (s)."""
    edges, values = [0.0], [rng.uniform(-1.0, 1.0)]
    while edges[-1] <= time_s[-1]:
        edges.append(edges[-1] + rng.uniform(*dwell_s))
        values.append(rng.uniform(-1.0, 1.0))
    return np.asarray(values)[np.searchsorted(edges, time_s, side="right") - 1]


def white(rng: np.random.Generator, n: int, sigma: float) -> Array:
    """Return white noise (n,)."""
    return sigma * rng.standard_normal(n)


def slow(rng: np.random.Generator, n: int, sigma: float, samples: float) -> Array:
    """Return first-order noise (n,) of standard deviation sigma that is correlated over `samples` samples."""
    a = float(np.exp(-1.0 / samples))
    lead = int(10 * samples)
    return np.asarray(sigma * lfilter([np.sqrt(1.0 - a * a)], [1.0, -a], rng.standard_normal(n + lead))[lead:])


def flicker(rng: np.random.Generator, n: int, sigma: float) -> Array:
    """Return noise (n,) of standard deviation sigma whose power falls with the frequency."""
    spectrum = np.fft.rfft(rng.standard_normal(4 * n))
    spectrum[1:] /= np.sqrt(np.arange(1, spectrum.size))
    spectrum[0] = 0.0
    values = np.fft.irfft(spectrum, 4 * n)
    return np.asarray(sigma * values[:n] / np.std(values))


def vibration(rng: np.random.Generator, n: int, rate_hz: float, sigma: float, frequency_hz: float, quality: float) -> Array:
    """Return noise (n,) of standard deviation sigma that is a mode of frequency_hz (Hz) and `quality`, shaken at random."""
    w, lead = 2.0 * np.pi * frequency_hz, int(20.0 * quality * rate_hz / frequency_hz)
    b, a, _ = cont2discrete(([w * w], [1.0, w / quality, w * w]), 1.0 / rate_hz, "zoh")
    values = lfilter(b.ravel(), a, rng.standard_normal(n + lead))
    return np.asarray(sigma * values[lead:] / np.std(values[lead:]))


def exact(numerator: Sequence[float], denominator: Sequence[float], u: Array, period_s: float, hold: str) -> Array:
    """Return the response (n,) of a transfer function to u (n,), in equilibrium with u[0] before.

    Args:
        numerator: falling powers of s.
        denominator: falling powers of s.
        u: input.
        period_s: between samples, s.
        hold: `zoh` for an input that is constant between samples, `foh` for a straight one.
    """
    b, a, _ = cont2discrete((list(numerator), list(denominator)), period_s, hold)
    return np.asarray(lfilter(b.ravel(), a, u, zi=lfilter_zi(b.ravel(), a) * u[0])[0])


def march(rate: Rate, start: State, time_s: Array, inputs: Sequence[Array], steps: int = 4, held: bool = True) -> Array:
    """Integrate a device by Runge-Kutta steps under recorded inputs.

    Args:
        rate: time derivative of the state.
        start: state at the first sample.
        time_s: sample times (n,) s.
        inputs: (n,) each.
        steps: per sample.
        held: the inputs are constant between samples, else straight.

    Returns:
        The states (n, m) at the samples.
    """
    rows = [tuple(map(float, row)) for row in zip(*inputs, strict=True)]
    state, found = start, [start]
    stamps = time_s.tolist()
    for i in range(len(stamps) - 1):
        u0, u1 = rows[i], rows[i] if held else rows[i + 1]
        state = _interval(rate, state, stamps[i], stamps[i + 1], u0, u1, steps)
        found.append(state)
    return np.array(found)


def under_control(rate: Rate, start: State, time_s: Array, control: Control, steps: int = 4) -> tuple[Array, Array]:
    """Integrate a device whose inputs are computed at each sample and held until the next.

    Returns the states (n, m) and the inputs (n, k). Args as for `march`; control gets the row and the state there.
    """
    state, found, used = start, [start], [control(0, start)]
    stamps = time_s.tolist()
    for i in range(len(stamps) - 1):
        state = _interval(rate, state, stamps[i], stamps[i + 1], used[-1], used[-1], steps)
        found.append(state)
        used.append(control(i + 1, state))
    return np.array(found), np.array(used)


def _interval(rate: Rate, s: State, begin: float, end: float, u0: State, u1: State, steps: int) -> State:
    """Return the state at `end` after `steps` classical Runge-Kutta steps."""
    h = (end - begin) / steps
    for k in range(steps):
        t = begin + k * h
        ua, ub, uc = (_mixed(u0, u1, (k + share) / steps) for share in (0.0, 0.5, 1.0))
        d1 = rate(t, s, ua)
        d2 = rate(t + 0.5 * h, tuple([x + 0.5 * h * d for x, d in zip(s, d1, strict=True)]), ub)
        d3 = rate(t + 0.5 * h, tuple([x + 0.5 * h * d for x, d in zip(s, d2, strict=True)]), ub)
        d4 = rate(t + h, tuple([x + h * d for x, d in zip(s, d3, strict=True)]), uc)
        s = tuple([x + h / 6.0 * (a + 2.0 * b + 2.0 * c + d) for x, a, b, c, d in zip(s, d1, d2, d3, d4, strict=True)])
    return s


def _mixed(u0: State, u1: State, share: float) -> State:
    return u0 if u0 is u1 else tuple([a + share * (b - a) for a, b in zip(u0, u1, strict=True)])


def gap(x: Array, width: float) -> Array:
    """Return what follows x (n,) once a gap of `width` is taken up, starting in its middle."""
    out, y = [], float(x[0])
    for value in x.tolist():
        y = min(max(y, value - 0.5 * width), value + 0.5 * width)
        out.append(y)
    return np.array(out)


class Regulator:
    """A proportional-integral controller that acts on a noisy reading."""

    def __init__(self, wanted: Array, noise: Array, period_s: float, gains: tuple[float, float], late: int = 0) -> None:
        """Prepare a loop.

        Args:
            wanted: set-point (n,).
            noise: of the reading (n,).
            period_s: between samples, s.
            gains: proportional; integral, 1/s.
            late: rows by which the reading that is used is older.
        """
        self.wanted, self.noise, self.period_s, self.late = wanted.tolist(), noise.tolist(), period_s, late
        self.proportional, self.integral = gains
        self.total = 0.0
        self.readings: list[float] = []

    def command(self, row: int, value: float, forward: float = 0.0) -> float:
        """Return the input from row `row` on, for a device whose measured quantity is `value`."""
        self.readings.append(value + self.noise[row])
        error = self.wanted[row] - self.readings[max(row - self.late, 0)]
        self.total += error * self.period_s
        return forward + self.proportional * error + self.integral * self.total
