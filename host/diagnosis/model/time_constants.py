"""How slow a plant is by what the nominal model's file states: a check of the unit of its time stamps."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from host.diagnosis.model.expressions import value_of
from host.diagnosis.model.nominal import NominalSpec

TERMS = ("mass", "damping", "stiffness")  # in falling powers of s


def slowest_s(spec: NominalSpec) -> float | None:
    """The longest stated time constant (s) of the nominal model; None where none is stated.

    That of a law is the inverse of the slowest zero of m s^2 + c s + k. A pole at zero integrates and has no time constant.
    """
    found = [p.value for name, p in spec.parameters.items() if spec.link and "time_constant_" in name]
    section = spec.axis or spec.impedance
    if section is not None:
        stated = [spec.start(t, 0.0)[0] if t in section.terms and t in spec.parameters else 0.0 for t in TERMS]
        found += _times_s(np.roots(stated))
    if spec.linear is not None and spec.linear.period_s is None:
        values = {name: parameter.value for name, parameter in spec.parameters.items()}
        values |= {offer.parameter: offer.off for offer in spec.offer}
        rows = [spec.linear.denominator] if spec.linear.denominator is not None else spec.linear.A or []
        numbers = [[value_of(one, values) for one in row] for row in rows]
        if not all(np.isfinite(row).all() for row in numbers):
            return None
        if spec.linear.denominator is not None:
            found += _times_s(np.roots(numbers[0]))
        elif all(len(row) == len(numbers) for row in numbers):  # otherwise the model refuses it
            found += _times_s(np.linalg.eigvals(np.array(numbers)))
    return max(found, default=None)


def _times_s(poles: npt.ArrayLike) -> list[float]:
    sizes = np.abs(np.asarray(poles, dtype=complex))
    return [float(1.0 / size) for size in sizes if np.isfinite(size) and size > 0.0]
