"""The command as its user meets it: JSON by contract, a report that stands alone, bad input as one line."""

from __future__ import annotations

import json
import subprocess
import sys
from html import unescape
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from host.cli.diagnose import diagnose
from host.diagnosis import diagnose as find
from protocol.errors import InputError
from tests.host.diagnosis import planted

KEYS = {
    "verdict",
    "located",
    "data_findings",
    "probability_none",
    "probability_none_raw",
    "rules",
    "worse",
    "next",
    "stopped_early",
    "effects",
    "fit",
    "seconds",
    "scripts",
}
FIT = {
    "heldout",
    "rmse_before",
    "rmse_after",
    "noise_floor",
    "unit",
    "per_channel",
    "whiteness_p_before",
    "whiteness_p_after",
}
EFFECT = {
    "id",
    "subsystem",
    "port",
    "probability",
    "probability_raw",
    "alternatives",
    "rests_on",
    "cross_validated",
    "says",
    "equation",
    "parameters",
    "evidence",
    "indistinguishable_from",
    "experiment_to_tell_apart",
    "experiment_separates",
}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict, str]:
    """JSON and report of a planted case."""
    folder = tmp_path_factory.mktemp("case")
    nominal, files = planted.transmission(folder, "backlash", 1)
    diagnose([str(f) for f in files], str(nominal), out=folder / "out", quiet=True)
    return json.loads((folder / "out" / "verdict.json").read_text()), (folder / "out" / "report.html").read_text()


def test_json_is_what_the_contract_says(made: tuple[dict, str]) -> None:
    verdict, _ = made
    assert set(verdict) == KEYS and set(verdict["fit"]) >= FIT and verdict["fit"]["heldout"] is True
    (effect,) = verdict["effects"]
    assert set(effect) == EFFECT and set(effect["evidence"]) == {"heldout_log_likelihood_gain", "p_value"}
    (place,) = verdict["located"]
    assert set(place) >= {"subsystem", "channels", "windows_s", "condition", "residual_share"}
    assert verdict["fit"]["rmse_after"] < verdict["fit"]["rmse_before"]
    assert all(len(p["ci95"]) == 2 and p["ci95"][0] <= p["value"] <= p["ci95"][1] for p in effect["parameters"].values())


def test_recordings_without_information_get_the_same_keys_and_a_report(made: tuple[dict, str], tmp_path: Path) -> None:
    verdict, _ = made
    t = np.arange(600) * 0.01
    nominal = {
        "name": "gear",
        "kind": "transmission",
        "data": {"time": "t"},
        "channels": {"motor": {"column": "m", "unit": "rad"}, "tip": {"column": "y", "unit": "rad"}},
        "link": [{"subsystem": "gear", "input": "motor", "output": "tip"}],
    }
    nothing = find([{"t": t, "m": np.sin(t), "y": np.full(t.size, 3.0)}], nominal)
    page = nothing.write(tmp_path).read_text(encoding="utf-8")
    found = json.loads((tmp_path / "verdict.json").read_text())
    assert nothing.diagnosis is None and found["data_findings"]
    assert set(found) == set(verdict) and set(found["fit"]) == set(verdict["fit"])
    assert "Diagnosis of gear" in page and all(finding["says"] in unescape(page) for finding in found["data_findings"])
    assert unescape(page).count(found["next"]) == 1


def test_report_needs_nothing_from_outside(made: tuple[dict, str]) -> None:
    _, page = made
    assert page.count("data:image/svg+xml") >= 6 and "Missing: backlash (cable)" in page
    assert 'src="http' not in page and "<script" not in page and "<link" not in page


def test_misuse_is_bad_input(tmp_path: Path) -> None:
    nominal, files = planted.transmission(tmp_path, "none", 0)
    with pytest.raises(InputError, match="--nominal"):
        diagnose([str(files[0])])
    with pytest.raises(InputError, match="without"):
        diagnose([str(files[0])], str(nominal), without=["backlsh"])
    with pytest.raises(InputError, match="recording"):
        diagnose([str(tmp_path / "none.csv")], str(nominal), quiet=True)


def test_help_names_every_option() -> None:
    import typer

    app = typer.Typer()
    app.command()(diagnose)
    text = CliRunner().invoke(app, ["--help"], env={"COLUMNS": "200"}).output
    for word in ("--nominal", "--json", "--out", "--data", "--without"):
        assert word in text


@pytest.mark.slow
def test_progress_goes_to_standard_error(tmp_path: Path) -> None:
    nominal, files = planted.transmission(tmp_path, "none", 0)
    code = (
        f"import sys; from host.cli.diagnose import diagnose; diagnose({[str(f) for f in files]!r}, {str(nominal)!r}, True)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout)["verdict"] == "nothing_missing"
    assert "screening" in done.stderr
