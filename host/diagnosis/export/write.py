"""The extended model as a file: a Python module, a simulator's parameters or model file, or a rig file.

`export` chooses by the suffix. A module holds the source of every function that the model needs, gathered from the finder
(`sources`), and the fitted numbers; it runs with numpy and scipy alone.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from host.diagnosis.export.mjcf import mjcf_of
from host.diagnosis.export.module import module_of
from host.diagnosis.export.parameters import parameters_of, ssv_of
from host.diagnosis.export.rig import rig_patch, rig_text
from host.diagnosis.pipeline import Diagnosis
from protocol.errors import Description, InputError

__all__ = ["check_target", "export"]
Content = tuple[str, list[str]]  # text, and sentences about what the format cannot hold


def _rig_file(result: Diagnosis, path: Path) -> Content:
    patch = rig_patch(result)
    return rig_text(patch), patch.left_out


WRITERS: dict[str, Callable[[Diagnosis, Path], Content]] = {
    ".py": lambda result, path: (module_of(result), []),
    ".json": lambda result, path: (parameters_of(result), []),
    ".xml": lambda result, path: (mjcf_of(result, path), []),
    ".ssv": lambda result, path: (ssv_of(result), []),
    ".toml": _rig_file,
}


# Kinds of nominal models that each suffix can hold.
KINDS = {
    ".py": ("transmission", "axis", "callable", "linear"),
    ".json": ("callable", "linear", "mujoco", "fmu"),
    ".xml": ("mujoco",),
    ".ssv": ("fmu",),
    ".toml": ("rig",),
}


def check_target(path: Path, kind: str | None = None) -> None:
    """Raise InputError where `path` has no suffix that can be written (for `kind`), or its folder does not exist."""
    if path.suffix not in WRITERS:
        raise InputError("--export", str(path), "a file ending in " + ", ".join(WRITERS))
    if kind is not None and kind not in KINDS[path.suffix]:
        possible = [suffix for suffix, kinds in KINDS.items() if kind in kinds]
        wanted = "a file ending in " + " or ".join(possible) if possible else f"no --export: kind {kind} has no file"
        raise InputError("--export", Description(f"{path} for a nominal model of kind {kind}"), wanted)
    if not path.parent.is_dir():
        raise InputError("--export", str(path), "a file in a folder that exists")


def export(result: Diagnosis, path: Path) -> list[str]:
    """Write the nominal model with the effects that were found to `path`.

    Parameters:
        result: a diagnosis.
        path: `.py` (a module that runs without the finder), `.json` (names and values of the simulator's parameters),
            `.xml` (MuJoCo's model file with them), `.ssv` (they for tools of FMI) or `.toml` (the file of a recorded rig).

    Returns:
        What the file cannot hold of the model, a sentence each.

    Raises:
        InputError: a suffix or a model that cannot be written so; names the effects that stand in the way.
        OSError: the file cannot be written.
    """
    check_target(path, result.model.inner.kind)
    text, left_out = WRITERS[path.suffix](result, path)
    path.write_text(text, encoding="utf-8")
    return left_out
