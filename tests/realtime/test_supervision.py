"""The cross-checks beside the tick: what is normal raises nothing, what is not raises its cause once."""

import numpy as np

from protocol.enums import SafetyAction
from realtime.control import safety
from realtime.core.supervision import FORCE_DIFFERENCE_N, HOST_SILENT_NS, STEPS_DIFFERENCE, Supervision

MS = 1_000_000
ZERO = np.zeros(3, int)


def pair(sensor_N: np.ndarray, model_N: np.ndarray) -> dict[str, np.ndarray]:
    return {"force sensor": sensor_N, "model": model_N}


def made() -> Supervision:
    supervision = Supervision((1.0, 1.0, 2.0))
    supervision.restart()
    return supervision


def test_an_offset_at_arming_and_the_lag_of_a_move_are_no_loss() -> None:
    supervision = made()
    for tick in range(200):
        steps = np.array([16 * tick, 0, 10 * tick])
        assert supervision.status(steps, np.array([16 * tick + 5000 - 80, 7, 20 * tick]), tick * 5 * MS) is None
    assert supervision.causes == 0


def test_steps_that_stay_lost_are_told_once_and_stand_until_the_restart() -> None:
    supervision = made()
    lost = np.array([0, STEPS_DIFFERENCE + 1, 0])
    told = [supervision.status(ZERO, -lost * (tick > 3), tick * 5 * MS) for tick in range(40)]
    words = [finding.text for finding in told if finding]
    assert len(words) == 1 and words[0].startswith("roll: encoder and steps differ by 151 steps")
    assert supervision.causes == safety.STEPS_LOST and safety.action_of(supervision.causes) == SafetyAction.RETRACT
    supervision.restart()
    assert supervision.causes == 0


def test_one_strange_status_is_no_loss() -> None:
    supervision = made()
    for tick in range(40):
        supervision.status(ZERO, ZERO + 500 * (tick == 10), tick * 5 * MS)
    assert supervision.causes == 0


def test_a_noisy_model_agrees_and_a_drifting_sensor_does_not() -> None:
    rng, supervision = np.random.default_rng(1), made()
    for sample in range(4000):
        estimate = np.array([0.0, 0.03, 0.13]) + rng.normal(0.0, [0.003, 0.11, 0.22])
        supervision.forces(pair(np.array([0.0, 0.0, 0.2]), estimate), sample * 25 * MS)
    assert supervision.causes == 0
    found = next(
        sample
        for sample in range(4000)
        if supervision.forces(
            pair(np.array([0.0, 0.0, 0.2 - 0.1 * sample * 0.025]), np.array([0.0, 0.0, 0.2])), (4000 + sample) * 25 * MS
        )
    )
    assert FORCE_DIFFERENCE_N < 0.1 * found * 0.025 < FORCE_DIFFERENCE_N + 0.15
    assert safety.action_of(supervision.causes) == SafetyAction.RETRACT


def test_nan_of_either_side_counts_for_nothing() -> None:
    supervision = made()
    for sample in range(100):
        supervision.forces(pair(np.full(3, np.nan), np.zeros(3)), sample * 25 * MS)
    assert supervision.causes == 0


def test_a_silent_and_a_slow_model_process_are_logged_once_each() -> None:
    host = made().host
    assert host.overdue(10**12) is None  # it never answered: there may be none
    assert host.answered(0, 10 * MS) is None
    found = [host.overdue(10 * MS + tick * MS) for tick in range(600)]
    assert [tick for tick, finding in enumerate(found) if finding] == [HOST_SILENT_NS // MS + 1]
    slow = host.answered(0, 900 * MS)
    assert slow is not None and "slow" in slow.text and slow.cause == 0 and host.answered(0, 910 * MS) is None
    assert host.answered(920 * MS, 930 * MS) is None
