"""Scripts of the experiments that a diagnosis proposes: TOML that a rig's commander gives, for other data timed inputs."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from host.diagnosis.design.experiment import Design, planned
from host.diagnosis.pipeline import Diagnosis


def write_scripts(result: Diagnosis, folder: Path) -> list[Path]:
    """Write one file for each experiment, next to the report. Raises OSError, InputError where a rig's limits forbid one."""
    out = []
    for number, design in enumerate(planned(result), start=1):
        path = folder / f"experiment_{number}"
        if result.model.inner.on_rig:
            from host.diagnosis.design.rig_experiment import script_of, write_script

            script = script_of(
                result.model.inner, result.problem, result.found.best, design.excitation, design.inputs, design.says
            )
            out.append(write_script(script, path.with_suffix(".toml")))
        else:
            out.append(write_table(result, design, path.with_suffix(".csv")))
    return out


def write_table(result: Diagnosis, design: Design, path: Path) -> Path:
    """Inputs over time (s) in SI units, as columns of the channels' names."""
    units = result.problem.segments[0].recording.units
    names = [f"{name} ({units[name]})" if units.get(name) else name for name in design.inputs]
    table = np.column_stack((design.excitation.time_s, *design.inputs.values()))
    head = ",".join(["time (s)" if result.problem.segments[0].recording.timed else "sample", *names])
    np.savetxt(path, table, fmt="%.7g", delimiter=",", header=f"{design.says}\n{head}", comments="# ")
    return path
