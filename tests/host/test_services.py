"""Services: unit files that systemd finds good and tight, put in and taken away; a supervisor with the same contract."""

import os
import shutil
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from host.cli.install_services import install_services
from host.run import installation_check
from host.run.installation_check import writable_by_others
from host.run.service_units import UnitSettings, install, undo, unit_texts
from protocol.errors import InputError
from protocol.rig_file import load_rig, parse_rig, read_rig_data
from tests.host.supervisor import ServiceSettings, Supervisor
from tests.realtime.conftest import RIG_FILE
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.usefixtures("rig_alone")

MOST_EXPOSED = 2.0


def files(root: Path) -> list[Path]:
    return sorted(path for path in root.rglob("*") if path.is_file())


@pytest.fixture
def units(tmp_path: Path) -> list[Path]:
    install_services(rig=RIG_FILE, simulated=True, cpu=-1, root=tmp_path, take_away=False)
    return [path for path in files(tmp_path) if path.suffix == ".service"]


def systemd_analyze(*arguments: str) -> subprocess.CompletedProcess[str]:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not here (Debian: systemd)")
    return subprocess.run(["systemd-analyze", "--no-pager", *arguments], capture_output=True, text=True, check=False)


def test_systemd_finds_nothing_wrong_with_the_units(units: list[Path]) -> None:
    result = systemd_analyze("verify", "--man=no", *map(str, units))
    assert result.returncode == 0 and not [line for line in result.stderr.splitlines() if "seldinger" in line]


def test_the_units_are_tight(units: list[Path]) -> None:
    for unit in units:
        threshold = str(round(10 * MOST_EXPOSED))
        result = systemd_analyze("security", "--offline=true", f"--threshold={threshold}", str(unit))
        assert result.returncode == 0, f"{unit.name}: {result.stdout.strip().splitlines()[-1]}"


def test_the_loop_has_priority_watchdog_memory_and_a_processor(units: list[Path]) -> None:
    text = next(unit for unit in units if "realtime" in unit.name).read_text()
    for line in (
        "Type=notify",
        "WatchdogSec=2",
        "CPUSchedulingPolicy=fifo",
        "LimitMEMLOCK=infinity",
        "NoNewPrivileges=yes",
        "User=seldinger",
        f"CPUAffinity={(os.cpu_count() or 1) - 1}",
        "Restart=on-failure",
    ):
        assert line in text.splitlines()
    assert "@" not in "".join(line for line in text.splitlines() if "SystemCallFilter" not in line)


def test_undo_takes_away_what_was_written_and_nothing_else(tmp_path: Path) -> None:
    settings, rig = UnitSettings(RIG_FILE, 0), load_rig(RIG_FILE)
    install(tmp_path, unit_texts(settings, rig))
    stranger = tmp_path / "etc/systemd/system/seldinger-other.service"
    stranger.write_text("[Unit]\n")
    assert len(undo(tmp_path)) == 3
    assert files(tmp_path) == [stranger]
    assert undo(tmp_path) == []


def test_a_file_of_someone_else_is_not_written_over(tmp_path: Path) -> None:
    path = tmp_path / "etc/systemd/system/seldinger-host.service"
    path.parent.mkdir(parents=True)
    path.write_text("mine")
    with pytest.raises(InputError, match="a folder without files of that name"):
        install_services(rig=RIG_FILE, simulated=False, cpu=-1, root=tmp_path, take_away=False)
    assert files(tmp_path) == [path] and path.read_text() == "mine"


def test_what_a_unit_cannot_hold_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="without spaces"):
        unit_texts(UnitSettings(Path("/a rig.toml"), 0), load_rig(RIG_FILE))
    data = read_rig_data(RIG_FILE)
    data["force_sensor"]["address"] = "box.example"
    with pytest.raises(ValueError, match=r"force_sensor\.address"):
        unit_texts(UnitSettings(RIG_FILE, 0), parse_rig(data))
    with pytest.raises(InputError, match="--cpu"):
        install_services(rig=RIG_FILE, simulated=False, cpu=4096, root=tmp_path, take_away=False)


SERVICE = """
import sys, time
from realtime.loop.service_notify import ServiceNotifier
manager = ServiceNotifier()
manager.ready("disarmed")
beat = 0
while True:
    time.sleep(0.02)
    beat += 0 if {hangs} else 1
    manager.beat(beat)
"""


def killed(supervisor: Supervisor) -> None:
    """SIGKILL for the service, and only for it."""
    assert supervisor.pid > 0
    os.kill(supervisor.pid, signal.SIGKILL)


def service(hangs: bool) -> list[str]:
    return [sys.executable, "-c", textwrap.dedent(SERVICE.format(hangs=hangs))]


def test_a_service_whose_heart_stands_still_is_ended_and_started_anew_then_given_up() -> None:
    with Supervisor(ServiceSettings(service(hangs=True), watchdog_s=0.4, restart_s=0.05, burst=2)) as supervisor:
        assert supervisor.run_until(lambda: supervisor.failed, PATIENCE_S)
        assert supervisor.history == ["started", "ready", "watchdog", "started", "ready", "watchdog", "given up"]


def test_a_killed_service_starts_anew_and_a_stopped_one_does_not() -> None:
    with Supervisor(ServiceSettings(service(hangs=False), watchdog_s=30.0, restart_s=0.05, stop_s=PATIENCE_S)) as supervisor:
        assert supervisor.run_until(lambda: supervisor.ready, PATIENCE_S)
        killed(supervisor)
        assert supervisor.run_until(lambda: supervisor.starts == 2 and supervisor.ready, PATIENCE_S)
        assert supervisor.status == "disarmed"
        assert supervisor.stop() == -signal.SIGTERM
        assert "watchdog" not in supervisor.history


@pytest.mark.slow
def test_the_simulated_rig_and_the_control_loop_run_as_services_and_come_back_disarmed(tmp_path: Path) -> None:
    ports = tmp_path / "ports.env"
    rig = ["-m", "sim.rig_server", "--rig", str(RIG_FILE), "--board", "native", "--ports-file", str(ports)]
    with Supervisor(ServiceSettings([sys.executable, *rig], watchdog_s=60.0, stop_s=PATIENCE_S)) as world:
        assert world.run_until(lambda: world.ready and ports.exists(), PATIENCE_S)
        named = dict(line.split("=", 1) for line in ports.read_text().splitlines())
        loop = [
            "-m",
            "realtime",
            "--rig",
            str(RIG_FILE),
            "--board-port",
            named["BOARD_PORT"],
            "--tracker-port",
            named["TRACKER_PORT"],
            "--force-port",
            named["FORCE_PORT"],
        ]
        settings = ServiceSettings([sys.executable, *loop], watchdog_s=60.0, restart_s=0.05, stop_s=PATIENCE_S)
        with Supervisor(settings) as control:
            assert control.run_until(lambda: control.ready, PATIENCE_S)
            killed(control)
            assert control.run_until(lambda: control.starts == 2 and control.ready, PATIENCE_S)
            assert control.status.startswith("disarmed")
            assert control.stop() == 0 and control.history[-1] == "stopping"


def test_what_others_can_write_is_not_installed(tmp_path: Path) -> None:
    user = os.geteuid()
    mine = tmp_path / "rig.toml"
    mine.write_text("")
    mine.chmod(0o644)
    assert writable_by_others(mine, {user}) == ""
    assert "belongs to user" in writable_by_others(mine, {user + 1})
    mine.chmod(0o646)
    assert "every user" in writable_by_others(mine, {user})
    folder = tmp_path / "open"
    folder.mkdir()
    folder.chmod(0o777)
    assert "every user" in writable_by_others(folder, {user})
    folder.chmod(0o1777)
    assert writable_by_others(folder, {user}) == "", "the sticky bit keeps others from replacing files"


@pytest.mark.parametrize("weak", ["interpreter", "checkout", "--rig"])
def test_the_refusal_names_what_is_weak_and_the_command_that_corrects_it(
    weak: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(installation_check, "_user_ids", lambda name: [os.geteuid()])
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "interpreter"))
    paths = {name: tmp_path / name / "file" for name in ("interpreter", "checkout", "--rig")}
    for path in paths.values():
        path.parent.mkdir()
        path.write_text("")
    installation_check.check_installation(*paths.values())
    paths[weak].parent.chmod(0o777)
    with pytest.raises(InputError, match="every user can write") as refused:
        installation_check.check_installation(*paths.values())
    assert refused.value.key == weak and "chmod -R go-w" in str(refused.value)


def test_a_module_in_the_checkout_that_others_can_write_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(installation_check, "_user_ids", lambda name: [os.geteuid()])
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    module = tmp_path / "host" / "run" / "module.py"
    module.parent.mkdir(parents=True)
    module.write_text("")
    installation_check.check_installation(tmp_path / "python", tmp_path, tmp_path / "rig.toml")
    module.chmod(0o666)
    with pytest.raises(InputError, match=r"module\.py"):
        installation_check.check_installation(tmp_path / "python", tmp_path, tmp_path / "rig.toml")
