"""Phase margins of the thesis' two loops (Figs. 6.12, 7.1), linear: gains, delays and the stiffness that is assumed.

In the PI form the joints follow K_p e + K_i sum(e), so L(s) = (K_p + K_i/s) e^(-sT) for the position, times
(K_f + K_if/s) k for the force (`pi_margin_deg`).

In the incremental form both integrate (the actuators are moved by differences), so L(s) = (K_p + K_i/s) / s e^(-sT) for
the position and (K_p + K_i/s) / s (K_f + K_if/s) k e^(-sT) for the force. Backlash and noise ask for more than a margin
above zero: `seldinger tune` finds by simulation which gains oscillate.
"""

from __future__ import annotations

import math
from typing import NamedTuple

# A loop with less is taken for unstable.
LEAST_MARGIN_deg = 20.0


def _margin_deg(gain: float, corners: tuple[float, ...], delay_s: float) -> float:
    """Return the phase margin (degrees) of gain / s prod(1 + corner / s) e^(-s delay), corners in rad/s."""
    if gain <= 0.0 or not all(math.isfinite(corner) for corner in corners):
        return 90.0 if gain <= 0.0 and not any(corners) else -90.0
    low, high = 1e-6, 1e6
    for _ in range(100):
        omega = math.sqrt(low * high)
        size = gain / omega * math.prod(math.hypot(1.0, corner / omega) for corner in corners)
        low, high = (omega, high) if size > 1.0 else (low, omega)
    lag = sum(math.atan2(corner, omega) for corner in corners) + omega * delay_s
    return 90.0 - math.degrees(lag)


def position_margin_deg(gain_per_s: float, integral_per_s2: float, delay_s: float) -> float:
    """Return the phase margin of the position loop (degrees). delay_s: from pose to stage. -90 with integral but no gain."""
    return _margin_deg(gain_per_s, (_corner(integral_per_s2, gain_per_s),), delay_s)


def force_margin_deg(
    gain_per_s: float,
    integral_per_s2: float,
    force_gain_m_per_N: float,
    force_integral_m_per_N_s: float,
    stiffness_N_per_m: float,
    delay_s: float,
) -> float:
    """Return the phase margin (degrees) of the force loop around it, with a force sensor. delay_s: from force to stage."""
    corners = (_corner(integral_per_s2, gain_per_s), _corner(force_integral_m_per_N_s, force_gain_m_per_N))
    return _margin_deg(gain_per_s * force_gain_m_per_N * stiffness_N_per_m, corners, delay_s)


def _corner(integral: float, gain: float) -> float:
    """Return the frequency (rad/s) below which the integral part dominates."""
    if integral <= 0.0:
        return 0.0
    return integral / gain if gain > 0.0 else math.inf


class ProportionalIntegral(NamedTuple):
    """One controller K_p + K_i / s: gain dimensionless, integral in 1/s."""

    gain: float
    integral_per_s: float


def pi_margin_deg(parts: tuple[ProportionalIntegral, ...], delay_s: float) -> float:
    """Phase margin (degrees) of the product of K_p + K_i/s with a delay (s), the PI form of the law.

    The gain falls towards the product of the proportional parts. From 1 up there is no crossover: -90.
    """
    if math.prod(part.gain for part in parts) >= 1.0 or not all(math.isfinite(v) for part in parts for v in part):
        return -90.0

    def size(omega: float) -> float:
        return math.prod(math.hypot(part.gain, part.integral_per_s / omega) for part in parts)

    low, high = 1e-6, 1e6
    if size(low) < 1.0:
        return 90.0
    for _ in range(100):
        omega = math.sqrt(low * high)
        low, high = (omega, high) if size(omega) > 1.0 else (low, omega)
    lag = sum(math.atan2(part.integral_per_s, part.gain * low) for part in parts) + low * delay_s
    return 180.0 - math.degrees(lag)
