"""A simulated rig on its own thread, in virtual time, behind zenoh: commands reach it, and its messages leave, as on a rig.

Its time stands still while the machine does. A stall of seconds therefore makes no pose stale and ends no lease, and what
a test sees does not depend on the machine's speed. Its time never passes faster than the machine's.
"""

from __future__ import annotations

import threading
import time

from protocol.rig_file import Rig
from protocol.topics import Message
from protocol.zenoh_session import Session
from sim.board import SimulatedBoard
from sim.scenario import Scenario
from sim.world import World, simulated_plant

STEP_S = 0.001


class VirtualRig:
    """Runs from entering to leaving it as a context. session: of the rig's side; it is not closed here."""

    def __init__(self, rig: Rig, session: Session) -> None:
        self._rig, self._session = rig, session
        self._publishers = {}
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="virtual rig", daemon=True)
        self.failure: BaseException | None = None

    @property
    def now_ns(self) -> int:
        """The rig's clock. Commanders stamp by it: by the machine's clock their commands would come from the future."""
        return self._scenario.now_ns

    def _publish(self, topic: str, message: Message) -> None:
        if topic not in self._publishers:
            self._publishers[topic] = self._session.publisher(topic)
        self._publishers[topic].put(message)

    def _run(self) -> None:
        try:
            while not self._ending.is_set():
                self._scenario.step()
                time.sleep(STEP_S)
        except BaseException as failure:
            self.failure = failure
            raise

    def __enter__(self) -> VirtualRig:
        self._board = SimulatedBoard("native").__enter__()
        self._scenario = Scenario(self._rig, World(self._rig, simulated_plant(self._rig, 1), self._board, 1), self._publish)
        self._server = self._session.serve_requests(self._scenario.loop.request)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.set()
        self._thread.join()
        self._board.__exit__(None, None, None)
        assert self.failure is None
