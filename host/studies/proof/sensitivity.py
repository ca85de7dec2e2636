"""Each threshold of the finder moved by 20 %, down and up: which verdicts of a finished run change, and for better or worse.

python -m host.studies.proof.sensitivity --dir runs/prove_SEED --cases ode/0005 own/0024 --out m.jsonl --docs docs/proof.md

A rule that a case does not read cannot change its verdict and is not tried there. Results are appended to `--out` rule by
rule; the same call continues a run that was stopped.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from host.diagnosis import diagnose
from host.diagnosis.estimation.rules import RULES, SelectionRules
from host.diagnosis.model.data_rules import DataRules
from host.studies.proof.page import write_between
from host.studies.proof.scoring import judge
from host.studies.proof.worlds.suite import read_labels
from protocol.errors import InputError
from protocol.worker_process import end_with_parent
from sim.concealed.label import Label

BY = 0.2  # relative
NAMES = frozenset(RULES.as_dict())


@dataclass(frozen=True)
class LabelledCase:
    """One case of a finished run."""

    world: str
    label: Label
    folder: Path

    @property
    def name(self) -> str:
        """Name in `--cases` and in the table, such as ode/0005."""
        return f"{self.world}/{self.label['id'].removeprefix('case_')}"


@dataclass(frozen=True)
class Change:
    """One rule at another value."""

    rule: str
    value: float

    def applied(self) -> SelectionRules:
        """All rules, with this one changed."""
        return RULES.changed(**{self.rule: self.value})


class _Notes:
    """Rules that note which of them are read, other than to copy or print all of them."""

    read: ClassVar[set[str]] = set()  # of the process, which makes one diagnosis at a time

    def __getattribute__(self, name: str) -> Any:
        if name in NAMES and sys._getframe(1).f_globals.get("__name__") != "dataclasses":
            _Notes.read.add(name)
        return super().__getattribute__(name)


class _NotedData(_Notes, DataRules):
    pass


class _Noted(_Notes, SelectionRules):
    pass


def values_of(value: float) -> tuple[float, float]:
    """A fifth less and a fifth more; of a whole number at least one less and one more.

    A share that a fifth more would bring above one comes a fifth nearer to one.

    Examples:
        >>> values_of(6.0), values_of(10), values_of(2), values_of(0.95)
        ((4.8, 7.2), (8, 12), (1, 3), (0.76, 0.96))
    """
    if isinstance(value, int):
        return min(math.floor((1.0 - BY) * value), value - 1), max(math.ceil((1.0 + BY) * value), value + 1)
    share = value < 1.0 < (1.0 + BY) * value
    more = 1.0 - (1.0 - BY) * (1.0 - value) if share else (1.0 + BY) * value
    return round((1.0 - BY) * value, 12), round(more, 12)


def changes() -> list[Change]:
    """Every rule at both of its other values."""
    return [Change(rule, value) for rule, now in RULES.as_dict().items() for value in values_of(now)]


def read_cases(run: Path, names: Sequence[str]) -> list[LabelledCase]:
    """Return cases of a finished run by name, `world/number`. Raises InputError for others, OSError without labels."""
    every = {}
    for world in dict.fromkeys(name.partition("/")[0] for name in names):
        for label in read_labels(run / world / "sealed" / "labels.json"):
            case = LabelledCase(world, label, run / world / "cases" / label["id"])
            every[case.name] = case
    for name in names:
        if name not in every:
            raise InputError("--cases", name, "world/number of a case of the run, such as ode/0005")
    return [every[name] for name in names]


def verdict_of(case: LabelledCase, change: Change | None) -> dict[str, Any]:
    """Line of results: what is named with which probability, whether it is right, and which rules were read."""
    _Notes.read.clear()
    rules = _Noted(_NotedData()) if change is None else change.applied()
    recordings = sorted(path for path in case.folder.iterdir() if path.name != "nominal.toml")
    said = diagnose(recordings, case.folder / "nominal.toml", rules=rules).as_dict()
    effects = [(f"{effect['id']}@{effect['subsystem']}", effect["probability"]) for effect in said["effects"]]
    line = {"case": case.name, "verdict": said["verdict"], "effects": effects, "right": judge(case.label, said).right}
    if change is None:
        return line | {"rule": "", "read": sorted(_Notes.read)}
    return line | {"rule": change.rule, "value": change.value}


def measure(cases: Sequence[LabelledCase], out: Path, jobs: int) -> list[dict[str, Any]]:
    """Lines of results, old and new."""
    lines = [json.loads(text) for text in out.read_text(encoding="utf-8").splitlines()] if out.exists() else []
    done = {(line["case"], line["rule"], line.get("value")) for line in lines}
    with ProcessPoolExecutor(max_workers=jobs, initializer=end_with_parent) as executor, out.open("a") as file:

        def run(tasks: Iterable[tuple[LabelledCase, Change | None]]) -> Iterator[dict[str, Any]]:
            todo = [
                (case, change)
                for case, change in tasks
                if (case.name, change.rule if change else "", change.value if change else None) not in done
            ]
            for number, line in enumerate(executor.map(verdict_of, *zip(*todo, strict=True)) if todo else (), 1):
                file.write(json.dumps(line) + "\n")
                file.flush()
                print(f"\r{number}/{len(todo)} {line['case']} {line['rule']:40s}", end="", file=sys.stderr)
                yield line

        lines += run((case, None) for case in cases)
        as_is = {line["case"]: line for line in lines if not line["rule"]}
        lines += run((case, change) for change in changes() for case in cases if change.rule in as_is[case.name]["read"])
    return lines


def named(line: dict[str, Any]) -> tuple[str, frozenset[str]]:
    """What a verdict states, without probabilities."""
    return line["verdict"], frozenset(name for name, _ in line["effects"])


def block(lines: Sequence[dict[str, Any]], run: Path) -> str:
    """Return the generated text: what the change of each rule does, and which rules no case reads."""
    as_is = {line["case"]: line for line in lines if not line["rule"]}
    seed = json.loads((run / "suite.json").read_text(encoding="utf-8"))["seed"]
    right = sum(line["right"] for line in as_is.values())
    read = set().union(*(line["read"] for line in as_is.values()))
    rows = ["| rule | value | 20 % less | 20 % more | probability |", "|---|---|---|---|---|"]
    same = []
    for rule, now in RULES.as_dict().items():
        moved = [[line for line in lines if line["rule"] == rule and line["value"] == value] for value in values_of(now)]
        cells = [_cell(each, as_is) for each in moved]
        most = max((_shift(line, as_is[line["case"]]) for each in moved for line in each), default=0.0)
        if cells != [NOTHING, NOTHING] or most >= VISIBLE:
            rows.append(f"| `{rule}` | {now:g} | {cells[0]} | {cells[1]} | {most:.2f} |")
        elif rule in read:
            same.append(rule)
    worlds = dict.fromkeys(name.partition("/")[0] for name in as_is)
    counts = ", ".join(f"{sum(name.partition('/')[0] == world for name in as_is)} of `{world}`" for world in worlds)
    unread = [rule for rule in RULES.as_dict() if rule not in read]
    return "\n\n".join(
        [
            f"Seed {seed}, {len(as_is)} cases ({counts}). With the rules as they are, {right} verdicts are right. A cell "
            "lists the cases whose names change: `+` right only then, `-` right only before, `~` both or neither. The last "
            "column is the largest change of an effect's stated probability.",
            "\n".join(rows),
            f"With {len(same)} other rules no name changes, and no probability by {VISIBLE:g}: {_listed(same)}.",
            f"None of these cases reads the other {len(unread)} rules: {_listed(unread)}.",
        ]
    )


NOTHING = "none"
VISIBLE = 0.01  # change of a probability


def _listed(rules: Sequence[str]) -> str:
    return ", ".join(f"`{rule}`" for rule in rules) or NOTHING


def _cell(lines: Sequence[dict[str, Any]], as_is: dict[str, dict[str, Any]]) -> str:
    said = []
    for line in lines:
        before = as_is[line["case"]]
        if named(line) != named(before):
            sign = "~" if line["right"] == before["right"] else "+" if line["right"] else "-"
            said.append(f"{sign}{line['case']}")
    return ", ".join(said) or NOTHING


def _shift(line: dict[str, Any], before: dict[str, Any]) -> float:
    """Largest change of the probability of an effect that is named both times."""
    now, then = dict(map(tuple, line["effects"])), dict(map(tuple, before["effects"]))
    return max((abs(now[name] - then[name]) for name in now if name in then), default=0.0)


def main(arguments: Sequence[str] | None = None) -> None:
    """Change every rule and write the table."""
    parser = argparse.ArgumentParser(prog="python -m host.studies.proof.sensitivity")
    parser.add_argument("--dir", type=Path, required=True, help="folder of a finished run of `seldinger prove`")
    parser.add_argument("--cases", nargs="+", required=True, help="world/number, such as ode/0005")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, required=True, help="results, one JSON object a line")
    parser.add_argument("--docs", type=Path, help="page whose table is replaced")
    given = parser.parse_args(arguments)
    lines = measure(read_cases(given.dir, given.cases), given.out, given.jobs)
    text = block(lines, given.dir)
    if given.docs is None:
        print(text)
    else:
        write_between(given.docs, text, "sensitivity")


if __name__ == "__main__":
    main()
