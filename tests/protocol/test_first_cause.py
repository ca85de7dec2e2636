"""The first cause as a table: what was observed, in ms, and which of it is the headline."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.first_cause import RULES, Observation, first_cause
from realtime.control.safety import CAUSES

TABLE = [
    ({}, None),
    ({"pose_stale": 0}, "pose_stale"),
    ({"loop_late": 0, "deadman": 60, "board_fault": 60, "pose_stale": 80, "pose_lost": 180}, "loop_late"),
    ({"loop_late": 500, "deadman": 60, "board_fault": 60, "pose_stale": 80}, "loop_late"),  # reported half a second later
    ({"loop_late": 0, "pose_lost": 20_000}, "loop_late"),  # the loop came first, and the tracker has its own cause
    ({"pose_stale": 0, "pose_lost": 100, "loop_late": 9_000}, "pose_stale"),
    ({"board_silent": 0, "deadman": 40, "board_fault": 50}, "board_silent"),
    ({"board_reset": 30, "board_silent": 0, "steps_lost": 90}, "board_reset"),
    ({"pose_rejected": 0, "poses_wild": 50, "pose_stale": 60, "pose_lost": 150}, "pose_rejected"),
    ({"force_stale": 0, "force_lost": 100, "force_handover": 100}, "force_stale"),
    ({"steps_lost": 0, "over_force": 40}, "steps_lost"),
    ({"pose_rejected": 0, "tracker_moved": 25, "force_disagrees": 400}, "tracker_moved"),
    ({"force_undecided": 0, "force_disagrees": 300, "body_contact": 270}, "body_contact"),  # averaged over a quarter second
    ({"tracker_moved": 0, "body_contact": 250, "force_disagrees": 300}, "tracker_moved"),
    ({"pose_rejected": 0, "tracker_moved": 9_000}, "pose_rejected"),
    ({"over_force": 0, "operator_stop": 900}, "over_force"),
    ({"operator_stop": 0, "board_fault": 20}, "operator_stop"),
    ({"board_silent": 0, "underrun": 91, "pose_stale": 190, "board_fault": 197, "deadman": 241}, "devices_silent"),
    ({"board_silent": 0, "pose_stale": 9_000}, "board_silent"),
    ({"loop_late": 0, "board_silent": 20, "pose_stale": 20}, "loop_late"),
    ({"something new": 0, "over_force": 10}, "something new"),
]


@pytest.mark.parametrize(("observed_ms", "headline"), TABLE)
def test_the_headline_is_the_first_cause(observed_ms: dict[str, int], headline: str | None) -> None:
    observed = [Observation(cause, at_ms * 1_000_000, cause) for cause, at_ms in observed_ms.items()]
    for order in itertools.islice(itertools.permutations(observed), 24):
        found = first_cause(order)
        assert (found.cause if found else None) == headline
        if found:
            assert found.says and found.remedy
            assert {item.cause for item in found.followed} == set(observed_ms) - {headline}
            assert [item.at_ns for item in found.followed] == sorted(item.at_ns for item in found.followed)


def test_every_cause_of_the_failsafe_has_a_rule_and_rules_name_rules() -> None:
    assert {name for name, *_ in CAUSES} <= set(RULES)
    assert all(cause in RULES for rule in RULES.values() for cause in rule.explained_by)
    for cause, rule in RULES.items():
        assert rule.says.endswith(".") and rule.remedy.endswith("."), cause


@given(st.lists(st.tuples(st.sampled_from(sorted(RULES)), st.integers(0, 10**12))))
def test_nothing_that_was_observed_is_lost(observed: list[tuple[str, int]]) -> None:
    found = first_cause(Observation(cause, at_ns) for cause, at_ns in observed)
    named = {found.cause, *(item.cause for item in found.followed)} if found else set()
    assert named | {"devices_silent"} == {cause for cause, _ in observed} | {"devices_silent"}
