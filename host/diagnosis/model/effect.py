"""Interface of an effect module: an id, its ports, its parameters with bounds, and its action on a signal."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from host.diagnosis.model.operators import direction

Array = npt.NDArray[np.float64]
# Units of forces and moments, each with the same unit without its scale.
FORCES = {"N": "N", "mN": "N", "kN": "N", "N m": "N m", "Nm": "N m", "N*m": "N m", "mN m": "N m"}
MOST_LINES = 200_000  # of a search by frequency: 8 Hz over three hours


@dataclass(frozen=True)
class Parameter:
    """One parameter. `grid`: values tried first; `log`: fitted as its logarithm (positive); `linear`: the change is
    proportional to it.
    """

    name: str
    unit: str
    grid: tuple[float, ...]
    low: float = -np.inf
    high: float = np.inf
    log: bool = False
    linear: bool = False
    step: float = 0.0  # natural size of a signed parameter; 0: the largest of the grid
    vanishes: bool = False  # its lower bound is as good as zero: no sign that another form is wanted
    shape: bool = False  # its upper bound is a limit of the form, even where the effect's bounds are natural
    dead_time: bool = False  # so many seconds of the output come from before the recording, below zero from after it
    event: bool = False  # the instant of a single event: only samples around it show it, no finer than their period
    follows: str = ""  # nominal parameter whose sign it has: a branch of a spring counts as the spring does
    spectral: bool = False  # a frequency in Hz: tried where the residual's spectrum has its lines

    @property
    def key(self) -> str:
        """Return the name with its unit as in the JSON, e.g. `width_m`."""
        unit = self.unit.replace("/", "_per_").replace(" ", "_").replace("^", "").replace(".", "_").strip("_")
        unit = unit.replace("1_per_", "per_")
        return f"{self.name}_{unit}" if unit else self.name


@dataclass(frozen=True)
class Scale:
    """Sizes at a port, from the recordings to fit: what start values and bounds are made of."""

    unit: str  # of the signal the effect changes
    span: float  # peak to peak of that signal
    low: float
    high: float
    speed: float  # RMS rate, per second
    tolerance: float  # movements below this are not movements
    need: float  # RMS of the mismatch as seen at this port
    dt_s: float
    duration_s: float
    timed: bool
    source_unit: str = ""
    source_rms: float = 1.0
    source_span: float = 1.0
    motion_unit: str = ""  # force ports: unit of the motion
    motion_span: float = 1.0


@dataclass
class Context:
    """Signals that an effect may read in addition to the one it changes."""

    time_s: Array
    dt_s: float
    motion: Array  # nominal input of the port
    tolerance: float
    start: float = 0.0  # displacement needed at the first sample: start of memory
    source: Array | None = None
    equations: dict[str, Array] = field(default_factory=dict)  # values of forms found by search, one in each sample
    start_rate: float = 0.0  # speed at the first sample beyond that of the motion: start of memory of second order
    starts: tuple[float, ...] = ()  # of an effect with `memories`: each of them, in this recording
    points: int = 1  # of the signal in one sample, where it is held between samples

    def moving(self, signal: Array) -> Array:
        """Direction of the last movement of `signal`."""
        return direction(signal, self.tolerance)

    def after(self, instant: float) -> Array:
        """Return 0 before `instant` (s) and 1 after it (n,); the step is one sample wide."""
        return np.asarray(np.clip((self.time_s - instant) / self.dt_s + 0.5, 0.0, 1.0))

    def laid_out(self, key: str) -> Array:
        """Values of the form `key` of `equations`, at each point of the signal."""
        values = self.equations[key]
        return values if self.points == 1 else np.repeat(values, self.points)

    def rate(self, signal: Array) -> Array:
        """Rate of `signal` per second by central differences."""
        return np.gradient(signal, self.dt_s)

    @property
    def load(self) -> Array:
        """The source signal of this candidate."""
        if self.source is None:
            raise ValueError("source: found nothing, wanted a load or another channel")
        return self.source


@dataclass(frozen=True)
class Evidence:
    """The residual at a port before an effect is fitted: one array (n,) for each recording, only samples to fit."""

    time_s: tuple[Array, ...]
    need: tuple[Array, ...]  # displacement or force that the port would need, NaN where nothing was measured
    readings: tuple[Reading, ...]
    one_clock: bool  # the recordings lie one after the other on one clock
    others: tuple[tuple[Array, ...], ...] = ()  # what else than the outputs was recorded, at every sample (n,)


@dataclass(frozen=True)
class Reading:
    """One output in one recording, samples to fit alone: what was simulated, the residual, and the weight of both.

    course: what was simulated, at every sample of the recording.
    """

    unit: str
    simulated: Array
    residual: Array
    scale: float
    course: Array = field(default_factory=lambda: np.zeros(0))


Apply = Callable[[Any, Context, Array, str], Any]
Parameters = Callable[[Scale, str], tuple[Parameter, ...]]
Seeds = Callable[[Evidence, tuple[Parameter, ...], str], tuple[Parameter, ...]]
Corner = Callable[[Array], tuple[str, str]]


@dataclass(frozen=True)
class Effect:
    """One effect at one kind of port.

    `port`: motion (a kinematic signal), turn (an angle), load (one that deflects the output), deflection (what it does),
    force (a force balance), travel (the motion that a force balance is given), timing, clock, limit, drift, mix and wrap (a
    scalar reading), or one of the rig's own ports. A `Port` is of one or several of these kinds, joined by `+`.
    `source`: the further signal that it depends on: "load" (a force), "drag" (a force or bend that presses), "spring" (a
    force of the law itself), "other" (another channel). `order`: place among the effects of one port, small first. `side`:
    motion ports only, before or after the nominal gain. `apply(signal, context, values, form)`: the changed signal. Force
    ports give `slots` for the force kernel instead. `contains`: ids of which this one is a generalization (nested pairs).
    """

    id: str
    port: str
    order: int
    parameters: Parameters
    says: str
    equation: str
    apply: Apply | None = None
    slots: Callable[[Array, str], dict[str, float]] | None = None
    side: str = "input"
    source: str = ""
    timed: bool = False
    forms: tuple[str, ...] = ("",)
    contains: tuple[str, ...] = ()
    seeds: Seeds | None = None  # start values out of the residual, where no grid is fine enough
    corner: Corner | None = None  # of a form that spans several ids: the id that values stand for, and what it then says
    spans: tuple[str, ...] = ()  # those ids
    listed: bool = True  # of the vocabulary
    extended: bool = False  # the vocabulary's effect is a narrower law: an equation outside it would say the same
    searched: bool = False  # an equation of recorded signals: it says nothing of a motion that was not recorded
    dated: bool = False  # its events belong to the recordings they were seen in: no other one says anything of them
    dissipates: bool = False  # its linear parameters are friction: none is negative, whichever way an output counts
    family: str = ""  # of one family only one acts at a port: the second takes the place of the first
    remembers: bool = False  # its state at a recording's first sample is not known: it is estimated
    begins_with_speed: bool = False  # so is its speed there
    memories: tuple[str, ...] = ()  # what each recording begins with, instead of a displacement: an amplitude, for one
    natural_bounds: bool = False  # a parameter may end at its bound: the bound is physics
    at_rest: bool = False  # seen without any motion of its port
    several: bool = False  # more than one may act at a port
    hides: bool = False  # the nominal parameters cannot be fitted without it
    shifts: str = ""  # its parameter is a delay: "time", or "rate" of one that grows
    joins: tuple[tuple[str, str], ...] = ()  # effects (id, form) of one parameter each that it is the sum of, in their order
    filters: bool = False  # a law of its motion with memory, linear where no limit is reached: it can take noise out
    invariant: bool = False  # linear and time-invariant: before or behind a linear plant it does the same
    rounded: bool = False  # a law without its corner: it takes the place of that law where the data call for it
    # Start values from the parameters of a mode of the drive that may be taken for it, and how late (s) the drive then is.
    as_mode: Callable[[dict[str, float]], tuple[dict[str, float], float] | None] | None = None
    of_law: bool = False  # a term that a nominal law can have itself, as exact as those that it has
    affine: bool = False  # a reading times a constant plus a constant: a state that is read begins elsewhere with it

    @property
    def cancels_noise(self) -> bool:
        """Whether it is a linear law with memory, which can take away noise of its input."""
        return self.filters or self.invariant or bool(self.shifts)


@dataclass(frozen=True)
class Port:
    """A place of the model where effects act. `loads`, `others`: names of channels an effect here may depend on."""

    name: str
    kind: str
    subsystem: str
    channels: tuple[str, ...]
    loads: tuple[str, ...] = ()
    others: tuple[str, ...] = ()
    drags: tuple[str, ...] = ()
    springs: tuple[str, ...] = ()  # forces of the law itself, which may press what rubs
    offers: tuple[Effect, ...] = ()  # parameters of a simulator that compete as effects, of this port alone
    held: bool = False  # an input that is held between samples: a delay within one sample is how it was held
    within: str = ""  # port of the link that this place along a loaded link belongs to: an equation acts there
    against: bool = False  # forces there count against the motion, never with it, also where a reading may count either way
    path: tuple[str, ...] = ()  # this port and those to which a linear time-invariant model alone leads


@dataclass(frozen=True)
class Candidate:
    """An effect bound to a port, a source channel and a form."""

    effect: Effect
    port: Port
    source: str = ""
    form: str = ""

    @property
    def key(self) -> str:
        """Return the identity as text, e.g. `backlash@insertion`."""
        tail = ",".join(part for part in (self.source, self.form) if part)
        return f"{self.effect.id}@{self.port.name}" + (f"({tail})" if tail else "")

    @property
    def name(self) -> str:
        """Effect and subsystem: what a verdict names."""
        return f"{self.effect.id}@{self.port.subsystem}"


def same_place(a: Candidate, b: Candidate) -> bool:
    """Whether no data can tell the place of `a` from that of `b`: one port, or linear time-invariant effects on one path.

    Linear time-invariant operators commute: a delay of the input of a linear plant is a delay of its output.
    """
    return a.port.name == b.port.name or (b.port.name in a.port.path and a.effect.invariant and b.effect.invariant)


def alike_everywhere(a: Candidate, b: Candidate) -> bool:
    """Whether `a` and `b` are one effect at two places that no motion separates."""
    return a.effect.id == b.effect.id and a.port.name != b.port.name and same_place(a, b)


def rate_key(port: str) -> str:
    """Key of the speed with which memory at `port` begins, among the starts of a recording."""
    return f"{port}/rate"


def memory_keys(candidate: Candidate) -> tuple[str, ...]:
    """Keys of what the memory of `candidate` begins with, among the starts of a recording; its speed is not among them."""
    port = candidate.port.name
    return tuple(f"{port}/{name}" for name in candidate.effect.memories) or (port,)


def cornered(candidate: Candidate, values: Array) -> Candidate:
    """`candidate` under the id that its fitted `values` stand for, if its effect spans several."""
    corner = candidate.effect.corner
    if corner is None:
        return candidate
    effect_id, says = corner(values)
    return replace(candidate, effect=replace(candidate.effect, id=effect_id, says=says))


def spread(low: float, high: float, count: int) -> tuple[float, ...]:
    """`count` values from `low` to `high` in equal ratios."""
    return tuple(float(value) for value in np.geomspace(low, high, count))


def in_form(effect: Effect, form: str, says: str, equation: str) -> Effect:
    """`effect` in another form, which says something else by another equation."""
    return replace(effect, forms=(form,), says=says, equation=equation)


def lines(s: Scale, low_Hz: float, top_Hz: float, spacing: float) -> tuple[float, ...]:
    """Frequencies (Hz) to search, so far apart that the phase differs by `spacing` turns over the recordings.

    At most MOST_LINES: two recordings of one clock may lie days apart.
    """
    return tuple(np.arange(low_Hz, top_Hz, max(spacing / s.duration_s, top_Hz / MOST_LINES)))


def is_force(unit: str) -> bool:
    """Return whether `unit` is one of force or moment."""
    return unit in FORCES
