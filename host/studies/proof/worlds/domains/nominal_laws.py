"""Nominal models that are Python functions: laws that a user writes down without knowing what is missing."""

from __future__ import annotations

import math

import numpy as np

Array = np.ndarray


def outlet(
    inputs: dict[str, Array], parameters: dict[str, float], time_s: Array, start: dict[str, float]
) -> dict[str, Array]:
    """Return the outlet temperature (n,) of a heat exchanger of one lag: lag T' + T = gain * inlet.

    Args:
        inputs: `inlet_degC` (n,), held between samples.
        parameters: `gain`; `lag`, s.
        time_s: sample times (n,) s.
        start: `outlet_degC` at the first sample.
    """
    inlet = parameters["gain"] * inputs["inlet_degC"]
    found, value = [start["outlet_degC"]], start["outlet_degC"]
    for k in range(time_s.size - 1):
        share = math.exp(-float(time_s[k + 1] - time_s[k]) / parameters["lag"])
        value = float(inlet[k]) + share * (value - float(inlet[k]))
        found.append(value)
    return {"outlet_degC": np.array(found)}
