"""`seldinger solve`: the static shape of a catheter under a tip force, by the planar or the spatial model."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import typer

from host.cli.contract_io import write_json
from host.cli.shape_plot import check_plot_path, plot_shape
from host.cli.static_requests import CosseratSolve, PcarSolve, catheter_for, read_request

PLOT_POINTS = 121


def solve(
    request: Annotated[str, typer.Argument(help="the request: a JSON file, or - for standard input")],
    json: Annotated[bool, typer.Option("--json", help="one JSON object on standard output")] = False,
    plot: Annotated[str | None, typer.Option(help="draw the shape into this PNG file")] = None,
) -> None:
    """Shape, tip pose and internal state of a loaded catheter. Status 1 where the load's branch has no answer."""
    check_plot_path(plot)
    checked = read_request(request, PcarSolve, CosseratSolve)  # type: ignore[type-var]
    answer = _planar(checked, plot) if isinstance(checked, PcarSolve) else _spatial(checked, plot)  # type: ignore[arg-type]
    if json:
        write_json(answer)
    else:
        _print_for_people(answer)
    if not answer["converged"]:
        reason = answer["reason"]
        typer.echo(
            f"seldinger: no equilibrium at full load ({reason}); the branch from the unloaded shape was followed "
            f"up to {answer['load_reached'] * 100:.1f} % of it",
            err=True,
        )
        raise typer.Exit(1)


def _planar(request: PcarSolve, plot: str | None) -> dict[str, Any]:
    from host.mechanics import pcar

    catheter = catheter_for(request, "pcar")
    arcs = pcar.arcs_of(catheter, request.insertion_m, request.curvature_per_m)
    total = arcs.total_length_m
    found = pcar.solve(arcs, request.force_N)
    if not found.converged:
        return {
            "converged": False,
            "reason": found.status.name.lower(),
            "load_reached": found.load_share,
            "iterations": found.iterations,
        }
    # inside the sheath the catheter is straight
    stations = [
        pcar.point_at(arcs, found.curvature_per_m, total - back) if back <= total else (np.array([total - back, 0.0]), 0.0)
        for back in request.stations_m
    ]
    if plot is not None:
        plot_shape(
            plot,
            f"{catheter.name}, circular arcs",
            pcar.shape(arcs, found.curvature_per_m, PLOT_POINTS),
            pcar.shape(arcs, arcs.unloaded_curvature_per_m, PLOT_POINTS),
            np.array(request.force_N),
            np.empty((0, 2)),
        )
    return {
        "tip": {"position_m": found.tip_position_m, "angle_rad": found.tip_angle_rad},
        "arc_curvatures_per_m": found.curvature_per_m,
        "arc_lengths_m": arcs.length_m,
        "stations": [{"position_m": position, "angle_rad": angle} for position, angle in stations],
        "iterations": found.iterations,
        "converged": True,
        "stable": found.stable,
    }


def _spatial(request: CosseratSolve, plot: str | None) -> dict[str, Any]:
    from host.mechanics.cosserat import solve_cosserat

    catheter = catheter_for(request, "cosserat")
    total = catheter.distal_length_m + request.insertion_m
    drawn = np.linspace(total, 0.0, PLOT_POINTS) if plot is not None else np.empty(0)
    arguments = (catheter, request.insertion_m, request.curvature_per_m)
    found = solve_cosserat(
        *arguments,
        request.force_N,
        request.force_frame,
        request.tendon_tension_N,
        np.concatenate([request.stations_m, drawn]),
    )
    if not found.converged:
        return {
            "converged": False,
            "reason": found.reason,
            "load_reached": found.load_reached,
            "iterations": found.iterations,
        }
    count = len(request.stations_m)
    if plot is not None:
        unloaded = solve_cosserat(*arguments, stations_m=drawn)
        plot_shape(
            plot,
            f"{catheter.name}, rod",
            found.station_positions_m[count:],
            unloaded.station_positions_m,
            np.asarray(found.force_base_N),
            np.empty((0, 3)),
        )
    stations = zip(found.station_positions_m[:count], found.station_quaternions_wxyz[:count], strict=True)
    return {
        "tip": {"position_m": found.tip_position_m, "quaternion_wxyz": found.tip_quaternion_wxyz},
        "stations": [{"position_m": position, "quaternion_wxyz": turn} for position, turn in stations],
        "force_tip_N": found.force_tip_N,
        "force_base_N": found.force_base_N,
        "iterations": found.iterations,
        "converged": True,
        "stable": found.stable,
        "branch": found.branch,
    }


def _print_for_people(answer: dict[str, Any]) -> None:
    if not answer["converged"]:
        return
    tip = answer["tip"]
    print("tip (mm):        " + "  ".join(f"{value * 1e3:+.4f}" for value in tip["position_m"]))
    if "angle_rad" in tip:
        print(f"tip angle (deg): {np.degrees(tip['angle_rad']):+.4f}")
        print("arcs (1/m):      " + "  ".join(f"{value:+.4f}" for value in answer["arc_curvatures_per_m"]))
    else:
        print("tip quaternion:  " + "  ".join(f"{value:+.6f}" for value in tip["quaternion_wxyz"]))
        print("force in tip (N): " + "  ".join(f"{value:+.5f}" for value in answer["force_tip_N"]))
    for station in answer["stations"]:
        print("station (mm):    " + "  ".join(f"{value * 1e3:+.4f}" for value in station["position_m"]))
    print(f"equilibrium {'stable' if answer['stable'] else 'unstable'}, {answer['iterations']} iterations")
