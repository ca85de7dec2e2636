"""`seldinger estimate`: the force at the tip from tracked poses, with its covariance and whether to believe it."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import typer

from host.cli.contract_io import write_json
from host.cli.shape_plot import check_plot_path, plot_shape
from host.cli.solve import PLOT_POINTS
from host.cli.static_requests import CosseratEstimate, PcarEstimate, catheter_for, read_request


def estimate(
    request: Annotated[str, typer.Argument(help="the request: a JSON file, or - for standard input")],
    json: Annotated[bool, typer.Option("--json", help="one JSON object on standard output")] = False,
    plot: Annotated[str | None, typer.Option(help="draw the shape and the force into this PNG file")] = None,
) -> None:
    """Force at the tip from poses. A pose that no force explains is reported with "converged": false, status 0."""
    check_plot_path(plot)
    checked = read_request(request, PcarEstimate, CosseratEstimate)  # type: ignore[type-var]
    answer = _planar(checked, plot) if isinstance(checked, PcarEstimate) else _spatial(checked, plot)  # type: ignore[arg-type]
    if json:
        write_json(answer)
    else:
        _print_for_people(answer)
    for warning in answer["warnings"]:
        typer.echo(f"seldinger: {warning}", err=True)


def _planar(request: PcarEstimate, plot: str | None) -> dict[str, Any]:
    from host.estimation import planar
    from host.mechanics import pcar

    catheter = catheter_for(request, "pcar")
    arcs = pcar.arcs_of(catheter, request.insertion_m, request.curvature_per_m)
    found = planar.estimate(arcs, [*request.tip.position_m, request.tip.angle_rad], thorough=True)
    if plot is not None:
        plot_shape(
            plot,
            f"{catheter.name}, force from the tip's pose",
            pcar.shape(arcs, found.curvature_per_m, PLOT_POINTS),
            pcar.shape(arcs, arcs.unloaded_curvature_per_m, PLOT_POINTS),
            found.force_N,
            np.array([request.tip.position_m]),
        )
    return {
        "force_N": found.force_N,
        "force_frame": "base",
        "covariance_N2": found.covariance_N2,
        "converged": found.converged,
        "residual": found.residual,
        "chi_square": found.chi_square,
        "iterations": found.iterations,
        "weakest_direction": found.weakest_direction,
        "weakest_std_N": found.weakest_std_N,
        "warnings": list(found.warnings),
    }


def _spatial(request: CosseratEstimate, plot: str | None) -> dict[str, Any]:
    from host.estimation.spatial import PoseSensor, estimate_cosserat

    catheter = catheter_for(request, "cosserat")
    sensors = [PoseSensor(sensor.offset_m, sensor.position_m, sensor.quaternion_wxyz) for sensor in request.sensors]
    arguments = (catheter, request.insertion_m, request.curvature_per_m)
    found = estimate_cosserat(*arguments, request.case, sensors)
    if plot is not None:
        from host.mechanics.cosserat import solve_cosserat

        drawn = np.linspace(catheter.distal_length_m + request.insertion_m, 0.0, PLOT_POINTS)
        loaded = solve_cosserat(*arguments, found.force_N, found.force_frame, stations_m=drawn)
        plot_shape(
            plot,
            f"{catheter.name}, force from poses, case {request.case}",
            loaded.station_positions_m,
            solve_cosserat(*arguments, stations_m=drawn).station_positions_m,
            np.asarray(loaded.force_base_N),
            np.array([sensor.position_m for sensor in request.sensors]),
        )
    return {
        "force_N": found.force_N,
        "force_frame": found.force_frame,
        "covariance_N2": found.covariance_N2,
        "converged": found.converged,
        "residual": found.residual,
        "chi_square": found.chi_square,
        "iterations": found.iterations,
        "weakest_direction": found.weakest_direction,
        "weakest_std_N": found.weakest_std_N,
        "solutions_N": found.solutions_N,
        "warnings": list(found.warnings),
    }


def _print_for_people(answer: dict[str, Any]) -> None:
    force, deviation = np.asarray(answer["force_N"]), np.sqrt(np.diag(answer["covariance_N2"]))
    for name, value, sigma in zip("xyz", force, deviation, strict=False):
        print(f"F{name} ({answer['force_frame']}): {value * 1e3:+9.3f} mN, standard deviation {sigma * 1e3:.2f} mN")
    print(
        f"{'converged' if answer['converged'] else 'NOT converged'}, residual {answer['residual']:.3g}, "
        f"chi square {answer['chi_square']:.3g}"
    )
