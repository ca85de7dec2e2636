"""A model with known effects is in all other respects the model without them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from host.diagnosis.estimation.known import Known
from host.diagnosis.model.model import Model
from host.diagnosis.model.nominal import EffectSpec, nominal_of
from host.diagnosis.model.tables import Table
from host.diagnosis.models import build
from host.diagnosis.problems import inspected, problems
from protocol.errors import InputError

JOINED = {"parameters", "taken"}  # attributes to which the known effects add


def halved(inputs: dict[str, Any], p: dict[str, float], time_s: Any, initial: dict[str, float]) -> dict[str, Any]:
    """A simulator without memory."""
    return {"x": p["gain"] * inputs["u"]}


NOMINAL: dict[str, Any] = {
    "name": "lever",
    "kind": "callable",
    "data": {"time": "t"},
    "channels": {"u": {"column": "u", "unit": "m"}, "x": {"column": "x", "unit": "m"}},
    "callable": {"function": halved, "inputs": ["u"], "outputs": ["x"], "subsystem": "lever"},
    "parameters": {"gain": {"value": 0.5, "unit": "1", "free": True}},
}
DELAY = EffectSpec(id="latency", at="x_reading", values={"delay_s": 0.03})


def recordings() -> list[Table]:
    """Two recordings of the lever, read 30 ms late."""
    t = np.arange(400) * 0.01
    return [Table(f"r{k}", {"t": t, "u": np.sin((3 + k) * t), "x": 0.5 * np.sin((3 + k) * (t - 0.03))}) for k in (0, 1)]


def known_and_inner() -> tuple[Known, Model]:
    """The lever with its delay known, and without."""
    spec = nominal_of(NOMINAL)
    inner = build(spec)
    return Known(inner, [DELAY], inspected(spec, recordings()).recordings), inner


def test_every_attribute_of_a_model_is_that_of_the_inner_one() -> None:
    """A loop over annotations: none can be forgotten. The parameters and what is taken grow by the known effect."""
    known, inner = known_and_inner()
    for name in Model.__annotations__:
        if name not in JOINED:
            assert getattr(known, name) == getattr(inner, name), name
    assert known.parameters[: len(inner.parameters)] == inner.parameters and len(known.parameters) > len(inner.parameters)
    assert known.taken > inner.taken


def test_every_method_of_a_model_is_defined() -> None:
    """A method that is inherited would answer for the defaults of `Model`, not for the inner model."""
    own = {name for name, member in vars(Model).items() if not name.startswith("_") and name not in Model.__annotations__}
    assert own <= vars(Known).keys()


@pytest.mark.parametrize("effects", [[], [DELAY]])
def test_a_simulator_with_a_known_effect_is_a_simulator(effects: list[EffectSpec]) -> None:
    """Its readings are compared with what it simulates, with a known effect and without."""
    spec = nominal_of(NOMINAL).model_copy(update={"effect": effects})
    model, _, _ = problems(spec, inspected(spec, recordings()).recordings)
    assert model.simulates


def test_an_effect_of_several_forms_asks_for_one_as_it_is_written() -> None:
    inner = build(nominal_of(NOMINAL))
    late = EffectSpec(id="presliding_friction", at="u", values={"lost_motion_m": 0.1, "distance_m": 0.2})
    with pytest.raises(InputError, match=r"in front of the values one of form=dahl \| form=maxwell \| form=reversal"):
        Known(inner, [late], inspected(nominal_of(NOMINAL), recordings()).recordings)
