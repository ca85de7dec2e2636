"""Benchmark of the model process: the answer to a pose of the running rig, spatial estimator and planar one."""

from __future__ import annotations

import time

from host.estimation.service import DEFAULT_ESTIMATOR, EstimationService, load_estimator, rehearse
from host.studies.benchmarks.runner import PairedTimes, Report, Row, row_of
from host.studies.control.runs import REGULAR, hold, with_control
from protocol.rig_file import SIMULATED_RIG, Rig, load_rig
from protocol.topics import Message, Pose

CONTACT_S = 8.0


def estimate_rig(seed: int, _report: Report) -> list[Row]:
    """Time from a pose to its answer, with adaptation and contact watch, from arming to 8 s of contact in lock step.

    Both estimators get the messages of one run, in which the force sensor closes the loop.
    """
    rig = load_rig(SIMULATED_RIG)
    messages: list[tuple[str, Message]] = []
    hold(rig, seed, REGULAR, CONTACT_S, publish=lambda topic, message: messages.append((topic, message)))
    spatial, planar = (_service(with_control(rig, "estimation", model=model)) for model in ("spatial", "planar"))
    timed = PairedTimes()
    for topic, message in messages:
        spatial.receive(topic, message)
        planar.receive(topic, message)
        if isinstance(message, Pose):
            ours_s, peer_s = _answer_s(spatial), _answer_s(planar)
            if ours_s and peer_s:
                timed.ours_s.append(ours_s)
                timed.peer_s.append(peer_s)
    return [row_of("estimate_rig", "spatial, poses of a job", "the planar estimator of the rig", timed, seed)]


def _service(rig: Rig) -> EstimationService:
    rehearse(load_estimator(DEFAULT_ESTIMATOR, rig), rig)
    return EstimationService(load_estimator(DEFAULT_ESTIMATOR, rig))


def _answer_s(service: EstimationService) -> float:
    """Return the time (s) of an answer; 0 if no pose waits or there is no estimate."""
    begin_ns = time.perf_counter_ns()
    answer = service.answer(0)
    return 0.0 if answer is None else (time.perf_counter_ns() - begin_ns) * 1e-9
