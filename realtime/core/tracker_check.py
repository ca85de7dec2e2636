"""Detects that the tracker's frame moved against the rig: the field generator, its table or the sheath was displaced.

All positions are then wrong by one vector, while every pose is plausible. Three facts tell such a displacement from a motion
of the catheter:

1. Knob, roll and every load on the catheter turn the sensors that they displace. A displaced tracker turns neither sensor.
2. The displacement of tip and shaft is the same vector.
3. The insertion displaces both sensors alike as well, but only along the sheath's axis (z of the base frame), in the
   direction of the stage and at most as far: a backlash only takes away motion.
"""

from __future__ import annotations

import bisect
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from realtime.core.intake import quaternion_product

Vector = NDArray[np.float64]

# A pose is compared with the frame two before it, which shows a jump, and with the oldest of this time, which shows a push.
WINDOW_NS = 250_000_000
# Smallest displacement that is reported. 1.5 mm of the free tip are 0.15 N on the stiffest catheter file.
LEAST_M = 0.0015
# In standard deviations of the tracker: a difference of two positions has 1.4 of them on each axis.
POSITION_SIGMAS = 6.0
# Tip and shaft may differ by this share of their displacement: the heart moves a tip in contact meanwhile.
UNEQUAL_SHARE = 0.25
# Displacement per turn, in lengths of the distal shaft: at most 0.57 on average over tip and shaft, for a cantilever with a
# load at its tip (tip 2/3 of the length per turn of the tip, a sensor at 0.8 of the length 0.47); a knob makes 0.42, and a
# roll the radius of the tip.
LEVER_SHARE = 0.6
# So many frames in a row must be displaced.
FRAMES = 2
# The stamp of a pose and the time of a board's status agree to this.
STAMP_ERROR_NS = 30_000_000


class _Pose(NamedTuple):
    stamp_ns: int
    position_m: Vector
    quaternion: Vector


class _TrackerFrame(NamedTuple):
    """Poses of tip and shaft of one frame of the tracker."""

    tip: _Pose
    shaft: _Pose

    @property
    def stamp_ns(self) -> int:
        return self.tip.stamp_ns

    def repeats(self, other: _TrackerFrame) -> bool:
        """Return whether both poses are those of `other` under a new stamp: a tracker that is frozen."""
        return all(np.array_equal(one.position_m, two.position_m) for one, two in zip(self, other, strict=True))


class TrackerCheck:
    """Compares the motion of both sensors with that of the insertion stage.

    Args:
        position_noise_m: standard deviation of the tracker's positions on one axis (m).
        length_m: length of the distal shaft (m).
    """

    def __init__(self, position_noise_m: float, length_m: float) -> None:
        self._least_m = max(POSITION_SIGMAS * position_noise_m, LEAST_M)
        self._noise_m, self._lever_m = POSITION_SIGMAS * position_noise_m, LEVER_SHARE * length_m
        self.restart()

    def restart(self) -> None:
        """Forget everything seen so far; for arming."""
        self._shaft: _Pose | None = None
        self._frames: deque[_TrackerFrame] = deque()
        # (time in ns, insertion by steps, insertion by the encoder), at the distal end in m
        self._insertion: deque[tuple[int, float, float]] = deque()
        self._displaced = 0

    def take_stage(self, now_ns: int, by_steps_m: float, by_encoder_m: float) -> None:
        """Note the insertion at `now_ns` (m), as the steps and as the encoder show it."""
        if self._insertion and now_ns <= self._insertion[-1][0]:
            self.restart()  # the clock was set back
        self._insertion.append((now_ns, by_steps_m, by_encoder_m))
        oldest_ns = (self._frames[0].stamp_ns if self._frames else now_ns - WINDOW_NS) - 2 * STAMP_ERROR_NS
        while len(self._insertion) > 2 and self._insertion[1][0] < oldest_ns:
            self._insertion.popleft()

    def take_pose(self, is_tip: bool, stamp_ns: int, position_m: Vector, quaternion: Vector) -> float:
        """Take a pose in the base frame, the shaft's of a frame before the tip's; (3,) m and (4,) scalar first.

        Return the displacement (m) that no motion of the catheter explains, once FRAMES frames in a row show one; else 0.
        """
        pose = _Pose(stamp_ns, np.array(position_m, float), np.array(quaternion, float))
        if not is_tip:
            self._shaft = pose
            return 0.0
        if self._shaft is None or self._shaft.stamp_ns != stamp_ns:
            return 0.0
        return self._take_frame(_TrackerFrame(pose, self._shaft))

    def _take_frame(self, frame: _TrackerFrame) -> float:
        frames = self._frames
        if frames and frame.stamp_ns <= frames[-1].stamp_ns:
            self.restart()  # the clock was set back
        if frames and frame.repeats(frames[-1]):
            return 0.0
        frames.append(frame)
        while len(frames) > FRAMES + 1 and frame.stamp_ns - frames[0].stamp_ns > WINDOW_NS:
            frames.popleft()
        if len(frames) <= FRAMES:
            return 0.0
        displaced_m = max(self._unexplained_m(before, frame) for before in (frames[0], frames[-1 - FRAMES]))
        self._displaced = self._displaced + 1 if displaced_m > self._least_m else 0
        return displaced_m if self._displaced >= FRAMES else 0.0

    def _unexplained_m(self, before: _TrackerFrame, now: _TrackerFrame) -> float:
        """Return the length of the common displacement between two frames, less what insertion and turn explain."""
        turn_rad = max(_turn_rad(old.quaternion, new.quaternion) for old, new in zip(before, now, strict=True))
        tip_m, shaft_m = (new.position_m - old.position_m for old, new in zip(before, now, strict=True))
        moved_m = (tip_m + shaft_m) / 2
        least_m, most_m = self._inserted_m(before.stamp_ns, now.stamp_ns)
        moved_m[2] -= min(max(moved_m[2], least_m), most_m)
        length_m = float(np.linalg.norm(moved_m))
        apart_m = float(np.linalg.norm(now.tip.position_m - now.shaft.position_m))
        unequal_m = float(np.linalg.norm(tip_m - shaft_m))
        if unequal_m > self._noise_m + UNEQUAL_SHARE * length_m + apart_m * turn_rad:
            return 0.0
        return length_m - self._lever_m * turn_rad

    def _inserted_m(self, begin_ns: int, end_ns: int) -> tuple[float, float]:
        """Return the least and the greatest displacement along the sheath that the insertion explains (m).

        They are the largest fall and the largest rise of the stage in this time: of a stage that went back and forth,
        backlash may have taken away either part. Steps and encoder both count, since either may be wrong.
        """
        if not self._insertion:
            return -np.inf, np.inf
        history = np.array([item[1:] for item in self._insertion])
        stamps_ns = [item[0] for item in self._insertion]
        # The samples within the stamps' error, one more at each end: between two samples the stage may have moved.
        first = max(bisect.bisect_left(stamps_ns, begin_ns - STAMP_ERROR_NS) - 1, 0)
        last = bisect.bisect_right(stamps_ns, end_ns + STAMP_ERROR_NS) + 1
        part = history[first:last]
        if not len(part):
            part = history[-1:]
        fall_m = np.max(np.maximum.accumulate(part, axis=0) - part)
        rise_m = np.max(part - np.minimum.accumulate(part, axis=0))
        return -float(fall_m), float(rise_m)


def _turn_rad(before: Vector, after: Vector) -> float:
    """Return the angle between two orientations, unit quaternions (4,), in rad."""
    conjugate = before * np.array([1.0, -1.0, -1.0, -1.0])
    return 2.0 * float(np.linalg.norm(quaternion_product(after, conjugate)[1:]))
