"""Where compiled kernels are kept. Numba sees an edit of a kernel's own file only; this cache sees edits of its callees too.

Each module with kernels has a folder named by a hash of its source and of all project sources that it imports. An edit
makes new folders for the modules that depend on it, and for no others. The hash holds no path, so that two checkouts of the
same sources share their kernels.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from functools import cache
from pathlib import Path

PACKAGES = ("protocol", "realtime", "sim", "host", "seldinger")
ROOT = Path(__file__).resolve().parent.parent
# Folders that no process has used for this long are removed when a new one is made.
KEPT_S = 14 * 86400.0
# Numba tries these in order; the first serves the files of this project, the others everything else.
_LOCATORS = (
    "protocol.kernel_locator.KernelLocator",
    "UserProvidedCacheLocator",
    "InTreeCacheLocator",
    "UserWideCacheLocator",
    "IPythonCacheLocator",
    "ZipCacheLocator",
)
_IMPORT = re.compile(r"^\s*(?:from\s+([\w.]+)\s+import\s+(\([^)]*\)|[\w, ]*)|import\s+([\w., ]+))", re.MULTILINE)
_COMMENT = re.compile(r"#.*")


def sources_state(module: Path, root: Path = ROOT) -> str:
    """Hash `module` (a file below `root`) together with all sources below `root` that it imports, directly or not.

    Returns 16 hexadecimal digits.
    """
    texts: dict[Path, bytes] = {}
    waiting = [module]
    while waiting:
        path = waiting.pop()
        if path not in texts:
            texts[path] = path.read_bytes()
            waiting += _imported(root, texts[path].decode())
    digest = hashlib.sha256()
    for path in sorted(texts):
        digest.update(f"{path.relative_to(root)} {len(texts[path])}\n".encode() + texts[path])
    return digest.hexdigest()[:16]


def _imported(root: Path, text: str) -> Iterator[Path]:
    """Files of the project that the imports of a source load, packages without code of their own left out."""
    for match in _IMPORT.finditer(text):
        module, names, modules = match.groups()
        for imported in [module] if module else _imported_names(modules):
            parts = imported.split(".")
            if parts[0] not in PACKAGES:
                continue
            folder = root.joinpath(*parts)
            if folder.with_suffix(".py").is_file():
                yield folder.with_suffix(".py")
                continue
            # "": `import package` runs the package's own code.
            for name in _imported_names(names) if module else [""]:
                inside = folder / f"{name}.py"
                if inside.is_file():
                    yield inside
                elif not (name and (folder / name).is_dir()) and (folder / "__init__.py").is_file():
                    yield folder / "__init__.py"


def _imported_names(text: str) -> list[str]:
    """Names in the list of an import, in parentheses or not, without what `as` calls them."""
    entries = _COMMENT.sub("", text).strip("() \n").split(",")
    return [entry.split()[0] for entry in entries if entry.split()]


def base() -> Path:
    """The folder of all kernels: below $XDG_CACHE_HOME, ~/.cache, or where neither can be written, the temporary folder."""
    chosen = os.environ.get("XDG_CACHE_HOME")
    parent = Path(chosen) if chosen else Path(os.path.expanduser("~")) / ".cache"
    try:
        (parent / "seldinger").mkdir(parents=True, exist_ok=True)
    except OSError:
        parent = Path(tempfile.gettempdir()) / f"seldinger-cache-{os.getuid()}"
    return parent / "seldinger" / "kernels"


@cache
def folder_of(module: Path) -> Path:
    """The folder of the kernels of `module`, a file of this project; made if needed. Raises OSError."""
    name = ".".join(module.relative_to(ROOT).with_suffix("").parts)
    folder = base() / f"{name}-{sources_state(module)}"
    if folder.is_dir():
        os.utime(folder)
    else:
        _remove_unused(folder.parent)
        folder.mkdir(parents=True, exist_ok=True)
    return folder


def _remove_unused(kernels: Path) -> None:
    oldest_s = time.time() - KEPT_S
    for folder in kernels.iterdir() if kernels.is_dir() else ():
        if folder.stat().st_mtime < oldest_s:
            shutil.rmtree(folder, ignore_errors=True)


def choose() -> None:
    """Make numba keep this project's kernels here. Does nothing where NUMBA_CACHE_DIR is set: the user has chosen."""
    if "NUMBA_CACHE_DIR" in os.environ or "NUMBA_CACHE_LOCATOR_CLASSES" in os.environ:
        return
    os.environ["NUMBA_CACHE_LOCATOR_CLASSES"] = ",".join(_LOCATORS)
    if "numba" in sys.modules:
        sys.modules["numba"].config.CACHE_LOCATOR_CLASSES = os.environ["NUMBA_CACHE_LOCATOR_CLASSES"]
