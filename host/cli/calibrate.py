"""`seldinger calibrate`: recorded shapes under known loads in, a catheter's TOML file with its uncertainty out."""

from __future__ import annotations

import importlib
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from host.cli.contract_io import write_json
from protocol.errors import InputError

METHODS = ("gauss-newton", "nelder-mead", "both")
MODELS = {"pcar": ("planar_model", "PlanarModel"), "cosserat": ("spatial_model", "SpatialModel")}


def calibrate(
    shapes: Annotated[
        str, typer.Argument(help="recorded shapes: .csv, .json, or - (JSON); format: host/identification/recorded_shapes.py")
    ],
    catheter: Annotated[str, typer.Option(help="where the search starts: a shipped catheter or a .toml file")],
    out: Annotated[Path | None, typer.Option(help="write the calibrated catheter into this .toml file")] = None,
    name: Annotated[str | None, typer.Option(help="name of the calibrated catheter")] = None,
    model: Annotated[str, typer.Option(help="pcar (planar) or cosserat (spatial)")] = "pcar",
    fit: Annotated[str, typer.Option(help="some of stiffness, lengths, curvature, comma separated")] = "stiffness,lengths",
    loss: Annotated[str, typer.Option(help="squares, huber, cauchy, or distance (the thesis' sum)")] = "huber",
    method: Annotated[str, typer.Option(help="gauss-newton, nelder-mead, or both to compare them")] = "gauss-newton",
    leave_one_out: Annotated[bool, typer.Option(help="refit without each recording in turn")] = True,
    json: Annotated[bool, typer.Option("--json", help="one JSON object on standard output")] = False,
) -> None:
    """Identify a catheter: stiffness, lengths and initial curvature with confidence, and what the data do not tell.

    The shapes: {"recordings": [{"insertion_m": 0.0485, "curvature_per_m": 15.7, "force_N": [0.0, -0.1197], "markers":
    [{"offset_m": 0.0, "position_m": [0.1145, -0.0283]}, ...]}, ...]}, offset_m back from the tip, SI; or a CSV of one row a
    marker headed recording,insertion_m,curvature_per_m,force_x_N,force_y_N,offset_m,x_m,y_m (spatial: and force_z_N, z_m).
    """
    from host.identification.calibration import calibrate_model
    from host.identification.recorded_shapes import read_recorded_shapes
    from host.identification.robust_fit import LOSSES

    for key, value, allowed in (("model", model, tuple(MODELS)), ("method", method, METHODS), ("loss", loss, tuple(LOSSES))):
        if value not in allowed:
            raise InputError(key, value, f"one of {', '.join(allowed)}")
    if out is not None and (out.suffix != ".toml" or not out.resolve().parent.is_dir()):
        raise InputError("out", str(out), "a .toml file in a folder that exists")
    recordings = read_recorded_shapes(shapes, 2 if model == "pcar" else 3)
    fitted = _model(model, catheter, recordings, tuple(part.strip() for part in fit.split(",") if part.strip()))
    names = [(p.name, p.unit, p.logarithmic) for p in fitted.parameters]
    try:
        found = calibrate_model(fitted, names, loss, method, leave_one_out)
    except ValueError as error:
        raise InputError("catheter", catheter, str(error).partition("wanted ")[2] or str(error)) from None
    calibrated = fitted.catheter_at(found.x)
    assert calibrated is not None
    report = _report(found, names)
    if out is not None:
        out.write_text(_toml(replace(calibrated, name=name or out.stem), found, len(recordings)), encoding="utf-8")
        report["written"] = str(out)
    if json:
        write_json(report)
    else:
        _print_for_people(report)


def _model(model: str, catheter: str, recordings: list[Any], fit: tuple[str, ...]) -> Any:
    from protocol.catheter import load_catheter

    start = load_catheter(catheter)
    module_name, class_name = MODELS[model]
    module = importlib.import_module(f"host.identification.{module_name}")
    unknown = [part for part in fit if part not in module.GROUPS]
    if unknown or not fit:
        raise InputError("fit", ",".join(fit) or "nothing", f"some of {', '.join(module.GROUPS)}, comma separated")
    return getattr(module, class_name)(start, recordings, fit)


def _report(found: Any, names: list[tuple[str, str, bool]]) -> dict[str, Any]:
    return {
        "parameters": {
            p.name: {"value": p.value, "ci95": [p.low, p.high], "unit": p.unit, "told": p.told} for p in found.parameters
        },
        "noise_m": found.noise_m,
        "rms_m": found.rms_m,
        "max_m": found.max_m,
        "outliers": [{"recording": r, "marker": m} for r, m in found.outliers],
        "identifiability": {"singular_values": found.singular_values, "untold": [vars(u) for u in found.untold]},
        "searches": [
            {
                "method": f.method,
                "objective": f.objective,
                "evaluations": f.evaluations,
                "seconds": f.seconds,
                "converged": f.converged,
                "x": dict(zip([n[0] for n in names], f.x.tolist(), strict=True)),
            }
            for f in found.fits
        ],
        "leave_one_out": [vars(left) for left in found.left_out],
    }


def _toml(catheter: Any, found: Any, count: int) -> str:
    from protocol.catheter import catheter_toml

    untold = "   NOT determined by the data: the start's value counts for much"
    notes = [
        f"Calibrated from {count} recorded shapes; root mean square error {found.rms_m * 1e3:.3f} mm.",
        "95 % intervals:",
    ]
    notes += [
        f"  {p.name} = {p.value:.6g} {p.unit}, {p.low:.6g} to {p.high:.6g}{'' if p.told else untold}"
        for p in found.parameters
    ]
    notes.append("Other values are those of the file that the search started from.")
    return catheter_toml(catheter, notes)


def _print_for_people(report: dict[str, Any]) -> None:
    for name, p in report["parameters"].items():
        note = "" if p["told"] else "   not told by the data"
        print(f"{name:>14} = {p['value']:.6g} {p['unit']}   95 %: {p['ci95'][0]:.6g} to {p['ci95'][1]:.6g}{note}")
    print(
        f"markers: rms {report['rms_m'] * 1e3:.3f} mm, largest {report['max_m'] * 1e3:.3f} mm, "
        f"noise {report['noise_m'] * 1e3:.3f} mm per axis, {len(report['outliers'])} outliers"
    )
    for search in report["searches"]:
        print(
            f"{search['method']:>14}: objective {search['objective']:.6f}, {search['evaluations']} evaluations, "
            f"{search['seconds'] * 1e3:.0f} ms{'' if search['converged'] else ', did not end'}"
        )
    for direction in report["identifiability"]["untold"]:
        mix = ", ".join(f"{weight:+.2f} {name}" for name, weight in direction["combination"].items())
        print(f"not told by the data: {mix} (relative standard deviation {direction['relative_std']:.2g})")
    if report["leave_one_out"]:
        worst = max(report["leave_one_out"], key=lambda left: left["rms_m"])
        print(
            f"leave one out: worst recording {worst['recording']}, rms {worst['rms_m'] * 1e3:.3f} mm, "
            f"tip {worst['tip_m'] * 1e3:.3f} mm"
        )
    if "written" in report:
        print(f"written: {report['written']}")
