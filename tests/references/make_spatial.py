"""Makes spatial.json beside it: spatial equilibria to about 1e-12 by an independent model, branches followed by arc length.

The thesis' own equations (3.10), (3.11) and (3.16) in the body frame, swept from base to tip by Runge-Kutta of order 4
with thousands of steps; unknown are the base moment and the load; derivatives by complex step. A branch that turns back
in load is a fold. Every answer is checked by scipy's DOP853 at 1e-13.

Run: python -m tests.references.make_spatial          (a few minutes)
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numba import njit
from scipy.integrate import solve_ivp

TARGET = Path(__file__).with_name("spatial.json")
SEED = 20
STIFFNESS = {  # Table 3.2, N m2: shaft EI1, EI2, GJ, body EI1, EI2, GJ
    "livewire": [0.0239e-3, 0.1961e-3, 0.0846e-3, 0.0195e-3, 0.7044e-3, 0.2784e-3],
    "steerocath_t": [0.1902e-3, 0.4168e-3, 0.2692e-3, 0.6163e-3, 0.8052e-3, 0.5384e-3],
}
ON_THE_WAY, AT_THE_END = 600, 4000  # Runge-Kutta steps per part
CONVERGED, FOLD = 0, 1


@njit(cache=False)
def rates(y, c, k0, out):
    """Derivative of y = position 0:3, quaternion 3:7, force 7:10 and moment 10:13 in the body frame."""
    q0, q1, q2, q3 = y[3], y[4], y[5], y[6]
    n1, n2, n3, m1, m2, m3 = y[7], y[8], y[9], y[10], y[11], y[12]
    k1, k2, t = c[0] * m1 + k0, c[1] * m2, c[2] * m3
    out[0], out[1], out[2] = 2 * (q1 * q3 + q0 * q2), 2 * (q2 * q3 - q0 * q1), 1 - 2 * (q1 * q1 + q2 * q2)
    out[3] = 0.5 * (-q1 * k1 - q2 * k2 - q3 * t)
    out[4] = 0.5 * (q0 * k1 - q3 * k2 + q2 * t)
    out[5] = 0.5 * (q3 * k1 + q0 * k2 - q1 * t)
    out[6] = 0.5 * (-q2 * k1 + q1 * k2 + q0 * t)
    out[7], out[8], out[9] = -k2 * n3 + t * n2, k1 * n3 - t * n1, k2 * n1 - k1 * n2
    out[10] = -k2 * m3 + t * m2 + n2
    out[11] = k1 * m3 - t * m1 - n1
    out[12] = k2 * m1 - k1 * m2


@njit(cache=False)
def shoot(parts, force, moment, steps):
    """State (13,) at the tip; parts (p, 5): length, three compliances, pre-curvature, from base to tip. Any number type."""
    y = np.zeros(13, dtype=moment.dtype)
    y[3] = 1.0
    y[7:10] = force
    y[10:13] = moment
    a, b, c, d = np.zeros_like(y), np.zeros_like(y), np.zeros_like(y), np.zeros_like(y)
    for p in range(parts.shape[0]):
        h, stiff, k0 = parts[p, 0] / steps, parts[p, 1:4], parts[p, 4]
        for _ in range(steps):
            rates(y, stiff, k0, a)
            rates(y + 0.5 * h * a, stiff, k0, b)
            rates(y + 0.5 * h * b, stiff, k0, c)
            rates(y + h * c, stiff, k0, d)
            y = y + h / 6.0 * (a + 2 * b + 2 * c + d)
    return y


def miss(parts, force, unknown, scale, steps):
    """Tip moment (3,) over `scale`, and its derivatives (3, 4) by base moment over `scale` and by load, complex step."""
    values, slopes = None, np.empty((3, 4))
    for i in range(4):
        z = unknown.astype(complex)
        z[i] += 1e-30j
        tip = shoot(parts, z[3] * force.astype(complex), scale * z[:3], steps)[10:13] / scale
        slopes[:, i], values = tip.imag / 1e-30, tip.real
    return values, slopes


def tangent_of(slopes, before):
    """Unit tangent (4,) of the branch, on the side of the one before."""
    t = np.linalg.svd(slopes)[2][3]
    return t if t @ before > 0 else -t


def follow(parts, force):
    """Base moment (3,) at full load on the branch from no load, and 1.0; or None and the load at which it turns back."""
    scale = max(float(np.linalg.norm(force)) * parts[:, 0].sum(), 1e-9)
    z, ds = np.zeros(4), 0.01
    t = tangent_of(miss(parts, force, z, scale, ON_THE_WAY)[1], np.array([0.0, 0.0, 0.0, 1.0]))
    for _ in range(200_000):
        trial = z + ds * t
        good = False
        for iteration in range(6):
            value, slopes = miss(parts, force, trial, scale, ON_THE_WAY)
            A = np.vstack([slopes, t])
            step = np.linalg.solve(A, -np.append(value, t @ (trial - z) - ds))
            trial = trial + step
            if iteration == 0 and np.linalg.norm(step) > 0.1 * ds:
                break
            if np.linalg.norm(step) < 1e-9:
                good = True
                break
        if not good:
            ds *= 0.5
            assert ds > 1e-12, "reference lost its branch"
            continue
        new = tangent_of(miss(parts, force, trial, scale, ON_THE_WAY)[1], t)
        if new @ t < 0.995:
            ds *= 0.5
            continue
        if new[3] < 0.0:
            return None, trial[3]
        if trial[3] >= 1.0:
            return finish(parts, force, z + (1.0 - z[3]) / (trial[3] - z[3]) * (trial - z), scale), 1.0
        z, t, ds = trial, new, min(1.4 * ds, 0.05)
    raise AssertionError("reference took too many steps")


def finish(parts, force, z, scale):
    """Newton at full load, fine steps."""
    z[3] = 1.0
    for _ in range(8):
        value, slopes = miss(parts, force, z, scale, AT_THE_END)
        step = np.linalg.solve(slopes[:, :3], -value)
        z[:3] += step
        if np.linalg.norm(step) < 1e-13:
            break
    return scale * z[:3]


def checked_pose(parts, force, moment):
    """Tip position and quaternion by fine Runge-Kutta, confirmed by DOP853."""
    y = shoot(parts, force, moment, AT_THE_END)
    state = np.concatenate([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], force, moment])
    for part in parts:

        def slope(_s, v, part=part):
            out = np.empty(13)
            rates(v, part[1:4], part[4], out)
            return out

        state = solve_ivp(slope, (0.0, part[0]), state, method="DOP853", rtol=1e-13, atol=1e-15).y[:, -1]
    growth = np.exp(parts[:, 0].sum() * np.sqrt(np.linalg.norm(force) * parts[:, 1:4].max()))
    assert np.abs(state[:7] - y[:7]).max() < max(2e-11, 1e-13 * growth), np.abs(state[:7] - y[:7]).max()
    return y[:3], y[3:7] / np.linalg.norm(y[3:7])


def uniform_inputs(count):
    """Shafts alone, load numbers F L2 / EI up to 62: stiffnesses (3,), curvature, force (3,)."""
    rng = np.random.default_rng(SEED)
    for _ in range(count):
        stiffness, k0 = rng.uniform(1e-4, 4e-4, 3), rng.uniform(0.0, 45.0)
        v = rng.normal(size=3)
        force = rng.uniform(0.0, 62.0) * stiffness.min() / 0.07**2 * v / np.linalg.norm(v)
        yield stiffness, k0, force


def catheter_inputs(count):
    """Whole catheters over 0 to 0.35 N, 0 to 60 1/m, 0 to 50 mm: name, insertion, curvature, force (3,)."""
    rng = np.random.default_rng(SEED + 1)
    for i in range(count):
        v = rng.normal(size=3)
        yield (
            list(STIFFNESS)[i % 2],
            rng.uniform(0.0, 0.05),
            rng.uniform(0.0, 60.0),
            rng.uniform(0.0, 0.35) * v / np.linalg.norm(v),
        )


def entry(parts, force):
    """What is stored: tip position and quaternion, or the share of the load at which the branch folds back."""
    moment, load = follow(parts, np.asarray(force))
    if moment is None:
        return {"fold": round(load, 6)}
    position, quaternion = checked_pose(parts, np.asarray(force), moment)
    return {"p": [float(f"{v:.13g}") for v in position], "q": [float(f"{v:.13g}") for v in quaternion]}


def main() -> None:
    """Writes spatial.json."""
    uniform = []
    for stiffness, k0, force in uniform_inputs(300):
        uniform.append(entry(np.array([[0.07, *(1.0 / stiffness), k0]]), force))
    catheters = []
    for name, insertion, k0, force in catheter_inputs(40):
        s = 1.0 / np.array(STIFFNESS[name])
        catheters.append(entry(np.array([[insertion, *s[3:], 0.0], [0.07, *s[:3], k0]]), force))
        print(len(catheters), name, np.linalg.norm(force), catheters[-1], flush=True)
    lines = [
        "{",
        f'"seed": {SEED},',
        '"uniform": [',
        ",\n".join(json.dumps(e) for e in uniform),
        "],",
        '"catheters": [',
        ",\n".join(json.dumps(e) for e in catheters),
        "]",
        "}",
    ]
    TARGET.write_text("\n".join(lines) + "\n", encoding="utf-8")
    print(sum("fold" in e for e in uniform), "folds of", len(uniform))


if __name__ == "__main__":
    main()
