"""`open_recording`: tables with units in the names of their columns."""

from __future__ import annotations

from pathlib import Path

import pytest

import seldinger as sd
from tests.seldinger.api_page import write_recording

pandas = pytest.importorskip("pandas")


def test_a_table_is_a_data_frame_over_seconds(tmp_path: Path) -> None:
    recording = sd.open_recording(write_recording(tmp_path))
    table = recording.table("force/sensor")
    assert isinstance(table, pandas.DataFrame) and len(table) == 500 and recording.topics == {"force/sensor": 500}
    assert table.index.name == "time_s" and table.index[0] == 0.0 and table.index[-1] == pytest.approx(0.998)
    assert table["fz_N"].iloc[-1] == pytest.approx(0.499) and recording.units("force/sensor")["fz_N"] == "N"
    suffixes = {"N": "_N", "ns": "_ns", "N m": "_Nm"}
    for column, unit in recording.units("force/sensor").items():
        assert column in table and column.endswith(suffixes.get(unit, "")), column
    assert recording.run["clock"] == "virtual" and recording.configuration["name"] == "simulated"
    assert recording.catheter["name"] and not recording.truncated


def test_an_unknown_topic_is_named(tmp_path: Path) -> None:
    recording = sd.open_recording(write_recording(tmp_path))
    for call in (recording.table, recording.units):
        with pytest.raises(sd.InputError) as error:
            call("force")
        assert error.value.key == "topic" and "force/sensor" in error.value.wanted
