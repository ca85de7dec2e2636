"""The catheter rig's twin: handle -> insertion, roll, curvature -> shape -> contact -> sensors, a port at every link."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from host.diagnosis.estimation.noise import by_steps, estimate, quiescent
from host.diagnosis.model.dataset import Recording
from host.diagnosis.model.effect import Candidate, Context, Parameter, Port
from host.diagnosis.model.model import ActiveEffect, Model, Output, Segment, apply_effects, tolerance_of
from host.diagnosis.model.nominal import ChannelSpec, NominalSpec
from host.diagnosis.model.operators import calm, fill
from host.diagnosis.models.rig_kernel import (
    Handle,
    Loads,
    ShaftBuild,
    Wall,
    contact,
    drag_along,
    matrices,
    rotation_logs,
    shapes,
)
from protocol.errors import Description, InputError

Array = npt.NDArray[np.float64]
HANDLES = {
    "handle_insertion": ("handle_insertion_m", "m"),
    "handle_roll": ("handle_roll_rad", "rad"),
    "handle_knob": ("handle_knob_rad", "rad"),
}
TIP = ("tip_x_m", "tip_y_m", "tip_z_m", "tip_qw", "tip_qx", "tip_qy", "tip_qz")
SHAFT = tuple(name.replace("tip", "shaft") for name in TIP)
FORCE = ("force_x_N", "force_y_N", "force_z_N")
POSES = 12  # outputs of poses: place and turn of tip and shaft, three each; then those of the force
POSE_ROWS, FORCE_ROWS = slice(0, POSES), slice(POSES, POSES + len(FORCE))
PARAMETERS = (
    ("insertion_gain", "", 1.0),
    ("insertion_offset", "m", 0.0),
    ("roll_slope", "", 1.0),
    ("roll_offset", "rad", 0.0),
    ("knob_gain", "1/(m rad)", 30.0),
    ("knob_offset", "1/m", 0.0),
    ("bending_stiffness", "N m2", 3e-4),
    ("wall_distance", "m", 0.04),
    ("wall_stiffness", "N/m", 1000.0),
)
TOUCH_M = 1e-3  # natural size of a place: slopes by its thousandth stay within the depth of a press
KEYS = {
    "insertion_offset": "insertion_offset_m",
    "roll_offset": "roll_offset_rad",
    "knob_gain": "knob_gain_per_m_rad",
    "knob_offset": "knob_offset_per_m",
    "bending_stiffness": "bending_stiffness_N_m2",
    "wall_distance": "wall_distance_m",
    "wall_stiffness": "wall_stiffness_N_per_m",
}
AXES = ("insertion", "roll", "knob")
FAINT = 0.5  # noise of the force sensor over RMS of the force, above which the force is taken from the model


def rig_channels(spec: NominalSpec) -> tuple[dict[str, ChannelSpec], set[str]]:
    """Channels of the rig under their default columns, renamed where `[channels]` says so; shaft and force may be absent."""
    needed = {name: ChannelSpec(column=column, unit=unit) for name, (column, unit) in HANDLES.items()}
    needed |= {name: ChannelSpec(column=name, unit=_unit(name)) for name in (*TIP, *SHAFT, *FORCE)}
    for name, channel in spec.channels.items():
        if name not in needed:
            raise InputError(f"channels.{name}", name, "one of " + ", ".join(needed))
        wanted = needed[name].unit
        if channel.unit not in ("", wanted):
            known = f"{wanted}, the unit of the value after scale, sign and offset" if wanted else "no unit"
            raise InputError(f"channels.{name}.unit", channel.unit, Description(known))
        needed[name] = channel.model_copy(update={"unit": wanted})
    return needed, {*SHAFT, *FORCE}


def _unit(name: str) -> str:
    return name.rsplit("_", 1)[1] if name.endswith(("_m", "_N")) else ""


@dataclass
class RigSegment(Segment):
    """A recording with the force that loads the shape, and the rotations that turns are measured from."""

    force: Array = field(default_factory=lambda: np.zeros((3, 0)))  # (3, n) on the wall, base frame
    beyond: Array | None = None  # (3, n) part of the recorded force that simulation and noise do not explain
    reference: tuple[Array, ...] = ()  # of tip and shaft
    exact: Array | None = None  # (outputs, n) rod model minus the linear model
    force_noise: list[tuple[float, float]] = field(default_factory=list)  # of each force row: deviation, correlation time
    kept: dict[Any, tuple[Array, ...]] = field(default_factory=dict)  # shapes of the last two runs


class RigModel(Model):
    """Nominal model of kind `rig`. Outputs: tip position and turn, shaft position and turn, force; three rows each."""

    kind = "rig"
    fit_samples = 6000
    coarsest_s = 0.04
    screen_samples = 4000
    scan_points = 40
    pointwise = True

    def __init__(self, spec: NominalSpec) -> None:
        if spec.rig is None:
            raise ValueError("rig: found nothing, wanted a section")
        self.spec = spec.rig
        normal = np.array(self.spec.wall_normal)
        if not np.linalg.norm(normal) > 0.0:
            raise InputError("rig.wall_normal", self.spec.wall_normal, "a vector that is not zero")
        self.normal = normal / np.linalg.norm(normal)
        parameters = []
        for name, unit, default in PARAMETERS:
            value, free = spec.start(KEYS.get(name, name), default)
            positive = name in ("bending_stiffness", "wall_stiffness")
            low, high = (value, value) if not free else (0.02 * value, 50.0 * value) if positive else (-np.inf, np.inf)
            step = TOUCH_M if unit == "m" else abs(value) or 1.0
            parameters.append(Parameter(name, unit, (value,), low, high, log=positive and free, step=step))
        self.parameters = tuple(parameters)
        self.outputs = tuple(
            [
                Output(f"{part}_{axis}", unit, subsystem)
                for part, unit, subsystem in (
                    ("tip", "m", "shape"),
                    ("tip_turn", "rad", "shape"),
                    ("shaft", "m", "shape"),
                    ("shaft_turn", "rad", "shape"),
                    ("force", "N", "contact"),
                )
                for axis in "xyz"
            ]
        )
        loads = {"insertion": ("axial_force",), "roll": (), "knob": ("axial_force",)}
        poses = tuple(o.channel for o in self.outputs)
        self.ports = tuple(
            [
                Port(
                    axis,
                    "motion+turn" if axis == "roll" else "motion",
                    axis,
                    poses,
                    loads[axis],
                    tuple(f"handle_{other}" for other in AXES if other != axis),
                    ("axial_force", "curvature"),
                )
                for axis in AXES
            ]
            + [
                Port(name, kind, name, poses)
                for name, kind in (
                    ("shape", "shape"),
                    ("contact", "contact"),
                    ("pose_sensor", "pose"),
                    ("force_sensor", "forces"),
                    ("base", "base"),
                )
            ]
        )
        units = {"insertion": "m", "roll": "rad", "knob": "rad"}
        self.travel = (*((axis, f"handle_{axis}", units[axis]) for axis in AXES), ("force", "axial_force", "N"))
        self.unlisted_at = tuple((axis, axis) for axis in AXES)
        self.moves = {axis: f"handle_{axis}" for axis in AXES}
        self.quiet_inputs = tuple(HANDLES)

    def prepare(self, recording: Recording) -> RigSegment:
        """Poses as positions and rotation matrices; forces bridged; loads derived."""
        n = recording.n
        channels = recording.channels
        missing = np.full(n, np.nan)
        inputs = {name: fill(channels[name]) for name in HANDLES}
        for axis in AXES:
            inputs[f"motion:{axis}"] = inputs[f"handle_{axis}"]
        force = np.vstack([channels.get(name, missing) for name in FORCE])
        poses = [np.vstack([channels.get(name, missing) for name in names]) for names in (TIP, SHAFT)]
        force_noise = self._force_noise(recording, inputs, force)
        given = np.vstack([calm(fill(row), *s) for row, s in zip(force, force_noise, strict=True)])
        tolerances = {}
        for axis in AXES:
            motion = inputs[f"handle_{axis}"]
            tolerances[axis] = tolerance_of(motion, float(np.ptp(motion)))
        units = {
            "insertion": "m",
            "output:insertion": "m",
            "roll": "rad",
            "output:roll": "rad",
            "knob": "rad",
            "output:knob": "1/m",
            "shape": "1/m",
            "contact": "N",
            "pose_sensor": "m",
            "force_sensor": "N",
            "base": "m",
            "axial_force": "N",
            "curvature": "1/m",
            "handle_insertion": "m",
            "handle_roll": "rad",
            "handle_knob": "rad",
        }
        inputs["axial_force"] = self.normal @ given
        theta = np.array([p.grid[0] for p in self.parameters])
        inputs["curvature"] = theta[4] * inputs["handle_knob"] + theta[5]
        nothing = np.full((len(self.outputs), n), np.nan)
        segment = RigSegment(recording, nothing, recording.fit, recording.heldout, inputs, units, tolerances)
        segment.force, segment.force_noise = np.zeros((3, n)), force_noise
        run = self._run(segment, theta, [])
        segment.force = given
        segment.reference = (run["tip_R"], run["shaft_R"])
        rows = []
        for pose, reference in zip(poses, segment.reference, strict=True):
            norm = np.sqrt(np.sum(pose[3:] ** 2, axis=0))
            good = np.isfinite(pose).all(axis=0) & (np.abs(norm - 1.0) < 0.05)
            turn = rotation_logs(reference, matrices(np.where(good, pose[3:], np.array([1.0, 0.0, 0.0, 0.0])[:, None])))
            rows += [np.where(good, pose[:3], np.nan), np.where(good, turn, np.nan)]
        segment.y = np.vstack([*rows, force])
        return segment

    def _force_noise(self, recording: Recording, inputs: dict[str, Array], force: Array) -> list[tuple[float, float]]:
        still = [quiescent([inputs[name] for name in HANDLES], recording.dt_s, recording.timed)]
        found = [estimate([row], still) for row in force]
        return [(noise.sigma, noise.correlation_samples) for noise in found]

    def settle(self, segment: Segment, theta: Array) -> None:
        """Recorded force as the shape's input: simulated contact force plus what of the difference is surely not noise.

        Sensor noise would bend the simulated shaft and be seen in its pose; a smooth force alone would miss the instant
        of contact. Where the sensor says next to nothing (noise above FAINT of the force), the simulated force goes on
        following the parameters in the fit, so that force and stiffness cannot drift off together.
        """
        assert isinstance(segment, RigSegment)
        recorded = segment.y[FORCE_ROWS]
        if not np.isfinite(recorded).any():
            segment.force = self._run(segment, theta, [])["force"]
            return
        simulated = self.simulate(segment, theta, [])[FORCE_ROWS]
        sigmas = [by_steps(row, *s) for row, s in zip(recorded - simulated, segment.force_noise, strict=True)]
        beyond = np.vstack([calm(fill(row), *s, True) for row, s in zip(recorded - simulated, sigmas, strict=True)])
        segment.force = simulated + beyond
        if max(segment.force_noise)[0] > FAINT * float(np.sqrt(np.mean(np.sum(segment.force**2, axis=0)))):
            segment.beyond = beyond
        else:
            segment.beyond = None
        segment.inputs["axial_force"] = self.normal @ segment.force

    def guess(self, segments: list[Segment]) -> Array:
        """The calibrated values of the TOML."""
        return np.array([p.grid[0] for p in self.parameters])

    def simulate(self, segment: Segment, theta: Array, active: list[ActiveEffect]) -> Array:
        """Outputs (15, n), free run from the handle and the recorded force."""
        assert isinstance(segment, RigSegment)
        run = self._run(segment, theta, active)
        reference = segment.reference
        return np.vstack(
            [
                run["tip"],
                rotation_logs(reference[0], run["tip_R"]),
                run["shaft"],
                rotation_logs(reference[1], run["shaft_R"]),
                run["force"],
            ]
        )

    def links(self, segment: Segment, theta: Array, active: list[ActiveEffect]) -> tuple[Array, Array, Array]:
        """Insertion, roll and curvature (n,) behind the three axes."""
        out = []
        for index, axis in enumerate(AXES):
            signal = apply_effects(segment.inputs[f"handle_{axis}"], active, axis, segment, "input")
            signal = theta[2 * index] * signal + theta[2 * index + 1]
            out.append(apply_effects(signal, active, axis, segment, "output"))
        return out[0], out[1], out[2]

    def _run(self, segment: RigSegment, theta: Array, active: list[ActiveEffect]) -> dict[str, Any]:
        insertion, roll, kappa = self.links(segment, theta, active)
        n = segment.n
        state: dict[str, Any] = {
            "insertion": insertion,
            "roll": roll,
            "kappa": kappa,
            "flex": np.full(n, 1.0 / theta[6]),
            "extra": np.zeros((3, n)),
            "load": np.zeros((3, n)),
            "point": np.zeros((3, n)),
            "point_at": np.zeros(n),
            "push": segment.force,
            "shift": np.zeros((3, n)),
            "normal": self.normal,
            "distal": self.spec.distal_length_m,
        }
        state["push"] = 2.0 * state["push"] - _vector(state["push"], active, "force_sensor", segment)
        prompt = state["push"]
        state = _changed(state, active, "shape", segment)
        slow = state["push"] - prompt
        state = _changed(state, active, "base", segment)
        shape = self._shapes(segment, state)
        free, soft = shape[4:]
        placed = (np.einsum("abn,bn->an", state["turn"], free) if "turn" in state else free) + state["shift"]
        law: dict[str, Any] = {
            "gap": self.normal @ placed - theta[7] - (self.normal @ soft) * (self.normal @ slow),
            "stiffness": np.full(n, theta[8]),
            "exponent": 1.0,
            "reference": 1e-3,
            "damping": 0.0,
            "crossley": 0.0,
            "relax": 0.0,
            "relax_time": 0.0,
            "friction": 0.0,
            "friction_distance": 1e-3,
        }
        law = _changed(law, active, "contact", segment)
        normal_force = _pressed(law, self.normal @ soft, segment.recording.dt_s)
        force = self.normal[:, None] * normal_force
        if segment.beyond is not None:
            shape = self._shapes(segment, {**state, "push": force + segment.beyond})
        run = _posed(shape, state)
        if law["friction"]:
            along = run["tip"] - self.normal[:, None] * (self.normal @ run["tip"])
            drag = law["friction"] * drag_along(along, law["friction_distance"])
            normal_force = _pressed(law, self.normal @ soft + np.sum(soft * drag, axis=0), segment.recording.dt_s)
            force = (self.normal[:, None] + drag) * normal_force
        run["force"] = _vector(force, active, "force_sensor", segment)
        return _changed(run, active, "pose_sensor", segment)

    def _shapes(self, segment: RigSegment, state: dict[str, Any]) -> tuple[Array, ...]:
        """Kernel call; the last two results are kept, since contact and sensors change without the shape."""
        key = tuple(
            hash(np.ascontiguousarray(state[name]).tobytes())
            for name in ("insertion", "roll", "kappa", "push", "extra", "load", "point", "point_at", "flex")
        )
        kept = segment.kept
        if key not in kept:
            while len(kept) > 1:
                kept.pop(next(iter(kept)))
            kept[key] = shapes(
                Handle(state["insertion"], state["roll"], state["kappa"]),
                Loads(-state["push"], state["extra"], state["load"], state["point"], state["point_at"]),
                ShaftBuild(
                    state["flex"],
                    1.0 / self.spec.torsion_to_bending,
                    self.spec.distal_length_m,
                    self.spec.shaft_sensor_offset_m,
                ),
                self.normal,
            )
        return kept[key]

    def slopes(self, segment: Segment, theta: Array, active: list[ActiveEffect]) -> dict[str, Array]:
        """Sensitivity of the outputs (15, n) to each axis."""
        return {axis: self.sensitivity(segment, theta, axis, active) for axis in AXES}

    def moved(self, segment: Segment, theta: Array, candidate: Candidate, values: Array) -> Array:
        """Change (n,) by a candidate of the signal that enters its axis."""
        axis = candidate.port.name
        index = AXES.index(axis)
        q = segment.inputs[f"handle_{axis}"]
        gain = theta[2 * index]
        side = candidate.effect.side
        signal = q if side == "input" else gain * q + theta[2 * index + 1]
        moved = apply_effects(signal, [(candidate, values)], axis, segment, side) - signal
        return np.asarray(moved if side == "input" else moved / gain)

    def motion(self, segment: Segment, port: Port) -> Array:
        """Handle motion at the axes; else a signal of the port's unit that shows its size."""
        if port.name in AXES:
            return segment.inputs[f"handle_{port.name}"]
        if port.name in ("contact", "force_sensor"):
            return segment.inputs["axial_force"]
        return (
            segment.inputs["curvature"]
            if port.name == "shape"
            else np.nan_to_num(segment.y[0]) - np.nan_to_num(segment.y[2])
        )

    def needs(self, segment: Segment, port: Port, theta: Array, residual: Array) -> Array:
        """Return the signal that the port lacks: least squares over the pose rows by the port's sensitivity; the residual
        itself at the sensors.
        """
        if port.name in AXES:
            S = self.sensitivity(segment, theta, port.name, [])
            weight = segment.weights()[POSE_ROWS]
            r = np.nan_to_num(residual[POSE_ROWS]) / weight
            s = np.where(np.isfinite(residual[POSE_ROWS]), S[POSE_ROWS], 0.0) / weight
            return np.asarray(np.sum(s * r, axis=0) / (np.sum(s * s, axis=0) + 1e-12 * np.mean(s * s) + 1e-300))
        row = 14 if port.name in ("contact", "force_sensor") else 0
        return np.asarray(residual[row])

    def sensitivity(self, segment: Segment, theta: Array, axis: str, active: list[ActiveEffect]) -> Array:
        """Change of outputs (15, n) per change of the signal that enters `axis`, by a central difference."""
        index = AXES.index(axis)
        step = 1e-5 if axis == "insertion" else 1e-4
        out = []
        for sign in (1.0, -1.0):
            moved = theta.copy()
            moved[2 * index + 1] += sign * step * theta[2 * index]
            out.append(self.simulate(segment, moved, active))
        return np.asarray((out[0] - out[1]) / (2.0 * step))


def _pressed(law: dict[str, Any], soft: Array, dt_s: float) -> Array:
    """Normal force (n,) of the contact law on a shaft of compliance `soft` (n,) along the normal."""
    return np.asarray(contact(law["gap"], soft, Wall(*(law[name] for name in Wall._fields)), dt_s))


def _posed(shape: tuple[Array, ...], state: dict[str, Any]) -> dict[str, Any]:
    """Tip and shaft of `shape` where the base has moved them."""
    run: dict[str, Any] = dict(zip(("tip", "tip_R", "shaft", "shaft_R"), shape, strict=False))
    for name in ("tip", "shaft"):
        run[name] = run[name] + state["shift"]
        if "turn" in state:
            run[name] = np.einsum("abn,bn->an", state["turn"], run[name])
            run[f"{name}_R"] = np.einsum("abn,bcn->acn", state["turn"], run[f"{name}_R"])
    return run


def _changed(state: dict[str, Any], active: list[ActiveEffect], port: str, segment: Segment) -> dict[str, Any]:
    """`state` after the active effects at a port of the rig's own kinds; they change it by key."""
    here = sorted((effect for effect in active if effect[0].port.name == port), key=lambda effect: effect[0].effect.order)
    if not here:
        return state
    state = dict(state)
    for candidate, values in here:
        if candidate.effect.apply is not None:
            state = candidate.effect.apply(state, _context(segment, candidate.source), values, candidate.form)  # type: ignore[arg-type,assignment]
    return state


def _vector(force: Array, active: list[ActiveEffect], port: str, segment: Segment) -> Array:
    """A force (3, n) as its sensor would read it."""
    for candidate, values in sorted(
        (effect for effect in active if effect[0].port.name == port), key=lambda effect: effect[0].effect.order
    ):
        if candidate.effect.apply is not None:
            force = candidate.effect.apply(force, _context(segment, candidate.source), values, candidate.form)
    return force


def _context(segment: Segment, source: str) -> Context:
    return Context(
        segment.recording.time_s,
        segment.recording.dt_s,
        segment.inputs["motion:insertion"],
        0.0,
        0.0,
        segment.inputs[source] if source else None,
        segment.equations,
    )
