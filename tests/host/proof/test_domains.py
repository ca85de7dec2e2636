"""The world `domains`: its data sets follow from the seed, and without the effects the nominal law holds."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.signal import cont2discrete, lfilter

from host.diagnosis.model.nominal import read_nominal
from host.studies.proof import page
from host.studies.proof.scoring import judge
from host.studies.proof.worlds import case
from host.studies.proof.worlds.domains import bench, generator, nominal_laws
from host.studies.proof.worlds.domains.dataset import LARGEST, SMALLEST, DataSet, Drawn

Array = np.ndarray
SEED = 900417  # no suite: only these tests draw from it
VOCABULARY = Path(__file__).parents[3] / "docs" / "diagnosis.md"
EVEN_TERMS = {"mass": 2, "damping": 1, "stiffness": 0}
DRAWN: dict[str, Drawn] = {}


def drawn(data_set: DataSet) -> Drawn:
    """The first draw of a data set, made once."""
    if data_set.name not in DRAWN:
        DRAWN[data_set.name] = data_set.draw(np.random.default_rng([SEED, 0]))
    return DRAWN[data_set.name]


each = pytest.mark.parametrize("data_set", generator.ALL, ids=lambda d: d.name)


def scaled(one: Drawn, i: int, channel: str, plain: bool) -> Array:
    """A column in SI: inputs as they are, measured ones without effects or noise."""
    spec, sheet = one.nominal["channels"][channel], one.sheets[i]
    values = (sheet.plain if plain else sheet.exact)[spec["column"]]
    return np.asarray(spec.get("scale", 1.0) * values + spec.get("offset", 0.0))


def law(one: Drawn) -> tuple[Array, Array]:
    """Numerator and denominator of a nominal axis or transfer function, falling powers of s."""
    if "axis" in one.nominal:
        table = one.nominal["axis"]
        order = {"position": 0, "velocity": 1, "acceleration": 2}[table["reads"]]
        den = np.array([one.values.get(name, 0.0) for name in EVEN_TERMS])
        num = np.r_[1.0, np.zeros(order)]
        while den[-1] == 0.0 and num[-1] == 0.0:
            num, den = num[:-1], den[:-1]
        return num, den
    table = one.nominal["linear"]
    return tuple(np.array([one.values.get(c, c) for c in table[k]], float) for k in ("numerator", "denominator"))  # type: ignore[return-value]


def replayed(one: Drawn, i: int) -> tuple[Array, Array]:
    """Output (n,) of the nominal axis or transfer function from rest, and columns (n, k) of its free motions and offset."""
    table = one.nominal.get("axis") or one.nominal["linear"]
    num, den = law(one)
    t = one.sheets[i].columns["time_s"]
    u = scaled(one, i, table["input"] if "axis" in one.nominal else table["inputs"][0], False)
    if np.ptp(np.diff(t)) < 1e-5:
        b, a, _ = cont2discrete((num, den), float(np.mean(np.diff(t))), "foh" if table["hold"] == "linear" else "zoh")
        b, still = b.ravel(), np.zeros(t.size)
        free = [lfilter(b, a, still, zi=start)[0] for start in np.eye(a.size - 1)]
        return lfilter(b, a, u), np.column_stack([*free, lfilter(b, a, still + 1.0)])
    assert den.size == 2  # with irregular stamps: one lag, whose input is constant or straight between samples
    out, lag = np.zeros((t.size, 3)), den[0] / den[1]
    out[0] = 0.0, 1.0, 0.0
    driven = np.column_stack([u, np.zeros(t.size), np.ones(t.size)]) * num[0] / den[1]
    for k, h in enumerate(np.diff(t)):
        slope = (driven[k + 1] - driven[k]) / h if table["hold"] == "linear" else 0.0
        settled = driven[k] - lag * slope
        out[k + 1] = settled + slope * h + np.exp(-h / lag) * (out[k] - settled)
    return out[:, 0], out[:, 1:]


def without_the_effect(one: Drawn) -> tuple[list[Array], list[Array], list[Array], float]:
    """Measured column, what the nominal law says of it, columns that may be added to that, and its scale."""
    kind, recordings = one.nominal["kind"], range(len(one.sheets))
    said, measured, free = [], [], []
    for i in recordings:
        t = one.sheets[i].columns["time_s"]
        if kind in ("axis", "linear"):
            table = one.nominal[kind]
            name = table["output"] if kind == "axis" else table["outputs"][0]
            y, columns = replayed(one, i)
            if kind == "linear" or "offset" not in one.values:
                columns = columns[:, :-1]
        elif kind == "impedance":
            name = "force_N"
            curve = CubicSpline(t, scaled(one, i, "motion_mm", False))
            y = sum(one.values.get(term, 0.0) * curve(t, order) for term, order in EVEN_TERMS.items())
            columns = np.ones((t.size, 1))
        elif kind == "callable":
            name, value = "outlet_degC", one.sheets[i].plain["outlet_degC"]
            inputs = {"inlet_degC": scaled(one, i, "inlet_degC", False)}
            y, columns = nominal_laws.outlet(inputs, one.values, t, {name: float(value[0])})[name], np.zeros((t.size, 1))
        else:
            row = one.nominal["link"][0]
            name, y = row["output"], one.values["gain"] * scaled(one, i, row["input"], False)
            columns = np.ones((t.size, 1))
        said.append(y)
        measured.append(scaled(one, i, name, True))
        free.append(columns)
    spec = one.nominal["channels"][name]
    noise = np.concatenate([s.noise[spec["column"]] for s in one.sheets])
    return measured, said, free, spec.get("scale", 1.0) * 1.48 * float(np.median(np.abs(noise)))


@each
def test_without_the_effect_the_nominal_law_holds(data_set: DataSet) -> None:
    one = drawn(data_set)
    if not one.values:
        pytest.skip("the measured columns are exchanged")
    if data_set.finding == "clock":
        pytest.skip("the law holds only after the clock is corrected")
    measured, said, free, noise = without_the_effect(one)
    for y, law_y, columns in zip(measured, said, free, strict=True):
        size = np.linalg.norm(columns, axis=0) + 1e-300
        remains = y - law_y - columns / size @ np.linalg.lstsq(columns / size, y - law_y, rcond=1e-12)[0]
        assert np.std(remains) < 0.05 * noise and np.std(y) > 2.0 * noise


@each
def test_recordings_are_finite_and_the_nominal_file_is_accepted(data_set: DataSet, tmp_path: Path) -> None:
    one = drawn(data_set)
    path = tmp_path / "nominal.toml"
    path.write_text(case.toml_of(one.nominal), encoding="utf-8")
    spec = read_nominal(path)
    assert {c.column for c in spec.channels.values()} | {"time_s"} == set(one.sheets[0].columns)
    assert 2 <= len(one.sheets) <= 3 and not spec.effect
    for sheet in one.sheets:
        t = sheet.columns["time_s"]
        assert np.all(np.diff(t) > 0.0) and 9.0 < np.ptp(t) <= 61.0 and t.size >= 60
        for name, values in sheet.columns.items():
            assert np.mean(np.isfinite(values)) > 0.95 and (name in sheet.plain or np.all(np.isfinite(values)))
    for place in data_set.truth:
        assert place.partition("@")[0] not in path.read_text()


@each
def test_planted_effects_change_the_measured_columns_and_nothing_else(data_set: DataSet) -> None:
    one = drawn(data_set)
    changed = [name for s in one.sheets for name in s.plain if not np.array_equal(s.true[name], s.plain[name])]
    assert bool(changed) == bool(data_set.truth)
    assert len(one.planted) == len(data_set.truth)
    if len(data_set.truth) == 2:
        assert all(len(s.alone[name]) == 2 for s in one.sheets for name in s.plain)


def test_labels_are_in_the_vocabulary() -> None:
    text = VOCABULARY.read_text(encoding="utf-8")
    assert len({d.name for d in generator.ALL}) == len(generator.ALL) == 50
    for data_set in generator.ALL:
        for names in data_set.accepted():
            assert all(f"| `{name}` |" in text for name in names if name != "unlisted")
        assert not data_set.finding or f"| `{data_set.finding}` |" in text
        assert len(data_set.accepted()) == len(data_set.truth) == {"null": 0, "pair": 2}.get(data_set.category, 1)


def test_the_same_seed_gives_the_same_bytes(tmp_path: Path) -> None:
    planned = [
        p for p in generator.plans(SEED, 50) if generator.ALL[p.mechanism].name in ("belt_stage", "humidity", "lidar")
    ]
    for turn in ("one", "two"):
        for plan in planned:
            case.write(generator.make(plan), tmp_path / turn / plan.id)
    for plan in planned:
        first, second = (sorted((tmp_path / turn / plan.id).iterdir()) for turn in ("one", "two"))
        assert [a.read_bytes() for a in first] == [b.read_bytes() for b in second]


def test_a_round_has_every_data_set_once() -> None:
    planned = generator.plans(SEED, 120)
    assert [p.index for p in planned] == list(range(120))
    for turn in (0, 1):
        assert sorted(p.mechanism for p in planned if p.turn == turn) == list(range(50))
    assert [p.mechanism for p in planned[:50]] != [p.mechanism for p in planned[50:100]]
    assert planned[:7] == generator.plans(SEED, 7)


def test_a_label_has_its_size_and_the_finding_that_is_wanted() -> None:
    wanted = {"ship_wheel", "steering", "pneumatic_cylinder"}
    planned = {generator.ALL[p.mechanism].name: p for p in generator.plans(SEED, 50)}
    labels = {name: generator.make(planned[name]).label for name in wanted}
    assert all(SMALLEST <= labels[n]["rho"] <= LARGEST for n in ("ship_wheel", "pneumatic_cylinder"))
    quiet = {"verdict": "nothing_missing", "effects": [], "data_findings": []}
    unit = [{"id": "unit", "channel": "wheel", "says": ""}]
    assert labels["steering"]["findings"] == ["unit"]
    assert not judge(labels["steering"], quiet).right
    assert judge(labels["steering"], {**quiet, "data_findings": unit}).right
    named = {"verdict": "missing_physics", "effects": [{"id": "backlash", "subsystem": "rudder", "probability": 0.95}]}
    facts = judge(labels["ship_wheel"], named)
    assert facts.right and facts.gap_closed is None and facts.window_f1 is None and facts.form is None


def test_the_page_lists_what_was_not_right(tmp_path: Path) -> None:
    planned = [p for p in generator.plans(SEED, 50) if generator.ALL[p.mechanism].name in ("steering", "ship_wheel")]
    labels = [generator.make(plan).label for plan in planned]
    (tmp_path / "suite.json").write_text(json.dumps({"seed": SEED, "cases": 50, "worlds": ["domains"]}))
    for folder in ("sealed", "verdicts"):
        (tmp_path / "domains" / folder).mkdir(parents=True)
    (tmp_path / "domains" / "sealed" / "labels.json").write_text(json.dumps({"labels": labels}))
    quiet = {"verdict": "nothing_missing", "effects": [], "data_findings": []}
    named = {"verdict": "missing_physics", "effects": [{"id": "backlash", "subsystem": "rudder", "probability": 0.95}]}
    for label in labels:
        content = named if label["kind"] == "ship_wheel" else quiet
        (tmp_path / "domains" / "verdicts" / f"{label['id']}.json").write_text(json.dumps(content))
    text = page.world_block(tmp_path, "domains")
    assert "| null | 1 | 0 | 0 |" in text and "| single | 1 | 1 | 0 |" in text and "| all | 2 | 1 | 0 |" in text
    assert "| nothing, finding unit | 0.00 | nothing missing; findings: none |" in text and "ship_wheel" not in text
    both = page.together([tmp_path, tmp_path])
    assert f"Seeds {SEED} together, 4 cases of domains:" in both and "| cases with nothing planted | | 2 |" in both
    document = tmp_path / "page.md"
    document.write_text("<!-- worlds begin -->\nx\n<!-- worlds end -->\n<!-- domains begin -->\n<!-- domains end -->\n")
    page.main(["--dir", str(tmp_path), "--world", "domains", "--docs", str(document)])
    assert document.read_text().startswith("<!-- worlds begin -->\nx\n<!-- worlds end -->") and text in document.read_text()


def test_the_integrator_and_the_noise_are_what_they_are_said_to_be() -> None:
    t = bench.even(50.0, 10.0)
    u = bench.motion(np.random.default_rng(1), t, 1.0)
    marched = bench.march(lambda _, s, v: ((v[0] - s[0]) / 0.4,), (float(u[0]),), t, [u], 4, False)[:, 0]
    assert np.max(np.abs(marched - bench.exact([1.0], [0.4, 1.0], u, 0.02, "foh"))) < 1e-7
    noise = bench.slow(np.random.default_rng(2), 200_000, 2.0, 20.0)
    assert np.std(noise) == pytest.approx(2.0, rel=0.05)
    assert np.mean(noise[20:] * noise[:-20]) / np.var(noise) == pytest.approx(np.exp(-1.0), abs=0.04)
    x = 3.0 * np.sin(t)
    assert np.ptp(bench.gap(x, 0.5)) == pytest.approx(5.5, abs=0.01)
