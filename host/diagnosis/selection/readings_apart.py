"""Readings of a simulator's outputs that another sign, unit or column explains: found before any physics is fitted.

The other kinds of model are checked by their law (`model/findings.py`). A simulator has none that could be read, so its
outputs are compared with what it simulates for its nominal parameters. The initial state of a recording is read off the
same outputs; what it explains is taken off both, so that a reversed reading is not compared with its own reversed start.
A simulator that is not linear can start from degrees called radians on another course altogether: if nothing alike comes
out, it is started from the readings in other units as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from host.diagnosis.estimation.fit import Problem
from host.diagnosis.model.dataset import Recording
from host.diagnosis.model.findings import FACTORS, NEAR_FACTOR, OPPOSITE, factor_of
from host.diagnosis.model.model import Segment
from host.diagnosis.model.readings import Finding

Array = npt.NDArray[np.float64]
Pair = tuple[Array, Array]  # measured and simulated outputs (outputs, n) of a recording
ALIKE = 0.95  # correlation with what is simulated, from which on a factor between the two is one of units
MATCHED = 0.9  # and where the gain is near one as well
LEFT = 0.1  # of what is unexplained, that an input in other units leaves at most
UNLIKE = 0.8  # correlation below which a simulator with one output is started from its reading in other units


def readings_apart(problem: Problem, recordings: Sequence[Recording]) -> tuple[list[Recording], list[Finding]]:
    """The recordings with readings put right, and what was found. problem: of a simulator, before any fit.

    Of several outputs one input explains all, or it is not the input. Of one output an input comes last: a factor of the
    output says as much.
    """
    model = problem.model
    if not model.simulates:
        return list(recordings), []
    theta = model.guess(problem.segments)
    pairs = [_freed(problem, segment, theta) for segment in problem.segments]
    names = [output.channel for output in model.outputs]
    several = len(names) > 1
    by_input = _input_in_other_units(problem, theta, pairs) if several else None
    if by_input is None:
        exchanged, order = _exchanged(problem, pairs, names)
        turned, change = _turned(problem, pairs, names, [row for row, other in enumerate(order) if other == row], theta)
        if exchanged or turned:
            return [_put_right(recording, names, order, change) for recording in recordings], [*exchanged, *turned]
        by_input = None if several else _input_in_other_units(problem, theta, pairs)
    return (list(recordings), []) if by_input is None else _with_input(problem, recordings, *by_input)


def _exchanged(problem: Problem, pairs: list[Pair], names: list[str]) -> tuple[list[Finding], list[int]]:
    """What is to be said of exchanged outputs, and for each output the one whose column it is in."""
    rows, findings = range(len(names)), []
    alike = np.array([[_likeness(pairs, measured, simulated)[0] for simulated in rows] for measured in rows])
    order = list(rows)
    for a in rows:
        for b in range(a + 1, len(names)):
            crossed, straight = min(alike[a, b], alike[b, a]), max(alike[a, a], alike[b, b])
            same = problem.model.outputs[a].unit == problem.model.outputs[b].unit
            if same and crossed > ALIKE and straight < 0.5:
                order[a], order[b] = b, a
                first, second = (problem.columns.get(names[row], names[row]) for row in (a, b))
                says = (
                    f"Columns {first} and {second} are probably exchanged: each follows what the nominal model says of the "
                )
                says += "other. The diagnosis continues with them exchanged."
                findings.append(Finding("swapped", first, says))
    return findings, order


def _turned(
    problem: Problem, pairs: list[Pair], names: list[str], rows: list[int], theta: Array
) -> tuple[list[Finding], dict[str, float]]:
    """What is to be said of outputs of another sign or unit, and what they have to be multiplied by."""
    findings: list[Finding] = []
    change: dict[str, float] = {}
    for row in rows:
        name, column = names[row], problem.columns.get(names[row], names[row])
        correlation, gain = _likeness(pairs, row, row)
        if correlation < OPPOSITE:
            says = f"Column {column} moves against what the nominal model says (correlation {correlation:.2f}): "
            says += "it, or an input, has the opposite sign (channels.*.sign). "
            says += f"The diagnosis continues with {column} reversed."
            findings.append(Finding("sign", column, says))
            change[name] = -1.0
        factor = factor_of(abs(gain), NEAR_FACTOR) if abs(correlation) > ALIKE else 0.0
        if abs(correlation) < UNLIKE and len(names) == 1:
            factor = _of_start(problem, theta)
        if factor:
            says = f"Column {column} is about {FACTORS[factor]} times what the nominal model says: the unit of it, or "
            says += "of an input, is probably another (channels.*.scale). "
            says += f"The diagnosis continues with {column} divided by that."
            findings.append(Finding("unit", column, says))
            change[name] = change.get(name, 1.0) / factor
    return findings, change


def _of_start(problem: Problem, theta: Array) -> float:
    """The factor of units by which the readings of the only output, and the start that they give, have to be divided; 0 if
    there is none.
    """
    for factor in FACTORS:
        scaled = []
        for segment in problem.segments:
            begin = segment.begin
            if begin is None:
                return 0.0
            changed = replace(
                begin, values=begin.values / factor, measured=begin.measured / factor, spread=begin.spread / factor
            )
            scaled.append(_freed(problem, replace(segment, y=segment.y / factor, begin=changed), theta))
        correlation, gain = _likeness(scaled, 0, 0)
        if correlation > MATCHED and abs(float(np.log(gain))) < NEAR_FACTOR:
            return factor
    return 0.0


def _input_in_other_units(problem: Problem, theta: Array, pairs: list[Pair]) -> tuple[str, float] | None:
    """An input and the factor of units by which it has to be divided so that all outputs are as simulated, if one is.

    A simulator that is not linear answers an angle in degrees by another course, in which no output shows a factor.
    """
    rows = range(len(problem.model.outputs))
    if all(_matches(pairs, row) for row in rows):
        return None
    most, found = LEFT * _unexplained(pairs), None
    for name in problem.model.moves:
        for factor in FACTORS:
            for segments in (problem.segments[:1], problem.segments):
                changed = [replace(s, inputs={**s.inputs, name: s.inputs[name] / factor}) for s in segments]
                tried = [_freed(problem, segment, theta) for segment in changed]
                if not all(_matches(tried, row) for row in rows):
                    break
            else:
                if _unexplained(tried) < most:
                    most, found = _unexplained(tried), (name, factor)
    return found


def _with_input(
    problem: Problem, recordings: Sequence[Recording], name: str, factor: float
) -> tuple[list[Recording], list[Finding]]:
    """The recordings with an input divided by `factor`, and the sentence about it."""
    column = problem.columns.get(name, name)
    says = f"Column {column} is about {FACTORS[factor]} times what the nominal model takes it for. With it divided by that, "
    says += "the outputs are as simulated. Its unit is probably another (channels.*.scale). The diagnosis continues so."
    right = [replace(r, channels={**r.channels, name: r.channels[name] / factor}) for r in recordings]
    return right, [Finding("unit", column, says)]


def _matches(pairs: list[Pair], row: int) -> bool:
    """Whether an output is as simulated, but for what parameters that are not exact make of it."""
    correlation, gain = _likeness(pairs, row, row)
    return correlation > MATCHED and abs(float(np.log(gain))) < NEAR_FACTOR


def _unexplained(pairs: list[Pair]) -> float:
    """Squared difference of measured and simulated outputs over the square of the measured, of all outputs together."""
    total = 0.0
    for row in range(pairs[0][0].shape[0]):
        left = sum(float(np.nansum((y[row] - out[row]) ** 2)) for y, out in pairs)
        total += left / max(sum(float(np.nansum(y[row] ** 2)) for y, _ in pairs), 1e-300)
    return total


def _put_right(recording: Recording, names: list[str], order: list[int], change: dict[str, float]) -> Recording:
    """A recording with its outputs in `order` and times `change`."""
    given = {name: recording.channels[names[place]] for name, place in zip(names, order, strict=True)}
    moved = {name: values * change.get(name, 1.0) for name, values in given.items()}
    return replace(recording, channels={**recording.channels, **moved})


def _freed(problem: Problem, segment: Segment, theta: Array) -> tuple[Array, Array]:
    """Measured and simulated outputs (outputs, n) without what offsets and initial states explain; NaN where missing."""
    simulated = np.asarray(problem.model.simulate(segment, theta, []))
    states = []
    begin = segment.begin
    if begin is not None:
        now = begin.values
        for k in np.flatnonzero(begin.spread > 0.0):
            begin.values = now + np.eye(now.size)[k] * begin.spread[k]
            states.append(np.asarray(problem.model.simulate(segment, theta, [])) - simulated)
        begin.values = now
    measured, said = np.full_like(segment.y, np.nan), np.full_like(segment.y, np.nan)
    for row in range(segment.y.shape[0]):
        good = np.isfinite(segment.y[row]) & np.isfinite(simulated[row])
        basis = np.column_stack([np.ones(int(good.sum())), *(state[row][good] for state in states)])
        size = np.linalg.norm(basis, axis=0)
        basis = basis[:, size > 0.0] / size[size > 0.0]
        if not np.isfinite(basis).all() or good.sum() < 2 * basis.shape[1]:
            continue
        for store, values in ((measured, segment.y[row][good]), (said, simulated[row][good])):
            store[row, good] = values - basis @ np.linalg.lstsq(basis, values, rcond=1e-9)[0]
    return measured, said


def _likeness(pairs: list[Pair], measured: int, simulated: int) -> tuple[float, float]:
    """Correlation of a measured with a simulated output over all recordings, and the gain between the two."""
    across = own = other = 0.0
    for y, out in pairs:
        good = np.isfinite(y[measured]) & np.isfinite(out[simulated])
        across += float(y[measured][good] @ out[simulated][good])
        own += float(y[measured][good] @ y[measured][good])
        other += float(out[simulated][good] @ out[simulated][good])
    if own <= 0.0 or other <= 0.0:
        return 0.0, 0.0
    return across / float(np.sqrt(own * other)), across / other
