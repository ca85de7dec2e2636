"""Benchmark of a diagnosis: backlash in a cable, found and fitted; the peer is given the effect and only fits it."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from host.diagnosis import diagnose as diagnose_recordings
from host.studies.benchmarks.runner import Report, Row, alternate, row_of

Array = NDArray[np.float64]

CASES = 3
RECORDINGS, SECONDS_s, RATE_hz = 3, 30.0, 50.0
GAIN, NOISE_rad = 0.8, 0.002
WIDTHS_rad = (0.04, 0.08, 0.12)
NOMINAL: dict[str, Any] = {
    "name": "cable with backlash",
    "kind": "transmission",
    "data": {"time": "t"},
    "channels": {"motor": {"column": "motor", "unit": "rad"}, "tip": {"column": "tip", "unit": "rad"}},
    "link": [{"subsystem": "cable", "input": "motor", "output": "tip"}],
}


def play(motor_rad: Array, width_rad: float) -> Array:
    """Return the play operator's output (n,): it follows the input at half the width, and rests between."""
    low, high = motor_rad - 0.5 * width_rad, motor_rad + 0.5 * width_rad
    out = np.empty_like(motor_rad)
    at = motor_rad[0]
    for i in range(len(motor_rad)):
        at = min(max(at, low[i]), high[i])
        out[i] = at
    return out


def recordings_of(seed: int, width_rad: float) -> list[dict[str, Array]]:
    """Return recordings of slow sines through a cable with backlash `width_rad`, tip angles with white noise."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, SECONDS_s, 1.0 / RATE_hz)
    made = []
    for _ in range(RECORDINGS):
        phases = rng.uniform(0.0, 2.0 * np.pi, 3)
        motor = sum(0.3 * np.sin(2.0 * np.pi * f * t + p) for f, p in zip((0.11, 0.23, 0.41), phases, strict=True))
        tip = GAIN * play(motor, width_rad) + rng.normal(0.0, NOISE_rad, len(t))
        made.append({"t": t, "motor": motor, "tip": tip})
    return made


def fitted_width_rad(recordings: list[dict[str, Array]]) -> float:
    """Return the width that least squares finds over gain, offset and width, from the best of a grid."""

    def residuals(values: Array) -> Array:
        return np.concatenate([values[0] * play(r["motor"], values[2]) + values[1] - r["tip"] for r in recordings])

    start = min(np.linspace(0.0, 0.3, 16), key=lambda width: float(np.sum(residuals(np.array([1.0, 0.0, width])) ** 2)))
    return float(least_squares(residuals, [1.0, 0.0, start], diff_step=1e-4).x[2])


def width_in(verdict: dict[str, Any]) -> float:
    """Return the width of the backlash that a verdict names, NaN where it names none."""
    for effect in verdict["effects"]:
        if effect["id"] == "backlash":
            return float(next(p["value"] for name, p in effect["parameters"].items() if name.startswith("width")))
    return float("nan")


def diagnose(seed: int, report: Report) -> list[Row]:
    """Time `seldinger diagnose` on arrays: location, selection, fit, held-out gain; compared with a fit by scipy."""
    found: dict[int, float] = {}
    by_peer: dict[int, float] = {}
    cases = [recordings_of(seed + number, WIDTHS_rad[number % len(WIDTHS_rad)]) for number in range(CASES)]

    def ours(number: int, repeats: int) -> None:
        for _ in range(repeats):
            found[number] = width_in(diagnose_recordings(cases[number], NOMINAL).as_dict())

    def peer(number: int) -> None:
        by_peer[number] = fitted_width_rad(cases[number])

    report("diagnose: the first call compiles or loads its kernels")
    ours(0, 1)
    report(f"diagnose: {CASES} cases, each in turn with its peer")
    timed = alternate(
        [partial(ours, number) for number in range(CASES)],
        [partial(peer, number) for number in range(CASES)],
    )
    truth = [WIDTHS_rad[number % len(WIDTHS_rad)] for number in range(CASES)]
    errors = np.array([abs(found[number] - truth[number]) for number in range(CASES)])
    peer_errors = np.array([abs(by_peer[number] - truth[number]) for number in range(CASES)])
    return [
        row_of(
            "diagnose",
            f"backlash, {RECORDINGS} recordings of {SECONDS_s:.0f} s",
            "scipy least_squares with the effect given",
            timed,
            seed,
            right=int(np.isfinite(errors).sum()),
            peer_right=CASES,
            width_error_rad=float(np.nanmax(errors)) if np.isfinite(errors).any() else None,
            peer_width_error_rad=float(peer_errors.max()),
        )
    ]
