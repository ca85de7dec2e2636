"""One step of the plant as a compiled kernel: stages -> vessel and knob -> catheter <-> tissue, planted effects between."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from sim import axis_effects, catheter_chain, heart, knob, load_effects, rotation, tissue, vessel
from sim.random_stream import seeded

Array = np.ndarray
HISTORY = 1024  # steps that delayed sensors can look back
TOOLS = 4
SUBSTEP_S = 0.0005
_LOAD_PER_SUBSTEP = 12.0  # F L^2 / EI that half a millisecond follows without ringing

RIG_STATE = np.dtype(
    [
        ("time_s", "f8"),
        ("step", "i8"),
        ("handle", "f8", (3,)),
        ("last_handle", "f8", (3,)),
        ("stage", "f8", (3,)),
        ("load", "f8", (4,)),
        ("curvature", "f8"),
        ("last_curvature", "f8"),
        ("exit", "f8", (3,)),
        ("exit_frame", "f8", (3, 3)),
        ("offset", "f8", (TOOLS,)),
        ("tools", "i8"),
        ("random", "i8", (1,)),
        ("history_s", "f8", (HISTORY,)),
        ("history", "f8", (HISTORY, TOOLS, 7)),
        ("wrench", "f8", (HISTORY, 6)),
        ("frame", "f8", (3, 3)),
        ("free_tip", "f8", (3,)),
        ("lever", "f8", (3,)),
        ("last_pose", "f8", (TOOLS, 7)),
        ("last_wrench", "f8", (6,)),
    ],
    align=True,
)


class Parts(NamedTuple):
    """All records of one plant; or, to hand them to a kernel in a microsecond, arrays of one record each (`hold`)."""

    chain: Any
    chain_state: Any
    vessel: Any
    vessel_state: Any
    knob: Any
    knob_state: Any
    tissue: Any
    tissue_state: Any
    heart: Any
    heart_state: Any
    rig: Any
    effects: Any


def hold(parts: Parts) -> tuple[Parts, Parts]:
    """(arrays of one record each, for kernels; records that look into them) from freshly made records."""
    arrays = Parts._make([np.array([part], part.dtype) for part in parts[:-1]] + [parts.effects])
    return arrays, Parts._make([array[0] for array in arrays[:-1]] + [parts.effects])


def start(stage: tuple[float, float, float], offsets_m: tuple[float, ...], seed: int) -> np.record:
    """State of the rig at rest with the stages at `stage`. Raises ValueError for more tools than there is room for."""
    if len(offsets_m) > TOOLS or any(not 0.0 <= offset < 1.0 for offset in offsets_m):
        raise ValueError(f"tool_offsets_m: found {offsets_m}, wanted at most {TOOLS} numbers from 0 to 1")
    s = np.zeros(1, RIG_STATE).view(np.recarray)[0]
    for field in (s.handle, s.last_handle, s.stage):
        field[:] = stage
    s.exit_frame[...] = np.eye(3)
    s.tools = len(offsets_m)
    s.offset[: len(offsets_m)] = offsets_m
    s.random[0] = seeded(seed, 2)
    return s


@njit(cache=True)
def advance(parts: Parts, stage: Array, dt_s: float) -> None:
    """Advance all states by `dt_s` while the stages move to `stage` (3,). `parts`: the arrays of `hold`."""
    rig = parts.rig[0]
    rig.time_s += dt_s
    rig.step += 1
    for axis in range(3):
        rig.last_handle[axis] = rig.handle[axis]
        rig.handle[axis] = axis_effects.apply(
            parts.effects, axis, stage[axis], rig.load[axis], stage, rig.curvature, rig.time_s, dt_s
        )
        rig.stage[axis] = stage[axis]
    rig.last_curvature = rig.curvature
    wanted = knob.pull(parts.knob[0], parts.knob_state[0], rig.handle[2])
    rig.curvature = axis_effects.apply(parts.effects, 3, wanted, rig.load[3], stage, wanted, rig.time_s, dt_s)
    load_effects.move_base(parts.effects, rig.time_s, rig.exit, rig.exit_frame)
    load_effects.alter_tissue(parts.effects, parts.tissue[0], rig.time_s)
    count = _substeps(parts, dt_s)
    for k in range(count):
        _substep(parts, (k + 1.0) / count, rig.time_s - dt_s + dt_s * (k + 1.0) / count, dt_s / count)
    _remember(parts)


@njit(cache=True)
def _substeps(parts: Parts, dt_s: float) -> int:
    """Substeps for this step: half a millisecond each, shorter for a slender catheter under much load."""
    chain, force = parts.chain_state[0], parts.tissue_state[0].force
    size = math.sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2)
    load = size * chain.exposed_m**2 / parts.chain[0].rigidity[0, 0]
    return int(math.ceil(dt_s / SUBSTEP_S - 1e-9) * (1 + min(7, int(load / _LOAD_PER_SUBSTEP))))


@njit(cache=True)
def _substep(parts: Parts, share: float, time_s: float, dt_s: float) -> None:
    """Body, shape and contact by one substep; `share` of the way to the new handle position."""
    rig, chain, wall, body = parts.rig[0], parts.chain_state[0], parts.tissue_state[0], parts.vessel_state[0]
    handle = rig.last_handle[0] + share * (rig.handle[0] - rig.last_handle[0])
    turn = rig.last_handle[1] + share * (rig.handle[1] - rig.last_handle[1])
    curvature = rig.last_curvature + share * (rig.curvature - rig.last_curvature)
    vessel.push(parts.vessel[0], body, handle, rig.load[0], dt_s)
    catheter_chain.expose(parts.chain[0], chain, body.body_m)
    catheter_chain.place(chain, body.roll_rad, rig.exit, rig.exit_frame)
    load_effects.load_shape(parts.effects, parts.chain[0], chain, curvature, time_s, dt_s)
    catheter_chain.predict(parts.chain[0], chain, curvature, dt_s)
    load_effects.touch_elsewhere(parts.effects, parts.chain[0], chain, curvature, time_s, dt_s)

    soft = vessel.roll_compliance(parts.vessel[0], dt_s)
    free = vessel.free_roll(parts.vessel[0], body, turn, dt_s) + soft * _along_axis(chain, chain.base_moment)
    _turn_lever(chain, rig.lever)
    for i in range(3):
        rig.free_tip[i] = chain.tip[i] + chain.shift[i] + rig.lever[i] * (free - body.roll_rad)
        for k in range(3):
            chain.compliance[i, k] += soft * rig.lever[i] * rig.lever[k]

    displacement = heart.advance(parts.heart[0], parts.heart_state[0], time_s, dt_s)
    displacement += load_effects.disturb_wall(parts.effects, time_s)
    tissue.solve(parts.tissue[0], wall, rig.free_tip, displacement, chain.compliance, dt_s)
    catheter_chain.settle(parts.chain[0], chain, wall.solved, dt_s)
    body.roll_rad = free
    for i in range(3):
        body.roll_rad += soft * rig.lever[i] * wall.solved[i]
    catheter_chain.place(chain, body.roll_rad, rig.exit, rig.exit_frame)
    tissue.report(parts.tissue[0], wall, chain.tip, displacement, dt_s)
    _loads(parts, curvature)


@njit(cache=True)
def _along_axis(chain, vector: Array) -> float:  # type: ignore[no-untyped-def]
    """Component of `vector` (3,) along the catheter's axis at the sheath's exit."""
    return vector[0] * chain.root[0, 2] + vector[1] * chain.root[1, 2] + vector[2] * chain.root[2, 2]


@njit(cache=True)
def _turn_lever(chain, out: Array) -> None:  # type: ignore[no-untyped-def]
    """out (3,) = shift of the tip per rad of roll: axis x (tip - base)."""
    a0, a1, a2 = chain.root[0, 2], chain.root[1, 2], chain.root[2, 2]
    x, y, z = chain.tip[0] - chain.exit[0], chain.tip[1] - chain.exit[1], chain.tip[2] - chain.exit[2]
    out[0], out[1], out[2] = a1 * z - a2 * y, a2 * x - a0 * z, a0 * y - a1 * x


@njit(cache=True)
def _loads(parts: Parts, curvature: float) -> None:
    """What each axis carries: push on the body (N), torque (Nm), wire tension (N), and the tip's force for the shape (N)."""
    rig, chain = parts.rig[0], parts.chain_state[0]
    rig.load[0] = _along_axis(chain, chain.base_force)
    rig.load[1] = _along_axis(chain, chain.base_moment)
    rig.load[2] = parts.chain[0].rigidity[0, 0] * curvature / parts.chain[0].wire_offset_m
    rig.load[3] = parts.tissue_state[0].normal_force


@njit(cache=True)
def pose(parts: Parts, offset_m: float, position: Array, frame: Array, quaternion: Array) -> None:
    """position (3,), frame (3,3) and quaternion (4,) at `offset_m` behind the tip. `parts`: the arrays of `hold`."""
    _pose(parts, offset_m, position, frame, quaternion)


@njit(cache=True)
def _pose(parts: Parts, offset_m: float, position: Array, frame: Array, quaternion: Array) -> None:
    catheter_chain.pose_at(parts.chain[0], parts.chain_state[0], offset_m, position, frame)
    rotation.quaternion(frame, quaternion)


@njit(cache=True)
def _remember(parts: Parts) -> None:
    """Poses of all tools into the history that delayed sensors read."""
    rig = parts.rig[0]
    slot = rig.step % HISTORY
    rig.history_s[slot] = rig.time_s
    for tool in range(rig.tools):
        row = rig.history[slot, tool]
        _pose(parts, rig.offset[tool], row[:3], rig.frame, row[3:])
    force, arm = parts.tissue_state[0].force, rig.lever
    for i in range(3):
        rig.wrench[slot, i] = -force[i]
        arm[i] = parts.chain_state[0].tip[i] - parts.tissue[0].point[i]
    rig.wrench[slot, 3] = arm[2] * force[1] - arm[1] * force[2]
    rig.wrench[slot, 4] = arm[0] * force[2] - arm[2] * force[0]
    rig.wrench[slot, 5] = arm[1] * force[0] - arm[0] * force[1]


@njit(cache=True)
def settle_unloaded(parts: Parts) -> None:
    """Bring the strains to the shape that the wires ask for at the start, before anything touches, and fill the history."""
    rig, chain = parts.rig[0], parts.chain_state[0]
    rig.curvature = knob.pull(parts.knob[0], parts.knob_state[0], rig.handle[2])
    rig.last_curvature = rig.curvature
    catheter_chain.expose(parts.chain[0], chain, parts.vessel_state[0].body_m)
    distal = min(int(chain.cells), int(parts.chain[0].distal_cells))
    for j in range(distal):
        chain.strain[j, 0] = rig.curvature
    catheter_chain.place(chain, parts.vessel_state[0].roll_rad, rig.exit, rig.exit_frame)
    for slot in range(HISTORY):
        rig.step = slot
        _remember(parts)
    rig.step = 0
    rig.history_s[:] = -1e9
    rig.history_s[0] = 0.0
    for tool in range(rig.tools):
        for i in range(7):
            rig.last_pose[tool, i] = rig.history[0, tool, i]
