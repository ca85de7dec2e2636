"""`seldinger install-services`: the rig's processes as systemd services, and `--undo`."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Annotated

import typer

from host.cli.contract_io import write_json
from host.cli.options import Json, RigFile, within
from protocol.errors import InputError
from protocol.rig_file import SIMULATED_RIG, load_rig

_MANAGER = Path("/run/systemd/system")


def install_services(
    rig: RigFile = SIMULATED_RIG,
    simulated: Annotated[bool, typer.Option("--simulated", help="Install the simulated rig as a service too.")] = False,
    cpu: Annotated[int, typer.Option(help="Processor for the control loop; -1: the last one.")] = -1,
    root: Annotated[
        Path, typer.Option(help="Write the files below this directory and do not call systemd.", hidden=True)
    ] = Path("/"),
    take_away: Annotated[bool, typer.Option("--undo", help="Stop the services and remove what was installed.")] = False,
    json: Json = False,
) -> None:
    """Write unit files and the service user, and reload systemd. Nothing is started; the command for that is printed."""
    from host.run.installation_check import check_installation
    from host.run.service_units import UnitSettings, install, unit_texts

    system = root == Path("/")
    if system and os.geteuid() != 0:
        raise InputError("user", "not root", "root (sudo), or --root DIRECTORY to inspect the files first")
    if take_away:
        removed = _undo(root, system)
        if json:
            write_json({"removed": removed})
        return
    count = os.cpu_count() or 1
    within("--cpu", cpu, -1, count - 1)
    settings = UnitSettings(rig.resolve(), count - 1 if cpu < 0 else cpu, simulated)
    try:
        check_installation(settings.python, Path(__file__).parents[2], rig)
    except InputError as error:
        if system:
            raise
        print(f"seldinger: warning, would be refused without --root: {error}", file=sys.stderr)
    try:
        written = install(root, unit_texts(settings, load_rig(rig)))
    except ValueError as error:
        raise InputError.from_sentence(str(error)) from None
    except FileExistsError as error:
        raise InputError("--root", str(error), "a folder without files of that name") from None
    except (NotADirectoryError, PermissionError) as error:
        raise InputError("--root", str(root), f"a folder that can be written ({error.strerror})") from None
    for path in written:
        print(f"seldinger: wrote {path}", file=sys.stderr)
    if system and _MANAGER.is_dir():
        _call("systemd-sysusers", "seldinger.conf")
        _call("systemctl", "daemon-reload")
    print(f"seldinger: now `systemctl enable --now {' '.join(settings.names)}`; the loop starts disarmed", file=sys.stderr)
    if json:
        write_json({"written": list(written), "services": list(settings.names)})


def _undo(root: Path, system: bool) -> list[str]:
    """Remove what was installed. Returns the paths of the removed files."""
    from host.run.service_units import undo

    managed = system and _MANAGER.is_dir()
    if managed:
        _call("systemctl", "disable", "--now", *(f"seldinger-{name}.service" for name in ("realtime", "host", "rig")))
    removed = undo(root)
    for path in removed:
        print(f"seldinger: removed {path}", file=sys.stderr)
    if managed:
        _call("systemctl", "daemon-reload")
    print(
        "seldinger: recordings in /var/lib/seldinger and the user remain; `userdel seldinger` removes the user"
        if removed
        else "seldinger: nothing was installed here",
        file=sys.stderr,
    )
    return [str(path) for path in removed]


def _call(*command: str) -> None:
    """Run one of systemd's tools; print its error message and continue."""
    if shutil.which(command[0]) is None:
        return
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode:
        print(f"seldinger: {' '.join(command)}: {result.stderr.strip()}", file=sys.stderr)
