"""Motions to learn from: sines, two tones, nested triangles, steps and sweeps of one input, within its place and speed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
SIZES = (1.0, 0.5, 0.2)
CYCLES = (2, 5, 12, 30)
SHAPES = ("sine", "two tones", "nested triangles", "steps", "sweep")
RISE_S = 1.0  # every motion begins and ends at rest


@dataclass(frozen=True)
class Span:
    """Where an input may go: about `centre` by `reach` either way, no faster than `speed` (units a second)."""

    unit: str
    centre: float
    reach: float
    speed: float


@dataclass(frozen=True)
class Excitation:
    """`values` (n,) of input `channel` at `time_s` (n,), others at rest; `held`: inputs that rest elsewhere than usual."""

    channel: str
    words: str
    time_s: Array
    values: Array
    held: tuple[tuple[str, float], ...] = ()


def family(name: str, span: Span, time_s: Array, timed: bool = True) -> Iterator[Excitation]:
    """Excitations of input `name` that keep within `span`; those it would be too fast for are left out."""
    length = float(time_s[-1] - time_s[0]) or 1.0
    edge = np.clip(np.minimum(time_s - time_s[0], time_s[-1] - time_s) / min(RISE_S, 0.1 * length), 0.0, 1.0)
    edge = edge * edge * (3.0 - 2.0 * edge)
    dt = float(np.median(np.diff(time_s)))
    for shape in SHAPES:
        for size in SIZES:
            for cycles in CYCLES:
                unit = _unit(shape, (time_s - time_s[0]) / length, cycles)
                if shape == "steps":
                    unit = _ramped(unit, span.speed / max(size * span.reach, 1e-300) * dt)
                values = span.centre + size * span.reach * edge * unit
                fastest = float(np.max(np.abs(np.diff(values)))) / dt
                if cycles > 0.1 * time_s.size or (timed and fastest > 1.001 * span.speed):
                    continue
                yield Excitation(name, _words(shape, size * span.reach, span.unit, cycles, length, timed), time_s, values)


def _unit(shape: str, share: Array, cycles: int) -> Array:
    """The shape with amplitude 1 over `share` (n,) 0 to 1."""
    turn = 2.0 * np.pi * cycles * share
    if shape == "sine":
        return np.sin(turn)
    if shape == "two tones":
        return 0.6 * np.sin(turn) + 0.4 * np.sin(turn * np.sqrt(23.0))
    if shape == "nested triangles":
        size = np.array([1.0, 0.55, 0.3])[np.minimum((share * 3).astype(int), 2)]
        return np.asarray(size * 2.0 / np.pi * np.arcsin(np.sin(turn)))
    if shape == "steps":
        levels = np.random.default_rng(cycles).permutation(np.linspace(-1.0, 1.0, 2 * cycles + 1))
        return levels[np.minimum((share * levels.size).astype(int), levels.size - 1)]
    return np.sin(2.0 * np.pi * (share + 0.5 * (2 * cycles - 1) * share**2))


def _ramped(values: Array, step: float) -> Array:
    """`values` (n,) followed with at most `step` a sample."""
    out, at = np.empty_like(values), float(values[0])
    for i, wanted in enumerate(values):
        at += min(max(wanted - at, -step), step)
        out[i] = at
    return out


def _words(shape: str, size: float, unit: str, cycles: int, length: float, timed: bool) -> str:
    if not timed:
        return f"{shape} of {size:.3g} {unit}, {cycles} over the recording"
    rate = cycles / length
    described = {
        "sine": f"{rate:.3g} Hz",
        "two tones": f"{rate:.3g} and {rate * np.sqrt(23.0):.3g} Hz",
        "nested triangles": f"{rate:.3g} Hz, then 0.55 and 0.3 of it",
        "steps": f"{2 * cycles + 1} levels, each held {length / (2 * cycles + 1):.2g} s",
        "sweep": f"{1 / length:.2g} to {2 * rate:.3g} Hz",
    }[shape]
    return f"{shape} of {size:.3g} {unit}, {described}, {length:.3g} s"
