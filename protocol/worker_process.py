"""Worker processes end with the command that started them, also if it is killed."""

from __future__ import annotations

import multiprocessing
import os
import threading


def end_with_parent() -> None:
    """Make this process end as soon as its parent has ended; the initializer of an executor.

    A worker whose parent was killed finishes its task, which may take an hour, and then waits for the next for ever.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, name="ends with its parent", daemon=True).start()
