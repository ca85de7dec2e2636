"""`seldinger diagnose`: recordings and a nominal model in; verdict out, as text, as JSON and as a report page."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from host.cli.contract_io import write_json
from host.cli.options import Json, writable_folder
from host.cli.progress import Progress
from protocol.errors import Description, InputError
from protocol.rig_file import SIMULATED_RIG, load_rig


def diagnose(
    recordings: Annotated[
        list[str] | None, typer.Argument(help="Tables or folders; default: the files that the nominal TOML lists.")
    ] = None,
    nominal: Annotated[str, typer.Option(help="Nominal model: a TOML file, or the name of a shipped one.")] = "",
    json: Json = False,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for verdict.json, report.html, and the scripts of discriminating experiments."),
    ] = None,
    data: Annotated[
        str | None, typer.Option(help="Folder of the recordings that the nominal TOML lists (default: SELDINGER_DATA).")
    ] = None,
    without: Annotated[list[str] | None, typer.Option(help="Id of an effect to exclude from the candidates.")] = None,
    time_budget: Annotated[
        float | None, typer.Option(help="Time after which the search ends, s; the verdict reports it.", min=0.0)
    ] = None,
    quiet: Annotated[bool, typer.Option(help="Print no progress on standard error.")] = False,
    live: Annotated[bool, typer.Option("--live", help="Compare a running rig with its twin and raise alarms.")] = False,
    rig: Annotated[
        Path | None, typer.Option(help="With --live: rig file (TOML); default: that of the simulated rig.")
    ] = None,
    effect: Annotated[
        list[str] | None,
        typer.Option(help="Effect that is known to be active: id@subsystem:key=value,... as printed in a report."),
    ] = None,
    export: Annotated[
        Path | None,
        typer.Option(
            help="File for the extended model: .py (module), .json, .xml, .ssv (parameters of a simulator), .toml (rig)."
        ),
    ] = None,
    trust: Annotated[
        bool,
        typer.Option("--trust", help="Run the code of the nominal TOML even if another user may have written it."),
    ] = False,
) -> None:
    """Compare recordings with a simulation: where they disagree, which physics is missing, its parameters, the evidence."""
    if live:
        of_recordings = {
            "recordings": recordings,
            "--nominal": nominal,
            "--out": out,
            "--data": data,
            "--without": without,
            "--time-budget": time_budget,
            "--effect": effect,
            "--export": export,
            "--trust": trust,
        }
        _diagnose_live(rig, json, of_recordings)
        return
    if rig is not None:
        raise InputError("--rig", str(rig), "this option with --live only: recordings are compared with --nominal")
    from host.diagnosis import diagnose as run

    if not nominal:
        raise InputError("--nominal", "nothing", "a TOML file")
    _refuse_twice(recordings or [])
    if data is not None and not Path(data).is_dir():
        raise InputError("--data", data, "a folder that exists")
    if out is not None:
        writable_folder("--out", out)
    if export is not None:
        from host.diagnosis.export.write import check_target
        from host.diagnosis.model.nominal import nominal_path, read_nominal

        check_target(export, read_nominal(nominal_path(nominal)).kind)  # before the search, which may take minutes
    _say_what_runs(nominal, trust)
    with Progress(quiet) as progress:
        verdict = run(
            recordings or [],
            nominal,
            without=without or [],
            known=effect or [],
            data_folder=data,
            time_budget_s=time_budget,
            progress=progress,
        )
    if out is not None:
        report = verdict.write(out)
        print(f"report: {report}", file=sys.stderr)
        for script in verdict.as_dict()["scripts"]:
            print(f"script: {script}", file=sys.stderr)
    if export is not None:
        print(f"model: {verdict.export(export)}", file=sys.stderr)
        for sentence in verdict.not_exported:
            print(f"not exported: {sentence}", file=sys.stderr)
    if json:
        write_json(verdict.as_dict())
    else:
        print("\n".join(summary(verdict.as_dict())))


def _refuse_twice(recordings: list[str]) -> None:
    """Raise InputError for a file that is given twice: it would count as evidence of its own."""
    places = [os.path.realpath(recording) for recording in recordings]
    twice = next((place for place in places if places.count(place) > 1), None)
    if twice is not None:
        raise InputError("recording", Description(f"{twice} twice"), "each recording once")


def _say_what_runs(nominal: str, trust: bool) -> None:
    """Print the code that the nominal TOML runs. Raises InputError if another user may have written it."""
    from host.diagnosis.model.nominal import nominal_path, read_nominal
    from host.diagnosis.model.trust import check_owner, code_of, code_path

    path = nominal_path(nominal)
    spec = read_nominal(path)
    what = code_of(spec)
    if not what:
        return
    code = code_path(spec)
    if not trust:
        check_owner(path, *([code] if code is not None else []))
    print(f"seldinger diagnose: {path} runs {what} with your rights", file=sys.stderr)


def _diagnose_live(rig: Path | None, json: bool, of_recordings: dict[str, Any]) -> None:
    """Watch a running rig until it is stopped.

    of_recordings: arguments by name that only a diagnosis of recordings reads. Raises InputError if one is given.
    """
    for name, value in of_recordings.items():
        if value is None or value is False or value in ("", []):
            continue
        found = Description("this option") if value is True else str(value[0] if isinstance(value, list) else value)
        raise InputError(name, found, "none with --live, which compares the running rig with its twin")
    _watch(SIMULATED_RIG if rig is None else rig, json)


def _watch(rig: Path, json: bool) -> None:
    """Watch a running rig until it is stopped; with `json`, one JSON object a line for each alarm."""
    from host.diagnosis.live.attach import attach
    from host.run.connection import may_run
    from protocol.messages import body_of
    from protocol.topics import Alarm

    def print_alarm(alarm: Alarm) -> None:
        if json:
            write_json(body_of(alarm))
            sys.stdout.flush()

    read = load_rig(rig)
    if not may_run(read):
        print(f"seldinger diagnose: no rig {read.name} runs at {read.local.folder} yet", file=sys.stderr, flush=True)
    attach(rig, lambda text: print(f"seldinger diagnose: {text}", file=sys.stderr, flush=True), print_alarm)


def summary(verdict: dict[str, Any]) -> list[str]:
    """Write the verdict as lines of text."""
    from host.diagnosis.report.verdict import likelier

    fit = verdict["fit"]
    lines = [f"data: {finding['says']}" for finding in verdict["data_findings"]]
    lines.append(verdict["verdict"].replace("_", " "))
    for effect in verdict["effects"]:
        lines.append(f"{effect['id']} ({effect['subsystem']}), probability {effect['probability']:.2f}: {effect['says']}")
        for key, p in effect["parameters"].items():
            mark = ", at its bound" if p["at_bound"] else ""
            lines.append(f"  {key} = {p['value']:.4g} (95 %: {p['ci95'][0]:.4g} to {p['ci95'][1]:.4g}){mark}")
        if effect["indistinguishable_from"]:
            lines.append("  indistinguishable from " + ", ".join(effect["indistinguishable_from"]))
        if said := likelier(effect):
            lines.append(f"  {said}")
    lines += [f"worse: {text}" for text in verdict["worse"]]
    if fit["rmse_before"] is None:
        return [*lines, f"next: {verdict['next']}"]
    after = f", with the effects {fit['rmse_after']:.4g} {fit['unit']}" if verdict["effects"] else ""
    noise = f"; noise {fit['noise_floor']:.4g} {fit['unit']}"
    lines.append(f"held-out RMS error {fit['rmse_before']:.4g} {fit['unit']}{after}{noise}")
    return [*lines, f"next: {verdict['next']}"]
