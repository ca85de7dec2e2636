"""Makes planar.json beside it: planar equilibria at 1e-12 by an independent model.

Run: python -m tests.references.make_planar
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from tests.references.arcs_by_quadrature import follow, point

TARGET = Path(__file__).with_name("planar.json")
EI = np.array([1.490e-3, 0.430e-3, 0.250e-3])  # Table 2.1, N m2
DISTAL = np.array([0.0192, 0.0508])  # m
TABLE_2_2 = [  # x_b (m), kappa0 (1/m), alpha (deg), F (N)
    (0.0485, 15.7, 270, 0.0125),
    (0.0485, 15.7, 270, 0.0484),
    (0.0485, 15.7, 270, 0.0895),
    (0.0485, 15.7, 270, 0.1197),
    (0.0485, 15.7, 270, 0.1578),
    (0.0413, 20.0, 240, 0.1230),
    (0.0413, 20.0, 193, 0.1578),
    (0.0413, 20.0, 222, 0.1578),
    (0.0413, 20.0, 157, 0.2220),
    (0.0413, 70.0, 270, 0.2220),
    (0.0413, 70.0, 61, 0.2866),
    (0.0413, 70.0, 116, 0.2866),
]
FOLDS = [  # x_b (m), kappa0 (1/m), F (N), stiffness divided by: rare, 1 in 400
    (0.0445, 35.9, (-0.0373, -0.3504), 2.04),
    (0.0485, 52.0, (-0.1269, -0.2802), 6.19),
    (0.0456, 48.0, (0.2006, -0.408), 3.37),
    (0.0402, 44.9, (0.046, -0.1208), 5.09),
    (0.0032, 42.7, (0.1092, -0.2234), 14.24),
    (0.0372, 37.0, (-0.0013, -0.0765), 2.83),
    (0.0388, 54.2, (-0.0357, -0.4042), 17.68),
    (0.0372, 37.3, (0.0011, -0.4519), 2.2),
]


def lengths(insertion_m: float) -> np.ndarray:
    """Arc lengths outside the sheath."""
    inside = max(0.0, -insertion_m)
    return np.array([max(0.0, insertion_m), max(0.0, DISTAL[0] - inside), DISTAL[1] - max(0.0, inside - DISTAL[0])])


def case(insertion_m: float, curvature_per_m: float, force: np.ndarray, softer: float = 1.0) -> dict:
    """One reference: the branch followed at two step sizes, which must agree."""
    length, unloaded = lengths(insertion_m), np.array([0.0, curvature_per_m, curvature_per_m])
    coarse, fine = (follow(length, EI / softer, unloaded, force, step) for step in (0.02, 0.008))
    assert (coarse is None) == (fine is None)
    entry = {"insertion_m": insertion_m, "curvature_per_m": curvature_per_m, "force_N": force.tolist(), "softer": softer}
    if fine is None:
        return {**entry, "fold": True}
    assert np.abs(length * (fine - coarse)).max() < 1e-11
    x, y, angle = point(length, fine)
    return {
        **entry,
        "fold": False,
        "curvature_per_m_of_arcs": fine.tolist(),
        "tip_m": [float(x), float(y)],
        "angle_rad": float(angle),
    }


def main() -> None:
    """Table 2.2, shafts partly in the sheath, 200 random cases of the thesis' range, and soft ones, some with folds."""
    rng = np.random.default_rng(20260101)
    cases = {
        "table_2_2": [
            case(x_b, k, f * np.array([np.cos(np.radians(a)), np.sin(np.radians(a))])) for x_b, k, a, f in TABLE_2_2
        ]
    }
    angle = lambda: (lambda t: np.array([np.cos(t), np.sin(t)]))(rng.uniform(0.0, 2.0 * np.pi))  # noqa: E731
    cases["retracted"] = [case(d, 25.0, 0.2 * angle()) for d in (0.0, -0.005, -0.0192, -0.03, -0.06)]
    cases["random"] = [
        case(rng.uniform(0.0, 0.05), rng.uniform(0.0, 60.0), rng.uniform(0.0, 0.35) * angle()) for _ in range(200)
    ]
    cases["soft"] = [
        case(
            rng.uniform(0.0, 0.05), rng.uniform(-60.0, 60.0), rng.uniform(0.1, 0.5) * angle(), 10.0 ** rng.uniform(0.7, 1.3)
        )
        for _ in range(100)
    ]
    cases["fold"] = [case(x_b, k, np.array(f), softer) for x_b, k, f, softer in FOLDS]
    folds = sum(entry["fold"] for group in cases.values() for entry in group)
    TARGET.write_text(json.dumps(cases, indent=None, separators=(",", ":")) + "\n", encoding="utf-8")
    print(f"{TARGET}: {sum(map(len, cases.values()))} cases, {folds} with a fold")


if __name__ == "__main__":
    main()
