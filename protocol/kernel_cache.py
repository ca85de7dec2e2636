"""Where compiled kernels are kept: a folder for each state of the sources, since numba does not see a callee's edits."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

_ROOMS = ("protocol", "realtime", "sim", "host")
_KEPT_STATES = 12
_IMPORT = re.compile(r"^\s*(?:from\s+([\w.]+)\s+import\s+(\([^)]*\)|[\w, ]*)|import\s+([\w.]+))", re.MULTILINE)


def sources_state(root: Path) -> str:
    """A short hash of the sources below `root` that a kernel can depend on: files with kernels, and all that they import."""
    texts = {path: path.read_bytes() for room in _ROOMS for path in (root / room).rglob("*.py")}
    wanted = {path for path, text in texts.items() if b"njit" in text}
    new = set(wanted)
    while new:
        new = {found for path in new for found in _imported(root, texts[path].decode()) if found in texts} - wanted
        wanted |= new
    digest = hashlib.sha256(str(root).encode())
    for path in sorted(wanted):
        digest.update(f"{path.relative_to(root)} {len(texts[path])}\n".encode() + texts[path])
    return digest.hexdigest()[:16]


def _imported(root: Path, text: str) -> Iterator[Path]:
    """Files that the imports of a source could mean."""
    for match in _IMPORT.finditer(text):
        module, names, plain = match.groups()
        folder = root.joinpath(*(module or plain).split("."))
        yield folder.with_suffix(".py")
        for name in re.findall(r"\w+", names or ""):
            yield folder / f"{name}.py"


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
