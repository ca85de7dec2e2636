"""A model file of MuJoCo as nominal model: actuators go in, sensors come out, joints and bodies offer effects."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from host.diagnosis.model.effect import spread
from host.diagnosis.model.model import Segment
from host.diagnosis.model.nominal import NominalSpec, OfferSpec
from host.diagnosis.models.simulated import SimulatedModel, first_state
from protocol.errors import Description, InputError

Array = npt.NDArray[np.float64]
ELEMENTS = ("joint", "actuator", "body", "geom", "tendon", "site")
PAYLOAD_KG = 1e-9  # mass of the body that a payload is put on, before there is one
PAYLOAD_INERTIA_KG_M2 = 1e-12  # of that body about itself: next to none
WHOLE_STEPS = 1e-6  # deviation of a recording's period from whole steps of MuJoCo, relative
# Offered attribute of a joint: vocabulary id, sizes to try in units of the joint's inertia, unit for hinge and slide.
OF_JOINT = {
    "frictionloss": ("coulomb_friction", (0.05, 100.0), "N m", "N"),  # times an acceleration
    "damping": ("viscous_friction", (0.05, 50.0), "N m s", "N s/m"),  # per time
    "stiffness": ("nonlinear_stiffness", (0.5, 5000.0), "N m/rad", "N/m"),  # squared frequency
    "armature": ("resonance", (0.02, 3.0), "kg m2", "kg"),
}
PAYLOAD_OF_MASS = (0.02, 3.0)
GEAR_RATIO = 3.0  # a gear is offered between its nominal value over and times this
TRIED = 5


class MujocoModel(SimulatedModel):
    """Nominal model of kind `mujoco`. Control is held between samples; a sample is a whole number of MuJoCo's steps."""

    kind = "mujoco"

    def __init__(self, spec: NominalSpec) -> None:
        if spec.mujoco is None:
            raise ValueError("mujoco: found nothing, wanted a section")
        self.spec = spec.mujoco
        self.path = Path(spec.folder, self.spec.model)
        offers = list(spec.offer)
        if self.spec.offers == "all":
            offers += self._own_offers({*spec.parameters, *(one.parameter for one in offers)})
        self.offs = {one.parameter: one.off for one in offers}
        names = [*spec.parameters, *self.offs]
        payloads = [name.removesuffix(".payload") for name in names if name.endswith(".payload")]
        self.mjcf = compiled(self.path, payloads)
        for name in names:
            place(self.mjcf, name)
        super().__init__(spec, self.spec, offers)
        self.steps_s = float(self.mjcf.opt.timestep)
        self.controls = {name: self._id("actuator", self.spec.actuators.get(name, name)) for name in self.spec.inputs}
        self.readings = {name: self._id("sensor", self.spec.sensors.get(name, name)) for name in self.spec.outputs}

    @property
    def label(self) -> str:
        """Return the name of the model file."""
        return self.path.name

    def _id(self, kind: str, name: str) -> int:
        named: Any = getattr(self.mjcf, kind)
        try:
            return int(named(name).id)
        except KeyError as error:
            raise InputError(f"mujoco.{kind}s", name, Description(f"one of {self.path.name}: {one_line(error)}")) from None

    def _own_offers(self, taken: set[str]) -> list[OfferSpec]:
        """Friction, damping, stiffness and inertia of joints, payload of their bodies, and gears, all off as in the file."""
        import mujoco

        model = compiled(self.path, [])
        mujoco.mj_forward(model, mujoco.MjData(model))
        found: dict[str, OfferSpec] = {}
        for k in range(model.njnt):
            joint = model.joint(k)
            kind = mujoco.mjtJoint(int(model.jnt_type[k]))
            if kind not in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE) or not joint.name:
                continue
            hinge = kind == mujoco.mjtJoint.mjJNT_HINGE
            inertia = float(model.dof_M0[model.jnt_dofadr[k]])
            for attribute, (effect, sizes, turning, sliding) in OF_JOINT.items():
                off = float(np.ravel(getattr(joint, attribute))[0])
                name, unit = f"{joint.name}.{attribute}", turning if hinge else sliding
                tried = spread(inertia * sizes[0], inertia * sizes[1], TRIED)
                found[name] = offer(effect, name, joint.name, off, 30.0 * tried[-1] + off, tried, unit)
            body = model.body(int(model.jnt_bodyid[k]))
            if body.name and float(body.mass[0]) > 0.0:
                tried = spread(float(body.mass[0]) * PAYLOAD_OF_MASS[0], float(body.mass[0]) * PAYLOAD_OF_MASS[1], TRIED)
                name = f"{body.name}.payload"
                found[name] = offer("gravity_load", name, body.name, 0.0, 30.0 * tried[-1], tried, "kg")
        for name in self.spec.actuators.values():
            gear = float(model.actuator(name).gear[0])
            low, high = sorted((gear / GEAR_RATIO, gear * GEAR_RATIO))
            parameter, tried = f"{name}.gear", (0.8 * gear, 1.25 * gear)
            found[parameter] = OfferSpec(
                id="sensor_scale", parameter=parameter, subsystem=name, off=gear, low=low, high=high, tried=list(tried)
            )
        return [one for name, one in found.items() if name not in taken]

    def initial_state(self, segment: Segment) -> tuple[list[str], list[float], list[float]]:
        """Positions and speeds of the joints that a sensor reads; others start as in the file."""
        names: list[str] = []
        means: list[float] = []
        sds: list[float] = []
        seen = {self._joint_of(name): name for name in self.spec.outputs}
        for row, name in zip(segment.y, self.spec.outputs, strict=True):
            joint = self._joint_of(name)
            if joint is None:
                continue
            (value, rate), (value_sd, rate_sd) = first_state(row, segment.recording.dt_s)
            names, means, sds = [*names, name], [*means, value], [*sds, value_sd]
            if joint[0] == "position" and ("speed", joint[1]) not in seen:
                names, means, sds = [*names, f"{name}_rate"], [*means, rate], [*sds, rate_sd]
        return names, means, sds

    def _joint_of(self, channel: str) -> tuple[str, int] | None:
        return read_joint(self.mjcf, self.readings[channel])

    def run(
        self, inputs: dict[str, Array], parameters: dict[str, float], time_s: Array, initial: dict[str, float]
    ) -> Mapping[str, Array]:
        """Simulate with the control held between samples; sensors are read where a step begins."""
        put(self.mjcf, {**self.offs, **parameters})
        return rolled(self.mjcf, (self.controls, self.readings), self.steps_s, inputs, time_s, initial)


def put(model: Any, values: dict[str, float]) -> None:
    """Set parameters of the compiled model, and what MuJoCo derives from them."""
    import mujoco

    for name, value in values.items():
        array, index = place(model, name)
        array[index] = value
    mujoco.mj_setConst(model, mujoco.MjData(model))


def read_joint(model: Any, sensor: int) -> tuple[str, int] | None:
    """Return the quantity that a sensor reads of a joint (position or speed) and the joint; None for another sensor."""
    import mujoco

    kinds = {mujoco.mjtSensor.mjSENS_JOINTPOS: "position", mujoco.mjtSensor.mjSENS_JOINTVEL: "speed"}
    kind = kinds.get(mujoco.mjtSensor(int(model.sensor_type[sensor])))
    return None if kind is None else (kind, int(model.sensor_objid[sensor]))


def rolled(
    model: Any,
    ids: tuple[dict[str, int], dict[str, int]],
    longest_step_s: float,
    inputs: dict[str, Array],
    time_s: Array,
    initial: dict[str, float],
) -> dict[str, Array]:
    """Sensors (n,) by channel of a run with the control held between samples.

    ids: actuator of each input and sensor of each output. A sample is a whole number of steps, none longer than
    `longest_step_s`. Sensors are read where a step begins, so that the first sample is the initial state.
    """
    import mujoco
    from mujoco import rollout

    controls, readings = ids
    dt_s = float(np.median(np.diff(time_s)))
    steps = max(1, int(np.ceil(dt_s / longest_step_s * (1.0 - WHOLE_STEPS))))
    model.opt.timestep = dt_s / steps
    data = mujoco.MjData(model)
    for name, value in initial.items():
        channel, rate = (name, False) if name in readings else (name.removesuffix("_rate"), True)
        joint = read_joint(model, readings[channel])
        if joint is not None:
            speed = rate or joint[0] == "speed"
            (data.qvel if speed else data.qpos)[(model.jnt_dofadr if speed else model.jnt_qposadr)[joint[1]]] = value
    control = np.zeros((time_s.size, model.nu))
    for name, signal in inputs.items():
        control[:, controls[name]] = signal
    full = mujoco.mjtState.mjSTATE_FULLPHYSICS
    begin = np.zeros(mujoco.mj_stateSize(model, full))
    mujoco.mj_getState(model, data, begin, full)
    _, read = rollout.rollout(model, data, begin[None], np.repeat(control, steps, axis=0)[None])
    rows = read[0, ::steps]
    return {name: np.array(rows[:, int(model.sensor_adr[at])]) for name, at in readings.items()}


def offer(
    effect: str, parameter: str, subsystem: str, off: float, high: float, tried: tuple[float, ...], unit: str
) -> OfferSpec:
    """Return the offer of one attribute of the file, from nothing to `high`."""
    values = [off + value for value in tried]
    return OfferSpec(id=effect, parameter=parameter, subsystem=subsystem, off=off, high=high, tried=values, unit=unit)


def compiled(path: Path, payloads: list[str]) -> Any:
    """The compiled model of `path`, with a body of next to no mass for each of `payloads` (bodies or sites).

    Raises:
        InputError: the file cannot be read, or there is no such body.
    """
    model = specified(path, dict.fromkeys(payloads, PAYLOAD_KG))
    try:
        return model.compile()
    except ValueError as error:
        raise InputError(
            "mujoco.model", Description(f"{path}: {one_line(error)}"), "a model file that MuJoCo compiles"
        ) from None


def specified(path: Path, payloads: dict[str, float]) -> Any:
    """The model file as MuJoCo's own specification, with a point mass (kg) at each of `payloads`. Raises InputError."""
    import mujoco

    try:
        model = mujoco.MjSpec.from_file(str(path))
    except (ValueError, OSError) as error:
        raise InputError(
            "mujoco.model", Description(f"{path}: {one_line(error)}"), "a model file of MuJoCo (MJCF)"
        ) from None
    for name, mass in payloads.items():
        parent, at = carrier(path, model, name)
        added = parent.add_body(name=f"{name}_payload", pos=at)
        added.mass, added.inertia, added.explicitinertial = mass, [PAYLOAD_INERTIA_KG_M2] * 3, True
        added.ipos = [0.0, 0.0, 0.0]  # left out, MuJoCo takes the body's place for it: the mass would be twice as far
    return model


def one_line(error: Exception) -> str:
    """MuJoCo's message, which spans several lines, as one."""
    return " ".join(str(error).split())


def carrier(path: Path, model: Any, name: str) -> tuple[Any, list[float]]:
    """Body that carries the payload at body or site `name`, and the place in it. Raises InputError."""
    body, site = model.body(name), model.site(name)
    if body is None and site is None:
        raise InputError("mujoco", f"{name}.payload", f"a body or site of {path.name}")
    at = model.copy().compile().body(name).ipos if body is not None else site.pos
    return (body if body is not None else site.parent), [float(x) for x in at]


def place(model: Any, name: str) -> tuple[Array, int]:
    """Array of the compiled model and index in it of parameter `element.attribute`. Raises InputError."""
    element, _, attribute = name.rpartition(".")
    if attribute == "payload":
        element, attribute = f"{element}_payload", "mass"
    for kind in ELEMENTS:
        try:
            found = getattr(getattr(model, kind)(element), attribute)
        except (KeyError, AttributeError):
            continue
        return found.reshape(-1), 0
    raise InputError("mujoco", name, "element.attribute of the model file, such as hinge.damping or forearm.mass")
