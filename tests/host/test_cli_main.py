"""The command line as a whole: what it loads, and what a user reads when a command cannot run."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from host.cli import main as command_line
from host.cli.extras import EXTRAS
from host.cli.options import writable_file, writable_folder
from protocol.errors import InputError

ROOT = Path(__file__).resolve().parents[2]
# What only a command that runs may load: messages, compiler, simulator, and the packages of the extras.
HEAVY = {"zenoh", "numba", "llvmlite", "scipy", "matplotlib", "sim", "mcap", *EXTRAS}


def loaded(program: str) -> set[str]:
    """Top-level modules that are loaded after `program` in a fresh interpreter."""
    script = f"{program}\nimport sys\nprint(*sorted({{name.partition('.')[0] for name in sys.modules}}))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT)
    return set(done.stdout.splitlines()[-1].split())


def seldinger(*arguments: str, state: Path | None = None) -> subprocess.CompletedProcess[str]:
    environment = os.environ | ({} if state is None else {"XDG_STATE_HOME": str(state)})
    command = [sys.executable, "-m", "host.cli.main", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT, env=environment)


def test_help_loads_no_heavy_package() -> None:
    program = "import sys, host.cli.main as m; sys.argv = ['seldinger', '--help']\n"
    program += "try:\n    m.main()\nexcept SystemExit:\n    pass"
    assert not loaded(program) & {*HEAVY, "numpy", "pydantic"}


@pytest.mark.parametrize("module", sorted({module for module, _, _ in command_line.COMMANDS.values()}))
def test_a_commands_file_loads_no_heavy_package_before_it_runs(module: str) -> None:
    assert not loaded(f"import {module}") & HEAVY


def test_help_names_every_command_and_says_what_it_does() -> None:
    text = CliRunner().invoke(command_line.build(["--help"]), ["--help"]).output
    text = " ".join(text.split())  # without the line breaks
    for name, (_, _, line) in command_line.COMMANDS.items():
        assert name in text and line in text


@pytest.mark.parametrize("name", sorted(command_line.COMMANDS))
def test_every_command_has_help(name: str) -> None:
    result = CliRunner().invoke(command_line.build([name]), [name, "--help"])
    assert result.exit_code == 0 and "Usage" in result.output


def test_version() -> None:
    done = seldinger("--version")
    assert done.returncode == 0 and done.stdout.startswith("seldinger 0.")


def test_bad_input_is_one_line_and_status_2(tmp_path: Path) -> None:
    done = seldinger("solve", str(tmp_path / "missing.json"), state=tmp_path)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1 and "missing.json" in done.stderr
    assert not list(tmp_path.rglob("*.log"))


def test_an_unexpected_error_is_one_line_status_1_and_a_traceback_in_the_log(tmp_path: Path) -> None:
    program = (
        "import sys, host.cli.main as m\n"
        "def broken(argv): raise ZeroDivisionError('division by zero')\n"
        "m.build = broken; sys.argv = ['seldinger', 'solve']; m.main()"
    )
    environment = os.environ | {"XDG_STATE_HOME": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT, env=environment)
    log = tmp_path / "seldinger" / "last_error.log"
    assert done.returncode == 1 and len(done.stderr.splitlines()) == 1
    assert "ZeroDivisionError: division by zero" in done.stderr and str(log) in done.stderr
    assert "Traceback" in log.read_text() and log.read_text().startswith("seldinger solve\n")


@pytest.mark.parametrize(("package", "extra"), [("starlette", "view"), ("fcl", "planning"), ("cryptography", "network")])
def test_a_missing_extra_is_named_in_one_line(
    package: str, extra: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def build(argv: list[str]) -> typer.Typer:
        raise ModuleNotFoundError(f"No module named '{package}'", name=package)

    monkeypatch.setattr(command_line, "build", build)
    monkeypatch.setattr(sys, "argv", ["seldinger", "view"])
    with pytest.raises(SystemExit) as ended:
        command_line.main()
    said = capsys.readouterr().err.splitlines()
    assert ended.value.code == 1 and len(said) == 1 and f'pip install "seldinger[{extra}]"' in said[0]


def test_extras_are_those_of_the_package() -> None:
    import tomllib

    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for package, extra in EXTRAS.values():
        assert any(line.startswith(package) for line in declared[extra]), (package, extra)


@pytest.mark.parametrize(
    ("arguments", "key"),
    [
        (("demo", "--seed", "-1"), "--seed"),
        (("faults", "--seed", "-1"), "--seed"),
        (("soak", "--seed", "-1"), "--seed"),
        (("bench", "--seed", "-1"), "--seed"),
        (("prove", "--seed", "-1"), "--seed"),
        (("tune", "--seed", "-1"), "--seed"),
        (("characterize", "--seed", "-1"), "--seed"),
        (("demo", "--hold", "nan"), "--hold"),
        (("demo", "--force", "nan"), "--force"),
        (("demo", "--out", "/dev/null/runs"), "--out"),
        (("demo", "--rig", "/nowhere.toml"), "/nowhere.toml"),
        (("characterize", "--out", "/dev/null/runs"), "--out"),
        (("reproduce", "control", "--out", "/dev/null/runs"), "--out"),
        (("prove", "--out", "/dev/null/runs"), "--out"),
        (("soak", "--docs", "/dev/null/page.md"), "--docs"),
        (("play", "/nowhere.mcap"), "/nowhere.mcap"),
        (("export", "/nowhere.mcap", "--out", "/tmp"), "/nowhere.mcap"),
        (("diagnose", "--nominal", "/nowhere.toml"), "nominal"),
        (("experiment", "/nowhere.toml"), "/nowhere.toml"),
        (("plan", "/nowhere.json"), "/nowhere.json"),
        (("latency-check", "--docs", "page.md"), "--docs"),
    ],
)
def test_bad_options_are_refused_before_any_work(
    arguments: tuple[str, ...], key: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["seldinger", *arguments])
    with pytest.raises(SystemExit) as ended:
        command_line.main()
    said = capsys.readouterr().err.splitlines()
    assert ended.value.code == 2 and len(said) == 1 and key in said[0], said


def test_a_place_for_output_is_tried_and_left_as_it_was(tmp_path: Path) -> None:
    kept = tmp_path / "kept.html"
    kept.write_text("as it was")
    assert writable_file("--report", kept).read_text() == "as it was"
    writable_file("--report", tmp_path / "new.html")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["kept.html"]
    with pytest.raises(InputError, match="--report"):
        writable_file("--report", tmp_path / "no" / "folder.html")
    with pytest.raises(InputError, match="--out"):
        writable_folder("--out", kept)


def shell(line: str) -> subprocess.CompletedProcess[str]:
    """Run the program (`$seldinger`) in a shell, whose redirections are those of a user."""
    environment = os.environ | {"seldinger": f"{sys.executable} -m host.cli.main"}
    return subprocess.run(["sh", "-c", line], capture_output=True, text=True, check=False, cwd=ROOT, env=environment)


def test_a_full_disk_below_standard_output_is_one_line() -> None:
    done = shell("$seldinger rig check protocol/rigs/simulated.toml --json > /dev/full")
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith("seldinger: standard output: found No space left on device"), done.stderr


@pytest.mark.parametrize("closed", [">&-", "<&- >&- 2>&-", "2> /dev/full"])
def test_streams_that_are_closed_or_full_do_not_end_a_command(closed: str) -> None:
    good = shell(f"$seldinger rig check protocol/rigs/simulated.toml {closed}")
    assert good.returncode == 0, good.stderr
    bad = shell(f"$seldinger rig check missing.toml {closed}")
    assert bad.returncode == 2 and "Traceback" not in bad.stderr


def test_an_interrupt_that_compiled_code_turns_into_another_error_is_an_interrupt(monkeypatch: pytest.MonkeyPatch) -> None:
    """Numba raises SystemError where KeyboardInterrupt came up in its callbacks."""

    def interrupted(argv: list[str]) -> int:
        with pytest.raises(KeyboardInterrupt):
            command_line._interrupt(2, None)
        raise SystemError("CPUDispatcher returned a result with an exception set")

    monkeypatch.setattr(command_line._Interrupted, "yes", False)
    monkeypatch.setattr(command_line, "_run", interrupted)
    monkeypatch.setattr(command_line, "_report", lambda error, argv: pytest.fail(f"reported as {error!r}"))
    with pytest.raises(SystemExit) as ended:
        command_line.main()
    assert ended.value.code == 130


START = """
import os, signal, sys

class Signals:
    def find_spec(self, name, *rest):
        if name == "typer":
            os.kill(os.getpid(), number)

number = int(sys.argv.pop())
sys.meta_path.insert(0, Signals())
"""


def started(script: str, number: signal.Signals, *words: str) -> subprocess.CompletedProcess[str]:
    """A start of the command; a job in the background of a shell would inherit that SIGINT is ignored."""
    command = [sys.executable, "-c", script, *words, str(int(number))]
    return subprocess.run(
        command,
        capture_output=True,
        text=True,
        check=False,
        cwd=ROOT,
        preexec_fn=lambda: signal.signal(number, signal.SIG_DFL),
    )


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_during_the_imports_ends_the_command_without_a_word(number: signal.Signals) -> None:
    done = started(f"{START}\nimport seldinger_start\nseldinger_start.main()", number, "--version")
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_that_is_ignored_stays_ignored_during_the_imports(number: signal.Signals) -> None:
    ignored = "signal.signal(number, signal.SIG_IGN)"
    done = started(f"{START}\n{ignored}\nimport seldinger_start\nseldinger_start.main()", number, "--version")
    assert done.returncode == 0 and done.stdout.startswith("seldinger 0.") and done.stderr == ""


INTERRUPTED = """
import os, signal, sys, seldinger_start, host.cli.drive, host.cli.main
signal.signal(signal.SIGINT, signal.default_int_handler)
number = int(sys.argv.pop())

def interrupted(*words, **options):
    os.kill(os.getpid(), number)

host.cli.drive.driving = interrupted
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("entry", ["host.cli.main.main", "seldinger_start.main"])
def test_an_interrupted_command_says_so(entry: str, number: signal.Signals) -> None:
    """Typer turns the KeyboardInterrupt of a command into its exit status, without a word."""
    done = started(f"{INTERRUPTED}\n{entry}()", number, "mark", "a note")
    assert done.returncode == 130 and done.stderr == f"{command_line.ENDED}\n"


def test_the_command_starts_in_a_module_that_loads_nothing() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert project["project"]["scripts"] == {"seldinger": "seldinger_start:main"}
    assert loaded("import seldinger_start") - loaded("pass") == {"seldinger_start"}


def test_a_full_disk_below_a_result_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert command_line._report(OSError(errno.ENOSPC, "No space left on device", "runs/result.json"), ["run"]) == 1
    assert capsys.readouterr().err == (
        "seldinger: runs/result.json: No space left on device; free some space, or choose another folder\n"
    )
