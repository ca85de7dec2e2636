"""How far and how fast a jog may be: the realtime process refuses more, and who commands asks for no more."""

from __future__ import annotations

from protocol.enums import JogAxis
from protocol.rig_file import Rig

# Longest way of one jog: m for tip and insertion, rad for roll and knob. A longer way needs several jogs, or a target.
LONGEST_JOG = {JogAxis.TIP: 0.020, JogAxis.INSERTION: 0.020, JogAxis.ROLL: 0.8, JogAxis.KNOB: 0.8}
# Share of their greatest speed that roll and knob are jogged at, at most.
SPEED_SHARE = 0.2


def unit_of(axis: JogAxis) -> str:
    """Return the unit of a jog of `axis`: m or rad."""
    return "m" if axis in (JogAxis.TIP, JogAxis.INSERTION) else "rad"


def fastest_jog(rig: Rig, axis: JogAxis) -> float:
    """Return the greatest speed of a jog (m/s or rad/s): of tip and insertion that of an approach, which may meet tissue."""
    if axis in (JogAxis.TIP, JogAxis.INSERTION):
        return rig.control.approach_speed_m_per_s
    return SPEED_SHARE * rig.stage(int(axis)).max_speed_unit_per_s
