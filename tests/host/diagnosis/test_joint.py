"""Two effects at once where none passes alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from host.diagnosis import diagnose
from host.diagnosis.estimation.fit import set_starts
from host.diagnosis.selection import search
from host.diagnosis.selection.found import Found, SearchMove
from host.diagnosis.selection.removal import reduce
from tests.host.diagnosis import test_hold as slides
from tests.host.proof import everyday as make


def _play_and_delay(number: int) -> dict[str, Any]:
    """A gear with play, behind which everything comes 80 ms late."""
    columns = make.with_play(make.gear(number, fastest_Hz=2.0), 0.25)
    return {**columns, "load": np.interp(columns["t"] - 0.08, columns["t"], columns["load"])}


@pytest.mark.slow
def test_a_pair_is_found_where_every_single_effect_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    found = search.good_enough
    monkeypatch.setattr(search, "good_enough", lambda trial, base: bool(base.terms) and found(trial, base))
    verdict = diagnose([_play_and_delay(1), _play_and_delay(2)], make.gear_nominal())
    assert {effect["id"] for effect in verdict.effects} == {"backlash", "latency"}
    assert [step.move for step in verdict.diagnosis.found.steps][:1] == [SearchMove.STOP]


@pytest.mark.slow
def test_a_pair_is_found_where_the_nominal_model_leaves_less_than_twice_the_noise() -> None:
    """A drift and a coupling, each of the size of the noise: neither alone leaves white noise, so neither is sure."""

    def drifting(number: int) -> dict[str, Any]:
        columns, rng = make.gear(number, fastest_Hz=1.0), np.random.default_rng(number)
        t, scale = columns["t"], float(np.std(columns["load"]))
        other = np.sin(2.0 * np.pi * 0.07 * t + number) + np.sin(2.0 * np.pi * 0.031 * t)
        load = columns["load"] + 0.011 * scale * other + 0.03 * scale * t / t[-1]
        return {**columns, "other": other, "load": load + 0.012 * scale * rng.standard_normal(t.size)}

    nominal = make.gear_nominal()
    nominal["channels"]["other"] = {"column": "other", "unit": "rad"}
    nominal["link"][0]["others"] = ["other"]
    verdict = diagnose([drifting(number) for number in (1, 2, 3)], nominal).as_dict()
    assert {effect["id"] for effect in verdict["effects"]} == {"coupling", "sensor_drift"}


@pytest.mark.slow
def test_a_delay_takes_the_place_of_a_mode_that_does_as_well_by_more_parameters(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(slides, "NOISE", 2e-3)
    diagnosis = diagnose([slides.slide(n, "linear", 0.017) for n in (1, 2, 3)], slides.nominal("linear")).diagnosis
    first = diagnosis.found.steps[0]
    mode = next(trial for trial in first.trials if trial.candidate.key == "resonance@slide_drive")
    found = Found(diagnosis.found.nominal, mode.fit, [first])
    set_starts(diagnosis.problem, mode.starts)
    reduce(diagnosis.problem, found)
    assert [term.candidate.key for term in found.best.terms] == ["latency@slide_drive"]


def test_no_pair_is_tried_where_nothing_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    fitted: list[str] = []
    monkeypatch.setattr("host.diagnosis.selection.joint._fitted", lambda *given: fitted.append("pair"))
    assert diagnose([make.gear(1), make.gear(2)], make.gear_nominal()).verdict == "nothing_missing"
    assert not fitted
