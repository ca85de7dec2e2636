"""`seldinger view` and `seldinger play` as they are called: what they refuse, and that they serve."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
from pathlib import Path

import httpx
import pytest

from host.recordings.recording import RecordingFile
from host.view.server import ADDRESS
from protocol.rig_file import SIMULATED_RIG
from tests.host.test_foxglove import recording  # noqa: F401 - a fixture
from tests.host.test_view import free_port
from tests.waiting import PATIENCE_S, until

pytestmark = pytest.mark.usefixtures("rig_alone")

ROOT = Path(__file__).parents[2]


def seldinger(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "host.cli.main", *arguments],
        capture_output=True,
        text=True,
        cwd=ROOT,
        timeout=PATIENCE_S,
        check=False,
    )


def serves(*arguments: str, port: int, ends_by: signal.Signals = signal.SIGINT) -> tuple[int, str]:
    """Exit status and standard error of a command that is served from until it is interrupted."""
    child = subprocess.Popen(
        [sys.executable, "-m", "host.cli.main", *arguments, "--port", str(port)],
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        # Tests that run under nohup, or in the background of a shell, ignore these, and a child inherits it.
        preexec_fn=lambda: [signal.signal(number, signal.SIG_DFL) for number in (signal.SIGINT, signal.SIGHUP)],
    )

    def answers() -> bool:
        try:
            assert httpx.get(f"http://{ADDRESS}:{port}/").status_code == 200
        except httpx.TransportError:
            assert child.poll() is None
            return False
        return True

    try:
        until(answers, "the page")
        child.send_signal(ends_by)
        _, words = child.communicate(timeout=PATIENCE_S)
    finally:
        child.kill()
    return child.returncode, words


@pytest.mark.parametrize("ends_by", [signal.SIGINT, signal.SIGHUP], ids=["Ctrl-C", "closed terminal"])
def test_play_serves_a_recording_until_it_is_interrupted(recording: Path, ends_by: signal.Signals) -> None:  # noqa: F811
    port = free_port()
    status, words = serves("play", str(recording), port=port, ends_by=ends_by)
    assert status in (0, 130, 143) and f"http://{ADDRESS}:{port}/" in words and "Traceback" not in words


def children_of(parent: int) -> list[int]:
    return [int(pid) for task in Path(f"/proc/{parent}/task").iterdir() for pid in (task / "children").read_text().split()]


@pytest.mark.slow
def test_sigterm_ends_what_view_has_started(tmp_path: Path) -> None:
    child = subprocess.Popen(
        [sys.executable, "-m", "host.cli.main", "view", "--simulated", "--out", str(tmp_path), "--port", str(free_port())],
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    )
    assert child.stderr is not None
    lines = iter(child.stderr.readline, "")
    assert any("rig simulated: http" in line for line in lines)
    started = children_of(child.pid)
    assert len(started) == 3
    child.send_signal(signal.SIGTERM)
    _, words = child.communicate(timeout=PATIENCE_S)
    (written,) = tmp_path.glob("view-*.mcap")
    assert f"recording: {written}" in words and "Traceback" not in words and not RecordingFile(written).truncated
    assert not [pid for pid in started if Path(f"/proc/{pid}").exists()]


def test_view_serves_before_the_rig_is_there() -> None:
    status, words = serves("view", "--rig", str(SIMULATED_RIG), port=free_port())
    assert status in (0, 130) and "rig simulated" in words and "Traceback" not in words


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("play", "nowhere.mcap"), "nowhere.mcap"),
        (("view", "--rig", "nowhere.toml"), "nowhere.toml"),
    ],
)
def test_what_is_not_there_is_named(arguments: tuple[str, ...], told: str) -> None:
    done = seldinger(*arguments)
    assert done.returncode == 2 and told in done.stderr and done.stderr.count("\n") == 1


def test_a_port_that_is_taken_is_named(recording: Path) -> None:  # noqa: F811
    with socket.socket() as taken:
        taken.bind((ADDRESS, 0))
        taken.listen()
        port = taken.getsockname()[1]
        done = seldinger("play", str(recording), "--port", str(port))
    assert done.returncode == 2 and f"--port: found {port}, wanted a free port" in done.stderr
