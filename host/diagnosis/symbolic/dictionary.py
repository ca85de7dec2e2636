"""Is the residual predicted by anything: simple forms of the recorded signals, each seen through the nominal model.

A form is a product, a power, a wave or a memory (play, lag) of signals, of no parameter but its size. Its response is what
the model's outputs would change if it were added at a port. Forms are weighed where the outputs are precise (in contact the
force shows micrometres of insertion, free motion does not), seen past the nominal parameters, chosen on samples to fit,
judged on those held out: sparse regression on a library (Brunton, Proctor, Kutz 2016), memory added, by a known noise.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import numpy.typing as npt

from host.diagnosis.estimation.fit import RAN_AWAY, Fit, Problem, Term, free, size_of
from host.diagnosis.estimation.rules import SelectionRules
from host.diagnosis.model.effect import Candidate, Context, Effect, Parameter, Port, Scale
from host.diagnosis.model.model import Segment
from host.diagnosis.model.operators import lag, play

Array = npt.NDArray[np.float64]
PLAYS = (0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.7)  # widths, parts of the span
LAGS_S = (0.05, 0.2, 0.6, 2.0, 6.0)
WAVES = tuple(np.arange(0.5, 10.0, 0.4))  # cycles over the span
MOST_SIGNALS = 4
OFF_CENTRE = 0.03  # part of the range by which its middle has to be off zero for a product of deviations to be another form
WILD = 3.0  # robust standard deviations beyond which a residual counts less (Huber 1964)
CURVES = ("abs", "sqrt", "square", "exp", "tanh")  # functions of which an equation of a static curve is made


@dataclass(frozen=True)
class Form:
    """`text` in names of columns; `evaluate` gives (n,) of a recording; `length`: symbols in it.

    `curve`: a memoryless function of the port's own signal alone.
    """

    text: str
    evaluate: Callable[[Segment], Array]
    length: int
    curve: bool = False


@dataclass(frozen=True)
class PredictedPart:
    """What the best forms at one place take from the residual. `forms`: the single forms to refit with their sizes, best
    first; `port`: None for a reading.
    """

    subsystem: str
    port: Port | None
    log_likelihood: float
    p_value: float
    share: float
    trained: float
    forms: tuple[tuple[Form, float], ...] = ()
    power: float = 0.0  # fall of the held-out squared error, over noise, summed over outputs
    sure: bool = False  # whether that is more than chance allows, on samples to fit and on those held out


def forms_at(problem: Problem, fit: Fit, port: Port) -> list[Form]:
    """The library at one port: its motion, further signals, their rates, magnitudes, waves, memory and products."""
    signals = [s for s in _signals(problem, fit, port) if s.span > 1e-9 * s.largest][:MOST_SIGNALS]
    timed = problem.segments[0].recording.timed
    factors = [_factors(s, timed) for s in signals]
    out = [form for group in factors for form in group]
    out += [form for s in signals for form in _memories(s, timed)]
    for i, group in enumerate(factors):
        for k, other in enumerate(factors[i:]):
            out += [_product(a, b) for at, a in enumerate(group) for b in (other[at:] if k == 0 else other)]
    out += [_product(_centred(a), _centred(b)) for a, b in combinations(signals, 2) if a.offset or b.offset]
    if timed and signals:
        x, rate = factors[0][0], factors[0][-2]
        out += [_product(_product(x, x), rate), _product(x, _product(rate, rate))]
    own = problem.columns.get(problem.model.moves[port.name], problem.model.moves[port.name])
    # A multiple of the port's own speed is a damping or a lag. What it explains past these is how a motion was smoothed.
    return [replace(form, curve=is_curve(form.text, own)) for form in out if form.text != f"rate({own})"]


def is_curve(text: str, own: str) -> bool:
    """Whether an equation is a memoryless function of the column `own` alone, neither a gain nor a wave along it."""
    names = set(re.findall(r"(?<![\w.])[A-Za-z_]\w*", text))
    return text != own and own in names and names <= {own, *CURVES}


@dataclass(frozen=True)
class _Signal:
    """A signal that forms are made of: its column, its unit, its values in a recording, its sizes over all of them."""

    name: str
    unit: str
    values: Callable[[Segment], Array]
    span: float
    largest: float
    offset: float = 0.0  # of its middle from zero, where that is seen


def _signals(problem: Problem, fit: Fit, port: Port) -> Iterator[_Signal]:
    first = problem.segments[0]
    units = first.recording.units | first.units
    own = problem.model.moves[port.name]
    sources: dict[str, Callable[[Segment], Array]] = {own: _own(problem, fit, port)}
    for key in (*port.others, *port.loads):
        if key != own and key in first.inputs:
            sources.setdefault(key, lambda p, key=key: p.inputs[key])  # type: ignore[misc]
    for key, values in sources.items():
        together = np.concatenate([values(p) for p in problem.segments])
        unit = units.get(key) or units.get(port.name, "") if key == own else units.get(key, "")
        span, middle = float(np.ptp(together)), 0.5 * float(np.min(together) + np.max(together))
        offset = float(f"{middle:.3g}") if abs(middle) > OFF_CENTRE * span else 0.0
        yield _Signal(problem.columns.get(key, key), unit, values, span, float(np.max(np.abs(together))) or 1.0, offset)


def _own(problem: Problem, fit: Fit, port: Port) -> Callable[[Segment], Array]:
    """The motion at a port: recorded, or simulated where it is itself an output, since what was read of that holds the
    residual.
    """
    channels = [output.channel for output in problem.model.outputs]
    if problem.model.moves[port.name] not in channels:
        return lambda p: problem.model.motion(p, port)
    row, known = channels.index(problem.model.moves[port.name]), {}  # type: ignore[var-annotated]

    def simulated(segment: Segment) -> Array:
        if id(segment) not in known:
            known[id(segment)] = problem.simulate(segment, fit.terms, fit.values)[row]
        return np.asarray(known[id(segment)])

    return simulated


def _factors(signal: _Signal, timed: bool) -> list[Form]:
    """The signal and what it may enter a product as; its rate and that one's magnitude come last."""
    name, x = signal.name, signal.values
    out = [Form(name, x, 1), Form(f"abs({name})", lambda p: np.abs(x(p)), 2)]
    if signal.unit == "rad":
        for k, text in ((1.0, name), (2.0, f"2*{name}")):
            out.append(Form(f"cos({text})", lambda p, k=k: np.cos(k * x(p)), 2))  # type: ignore[misc]
            out.append(Form(f"sin({text})", lambda p, k=k: np.sin(k * x(p)), 2))  # type: ignore[misc]
    if timed:
        out.append(Form(f"rate({name})", lambda p: _rate(x(p), p), 2))
        out.append(Form(f"abs(rate({name}))", lambda p: np.abs(_rate(x(p), p)), 3))
    return out


def _rate(values: Array, segment: Segment) -> Array:
    return np.asarray(np.gradient(values, segment.recording.dt_s))


def _memories(signal: _Signal, timed: bool) -> Iterator[Form]:
    name, x = signal.name, signal.values
    for part in PLAYS:
        width = float(f"{part * signal.span:.4g}")
        yield Form(f"play({name}, {width:.4g})", lambda p, w=width: play(x(p), 0.5 * w, 0.0), 3)  # type: ignore[misc]
    for cycles in WAVES:
        k = float(f"{2.0 * np.pi * cycles / signal.span:.4g}")
        yield Form(f"sin({k:.4g}*{name})", lambda p, k=k: np.sin(k * x(p)), 3)  # type: ignore[misc]
        yield Form(f"cos({k:.4g}*{name})", lambda p, k=k: np.cos(k * x(p)), 3)  # type: ignore[misc]
    yield Form(f"{name}^3", lambda p: x(p) ** 3, 3)
    for seconds in LAGS_S if timed else ():
        yield Form(f"lag({name}, {seconds:g})", lambda p, s=seconds: lag(x(p), p.recording.dt_s, s), 3)  # type: ignore[misc]


def _centred(signal: _Signal) -> Form:
    """The signal measured from the middle of its range, where that is not at zero."""
    if not signal.offset:
        return Form(signal.name, signal.values, 1)
    sign = "-" if signal.offset > 0.0 else "+"
    return Form(f"({signal.name} {sign} {abs(signal.offset):g})", lambda p: signal.values(p) - signal.offset, 1)


def _product(a: Form, b: Form) -> Form:
    text = f"{a.text}^2" if a is b else f"{a.text}*{b.text}"
    return Form(text, lambda p: a.evaluate(p) * b.evaluate(p), a.length + b.length)


def equation_at(port: Port, form: Form, size: float = 1.0) -> Candidate:
    """The form as an effect at `port`: its size is to be refitted with everything else. Its values are laid out in
    `Segment.equations` first (`lay_out`).
    """

    def parameters(s: Scale, which: str) -> tuple[Parameter, ...]:
        return (Parameter("amplitude", "", (size,), -np.inf, np.inf, linear=True, step=abs(size) or 1.0),)

    def apply(signal: Array, c: Context, p: Array, which: str) -> Array:
        return np.asarray(signal + p[0] * c.laid_out(form.text))

    says = "None of the known effects: the mismatch follows an equation found by search."
    if form.curve:
        says = "The relation from input to output is curved, as an equation found by search says."
    effect = Effect(
        "static_nonlinearity" if form.curve else "unlisted",
        port.kind.split("+")[0],
        76,
        parameters,
        says,
        form.text,
        apply,
        side="input",
        listed=form.curve,
        searched=True,
    )
    return Candidate(effect, port, "", "search")


def lay_out(segments: list[Segment], form: Form) -> None:
    """Values of a form for every recording, where its effect finds them."""
    for segment in segments:
        segment.equations[form.text] = form.evaluate(segment)


def predict_residual(problem: Problem, fit: Fit, only: str = "") -> list[PredictedPart]:
    """The best forms at each port where an equation may stand, and, if the model has many outputs, in each of them alone;
    or at the port `only`.
    """
    ports = {port.name: port for port in problem.model.ports}
    used = _measured(fit)
    rates = [_slopes(problem, fit, segment) for segment in problem.segments]
    found = []
    for name, target in problem.model.unlisted_at:
        if only not in ("", name):
            continue
        forms = forms_at(problem, fit, ports[name])
        if forms:
            responses = _responses(problem, fit, ports[target], forms)
            found.append(_best(problem, fit, rates, forms, responses, ports[name].subsystem, ports[name]))
            if problem.model.pointwise and not only:
                table = [r.table for r in responses]
                found += [
                    _best(problem, fit, rates, forms, _alone(problem, row, table), output.subsystem, None)
                    for row, output in enumerate(problem.model.outputs)
                    if used[row] and name == problem.model.unlisted_at[0][0]
                ]
    return found


def _measured(fit: Fit) -> list[bool]:
    return [any(np.isfinite(r[row]).any() for r in fit.residuals) for row in range(len(fit.residuals[0]))]


@dataclass(frozen=True)
class Response:
    """Change of the outputs (outputs, n) of one recording by each form: `slope` (outputs, n) times `table` (forms, n), or
    `whole` (forms, outputs, n).
    """

    table: Array
    slope: Array | None = None
    whole: Array | None = None

    def to(self, chosen: list[int], sizes: Array) -> Array:
        """Change by the forms `chosen`, of these sizes."""
        if self.slope is not None:
            return np.asarray(self.slope * (sizes @ self.table[chosen]))
        assert self.whole is not None
        return np.asarray(np.tensordot(sizes, self.whole[chosen], 1))


def _responses(problem: Problem, fit: Fit, target: Port, forms: list[Form]) -> list[Response]:
    nominal, active = problem.parted(fit.terms, fit.values)
    out = []
    for segment in problem.segments:
        table = np.array([np.nan_to_num(form.evaluate(segment)) for form in forms])
        if problem.model.pointwise:
            slope = problem.model.sensitivity(segment, nominal, target.name, active)
            out.append(Response(table, np.nan_to_num(slope)))
            continue
        slopes = problem.model.slopes(segment, nominal, active)
        if target.name in slopes:
            answers = [problem.model.answer(slopes[target.name], np.asarray(values)) for values in table]
            out.append(Response(table, whole=np.nan_to_num(np.array(answers))))
            continue
        base = problem.simulate(segment, fit.terms, fit.values)
        need = float(np.nanstd(problem.model.needs(segment, target, nominal, segment.y - base))) or 1e-6
        whole = np.zeros((len(forms), *base.shape))
        for index, (form, values) in enumerate(zip(forms, table, strict=True)):
            size = 0.1 * need / (float(np.std(values)) or 1.0)
            term = Term(equation_at(target, form), ())
            segment.equations[form.text] = values
            moved = problem.model.simulate(segment, nominal, [*active, (term.candidate, np.array([size]))])
            whole[index] = _finite((moved - base) / size, problem)
        out.append(Response(table, whole=whole))
    return out


def _alone(problem: Problem, row: int, tables: list[Array]) -> list[Response]:
    """Forms added to one output's reading."""
    unit = np.zeros((len(problem.model.outputs), 1))
    unit[row] = 1.0
    return [Response(table, np.broadcast_to(unit, p.y.shape)) for table, p in zip(tables, problem.segments, strict=True)]


def _slopes(problem: Problem, fit: Fit, segment: Segment) -> Array:
    """Change of the outputs by each free parameter in its own size, (parameters, outputs, n)."""
    base = problem.simulate(segment, fit.terms, fit.values)
    parameters, out = problem.parameters(fit.terms), []
    for index in free(parameters):
        p, value = parameters[index], float(fit.values[index])
        step = 1e-3 * (abs(value) if p.log else size_of(p, value))
        moved = fit.values.copy()
        moved[index] = value + step if value + step <= p.high else value - step
        out.append(_finite((problem.simulate(segment, fit.terms, moved) - base) / 1e-3, problem))
    return np.array(out) if out else np.zeros((0, *base.shape))


def _finite(change: Array, problem: Problem) -> Array:
    """A change of the outputs (outputs, n), zero where there are none; all of it is zero if the simulation ran away, as that
    of a loop that saturates may.
    """
    change = np.nan_to_num(change)
    return change if bool(np.all(np.abs(change) < RAN_AWAY * problem.scale[:, None])) else np.zeros_like(change)


def _best(
    problem: Problem,
    fit: Fit,
    slopes: list[Array],
    forms: list[Form],
    responses: list[Response],
    subsystem: str,
    port: Port | None,
) -> PredictedPart:
    """Greedy choice among `forms`, one more as long as held-out samples are predicted better."""
    rules, sums = problem.rules, _Sums(problem, fit, slopes, responses)
    best = PredictedPart(subsystem, port, 0.0, 1.0, 0.0, 0.0)
    chosen: list[int] = []
    worth: tuple[tuple[Form, float], ...] = ()
    for _ in range(rules.forms_joined):
        gain = sums.gains(chosen)
        order = _by_gain(gain, forms, rules)
        if not order:
            break
        worth = worth or tuple((forms[k], float(sums.sizes([k])[0])) for k in order[: rules.forms_refitted])
        tried = []
        for k in order[: rules.forms_judged]:  # chosen by held-out samples, which is paid for
            sizes = sums.sizes([*chosen, k])
            after = [
                r - response.to([*chosen, k], sizes) + np.tensordot(sums.absorbed([*chosen, k], sizes), slope, 1)
                for r, response, slope in zip(fit.residuals, responses, slopes, strict=True)
            ]
            tried.append((problem.gain("heldout", fit.residuals, after), k, after))
        held, k, after = max(tried, key=lambda one: one[0].log_likelihood)
        chosen = [*chosen, k]
        likelihood = held.log_likelihood - len(chosen) * (1.0 + np.log(len(tried)))
        if likelihood > best.log_likelihood:
            trained = problem.gain("fit", fit.residuals, after).log_likelihood
            power = fallen(problem, fit.residuals, after)
            best = PredictedPart(subsystem, port, likelihood, held.p_value, held.share, trained, worth, power)
    sure = (
        min(best.log_likelihood, best.trained) > rules.predictable_log_likelihood
        and best.share > rules.predictable_error_reduction
        and best.p_value < rules.predictable_significance
    )
    return replace(best, forms=worth, sure=sure)


def fallen(problem: Problem, before: list[Array], after: list[Array]) -> float:
    """Fall of the mean squared error on held-out samples, over each output's noise, summed over those where it fell."""
    total = 0.0
    noise_sd = problem.noise_sd
    for row in range(noise_sd.size):
        pairs = [(b[row][p.heldout], a[row][p.heldout]) for p, b, a in zip(problem.segments, before, after, strict=True)]
        change = np.concatenate([b**2 - a**2 for b, a in pairs])
        change = change[np.isfinite(change)]
        total += max(float(np.mean(change)), 0.0) / noise_sd[row] ** 2 if change.size else 0.0
    return total


def _by_gain(gain: Array, forms: list[Form], rules: SelectionRules) -> list[int]:
    """Forms by their gain, a shorter one before a longer one that gains hardly more."""
    order = [int(k) for k in np.argsort(-gain) if gain[k] > 0.0][: 4 * rules.forms_refitted]
    return sorted(order, key=lambda k: -gain[k] * (1.0 - rules.form_length_penalty * forms[k].length))


def _weights(r: Array) -> Array:
    """Square roots of Huber's weights of residuals `r` (outputs, n), in units of each output's own scatter."""
    weights = np.ones_like(r)
    for row, values in zip(weights, np.abs(r), strict=True):
        if values.any():  # samples that are not there are zeros
            row[:] = np.sqrt(np.minimum(1.0, WILD * 1.4826 * np.median(values[values > 0.0]) / np.maximum(values, 1e-300)))
    return weights


class _Sums:
    """Inner products, over the samples to fit and in units of noise, of forms, parameters and residual."""

    def __init__(self, problem: Problem, fit: Fit, slopes: list[Array], responses: list[Response]) -> None:
        unit = np.maximum(problem.noise_sd, 1e-100)[:, None]  # its square is a number too: recordings without noise exist
        count, rates = len(responses[0].table), len(slopes[0])
        gram, cross, pull = np.zeros((count, count)), np.zeros((count, rates)), np.zeros(count)
        own, start = np.zeros((rates, rates)), np.zeros(rates)
        for segment, residual, slope, response in zip(problem.segments, fit.residuals, slopes, responses, strict=True):
            mask = segment.fit
            if not mask.any():
                continue
            seen = np.isfinite(residual[:, mask])
            r = np.where(seen, residual[:, mask], 0.0) / unit
            r = np.clip(np.where(seen, r, 0.0), -1e6, 1e6)
            weighed = unit / _weights(r)
            r = np.where(seen, residual[:, mask], 0.0) / weighed
            J = np.where(seen, slope[:, :, mask], 0.0) / weighed
            J = np.where(np.any(seen, axis=1)[None, :, None], J, 0.0)
            own += np.einsum("kon,lon->kl", J, J)
            start += np.einsum("kon,on->k", J, r)
            if response.slope is not None:
                table = response.table[:, mask]
                s = np.where(seen, response.slope[:, mask], 0.0) / weighed
                gram += (table * np.sum(s * s, axis=0)) @ table.T
                cross += table @ np.einsum("on,kon->kn", s, J).T
                pull += table @ np.sum(s * r, axis=0)
            else:
                assert response.whole is not None
                D = (np.where(seen, response.whole[:, :, mask], 0.0) / weighed).reshape(count, -1)
                gram += D @ D.T
                cross += D @ J.reshape(rates, D.shape[1]).T  # there may be no rate at all
                pull += D @ r.ravel()
        size = np.sqrt(np.diag(own))
        size[size == 0.0] = 1.0
        self.inverse = np.linalg.pinv(own / np.outer(size, size), rcond=1e-9) / np.outer(size, size) if rates else own
        self.cross, self.size = cross, np.diag(gram)
        self.least_new = problem.rules.form_new_share
        self.gram, self.pull = gram - cross @ self.inverse @ cross.T, pull - cross @ self.inverse @ start

    def gains(self, chosen: list[int]) -> Array:
        """Fall of half the squared error by each form, together with those chosen."""
        left, size = self.pull, np.diag(self.gram)
        if chosen:
            solved = np.linalg.lstsq(self.gram[np.ix_(chosen, chosen)], self.gram[chosen], rcond=1e-10)[0]
            left = self.pull - self.pull[chosen] @ solved
            size = size - np.sum(self.gram[chosen] * solved, axis=0)
        seen = size > self.least_new * self.size + 1e-300
        return np.where(seen, 0.5 * left**2 / np.where(seen, size, 1.0), 0.0)

    def sizes(self, chosen: list[int]) -> Array:
        """Return the least-squares sizes of the chosen forms."""
        return np.asarray(np.linalg.lstsq(self.gram[np.ix_(chosen, chosen)], self.pull[chosen], rcond=1e-10)[0])

    def absorbed(self, chosen: list[int], sizes: Array) -> Array:
        """What the parameters take up of the forms chosen."""
        return np.asarray(self.inverse @ (self.cross[chosen].T @ sizes))
