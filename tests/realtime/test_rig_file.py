"""The rig file: what ships is good; each kind of mistake is refused in one line that names the key."""

import tomllib

import pytest

from protocol.errors import InputError
from protocol.rig_file import load_rig, parse_rig
from realtime.core.lines import tracker_config
from tests.realtime.conftest import RIG_FILE


def changed(key: str, value: object) -> dict:
    data = tomllib.loads(RIG_FILE.read_text())
    *path, last = key.split(".")
    section = data
    for part in path:
        section = section[part]
    if value is None:
        del section[last]
    else:
        section[last] = value
    return data


def test_the_shipped_rig_is_good() -> None:
    assert load_rig(RIG_FILE).name == "simulated"


@pytest.mark.parametrize(
    ("key", "value", "names"),
    [
        ("safety.over_force_N", 5.0, ["safety.over_force_N", "5.0", "at most 0.5"]),
        ("safety.stop_after_s", 10.0, ["safety.stop_after_s", "at most 0.15"]),
        ("safety.over_force_N", float("nan"), ["safety.over_force_N", "nan"]),
        ("stages.insertion.max_speed_unit_per_s", -1.0, ["stages.insertion.max_speed_unit_per_s", "-1.0", "above 0"]),
        ("stages.insertion.max_speed_unit_per_s", 1.0, ["stages.insertion", "20000 steps/s"]),
        (
            "control.position_gian_per_s",
            1.0,
            ["control.position_gian_per_s", "no such key; did you mean position_gain_per_s?"],
        ),
        ("control.loop_hz", None, ["control.loop_hz", "nothing"]),
        ("transmission.catheter", "livewire", ["transmission.catheter", "livewire", "another catheter"]),
        ("tracker.base_from_tracker_wxyz", [1.0, 1.0, 0.0, 0.0], ["tracker", "unit length"]),
    ],
)
def test_a_mistake_is_refused_with_key_value_and_range(key: str, value: object, names: list[str]) -> None:
    with pytest.raises(InputError) as refused:
        parse_rig(changed(key, value))
    message = str(refused.value)
    assert "\n" not in message
    for name in names:
        assert name in message, message


REAR = {"rear_handle": "0C", "rear_sensor_offset_m": 0.04}


def rig_data(**tracker: object) -> dict:
    data = tomllib.loads(RIG_FILE.read_text())
    data["tracker"] |= tracker
    return data


def test_a_third_sensor_is_one_more_tool_behind_the_second() -> None:
    two, three = parse_rig(rig_data()).tracker, parse_rig(rig_data(**REAR)).tracker
    assert [tool.topic for tool in two.tools] == ["pose/tip", "pose/shaft"] and two.tool_offsets_m == (0.0, 0.02)
    assert three.tools[:2] == two.tools and three.tools[2] == ("rear", "0C", "", 0.04)
    assert tracker_config(parse_rig(rig_data(**REAR))).tools == ("0A", "0B", "0C")


@pytest.mark.parametrize(
    ("tracker", "names"),
    [
        ({**REAR, "rear_handle": ""}, ["rear_handle", "rear_sensor_offset_m"]),
        ({"rear_handle": "0C"}, ["rear_sensor_offset_m above shaft_sensor_offset_m"]),
        ({**REAR, "rear_sensor_offset_m": 0.01}, ["rear_sensor_offset_m = 0.01"]),
        ({**REAR, "rear_handle": "0B"}, ["rear_handle = 0B", "third tool"]),
        ({**REAR, "rear_handle": "third"}, ["rear_handle = third", "two characters"]),
        ({**REAR, "kind": "udp", "rear_definition": "/a.rom"}, ["rear_definition", 'only for kind = "aurora"']),
    ],
)
def test_a_third_sensor_that_is_not_described_whole_is_refused(tracker: dict, names: list[str]) -> None:
    with pytest.raises(InputError) as refused:
        parse_rig(rig_data(**tracker))
    message = str(refused.value)
    assert "\n" not in message and all(name in message for name in names), message


@pytest.mark.parametrize(
    ("gains", "loop"),
    [
        ({"position_gain_per_s": 49.0}, "position"),
        ({"position_integral_per_s2": 100.0}, "position"),
        ({"position_gain_per_s": 25.0, "loop_hz": 100}, "position"),
        ({"force_integral_m_per_N_s": 0.5}, "force"),
        ({"force_gain_m_per_N": 0.0}, "force"),
    ],
)
def test_gains_that_would_be_unstable_are_refused(gains: dict, loop: str) -> None:
    data = changed("control.law", "thesis")
    data["control"]["form"] = "incremental"
    data["control"].update(gains)
    with pytest.raises(InputError, match=rf"^rig file: control: found gains .* in the {loop} loop .* wanted at least 20"):
        parse_rig(data)


@pytest.mark.parametrize(
    ("gains", "loop"),
    [
        ({"pi_position_gain": 1.1}, "position"),
        ({"pi_position_integral_per_s": 50.0}, "position"),
        ({"pi_force_gain_m_per_N": 0.5}, "force"),
    ],
)
def test_gains_of_the_pi_form_that_would_be_unstable_are_refused(gains: dict, loop: str) -> None:
    data = changed("control.law", "thesis")
    assert parse_rig(data).control.form == "pi"
    data["control"].update(gains)
    with pytest.raises(InputError, match=rf"^rig file: control: found gains of the PI form .* in the {loop} loop"):
        parse_rig(data)


def test_gains_that_hold_at_one_rate_may_not_at_another() -> None:
    data = changed("control.law", "thesis")
    data["control"].update(form="incremental", position_gain_per_s=22.0)
    assert parse_rig(data).control.law == "thesis"
    data["control"]["loop_hz"] = 100
    with pytest.raises(InputError, match="at 100 Hz"):
        parse_rig(data)


def test_an_unreadable_file_is_one_line(tmp_path) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path / "rig.toml"
    path.write_text("name = ")
    with pytest.raises(InputError) as refused:
        load_rig(path)
    assert "\n" not in str(refused.value) and "TOML" in str(refused.value)
