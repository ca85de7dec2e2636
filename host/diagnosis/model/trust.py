"""Code that a nominal TOML runs: which file it is in, and whether only its owner could have written it."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from host.diagnosis.model.nominal import NominalSpec
from protocol.errors import Description, InputError


def code_of(spec: NominalSpec) -> str:
    """Return a description of the code that `spec` runs, for a warning; empty if it runs no code."""
    path = code_path(spec)
    if spec.callable is not None and isinstance(spec.callable.function, str):
        return f"the Python function {spec.callable.function} ({path or 'an installed module'})"
    return f"the code of {path}" if path is not None else ""


def code_path(spec: NominalSpec) -> Path | None:
    """File of the code that `spec` runs; None for an installed module, or without code."""
    if spec.callable is not None and isinstance(spec.callable.function, str):
        path = Path(spec.folder, *spec.callable.function.partition(":")[0].split(".")).with_suffix(".py")
        return path if path.is_file() else None
    if spec.fmu is not None:
        return Path(spec.folder, spec.fmu.model)
    return None


def check_owner(*paths: Path) -> None:
    """Refuse code that another user could have written.

    Raises:
        InputError: a file that belongs to another user (root apart), that others may write, or that lies in a folder
            in which others may replace it.
    """
    for path in paths:
        if not path.exists():
            continue
        status, folder = path.stat(), path.resolve().parent.stat()
        wanted = f"a file that only you may write (chown, chmod o-w), or --trust once you have read {path.name}"
        if hasattr(os, "getuid") and status.st_uid not in (os.getuid(), 0):
            raise InputError(
                "--nominal", Description(f"{path} runs code and belongs to another user (uid {status.st_uid})"), wanted
            )
        if status.st_mode & stat.S_IWOTH:
            raise InputError("--nominal", Description(f"{path} runs code and may be written by every user"), wanted)
        if folder.st_mode & stat.S_IWOTH and not folder.st_mode & stat.S_ISVTX:
            raise InputError(
                "--nominal", Description(f"{path} runs code and lies in a folder that every user may write"), wanted
            )
