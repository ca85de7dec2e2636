"""The running rig's planar estimator: both tracked poses, projected by roll, with play in insertion and curvature.

An error of 1 mm in the insertion would read as 0.1 N, so the errors of insertion and curvature are estimated along with
the force and followed from pose to pose; the second sensor separates them from the force. The poses show no force out of
the plane: without a commanded contact it is reported as zero with `out_of_plane_sd_N`. With one it follows from the force in
the plane, because the force then points along the commanded direction, within `tangential_sd_N`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from host.estimation.contact_knowledge import ContactKnowledge
from host.estimation.interface import Actuation, PoseReading, TipForce
from host.estimation.lasting_errors import (
    CURVATURE,
    INSERTION,
    NOWHERE,
    ROLL,
    ActuationKnowledge,
    LastingErrors,
    Prior,
    lasting_part,
)
from host.estimation.planar import UNSEEN_STD_N, tip_covariance
from host.estimation.reach import check_reach
from host.estimation.sensor_noise import TrackedSensors
from host.mechanics.pcar import Arcs, Equilibrium, arcs_of, point_at, pose_sensitivity, solve
from host.mechanics.rod import finite
from protocol.catheter import Catheter, load_catheter
from protocol.rig_file import Rig

Array = NDArray[np.float64]

_FOLLOWED = (INSERTION, CURVATURE)
STEPS = 12
LONGEST_ARC_m = 0.0056  # the 11 mm arcs of the catheter file, halved: 0.1 % of the force
END_N = 1e-6
LARGEST_FORCE_STEP_N = 0.1
FORCE_LIMIT_N = 2.0
LEAST_IN_PLANE = 0.1  # of the commanded direction: with less of it in the plane nothing is known of the force there
CHI_SQUARE_PER_FREEDOM = 12.0  # about 3.5 standard deviations throughout: beyond it no force explains the poses


@dataclass(frozen=True)
class _Prior:
    mean: Array  # (4,) as the parameters of a fit
    information: Array  # (4, 4)
    of_lasting: Array  # (4, 4) the part of it on the actuation's errors and the force along the wall


@dataclass(frozen=True)
class _Fit:
    parameters: Array  # force x, y (N), insertion error (m), curvature error (1/m)
    information: Array  # (4, 4)
    covariance: Array  # (4, 4)
    chi_square: float
    residual: float
    ended: bool


def bending_plane(roll_rad: float) -> tuple[Array, Array]:
    """Unit vectors in the base frame: y of the planar model, and the plane's normal (e1 at roll 0)."""
    cosine, sine = math.cos(roll_rad), math.sin(roll_rad)
    return np.array([sine, -cosine, 0.0]), np.array([cosine, sine, 0.0])


def tangent_of(quaternion_wxyz: Array) -> Array:
    """The catheter's direction (third axis of the sensor's frame) in the base frame."""
    w, x, y, z = quaternion_wxyz
    return np.array([2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)])


class PlanarRigEstimator:
    """Implements `host.estimation.interface.Estimator` with the planar model. Keeps only the branch it is on."""

    def __init__(
        self,
        catheter: Catheter,
        sensors: TrackedSensors,
        knowledge: ActuationKnowledge,
        contact: ContactKnowledge | None = None,
    ) -> None:
        self._catheter, self._sensors = catheter, sensors
        self._weight = np.linalg.inv(tip_covariance(sensors.position_std_m, sensors.angle_std_rad))
        self._contact = contact or ContactKnowledge()
        self._roll_sd_rad = knowledge.start[ROLL]
        self.errors = LastingErrors(knowledge, self._contact.tangential_sd_N)
        self._branch = np.zeros(2)

    @classmethod
    def from_rig(cls, rig: Rig) -> PlanarRigEstimator:
        """For the catheter and the tracker of a rig file. Raises InputError where the catheter is not known."""
        return cls(
            load_catheter(rig.catheter.name),
            TrackedSensors.from_rig(rig),
            ActuationKnowledge.from_rig(rig),
            ContactKnowledge.from_rig(rig),
        )

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
        """The force of the tip on the tissue, base frame, that explains the poses. Raises: ValueError (bad input)."""
        finite("pose_tip", [*pose_tip.position_m, *pose_tip.quaternion_wxyz], (7,), "finite position and quaternion")
        finite("actuation", actuation[:3], (3,), "three finite numbers")
        arcs_of(self._catheter, actuation.insertion_m, actuation.curvature_per_m)  # refuses what is out of range
        outside = self._catheter.distal_length_m + actuation.insertion_m
        check_reach("pose_tip.position_m", pose_tip.position_m, outside)
        y_axis, normal = bending_plane(self._roll(pose_tip, actuation))
        poses = {0.0: self._planar(pose_tip, y_axis, actuation)}
        seen = pose_shaft is not None and np.isfinite([*pose_shaft.position_m, *pose_shaft.quaternion_wxyz]).all()
        if pose_shaft is not None and seen and self._sensors.shaft_offset_m < outside - 1e-3:
            check_reach("pose_shaft.position_m", pose_shaft.position_m, outside)
            poses[self._sensors.shaft_offset_m] = self._planar(pose_shaft, y_axis, actuation)
        self.errors.move_to(actuation)
        axes = np.column_stack([np.array([0.0, 0.0, 1.0]), y_axis])
        known = self.errors.prior(self._along_wall(actuation, axes), _FOLLOWED)
        prior = self._prior(actuation, axes, known)
        fit = self._fit(poses, actuation, prior, self._branch)
        if not fit.ended and self._branch.any():
            fit = self._fit(poses, actuation, prior, np.zeros(2))
        converged = fit.ended and fit.chi_square <= CHI_SQUARE_PER_FREEDOM * 3 * len(poses)
        if converged:
            self._learn(poses, actuation, known, _shown(known, axes), fit.parameters)
        self._branch = fit.parameters[:2] if converged else np.zeros(2)
        whole, unseen_sd_N = self._whole_force(actuation, axes, normal)
        force_N = -whole @ fit.parameters[:2]
        in_plane = fit.covariance[:2, :2]
        lasting_too = prior.of_lasting[:2, :2] - axes.T @ self.errors.information_of_one_pose(known.across) @ axes
        of_one_pose = np.linalg.inv(fit.information[:2, :2] - lasting_too)
        # A pose depends on force over stiffness, so a relative error of the stiffness is one of the force.
        stiffness = self._contact.stiffness_sd**2 * np.outer(force_N, force_N)
        unseen = unseen_sd_N**2 * np.outer(normal, normal)
        lasting = whole @ lasting_part(in_plane, of_one_pose) @ whole.T + stiffness + unseen
        total = whole @ in_plane @ whole.T + stiffness + unseen
        return TipForce(
            force_N,
            0.5 * (total + total.T),
            converged,
            fit.residual,
            pose_tip.stamp_ns,
            0.5 * (lasting + lasting.T),
        )

    def _learn(self, poses: dict[float, Array], actuation: Actuation, known: Prior, shown: Array, parameters: Array) -> None:
        """Take over what the poses told of the lasting errors: `parameters` of the fit, corrected by one step.

        Its sensitivities are those at the last force, which the noise of these poses did not reach
        (`spatial_rig_kernels.refit`).
        """
        here = self._linearize(poses, actuation, parameters)
        last = self._linearize(poses, actuation, np.array([*self._branch, *known.mean[len(known.across) :]]))
        if here is None or last is None:
            return
        held, loose = shown.T @ np.linalg.inv(known.covariance), np.eye(2) / self._contact.learned_sd(actuation) ** 2
        information, gradient = held @ shown, held @ (known.mean - shown @ parameters)
        information[:2, :2] += loose
        gradient[:2] -= loose @ parameters[:2]
        for (error, _), (_, jacobian) in zip(here, last, strict=True):
            information += jacobian.T @ self._weight @ jacobian
            gradient += jacobian.T @ self._weight @ error
        covariance = _capped(information)
        self.errors.learn(known, shown @ (parameters + covariance @ gradient), shown @ covariance @ shown.T)

    def _whole_force(self, actuation: Actuation, axes: Array, normal: Array) -> tuple[Array, float]:
        """Matrix (3, 2) that makes the whole force of its part in the plane, and the uncertainty (N) out of the plane.

        The force is f d + t u + ...: along the commanded direction d = p e + o n, and along the wall, u = -o e + p n. Here
        e is in the plane, n its normal, and t has the standard deviation `tangential_sd_N`. Both parts in the plane and out
        of it share f, so that F_n = (o / p) F_e + t / p.
        """
        if actuation.force_direction is None:
            return axes, self._contact.out_of_plane_sd_N
        direction = np.asarray(actuation.force_direction, dtype=float)
        along = axes.T @ direction
        p = float(np.linalg.norm(along))
        if p <= LEAST_IN_PLANE:
            return axes, self._contact.force_sd_N
        return axes + np.outer(normal, along) * (normal @ direction) / p**2, self._contact.tangential_sd_N / p

    @staticmethod
    def _along_wall(actuation: Actuation, axes: Array) -> Array:
        """Unit vector (1, 3) in the plane across the force that is commanded, base frame; (0, 3) if none is in it."""
        if actuation.force_direction is None:
            return NOWHERE
        along = axes.T @ np.asarray(actuation.force_direction, dtype=float)
        length = float(np.linalg.norm(along))
        return (axes @ np.array([-along[1], along[0]]) / length)[None, :] if length > LEAST_IN_PLANE else NOWHERE

    def _prior(self, actuation: Actuation, axes: Array, known: Prior) -> _Prior:
        """What is known before the poses are seen: of the force (x, y in the plane) and of what lasts."""
        shown = _shown(known, axes)
        held = shown.T @ np.linalg.inv(known.covariance)
        of_lasting = held @ shown
        information = of_lasting.copy()
        information[:2, :2] += np.eye(2) / self._contact.force_sd(actuation) ** 2
        mean: Array = np.linalg.solve(information, held @ known.mean).astype(np.float64)
        return _Prior(mean, information, of_lasting)

    def _roll(self, tip: PoseReading, actuation: Actuation) -> float:
        """Roll of the bending plane: the transmission's, corrected towards the plane that the tip lies in."""
        y_axis, normal = bending_plane(actuation.roll_rad)
        lateral, across = float(tip.position_m @ y_axis), float(tip.position_m @ normal)
        seen = lateral * lateral / self._sensors.position_std_m**2
        held = 1.0 / self._roll_sd_rad**2
        return actuation.roll_rad + math.atan2(across * lateral, lateral * lateral + 1e-12) * seen / (seen + held)

    @staticmethod
    def _planar(reading: PoseReading, y_axis: Array, actuation: Actuation) -> Array:
        tangent = tangent_of(np.asarray(reading.quaternion_wxyz))
        angle = math.atan2(float(tangent @ y_axis), float(tangent[2]))
        position = np.asarray(reading.position_m)
        # more than half a turn is resolved by the direction in which the shaft is bent
        if abs(angle) > 0.5 * math.pi and angle * actuation.curvature_per_m < 0.0:
            angle += math.copysign(2.0 * math.pi, actuation.curvature_per_m)
        return np.array([position[2], float(position @ y_axis), angle])

    def _fit(self, poses: dict[float, Array], actuation: Actuation, prior: _Prior, start: Array) -> _Fit:
        """Gauss-Newton on force, insertion error and curvature error from the force `start` (2,)."""
        held, mean = prior.information, prior.mean
        parameters, ended, chi_square, residual = np.array([*start, *mean[2:]]), False, math.inf, math.inf
        information = held
        for _ in range(STEPS):
            linear = self._linearize(poses, actuation, parameters)
            if linear is None:
                parameters[:2] *= 0.5
                continue
            off = mean - parameters
            information, gradient = held.copy(), held @ off
            chi_square, residual = float(off @ held @ off), 0.0
            for error, jacobian in linear:
                information += jacobian.T @ self._weight @ jacobian
                gradient += jacobian.T @ self._weight @ error
                chi_square += float(error @ self._weight @ error)
                outside = self._catheter.distal_length_m + actuation.insertion_m
                residual = max(residual, math.hypot(*(error[:2] / outside), error[2]))
            step = np.linalg.solve(information, gradient)
            parameters = parameters + step * min(1.0, LARGEST_FORCE_STEP_N / max(np.hypot(*step[:2]), 1e-12))
            if not np.hypot(*parameters[:2]) < FORCE_LIMIT_N:
                break
            if np.hypot(*step[:2]) < END_N:
                ended = True
                break
        return _Fit(parameters, information, _capped(information), chi_square, residual, ended)

    def _linearize(
        self, poses: dict[float, Array], actuation: Actuation, parameters: Array
    ) -> list[tuple[Array, Array]] | None:
        """Error and Jacobian of each pose; None where the force has no equilibrium on the branch."""
        insertion = max(actuation.insertion_m + parameters[2], -self._catheter.distal_length_m + 1e-3)
        arcs = arcs_of(self._catheter, insertion, actuation.curvature_per_m + parameters[3], LONGEST_ARC_m)
        found = solve(arcs, parameters[:2])
        if not found.converged:
            return None
        return [self._one_pose(arcs, found, parameters[:2], back, pose) for back, pose in poses.items()]

    @staticmethod
    def _one_pose(arcs: Arcs, found: Equilibrium, force: Array, back_m: float, pose: Array) -> tuple[Array, Array]:
        back_m = min(back_m, arcs.total_length_m)
        position, angle = point_at(arcs, found.curvature_per_m, arcs.total_length_m - back_m)
        by = pose_sensitivity(arcs, found, force, back_m)
        jacobian = np.column_stack([by.by_force, by.by_insertion, by.by_curvature])
        return pose - np.array([*position, angle]), jacobian


def _shown(known: Prior, axes: Array) -> Array:
    """Matrix (m + 2, 4) that makes the force along the wall and both joints' errors of the parameters of a fit."""
    m = len(known.across)
    shown = np.zeros((m + 2, 4))
    shown[:m, :2], shown[m:, 2:] = known.across @ axes, np.eye(2)
    return shown


def _capped(information: Array) -> Array:
    """Inverse of the information, no variance beyond that of `UNSEEN_STD_N`."""
    scale = 1.0 / np.sqrt(np.diag(information))
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    inverse = (vectors / np.maximum(values, 1e-12)) @ vectors.T * np.outer(scale, scale)
    return np.asarray(inverse * min(1.0, UNSEEN_STD_N**2 / max(float(inverse[:2, :2].max()), 1e-300)))
