"""Spectrum of a signal: leaky Fourier sums on a geometric grid of frequencies, to find a heart or breath rate."""

from __future__ import annotations

import math

from numba import njit

from realtime.control.records import BANK_POINTS, Bank

# The grid is wide enough for 40-180 heart beats and 6-36 breaths a minute.
POINTS = BANK_POINTS
# Samples come in at about this rate; faster streams are averaged first.
STEP_S = 0.020


@njit(cache=True)
def start(bank: Bank, low_Hz: float, high_Hz: float, memory_s: float, level: float) -> None:
    """Start empty, between `low_Hz` and `high_Hz`, with a window of about two `memory_s`.

    level: first guess of the mean (unit of the signal).
    """
    bank.low_Hz, bank.high_Hz, bank.memory_s, bank.since_s, bank.level = low_Hz, high_Hz, memory_s, 0.0, level
    for k in range(POINTS):
        bank.phase_rad[k] = 0.0
        for part in range(2):
            bank.first[k, part] = 0.0
            bank.second[k, part] = 0.0


@njit(cache=True)
def frequency_Hz(bank: Bank, place: float) -> float:
    """Return the frequency (Hz) at a place on the grid, 0 to POINTS - 1, fractions allowed."""
    ratio: float = (bank.high_Hz / bank.low_Hz) ** (place / (POINTS - 1))
    return bank.low_Hz * ratio


@njit(cache=True)
def amplitude(bank: Bank, point: int) -> float:
    """Return the amplitude (unit of the signal) near grid point number `point`."""
    return 2.0 * math.hypot(bank.second[point, 0], bank.second[point, 1])


@njit(cache=True)
def apply(bank: Bank, value: float, dt_s: float) -> None:
    """Take in the signal's mean `value` over the last `dt_s` seconds.

    Two leaky sums in cascade (window t exp(-t/memory)): side lobes fall with the square of the distance, so that breath
    and mean do not show up as heart.
    """
    bank.since_s += dt_s
    leak = min(dt_s / bank.memory_s, 1.0)
    bank.level += leak * (value - bank.level)
    moving = value - bank.level
    ratio = (bank.high_Hz / bank.low_Hz) ** (1.0 / (POINTS - 1))
    turn = 2.0 * math.pi * bank.low_Hz * dt_s
    for k in range(POINTS):
        phase = bank.phase_rad[k] + turn
        phase -= 2.0 * math.pi * math.floor(phase / (2.0 * math.pi))
        bank.phase_rad[k] = phase
        bank.first[k, 0] += leak * (moving * math.cos(phase) - bank.first[k, 0])
        bank.first[k, 1] += leak * (-moving * math.sin(phase) - bank.first[k, 1])
        for part in range(2):
            bank.second[k, part] += leak * (bank.first[k, part] - bank.second[k, part])
        turn *= ratio


@njit(cache=True)
def _strength(bank: Bank, point: int, by_speed: bool) -> float:
    """Return the amplitude near a grid point, or the amplitude of its speed (over 2 pi)."""
    size = amplitude(bank, point)
    return size * frequency_Hz(bank, point) if by_speed else size


@njit(cache=True)
def peak(bank: Bank, by_speed: bool) -> tuple[float, float]:
    """Return frequency (Hz) and amplitude of the strongest motion inside the grid; (0, 0) if it is at the edge.

    by_speed: the strongest is the one with the greatest speed. After two breaths a drift of the mean has a larger amplitude
    at the grid's low end than the breath: its spectrum falls with the frequency, that of its speed does not.

    If the amplitude at half the frequency is more than a third of it, half the frequency is returned, because the
    strongest motion may be a second harmonic. This is tested only after several periods of half the frequency, when
    the leakage of the strongest motion has decayed.
    """
    best = 0
    for k in range(1, POINTS - 1):
        if _is_top(bank, k, by_speed) and (best == 0 or _strength(bank, k, by_speed) > _strength(bank, best, by_speed)):
            best = k
    if best == 0:
        return 0.0, 0.0
    octave = (POINTS - 1) * math.log(2.0) / math.log(bank.high_Hz / bank.low_Hz)
    half = best - round(octave)
    long_enough = bank.since_s * frequency_Hz(bank, half) > 4.0
    if 1 <= half and long_enough and _is_top(bank, half, by_speed) and amplitude(bank, half) > 0.33 * amplitude(bank, best):
        best = half
    left, middle = _strength(bank, best - 1, by_speed), _strength(bank, best, by_speed)
    right = _strength(bank, best + 1, by_speed)
    bend = left - 2.0 * middle + right
    shift = 0.5 * (left - right) / bend if bend < 0.0 else 0.0
    return frequency_Hz(bank, best + min(max(shift, -0.5), 0.5)), amplitude(bank, best)


@njit(cache=True)
def pair(bank: Bank, rate_Hz: float) -> tuple[float, float]:
    """Return the pair (p, q) of the motion at `rate_Hz` now, from the nearest grid point; p is its share of the value."""
    place = (POINTS - 1) * math.log(rate_Hz / bank.low_Hz) / math.log(bank.high_Hz / bank.low_Hz)
    k = min(max(round(place), 0), POINTS - 1)
    c, s = math.cos(bank.phase_rad[k]), math.sin(bank.phase_rad[k])
    re, im = 2.0 * bank.second[k, 0], 2.0 * bank.second[k, 1]
    lag = 2.0 * math.atan(2.0 * math.pi * (rate_Hz - frequency_Hz(bank, k)) * bank.memory_s)
    re, im = re * math.cos(lag) - im * math.sin(lag), re * math.sin(lag) + im * math.cos(lag)
    return re * c - im * s, re * s + im * c


@njit(cache=True)
def _is_top(bank: Bank, point: int, by_speed: bool) -> bool:
    here = _strength(bank, point, by_speed)
    return here >= _strength(bank, point - 1, by_speed) and here >= _strength(bank, point + 1, by_speed)
