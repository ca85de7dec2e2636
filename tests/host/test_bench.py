"""The benchmark's registry and rows; never how fast anything is."""

from __future__ import annotations

import sys
import time
import types

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from host.cli.bench import bench as bench_command
from host.studies.benchmarks import control
from host.studies.benchmarks import runner as bench
from host.studies.benchmarks.runner import PairedTimes, alternate, find, row_of, run
from protocol.errors import InputError

CONTRACT_KEYS = ("name", "unit", "median", "p95", "seed", "peer", "peer_median", "speedup")


def quiet(_line: str) -> None:
    return None


def test_every_name_of_the_contract_is_registered() -> None:
    assert bench.CONTRACT <= set(bench.BENCHMARKS) and len(bench.CONTRACT) == 13


def test_both_sides_run_in_turn_on_each_input() -> None:
    calls: list[str] = []

    def ours(name: str) -> object:
        return lambda repeats: (calls.append(name), time.sleep(2e-4))

    def peer(name: str) -> object:
        return lambda: calls.append("peer " + name)

    timed = alternate([ours("a"), ours("b")], [peer("a"), peer("b")])  # type: ignore[list-item]
    assert calls == (["a"] + ["a", "peer a"] * bench.BLOCKS + ["b"] + ["b", "peer b"] * bench.BLOCKS)
    assert len(timed.ours_s) == len(timed.peer_s) == 2 and min(timed.ours_s) > 1e-4


def test_a_row_has_the_contracts_keys() -> None:
    row = row_of(
        "x", "cold", "some peer", PairedTimes([1e-6, 2e-6, 3e-6], [1e-3] * 3), 5, tip_error_m=1e-9, peer_tip_error_m=1e-4
    )
    assert all(key in row for key in CONTRACT_KEYS)
    assert row["unit"] == "us" and row["median"] == pytest.approx(2.0) and row["speedup"] == pytest.approx(500.0)
    assert row["tip_error_m"] == 1e-9 and row["seed"] == 5 and row["cases"] == 3


def test_an_unknown_name_is_bad_input() -> None:
    with pytest.raises(InputError, match="cosserat_tip"):
        run(["cosserat_tipp"], 1, quiet)


def test_a_benchmark_can_be_added_and_one_whose_module_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    module = types.ModuleType("a_new_benchmark")
    module.added = lambda seed, report: [{"name": "added", "seed": seed}]  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "a_new_benchmark", module)
    monkeypatch.setattr(
        bench, "BENCHMARKS", {"added": "a_new_benchmark:added", "absent": "host.studies.benchmarks.absent:absent"}
    )
    rows, missing = run([], 3, quiet)
    assert rows == [{"name": "added", "seed": 3}]
    assert missing == {"absent": "the module host.studies.benchmarks.absent is not installed"}


def test_a_row_of_the_contract_that_is_missing_fails_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "BENCHMARKS", {"diagnose": "no_such_module:diagnose", "extra": "no_such_module:extra"})
    done = CliRunner().invoke(_app(), [])
    assert done.exit_code == 1 and "missing row diagnose: the module no_such_module is not installed" in done.output
    monkeypatch.setattr(bench, "BENCHMARKS", {"extra": "no_such_module:extra"})
    done = CliRunner().invoke(_app(), [])
    assert done.exit_code == 0 and "extra: left out, the module no_such_module is not installed" in done.output
    assert CliRunner().invoke(_app(), ["--only", "extra"]).exit_code == 1


def _app() -> typer.Typer:
    app = typer.Typer()
    app.command()(bench_command)
    return app


def test_the_diagnosis_names_the_effect_and_the_messages_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    from host.studies.benchmarks import diagnosis, messages

    verdict = {"effects": [{"id": "backlash", "parameters": {"width_rad": {"value": 0.08}}}]}
    assert diagnosis.width_in(verdict) == 0.08 and np.isnan(diagnosis.width_in({"effects": []}))
    recordings = diagnosis.recordings_of(1, 0.08)
    assert abs(diagnosis.fitted_width_rad(recordings) - 0.08) < 1e-3
    monkeypatch.setattr(messages, "CASES", 7)
    rows = [*messages.message_decode(1, quiet), *messages.message_encode(1, quiet)]
    assert [row["right"] for row in rows] == [7, 7]


def test_a_module_that_is_there_but_broken_is_an_error(monkeypatch: pytest.MonkeyPatch, tmp_path: object) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "broken_benchmark.py").write_text("import no_such_library\n")  # type: ignore[operator]
    monkeypatch.setattr(bench, "BENCHMARKS", {"broken": "broken_benchmark:run"})
    with pytest.raises(ModuleNotFoundError, match="no_such_library"):
        find("broken")


@pytest.mark.parametrize("name", ["cosserat_tip", "pcar_direct"])
def test_a_real_benchmark_holds_its_accuracy(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from host.studies.benchmarks import planar, statics

    monkeypatch.setattr(statics, "CASES", 4)
    monkeypatch.setattr(planar, "CASES", 4)
    (row,), missing = run([name], 1, quiet)
    assert not missing and all(key in row for key in CONTRACT_KEYS)
    assert row["name"] == name and row["right"] == row["cases"] == 4 and row["tip_error_m"] < 1e-6


def test_the_predictor_is_the_textbooks_filter(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control, "READINGS", 1)
    row = control.kalman_predict(3, lambda line: None)[0]
    assert row["position_difference_m"] < 1e-12


def test_the_tick_as_plain_python_is_the_compiled_tick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control, "READINGS", 1)
    row = control.control_tick(3, lambda line: None)[0]
    assert row["joint_difference"] == 0.0


def test_the_rigs_estimators_answer_every_pose_of_one_job(monkeypatch: pytest.MonkeyPatch) -> None:
    from host.studies.benchmarks import rig_estimators

    monkeypatch.setattr(rig_estimators, "CONTACT_S", 0.5)
    (row,) = rig_estimators.estimate_rig(1, lambda line: None)
    assert row["cases"] > 50 and row["median"] > 0.0 and row["peer_median"] > 0.0
