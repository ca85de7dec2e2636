"""`seldinger`: find the command's file and run it. Only the file of the command that is called gets imported."""

from __future__ import annotations

import difflib
import errno
import importlib
import io
import os
import re
import signal
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any, TextIO

import typer

from host.cli.extras import missing_extra
from protocol import compile_notice
from protocol.errors import Description, InputError, any_of
from protocol.usual_values import UnusualValue

# command -> (module, function, one line for the overview)
COMMANDS: dict[str, tuple[str, str, str]] = {
    "demo": ("host.cli.demo", "demo", "Hold a contact force on the beating wall of the simulated rig."),
    "solve": ("host.cli.solve", "solve", "Compute the shape of a catheter under a tip force, from a JSON request."),
    "estimate": ("host.cli.estimate", "estimate", "Estimate the tip force from measured poses, from a JSON request."),
    "calibrate": ("host.cli.calibrate", "calibrate", "Identify a catheter's stiffness from shapes under known loads."),
    "bench": (
        "host.cli.bench",
        "bench",
        "Measure computing times and errors, each next to a reference method in the same run.",
    ),
    "diagnose": (
        "host.cli.diagnose",
        "diagnose",
        "Find where recordings and simulation disagree, and which physics is missing.",
    ),
    "experiment": ("host.cli.experiment", "experiment", "Check the script of a diagnosis, or run it on the rig."),
    "prove": ("host.cli.prove", "prove", "Test the mismatch finder on concealed cases and print its scores."),
    "reproduce": ("host.cli.reproduce", "reproduce", "Reproduce the thesis' figures: mechanics or control."),
    "characterize": ("host.cli.characterize", "characterize", "Measure a rig's backlash, slopes and dead zones by sweeps."),
    "tune": ("host.cli.tune", "tune", "Tune the force controller's gains on the simulated rig."),
    "control-study": (
        "host.cli.control_study",
        "control_study",
        "Measure the errors of the controllers on the simulated rig.",
    ),
    "plan": ("host.cli.plan", "plan", "Plan a path of the tip past obstacles, from a JSON request."),
    "faults": ("host.cli.faults", "faults", "Inject faults in every phase on the simulated rig; report their detection."),
    "run": ("host.cli.run", "run", "Run a protocol (a scripted experiment) and write a report."),
    "bridge": ("host.cli.bridge", "bridge", "Send the running rig's poses and forces over OpenIGTLink or ROS 2."),
    "rig": ("host.cli.rig", "rig", "Check a rig file; show the effective configuration."),
    "stop": ("host.cli.stop", "stop", "Stop the rig over every path and report whether its state confirms the stop."),
    "check-device": (
        "host.cli.check_device",
        "check_device",
        "Read one device of a rig and report whether it is fit for use.",
    ),
    "status": ("host.cli.drive", "status", "Show the state of a running rig and the first cause of a problem."),
    "arm": ("host.cli.drive", "arm", "Power the stages of the running rig; they hold."),
    "disarm": ("host.cli.drive", "disarm", "Bring the stages to rest and disarm the board."),
    "jog": ("host.cli.drive", "jog", "Move one axis, or the tip along a direction, a short way."),
    "goto": ("host.cli.drive", "goto", "Bring the tip to a point in free space."),
    "touch": ("host.cli.drive", "touch", "Approach the tissue along a normal and hold a force."),
    "force": ("host.cli.drive", "force", "Change the force of the present touch."),
    "hold": ("host.cli.drive", "hold", "Hold the present position; needs no lease."),
    "retract": ("host.cli.drive", "retract", "Withdraw the tip from the tissue, then stop."),
    "clear": ("host.cli.drive", "clear", "Clear latched causes and faults; the rig is disarmed afterwards."),
    "zero": ("host.cli.drive", "zero", "Make the present load of the force sensor its zero."),
    "mark": ("host.cli.drive", "mark", "Write a note with the rig's time into log and recording."),
    "home": ("host.cli.home", "home", "Move an axis to its home switch and set its position."),
    "flash": ("host.cli.flash", "flash", "Write the firmware to the stepper board."),
    "install-services": (
        "host.cli.install_services",
        "install_services",
        "Install the rig's systemd services, or remove them.",
    ),
    "keys": ("host.cli.keys", "keys", "Issue certificates for readers and commanders on other machines."),
    "soak": ("host.cli.soak", "soak", "Run the simulated rig for hours of virtual time; check memory, clocks and steps."),
    "view": ("host.cli.view", "view", "Show the running rig on a page (shape, force, safety) with buttons to drive it."),
    "play": ("host.cli.play", "play", "Show a recording on the page of `view`, with the windows of its diagnosis."),
    "export": ("host.cli.export", "export", "Write a recording's topics as parquet or csv tables."),
    "warm": ("host.cli.warm", "warm", "Compile every kernel that a command needs, on all cores."),
    "latency-check": (
        "host.cli.latency_check",
        "latency_check",
        "Measure the lateness of the control loop on this machine.",
    ),
}

# Commands whose arguments may begin with a minus, such as -2mm.
NEGATIVE_VALUES = ("jog", "goto", "touch", "force")

# What typer raises for an option or argument that a command does not take; its click is a copy of its own, or the package.
Refused = next(kind for kind in typer.BadParameter.__mro__ if kind.__name__ == "ClickException")

ENDED = "seldinger: interrupted before the end"
# Exit status after Ctrl-C or SIGTERM.
INTERRUPTED = 130


def build(argv: list[str]) -> typer.Typer:
    """Make the application with the called command in it, or with all their lines when none is named (help)."""
    app = typer.Typer(
        name="seldinger",
        help="Control stack for robotic steerable catheters. Not a medical device.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )
    app.callback()(_options)
    called = next((word for word in argv if not word.startswith("-")), None)
    if called is not None and called not in COMMANDS:
        near = difflib.get_close_matches(called, COMMANDS, 1)
        raise InputError(
            "command", called, f"one that exists; did you mean {near[0]}?" if near else f"one of {', '.join(COMMANDS)}"
        )
    if called is None:
        for name, (_, _, line) in COMMANDS.items():
            app.command(name, help=line, short_help=line)(_only_listed)
        return app
    module, function, line = COMMANDS[called]
    target = getattr(importlib.import_module(module), function)
    if isinstance(target, typer.Typer):
        app.add_typer(target, name=called, help=line)
    else:
        values = {"ignore_unknown_options": True} if called in NEGATIVE_VALUES else None
        app.command(called, help=line, context_settings=values)(target)
    return app


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"seldinger {version('seldinger')}")
        raise typer.Exit()


def _options(
    version: bool = typer.Option(False, "--version", callback=_print_version, is_eager=True, help="Print the version."),
) -> None:
    """Options that stand before the command."""


def _only_listed() -> None:
    """Represent every command when none is called, so that the overview imports nothing."""


def error_log() -> Path:
    """Return the file that keeps the traceback of the last unexpected error: below XDG_STATE_HOME, or ~/.local/state."""
    chosen = os.environ.get("XDG_STATE_HOME")
    return (Path(chosen) if chosen else Path.home() / ".local" / "state") / "seldinger" / "last_error.log"


def _keep_traceback(error: Exception, argv: list[str]) -> str:
    """Write the traceback of `error` into the log; return the end of the sentence that says where it is."""
    import traceback

    text = "".join(traceback.format_exception(error))
    path = error_log()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"seldinger {' '.join(argv)}\n\n{text}", encoding="utf-8")
    except OSError as failed:
        sys.stderr.write(text)
        return f"the traceback is above; {path} could not be written ({failed.strerror})"
    return f"the traceback is in {path}"


def _report(error: Exception, argv: list[str]) -> int:
    """Print one line about `error`. Return the exit status: 2 for bad input, 1 for anything else."""
    if isinstance(error, InputError):
        print(f"seldinger: {_one_line(str(error))}", file=sys.stderr)
        return 2
    if isinstance(error, Refused):
        print(f"seldinger: {_one_line(_refusal(error))}", file=sys.stderr)
        return 2
    failure = getattr(getattr(getattr(sys.stdout, "buffer", None), "raw", None), "failure", "")
    if failure:
        print(f"seldinger: standard output: found {failure}, wanted a place that can be written", file=sys.stderr)
        return 1
    command = " ".join(["seldinger", *(word for word in argv[:1] if not word.startswith("-"))])
    missing = missing_extra(error, command) if isinstance(error, ModuleNotFoundError) else None
    if missing is not None:
        print(f"seldinger: {missing}", file=sys.stderr)
        return 1
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EROFS):
        where = f"{error.filename}: " if error.filename else ""
        print(f"seldinger: {where}{error.strerror}; free some space, or choose another folder", file=sys.stderr)
        return 1
    said = str(error).strip().partition("\n")[0]
    what = f"{type(error).__name__}: {said}" if said else type(error).__name__
    print(f"seldinger: unexpected error, {what}; {_keep_traceback(error, argv)}", file=sys.stderr)
    return 1


def _refusal(error: Exception) -> str:
    """What is wrong with the words of the command line: typer's sentence, or for a group of commands which ones it has."""
    context = getattr(error, "ctx", None)
    group = getattr(getattr(context, "command", None), "commands", None)
    said = str(error.format_message())  # type: ignore[attr-defined]
    found = re.match(r"No such command '(.*)'", said)
    if group is None or not (found or said.startswith("Usage")):
        return said
    name = str(context.info_name)  # type: ignore[union-attr]
    what = Description("nothing") if found is None else found[1]
    return str(InputError(name, what, any_of(group)))


class _Standard(io.RawIOBase):
    """Standard output or error.

    A failure of standard output is kept, so that it is reported as what it is. One of standard error is not raised: a log on
    a full disk must not end a command that moves a rig. A reader that has gone (BrokenPipeError) ends a command in both.
    """

    def __init__(self, number: int) -> None:
        self.number, self.failure = number, ""

    def writable(self) -> bool:
        return True

    def fileno(self) -> int:
        return self.number

    def isatty(self) -> bool:
        return os.isatty(self.number)

    def write(self, content: Any) -> int:
        try:
            return os.write(self.number, content)
        except BrokenPipeError:
            raise
        except OSError as error:
            if self.number == 2 or self.failure:
                return len(content)
            self.failure = error.strerror or str(error)
            raise


def _open_standard_streams() -> None:
    """Give the streams that the caller has closed a place, so that no recording or socket gets their number."""
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest number that is free, which is this one
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, mode, encoding="utf-8", errors="backslashreplace", closefd=False))
    for number, stream, original in ((1, sys.stdout, sys.__stdout__), (2, sys.stderr, sys.__stderr__)):
        if original is not None and stream is original:  # not where a test has put another in its place
            name = "stdout" if number == 1 else "stderr"
            stream.flush()
            text = io.TextIOWrapper(
                io.BufferedWriter(_Standard(number)),
                stream.encoding,
                stream.errors,
                line_buffering=number == 2 or os.isatty(1),
            )
            setattr(sys, name, text)


_python_shows = warnings.showwarning


def _show_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    """Print an unusual value of a rig or catheter file as one line; other warnings as Python does."""
    if issubclass(category, UnusualValue):
        print(f"seldinger: warning: {_one_line(str(message))}", file=sys.stderr)
    else:
        _python_shows(message, category, filename, lineno, file, line)


def _one_line(text: str) -> str:
    """Return `text` on one line, without the characters that would steer a terminal."""
    return "".join(c if c.isprintable() else f"\\x{ord(c):02x}" for c in " ".join(text.split()))


def _run(argv: list[str]) -> int:
    """Run the command that `argv` names. Returns its exit status."""
    program = typer.main.get_command(build(argv))
    _refuse_unknown_options(program, argv)
    try:
        status = int(program.main(argv, "seldinger", standalone_mode=False) or 0)
    except typer.Abort:  # "no" to a question, or Ctrl-C at one
        print(ENDED, file=sys.stderr)
        return 1
    if status == INTERRUPTED:  # typer makes it of the KeyboardInterrupt that leaves a command
        print(ENDED, file=sys.stderr)
    return status


def _refuse_unknown_options(program: Any, argv: list[str]) -> None:
    """Refuse an option that a command of NEGATIVE_VALUES does not have: its parser takes it for a value.

    Raises InputError with the option that was probably meant.
    """
    called = next((word for word in argv if not word.startswith("-")), "")
    if called not in NEGATIVE_VALUES:
        return
    known = [name for option in program.commands[called].params for name in option.opts if name.startswith("--")]
    words = argv[: argv.index("--")] if "--" in argv else argv
    for word in (word.partition("=")[0] for word in words if word.startswith("--")):
        if word not in (*known, "--help"):
            near = difflib.get_close_matches(word, known, 1)
            raise InputError(called, word, f"an option; did you mean {near[0]}?" if near else f"one of {', '.join(known)}")


class _Interrupted:
    """Whether Ctrl-C or SIGTERM has ended the command.

    A KeyboardInterrupt that is raised while compiled code runs or is compiled comes out as SystemError or another exception.
    """

    yes = False


def _interrupt(number: int, frame: FrameType | None) -> None:
    _Interrupted.yes = True
    raise KeyboardInterrupt


def _take_signals(starting: Callable[[int, FrameType | None], object] | None) -> None:
    """Let SIGINT, SIGTERM and SIGHUP interrupt the command, where they still have their usual handlers or `starting`."""
    for number, usual in ((signal.SIGTERM, signal.SIG_DFL), (signal.SIGINT, signal.default_int_handler)):
        now = signal.getsignal(number)
        if now == usual or (starting is not None and now is starting):
            signal.signal(number, _interrupt)
    if signal.getsignal(signal.SIGHUP) is signal.SIG_DFL:  # a closed terminal; `nohup` ignores it
        # As SIGTERM, which a server handles in its own way.
        signal.signal(signal.SIGHUP, lambda number, frame: os.kill(os.getpid(), signal.SIGTERM))


def main(starting: Callable[[int, FrameType | None], object] | None = None) -> None:
    """Run the command line. `starting`: handler of SIGINT and SIGTERM until now, where the caller has set one.

    Exit status: 0 done; 2 bad input, one line on standard error; 130 interrupted; 1 anything else, one line on standard
    error, and the traceback of an unexpected error in a log file. SIGTERM, and the end of its terminal, end a command as
    Ctrl-C does: what it has started is stopped in order.
    """
    argv = sys.argv[1:]
    try:
        _take_signals(starting)
        _open_standard_streams()
        warnings.showwarning = _show_warning
        compile_notice.on_first(lambda: print(compile_notice.WORDS, file=sys.stderr, flush=True))
        status = _run(argv)
        sys.stdout.flush()
        sys.exit(status)
    except SystemExit as ending:
        _leave_stalled_stop(ending)
        raise
    except BrokenPipeError:  # the reader of the output has closed it, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except (Exception, KeyboardInterrupt) as error:
        if _Interrupted.yes or isinstance(error, KeyboardInterrupt):
            print(ENDED, file=sys.stderr)
            sys.exit(INTERRUPTED)
        sys.exit(_report(error, argv))
    finally:
        if signal.getsignal(signal.SIGTERM) is _interrupt:  # a server passes the signal on as it ends: nothing is left to do
            signal.signal(signal.SIGTERM, lambda number, frame: None)


def _leave_stalled_stop(ending: SystemExit) -> None:
    """End the program at once if a stop still waits in zenoh for a stalled process.

    An interpreter that ends below such a thread aborts the program, and its exit status would be lost.
    """
    stop_client = sys.modules.get("protocol.stop_client")
    if stop_client is not None and stop_client.still_asking():
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(ending.code if isinstance(ending.code, int) else 1 if ending.code else 0)


if __name__ == "__main__":
    main()
