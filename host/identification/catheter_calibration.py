"""Calibrate a catheter: recorded shapes under known loads in, its parameters with intervals and its TOML file's text out."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from host.identification.calibration import Calibration, calibrate_model
from host.identification.planar_model import GROUPS as PLANAR_GROUPS
from host.identification.planar_model import PlanarModel
from host.identification.recorded_shapes import checked_shapes, read_recorded_shapes
from host.identification.robust_fit import LOSSES
from host.identification.spatial_model import GROUPS as SPATIAL_GROUPS
from host.identification.spatial_model import SpatialModel
from protocol.catheter import Catheter, catheter_toml, load_catheter
from protocol.errors import InputError
from protocol.requests import plain

METHODS = ("gauss-newton", "nelder-mead", "both")
MODELS: dict[str, tuple[Any, tuple[str, ...], int]] = {
    "pcar": (PlanarModel, PLANAR_GROUPS, 2),
    "cosserat": (SpatialModel, SPATIAL_GROUPS, 3),
}


def calibrate(
    shapes: Sequence[Mapping[str, Any]] | str | os.PathLike[str],
    catheter: Catheter | str,
    *,
    model: str = "pcar",
    fit: Sequence[str] = ("stiffness", "lengths"),
    loss: str = "huber",
    method: str = "gauss-newton",
    leave_one_out: bool = True,
) -> Calibration:
    """Identify a catheter's parameters from shapes recorded under known loads.

    Parameters:
        shapes: one dictionary for each recording: `insertion_m` (m), `curvature_per_m` (1/m), `force_N` (2,) or (3,) in
            the base frame (N), `markers`, a list of {"offset_m": arc length back from the tip (m), "position_m": (2,) or
            (3,) (m)}, and perhaps `weight`; or the path of a .json or .csv file with them.
        catheter: where the search starts: a catheter, the name of one that ships, or a .toml file's path.
        model: "pcar" (planar, two coordinates) or "cosserat" (spatial, three coordinates).
        fit: groups of parameters that are fitted: of "stiffness", "lengths", "curvature" (pcar), or of "stiffness",
            "torsion", "curvature" (cosserat).
        loss: "squares", "huber", "cauchy", or "distance" (the sum of distances, as in the thesis).
        method: "gauss-newton", "nelder-mead" (as in the thesis), or "both", to compare them.
        leave_one_out: fit again without each recording in turn, and predict it.

    Returns:
        Calibration: `catheter` with the fitted values; `parameters`, each with `name`, `unit`, `value`, 95 % interval `low`
        to `high`, and `determined`; `noise_m`, `rms_m`, `max_m` of the markers; `undetermined` directions; `left_out`.

    Raises:
        InputError: a shape cannot be used, or an option is not known; names the key.

    Source:
        Thesis, section 2.3.1 and (2.20); robust loss, exact sensitivities and intervals are ours.

    Examples:
        >>> calibrate("shapes.csv", "thermocool_sf").parameters  # doctest: +SKIP
    """
    for key, value, allowed in (("model", model, MODELS), ("method", method, METHODS), ("loss", loss, LOSSES)):
        if value not in allowed:
            raise InputError(key, value, f"one of {', '.join(allowed)}")
    make, groups, dimensions = MODELS[model]
    if not fit or any(part not in groups for part in fit):
        raise InputError("fit", ",".join(fit) or "nothing", f"some of {', '.join(groups)}, comma separated")
    start = catheter if isinstance(catheter, Catheter) else load_catheter(catheter)
    if isinstance(shapes, str | os.PathLike):
        recordings = read_recorded_shapes(os.fspath(shapes), dimensions)
    else:
        recordings = checked_shapes({"recordings": plain(list(shapes))}, dimensions)
    return calibrate_model(make(start, recordings, tuple(fit)), loss, method, leave_one_out)


def calibration_report(found: Calibration) -> dict[str, Any]:
    """Return the result as JSON's types: parameters with 95 % intervals, residuals, what the data do not determine."""
    return {
        "parameters": {
            p.name: {"value": p.value, "ci95": [p.low, p.high], "unit": p.unit, "determined": p.determined}
            for p in found.parameters
        },
        "noise_m": found.noise_m,
        "rms_m": found.rms_m,
        "max_m": found.max_m,
        "outliers": [{"recording": r, "marker": m} for r, m in found.outliers],
        "identifiability": {"singular_values": found.singular_values, "undetermined": [vars(u) for u in found.undetermined]},
        "searches": [_search(search, [p.name for p in found.parameters]) for search in found.fits],
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


def calibrated_toml(found: Calibration, name: str) -> str:
    """Return the text of the calibrated catheter's file, called `name`, with the intervals as comments."""
    undetermined = "   NOT determined by the data: mostly the start's value"
    notes = [
        f"Calibrated from {found.recordings} recorded shapes; root mean square error {found.rms_m * 1e3:.3f} mm.",
        "95 % intervals:",
    ]
    notes += [
        f"  {p.name} = {p.value:.6g} {p.unit}, {p.low:.6g} to {p.high:.6g}{'' if p.determined else undetermined}"
        for p in found.parameters
    ]
    notes.append("Other values are those of the file that the search started from.")
    return catheter_toml(replace(found.catheter, name=name), notes)
