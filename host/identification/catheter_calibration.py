"""Calibrate a catheter: recorded shapes under known loads in, its parameters with intervals and its TOML file's text out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from host.identification import planar_model, spatial_model
from host.identification.calibration import calibrate_model
from host.identification.recorded_shapes import read_recorded_shapes
from host.identification.robust_fit import LOSSES
from protocol.catheter import Catheter, catheter_toml, load_catheter
from protocol.errors import InputError

METHODS = ("gauss-newton", "nelder-mead", "both")
MODELS: dict[str, tuple[Any, Any, int]] = {
    "pcar": (planar_model, planar_model.PlanarModel, 2),
    "cosserat": (spatial_model, spatial_model.SpatialModel, 3),
}


@dataclass(frozen=True)
class CalibrationRequest:
    """What to calibrate from and how.

    shapes: file of recorded shapes (`recorded_shapes`), or "-". catheter: where the search starts, a shipped name or a .toml
    file. model: a key of MODELS. fit: parameter groups of that model. loss: a key of LOSSES. method: one of METHODS.
    """

    shapes: str
    catheter: str
    model: str = "pcar"
    fit: tuple[str, ...] = ("stiffness", "lengths")
    loss: str = "huber"
    method: str = "gauss-newton"
    leave_one_out: bool = True


@dataclass(frozen=True)
class CatheterCalibration:
    """The calibrated catheter; `found` as `calibrate_model` returns it; names of the parameters; number of recordings."""

    catheter: Catheter
    found: Any
    names: tuple[str, ...]
    recordings: int


def calibrate_catheter(request: CalibrationRequest) -> CatheterCalibration:
    """Identify a catheter from recorded shapes.

    Raises:
        InputError: an unknown choice, an unreadable file, or a start that does not fit the shapes.
    """
    for key, value, allowed in (
        ("model", request.model, tuple(MODELS)),
        ("method", request.method, METHODS),
        ("loss", request.loss, tuple(LOSSES)),
    ):
        if value not in allowed:
            raise InputError(key, value, f"one of {', '.join(allowed)}")
    module, model, dimensions = MODELS[request.model]
    if not request.fit or any(group not in module.GROUPS for group in request.fit):
        wanted = f"some of {', '.join(module.GROUPS)}, comma separated"
        raise InputError("fit", ",".join(request.fit) or "nothing", wanted)
    recordings = read_recorded_shapes(request.shapes, dimensions)
    fitted = model(load_catheter(request.catheter), recordings, request.fit)
    parameters = [(p.name, p.unit, p.logarithmic) for p in fitted.parameters]
    try:
        found = calibrate_model(fitted, parameters, request.loss, request.method, request.leave_one_out)
    except InputError:
        raise
    except ValueError as error:
        raise InputError("catheter", request.catheter, str(error).partition("wanted ")[2] or str(error)) from None
    calibrated = fitted.catheter_at(found.x)
    assert calibrated is not None
    return CatheterCalibration(calibrated, found, tuple(name for name, _, _ in parameters), len(recordings))


def calibration_report(calibration: CatheterCalibration) -> dict[str, Any]:
    """Return the result as JSON's types: parameters with 95 % intervals, residuals, what the data do not determine."""
    found = calibration.found
    return {
        "parameters": {
            p.name: {"value": p.value, "ci95": [p.low, p.high], "unit": p.unit, "told": p.told} for p in found.parameters
        },
        "noise_m": found.noise_m,
        "rms_m": found.rms_m,
        "max_m": found.max_m,
        "outliers": [{"recording": r, "marker": m} for r, m in found.outliers],
        "identifiability": {"singular_values": found.singular_values, "untold": [vars(u) for u in found.untold]},
        "searches": [_search(search, calibration.names) for search in found.fits],
        "leave_one_out": [vars(left) for left in found.left_out],
    }


def _search(search: Any, names: Sequence[str]) -> dict[str, Any]:
    return {
        "method": search.method,
        "objective": search.objective,
        "evaluations": search.evaluations,
        "seconds": search.seconds,
        "converged": search.converged,
        "x": dict(zip(names, search.x.tolist(), strict=True)),
    }


def calibrated_toml(calibration: CatheterCalibration, name: str) -> str:
    """Return the text of the calibrated catheter's file, called `name`, with the intervals as comments."""
    found = calibration.found
    undetermined = "   NOT determined by the data: mostly the start's value"
    notes = [
        f"Calibrated from {calibration.recordings} recorded shapes; root mean square error {found.rms_m * 1e3:.3f} mm.",
        "95 % intervals:",
    ]
    notes += [
        f"  {p.name} = {p.value:.6g} {p.unit}, {p.low:.6g} to {p.high:.6g}{'' if p.told else undetermined}"
        for p in found.parameters
    ]
    notes.append("Other values are those of the file that the search started from.")
    return catheter_toml(replace(calibration.catheter, name=name), notes)
