"""One concealed case from recording to verdict as a picture: the recording, what each model leaves, what was said and true.

`python -m host.studies.proof.picture --dir runs/prove_7_200 --case case_0012 --out case.png` after `seldinger prove`.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from host.diagnosis.model.dataset import find_files
from host.diagnosis.model.nominal import read_nominal
from host.diagnosis.pipeline import Diagnosis, diagnose
from host.diagnosis.report.pictures import FAULT, SHADE, shown
from host.diagnosis.report.verdict import as_json
from host.report.style import _STYLE, ESTIMATED, INK, MEASURED, MUTED, legend_above, thinned

Array = np.ndarray
INPUT_COLOURS = (INK, ESTIMATED, MUTED)


def draw_case(case: Path, label: dict[str, Any], out: Path) -> dict[str, Any]:
    """Diagnoses the recordings in folder `case` and draws them with the sealed `label` into `out` (PNG). The verdict."""
    spec = read_nominal(case / "nominal.toml")
    files = find_files(spec, [str(p) for p in sorted(case.glob("*.csv")) + sorted(case.glob("*.parquet"))], None)
    result = diagnose(spec, files, lambda what, part: None)
    verdict = as_json(result, 0.0)
    with matplotlib.rc_context(_STYLE | {"figure.facecolor": "white", "savefig.facecolor": "white"}):
        figure = Figure(figsize=(8.2, 5.9), layout=ConstrainedLayoutEngine(w_pad=0.05, h_pad=0.06))
        top, middle, bottom, words = figure.subplots(4, 1, height_ratios=[1.0, 1.0, 1.0, 0.62])
        _recording(result, top)
        _left(result, verdict, middle, bottom)
        _words(verdict, label, words)
        figure.savefig(out, dpi=160, metadata={"Software": None})
    return verdict


def _recording(result: Diagnosis, axes: Axes) -> None:
    """Inputs of the held-out recording, each as a share of its own range."""
    segment, _, _ = shown(result)
    names = [name for name in result.model.quiet_inputs if name in segment.inputs]
    for name, colour in zip(names, INPUT_COLOURS, strict=False):
        share = segment.inputs[name] / (np.max(np.abs(segment.inputs[name])) or 1.0)
        axes.plot(*thinned(segment.recording.time_s, share), color=colour, label=name.replace("_", " "))
    axes.set(ylabel="of its range", title="")
    axes.tick_params(labelbottom=False)
    legend_above(axes, 4)


def _left(result: Diagnosis, verdict: dict[str, Any], before: Axes, after: Axes) -> None:
    """Return the residuals of both models (refitted nominal, extended) for the output with the largest mismatch."""
    segment, index, row = shown(result)
    unit, sigma = result.model.outputs[row].unit, result.full.noise[row].sigma
    scale, unit = (1e3, f"m{unit}") if unit in ("m", "rad", "N") else (1.0, unit)
    pairs = (
        (before, result.full_rate.nominal, FAULT, "the refitted nominal model"),
        (after, result.full_rate.best, MEASURED, "the model with what was found"),
    )
    limit = 1.05 * scale * float(np.nanmax(np.abs(result.full_rate.nominal.residuals[index][row])))
    for axes, fit, colour, name in pairs:
        axes.plot(
            *thinned(segment.recording.time_s, scale * fit.residuals[index][row]),
            color=colour,
            lw=0.8,
            label=f"{result.model.outputs[row].channel.replace('_', ' ')}, recorded less {name}",
        )
        axes.axhspan(-scale * sigma, scale * sigma, color="#e9edf1", zorder=0, label="noise (1 sigma)")
        axes.set(ylim=(-limit, limit), ylabel=unit)
    legend_above(after, 2)
    first, last = float(segment.recording.time_s[0]), float(segment.recording.time_s[-1])
    spans = [(a, b) for location in verdict["located"] for a, b in location["windows_s"] if b > first and a < last]
    for k, (a, b) in enumerate(spans):
        before.axvspan(max(a, first), min(b, last), color=SHADE, zorder=-1, label="" if k else "windows named")
    legend_above(before, 3)
    for axes in (before, after):
        axes.set_xlim(first, last)
    before.tick_params(labelbottom=False)
    after.set_xlabel("time (s)")


def _words(verdict: dict[str, Any], label: dict[str, Any], axes: Axes) -> None:
    """Verdict, and what was under the seal."""
    axes.set_axis_off()
    said = [
        f"{e['id']} at {e['subsystem']}: " + ", ".join(_interval(*p) for p in e["parameters"].items())
        for e in verdict["effects"]
    ]
    planted = [
        f"{item['id']} at {place.partition('@')[2]}: "
        + ", ".join(f"{key} = {value:.4g}" for key, value in item["parameters"].items())
        for item, place in zip(label["planted"], label["truth"], strict=True)
    ]
    fit, loop = verdict["fit"], "closed" if label["closed_loop"] else "open"
    error = f"Held-out error {fit['rmse_before']:.3g} -> {fit['rmse_after']:.3g} {fit['unit']}"
    lines = [
        f"Verdict: {verdict['verdict'].replace('_', ' ')}. {'; '.join(said) or 'No effect named'}",
        f"{error}, noise {fit['noise_floor']:.3g} {fit['unit']}",
        f"Under the seal: {'; '.join(planted) or 'nothing'} (rho {label['rho']:.2f}, {loop} loop)",
    ]
    axes.text(0.0, 0.95, "\n".join(lines), va="top", linespacing=1.7, fontsize=9, wrap=True)


def _interval(key: str, parameter: dict[str, Any]) -> str:
    low, high = parameter["ci95"]
    return f"{key} = {parameter['value']:.4g} [{low:.4g}, {high:.4g}]"


def main(arguments: Sequence[str] | None = None) -> None:
    """Draw one case of a finished run."""
    parser = argparse.ArgumentParser(prog="python -m host.studies.proof.picture")
    parser.add_argument("--dir", type=Path, required=True, help="folder of a run of `seldinger prove`")
    parser.add_argument("--case", required=True)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args(arguments)
    labels = json.loads((given.dir / "sealed" / "labels.json").read_text(encoding="utf-8"))["labels"]
    label = next((item for item in labels if item["id"] == given.case), None)
    if label is None:
        parser.error(f"--case: found {given.case!r}, wanted one of {labels[0]['id']} to {labels[-1]['id']}")
    draw_case(given.dir / "cases" / given.case, label, given.out)


if __name__ == "__main__":
    main()
