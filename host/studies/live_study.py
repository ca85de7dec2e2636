"""How fast the live watch raises its alarm, and how often without a cause: the table of docs/live.md.

python -m host.studies.live_study                          # the table of effects, and 120 s without any
python -m host.studies.live_study --quiet-s 1800 --docs docs/live.md
"""

from __future__ import annotations

import argparse
import math
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from host.commissioning.experiment_script import Script, perform
from host.diagnosis.live.watch import Watch
from host.run.experiment_run import VirtualDesk
from protocol.rig_file import SIMULATED_RIG, Rig, load_rig
from protocol.topics import Alarm, Message
from sim.board import Board
from sim.effects import parse
from sim.scenario import TARGET_M, ContactJob, Scenario
from sim.world import World, simulated_plant

ON_S, HOLD_S = 25.0, 32.0
PRESS, ROUND = "press", "round"
CASES = (
    ("backlash@insertion", PRESS),
    ("coulomb_friction@insertion", PRESS),
    ("coupling@knob", PRESS),
    ("latency@pose_sensor", PRESS),
    ("field_distortion@pose_sensor", PRESS),
    ("sensor_bias@force_sensor", PRESS),
    ("base_motion@base", PRESS),
    ("creep_relaxation@shape", PRESS),
    ("asymmetry@roll", PRESS),
    ("asymmetry@roll", ROUND),
    ("whip@roll", ROUND),
)
BEGIN, END = "<!-- live_study begin -->", "<!-- live_study end -->"


@dataclass(frozen=True)
class Row:
    """One run: what was planted and done, alarms, and the largest score of a second that raised none."""

    planted: str
    job: str
    seconds: float
    alarms: list[Alarm]
    highest: float

    @property
    def line(self) -> str:
        """The row of the table."""
        first = next((a for a in self.alarms if a.since_ns * 1e-9 > ON_S - 1.0), None)
        if first is None:
            return f"| {self.planted} | {self.job} | never | never | silent; largest score {self.highest:.2f} of 1 | |"
        others = re.search(r"\(as well may be (.*?)\)", first.words)
        return (
            f"| {self.planted} | {self.job} | {first.since_ns * 1e-9 - ON_S:.1f} | {first.stamp_ns * 1e-9 - ON_S:.1f} "
            f"| {first.subsystem}: {first.effect.replace('_', ' ')} | {others[1].replace('_', ' ') if others else ''} |"
        )


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


def run(planted: str, job: str, hold_s: float, seed: int, board: str = "native") -> Row:
    """The watch on one run of the simulated rig. `planted`: effect of the command line with its default size, or nothing."""
    rig = load_rig(SIMULATED_RIG)
    effects = (parse(f"{planted}{',' if ':' in planted else ':'}start_s={ON_S}"),) if planted else ()
    watch, alarms, scores = Watch(rig), [], [0.0]
    with Board(board) as made:
        world = World(rig, simulated_plant(rig, seed, effects=effects), made, seed)

        def heard(topic: str, message: Message) -> None:
            watch.hear(topic, message)
            if topic == "pose/shaft":
                alarm = watch.look()
                alarms.extend([alarm] if alarm else [])
                scores.append(watch.score)

        scenario = Scenario(rig, world, heard)
        if job == PRESS:
            scenario.press(ContactJob(target_m=TARGET_M, force_N=0.2, hold_s=hold_s))
        else:
            scenario.arm()
            desk: Any = VirtualDesk(scenario)
            perform(round_trip(rig, hold_s), desk)
        return Row(planted or "nothing", job, world.now_ns * 1e-9, alarms, max(scores))


def table(rows: list[Row]) -> str:
    """The page's table."""
    head = "| planted | job | first odd (s after) | alarm (s after) | named | also possible |\n|---|---|---|---|---|---|"
    return "\n".join([head, *(row.line for row in rows)])


def quiet_line(rows: list[Row]) -> str:
    """How often there was an alarm without an effect."""
    hours = sum(row.seconds for row in rows) / 3600.0
    alarms, highest = sum(len(row.alarms) for row in rows), max(row.highest for row in rows)
    each = ", ".join(f"{row.job} seed {k + 1} {row.seconds:.0f} s" for k, row in enumerate(rows))
    return f"Without any effect: {alarms} alarms in {hours:.2f} hours ({each}); largest score {highest:.2f} of 1."


def write_docs(path: Path, text: str) -> None:
    """`text` between the marks of `path`. Raises ValueError where they are missing."""
    page = path.read_text(encoding="utf-8")
    if BEGIN not in page or END not in page:
        raise ValueError(f"{path}: found no marks {BEGIN} and {END}, wanted both")
    before, after = page.split(BEGIN)[0], page.split(END)[1]
    path.write_text(f"{before}{BEGIN}\n{text}\n{END}{after}", encoding="utf-8")


def main(arguments: list[str] | None = None) -> None:
    """Runs the study and prints, or writes, its table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quiet-s", type=float, default=120.0, help="seconds without an effect, half of them in each job")
    parser.add_argument("--only", default="", help="only effects whose name holds this")
    parser.add_argument("--board", default="native")
    parser.add_argument("--docs", type=Path, help="page whose table is to be written")
    given = parser.parse_args(arguments)
    rows = []
    for planted, job in CASES:
        if given.only in planted:
            rows.append(run(planted, job, HOLD_S, 1, given.board))
            print(rows[-1].line, file=sys.stderr, flush=True)
    silent = [run("", job, 0.5 * given.quiet_s, seed, given.board) for seed, job in enumerate((PRESS, ROUND), 1)]
    text = f"{table(rows)}\n\n{quiet_line(silent)}"
    print(text)
    if given.docs is not None:
        write_docs(given.docs, text)


if __name__ == "__main__":
    main()
