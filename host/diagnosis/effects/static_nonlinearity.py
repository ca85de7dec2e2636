"""Static nonlinearity: any other memoryless curve, traced the same way up and down (polynomial)."""

from __future__ import annotations

import numpy as np

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Quadratic and cubic bend, as displacement at the ends of the range; `fine`: up to the sixth power.

    `sloped`: with a change of the slope, for an input that has no gain in the nominal model.
    """
    powers = [*(("quartic", "quintic", "sextic") if "fine" in form else ()), *(("slope",) if "sloped" in form else ())]
    return (
        Parameter("quadratic", s.unit, (s.need,), linear=True),
        Parameter("cubic", s.unit, (s.need,), linear=True),
        Parameter("middle", s.unit, (0.5 * (s.low + s.high),), 0.5 * (s.low + s.high), 0.5 * (s.low + s.high)),
        Parameter("half_range", s.unit, (0.5 * s.span,), 0.5 * s.span, 0.5 * s.span),
        *(Parameter(name, s.unit, (s.need,), linear=True) for name in powers),
    )


def force(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Force that depends on place: amplitudes of the square and the cube over the travel."""
    return (Parameter("quadratic", s.unit, (s.need,), linear=True), Parameter("cubic", s.unit, (s.need,), linear=True))


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Polynomial of the place in the range; mean (and slope, if not `sloped`) stay with the nominal model."""
    u = (signal - p[2]) / p[3]
    bend = p[0] * (u * u - 1.0 / 3.0) + p[1] * (u**3 - 0.6 * u)
    if "sloped" in form:
        bend += p[-1] * u
    if "fine" in form:
        v = np.clip(u, -1.2, 1.2)
        bend += np.polynomial.chebyshev.chebval(v, [0.0, 0.0, 0.0, 0.0, *p[4:7]])
    return np.asarray(signal + bend)


EFFECTS = (
    Effect(
        "static_nonlinearity",
        "motion",
        31,
        parameters,
        "The relation from input to output is curved, equally in both directions of motion.",
        "y = x + quadratic*(u^2 - 1/3) + cubic*(u^3 - 3u/5),  u = (x - middle)/half_range",
        apply,
    ),
    Effect(
        "static_nonlinearity",
        "motion",
        30,
        parameters,
        "The relation from input to output has several bends, equal in both directions of motion.",
        "y = x + quadratic*(u^2 - 1/3) + cubic*(u^3 - 3u/5) + quartic*T4(u) + quintic*T5(u) + sextic*T6(u),"
        "  u = (x - middle)/half_range",
        apply,
        forms=("fine",),
    ),
    Effect(
        "static_nonlinearity",
        "scale",
        31,
        parameters,
        "The relation from input to output is curved, equally in both directions of motion.",
        "y = x + slope*u + quadratic*(u^2 - 1/3) + cubic*(u^3 - 3u/5),  u = (x - middle)/half_range",
        apply,
        forms=("sloped",),
        contains=("sensor_scale",),
    ),
    Effect(
        "static_nonlinearity",
        "scale",
        30,
        parameters,
        "The relation from input to output has several bends, equal in both directions of motion.",
        "y = x + slope*u + quadratic*(u^2 - 1/3) + cubic*(u^3 - 3u/5) + quartic*T4(u) + quintic*T5(u) + sextic*T6(u),"
        "  u = (x - middle)/half_range",
        apply,
        forms=("sloped fine",),
        contains=("sensor_scale",),
    ),
)
