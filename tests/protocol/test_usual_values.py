"""Values in another unit: a number of a rig or catheter file that is wrong by 1000 or 57.3 is refused or gets a warning."""

from __future__ import annotations

import copy
import json
import tomllib
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from host.cli.rig import rig as rig_command
from protocol.catheter import CATHETER_FOLDER, catheter_from_table, load_catheter, shipped_catheters, unusual_parameters
from protocol.errors import InputError
from protocol.rig_file import SIMULATED_RIG, Rig, load_rig, parse_rig, problems_of, unusual_values
from protocol.usual_values import CATHETER, NET_FT, RIG, UnusualValue, unusual

TEXT = SIMULATED_RIG.read_text(encoding="utf-8")
DATA = parse_rig(tomllib.loads(TEXT)).effective()
FACTORS = (1e3, 1e-3, 57.29578, 1 / 57.29578)
# A box that counts in N m has 1e6 here, one in N mm 1e9, and there are boxes between: `check-device force` compares
# this number with the one on the box's page.
BETWEEN = "force_sensor.counts_per_newton_metre"


def numbers(content: Any, place: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Each number, or list of numbers, that is not zero, with its place."""
    if isinstance(content, dict):
        for key, value in content.items():
            yield from numbers(value, (*place, key))
    elif isinstance(content, list) and content and all(isinstance(item, float) for item in content):
        yield place, content
    elif isinstance(content, int | float) and not isinstance(content, bool) and content:
        yield place, content


def changed(content: dict[str, Any], place: tuple[str, ...], factor: float) -> dict[str, Any]:
    out = copy.deepcopy(content)
    section: Any = out
    for key in place[:-1]:
        section = section[key]
    value = section[place[-1]]
    section[place[-1]] = [item * factor for item in value] if isinstance(value, list) else type(value)(value * factor)
    return out


@pytest.mark.parametrize(("place", "value"), list(numbers(DATA)), ids=[".".join(place) for place, _ in numbers(DATA)])
def test_a_number_of_the_rig_file_in_another_unit_is_refused_or_warned_of(place: tuple[str, ...], value: Any) -> None:
    for factor in FACTORS:
        if ".".join(place) == BETWEEN and factor < 1.0:
            continue
        data = changed(DATA, place, factor)
        said = problems_of(data) or unusual_values(parse_rig(data))
        # A change of a length, a rate or a gain may be found at the key that it no longer agrees with.
        assert said, f"{'.'.join(place)} = {value} times {factor:g} is accepted without a word"


@pytest.mark.parametrize("name", shipped_catheters())
def test_a_number_of_a_catheter_file_in_another_unit_is_refused_or_warned_of(name: str) -> None:
    data = tomllib.loads((CATHETER_FOLDER / f"{name}.toml").read_text(encoding="utf-8"))
    assert unusual_parameters(load_catheter(name)) == []
    for place, value in numbers(data):
        for factor in (1e3, 1e-3, 1e6):
            try:
                said = unusual_parameters(catheter_from_table(changed(data, place, factor)))
            except InputError as refused:
                said = [str(refused)]
            assert said, f"{name}: {'.'.join(place)} = {value} times {factor:g} is accepted without a word"


def test_the_shipped_rig_has_no_unusual_value_and_each_range_is_of_a_key() -> None:
    rig = load_rig(SIMULATED_RIG)
    assert unusual_values(rig) == []
    keys = {".".join(place) for place, _ in numbers(DATA)}
    assert set(RIG) | set(NET_FT) <= keys
    for key, (low, high) in (RIG | NET_FT | CATHETER).items():
        assert 0 < low < high, key


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("tracker.latency_s", 2.5e-5, "2.5e-05 s is 0.025 ms"),
        ("tracker.orientation_noise_rad", 0.2, "in rad: 0.2 degrees is 0.00349066"),
        ("stages.roll.steps_per_unit", 35.6, "in steps/rad: 35.6 steps/degrees is 2039.73"),
        ("stages.knob.max_unit", 0.0305, "0.0305 rad is 1.74752 degrees"),
        ("control.force_gain_m_per_N", 3e-6, "3e-06 m/N is 0.003 mm/N"),
        ("force_sensor.noise_N", 3e-6, "3e-06 N is 0.003 mN"),
        ("control.pi_position_gain", 0.001, "found 0.001, usual 0.005 to 2"),
    ],
)
def test_the_unit_slip_is_named(key: str, value: float, says: str) -> None:
    content: dict[str, Any] = {}
    section = content
    *sections, last = key.split(".")
    for name in sections:
        section = section.setdefault(name, {})
    section[last] = value
    lines = unusual(content, RIG)
    assert len(lines) == 1 and lines[0].startswith(f"{key}: found ") and says in lines[0]


def test_zero_and_counts_of_another_kind_of_sensor_are_not_unusual(tmp_path: Path) -> None:
    data = copy.deepcopy(DATA)
    data["control"]["play_sd_m"] = 0.0
    data["force_sensor"] |= {"kind": "my_sensor", "counts_per_newton": 1.0, "counts_per_newton_metre": 1.0}
    assert unusual_values(Rig.model_validate(data)) == []


def test_the_check_and_the_start_say_the_same(tmp_path: Path) -> None:
    file = tmp_path / "lab.toml"
    file.write_text(TEXT.replace("latency_s = 0.025", "latency_s = 0.000025"), encoding="utf-8")
    told = CliRunner().invoke(rig_command, ["check", str(file), "--quiet"])
    line = f"{file}: tracker.latency_s: found 2.5e-05, usual 0.001 to 0.15; 2.5e-05 s is 0.025 ms"
    assert told.exit_code == 0 and told.stderr.strip() == f"seldinger: warning: {line}"
    assert json.loads(CliRunner().invoke(rig_command, ["check", str(file), "--json"]).stdout)["unusual"]
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        load_rig(file)
    assert [(item.category, str(item.message)) for item in given] == [(UnusualValue, line)]
