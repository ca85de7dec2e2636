"""Exported tables hold what the recording holds, with units, and the command refuses what it cannot use in one line."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest
import typer
from typer.testing import CliRunner

from host.cli.export import export as export_command
from host.recordings.export import export
from host.recordings.header import RecordingHeader
from host.recordings.recording import RecordingFile
from host.recordings.writer import RecordingWriter
from protocol.errors import InputError
from protocol.topics import Pose, RigState

HEADER = RecordingHeader(
    rig="simulated", clock="virtual", configuration={"control": {"loop_hz": 1000}}, catheter={"name": "x"}, seed=1
)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> RecordingFile:
    path = tmp_path_factory.mktemp("export") / "a.mcap"
    with RecordingWriter(path, HEADER) as writer:
        for frame in range(40):
            seen = frame % 4 != 0
            writer.write(
                "pose/tip",
                Pose(
                    stamp_ns=frame * 25_000_000,
                    arrival_ns=frame * 25_000_000 + 1,
                    frame=frame,
                    missing=not seen,
                    position_m=(0.1, -0.2, 0.3 + frame / 300) if seen else None,
                    quaternion_wxyz=(1.0, 0.0, 0.0, 0.0) if seen else None,
                ),
            )
            writer.write(
                "state",
                RigState(
                    stamp_ns=frame,
                    mode="contact",
                    safety_action="warn",
                    cause='a "quoted", cause; with; separators\nand lines',
                ),
            )
    return RecordingFile(path)


def test_parquet_is_exact_and_knows_its_units(recording: RecordingFile, tmp_path: Path) -> None:
    written = export(recording, "parquet", tmp_path / "new" / "folder")
    assert [path.name for path in written] == ["pose_tip.parquet", "state.parquet"]
    table = pyarrow.parquet.read_table(written[0])
    for name, values in recording.table("pose/tip").items():
        np.testing.assert_array_equal(table.column(name).to_numpy(), values)
    assert table.schema.field("z_m").metadata == {b"unit": b"m"}
    assert json.loads(table.schema.metadata[b"run"])["seed"] == "1"
    assert pyarrow.parquet.read_table(written[1]).column("cause").to_pylist() == recording.table("state")["cause"].tolist()


def test_csv_reads_back_to_the_last_bit(recording: RecordingFile, tmp_path: Path) -> None:
    export(recording, "csv", tmp_path)
    with (tmp_path / "pose_tip.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    expected = recording.table("pose/tip")
    assert len(rows) == 40 and set(rows[0]) == set(expected)
    assert [float(row["z_m"] or "nan") for row in rows] == pytest.approx(expected["z_m"], abs=0, nan_ok=True)
    assert rows[0]["z_m"] == "" and [int(row["stamp_ns"]) for row in rows] == expected["stamp_ns"].tolist()
    assert json.loads((tmp_path / "units.json").read_text())["pose/tip"]["qw"] == ""
    assert json.loads((tmp_path / "header.json").read_text())["catheter"] == {"name": "x"}
    with (tmp_path / "state.csv").open(newline="") as stream:
        assert next(csv.DictReader(stream))["cause"] == 'a "quoted", cause; with; separators\nand lines'


def run(*arguments: str) -> tuple[int, str]:
    app = typer.Typer()
    app.command()(export_command)
    result = CliRunner().invoke(app, list(arguments))
    if isinstance(result.exception, InputError):
        return 2, str(result.exception)
    return result.exit_code, result.stdout


def test_command_says_what_it_wrote(recording: RecordingFile, tmp_path: Path) -> None:
    status, output = run(str(recording.path), "--to", "parquet", "--out", str(tmp_path), "--json")
    said = json.loads(output)
    assert status == 0 and said["tables"] == {"pose/tip": 40, "state": 40} and not said["truncated"]
    assert all(Path(name).exists() for name in said["files"])


def test_command_takes_a_recording_that_was_cut(recording: RecordingFile, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(recording.path.read_bytes()[:-20])
    status, output = run(str(cut), "--out", str(tmp_path / "tables"), "--json")
    assert status == 0 and json.loads(output)["truncated"] is True


@pytest.mark.parametrize(("to", "says"), [("xlsx", "to: found"), ("parquet", "wanted a readable recording")])
def test_command_refuses_in_one_line(tmp_path: Path, to: str, says: str) -> None:
    status, output = run(str(tmp_path / "none.mcap"), "--to", to, "--out", str(tmp_path / "tables"))
    assert status == 2 and says in output and "\n" not in output


def test_a_file_that_is_no_recording_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_text("no recording")
    status, output = run(str(tmp_path / "a.mcap"), "--out", str(tmp_path / "tables"))
    assert status == 2 and "wanted an MCAP recording" in output


def test_importing_the_command_does_not_load_the_models() -> None:
    heavy = ("numba", "scipy", "matplotlib", "zenoh")
    program = f"import sys, host.cli.export; print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=Path(__file__).parents[2]
    )
    assert done.stdout == "[]\n"
