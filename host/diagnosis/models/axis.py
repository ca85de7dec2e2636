"""Force in, motion out: m a + c v + k x = force + offset, simulated freely, from recorded force or under a controller."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from numpy.lib.stride_tricks import sliding_window_view
from scipy.integrate import cumulative_trapezoid

from host.diagnosis.estimation.noise import Noise
from host.diagnosis.model.dataset import Recording
from host.diagnosis.model.effect import Parameter, Port
from host.diagnosis.model.force_kernel import SPRING, run_axis, slot_array
from host.diagnosis.model.model import (
    ActiveEffect,
    Begin,
    Model,
    Output,
    Segment,
    affine_reading,
    apply_effects,
    filled,
    stack,
    tolerance_of,
)
from host.diagnosis.model.nominal import NominalSpec
from host.diagnosis.model.operators import calm, fill, reading_noise, smooth_derivatives, smoothed, wander_at_rest
from host.diagnosis.models import balance
from protocol.errors import InputError

Array = npt.NDArray[np.float64]
BEGINS = ("position", "speed", "second_place", "second_speed")  # the last two are those of a second mass from the axis
READ = ("position", "velocity", "acceleration")
SMOOTHING_S = 0.02  # longest window of the smoothing,
SHORTEST = 7  # and samples of the shortest one
SMOOTH_OVER_NOISE = 2.0  # difference from the smoothed motion, over the noise, from which the window is too long
UNSEEN_S = 0.05  # least scale of an initial position or speed that is not read
UNKNOWN = np.array([0.01, 0.05])  # of the range of position and speed, that an input before the recording can have made
KICK = 100.0  # changes of the usual size that an input makes in one sample, from which it changes the first speed at once
FINER = 8  # points in each sub-step at which a held input is computed that an effect delays


@dataclass
class AxisSegment(Segment):
    """A recording with its smoothed motion, and what either way of comparing needs of it."""

    x: Array = field(default_factory=lambda: np.zeros(0))  # (n,) reading, smoothed, its rate, and the rate of that
    v: Array = field(default_factory=lambda: np.zeros(0))
    a: Array = field(default_factory=lambda: np.zeros(0))
    substeps: int = 1  # of the integration, in one period
    stages: Array | None = None  # (n, substeps, 3) recorded input at the stages of Runge-Kutta
    balance: balance.Balance | None = None
    force_noise: Array | None = None  # (n,) of the recorded force, where it is what is compared: its distance from means,
    fine_force_noise: Array | None = None  # (n,) and from parabolas, which follow its bends
    rests: npt.NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))  # (n,) where the axis is at rest


class AxisModel(Model):
    """Nominal model of kind `axis`.

    With a controller in the nominal the loop is closed in simulation and the force is compared too. Without one, and
    without a spring, small forces that were not recorded let the simulated axis run away from a recording. The force that
    its measured motion needs is then compared with the input instead (`balance.py`), unless `compare` is "motion". A
    diagnosis without `compare` tries "motion" first and keeps it if that explains the recordings down to their noise.
    """

    kind = "axis"

    def __init__(self, spec: NominalSpec, along: bool = False) -> None:
        """along: whether the force is compared that the measured motion needs, also where a spring holds the axis."""
        if spec.axis is None:
            raise ValueError("axis: found nothing, wanted a section")
        self.nominal, self.spec = spec, spec.axis
        self.hold: str = spec.axis.hold or "linear"
        self.hold_stated = spec.axis.hold is not None
        self.holds = balance.HOLDS if spec.axis.controller is None else ()
        self.units = {name: channel.unit for name, channel in spec.channels.items()}
        self.reads = "position" if along else self.spec.reads  # a speed is integrated, to be compared along the motion
        force, motion, name = self.units[self.spec.input], self.units[self.spec.output], self.spec.subsystem
        place = integral_unit(motion, READ.index(self.spec.reads))
        self.free_run = not along and (not self.spec.runs_away or self.spec.compare == "motion")
        self.driven = self.free_run and self.spec.controller is None
        outputs = [Output(self.spec.output, motion, name)] if self.free_run else []
        if self.spec.controller is not None or not self.free_run:
            outputs.append(Output(self.spec.input, force, name))
        self.outputs = tuple(outputs)
        self.ports = (
            Port(name, "force+bristle", name, tuple(o.channel for o in outputs)),
            Port(
                f"{name}_drive",
                "timing+limit+mode" if spec.axis.controller is None else "loop",
                name,
                (self.spec.output,),
                held=True,
            ),
            Port(f"{name}_reading", "drift+limit+clock", name, (self.spec.output,)),
        )
        defaults = {
            "mass": (1.0, f"{force} s2/{place}"),
            "damping": (1.0, f"{force} s/{place}"),
            "stiffness": (1.0, f"{force}/{place}"),
            "offset": (0.0, force),
        }
        parameters = []
        for term in self.spec.terms:
            value, free = spec.start(term, defaults[term][0])
            if (term == "mass" and value == 0.0) or (term != "offset" and value < 0.0):
                least = "a value above 0" if term == "mass" else "0 or a value above it"
                wanted = f"{least}; leave {term} out of axis.terms if the axis has none"
                raise InputError(f"parameters.{term}", value, wanted)
            low, high = (value, value) if not free else (-np.inf, np.inf) if term == "offset" else (1e-12, 1e12)
            parameters.append(Parameter(term, defaults[term][1], (value,), low, high, log=term != "offset" and free))
        self.given = [term for term in self.spec.terms if term in spec.parameters]
        self.parameters = tuple(parameters)
        stiff, offset = ("stiffness" in self.spec.terms), ("offset" in self.spec.terms)
        self.taken = frozenset(["viscous_friction:"] if "damping" in self.spec.terms else [])
        self.taken |= {"compliance:spring"} if stiff else {"softening:", "contact_nonlinear:"}
        self.taken |= {"gravity_load:constant"} if offset else frozenset()
        self.travel = ((self.spec.output.replace("_", " "), f"motion:{name}", place),)
        self.unlisted_at = ((name, f"{name}_drive"),) if self.spec.controller is None else ()
        self.moves = {name: self.spec.output}
        self.quiet_inputs = (self.spec.input,)

    def prepare(self, recording: Recording) -> AxisSegment:
        """Input up-sampled to half sub-steps; start taken from the measured motion."""
        spec = self.spec
        names = [spec.input]
        if spec.controller is not None:
            names += [name for name in (spec.controller.reference, spec.controller.added) if name in recording.channels]
        y = stack(recording, [o.channel for o in self.outputs])
        segment = AxisSegment(recording, y, recording.fit, recording.heldout, filled(recording, names))
        motion = fill(recording.channels[spec.output])
        if self.reads != spec.reads:
            motion = cumulative_trapezoid(motion, dx=recording.dt_s, initial=0.0)
        window, x, v, spread = _smooth(motion, recording.dt_s)
        name = spec.subsystem
        once = _integrated(x, recording.dt_s, 1)
        twice = _integrated(once, recording.dt_s, 2)
        place = {"position": x, "velocity": np.cumsum(x) * recording.dt_s, "acceleration": twice}[self.reads]
        segment.inputs[f"motion:{name}"] = place
        begin = {"position": (x[0], v[0]), "velocity": (0.0, x[0]), "acceleration": (0.0, 0.0)}[self.reads]
        # Position and speed at the first sample are estimated: one is a derivative of noise, and its error rings on.
        again = self.free_run and spec.controller is None
        # What is not read is found from the recording; it begins about as large as the integral of the reading gets.
        largest = float(np.max(np.abs(x)))
        if self.reads == "velocity":
            spread = np.array([max(largest * UNSEEN_S, float(np.std(once))), spread[0]])
        elif self.reads == "acceleration":
            spread = np.array(
                [max(largest * UNSEEN_S**2, float(np.std(twice))), max(largest * UNSEEN_S, float(np.std(once)))]
            )
        elif spec.compare == "motion":  # a delay puts the unknown input before the recording into its first moments
            spread = np.maximum(spread, UNKNOWN * np.array([np.ptp(x), np.ptp(v)]))
        kick = np.abs(np.diff(segment.inputs[spec.input][: window + 1]))
        if self.reads == "position" and np.max(kick) > KICK * np.median(np.abs(np.diff(segment.inputs[spec.input]))):
            spread[1] = max(spread[1], abs(v[0]))  # the window reads the speed behind the kick, not that before it
        # A second mass on a spring moves before the recording, too. Near its mode it may be elsewhere by all of the motion.
        apart = np.array([np.ptp(place), np.ptp(np.gradient(place, recording.dt_s))])
        known = np.array([*begin, 0.0, 0.0])
        segment.begin = Begin(
            BEGINS, known, np.concatenate((spread, np.where(spread > 0.0, apart, 0.0))), known.copy(), again
        )
        segment.x, segment.v, segment.a = x, v, np.gradient(v, recording.dt_s)
        segment.substeps = self._substeps(segment)
        along = motion if self.reads == "position" else place
        segment.tolerances[name] = tolerance_of(along, float(np.ptp(along)))
        if self.reads == "position":
            segment.tolerances[name] = max(segment.tolerances[name], wander_at_rest(motion, x, window))
        segment.units = {
            **self.units,
            name: self.units[spec.input],
            f"motion:{name}": integral_unit(self.units[spec.output], READ.index(spec.reads)),
            f"{name}_drive": self.units[spec.input],
            f"{name}_reading": self.units[spec.output],
        }
        if self.free_run:
            segment.stages = stages(segment.inputs[spec.input], segment.substeps, self.hold)
        else:
            segment.y = np.zeros_like(y)
            seen = np.isfinite(recording.channels[spec.output]) & np.isfinite(recording.channels[spec.input])
            recorded = segment.inputs[spec.input]
            level = reading_noise(recorded)
            segment.force_noise = recorded - calm(recorded, level, 1.0)
            segment.fine_force_noise = recorded - smoothed(recorded, level)
            segment.balance = balance.prepare(segment, spec.input, motion, seen, SMOOTHING_S, self.hold)
            half = segment.balance.support.size // 2
            segment.rests = balance.at_rest(x, segment.tolerances[name], half)
            segment.y[:, balance.at_edges(segment.rests, half)] = np.nan
            segment.spread, segment.read_motion = half, recording.channels[spec.output]
        return segment

    def begins_with(self, segment: Segment, theta: Array, active: list[ActiveEffect]) -> npt.NDArray[np.intp]:
        """Place and speed of the axis, and those of a second mass if there is one."""
        found = super().begins_with(segment, theta, active)
        second = any(
            candidate.effect.slots is not None and "second_mass" in candidate.effect.slots(values, candidate.form)
            for candidate, values in active
        )
        return found if second else found[found < 2]

    def linear_path(self, segment: Segment, theta: Array) -> tuple[str, ...]:
        """Drive and reading: the mass on its spring and damper between them is linear."""
        name = self.spec.subsystem
        return (f"{name}_drive", f"{name}_reading") if self.spec.controller is None else ()

    def hold_as(self, segments: list[Segment], hold: str) -> None:
        """Let the input run between its samples as `hold` says, in all that is derived from it."""
        self.hold = hold
        for segment in segments:
            assert isinstance(segment, AxisSegment)
            if self.free_run:
                segment.stages = stages(segment.inputs[self.spec.input], segment.substeps, hold)
            elif segment.balance is not None:
                segment.balance = balance.held_as(segment.balance, segment, hold)

    def along_motion(self) -> AxisModel | None:
        """The same axis, compared by the force that its measured motion needs; None of a controller or an acceleration."""
        if self.spec.controller is not None or self.spec.reads == "acceleration":
            return None
        return AxisModel(self.nominal, along=True) if self.free_run else self

    def guess(self, segments: list[Segment]) -> Array:
        """Equation-error estimate in the frequency domain where the TOML gives no value: U = (-w^2 m + i w c + k) X."""
        given = np.array([p.grid[0] for p in self.parameters])
        if len(self.given) == len(self.spec.terms):
            return given
        rows, sides = [], []
        for segment in segments:
            if not segment.fit.any():
                continue
            u, y = segment.inputs[self.spec.input], fill(segment.recording.channels[self.spec.output])
            window = np.hanning(u.size)
            U, Y = np.fft.rfft(window * (u - u.mean())), np.fft.rfft(window * (y - y.mean()))
            s = 2j * np.pi * np.fft.rfftfreq(u.size, segment.recording.dt_s)
            keep = (np.abs(s) > 0) & (np.abs(U) > 0.02 * np.max(np.abs(U)))
            X = Y[keep] / s[keep] ** READ.index(self.spec.reads)
            columns = {"mass": s[keep] ** 2 * X, "damping": s[keep] * X, "stiffness": X, "offset": np.zeros_like(X)}
            rows.append(np.array([columns[term] for term in self.spec.terms]).T)
            sides.append(U[keep])
        A, b = np.concatenate(rows), np.concatenate(sides)
        size = np.linalg.norm(A, axis=0) + 1e-300
        A, b = np.concatenate((A.real, A.imag)), np.concatenate((b.real, b.imag))
        found = np.linalg.lstsq(A / size, b, rcond=1e-12)[0] / size
        pick = [
            value if term in self.given or not np.isfinite(f) or (p.log and f <= 0) else f
            for term, value, f, p in zip(self.spec.terms, given, found, self.parameters, strict=True)
        ]
        return np.array(pick)

    def restarts(self, segments: list[Segment]) -> list[Array]:
        """Nominal parameters over a range of time constants and dampings, each with the gain that gives the measured RMS.

        Parameters that the TOML holds keep their values.
        """
        used = (
            [segment for segment in segments if segment.fit.any()] if self.free_run and self.spec.controller is None else []
        )
        if not used:
            return []
        slowest_s = max(float(segment.recording.time_s[-1]) for segment in used) / 8.0
        times_s = np.geomspace(3.0 * used[0].recording.dt_s, slowest_s, 9)
        measured = np.sqrt(np.nanmean(np.concatenate([segment.y[0][segment.fit] for segment in used]) ** 2))
        found = []
        for law in [law for time_s in times_s for law in self._laws(float(time_s))]:
            theta = np.array([law[term] for term in self.spec.terms])
            run = np.concatenate([self.simulate(segment, theta, [])[0][segment.fit] for segment in used])
            rms = float(np.sqrt(np.mean(run**2)))
            if np.isfinite(rms) and rms > 0.0:
                theta = theta * rms / measured
                held = [p.grid[0] if p.high <= p.low else t for p, t in zip(self.parameters, theta, strict=True)]
                found.append(np.array(held))
        return found

    def _laws(self, time_s: float) -> list[dict[str, float]]:
        """Laws of unit gain and one time constant: oscillators where a spring holds a position, else slowing down."""
        if self.spec.reads == "position" and "stiffness" in self.spec.terms:
            slowed = [{"mass": time_s**2, "damping": 2.0 * ratio * time_s, "stiffness": 1.0} for ratio in (0.1, 0.4, 1.0)]
        else:
            slowed = [{"mass": time_s, "damping": 1.0, "stiffness": spring / time_s} for spring in (1e-9, 1.0)]
        return [{**law, "offset": 0.0} for law in slowed]

    def _substeps(self, segment: Segment) -> int:
        return 2 if self.spec.controller is not None or "stiffness" not in self.spec.terms else 3

    def simulate(self, segment: Segment, theta: Array, active: list[ActiveEffect]) -> Array:
        """Outputs in free run. Shape (outputs, n)."""
        assert isinstance(segment, AxisSegment) and segment.begin is not None
        spec = self.spec
        linear = np.zeros(4)
        for term, value in zip(spec.terms, theta, strict=True):
            linear[("mass", "damping", "stiffness", "offset").index(term)] = value
        if "mass" not in spec.terms:
            linear[0] = 1.0
        recorded, place = segment.inputs[spec.input], f"{spec.subsystem}_drive"
        drive = [effect for effect in active if effect[0].port.name == place]
        late = self.hold == "zero" and any(candidate.effect.shifts == "time" for candidate, _ in drive)
        finer = FINER * segment.substeps if late else 1  # a held input that is late by a part of a sample jumps within it
        # The force sensor is not a part of the drive: no effect smooths its noise. What a drive remembers takes the bends of
        # the force with it. To laws without memory the means stay: see docs/history/diagnosis.md.
        remembers = any(candidate.effect.remembers or candidate.effect.shifts for candidate, _ in drive)
        noise = (segment.fine_force_noise if remembers else segment.force_noise) if drive else None
        true = recorded if noise is None else recorded - noise
        force = apply_effects(np.repeat(true, finer) if late else true, drive, place, segment, None, finer=finer)
        if noise is not None:
            force = force + (np.repeat(noise, finer) if late else noise)
        slots = [
            candidate.effect.slots(values, candidate.form)
            for candidate, values in active
            if candidate.effect.slots is not None
        ]
        p = slot_array([*slots, {"stiffness": float(linear[2])}])
        # A spring that the law lacks counts as its own would: under the test function, not along the smoothed motion.
        linear[2], p[SPRING] = linear[2] + p[SPRING], 0.0
        load = np.zeros(segment.n)
        if spec.controller is not None:
            c = spec.controller
            control = np.array([c.position_gain_per_s, c.velocity_gain, c.force_gain, c.force_limit])
            reference = np.vstack([segment.inputs[c.reference], segment.inputs.get(c.added, load)])
        else:
            control, reference = np.zeros(0), load[None, :]
        if segment.balance is not None:
            measured = balance.Motion(
                segment.x,
                segment.v,
                segment.a,
                segment.tolerances[spec.subsystem],
                segment.start.get(spec.subsystem, 0.0),
                segment.rests,
                recorded if segment.force_noise is None else recorded - segment.force_noise,
            )
            return balance.error(segment.balance, segment, measured, linear, force, p)
        if segment.stages is not None and not drive:
            course = segment.stages
        elif late:
            course = averaged(force, segment.n, segment.substeps)
        else:
            course = stages(force, segment.substeps, self.hold)
        run = run_axis(
            course,
            segment.substeps,
            segment.recording.dt_s,
            linear,
            p,
            self._begin(segment, active),
            load,
            control,
            reference,
            segment.start.get(spec.subsystem, 0.0),
            float(segment.recording.time_s[0]),
        )
        motion = run[READ.index(self.reads)]
        motion = apply_effects(motion, active, f"{spec.subsystem}_reading", segment, None)
        return np.vstack([motion, run[3]]) if spec.controller is not None else motion[None, :]

    def _begin(self, segment: AxisSegment, active: list[ActiveEffect]) -> Array:
        """What the motion begins with (4,): where the effects on its reading, if affine, have what was read."""
        assert segment.begin is not None
        reads_place = self.reads == "position"
        affine = affine_reading(segment, active, f"{self.spec.subsystem}_reading") if reads_place else None
        if affine is None:
            return segment.begin.values
        offset, gain = affine
        return (segment.begin.values - np.array([offset, 0.0, 0.0, 0.0])) / gain

    def noise_of(self, segment: Segment) -> Noise | None:
        """Noise of the force that a measured motion needs, from the spectra of both."""
        assert isinstance(segment, AxisSegment)
        return segment.balance.noise if segment.balance is not None else None

    @property
    def scripted(self) -> tuple[str, ...]:
        """The controller's reference where there is one."""
        return (self.spec.controller.reference,) if self.spec.controller is not None else self.quiet_inputs

    def motion(self, segment: Segment, port: Port) -> Array:
        """Motion at the force port, force at the drive, reading at the sensor."""
        assert isinstance(segment, AxisSegment)
        if port.name == f"{self.spec.subsystem}_drive":
            return segment.inputs[self.spec.input]
        return (
            segment.x if port.name == f"{self.spec.subsystem}_reading" else segment.inputs[f"motion:{self.spec.subsystem}"]
        )

    def needs(self, segment: Segment, port: Port, theta: Array, residual: Array) -> Array:
        """Force residual where a force is compared; else the motion residual times what a unit of the reading takes.

        That is the stiffness for a position (quasi-static), and at the typical rate of the motion the sum of damping and
        inertia for a speed, and the mass for an acceleration.
        """
        if len(self.outputs) == 2 or not self.free_run:
            return np.asarray(residual[-1])
        if port.name.endswith("_reading"):
            return np.asarray(residual[0])
        assert isinstance(segment, AxisSegment)
        law = dict(zip(self.spec.terms, map(float, theta), strict=False))
        if self.spec.reads == "position":
            return np.asarray(residual[0] * law.get("stiffness", 1.0))
        mass = law.get("mass", 1.0)
        seen = np.isfinite(residual[0])
        free_of_noise = segment.y[0][seen] - residual[0][seen]
        moved = max(float(np.std(free_of_noise)), 1e-300)
        rate = float(np.std(np.diff(free_of_noise))) / segment.recording.dt_s / moved
        size = mass if self.spec.reads == "acceleration" else law.get("damping", 0.0) + mass * rate
        return np.asarray(residual[0] * size)


def integral_unit(unit: str, order: int) -> str:
    """Unit of what has `unit`, integrated over time `order` times: m/s2 becomes m."""
    for _ in range(order):
        for rate, whole in (("/s2", "/s"), ("/s^2", "/s"), ("/s", "")):
            if unit.endswith(rate):
                unit = unit.removesuffix(rate) + whole
                break
        else:
            unit = f"{unit} s"
    return unit


def _integrated(x: Array, dt_s: float, order: int) -> Array:
    """Integral (n,) of `x` (n,) without the polynomial of `order` that an unknown start and offset add to it."""
    at = np.linspace(-1.0, 1.0, x.size)
    run = np.cumsum(x) * dt_s
    return np.asarray(run - np.polynomial.polynomial.polyval(at, np.polynomial.polynomial.polyfit(at, run, order)))


def _smooth(motion: Array, dt_s: float) -> tuple[int, Array, Array, Array]:
    """Samples of the smoothing window, `motion` (n,) smoothed, its rate, and the standard deviations (2,) of position and
    speed at the first sample.

    The window is halved until a cubic over it leaves no more than twice the noise: one of 20 ms takes away a mode of 100 Hz,
    and the first speed with it.
    """
    window, spread = max(SHORTEST, round(SMOOTHING_S / dt_s) | 1), np.zeros(2)
    noise = 0.0 if window == SHORTEST else reading_noise(motion)
    while True:
        x, v, _ = smooth_derivatives(motion, dt_s, window)
        spread = np.maximum(spread, _begin_spread(motion, x, dt_s, window))
        if window == SHORTEST or float(np.std(motion - x)) <= SMOOTH_OVER_NOISE * noise:
            return window, x, v, spread
        window = max(SHORTEST, (window // 2) | 1)


def _begin_spread(motion: Array, smooth: Array, dt_s: float, window: int) -> Array:
    """Standard deviations (2,) of position and speed at the first sample, read off a cubic over `window` samples."""
    first = slice(0, min(motion.size, 20 * window))
    noise = float(np.std((motion - smooth)[first])) * float(np.sqrt(window / max(window - 4.0, 1.0)))
    t = np.arange(window) * dt_s
    covariance = np.linalg.inv(np.vander(t / t[-1], 4, increasing=True).T @ np.vander(t / t[-1], 4, increasing=True))
    return np.maximum(1.5 * noise * np.sqrt(np.diag(covariance)[:2]) / np.array([1.0, t[-1]]), 1e-300)


def stages(u: Array, substeps: int, hold: str) -> Array:
    """Input at the start, middle and end of each sub-step, (n, substeps, 3).

    A held input jumps at the samples: the end of a sample's last sub-step is still the held value, which the next sample's
    start is not. hold: zero, linear, or band_limited (by Fourier, the whole record).
    """
    n = u.size
    if hold == "zero":
        return np.broadcast_to(u[:, None, None], (n, substeps, 3)).copy()
    points = _between(u, 2 * substeps, hold)
    return np.ascontiguousarray(sliding_window_view(points, 3)[::2].reshape(n, substeps, 3))


def averaged(u: Array, n: int, substeps: int) -> Array:
    """Input at the start, middle and end of each sub-step, (n, substeps, 3), of a course `u` (n * substeps * FINER,).

    A straight line in each sub-step, with the course's mean and first moment there: a held input that is late by a part of
    a sample jumps within it, and the motion depends on when.
    """
    cells = u.reshape(n, substeps, -1)
    at = (np.arange(cells.shape[2]) + 0.5) / cells.shape[2] - 0.5
    mean, slope = cells.mean(axis=2), cells @ at / float(at @ at)
    return np.asarray(mean[:, :, None] + slope[:, :, None] * np.array([-0.5, 0.0, 0.5]))


def _between(u: Array, factor: int, hold: str) -> Array:
    """A continuous input at `factor` points a sample, (n * factor + 1,)."""
    n = u.size
    if hold == "linear":
        between = u[:-1, None] + np.diff(u)[:, None] * (np.arange(factor) / factor)
        return np.concatenate((between.ravel(), np.full(factor + 1, u[-1])))
    from scipy.signal import resample

    pad = min(n - 1, 400)
    mirrored = np.concatenate((u[pad:0:-1], u, u[-2 : -pad - 2 : -1]))
    size = 2 ** math.ceil(math.log2(mirrored.size))
    mirrored = np.pad(mirrored, (0, size - mirrored.size), mode="linear_ramp", end_values=mirrored[0])
    fine = resample(mirrored, size * factor)
    return np.asarray(fine[pad * factor : (pad + n) * factor + 1])
