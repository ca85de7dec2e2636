"""Errors that last from pose to pose: of insertion, curvature and roll, and the force along the wall; a Kalman filter.

The controller's joints are those of a transmission with backlash and windup. Their errors are unknown at the start and
change when the joints move. Each pose contains information on them and on the force. The filter keeps what the poses have
told: mean and covariance of the three errors, and lets their uncertainty grow with the travel of the joints and with time.

A backlash that is wider than assumed makes one part of the insertion's error alternate: it is -p while the body is pushed
and +p while it is pulled, with p half of the missing width, and changes over while the body moves by 2 p after a reversal.
This is a fourth state, p, which poses of several reversals determine; the other three would follow it only with a delay.

A knob that turns to and fro brings the curvature back to what it was, friction included: within the range that it visited
lately its travel adds no uncertainty. Otherwise the knob's motion with each beat would make the filter forget in seconds
what many poses had told of the curvature, which one pose can hardly tell from a force along the wall.

A wall that is not perpendicular to the commanded force makes a force along it that lasts as long as the contact. Three more
states hold this force. Were it taken for new in each pose, its mean would count as an error of insertion and curvature, and
the filter would be surer of the wrong one with every pose.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from host.estimation.interface import Actuation
from protocol.enums import Phase
from protocol.rig_file import Rig

Array = NDArray[np.float64]

INSERTION, CURVATURE, ROLL, FLANK = 0, 1, 2, 3
ALL_JOINTS = (INSERTION, CURVATURE, ROLL)
NOWHERE: Array = np.zeros((0, 3))  # no direction along a wall
GAP_NS = 1_000_000_000  # after so long without a pose nothing is remembered
_FLANK_MEMORY_S = 60.0  # with a force sensor the controller corrects its width in contact
_VISIT_MEMORY_S = 30.0  # a knob that returns within it brings the curvature back, friction included
_SHORTEST_CROSSING_m = 1e-4  # of the body, between the flanks: the side is seen at the tracker's rate
_JOINTS, _ALONG_WALL = slice(0, 4), slice(4, 7)
# Of the force along the wall: its memory, and the share of its variance that is new in each pose. A smaller share makes
# the filter surer of a tilted wall than it is (docs/mechanics.md).
_WALL_MEMORY_S, _NEW_SHARE = 30.0, 0.1
_LEAST_ACROSS = 0.1  # of a commanded direction that winds up the shaft; less of it changes the roll by less than its noise
# Nothing is commanded to press on the wall in these, or the tip is still on its way to it.
_APART = frozenset(phase.label for phase in (Phase.HOLD, Phase.POSITION, Phase.APPROACH, Phase.JOG))


@dataclass(frozen=True)
class ActuationKnowledge:
    """Uncertainty of the joints: standard deviations at the start, and their growth.

    start (3,): insertion (m), curvature (1/m), roll (rad). by_travel (3,): of each joint's error after one unit of its
    own travel (m, 1/m, rad), growing with the square root of the travel; of the knob only travel beyond the range that it
    visited lately counts. by_time (3,): the same after one second.
    flank_m: of half the backlash's width, which lasts; 0: known. flank_mean_m: by how much half the width that the
    controller assumes is expected to be too small.
    """

    start: tuple[float, float, float]
    by_travel: tuple[float, float, float]
    by_time: tuple[float, float, float]
    flank_m: float = 0.0
    flank_mean_m: float = 0.0

    @classmethod
    def from_rig(cls, rig: Rig) -> ActuationKnowledge:
        """Return the values of the rig file: backlash, its uncertainty, and section [estimation]."""
        width_m, known = rig.transmission.insertion_backlash_m, rig.estimation
        # At the start the distal end may be anywhere in the backlash. After one width of travel it is at the other flank,
        # whose place is known as surely as the backlash.
        start_m = max(width_m / np.sqrt(12.0), known.insertion_sd_m)
        return cls(
            (start_m, known.curvature_sd_per_m, known.roll_sd_rad),
            (
                known.insertion_sd_m / np.sqrt(max(width_m, 1e-3)),
                known.curvature_sd_per_m / np.sqrt(rig.catheter.max_curvature_per_m),
                known.roll_sd_rad,
            ),
            (known.insertion_walk_m, known.curvature_walk_per_m, known.roll_walk_rad),
            rig.control.play_sd_m,
            # The predictive law takes the backlash for narrower than in the file until it is learned in contact.
            0.5 * rig.control.play_caution_m if rig.control.law == "predictive" else 0.0,
        )


class Prior(NamedTuple):
    """What is expected of the force along the wall (m) and of k joints' errors, in this order.

    across: (m, 3) unit vectors along the wall, base frame. which: the k joints. mean: (m + k,). covariance: (m + k, m + k).
    """

    across: Array
    which: tuple[int, ...]
    mean: Array
    covariance: Array


class LastingErrors:
    """True joints minus the controller's, and the force on the tip along the wall, at the present pose."""

    def __init__(self, knowledge: ActuationKnowledge, tangential_sd_N: float) -> None:
        """tangential_sd_N: standard deviation of the force along the wall, in each direction, before a pose is seen."""
        self._known = knowledge
        self._new_N2 = _NEW_SHARE * tangential_sd_N**2
        self._wall_N2 = (1.0 - _NEW_SHARE) * tangential_sd_N**2
        self.forget()

    def forget(self) -> None:
        """Return to the state at the start."""
        known = self._known
        self._mean = np.array([0.0, 0.0, 0.0, known.flank_mean_m, 0.0, 0.0, 0.0])
        self._covariance = np.diag([*np.square([*known.start, known.flank_m]), *3 * [self._wall_N2]])
        self._by_first = np.eye(7)[CURVATURE]  # sensitivity of the states to the curvature's error expected at the start
        self._last: Actuation | None = None
        self._side = 0.0
        self._visited = (0.0, 0.0)  # lowest and highest curvature (1/m), from the first actuation on

    @property
    def mean(self) -> Array:
        """Expected errors (3,) of insertion, curvature and roll."""
        return self.prior(NOWHERE, ALL_JOINTS).mean

    @property
    def covariance(self) -> Array:
        """Covariance (3, 3) of these errors."""
        return self.prior(NOWHERE, ALL_JOINTS).covariance

    @property
    def missing_backlash(self) -> tuple[float, float]:
        """Return the excess (m) of the backlash over the controller's, and its standard deviation."""
        return 2.0 * float(self._mean[FLANK]), 2.0 * float(np.sqrt(self._covariance[FLANK, FLANK]))

    def prior(self, across: Array, which: tuple[int, ...]) -> Prior:
        """Return what is expected before the pose is seen. across: (m, 3) unit vectors along the wall. which: joints."""
        now = self._now(across, which)
        new = np.diag([*len(across) * [self._new_N2], *len(which) * [0.0]])
        return Prior(across, which, now @ self._mean, np.asarray(now @ self._covariance @ now.T) + new)

    def learn(self, prior: Prior, mean: Array, covariance: Array) -> None:
        """Take over what a pose made of `prior`: mean (m + k,) and covariance (m + k, m + k) after it.

        The states follow by their covariance with these quantities (Kalman filter, with the measurement already combined
        with its prior).
        """
        cross = self._covariance @ self._now(prior.across, prior.which).T
        gain = np.linalg.solve(prior.covariance, cross.T).T
        self._mean = self._mean + gain @ (np.asarray(mean) - prior.mean)
        expected = self._now(prior.across, prior.which) @ self._by_first
        self._by_first = self._by_first + gain @ (covariance @ np.linalg.solve(prior.covariance, expected) - expected)
        after = self._covariance - gain @ (prior.covariance - covariance) @ gain.T
        self._covariance = 0.5 * (after + after.T)

    def information_of_one_pose(self, across: Array) -> Array:
        """Return the information (3, 3) on the force, base frame, that its part along the wall has if no pose was seen."""
        return np.asarray(across.T @ across) / (self._new_N2 + self._wall_N2)

    def _now(self, across: Array, which: tuple[int, ...]) -> Array:
        """Matrix (m + k, 7) that makes the force along the wall and the joints' errors of the states."""
        joints = np.eye(3, 7)
        joints[INSERTION, FLANK] = -self._side
        wall = np.zeros((len(across), 7))
        wall[:, _ALONG_WALL] = across
        return np.vstack([wall, joints[list(which)]])

    def move_to(self, actuation: Actuation) -> None:
        """Let the uncertainty grow by the travel and the time since the last call; never above that at the start."""
        last, self._last = self._last, actuation
        if last is None or not 0 <= actuation.stamp_ns - last.stamp_ns <= GAP_NS:
            self.forget()
            self._last = actuation
            self._visited = (actuation.curvature_per_m, actuation.curvature_per_m)
            return
        moved = np.array(
            [
                actuation.insertion_m - last.insertion_m,
                actuation.curvature_per_m - last.curvature_per_m,
                actuation.roll_rad - last.roll_rad,
            ]
        )
        self._change_side(moved[INSERTION])
        seconds = (actuation.stamp_ns - last.stamp_ns) * 1e-9
        moved[CURVATURE] = self._beyond(actuation.curvature_per_m, seconds)
        growth = np.square(self._known.by_travel) * np.abs(moved) + np.square(self._known.by_time) * seconds
        grown = self._covariance[_JOINTS, _JOINTS] + np.diag([*growth, self._known.flank_m**2 * seconds / _FLANK_MEMORY_S])
        if _winds_up(actuation):
            grown[ROLL, ROLL] += self._known.start[ROLL] ** 2
        start = np.array([*self._known.start, self._known.flank_m])
        shrink = np.minimum(1.0, start / np.maximum(np.sqrt(np.diag(grown)), 1e-12))
        pressed = actuation.force_direction is not None and actuation.mode not in _APART
        kept = np.exp(-seconds / _WALL_MEMORY_S) if pressed else 0.0
        self._covariance[_JOINTS, _JOINTS] = grown * np.outer(shrink, shrink)
        self._covariance[_JOINTS, _ALONG_WALL] *= kept * shrink[:, None]
        self._covariance[_ALONG_WALL, _JOINTS] = self._covariance[_JOINTS, _ALONG_WALL].T
        self._covariance[_ALONG_WALL, _ALONG_WALL] *= kept**2
        self._covariance[_ALONG_WALL, _ALONG_WALL] += (1.0 - kept**2) * self._wall_N2 * np.eye(3)
        self._mean[_ALONG_WALL] *= kept
        self._by_first[_ALONG_WALL] *= kept

    def restate_curvature(self, by_per_m: float) -> None:
        """Expect every curvature from now on larger by this (1/m) where the knob did not move: the shaft did not either.

        At the start no error was expected of the curvature that was given then; now none is expected of the new one. What
        the states still have of this expectation moves along.
        """
        self._mean += self._by_first * by_per_m
        self._mean[CURVATURE] -= by_per_m
        self._visited = (self._visited[0] + by_per_m, self._visited[1] + by_per_m)

    def _beyond(self, curvature_per_m: float, seconds: float) -> float:
        """Return how far the curvature is outside those visited lately, and take it among them."""
        kept = math.exp(-seconds / _VISIT_MEMORY_S)
        low, high = (curvature_per_m + kept * (end - curvature_per_m) for end in self._visited)
        self._visited = min(low, curvature_per_m), max(high, curvature_per_m)
        return max(low - curvature_per_m, curvature_per_m - high, 0.0)

    def _change_side(self, moved_m: float) -> None:
        """Follow the flank of the backlash: +1 pushed, -1 pulled, between them in proportion to the body's motion."""
        crossing_m = max(2.0 * abs(self._mean[FLANK]), _SHORTEST_CROSSING_m)
        self._side = min(max(self._side + 2.0 * moved_m / crossing_m, -1.0), 1.0)


def _winds_up(actuation: Actuation) -> bool:
    """Whether the commanded force has a part across the sheath's axis.

    It winds up the shaft in proportion to itself, by 0.2 rad from one pose to the next, so the roll does not last.
    """
    across = actuation.force_direction
    return across is not None and math.hypot(float(across[0]), float(across[1])) > _LEAST_ACROSS


def lasting_part(total: Array, of_one_pose: Array) -> Array:
    """Return the part (n, n) of the covariance `total` (n, n) that estimates shortly after each other share.

    of_one_pose: (n, n), positive definite, covariance of the force from one pose alone, joints known. What the filter
    remembers makes estimates scatter less and together: over some tenths of a second their mean is as uncertain as that of
    estimates from single poses. Who averages estimates as if they were independent has to be told the scatter of single
    ones. In directions in which this is more than `total`, nothing lasts. `total` minus the result is a covariance too.
    """
    root = np.linalg.cholesky(of_one_pose)
    relative = np.linalg.solve(root, np.linalg.solve(root, total).T)
    values, vectors = np.linalg.eigh(0.5 * (relative + relative.T))
    back = root @ vectors
    return np.asarray((back * np.maximum(values - 1.0, 0.0)) @ back.T)
