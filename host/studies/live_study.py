"""Alarms of the live watch in virtual time: false ones, their delay, and the subsystem that they name; for docs/live.md.

    python -m host.studies.live_study        # the short form: minutes
    make live-study                          # 5 hours of each job, 60 planted runs; continues a stopped study

Every run is the simulated rig in lock step: a seed decides it. `--out` keeps one line of JSON for every finished run.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from host.commissioning.experiment_script import Script, perform
from host.diagnosis.live.watch import Watch
from host.run.experiment_run import SimulatedCommands
from protocol.rig_file import SIMULATED_RIG, Rig, load_rig
from protocol.topics import Alarm, Message
from sim.board import SimulatedBoard
from sim.effects import PlantedEffect, describe, parse
from sim.scenario import TARGET_M, ContactJob, Scenario
from sim.world import World, simulated_plant

ON_S, HOLD_S = 25.0, 32.0
CHUNK_S = 600.0  # length of one run without an effect: a rig is armed several times a day
LAST_S = 8.0  # end of a run over which the residual is compared with the usual one
DOUBLE = 2.0  # residual with an effect relative to the usual one, for the alarm's delay
WITHIN_S = 3.0  # of its begin an effect of that size is to be reported
PRESS, ROUND = "press", "round"
# effect, job, and the parameters that grow with its size
CASES = (
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
BEGIN, END = "<!-- live_study begin -->", "<!-- live_study end -->"


@dataclass(frozen=True)
class Task:
    """One run to do. `planted` is empty for none; `size` multiplies the default; `part` is what it counts for."""

    part: str  # quiet, default, doubled, planted
    planted: str
    job: str
    seed: int
    seconds: float
    size: float = 1.0

    @property
    def key(self) -> str:
        """Return the key of the run in the file of finished ones (a doubled run's size follows from another run)."""
        return "|".join((self.part, self.planted, self.job, str(self.seed), f"{self.seconds:g}"))


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
    def line(self) -> str:
        """Return the row of the table for this task."""
        name, job = self.task.planted, self.task.job
        size = f"{self.task.size:.2g}"
        if self.first is None:
            score = f"no alarm; largest score {self.highest:.2f} of 1"
            return f"| {name} | {job} | {size} | {self.residual_ratio:.1f} | {score} | | |"
        others = re.search(r"\(indistinguishable from (.*?)\)", self.first["words"])
        named = f"{self.first['subsystem']}: {self.first['effect'].replace('_', ' ')}"
        also = others[1].replace("_", " ") if others else ""
        return f"| {name} | {job} | {size} | {self.residual_ratio:.1f} | {self.delay_s:.1f} | {named} | {also} |"


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
    if "ratio" in values:  # of the two directions: 1 is no effect
        values["ratio"] = 1.0 - task.size * (1.0 - defaults["ratio"])
    return (replace(plain, parameters=values, start_s=ON_S),)


def run(task: Task, board: str = "native") -> LiveRow:
    """The watch on one run of the simulated rig."""
    rig = load_rig(SIMULATED_RIG)
    watch, alarms, scores = Watch(rig), [], [0.0]
    with SimulatedBoard(board) as made:
        world = World(rig, simulated_plant(rig, task.seed, effects=effect_of(task)), made, task.seed)

        def received(topic: str, message: Message) -> None:
            watch.receive(topic, message)
            if topic == "pose/shaft":
                alarm = watch.look()
                alarms.extend([alarm] if alarm else [])
                scores.append(watch.score)

        scenario = Scenario(rig, world, received)
        if task.job == PRESS:
            scenario.press(ContactJob(target_m=TARGET_M, force_N=0.2, hold_s=task.seconds))
        else:
            scenario.arm()
            control: Any = SimulatedCommands(scenario)
            perform(round_trip(rig, task.seconds), control)
        return LiveRow(task, world.now_ns * 1e-9, tuple(map(_alarm, alarms)), max(scores), _ratio(watch))


def _alarm(alarm: Alarm) -> dict[str, Any]:
    return {
        "at_s": alarm.stamp_ns * 1e-9,
        "since_s": alarm.since_ns * 1e-9,
        "subsystem": alarm.subsystem,
        "effect": alarm.effect,
        "words": alarm.words,
    }


def _ratio(watch: Watch) -> float:
    """Largest RMS residual of an output over the run's last seconds, relative to the usual one; NaN if it never learned."""
    if watch.baseline is None:
        return math.nan
    residual = watch._residual(-watch._rows(LAST_S))[1]
    good = np.mean(np.isfinite(residual), axis=1) > 0.3
    rms = np.sqrt(np.nanmean(np.where(np.isfinite(residual), residual, np.nan) ** 2, axis=1))
    return float(np.max(np.where(good, rms / watch.baseline.rms, 0.0)))


def tasks(quiet_s: float, planted: int, only: str = "") -> Iterator[Task]:
    """All runs but the doubled ones: quiet_s without an effect in each job, each effect once, `planted` of other sizes."""
    for name, job, _ in CASES:
        if only in name:
            yield Task("default", name, job, 1, HOLD_S)
    if only:
        return
    chunks = max(1, math.ceil(quiet_s / CHUNK_S))
    for seed in range(1, chunks + 1):
        for k, job in enumerate((PRESS, ROUND)):
            yield Task("quiet", "", job, 2 * seed + k - 1, quiet_s / chunks)
    for k in range(planted):
        name, job, _ = CASES[k % len(CASES)]
        size = float(np.exp(np.random.default_rng([31, k]).uniform(np.log(0.7), np.log(2.0))))
        yield Task("planted", name, job, 100 + k, HOLD_S, round(size, 3))


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
    head = "| planted | job | size | residual, of the usual | alarm (s after) | named | also possible |"
    return "\n".join([head, "|---|---|---|---|---|---|---|", *(row.line for row in rows)])


def quiet_line(rows: Sequence[LiveRow]) -> str:
    """Return a line with the number of alarms without an effect, by job."""
    parts = []
    for job in dict.fromkeys(row.task.job for row in rows):
        mine = [row for row in rows if row.task.job == job]
        hours, alarms = sum(row.seconds for row in mine) / 3600.0, sum(len(row.alarms) for row in mine)
        parts.append(f"{job} {alarms} alarms in {hours:.2f} hours ({len(mine)} runs)")
    highest = max(row.highest for row in rows)
    return f"Without any effect: {'; '.join(parts)}; largest score {highest:.2f} of 1."


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
    wrong = [row for row in reported if row.first and row.first["subsystem"] != row.task.planted.partition("@")[2]]
    listed = ", ".join(f"{r.task.planted} as {r.first['subsystem']}" for r in wrong if r.first)
    return (
        f"Planted runs: {len(rows)}; {len(reported)} reported, {len(wrong)} of them with a wrong subsystem"
        + (f" ({listed})" if listed else "")
        + "."
    )


def summary(rows: Sequence[LiveRow]) -> str:
    """The page's text: one table, one line for each figure."""
    by = {part: [row for row in rows if row.task.part == part] for part in ("default", "doubled", "planted", "quiet")}
    parts = [table([*by["default"], *by["doubled"]])]
    for name, line in (("quiet", quiet_line), ("doubled", doubled_line), ("planted", planted_line)):
        parts += [line(by[name])] if by[name] else []
    return "\n\n".join(parts)


def write_docs(path: Path, text: str) -> None:
    """`text` between the marks of `path`. Raises ValueError where they are missing."""
    page = path.read_text(encoding="utf-8")
    if BEGIN not in page or END not in page:
        raise ValueError(f"{path}: found no marks {BEGIN} and {END}, wanted both")
    before, after = page.split(BEGIN)[0], page.split(END)[1]
    path.write_text(f"{before}{BEGIN}\n{text}\n{END}{after}", encoding="utf-8")


def read_rows(path: Path) -> dict[str, LiveRow]:
    """Finished runs of an earlier call by their keys; a last line that was cut off is left out."""
    found = {}
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
        try:
            content = json.loads(line)
        except ValueError:
            continue
        row = LiveRow(**{**content, "task": Task(**content["task"]), "alarms": tuple(content["alarms"])})
        found[row.task.key] = row
    return found


class Book:
    """Runs tasks that are not yet in `path`, and appends each when it is finished."""

    def __init__(self, path: Path | None, board: str) -> None:
        """Read what is finished; path None keeps nothing."""
        self._path, self._board = path, board
        self.rows = read_rows(path) if path else {}

    def row(self, task: Task) -> LiveRow:
        """Return the finished run of `task`; run it if needed."""
        if task.key not in self.rows:
            row = self.rows[task.key] = run(task, self._board)
            print(row.line if task.planted else quiet_line([row]), file=sys.stderr, flush=True)
            if self._path:
                self._path.parent.mkdir(parents=True, exist_ok=True)
                with self._path.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(asdict(row)) + "\n")
        return self.rows[task.key]


def main(arguments: list[str] | None = None) -> None:
    """Run the study and print, or write, its text."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quiet-hours", type=float, default=120.0 / 3600.0, help="hours without an effect, in each job")
    parser.add_argument(
        "--planted", type=int, default=0, help="further runs with effects of 0.7 to 2 times the default size"
    )
    parser.add_argument("--doubled", action="store_true", help="also every effect at twice the usual residual")
    parser.add_argument("--only", default="", help="only effects whose name holds this")
    parser.add_argument("--board", default="native")
    parser.add_argument("--out", type=Path, help="folder of finished runs, to go on with")
    parser.add_argument("--docs", type=Path, help="page whose text is to be written")
    given = parser.parse_args(arguments)
    book = Book(given.out / "runs.jsonl" if given.out else None, given.board)
    rows = []
    for task in tasks(given.quiet_hours * 3600.0, given.planted, given.only):
        rows.append(book.row(task))
        again = doubled(rows[-1]) if given.doubled and task.part == "default" else None
        rows += [book.row(again)] if again else []
    text = summary(rows)
    print(text)
    if given.docs is not None:
        write_docs(given.docs, text)


if __name__ == "__main__":
    main()
