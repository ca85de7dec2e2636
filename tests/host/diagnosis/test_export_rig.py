"""An exported rig file: a twin made of it equals the extended model of the recorded rig, and what has no key is said."""

from __future__ import annotations

import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from host.diagnosis.effects import candidates
from host.diagnosis.estimation.fit import Fit, Problem, Term
from host.diagnosis.export.rig import rig_patch, rig_text
from host.diagnosis.export.write import export
from host.diagnosis.live import recorded_rig
from host.diagnosis.live.recorded_rig import RecordedRig
from host.diagnosis.model.effect import Candidate, Context, Parameter
from host.diagnosis.model.nominal import nominal_path, read_nominal
from host.diagnosis.model.operators import play
from protocol.catheter import load_catheter
from protocol.errors import InputError
from protocol.rig_file import SIMULATED_RIG, Rig, load_rig, parse_rig


@pytest.fixture
def model(monkeypatch: pytest.MonkeyPatch) -> RecordedRig:
    """The rig of the simulated rig's file, as if a recording had carried it."""
    rig = load_rig(SIMULATED_RIG)
    monkeypatch.setattr(recorded_rig, "rig_of", lambda files: rig)
    monkeypatch.setattr(recorded_rig, "RecordingFile", lambda path: SimpleNamespace(catheter={}))
    monkeypatch.setattr(recorded_rig, "catheter_of", lambda data: load_catheter(rig.catheter.name))
    spec = read_nominal(nominal_path("rig"))
    spec._files = [Path("recording.mcap")]
    return RecordedRig(spec)


def diagnosed(model: RecordedRig, found: dict[str, list[float]], **nominal: float) -> Any:
    """A diagnosis with these effects and values, and these fitted nominal parameters."""
    every = {candidate.key: candidate for candidate in candidates(model.ports, True)}
    terms = [Term(every[key], tuple(Parameter(str(i), "", (v,)) for i, v in enumerate(at))) for key, at in found.items()]
    theta = [nominal.get(p.name, p.grid[0]) for p in model.parameters]
    values = np.array([*theta, *(v for at in found.values() for v in at)])
    problem = Problem(model, [], [], np.ones(12))
    return SimpleNamespace(model=model, problem=problem, found=SimpleNamespace(best=Fit(tuple(terms), values)))


def written(result: Any) -> tuple[Rig, list[str]]:
    patch = rig_patch(result)
    return parse_rig(tomllib.loads(rig_text(patch))), patch.left_out


def at(candidate: Candidate, signal: Any, values: list[float], time_s: Any) -> Any:
    assert candidate.effect.apply is not None
    context = Context(time_s, float(time_s[1] - time_s[0]), signal, 0.0)
    return candidate.effect.apply(signal, context, np.array(values), candidate.form)


def effect(model: RecordedRig, key: str) -> Candidate:
    return next(candidate for candidate in candidates(model.ports, True) if candidate.key == key)


def test_nothing_found_gives_the_recorded_rig_file(model: RecordedRig) -> None:
    rig, left_out = written(diagnosed(model, {}))
    assert rig == model.recorded_on and left_out == []


def test_two_plays_are_one_of_both_widths(model: RecordedRig) -> None:
    rig, left_out = written(diagnosed(model, {"backlash@insertion": [0.002]}, insertion_offset=-0.0885))
    known = model.recorded_on.transmission.insertion_backlash_m
    assert rig.transmission.insertion_at_home_m == -0.0885 and left_out == []
    handle = 0.01 * np.cumsum(np.random.default_rng(1).standard_normal(500))
    both = play(play(handle, 0.5 * known, handle[0]), 0.001, handle[0])
    one = play(handle, 0.5 * rig.transmission.insertion_backlash_m, handle[0])
    assert np.allclose(one[100:], both[100:], atol=1e-12)


def test_a_bent_knob_goes_into_the_curve_of_the_knob(model: RecordedRig) -> None:
    key, values = "static_nonlinearity@knob", [0.03, -0.05, 0.1, 1.2]
    gain = 33.0
    rig, left_out = written(diagnosed(model, {key: values}, knob_gain=gain, knob_offset=0.4))
    assert left_out == []
    old, new = model.recorded_on.transmission, rig.transmission
    first = next(p.grid[0] for p in model.parameters if p.name == "knob_gain")
    knob = np.linspace(old.knob_rad[0], old.knob_rad[-1], 301)
    handle = np.interp(knob, old.knob_rad, old.curvature_per_m) / first
    exact = gain * at(effect(model, key), handle, values, np.arange(knob.size) * 0.02) + 0.4
    assert np.max(np.abs(np.interp(knob, new.knob_rad, new.curvature_per_m) - exact)) < 2e-3 * np.ptp(exact)


@pytest.mark.parametrize(
    ("key", "values"),
    [
        ("sensor_misalignment@pose_sensor", [0.05, -0.02, 0.1]),
        ("sensor_bias@pose_sensor", [0.001, -0.002, 0.003]),
        ("base_motion@base(constant)", [0.002, -0.001, 0.03, -0.04]),
    ],
)
def test_the_tracker_is_registered_so_that_its_poses_are_the_true_ones(
    model: RecordedRig, key: str, values: list[float]
) -> None:
    rig, left_out = written(diagnosed(model, {key: values}))
    assert left_out == []
    true = np.random.default_rng(2).normal(0.0, 0.05, (3, 4))
    if key.startswith("base"):
        state = {"shift": np.zeros((3, 4)), "turn": None}
        candidate = effect(model, key)
        assert candidate.effect.apply is not None
        nothing = Context(np.arange(4.0), 1.0, np.zeros(4), 0.0)
        moved: Any = candidate.effect.apply(state, nothing, np.array(values), candidate.form)
        read = np.einsum("abn,bn->an", moved["turn"], true + moved["shift"])
    else:
        run = {name: true for name in ("tip", "shaft")} | {f"{name}_R": np.zeros((3, 3, 4)) for name in ("tip", "shaft")}
        candidate = effect(model, key)
        assert candidate.effect.apply is not None
        context = Context(np.arange(4.0), 1.0, np.zeros(4), 0.0)
        read = candidate.effect.apply(run, context, np.array(values), "")["tip"]
    old, new = model.recorded_on.tracker, rig.tracker
    before, after = (Rotation.from_quat(np.roll(t.base_from_tracker_wxyz, -1)) for t in (old, new))
    raw = before.inv().apply(read.T - np.array(old.base_from_tracker_m))
    # The finder turns by a rotation of second order in the angles, the file holds an exact one.
    assert np.allclose(after.apply(raw) + np.array(new.base_from_tracker_m), true.T, atol=1e-5)


def test_force_readings_become_the_true_force(model: RecordedRig) -> None:
    found = {"sensor_misalignment@force_sensor": [0.2, 0.1, -0.1], "sensor_scale@force_sensor": [0.25]}
    rig, _ = written(diagnosed(model, found))
    old, new = model.recorded_on.force_sensor, rig.force_sensor
    force = np.array([[0.1], [-0.2], [0.3]])
    time_s = np.arange(2.0)
    read = 1.25 * at(
        effect(model, "sensor_misalignment@force_sensor"), force, found["sensor_misalignment@force_sensor"], time_s
    )
    before, after = (Rotation.from_quat(np.roll(s.base_from_sensor_wxyz, -1)) for s in (old, new))
    counts = before.inv().apply(read.T) * old.counts_per_newton
    assert np.allclose(after.apply(counts / new.counts_per_newton), force.T, atol=1e-12)


def test_late_poses_are_stamped_earlier(model: RecordedRig) -> None:
    rig, _ = written(diagnosed(model, {"latency@pose_sensor": [0.05]}))
    assert rig.tracker.latency_s == pytest.approx(model.recorded_on.tracker.latency_s + 0.05)


def test_what_has_no_key_is_said_in_a_line_of_the_file(model: RecordedRig, tmp_path: Path) -> None:
    result = diagnosed(model, {"backlash@knob": [0.06]}, bending_stiffness=2.5e-4, roll_offset=0.02)
    left_out = export(result, tmp_path / "rig.toml")
    assert [sentence.split()[0] for sentence in left_out] == ["The", "The", "backlash@knob"]
    text = (tmp_path / "rig.toml").read_text()
    assert all(f"# {sentence}\n" in text for sentence in left_out)
    assert load_rig(tmp_path / "rig.toml") == model.recorded_on


def test_a_value_beyond_a_limit_of_the_rig_file_is_refused(model: RecordedRig) -> None:
    with pytest.raises(InputError, match="insertion_backlash_m"):
        rig_patch(diagnosed(model, {"backlash@insertion": [0.03]}))


def test_another_kind_has_no_rig_file(tmp_path: Path) -> None:
    from tests.host.diagnosis.test_export import case

    with pytest.raises(InputError, match="recordings of a rig"):
        rig_patch(case(tmp_path, "callable", ()))
