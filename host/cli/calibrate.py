"""`seldinger calibrate`: recorded shapes under known loads in, a catheter's TOML file with its uncertainty out."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any

import typer

from host.cli.contract_io import write_json
from host.cli.options import Json, writable_file, writable_folder
from host.cli.progress import Working
from protocol.errors import InputError


def calibrate(
    shapes: Annotated[
        str,
        typer.Argument(
            help="Recorded shapes: .csv, .json, or - (JSON). The format is in host/identification/recorded_shapes.py."
        ),
    ],
    catheter: Annotated[str, typer.Option(help="Catheter from which the search starts: a shipped one or a .toml file.")],
    out: Annotated[Path | None, typer.Option("--out", help="Folder for the calibrated catheter, NAME.toml.")] = None,
    name: Annotated[str, typer.Option(help="Name of the calibrated catheter: a-z, 0-9 and _.")] = "calibrated",
    model: Annotated[
        str,
        typer.Option(
            help="Model: pcar (planar), cosserat (spatial), or wire (friction of the pull-wire, from a loading loop)."
        ),
    ] = "pcar",
    fit: Annotated[
        str, typer.Option(help="Parameters to fit: stiffness, lengths, curvature, comma separated.")
    ] = "stiffness,lengths",
    loss: Annotated[
        str, typer.Option(help="Loss function: squares, huber, cauchy, or distance (the sum of the thesis).")
    ] = "huber",
    method: Annotated[
        str, typer.Option(help="Search: gauss-newton, nelder-mead, or both (to compare them).")
    ] = "gauss-newton",
    leave_one_out: Annotated[bool, typer.Option(help="Fit again without each recording in turn.")] = True,
    json: Json = False,
) -> None:
    """Identify a catheter: stiffness, lengths and unloaded curvature with intervals, and what the data do not determine.

    The shapes: {"recordings": [{"insertion_m": 0.0485, "curvature_per_m": 15.7, "force_N": [0.0, -0.1197], "markers":
    [{"offset_m": 0.0, "position_m": [0.1145, -0.0283]}, ...]}, ...]}, offset_m back from the tip, SI; or a CSV of one row a
    marker headed recording,insertion_m,curvature_per_m,force_x_N,force_y_N,offset_m,x_m,y_m (spatial: and force_z_N, z_m).
    For --model wire a CSV headed curvature_per_m,bend_rad: what the knob's curve gives, and the bend of the free tip, while
    the knob goes up and comes back.
    """
    from host.identification.catheter_calibration import calibrate as run
    from host.identification.catheter_calibration import calibrated_toml, calibration_report

    if not re.fullmatch(r"[a-z0-9_]{1,64}", name):
        raise InputError("--name", name, "1 to 64 of a-z, 0-9 and _")
    written = None if out is None else writable_file("--out", writable_folder("--out", out) / f"{name}.toml")
    if model == "wire":
        _calibrate_wire(shapes, catheter, written, name, json)
        return
    groups = tuple(part.strip() for part in fit.split(",") if part.strip())
    with Working("calibration"):
        found = run(shapes, catheter, model=model, fit=groups, loss=loss, method=method, leave_one_out=leave_one_out)
    report = calibration_report(found)
    if written is not None:
        written.write_text(calibrated_toml(found, name), encoding="utf-8")
        report["written"] = str(written)
    if json:
        write_json(report)
    else:
        _print_table(report)


def _calibrate_wire(loop: str, catheter: str, written: Path | None, name: str, json: bool) -> None:
    """Friction of the pull-wire from a loading-unloading loop."""
    from host.identification.wire_loop import identify_wire_friction, read_wire_loop, with_friction
    from protocol.catheter import load_catheter

    start = load_catheter(catheter)
    found = identify_wire_friction(start, read_wire_loop(loop))
    report: dict[str, Any] = dict(vars(found))
    if written is not None:
        written.write_text(with_friction(start, found, name), encoding="utf-8")
        report["written"] = str(written)
    if json:
        write_json(report)
        return
    low, high = found.friction_ci95
    print(f"friction coefficient {found.friction_coefficient:.4g}   95 %: {low:.4g} to {high:.4g}")
    print(f"gain of the knob's curve {found.gain:.4g}   95 %: {found.gain_ci95[0]:.4g} to {found.gain_ci95[1]:.4g}")
    print(f"error of the bend: {found.rms_rad:.4g} rad, {found.rms_without_rad:.4g} rad without friction")


def _print_table(report: dict[str, Any]) -> None:
    for name, p in report["parameters"].items():
        note = "" if p["determined"] else "   not determined by the data"
        print(f"{name:>14} = {p['value']:.6g} {p['unit']}   95 %: {p['ci95'][0]:.6g} to {p['ci95'][1]:.6g}{note}")
    print(
        f"markers: rms {report['rms_m'] * 1e3:.3f} mm, largest {report['max_m'] * 1e3:.3f} mm, "
        f"noise {report['noise_m'] * 1e3:.3f} mm per axis, {len(report['outliers'])} outliers"
    )
    for search in report["searches"]:
        print(
            f"{search['method']:>14}: objective {search['objective']:.6f}, {search['evaluations']} evaluations, "
            f"{search['seconds'] * 1e3:.0f} ms{'' if search['converged'] else ', not converged'}"
        )
    for direction in report["identifiability"]["undetermined"]:
        mix = ", ".join(f"{weight:+.2f} {name}" for name, weight in direction["combination"].items())
        print(f"not determined by the data: {mix} (relative standard deviation {direction['relative_std']:.2g})")
    if report["leave_one_out"]:
        worst = max(report["leave_one_out"], key=lambda left: left["rms_m"])
        print(
            f"leave one out: worst recording {worst['recording']}, rms {worst['rms_m'] * 1e3:.3f} mm, "
            f"tip {worst['tip_m'] * 1e3:.3f} mm"
        )
    if "written" in report:
        print(f"written: {report['written']}")
