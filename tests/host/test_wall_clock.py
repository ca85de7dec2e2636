"""The processes of the rig on the wall clock, one of them killed in contact: the stages rest, the recording reads back.

Times that are asserted are the simulated board's own; the wall clock is only waited for. The force is asserted in virtual
time (`tests/sim/test_scenario.py`): here the wall beats on while the machine stalls.
"""

import os
import signal
import time
from pathlib import Path

import pytest

from host.recordings.recording import RecordingFile
from host.run.demo import DemoSettings
from host.run.wall_clock import Fleet, Operator
from sim.scenario import TARGET_M, ContactJob

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("rig_alone")]

JOB = ContactJob(TARGET_M, force_N=0.15, approach_s=120.0)
PATIENCE_S = 300.0


@pytest.mark.parametrize("victim", ["realtime", "host", "rig"])
def test_killing_a_process_in_contact(victim: str, tmp_path: Path) -> None:
    settings = DemoSettings(board="native", directory=tmp_path, estimator="tests.host.no_estimator:make")
    recording = tmp_path / "kill.mcap"
    with Fleet(settings, recording) as fleet:
        operator = Operator(fleet)
        assert operator.touch(JOB, PATIENCE_S), [operator.mode(), *(fleet.last_log_line(name) for name in fleet.processes)]
        os.kill(fleet.processes[victim].pid, signal.SIGKILL)
        fleet.processes[victim].wait()
        time.sleep(1.0)
        others = set(fleet.processes) - {victim}
        assert fleet.dead() == [victim], f"{others} must live on"
        operator.session.close()
    if victim == "realtime":
        summary = fleet.rig_summary
        assert summary["last_edge_s"] - summary["last_byte_s"] <= 0.100
    read = RecordingFile(recording)
    assert read.topics["state"] > 0 and len(read.table("pose/tip")["x_m"]) > 0
