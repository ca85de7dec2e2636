"""`seldinger diagnose`: recordings and a nominal model in, verdict out, as JSON and as a report page."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from host.cli.contract_io import write_json


class Progress:
    """One line on standard error that says what is being done; drawn over itself on a terminal, one line a task
    elsewhere.
    """

    def __init__(self, quiet: bool) -> None:
        self.quiet, self.last, self.drawn, self.began = quiet, "", 0.0, time.monotonic()
        self.live = sys.stderr.isatty()

    def __call__(self, what: str, part: float) -> None:
        """`part` of `what` is done, 0 to 1."""
        now = time.monotonic()
        if self.quiet or (what == self.last and (not self.live or now - self.drawn < 0.1)):
            return
        bar = "#" * round(20 * part)
        text = f"[{bar:<20}] {now - self.began:5.1f} s  {what}"
        sys.stderr.write(f"\r{text[:110]:<110}" if self.live else f"{text}\n")
        sys.stderr.flush()
        self.last, self.drawn = what, now

    def close(self) -> None:
        """Ends the line."""
        if self.live and not self.quiet:
            sys.stderr.write("\r" + " " * 110 + "\r")


def diagnose(
    recordings: Annotated[
        list[str] | None, typer.Argument(help="tables or folders; without any, those the nominal TOML names")
    ] = None,
    nominal: Annotated[str, typer.Option(help="nominal model, a TOML file or the name of one that ships")] = "",
    json: Annotated[str | None, typer.Option(help="where the verdict goes; - for standard output")] = None,
    report: Annotated[str | None, typer.Option(help="where the report page goes (one HTML file)")] = None,
    out: Annotated[
        Path | None, typer.Option(help="folder for verdict.json, report.html, and the scripts of experiments to tell apart")
    ] = None,
    data: Annotated[
        str | None, typer.Option(help="folder of the recordings that the nominal TOML names (else SELDINGER_DATA)")
    ] = None,
    without: Annotated[list[str] | None, typer.Option(help="effect id the finder is not to know")] = None,
    quiet: Annotated[bool, typer.Option(help="no progress on standard error")] = False,
    live: Annotated[bool, typer.Option("--live", help="watch a running rig against its twin, and raise alarms")] = False,
    rig: Annotated[str | None, typer.Option(help="with --live: the rig's file (default: the simulated rig)")] = None,
    effect: Annotated[
        list[str] | None,
        typer.Option(help="effect that is known to be there: id@subsystem:key=value,... as the report gives it"),
    ] = None,
) -> None:
    """Where simulation and recording part, what physics was left out, its model, and the proof."""
    if live:
        from host.cli.diagnose_live import watch_rig

        watch_rig(rig, json)
        return
    from host.diagnosis.model.dataset import find_files
    from host.diagnosis.model.effect import library
    from host.diagnosis.model.nominal import effect_of, read_nominal
    from host.diagnosis.pipeline import diagnose as run
    from host.diagnosis.report.verdict import as_json
    from protocol.errors import InputError

    began = time.monotonic()
    known = {effect.id for effect in library()}
    for effect_id in without or []:
        if effect_id not in known:
            raise InputError("--without", effect_id, "one of " + ", ".join(sorted(known)))
    if not nominal:
        raise InputError("--nominal", "nothing", "a TOML file")
    spec = read_nominal(nominal_path(nominal))
    spec.effect += [effect_of(text) for text in effect or []]
    files = find_files(spec, recordings or [], data or os.environ.get("SELDINGER_DATA"))
    progress = Progress(quiet)
    result = run(spec, files, progress, frozenset(without or []))
    progress.close()
    verdict = as_json(result, time.monotonic() - began)
    if out is not None:
        from host.diagnosis.design.scripts import write_scripts

        out.mkdir(parents=True, exist_ok=True)
        verdict["scripts"] = [str(path) for path in write_scripts(result, out)]
        report = report or str(out / "report.html")
        write_json(verdict, str(out / "verdict.json"))
        for path in verdict["scripts"]:
            print(f"script: {path}", file=sys.stderr)
    if report:
        from host.diagnosis.report.page import write_report

        write_report(result, verdict, Path(report))
    if json or not report:
        write_json(verdict, json)


def nominal_path(name: str) -> Path:
    """The file `name`, or the shipped nominal of that name."""
    path = Path(name)
    shipped = Path(__file__).parents[1] / "diagnosis" / "nominals" / f"{name}.toml"
    return shipped if not path.exists() and shipped.exists() else path
