"""Calibration: exact sensitivities, truth recovered, a finer model fitted, outliers survived, ignorance admitted."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from host.cli.calibrate import calibrate
from host.identification.calibration import Calibration, calibrate_model
from host.identification.planar_model import PlanarModel
from host.identification.recorded_shapes import PLANAR_COLUMNS, RecordedShape, read_recorded_shapes
from host.identification.robust_fit import Objective, gauss_newton, nelder_mead
from host.mechanics import pcar
from protocol.catheter import CATHETER_FOLDER, Catheter, PcarParameters, load_catheter
from protocol.errors import InputError
from tests.references import elastica

THERMOCOOL = load_catheter("thermocool_sf")
TRUTH = {"EI1": 1.490e-3, "EI2": 0.430e-3, "EI3": 0.250e-3, "l2": 0.0192}
START = replace(THERMOCOOL, pcar=PcarParameters((1.0e-3, 0.3e-3, 0.3e-3), (0.030, 0.040)))
EVERYTHING = ("stiffness", "lengths", "curvature")


def shapes(
    count: int, noise_m: float = 0.0, outliers: bool = False, loaded: bool = True, continuous: bool = False
) -> list[RecordedShape]:
    """Recordings as in section 2.3.1: three initial curvatures, weights hung in several directions, 12 markers.

    `continuous`: shapes of the finer model, a rod by an ODE solver, in place of three arcs.
    """
    rng = np.random.default_rng(4)
    found = []
    for k in range(count):
        insertion, curvature = rng.uniform(0.03, 0.05), (15.0, 20.0, 30.0)[k % 3]
        angle = rng.uniform(0.0, 2.0 * np.pi)
        force = rng.uniform(0.02, 0.2) * np.array([np.cos(angle), np.sin(angle)]) * (loaded and k > 1)
        offset = np.linspace(0.0, 0.95 * (insertion + 0.07), 12)
        if continuous:
            _, at = elastica.shape(
                [insertion, 0.0192, 0.0508],
                list(TRUTH.values())[:3],
                [0.0, curvature, curvature],
                force,
                stations=insertion + 0.07 - offset,
                steps=4,
            )
        else:
            arcs = pcar.arcs_of(THERMOCOOL, insertion, curvature)
            kappa = pcar.solve(arcs, force).curvature_per_m
            at = np.array([pcar.point_at(arcs, kappa, arcs.total_length_m - back)[0] for back in offset])
        at = at + noise_m * rng.normal(size=at.shape)
        if outliers and k % 3 == 0:
            at[rng.integers(12)] += 0.02 * rng.normal(size=2)
        found.append(RecordedShape(insertion, curvature, force, offset, at))
    return found


def fitted(model: PlanarModel, loss: str = "huber", method: str = "gauss-newton", leave: bool = False) -> Calibration:
    return calibrate_model(model, loss, method, leave)


@pytest.mark.parametrize("insertion_m", [0.04, 0.0, -0.01, -0.025, -0.035])
def test_sensitivities_equal_high_order_differences(insertion_m: float) -> None:
    shape = replace(shapes(5)[4], insertion_m=insertion_m, offset_m=np.linspace(0.0, 0.03, 5), position_m=np.zeros((5, 2)))
    model = PlanarModel(START, [shape], EVERYTHING)
    x = model.start() + 0.01 * model.scale()
    predicted = model.predict(x, 0, jacobian=True)
    assert predicted is not None and predicted[1].shape == (5, 2, 5)
    for p, step in enumerate(1e-3 * model.scale()):
        at = [model.predict(x + k * step * np.eye(5)[p], 0) for k in (-2, -1, 1, 2)]
        by = (at[0][0] - 8.0 * at[1][0] + 8.0 * at[2][0] - at[3][0]) / (12.0 * step)  # type: ignore[index]
        assert np.allclose(predicted[1][:, :, p], by, rtol=0, atol=1e-9 * max(1.0, np.abs(by).max() / 1e-1))


def test_noiseless_shapes_give_the_parameters_back() -> None:
    found = fitted(PlanarModel(START, shapes(15), ("stiffness", "lengths")))
    for parameter in found.parameters:
        assert parameter.value == pytest.approx(TRUTH[parameter.name], rel=1e-9) and parameter.determined
    assert found.rms_m < 1e-12 and not found.undetermined and found.fits[0].converged


@pytest.mark.parametrize("loss", ["squares", "huber", "cauchy", "distance"])
def test_intervals_hold_the_truth_under_noise(loss: str) -> None:
    found = fitted(PlanarModel(START, shapes(15, 1e-4), ("stiffness", "lengths")), loss)
    for parameter in found.parameters:
        assert parameter.low < TRUTH[parameter.name] < parameter.high
        assert parameter.high - parameter.low < 0.5 * parameter.value
    assert found.noise_m == pytest.approx(1e-4, rel=0.25)


def test_initial_curvature_is_fitted_for_each_nominal_one() -> None:
    recordings = [
        replace(shape, curvature_per_m={15.0: 14.0, 20.0: 21.0, 30.0: 33.0}[shape.curvature_per_m])
        for shape in shapes(15, 5e-5)
    ]
    found = {p.name: p for p in fitted(PlanarModel(START, recordings, EVERYTHING)).parameters}
    for nominal, true in ((14, 15.0), (21, 20.0), (33, 30.0)):
        assert found[f"kappa0[{nominal}]"].value == pytest.approx(true, abs=0.1)
    assert found["EI2"].value == pytest.approx(TRUTH["EI2"], rel=0.05)


def test_gauss_newton_and_nelder_mead_reach_the_same_optimum_of_the_thesis_sum() -> None:
    model = PlanarModel(START, shapes(6, 2e-4), ("stiffness", "lengths"))
    objective = Objective(model, "distance", 2e-4)
    newton, simplex = gauss_newton(objective, model.start()), nelder_mead(objective, model.start())
    assert newton.objective <= simplex.objective * (1.0 + 1e-6)
    assert np.allclose(list(model.values(newton.x).values()), list(model.values(simplex.x).values()), rtol=2e-3)
    assert newton.evaluations < 0.4 * simplex.evaluations


def test_outliers_hardly_move_the_robust_fit_and_are_named() -> None:
    clean = fitted(PlanarModel(START, shapes(15, 2e-4), ("stiffness", "lengths")))
    model = PlanarModel(START, shapes(15, 2e-4, outliers=True), ("stiffness", "lengths"))
    robust, squares = fitted(model, "cauchy"), fitted(model, "squares")
    off = [
        max(abs(p.value / q.value - 1.0) for p, q in zip(found.parameters, clean.parameters, strict=True))
        for found in (robust, squares)
    ]
    assert off[0] < 0.05 and off[0] < 0.5 * off[1]
    # five markers were moved by some 20 mm; the ones that are far off are listed
    assert 3 <= len(robust.outliers) <= 7 and all(recording % 3 == 0 for recording, _ in robust.outliers)


def test_a_finer_model_is_fitted_within_the_thesis_error() -> None:
    recordings = shapes(9, 2e-5, continuous=True)
    found = fitted(PlanarModel(START, recordings, ("stiffness", "lengths")), leave=True)
    # three arcs against the continuous rod: far inside the thesis' 1.85 mm at the tip
    assert found.rms_m < 0.4e-3 and max(left.tip_m for left in found.left_out) < 1.85e-3
    body = next(p for p in found.parameters if p.name == "EI1")
    assert body.value == pytest.approx(TRUTH["EI1"], rel=0.15)


def test_leave_one_out_is_worse_than_the_fit_and_of_the_size_of_the_noise() -> None:
    found = fitted(PlanarModel(START, shapes(8, 2e-4), ("stiffness", "lengths")), "squares", leave=True)
    assert len(found.left_out) == 8
    assert found.rms_m < np.sqrt(np.mean([left.rms_m**2 for left in found.left_out])) < 2.0 * found.rms_m


def test_what_the_data_do_not_tell_is_said() -> None:
    unloaded = fitted(PlanarModel(START, shapes(6, 1e-4, loaded=False), EVERYTHING))
    told = {p.name: p.determined for p in unloaded.parameters}
    assert not any(told[name] for name in ("EI1", "EI2", "EI3", "l2"))
    assert all(value for name, value in told.items() if name.startswith("kappa0"))
    assert {name for direction in unloaded.undetermined for name in direction.combination} >= {"EI1", "EI2", "EI3"}
    inside = [replace(shape, insertion_m=-0.01, offset_m=shape.offset_m * 0.4) for shape in shapes(6)]
    model = PlanarModel(START, inside, ("stiffness",))
    inside = [replace(shape, position_m=model.predict(model.start(), i)[0]) for i, shape in enumerate(inside)]  # type: ignore[index]
    body = fitted(PlanarModel(START, inside, ("stiffness",))).parameters[0]
    assert body.name == "EI1" and not body.determined  # the body was never outside the sheath


def as_json(recordings: list[RecordedShape]) -> dict:
    def markers(r: RecordedShape) -> list[dict]:
        return [{"offset_m": float(o), "position_m": p.tolist()} for o, p in zip(r.offset_m, r.position_m, strict=True)]

    return {
        "recordings": [
            {
                "insertion_m": r.insertion_m,
                "curvature_per_m": r.curvature_per_m,
                "force_N": r.force_N.tolist(),
                "markers": markers(r),
            }
            for r in recordings
        ]
    }


def as_csv(recordings: list[RecordedShape]) -> str:
    lines = [",".join(PLANAR_COLUMNS)]
    for k, r in enumerate(recordings):
        for o, p in zip(r.offset_m, r.position_m, strict=True):
            lines.append(",".join(map(repr, [k, r.insertion_m, r.curvature_per_m, *map(float, [*r.force_N, o, *p])])))
    return "\n".join(lines) + "\n"


def test_json_and_csv_read_the_same(tmp_path: Path) -> None:
    recordings = shapes(4, 1e-4)
    (tmp_path / "a.json").write_text(json.dumps(as_json(recordings)))
    (tmp_path / "a.csv").write_text(as_csv(recordings))
    for name in ("a.json", "a.csv"):
        read = read_recorded_shapes(str(tmp_path / name), 2)
        assert len(read) == 4
        for one, other in zip(read, recordings, strict=True):
            assert np.array_equal(one.position_m, other.position_m) and np.array_equal(one.offset_m, other.offset_m)
            assert np.array_equal(one.force_N, other.force_N) and one.insertion_m == other.insertion_m


@pytest.mark.parametrize(
    ("path", "value", "key"),
    [
        (("recordings", 0, "force_N"), [0.1], "recordings.0.force_N"),
        (("recordings", 0, "force_N"), [0.1, 0.2, 0.3], "recordings.0.force_N"),
        (("recordings", 0, "insertion_m"), float("nan"), "recordings.0.insertion_m"),
        (("recordings", 1, "markers"), [], "recordings.1.markers"),
        (("recordings", 1, "markers", 0, "offset_m"), -0.01, "recordings.1.markers.0.offset_m"),
        (("recordings", 1, "markers", 0, "position_m"), [0.1, 0.2, 0.3], "recordings.1.markers.0.position_m"),
        (("recordings", 1, "colour"), 1, "recordings.1.colour"),
    ],
)
def test_bad_recordings_are_refused_by_key(tmp_path: Path, path: tuple, value: object, key: str) -> None:
    data = as_json(shapes(2))
    place = data
    for part in path[:-1]:
        place = place[part]
    place[path[-1]] = value
    (tmp_path / "a.json").write_text(json.dumps(data))
    with pytest.raises(InputError) as caught:
        read_recorded_shapes(str(tmp_path / "a.json"), 2)
    assert caught.value.key == key


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text.replace("x_m", "x_mm"),
        lambda text: text.replace("15.0", "fifteen", 1),
        lambda text: text.replace("0,", "0,1", 1),
        lambda text: "",
    ],
)
def test_bad_tables_are_refused(tmp_path: Path, change) -> None:
    (tmp_path / "a.csv").write_text(change(as_csv(shapes(2))))
    with pytest.raises(InputError):
        read_recorded_shapes(str(tmp_path / "a.csv"), 2)


def test_markers_behind_the_sheath_are_refused() -> None:
    with pytest.raises(InputError, match="offset_m"):
        PlanarModel(START, [replace(shapes(1)[0], insertion_m=-0.03)], ("stiffness",))


def test_the_command_writes_a_catheter_that_loads(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.json").write_text(json.dumps(as_json(shapes(8, 1e-4))))
    (tmp_path / "start.toml").write_text((CATHETER_FOLDER / "thermocool_sf.toml").read_text().replace("1.490e-3", "0.9e-3"))
    calibrate(str(tmp_path / "a.json"), str(tmp_path / "start.toml"), tmp_path, name="made", method="both", json=True)
    report = json.loads(capsys.readouterr().out)
    made = load_catheter(tmp_path / "made.toml")
    assert isinstance(made, Catheter) and made.name == "made" and made.pcar is not None
    assert made.pcar.EI_N_m2[0] == pytest.approx(report["parameters"]["EI1"]["value"])
    assert made.pcar.EI_N_m2[0] == pytest.approx(1.490e-3, rel=0.03)
    assert [search["method"] for search in report["searches"]] == ["gauss-newton", "nelder-mead"]
    assert len(report["leave_one_out"]) == 8 and report["identifiability"]["undetermined"] == []
    assert "95 % intervals" in (tmp_path / "made.toml").read_text()
    calibrate(str(tmp_path / "a.json"), "thermocool_sf", leave_one_out=False)
    assert "EI1 =" in capsys.readouterr().out


@pytest.mark.parametrize(
    "wrong",
    [
        {"fit": "colour"},
        {"fit": ""},
        {"loss": "cubes"},
        {"method": "guess"},
        {"model": "rod"},
        {"out": Path("/dev/null/at/all")},
        {"name": "x.json"},
        {"catheter": "none"},
    ],
)
def test_bad_options_are_refused(tmp_path: Path, wrong: dict) -> None:
    (tmp_path / "a.json").write_text(json.dumps(as_json(shapes(2))))
    with pytest.raises(InputError):
        calibrate(**{"shapes": str(tmp_path / "a.json"), "catheter": "thermocool_sf", **wrong})


def test_the_rod_is_identified_from_spatial_shapes() -> None:
    from host.identification.spatial_model import SpatialModel
    from host.mechanics.cosserat import solve_cosserat

    table = load_catheter("steerocath_t")
    assert table.cosserat is not None
    # Table 3.2's torsion of this catheter is not the isotropic one that section 3.3 assumes
    isotropic = {
        "GJ": 0.3846 * (table.cosserat.EI1 + table.cosserat.EI2),
        "GbJ": 0.3846 * (table.cosserat.EbI1 + table.cosserat.EbI2),
    }
    truth = replace(table, cosserat=replace(table.cosserat, **isotropic))
    rng, recordings = np.random.default_rng(8), []
    for k in range(8):
        force = 0.1 * rng.normal(size=3)
        offset = np.linspace(0.0, 0.09, 10)
        at = solve_cosserat(truth, 0.03, 15.0 + 10.0 * (k % 2), force, stations_m=offset).station_positions_m
        recordings.append(RecordedShape(0.03, 15.0 + 10.0 * (k % 2), force, offset, at + 1e-4 * rng.normal(size=at.shape)))
    assert truth.cosserat is not None
    start = replace(truth, cosserat=replace(truth.cosserat, EI1=3e-4, EI2=3e-4, EbI1=5e-4, EbI2=5e-4))
    model = SpatialModel(start, recordings, ("stiffness",))
    found = calibrate_model(model, leave_one_out=False)
    for parameter in found.parameters:
        assert parameter.value == pytest.approx(vars(truth.cosserat)[parameter.name], rel=0.05), parameter
        assert parameter.low < vars(truth.cosserat)[parameter.name] < parameter.high
    made = model.catheter_at(found.x)
    assert made is not None and made.cosserat is not None
    assert made.cosserat.GJ == pytest.approx(0.3846 * (made.cosserat.EI1 + made.cosserat.EI2))
