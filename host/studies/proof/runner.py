"""The proof from seed to table: generate in a child process, diagnose blindly, open the seal last, list and count."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import savgol_filter

from host.studies.proof import baselines, table, workers
from host.studies.proof.calibration import Calibration, as_stated
from host.studies.proof.scoring import Facts, judge, mean
from host.studies.proof.worlds.suite import OWN
from protocol.errors import InputError
from protocol.requests import plain
from protocol.worker_process import end_with_parent
from sim.concealed.generic import OUTPUTS
from sim.concealed.label import Label

MEASURED = frozenset(name for names in OUTPUTS.values() for name in names)
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Settings:
    """Settings of a run. All results are kept in `folder`, so that the same call continues a stopped run.

    Attributes:
        cases: how many in each world.
        seed: decides every suite.
        folder: gets one folder for each world.
        jobs: processes.
        scheduler: address of a Dask scheduler, or None.
        finder: command, called as `seldinger diagnose` is.
        limit_s: longest time for one case, s.
        with_baselines: also run the baselines, on the project's own world.
        worlds: of `worlds.suite.WORLDS`.
        calibration: table applied to the finder's raw probabilities; None: as the finder states them.
    """

    cases: int
    seed: int
    folder: Path
    jobs: int = 2
    scheduler: str | None = None
    finder: Sequence[str] = workers.FINDER
    limit_s: float = 900.0
    with_baselines: bool = True
    worlds: tuple[str, ...] = (OWN,)
    calibration: Calibration = as_stated


def is_spent(seed: int) -> bool:
    """Whether a suite of `seed` was looked at while finder or generators were built (spent_seeds.toml)."""
    content = tomllib.loads((Path(__file__).parent / "spent_seeds.toml").read_text(encoding="utf-8"))
    return any(seed in group["seeds"] for group in content.values())


def prove(settings: Settings, progress: Progress, announce: Callable[[str], None]) -> dict[str, Any]:
    """The JSON object that `seldinger prove --json` prints (docs/proof.md). Raises InputError, RuntimeError.

    `announce` gets the labels' sha256 before the finder runs.
    With several worlds all seals are announced before the first verdict, and `worlds` holds each one's table.
    """
    _claim(settings)
    digests = {world: generate(settings, world, progress) for world in settings.worlds}
    for world, digest in digests.items():
        announce(digest if len(digests) == 1 else f"{world} {digest}")
    rows: list[dict[str, Any]] = []
    facts: dict[str, list[Facts]] = {}
    compared: dict[str, Any] = {}
    opened = []
    for world, digest in digests.items():
        at = settings.folder / world
        folders = {path.name: path for path in sorted((at / "cases").iterdir())}
        opened.append((world, digest, folders, _diagnosed(settings, at, folders, progress)))
    for world, digest, folders, verdicts in opened:  # only now: no seal is opened before all verdicts are in
        labels = open_seal(settings.folder / world, digest)
        judged = {
            label["id"]: judge(
                label, verdicts[label["id"]], _heldout(folders[label["id"]], world), calibrate=settings.calibration
            )
            for label in labels
        }
        facts[world] = list(judged.values())
        rows += [_row(world, label, verdicts[label["id"]], judged[label["id"]]) for label in labels]
        if settings.with_baselines and world == OWN:
            compared = _baselines(settings, labels, folders, progress)
    joined = "".join(digests.values())
    return {
        "labels_sha256": joined if len(digests) == 1 else hashlib.sha256(joined.encode()).hexdigest(),
        "cases": rows,
        "table": table.tabulate([fact for each in facts.values() for fact in each]),
        "baselines": compared,
        "worlds": {
            world: {
                "labels_sha256": digests[world],
                "table": table.tabulate(each),
                "shares": {key: asdict(share) for key, share in table.shares(each).items()},
                "reliability": [asdict(b) for b in table.reliability(each)],
            }
            for world, each in facts.items()
        },
    }


def _claim(settings: Settings) -> None:
    """The folder belongs to one seed, one number of cases and some worlds. Raises InputError for another's."""
    settings.folder.mkdir(parents=True, exist_ok=True)
    note = settings.folder / "suite.json"
    mine = {"seed": settings.seed, "cases": settings.cases, "worlds": list(settings.worlds)}
    if note.exists():
        found = json.loads(note.read_text(encoding="utf-8"))
        if found != mine:
            raise InputError("--out", found, f"a folder of the suite {mine}, or an empty one")
    note.write_text(json.dumps(mine), encoding="utf-8")


def generate(settings: Settings, world: str, progress: Progress) -> str:
    """Run a world's generator as a child process. Returns the labels' sha256. Raises RuntimeError if it fails."""
    command = [
        sys.executable,
        "-m",
        "host.studies.proof.worlds.suite",
        "--world",
        world,
        "--seed",
        str(settings.seed),
        "--cases",
        str(settings.cases),
        "--dir",
        str((settings.folder / world).resolve()),
        "--jobs",
        str(settings.jobs),
    ]
    stage = f"generate {world}"
    progress(stage, 0, settings.cases)
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=Path(__file__).parents[3]
    ) as child:
        assert child.stderr and child.stdout
        said = ""
        for line in child.stderr:
            if line.strip().isdigit():
                progress(stage, int(line), settings.cases)
            else:
                said = line.strip() or said
        digest = child.stdout.read().strip()
    if child.returncode == 2:
        raise InputError("--world", world, said)
    if child.returncode != 0 or len(digest) != 64:
        raise RuntimeError(f"generator ended with status {child.returncode}: {said}")
    return digest


def _diagnosed(settings: Settings, folder: Path, folders: dict[str, Path], progress: Progress) -> dict[str, dict[str, Any]]:
    """Verdicts of all cases of one world; those kept from an earlier run are not computed again."""
    kept = folder / "verdicts"
    kept.mkdir(exist_ok=True)
    todo = {name: path for name, path in folders.items() if not (kept / f"{name}.json").exists()}
    if settings.scheduler:
        running = workers.on_cluster(todo, settings.finder, settings.limit_s, settings.scheduler)
    else:
        running = workers.locally(todo, settings.finder, settings.limit_s, settings.jobs)
    done, stage = len(folders) - len(todo), f"diagnose {folder.name}"
    progress(stage, done, len(folders))
    for name, verdict in running if todo else ():
        _keep(kept / f"{name}.json", {**verdict, "recorded_s": recorded_s(folders[name])})
        done += 1
        progress(stage, done, len(folders))
    return {name: json.loads((kept / f"{name}.json").read_text(encoding="utf-8")) for name in folders}


def _keep(path: Path, value: Any) -> None:
    """Write whole or not at all."""
    path.with_suffix(".new").write_text(json.dumps(plain(value)), encoding="utf-8")
    path.with_suffix(".new").rename(path)


def recorded_s(folder: Path) -> float:
    """Seconds of all recordings of a case."""
    tables = [baselines.read_columns(path) for path in sorted(folder.iterdir()) if path.name != "nominal.toml"]
    return float(sum(np.ptp(t["time_s"]) for t in tables))


def open_seal(folder: Path, digest: str) -> list[Label]:
    """The labels, after all verdicts are in. Raises RuntimeError where they are not those announced."""
    content = (folder / "sealed" / "labels.json").read_bytes()
    found = hashlib.sha256(content).hexdigest()
    if found != digest:
        raise RuntimeError(f"sealed labels: found sha256 {found}, wanted {digest}: they were changed during the run")
    labels = json.loads(content)["labels"]
    found_labels: list[Label] = labels
    return found_labels


def _heldout(folder: Path, world: str) -> dict[str, Any] | None:
    """Columns of the held-out recording for equations: gaps bridged, what is measured smoothed over 0.15 s.

    None for other worlds than the own one, whose effects outside the vocabulary have no equation in column names.
    """
    if world != OWN:
        return None
    columns = baselines.read_columns(next(folder.glob("c.*")))
    time_s = columns["time_s"]
    width = 2 * round(0.075 / float(np.median(np.diff(time_s)))) + 1
    for name, values in columns.items():
        known = np.isfinite(values)
        columns[name] = np.interp(time_s, time_s[known], values[known]) if known.any() else np.zeros_like(values)
        if name in MEASURED:
            columns[name] = savgol_filter(columns[name], width, 3)
    return columns


def _row(world: str, label: Label, verdict: dict[str, Any], facts: Facts) -> dict[str, Any]:
    """One line of the list of cases."""
    return {
        "id": label["id"],
        "world": world,
        "truth": label["truth"],
        "rho": label["rho"],
        "closed_loop": label["closed_loop"],
        "category": label["category"],
        "kind": label["kind"],
        "set": label["set"],
        "form": label["form"],
        "verdict": verdict,
        "right": facts.right,
    }


def _baselines(settings: Settings, labels: list[Label], folders: dict[str, Path], progress: Progress) -> dict[str, Any]:
    """Rows of the baselines, case by case kept like the verdicts."""
    kept = settings.folder / OWN / "baselines"
    kept.mkdir(exist_ok=True)
    todo = [label for label in labels if not (kept / f"{label['id']}.json").exists()]
    done = len(labels) - len(todo)
    progress("baselines", done, len(labels))
    jobs = max(1, settings.jobs)
    with ProcessPoolExecutor(max_workers=jobs, initializer=end_with_parent) as executor:
        made: Iterable[None] = (executor.map if jobs > 1 else map)(partial(_compare, kept, folders), todo)
        for _ in made:
            done += 1
            progress("baselines", done, len(labels))
    rows = {label["id"]: json.loads((kept / f"{label['id']}.json").read_text(encoding="utf-8")) for label in labels}
    return {name: _summary(labels, [rows[label["id"]][name] for label in labels]) for name in baselines.NAMES}


def _compare(kept: Path, folders: dict[str, Path], label: Label) -> None:
    _keep(kept / f"{label['id']}.json", baselines.compare(label, folders[label["id"]]))


def _summary(labels: list[Label], rows: list[dict[str, Any]]) -> dict[str, Any]:
    """A baseline's part of the table: it detects and closes gaps, it names nothing."""
    if any("unavailable" in row for row in rows):
        return {"unavailable": next(row["unavailable"] for row in rows if "unavailable" in row)}

    def gaps(*categories: str) -> float | None:
        found = [
            r["gap_closed"]
            for la, r in zip(labels, rows, strict=True)
            if la["category"] in categories and r["gap_closed"] is not None
        ]
        return float(np.median(found)) if found else None

    def seen(rho: float) -> float | None:
        return mean(
            [
                float(r["detected"])
                for la, r in zip(labels, rows, strict=True)
                if la["category"] in ("single", "pair", "outside")
                and rho / table.WIDE <= la["rho"] <= rho * table.WIDE
                and r["detected"] is not None
            ]
        )

    null = [r["detected"] for la, r in zip(labels, rows, strict=True) if la["category"] == "null"]
    return {
        "null_cases": len(null),
        "false_alarms": None if None in null else sum(null),
        "detected_rho_0.25": seen(0.25),
        "detected_rho_0.5": seen(0.5),
        "gap_closed_in_library": gaps("single", "pair"),
        "gap_closed_outside": gaps("outside"),
        "seconds_per_case_median": float(np.median([r["seconds"] for r in rows])) if rows else None,
    }
