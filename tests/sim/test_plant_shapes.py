"""Static shapes of the simulated catheter against closed forms and a finely integrated elastica."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from sim import catheter_chain
from sim.catheter_chain import CATHETERS
from sim.heart import HeartConfig
from sim.knob import KnobConfig
from sim.plant import Plant, PlantConfig
from sim.tissue import TissueConfig
from sim.vessel import VesselConfig

STILL = HeartConfig(beat_m=0.0, respiration_m=0.0)
FAR = TissueConfig(point_m=(0.0, 0.0, 1.0))
EI1, EI2, GJ = CATHETERS["blazer_prime_xp"].distal_Nm2


def knob_for(curvature_per_m: float) -> float:
    """Knob angle that asks for a curvature."""
    k = KnobConfig()
    return float(np.sign(curvature_per_m) * (k.slack_rad + abs(curvature_per_m) * (k.stop_rad - k.slack_rad) / 45.0))


def rested(
    exposed_m: float, curvature_per_m: float, tissue: TissueConfig = FAR, cells: int = 55, roll_rad: float = 0.0
) -> Plant:
    """A plant that has come to rest with so much of the shaft out, by slow enough steps."""
    catheter = replace(CATHETERS["blazer_prime_xp"], distal_cells=cells)
    vessel = VesselConfig(play_width_m=0.0, home_insertion_m=exposed_m - catheter.distal_length_m)
    stage = (0.0, roll_rad, knob_for(curvature_per_m))
    plant = Plant(PlantConfig(catheter, vessel, tissue=tissue, heart=STILL, start_stage=stage))
    for _ in range(2000):
        plant.step(1e-3, stage)
    return plant


@pytest.mark.parametrize("curvature", [-40.0, -12.0, 0.0, 14.0, 45.0])
@pytest.mark.parametrize("exposed", [0.021, 0.0403, 0.110])
def test_unloaded_shaft_is_an_arc_of_the_asked_curvature(curvature: float, exposed: float) -> None:
    tip, quaternion = rested(exposed, curvature).sensor_pose(0.0)
    angle = curvature * exposed
    arc = exposed * np.array([0.0, -(1 - np.cos(angle)) / angle if angle else 0.0, np.sinc(angle / np.pi)])
    discretization = (0.002 * curvature) ** 2 / 12.0  # relative, of rigid links of 2 mm
    assert np.abs(tip - arc).max() <= 1.1 * discretization * exposed + 1e-12
    half = 0.5 * angle
    assert quaternion[:2] == pytest.approx(np.sign(np.cos(half)) * np.array([np.cos(half), np.sin(half)]), abs=1e-9)


def test_refining_the_chain_converges_at_second_order() -> None:
    exact = np.sin(40.0 * 0.110) / 40.0
    errors = [abs(rested(0.110, 40.0, cells=n).sensor_pose(0.0)[0][2] - exact) for n in (25, 50, 100)]
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.05) and errors[1] / errors[2] == pytest.approx(4.0, rel=0.05)


@pytest.mark.parametrize(("normal", "rigidity"), [((0.0, 1.0, 0.0), EI1), ((0.0, -1.0, 0.0), EI1), ((1.0, 0.0, 0.0), EI2)])
def test_small_side_load_bends_like_a_cantilever(normal: tuple[float, float, float], rigidity: float) -> None:
    point = tuple(2e-4 * np.array(normal))
    plant = rested(0.040, 0.0, TissueConfig(point_m=point, normal=normal, stiffness_N_per_m=100.0))  # type: ignore[arg-type]
    force = float(np.linalg.norm(plant.contact_force_N))
    deflection = float(plant.sensor_pose(0.0)[0] @ np.array(normal))
    assert force > 1e-4
    assert deflection == pytest.approx(force * 0.040**3 / (3.0 * rigidity), rel=2e-3)


def test_body_behind_the_distal_shaft_has_its_own_stiffness_and_no_curvature() -> None:
    normal = (0.0, 1.0, 0.0)
    plant = rested(0.130, 0.0, TissueConfig(point_m=(0.0, 2e-4, 0.0), normal=normal, stiffness_N_per_m=100.0))
    body = CATHETERS["blazer_prime_xp"].body_Nm2[0]
    compliance = 0.110**3 / (3 * EI1) + (0.130**3 - 0.110**3) / (3 * body)
    force = plant.contact_force_N[1]
    assert plant.sensor_pose(0.0)[0][1] == pytest.approx(-force * compliance, rel=3e-3)
    bent = rested(0.130, 20.0)
    assert np.allclose(bent.sensor_pose(0.112)[1], [1, 0, 0, 0], atol=1e-12)


def elastica(length: float, curvature: float, force: float) -> tuple[float, float, float]:
    """(axial, lateral, angle) of the tip of a clamped planar rod under an axial push, on the branch next to the arc."""

    def shot(curvature_base: float) -> np.ndarray:
        def slope(s: float, y: np.ndarray) -> list[float]:
            return [curvature + y[1] / EI1, -force * np.sin(y[0]), np.cos(y[0]), np.sin(y[0])]

        return solve_ivp(slope, (0.0, length), [0.0, curvature_base, 0.0, 0.0], rtol=1e-11, atol=1e-13).y[:, -1]

    moment = brentq(lambda m: shot(m)[1], 0.0, 3.0 * force * length, xtol=1e-14)
    angle, _, axial, lateral = shot(moment)
    return axial, lateral, angle


@pytest.mark.parametrize(
    ("exposed", "curvature", "wall"), [(0.0264, 14.0, 0.025), (0.0400, 20.0, 0.028), (0.0600, 20.0, 0.033)]
)
def test_large_axial_load_follows_the_elastica(exposed: float, curvature: float, wall: float) -> None:
    plant = rested(exposed, curvature, TissueConfig(point_m=(0.0, 0.0, wall)))
    force = float(plant.contact_force_N[2])
    axial, lateral, _ = elastica(exposed, curvature, force)
    tip = plant.sensor_pose(0.0)[0]
    assert force > 0.05
    assert tip[2] == pytest.approx(axial, abs=1e-3 * exposed)
    assert -tip[1] == pytest.approx(lateral, abs=1e-3 * exposed)


def energy(plant: Plant) -> float:
    """Elastic energy of chain and wall at the strains now in the plant's record (J)."""
    parts = plant._parts
    chain, total = parts.chain_state, 0.0
    catheter_chain.place(chain, float(parts.vessel_state.roll_rad), np.zeros(3), np.eye(3))
    for j in range(chain.cells):
        rest = np.array([parts.rig.curvature, 0.0, 0.0])
        total += 0.5 * chain.length[j] * float(parts.chain.rigidity[0] @ (chain.strain[j] - rest) ** 2)
    depth = max(0.0, -float(parts.tissue.normal @ (chain.tip - parts.tissue.point)))
    return total + 0.5 * float(parts.tissue.stiffness) * depth**2


def test_rest_in_space_is_where_the_energy_is_stationary() -> None:
    wall = TissueConfig(point_m=(0.002, -0.004, 0.032), normal=(0.5, 0.3, -0.8))
    plant = rested(0.040, 18.0, wall, roll_rad=0.8)
    chain = plant._parts.chain_state
    assert np.linalg.norm(plant.contact_force_N) > 0.02
    assert chain.residual < 1e-6
    assert np.abs(chain.strain[: chain.cells, 1:]).max() > 0.1, "the case should bend out of plane and twist"
    for j in range(0, int(chain.cells), 4):
        for k in range(3):
            kept, step = chain.strain[j, k], 1e-3
            chain.strain[j, k] = kept + step
            above = energy(plant)
            chain.strain[j, k] = kept - step
            below = energy(plant)
            chain.strain[j, k] = kept
            moment = (above - below) / (2.0 * step * chain.length[j])
            assert abs(moment) < 2e-3 * 0.02 * 0.040, f"cell {j} axis {k}: {moment} Nm out of balance"


def test_loads_on_the_sheath_balance_the_contact() -> None:
    plant = rested(0.0264, 14.0, TissueConfig(point_m=(0.0, 0.0, 0.025)))
    truth = plant.truth()
    assert truth["base_force_N"] == pytest.approx(-truth["contact_force_N"], abs=1e-6)
    assert truth["base_moment_Nm"] == pytest.approx(np.cross(truth["tip_m"], -truth["contact_force_N"]), abs=1e-7)


def test_poses_along_the_shaft_join_smoothly_and_follow_the_sheath_inside() -> None:
    plant = rested(0.0301, 25.0)
    offsets = np.linspace(0.0, 0.040, 4001)
    points = np.array([plant.sensor_pose(offset)[0] for offset in offsets])
    assert np.linalg.norm(np.diff(points, axis=0), axis=1) == pytest.approx(1e-5, rel=2e-3)
    inside = offsets > 0.0302
    assert np.allclose(points[inside, :2], 0.0) and np.allclose(points[inside, 2], 0.0301 - offsets[inside], atol=1e-12)


def test_sliding_out_of_the_sheath_never_jumps() -> None:
    plant = Plant(PlantConfig(vessel=VesselConfig(play_width_m=0.0), tissue=FAR, start_stage=(0.0, 0.0, knob_for(20.0))))
    last = plant.sensor_pose(0.0)[0]
    for n in range(1500):
        plant.step(1e-3, (2e-5 * n, 0.0, knob_for(20.0)))
        tip = plant.sensor_pose(0.0)[0]
        assert np.linalg.norm(tip - last) < 4e-5
        last = tip
