"""The simulated tracker behind an OpenIGTLink server, as PLUS serves an Aurora: one TRANSFORM a tool and frame, over TCP.

Messages are packed by pyigtl, which knows nothing of the driver that reads them (`realtime.drivers.openigtlink`).
"""

from __future__ import annotations

import time

import numpy as np

from protocol.broadcast_server import BroadcastServer
from realtime.core.intake import rotation
from sim.aurora_emulator import AuroraEmulator


class PlusServer:
    """Serves the frames of an emulated tracker at `address` (host, port; port 0: a free one). `step` moves what is due."""

    def __init__(self, emulator: AuroraEmulator, address: tuple[str, int]) -> None:
        import pyigtl

        self._message = pyigtl.TransformMessage
        self.emulator, self._server = emulator, BroadcastServer(address)
        host, port = self._server.address
        self.path = f"{host}:{port}"  # as `tracker.port` of a rig file has it
        self._sent_ns, self._epoch_s = -1, time.time()

    def step(self, now_ns: int) -> None:
        """Take new clients, and send what has become available by `now_ns`, the world's clock."""
        self._server.accept()
        for frame in self.emulator.frames_until(now_ns):
            if frame.available_ns <= self._sent_ns:
                continue
            self._sent_ns = frame.available_ns
            for handle, tracked in frame.tools.items():
                if tracked.pose is not None:
                    self._server.send(self._packed(handle, tracked.pose, frame.available_ns))

    def unplug(self) -> None:
        """End the server: its clients read an end of file, new ones are refused."""
        self._server.close()

    close = unplug

    def _packed(self, handle: str, pose: tuple[float, ...], available_ns: int) -> bytes:
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation(pose[:4]), pose[4:7]  # mm, as OpenIGTLink has it
        stamp_s = self._epoch_s + available_ns * 1e-9
        return bytes(self._message(matrix, timestamp=stamp_s, device_name=handle).pack())
