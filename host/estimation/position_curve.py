"""Every force that explains one position (cases 1 and 3): roots along the curve of forces that give its direction.

A chord of the catheter (sheath's exit to tip, or second sensor to first) hardly changes its length under load, so of the
three equations of cases 1 and 3 two are strong, the chord's direction, and one is weak, its length. The forces that meet
the two are a curve. It is found from the unloaded shape, whose chord is turned to the measured direction step by step,
and then followed both ways by predictor and corrector (pseudo-arc-length continuation); where the length along it passes
the measured one, or comes nearest to it, a force is polished. A search from scattered starts instead has to meet the
weak equation across hills, and misses answers.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from host.estimation.spatial_kernels import SAME, Scratch, cost_at, cost_on_branch, estimate
from host.estimation.spatial_residuals import MeasuredPose
from host.mechanics.cosserat_kernels import COARSE, EXACT
from host.mechanics.rotations import turn_back
from host.mechanics.tip_shooting import length3, load_number

Array = NDArray[np.float64]

# Forces are counted in load numbers (F L^2 / EI) here, and the chord in its own measured length.
FIRST_STEP, LONGEST_STEP, SHORTEST_STEP = 0.5, 2.0, 1e-3  # along the curve
MOST_STEPS = 200  # the bench's inputs take fewer than 60 both ways together
SMOOTH_COSINE, EASY_COSINE = 0.8, 0.97  # of the tangents before and after a step: below one it is repeated, above longer
CURVE_MISS = 3e-3  # rad, of the direction on the curve; the polishing makes it exact
TURN_rad, LEAST_TURN = 0.5, 0.005  # of the chord in one step towards the curve; share of the way that gives up
CORRECTIONS, START_CORRECTIONS = 4, 6
MOST_ROOTS = 8
SAME_N2 = 1e-8  # squared distance below which two exact answers are one
FAR_WORSE = 16.0  # chi square above the best answer's: 4 standard deviations
STAYS = 0.15  # load number: a force nearer than this to the one before is on its branch; others can be 0.4 away


class Chord(NamedTuple):
    """The measured chord and what is reused while the curve is followed."""

    unit_N: float  # force of load number 1
    length_m: float
    aim: Array  # (3, 3) rows: unit vector along the wanted direction, and two across it
    miss: Array  # (3,) across, across, relative length
    slope: Array  # (3, 3) of `miss` by the force in load numbers


@njit(cache=True, error_model="numpy", nogil=True)
def cross_into(a: Array, b: Array, out: Array) -> None:
    """Set `out` (3,) to the cross product a x b of vectors (3,), without allocating."""
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@njit(cache=True, error_model="numpy", nogil=True)
def aim_at(direction: Array, aim: Array) -> None:
    """Set the rows of aim (3, 3) = the unit vector along `direction` (3,) and two across it."""
    least = 0
    for i in range(3):
        aim[0, i] = direction[i] / length3(direction)
    for i in range(3):
        if abs(aim[0, i]) < abs(aim[0, least]):
            least = i
    aim[2] = 0.0
    aim[2, least] = 1.0
    cross_into(aim[0], aim[2], aim[1])
    size = length3(aim[1])
    for i in range(3):
        aim[1, i] /= size
    cross_into(aim[0], aim[1], aim[2])


@njit(cache=True, error_model="numpy", nogil=True)
def chord_of(p: MeasuredPose) -> Chord:
    """Chord of a sample of case 1 or 3, aimed at the measured direction."""
    measured = p.positions[0].copy() if p.case == 1 else p.positions[1] - p.positions[0]
    aim = np.empty((3, 3))
    aim_at(measured, aim)
    return Chord(1.0 / load_number(p.whole_rod, 1.0), length3(measured), aim, np.empty(3), np.empty((3, 3)))


@njit(cache=True, error_model="numpy", nogil=True)
def measured_chord(p: MeasuredPose, out: Array) -> None:
    """Set out (3,) = the measured chord, m."""
    for i in range(3):
        out[i] = p.positions[0, i] if p.case == 1 else p.positions[1, i] - p.positions[0, i]


@njit(cache=True, error_model="numpy", nogil=True)
def look(p: MeasuredPose, chord: Chord, y: Array, s: Scratch) -> float:
    """Fill chord.miss and chord.slope at the force y (3,) in load numbers. Returns the model's chord along the aim.

    The model's chord, over the measured length, is left in s.vectors[2].
    """
    x, c = s.vectors[0], s.vectors[2]
    for i in range(3):
        x[i] = y[i] * chord.unit_N
    cost_at(p, x, COARSE, True, s)
    measured_chord(p, c)
    for i in range(3):
        c[i] = (c[i] - s.raw[i]) / chord.length_m
    size = max(length3(c), 1e-300)
    aim, miss, slope = chord.aim, chord.miss, chord.slope
    along = 0.0
    miss[0] = miss[1] = 0.0
    for i in range(3):
        along += aim[0, i] * c[i]
        miss[0] += aim[1, i] * c[i]
        miss[1] += aim[2, i] * c[i]
    miss[2] = size - 1.0
    for k in range(3):
        slope[0, k] = slope[1, k] = slope[2, k] = 0.0
        for i in range(3):
            a = s.raw_A[i, k] * chord.unit_N / chord.length_m
            slope[0, k] += aim[1, i] * a
            slope[1, k] += aim[2, i] * a
            slope[2, k] += c[i] / size * a
    return along


@njit(cache=True, error_model="numpy", nogil=True)
def reach_curve(p: MeasuredPose, chord: Chord, y: Array, s: Scratch) -> tuple[bool, int]:
    """Move y (3,) to the nearest force whose chord has the aimed direction: damped Gauss-Newton steps of least length."""
    along, sweeps = look(p, chord, y, s), 1
    miss, slope = chord.miss, chord.slope
    step, trial = np.empty(3), np.empty(3)
    for _ in range(START_CORRECTIONS):
        square = miss[0] ** 2 + miss[1] ** 2
        if square < CURVE_MISS**2 / 9.0 and along > 0.0:
            return True, sweeps
        a = b = c = 0.0
        for k in range(3):
            a += slope[0, k] ** 2
            b += slope[0, k] * slope[1, k]
            c += slope[1, k] ** 2
        damping = 1e-3 * (a + c) * min(1.0, square)
        a, c = a + damping, c + damping
        determinant = a * c - b * b + 1e-300
        u, v = (c * miss[0] - b * miss[1]) / determinant, (a * miss[1] - b * miss[0]) / determinant
        for k in range(3):
            step[k] = -(slope[0, k] * u + slope[1, k] * v)
        share = min(1.0, 3.0 / max(length3(step), 1e-300))
        for _ in range(CORRECTIONS):
            for k in range(3):
                trial[k] = y[k] + share * step[k]
            along = look(p, chord, trial, s)
            sweeps += 1
            if miss[0] ** 2 + miss[1] ** 2 < square or along <= 0.0:
                break
            share *= 0.4
        y[:] = trial
    return miss[0] ** 2 + miss[1] ** 2 < CURVE_MISS**2 / 9.0 and along > 0.0, sweeps


@njit(cache=True, error_model="numpy", nogil=True)
def turn_to_curve(p: MeasuredPose, chord: Chord, y: Array, s: Scratch) -> tuple[bool, int]:
    """Move y (3,) onto the curve: turn the aim from the chord that y gives to the measured one, along a great circle."""
    aimed, start, goal, kept = np.empty(3), np.empty(3), np.empty(3), y.copy()
    measured_chord(p, goal)
    look(p, chord, y, s)
    sweeps, start[:] = 1, s.vectors[2]
    size, cosine = length3(start), 0.0
    for i in range(3):
        start[i], goal[i] = start[i] / size, goal[i] / chord.length_m
        cosine += start[i] * goal[i]
    angle = math.acos(min(1.0, max(-1.0, cosine)))
    done, share = 0.0, min(1.0, TURN_rad / max(angle, 1e-9))
    while True:
        to = min(1.0, done + share)
        for i in range(3):
            aimed[i] = (
                goal[i]
                if math.sin(angle) < 1e-6
                else (math.sin((1.0 - to) * angle) * start[i] + math.sin(to * angle) * goal[i])
            )
        aim_at(aimed, chord.aim)
        reached, used = reach_curve(p, chord, y, s)
        sweeps += used
        if reached:
            if to >= 1.0:
                return True, sweeps
            done, share, kept[:] = to, 1.5 * share, y
        else:
            share, y[:] = 0.4 * share, kept
            if share < LEAST_TURN:
                aim_at(goal, chord.aim)
                return False, sweeps


@njit(cache=True, error_model="numpy", nogil=True)
def correct(p: MeasuredPose, chord: Chord, tangent: Array, y: Array, s: Scratch) -> tuple[int, int]:
    """Bring y (3,) back to the curve across `tangent` (3,). Returns (corrections, or -1 where it does not, sweeps)."""
    miss, slope, part = chord.miss, chord.slope, np.empty(3)
    before = 1e300
    for count in range(CORRECTIONS):
        along = look(p, chord, y, s)
        square = miss[0] ** 2 + miss[1] ** 2
        if square < CURVE_MISS**2 and along > 0.0:
            return count, count + 1
        if square > before or along <= 0.0:
            return -1, count + 1
        before = square
        # Newton's step of the two equations in the plane across the tangent, by Cramer's rule
        cross_into(slope[0], slope[1], part)
        determinant = part[0] * tangent[0] + part[1] * tangent[1] + part[2] * tangent[2]
        if abs(determinant) < 1e-12:
            return -1, count + 1
        cross_into(slope[1], tangent, part)
        for i in range(3):
            y[i] -= miss[0] / determinant * part[i]
        cross_into(tangent, slope[0], part)
        for i in range(3):
            y[i] -= miss[1] / determinant * part[i]
    return -1, CORRECTIONS


@njit(cache=True, error_model="numpy", nogil=True)
def heading(chord: Chord, sign: float, tangent: Array) -> float:
    """Set tangent (3,) = unit tangent of the curve, one way or the other. Returns how the chord's length grows along it."""
    cross_into(chord.slope[0], chord.slope[1], tangent)
    size, rate = sign / length3(tangent), 0.0
    for i in range(3):
        tangent[i] *= size
        rate += chord.slope[2, i] * tangent[i]
    return rate


@njit(cache=True, error_model="numpy", nogil=True)
def root_share(last: float, last_rate: float, now: float, rate: float) -> float:
    """Share of a step at which the length error passes zero or, next to zero, turns; -1 where it does neither."""
    if last * now <= 0.0:
        return last / (last - now) if last != now else 0.0
    return last_rate / (last_rate - rate) if last_rate * rate < 0.0 and last * last_rate < 0.0 else -1.0


@njit(cache=True, error_model="numpy", nogil=True)
def follow(
    p: MeasuredPose, chord: Chord, start: Array, sign: float, largest_N: float, roots: Array, s: Scratch
) -> tuple[int, bool, int]:
    """Follow the curve from `start` (3,) one way. Returns (roots written to (k, 3) in N, closed, sweeps).

    The curve ends at the largest force, where it closes, or where no step is short enough.
    """
    y, trial, tangent, new_tangent = start.copy(), np.empty(3), np.empty(3), np.empty(3)
    look(p, chord, y, s)
    last, last_rate = chord.miss[2], heading(chord, sign, tangent)
    count, sweeps, step = 0, 1, FIRST_STEP
    for k in range(MOST_STEPS):
        for i in range(3):
            trial[i] = y[i] + step * tangent[i]
        corrections, used = correct(p, chord, tangent, trial, s)
        sweeps += used
        rate = heading(chord, sign, new_tangent)
        cosine = tangent[0] * new_tangent[0] + tangent[1] * new_tangent[1] + tangent[2] * new_tangent[2]
        if corrections < 0 or not cosine >= SMOOTH_COSINE:
            step *= 0.4
            if step < SHORTEST_STEP:
                break
            continue
        share = root_share(last, last_rate, chord.miss[2], rate)
        if share >= 0.0 and count < roots.shape[0]:
            for i in range(3):
                roots[count, i] = (y[i] + share * (trial[i] - y[i])) * chord.unit_N
            count += 1
        last, last_rate, distance = chord.miss[2], rate, 0.0
        for i in range(3):
            y[i], tangent[i] = trial[i], new_tangent[i]
            distance += (y[i] - start[i]) ** 2
        if k > 5 and distance < (0.5 * step) ** 2:
            return count, True, sweeps
        if length3(y) * chord.unit_N > largest_N:
            break
        if corrections <= 1 and cosine > EASY_COSINE:
            step = min(1.6 * step, LONGEST_STEP)
        elif corrections >= 3:
            step *= 0.7
    return count, False, sweeps


@njit(cache=True, error_model="numpy", nogil=True)
def is_new(x: Array, forces: Array, s: Scratch) -> bool:
    """Whether x (3,), to which s belongs, differs from forces (k, 3) by more than rounding and a tenth of the noise."""
    for j in range(forces.shape[0]):
        plain = noise = 0.0
        for a in range(3):
            plain += (x[a] - forces[j, a]) ** 2
            for b in range(3):
                noise += (x[a] - forces[j, a]) * s.information[a, b] * (x[b] - forces[j, b])
        if plain < SAME_N2 or noise < SAME:
            return False
    return True


@njit(cache=True, error_model="numpy", nogil=True)
def forces_along(
    p: MeasuredPose, start: Array, largest_N: float, acceptable: float, forces: Array, costs: Array, s: Scratch
) -> tuple[int, int]:
    """Forces that explain the chord, on the curve that is reached from `start` (3,) N: forces (k, 3), costs (k,).

    Returns (how many, sweeps); s holds what belongs to the last one.
    """
    chord, y, roots, x = chord_of(p), np.empty(3), np.empty((MOST_ROOTS, 3)), np.empty(3)
    for i in range(3):
        y[i] = start[i] / chord.unit_N
    count = 0
    if length3(start) > 0.0:
        reached, sweeps = reach_curve(p, chord, y, s)
    else:
        reached, sweeps = turn_to_curve(p, chord, y, s)
    if not reached:
        return 0, sweeps
    for sign in (1.0, -1.0):
        found, closed, used = follow(p, chord, y, sign, largest_N, roots, s)
        sweeps += used
        for k in range(found):
            x[:] = roots[k]
            settled, cost, used = estimate(p, largest_N, x, s)
            sweeps += used
            if settled and cost <= acceptable and count < forces.shape[0] and is_new(x, forces[:count], s):
                forces[count], costs[count] = x, cost
                count += 1
        if closed:
            break
    return count, sweeps


@njit(cache=True, error_model="numpy", nogil=True)
def grows_from_zero(p: MeasuredPose, x: Array, s: Scratch) -> bool:
    """Whether the force x (3,), tip frame, is on the branch that starts at the unloaded shape as its load grows."""
    cost_at(p, x, EXACT, False, s)
    base, force = s.rows[s.rows.shape[0] - 1, 6:10].copy(), np.empty(3)
    turn_back(base, x, force)
    if cost_on_branch(p, force, s) >= 1e300:
        return False
    apart = (s.vectors[3, 0] - x[0]) ** 2 + (s.vectors[3, 1] - x[1]) ** 2 + (s.vectors[3, 2] - x[2]) ** 2
    return apart < (1e-4 + 1e-3 * length3(x)) ** 2


@njit(cache=True, error_model="numpy", nogil=True)
def has_chord(p: MeasuredPose) -> bool:
    """Whether the sample is one of a position alone: case 1 or 3, without a prior, and not of length zero."""
    if (p.case != 1 and p.case != 3) or p.prior.shape[0] != 0:
        return False
    d = np.empty(3)
    measured_chord(p, d)
    return length3(d) > 1e-6


@njit(cache=True, error_model="numpy", nogil=True)
def every_force(p: MeasuredPose, largest_N: float, acceptable: float, forces: Array, s: Scratch) -> tuple[int, int]:
    """Forces (k, 3) that explain the chord, on the curve of no force: those that grow from zero first, then by size.

    Left out: forces that explain it far worse than the best one. Returns (how many, sweeps).
    """
    costs = np.empty(forces.shape[0])
    count, sweeps = forces_along(p, np.zeros(3), largest_N, acceptable, forces, costs, s)
    if count <= 1:
        return count, sweeps
    best, kept, rank = costs[:count].min(), 0, np.empty(count)
    for k in range(count):
        if costs[k] <= best + FAR_WORSE:
            rank[kept] = length3(forces[k]) + (0.0 if grows_from_zero(p, forces[k], s) else 2.0 * largest_N)
            forces[kept] = forces[k]
            kept += 1
    forces[:kept] = forces[np.argsort(rank[:kept])]
    return kept, sweeps


@njit(cache=True, error_model="numpy", nogil=True)
def force_next_to(p: MeasuredPose, largest_N: float, acceptable: float, x: Array, s: Scratch) -> tuple[bool, float, int]:
    """The force that explains the chord and is nearest to x (3,), the one before, in place. Returns (settled, cost, sweeps).

    The quick search is kept where it stays near; where it jumped, the curve through x gives the nearest answer.
    """
    before = x.copy()
    settled, cost, sweeps = estimate(p, largest_N, x, s)
    near = STAYS / load_number(p.whole_rod, 1.0)
    leap = math.sqrt((x[0] - before[0]) ** 2 + (x[1] - before[1]) ** 2 + (x[2] - before[2]) ** 2)
    if settled and cost <= acceptable and leap < near:
        return True, cost, sweeps
    forces = np.empty((MOST_ROOTS, 3))
    count, used = forces_along(p, before, largest_N, acceptable, forces, np.empty(MOST_ROOTS), s)
    sweeps += used
    best, nearest = -1, leap if settled and cost <= acceptable else 1e300
    for k in range(count):
        apart = (forces[k, 0] - before[0]) ** 2 + (forces[k, 1] - before[1]) ** 2 + (forces[k, 2] - before[2]) ** 2
        if math.sqrt(apart) < nearest:
            best, nearest = k, math.sqrt(apart)
    if best >= 0:
        x[:] = forces[best]
    settled, cost, used = estimate(p, largest_N, x, s)
    return settled, cost, sweeps + used
