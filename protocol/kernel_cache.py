"""Where compiled kernels are kept: a folder for each state of the sources, since numba does not see a callee's edits."""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
import tempfile
from pathlib import Path

_ROOMS = ("protocol", "realtime", "sim", "host")
_KEPT_STATES = 6


def sources_state(root: Path) -> str:
    """A short hash of name, size and time of change of every Python file in the rooms below `root`."""
    digest = hashlib.sha256(str(root).encode())
    for room in _ROOMS:
        for path in sorted((root / room).rglob("*.py")):
            status = path.stat()
            digest.update(f"{path.relative_to(root)} {status.st_size} {status.st_mtime_ns}\n".encode())
    return digest.hexdigest()[:16]


def _base() -> Path:
    chosen = os.environ.get("XDG_CACHE_HOME")
    base = Path(chosen) if chosen else Path(os.path.expanduser("~")) / ".cache"
    try:
        (base / "seldinger").mkdir(parents=True, exist_ok=True)
    except OSError:
        base = Path(tempfile.gettempdir()) / f"seldinger-cache-{os.getuid()}"
    return base / "seldinger" / "kernels"


def choose() -> None:
    """Point numba at the folder of the present sources, unless NUMBA_CACHE_DIR is set. Drops the oldest folders."""
    if "NUMBA_CACHE_DIR" in os.environ:
        return
    base = _base()
    folder = base / sources_state(Path(__file__).resolve().parent.parent)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
        for old in sorted(base.iterdir(), key=lambda path: path.stat().st_mtime)[:-_KEPT_STATES]:
            shutil.rmtree(old, ignore_errors=True)
    except OSError:
        return
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    if "numba" in sys.modules:
        sys.modules["numba"].config.CACHE_DIR = str(folder)
