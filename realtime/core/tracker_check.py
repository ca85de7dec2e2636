"""Detects that the tracker moved against the rig: the field generator, its table or the sheath was displaced.

All positions are then wrong by one vector, while every pose is plausible. Three facts tell such a displacement from a motion
of the catheter:

1. The displacement of tip and shaft is the same vector.
2. Knob, roll and every load on the catheter turn the sensors that they displace. If the whole part outside the sheath turned
   by R about the sheath's exit, a sensor at p would be displaced by (R - 1) p. A part that bends along its length displaces
   it by less in each direction. A displaced tracker turns neither sensor.
3. The insertion displaces both sensors alike as well, by what the stage moved, less its backlash. Its direction lies
   between the sheath's axis (z of the base frame) and the catheter's axis at the sensors: if the knob straightens the
   catheter while it is inserted, both sensors keep their directions and the whole arc becomes longer.

A catheter that slips in its holder, or a sheath that is displaced, looks the same and is as dangerous.
"""

from __future__ import annotations

import bisect
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from realtime.core.intake import quaternion_product, rotation

Vector = NDArray[np.float64]

# A frame is compared with at most COMPARED frames of this time before it: a jump shows between near ones, a push between
# distant ones, and where a heart turns the tip some are turned alike.
WINDOW_NS, COMPARED = 250_000_000, 8
# Smallest displacement beyond the noise that is reported.
LEAST_M = 0.0005
# In standard deviations of the tracker. A difference of two poses has 1.4 of them on each axis, the mean of two sensors 1.
POSITION_SIGMAS, TURN_SIGMAS = 6.0, 3.0
# Beyond this turn a catheter that bends along its length leaves the bounds of (R - 1) p, by 1/8 of the turn squared times
# the length: 0.5 mm of 100 mm.
LARGEST_TURN_rad = 0.2
# The backlash may differ from its stated width: the insertion is followed with these multiples of it.
WIDTHS = (0.75, 1.0, 1.25)
# Tip and shaft may differ by this share of their displacement: the heart moves a tip in contact meanwhile.
UNEQUAL_SHARE = 0.25
# So many frames in a row must be displaced.
FRAMES = 2
# Of the sheath's exit in the base frame, and of the catheter in the frame of each sensor.
EXIT_AXIS = np.array([0.0, 0.0, 1.0])
# What the insertion may have moved before the first status of the board.
ANYWHERE_M = 1.0
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


class _InsertionHistory(NamedTuple):
    """Possible insertions of the distal end, (n, ...) in m, at n times in ns."""

    stamps_ns: list[int]
    possible_m: Vector

    def moved_m(self, begin_ns: int, end_ns: int) -> tuple[float, float]:
        """Return the least and the greatest displacement along the sheath that the insertion explains (m)."""
        if not self.stamps_ns:
            return -ANYWHERE_M, ANYWHERE_M
        begin_m = self.possible_m[_around(self.stamps_ns, begin_ns)]
        end_m = self.possible_m[_around(self.stamps_ns, end_ns)]
        least_m = np.min(end_m.min(axis=0) - begin_m.max(axis=0))
        most_m = np.max(end_m.max(axis=0) - begin_m.min(axis=0))
        return float(least_m), float(most_m)


class TrackerCheck:
    """Compares the motion of both sensors with their turn and with the insertion stage.

    Args:
        position_noise_m: standard deviation of the tracker's positions on one axis (m).
        orientation_noise_rad: standard deviation of its orientations about one axis (rad).
        backlash_m: width of the insertion's backlash (m).
    """

    def __init__(self, position_noise_m: float, orientation_noise_rad: float, backlash_m: float) -> None:
        self._noise_m, self._turn_noise_rad = POSITION_SIGMAS * position_noise_m, TURN_SIGMAS * orientation_noise_rad
        self._widths_m = backlash_m * np.array(WIDTHS)
        self.restart()

    def restart(self) -> None:
        """Forget everything seen so far; for arming."""
        self._shaft: _Pose | None = None
        self._frames: deque[_TrackerFrame] = deque()
        # (time in ns, possible insertions of the distal end in m)
        self._insertion: deque[tuple[int, Vector]] = deque()
        self._displaced = 0

    def take_stage(self, now_ns: int, by_steps_m: float, by_encoder_m: float) -> None:
        """Note the insertion of the stage at `now_ns` (m), as the steps and as the encoder show it.

        Steps and encoder both count, since either may be wrong. The distal end follows each by a play operator: at first it
        may be anywhere in the backlash.
        """
        if self._insertion and now_ns <= self._insertion[-1][0]:
            self.restart()  # the clock was set back
        stage_m = np.array([[[by_steps_m], [by_encoder_m]]])
        if self._insertion:
            before_m = self._insertion[-1][1]
        else:
            before_m = stage_m - np.array([0.0, 1.0])[:, None, None] * self._widths_m
        self._insertion.append((now_ns, np.clip(before_m, stage_m - self._widths_m, stage_m)))
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
        # The last before this one is left out: a jump has to show against the frame before both.
        compared = list(frames)[:-FRAMES][:: -(-len(frames) // COMPARED)]
        insertion = self._insertion_history()
        found = [self._unexplained_m(before, frame, insertion) for before in compared]
        known_m = [displaced_m for displaced_m in found if displaced_m is not None]
        if known_m:
            self._displaced = self._displaced + 1 if max(known_m) > LEAST_M else 0
        return max(known_m, default=0.0) if self._displaced >= FRAMES else 0.0

    def _unexplained_m(self, before: _TrackerFrame, now: _TrackerFrame, insertion: _InsertionHistory) -> float | None:
        """Return the length of the common displacement between two frames, less what noise, insertion and turn explain.

        None where the sensors turned too far to tell.
        """
        tip_m, shaft_m = (new.position_m - old.position_m for old, new in zip(before, now, strict=True))
        turns = [_turn(old.quaternion, new.quaternion) for old, new in zip(before, now, strict=True)]
        largest_rad = max(2.0 * float(np.linalg.norm(turn[1:])) for turn in turns)
        if largest_rad > LARGEST_TURN_rad:
            return None
        # The bounds of the displacement on each axis: none, a turn of the whole catheter, the insertion.
        place_m = (before.tip.position_m + before.shaft.position_m) / 2
        turned_m = rotation((turns[0] + turns[1]) / 2) @ place_m - place_m
        least_m, most_m = np.minimum(turned_m, 0.0), np.maximum(turned_m, 0.0)
        inserted_m = np.outer(insertion.moved_m(before.stamp_ns, now.stamp_ns), _directions(before)).reshape(-1, 3)
        least_m += inserted_m.min(axis=0)
        most_m += inserted_m.max(axis=0)
        moved_m = (tip_m + shaft_m) / 2
        length_m = float(np.linalg.norm(moved_m - np.clip(moved_m, least_m, most_m)))
        apart_m = float(np.linalg.norm(now.tip.position_m - now.shaft.position_m))
        unequal_m = float(np.linalg.norm(tip_m - shaft_m))
        if unequal_m > self._noise_m + UNEQUAL_SHARE * length_m + apart_m * largest_rad:
            return 0.0
        return length_m - float(np.hypot(self._noise_m, self._turn_noise_rad * np.linalg.norm(place_m)))

    def _insertion_history(self) -> _InsertionHistory:
        stamps_ns = [stamp_ns for stamp_ns, _ in self._insertion]
        return _InsertionHistory(stamps_ns, np.array([possible_m for _, possible_m in self._insertion]))


def _directions(frame: _TrackerFrame) -> Vector:
    """Return the axes of the catheter at the sheath's exit and at both sensors, (3, 3): rows of unit vectors."""
    return np.array([EXIT_AXIS, *(rotation(pose.quaternion) @ EXIT_AXIS for pose in frame)])


def _around(stamps_ns: list[int], stamp_ns: int) -> slice:
    """Return the samples within STAMP_ERROR_NS of a time, and one more on either side: the stage may move between two."""
    first = max(bisect.bisect_left(stamps_ns, stamp_ns - STAMP_ERROR_NS) - 1, 0)
    last = bisect.bisect_right(stamps_ns, stamp_ns + STAMP_ERROR_NS) + 1
    return slice(min(first, len(stamps_ns) - 1), last)


def _turn(before: Vector, after: Vector) -> Vector:
    """Return the rotation from one orientation to another as a unit quaternion (4,), scalar first and not negative."""
    turn = quaternion_product(after, before * np.array([1.0, -1.0, -1.0, -1.0]))
    return turn if turn[0] >= 0 else -turn
