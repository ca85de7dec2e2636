"""`seldinger solve` and `seldinger estimate` as scripts call them: JSON in, one object out, exit statuses, refusals."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import typer

from host.cli.estimate import estimate
from host.cli.solve import solve
from protocol.errors import InputError

REFERENCES = json.loads((Path(__file__).parents[1] / "references" / "planar.json").read_text())
PLANAR = {
    "model": "pcar",
    "catheter": "thermocool_sf",
    "insertion_m": 0.0485,
    "curvature_per_m": 15.7,
    "force_N": [0.0, -0.1197],
}
SPATIAL = {
    "model": "cosserat",
    "catheter": "livewire",
    "insertion_m": 0.01,
    "curvature_per_m": 10.0,
    "force_N": [0.0, 0.05, 0.0],
    "force_frame": "base",
    "tendon_tension_N": 0.0,
    "stations_m": [0.03, 0.05],
}
POSE = {
    "model": "pcar",
    "catheter": "thermocool_sf",
    "insertion_m": 0.0485,
    "curvature_per_m": 15.7,
    "tip": {"position_m": [0.114, -0.028], "angle_rad": -0.16},
}
SENSOR = {"offset_m": 0.0, "position_m": [0.0, 0.0, 0.07], "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]}
SENSORS = {
    "model": "cosserat",
    "catheter": "livewire",
    "insertion_m": 0.01,
    "curvature_per_m": 10.0,
    "case": 2,
    "sensors": [SENSOR],
}


@pytest.fixture
def ask(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable:
    """Calls a command with a request; returns exit status, the JSON object, and what was said on standard error."""

    def run(command: Callable, request: object, **options: object) -> tuple[int, dict, str]:
        path = tmp_path / "request.json"
        path.write_text(request if isinstance(request, str) else json.dumps(request))
        status = 0
        try:
            command(str(path), json=True, **options)
        except typer.Exit as ended:
            status = ended.exit_code
        heard = capsys.readouterr()
        return status, json.loads(heard.out), heard.err

    return run


@pytest.mark.parametrize("case", [*REFERENCES["table_2_2"], *REFERENCES["retracted"]])
def test_solve_pcar_meets_the_references_and_estimate_inverts_it(ask: Callable, case: dict) -> None:
    actuation = {
        "model": "pcar",
        "catheter": "thermocool_sf",
        "insertion_m": case["insertion_m"],
        "curvature_per_m": case["curvature_per_m"],
    }
    status, answer, _ = ask(solve, {**actuation, "force_N": case["force_N"]})
    assert status == 0 and answer["converged"] and answer["stable"] and isinstance(answer["iterations"], int)
    assert np.allclose(answer["tip"]["position_m"], case["tip_m"], rtol=0, atol=1e-12)
    assert answer["tip"]["angle_rad"] == pytest.approx(case["angle_rad"], abs=1e-11)
    assert len(answer["arc_curvatures_per_m"]) == 3
    status, found, _ = ask(estimate, {**actuation, "tip": answer["tip"]})
    assert status == 0 and found["converged"] and found["force_frame"] == "base" and found["residual"] < 1e-9
    assert np.shape(found["covariance_N2"]) == (2, 2)
    if case["insertion_m"] > -0.0192:  # beyond, one arc is out, which cannot tell the force
        assert np.abs(np.array(found["force_N"]) - case["force_N"]).max() < 1e-6


def test_stations_are_arc_lengths_back_from_the_tip(ask: Callable) -> None:
    _, answer, _ = ask(solve, {**PLANAR, "stations_m": [0.0, 0.07, 0.1185, 0.1285]})
    tip, joint, base, inside = answer["stations"]
    assert np.allclose(inside["position_m"], [-0.01, 0.0], atol=1e-15) and inside["angle_rad"] == 0.0
    assert np.allclose(tip["position_m"], answer["tip"]["position_m"], atol=1e-15)
    body = answer["arc_curvatures_per_m"][0] * 0.0485
    assert joint["angle_rad"] == pytest.approx(body) and np.allclose(base["position_m"], 0.0, atol=1e-15)


def test_a_fold_is_status_1_and_not_converged(ask: Callable, tmp_path: Path) -> None:
    case = REFERENCES["fold"][0]
    soft = tmp_path / "soft.toml"
    EI = [value / case["softer"] for value in (1.490e-3, 0.430e-3, 0.250e-3)]
    soft.write_text(
        f'name = "soft"\ndistal_length_m = 0.07\ndiameter_m = 0.002\npull_wire_offset_m = 0.0007\n'
        f"[pcar]\nEI_N_m2 = {EI}\ndistal_arcs_m = [0.0192, 0.0508]\n"
    )
    status, answer, said = ask(
        solve,
        {
            "model": "pcar",
            "catheter": str(soft),
            "insertion_m": case["insertion_m"],
            "curvature_per_m": case["curvature_per_m"],
            "force_N": case["force_N"],
        },
    )
    assert status == 1 and answer["converged"] is False and answer["reason"] == "fold" and "tip" not in answer
    assert 0.2 < answer["load_reached"] < 0.3 and "fold" in said


def test_a_pose_that_no_force_explains_is_status_1_and_not_converged(ask: Callable) -> None:
    status, answer, said = ask(estimate, {**POSE, "tip": {"position_m": [0.1, 0.0], "angle_rad": 2.0}})
    assert status == 1 and answer["converged"] is False and answer["residual"] > 0.01 and said
    assert np.isfinite(answer["force_N"]).all() and np.isfinite(answer["covariance_N2"]).all()


@pytest.mark.parametrize(
    ("request_", "key"),
    [
        ({**POSE, "tip": {"position_m": [0.14, 0.0], "angle_rad": 0.0}}, "tip.position_m"),
        ({**SENSORS, "sensors": [{**SENSOR, "position_m": [0.0, 0.0, 0.2]}]}, "sensors.0.position_m"),
    ],
)
def test_a_pose_beyond_the_catheters_reach_is_bad_input(ask: Callable, request_: dict, key: str) -> None:
    with pytest.raises(InputError, match=f"^{key}: .*mm from the sheath's exit"):
        ask(estimate, request_)


def test_solve_cosserat_and_estimate_agree(ask: Callable) -> None:
    status, answer, _ = ask(solve, {**SPATIAL, "force_N": [0.02, 0.05, -0.01]})
    assert status == 0 and answer["converged"] and len(answer["stations"]) == 2
    assert np.linalg.norm(answer["force_tip_N"]) == pytest.approx(np.linalg.norm([0.02, 0.05, -0.01]), rel=1e-9)
    sensors = [
        {"offset_m": 0.0, **answer["tip"]},
        {"offset_m": 0.03, **answer["stations"][0]},
        {"offset_m": 0.05, **answer["stations"][1]},
    ]
    for case in (2, 4, 6):
        status, found, _ = ask(estimate, {**SENSORS, "case": case, "sensors": sensors})
        assert status == 0 and found["converged"] and found["force_frame"] == "tip"
        assert np.abs(np.array(found["force_N"]) - answer["force_tip_N"]).max() < 1e-6
        assert np.shape(found["covariance_N2"]) == (3, 3)


def test_planar_case_of_the_rod_equals_many_arcs(ask: Callable) -> None:
    from host.mechanics import pcar
    from protocol.catheter import load_catheter

    arcs = pcar.arcs_of(load_catheter("steerocath_t"), 0.03, 20.0, 2.5e-4)
    found = pcar.solve(arcs, [-0.05, -0.12])
    _, answer, _ = ask(
        solve,
        {
            **SPATIAL,
            "catheter": "steerocath_t",
            "insertion_m": 0.03,
            "curvature_per_m": 20.0,
            "force_N": [0.0, 0.12, -0.05],
            "stations_m": [],
        },
    )
    x, y = found.tip_position_m
    assert np.allclose(answer["tip"]["position_m"], [0.0, -y, x], rtol=0, atol=2e-7)


def without(request: dict, key: str) -> dict:
    return {name: value for name, value in request.items() if name != key}


@pytest.mark.parametrize(
    ("command", "request_", "key"),
    [
        *[(solve, without(PLANAR, key), key) for key in ("model", "catheter", "insertion_m", "curvature_per_m", "force_N")],
        *[(solve, without(SPATIAL, key), key) for key in ("force_N", "force_frame")],
        (solve, {**PLANAR, "forces_N": [0.0, 0.1]}, "forces_N"),
        (solve, {**without(PLANAR, "force_N"), "forces_N": [0.0, 0.1]}, "forces_N"),
        (solve, {**PLANAR, "model": "helical"}, "model"),
        (solve, {**PLANAR, "catheter": "lifewire"}, "catheter"),
        (solve, {**PLANAR, "catheter": 7}, "catheter"),
        (solve, {**PLANAR, "insertion_m": -0.08}, "insertion_m"),
        (solve, {**PLANAR, "insertion_m": "0.01"}, "insertion_m"),
        (solve, {**PLANAR, "insertion_m": True}, "insertion_m"),
        (solve, {**PLANAR, "insertion_m": None}, "insertion_m"),
        (solve, {**PLANAR, "curvature_per_m": float("nan")}, "curvature_per_m"),
        (solve, {**PLANAR, "force_N": [0.0, float("inf")]}, "force_N.1"),
        (solve, {**PLANAR, "force_N": [0.0]}, "force_N"),
        (solve, {**PLANAR, "force_N": [0.0, 0.1, 0.0]}, "force_N"),
        (solve, {**PLANAR, "force_N": 0.1}, "force_N"),
        (solve, {**PLANAR, "force_N": [[0.0], [0.1]]}, "force_N.0"),
        (solve, {**PLANAR, "force_frame": "tip"}, "force_frame"),
        (solve, {**PLANAR, "stations_m": [-0.01]}, "stations_m.0"),
        (solve, {**PLANAR, "stations_m": [0.02, 2.0]}, "stations_m.1"),
        (solve, {**SPATIAL, "catheter": "thermocool_sf"}, "catheter"),
        (solve, {**SPATIAL, "force_frame": "world"}, "force_frame"),
        (solve, {**SPATIAL, "force_N": [0.0, 0.1]}, "force_N"),
        (solve, {**SPATIAL, "tendon_tension_N": -1.0}, "tendon_tension_N"),
        (solve, {**SPATIAL, "insertion_m": -0.07}, "insertion_m"),
        *[(estimate, without(POSE, key), key) for key in ("model", "catheter", "insertion_m", "curvature_per_m", "tip")],
        (estimate, {**POSE, "tip": {"position_m": [0.1], "angle_rad": 0.0}}, "tip.position_m"),
        (estimate, {**POSE, "tip": {"position_m": [0.1, float("nan")], "angle_rad": 0.0}}, "tip.position_m.1"),
        (estimate, {**POSE, "tip": {"position_m": [0.1, 0.0]}}, "tip.angle_rad"),
        (estimate, {**POSE, "tip": {"position_m": [0.1, 0.0], "angle_rad": 0.0, "roll": 1}}, "tip.roll"),
        *[(estimate, without(SENSORS, key), key) for key in ("case", "sensors")],
        (estimate, {**SENSORS, "case": 7}, "case"),
        (estimate, {**SENSORS, "case": 2.5}, "case"),
        (estimate, {**SENSORS, "case": 4}, "request"),
        (estimate, {**SENSORS, "sensors": []}, "sensors"),
        (
            estimate,
            {**SENSORS, "sensors": [{**SENSOR, "quaternion_wxyz": [1.0, 0.1, 0.0, 0.0]}]},
            "sensors.0.quaternion_wxyz",
        ),
        (estimate, {**SENSORS, "sensors": [{**SENSOR, "quaternion_wxyz": [1.0, 0.0, 0.0]}]}, "sensors.0.quaternion_wxyz"),
        (estimate, {**SENSORS, "sensors": [{**SENSOR, "offset_m": -0.01}]}, "sensors.0.offset_m"),
        (estimate, {**SENSORS, "sensors": [{**SENSOR, "position_m": [0.0, float("inf"), 0.0]}]}, "sensors.0.position_m.1"),
        (solve, [1, 2], "request.json"),
        (estimate, "{", "request.json"),
        (estimate, "", "request.json"),
    ],
)
def test_bad_input_is_refused_naming_the_key(ask: Callable, command: Callable, request_: object, key: str) -> None:
    with pytest.raises(InputError) as caught:
        ask(command, request_)
    assert caught.value.key.endswith(key) and "\n" not in str(caught.value)


def test_missing_files_are_refused() -> None:
    for command in (solve, estimate):
        with pytest.raises(InputError, match="no_such_file"):
            command("no_such_file.json")


def test_standard_input_and_the_words_for_people(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(json.dumps(PLANAR).encode())))
    solve("-")
    assert "tip (mm):        +114.4728  -28.3299" in capsys.readouterr().out
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(json.dumps(POSE).encode())))
    estimate("-")
    assert "standard deviation" in capsys.readouterr().out


def test_plots_are_drawn_and_bad_targets_refused_first(ask: Callable, tmp_path: Path) -> None:
    for command, request in ((solve, PLANAR), (estimate, POSE)):
        target = tmp_path / f"{command.__name__}.png"
        assert ask(command, request, plot=str(target))[0] == 0
        assert target.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    for bad in ("shape.pdf", str(tmp_path / "none" / "shape.png")):
        with pytest.raises(InputError, match="plot"):
            ask(solve, PLANAR, plot=bad)
