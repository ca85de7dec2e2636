"""The mismatch finder: where simulation and recordings disagree, which physics is missing, its model and the evidence.

Steps, each a room, arrows in this order: `model` (recordings, channels, data findings, operators) and `effects` (the
vocabulary); `estimation` (fit, noise, evidence, intervals, rules); `models` (nominal models, one file a kind); `symbolic`
(equations of recorded signals); `selection` (objective and decision rule are written there); `design` (experiments that
separate models); `live` (a running rig); `pipeline` (one diagnosis from start to end); `report` (verdict and page);
`export` (the extended model as a file).
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from protocol.errors import InputError

if TYPE_CHECKING:
    from host.diagnosis.estimation.rules import SelectionRules
    from host.diagnosis.model.tables import Table
    from host.diagnosis.pipeline import Diagnosis

__all__ = ["Verdict", "diagnose"]


class Verdict:
    """What a diagnosis found. `as_dict` has all of it, as `seldinger diagnose --json` prints it."""

    def __init__(self, name: str, content: dict[str, Any], diagnosis: Diagnosis | None) -> None:
        self._name, self._content, self.diagnosis = name, content, diagnosis
        self.not_exported: list[str] = []  # what the file last exported cannot hold of the model, a sentence each

    @property
    def verdict(self) -> str:
        """Return `missing_physics`, `nothing_missing` or `mismatch_not_identified`."""
        return str(self._content["verdict"])

    @property
    def effects(self) -> list[dict[str, Any]]:
        """Effects that are missing from the nominal model, most probable first, each as in the JSON."""
        return list(self._content["effects"])

    @property
    def data_findings(self) -> list[dict[str, str]]:
        """What is wrong with the recordings themselves, in plain sentences: read these first."""
        return list(self._content["data_findings"])

    def as_dict(self) -> dict[str, Any]:
        """The whole verdict as JSON's own types; NaN is None."""
        from protocol.requests import plain

        return dict(plain(self._content))

    def export(self, path: Path | str) -> Path:
        """Write the nominal model with the effects that were found.

        Parameters:
            path: `.py` (a module that runs without the diagnosis), `.json` (names and values of a simulator's parameters),
                `.xml` (kind mujoco: the model file with them), `.ssv` (kind fmu: a parameter set) or `.toml` (a recorded
                rig: its file).

        Returns:
            The path. `not_exported` says what the file cannot hold.

        Raises:
            InputError: a model that cannot be written so, or recordings in which there was nothing to compare.
        """
        from host.diagnosis.export.write import export

        if self.diagnosis is None:
            raise InputError("--export", "no model: there was nothing to compare", "recordings that can be compared")
        self.not_exported = export(self.diagnosis, Path(path))
        return Path(path)

    def write(self, folder: Path | str) -> Path:
        """Write verdict.json, report.html and, if there was something to compare, the scripts of proposed experiments.

        Parameters:
            folder: made if it does not exist.

        Returns:
            The report's path.

        Raises:
            OSError: the folder cannot be written.
        """
        import json

        from host.diagnosis.report.page import write_data_report, write_report
        from host.diagnosis.report.scripts import write_scripts

        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        scripts = [] if self.diagnosis is None else write_scripts(self.diagnosis, folder)
        self._content["scripts"] = [str(path) for path in scripts]
        (folder / "verdict.json").write_text(json.dumps(self.as_dict(), allow_nan=False) + "\n", encoding="utf-8")
        if self.diagnosis is None:
            return write_data_report(self._name, self._content, folder / "report.html")
        return write_report(self.diagnosis, self._content, folder / "report.html")


def diagnose(
    recordings: Sequence[Any],
    nominal: Mapping[str, Any] | str | os.PathLike[str],
    *,
    without: Sequence[str] = (),
    known: Sequence[str] = (),
    data_folder: str | None = None,
    rules: SelectionRules | None = None,
    time_budget_s: float | None = None,
    progress: Callable[[str, float], None] = lambda what, part: None,
) -> Verdict:
    """Compare recordings with a nominal model and name the physics that it lacks.

    Parameters:
        recordings: each a dictionary of arrays (n,), a DataFrame, or a path (a folder stands for the tables in it).
            Empty: the files that the nominal model names, in `data_folder`.
        nominal: a TOML file, the name of one that ships, or the content of such a file as a dictionary.
        without: ids of effects that are not to be considered.
        known: effects to take for granted, `id@subsystem:key=value,...`.
        data_folder: where files that the nominal model names lie (default: SELDINGER_DATA).
        rules: thresholds, those of the data checks too (default: `host.diagnosis.estimation.rules.RULES`).
        time_budget_s: time after which nothing further is tried; the verdict then says `stopped_early`.
        progress: called with what is being done and the part of it that is done (0 to 1).

    Returns:
        The verdict: `.verdict`, `.effects`, `.as_dict()`, `.write(folder)`.

    Raises:
        InputError: recordings or nominal model cannot be used; names the key.

    Examples:
        >>> verdict = diagnose([{"t": t, "f": f, "x": x}], "stage.toml")  # doctest: +SKIP
        >>> verdict.effects[0]["id"]  # doctest: +SKIP
        'coulomb_friction'
    """
    from host.diagnosis.effects import library
    from host.diagnosis.estimation.rules import RULES
    from host.diagnosis.model.dataset import find_files
    from host.diagnosis.model.nominal import effect_of, nominal_of, nominal_path, read_nominal
    from host.diagnosis.model.tables import table_of
    from host.diagnosis.pipeline import diagnose as run
    from host.diagnosis.problems import NothingToCompare
    from host.diagnosis.report.verdict import as_json, without_fit

    began = time.monotonic()
    ids = {effect.id for effect in library()}
    for effect_id in without:
        if effect_id not in ids:
            raise InputError("without", effect_id, "one of " + ", ".join(sorted(ids)))
    spec = nominal_of(dict(nominal)) if isinstance(nominal, Mapping) else read_nominal(nominal_path(os.fspath(nominal)))
    spec.effect += [effect_of(text) for text in known]
    if isinstance(recordings, Mapping | str | os.PathLike) or hasattr(recordings, "columns"):
        recordings = [recordings]
    sources: list[Path | Table] = []
    for number, recording in enumerate(recordings):
        source = table_of(recording, number)
        if isinstance(source, Path):
            sources += find_files(spec, [str(source)], None)
        else:
            sources.append(source)
    sources += [] if sources else find_files(spec, [], data_folder)
    rules = rules or RULES
    try:
        result = run(spec, sources, progress, frozenset(without), rules, time_budget_s)
    except NothingToCompare as nothing:
        return Verdict(spec.name, without_fit(nothing.findings, rules, time.monotonic() - began), None)
    return Verdict(spec.name, as_json(result, time.monotonic() - began), result)
