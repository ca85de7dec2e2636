"""Set the folder in which numba caches a kernel of this project. Loaded by numba itself; see `kernel_cache`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba.core.caching import _CacheLocator

from protocol import compile_notice
from protocol.kernel_cache import PACKAGES, ROOT, folder_of

compile_notice.listen()


class KernelLocator(_CacheLocator):  # type: ignore[misc]
    """Locator of one function's cache: the folder's name already stands for the state of the sources."""

    def __init__(self, folder: Path, line: int) -> None:
        self._folder, self._line = folder, line

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> KernelLocator | None:
        """The locator of `py_func`, or None for a file of another project or a folder that cannot be written."""
        path = Path(py_file).resolve()
        if not path.is_relative_to(ROOT) or path.relative_to(ROOT).parts[0] not in PACKAGES:
            return None
        try:
            locator = cls(folder_of(path), py_func.__code__.co_firstlineno)
            locator.ensure_cache_path()
        except OSError:
            return None
        return locator

    def get_cache_path(self) -> str:
        """The folder, as numba asks for it."""
        return str(self._folder)

    def get_source_stamp(self) -> str:
        """A constant of this state of the sources."""
        return self._folder.name

    def get_disambiguator(self) -> str:
        """The line of the function: two functions of one name in a file differ by it."""
        return str(self._line)
