"""`seldinger solve`: the static shape of a catheter under a tip force, by the planar or the spatial model."""

from __future__ import annotations

import math
from typing import Annotated, Any

import typer

from host.cli.contract_io import write_json
from host.cli.options import Json, RequestFile, plot_file


def solve(
    request: RequestFile,
    json: Json = False,
    plot: Annotated[str | None, typer.Option(help="PNG file for a drawing of the shape.")] = None,
) -> None:
    """Compute shape, tip pose and internal state of a loaded catheter.

    Exit status 1 where the branch of equilibria that starts at the unloaded shape ends before full load.
    """
    from host.mechanics.requests import CosseratSolve, PcarSolve, read_request, solve_request
    from host.report.shape_plot import plot_shape

    plot_file(plot)
    answer, picture = solve_request(read_request(request, PcarSolve, CosseratSolve), with_picture=plot is not None)
    if plot is not None and picture is not None:
        plot_shape(plot, *picture)
    if json:
        write_json(answer)
    else:
        _print_table(answer)
    if not answer["converged"]:
        typer.echo(
            f"seldinger: no equilibrium at full load ({answer['reason']}); the branch from the unloaded shape was followed "
            f"up to {answer['load_reached'] * 100:.1f} % of it",
            err=True,
        )
        raise typer.Exit(1)


def _print_table(answer: dict[str, Any]) -> None:
    if not answer["converged"]:
        return
    tip = answer["tip"]
    print("tip (mm):        " + "  ".join(f"{value * 1e3:+.4f}" for value in tip["position_m"]))
    if "angle_rad" in tip:
        print(f"tip angle (deg): {math.degrees(tip['angle_rad']):+.4f}")
        print("arcs (1/m):      " + "  ".join(f"{value:+.4f}" for value in answer["arc_curvatures_per_m"]))
    else:
        print("tip quaternion:  " + "  ".join(f"{value:+.6f}" for value in tip["quaternion_wxyz"]))
        print("force in tip (N): " + "  ".join(f"{value:+.5f}" for value in answer["force_tip_N"]))
    for station in answer["stations"]:
        print("station (mm):    " + "  ".join(f"{value * 1e3:+.4f}" for value in station["position_m"]))
    print(f"equilibrium {'stable' if answer['stable'] else 'unstable'}, {answer['iterations']} iterations")
