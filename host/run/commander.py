"""A commander on the wall clock: its lease is kept by a thread, and a stop goes over every path and is confirmed."""

from __future__ import annotations

import threading
import time
from typing import Any

from protocol.commander import Acknowledgement, CommandSender
from protocol.stop_client import CONFIRM_S, PathAnswer, shows_stop, stop_by_socket, stop_over
from protocol.topics import RigState
from protocol.zenoh_session import Session

RENEW_S = 1.0
_POLL_S = 0.002


class Commander(CommandSender):
    """`protocol.commander.CommandSender` whose lease is renewed in the background, from `take` to `release` or `close`.

    A stop is sent over zenoh and, on the rig's computer, over the realtime process's own socket at the same time. It is
    accepted only if the rig's own state shows it within `confirm_s`.

    Use as a context, or `close` it: an unclosed one keeps others from commanding as long as its process lives.
    """

    def __init__(self, session: Session, name: str, *, confirm_s: float = CONFIRM_S, **options: Any) -> None:
        super().__init__(session, name, **options)
        self._wanted, self._ending = threading.Event(), threading.Event()
        self._zenoh, self._confirm_s = session, confirm_s
        self._states = session.latest("state")
        self.lost = ""
        self._keeper: threading.Thread | None = None

    def take(self) -> Acknowledgement:
        """Take the lease and renew it in the background. `lost` states the reason if renewing was refused."""
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
        """Release the lease and end its renewal."""
        with self._lock:
            self._wanted.clear()
            return super().release()

    def stop(self) -> Acknowledgement:
        """Stop over every path at once. Accepted if the rig's own state shows the stop within `confirm_s`.

        Only disarming and arming lead out of it. Needs no lease, is obeyed late too.
        """
        local = self._zenoh.local
        paths = {"zenoh": self.stop_by_zenoh}
        if local is not None:
            paths["socket"] = lambda: stop_by_socket(local)
        return stop_result(stop_over(paths))

    def stop_by_zenoh(self) -> PathAnswer:
        """Stop over zenoh alone, and wait until the rig's published state shows it or `confirm_s` is over."""
        self._states.take()
        answer = super().stop()
        if answer.result == "unanswered":
            return PathAnswer("zenoh", False, False, "the model process or the realtime process does not run, or is stalled")
        if not answer.accepted:
            return PathAnswer("zenoh", True, False, answer.reason)
        begin_s, mode, action = time.monotonic(), "no state", ""
        while True:
            state = self._states.take()
            if isinstance(state, RigState):
                mode, action = state.mode, state.safety_action
            after_s = time.monotonic() - begin_s
            if shows_stop(mode, action):
                return PathAnswer("zenoh", True, True, f"{mode}, seen {after_s * 1e3:.0f} ms after the answer")
            if after_s > self._confirm_s:
                return PathAnswer(
                    "zenoh", True, False, f"accepted, but the rig's state is {mode} after {after_s * 1e3:.0f} ms"
                )
            time.sleep(_POLL_S)

    def close(self) -> None:
        """Release the lease and end the thread."""
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


def stop_result(paths: tuple[PathAnswer, ...]) -> Acknowledgement:
    """Return the result of a stop that was sent over `paths`: accepted if the rig confirmed it on one of them."""
    if any(path.confirmed for path in paths):
        return Acknowledgement(True, "", "accepted", paths)
    said = "; ".join(f"{path.path}: {path.text}" for path in paths)
    return Acknowledgement(False, f"not confirmed: {said}. Use the emergency stop", "not confirmed", paths)


__all__ = ["Acknowledgement", "Commander", "stop_result"]
