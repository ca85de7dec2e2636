"""The integrals of t^k exp(iut) over 0..1, exact and smooth through u = 0: all that a circular arc needs."""

from __future__ import annotations

import math

from numba import njit

# Below this angle the power series is used, above it the recurrence; both keep 15 digits at the seam.
SERIES_LIMIT_rad = 1.0


TERMS = 10  # of each series; at the limit the first one left out is below 1e-17
REAL = tuple((-1) ** k / (math.factorial(2 * k) * (2 * k + 3)) for k in reversed(range(TERMS)))
IMAGINARY = tuple((-1) ** k / (math.factorial(2 * k + 1) * (2 * k + 4)) for k in reversed(range(TERMS)))


@njit(cache=True, nogil=True, error_model="numpy")
def phi2_series(u: float) -> tuple[float, float]:
    """Integral of t^2 exp(iut) for |u| <= 1 as (real, imaginary): the sum of (iu)^m / (m! (m + 3)), by Horner."""
    w = u * u
    real = imaginary = 0.0
    for k in range(TERMS):
        real = real * w + REAL[k]
        imaginary = imaginary * w + IMAGINARY[k]
    return real, u * imaginary


@njit(cache=True, nogil=True, error_model="numpy")
def phi(u: float) -> tuple[float, float, float, float, float, float, float, float]:
    """phi_k(u) = integral of t^k exp(iut) dt over 0..1 for k = 0, 1, 2, and exp(iu).

    Arguments: `u`, the arc's turning angle (rad). Result: (re0, im0, re1, im1, re2, im2, cos u, sin u).
    An arc of length l that starts at angle a ends l exp(ia) phi_0(kappa l) further; d phi_k / du = i phi_(k+1).
    Replaces the quotients by kappa of (2.3)-(2.18), which are singular for a straight arc.
    """
    cosine, sine = math.cos(u), math.sin(u)
    if abs(u) < SERIES_LIMIT_rad:
        re2, im2 = phi2_series(u)
        # phi_(k-1) = (exp(iu) - iu phi_k) / k: downwards, errors shrink for small u
        re1, im1 = 0.5 * (cosine + u * im2), 0.5 * (sine - u * re2)
        re0, im0 = cosine + u * im1, sine - u * re1
    else:
        inverse = 1.0 / u
        # phi_k = (exp(iu) - k phi_(k-1)) / (iu): upwards
        re0, im0 = sine * inverse, (1.0 - cosine) * inverse
        re1, im1 = (sine - im0) * inverse, (re0 - cosine) * inverse
        re2, im2 = (sine - 2.0 * im1) * inverse, (2.0 * re1 - cosine) * inverse
    return re0, im0, re1, im1, re2, im2, cosine, sine


@njit(cache=True, nogil=True, error_model="numpy")
def phi3(u: float, re2: float, im2: float, cosine: float, sine: float) -> tuple[float, float]:
    """phi_3(u) from phi_2(u) and exp(iu); needed only under distributed loads."""
    if abs(u) >= SERIES_LIMIT_rad:
        return (sine - 3.0 * im2) / u, (3.0 * re2 - cosine) / u
    real = imaginary = 0.0
    term_re, term_im = 1.0, 0.0
    for m in range(24):
        real += term_re / (m + 4)
        imaginary += term_im / (m + 4)
        term_re, term_im = -u * term_im / (m + 1), u * term_re / (m + 1)
    return real, imaginary
