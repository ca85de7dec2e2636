"""Who else could change what the services run: interpreter, packages, checkout and rig file, checked at the installation."""

from __future__ import annotations

import os
import pwd
import stat
import sys
from collections.abc import Collection, Iterator
from pathlib import Path

from protocol.errors import Description, InputError

SERVICE_USER = "seldinger"
PACKAGES = ("host", "protocol", "realtime", "sim", "seldinger", "firmware")


def check_installation(python: Path, checkout: Path, rig_file: Path) -> None:
    """Raise InputError if others than root and the service's user can write the interpreter, its packages, code or rig file.

    A user who can write one of them, or a folder above, can let the services do anything to the rig.
    """
    trusted = {0, *_user_ids(SERVICE_USER)}
    subjects = {
        "interpreter": (python, [Path(sys.prefix), python.resolve().parent.parent / "lib"]),
        "checkout": (checkout, [checkout / name for name in PACKAGES]),
        "--rig": (rig_file, []),
    }
    for key, (subject, folders) in subjects.items():
        for path in _paths(subject, folders):
            problem = writable_by_others(path, trusted)
            if problem:
                raise InputError(
                    key,
                    Description(f"{path}, {problem}"),
                    f"one that only root and {SERVICE_USER} can write: copy it to a folder of root's, as /opt/seldinger, or "
                    f"`sudo chown -R root: {path} && sudo chmod -R go-w {path}`",
                )


def writable_by_others(path: Path, trusted: Collection[int]) -> str:
    """Return the reason why users other than `trusted` (ids) can write `path`; empty if they cannot.

    A folder with the sticky bit, as /tmp, lets others add files but not replace those of another user.
    """
    try:
        found = path.lstat()
    except OSError:
        return ""
    if found.st_uid not in trusted:
        return f"which belongs to user {_name(found.st_uid)}"
    if stat.S_ISLNK(found.st_mode) or (stat.S_ISDIR(found.st_mode) and found.st_mode & stat.S_ISVTX):
        return ""
    if found.st_mode & stat.S_IWOTH:
        return "which every user can write"
    if found.st_mode & stat.S_IWGRP and found.st_gid != 0:
        return f"which group {found.st_gid} can write"
    return ""


def _paths(subject: Path, folders: list[Path]) -> Iterator[Path]:
    """Yield `subject`, what it links to, all folders above both, and everything in `folders`."""
    subject = Path(os.path.abspath(subject))
    for path in dict.fromkeys((subject, subject.resolve())):
        yield path
        yield from path.parents
    for folder in folders:
        yield folder
        for here, names, files in os.walk(folder):
            names[:] = [name for name in names if name != "__pycache__"]
            yield from (Path(here) / name for name in (*names, *files))


def _user_ids(name: str) -> list[int]:
    try:
        return [pwd.getpwnam(name).pw_uid]
    except KeyError:  # the user is made by the installation
        return []


def _name(uid: int) -> str:
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)
