"""Polarity of the enable line and of the switches, on the pins of the simulated processors, through resets and faults."""

from __future__ import annotations

from typing import Any

import pytest

from protocol.board_pins import SWITCHES
from protocol.enums import BoardState
from protocol.rig_file import Pins
from protocol.serial_frames import Fault, InputBit
from sim.board import BUILD_DIR, SimulatedBoard
from tests.sim.board_rig import BoardRig


def rig_with(kind: str, **pins: Any) -> BoardRig:
    """A board on the bench, built with these pins and polarities."""
    chosen = Pins.model_validate(pins)
    return BoardRig(kind, chosen.mcu, chosen.build())


def trip(rig: BoardRig) -> None:
    """Press the emergency stop of an armed board and wait for the fault."""
    rig.inputs["estop"] = True
    rig.run_ms(60)
    assert (rig.status.state, rig.status.fault) == (BoardState.FAULT, Fault.ESTOP)


POLARITIES = [
    pytest.param("native", {}, id="native"),
    *(
        pytest.param("avr", {"mcu": mcu, "enable_active": active}, id=f"{mcu}-enable-{active}", marks=pytest.mark.avr)
        for mcu in ("atmega2560", "atmega328p")
        for active in ("low", "high")
    ),
]


@pytest.fixture(autouse=True)
def tools(request: pytest.FixtureRequest) -> None:
    if request.node.get_closest_marker("avr"):
        request.getfixturevalue("avr_tools")


@pytest.mark.parametrize(("kind", "pins"), POLARITIES)
def test_the_drives_are_powered_from_arm_to_rest_only(kind: str, pins: dict[str, Any]) -> None:
    rig = rig_with(kind, **pins)
    rig.bring_up()
    assert rig.last is not None and not rig.last.enabled and rig.last.enable_changes == 0
    rig.arm()
    assert rig.last.enabled
    rig.run_ms(10, rig.link.disarm())
    assert rig.status.state == BoardState.DISARMED and not rig.last.enabled
    rig.arm()
    trip(rig)
    assert not rig.last.enabled and rig.last.enable_changes == 4
    rig.close()


@pytest.mark.parametrize(("kind", "pins"), POLARITIES)
def test_no_reset_powers_the_drives_even_for_an_instant(kind: str, pins: dict[str, Any]) -> None:
    """Each reset of an armed board is one change of the line, to off: pins before their setup are no pulse either."""
    rig = rig_with(kind, **pins)
    for reset in (rig.board.power_cycle, rig.board.reset, rig.board.freeze):
        rig.run_ms(20)
        rig.link.restart()
        rig.bring_up()
        assert rig.last is not None and not rig.last.enabled
        before = rig.last.enable_changes
        rig.arm()
        assert rig.last.enabled and rig.last.enable_changes == before + 1
        reset()
        rig.run_ms(100)
        assert not rig.last.enabled and rig.last.enable_changes == before + 2
    rig.close()


@pytest.mark.avr
@pytest.mark.parametrize("mcu", ["atmega2560", "atmega328p"])
def test_a_vertical_axis_stays_powered_on_a_fault_until_it_is_disarmed(mcu: str) -> None:
    rig = rig_with("avr", mcu=mcu, keep_enabled=True)
    rig.bring_up()
    rig.arm()
    trip(rig)
    assert rig.last is not None and rig.last.enabled
    rig.inputs["estop"] = False
    rig.run_ms(5)
    rig.run_ms(5, rig.link.clear_fault(Fault.ESTOP))
    assert rig.status.state == BoardState.DISARMED and rig.last.enabled
    rig.run_ms(5, rig.link.disarm())
    assert not rig.last.enabled
    rig.close()


@pytest.mark.avr
@pytest.mark.parametrize("mcu", ["atmega2560", "atmega328p"])
@pytest.mark.parametrize("normally_open", [(), ("estop",), SWITCHES[:-1], SWITCHES], ids=["none", "estop", "limits", "all"])
def test_each_switch_is_reported_hit_whichever_way_it_is_made(mcu: str, normally_open: tuple[str, ...]) -> None:
    rig = rig_with("avr", mcu=mcu, normally_open=normally_open)
    rig.bring_up()
    rig.run_ms(5)
    assert rig.status.inputs == 0
    for bit in InputBit:
        rig.inputs = {"estop": True} if bit == InputBit.ESTOP else {"limit_bits": 1 << bit}
        rig.run_ms(8)
        seen = rig.status.inputs
        twins = 3 << (bit & ~1) if mcu == "atmega328p" and bit != InputBit.ESTOP else 1 << bit
        assert seen & 1 << bit and not seen & ~twins, f"{bit.name}: {seen:07b}"
        rig.inputs = {}
        rig.run_ms(8)
        if bit == InputBit.ESTOP:
            rig.run_ms(5, rig.link.clear_fault(Fault.ESTOP))
        assert rig.status.inputs == 0
    rig.close()


def test_another_polarity_is_a_build_of_its_own() -> None:
    usual, other = Pins.model_validate({}).build(), Pins.model_validate({"enable_active": "high"}).build()
    assert usual.folder == BUILD_DIR.name and not usual.variables
    assert other.folder != usual.folder and "-DBOARD_ENABLE_ACTIVE_LOW=0" in other.variables[1]
    with SimulatedBoard("native", build=Pins.model_validate({"keep_enabled": True}).build()) as board:
        assert not board.exchange(1000).enabled
