"""The face that every nominal model shows the finder: outputs, ports, parameters, and one free-run simulation."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from host.diagnosis.model.dataset import Recording
from host.diagnosis.model.effect import Candidate, Context, Parameter, Port, Scale
from host.diagnosis.model.operators import fill

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
ActiveEffect = tuple[Candidate, Array]


@dataclass(frozen=True)
class Output:
    """One scalar output that is compared with the recording."""

    channel: str
    unit: str
    subsystem: str


@dataclass
class Segment:
    """One recording made ready for a model. `y` (outputs, n) is what was measured, NaN where missing or wild."""

    recording: Recording
    y: Array
    fit: Mask
    heldout: Mask
    inputs: dict[str, Array]
    start: dict[str, float] = field(default_factory=dict)
    extra: dict[str, Any] = field(default_factory=dict)

    @property
    def n(self) -> int:
        """Number of samples."""
        return self.recording.n


class Model(Protocol):
    """A nominal model. `simulate` runs freely from the inputs; active effects change it at their ports."""

    kind: str
    outputs: tuple[Output, ...]
    ports: tuple[Port, ...]
    parameters: tuple[Parameter, ...]
    quiet_inputs: tuple[str, ...]
    screen_samples: int  # about so many samples are enough to screen by
    scan_points: int  # simulations that screening one candidate may take
    fit_samples: int  # and so many to fit; beyond, samples are averaged
    coarsest_s: float  # period beyond which they must not be averaged
    travel: tuple[tuple[str, str, str], ...]  # signals a condition may speak of: words, key of Segment.inputs, unit
    moves: dict[str, str]  # channel of the motion at each port of `unlisted_at`
    unlisted_at: tuple[
        tuple[str, str], ...
    ]  # ports of an equation found by search: whose motion it is made of, where it is added
    taken: frozenset[str]  # effects (id, or id:form) that the nominal model has already

    def prepare(self, recording: Recording) -> Segment:
        """Inputs filled and derived, outputs stacked."""
        ...

    def guess(self, segments: list[Segment]) -> Array:
        """Start values of the nominal parameters."""
        ...

    def simulate(self, segment: Segment, theta: Array, active: list[ActiveEffect]) -> Array:
        """Outputs (outputs, n) for nominal parameters `theta` and active effects."""
        ...

    def motion(self, segment: Segment, port: Port) -> Array:
        """Nominal signal (n,) at `port`, whose sizes set start values."""
        ...

    def needs(self, segment: Segment, port: Port, theta: Array, residual: Array) -> Array:
        """The displacement or force (n,) that `port` would need to explain `residual` (outputs, n)."""
        ...


def tolerance_of(values: Array, span: float) -> float:
    """Movements below this are not movements: three steps of resolution, or 0.1 % of the span."""
    from host.diagnosis.model.operators import quantum

    return max(3.0 * quantum(values), 1e-3 * span, 1e-12)


def apply_effects(
    signal: Array, active: list[ActiveEffect], port: str, segment: Segment, side: str | None, kind: str | None = None
) -> Array:
    """`signal` after all active effects at `port` (on `side` of the nominal gain), in their order."""
    here = [effect for effect in active if effect[0].port.name == port and (side is None or effect[0].effect.side == side)]
    if not here:
        return signal
    motion = signal
    span = float(np.ptp(motion)) or 1.0
    tolerance = segment.extra.get(f"tolerance:{port}", 1e-3 * span)
    for candidate, values in sorted(here, key=lambda effect: effect[0].effect.order):
        if kind is not None and candidate.effect.port != kind:
            continue
        if candidate.effect.apply is None:
            continue
        source = segment.inputs[candidate.source] if candidate.source else None
        base = segment.inputs.get(f"motion:{port}", motion) if candidate.effect.side == "output" else signal
        context = Context(
            segment.recording.time_s,
            segment.recording.dt_s,
            base,
            tolerance,
            segment.start.get(port, 0.0),
            source,
            segment.extra,
        )
        signal = candidate.effect.apply(signal, context, values, candidate.form)
    return signal


def scale_of(model: Model, segments: list[Segment], port: Port, candidate: Candidate, need_rms: float) -> Scale:
    """Sizes at `port` over the samples to fit."""
    motions = [model.motion(segment, port)[segment.fit] for segment in segments if segment.fit.any()]
    together = np.concatenate(motions)
    low, high = float(np.min(together)), float(np.max(together))
    used = [segment for segment in segments if segment.fit.any()]
    dt = used[0].recording.dt_s
    rates = [np.gradient(model.motion(segment, port), segment.recording.dt_s) for segment in used]
    speed = float(np.sqrt(np.mean(np.concatenate(rates) ** 2))) or 1e-12
    duration = max(float(segment.recording.time_s[-1]) for segment in used)
    source = np.concatenate([segment.inputs[candidate.source] for segment in used]) if candidate.source else np.ones(1)
    units = used[0].recording.units
    unit = used[0].extra["units"][port.name]
    if candidate.effect.side == "output":
        unit = used[0].extra["units"].get(f"output:{port.name}", unit)
    span = max(high - low, 1e-12)
    return Scale(
        unit=unit,
        span=span,
        low=low,
        high=high,
        speed=speed,
        tolerance=tolerance_of(together, span),
        need=max(need_rms, 1e-12),
        dt_s=dt,
        duration_s=duration,
        timed=used[0].recording.timed,
        source_unit=units.get(candidate.source, used[0].extra["units"].get(candidate.source, "")) or "1",
        source_span=float(np.ptp(source)) or 1.0,
        source_rms=float(np.sqrt(np.mean(source**2))) or 1.0,
        motion_unit=used[0].extra["units"].get(f"motion:{port.name}", unit),
        motion_span=span,
    )


def stack(recording: Recording, names: list[str]) -> Array:
    """Channels `names` as rows."""
    return np.vstack([recording.channels[name] for name in names])


def filled(recording: Recording, names: list[str]) -> dict[str, Array]:
    """Input channels with missing samples bridged."""
    return {name: fill(recording.channels[name]) for name in names}
