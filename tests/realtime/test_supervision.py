"""The cross-checks beside the tick: what is normal raises nothing, what is not raises its cause once."""

import numpy as np

from protocol.enums import SafetyAction
from protocol.rig_file import SIMULATED_RIG, load_rig
from protocol.topics import ForceEstimate
from realtime.control import safety
from realtime.core.supervision import HOST_SILENT_NS, STEPS_SWING, Supervision

MS = 1_000_000
LOST_NS = 2_000_000_000  # host_lost_after_s of the rig file
ZERO = np.zeros(3, int)


def answer(stamp_ns: int, body_contact: bool = False) -> ForceEstimate:
    """An answer of the model process for a pose of `stamp_ns`."""
    return ForceEstimate(
        stamp_ns=stamp_ns, frame="base", converged=False, published_ns=stamp_ns, compute_us=0.0, body_contact=body_contact
    )


def made() -> Supervision:
    """Checks of a rig with 1, 1 and 2 encoder counts per step."""
    rig = load_rig(SIMULATED_RIG)
    knob = rig.stages.knob.model_copy(update={"encoder_counts_per_step": 2.0})
    supervision = Supervision(rig.model_copy(update={"stages": rig.stages.model_copy(update={"knob": knob})}))
    supervision.restart()
    return supervision


def test_an_offset_at_arming_and_the_lag_of_a_move_are_no_loss() -> None:
    supervision = made()
    for tick in range(200):
        steps = np.array([16 * tick, 0, 10 * tick])
        assert supervision.status(steps, np.array([16 * tick + 5000 - 80, 7, 20 * tick]), tick * MS) is None
    assert supervision.causes == 0


def test_steps_that_stay_lost_are_told_once_and_stand_until_the_restart() -> None:
    supervision = made()
    lost = np.array([0, round(STEPS_SWING) + 1, 0])
    told = [supervision.status(ZERO, -lost * (tick > 3), tick * MS) for tick in range(40)]
    words = [finding.text for finding in told if finding]
    assert len(words) == 1 and words[0].startswith("roll: encoder and steps differ by 41 steps")
    assert supervision.causes == safety.STEPS_LOST and safety.action_of(supervision.causes) == SafetyAction.RETRACT
    supervision.restart()
    assert supervision.causes == 0


def test_one_strange_status_is_no_loss() -> None:
    supervision = made()
    for tick in range(40):
        supervision.status(ZERO, ZERO + 500 * (tick == 10), tick * MS)
    assert supervision.causes == 0


def test_a_rotor_that_slips_at_full_speed_is_found_with_the_second_status() -> None:
    supervision = made()
    supervision.status(ZERO, ZERO, 0)
    found = [
        supervision.status(ZERO, np.array([0, 0, -2 * 61 * (tick + 1)]), (tick + 1) * MS) is not None for tick in range(3)
    ]
    assert found == [False, True, False]


def test_a_rotor_that_turns_faster_than_the_board_counts_is_found_with_its_next_status() -> None:
    supervision = made()
    told = [supervision.status(ZERO, ZERO, tick * MS, (65530 + 60 * max(tick - 3, 0)) % 65536) for tick in range(6)]
    assert [finding is not None for finding in told] == [False] * 4 + [True, False]
    assert supervision.causes == safety.STEPS_LOST


def test_single_impossible_transitions_are_noise() -> None:
    supervision = made()
    for tick in range(40):
        assert supervision.status(ZERO, ZERO, tick * MS, 1000 + 2 * tick) is None


def test_a_silent_model_process_holds_and_a_lost_one_retracts() -> None:
    supervision = made()
    supervision.host_overdue(10**12)
    assert supervision.causes == 0  # it never answered: there may be none
    supervision.host_answered(answer(0), 10 * MS)
    supervision.host_overdue(10 * MS + HOST_SILENT_NS + 1)
    assert supervision.causes == safety.HOST_SILENT
    supervision.host_overdue(10 * MS + LOST_NS + 1)
    assert safety.action_of(supervision.causes) == SafetyAction.RETRACT
    supervision.host_answered(answer(10 * MS + LOST_NS), 20 * MS + LOST_NS)
    supervision.host_overdue(20 * MS + LOST_NS)
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


def test_a_contact_of_the_body_warns_while_it_is_reported_and_never_stops() -> None:
    supervision = made()
    supervision.host_answered(answer(0, body_contact=True), 10 * MS)
    assert supervision.causes == safety.BODY_CONTACT
    assert safety.decide(supervision.causes, 0, False) == (SafetyAction.WARN, 0)
    supervision.host_answered(answer(25 * MS), 35 * MS)
    assert supervision.causes == 0
    supervision.host_answered(answer(50 * MS, body_contact=True), 60 * MS)
    supervision.host_overdue(60 * MS + HOST_SILENT_NS + 1)
    assert supervision.causes == safety.HOST_SILENT  # what it said last says nothing of now
