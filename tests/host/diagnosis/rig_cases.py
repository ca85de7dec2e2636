"""Small recordings of the rig's chain by other means than the finder's: forty rigid segments and springs between them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
PIECES = 40
EI, GJ, DISTAL, BEHIND = 3.0e-4, 2.3e-4, 0.110, 0.030
TOML = """
name = "rig"
kind = "rig"
[data]
time = "time_s"
[rig]
distal_length_m = 0.110
shaft_sensor_offset_m = 0.030
torsion_to_bending = 0.766667
wall_normal = [0.0, 0.0, 1.0]
[parameters]
insertion_gain = 1.0
insertion_offset_m = -0.070
roll_slope = 0.48
roll_offset_rad = 0.0
knob_gain_per_m_rad = 28.6
knob_offset_per_m = 0.0
bending_stiffness_N_m2 = 3.0e-4
wall_distance_m = 0.036
wall_stiffness_N_per_m = 1000.0
"""


@dataclass
class Truth:
    """What the world does to handle motions before they bend anything; identities where nothing is planted."""

    insertion: Callable[[Array, Array], Array] = lambda q, t: q
    roll: Callable[[Array, Array], Array] = lambda q, t: q
    knob: Callable[[Array, Array], Array] = lambda q, t: q
    force_reading: Callable[[Array, Array], Array] = lambda f, t: f
    columns: Callable[[dict[str, Array], Array], None] = lambda c, t: None
    shift: Callable[[Array], Array] = field(default=lambda t: np.zeros((3, t.size)))


def rotation(v: Array) -> Array:
    """Rotation matrix of the rotation vector v."""
    angle = np.linalg.norm(v)
    if angle < 1e-12:
        return np.eye(3)
    k = v / angle
    K = np.array([[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K)


def shape(d: float, roll: float, kappa: float) -> tuple[Array, Array]:
    """Points (PIECES + 1, 3) and rotations (PIECES + 1, 3, 3) of the free arc; insertion not positive."""
    length = max(DISTAL + d, 1e-3)
    h = length / PIECES
    points, frames = [np.zeros(3)], [rotation(np.array([0, 0, roll]))]
    for _ in range(PIECES):
        half = frames[-1] @ rotation(np.array([0.5 * kappa * h, 0, 0]))
        points.append(points[-1] + h * half[:, 2])
        frames.append(half @ rotation(np.array([0.5 * kappa * h, 0, 0])))
    return np.array(points), np.array(frames)


def bent(points: Array, frames: Array, force: Array, upto: float) -> tuple[Array, Array]:
    """Pose at arc share `upto` after a tip force, every segment's turn summed (small)."""
    h = np.linalg.norm(points[1] - points[0])
    place = upto * PIECES
    low = min(int(place), PIECES - 1)
    share = place - low
    here = points[low] + share * (points[low + 1] - points[low])
    turn, move = np.zeros(3), np.zeros(3)
    for i in range(PIECES):
        part = min(max(place - i, 0.0), 1.0)
        if part == 0.0:
            break
        middle = 0.5 * (points[i] + points[i + 1]) if part == 1.0 else points[i] + 0.5 * part * (points[i + 1] - points[i])
        R = frames[i]
        m = R.T @ np.cross(points[-1] - middle, force)
        kappa = R @ (m / np.array([EI, EI, GJ]))
        turn += h * part * kappa
        move += h * part * np.cross(kappa, here - middle)
    step = rotation(share * np.array([np.arcsin(np.clip((frames[low].T @ frames[low + 1])[2, 1], -1, 1)), 0, 0]))
    return here + move, rotation(turn) @ frames[low] @ step


def coloured(rng: np.random.Generator, shape_: tuple[int, int], sigma: float, phi: float) -> Array:
    """First-order autoregressive noise of standard deviation sigma, rows independent."""
    out = np.zeros(shape_)
    out[:, 0] = rng.normal(size=shape_[0])
    for i in range(1, shape_[1]):
        out[:, i] = phi * out[:, i - 1] + np.sqrt(1 - phi**2) * rng.normal(size=shape_[0])
    return sigma * out


def wander(rng: np.random.Generator, t: Array, low: float, high: float, moves: int) -> Array:
    """A handle that goes to random places by smooth moves and rests between them."""
    out = np.full(t.size, rng.uniform(low, high))
    edges = np.sort(rng.uniform(0.05, 0.95, moves)) * t[-1]
    for start in edges:
        goal, length = rng.uniform(low, high), rng.uniform(0.8, 2.5)
        u = np.clip((t - start) / length, 0, 1)
        out = out + (goal - out) * (3 * u**2 - 2 * u**3)
    return out


def record(
    truth: Truth, seed: int, duration_s: float = 30.0, rate_Hz: float = 40.0, contact: bool = True
) -> dict[str, Array]:
    """Columns of one recording."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, duration_s, 1 / rate_Hz)
    q = {
        "insertion": wander(rng, t, -0.004, 0.006, 14),
        "roll": wander(rng, t, -1.0, 1.0, 8),
        "knob": wander(rng, t, 0.2, 0.8, 10),
    }
    d = truth.insertion(q["insertion"], t) - 0.070
    roll = 0.48 * truth.roll(q["roll"], t)
    kappa = 28.6 * truth.knob(q["knob"], t)
    n = t.size
    poses, force, shift = np.zeros((2, 7, n)), np.zeros((3, n)), truth.shift(t)
    for i in range(n):
        points, frames = shape(d[i], roll[i], kappa[i])
        gap = points[-1][2] + shift[2, i] - 0.036
        if contact and gap > 0:
            soft = bent(points, frames, np.array([0, 0, 1.0]), 1.0)[0][2] - points[-1][2]
            force[2, i] = gap / (1e-3 + soft)
        for k, upto in enumerate((1.0, 1.0 - BEHIND / max(DISTAL + d[i], 1e-3))):
            p, R = bent(points, frames, -force[:, i], upto)
            poses[k, :3, i] = p + shift[:, i]
            w = 0.5 * np.sqrt(max(1 + np.trace(R), 1e-12))
            poses[k, 3:, i] = np.array(
                [w, (R[2, 1] - R[1, 2]) / (4 * w), (R[0, 2] - R[2, 0]) / (4 * w), (R[1, 0] - R[0, 1]) / (4 * w)]
            )
    poses[:, :3] += coloured(rng, (6, n), 2.5e-4, 0.4).reshape(2, 3, n)
    poses[:, 4:] += 0.5 * coloured(rng, (6, n), 3.5e-3, 0.4).reshape(2, 3, n)
    poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    columns: dict[str, Array] = {
        "time_s": t,
        **{f"handle_{k}_{u}": q[k] for k, u in (("insertion", "m"), ("roll", "rad"), ("knob", "rad"))},
    }
    for name, pose in zip(("tip", "shaft"), poses, strict=True):
        columns |= {f"{name}_{c}": pose[j] for j, c in enumerate(("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"))}
    reading = truth.force_reading(force, t) + coloured(rng, (3, n), 4e-3, 0.3)
    columns |= {f"force_{a}_N": reading[j] for j, a in enumerate("xyz")}
    truth.columns(columns, t)
    lost = rng.random(n) < 0.01
    for name in columns:
        if name.startswith(("tip", "shaft")):
            columns[name] = np.where(lost, np.nan, columns[name])
    return columns


def write(folder: Path, truth: Truth, seed: int, recordings: int = 3, **how: float) -> tuple[Path, list[Path]]:
    """Nominal TOML and recordings in `folder`."""
    nominal = folder / "nominal.toml"
    nominal.write_text(TOML)
    files = []
    for k in range(recordings):
        columns = record(truth, seed * 100 + k, **how)  # type: ignore[arg-type]
        path = folder / f"r{k}.csv"
        np.savetxt(path, np.array(list(columns.values())).T, delimiter=",", header=",".join(columns), comments="")
        files.append(path)
    return nominal, files
