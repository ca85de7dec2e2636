"""Tables, channels, split and clock."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from host.diagnosis.model.data_rules import DataRules
from host.diagnosis.model.dataset import Recording, find_files, load, read_tables, thin
from host.diagnosis.model.findings import inspect
from host.diagnosis.model.nominal import NominalSpec, nominal_of, read_nominal
from host.diagnosis.model.tables import Table, read_table, table_of
from host.diagnosis.models import build, channels_of
from host.diagnosis.problems import inspected
from protocol.errors import InputError

TOML = """
name = "t"
kind = "transmission"
[data]
time = "t"
[channels.motor]
column = "a"
scale = 0.1
unit = "rad"
sign = -1
[channels.jaw]
column = "b"
unit = "rad"
[[link]]
input = "motor"
output = "jaw"
"""


def spec(folder: Path, text: str = TOML) -> NominalSpec:
    path = folder / "n.toml"
    path.write_text(text)
    return read_nominal(path)


def table(path: Path, start: float = 0.0, n: int = 100) -> Path:
    t = start + np.arange(n) * 0.01
    np.savetxt(path, np.column_stack((t, np.arange(n), np.arange(n) ** 2)), delimiter=",", header="t,a,b", comments="")
    return path


def read(folder: Path, files: list[Path], text: str = TOML) -> list[Recording]:
    nominal = spec(folder, text)
    return load(nominal, read_tables(nominal, files), *channels_of(nominal), DataRules())


def test_every_kind_of_file_gives_the_same_columns(tmp_path: Path) -> None:
    import pyarrow
    import pyarrow.parquet
    import scipy.io

    a = np.linspace(0, 1, 60)
    np.savez(tmp_path / "x.npz", a=a)
    scipy.io.savemat(tmp_path / "x.mat", {"a": a[:, None]})
    pyarrow.parquet.write_table(pyarrow.table({"a": a}), tmp_path / "x.parquet")
    np.savetxt(tmp_path / "x.csv", a, header="a", comments="")
    for name in ("x.npz", "x.mat", "x.parquet", "x.csv"):
        assert np.allclose(read_table(tmp_path / name)["a"], a)


HEADING_ROWS = [("time_s", "a"), ("0.5", "1.25"), ("0.75", "-2.5"), ("1", "3")]


@pytest.mark.parametrize(
    ("name", "separator", "point", "before"),
    [
        ("x.csv", ",", ".", ""),
        ("x.csv", ";", ",", ""),
        ("x.csv", ";", ".", "# logger of the bench\n# rig 7, a and b\n"),
        ("x.csv", "\t", ",", "% exported\n"),
        ("x.tsv", "\t", ".", "\ufeff"),
    ],
)
def test_text_tables_as_programs_write_them(tmp_path: Path, name: str, separator: str, point: str, before: str) -> None:
    rows = [separator.join(cell.replace(".", point) for cell in row) for row in HEADING_ROWS]
    (tmp_path / name).write_text(before + "\n".join(rows) + "\n", encoding="utf-8")
    columns = read_table(tmp_path / name)
    assert columns["time_s"].tolist() == [0.5, 0.75, 1.0] and columns["a"].tolist() == [1.25, -2.5, 3.0]


def test_a_comma_within_a_heading_of_commas_stays_a_separator(tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text("a,b;c\n1,2\n3,4\n")
    assert read_table(tmp_path / "x.csv") == {"a": pytest.approx([1, 3]), "b;c": pytest.approx([2, 4])}


def test_dates_count_in_seconds_since_1970(tmp_path: Path) -> None:
    import pandas as pd

    instants = pd.Timestamp("2026-03-01 12:00:00") + pd.to_timedelta([0.0, 0.25, 0.5], unit="s")
    frame = pd.DataFrame({"t": instants, "a": [1.0, 2.0, 3.0]})
    frame.to_csv(tmp_path / "x.csv", index=False)
    frame.assign(t=instants.tz_localize("UTC")).to_parquet(tmp_path / "x.parquet")
    np.savez(tmp_path / "x.npz", t=instants.to_numpy(), a=frame["a"])
    in_python = [frame, frame.set_index("t"), frame.set_index("t").tz_localize("UTC"), {"t": instants, "a": frame["a"]}]
    read_columns = [read_table(tmp_path / name) for name in ("x.csv", "x.parquet", "x.npz")]
    for columns in read_columns + [made.columns for made in map(table_of, in_python, range(4)) if isinstance(made, Table)]:
        assert np.allclose(columns["t"] - 1772366400.0, [0.0, 0.25, 0.5], atol=3e-7), columns
    assert len(in_python) == 4


def test_a_missing_date_is_a_missing_number(tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text("t,a\n2026-03-01 12:00:00,1\n,2\n")
    assert np.isnan(read_table(tmp_path / "x.csv")["t"]).tolist() == [False, True]


def test_times_in_milliseconds_are_scaled(tmp_path: Path) -> None:
    path = table(tmp_path / "x.csv")
    (plain,) = read(tmp_path, [path])
    (scaled,) = read(tmp_path, [path], TOML.replace('time = "t"', 'time = "t"\ntime_scale = 1e-3'))
    assert scaled.dt_s == pytest.approx(1e-3 * plain.dt_s)


def test_empty_fields_are_missing(tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text("a,b\n1,2\n,3\nnan,4\n")
    columns = read_table(tmp_path / "x.csv")
    assert np.isnan(columns["a"][1:]).all() and columns["b"].tolist() == [2, 3, 4]


def test_infinite_values_are_missing_and_said(tmp_path: Path) -> None:
    path = table(tmp_path / "x.csv")
    lines = path.read_text().splitlines()
    lines[2] = "0.01,inf,1"
    path.write_text("\n".join(lines) + "\n")
    (one,) = read(tmp_path, [path])
    assert np.isnan(one.channels["motor"][1]) and one.infinite == ("motor",)
    findings = [finding.says for finding in inspect(spec(tmp_path), [one], DataRules()).findings if finding.id == "missing"]
    assert findings == ["Column a holds infinite values. They count as missing."]


@pytest.mark.parametrize("terms", ["[]", '["mass", "mass"]'])
def test_a_law_has_each_term_once(tmp_path: Path, terms: str) -> None:
    law = f'[axis]\ninput = "motor"\noutput = "jaw"\nterms = {terms}\n'
    with pytest.raises(InputError, match=r"axis\.terms: .*wanted at least one term, and each once"):
        spec(tmp_path, TOML.split("[[link]]")[0].replace("transmission", "axis") + law)


def test_scale_and_sign_are_applied(tmp_path: Path) -> None:
    (one,) = read(tmp_path, [table(tmp_path / "x.csv")])
    assert one.channels["motor"][10] == pytest.approx(-1.0) and one.channels["jaw"][10] == pytest.approx(100.0)


def test_a_lone_recording_is_split_into_blocks_and_three_by_recording(tmp_path: Path) -> None:
    (one,) = read(tmp_path, [table(tmp_path / "x.csv")])
    assert one.fit.any() and one.heldout.any() and not (one.fit & one.heldout).any()
    three = read(tmp_path, [table(tmp_path / f"{k}.csv") for k in "abc"])
    assert [r.heldout.all() for r in three] == [False, True, False]


def test_heldout_patterns_choose_recordings(tmp_path: Path) -> None:
    text = TOML.replace('time = "t"', 'time = "t"\nheldout = ["c*"]')
    assert [r.heldout.all() for r in read(tmp_path, [table(tmp_path / f"{k}.csv") for k in "abc"], text)] == [
        False,
        False,
        True,
    ]
    with pytest.raises(InputError, match=r"data\.heldout"):
        read(tmp_path, [table(tmp_path / f"{k}.csv") for k in "ab"], text)


def test_recordings_one_after_the_other_keep_their_clock(tmp_path: Path) -> None:
    follow = read(tmp_path, [table(tmp_path / "a.csv", 5.0), table(tmp_path / "b.csv", 9.0)])
    assert [r.time_s[0] for r in follow] == pytest.approx([0.0, 4.0])
    apart = read(tmp_path, [table(tmp_path / "a.csv", 5.0), table(tmp_path / "b.csv", 5.0)])
    assert [r.time_s[0] for r in apart] == [0.0, 0.0]


def test_thinning_averages(tmp_path: Path) -> None:
    (one,) = read(tmp_path, [table(tmp_path / "x.csv")])
    assert thin(one, 4).channels["motor"][0] == pytest.approx(-0.15) and thin(one, 4).n == 25


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ('column = "a"', 'column = "zz"', "channels.motor.column"),
        ("scale = 0.1", "skale = 0.1", "n.toml: channels.motor.skale"),
        ('kind = "transmission"', 'kind = "gearbox"', "n.toml: kind"),
        ('input = "motor"', 'input = "motr"', "motr"),
        ('time = "t"', 'time = "tt"', "data.time"),
    ],
)
def test_bad_nominals_name_the_key(tmp_path: Path, old: str, new: str, key: str) -> None:
    with pytest.raises(InputError) as caught:
        read(tmp_path, [table(tmp_path / "x.csv")], TOML.replace(old, new))
    assert caught.value.key == key or caught.value.key == str(tmp_path / key)


def test_no_files_is_bad_input(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SELDINGER_DATA", raising=False)
    with pytest.raises(InputError, match="recording"):
        find_files(spec(tmp_path), [], None)


STAGE: dict[str, Any] = {
    "name": "stage",
    "kind": "axis",
    "data": {"time": "t"},
    "channels": {"force": {"column": "f", "unit": "N"}, "place": {"column": "y", "unit": "m"}},
    "axis": {"input": "force", "output": "place", "terms": ["mass", "damping", "stiffness"]},
    "parameters": {"mass": 1.1, "damping": 3.5, "stiffness": 140.0},
}
PLANT = {
    **STAGE,
    "kind": "linear",
    "linear": {"inputs": ["force"], "outputs": ["place"], "numerator": ["K"], "denominator": ["tau", 1.0]},
}


@pytest.mark.parametrize(
    ("nominal", "parameters", "wanted"),
    [
        (STAGE, {"mass": 0.0}, "parameters.mass: found 0.0, wanted a value above 0; leave mass out of axis.terms"),
        (STAGE, {"damping": -1.0}, "parameters.damping: found -1.0, wanted 0 or a value above it"),
        (STAGE, {"masss": 1.0}, "parameters.masss: found .*, wanted one of mass, damping, stiffness, offset"),
        (
            STAGE,
            {"offset": 0.2},
            "parameters.offset: found 0.2, wanted 0, or offset in axis.terms, without which the law has none",
        ),
        (PLANT, {"K": 1.0, "tau": 2.0, "taw": 2.0}, "parameters.taw: found .*, wanted one of K, tau"),
    ],
)
def test_a_parameter_that_the_model_cannot_have_is_bad_input(
    nominal: dict[str, Any], parameters: dict[str, float], wanted: str
) -> None:
    with pytest.raises(InputError, match=wanted):
        build(nominal_of({**nominal, "parameters": parameters}))


@pytest.mark.parametrize("values", [np.full(200, "1.5"), np.full(200, 1j), np.array([None, "a"] * 100)])
def test_a_column_that_holds_no_real_numbers_is_named(values: np.ndarray) -> None:
    table = table_of({"t": np.arange(200.0), "f": np.arange(200.0), "y": values}, 0)
    assert isinstance(table, Table)
    with pytest.raises(InputError, match=f"channels.place.column: found .*column y of recording 1 .*{values.dtype}"):
        inspected(nominal_of(STAGE), [table])


def test_a_column_of_times_that_the_nominal_model_does_not_name_is_bad_input() -> None:
    """Without times the mass would be in newtons, metres and samples: 12000 kg for 1.2 kg read every 0.01 s."""
    untimed = nominal_of({key: value for key, value in STAGE.items() if key != "data"})
    x = np.random.default_rng(1).standard_normal((2, 200))
    for name in ("t", "Time (s)", "time_s", "stamp"):
        with pytest.raises(InputError, match=r"data\.time: found .*although column"):
            inspected(untimed, [Table("r", {name: np.arange(200) * 0.01, "f": x[0], "y": x[1]})])
    for name, values in (("temperature", np.arange(200.0)), ("t", x[0]), ("index", np.arange(200.0))):
        assert not inspected(untimed, [Table("r", {name: values, "f": x[0], "y": x[1]})]).recordings[0].timed
