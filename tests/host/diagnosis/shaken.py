"""A mass on a spring and a damper that a random force shakes, by time steps in which dry friction can hold (Moreau 1988)."""

from __future__ import annotations

import numpy as np

from tests.host.proof.everyday import stream

Array = np.ndarray
Columns = dict[str, Array]
DT_S, SAMPLES, STEPS, BEGIN = 0.01, 1500, 40, 200  # steps of the simulation in one sample; samples before a recording


def tones(rng: np.random.Generator, t: Array, low_Hz: float, top_Hz: float) -> Array:
    """Seven tones (n,) of equal size and an RMS of 1."""
    f = np.geomspace(low_Hz, top_Hz, 7) * rng.uniform(0.93, 1.07, 7)
    return np.sin(2 * np.pi * np.outer(t, f) + rng.uniform(0.0, 6.28, 7)) @ np.full(7, np.sqrt(2 / 7))


def shaken(
    seed: int,
    *,
    damping: float = 15.0,
    stiffness: float = 900.0,
    cubic: float = 0.0,
    friction: float = 0.0,
    constant: float = 0.0,
    reads: str = "position",
    noise: float = 2e-4,
) -> list[Columns]:
    """Three recordings of a mass of 2 kg (SI units), cut from motion, the force straight between samples.

    constant: a force that acts in addition to the recorded one; noise: of the reading, position or velocity.
    """
    rng, out, h = stream(seed), [], DT_S / STEPS
    for _ in range(3):
        t = DT_S * np.arange(SAMPLES + BEGIN)
        f = 60.0 * tones(rng, t, 0.2, 5.0)
        fine = np.interp(np.arange(0.5 * h, t[-1], h), t, f) + constant
        x, v, slow, found = 0.0, 0.0, 0.5 * h * friction, np.zeros((2, fine.size))
        drag = 0.25 * h * damping
        for k, force in enumerate(fine):
            found[:, k] = x, v
            middle = x + 0.5 * h * v
            free = (v * (1.0 - drag) + 0.5 * h * (force - (stiffness + cubic * middle**2) * middle)) / (1.0 + drag)
            faster = np.sign(free) * max(abs(free) - slow, 0.0)
            x, v = x + 0.5 * h * (v + faster), faster
        at = found[0 if reads == "position" else 1, ::STEPS]
        keep = slice(BEGIN, at.size)
        read = at + noise * rng.standard_normal(at.size)
        out.append({"t": t[: at.size][keep] - t[BEGIN], "f": f[: at.size][keep], "x": read[keep]})
    return out
