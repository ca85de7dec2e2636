"""Planted effects on what devices are handed: poses of the tracker's tools and the force sensor's wrench."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from sim import effect_codes as code
from sim.random_stream import normal, uniform
from sim.rotation import quaternion_of_vector, quaternion_product

Array = np.ndarray
_TWO_PI = 2.0 * math.pi
_PER_TOOL = 32  # numbers an effect remembers per tool


@njit(cache=True)
def _delay(effects: Array, port: int, time_s: float) -> float:
    """All planted delays of a sensor at this time (s)."""
    delay = 0.0
    for k in range(effects.shape[0]):
        e = effects[k]
        if e.port == port and time_s >= e.start_s:
            if e.code == code.LATENCY:
                delay += e.p[0]
            elif e.code == code.CLOCK_DRIFT:
                delay += e.p[0] * (time_s - e.start_s)
    return delay


@njit(cache=True)
def _slot_before(rig, time_s: float) -> tuple[int, float]:  # type: ignore[no-untyped-def]
    """The last history slot not after `time_s` and the share of the way to the next."""
    size = rig.history_s.shape[0]
    slot = rig.step % size
    for _ in range(size - 1):
        if rig.history_s[slot] <= time_s:
            break
        slot = (slot - 1) % size
    after = (slot + 1) % size
    if slot == rig.step % size:
        return slot, 0.0
    span = rig.history_s[after] - rig.history_s[slot]
    return slot, min(1.0, max(0.0, (time_s - rig.history_s[slot]) / span))


@njit(cache=True)
def measure_pose(effects: Array, rigs: Array, tool: int, position: Array, quaternion: Array) -> bool:
    """position (3,) and quaternion (4,) of `tool` as the tracker gets them now; True where the sample is lost."""
    rig = rigs[0]
    slot, share = _slot_before(rig, rig.time_s - _delay(effects, code.POSE_SENSOR, rig.time_s))
    now, after = rig.history[slot, tool], rig.history[(slot + 1) % rig.history_s.shape[0], tool]
    sign = 1.0
    if now[3] * after[3] + now[4] * after[4] + now[5] * after[5] + now[6] * after[6] < 0.0:
        sign = -1.0
    for i in range(3):
        position[i] = now[i] + (share * (after[i] - now[i]) if share > 0.0 else 0.0)
    for i in range(4):
        quaternion[i] = now[3 + i] + (share * (sign * after[3 + i] - now[3 + i]) if share > 0.0 else 0.0)
    _normalize(quaternion)
    missing = False
    for k in range(effects.shape[0]):
        e = effects[k]
        if e.port != code.POSE_SENSOR or rig.time_s < e.start_s:
            continue
        if e.code == code.SENSOR_MISALIGNMENT:
            _turn_pose(e.p[0], e.p[1], e.p[2], position, quaternion)
        elif e.code == code.FIELD_DISTORTION:
            _distort(e, position, quaternion)
        elif e.code == code.DROPOUT:
            missing = _dropped(e, rig, tool) or missing
        else:
            _reading(e, rig, tool * _PER_TOOL, position, 3)
    row = rig.last_pose[tool]
    for i in range(3):
        position[i] = row[i] if missing else position[i]
        row[i] = position[i]
    for i in range(4):
        quaternion[i] = row[3 + i] if missing else quaternion[i]
        row[3 + i] = quaternion[i]
    return missing


@njit(cache=True)
def measure_wrench(effects: Array, rigs: Array, wrench: Array) -> None:
    """wrench (6,), force then torque, through the planted effects; a lost sample repeats the last."""
    rig = rigs[0]
    delay = _delay(effects, code.FORCE_SENSOR, rig.time_s)
    if delay > 0.0:
        slot, share = _slot_before(rig, rig.time_s - delay)
        now, after = rig.wrench[slot], rig.wrench[(slot + 1) % rig.history_s.shape[0]]
        for i in range(6):
            wrench[i] = now[i] + (share * (after[i] - now[i]) if share > 0.0 else 0.0)
    lost = False
    for k in range(effects.shape[0]):
        e = effects[k]
        if e.port != code.FORCE_SENSOR or rig.time_s < e.start_s:
            continue
        if e.code == code.SENSOR_MISALIGNMENT:
            _cross_add(e.p[0], e.p[1], e.p[2], wrench[:3])
            _cross_add(e.p[0], e.p[1], e.p[2], wrench[3:])
        elif e.code == code.DROPOUT:
            lost = _dropped(e, rig, 0) or lost
        else:
            _reading(e, rig, 0, wrench, 3)
    for i in range(6):
        wrench[i] = rig.last_wrench[i] if lost else wrench[i]
        rig.last_wrench[i] = wrench[i]


@njit(cache=True)
def _normalize(q: Array) -> None:
    """Bring q (4,) to unit length, in place."""
    size = math.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    for i in range(4):
        q[i] /= size


@njit(cache=True)
def _cross_add(v0: float, v1: float, v2: float, x: Array) -> None:
    """x (3,) turned by the rotation vector v (Rodrigues)."""
    angle = math.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
    if angle < 1e-12:
        return
    n0, n1, n2 = v0 / angle, v1 / angle, v2 / angle
    c, s = math.cos(angle), math.sin(angle)
    dot = (n0 * x[0] + n1 * x[1] + n2 * x[2]) * (1.0 - c)
    x0 = x[0] * c + (n1 * x[2] - n2 * x[1]) * s + n0 * dot
    x1 = x[1] * c + (n2 * x[0] - n0 * x[2]) * s + n1 * dot
    x2 = x[2] * c + (n0 * x[1] - n1 * x[0]) * s + n2 * dot
    x[0], x[1], x[2] = x0, x1, x2


@njit(cache=True)
def _turn_pose(v0: float, v1: float, v2: float, position: Array, quaternion: Array) -> None:
    """The whole pose turned about the base's origin by the rotation vector v."""
    _cross_add(v0, v1, v2, position)
    turn, old = np.empty(4), np.empty(4)
    quaternion_of_vector(v0, v1, v2, turn)
    old[:] = quaternion
    quaternion_product(turn, old, quaternion)


@njit(cache=True)
def _distort(e, position: Array, quaternion: Array) -> None:  # type: ignore[no-untyped-def]
    """The field of a metal object: shift away from it that falls with the cube of distance beyond its reach."""
    x, y, z = position[0] - e.p[1], position[1] - e.p[2], position[2] - e.p[3]
    distance = math.sqrt(x * x + y * y + z * z)
    size = e.p[0] / (1.0 + (distance / e.p[4]) ** 3)
    scale = size / max(distance, 1e-6)
    _turn_pose(0.0, 10.0 * size, 0.0, np.zeros(3), quaternion)
    position[0] += scale * x
    position[1] += scale * y
    position[2] += scale * z


@njit(cache=True)
def _dropped(e, rig, tool: int) -> bool:  # type: ignore[no-untyped-def]
    """Two states, seen and lost: a share p[0] of samples lost, in bursts of p[1] on average (Gilbert)."""
    leave = 1.0 / e.p[1]
    enter = min(1.0, leave * e.p[0] / max(1e-9, 1.0 - e.p[0]))
    draw = uniform(rig.random)
    lost = draw >= leave if e.s[tool] > 0.5 else draw < enter
    e.s[tool] = 1.0 if lost else 0.0
    return lost


@njit(cache=True)
def _reading(  # type: ignore[no-untyped-def]  # noqa: C901 - one branch for each effect
    e, rig, at: int, x: Array, n: int
) -> None:
    """Effects on the first n numbers of the reading x (m or N); `at` is where this reading's memory begins."""
    since = rig.time_s - e.start_s
    if e.code == code.RATE_LAG or e.code == code.CREEP_RELAXATION:
        _slow(e, rig, at, x, n)
    elif e.code == code.SENSOR_DRIFT:
        warm = e.p[3] * (1.0 - math.exp(-since / e.p[3]))
        for i in range(n):
            x[i] += e.p[i] * warm
    elif e.code == code.PERIODIC_DISTURBANCE:
        x[int(e.p[2])] += e.p[0] * math.sin(_TWO_PI * e.p[1] * since)
    elif e.code == code.SENSOR_SCALE:
        for i in range(n):
            x[i] *= e.p[0]
    elif e.code == code.SENSOR_BIAS:
        for i in range(n):
            x[i] += e.p[i]
    elif e.code == code.RECTIFIED_SENSOR:
        x[int(e.p[0])] = abs(x[int(e.p[0])])
    elif e.code == code.SATURATION:
        for i in range(n):
            x[i] = min(max(x[i], -e.p[0]), e.p[0])
    elif e.code == code.QUANTIZATION:
        for i in range(n):
            x[i] = e.p[0] * math.floor(x[i] / e.p[0] + 0.5)
    elif e.code == code.OUTLIER:
        if uniform(rig.random) < e.p[0]:
            for i in range(n):
                x[i] += e.p[1] * normal(rig.random)


@njit(cache=True)
def _slow(e, rig, at: int, x: Array, n: int) -> None:  # type: ignore[no-untyped-def]
    """A first-order lag, or a slow tail of part of the reading, which runs straight between this and its last sample."""
    elapsed = rig.time_s - e.s[at + 3]
    constant = e.p[0] if e.code == code.RATE_LAG else e.p[1]
    for i in range(n):
        if e.s[at + 4] == 0.0:
            e.s[at + i] = e.s[at + 5 + i] = x[i]
        before, reading = e.s[at + 5 + i], x[i]
        behind = (reading - before) * constant / elapsed if elapsed > 0.0 else 0.0
        e.s[at + i] = reading - behind + (e.s[at + i] - before + behind) * math.exp(-elapsed / constant)
        e.s[at + 5 + i] = reading
        x[i] = e.s[at + i] if e.code == code.RATE_LAG else reading + e.p[0] * (e.s[at + i] - reading)
    e.s[at + 3] = rig.time_s
    e.s[at + 4] = 1.0
