"""`seldinger diagnose`: recordings and a nominal model in; verdict out, as text, as JSON and as a report page."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from host.cli.contract_io import write_json
from protocol.errors import InputError


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
    json: Annotated[bool, typer.Option("--json", help="one JSON object on standard output")] = False,
    out: Annotated[
        Path | None, typer.Option(help="folder for verdict.json, report.html, and the scripts of experiments to tell apart")
    ] = None,
    data: Annotated[
        str | None, typer.Option(help="folder of the recordings that the nominal TOML names (else SELDINGER_DATA)")
    ] = None,
    without: Annotated[list[str] | None, typer.Option(help="effect id that is not to be considered")] = None,
    quiet: Annotated[bool, typer.Option(help="no progress on standard error")] = False,
    live: Annotated[bool, typer.Option("--live", help="watch a running rig against its twin, and raise alarms")] = False,
    rig: Annotated[str | None, typer.Option(help="with --live: the rig's file (default: the simulated rig)")] = None,
    effect: Annotated[
        list[str] | None,
        typer.Option(help="effect that is known to be there: id@subsystem:key=value,... as the report gives it"),
    ] = None,
) -> None:
    """Compare recordings with a simulation: where they disagree, which physics is missing, its parameters, the evidence."""
    if live:
        from host.cli.diagnose_live import watch_rig

        watch_rig(rig, json)
        return
    from host.diagnosis import diagnose as run

    if not nominal:
        raise InputError("--nominal", "nothing", "a TOML file")
    progress = Progress(quiet)
    verdict = run(recordings or [], nominal, without=without or [], known=effect or [], data_folder=data, progress=progress)
    progress.close()
    if out is not None:
        report = verdict.write(out)
        print(f"report: {report}", file=sys.stderr)
        for script in verdict.as_dict()["scripts"]:
            print(f"script: {script}", file=sys.stderr)
    if json:
        write_json(verdict.as_dict())
    else:
        print("\n".join(summary(verdict.as_dict())))


def summary(verdict: dict[str, Any]) -> list[str]:
    """The verdict as lines for people."""
    fit = verdict["fit"]
    lines = [verdict["verdict"].replace("_", " ")]
    for effect in verdict["effects"]:
        lines.append(f"{effect['id']} ({effect['subsystem']}): {effect['says']}")
        for key, p in effect["parameters"].items():
            lines.append(f"  {key} = {p['value']:.4g} (95 %: {p['ci95'][0]:.4g} to {p['ci95'][1]:.4g})")
        if effect["indistinguishable_from"]:
            lines.append("  indistinguishable from " + ", ".join(effect["indistinguishable_from"]))
    lines.append(
        f"held-out RMS error {fit['rmse_before']:.4g} {fit['unit']}, with the effects {fit['rmse_after']:.4g} "
        f"{fit['unit']}; noise {fit['noise_floor']:.4g} {fit['unit']}"
    )
    return lines
