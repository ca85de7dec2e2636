"""The full circle with MuJoCo: what is concealed is named, and the patched file predicts fresh recordings to their noise."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from host.studies import full_circle

mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed: pip install 'seldinger[mujoco]'")


def test_the_real_arm_differs_from_its_model_file_by_what_is_concealed(tmp_path: Path) -> None:
    plain, real = (mujoco.MjModel.from_xml_string(text) for text in (full_circle.ARM, full_circle.real_arm()))
    assert real.joint("elbow").frictionloss[0] == full_circle.CONCEALED["elbow.frictionloss"]
    added = float(np.sum(real.body_mass) - np.sum(plain.body_mass))
    assert added == pytest.approx(full_circle.CONCEALED["hand.payload"])
    u = full_circle.torques(np.random.default_rng(1), 50)
    assert not np.allclose(full_circle.stepped(plain, u), full_circle.stepped(real, u), atol=10 * full_circle.NOISE_RAD)


@pytest.mark.slow
@pytest.mark.long
def test_the_patched_file_predicts_to_the_noise(tmp_path: Path) -> None:
    circle = full_circle.run(tmp_path, seed=1)
    assert {effect["port"] for effect in circle.verdict["effects"]} >= set(full_circle.CONCEALED)
    assert np.all(circle.nominal_rad > 20.0 * full_circle.NOISE_RAD)
    assert np.all(circle.patched_rad < 1.5 * full_circle.NOISE_RAD)
