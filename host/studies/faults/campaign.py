"""The fault campaign: a plan of random faults, rigs brought to each phase once, a forked process for each run."""

from __future__ import annotations

import json
import math
import os
import resource
import signal
import tempfile
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from host.estimation.service import DEFAULT_ESTIMATOR, EstimationService, load_estimator
from host.recordings.header import header_of
from host.recordings.recording import RecordingFile
from host.recordings.writer import RecordingWriter
from protocol.enums import Phase
from protocol.rig_file import SIMULATED_RIG, Rig, load_rig
from protocol.topics import Message
from protocol.worker_process import end_with_parent
from sim.fault_run import FaultyScenario, Watcher
from sim.fault_table import BY_NAME, FAULTS, PEAK_N, PHASES
from sim.forked_board import ForkableBoard, forkable_board
from sim.heart import HeartConfig
from sim.line_noise import LineNoise
from sim.plant import Plant, PlantConfig
from sim.scenario import TARGET_M, ContactJob
from sim.tissue import TissueConfig
from sim.world import World, simulated_plant

JOB = ContactJob(target_m=TARGET_M)
RUNS_PER_RIG = 50
HOLD_AFTER_S = 2.0  # of contact: what was a touch is now a force held
PAIRS, SECOND_WITHIN_S = 0.2, 0.3  # share of runs with a second fault, and the latest time of it after the first
DELAYS_S = {"approach": 0.5, "contact": 0.5, "hold": 1.0}
RUN_TIMEOUT_S = 300  # of processor time; a run takes a few seconds. A run that waits for ever ends after ten times that
# A catheter is that of its file up to this (log of the stiffness), twice the standard deviation that the rig file states.
KNOWN_STIFFNESS = 0.1
OVER_FORCE_SHARE = 0.9  # of the limit: a true force from which on an alarm is right
DISK_ROOM = 20_000  # bytes left on the full disk
Progress = Callable[["RunResult", int], None]


@dataclass(frozen=True)
class RigDraw:
    """One rig of the campaign: source of the force of its loop, and a catheter, wall and heart unlike its file."""

    force_source: str
    stiffness: float  # of the catheter, relative to the model's
    wall_N_per_m: float
    heart: HeartConfig

    @staticmethod
    def of(seed: int, number: int) -> RigDraw:
        """Return rig `number` of a campaign: of three one as the rig file says, one in a drawn patient, one all drawn.

        The next three are the same with the estimate in the loop. A drawn patient has another wall and heart, and the
        catheter of the rig file.
        """
        source = "estimate" if number % 6 >= 3 else "sensor"
        if number % 3 == 0:
            return RigDraw(source, 1.0, TissueConfig().stiffness_N_per_m, HeartConfig())
        rng = np.random.default_rng((seed, 2_000_000 + number))
        heart = HeartConfig(
            beat_m=float(np.exp(rng.uniform(math.log(0.5e-3), math.log(5e-3)))),
            beat_Hz=float(rng.uniform(0.8, 3.0)),
            irregularity=float(rng.uniform(0.0, 0.2)),
            premature_share=float(rng.uniform(0.0, 0.2)),
        )
        wall_N_per_m = float(np.exp(rng.uniform(math.log(1e3), math.log(1e4))))
        stiffness = 1.0 if number % 3 == 1 else float(np.exp(rng.uniform(math.log(0.5), math.log(2.0))))
        return RigDraw(source, stiffness, wall_N_per_m, heart)

    def limit_N(self, rig: Rig) -> float:
        """Return the greatest true force (N) that is allowed with the catheter and limits of `rig`.

        It is PEAK_N, or what a catheter that stands still gets from this wall, if that is more: the requested force and the
        wall's whole motion times the stiffness of catheter and wall in series. A board without its link cannot move the
        stages away from a wall, so no software can stay below it.
        """
        usual = HeartConfig()
        swing_m = 2.0 * (self.heart.beat_m + usual.respiration_m)
        free_N_per_m = self.stiffness / rig.control.tip_compliance_m_per_N
        in_series_N_per_m = 1.0 / (1.0 / free_N_per_m + 1.0 / self.wall_N_per_m)
        return max(PEAK_N, JOB.force_N + in_series_N_per_m * swing_m)

    def plant(self, rig: Rig, seed: int) -> Plant:
        """Return the simulated plant with this catheter, wall and heart."""
        usual = PlantConfig().catheter
        catheter = replace(
            usual,
            distal_Nm2=_times(self.stiffness, usual.distal_Nm2),
            body_Nm2=_times(self.stiffness, usual.body_Nm2),
        )
        tissue = TissueConfig(stiffness_N_per_m=self.wall_N_per_m)
        return simulated_plant(rig, seed, catheter=catheter, tissue=tissue, heart=self.heart)


def _times(factor: float, values: tuple[float, float, float]) -> tuple[float, float, float]:
    return factor * values[0], factor * values[1], factor * values[2]


@dataclass(frozen=True)
class RunPlan:
    """One run: which fault, in which phase of the job on which rig, how bad and how long, delay_s after the phase began.

    `second` is a fault that is injected `second_s` after the first; empty for most runs.
    """

    index: int
    rig: int
    fault: str
    phase: str
    size: float
    seconds: float
    delay_s: float
    second: str = ""
    second_size: float = 0.0
    second_seconds: float = 0.0
    second_s: float = 0.0


@dataclass(frozen=True)
class RunResult:
    """Result of a run. `violations`: what the rig must not do and did, one line each."""

    plan: RunPlan
    outcome: dict[str, Any]
    recording_readable: bool
    recording_lost_s: float
    unhandled: str
    violations: tuple[str, ...]


def plan_runs(runs: int, seed: int, faults: tuple[str, ...] = ()) -> list[RunPlan]:
    """All runs of a campaign. Faults and phases come by turns, everything else at random; the seed decides all.

    faults: only these, all without. Raises ValueError for an unknown one.
    """
    for name in faults:
        if name not in BY_NAME:
            raise ValueError(f"--fault: found {name!r}, wanted one of {', '.join(BY_NAME)}")
    pairs = [(fault, phase) for phase in PHASES for fault in (faults or tuple(BY_NAME))]
    rigs = 6 * -(-runs // (6 * RUNS_PER_RIG))
    plans = []
    for index in range(runs):
        rng = np.random.default_rng((seed, index))
        fault, phase = pairs[index % len(pairs)]
        size, seconds = BY_NAME[fault].draw(rng)
        rig, delay_s = int(rng.integers(rigs)), float(rng.uniform(0.0, DELAYS_S[phase]))
        plan = RunPlan(index, rig, fault, phase, size, seconds, delay_s)
        if rng.random() < PAIRS and fault != "none":
            second = BY_NAME[list(BY_NAME)[int(rng.integers(1, len(BY_NAME)))]]
            size, seconds = second.draw(rng)
            plan = replace(
                plan,
                second=second.name,
                second_size=size,
                second_seconds=seconds,
                second_s=float(rng.uniform(0.0, SECOND_WITHIN_S)),
            )
        plans.append(plan)
    return plans


def run_campaign(
    runs: int,
    seed: int,
    jobs: int = 1,
    board: str = "native",
    faults: tuple[str, ...] = (),
    finished: Sequence[RunResult] = (),
    progress: Progress = lambda result, done: None,
) -> list[RunResult]:
    """Return all runs, in the order of the plan; the same for every number of `jobs`.

    finished: runs of the same campaign that are not made again.
    progress: gets each further run and the number of runs that are finished.
    Raises ValueError for an unknown fault, BoardUnavailable where the board cannot be built.
    """
    results = list(finished)
    there = {result.plan.index for result in results}
    plans = [plan for plan in plan_runs(runs, seed, faults) if plan.index not in there]
    for result in run_plans(plans, seed, jobs, board):
        results.append(result)
        progress(result, len(results))
    return sorted(results, key=lambda result: result.plan.index)


def run_plans(plans: Sequence[RunPlan], seed: int, jobs: int = 1, board: str = "native") -> Iterator[RunResult]:
    """Make the runs of `plans`, those of one rig together; each result as soon as it is there.

    seed: that of the campaign, from which the rigs are drawn. Raises BoardUnavailable where the board cannot be built.
    """
    of_rig = [[plan for plan in plans if plan.rig == rig] for rig in sorted({plan.rig for plan in plans})]
    if jobs <= 1:
        for group in of_rig:
            yield from run_on_rig(group, seed, board)
        return
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn"), initializer=end_with_parent) as pool:
        for future in as_completed([pool.submit(_all_on_rig, group, seed, board) for group in of_rig]):
            yield from future.result()


def _all_on_rig(plans: list[RunPlan], seed: int, board: str) -> list[RunResult]:
    return list(run_on_rig(plans, seed, board))


def run_on_rig(plans: list[RunPlan], seed: int, board_kind: str) -> Iterator[RunResult]:
    """Bring one rig through the phases of the job; at each, fork off the runs of `plans` that begin there."""
    rig, number = load_rig(SIMULATED_RIG), plans[0].rig
    rig_seed = int(np.random.default_rng((seed, 1_000_000 + number)).integers(2**31))
    drawn = RigDraw.of(seed, number)
    with forkable_board(board_kind) as board:
        world = World(rig, drawn.plant(rig, rig_seed), board, rig_seed)
        service = EstimationService(load_estimator(DEFAULT_ESTIMATOR, rig))
        run = FaultyScenario(rig, world, _nothing, rig_seed, service, drawn.force_source)
        reached = True
        last = max(PHASES.index(plan.phase) for plan in plans)
        for phase in PHASES[: last + 1]:
            reached = reached and _bring_to(run, phase)
            if not reached and number % 3 == 0:
                raise RuntimeError(
                    f"rig {number} without a fault did not reach the phase {phase}, wanted it before the fault"
                )
            for plan in plans:
                if plan.phase == phase:
                    yield _forked(run, board, plan, drawn) if reached else RunResult(plan, {}, True, 0.0, "", ())


def _nothing(topic: str, message: Message) -> None:
    """Ignore messages before the fault."""


def _bring_to(run: FaultyScenario, phase: str) -> bool:
    """From the phase before to the beginning of `phase`. Return whether the rig without a fault got there.

    A rig whose catheter or wall is far from its file may retract before, which is right; it then has no such phase.
    """
    if phase == "approach":
        if not run.arm():
            return False
        run._shape(JOB)
        return run.command("target", "contact", target_m=JOB.target_m, normal=JOB.into, force_N=JOB.force_N).accepted
    if phase == "contact":
        return run.run(10.0, lambda: run.phase in (Phase.CONTACT, Phase.STOPPED)) and run.phase == Phase.CONTACT
    run.run(HOLD_AFTER_S)
    return run.phase == Phase.CONTACT


def _forked(run: FaultyScenario, board: ForkableBoard, plan: RunPlan, drawn: RigDraw) -> RunResult:
    """The run in a copy of this process; its result, or its failure, comes back through a pipe."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        status = 1
        try:
            os.close(reading)
            signal.setitimer(signal.ITIMER_PROF, RUN_TIMEOUT_S)
            signal.alarm(10 * RUN_TIMEOUT_S)
            board.after_fork()
            with os.fdopen(writing, "w") as pipe:
                json.dump(_inject(run, plan), pipe)
            board.close()
            status = 0
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(status)
    os.close(writing)
    with os.fdopen(reading) as pipe:
        said = pipe.read()
    _, status = os.waitpid(child, 0)
    if status != 0 or not said:
        failed = f"run ended with status {status}"
        said = json.dumps({"outcome": {}, "recording_readable": False, "recording_lost_s": 0.0, "unhandled": failed})
    answered = json.loads(said)
    if answered["outcome"]:
        answered["outcome"] |= {"limit_N": drawn.limit_N(run.loop.rig), "stiffness": drawn.stiffness}
    return judged(plan, answered)


def judged(plan: RunPlan, answered: dict[str, Any]) -> RunResult:
    """Return the run of `plan` with the rules that it broke. answered: the other fields of the result."""
    result = RunResult(plan, violations=(), **answered)
    return replace(result, violations=tuple(violations(result)))


def _inject(run: FaultyScenario, plan: RunPlan) -> dict[str, Any]:
    """The fault and what follows, recorded as the model process would."""
    fault = BY_NAME[plan.fault]
    run.noise = LineNoise(plan.index)
    run.run(plan.delay_s)
    unhandled = ""
    with tempfile.TemporaryDirectory(prefix="seldinger-fault-") as folder:
        path = Path(folder) / "run.mcap"
        header = header_of(run.loop.rig, "virtual", plan.index, {"fault": plan.fault, "phase": plan.phase})
        recording = RecordingWriter(path, header, lambda text: run.loop.log(run.now_ns, "error", "recorder", text))

        def record(topic: str, message: Message) -> None:
            recording.write(topic, message, run.now_ns)

        run.out = record
        watcher = Watcher(run, fault.large, fault.within_s)
        run.watchers = [watcher]
        if plan.fault == "disk_full":
            resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + DISK_ROOM,) * 2)
        try:
            fault.inject(run, plan.size, plan.seconds)
            tail_s = plan.seconds + fault.tail_s
            if plan.second:
                second = BY_NAME[plan.second]
                run.run(plan.second_s)
                second.inject(run, plan.second_size, plan.second_seconds)
                tail_s = max(tail_s - plan.second_s, plan.second_seconds + second.tail_s)
            run.run(tail_s)
        except Exception as error:  # the very thing to be counted
            unhandled = f"{type(error).__name__}: {error} at {traceback.extract_tb(error.__traceback__)[-1].name}"
        end_ns = run.now_ns
        run.watchers = []
        recording.close()
        readable, lost_s = _read_back(path, end_ns)
    return {
        "outcome": asdict(watcher.close()),
        "recording_readable": readable,
        "recording_lost_s": lost_s,
        "unhandled": unhandled,
    }


def _read_back(path: Path, end_ns: int) -> tuple[bool, float]:
    """Whether the recording can be read, and the seconds at its end that it does not have."""
    try:
        recording = RecordingFile(path)
    except ValueError:
        return False, 0.0
    return bool(recording.run), max((end_ns - recording.span_ns[1]) * 1e-9, 0.0) if recording.topics else end_ns * 1e-9


def found_due_s(result: RunResult) -> float | None:
    """Time (s, from the injection) from which the fault had to be found, None: it need not be."""
    fault, plan = BY_NAME[result.plan.fault], result.plan
    if plan.second:  # one may hide the other: only the rules on force, rest and motion hold for pairs
        return None
    if fault.large is not None:
        large_s: float | None = result.outcome.get("large_s")
        return large_s
    return 0.0 if fault.must_detect(plan.size, plan.seconds) else None


def violations(result: RunResult) -> Iterator[str]:
    """Yield the violations of one run, one line each."""
    plan, outcome = result.plan, result.outcome
    fault = BY_NAME[plan.fault]
    if result.unhandled:
        yield f"unhandled: {result.unhandled}"
    if not result.recording_readable:
        yield "recording not readable"
    if not outcome:
        return
    detected_s = outcome["detected_s"]
    if fault.name == "none" and detected_s is not None and not _alarm_is_right(outcome):
        yield f"false alarm: {outcome['detected_by']}"
    due_s = found_due_s(result)
    if due_s is not None and detected_s is None:
        yield f"not detected within {fault.within_s} s"
    elif due_s is not None and detected_s > due_s + fault.within_s:
        yield f"detected only after {detected_s - due_s:.3f} s"
    limit_N = outcome.get("limit_N", PEAK_N)
    if outcome["peak_force_N"] > limit_N:
        yield f"peak force {outcome['peak_force_N']:.3f} N, wanted at most {limit_N:.2f} N"
    if fault.rest_s and not plan.second and outcome["rest_s"] > fault.rest_s:
        yield f"still moving {outcome['rest_s'] * 1e3:.0f} ms after the link was lost, wanted {fault.rest_s * 1e3:.0f} ms"
    if fault.stops and not plan.second and outcome["final_phase"] not in ("stopped", "disarmed"):
        yield f"ended in phase {outcome['final_phase']}, wanted stopped"
    if outcome["rearmed"]:
        yield "moved on by itself after a stop"


def _alarm_is_right(outcome: dict[str, Any]) -> bool:
    """Whether a rig without a fault had to raise an alarm: its catheter is not that of its file, or it pressed hard."""
    wrong_catheter = abs(math.log(outcome.get("stiffness", 1.0))) > KNOWN_STIFFNESS
    return wrong_catheter or outcome["peak_force_N"] > OVER_FORCE_SHARE * outcome.get("limit_N", PEAK_N)


def by_fault(results: list[RunResult]) -> list[dict[str, Any]]:
    """A row per fault and phase, as the command prints it, with the actions and violations."""
    rows = []
    for fault in FAULTS:
        for phase in PHASES:
            mine = [result for result in results if (result.plan.fault, result.plan.phase) == (fault.name, phase)]
            if mine:
                rows.append({"fault": fault.name, "phase": phase, **summary_of(mine)})
    return rows


def summary_of(results: list[RunResult]) -> dict[str, Any]:
    """Return counts, times of detection, actions and peak force over `results`."""
    outcomes = [result.outcome for result in results if result.outcome]
    times_ms = [
        1e3 * max(result.outcome["detected_s"] - (found_due_s(result) or 0.0), 0.0)
        for result in results
        if result.outcome.get("detected_s") is not None
    ]
    actions: dict[str, int] = {}
    for outcome in outcomes:
        actions[outcome["action"]] = actions.get(outcome["action"], 0) + 1
    # A rig whose catheter or wall is far from its file may not reach the phase; then there was no fault to detect.
    wanted = [result for result in results if found_due_s(result) is not None and (result.outcome or result.unhandled)]
    stopping = [outcome["moved_after_m"] for outcome in outcomes if outcome["action"] in ("hold", "retract", "stop")]
    return {
        "runs": len(results),
        "not_reached": sum(not (result.outcome or result.unhandled) for result in results),
        "detected": len(times_ms),
        "must_detect": len(wanted),
        "missed": sum(result.outcome.get("detected_s") is None for result in wanted),
        "detection_ms_p50": float(np.median(times_ms)) if times_ms else None,
        "detection_ms_p99": float(np.percentile(times_ms, 99)) if times_ms else None,
        "peak_force_N": max((outcome["peak_force_N"] for outcome in outcomes), default=0.0),
        "moved_after_m": max(stopping, default=0.0),
        "rest_ms_max": max((1e3 * outcome["rest_s"] for outcome in outcomes), default=0.0),
        "actions": actions,
        "poses_lost": sum(outcome["poses_lost"] for outcome in outcomes),
        "recording_lost_s": max((result.recording_lost_s for result in results), default=0.0),
        "recordings_unreadable": sum(not result.recording_readable for result in results),
        "unhandled": sum(bool(result.unhandled) for result in results),
        "violations": sum(bool(result.violations) for result in results),
    }
