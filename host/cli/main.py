"""`seldinger`: finds the command's file and runs it. Only the file of the command that is called gets imported."""

from __future__ import annotations

import importlib
import signal
import sys
from types import FrameType

import typer

from protocol.errors import InputError

# command -> (module, function, one line for the overview)
COMMANDS: dict[str, tuple[str, str, str]] = {
    "demo": ("host.cli.demo", "demo", "Bring the tip of the simulated rig to a beating wall and hold a force on it."),
    "solve": ("host.cli.solve", "solve", "Shape of a catheter under a force, from a JSON request."),
    "estimate": ("host.cli.estimate", "estimate", "Force at the tip from measured poses, from a JSON request."),
    "calibrate": ("host.cli.calibrate", "calibrate", "Stiffness of a catheter from shapes under known loads."),
    "bench": ("host.cli.bench", "bench", "Times of the kernels, each beside a peer in the same run."),
    "diagnose": ("host.cli.diagnose", "diagnose", "Where recordings and simulation part, and what physics is missing."),
    "experiment": ("host.cli.experiment", "experiment", "The script of a diagnosis on the rig, or checked only."),
    "prove": ("host.cli.prove", "prove", "The finder on concealed cases, scored against sealed labels."),
    "reproduce": ("host.cli.reproduce", "reproduce", "The thesis' figures again: mechanics or control."),
    "characterize": ("host.cli.characterize", "characterize", "Backlash, slopes and dead zones of a rig, by sweeps."),
    "tune": ("host.cli.tune", "tune", "Gains of the force controller on the simulated rig."),
    "control-study": ("host.cli.control_study", "control_study", "The controller's figures, each beside its reference."),
    "plan": ("host.cli.plan", "plan", "A path of the tip past obstacles, from a JSON request."),
    "faults": ("host.cli.faults", "faults", "Faults in every phase on the simulated rig: what is detected, and when."),
    "rig": ("host.cli.rig", "rig", "Check a rig file; show the effective configuration."),
    "check-device": ("host.cli.check_device", "check_device", "Talk to one device of a rig and say what it answers."),
    "home": ("host.cli.home", "home", "Find an axis' home switch; the stage moves."),
    "flash": ("host.cli.flash", "flash", "Write the firmware to the stepper board."),
    "install-services": ("host.cli.install_services", "install_services", "systemd units of the rig, and their undo."),
    "keys": ("host.cli.keys", "keys", "Certificates for readers and commanders on other machines."),
    "soak": ("host.cli.soak", "soak", "Hours of virtual operation: memory, clocks, steps."),
    "view": ("host.cli.view", "view", "The running rig on a page: shape, force, safety; arm, hold, stop."),
    "play": ("host.cli.play", "play", "A recording on the same page, with the windows of its diagnosis."),
    "export": ("host.cli.export", "export", "Tables of a recording as parquet or csv."),
    "latency-check": ("host.cli.latency_check", "latency_check", "How punctual the loop is here, beside cyclictest."),
}


def build(argv: list[str]) -> typer.Typer:
    """The application with the called command in it, or with all their lines when none is named (help)."""
    app = typer.Typer(
        name="seldinger",
        help="Control stack for robotic steerable catheters. Not a medical device.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )
    app.callback()(lambda: None)
    called = next((word for word in argv if not word.startswith("-")), None)
    if called not in COMMANDS:
        for name, (_, _, line) in COMMANDS.items():
            app.command(name, help=line)(_only_listed)
        return app
    module, function, line = COMMANDS[called]
    target = getattr(importlib.import_module(module), function)
    if isinstance(target, typer.Typer):
        app.add_typer(target, name=called, help=line)
    else:
        app.command(called, help=line)(target)
    return app


def _only_listed() -> None:
    """Stands for every command where none is called, so that the overview imports nothing."""


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def main() -> None:
    """Entry point. Exit status: 0 done; 2 bad input, one line on standard error; 1 anything else.

    SIGTERM ends a command as Ctrl-C does: what it has started is stopped in order.
    """
    if signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:
        signal.signal(signal.SIGTERM, _interrupt)
    try:
        build(sys.argv[1:])()
    except InputError as error:
        print(f"seldinger: {error}", file=sys.stderr)
        sys.exit(2)
    finally:
        if signal.getsignal(signal.SIGTERM) is _interrupt:  # a server hands it on as it ends: nothing is left to do
            signal.signal(signal.SIGTERM, lambda number, frame: None)


if __name__ == "__main__":
    main()
