"""The running rig's spatial estimator: the rod of chapter 3, both tracked poses, with the actuation's errors followed.

With a sensor at the tip alone the poses are those of case 2, with a second one those of case 4 and the tip's absolute
position; a third (case 6) is a further row. The absolute positions determine the errors of insertion and roll,
which cases 4 and 6 leave out. Source: chapter 5, weighted, with the errors of the actuation as further unknowns.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from host.estimation.contact_knowledge import ContactKnowledge
from host.estimation.interface import Actuation, PoseReading, TipForce
from host.estimation.lasting_errors import ALL_JOINTS, NOWHERE, ActuationKnowledge, LastingErrors, Prior, lasting_part
from host.estimation.reach import check_reach
from host.estimation.sensor_noise import TrackedSensors, chi_square_limit
from host.estimation.spatial import start_grid
from host.estimation.spatial_rig_kernels import FrameFit, TrackedFrame, fit, known_rows, new_fit, refit
from host.mechanics.rod import finite, rod_record
from protocol.catheter import Catheter, load_catheter
from protocol.rig_file import Rig

Array = NDArray[np.float64]

LARGEST_FORCE_N = 1.0
ODD_DEVIATIONS = 5.0  # of the chi square that no force explains
RESTARTS = slice(0, 26)
CONFUSED_FRAMES = 8  # so many in a row that no force explains: what was learned of the actuation is wrong
UNSEEN_STD_N = 10.0


class SpatialRigEstimator:
    """Implements `host.estimation.interface.Estimator` with the rod. Keeps the force's branch and the actuation's errors."""

    def __init__(
        self,
        catheter: Catheter,
        sensors: TrackedSensors,
        knowledge: ActuationKnowledge,
        contact: ContactKnowledge | None = None,
    ) -> None:
        self._catheter, self._sensors = catheter, sensors
        self._contact = contact or ContactKnowledge()
        self.errors = LastingErrors(knowledge, self._contact.tangential_sd_N)
        self._force = np.zeros(3)
        self._unexplained = 0

    @classmethod
    def from_rig(cls, rig: Rig) -> SpatialRigEstimator:
        """For the catheter and the tracker of a rig file. Raises InputError where the rod's stiffness is not known."""
        catheter = load_catheter(rig.catheter.name)
        rod_record(catheter, 0.0, 0.0)
        return cls(catheter, TrackedSensors.from_rig(rig), ActuationKnowledge.from_rig(rig), ContactKnowledge.from_rig(rig))

    def use_stiffness(self, catheter: Catheter, relative_sd: float) -> None:
        """Use the stiffness of `catheter` from now on, known to `relative_sd`."""
        self._catheter = catheter
        self._contact = replace(self._contact, stiffness_sd=relative_sd)

    def restate_curvature(self, by_per_m: float) -> None:
        """Expect every curvature from now on larger by this (1/m), and what was learned of its error smaller by as much."""
        self.errors.restate_curvature(by_per_m)

    def estimate(
        self,
        pose_tip: PoseReading,
        pose_shaft: PoseReading | None,
        actuation: Actuation,
        pose_rear: PoseReading | None = None,
    ) -> TipForce:
        """The force of the tip on the tissue, base frame, that explains the poses. Raises: InputError (bad input)."""
        rod = rod_record(self._catheter, actuation.insertion_m, actuation.curvature_per_m)
        exposed_m = self._catheter.distal_length_m + actuation.insertion_m
        finite("pose_tip", [*pose_tip.position_m, *pose_tip.quaternion_wxyz], (7,), "three finite numbers in m and four")
        check_reach("pose_tip.position_m", pose_tip.position_m, exposed_m)
        offsets, poses = [0.0], [[*pose_tip.position_m, *pose_tip.quaternion_wxyz]]
        for key, offset_m, pose in (
            ("pose_shaft", self._sensors.shaft_offset_m, pose_shaft),
            ("pose_rear", self._sensors.rear_offset_m, pose_rear),
        ):
            if offset_m is not None and pose is not None and np.isfinite([*pose.position_m, *pose.quaternion_wxyz]).all():
                check_reach(f"{key}.position_m", pose.position_m, exposed_m)
                offsets.append(offset_m)
                poses.append([*pose.position_m, *pose.quaternion_wxyz])
        self.errors.move_to(actuation)
        known = self.errors.prior(along_wall(actuation), ALL_JOINTS)
        joints = np.array([actuation.insertion_m, actuation.curvature_per_m, actuation.roll_rad])
        frame = TrackedFrame(
            rod[:6].copy(),
            self._catheter.distal_length_m,
            joints,
            np.array(offsets),
            np.array(poses),
            self._sensors.position_std_m,
            self._sensors.angle_std_rad,
            *known_rows(known, self._contact.force_sd(actuation)),
        )
        settled, cost, found = self._search(frame, known)
        converged = settled and cost <= chi_square_limit(6 * len(offsets), ODD_DEVIATIONS)
        if converged:
            self._learn(frame._replace(known=known_rows(known, self._contact.learned_sd(actuation))[0]), known, found)
        return self._answer(frame, known, found, converged, pose_tip.stamp_ns)

    def _search(self, frame: TrackedFrame, known: Prior) -> tuple[bool, float, FrameFit]:
        """From the last force; where that explains nothing, from none, then from a grid of forces."""
        limit = chi_square_limit(6 * len(frame.offsets), ODD_DEVIATIONS)
        best: tuple[bool, float, FrameFit] | None = None
        starts = [self._force]
        if self._force.any():
            starts.append(np.zeros(3))
        if self._unexplained <= 1:  # a pose that stays odd is not searched for again at every frame
            starts += list(start_grid(0.5)[RESTARTS])
        for start in starts:
            found = new_fit(len(frame.offsets))
            found.x[:3], found.x[3:] = start, known.mean[len(known.across) :]
            settled, cost = fit(frame, LARGEST_FORCE_N, found)
            if best is None or (settled, -cost) > (best[0], -best[1]):
                best = (settled, cost, found)
            if best[0] and best[1] <= limit:
                break
        assert best is not None
        return best

    def _answer(self, frame: TrackedFrame, known: Prior, found: FrameFit, converged: bool, stamp_ns: int) -> TipForce:
        covariance: Array = np.linalg.inv(found.information).astype(np.float64)
        force_N = -found.force_N
        total = found.by_x @ covariance @ found.by_x.T
        of_one_pose = self._of_one_pose(frame, known, found)
        # A pose depends on force over stiffness, so a relative error of the stiffness is one of the force.
        stiffness = self._contact.stiffness_sd**2 * np.outer(force_N, force_N)
        lasting = lasting_part(total, of_one_pose) + stiffness
        total = total + stiffness
        total *= min(1.0, UNSEEN_STD_N**2 / max(float(np.diag(total).max()), 1e-300))
        residual = _residual(frame, found)
        if converged:
            self._force, self._unexplained = found.x[:3].copy(), 0
        else:
            self._force = np.zeros(3)
            self._unexplained += 1
            if self._unexplained >= CONFUSED_FRAMES:
                self.errors.forget()
                self._unexplained = 0
        return TipForce(force_N, 0.5 * (total + total.T), converged, residual, stamp_ns, 0.5 * (lasting + lasting.T))

    def _learn(self, frame: TrackedFrame, known: Prior, found: FrameFit) -> None:
        """Take over what the poses told of the lasting errors, with sensitivities at the last force."""
        at = new_fit(len(frame.offsets))
        at.x[:3], at.x[3:] = self._force, known.mean[len(known.across) :]
        refit(frame, found, at)
        shown = np.vstack([known.across @ at.by_x, np.eye(3, 6, 3)])
        covariance = np.linalg.inv(at.information)
        self.errors.learn(known, np.array([*known.across @ at.force_N, *at.x[3:]]), shown @ covariance @ shown.T)

    def _of_one_pose(self, frame: TrackedFrame, known: Prior, found: FrameFit) -> Array:
        """Covariance (3, 3) of the force from this pose alone, with the joints' errors held at their estimate."""
        by_force = found.by_x[:, :3]
        lasting = (frame.known[3:, :3] @ found.by_x + frame.known[3:, 3:])[:, :3]
        new = by_force.T @ self.errors.information_of_one_pose(known.across) @ by_force
        information = found.information[:3, :3] - lasting.T @ lasting + new
        return np.asarray(by_force @ np.linalg.inv(information) @ by_force.T)


def along_wall(actuation: Actuation) -> Array:
    """Return unit vectors (2, 3) across the force that is commanded, base frame; (0, 3) without one."""
    if actuation.force_direction is None:
        return NOWHERE
    return np.linalg.svd(np.asarray(actuation.force_direction, dtype=float)[None, :])[2][1:]


def _residual(frame: TrackedFrame, found: FrameFit) -> float:
    """Largest of the sensors' residuals, dimensionless: |position error| over the exposed length, and the turn."""
    outside = frame.distal_length_m + frame.actuation[0]
    return max(math.hypot(np.linalg.norm(row[:3]) / outside, np.linalg.norm(row[3:])) for row in found.residual)
