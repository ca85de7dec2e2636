"""Readings of a simulator's outputs that another sign, unit or column explains: found before any physics is fitted.

The other kinds of model are checked by their law (`model/findings.py`). A simulator has none that could be read, so its
outputs are compared with what it simulates for its nominal parameters. The initial state of a recording is read off the
same outputs; what it explains is taken off both, so that a reversed reading is not compared with its own reversed start.
A simulator that is not linear can start from degrees called radians on another course altogether: if nothing alike comes
out, it is started from the readings in other units as well.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from host.diagnosis.estimation.fit import Problem
from host.diagnosis.estimation.rules import SelectionRules
from host.diagnosis.model.dataset import Recording
from host.diagnosis.model.findings import FACTORS, factor_of
from host.diagnosis.model.model import Segment
from host.diagnosis.model.readings import Finding

Array = npt.NDArray[np.float64]
Pair = tuple[Array, Array]  # measured and simulated outputs (outputs, n) of a recording


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
    mistake = _input_mistake(problem, theta, pairs, _of_units(problem)) if several else None
    if mistake is None:
        exchanged, order = _exchanged(problem, pairs, names)
        turned, change = _turned(problem, pairs, names, [row for row, other in enumerate(order) if other == row], theta)
        if exchanged or turned:
            return [_put_right(recording, names, order, change) for recording in recordings], [*exchanged, *turned]
        possible = _of_sign_or_column(problem) if several else [*_of_units(problem), *_of_sign_or_column(problem)]
        mistake = _input_mistake(problem, theta, pairs, possible)
    if mistake is None:
        return list(recordings), []
    right = [replace(recording, channels=mistake.put_right(recording.channels)) for recording in recordings]
    return right, [mistake.finding(problem.columns)]


def _exchanged(problem: Problem, pairs: list[Pair], names: list[str]) -> tuple[list[Finding], list[int]]:
    """What is to be said of exchanged outputs, and for each output the one whose column it is in."""
    rows, findings, rules = range(len(names)), [], problem.rules
    alike = np.array([[_likeness(pairs, measured, simulated)[0] for simulated in rows] for measured in rows])
    order = list(rows)
    for a in rows:
        for b in range(a + 1, len(names)):
            crossed, straight = min(alike[a, b], alike[b, a]), max(alike[a, a], alike[b, b])
            same = problem.model.outputs[a].unit == problem.model.outputs[b].unit
            follow = crossed > rules.simulator_unit_correlation and straight < rules.simulator_own_correlation
            if same and (follow or _match_exchanged(pairs, a, b, rules)):
                order[a], order[b] = b, a
                first, second = (problem.columns.get(names[row], names[row]) for row in (a, b))
                says = (
                    f"Columns {first} and {second} are probably exchanged: each follows what the nominal model says of the "
                )
                says += "other. The diagnosis continues with them exchanged."
                findings.append(Finding("swapped", first, says))
    return findings, order


def _match_exchanged(pairs: list[Pair], a: int, b: int, rules: SelectionRules) -> bool:
    """Whether all outputs are as simulated with the readings of two exchanged, and as they are recorded they are not."""
    rows = list(range(pairs[0][0].shape[0]))
    order = [b if row == a else a if row == b else row for row in rows]
    crossed = [(y[order], out) for y, out in pairs]
    most = rules.simulator_unexplained_ratio * _unexplained(pairs)
    return _all_match(crossed, rules) and _unexplained(crossed) < most


def _turned(
    problem: Problem, pairs: list[Pair], names: list[str], rows: list[int], theta: Array
) -> tuple[list[Finding], dict[str, float]]:
    """What is to be said of outputs of another sign or unit, and what they have to be multiplied by."""
    findings: list[Finding] = []
    change: dict[str, float] = {}
    rules = problem.rules
    for row in rows:
        name, column = names[row], problem.columns.get(names[row], names[row])
        correlation, gain = _likeness(pairs, row, row)
        if correlation < rules.data.opposite_correlation:
            says = f"Column {column} moves against what the nominal model says (correlation {correlation:.2f}): "
            says += "it, or an input, has the opposite sign (channels.*.sign). "
            says += f"The diagnosis continues with {column} reversed."
            findings.append(Finding("sign", column, says))
            change[name] = -1.0
        alike = abs(correlation) > rules.simulator_unit_correlation
        factor = factor_of(abs(gain), rules.data.unit_factor_stated) if alike else 0.0
        if abs(correlation) < rules.simulator_start_correlation and len(names) == 1:
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
        if _all_match(scaled, problem.rules):
            return factor
    return 0.0


@dataclass(frozen=True)
class InputMistake:
    """Inputs that are to be divided by `factor`, or, where that is 1, two that are to be exchanged."""

    names: tuple[str, ...]
    factor: float = 1.0

    def put_right(self, signals: dict[str, Array]) -> dict[str, Array]:
        """`signals` (n,) by channel without the mistake."""
        if self.factor == 1.0:
            a, b = self.names
            return {**signals, a: signals[b], b: signals[a]}
        return {**signals, **{name: signals[name] / self.factor for name in self.names}}

    def finding(self, columns: dict[str, str]) -> Finding:
        """The sentence about it. columns: channel -> column."""
        listed = [columns.get(name, name) for name in self.names]
        which, are = (f"Columns {' and '.join(listed)}", "are") if len(listed) > 1 else (f"Column {listed[0]}", "is")
        column, so = listed[0], "the outputs are as simulated"
        if self.factor == 1.0:
            says = f"{which} are probably exchanged: with them exchanged back, {so}. The diagnosis continues so."
            return Finding("swapped", column, says)
        if self.factor < 0.0:
            says = f"{which} has the opposite sign of what the nominal model takes it for (channels.*.sign): with it "
            return Finding("sign", column, f"{says}reversed, {so}. The diagnosis continues so.")
        says = f"{which} {are} about {FACTORS[self.factor]} times what the nominal model takes it for. Divided by that, "
        return Finding(
            "unit", column, f"{says}{so}. The unit is probably another (channels.*.scale). The diagnosis continues so."
        )


def _alike(problem: Problem) -> list[tuple[str, ...]]:
    """Inputs of one unit, where there are several."""
    units = problem.segments[0].recording.units
    groups = [tuple(n for n in problem.model.moves if units.get(n) == u) for u in dict.fromkeys(units.values()) if u]
    return [group for group in groups if len(group) > 1]


def _of_units(problem: Problem) -> list[InputMistake]:
    """Each input, or all of one unit, in another one."""
    which = [*((name,) for name in problem.model.moves), *_alike(problem)]
    return [InputMistake(names, factor) for names in which for factor in FACTORS]


def _of_sign_or_column(problem: Problem) -> list[InputMistake]:
    """Each input reversed, and each two of one unit exchanged."""
    pairs = [pair for group in _alike(problem) for pair in itertools.combinations(group, 2)]
    return [*(InputMistake((name,), -1.0) for name in problem.model.moves), *(InputMistake(pair) for pair in pairs)]


def _input_mistake(problem: Problem, theta: Array, pairs: list[Pair], possible: list[InputMistake]) -> InputMistake | None:
    """The one of `possible` mistakes without which all outputs are as simulated, if there is one and they are not with it.

    A simulator that is not linear answers an angle in degrees by another course, in which no output shows a factor.
    """
    if _all_match(pairs, problem.rules):
        return None
    most, found = problem.rules.simulator_unexplained_ratio * _unexplained(pairs), None
    responses: dict[tuple[str, ...], float] = {}
    for mistake in possible:
        if 0.0 < mistake.factor < 1.0:
            if mistake.names not in responses:
                responses[mistake.names] = _response(problem, theta, mistake.names)
            if responses[mistake.names] > mistake.factor * problem.rules.simulator_largest_response:
                continue
        left = _left_without(problem, theta, mistake)
        if left < most:
            most, found = left, mistake
    return found


def _response(problem: Problem, theta: Array, names: tuple[str, ...]) -> float:
    """What inputs, multiplied by 1 + a, cause for each a to first order, over what is measured, in the output where most.

    An input that is recorded too small causes little. What would move the outputs by a thousand times what is measured is
    not tried: a simulator of large deflections takes minutes for forces that would tear the thing apart.
    """
    segment, by = problem.segments[0], 1e-3
    more = {**segment.inputs, **{name: segment.inputs[name] * (1.0 + by) for name in names}}
    now, then = (problem.model.simulate(replace(segment, inputs=given), theta, []) for given in (segment.inputs, more))
    caused = np.nanstd(np.asarray(then) - np.asarray(now), axis=1) / by
    return float(np.nanmax(caused / np.maximum(np.nanstd(segment.y, axis=1), 1e-300), initial=0.0))


def _left_without(problem: Problem, theta: Array, mistake: InputMistake) -> float:
    """What is unexplained without `mistake`; infinite where an output is not as simulated, in the first recording or all."""
    tried: list[Pair] = []
    for segment in problem.segments:
        tried.append(_freed(problem, replace(segment, inputs=mistake.put_right(segment.inputs)), theta))
        if len(tried) in (1, len(problem.segments)) and not _all_match(tried, problem.rules):
            return np.inf
    return _unexplained(tried)


def _all_match(pairs: list[Pair], rules: SelectionRules) -> bool:
    """Whether every output is as simulated, but for what parameters that are not exact make of it."""
    likeness = (_likeness(pairs, row, row) for row in range(pairs[0][0].shape[0]))
    least, near = rules.simulator_match_correlation, rules.data.unit_factor_stated
    return all(correlation > least and abs(float(np.log(gain))) < near for correlation, gain in likeness)


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
        for k in problem.model.begins_with(segment, theta, []):
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
