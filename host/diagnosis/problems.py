"""From files to what is fitted: recordings that can be compared, the model, the problem, and the candidate effects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from host.diagnosis.effects import candidates
from host.diagnosis.estimation import noise as noise_module
from host.diagnosis.estimation.fit import Problem
from host.diagnosis.estimation.known import Known
from host.diagnosis.estimation.noise import Noise
from host.diagnosis.estimation.rules import RULES, SelectionRules
from host.diagnosis.live.recorded_rig import RecordedRig
from host.diagnosis.model import readings
from host.diagnosis.model.dataset import Recording, load, read_tables, thin
from host.diagnosis.model.effect import Candidate, Port
from host.diagnosis.model.findings import Finding, Inspected, inspect
from host.diagnosis.model.model import Model
from host.diagnosis.model.nominal import NominalSpec
from host.diagnosis.model.tables import Table
from host.diagnosis.models import build, channels_of
from protocol.errors import InputError


class NothingToCompare(Exception):
    """No recording has what the nominal model compares; `findings` say why."""

    def __init__(self, findings: list[Finding]) -> None:
        super().__init__(" ".join(finding.says for finding in findings))
        self.findings = findings


def inspected(spec: NominalSpec, sources: Sequence[Path | Table], rules: SelectionRules = RULES) -> Inspected:
    """Recordings as they can be compared, and what is wrong with them. Raises InputError, NothingToCompare."""
    if spec.recorded_rig and not all(isinstance(source, Path) for source in sources):
        raise InputError("recordings", "arrays", "files (MCAP): a recorded rig is described in its own recordings")
    tables = read_tables(spec, sources)
    spec._files = [table.path for table in tables if table.path is not None]
    needed, optional = channels_of(spec)
    data = inspect(spec, load(spec, tables, needed, optional, rules.data), rules.data)
    if not data.recordings:
        raise NothingToCompare(data.findings)
    return data


def prepare(
    spec: NominalSpec, sources: Sequence[Path | Table], rules: SelectionRules = RULES
) -> tuple[Model, Problem, Problem]:
    """Model, the problem at the rate that is fitted, and the problem at full rate. Raises InputError, NothingToCompare."""
    return problems(spec, inspected(spec, sources, rules).recordings, rules)


def problems(
    spec: NominalSpec, recordings: list[Recording], rules: SelectionRules = RULES
) -> tuple[Model, Problem, Problem]:
    """Model, the problem at the rate that is fitted, and the problem at full rate."""
    model: Model = RecordedRig(spec) if spec.recorded_rig else build(spec)
    if spec.effect:
        model = Known(model, spec.effect, recordings)
    factor = thinning(model, recordings)
    columns = {name: channel.column for name, channel in channels_of(spec)[0].items()}
    full = problem_of(model, recordings, columns, rules)
    return model, full if factor <= 1 else problem_of(model, recordings, columns, rules, factor), full


def thinning(model: Model, recordings: list[Recording]) -> int:
    """Samples averaged into one, so that a fit stays in seconds; never coarser than the model allows."""
    total = sum(r.n for r in recordings)
    factor = max(1, round(total / model.fit_samples))
    if recordings[0].timed:
        factor = min(factor, max(1, int(model.coarsest_s / recordings[0].dt_s + 1e-9)))
    return factor


def problem_of(
    model: Model, recordings: list[Recording], columns: dict[str, str], rules: SelectionRules, factor: int = 1
) -> Problem:
    """The problem of recordings of which `factor` samples are averaged into one."""
    segments = [model.prepare(thin(r, factor)) for r in recordings]
    still = [
        noise_module.quiescent([p.inputs[name] for name in model.quiet_inputs], p.recording.dt_s, p.recording.timed, rules)
        for p in segments
    ]
    repeats = noise_module.repeated([[p.inputs[name] for name in model.quiet_inputs] for p in segments], rules)
    noises: list[Noise] = []
    for row in range(len(model.outputs)):
        # single wild samples would raise the noise by which they are found
        tame = [
            np.where(readings.wild(p.y[row], readings.scatter(p.y[row]), rules.data), np.nan, p.y[row]) for p in segments
        ]
        found = noise_module.estimate(tame, still, repeats, model.simulates, rules)
        seldom = [readings.repeated(p.y[row], rules.data) for p in segments]
        for segment, places in zip(segments, seldom, strict=True):
            if places is not None:
                segment.repeats[row] = places
        if any(places is not None for places in seldom):  # the noise of readings, not of their repetitions
            kept = [slice(None) if places is None else np.unique(places) for places in seldom]
            read = [y[k] for y, k in zip(tame, kept, strict=True)]
            alone = noise_module.estimate(read, [m[k] for m, k in zip(still, kept, strict=True)], rules=rules)
            found = replace(found, sigma=max(found.sigma, alone.sigma))
        own = [noise for noise in (model.noise_of(p) for p in segments) if noise is not None]
        if own:
            found = sorted(own, key=lambda noise: noise.sigma)[len(own) // 2]
        noises.append(found)
        for segment in segments:
            segment.y[row, readings.wild(segment.y[row], found.sigma, rules.data)] = np.nan
    for segment in segments:
        segment.resolution = np.array([readings.resolution(y, rules.data, switched=False) for y in segment.y]) / np.sqrt(
            12.0
        )
    period_s = recordings[0].dt_s if recordings[0].timed else 0.0
    return Problem(model, segments, noises, np.ones(len(model.outputs)), columns, rules, recorded_s=period_s)


def candidates_of(problem: Problem, left_out: frozenset[str]) -> list[Candidate]:
    """Candidate effects of a problem, whose initial states are fitted together with the parameters on a linear path."""
    ports = candidate_ports(problem)
    problem.joint_states = any(port.path for port in ports)
    found = candidates(ports, problem.segments[0].recording.timed, problem.model.taken | left_out)
    return [candidate for candidate in found if candidate.effect.id not in left_out]


def candidate_ports(problem: Problem) -> tuple[Port, ...]:
    """Ports of the model, each with those at which a linear time-invariant effect does the same."""
    first = next(segment for segment in problem.segments if segment.fit.any())
    path = problem.model.linear_path(first, problem.model.guess(problem.segments))
    return tuple(replace(port, path=path) if port.name in path else port for port in problem.model.ports)
