"""Inputs that were not recorded for a while: one value is repeated, and the output moves on as if it were driven.

An input may be meant to rest, and readings without noise may repeat a value while a mechanism sticks. Both follow the
nominal model about as well as the other samples do. A frozen channel does not: past its samples the model
fits, and over them it leaves a large part of the motion.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from host.diagnosis.estimation.fit import Fit
from host.diagnosis.model.data_rules import DataRules
from host.diagnosis.model.dataset import Recording, named_apart
from host.diagnosis.model.frozen import (
    HeldRun,
    frozen_finding,
    has_noise,
    held_runs,
    is_limit,
    jumps,
    moving,
    outside,
    turns_abruptly,
    without_runs,
)
from host.diagnosis.model.readings import Finding

Array = npt.NDArray[np.float64]


def without_frozen(
    recordings: Sequence[Recording],
    driven: set[str],
    outputs: Sequence[str],
    columns: dict[str, str],
    fitted: Callable[[list[Recording]], Fit],
    rules: DataRules,
) -> tuple[list[Recording], list[Finding]]:
    """Recordings without the runs in which a channel is frozen, and what was found.

    driven: outputs. outputs: channels that are compared. fitted: fits the nominal model to recordings.
    """
    candidates = [_candidates(recording, driven, rules) for recording in recordings]
    if not any(candidates):
        return list(recordings), []
    past = fitted([p for r, runs in zip(recordings, candidates, strict=True) for p in without_runs(r, runs, driven, rules)])
    whole = fitted(list(recordings))
    elsewhere = np.sqrt([_mean_square([r[row] for r in past.residuals]) for row in range(len(outputs))])
    least = rules.frozen_unexplained * np.array([_power(recordings, name) for name in outputs])
    kept, findings = [], []
    for recording, runs, residual in zip(recordings, candidates, whole.residuals, strict=True):
        sure = []
        for run in runs:
            about = slice(run.first, 2 * run.end - run.first)  # and as long behind it: a plant answers late
            error = np.sqrt([_mean_square([left[about]]) for left in residual])
            if np.any((error > rules.frozen_error_ratio * elsewhere) & (error**2 > least)):
                sure.append(run)
        kept += without_runs(recording, sure, driven, rules)
        for name in dict.fromkeys(run.name for run in sure):
            own = [run for run in sure if run.name == name]
            mover = _mover(recording, own[0], driven, rules)
            unit = recording.units.get(name, "")
            findings.append(frozen_finding(recording, own, columns.get(name, name), unit, columns.get(mover, mover)))
    return named_apart(kept), findings


def _candidates(recording: Recording, driven: set[str], rules: DataRules) -> list[HeldRun]:
    """Runs of one value that begin or end abruptly, while a channel on the other side of the model moves."""
    found = []
    for name, values in recording.channels.items():
        runs = held_runs(name, values, rules)
        free = outside(runs, values.size)
        noisy = bool(runs) and name in driven and has_noise(values, free, rules)
        for run in runs:
            alone = name not in driven or sum(other.value == run.value for other in runs) == 1  # else a dead zone
            abrupt = noisy or (name not in driven and turns_abruptly(values, run, free, rules))
            abrupt = jumps(values, run, free, rules) or (abrupt and alone and not is_limit(values, run))
            if abrupt and _mover(recording, run, driven, rules):
                found.append(run)
    return found


def _mover(recording: Recording, run: HeldRun, driven: set[str], rules: DataRules) -> str:
    """The channel on the other side of the model that moves on during the run; empty if none does."""
    others = [name for name in recording.channels if (name in driven) != (run.name in driven)]
    return moving(recording, run, others, rules)


def _mean_square(values: Sequence[Array]) -> float:
    together = np.concatenate(values)
    good = together[np.isfinite(together)]
    return float(np.mean(good**2)) if good.size else 0.0


def _power(recordings: Sequence[Recording], name: str) -> float:
    """Variance of channel `name` within the recordings."""
    found = [r.channels[name] - np.nanmean(r.channels[name]) for r in recordings if name in r.channels]
    return _mean_square(found) if found else np.inf
