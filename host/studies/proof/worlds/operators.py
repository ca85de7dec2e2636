"""What a signal becomes on a fine time grid: hysteresis, delay, creep and modes by formulas that the finder does not use.

Play engages gradually, presliding is a Prandtl-Ishlinskii operator, creep a chain of Kelvin elements in logarithmic
spacing, saturation an algebraic sigmoid. Every operator takes x (n,) on an even grid, of step h (s), and returns (n,).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from scipy.signal import lfilter

Array = np.ndarray
ENGAGING = 6.0  # power of the taken-up share of a gap with which its flanks pass motion on


@njit(cache=True)
def play(x: Array, width: float) -> Array:
    """Follower behind a gap of `width` whose flanks give way: it takes ever more of the motion as the gap is taken up."""
    out = np.empty_like(x)
    y, before, half = x[0], x[0], 0.5 * width
    for i in range(x.size):
        step, before = x[i] - before, x[i]
        taken_up = (before - step - y) * math.copysign(1.0, step) / half if half > 0.0 else 1.0
        y += step * min(max(taken_up, 0.0), 1.0) ** ENGAGING
        y = min(max(y, x[i] - half), x[i] + half)
        out[i] = y
    return out


@njit(cache=True)
def plays(x: Array, widths: Array, weights: Array) -> Array:
    """Weighted sum of ideal plays: a Prandtl-Ishlinskii operator."""
    out = np.zeros_like(x)
    y = np.full(widths.size, x[0])
    for i in range(x.size):
        for k in range(widths.size):
            y[k] = min(max(y[k], x[i] - 0.5 * widths[k]), x[i] + 0.5 * widths[k])
            out[i] += weights[k] * y[k]
    return out


def prandtl_ishlinskii(x: Array, share: float, distance: float) -> Array:
    """Motion x with `share` of it lost to friction that builds up over about `distance`; 0 <= share < 1."""
    widths = distance * np.geomspace(0.15, 3.0, 8)
    weights = np.exp(-widths / distance)
    return np.asarray((1.0 - share) * x + share * plays(x, widths, weights / weights.sum()))


def lag(x: Array, h: float, tau_s: float) -> Array:
    """First-order lag, exact for inputs that run straight between grid points."""
    a = math.exp(-h / tau_s)
    b1 = 1.0 - tau_s / h * (1.0 - a)
    b0 = 1.0 - a - b1
    return np.asarray(lfilter([b1, b0], [1.0, -a], x, zi=[x[0] * (1.0 - b1)])[0])


def creep(x: Array, h: float, share: float, tau_s: float) -> Array:
    """Motion x of which `share` follows through four lags from tau/4 to 4 tau (s)."""
    slow = np.mean([lag(x, h, tau_s * factor) for factor in (0.25, 0.63, 1.6, 4.0)], axis=0)
    return np.asarray((1.0 - share) * x + share * slow)


def delayed(x: Array, h: float, delay_s: float) -> Array:
    """Motion x later by delay_s; the first value stands before the grid."""
    at = np.arange(x.size) - delay_s / h
    return np.interp(at, np.arange(x.size), x)


def mode(x: Array, h: float, frequency_hz: float, damping: float) -> Array:
    """Base-excited mode: y'' + 2 zeta w (y' - x') + w^2 (y - x) = 0, by the bilinear rule."""
    w, k = 2.0 * math.pi * frequency_hz, 2.0 / h
    c = 2.0 * damping * w
    b = np.array([c * k + w * w, 2.0 * w * w, w * w - c * k])
    a = np.array([k * k + c * k + w * w, 2.0 * w * w - 2.0 * k * k, k * k - c * k + w * w])
    d = x - x[0]
    return np.asarray(x[0] + lfilter(b / a[0], a / a[0], d))


def saturated(x: Array, limit: float) -> Array:
    """Algebraic sigmoid x / (1 + |x / limit|^8)^(1/8)."""
    return np.asarray(x / (1.0 + np.abs(x / limit) ** 8) ** 0.125)


def dead_zone(x: Array, half_width: float) -> Array:
    """Zero within half_width of the centre, with corners rounded over a twentieth of it."""
    e = 0.05 * half_width
    up = 0.5 * (x - half_width + np.sqrt((x - half_width) ** 2 + e * e))
    down = 0.5 * (-x - half_width + np.sqrt((x + half_width) ** 2 + e * e))
    return np.asarray(up - down)


@njit(cache=True)
def maxwell_slip(x: Array, distance: float) -> Array:
    """Force in -1..1 of five parallel elements that yield over `distance` on average: generalized Maxwell slip."""
    out = np.zeros_like(x)
    z = np.zeros(5)
    for i in range(x.size):
        step = x[i] - x[i - 1] if i > 0 else 0.0
        for k in range(5):
            limit = distance * (0.2 + 0.4 * k)
            z[k] = min(max(z[k] + step, -limit), limit)
            out[i] += 0.2 * z[k] / limit
    return out
