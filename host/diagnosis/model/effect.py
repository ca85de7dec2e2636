"""What an effect module is: an id, the ports it may act at, its parameters with bounds, and what it does to a signal."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from host.diagnosis.model.operators import direction

Array = npt.NDArray[np.float64]


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

    @property
    def key(self) -> str:
        """Name with its unit as the JSON wants it, e.g. `width_m`."""
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
    source_span: float = 1.0
    source_rms: float = 1.0
    motion_unit: str = ""  # force ports: unit of the motion
    motion_span: float = 1.0


@dataclass
class Context:
    """What an effect may look at besides the signal it changes."""

    time_s: Array
    dt_s: float
    motion: Array  # nominal input of the port
    tolerance: float
    start: float = 0.0  # displacement needed at the first sample: start of memory
    source: Array | None = None
    extra: dict[str, Any] = field(default_factory=dict)
    _cache: dict[str, Array] = field(default_factory=dict)

    def moving(self, signal: Array) -> Array:
        """Direction of the last movement of `signal`."""
        return direction(signal, self.tolerance)

    def rate(self, signal: Array) -> Array:
        """Rate of `signal` per second by central differences."""
        return np.gradient(signal, self.dt_s)

    @property
    def load(self) -> Array:
        """The source signal of this candidate."""
        if self.source is None:
            raise ValueError("source: found nothing, wanted a load or another channel")
        return self.source


Apply = Callable[[Any, Context, Array, str], Any]
Parameters = Callable[[Scale, str], tuple[Parameter, ...]]


@dataclass(frozen=True)
class Effect:
    """One effect at one kind of port.

    `port`: motion (a kinematic signal), turn (an angle), force (a force balance), timing, limit, drift and mix (a scalar
    reading),
    or one of the rig's own ports. A `Port` is of one or several of these kinds, joined by `+`.
    `source`: what it depends on besides: "load" (a force), "drag" (a force or bend that presses), "other" (another channel).
    `order`: place among the effects of one port, small first. `side`: motion ports only, before or after the nominal gain.
    `apply(signal, context, values, form)`: the changed signal. Force ports give `slots` for the force kernel instead.
    `contains`: ids of which this one is a generalization (nested pairs).
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
    family: str = ""  # of one family only one acts at a port: the second takes the place of the first


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


@dataclass(frozen=True)
class Candidate:
    """An effect bound to a port, a source channel and a form."""

    effect: Effect
    port: Port
    source: str = ""
    form: str = ""

    @property
    def key(self) -> str:
        """Readable identity, e.g. `backlash@insertion`."""
        tail = ",".join(part for part in (self.source, self.form) if part)
        return f"{self.effect.id}@{self.port.name}" + (f"({tail})" if tail else "")

    @property
    def name(self) -> str:
        """Effect and subsystem: what a verdict names."""
        return f"{self.effect.id}@{self.port.subsystem}"


@cache
def library() -> tuple[Effect, ...]:
    """Every effect of the package `effects`, in the order of their files."""
    from host.diagnosis import effects

    found: list[Effect] = []
    for info in sorted(pkgutil.iter_modules(effects.__path__), key=lambda item: item.name):
        module = importlib.import_module(f"{effects.__name__}.{info.name}")
        found += list(getattr(module, "EFFECTS", ()))
    return tuple(found)


def candidates(ports: tuple[Port, ...], timed: bool, left_out: frozenset[str] = frozenset()) -> list[Candidate]:
    """All candidates at `ports`; rate effects only with a time line.

    `left_out`: ids, id:form, or id:form@port, not to use: what the nominal model has already, and those of a
    leave-one-out proof.
    """
    found = []
    for port in ports:
        for effect in library():
            if (
                effect.id in left_out
                or effect.port not in port.kind.split("+")
                or effect.id in left_out
                or (effect.timed and not timed)
            ):
                continue
            sources = {"": ("",), "load": port.loads, "drag": port.drags or port.loads, "other": port.others}[effect.source]
            forms = [
                form for form in effect.forms if not {f"{effect.id}:{form}", f"{effect.id}:{form}@{port.name}"} & left_out
            ]
            found += [Candidate(effect, port, source, form) for source in sources for form in forms]
    return found


def spread(low: float, high: float, count: int) -> tuple[float, ...]:
    """`count` values from `low` to `high` in equal ratios."""
    return tuple(float(value) for value in np.geomspace(low, high, count))
