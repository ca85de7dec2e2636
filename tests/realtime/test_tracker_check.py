"""A displaced tracker is found within two frames; no motion of the catheter is taken for one."""

from collections.abc import Callable

import numpy as np
import pytest

from realtime.core.tracker_check import WINDOW_NS, TrackerCheck

NOISE_M, NOISE_RAD, BACKLASH_M = 0.00029, 0.0035, 0.003
FRAME_NS, STATUS_NS = 25_000_000, 5_000_000
TIP_M, SHAFT_M = np.array([0.01, 0.0, 0.06]), np.array([0.004, 0.0, 0.042])
FRAMES, MOVED_AT = 80, 40
Vector = np.ndarray

# Functions of the time in s: insertion in m; displacement of tip and shaft in m; turn of both about x in rad.
Insertion = Callable[[float], float]
Displacement = Callable[[float], Vector]


def still(seconds: float) -> Vector:
    return np.zeros(3)


def stopped(seconds: float) -> float:
    return 0.0


def found(
    tip: Displacement = still,
    shaft: Displacement = still,
    insertion: Insertion = stopped,
    turn: Insertion = stopped,
    frozen: range = range(0),
    missing: range = range(0),
    encoder: Insertion | None = None,
    seed: int = 1,
) -> list[int]:
    """Return the frames in which the check reports a displacement, of FRAMES frames with the tracker's noise."""
    rng = np.random.default_rng(seed)
    check = TrackerCheck(NOISE_M, NOISE_RAD, BACKLASH_M)
    reported, poses = [], [(TIP_M, np.array([1.0, 0, 0, 0]))] * 2
    for frame in range(FRAMES):
        begin_ns = 10**12 + frame * FRAME_NS
        for status in range(FRAME_NS // STATUS_NS):
            seconds = (frame * FRAME_NS + status * STATUS_NS) * 1e-9
            by_encoder = (encoder or insertion)(seconds)
            check.take_stage(begin_ns + status * STATUS_NS, insertion(seconds), by_encoder)
        seconds = frame * FRAME_NS * 1e-9
        if frame not in frozen:
            poses = []
            for place, moved in ((SHAFT_M, shaft), (TIP_M, tip)):
                half = (turn(seconds) + rng.normal(0.0, NOISE_RAD)) / 2
                quaternion = np.array([np.cos(half), np.sin(half), *rng.normal(0.0, NOISE_RAD / 2, 2)])
                poses.append((place + moved(seconds) + rng.normal(0.0, NOISE_M, 3), quaternion))
        if frame in missing:
            continue
        for is_tip, (position_m, quaternion) in zip((False, True), poses, strict=True):
            if check.take_pose(is_tip, begin_ns, position_m, quaternion):
                reported.append(frame)
    return reported


def step(axis: int, size_m: float, ramp_s: float = 0.0) -> Displacement:
    """A displacement along an axis from frame MOVED_AT on."""

    def displaced(seconds: float) -> Vector:
        since_s = seconds - MOVED_AT * FRAME_NS * 1e-9
        share = float(since_s >= 0) if ramp_s == 0 else min(max(since_s / ramp_s, 0.0), 1.0)
        return size_m * share * np.eye(3)[axis]

    return displaced


def approach(speed_m_per_s: float) -> Insertion:
    return lambda seconds: speed_m_per_s * seconds


def along(insertion: Insertion) -> Displacement:
    return lambda seconds: np.array([0.0, 0.0, insertion(seconds)])


def plus(*parts: Displacement) -> Displacement:
    return lambda seconds: np.sum([part(seconds) for part in parts], axis=0)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("size_m", [-0.02, -0.004, 0.004, 0.02])
def test_a_jump_of_the_tracker_is_found_with_its_second_frame(axis: int, size_m: float) -> None:
    moved = step(axis, size_m)
    assert found(moved, moved)[0] == MOVED_AT + 1


@pytest.mark.parametrize("size_m", [-0.004, 0.004])
def test_a_jump_along_an_advancing_catheter_is_found(size_m: float) -> None:
    insertion = approach(0.02)
    moved = plus(along(insertion), step(2, size_m))
    assert found(moved, moved, insertion)[0] == MOVED_AT + 1


def test_a_push_of_a_fifth_of_a_second_is_found_before_it_ends_plus_two_frames() -> None:
    moved = step(0, 0.006, ramp_s=0.2)
    assert MOVED_AT < found(moved, moved)[0] <= MOVED_AT + 10


@pytest.mark.parametrize("seed", range(20))
def test_noise_alone_is_no_displacement(seed: int) -> None:
    assert found(seed=seed) == []


def behind_play(insertion: Insertion, width_m: float) -> Displacement:
    """The motion of a distal end behind a play of a width, by small steps from time 0."""
    times = np.arange(0.0, FRAMES * FRAME_NS * 1e-9, 0.002)
    places = [-width_m / 2]
    for seconds in times[1:]:
        stage_m = insertion(float(seconds))
        places.append(min(max(places[-1], stage_m - width_m), stage_m))
    return along(lambda seconds: float(np.interp(seconds, times, places)) - places[0])


@pytest.mark.parametrize("speed_m_per_s", [-0.05, 0.05])
@pytest.mark.parametrize("width", [0.7, 1.0, 1.3])
def test_an_insertion_at_full_speed_is_none_also_if_the_backlash_is_not_as_stated(
    speed_m_per_s: float, width: float
) -> None:
    insertion = approach(speed_m_per_s)
    moved = behind_play(insertion, width * BACKLASH_M)
    assert found(moved, moved, insertion) == []


@pytest.mark.parametrize("hertz", [0.5, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("width", [0.7, 1.0, 1.3])
def test_reversals_are_none_also_if_the_backlash_is_not_as_stated(width: float, hertz: float) -> None:
    def insertion(seconds: float) -> float:
        return 0.004 * float(np.sin(2 * np.pi * hertz * seconds))

    moved = behind_play(insertion, width * BACKLASH_M)
    assert found(moved, moved, insertion) == []


def test_a_push_against_an_advancing_catheter_is_found() -> None:
    """It seems to stand still: only its stage shows that it should have moved."""
    insertion = approach(0.02)
    moved = plus(along(insertion), step(2, -0.0055, ramp_s=0.25))
    assert MOVED_AT < found(moved, moved, insertion)[0] <= MOVED_AT + 11


def test_a_catheter_that_slips_in_its_holder_is_found() -> None:
    assert found(insertion=lambda seconds: 0.03 * max(seconds - 1.0, 0.0)) != []


def test_a_rotor_that_is_turned_by_its_load_is_none_since_the_encoder_shows_it() -> None:
    slip = lambda seconds: -0.05 * max(seconds - 1.0, 0.0)  # noqa: E731
    moved = along(slip)
    assert found(moved, moved, stopped, encoder=slip) == []
    assert found(moved, moved, stopped) != []  # without the encoder nothing explains it


def test_a_motion_that_turns_the_sensors_is_none() -> None:
    """A knob's motion displaces both sensors alike in the worst case, but it turns them."""
    moved = step(1, 0.004)
    assert found(moved, moved, turn=lambda seconds: -0.08 * float(moved(seconds)[1] > 0)) == []
    assert found(moved, moved, turn=lambda seconds: 0.08 * float(moved(seconds)[1] > 0)) != []  # a turn the other way


def test_an_insertion_while_the_knob_straightens_is_none() -> None:
    """The arc becomes longer and the sensors keep their directions: both move along the catheter, not along the sheath."""
    bend_rad, insertion = 0.9, approach(0.03)
    direction = np.array([0.0, -np.sin(bend_rad), np.cos(bend_rad)])
    moved = lambda seconds: insertion(seconds) * direction  # noqa: E731
    assert found(moved, moved, insertion, turn=lambda seconds: bend_rad) == []
    assert found(moved, moved, turn=lambda seconds: bend_rad) != []  # without the insertion nothing explains it


def test_one_sensor_that_is_displaced_is_none() -> None:
    assert found(tip=step(0, 0.01)) == [] and found(shaft=step(0, 0.01)) == []
    assert found(step(0, 0.01), step(0, -0.01)) == []


def test_poses_that_were_frozen_or_missing_during_an_insertion_are_none() -> None:
    insertion = approach(0.05)
    moved = along(insertion)
    gap = range(MOVED_AT, MOVED_AT + 2 * WINDOW_NS // FRAME_NS)
    assert found(moved, moved, insertion, frozen=gap) == []
    assert found(moved, moved, insertion, missing=gap) == []


def test_a_displacement_while_the_tracker_saw_nothing_is_found_when_it_sees_again() -> None:
    gap = range(MOVED_AT, MOVED_AT + 2 * WINDOW_NS // FRAME_NS)
    moved = step(0, 0.005)
    assert found(moved, moved, missing=gap)[0] <= gap.stop + 1


def test_a_clock_that_is_set_back_starts_the_comparison_again() -> None:
    check = TrackerCheck(NOISE_M, NOISE_RAD, BACKLASH_M)
    turn = np.array([1.0, 0.0, 0.0, 0.0])
    reported = []
    for stamp_ns, place in [(10**12 + k * FRAME_NS, 0.0) for k in range(10)] + [(k * FRAME_NS, 0.02) for k in range(10)]:
        check.take_stage(stamp_ns, 0.0, 0.0)
        for is_tip in (False, True):
            reported.append(check.take_pose(is_tip, stamp_ns, np.full(3, place), turn))
    assert not any(reported)
