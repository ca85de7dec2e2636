"""Planted effects on shape, contact and base: loads and material of the catheter, tissue, a sheath that moves."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from sim import catheter_chain
from sim import effect_codes as code
from sim.friction_effects import bouc_wen, lugre
from sim.rotation import exponential

Array = np.ndarray
_TWO_PI = 2.0 * math.pi
_BLOOD_DRAG = 0.5 * 1060.0 * 1.1  # half density (kg/m^3) times a cylinder's drag coefficient
_HALF = 256  # second half of an effect's state: two numbers per cell, 128 cells
_COULOMB_PER_M = 0.5  # curvature over which Coulomb's friction turns round


@njit(cache=True)
def _direction(e, first: int, i: int) -> float:  # type: ignore[no-untyped-def]
    """Component i of the unit vector in parameters first..first+2."""
    x, y, z = e.p[first], e.p[first + 1], e.p[first + 2]
    return (x, y, z)[i] / max(1e-12, math.sqrt(x * x + y * y + z * z))


@njit(cache=True)
def move_base(effects: Array, time_s: float, base: Array, frame: Array) -> None:
    """base (3,) and frame (3,3) of the sheath's exit at `time_s`, as planted: a sway, or a shift over the rise time."""
    for k in range(effects.shape[0]):
        e = effects[k]
        if e.code != code.BASE_MOTION or time_s < e.start_s:
            continue
        since = time_s - e.start_s
        share = math.sin(_TWO_PI * e.p[6] * since) if e.p[6] > 0.0 else 1.0 - math.exp(-((since / e.p[7]) ** 2))
        for i in range(3):
            base[i] = share * e.p[i]
        exponential(share * e.p[3], share * e.p[4], share * e.p[5], frame)


@njit(cache=True)
def alter_tissue(effects: Array, tissue, time_s: float) -> None:  # type: ignore[no-untyped-def]
    """Give the tissue's record its planted law, viscosity, friction or softening once their time has come."""
    for k in range(effects.shape[0]):
        e = effects[k]
        if e.port != code.CONTACT or time_s < e.start_s:
            continue
        if e.code == code.SOFTENING:
            if not e.began:
                e.s[0] = tissue.stiffness
            tissue.stiffness = e.s[0] * max(e.p[1], 1.0 / (1.0 + e.p[0] * (time_s - e.start_s)))
        elif not e.began and e.code == code.CONTACT_NONLINEAR:
            tissue.exponent, tissue.depth0 = e.p[0], e.p[1]
            tissue.law = 2 if e.p[1] > 0.0 else 1
        elif not e.began and e.code == code.CONTACT_VISCOUS:
            tissue.hunt_crossley, tissue.relaxing, tissue.relaxation_s = e.p[0], e.p[1], e.p[2]
        elif not e.began and e.code == code.CONTACT_FRICTION:
            tissue.friction, tissue.bristle = e.p[0], e.p[1]
        e.began = 1


@njit(cache=True)
def disturb_wall(effects: Array, time_s: float) -> float:
    """Displacement of the wall along its normal (m) in addition to the heart's."""
    total = 0.0
    for k in range(effects.shape[0]):
        e = effects[k]
        if e.port == code.CONTACT and e.code == code.PERIODIC_DISTURBANCE and time_s >= e.start_s:
            total += e.p[0] * math.sin(_TWO_PI * e.p[1] * (time_s - e.start_s) + e.p[2])
    return total


@njit(cache=True)
def load_shape(effects: Array, p, chain, curvature: float, time_s: float, dt_s: float) -> None:  # type: ignore[no-untyped-def]
    """Write the planted loads and material of this substep into the chain's record."""
    cleared = False
    for k in range(effects.shape[0]):
        e = effects[k]
        if e.port != code.SHAPE or time_s < e.start_s:
            continue
        if not cleared:
            chain.rest[:, :] = 0.0
            chain.moment[:, :] = 0.0
            chain.force[:, :] = 0.0
            chain.tip_load[:] = 0.0
            chain.stiffness = chain.retardation = 1.0
            cleared = True
        if e.code == code.SOFTENING:
            chain.stiffness *= max(e.p[1], 1.0 / (1.0 + e.p[0] * (time_s - e.start_s)))
        elif e.code == code.VISCOUS_FRICTION:
            chain.retardation += e.p[0] / p.retardation_s
        elif e.code == code.COULOMB_FRICTION or e.code == code.PRESLIDING_FRICTION:
            _internal_friction(e, p, chain)
        elif e.code == code.GRAVITY_LOAD or e.code == code.FLOW_DRAG:
            _distributed(e, p, chain, time_s)
        elif e.code == code.SECOND_CONTACT:
            _press(e, chain, e.s[0])
        else:
            _material(e, p, chain, curvature, dt_s)


@njit(cache=True)
def _internal_friction(e, p, chain) -> None:  # type: ignore[no-untyped-def]
    """A friction moment in every cell against its bending: Coulomb by steep LuGre bristles, presliding by Bouc-Wen."""
    soft = max(_COULOMB_PER_M, e.p[0] / (5.0 * p.rigidity[0, 0]))
    for j in range(chain.cells):
        for k in range(2):
            i = 2 * j + k
            moved = chain.strain[j, k] - e.s[_HALF + i] if e.began else 0.0
            e.s[_HALF + i] = chain.strain[j, k]
            e.s[i] = lugre(e.s[i], moved / soft) if e.code == code.COULOMB_FRICTION else bouc_wen(e.s[i], moved / e.p[1])
            chain.moment[j, k] -= e.p[0] * e.s[i]
    e.began = 1


@njit(cache=True)
def _distributed(e, p, chain, time_s: float) -> None:  # type: ignore[no-untyped-def]
    """Weight, or drag of blood across each cell: a cylinder's quadratic law for the flow's part across it."""
    first = 2 if e.code == code.GRAVITY_LOAD else 3
    x, y, z = _direction(e, first, 0), _direction(e, first, 1), _direction(e, first, 2)
    pulse = _TWO_PI * e.p[2] * (time_s - e.start_s)
    speed = e.p[0] * (1.0 + e.p[1] * (math.sin(pulse) + 0.4 * math.sin(2.0 * pulse + 0.7)))
    for j in range(chain.cells):
        if e.code == code.GRAVITY_LOAD:
            size, along = e.p[0] * chain.length[j], 0.0
        else:
            along = x * chain.middle[j, 0, 2] + y * chain.middle[j, 1, 2] + z * chain.middle[j, 2, 2]
            across = math.sqrt(max(0.0, 1.0 - along * along))
            size = _BLOOD_DRAG * p.diameter_m * chain.length[j] * abs(speed) * speed * across
        chain.force[j, 0] += size * (x - along * chain.middle[j, 0, 2])
        chain.force[j, 1] += size * (y - along * chain.middle[j, 1, 2])
        chain.force[j, 2] += size * (z - along * chain.middle[j, 2, 2])
    if e.code == code.GRAVITY_LOAD:
        for i in range(3):
            chain.tip_load[i] += e.p[1] * (x, y, z)[i]


@njit(cache=True)
def _material(e, p, chain, curvature: float, dt_s: float) -> None:  # type: ignore[no-untyped-def]
    """Creep (a Kelvin element in series), plastic set, hardening and one-sided stiffness of each cell's bending."""
    for j in range(chain.cells):
        distal = j < p.distal_cells
        for k in range(2):
            i = 2 * j + k
            strain = chain.strain[j, k] - (curvature if distal and k == 0 else 0.0)
            rigidity = p.rigidity[0 if distal else 1, k]
            if e.code == code.CREEP_RELAXATION:
                elastic = strain - e.s[i]
                e.s[i] += (e.p[0] * elastic - e.s[i]) * (1.0 - math.exp(-dt_s / e.p[1]))
                chain.rest[j, k] += e.s[i]
            elif e.code == code.PLASTIC_SET:
                over = e.p[1] * (abs(strain - e.s[i]) - e.p[0])
                if over > abs(e.s[i]):
                    e.s[i] = math.copysign(over, strain - e.s[i])
                chain.rest[j, k] += e.s[i]
            elif e.code == code.NONLINEAR_STIFFNESS:
                square = min(e.p[0] * strain * strain, 4.0)
                chain.moment[j, k] -= rigidity * square * strain
            elif e.code == code.ASYMMETRY and strain < 0.0:
                chain.moment[j, k] -= rigidity * (e.p[0] - 1.0) * strain


@njit(cache=True)
def _nearest_link(e, chain) -> tuple[int, float]:  # type: ignore[no-untyped-def]
    """The joint beyond the obstacle along e3 and its share of the contact force (the next joint back has the remainder)."""
    for j in range(chain.cells - 1, 0, -1):
        here, beyond = chain.joint[j, 2], chain.joint[j - 1, 2]
        if here <= e.p[0] < beyond:
            return j - 1, (e.p[0] - here) / (beyond - here)
    return -1, 0.0


@njit(cache=True)
def _press(e, chain, force_N: float) -> None:  # type: ignore[no-untyped-def]
    """Put the obstacle's push, against its direction, on the joints at its place."""
    j, share = _nearest_link(e, chain)
    if j < 0 or force_N == 0.0:
        return
    for i in range(3):
        push = -force_N * _direction(e, 3, i)
        chain.force[j, i] += share * push
        chain.force[j + 1, i] += (1.0 - share) * push


@njit(cache=True)
def touch_elsewhere(effects: Array, p, chain, curvature: float, time_s: float, dt_s: float) -> None:  # type: ignore[no-untyped-def]
    """Bring each obstacle's push to its spring law at the shaft's predicted place, and predict again with it.

    The obstacle stands `place_m` along e3 and `clearance_m` off the axis in its direction.
    """
    for k in range(effects.shape[0]):
        e = effects[k]
        if e.port != code.SHAPE or e.code != code.SECOND_CONTACT or time_s < e.start_s:
            continue
        j, share = _nearest_link(e, chain)
        old = e.s[0]
        if j < 0:
            e.s[0] = 0.0
            continue
        depth, soft = -e.p[1], 0.0
        for i in range(3):
            d = _direction(e, 3, i)
            depth += d * (share * chain.joint[j, i] + (1.0 - share) * chain.joint[j + 1, i])
        shift, soft = _shift_of_joint(e, p, chain, j, dt_s)
        wanted = e.p[2] * (depth + shift)
        e.s[0] = max(0.0, old + (wanted - old) / (1.0 + e.p[2] * soft))
        if e.s[0] != old:
            _press(e, chain, e.s[0] - old)
            catheter_chain.predict(p, chain, curvature, dt_s)


@njit(cache=True)
def _shift_of_joint(e, p, chain, joint: int, dt_s: float) -> tuple[float, float]:  # type: ignore[no-untyped-def]
    """Predicted shift of a joint along the obstacle's direction (m) and its compliance there within the step (m/N)."""
    d0, d1, d2 = _direction(e, 3, 0), _direction(e, 3, 1), _direction(e, 3, 2)
    ratio = p.retardation_s * chain.retardation / dt_s
    shift = soft = 0.0
    for j in range(joint + 1, chain.cells):
        a, b, c = (
            chain.joint[joint, 0] - chain.joint[j, 0],
            chain.joint[joint, 1] - chain.joint[j, 1],
            chain.joint[joint, 2] - chain.joint[j, 2],
        )
        t0, t1, t2 = b * d2 - c * d1, c * d0 - a * d2, a * d1 - b * d0
        for k in range(3):
            turn = chain.middle[j, 0, k] * t0 + chain.middle[j, 1, k] * t1 + chain.middle[j, 2, k] * t2
            shift += turn * (chain.free[j, k] - chain.strain[j, k]) * chain.length[j]
            rigidity = p.rigidity[0 if j < p.distal_cells else 1, k] * chain.stiffness
            soft += turn * turn * chain.length[j] / (rigidity * (1.0 + ratio))
    return shift, soft
