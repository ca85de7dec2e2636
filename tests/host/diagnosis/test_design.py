"""Choice of the motion that separates two models."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from host.diagnosis.design import experiment
from host.diagnosis.estimation.rules import RULES


def test_motions_that_cannot_be_better_are_not_linearized(monkeypatch: pytest.MonkeyPatch) -> None:
    """What remains after a rival has adapted is at most the whole difference: the best of all is found among a few."""
    rng = np.random.default_rng(4)
    whole, share = rng.uniform(1.0, 10.0, 60), rng.uniform(0.7, 1.0, 60)
    tried: list[int] = []

    def remains(trial: Any, rival: Any, known: Any) -> float:
        tried.append(trial.number)
        return float(whole[trial.number] * share[trial.number])

    monkeypatch.setattr(experiment, "separation", remains)
    for name in ("weighed", "information"):
        monkeypatch.setattr(experiment, name, lambda *_: None)
    monkeypatch.setattr(experiment, "difference", lambda *_: np.zeros(3))
    monkeypatch.setattr(experiment, "asked", lambda _: ())
    recording = SimpleNamespace(recording=SimpleNamespace(channels={}))
    made: Any = [
        (k, SimpleNamespace(number=k, segments=[recording], stacked=lambda *_, size=size: np.array([size])))
        for k, size in enumerate(whole)
    ]
    given: Any = SimpleNamespace(terms=(), values=np.zeros(1), rules=RULES)
    found: Any = experiment.against(given, given, given, given, given, made)
    first = np.argsort(-whole)[: experiment.FINALISTS]
    assert found.excitation == first[np.argmax((whole * share)[first])] and len(tried) < experiment.FINALISTS
