"""Experiments to tell models apart: designed by their predictions, and with their recordings the set gets smaller."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import lsim

from host.cli.diagnose import diagnose
from host.diagnosis.design.excitation import SHAPES, Span, family
from tests.host.diagnosis.planted import CABLE, coloured

Array = np.ndarray


def record(path: Path, t: Array, motor: Array, plant: Callable[[Array, Array], Array], seed: int) -> Path:
    tip = plant(t, motor) + coloured(np.random.default_rng(seed), t.size, 2e-3)
    np.savetxt(path, np.column_stack((t, motor, tip)), delimiter=",", header="t,motor,tip", comments="")
    return path


def late(t: Array, q: Array) -> Array:
    return np.interp(t - 0.06, t, q)


def lagging(t: Array, q: Array) -> Array:
    """Exact for an input that is straight between its samples.

    A recursive filter would follow a part of each sample at once, which is a lag beside a direct path.
    """
    lagged = lsim(([1.0], [0.08, 1.0]), q - q[0], t)[1]
    return np.asarray(lagged + q[0], dtype=float)


def slow(k: int) -> tuple[Array, Array]:
    """One slow tone, which leaves much open."""
    t = np.arange(0.0, 30.0, 0.01)
    return t, np.where(t < 3.0, 0.0, 0.5 * np.sin(2.0 * np.pi * (0.11 + 0.005 * k) * np.maximum(t - 3.0, 0.0)))


def verdict_of(folder: Path, files: list[Path], out: str) -> dict[str, Any]:
    diagnose([str(f) for f in files], str(folder / "n.toml"), out=folder / out, quiet=True)
    found: dict[str, Any] = json.loads((folder / out / "verdict.json").read_text())
    return found


@pytest.mark.parametrize(("plant", "name"), [(late, "latency"), pytest.param(lagging, "rate_lag", marks=pytest.mark.long)])
def test_the_set_gets_smaller_with_the_recording_of_the_script(
    tmp_path: Path, plant: Callable[[Array, Array], Array], name: str
) -> None:
    (tmp_path / "n.toml").write_text(CABLE.replace("TIME", 'time = "t"'))
    files = [record(tmp_path / f"r{k}.csv", *slow(k), plant, k) for k in range(3)]
    first = verdict_of(tmp_path, files, "first")
    alike = first["effects"][0]["indistinguishable_from"]
    assert alike and first["scripts"] and "Predicted separation" in first["effects"][0]["experiment_to_tell_apart"]
    script = Path(first["scripts"][0])
    assert "separation" in script.read_text().splitlines()[0]
    t, motor = np.loadtxt(script, delimiter=",").T
    assert np.max(np.abs(motor)) <= 0.5 and np.max(np.abs(np.diff(motor) / np.diff(t))) < 0.5
    files += [record(tmp_path / f"s{k}.csv", t, motor, plant, 10 + k) for k in range(2)]
    second = verdict_of(tmp_path, files, "second")["effects"][0]
    assert second["id"] == name and len(second["indistinguishable_from"]) < len(alike)


def test_motions_stay_within_place_and_speed() -> None:
    time_s = np.arange(0.0, 40.0, 0.02)
    span = Span("m", 0.01, 0.004, 0.02)
    made = list(family("x", span, time_s))
    assert {e.words.split(" of ")[0] for e in made} == set(SHAPES)
    for e in made:
        assert np.max(np.abs(e.values - span.centre)) <= span.reach * (1.0 + 1e-9)
        assert np.max(np.abs(np.diff(e.values))) / 0.02 <= 1.01 * span.speed
        assert e.values[0] == pytest.approx(span.centre) and e.values[-1] == pytest.approx(span.centre, abs=0.1 * span.reach)
    assert not list(family("x", Span("m", 0.0, 1.0, 1e-4), time_s))
