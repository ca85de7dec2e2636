"""The exposed catheter in space: a chain of short rigid links with bending and twisting springs between them.

Cell j counts from the tip, so material keeps its cell while the catheter slides through the sheath; only the cell at the
sheath is cut. A cell is half a link, a joint that turns by strain * length, and half a link. The springs are of Kelvin-Voigt
kind, so motion is overdamped with one retardation time; a step is implicit in springs and contact, explicit in the change
of the load's levers. What rests is a discrete equilibrium whatever the step.
Positive curvature turns about d1 and bends towards -e2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from protocol.catheter import load_catheter
from sim.rotation import exponential, multiply

Array = np.ndarray
CELLS = 128  # at most
SHORTEST_M = 0.004  # the sheath holds the last millimetres of tip electrode


@dataclass(frozen=True)
class CatheterConfig:
    """Geometry (m), and rigidities (EI about d1, EI about d2, GJ) in N m^2 of the distal shaft and of the body behind it.

    wire_offset_m: pull wire to centre line; curvature * EI1 / offset is the wire's tension.
    """

    name: str
    distal_length_m: float
    diameter_m: float
    wire_offset_m: float
    distal_Nm2: tuple[float, float, float]
    body_Nm2: tuple[float, float, float]
    retardation_s: float = 0.004
    distal_cells: int = 55


def _simulated(
    name: str, distal_Nm2: tuple[float, float, float], body_Nm2: tuple[float, float, float], distal_cells: int
) -> CatheterConfig:
    """Return the simulated catheter: geometry as in the catheter's file, rigidities and cells of its own.

    What a ruler measures has one home, `protocol/catheters/`; the judged models read the same file. The rigidities are
    written apart, so that a wrong stiffness in a catheter's file does not change the simulated truth with it.
    """
    file = load_catheter(name)
    lengths = (file.distal_length_m, file.diameter_m, file.pull_wire_offset_m)
    return CatheterConfig(name, *lengths, distal_Nm2, body_Nm2, distal_cells=distal_cells)


_STEEROCATH = ((0.1902e-3, 0.4168e-3, 0.2692e-3), (0.6163e-3, 0.8052e-3, 0.5384e-3))
_LIVEWIRE = ((0.0239e-3, 0.1961e-3, 0.0846e-3), (0.0195e-3, 0.7044e-3, 0.2784e-3))
CATHETERS = {  # thesis table 3.2; the rigidity of blazer_prime_xp is not published: assumed like steerocath_t
    "livewire": _simulated("livewire", *_LIVEWIRE, 35),
    "steerocath_t": _simulated("steerocath_t", *_STEEROCATH, 35),
    "blazer_prime_xp": _simulated("blazer_prime_xp", *_STEEROCATH, 55),
}

CHAIN_PARAMETERS = np.dtype(
    [
        ("rigidity", "f8", (2, 3)),
        ("cell_m", "f8"),
        ("distal_cells", "i8"),
        ("distal_m", "f8"),
        ("retardation_s", "f8"),
        ("diameter_m", "f8"),
        ("wire_offset_m", "f8"),
    ],
    align=True,
)
CHAIN_STATE = np.dtype(
    [
        ("cells", "i8"),
        ("exposed_m", "f8"),
        ("strain", "f8", (CELLS, 3)),
        ("length", "f8", (CELLS,)),
        ("joint", "f8", (CELLS, 3)),
        ("before", "f8", (CELLS, 3, 3)),
        ("middle", "f8", (CELLS, 3, 3)),
        ("exit", "f8", (3,)),
        ("root", "f8", (3, 3)),
        ("tip", "f8", (3,)),
        ("tip_frame", "f8", (3, 3)),
        # what planted effects write before each step: unloaded strain in addition to the wires', moments inside, forces on
        # the joints
        ("rest", "f8", (CELLS, 3)),
        ("moment", "f8", (CELLS, 3)),
        ("force", "f8", (CELLS, 3)),
        ("stiffness", "f8"),
        ("retardation", "f8"),
        ("tip_load", "f8", (3,)),
        # results of the step
        ("free", "f8", (CELLS, 3)),
        ("compliance", "f8", (3, 3)),
        ("shift", "f8", (3,)),
        ("base_force", "f8", (3,)),
        ("base_moment", "f8", (3,)),
        ("residual", "f8"),
        ("turn", "f8", (3, 3)),
    ],
    align=True,
)


def parameters(config: CatheterConfig) -> np.record:
    """Return `config` as the kernel's record."""
    p = np.zeros(1, CHAIN_PARAMETERS).view(np.recarray)[0]
    p.rigidity[0], p.rigidity[1] = config.distal_Nm2, config.body_Nm2
    p.distal_m, p.distal_cells = config.distal_length_m, config.distal_cells
    p.cell_m = config.distal_length_m / config.distal_cells
    p.retardation_s, p.diameter_m = config.retardation_s, config.diameter_m
    p.wire_offset_m = config.wire_offset_m
    return p


def start() -> np.record:
    """A straight chain inside the sheath."""
    s = np.zeros(1, CHAIN_STATE).view(np.recarray)[0]
    s.stiffness, s.retardation = 1.0, 1.0
    s.root[...] = np.eye(3)
    return s


@njit(cache=True)
def expose(p, s, insertion_m: float) -> None:  # type: ignore[no-untyped-def]
    """Cut the chain at the sheath for body insertion d (m): cells that came out start straight, as the sheath held them."""
    longest = (CELLS - 1) * p.cell_m
    s.exposed_m = min(max(p.distal_m + insertion_m, SHORTEST_M), longest)
    cells = int(np.ceil(s.exposed_m / p.cell_m - 1e-12))
    for j in range(min(cells, s.cells), max(cells, s.cells)):
        s.strain[j, :] = 0.0
    for j in range(cells):
        s.length[j] = p.cell_m
    s.length[cells - 1] = s.exposed_m - (cells - 1) * p.cell_m
    s.cells = cells


@njit(cache=True)
def place(s, roll_rad: float, base: Array, base_frame: Array) -> None:  # type: ignore[no-untyped-def]
    """Positions and frames of all joints and of the tip, from strains; the root is `base_frame` (3,3) turned by the roll."""
    exponential(0.0, 0.0, roll_rad, s.turn)
    multiply(base_frame, s.turn, s.root)
    s.exit[:] = base
    s.tip[:] = base
    s.tip_frame[:, :] = s.root
    for j in range(s.cells - 1, -1, -1):
        length = s.length[j]
        half = 0.5 * length
        s.before[j, :, :] = s.tip_frame
        for i in range(3):
            s.joint[j, i] = s.tip[i] + half * s.tip_frame[i, 2]
        exponential(half * s.strain[j, 0], half * s.strain[j, 1], half * s.strain[j, 2], s.turn)
        multiply(s.before[j], s.turn, s.middle[j])
        multiply(s.middle[j], s.turn, s.tip_frame)
        for i in range(3):
            s.tip[i] = s.joint[j, i] + half * s.tip_frame[i, 2]


@njit(cache=True)
def predict(p, s, curvature_per_m: float, dt_s: float) -> None:  # type: ignore[no-untyped-def]
    """Strains after the step without contact (s.free), the tip's shift with them (s.shift) and its compliance in the step.

    Per cell, about its middle frame: K (u - u0) + K T du/dt = M + Mi, by backward Euler; M is the moment of the forces on
    joints and tip, Mi that of planted internal effects. s.compliance (3,3) is the tip's shift per force on the tip (m/N).
    """
    force0, force1, force2 = s.tip_load[0], s.tip_load[1], s.tip_load[2]
    m0 = m1 = m2 = 0.0
    x, y, z = s.tip[0], s.tip[1], s.tip[2]
    ratio = p.retardation_s * s.retardation / dt_s
    s.shift[:] = 0.0
    s.compliance[:, :] = 0.0
    for j in range(s.cells):
        a, b, c = x - s.joint[j, 0], y - s.joint[j, 1], z - s.joint[j, 2]
        m0 += b * force2 - c * force1
        m1 += c * force0 - a * force2
        m2 += a * force1 - b * force0
        x, y, z = s.joint[j, 0], s.joint[j, 1], s.joint[j, 2]
        force0 += s.force[j, 0]
        force1 += s.force[j, 1]
        force2 += s.force[j, 2]
        distal = j < p.distal_cells
        lever0, lever1, lever2 = s.tip[0] - x, s.tip[1] - y, s.tip[2] - z
        for k in range(3):
            d0, d1, d2 = s.middle[j, 0, k], s.middle[j, 1, k], s.middle[j, 2, k]
            rigidity = p.rigidity[0 if distal else 1, k] * s.stiffness
            rest = s.rest[j, k] + (curvature_per_m if distal and k == 0 else 0.0)
            moment = d0 * m0 + d1 * m1 + d2 * m2 + s.moment[j, k]
            s.free[j, k] = (rest + ratio * s.strain[j, k] + moment / rigidity) / (1.0 + ratio)
            g0, g1, g2 = d1 * lever2 - d2 * lever1, d2 * lever0 - d0 * lever2, d0 * lever1 - d1 * lever0
            change = (s.free[j, k] - s.strain[j, k]) * s.length[j]
            s.shift[0] += g0 * change
            s.shift[1] += g1 * change
            s.shift[2] += g2 * change
            soft = s.length[j] / (rigidity * (1.0 + ratio))
            s.compliance[0, 0] += soft * g0 * g0
            s.compliance[0, 1] += soft * g0 * g1
            s.compliance[0, 2] += soft * g0 * g2
            s.compliance[1, 1] += soft * g1 * g1
            s.compliance[1, 2] += soft * g1 * g2
            s.compliance[2, 2] += soft * g2 * g2
    s.compliance[1, 0], s.compliance[2, 0], s.compliance[2, 1] = s.compliance[0, 1], s.compliance[0, 2], s.compliance[1, 2]
    s.base_force[0], s.base_force[1], s.base_force[2] = force0, force1, force2
    a, b, c = x - s.exit[0], y - s.exit[1], z - s.exit[2]
    s.base_moment[0] = m0 + b * force2 - c * force1
    s.base_moment[1] = m1 + c * force0 - a * force2
    s.base_moment[2] = m2 + a * force1 - b * force0


@njit(cache=True)
def settle(p, s, contact: Array, dt_s: float) -> None:  # type: ignore[no-untyped-def]
    """Strains after the step with the force `contact` (3,) on the tip; s.base_*: loads on the sheath's exit.

    s.residual: fastest du/dt (1/m/s), zero in equilibrium.
    """
    ratio = p.retardation_s * s.retardation / dt_s
    s.residual = 0.0
    for j in range(s.cells):
        a, b, c = s.tip[0] - s.joint[j, 0], s.tip[1] - s.joint[j, 1], s.tip[2] - s.joint[j, 2]
        m0 = b * contact[2] - c * contact[1]
        m1 = c * contact[0] - a * contact[2]
        m2 = a * contact[1] - b * contact[0]
        for k in range(3):
            moment = s.middle[j, 0, k] * m0 + s.middle[j, 1, k] * m1 + s.middle[j, 2, k] * m2
            rigidity = p.rigidity[0 if j < p.distal_cells else 1, k] * s.stiffness
            strain = s.free[j, k] + moment / (rigidity * (1.0 + ratio))
            s.residual = max(s.residual, abs(strain - s.strain[j, k]) / dt_s)
            s.strain[j, k] = strain
    a, b, c = s.tip[0] - s.exit[0], s.tip[1] - s.exit[1], s.tip[2] - s.exit[2]
    s.base_moment[0] += b * contact[2] - c * contact[1]
    s.base_moment[1] += c * contact[0] - a * contact[2]
    s.base_moment[2] += a * contact[1] - b * contact[0]
    for i in range(3):
        s.base_force[i] += contact[i]


@njit(cache=True)
def pose_at(p, s, offset_m: float, position: Array, frame: Array) -> None:  # type: ignore[no-untyped-def]
    """position (3,) and frame (3,3) at `offset_m` behind the tip; inside the sheath on its straight axis."""
    if offset_m >= s.exposed_m:
        frame[:, :] = s.root
        for i in range(3):
            position[i] = s.exit[i] - (offset_m - s.exposed_m) * s.root[i, 2]
        return
    j = min(int(max(offset_m, 0.0) / p.cell_m), s.cells - 1)
    along = min(s.length[j], j * p.cell_m + s.length[j] - max(offset_m, 0.0))
    exponential(along * s.strain[j, 0], along * s.strain[j, 1], along * s.strain[j, 2], s.turn)
    multiply(s.before[j], s.turn, frame)
    half = 0.5 * s.length[j]
    for i in range(3):
        position[i] = s.joint[j, i] + (0.5 * along - half) * s.before[j, i, 2] + 0.5 * along * frame[i, 2]
