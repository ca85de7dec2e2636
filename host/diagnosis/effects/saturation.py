"""Saturation: a limit beyond which nothing follows."""

from __future__ import annotations

import numpy as np

from host.diagnosis.effect import Array, Context, Effect, Parameter, Scale, spread



def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Limit above (or below)."""
    share = (0.98, 0.93, 0.85, 0.75) if form == "upper" else (0.02, 0.07, 0.15, 0.25)
    return (Parameter("limit", s.unit, tuple(s.low + f * s.span for f in share), s.low, s.high, step=0.05 * s.span),)


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Clipped at the limit."""
    return np.asarray(np.minimum(signal, p[0]) if form == "upper" else np.maximum(signal, p[0]))


SAYS = "Beyond {limit} nothing follows."
EFFECTS = tuple(
    Effect("saturation", port, 33, parameters, SAYS, "y = min(x, limit)", apply, forms=("upper", "lower")) for port in ("motion", "limit")
)
