"""Catheter files: what ships, what is refused, and that writing and reading agree."""

from __future__ import annotations

import dataclasses
import warnings
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.catheter import (
    Catheter,
    ConstitutiveParameters,
    CosseratParameters,
    PcarParameters,
    catheter_from_table,
    catheter_toml,
    load_catheter,
    shipped_catheters,
)
from protocol.errors import InputError
from protocol.usual_values import UnusualValue

GOOD = {
    "name": "x",
    "distal_length_m": 0.07,
    "diameter_m": 0.00233,
    "pull_wire_offset_m": 0.0007,
    "pcar": {"EI_N_m2": [1e-3, 4e-4, 3e-4], "distal_arcs_m": [0.02, 0.05]},
}


def test_what_ships_bears_the_thesis_values() -> None:
    assert shipped_catheters() == ["blazer_prime_xp", "livewire", "steerocath_t", "thermocool_sf"]
    thermocool, livewire = load_catheter("thermocool_sf"), load_catheter("livewire")
    assert thermocool.pcar is not None and livewire.cosserat is not None
    assert thermocool.pcar.EI_N_m2 == (1.490e-3, 0.430e-3, 0.250e-3) and thermocool.pcar.l2_m == 0.0192
    assert thermocool.cosserat is None
    assert vars(livewire.cosserat) == {
        "EI1": 0.0239e-3,
        "EI2": 0.1961e-3,
        "GJ": 0.0846e-3,
        "EbI1": 0.0195e-3,
        "EbI2": 0.7044e-3,
        "GbJ": 0.2784e-3,
    }
    assert load_catheter("blazer_prime_xp").distal_length_m == 0.110
    with pytest.raises(dataclasses.FrozenInstanceError):
        thermocool.name = "y"  # type: ignore[misc]


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"colour": 1}, "colour"),
        ({"distal_length_m": -0.07}, "distal_length_m"),
        ({"distal_length_m": float("nan")}, "distal_length_m"),
        ({"diameter_m": "7 F"}, "diameter_m"),
        ({"pcar": {"EI_N_m2": [1e-3, 4e-4], "distal_arcs_m": [0.02, 0.05]}}, "pcar.EI_N_m2"),
        ({"pcar": {"EI_N_m2": [1e-3, 4e-4, 3e-4], "distal_arcs_m": [0.02, 0.06]}}, "pcar.distal_arcs_m"),
        ({"pcar": {"EI_N_m2": [1e-3, 0.0, 3e-4], "distal_arcs_m": [0.02, 0.05]}}, "pcar.EI_N_m2.1"),
        ({"pcar": {"EI": [1e-3], "distal_arcs_m": [0.07]}}, "pcar.EI"),
        ({"cosserat": {"EI1_N_m2": 1e-4}}, "cosserat"),
        ({"constitutive": {"friction_coefficient": -0.1}}, "constitutive.friction_coefficient"),
    ],
)
def test_bad_tables_are_refused_by_key(change: dict, key: str) -> None:
    with pytest.raises(InputError) as caught:
        catheter_from_table({**GOOD, **change})
    assert caught.value.key.startswith(key)


def test_missing_key_is_named() -> None:
    table = {key: value for key, value in GOOD.items() if key != "diameter_m"}
    with pytest.raises(InputError) as caught:
        catheter_from_table(table)
    assert caught.value.key == "diameter_m" and caught.value.found == "nothing"


@pytest.mark.parametrize("content", [None, "name = ", "\x00", "[pcar]\n"])
def test_unreadable_files_are_refused(tmp_path: Path, content: str | None) -> None:
    path = tmp_path / "c.toml"
    if content is not None:
        path.write_text(content)
    with pytest.raises(InputError):
        load_catheter(path)


@pytest.mark.parametrize("name", ["", "Livewire", "../livewire", "/etc/passwd", "livewire.json"])
def test_unknown_names_list_the_known_ones(name: str) -> None:
    with pytest.raises(InputError, match="thermocool_sf"):
        load_catheter(name)


positive = st.floats(1e-6, 1.0)
lengths = st.floats(1e-3, 0.1)
diameters = st.floats(2e-4, 0.02)


@given(
    name=st.text(min_size=1) | st.just('\x7f"\\\n'),
    values=st.lists(positive, min_size=6, max_size=6),
    arcs=st.lists(lengths, min_size=1, max_size=6),
    diameter_m=diameters,
    groups=st.tuples(st.booleans(), st.booleans()),
)
def test_writing_then_reading_gives_the_same_catheter(
    tmp_path_factory: pytest.TempPathFactory,
    name: str,
    values: list[float],
    arcs: list[float],
    diameter_m: float,
    groups: tuple[bool, bool],
) -> None:
    pcar = PcarParameters(tuple([values[2]] * (len(arcs) + 1)), tuple(arcs))
    catheter = Catheter(
        name,
        sum(arcs),
        diameter_m,
        0.5 * diameter_m * values[1],
        pcar,
        CosseratParameters(*values) if groups[0] else None,
        ConstitutiveParameters(values[3], values[4]) if groups[1] else None,
    )
    path = tmp_path_factory.mktemp("c") / "c.toml"
    path.write_text(catheter_toml(catheter, ["a note\nof two lines"]), encoding="utf-8")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnusualValue)
        assert load_catheter(path) == catheter
