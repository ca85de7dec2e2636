"""The proof from sealed suite to table with finders that cheat, resumed runs, and lost workers."""

import io
import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from host.cli.progress import Progress
from host.cli.prove import prove
from host.studies.proof import baselines, picture, workers
from host.studies.proof.runner import Settings, open_seal
from host.studies.proof.runner import prove as run
from protocol.errors import InputError
from tests.host.proof import suite

N = len(suite.DRAFTS)
Fresh = Callable[[], Path]
Built = tuple[Path, list[dict]]  # type: ignore[type-arg]


def settings(folder: Path, finder: str, **more: object) -> Settings:
    return Settings(N, suite.SEED, folder, 1, finder=tuple(finder.split()), limit_s=60.0, with_baselines=False, **more)  # type: ignore[arg-type]


def outcome(folder: Path, finder: str, **more: object) -> dict:  # type: ignore[type-arg]
    return run(settings(folder, finder, **more), lambda *a: None, lambda digest: None)


def test_one_that_always_says_nothing(fresh: Fresh, tmp_path: Path) -> None:
    result = outcome(fresh(), suite.finder(tmp_path / "f.py", suite.NOTHING))
    table = result["table"]
    assert table["null_cases"] == 3 and table["false_alarms"] == 0
    assert table["named_first"] == table["truth_in_set"] == table["pairs_exact"] == table["outside_flagged"] == 0.0
    assert table["confident_wrong_in_library"] == table["confident_wrong_outside"] == 0.0
    assert table["detected_rho_0.5"] == 0.0 and table["gap_closed_in_library"] is None
    right = {c["category"] for c in result["cases"] if c["right"] and c["rho"] > 0.15}
    assert right == set() and all(c["right"] for c in result["cases"] if c["category"] == "null")


def test_one_that_always_says_backlash(fresh: Fresh, tmp_path: Path) -> None:
    result = outcome(fresh(), suite.finder(tmp_path / "f.py", suite.BACKLASH))
    table = result["table"]
    true = [c for c in result["cases"] if any(t.startswith("backlash@") for t in c["truth"])]
    assert table["false_alarms"] == table["null_cases"] == 3
    assert table["confident_wrong_outside"] == 1.0 and table["outside_flagged"] == 0.0
    assert table["confident_wrong_in_library"] == pytest.approx(1.0 - len(true) / 5)
    assert not any(c["right"] for c in result["cases"] if c not in true)


def test_one_that_copies_the_truth(built: Built, fresh: Fresh, tmp_path: Path) -> None:
    result = outcome(fresh(), suite.truthful(tmp_path / "f.py", *built))
    table = result["table"]
    assert all(c["right"] for c in result["cases"]), [c["id"] for c in result["cases"] if not c["right"]]
    assert table["false_alarms"] == 0 and table["confident_wrong_in_library"] == table["confident_wrong_outside"] == 0.0
    for key in (
        "named_first",
        "truth_in_set",
        "pairs_exact",
        "outside_flagged",
        "equation_form",
        "subsystem_right",
        "coverage_95",
    ):
        assert table[key] == 1.0, key
    assert table["gap_closed_in_library"] == pytest.approx(1.0) and table["window_f1"] > 0.95
    assert set(result) == {"labels_sha256", "cases", "table", "baselines", "worlds"}


def test_the_finder_gets_recordings_and_nothing_else(fresh: Fresh, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SELDINGER_DATA", "/somewhere")
    spy = (
        "verdict = {'verdict': 'nothing_missing', 'effects': [], 'files': sorted(os.listdir()), 'arguments': sys.argv[1:],"
        " 'told': [k for k in os.environ if k.startswith('SELDINGER')]}"
    )
    folder = fresh()
    (folder / "own" / "cases" / "case_0000").rename(tmp_path / "only")
    verdict = workers.run_case(workers.read_case(tmp_path / "only"), suite.finder(tmp_path / "f.py", spy).split(), 60.0)
    assert {name.partition(".")[0] for name in verdict["files"]} == {"a", "b", "c", "nominal"}
    assert verdict["told"] == [] and str(folder) not in " ".join(verdict["arguments"])


def test_labels_are_announced_before_and_checked_after(fresh: Fresh, tmp_path: Path) -> None:
    folder, order = fresh(), []
    spoiling = suite.finder(
        tmp_path / "f.py",
        suite.NOTHING + f"\nos.chmod({str(folder / 'own/sealed/labels.json')!r}, 0o600)"
        f"\nopen({str(folder / 'own/sealed/labels.json')!r}, 'a').write(' ')",
    )
    with pytest.raises(RuntimeError, match="changed during the run"):
        run(settings(folder, spoiling), lambda stage, *a: order.append(stage), lambda digest: order.append(digest))
    assert len(order[1 + order.index("generate own")]) == 64 and order.index("diagnose own") > 1


def test_a_stopped_run_goes_on_where_it_was(fresh: Fresh, tmp_path: Path) -> None:
    folder, log = fresh(), tmp_path / "log"
    counting = suite.finder(tmp_path / "f.py", f"open({str(log)!r}, 'a').write('x')\n{suite.NOTHING}")

    def stop_after_four(stage: str, done: int, total: int) -> None:
        if stage == "diagnose own" and done == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(settings(folder, counting), stop_after_four, lambda digest: None)
    kept = {p.name: p.stat().st_mtime_ns for p in (folder / "own" / "verdicts").glob("*.json")}
    assert 4 <= len(kept) < N or len(log.read_text()) == N
    outcome(folder, counting)
    assert all((folder / "own" / "verdicts" / name).stat().st_mtime_ns == at for name, at in kept.items())
    assert len(list((folder / "own" / "verdicts").glob("*.json"))) == N
    before = len(log.read_text())
    outcome(folder, counting)
    assert len(log.read_text()) == before


def test_a_folder_of_another_suite_is_refused(fresh: Fresh) -> None:
    folder = fresh()
    (folder / "suite.json").write_text(json.dumps({"seed": 1, "cases": 5}))
    with pytest.raises(InputError, match="--out"):
        outcome(folder, "false")


def test_a_process_that_dies_runs_again_and_a_failure_is_listed(built: Built, tmp_path: Path) -> None:
    folders = {name: built[0] / "own" / "cases" / name for name in ("case_0000", "case_0001")}
    mark = tmp_path / "mark"
    dying = suite.finder(
        tmp_path / "f.py",
        f"if not os.path.exists({str(mark)!r}):\n    open({str(mark)!r}, 'w')\n    os.kill(os.getpid(), 9)\n{suite.NOTHING}",
    )
    verdicts = dict(workers.locally(folders, dying.split(), 60.0, 1))
    assert {v["verdict"] for v in verdicts.values()} == {"nothing_missing"} and mark.exists()
    failing = suite.finder(tmp_path / "g.py", "sys.exit('seldinger: kind: found x')")
    verdict = dict(workers.locally(folders, failing.split(), 60.0, 1))["case_0001"]
    assert verdict["verdict"] == "failed" and "found x" in verdict["error"]
    slow = suite.finder(tmp_path / "h.py", "time.sleep(30)")
    assert "no verdict" in workers.run_case(workers.read_case(folders["case_0000"]), slow.split(), 0.5)["error"]


def test_two_workers_on_loopback_and_one_is_lost(built: Built, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed", reason="dask.distributed is not installed")
    folders = {label["id"]: built[0] / "own" / "cases" / label["id"] for label in built[1]}
    slow = suite.finder(tmp_path / "f.py", f"time.sleep(0.2)\n{suite.NOTHING}")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0", host="127.0.0.1"
    ) as cluster:
        verdicts, killed = {}, False
        for name, verdict in workers.on_cluster(folders, slow.split(), 60.0, cluster.scheduler_address):
            verdicts[name] = verdict["verdict"]
            if not killed:
                with distributed.Client(cluster.scheduler_address) as client:
                    busy = next(worker for worker, cases in client.processing().items() if cases)
                    pid = client.run(os.getpid, workers=[busy])[busy]
                os.kill(pid, 9)
                killed = True
    assert verdicts == dict.fromkeys(folders, "nothing_missing")


def test_no_scheduler_is_one_line(built: Built) -> None:
    pytest.importorskip("distributed", reason="dask.distributed is not installed")
    with pytest.raises(InputError, match="--scheduler"):
        list(
            workers.on_cluster({"case_0000": built[0] / "own" / "cases" / "case_0000"}, ["false"], 1.0, "tcp://127.0.0.1:9")
        )


def test_a_changed_seal_is_seen(fresh: Fresh) -> None:
    with pytest.raises(RuntimeError, match="sha256"):
        open_seal(fresh() / "own", "0" * 64)


def test_baselines_on_a_case(built: Built) -> None:
    label = next(la for la in built[1] if la["category"] == "single" and la["kind"] == "axis")
    rows = baselines.compare(json.loads(json.dumps(label)), built[0] / "own" / "cases" / label["id"])
    assert tuple(rows) == baselines.NAMES
    assert rows["refitted_nominal"]["gap_closed"] == 0.0
    assert rows["oracle"]["gap_closed"] == pytest.approx(1.0, abs=0.15) and rows["oracle"]["detected"]
    assert "unavailable" in rows["pysindy"] or rows["pysindy"]["gap_closed"] < rows["oracle"]["gap_closed"]
    assert rows["gaussian_process"]["gap_closed"] < rows["oracle"]["gap_closed"]


def test_pysindy_absent_is_said(built: Built, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pysindy", None)
    label = built[1][1]
    rows = baselines.compare(label, built[0] / "own" / "cases" / label["id"])
    assert "not installed" in rows["pysindy"]["unavailable"]


def test_command_prints_a_table_and_keeps_its_result(
    fresh: Fresh, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = fresh()
    prove(
        cases=N,
        seed=suite.SEED,
        json=False,
        jobs=1,
        scheduler=None,
        resume=None,
        out=folder,
        limit_s=60.0,
        baselines=False,
        finder=suite.finder(tmp_path / "f.py", suite.NOTHING),
        world="own",
        calibration=None,
    )
    out, err = capsys.readouterr()
    assert "| false alarms | 0 | 0 |" in out and "labels sha256" in err and "WRONG  own case_0003" in err
    assert json.loads((folder / "proof.json").read_text())["table"]["null_cases"] == 3
    prove(
        cases=N,
        seed=suite.SEED,
        json=True,
        jobs=1,
        scheduler=None,
        resume=folder,
        out=None,
        limit_s=60.0,
        baselines=False,
        finder=None,
        world="own",
        calibration=None,
    )
    assert json.loads(capsys.readouterr().out)["labels_sha256"]
    with pytest.raises(InputError, match="--cases"):
        prove(
            cases=0,
            seed=1,
            json=False,
            jobs=1,
            scheduler=None,
            resume=None,
            out=folder,
            limit_s=60.0,
            baselines=False,
            finder=None,
            world="own",
            calibration=None,
        )
    with pytest.raises(InputError, match="--resume"):
        prove(
            cases=N,
            seed=1,
            json=False,
            jobs=1,
            scheduler=None,
            resume=tmp_path / "none",
            out=None,
            limit_s=60.0,
            baselines=False,
            finder=None,
            world="own",
            calibration=None,
        )


def test_without_a_terminal_progress_is_a_line_at_begin_and_end_and_now_and_then(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    monkeypatch.setattr("sys.stderr", stream)
    clock = iter(range(1000))
    monkeypatch.setattr("host.cli.progress.time.monotonic", lambda: 0.5 * next(clock))
    bar = Progress()
    for done in range(101):
        bar("diagnose", done / 100, f"{done}/100")
    lines = stream.getvalue().splitlines()
    # Fifty seconds: the first line, one every ten seconds, and the last, which is due when the work ends.
    assert "0/100" in lines[0] and "100/100" in lines[-1] and len(lines) == 2 + 4


def test_a_case_as_a_picture(built: Built, tmp_path: Path) -> None:
    picture.main(["--dir", str(built[0] / "own"), "--case", "case_0000", "--out", str(tmp_path / "case.png")])
    assert (tmp_path / "case.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
