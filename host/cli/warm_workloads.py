"""Small real uses of every kernel that a command needs. Running one compiles its kernels; nothing lists kernels by hand.

A workload runs in a process of its own. It may use files that an earlier one left in the common folder.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

PLANAR = {"model": "pcar", "catheter": "thermocool_sf", "insertion_m": 0.02, "curvature_per_m": 15.7}
SPATIAL = {"model": "cosserat", "catheter": "livewire", "insertion_m": 0.01, "curvature_per_m": 10.0}
RECORDING = "recording.txt"  # file in the common folder that names the recording of the simulated rig


class Workload(NamedTuple):
    """A use of kernels: what it is for, what runs it (given the common folder), and the workloads that must come first.

    `after` also keeps two processes from compiling the same kernels at once.
    """

    title: str
    run: Callable[[Path], None]
    after: tuple[str, ...] = ()


def planar_model(folder: Path) -> None:
    """Solve and estimate with the planar model."""
    from host.estimation.requests import PcarEstimate, estimate_request
    from host.mechanics.requests import PcarSolve, solve_request
    from protocol.requests import plain, validate

    for stations_m in ([], [0.01]):
        request = validate(PcarSolve, {**PLANAR, "force_N": [0.0, -0.05], "stations_m": stations_m})
        answer, _ = solve_request(request, with_picture=True)
    estimate_request(validate(PcarEstimate, {**PLANAR, "tip": plain(answer["tip"])}), with_picture=True)


def _solved_rod(frame: str, tension_N: float) -> list[dict[str, object]]:
    from host.mechanics.requests import CosseratSolve, solve_request
    from protocol.requests import plain, validate

    load = {"force_N": [0.01, 0.04, -0.01], "force_frame": frame, "tendon_tension_N": tension_N}
    answer, _ = solve_request(validate(CosseratSolve, {**SPATIAL, **load, "stations_m": [0.02, 0.04]}), with_picture=True)
    poses = [answer["tip"], *answer["stations"]]
    return [{"offset_m": offset, **plain(pose)} for offset, pose in zip((0.0, 0.02, 0.04), poses, strict=True)]


def rod_model(folder: Path) -> None:
    """Solve with the rod model, in both frames, with and without tendon tension."""
    for frame in ("base", "tip"):
        for tension_N in (0.0, 1.0):
            _solved_rod(frame, tension_N)


def rod_estimates(folder: Path) -> None:
    """Estimate with the rod model, all sensor cases."""
    from host.estimation.requests import SENSORS_OF_CASE, CosseratEstimate, estimate_request
    from protocol.requests import validate

    poses = _solved_rod("base", 0.0)
    for case, count in SENSORS_OF_CASE.items():
        request = {**SPATIAL, "case": case, "sensors": poses[:count]}
        estimate_request(validate(CosseratEstimate, request), with_picture=False)


def many_cases(folder: Path) -> None:
    """Solve and estimate arrays of cases, with both models, as from Python."""
    import numpy as np

    from host.estimation import estimate_force
    from host.mechanics import solve
    from protocol.catheter import load_catheter

    rod, arcs = load_catheter("livewire"), load_catheter("thermocool_sf")
    shapes = solve(rod, 0.01, 10.0, np.array([[0.0, 0.01, 0.0], [0.0, 0.02, 0.0]]), stations_m=[0.0, 0.03])
    positions, quaternions = shapes.station_positions_m, shapes.station_quaternions_wxyz
    sensors = [(offset, positions[:, i], quaternions[:, i]) for i, offset in enumerate((0.0, 0.03))]
    estimate_force(rod, 0.01, 10.0, sensors, 4)
    planar = solve(arcs, 0.02, 15.0, np.array([[0.0, -0.05], [0.0, 0.05]]), model="pcar")
    estimate_force(arcs, 0.02, 15.0, [(0.0, planar.tip_position_m, planar.tip_angle_rad)], model="pcar")


def calibration(folder: Path) -> None:
    """Calibrate a catheter of each model from shapes that the model itself makes."""
    import json

    from host.identification.catheter_calibration import calibrate
    from host.mechanics.requests import CosseratSolve, PcarSolve, solve_request
    from protocol.requests import plain, validate

    offsets_m = [0.0, 0.01, 0.02, 0.03, 0.04]
    for base, model, force_N in ((PLANAR, PcarSolve, [0.0, -0.05]), (SPATIAL, CosseratSolve, [0.01, 0.04, 0.0])):
        recordings = []
        for scale in (0.0, 1.0, 2.0):
            load = {"force_N": [scale * part for part in force_N], "force_frame": "base", "stations_m": offsets_m}
            request = validate(model, {**base, **load})  # type: ignore[type-var]
            answer, _ = solve_request(request, with_picture=False)  # type: ignore[arg-type]
            markers = [
                {"offset_m": offset, "position_m": plain(station["position_m"])}
                for offset, station in zip(offsets_m, answer["stations"], strict=True)
            ]
            shape = {key: base[key] for key in ("insertion_m", "curvature_per_m")}
            recordings.append({**shape, "force_N": load["force_N"], "markers": markers})
        shapes = folder / f"shapes_{base['model']}.json"
        shapes.write_text(json.dumps({"recordings": recordings}), encoding="utf-8")
        catheter, model_name = str(base["catheter"]), str(base["model"])
        calibrate(str(shapes), catheter, model=model_name, fit=("stiffness",), leave_one_out=False)


def simulated_rig(folder: Path) -> None:
    """Run the demo for a second: control tick, plant, estimator, recording."""
    from host.run.demo import DemoSettings, run_lockstep

    run = run_lockstep(DemoSettings(board="native", hold_s=1.0, pace=0.0, directory=folder))
    (folder / RECORDING).write_text(str(run.recording), encoding="utf-8")


def control_loop(folder: Path) -> None:
    """Run the wall-clock loop with the real tick."""
    from protocol.rig_file import SIMULATED_RIG, load_rig
    from realtime.control.configure import tick_parameters
    from realtime.control.tick import tick
    from realtime.core.control_loop import run
    from realtime.loop.latency import check_latency

    check_latency(tick, tick_parameters(load_rig(SIMULATED_RIG)), 1000, 0.2, None, compare_cyclictest=False, run=run)


def rig_processes(folder: Path) -> None:
    """Run rig, realtime and model process on the wall clock, as `demo --wall-clock` and `view --simulated` do."""
    from host.run.demo import DemoSettings
    from host.run.wall_clock import run_wall_clock

    run_wall_clock(DemoSettings(board="native", hold_s=1.0, directory=folder), lambda phase, share, force: None)


def shape_on_the_page(folder: Path) -> None:
    """Draw the recorded catheter as the page does."""
    from host.recordings.recording import RecordingFile
    from host.view.replay import Replay

    player = Replay(RecordingFile(Path((folder / RECORDING).read_text(encoding="utf-8"))), 50.0)
    player.hello()
    for at_s in (1.0, 4.0):
        player.act(f'{{"seek_s": {player.hello()["begin"] + at_s}}}')
        player.frame()


def commissioning(folder: Path) -> None:
    """Fit sweeps of an axis, and evaluate the tuning's criterion on the simulated rig."""
    import numpy as np

    from host.commissioning.sweep_fits import Run, fit_play
    from host.commissioning.tuning import criterion, present_gains
    from protocol.rig_file import SIMULATED_RIG, load_rig

    time_s = np.arange(0.0, 13.0, 0.01)
    encoder = 0.01 * np.sin(time_s)
    runs = [Run(time_s, encoder, time_s, encoder, 0.01, 1.0)]
    fit_play(runs, 0.012, 3e-4)
    rig = load_rig(SIMULATED_RIG)
    criterion(rig, present_gains(rig), forces_N=(0.2,), iterations=10)


def diagnosis_of_tables(folder: Path) -> None:
    """Diagnose tables of a mass on a spring with friction."""
    import numpy as np

    from host.diagnosis import diagnose

    rng, time_s = np.random.default_rng(1), np.arange(0.0, 8.0, 0.01)
    nominal = {
        "name": "stage",
        "kind": "axis",
        "data": {"time": "t"},
        "channels": {"force": {"column": "f", "unit": "N"}, "position": {"column": "x", "unit": "m"}},
        "axis": {"subsystem": "stage", "input": "force", "output": "position", "terms": ["mass", "damping", "stiffness"]},
    }
    tables = []
    for phase in range(3):
        force = np.sin(4.0 * time_s + phase) + 0.5 * np.sin(9.0 * time_s)
        x, v, position = 0.0, 0.0, np.empty_like(time_s)
        for index, f in enumerate(force):
            v += 0.01 * (f - v - 40.0 * x - 0.3 * math.tanh(v / 1e-3))
            x += 0.01 * v
            position[index] = x
        tables.append({"t": time_s, "f": force, "x": position + 1e-4 * rng.normal(size=time_s.size)})
    diagnose(tables, nominal)


def diagnosis_of_the_rig(folder: Path) -> None:
    """Diagnose the recording of the simulated rig with the nominal model `rig`."""
    from host.diagnosis import diagnose

    diagnose([(folder / RECORDING).read_text(encoding="utf-8")], "rig")


def live_diagnosis(folder: Path) -> None:
    """Compare made-up messages of a rig with its twin."""
    from host.diagnosis.live.watch import warm_up
    from protocol.rig_file import SIMULATED_RIG, load_rig

    warm_up(load_rig(SIMULATED_RIG))


# In the order in which they start, the longest chains first.
WORKLOADS = {
    "rod": Workload("rod model", rod_model),
    "rig": Workload("simulated rig and control tick", simulated_rig),
    "planar": Workload("planar model", planar_model, ("rig",)),
    "estimates": Workload("force from poses, cases 1 to 6", rod_estimates, ("rod",)),
    "arrays": Workload("arrays of cases, both models", many_cases, ("estimates", "planar")),
    "loop": Workload("wall-clock loop", control_loop, ("rig",)),
    "tables": Workload("diagnosis of tables", diagnosis_of_tables),
    "processes": Workload("rig on the wall clock", rig_processes, ("loop", "planar")),
    "rig diagnosis": Workload("diagnosis of the rig's recordings", diagnosis_of_the_rig, ("rig", "tables")),
    "live": Workload("live diagnosis", live_diagnosis, ("rig diagnosis",)),
    "page": Workload("shape on the page", shape_on_the_page, ("planar",)),
    "commissioning": Workload("sweeps and tuning", commissioning, ("rig",)),
    "calibration": Workload("calibration of a catheter", calibration, ("planar", "rod")),
}
