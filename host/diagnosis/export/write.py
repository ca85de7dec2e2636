"""The extended model as a file: a Python module, or the parameters of a simulator.

`export` chooses by the suffix. A module holds the source of every function that the model needs, gathered from the finder
(`sources`), and the fitted numbers; it runs with numpy and scipy alone.
"""

from __future__ import annotations

from pathlib import Path

from host.diagnosis.export.module import module_of
from host.diagnosis.export.parameters import parameters_of
from host.diagnosis.pipeline import Diagnosis
from protocol.errors import InputError

__all__ = ["check_target", "export"]
WRITERS = {".py": module_of, ".json": parameters_of}


def check_target(path: Path) -> None:
    """Raise InputError where `path` has no suffix that can be written, or its folder does not exist."""
    if path.suffix not in WRITERS:
        raise InputError("--export", str(path), "a file ending in " + ", ".join(WRITERS))
    if not path.parent.is_dir():
        raise InputError("--export", str(path), "a file in a folder that exists")


def export(result: Diagnosis, path: Path) -> Path:
    """Write the nominal model with the effects that were found to `path`.

    Parameters:
        result: a diagnosis.
        path: `.py` (a module that runs without the finder) or `.json` (names and values of the simulator's parameters).

    Returns:
        The path.

    Raises:
        InputError: a suffix or a model that cannot be written so; names the effects that stand in the way.
        OSError: the file cannot be written.
    """
    check_target(path)
    path.write_text(WRITERS[path.suffix](result), encoding="utf-8")
    return path
