"""`seldinger rig check`: good files are shown, each mistake is one line; the shipped file names every key there is."""

import json
import tomllib
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from host.cli.rig import rig as app
from protocol.rig_file import Rig, load_rig
from tests.realtime.conftest import RIG_FILE


def checked(path: Path, *options: str) -> Any:
    return CliRunner().invoke(app, ["check", str(path), *options])


def test_the_shipped_file_is_good_and_shown_whole() -> None:
    told = checked(RIG_FILE)
    assert told.exit_code == 0
    assert "stages.insertion.steps_per_unit" in told.stdout and "default" not in told.stdout


@pytest.mark.parametrize(
    ("kind", "typed", "says"),
    [
        ("aurora", "auroa", "tracker.kind: found 'auroa', wanted one of aurora, openigtlink; a package adds one"),
        ("net_ft", "netft", "did you mean net_ft?"),
    ],
)
def test_a_kind_without_a_driver_is_refused_as_at_the_start(kind: str, typed: str, says: str, tmp_path: Path) -> None:
    file = tmp_path / "rig.toml"
    file.write_text(RIG_FILE.read_text().replace(f'kind = "{kind}"', f'kind = "{typed}"', 1))
    told = checked(file, "--quiet")
    assert told.exit_code == 2 and says.replace("'", '"') in told.stderr and len(told.stderr.splitlines()) == 1


def test_json_gives_the_effective_configuration() -> None:
    told = json.loads(checked(RIG_FILE, "--json").stdout)
    assert told["good"] and told["configuration"] == load_rig(RIG_FILE).effective()


def test_all_mistakes_are_told_at_once_with_key_value_and_range(tmp_path: Path) -> None:
    file = tmp_path / "rig.toml"
    text = RIG_FILE.read_text().replace("over_force_N = 0.5 ", "over_force_N = 5.0 ").replace("loop_hz =", "lop_hz =")
    file.write_text(text)
    told = checked(file)
    lines = told.stderr.strip().splitlines()
    assert told.exit_code == 2 and told.stdout == ""
    assert any("safety.over_force_N: found 5.0, wanted at most 0.5" in line for line in lines)
    assert any("control.lop_hz" in line and "did you mean loop_hz?" in line for line in lines)
    assert any("control.loop_hz: found nothing" in line for line in lines)


def test_a_catheter_that_nobody_knows_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "rig.toml"
    file.write_text(RIG_FILE.read_text().replace('"blazer_prime_xp"', '"garden_hose"'))
    told = checked(file)
    assert told.exit_code == 2 and "catheter.name: found 'garden_hose'" in told.stderr


@pytest.mark.parametrize("text", ["", "name = ", "[catheter\n"])
def test_what_is_no_rig_file_is_refused(tmp_path: Path, text: str) -> None:
    file = tmp_path / "rig.toml"
    file.write_text(text)
    told = checked(file)
    assert told.exit_code != 0 and told.stdout == ""


def _missing(model: Any, data: dict[str, Any], prefix: str = "") -> list[str]:
    out = []
    for key, field in model.model_fields.items():
        if key not in data:
            out.append(prefix + key)
        elif hasattr(field.annotation, "model_fields"):
            out += _missing(field.annotation, data[key], f"{prefix}{key}.")
    return out


def test_the_shipped_file_is_complete() -> None:
    assert _missing(Rig, tomllib.loads(RIG_FILE.read_text())) == []


def test_every_key_of_the_shipped_file_is_explained_once() -> None:
    explained = [line for line in RIG_FILE.read_text().splitlines() if " = " in line and "#" in line]
    keys = [line for line in RIG_FILE.read_text().splitlines() if " = " in line]
    assert len(explained) >= 0.75 * len(keys)
