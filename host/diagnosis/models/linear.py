"""A transfer function or state space of any order as nominal model, alone or inside a feedback loop.

    x' = A x + B u,  y = C x + D u          continuous, or x[k + 1] = A x[k] + B u[k] with a period of its own
    u = K (r - y_fed_back)                  with feedback: K is the controller's transfer function

A continuous model is sampled exactly for an input that is held, or straight, between samples (Franklin, Powell and
Workman, Digital Control of Dynamic Systems, 1998, section 4.3). Effects inside the loop enter as changes of the plant's
input and of the output that is fed back; the linear loop is solved for these changes until they are those that its own
signals cause. With `hold = "zero"` the controller works once a sample and its command is held; else it works continuously,
and the reference runs straight between samples ("linear") or is held ("held_reference").
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.linalg import expm
from scipy.signal import tf2ss

from host.diagnosis.model.effect import Port
from host.diagnosis.model.expressions import names_in, value_of
from host.diagnosis.model.model import Segment, apply_effects
from host.diagnosis.model.nominal import Coefficient, LinearSpec, NominalSpec
from host.diagnosis.models.simulated import SimulatedModel, SimulatorRun, first_state
from protocol.errors import InputError

Array = npt.NDArray[np.float64]
SAME_PERIOD = 1e-3  # deviation of a recording's period from a discrete model's, relative
WIDE = 2.0  # standard deviation of a state that is not measured, in spans of what it does to an output
MOST_ROUNDS = 80  # of the loop with effects inside
SETTLED = 1e-7  # change of the loop's signals in a round, relative
HOLDS = ("zero", "linear")
LOOP_WORDS = {
    "zero": "works once a sample, and its command is held",
    "linear": "works continuously, and the reference runs straight between samples",
    "held_reference": "works continuously, and the reference is held between samples",
}
COMMAND = "command"  # whose free response says with what state a controller begins
DIVERGED = 1e9  # change in a round, relative to that of the first, from which rounds do not settle any more
MEMORY = 6  # rounds that the next one is made of (Anderson acceleration)


class StateSpace(NamedTuple):
    """x[k + 1] = A x[k] + B u[k], y[k] = C x[k] + D u[k]."""

    A: Array
    B: Array
    C: Array
    D: Array


class LinearModel(SimulatedModel):
    """Nominal model of kind `linear`: a transfer function or state space, alone or in a loop."""

    kind = "linear"
    driven = True

    def __init__(self, spec: NominalSpec) -> None:
        if spec.linear is None:
            raise ValueError("linear: found nothing, wanted a section")
        self.spec = spec.linear
        self._check(spec)
        name = self.spec.subsystem
        actuation, fed_back = f"{name}_actuation", f"{name}_feedback"
        self.inside = (actuation, fed_back) if self.spec.feedback else ()
        self.offs = {offer.parameter: offer.off for offer in spec.offer}
        self._nominal_A = self.matrices({**self.offs, **{key: p.value for key, p in spec.parameters.items()}})[0]
        # Where the plant settles, the initial state takes what an offset of the input does more than one of the reading.
        self.shifted = self.spec.feedback is None and self._integrates()
        super().__init__(spec, self.spec, spec.offer)
        self.hold, self.hold_stated = self.spec.hold, "hold" in self.spec.model_fields_set
        holds = HOLDS if self.spec.feedback is None else tuple(LOOP_WORDS)
        self.holds = holds if self.spec.period_s is None else ()
        if self.hold not in holds:
            raise InputError("linear.hold", self.hold, f"one of {', '.join(holds)} without linear.feedback")
        if self.spec.feedback is not None:
            self.hold_words = ("The controller", LOOP_WORDS)
            output, channels = self.spec.feedback.output, tuple(self.spec.outputs)
            self.inside_units = {actuation: self.units.get(self.spec.feedback.actuation, ""), fed_back: self.units[output]}
            self.ports += (
                Port(actuation, "motion", name, channels, held=True),
                Port(fed_back, "drift+timing+limit", self.subsystem_of(output), channels),
            )

    def _integrates(self) -> bool:
        """Whether a constant input moves the nominal plant for ever."""
        A = self._nominal_A
        at_rest = A - np.eye(A.shape[0]) if self.spec.period_s is not None else A
        return A.size > 0 and bool(np.linalg.matrix_rank(at_rest) < A.shape[0])

    def _check_names(self, spec: NominalSpec) -> set[str]:
        """Return the names in the coefficients, each of which has to be a parameter."""
        known = {*spec.parameters, *(offer.parameter for offer in spec.offer)}
        used: set[str] = set()
        for key, coefficients in _coefficients(self.spec):
            for text in coefficients:
                used |= names_in(text, key)
                for name in sorted(names_in(text, key) - known):
                    raise InputError(key, name, "a parameter under [parameters]")
        return used

    def _check(self, spec: NominalSpec) -> None:
        used = self._check_names(spec)
        section = self.spec
        outputs = len(section.outputs)
        if section.feedback is not None:
            loop = section.feedback
            for key, name in (("output", loop.output), ("actuation", loop.actuation or loop.output)):
                if name not in section.outputs:
                    known = ", ".join(section.outputs)
                    raise InputError(f"linear.feedback.{key}", name, f"one of linear.outputs ({known}), or add it there")
            if section.inputs != [loop.reference]:
                raise InputError("linear.inputs", section.inputs, f"the reference alone, {loop.reference}")
            outputs -= bool(loop.actuation)
        if section.A is not None and section.B is not None and section.C is not None:
            order, inputs = len(section.A), len(section.inputs)
            shapes = {
                "A": (section.A, (order, order)),
                "B": (section.B, (order, inputs)),
                "C": (section.C, (outputs, order)),
            }
            if section.D is not None:
                shapes["D"] = (section.D, (outputs, inputs))
            for key, (rows, (high, wide)) in shapes.items():
                if len(rows) != high or any(len(row) != wide for row in rows):
                    raise InputError(
                        f"linear.{key}", f"{len(rows)} rows of {[len(row) for row in rows]}", f"{high} by {wide}"
                    )
        unused = next((name for name in spec.parameters if name not in used), None)
        if unused is not None:
            raise InputError(f"parameters.{unused}", "in no coefficient", "one of " + ", ".join(sorted(used)))

    def matrices(self, parameters: Mapping[str, float]) -> tuple[Array, Array, Array, Array]:
        """A, B, C and D of the plant for these parameters."""
        section = self.spec
        if section.numerator is not None and section.denominator is not None:
            numerator, denominator = _values(section.numerator, parameters), _values(section.denominator, parameters)
            return _realized(numerator, denominator)
        assert section.A is not None and section.B is not None and section.C is not None
        A, B, C = (np.array([_values(row, parameters) for row in rows]) for rows in (section.A, section.B, section.C))
        D = (
            np.zeros((C.shape[0], B.shape[1]))
            if section.D is None
            else np.array([_values(r, parameters) for r in section.D])
        )
        return A, B, C, D

    def sampled(self, A: Array, B: Array, dt_s: float) -> tuple[Array, Array, Array]:
        """Ad, and the weights of the input at a sample and at the next. Raises InputError for another period."""
        if self.spec.period_s is not None:
            if abs(dt_s / self.spec.period_s - 1.0) > SAME_PERIOD:
                raise InputError("linear.period_s", self.spec.period_s, f"the period of the recordings, {dt_s:g} s")
            return A, B, np.zeros_like(B)
        return sampled(A, B, dt_s, self.hold)

    def hold_as(self, segments: list[Segment], hold: str) -> None:
        """Let the inputs run between samples as `hold` says."""
        if hold != self.hold:
            self.hold = hold
            self._kept.clear()

    def initial_state(self, segment: Segment) -> tuple[list[str], list[float], list[float]]:
        """The free response at the first sample: each output, its rate, and so on to the model's order.

        These say the same for all parameters; the state itself depends on how the model is written.
        """
        order = self._nominal_A.shape[0]
        names: list[str] = []
        means: list[float] = []
        sds: list[float] = []
        for row, name in zip(segment.y, self._plant_outputs(), strict=False):
            rate = self.rate_of(segment)
            (value, speed), _ = first_state(row, segment.recording.dt_s)
            size = WIDE * (float(np.nanmax(row) - np.nanmin(row)) or 1.0)
            for k in range(order):
                names.append(f"{name}_{k}")
                means.append(value if k == 0 else speed / rate if k == 1 and self.spec.period_s is None else 0.0)
                sds.append(size)
        if self.spec.feedback is not None:
            command, first = self._expected_command(segment)
            order = len(self.spec.feedback.denominator) - 1
            names += [f"{COMMAND}_{k}" for k in range(order)]
            means += [first, *[0.0] * order][:order]
            sds += [WIDE * (float(np.nanmax(command) - np.nanmin(command)) or 1.0)] * order
        return names, means, sds

    def _expected_command(self, segment: Segment) -> tuple[Array, float]:
        """The command (n,) of a nominal controller that begins at rest, from what was recorded of its error, and what a
        controller under way adds to the first of it (0 where its command was not recorded).
        """
        loop = self.spec.feedback
        assert loop is not None
        y = super().motion(segment, next(p for p in self.ports if p.name == f"{loop.output}_reading"))
        Ak, Bk, Ck, Dk = self._controller({**self.offs, **{p.name: p.grid[0] for p in self.parameters}})
        dt_s = segment.recording.dt_s
        Akd, Bk0, Bk1 = (Ak, Bk, 0.0 * Bk) if self.spec.period_s is not None else sampled(Ak, Bk, dt_s, "zero")
        error = segment.inputs[loop.reference] - y
        command = response(Akd, Bk0, Bk1, Ck, Dk, error[None, :], np.zeros(Ak.shape[0]))[0]
        if not loop.actuation:
            return command, 0.0
        (value, _), _ = first_state(segment.y[self.spec.outputs.index(loop.actuation)], dt_s)
        return command, value - float(command[0])

    def _controller(self, parameters: Mapping[str, float]) -> tuple[Array, Array, Array, Array]:
        """State space of the controller for these parameters."""
        loop = self.spec.feedback
        assert loop is not None
        return _realized(_values(loop.numerator, parameters), _values(loop.denominator, parameters))

    def rate_of(self, segment: Segment) -> float:
        """Rate of the first output; a discrete model counts in samples."""
        return typical_rate(segment.y[0], segment.recording.dt_s) if self.spec.period_s is None else 1.0

    def _plant_outputs(self) -> list[str]:
        actuation = self.spec.feedback.actuation if self.spec.feedback is not None else ""
        return [name for name in self.spec.outputs if name != actuation]

    def _begin_state(self, run: SimulatorRun, A: Array, C: Array, names: list[str]) -> Array:
        """State at the first sample from the free responses `names` (rows of C) that `initial` describes, in a scale of
        time of its own.
        """
        if not run.initial or not A.size:
            return np.zeros(A.shape[0])
        scale, rows, wanted = run.rate, [], []
        for row, name in zip(C, names, strict=True):
            for k in range(A.shape[0]):
                rows.append(row)
                wanted.append(run.initial[f"{name}_{k}"])
                row = row @ A / scale
        return np.asarray(np.linalg.lstsq(np.array(rows), np.array(wanted), rcond=1e-10)[0])

    def run_many(self, runs: list[SimulatorRun]) -> list[Array]:
        """Outputs of each run, the loop closed around effects inside it."""
        return [self._checked(run, self._solved(run)) for run in runs]

    def run(
        self, inputs: dict[str, Array], parameters: dict[str, float], time_s: Array, initial: dict[str, float]
    ) -> Mapping[str, Array]:
        """Outputs without effects inside the loop."""
        return self._solved(SimulatorRun(inputs, parameters, time_s, initial))

    def _solved(self, run: SimulatorRun) -> dict[str, Array]:
        parameters = {**self.offs, **run.parameters}
        dt_s = float(np.median(np.diff(run.time_s)))
        A, B, C, D = self.matrices(parameters)
        names = self._plant_outputs()
        if not (np.isfinite(A).all() and np.isfinite(B).all() and np.isfinite(C).all()):
            return {name: np.full(run.time_s.size, np.nan) for name in self.spec.outputs}
        begin = self._begin_state(run, A, C, names)
        if self.spec.feedback is None:
            Ad, B0, B1 = self.sampled(A, B, dt_s)
            u = np.vstack([run.inputs[name] for name in self.spec.inputs])
            return dict(zip(names, response(Ad, B0, B1, C, D, u, begin), strict=True))
        loop = self.spec.feedback
        plant, controller = StateSpace(A, B, C, D), StateSpace(*self._controller(parameters))
        at_first = np.concatenate((begin, self._begin_state(run, controller.A, controller.C, [COMMAND])))
        fed, reference = names.index(loop.output), run.inputs[loop.reference]
        solve = self._loop(plant, controller, fed, reference, at_first, dt_s)

        changes = np.zeros((2, run.time_s.size))
        y, command = solve(changes)
        if run.inside is not None:
            changes = settled(lambda given: self._caused(run, solve(given), fed), changes)
            y, command = solve(changes)
        found = dict(zip(names, y, strict=True))
        if loop.actuation:
            found[loop.actuation] = command + changes[0]
        return found

    def _loop(
        self, plant: StateSpace, controller: StateSpace, fed: int, reference: Array, begin: Array, dt_s: float
    ) -> Callable[[Array], tuple[Array, Array]]:
        """Outputs and the controller's command of the loop, as a function of changes (2, n) of the plant's input and of the
        output that is fed back. begin: states of the plant, then of the controller.
        """
        order = plant.A.shape[0]
        if self.hold != "zero" and self.spec.period_s is None:
            loop = continuous_loop(plant, controller, fed)
            step, now, after = sampled(loop.A, loop.B, dt_s, "linear")
            if self.hold == "held_reference":
                now[:, 0], after[:, 0] = now[:, 0] + after[:, 0], 0.0

            def together(changes: Array) -> tuple[Array, Array]:
                u = np.vstack((reference, changes))
                *y, command = response(step, now, after, loop.C, loop.D, u, begin)
                return np.array(y), command

            return together
        if self.spec.period_s is None:
            step, now, _ = sampled(controller.A, controller.B, dt_s, "zero")
            controller = controller._replace(A=step, B=now)
            step, now, _ = sampled(plant.A, plant.B, dt_s, "zero")
            plant = plant._replace(A=step, B=now)
        else:
            self.sampled(plant.A, plant.B, dt_s)  # checks the period
        return lambda changes: closed_loop(plant, controller, fed, reference, changes, begin[:order], begin[order:])

    def _caused(self, run: SimulatorRun, signals: tuple[Array, Array], fed: int) -> Array:
        """Changes (2, n) that the effects inside the loop make of its signals."""
        assert run.inside is not None
        segment, active = run.inside
        out = [signals[1], signals[0][fed]]
        with np.errstate(over="ignore", invalid="ignore"):  # a loop that diverges counts as far from every recording
            changed = [apply_effects(s, active, name, segment, None) for s, name in zip(out, self.inside, strict=True)]
            return np.array(changed) - np.array(out)

    def prepare(self, recording: Any) -> Segment:
        """Prepare a recording as every simulator does; sizes inside the loop are those of the nominal model."""
        segment = super().prepare(recording)
        for name in self.inside:
            segment.units[name] = segment.units[f"output:{name}"] = self.inside_units[name]
        return segment

    def motion(self, segment: Segment, port: Port) -> Array:
        """Inside the loop the nominal signal, elsewhere what was recorded."""
        if port.name not in self.inside or self.spec.feedback is None:
            return super().motion(segment, port)
        loop = self.spec.feedback
        if port.name == self.inside[1]:
            return super().motion(segment, next(p for p in self.ports if p.name == f"{loop.output}_reading"))
        if loop.actuation:
            return super().motion(segment, next(p for p in self.ports if p.name == f"{loop.actuation}_reading"))
        return self._expected_command(segment)[0]

    def needs(self, segment: Segment, port: Port, theta: Array, residual: Array) -> Array:
        """Inside the loop, the residual of the output that is fed back."""
        if port.name in self.inside and self.spec.feedback is not None:
            return np.asarray(residual[self.spec.outputs.index(self.spec.feedback.output)])
        return super().needs(segment, port, theta, residual)


def _coefficients(section: LinearSpec) -> list[tuple[str, list[Coefficient]]]:
    """Every list of coefficients with its key."""
    found = [(f"linear.{key}", getattr(section, key)) for key in ("numerator", "denominator") if getattr(section, key)]
    for key in "ABCD":
        found += [(f"linear.{key}", row) for row in getattr(section, key) or []]
    if section.feedback is not None:
        found += [(f"linear.feedback.{key}", getattr(section.feedback, key)) for key in ("numerator", "denominator")]
    return found


def _values(coefficients: list[Coefficient], parameters: Mapping[str, float]) -> Array:
    return np.array([value_of(one, parameters) for one in coefficients])


def _realized(numerator: Array, denominator: Array) -> tuple[Array, Array, Array, Array]:
    """State space of a transfer function; NaN where the denominator is nothing."""
    if not (np.isfinite(numerator).all() and np.isfinite(denominator).all()) or denominator[0] == 0.0:
        order = max(denominator.size - 1, 0)
        return np.full((order, order), np.nan), np.zeros((order, 1)), np.zeros((1, order)), np.zeros((1, 1))
    if denominator.size == 1:
        return np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.array([[numerator[-1] / denominator[0]]])
    A, B, C, D = tf2ss(numerator, denominator)
    return np.asarray(A), np.asarray(B), np.asarray(C), np.asarray(D)


def typical_rate(row: Array, dt_s: float) -> float:
    """Typical rate (1/s) of a signal (n,): RMS of its derivative over its own."""
    seen = row[np.isfinite(row)]
    size = float(np.std(seen)) or 1.0
    return max(float(np.std(np.diff(seen))) / dt_s / size, 1e-3 / dt_s)


def sampled(A: Array, B: Array, dt_s: float, hold: str) -> tuple[Array, Array, Array]:
    """Ad, B0 and B1 of x[k + 1] = Ad x[k] + B0 u[k] + B1 u[k + 1], for an input held (zero) or straight (linear)."""
    n, m = B.shape
    whole = np.zeros((n + 2 * m, n + 2 * m))
    whole[:n, :n], whole[:n, n : n + m] = A * dt_s, B * dt_s
    whole[n : n + m, n + m :] = np.eye(m)
    grown = expm(whole)
    # Copies: a compiled product of parts of a larger matrix is slower, and numba warns of it on the user's terminal.
    step, held, ramp = (np.ascontiguousarray(part) for part in (grown[:n, :n], grown[:n, n : n + m], grown[:n, n + m :]))
    if hold == "zero":
        return step, held, np.zeros_like(held)
    return step, held - ramp, ramp


@njit(cache=True, inline="always")
def add_product(out: Array, M: Array, v: Array) -> None:
    """Add M v to `out`.

    A loop, inlined: for a few states a call, of a matrix product or of a function on parts of arrays, takes longer than its
    arithmetic.
    """
    for i in range(M.shape[0]):
        for j in range(M.shape[1]):
            out[i] += M[i, j] * v[j]


@njit(cache=True)
def response(A: Array, B0: Array, B1: Array, C: Array, D: Array, u: Array, begin: Array) -> Array:
    """Outputs (outputs, n) to inputs u (inputs, n) from the state `begin`."""
    n = u.shape[1]
    out = np.zeros((C.shape[0], n))
    x, after = begin.copy(), np.empty(begin.size)
    for k in range(n):
        add_product(out[:, k], C, x)
        add_product(out[:, k], D, u[:, k])
        after[:] = 0.0
        add_product(after, A, x)
        add_product(after, B0, u[:, k])
        add_product(after, B1, u[:, min(k + 1, n - 1)])
        x[:] = after
    return out


@njit(cache=True)
def closed_loop(
    plant: StateSpace, controller: StateSpace, fed: int, reference: Array, changes: Array, begin: Array, under_way: Array
) -> tuple[Array, Array]:
    """Outputs (outputs, n) and command (n,) of plant and controller, both sampled, the plant's input held between samples.

    fed: row of the output that is fed back. changes: (2, n) of the plant's input and of that output, by effects. begin,
    under_way: states of the plant and of the controller at the first sample.
    A plant that answers at once (D not zero) answers the input of the sample before.
    """
    A, B, C, D = plant
    Ak, Bk, Ck, Dk = controller
    n = reference.size
    y, command = np.zeros((C.shape[0], n)), np.zeros(n)
    x, z = begin.copy(), under_way.copy()
    x_after, z_after = np.empty(x.size), np.empty(z.size)
    u, error = np.zeros(1), np.zeros(1)
    for k in range(n):
        add_product(y[:, k], D, u)
        add_product(y[:, k], C, x)
        error[0] = reference[k] - y[fed, k] - changes[1, k]
        add_product(command[k : k + 1], Dk, error)
        add_product(command[k : k + 1], Ck, z)
        u[0] = command[k] + changes[0, k]
        z_after[:], x_after[:] = 0.0, 0.0
        add_product(z_after, Bk, error)
        add_product(z_after, Ak, z)
        add_product(x_after, B, u)
        add_product(x_after, A, x)
        x[:], z[:] = x_after, z_after
    return y, command


def continuous_loop(plant: StateSpace, controller: StateSpace, fed: int) -> StateSpace:
    """Plant and controller as one continuous model: of the reference, the change of the plant's input and that of the
    output that is fed back (row `fed`); its outputs are those of the plant and the controller's command.
    """
    A, B, C, D = plant
    Ak, Bk, Ck, Dk = controller
    inputs = np.eye(3)[:, None, :]  # as rows (1, 3)
    r, du, dy = inputs
    answer = 1.0 / (1.0 + float(Dk[0, 0] * D[fed, 0]))  # a plant that answers at once
    # u = command + du, command = Ck z + Dk e, e = r - C x - D u - dy
    u_x, u_z = -answer * Dk @ C[fed : fed + 1], answer * Ck
    u_in = answer * (Dk * (r - dy) + du)
    e_x, e_z = -C[fed : fed + 1] - D[fed, 0] * u_x, -D[fed, 0] * u_z
    e_in = r - dy - D[fed, 0] * u_in
    return StateSpace(
        np.block([[A + B @ u_x, B @ u_z], [Bk @ e_x, Ak + Bk @ e_z]]),
        np.vstack((B @ u_in, Bk @ e_in)),
        np.block([[C + D @ u_x, D @ u_z], [u_x, u_z]]),
        np.vstack((D @ u_in, u_in - du)),
    )


def settled(caused: Any, begin: Array) -> Array:
    """Changes (2, n) that cause themselves, by fixed-point rounds with Anderson acceleration; NaN where they do not settle.

    Walker and Ni, Anderson acceleration for fixed-point iterations, SIAM Journal on Numerical Analysis 49 (2011).
    """
    points: list[Array] = [begin.ravel()]
    images: list[Array] = [caused(begin).ravel()]
    for _ in range(MOST_ROUNDS):
        error = images[-1] - points[-1]
        if not np.max(np.abs(error)) < DIVERGED * (1.0 + np.max(np.abs(images[0]))):
            break
        if np.max(np.abs(error)) <= SETTLED * max(float(np.max(np.abs(images[-1]))), 1e-300):
            return images[-1].reshape(begin.shape)
        errors = np.array([image - point for image, point in zip(images, points, strict=True)])
        if len(points) > 1:
            steps = np.diff(errors, axis=0).T
            weights = np.linalg.lstsq(steps, errors[-1], rcond=1e-8)[0]
            new = images[-1] - np.diff(np.array(images), axis=0).T @ weights
        else:
            new = images[-1]
        points, images = [*points[-MEMORY + 1 :], new], [*images[-MEMORY + 1 :], caused(new.reshape(begin.shape)).ravel()]
    return np.full(begin.shape, np.nan)
