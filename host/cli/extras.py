"""Optional packages: the extra that installs each, and the line that a command prints where one is missing."""

from __future__ import annotations

# importable name -> (package, extra), as pyproject.toml declares them
EXTRAS: dict[str, tuple[str, str]] = {
    "trimesh": ("trimesh", "planning"),
    "fcl": ("python-fcl", "planning"),
    "toppra": ("toppra", "planning"),
    "pyoperon": ("pyoperon", "symbolic"),
    "cryptography": ("cryptography", "network"),
    "starlette": ("starlette", "view"),
    "uvicorn": ("uvicorn", "view"),
    "websockets": ("websockets", "view"),
    "pyarrow": ("pyarrow", "tables"),
    "pandas": ("pandas", "tables"),
    "distributed": ("distributed", "cluster"),
    "mujoco": ("mujoco", "mujoco"),
    "fmpy": ("fmpy", "fmu"),
    "pysindy": ("pysindy", "baselines"),
    "nidaqmx": ("nidaqmx", "daq"),
    "pyigtl": ("pyigtl", "guidance"),
    "rosbags": ("rosbags", "guidance"),
}


def missing_extra(error: ModuleNotFoundError, command: str) -> str | None:
    """Say which extra `command` needs.

    Returns:
        One sentence with the command that installs it; None where the missing module belongs to no extra.
    """
    name = (error.name or "").partition(".")[0]
    if name not in EXTRAS:
        return None
    package, extra = EXTRAS[name]
    return f'{command} needs the package {package}, which is not installed. Run: pip install "seldinger[{extra}]"'
