"""`seldinger estimate`: the force at the tip from tracked poses, with its covariance and whether it explains the poses."""

from __future__ import annotations

import math
from typing import Annotated, Any

import typer

from host.cli.contract_io import write_json
from host.cli.options import Json, RequestFile, plot_file


def estimate(
    request: RequestFile,
    json: Json = False,
    plot: Annotated[str | None, typer.Option(help="PNG file for a drawing of the shape and the force.")] = None,
) -> None:
    """Estimate the force at the tip from poses.

    A pose that no force explains is answered with "converged": false, its residual, and exit status 1.
    """
    from host.estimation.requests import CosseratEstimate, PcarEstimate, estimate_request
    from host.mechanics.requests import read_request
    from host.report.shape_plot import plot_shape

    plot_file(plot)
    answer, picture = estimate_request(read_request(request, PcarEstimate, CosseratEstimate), with_picture=plot is not None)
    if plot is not None and picture is not None:
        plot_shape(plot, *picture)
    if json:
        write_json(answer)
    else:
        _print_table(answer)
    for warning in answer["warnings"]:
        typer.echo(f"seldinger: {warning}", err=True)
    if not answer["converged"]:
        raise typer.Exit(1)


def _print_table(answer: dict[str, Any]) -> None:
    variances = [row[index] for index, row in enumerate(answer["covariance_N2"])]
    for name, value, variance in zip("xyz", answer["force_N"], variances, strict=False):
        deviation = f"standard deviation {math.sqrt(variance) * 1e3:.2f} mN"
        print(f"F{name} ({answer['force_frame']}): {value * 1e3:+9.3f} mN, {deviation}")
    print(
        f"{'converged' if answer['converged'] else 'NOT converged'}, residual {answer['residual']:.3g}, "
        f"chi square {answer['chi_square']:.3g}"
    )
