"""A commander on the wall clock: the same, and a thread that keeps its lease as long as it is wanted."""

from __future__ import annotations

import threading
from typing import Any

from protocol.commander import Acknowledgement, Asker, CommandSender

RENEW_S = 1.0


class Commander(CommandSender):
    """`protocol.commander.CommandSender` whose lease is renewed in the background, from `take` to `release` or `close`.

    Use as a context, or `close` it: an unclosed one keeps others from commanding as long as its process lives.
    """

    def __init__(self, session: Asker, name: str, **options: Any) -> None:
        super().__init__(session, name, **options)
        self._wanted, self._ending = threading.Event(), threading.Event()
        self.lost = ""
        self._keeper: threading.Thread | None = None

    def take(self) -> Acknowledgement:
        """Take the lease and keep it. `lost` says why it went, where renewing was refused."""
        answer = super().take()
        if answer.accepted:
            self.lost = ""
            self._wanted.set()
            if self._keeper is None:
                self._keeper = threading.Thread(target=self._keep, name="lease", daemon=True)
                self._keeper.start()
        elif self._wanted.is_set() and answer.result != "unanswered":
            self._wanted.clear()
            self.lost = answer.reason
        return answer

    def release(self) -> Acknowledgement:
        """Give the lease back, and renew it no more."""
        with self._lock:
            self._wanted.clear()
            return super().release()

    def close(self) -> None:
        """Release what is held and end the thread."""
        if self._wanted.is_set():
            self.release()
        self._ending.set()
        if self._keeper is not None:
            self._keeper.join(2.0)

    def _keep(self) -> None:
        while not self._ending.wait(RENEW_S):
            with self._lock:
                if self._wanted.is_set():
                    self.take()

    def __enter__(self) -> Commander:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


__all__ = ["Acknowledgement", "Commander"]
