"""Progress on standard error: a bar on a terminal; elsewhere a line now and then, for a log."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator

_WIDTH = 28
_REDRAW_S, _LINE_EVERY_S, _FIRST_LINE_S = 0.1, 10.0, 5.0


class Progress:
    """A bar that says what is done, how much of it, and for how long.

    On a terminal the line is drawn over itself. Elsewhere a line is printed for each new stage, every ten
    seconds of it, and at its end.
    """

    def __init__(self, quiet: bool = False) -> None:
        self._quiet, self._live = quiet, sys.stderr.isatty()
        self._began_s = time.monotonic()
        self._stage, self._share, self._printed_s, self._drawn = "", 0.0, 0.0, False

    def __call__(self, stage: str, share: float, count: str = "") -> None:
        """Show that `share` (0 to 1) of `stage` is done. count: the same as text, such as 3/24."""
        if self._quiet:
            return
        now_s = time.monotonic()
        new, every_s = stage != self._stage, _REDRAW_S if self._live else _LINE_EVERY_S
        ends = share >= 1.0 > self._share
        if not (new or ends or now_s - self._printed_s >= every_s):
            return
        filled = "#" * round(_WIDTH * min(max(share, 0.0), 1.0))
        text = f"[{filled:<{_WIDTH}}] {now_s - self._began_s:6.1f} s  {stage}{f'  {count}' if count else ''}"
        sys.stderr.write(f"\r{text[:110]:<110}" if self._live else f"{text}\n")
        sys.stderr.flush()
        self._stage, self._share, self._printed_s, self._drawn = stage, share, now_s, True

    def close(self) -> None:
        """End the line on a terminal."""
        if self._live and self._drawn:
            sys.stderr.write("\r" + " " * 110 + "\r")
            sys.stderr.flush()

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


class Working:
    """Report the time of a step whose progress is not known, and its maximum.

    The first line comes after five seconds, then one every ten; on a terminal every second. A step that ends before
    says nothing.
    """

    def __init__(self, stage: str, at_most_s: float | None = None) -> None:
        self._stage, self._at_most_s = stage, at_most_s
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._show_working, name="progress", daemon=True)

    def __enter__(self) -> Working:
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._done.set()
        self._thread.join()

    def _show_working(self) -> None:
        live, printed = sys.stderr.isatty(), False
        of = "" if self._at_most_s is None else f" of {self._at_most_s:g} s"
        began_s, wait_s = time.monotonic(), _FIRST_LINE_S
        while not self._done.wait(wait_s):
            text = f"seldinger: {self._stage}: {time.monotonic() - began_s:.0f} s{of}"
            sys.stderr.write(f"\r{text[:110]:<110}" if live else f"{text}\n")
            sys.stderr.flush()
            wait_s, printed = 1.0 if live else _LINE_EVERY_S, True
        if live and printed:
            sys.stderr.write("\r" + " " * 110 + "\r")
            sys.stderr.flush()


@contextlib.contextmanager
def share_bar(stage: str) -> Iterator[Callable[[float], None]]:
    """Give a function that shows the share (0 to 1) of `stage` that is done."""
    with Progress() as bar:
        yield lambda share: bar(stage, share)
