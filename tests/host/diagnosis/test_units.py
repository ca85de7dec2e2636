"""Units in a nominal model: every spelling of a known one is understood, every other is refused with the remedy."""

from __future__ import annotations

import math

import pytest

from host.diagnosis.model.nominal import ChannelSpec, OfferSpec, ParameterSpec
from host.diagnosis.model.units import size, unit
from protocol.errors import InputError
from protocol.requests import validate


@pytest.mark.parametrize(
    ("written", "read", "in_si"),
    [
        ("", "", 1.0),
        ("1", "1", 1.0),
        ("N", "N", 1.0),
        ("mN", "mN", 1e-3),
        ("Nm", "N m", 1.0),
        ("N*m", "N m", 1.0),
        ("N·m", "N m", 1.0),
        ("kg m²", "kg m2", 1.0),
        ("kg m^2", "kg m2", 1.0),
        ("m/s**2", "m/s2", 1.0),
        ("m s^-1", "m s-1", 1.0),
        ("N/(m s)", "N/(m s)", 1.0),
        ("1/s", "1/s", 1.0),
        ("µm", "um", 1e-6),
        ("deg/s", "deg/s", math.pi / 180.0),
        ("min", "min", 60.0),
        ("counts", "counts", 1.0),
        ("Ω", "ohm", 1.0),
        ("g", "g", 1e-3),
    ],
)
def test_a_known_unit_is_read_however_it_is_spelled(written: str, read: str, in_si: float) -> None:
    assert unit(written) == read and unit(read) == read
    assert math.isclose(size(written), in_si, rel_tol=1e-12)


@pytest.mark.parametrize(
    ("written", "remedy"),
    [
        ("newtons", "newtons is N"),
        ("millimeters", "millimeters is mm"),
        ("metres per second", "metres per second is m/s"),
        ("newton metre", "newton metre is N m"),
        ("degrees", "degrees is deg"),
        ("n", "n is N"),
        ("Rad", "Rad is rad"),
        ("furlong", "such as N, m, rad"),
        ("m/s/s", "such as N, m, rad"),
        ("N/", "such as N, m, rad"),
        ("m2.5", "such as N, m, rad"),
    ],
)
@pytest.mark.parametrize(
    ("spec", "others"),
    [
        (ChannelSpec, {"column": "a"}),
        (ParameterSpec, {"value": 1.0}),
        (OfferSpec, {"id": "backlash", "parameter": "a", "high": 1.0}),
    ],
)
def test_an_unknown_unit_is_refused_wherever_it_is_written(
    spec: type[ChannelSpec | ParameterSpec | OfferSpec], others: dict[str, object], written: str, remedy: str
) -> None:
    with pytest.raises(InputError) as caught:
        validate(spec, {**others, "unit": written})
    assert str(caught.value).startswith(f'unit: found "{written}", wanted the symbols of a unit') and remedy in str(
        caught.value
    )


def test_a_unit_that_names_the_columns_scale_is_that_of_the_column() -> None:
    assert validate(ChannelSpec, {"column": "a", "scale": 1e-3, "unit": "mm"}).unit == "m"
    assert validate(ChannelSpec, {"column": "a", "scale": 0.0174533, "unit": "deg"}).unit == "rad"
    assert validate(ChannelSpec, {"column": "a", "unit": "mm"}).unit == "mm"
    assert validate(ChannelSpec, {"column": "a", "scale": 0.5, "unit": "m"}).unit == "m"
