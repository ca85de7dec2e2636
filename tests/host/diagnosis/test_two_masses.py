"""A motor, a compliant shaft and a load, against one rigid inertia: the mode is found from either side."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import butter, lfilter

import seldinger as sd
from host.diagnosis.effects import library
from host.diagnosis.estimation.fit import Term, lines_of, tuned
from host.diagnosis.model.effect import Candidate, Context, Port, Scale

Array = np.ndarray
DT_S, DRIVE, LOAD, DAMPING = 0.005, 0.02, 0.01, 0.08
CHANNELS = {"u": {"column": "u", "unit": "N m"}, "y": {"column": "y", "unit": "rad/s"}}
RIGID: dict[str, Any] = {
    "name": "drive",
    "kind": "linear",
    "data": {"time": "t"},
    "channels": CHANNELS,
    "linear": {
        "inputs": ["u"],
        "outputs": ["y"],
        "numerator": [1.0],
        "denominator": ["J", "c"],
        "hold": "linear",
        "subsystem": "drive",
    },
    "parameters": {"J": {"value": 0.04, "low": 1e-3, "high": 1.0}, "c": {"value": 0.1, "low": 1e-4, "high": 10.0}},
}


def speeds(u: Array, hertz: float, ratio: float) -> tuple[Array, Array]:
    """Speeds of motor and load under the torque u (n,), straight between samples: exact, by the matrix exponential."""
    k = (2.0 * np.pi * hertz) ** 2 * DRIVE * LOAD / (DRIVE + LOAD)
    d = 2.0 * ratio * np.sqrt(k * DRIVE * LOAD / (DRIVE + LOAD))
    whole = np.zeros((5, 5))  # twist, motor speed, load speed, torque, its rate
    whole[0, 1:3] = 1.0, -1.0
    whole[1, :4] = -k / DRIVE, -(DAMPING + d) / DRIVE, d / DRIVE, 1.0 / DRIVE
    whole[2, :3] = k / LOAD, d / LOAD, -d / LOAD
    whole[3, 4] = 1.0
    step = expm(whole * DT_S)
    state, out = np.zeros(3), np.zeros((2, u.size))
    for i in range(u.size):
        out[:, i] = state[1:]
        slope = (u[min(i + 1, u.size - 1)] - u[i]) / DT_S
        state = step[:3, :3] @ state + step[:3, 3] * u[i] + step[:3, 4] * slope
    return out[0], out[1]


def drive(seed: int, hertz: float, ratio: float, side: str, n: int = 2000) -> dict[str, Array]:
    rng, lead = np.random.default_rng([17, seed]), 400
    u = 3.0 * lfilter(*butter(2, 0.12), rng.standard_normal(n + lead))
    y = speeds(u, hertz, ratio)[("motor", "load").index(side)][lead:]
    return {"t": np.arange(n) * DT_S, "u": u[lead:], "y": y + 3e-3 * np.std(y) * rng.standard_normal(n)}


def mode_of(port: str) -> Any:
    return next(e for e in library() if e.id == "resonance" and e.port == port)


SCALE = Scale("N m", 2.0, -1.0, 1.0, 5.0, 1e-3, 0.3, DT_S, 10.0, True)


def test_a_mode_is_tried_between_the_lines_of_the_residual_too() -> None:
    """A disturbance is at a line; a mode that no tone excites lies between them."""
    t = np.arange(2000) * DT_S
    lines = lines_of([np.sin(2.0 * np.pi * 7.3 * t)[None, :]], DT_S)
    effect = mode_of("motion")
    for form in effect.forms:
        term = Term(Candidate(effect, Port("u", "motion", "drive", ("y",)), "", form), effect.parameters(SCALE, form))
        (frequency,) = (p for p in tuned(term, lines) if p.spectral)
        (plain,) = (p for p in term.parameters if p.spectral)
        assert set(plain.grid) <= set(frequency.grid)
        assert min(abs(f - 7.3) for f in frequency.grid) < 0.05 < min(abs(f - 7.3) for f in plain.grid)


def test_what_a_load_does_to_its_drive() -> None:
    """The form against the exact motion of two masses, of which the rigid pair is the nominal part."""
    rng = np.random.default_rng(5)
    u = lfilter(*butter(2, 0.05), rng.standard_normal(3000))
    u[:50] = 0.0
    motor, _ = speeds(u, 7.3, 0.01)
    rate = DAMPING / (DRIVE + LOAD)  # small: the form has the damping of the motor at the rigid pair
    context = Context(np.arange(u.size) * DT_S, DT_S, u, 1e-6)
    given = mode_of("motion").apply(u, context, np.array([LOAD / DRIVE, 7.3, 0.01 + 0.0145]), "drive")
    keep = np.exp(-rate * DT_S)
    rigid = lfilter([0.5 * (1 - keep), 0.5 * (1 - keep)], [1.0, -keep], given) / DAMPING
    assert np.std(rigid - motor) < 0.05 * np.std(motor)


def test_a_motion_that_is_imposed_feels_no_load() -> None:
    imposed = Scale("rad", 2.0, -1.0, 1.0, 5.0, 1e-3, 0.3, DT_S, 10.0, True)
    assert mode_of("motion").parameters(imposed, "drive") == () and mode_of("motion").parameters(SCALE, "drive") != ()


@pytest.mark.parametrize(
    ("side", "hertz"),
    [pytest.param("motor", 7.3, marks=pytest.mark.slow), pytest.param("load", 13.0, marks=pytest.mark.long)],
)
def test_the_mode_of_a_compliant_shaft_is_named(side: str, hertz: float) -> None:
    verdict = sd.diagnose([drive(k, hertz, 0.004, side) for k in (1, 2)], RIGID)
    (found,) = verdict.effects
    fit = verdict.as_dict()["fit"]
    assert found["id"] == "resonance" and found["probability"] > 0.8
    assert found["parameters"]["frequency_Hz"]["value"] == pytest.approx(hertz, rel=0.01)
    assert fit["rmse_after"] < 0.15 * fit["rmse_before"]
    if side == "motor":
        assert found["parameters"]["load_ratio"]["value"] == pytest.approx(LOAD / DRIVE, rel=0.1)
