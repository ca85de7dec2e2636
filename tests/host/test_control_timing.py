"""The tick that the control study times is one in contact."""

from __future__ import annotations

import pytest

from host.studies.control import timing
from host.studies.control.runs import with_control
from protocol.rig_file import SIMULATED_RIG, load_rig


@pytest.mark.slow
@pytest.mark.parametrize("law", ["predictive", "thesis"])
def test_the_timed_tick_stays_in_contact(law: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(timing, "TICKS", 2000)  # two seconds: a disagreement of the forces retracts within one
    found = timing.tick_us(with_control(load_rig(SIMULATED_RIG), law=law))
    assert 0.0 < found["p50"] <= found["p99"] <= found["p999"]
