"""Write the tables of the worlds to docs/proof.md: as the finder states its probabilities, and leaving one world out.

python -m host.studies.proof.page --dir runs/prove_JUDGED --calibrate-on runs/prove_OTHER --docs docs/proof.md
python -m host.studies.proof.page --dir runs/prove_JUDGED --together runs/prove_BEFORE     # and a table of both runs
python -m host.studies.proof.page --dir runs/prove_JUDGED --world domains --docs docs/proof.md    # one world: a short table
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from host.studies.proof import table
from host.studies.proof.calibrate import calibrated, read_run
from host.studies.proof.calibration import Calibration, as_stated
from host.studies.proof.scoring import Facts, judge
from host.studies.proof.worlds.suite import OWN


def scored(run: Path, world: str, calibrate: Calibration) -> list[Facts]:
    """Return the facts of one world's cases, without equations."""
    return [judge(label, verdict, calibrate=calibrate) for label, verdict in read_run(run)[world]]


def block(run: Path, others: Sequence[Path]) -> str:
    """Return the generated text: both tables, reliability, and every case that was not right."""
    note = json.loads((run / "suite.json").read_text(encoding="utf-8"))
    worlds = note["worlds"]
    stated = {world: scored(run, world, as_stated) for world in worlds}
    counts = {world: len(facts) for world, facts in stated.items()}
    short = [f"{count} of {world}" for world, count in counts.items() if count < note["cases"]]
    stopped = f" The run was stopped before its end: {', '.join(short)} have a verdict." if short else ""
    parts = [
        f"Seed {note['seed']}, {note['cases']} cases of each world.{stopped} As the finder states its probabilities:",
        _table(stated),
    ]
    used = stated
    if others:
        used = {world: scored(run, world, calibrated(others, [world])) for world in worlds}
        seeds = ", ".join(str(json.loads((o / "suite.json").read_text(encoding="utf-8"))["seed"]) for o in others)
        parts += [
            f"Leaving one world out: each world with probabilities calibrated on the other worlds of seed {seeds}:",
            _table(used),
        ]
    parts += [_reliability(used), "Cases that were not right:", _failures(run)]
    return "\n\n".join(parts)


def _table(facts: dict[str, list[Facts]]) -> str:
    tables = {world: table.tabulate(found) for world, found in facts.items()}
    return table.worlds_markdown(tables, {world: table.shares(found) for world, found in facts.items()}, OWN)


def _reliability(facts: dict[str, list[Facts]]) -> str:
    shares = table.reliability_markdown({world: table.reliability(found) for world, found in facts.items()})
    return f"Stated probability against frequency:\n\n{shares}"


def together(runs: Sequence[Path]) -> str:
    """Return one table of all cases of several runs, as the finder of each run states its probabilities."""
    facts: dict[str, list[Facts]] = {}
    notes = [json.loads((run / "suite.json").read_text(encoding="utf-8")) for run in runs]
    for run, note in zip(runs, notes, strict=True):
        for world in note["worlds"]:
            facts.setdefault(world, []).extend(scored(run, world, as_stated))
    counts = ", ".join(f"{len(found)} cases of {world}" for world, found in facts.items())
    title = f"Seeds {' and '.join(dict.fromkeys(str(note['seed']) for note in notes))} together, {counts}:"
    return "\n\n".join((title, _table(facts), _reliability(facts)))


def world_block(run: Path, world: str) -> str:
    """Return the generated text about one world: what was drawn and right by category, and every case that was not right.

    A wrong name is an effect that is not true, with the probability that the finder states.
    """
    note = json.loads((run / "suite.json").read_text(encoding="utf-8"))
    judged = [(label, judge(label, verdict)) for label, verdict in read_run(run)[world]]
    lines = ["| category | drawn | right | a wrong name with a probability of 0.9 or more |", "|---|---|---|---|"]
    for category in ("null", "single", "pair", "outside"):
        facts = [f for label, f in judged if label["category"] == category]
        lines.append(f"| {category} | {len(facts)} | {sum(f.right for f in facts)} | {sum(f.wrong for f in facts)} |")
    facts = [f for _, f in judged]
    lines.append(f"| all | {len(facts)} | {sum(f.right for f in facts)} | {sum(f.wrong for f in facts)} |")
    head = f"Seed {note['seed']}, {len(judged)} of {note['cases']} cases:"
    return "\n\n".join([head, "\n".join(lines), "Cases that were not right:", _failures(run, (world,))])


def _failures(run: Path, worlds: Sequence[str] = ()) -> str:
    lines = ["| world | case | kind | planted | rho | verdict |", "|---|---|---|---|---|---|"]
    for world, judged in read_run(run).items():
        for label, verdict in judged:
            if (worlds and world not in worlds) or judge(label, verdict).right:
                continue
            named = ", ".join(_effect(e) for e in verdict.get("effects") or [])
            failed = str(verdict.get("error") or "").partition("; the traceback")[0]  # that names a file of one machine
            said = failed or f"{str(verdict.get('verdict')).replace('_', ' ')} {named}".strip()
            kind = f"{label['kind']}, {'closed' if label['closed_loop'] else 'open'}"
            truth = " + ".join(label["truth"]) or "nothing"
            if wanted := label.get("findings"):
                truth += f", finding {', '.join(wanted)}"
                stated = dict.fromkeys(str(f.get("id")) for f in verdict.get("data_findings") or [])
                said += f"; findings: {', '.join(stated) or 'none'}"
            lines.append(f"| {world} | {label['id'][5:]} | {kind} | {truth} | {label['rho']:.2f} | {said} |")
    return "\n".join(lines)


def _effect(effect: dict[str, Any]) -> str:
    """Return id, place and stated probability of an effect."""
    p = effect.get("probability")
    return f"{effect.get('id')}@{effect.get('subsystem')}" + (f" ({p:.2f})" if isinstance(p, (int, float)) else "")


def write_between(page: Path, text: str, mark: str = "worlds") -> None:
    """Put `text` between the marks `mark` of `page`. Raises ValueError where they are missing."""
    content = page.read_text(encoding="utf-8")
    begin, end = f"<!-- {mark} begin -->", f"<!-- {mark} end -->"
    if begin not in content or end not in content:
        raise ValueError(f"{page}: found no marks {begin} and {end}, wanted both")
    page.write_text(f"{content.split(begin)[0]}{begin}\n{text}\n{end}{content.split(end)[1]}", encoding="utf-8")


def main(arguments: Sequence[str] | None = None) -> None:
    """Score a finished run and write or print its tables."""
    parser = argparse.ArgumentParser(prog="python -m host.studies.proof.page")
    parser.add_argument("--dir", type=Path, nargs="+", required=True, help="folders of judged runs, in this order")
    parser.add_argument("--calibrate-on", type=Path, action="append", default=[], help="folder of another finished run")
    parser.add_argument("--together", type=Path, nargs="+", default=[], help="further runs: a table of all comes first")
    parser.add_argument("--world", help="only this world, in a short form between marks of its name")
    parser.add_argument("--docs", type=Path, help="page whose block is to be written; else it is printed")
    given = parser.parse_args(arguments)
    runs = given.dir
    text = "\n\n".join(world_block(run, given.world) if given.world else block(run, given.calibrate_on) for run in runs)
    if given.together:
        text = f"{together([*given.together, *runs])}\n\n{text}"
    if given.docs is None:
        print(text)
    else:
        write_between(given.docs, text, given.world or "worlds")


if __name__ == "__main__":
    main()
