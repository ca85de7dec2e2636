"""Alarms of the live watch in virtual time: false ones, their delay, and the subsystem that they name; for docs/live.md.

    python -m host.studies.live_study        # the short form: minutes
    make live-study                          # 5 hours of each job, 60 planted runs; continues a stopped study

Every run is the simulated rig in lock step: a seed decides it. `--out` keeps what the watch received in each run. A later
call judges it again within seconds, with the watch as it is then.
"""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from host.commissioning.experiment_script import Script, perform
from host.diagnosis.live.twin import COLUMNS, FrameCollector
from host.diagnosis.live.watch import Watch, is_armed
from host.diagnosis.models.rig import SHAFT, TIP
from host.run.experiment_run import SimulatedCommands
from protocol.rig_file import SIMULATED_RIG, Rig, load_rig
from protocol.topics import Alarm, ForceSensor, Message, Pose, RigState, Stage
from realtime.core.intake import quaternion_product, rotation
from sim.effects import PlantedEffect, describe, parse
from sim.forked_board import forkable_board
from sim.plant import Plant
from sim.scenario import TARGET_M, ContactJob, Scenario
from sim.world import World, simulated_plant

Array = npt.NDArray[np.float64]
Stamps = npt.NDArray[np.int64]

SECOND_NS = 1_000_000_000
ON_S, HOLD_S = 20.0, 27.0
CHUNK_S = 120.0  # length of one run without an effect: what is usual is learned again in each
LAST_S = 8.0  # end of a run over which the residual is compared with the usual one
DOUBLE = 2.0  # residual with an effect relative to the usual one, for the alarm's delay
WITHIN_S = 3.0  # of its begin an effect of that size is to be reported
PRESS, ROUND, HAND = JOBS = ("press", "round", "hand")
FRESH_SEED = 50_000  # first seed of fresh noise
# effect, job, and the parameters that grow with its size
CASES: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("backlash@insertion", PRESS, ("width_m",)),
    ("coulomb_friction@insertion", PRESS, ("force_N",)),
    ("coupling@knob", PRESS, ("gain",)),
    ("latency@pose_sensor", PRESS, ("delay_s",)),
    ("field_distortion@pose_sensor", PRESS, ("amplitude_m",)),
    ("sensor_bias@force_sensor", PRESS, ("x_N", "y_N", "z_N")),
    ("base_motion@base", PRESS, ("x_m", "y_m", "z_m", "x_rad", "y_rad", "z_rad")),
    ("creep_relaxation@shape", PRESS, ("share",)),
    ("asymmetry@roll", PRESS, ("ratio",)),
    ("asymmetry@roll", ROUND, ("ratio",)),
    ("whip@roll", ROUND, ("amplitude_rad",)),
)
CASES += tuple((name, HAND, keys) for name, keys in dict.fromkeys((name, keys) for name, _, keys in CASES))
BEGIN, END = "<!-- live_study begin -->", "<!-- live_study end -->"


@dataclass(frozen=True)
class Task:
    """One run to do. `planted` is empty for none; `size` multiplies the default; `part` is what it counts for.

    `noise` above 0: the run is recorded as it is without it, and gets the tracker's noise of this seed afterwards.
    """

    part: str  # quiet, fresh, default, doubled, planted
    planted: str
    job: str
    seed: int
    seconds: float
    size: float = 1.0
    noise: int = 0

    @property
    def file(self) -> str:
        """Return the name of the file that keeps the recorded run."""
        part = "quiet" if self.part == "fresh" else self.part
        words = (part, self.planted or "nothing", self.job, f"{self.seed}", f"{self.seconds:g}s", f"size{self.size:g}")
        return "_".join(words) + ".npz"


@dataclass(frozen=True)
class LiveRow:
    """One finished run: alarms, the largest score, and the residual at its end relative to the usual one."""

    task: Task
    seconds: float
    alarms: tuple[dict[str, Any], ...]
    highest: float
    residual_ratio: float

    @property
    def first(self) -> dict[str, Any] | None:
        """The first alarm of a mismatch that began with the effect."""
        return next((a for a in self.alarms if a["since_s"] > ON_S - 1.0), None)

    @property
    def delay_s(self) -> float | None:
        """Time from the effect's begin to its alarm; None for no alarm."""
        return self.first["at_s"] - ON_S if self.first else None

    @property
    def wrong(self) -> bool:
        """Return whether the alarm names another subsystem than the one of the planted effect."""
        return self.first is not None and self.first["subsystem"] != self.task.planted.partition("@")[2]

    @property
    def line(self) -> str:
        """Return the row of the table for this task."""
        task = self.task
        head = f"| {task.planted} | {task.job} | {task.seed} | {task.size:.2g} | {self.residual_ratio:.1f} |"
        if self.first is None:
            score = f"no alarm; largest score {self.highest:.2f} of 1"
            return f"{head} {score} | | |"
        others = re.search(r"also possible: (.*)$", self.first["words"])
        named = f"{self.first['subsystem']}: {self.first['effect'].replace('_', ' ')} ({self.first['probability']:.2f})"
        also = others[1] if others else ""
        return f"{head} {self.delay_s:.1f} | {named} | {also} |"


def round_trip(rig: Rig, seconds: float) -> Script:
    """The tip to and fro on an arc of 60 degrees either way before the wall, with motions in and out."""
    t = np.arange(0.0, seconds, 0.1)
    angle = math.radians(60.0) * np.sin(2.0 * math.pi * 0.1 * t)
    depth = 0.018 + 0.002 * np.sin(2.0 * math.pi * 0.17 * t)
    radius = 0.007 + 0.001 * np.sin(2.0 * math.pi * 0.23 * t)
    rows = np.column_stack((t, radius * np.sin(angle), -radius * np.cos(angle), depth))
    return Script(
        says="round trip", rig=rig.name, catheter=rig.catheter.name, motion="free",
        start_m=[0.0, -0.007, 0.018], rows=[[float(v) for v in row] for row in rows],
    )  # fmt: skip


def effect_of(task: Task) -> tuple[PlantedEffect, ...]:
    """The effect that `task` plants, at its size; nothing where it plants none. Raises ValueError for an unknown one."""
    if not task.planted:
        return ()
    plain = parse(task.planted)
    keys = next(keys for name, _, keys in CASES if name == task.planted)
    defaults = {p.name: p.default for p in describe(plain.id, plain.port)}
    values = {key: task.size * defaults[key] for key in keys if key in defaults}
    if "ratio" in values:  # of the two directions: 1 is not an effect
        values["ratio"] = 1.0 - task.size * (1.0 - defaults["ratio"])
    return (replace(plain, parameters=values, start_s=ON_S),)


@dataclass(frozen=True)
class Frames:
    """What the watch received in one run: the time of arming, and each row with its time stamp and its arrival."""

    armed_ns: int
    stamps_ns: Stamps  # (n,)
    arrived_ns: Stamps  # (n,)
    rows: Array  # (n, columns) of `FrameCollector`

    def save(self, path: Path) -> None:
        """Write the run to `path` (npz), whole or not at all."""
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(".part")
        with part.open("wb") as file:
            np.savez_compressed(file, **vars(self))
        part.replace(path)

    @classmethod
    def load(cls, path: Path) -> Frames:
        """Read a run that `save` wrote."""
        with np.load(path) as content:
            return cls(int(content["armed_ns"]), content["stamps_ns"], content["arrived_ns"], content["rows"])


def by_hand(rig: Rig, effects: tuple[PlantedEffect, ...], seconds: float, seed: int) -> Iterator[tuple[int, str, Message]]:
    """Move the simulated catheter by hand, without loop and board: all axes at once, before the wall and onto it.

    Yields arrival (ns), topic and message in the order of measurement. The seed sets the noise and the speed of each motion.
    """
    plant = simulated_plant(rig, seed, effects=effects)
    rng = np.random.default_rng(seed)
    rate = rng.uniform(0.85, 1.15, 4) * (2.0, 5.3, 1.1, 0.9)
    yield 0, "state", RigState(stamp_ns=0, mode="hold", safety_action="none", cause="", poses_rejected=0, forces_rejected=0)
    for ms in range(1, round(seconds * 1e3)):
        t, now = 1e-3 * ms, ms * 1_000_000
        wave = np.sin(rate * t)
        handle = min(t, 1.0) * np.array([0.003 * wave[0] + 0.001 * wave[1], 0.5 * wave[2], 0.6 + 0.12 * wave[3]])
        plant.step(1e-3, handle)
        if ms % 5 == 0:
            insertion, roll, knob = map(float, handle)
            yield now, "stage", Stage(
                stamp_ns=now,
                command_insertion_m=insertion, command_roll_rad=roll, command_knob_rad=knob,
                encoder_insertion_m=insertion, encoder_roll_rad=roll, encoder_knob_rad=knob,
            )  # fmt: skip
            force = plant.measured_wrench()[0] + rig.force_sensor.noise_N * rng.standard_normal(3)
            yield now, "force/sensor", ForceSensor(stamp_ns=now, arrival_ns=now, force_N=tuple(map(float, force)))
        if ms % 25 == 0:
            for tool, topic in enumerate(("pose/tip", "pose/shaft")):
                yield now + 30_000_000, topic, _pose(plant, rig, tool, now, rng)


def _pose(plant: Plant, rig: Rig, tool: int, now_ns: int, rng: np.random.Generator) -> Pose:
    shown = plant.measured_pose(tool)
    position = shown.position_m + rig.tracker.position_noise_m * rng.standard_normal(3)
    quaternion = shown.quaternion_wxyz + 0.5 * rig.tracker.orientation_noise_rad * rng.standard_normal(4)
    return Pose(
        stamp_ns=now_ns, arrival_ns=now_ns + 30_000_000, frame=now_ns // 25_000_000 - 1, missing=rng.random() < 0.02,
        position_m=tuple(map(float, position)), quaternion_wxyz=tuple(map(float, quaternion / np.linalg.norm(quaternion))),
    )  # fmt: skip


def record(task: Task, board: str = "native") -> Frames:
    """Run the simulated rig and return what a watch would receive: the costly part of the study."""
    rig = load_rig(SIMULATED_RIG)
    collector = FrameCollector(rig, 2.0 * task.seconds + 120.0)
    if task.job == HAND:
        return _recorded_by_hand(task, rig, collector)
    arrived: list[int] = []
    armed: list[int] = []
    with forkable_board(board) as made:
        world = World(rig, simulated_plant(rig, task.seed, effects=effect_of(task)), made, task.seed)

        def received(topic: str, message: Message) -> None:
            if isinstance(message, RigState) and not armed and is_armed(message):
                armed.append(message.stamp_ns)
            collector.receive(topic, message)
            if topic == "pose/shaft":
                arrived.extend([world.now_ns] * collector.settle())

        scenario = Scenario(rig, world, received)
        if task.job == PRESS:
            scenario.press(ContactJob(target_m=TARGET_M, force_N=0.2, hold_s=task.seconds))
        else:
            scenario.arm()
            control: Any = SimulatedCommands(scenario)
            perform(round_trip(rig, task.seconds), control)
    return Frames(armed[0], np.array(collector.stamps_ns), np.array(arrived), np.array(collector.rows))


def tracker_noise(rig: Rig, seed: int, count: int) -> Array:
    """Return what the simulated tracker of a world with `seed` adds to `count` frames.

    Shape (count, 2, 7): of tip and shaft, quaternion (scalar first) and position (mm), tracker's frame.
    """
    with forkable_board("native") as board:
        tracker = World(rig, simulated_plant(rig, seed), board, seed).tracker
    none = (np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    found = []
    for _ in range(count):
        tracker.sample(tracker.next_frame_ns, [none, none])
        tools = tracker.frames_until(tracker.next_frame_ns + SECOND_NS)[-1].tools
        found.append([(tools[handle].pose or ())[:7] for handle in tracker.config.handles])
    return np.array(found, float)


def with_noise(frames: Frames, rig: Rig, seed: int, fresh: int) -> Frames:
    """Return a run of `seed` with the tracker's noise of seed `fresh` in place of its own; motions and forces are the same.

    A replay costs a few percent of a run. It tests the watch against sensor noise, not against motions.
    """
    number = np.rint(frames.stamps_ns * 1e-9 * rig.tracker.rate_hz).astype(int)
    old, new = (tracker_noise(rig, s, int(number[-1]) + 1)[number] for s in (seed, fresh))
    turn = rotation(np.array(rig.tracker.base_from_tracker_wxyz))
    rows = frames.rows.copy()
    for tool, first in enumerate((COLUMNS.index(TIP[0]), COLUMNS.index(SHAFT[0]))):
        rows[:, first : first + 3] += 1e-3 * (new[:, tool, 4:] - old[:, tool, 4:]) @ turn.T
        back = old[:, tool, :4] * (1.0, -1.0, -1.0, -1.0)
        pose = zip(rows[:, first + 3 : first + 7], back, new[:, tool, :4], strict=True)
        rows[:, first + 3 : first + 7] = [quaternion_product(quaternion_product(q, a), b) for q, a, b in pose]
    return replace(frames, rows=rows)


def _recorded_by_hand(task: Task, rig: Rig, collector: FrameCollector) -> Frames:
    arrived: list[int] = []
    coming = by_hand(rig, effect_of(task), task.seconds, task.seed)
    for arrival_ns, topic, message in sorted(coming, key=lambda item: item[0]):
        collector.receive(topic, message)
        if topic == "pose/shaft":
            arrived.extend([arrival_ns] * collector.settle())
    return Frames(0, np.array(collector.stamps_ns), np.array(arrived), np.array(collector.rows))


def judge(task: Task, frames: Frames) -> LiveRow:
    """Let a watch see the run as it came in."""
    watch, alarms, scores = Watch(load_rig(SIMULATED_RIG)), [], [0.0]
    for stamp_ns, arrived_ns, row in zip(frames.stamps_ns.tolist(), frames.arrived_ns.tolist(), frames.rows, strict=True):
        if arrived_ns >= frames.armed_ns:
            watch.arm(frames.armed_ns)
        watch.frames.append(stamp_ns, row)
        alarm = watch.look()
        alarms.extend([_alarm(alarm, arrived_ns)] if alarm else [])
        scores.append(watch.score)
    return LiveRow(task, int(frames.arrived_ns[-1]) * 1e-9, tuple(alarms), max(scores), _ratio(watch))


def _alarm(alarm: Alarm, arrived_ns: int) -> dict[str, Any]:
    return {
        "at_s": arrived_ns * 1e-9,
        "since_s": alarm.since_ns * 1e-9,
        "subsystem": alarm.subsystem,
        "effect": alarm.effect,
        "probability": alarm.probability,
        "words": alarm.words,
    }


def _ratio(watch: Watch) -> float:
    """Largest RMS residual of an output over the run's last seconds, relative to the usual one; NaN if it never learned."""
    if watch.charts is None:
        return math.nan
    usual = watch.charts.usual
    residual = watch._residual(-watch._rows(LAST_S))[1] - usual.mean[:, None]
    good = np.mean(np.isfinite(residual), axis=1) > 0.3
    rms = np.sqrt(np.nanmean(np.where(np.isfinite(residual), residual, np.nan) ** 2, axis=1))
    return float(np.max(np.where(good, rms / usual.rms, 0.0)))


def tasks(
    quiet_s: float, planted: int, fresh_s: float = 0.0, only: str = "", jobs: Sequence[str] = (PRESS, ROUND)
) -> Iterator[Task]:
    """All runs but the doubled ones: each effect once; `planted` of other sizes, and quiet_s (s) without an effect in each
    job, in turn; then fresh_s (s) of each job with fresh noise of the tracker on the recorded runs without an effect.
    """
    cases = [(name, job) for name, job, _ in CASES if job in jobs]
    for name, job in cases:
        if only in name:
            yield Task("default", name, job, 1, HOLD_S)
    if only:
        return
    chunks = math.ceil(quiet_s / CHUNK_S)
    quiet = [Task("quiet", "", jobs[k % len(jobs)], k + 1, quiet_s / chunks) for k in range(len(jobs) * chunks)]
    for k in range(max(planted, len(quiet))):
        if k < planted:
            name, job = cases[k % len(cases)]
            size = float(np.exp(np.random.default_rng([31, k]).uniform(np.log(0.7), np.log(2.0))))
            yield Task("planted", name, job, 100 + k, HOLD_S, round(size, 3))
        yield from quiet[k : k + 1]
    first = [task for task in quiet[: len(jobs)] if task.job != HAND]  # one run of each job is enough to test the noise
    for k in range(len(first) * math.ceil(fresh_s / CHUNK_S)):
        yield replace(first[k % len(first)], part="fresh", noise=FRESH_SEED + k)


def doubled(row: LiveRow) -> Task | None:
    """The run whose residual is DOUBLE the usual one, from that of the default size; None where that one shows nothing.

    The effect's part grows with its size and adds to the usual residual by its square.
    """
    part = math.sqrt(max(row.residual_ratio**2 - 1.0, 0.0))
    if not part > 0.2:
        return None
    size = math.sqrt(DOUBLE**2 - 1.0) / part
    return replace(row.task, part="doubled", seed=row.task.seed + 1, size=round(size, 3))


def table(rows: Sequence[LiveRow]) -> str:
    """Return the table of docs/live.md as markdown."""
    head = "| planted | job | seed | size | residual, of the usual | alarm (s after) | named | also possible |"
    return "\n".join([head, "|---|---|---|---|---|---|---|---|", *(row.line for row in rows)])


def quiet_line(rows: Sequence[LiveRow]) -> str:
    """Return a line with the number of alarms without an effect, by job, and the largest score."""
    parts = []
    for job in dict.fromkeys(row.task.job for row in rows):
        mine = [row for row in rows if row.task.job == job]
        hours, alarms = sum(row.seconds for row in mine) / 3600.0, sum(len(row.alarms) for row in mine)
        parts.append(f"{job} {alarms} alarms in {hours:.2f} hours ({len(mine)} runs)")
    highest = max(row.highest for row in rows)
    what = "Without any effect, fresh noise of the tracker on recorded runs" if rows[0].task.noise else "Without any effect"
    return f"{what}: {'; '.join(parts)}; largest score {highest:.2f} of 1."


def doubled_line(rows: Sequence[LiveRow]) -> str:
    """Delay of the alarms where the residual is about twice the usual one."""
    late = [row.delay_s for row in rows if row.delay_s is not None]
    in_time = sum(delay <= WITHIN_S for delay in late)
    middle = f", median {np.median(late):.1f} s" if late else ""
    return (
        f"Effects of {DOUBLE:g} times the usual residual: {in_time} of {len(rows)} reported within {WITHIN_S:g} s, "
        f"{len(rows) - len(late)} not reported{middle}."
    )


def planted_line(rows: Sequence[LiveRow]) -> str:
    """Return a line with the number of alarms that named a wrong subsystem."""
    reported = [row for row in rows if row.first]
    wrong = sum(row.wrong for row in reported)
    right = sum(bool(r.first) and r.task.planted.startswith(f"{r.first['effect']}@") for r in reported if r.first)
    return (
        f"Planted runs of other seeds and sizes: {len(rows)}; {len(reported)} reported, {wrong} of them with a wrong "
        f"subsystem; {right} name the planted effect. The table lists those that are not reported or name a wrong subsystem."
    )


def summary(rows: Sequence[LiveRow]) -> str:
    """The page's text: one line for each figure, one table."""
    lines: tuple[tuple[str, Callable[[Sequence[LiveRow]], str]], ...] = (
        ("quiet", quiet_line), ("fresh", quiet_line), ("doubled", doubled_line), ("planted", planted_line)
    )  # fmt: skip
    by = {part: [row for row in rows if row.task.part == part] for part in ("default", *(part for part, _ in lines))}
    parts = [line(by[part]) for part, line in lines if by[part]]
    failed = [row for row in by["planted"] if row.wrong or row.first is None]
    shown = [*by["default"], *by["doubled"], *failed]
    return "\n\n".join([*parts, *([table(shown)] if shown else [])])


def write_docs(path: Path, text: str) -> None:
    """`text` between the marks of `path`. Raises ValueError where they are missing."""
    page = path.read_text(encoding="utf-8")
    if BEGIN not in page or END not in page:
        raise ValueError(f"{path}: found no marks {BEGIN} and {END}, wanted both")
    before, after = page.split(BEGIN)[0], page.split(END)[1]
    path.write_text(f"{before}{BEGIN}\n{text}\n{END}{after}", encoding="utf-8")


class Book:
    """Recorded runs in a folder. A run that is not there yet is made; the watch judges each run again at each call."""

    def __init__(self, folder: Path | None, board: str, only_recorded: bool = False) -> None:
        """Keep nothing if `folder` is None; make no run if `only_recorded`."""
        self._folder, self._board, self._only_recorded = folder, board, only_recorded

    def row(self, task: Task) -> LiveRow | None:
        """Return the judged run of `task`; None for a run that is not recorded and must not be made."""
        path = self._folder / task.file if self._folder else None
        if path and path.exists():
            frames = Frames.load(path)
        elif self._only_recorded:
            return None
        else:
            frames = record(task, self._board)
            if path:
                frames.save(path)
        if task.noise:
            frames = with_noise(frames, load_rig(SIMULATED_RIG), task.seed, task.noise)
        row = judge(task, frames)
        print(row.line if task.planted else quiet_line([row]), file=sys.stderr, flush=True)
        return row


def main(arguments: list[str] | None = None) -> None:
    """Run the study and print, or write, its text."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quiet-hours", type=float, default=120.0 / 3600.0, help="hours without an effect, in each job")
    parser.add_argument("--fresh-hours", type=float, default=0.0, help="hours of them with fresh noise of the tracker")
    parser.add_argument(
        "--planted", type=int, default=0, help="further runs with effects of 0.7 to 2 times the default size"
    )
    parser.add_argument("--doubled", action="store_true", help="also every effect at twice the usual residual")
    parser.add_argument(
        "--jobs", nargs="+", choices=JOBS, default=[PRESS, ROUND], help="hand: the catheter without the loop"
    )
    parser.add_argument("--only", default="", help="only effects whose name holds this")
    parser.add_argument("--board", default="native")
    parser.add_argument("--out", type=Path, help="folder of recorded runs, to go on with")
    parser.add_argument("--recorded", action="store_true", help="judge the runs in --out; make no further ones")
    parser.add_argument("--docs", type=Path, help="page whose text of all jobs is to be written")
    given = parser.parse_args(arguments)
    if given.docs is not None and set(given.jobs) != set(JOBS):  # the text is replaced as a whole
        parser.error(f"argument --docs: found --jobs {' '.join(given.jobs)}, wanted --jobs {' '.join(JOBS)}")
    book = Book(given.out, given.board, given.recorded)
    parts = []
    for title, jobs in (("In lock step", (PRESS, ROUND)), ("By hand", (HAND,))):
        rows: list[LiveRow] = []
        wanted = [job for job in jobs if job in given.jobs]
        hours = 3600.0 * given.quiet_hours, 3600.0 * given.fresh_hours
        for task in tasks(hours[0], given.planted, hours[1], given.only, wanted) if wanted else ():
            row = book.row(task)
            again = doubled(row) if row and given.doubled and task.part == "default" else None
            rows += [found for found in (row, book.row(again) if again else None) if found]
        parts += [f"**{title}.**", summary(rows)] if rows else []
    text = "\n\n".join(parts)
    print(text)
    if given.docs is not None:
        write_docs(given.docs, text)


if __name__ == "__main__":
    main()
