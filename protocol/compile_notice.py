"""Say that a kernel is being compiled: a command without output for a minute looks broken.

Numba's event comes only where neither memory nor the cache on disk has the kernel. `kernel_locator`, which numba loads with
the first cached kernel, starts to listen; so a process without kernels never imports numba for this.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

WORDS = "seldinger: compiling kernels, which can take some minutes; `seldinger warm` compiles all of them once, on all cores"

_callback: Callable[[], None] | None = None


def on_first(callback: Callable[[], None]) -> None:
    """Call `callback` once, when this process compiles its first kernel. To be called before numba is imported."""
    global _callback
    _callback = callback


def listen() -> None:
    """Start to listen to numba's compiler, if a notice is wanted. Called when numba is there."""
    if _callback is None:
        return
    from numba.core import event

    class CompileListener(event.Listener):  # type: ignore[misc]
        """Calls back at the first event."""

        def on_start(self, event: Any) -> None:
            """A kernel starts to be compiled."""
            global _callback
            callback, _callback = _callback, None
            if callback is not None:
                callback()

        def on_end(self, event: Any) -> None:
            """Do nothing; numba's interface requires this method."""

    event.register("numba:compile", CompileListener())
