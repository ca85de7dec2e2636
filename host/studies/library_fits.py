"""Compare the calibration's own Gauss-Newton search, and the project's rotations, with scipy's: result and processor time.

python -m host.studies.library_fits
"""

from __future__ import annotations

import time
import timeit
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from host.identification.planar_model import PlanarModel
from host.identification.recorded_shapes import RecordedShape
from host.identification.robust_fit import LOSSES, Objective, gauss_newton
from host.mechanics import pcar
from host.mechanics.rotations import quaternion_of_vector, rotation_matrix
from protocol.catheter import PcarParameters, load_catheter

Array = NDArray[np.float64]
NOISE_m, RECORDINGS, OUTLIER_m = 1e-4, 15, 0.02
MOST_EVALUATIONS = 200


def shapes() -> list[RecordedShape]:
    """Return noisy planar shapes of 12 markers under known loads; one marker of every third recording is an outlier."""
    rng, catheter, found = np.random.default_rng(4), load_catheter("thermocool_sf"), []
    for k in range(RECORDINGS):
        insertion, curvature, angle = rng.uniform(0.03, 0.05), (15.0, 20.0, 30.0)[k % 3], rng.uniform(0.0, 2.0 * np.pi)
        force = rng.uniform(0.02, 0.2) * np.array([np.cos(angle), np.sin(angle)]) * (k > 1)
        offset = np.linspace(0.0, 0.95 * (insertion + 0.07), 12)
        arcs = pcar.arcs_of(catheter, insertion, curvature)
        kappa = pcar.solve(arcs, force).curvature_per_m
        at = np.array([pcar.point_at(arcs, kappa, arcs.total_length_m - back)[0] for back in offset])
        at = at + NOISE_m * rng.normal(size=at.shape)
        if k % 3 == 0:
            at[rng.integers(12)] += OUTLIER_m * rng.normal(size=2)
        found.append(RecordedShape(insertion, curvature, force, offset, at))
    return found


def by_scipy(objective: Objective, start: Array, method: str) -> Array:
    """Minimize the same objective (one robust residual for each marker) with `least_squares`; return parameters (p,)."""
    model, scale = objective.model, objective.model.scale()
    value_of, weight_of = LOSSES[objective.loss]

    def both(y: Array) -> tuple[Array, Array]:
        residuals, slopes = [], []
        for index in objective.used:
            recording, found = model.recordings[index], model.predict(y * scale, index, jacobian=True)
            if found is None:
                residuals.append(np.full(len(recording.position_m), 1e6))
                slopes.append(np.zeros((len(recording.position_m), y.size)))
                continue
            error = (found[0] - recording.position_m) / objective.noise_m
            distance = np.linalg.norm(error, axis=1)
            r = np.sqrt(2.0 * recording.weight * value_of(distance)) + 1e-300
            slope = np.einsum("m,md,mdp->mp", weight_of(distance), error, found[1] / objective.noise_m)
            residuals.append(r)
            slopes.append(recording.weight * slope / r[:, None] * scale)
        objective.evaluations += 1
        return np.concatenate(residuals), np.vstack(slopes)

    kept: dict[bytes, tuple[Array, Array]] = {}

    def at(y: Array) -> tuple[Array, Array]:
        if y.tobytes() not in kept:
            kept.clear()
            kept[y.tobytes()] = both(y)
        return kept[y.tobytes()]

    found = least_squares(
        lambda y: at(y)[0],
        start / scale,
        lambda y: at(y)[1],
        method=method,
        xtol=1e-7,
        ftol=1e-15,
        gtol=1e-15,
        max_nfev=MOST_EVALUATIONS,
    )
    return np.asarray(found.x * scale)


def main() -> None:
    """Print objective, evaluations and processor time of each search, then the time of a rotation matrix."""
    start = replace(load_catheter("thermocool_sf"), pcar=PcarParameters((1.0e-3, 0.3e-3, 0.3e-3), (0.030, 0.040)))
    model = PlanarModel(start, shapes(), ("stiffness", "lengths", "curvature"))
    gauss_newton(Objective(model, "huber", NOISE_m), model.start(), 2)  # compiles
    for loss in LOSSES:
        # MINPACK ("lm") does not end within 100 s for "distance", whose residual has a square root at zero distance.
        for method in ("gauss-newton", "trf", "lm") if loss != "distance" else ("gauss-newton", "trf"):
            objective, begin = Objective(model, loss, NOISE_m), time.process_time()
            own = method == "gauss-newton"
            x = gauss_newton(objective, model.start()).x if own else by_scipy(objective, model.start(), method)
            spent, used = time.process_time() - begin, objective.evaluations
            print(f"{loss:9} {method:13} objective {objective(x):12.3f}  evaluations {used:3d}  {1e3 * spent:6.0f} ms")
    q = np.array([quaternion_of_vector(v) for v in np.random.default_rng(0).normal(size=(2000, 3))])
    rotation_matrix(q[0])  # compiles
    for count in (1, 2000):
        some = q[:count]
        ours = min(timeit.repeat("[rotation_matrix(one) for one in some]", globals=globals() | locals(), number=1, repeat=5))
        theirs = min(
            timeit.repeat(
                "Rotation.from_quat(roll(some, -1, 1)).as_matrix()",
                globals={"Rotation": Rotation, "roll": np.roll, "some": some},
                number=1,
                repeat=5,
            )
        )
        print(f"rotation matrices {count:4d}: own {1e6 * ours:8.1f} us, scipy {1e6 * theirs:8.1f} us")


if __name__ == "__main__":
    main()
