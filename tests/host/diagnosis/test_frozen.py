"""A channel that repeats one value while what it reads moves on is stated, and these samples are left out."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.signal import lsim

import seldinger as sd
from host.diagnosis.estimation.fit import Fit
from host.diagnosis.model.data_rules import DataRules
from host.diagnosis.model.dataset import Recording
from host.diagnosis.model.frozen import has_noise, held_runs
from host.diagnosis.model.nominal import nominal_of
from host.diagnosis.model.operators import play
from host.diagnosis.model.pairs import driven_of
from host.diagnosis.model.readings import Finding
from host.diagnosis.model.tables import Table
from host.diagnosis.problems import inspected, problems
from host.diagnosis.selection.frozen_inputs import without_frozen
from host.diagnosis.selection.full_rate import at_full_rate
from host.diagnosis.selection.refits import fit_nominal

Array = np.ndarray
T = np.arange(2000) * 0.01
NOISE_M = 1e-4
AXIS: dict[str, Any] = {
    "name": "stage",
    "kind": "axis",
    "data": {"time": "t"},
    "channels": {"force": {"column": "f", "unit": "N"}, "place": {"column": "y", "unit": "m"}},
    "axis": {"input": "force", "output": "place", "terms": ["mass", "damping", "stiffness"], "hold": "linear"},
    "parameters": {"mass": 1.1, "damping": 3.5, "stiffness": 140.0},
}
GEAR: dict[str, Any] = {
    "name": "gear",
    "kind": "transmission",
    "data": {"time": "t"},
    "channels": {"motor": {"column": "f", "unit": "rad"}, "jaw": {"column": "y", "unit": "rad"}},
    "link": [{"input": "motor", "output": "jaw"}],
}


def tones(seed: int) -> Array:
    """Four tones that never repeat a value."""
    phases = np.random.default_rng(seed).uniform(0.0, 6.28, 4)
    parts = zip((0.3, 0.9, 1.6, 2.6), (3.0, 2.0, 3.0, 2.0), phases, strict=True)
    return np.asarray(sum(a * np.sin(2.0 * np.pi * f * T + phase) for f, a, phase in parts))


def stage(force: Array, noise_m: float = NOISE_M) -> Array:
    """The place of 1.2 kg on 150 N/m and 3 N s/m."""
    place = lsim(([1.0], [1.2, 3.0, 150.0]), force, T)[1]
    return np.asarray(place + noise_m * np.random.default_rng(7).standard_normal(T.size))


def held(values: Array, first_s: float, end_s: float, value: float | None = None) -> Array:
    """The channel with one value in a span: `value`, or the one that it has at its beginning."""
    inside = (first_s - 1e-6 <= T) & (end_s - 1e-6 > T)
    return np.where(inside, values[np.argmax(inside)] if value is None else value, values)


def stated(f: Array, y: Array, nominal: dict[str, Any] = AXIS) -> tuple[list[Finding], list[Recording]]:
    """What is found before the search, and the recordings that it is made in."""
    spec = nominal_of(nominal)
    data = inspected(spec, [Table("r", {"t": T, "f": f, "y": y})])

    def fitted(parts: list[Recording]) -> Fit:
        _, problem, full = problems(spec, parts)
        return at_full_rate(full, fit_nominal(problem), problem)

    outputs = sorted(driven_of(spec))
    kept, later = without_frozen(data.recordings, set(outputs), outputs, {"force": "f", "place": "y"}, fitted, DataRules())
    return [one for one in [*data.findings, *later] if one.id == "frozen"], kept


@pytest.mark.parametrize(
    ("channel", "first_s", "end_s", "value"),
    [("f", 8.0, 10.0, None), ("f", 8.0, 10.0, 0.0), ("f", 15.0, 20.0, 0.0), ("y", 6.0, 9.0, None), ("y", 15.0, 20.0, None)],
    ids=["input", "input logged as zero", "input zero to the end", "output", "output to the end"],
)
def test_a_frozen_channel_is_stated_and_left_out(channel: str, first_s: float, end_s: float, value: float | None) -> None:
    data = {"f": tones(130), "y": stage(tones(130))}
    (finding,), kept = stated(**data | {channel: held(data[channel], first_s, end_s, value)})
    assert finding.channel == channel and f"from {first_s:.4g} to {end_s - 0.01:.4g} s of r, while" in finding.says
    assert sum(recording.n for recording in kept) == T.size - round((end_s - first_s) * 100)


@pytest.mark.parametrize("channel", ["f", "y"])
def test_the_verdict_is_that_of_the_other_samples(channel: str) -> None:
    """The input gave "nothing missing" with a damping of 2.8 N s/m."""
    data = {"t": T, "f": tones(130), "y": stage(tones(130))}
    verdict = sd.diagnose([data | {channel: held(data[channel], 15.0, 20.0)}], AXIS)
    damping = verdict.as_dict()["fit"]["nominal_parameters"]["damping_N_s_per_m"]["value"]
    assert verdict.verdict == "nothing_missing" and damping == pytest.approx(3.0, rel=0.01)
    assert verdict.data_findings[0]["id"] == "frozen"
    assert verdict.as_dict()["next"].startswith(f"Correct the data first (frozen: {channel})")


def test_two_short_spans_are_stated_in_one_sentence() -> None:
    (finding,), kept = stated(held(held(tones(5), 5.0, 5.6, 0.0), 11.0, 11.5, 0.0), stage(tones(5)))
    assert "from 5 to 5.59, 11 to 11.49 s" in finding.says and [r.name for r in kept] == ["r", "r (2)", "r (3)"]


@pytest.mark.parametrize(("value", "noise_m"), [(0.0, NOISE_M), (0.0, 0.0), (None, NOISE_M)])
def test_an_input_that_rests_in_the_middle_is_not_frozen(value: float | None, noise_m: float) -> None:
    """The output answers the rest, which begins and ends abruptly."""
    f = held(tones(130), 6.0, 9.0, value)
    assert not stated(f, stage(f, noise_m))[0]


def relaxing() -> tuple[Array, Array]:
    """A ramp that is held, and the force of a spring with a branch that relaxes."""
    x = np.interp(T % 12.0, (0.0, 2.0, 9.0, 11.0, 12.0), (0.0, 1.0, 1.0, 0.0, 0.0))
    branch = x - lsim(([1.0], [1.5, 1.0]), x, T)[1]
    return x, x + 1.5 * branch + 2e-3 * np.random.default_rng(3).standard_normal(T.size)


def limited(low: float, high: float, dead: float = 0.0) -> tuple[Array, Array]:
    """A noisy reading that is clipped, or zero in a dead zone."""
    x = 0.05 * tones(5)
    y = x + 1e-3 * np.random.default_rng(4).standard_normal(T.size)
    return x, np.clip(np.where(np.abs(y) < dead, 0.0, y - dead * np.sign(y)), low, high)


@pytest.mark.parametrize(
    ("f", "y"),
    [
        (0.05 * tones(5), play(0.05 * tones(5), 0.06, 0.0)),
        relaxing(),
        limited(-0.3, 0.2),
        limited(-1.0, 1.0, 0.08),
        (0.05 * tones(5), np.round(0.05 * tones(5) / 0.02) * 0.02),
        (
            np.repeat(tones(5)[::50], 50),
            np.repeat(tones(5)[::50], 50) + 0.01 * np.random.default_rng(6).standard_normal(2000),
        ),
        (0.05 * tones(5), np.repeat(0.05 * tones(5)[::25] + 1e-3 * np.random.default_rng(6).standard_normal(80), 25)),
    ],
    ids=["sticking", "relaxing", "limited", "dead zone", "coarse", "levels", "read seldom"],
)
def test_what_repeats_a_value_by_its_nature_is_not_frozen(f: Array, y: Array) -> None:
    assert not stated(f, y, GEAR)[0]


def test_noise_of_a_reading_is_told_from_rounding() -> None:
    rules, y, every = DataRules(), stage(tones(5), 0.0), np.ones(T.size, dtype=bool)
    assert has_noise(stage(tones(5)), every, rules)
    for quiet in (y, y.astype(np.float32).astype(float), np.round(y, 7), np.round(y, 5)):
        assert not has_noise(quiet, every, rules)
    assert not held_runs("y", np.round(y, 3), rules)
