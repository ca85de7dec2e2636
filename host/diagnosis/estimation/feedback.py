"""Noise that comes back through a controller: what later input of a recording says of the noise in its output.

A controller that reads an output sends its noise into the next input. The new part of that input (what its own past does
not predict) then holds the noise of a moment before, and an effect that makes the simulated output later, or mixes
neighbouring samples, can take a part of the noise away without any physics in it. Forssell and Ljung, "Closed-loop
identification revisited" (Automatica, 1999): a consistent comparison needs the noise that is fed back in the noise model.
Here the part of the residual that later input predicts is taken off before two models are compared.

A controller that computes the input of a row from the reading of the same row sends its noise into that row. A direct path
through the plant would look alike, but such a path passes all of the input alike, and noise is in its new part alone:
the residual then follows the new part and not the other one. Noise of the input's own reading has the same signature.

Coloured noise is predicted by its own past, and earlier new input holds this past: a law that passes small signals otherwise
than large ones takes a part of the noise away. The innovations of the residual show feedback whatever the colour
(`handed_on`); what new input says on both sides of a sample is then taken off.

Where both sides of a law are compared behind a test function, the noise of a sample is in the residual before and after it.
Earlier new input then holds noise as well, and a filter of the input could take it away.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from host.diagnosis.estimation.noise import innovations, prediction_error, predictor
from host.diagnosis.estimation.rules import SelectionRules
from host.diagnosis.model.model import Segment
from host.diagnosis.model.operators import fill

Array = npt.NDArray[np.float64]
ORDER = 20  # of the prediction of an input from its own past
LAGS = 30  # later samples of the inputs together
HELD = 2  # first later sample by which feedback is found: the one before may show how an input is held
SAMPLES_PER_LAG = 40  # recorded, at least
MOST_SAMPLES = 60000  # of a recording; a longer one is compared as it is
PASSES = 3  # of a prediction that leaves out the rows of steps


def unpredicted(x: Array) -> Array:
    """Return what `x` (n,) does beyond its best linear prediction from the last ORDER samples, zero at its begin."""
    past = _past(x)
    new = x[ORDER:] - past @ np.linalg.lstsq(past, x[ORDER:], rcond=None)[0]
    return np.concatenate((np.zeros(ORDER), new))


def common_part(x: Array, rules: SelectionRules) -> tuple[Array, Array]:
    """The new part of `x` (n,) without steps of a set-point, and the rows (n,) of a step: both are 0 or False at the begin.

    Steps exceed all other new parts together. The prediction is fitted without their rows, and they are 0 in the result.
    """
    past = _past(x)
    usual = np.ones(x.size - ORDER, dtype=bool)
    new = x[ORDER:]
    for _ in range(PASSES):
        weights = np.linalg.lstsq(past[usual], x[ORDER:][usual], rcond=None)[0]
        new = x[ORDER:] - past @ weights
        usual = np.abs(new) <= rules.new_input_deviations * 1.4826 * float(np.median(np.abs(new)))
    steps = np.concatenate((np.zeros(ORDER, dtype=bool), ~usual))
    if np.count_nonzero(usual) < ORDER * SAMPLES_PER_LAG // 2:
        return np.zeros_like(x), steps
    return np.concatenate((np.zeros(ORDER), np.where(usual, new, 0.0))), steps


def _past(x: Array) -> Array:
    """The last ORDER samples before each sample of `x` (n,) from ORDER on, and a constant: (n - ORDER, ORDER + 1)."""
    return np.column_stack([x[ORDER - k - 1 : x.size - k - 1] for k in range(ORDER)] + [np.ones(x.size - ORDER)])


def handed_on(
    lines: list[Array], inputs: Sequence[Sequence[Array]], rules: SelectionRules, sure: bool = False
) -> int | None:
    """Samples after which innovations of the residuals `lines` (n_i,) are in the new part of an input; None if they are not.

    inputs: (n_i,) of each recording. Innovations are white, so noise of any colour is seen here, unlike by `_share`.
    sure: the residual must follow the new part alone where this is of the same sample or the next. A direct path through the
    plant, and an input that is held in another way, look alike otherwise.
    """
    of_residuals = [np.concatenate((np.zeros(ORDER), e)) for e in innovations(lines, ORDER)]
    for channel in range(min(len(u) for u in inputs)):
        read = [fill(u[channel]) for u in inputs]
        new = [common_part(u, rules)[0] for u in read]
        size = sum(float(z @ z) for z in new) * sum(float(e @ e) for e in of_residuals)
        for k in range(LAGS + 1):
            both = sum(float(e[: e.size - k] @ z[k:]) for e, z in zip(of_residuals, new, strict=True))
            if both * both > rules.feedback_share * size and (
                k >= HELD or not sure or _new_alone(lines, read, new, k, rules)
            ):
                return k
    return None


def _new_alone(lines: list[Array], read: list[Array], new: list[Array], late: int, rules: SelectionRules) -> bool:
    """Whether residuals `lines` (n_i,) follow the `new` part of an input (n_i,) `late` samples later and no other part.

    All are freed of the residuals' own colour first.
    """
    parts = [[r[: r.size - late], z[late:], (u - z)[late:]] for r, u, z in zip(lines, read, new, strict=True)]
    a = predictor([r for r, _, _ in parts], ORDER)
    white = [np.array([prediction_error(x - np.mean(x), a) for x in part]) for part in parts]
    e, z, held = np.concatenate(white, axis=1)
    by_new, by_held = np.linalg.lstsq(np.column_stack((z, held)), e, rcond=1e-12)[0]
    return bool(abs(by_new) >= rules.feedback_over_remainder * abs(by_held))


def find_feedback(segments: list[Segment], residuals: list[Array], inputs: tuple[str, ...], rules: SelectionRules) -> bool:
    """Set `fed_back` of every segment, of the outputs whose residual is predicted by later `inputs` or at once.

    residuals: (outputs, n) of each segment. `fed_back[row]` is an orthonormal basis (n, lags), or None.

    Returns whether a law is compared behind a test function, and its residual is mostly noise that a controller fed back:
    a linear law with memory can then take that noise away, and nothing tells it from one that does not.
    """
    noisy = False
    new = [_new_input(segment, inputs, rules) for segment in segments]
    around: list[Array | None] = []
    if _said_by_motion(segments, inputs, rules) > rules.feedback_predicted_share:
        around = [_around(u, segment.spread) for segment, u in zip(segments, new, strict=True)]
    after, before = [_later(u, HELD) for u in new], [_earlier(u) for u in new]
    after_next = [_later(u, 1) for u in new]  # a rate that is interpolated sees the next sample, and its noise
    for segment in segments:
        segment.fed_back = [None] * segment.y.shape[0]
    for row in range(segments[0].y.shape[0]):
        later, earlier = _share(after, residuals, row), _share(before, residuals, row)
        fed = later >= max(rules.feedback_share, rules.feedback_over_past * earlier)
        late = _delay(segments, residuals, row, inputs, rules)
        coloured = late is not None and _predicts_colour([_before(u, late) for u in new], residuals, row, rules)
        if fed or coloured:
            bases = [_around(u, LAGS, SAMPLES_PER_LAG // 2) for u in new] if coloured else after_next
            for segment, basis in zip(segments, bases, strict=True):
                segment.fed_back[row] = basis
        if around:
            noisy = noisy or _share(around, residuals, row) > rules.feedback_predicted_share
            for segment, basis in zip(segments, around, strict=True):
                segment.fed_back[row] = basis
        # A controller that is late by less than a sample sends noise into the same row as well, if less of it.
        least = None if fed else max(rules.feedback_share, rules.feedback_over_past * earlier)
        at_once = [_at_once(segments, residuals, row, name, least, rules) for name in inputs]
        for index, column in itertools.chain.from_iterable(at_once):
            segments[index].fed_back[row] = _with(segments[index].fed_back[row], column)
    return noisy


def _delay(
    segments: list[Segment], residuals: list[Array], row: int, inputs: tuple[str, ...], rules: SelectionRules
) -> int | None:
    """Samples after which innovations of output `row` are in new input; recordings are neither short nor very long."""
    long = [k for k, segment in enumerate(segments) if ORDER * SAMPLES_PER_LAG <= segment.n <= MOST_SAMPLES]
    lines = [np.nan_to_num(residuals[k][row]) for k in long]
    read = [[segments[k].inputs[name] for name in inputs if name in segments[k].inputs] for k in long]
    usable = bool(lines) and all(read) and all(map(np.any, lines))
    return handed_on(lines, read, rules, sure=True) if usable else None


def _predicts_colour(bases: list[Array | None], residuals: list[Array], row: int, rules: SelectionRules) -> bool:
    """Whether earlier new input, of `bases`, says something of the residual of output `row` and nothing of its innovations.

    Coloured noise is predicted by its own past as well. A mismatch is not: what the input does to it next is new.
    """
    if _share(bases, residuals, row) < rules.feedback_share:
        return False
    lines = [np.nan_to_num(residual[row]) for residual in residuals]
    used = [line for line, basis in zip(lines, bases, strict=True) if basis is not None]
    a = predictor(used, ORDER)
    new = [prediction_error(line, a)[None, :] for line in lines]
    return _share(bases, new, 0) < rules.feedback_innovation_share


def _at_once(
    segments: list[Segment], residuals: list[Array], row: int, name: str, least: float | None, rules: SelectionRules
) -> list[tuple[int, Array]]:
    """New part of input `name` of each segment, by its index, if noise of this output is in it; else none.

    least: share of the residual's variance that it has to say, and more than the other part of the input does; None where
    later input shows that there is feedback.
    """
    parts = []
    for index, (segment, residual) in enumerate(zip(segments, residuals, strict=True)):
        x = segment.inputs.get(name)
        if x is None or not ORDER * SAMPLES_PER_LAG <= segment.n <= MOST_SAMPLES or np.ptp(x) == 0.0:
            continue
        new = unpredicted(fill(x))
        spread = 1.4826 * float(np.median(np.abs(new[ORDER:])))
        new = np.where(np.abs(new) <= rules.new_input_deviations * spread, new, 0.0)
        rest = fill(x) - new
        parts.append((index, new, rest - np.mean(rest), np.nan_to_num(residual[row])))
    if not parts:
        return []
    new, rest, r = (np.concatenate([part[k] for part in parts]) for k in (1, 2, 3))
    power, size = float(r @ r), float(new @ new)
    if power == 0.0 or size == 0.0:
        return []
    by_new, by_rest = np.linalg.lstsq(np.column_stack((new, rest)), r, rcond=1e-12)[0]
    plain = abs(by_new) >= rules.feedback_over_remainder * abs(by_rest)
    if least is not None and not (plain and by_new**2 * size / power >= least):
        return []
    return [(index, part) for index, part, _, _ in parts if np.any(part)]


def _with(basis: Array | None, column: Array) -> Array:
    """`basis` (n, k) extended by `column` (n,), orthonormal."""
    return np.linalg.qr(column[:, None] if basis is None else np.column_stack((basis, column)))[0]


def freed(segment: Segment, row: int, residual: Array) -> Array:
    """Return `residual` (n,) of output `row` without what later input says of it; missing samples stay missing."""
    basis = segment.fed_back[row] if segment.fed_back else None
    if basis is None:
        return residual
    return residual - basis @ (basis.T @ np.nan_to_num(residual))


def _new_input(segment: Segment, inputs: tuple[str, ...], rules: SelectionRules) -> list[Array]:
    if not ORDER * SAMPLES_PER_LAG <= segment.n <= MOST_SAMPLES:
        return []
    moving = [fill(segment.inputs[name]) for name in inputs if name in segment.inputs and np.ptp(segment.inputs[name]) > 0.0]
    new = [common_part(x, rules)[0] for x in moving]
    return [u / np.std(u) for u in new if np.any(u)]


def _later(new: list[Array], first: int) -> Array | None:
    return _basis(new, lambda u, k: np.concatenate((u[k + first - 1 :], np.zeros(k + first - 1))))


def _said_by_motion(segments: list[Segment], inputs: tuple[str, ...], rules: SelectionRules) -> float:
    """Share of the variance of the new input that the measured motion, up to the same row, says (Granger 1969).

    A motion follows its input. It says something of a later one only through a controller. 0 where no law is compared
    behind a test function.
    """
    alone = together = 0.0
    for segment in segments:
        if segment.spread == 0 or segment.read_motion is None or not ORDER * SAMPLES_PER_LAG <= segment.n <= MOST_SAMPLES:
            continue
        x = fill(segment.read_motion)
        for name in inputs:
            u = fill(segment.inputs[name])
            new, steps = common_part(u, rules)
            new, usual = new[ORDER:], np.logical_not(steps[ORDER:])
            if not np.any(new):
                continue
            past = [u[ORDER - k - 1 : u.size - k - 1] for k in range(ORDER)]
            known = np.column_stack([*past, *(x[ORDER - k : x.size - k] for k in range(ORDER)), np.ones(new.size)])
            new, known = new[usual], known[usual]
            left = new - known @ np.linalg.lstsq(known, new, rcond=1e-12)[0]
            scale = float(np.mean(new**2)) + 1e-300
            alone, together = alone + float(new @ new) / scale, together + float(left @ left) / scale
    return 1.0 - together / alone if alone > 0.0 else 0.0


def _around(new: list[Array], spread: int, samples_per_lag: int = SAMPLES_PER_LAG) -> Array | None:
    """The new input from `spread` samples before to LAGS more after: a test function spreads a sample's noise so far, and a
    controller hands it on later.
    """
    if not new:
        return None
    most = max(1, new[0].size // samples_per_lag // len(new))
    before, after = min(spread, most // 3), min(spread + LAGS, most - most // 3)
    return np.linalg.qr(np.column_stack([np.roll(u, k) for u in new for k in range(-after, before + 1)]))[0]


def _earlier(new: list[Array]) -> Array | None:
    return _basis(new, lambda u, k: np.concatenate((np.zeros(k), u[: u.size - k])))


def _before(new: list[Array], late: int) -> Array | None:
    """The new input that holds the noise of earlier samples, where that of each is in the input `late` samples later."""
    return _basis(new, lambda u, k: np.roll(u, k - late))


def _basis(new: list[Array], moved: Callable[[Array, int], Array]) -> Array | None:
    if not new:
        return None
    count = max(1, min(LAGS, new[0].size // SAMPLES_PER_LAG) // len(new))
    return np.linalg.qr(np.column_stack([moved(u, k) for u in new for k in range(1, count + 1)]))[0]


def _share(bases: list[Array | None], residuals: list[Array], row: int) -> float:
    """Return the share of the residuals' variance that the bases hold, less what chance gives them."""
    taken = total = 0.0
    for basis, residual in zip(bases, residuals, strict=True):
        r = np.nan_to_num(residual[row])
        n = int(np.count_nonzero(r))
        if basis is None or n <= 2 * basis.shape[1]:
            continue
        power = float(r @ r)
        total += power
        taken += float(np.sum((basis.T @ r) ** 2)) - power * basis.shape[1] / n
    return taken / total if total > 0.0 else 0.0
