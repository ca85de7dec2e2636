"""What spoils bytes between computer and rig: damaged, dropped, doubled, swapped and flooding frames, a cut cable."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from realtime.core.lines import FromRig, ToRig
from sim.sensor_faults import SensorFault, active, checked, strongest

# bit_errors: `value` is the rate per bit of the board's line, both ways; drop, duplicate, reorder: `value` is the chance
# per frame of the board's line, both ways; cut: nothing passes on the board's line; flood_in: all that arrives from the
# board and the force sensor arrives `value` times; flood_out: each frame to the board is sent `value` times.
FAULT_KINDS = ("bit_errors", "drop", "duplicate", "reorder", "cut", "flood_in", "flood_out")


@dataclass
class LineCounts:
    """Frames of the board's line that were touched, both ways."""

    damaged: int = 0
    dropped: int = 0
    doubled: int = 0
    swapped: int = 0


class LineNoise:
    """The cables, as bad as the faults in `faults` say. Same seed and bytes, same damage."""

    def __init__(self, seed: int) -> None:
        self.faults: list[SensorFault] = []
        self.counts = LineCounts()
        self._rng = np.random.default_rng(seed)
        self._late: dict[str, bytes] = {"out": b"", "in": b""}
        self._part = b""

    def add(self, fault: SensorFault) -> None:
        """One more fault. Raises ValueError for a kind that is not of FAULT_KINDS."""
        self.faults += checked([fault], FAULT_KINDS)

    def outgoing(self, leaving: ToRig, now_ns: int) -> ToRig:
        """What of `leaving` gets through to the rig."""
        if not self.faults:
            return leaving
        board = self._line(leaving.board, now_ns, "out")
        board *= max(int(strongest(self.faults, now_ns, "flood_out")), 1)
        return ToRig(board, leaving.tracker, leaving.tracker_line, leaving.force)

    def incoming(self, arriving: FromRig, now_ns: int) -> FromRig:
        """What of `arriving` gets through to the computer."""
        if not self.faults:
            return arriving
        times = max(int(strongest(self.faults, now_ns, "flood_in")), 1)
        board = self._whole_frames(arriving.board)
        board = self._line(board, now_ns, "in") * times
        return FromRig(board, arriving.tracker, [record for record in arriving.force for _ in range(times)])

    def _whole_frames(self, data: bytes) -> bytes:
        """Frames are handled whole: what has not ended yet waits for its end."""
        data = self._part + data
        end = data.rfind(b"\0") + 1
        self._part = data[end:]
        return data[:end]

    def _line(self, data: bytes, now_ns: int, way: str) -> bytes:
        if active(self.faults, now_ns, "cut"):
            self._late[way] = b""
            return b""
        chances = [strongest(self.faults, now_ns, kind) for kind in ("drop", "duplicate", "reorder")]
        frames = [self._late[way]] if self._late[way] else []
        self._late[way] = b""
        out = []
        for frame in (part + b"\0" for part in data.split(b"\0")[:-1]):
            draws = self._rng.random(3)
            if draws[0] < chances[0]:
                self.counts.dropped += 1
                continue
            if draws[2] < chances[2] and not self._late[way]:
                self.counts.swapped += 1
                self._late[way] = frame
                continue
            out.append(frame)
            if draws[1] < chances[1]:
                self.counts.doubled += 1
                out.append(frame)
        return self._flipped(b"".join([*out, *frames]), now_ns)

    def _flipped(self, data: bytes, now_ns: int) -> bytes:
        rate = strongest(self.faults, now_ns, "bit_errors")
        if rate <= 0.0 or not data:
            return data
        flips = np.packbits(self._rng.random((len(data), 8)) < rate, axis=1)[:, 0]
        self.counts.damaged += int(np.count_nonzero(flips))
        return bytes(np.bitwise_xor(np.frombuffer(data, np.uint8), flips))
