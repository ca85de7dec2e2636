"""Figures of the controller on the simulated rig, each with its reference from the same run."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from host.studies.control import oracle as control_oracle
from host.studies.control import runs as control_runs
from host.studies.control import timing as control_timing
from host.studies.control.runs import IRREGULAR, REGULAR, STILL, WANTED_N, Held, with_control
from protocol.rig_file import SIMULATED_RIG, Rig, load_rig

PLAY_OFF_m = 0.0006  # accuracy of the backlash in the thesis
TRACKER_NOISE_m = 0.0004  # of one axis, for positioning
# The thesis' law with gains raised for a beating wall, as far as it does not ring on a still one.
RETUNED = {"force_gain_m_per_N": 0.06, "force_integral_m_per_N_s": 0.03}
# The same in the PI form: (7.6) with 25 times its position integral; at 33 times it rings (sd 60 mN on a still wall).
RETUNED_PI = {"pi_position_integral_per_s": 6.0}
SECTIONS = ("force", "touch", "kept", "prediction", "positions", "tick", "latency", "limits")
Progress = Callable[[str], None]


@dataclass(frozen=True)
class StudySettings:
    """seeds: runs of each kind; hold_s after contact; goals for positioning; sections: which of SECTIONS."""

    seeds: tuple[int, ...] = (1, 2, 3)
    hold_s: float = 60.0
    goals: int = 50
    rig_file: Path = SIMULATED_RIG
    sections: tuple[str, ...] = SECTIONS


def _quiet(text: str) -> None:
    """Ignore `text`; the default of `progress`."""


def study(settings: StudySettings, progress: Progress = _quiet) -> dict[str, Any]:
    """All figures of the chosen sections. Raises InputError, BoardUnavailable before anything moves."""
    rig = load_rig(settings.rig_file)
    result: dict[str, Any] = {
        "wanted_force_N": WANTED_N,
        "seeds": list(settings.seeds),
        "hold_s": settings.hold_s,
        "board": "native",
        "clock": "virtual",
        "settled_after_s": control_runs.SETTLED_S,
    }
    runs = _Runs(rig, settings, progress)
    for name in SECTIONS:
        if name in settings.sections:
            progress(name)
            result[name] = _SECTION[name](runs)
    return result


_LAWS: dict[str, dict[str, Any]] = {
    "thesis": {"law": "thesis", "form": "pi"},
    "incremental": {"law": "thesis", "form": "incremental", "force_added_to": "tip"},
    "retuned": {"law": "thesis", "form": "incremental", "force_added_to": "tip", **RETUNED},
    "retuned_pi": {"law": "thesis", "form": "pi", **RETUNED_PI},
}


class _Runs:
    """Runs are made once and used by several sections."""

    def __init__(self, rig: Rig, settings: StudySettings, progress: Progress) -> None:
        self.rig, self.settings, self.progress = rig, settings, progress
        self._held: dict[tuple[str, str, int], Held] = {}

    def held(self, kind: str, beat: str) -> list[Held]:
        """Holding with `kind` (predictive, pose or one of _LAWS) on a `beat` (regular, irregular, still), one a seed."""
        heart = {"regular": REGULAR, "irregular": IRREGULAR, "still": STILL}[beat]
        rig = with_control(self.rig, **_LAWS.get(kind, {"law": "predictive"}))
        seconds = 6.0 if beat == "still" else self.settings.hold_s
        for seed in self.settings.seeds:
            if (kind, beat, seed) not in self._held:
                self.progress(f"{kind}, {beat} beat, seed {seed}: {seconds:g} s")
                self._held[kind, beat, seed] = control_runs.hold(
                    rig, seed, heart, seconds, "estimate" if kind == "pose" else "sensor"
                )
        return [self._held[kind, beat, seed] for seed in self.settings.seeds]


def _summary(values: Iterable[float]) -> dict[str, Any]:
    each = [float(value) for value in values]
    return {"mean": float(np.mean(each)), "worst": float(np.max(each)), "each": each}


def _force(runs: _Runs) -> dict[str, Any]:
    """Return the RMS force errors after settling, for each law and seed."""
    seeds, rig = runs.settings.seeds, runs.rig
    table: dict[str, Any] = {}
    for beat in ("regular", "irregular"):
        for kind in ("predictive", "thesis", "retuned_pi", "incremental", "retuned", "pose"):
            table[f"{kind}_{beat}_rms_N"] = _summary(run.rms_N(WANTED_N) for run in runs.held(kind, beat))
    table["pose_regular_spread_N"] = _summary(run.spread_N() for run in runs.held("pose", "regular"))
    runs.progress("still catheter, oracle")
    table["still_rms_N"] = _summary(control_runs.still(rig, seed, 10.0) for seed in seeds)
    table["oracle_rms_N"] = _summary(control_oracle.rms_N(rig, seed, REGULAR, 10.0, WANTED_N) for seed in seeds)
    ours, still = table["predictive_regular_rms_N"]["mean"], table["still_rms_N"]["mean"]
    table["of_thesis"] = ours / table["thesis_regular_rms_N"]["mean"]
    table["of_thesis_retuned"] = ours / min(table[f"{kind}_regular_rms_N"]["mean"] for kind in ("retuned", "retuned_pi"))
    table["of_still"] = ours / still
    table["pose_of_still"] = table["pose_regular_rms_N"]["mean"] / still
    of_thesis = max(table["of_thesis"], table["of_thesis_retuned"])
    table["reached"] = bool(of_thesis <= 0.5 and table["of_still"] <= 0.25 and table["pose_of_still"] <= 0.5)
    return table


def _touch(runs: _Runs) -> dict[str, Any]:
    """Force above the wanted one in the first seconds of a touch at the rig file's approach speed."""
    table: dict[str, Any] = {"approach_speed_m_per_s": runs.rig.control.approach_speed_m_per_s}
    for beat in ("still", "regular"):
        for kind in ("predictive", "thesis", "retuned"):
            table[f"{kind}_{beat}_overshoot_N"] = _summary(run.overshoot_N(WANTED_N) for run in runs.held(kind, beat))
    table["reached"] = bool(max(table[f"predictive_{beat}_overshoot_N"]["worst"] for beat in ("still", "regular")) < 0.05)
    return table


def _kept(runs: _Runs) -> dict[str, Any]:
    """Share of the time in contact, from the first touch on."""
    table: dict[str, Any] = {}
    for kind in ("predictive", "thesis", "retuned", "pose"):
        for beat in ("regular", "irregular"):
            each = [run.kept() for run in runs.held(kind, beat)]
            table[f"{kind}_{beat}_share"] = {"mean": float(np.mean(each)), "worst": float(np.min(each)), "each": each}
    table["reached"] = bool(min(table[f"predictive_{beat}_share"]["worst"] for beat in ("regular", "irregular")) == 1.0)
    return table


def _prediction(runs: _Runs) -> dict[str, Any]:
    """Return the RMS errors of the wall predicted 40 ms ahead."""
    table: dict[str, Any] = {"ahead_s": control_runs.AHEAD_S}
    for source, by_pose in (("force", False), ("pose", True)):
        for beat, heart, wanted in (("regular", REGULAR, 0.25), ("irregular", IRREGULAR, 0.5)):
            each = [control_runs.predict_target(runs.rig, seed, heart, by_pose) for seed in runs.settings.seeds]
            errors = {name: float(np.mean([getattr(one, name) for one in each])) for name in each[0]._fields}
            share = errors["predictor_m"] / errors["holding_m"]
            table[f"by_{source}_{beat}"] = {**errors, "of_holding": share, "reached": share <= wanted}
    return table


def _positions(runs: _Runs) -> dict[str, Any]:
    """The tip to random points, by the predictive law and by the thesis' integral controller."""
    noisy = with_control(runs.rig, "tracker", position_noise_m=TRACKER_NOISE_m)
    thesis = with_control(noisy, law="thesis", form="incremental", position_integral_per_s2=0.0, approach_speed_m_per_s=0.02)
    goals = control_runs.random_goals(runs.rig, runs.settings.goals, 5)
    table: dict[str, Any] = {"goals": len(goals), "tracker_noise_m": TRACKER_NOISE_m}
    for name, rig in (("predictive", noisy), ("thesis", thesis)):
        runs.progress(f"positions, {name}: {len(goals)} goals")
        there = control_runs.go_to(rig, goals, runs.settings.seeds[0])
        table[name] = {
            "rms_m": float(np.sqrt(np.mean(there.rms_m**2))),
            "worst_rms_m": float(np.max(there.rms_m)),
            "overshoot_m": float(np.max(there.overshoot_m)),
            "settled_p50_s": float(np.median(there.settled_s)),
            "settled_max_s": float(np.max(there.settled_s)),
            "distance_mean_m": float(np.mean(there.distance_m)),
            "stopped_by": there.stopped_by,
        }
    ours = table["predictive"]
    stopped = any(table[name]["stopped_by"] for name in ("predictive", "thesis"))
    accurate = ours["rms_m"] <= 5e-4 and ours["overshoot_m"] < 1e-3 and ours["settled_max_s"] <= 2.0
    table["reached"] = bool(accurate and not stopped)
    return table


def _tick(runs: _Runs) -> dict[str, Any]:
    """Time of the compiled tick in contact, everything on."""
    table = {law: control_timing.tick_us(with_control(runs.rig, law=law)) for law in ("predictive", "thesis")}
    return {**table, "reached": bool(table["predictive"]["p50"] < 20.0 and table["predictive"]["p999"] < 60.0)}


def _latency(runs: _Runs) -> dict[str, Any]:
    """From the arrival of a pose to the first step edge that is there because of it, virtual time."""
    each = [control_runs.pose_to_step(runs.rig, seed) for seed in runs.settings.seeds]
    return {
        "pose_to_step_s": _summary(each),
        "setpoint_lead_s": runs.rig.board.setpoint_lead_s,
        "reached": bool(max(each) < 0.006),
    }


def _limits(runs: _Runs) -> dict[str, Any]:
    """Return the errors with a wrong backlash width, one seed."""
    table: dict[str, Any] = {}
    play_m, seed = runs.rig.transmission.insertion_backlash_m, runs.settings.seeds[0]
    for name, off_m in (("narrower", -PLAY_OFF_m), ("wider", PLAY_OFF_m)):
        rig = with_control(runs.rig, "transmission", insertion_backlash_m=play_m + off_m)
        for source in ("sensor", "estimate"):
            runs.progress(f"configured backlash off by {off_m * 1e3:+.1f} mm {name}, {source}")
            run = control_runs.hold(rig, seed, REGULAR, min(runs.settings.hold_s, 20.0), source)
            table[f"backlash_configured_{name}_{source}_rms_N"] = run.rms_N(WANTED_N)
    return table


_SECTION: dict[str, Callable[[_Runs], dict[str, Any]]] = {
    "force": _force,
    "touch": _touch,
    "kept": _kept,
    "prediction": _prediction,
    "positions": _positions,
    "tick": _tick,
    "latency": _latency,
    "limits": _limits,
}


def table_lines(result: dict[str, Any]) -> list[str]:
    """The table as text, one line for each figure."""
    lines: list[str] = []
    for name in SECTIONS:
        if name in result:
            lines += [f"{name}:", *_lines(result[name], 1)]
    return lines


def _lines(table: dict[str, Any], depth: int) -> list[str]:
    lines = []
    for key, value in table.items():
        if isinstance(value, dict) and "each" in value:
            each = ", ".join(_number(key, one) for one in value["each"])
            lines.append(f"{'  ' * depth}{_plain(key):<44}{_number(key, value['mean']):>12}   ({each})")
        elif isinstance(value, dict):
            lines += [f"{'  ' * depth}{_plain(key)}:", *_lines(value, depth + 1)]
        else:
            lines.append(f"{'  ' * depth}{_plain(key):<44}{_number(key, value):>12}")
    return lines


_UNITS: Sequence[tuple[str, float, str]] = (
    ("_m_per_s", 1e3, "mm/s"),
    ("_N", 1e3, "mN"),
    ("_m", 1e3, "mm"),
    ("_s", 1.0, "s"),
    ("_share", 100.0, "%"),
)


def _plain(key: str) -> str:
    for suffix, _, _ in _UNITS:
        key = key.removesuffix(suffix)
    return key.replace("_", " ")


def _number(key: str, value: Any) -> str:
    if isinstance(value, str):
        return value or "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    for suffix, scale, unit in _UNITS:
        if key.endswith(suffix):
            return f"{scale * value:.3g} {unit}"
    return f"{value:.3g}"
