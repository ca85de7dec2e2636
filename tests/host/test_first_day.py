"""docs/first-day.md as a stranger reads it: its commands, in order, on a simulated rig that is not told anything else."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pyigtl
import pytest

from host.run.demo import DemoSettings
from host.run.igtl_bridge import IgtlBridge
from host.run.wall_clock import Fleet
from protocol.rig_file import load_rig
from protocol.zenoh_session import Session
from tests.host.test_drive_commands import VirtualRig, rig, virtual  # noqa: F401 - fixtures
from tests.host.test_drive_commands import called as driven
from tests.waiting import free_port, until

pytestmark = pytest.mark.usefixtures("rig_alone")

PATIENCE_S = 300.0
ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "first-day.md").read_text(encoding="utf-8")


def commands() -> list[list[str]]:
    """Words of each `seldinger` line of the page's code, in order, without its comment."""
    lines = re.findall(r"^    (seldinger .*?)(?:\s+#.*)?$", PAGE, re.MULTILINE)
    return [line.split()[1:] for line in lines]


def called(words: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "host.cli.main", *words], capture_output=True, text=True, cwd=ROOT, timeout=1800, check=False
    )


def test_the_page_leads_from_setup_to_a_report() -> None:
    order = [words[0] for words in commands()]
    wanted = ["--version", "rig", "view", "status", "arm", "goto", "jog", "zero", "touch", "disarm", "run", "run", "play"]
    assert [name for name in order if name in wanted][: len(wanted)] == wanted and "make setup" in PAGE
    assert [name for name in order[len(order) - 6 :]] == ["export", "rig", "view", "check-device", "status", "bridge"]


def test_what_needs_no_rig_runs_as_written(tmp_path: Path) -> None:
    for words in commands():
        if (words[0] in ("--version", "rig") and "lab.toml" not in words) or "--dry-run" in words:
            done = called(words, tmp_path)
            assert done.returncode == 0, f"{words}: {done.stderr}"


@pytest.mark.slow
def test_the_rig_is_seen_and_driven_as_written(rig: VirtualRig) -> None:  # noqa: F811
    """Steps 2 and 3: each command as the page has it, on a simulated rig whose time is virtual.

    That `seldinger view --simulated` starts such a rig with its page is tests/host/test_view_commands.py.
    """
    written = commands()
    order = [words[0] for words in written]
    begin, end = order.index("status"), order.index("disarm") + 1
    assert written[begin - 1] == ["view", "--simulated"]
    phases = {"arm": "hold", "goto": "position", "jog": "hold", "zero": "hold", "touch": "stopped", "disarm": "disarmed"}
    assert order[begin:end] == ["status", *phases]
    for words in written[begin:end]:
        done = driven(*words, "--json")
        assert done.exit_code == 0, (words, done.stderr)
        told = json.loads(done.stdout)
        if words[0] == "status":
            assert told["topics"]["state"]["mode"] == "disarmed" and {"pose/tip", "force/sensor", "board"} <= set(
                told["topics"]
            )
            continue
        assert told["accepted"], words
        rig.sleep(0.2)
        assert rig.newest["state"].mode == phases[words[0]], words  # type: ignore[attr-defined]
        if words[0] == "touch":
            assert abs(told["mean_force_N"] - 0.2) < 0.05


@pytest.mark.slow
def test_the_line_of_six_touches_ends_with_a_report(tmp_path: Path) -> None:
    (words,) = [words for words in commands() if words[0] == "run" and "--simulated" in words]
    at = words.index("--out")
    words = [*words[:at], "--out", str(tmp_path), *words[at + 2 :], "--board", "native", "--json"]
    done = called(words, tmp_path)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["summary"]["done"] and result["summary"]["touches"] == 6
    assert Path(result["recording"]).exists() and "mean force" in Path(result["report"]).read_text(encoding="utf-8")
    assert done.stderr.count("touch ") >= 6


def lab_toml(folder: Path) -> Path:
    """The rig file that the page's `sed` line makes, with a free port in place of the page's."""
    (script,) = re.findall(r"^    sed '(.*?)' protocol/rigs/simulated.toml > lab.toml$", PAGE, re.MULTILINE)
    made = subprocess.run(
        ["sed", script, "protocol/rigs/simulated.toml"], capture_output=True, text=True, check=True, cwd=ROOT
    ).stdout
    assert made.count("18944") == 1 and 'kind = "openigtlink"' in made
    path = folder / "lab.toml"
    path.write_text(made.replace("18944", str(free_port())).replace('folder = ""', f'folder = "{folder}"'), encoding="utf-8")
    return path


def test_the_swapped_tracker_is_read_over_openigtlink(tmp_path: Path) -> None:
    """The simulated tracker as a server, and the page's commands that check it; no verdict here depends on a rate."""
    lab = lab_toml(tmp_path)
    assert called(["rig", "check", str(lab), "--quiet"], tmp_path).returncode == 0
    missing = called(["check-device", "tracker", "--rig", str(lab), "--seconds", "0.2"], tmp_path)
    assert missing.returncode == 1 and "no server at" in missing.stderr
    command = [sys.executable, "-m", "sim.rig_server", "--rig", str(lab), "--board", "native"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, cwd=ROOT) as server:
        try:
            assert server.stdout is not None
            ports = json.loads(server.stdout.readline())
            assert ports["tracker"] == load_rig(lab).tracker.port
            done = called(["check-device", "tracker", "--rig", str(lab), "--seconds", "1", "--json"], tmp_path)
        finally:
            server.terminate()
    report = json.loads(done.stdout)
    assert report["device"] == "openigtlink", done.stderr
    assert {"0A.rate_hz", "0B.rate_hz"} <= set(report["figures"]), done.stderr


@pytest.mark.slow
def test_the_loop_runs_on_the_swapped_tracker_and_slicer_sees_it(tmp_path: Path) -> None:
    """A whole rig on the wall clock: poses come in over OpenIGTLink, and go out over the bridge to pyigtl's client."""
    lab = lab_toml(tmp_path)
    with Fleet(DemoSettings(rig_file=lab, board="native"), tmp_path / "swap.mcap") as fleet:
        fleet.wait_for_state(PATIENCE_S)
        live = load_rig(fleet.rig_file)
        with Session.of_rig(live) as session:
            bridge = IgtlBridge(session, ("127.0.0.1", 0))
            client = pyigtl.OpenIGTLinkClient(*bridge.server.address)
            names: set[str] = set()

            def served() -> bool:
                bridge.step()
                names.update(message.device_name for message in client.get_latest_messages())
                return {"TipToBase", "ShaftToBase", "ForceSensorText", "Status"} <= names

            try:
                assert until(served, "", PATIENCE_S), names
            finally:
                client.stop()
                bridge.close()
