"""Interface of every nominal model: outputs, ports, parameters, and one free-run simulation."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from host.diagnosis.model.dataset import Recording
from host.diagnosis.model.effect import Candidate, Context, Parameter, Port, Scale, is_force, memory_keys, rate_key
from host.diagnosis.model.operators import fill, quantum
from host.diagnosis.model.readings import Finding

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Places = npt.NDArray[np.int64]
ActiveEffect = tuple[Candidate, Array]


@dataclass(frozen=True)
class Output:
    """One scalar output that is compared with the recording."""

    channel: str
    unit: str
    subsystem: str


HOLD_WORDS = {"zero": "is held", "linear": "runs straight", "band_limited": "runs smoothly (band-limited)"}


@dataclass
class Begin:
    """The state from which one recording is simulated, and what is known of it beforehand, each (k,).

    Copies of a segment share it: a state that is found again holds for all of them.
    """

    names: tuple[str, ...]
    measured: Array  # mean before the fit
    spread: Array  # standard deviation before the fit; 0 where the state is known
    values: Array
    estimated: bool = True  # whether `Model.start_again` looks for it


@dataclass
class Segment:
    """One recording made ready for a model. `y` (outputs, n) is what was measured, NaN where missing or wild."""

    recording: Recording
    y: Array
    fit: Mask
    heldout: Mask
    inputs: dict[str, Array]
    units: dict[str, str] = field(default_factory=dict)  # of ports, inputs, `output:port` and `motion:port`
    tolerances: dict[str, float] = field(default_factory=dict)  # port -> movement below which nothing has moved
    start: dict[str, float] = field(default_factory=dict)  # port -> displacement needed at the first sample
    begin: Begin | None = None
    resolution: Array | None = None  # (outputs,) standard deviation that the steps of each reading make
    weight: Array | None = None  # (outputs,) scale of each output's residual
    equations: dict[str, Array] = field(default_factory=dict)  # values (n,) of forms found by search
    spread: int = 0  # samples by which a test function spreads noise to either side
    read_motion: Array | None = None  # (n,) as it was recorded, where a law is compared behind a test function
    fed_back: list[Array | None] = field(default_factory=list)  # of each output, later input that holds its noise
    repeats: dict[int, Places] = field(default_factory=dict)  # output -> (n,) sample whose reading each sample repeats

    @property
    def n(self) -> int:
        """Return the number of samples."""
        return self.recording.n

    def weights(self) -> Array:
        """Scale of each output's residual, (outputs, 1); ones before the first fit."""
        return (np.ones(self.y.shape[0]) if self.weight is None else self.weight)[:, None]


def forces_among(channels: tuple[str, ...], units: dict[str, str]) -> tuple[str, ...]:
    """Those `channels` that are measured in units of force: where a nominal model names no load, they may be one."""
    return tuple(name for name in channels if is_force(units.get(name, "")))


class Model(ABC):
    """A nominal model. `simulate` runs freely from the inputs; active effects change it at their ports.

    What follows the abstract methods is optional: a model overrides what it has, and nothing asks whether it is there.
    """

    kind: str
    outputs: tuple[Output, ...]
    ports: tuple[Port, ...]
    parameters: tuple[Parameter, ...]
    quiet_inputs: tuple[str, ...]
    screen_samples: int = 20000  # about so many samples are enough to screen by
    scan_points: int = 120  # simulations that screening one candidate may take
    fit_samples: int = 1000000000  # and so many to fit; beyond, samples are averaged
    coarsest_s: float = 0.0  # period beyond which they must not be averaged
    travel: tuple[tuple[str, str, str], ...] = ()  # signals a condition may speak of: words, key of Segment.inputs, unit
    moves: dict[str, str]  # channel of the motion at each port of `unlisted_at`
    # Ports of an equation found by search: whose motion it is made of, where it is added.
    unlisted_at: tuple[tuple[str, str], ...] = ()
    taken: frozenset[str] = frozenset()  # effects (id, or id:form) that the nominal model has already
    holds: tuple[str, ...] = ()  # ways in which the input may run between its samples, where the model has a choice,
    hold: str = ""  # the one that it takes,
    hold_stated: bool = False  # and whether its file states it
    hold_words: tuple[str, Mapping[str, str]] = ("", HOLD_WORDS)  # of what it says (empty: of its inputs), and what
    either_sign: bool = False  # whether a force that is read may count against the motion as well as with it
    simulates: bool = False  # whether it runs a simulator, whose law cannot be read: data are checked against its outputs
    driven: bool = False  # whether its inputs move a state of its own, which outputs show
    pointwise: bool = False  # whether outputs answer the signal at a port sample by sample: then `sensitivity` is defined

    @abstractmethod
    def prepare(self, recording: Recording) -> Segment:
        """Inputs filled and derived, outputs stacked."""

    @abstractmethod
    def simulate(self, segment: Segment, theta: Array, active: list[ActiveEffect]) -> Array:
        """Outputs (outputs, n) for nominal parameters `theta` and active effects."""

    @abstractmethod
    def motion(self, segment: Segment, port: Port) -> Array:
        """Nominal signal (n,) at `port`, whose sizes set start values."""

    @abstractmethod
    def needs(self, segment: Segment, port: Port, theta: Array, residual: Array) -> Array:
        """The displacement or force (n,) that `port` would need to explain `residual` (outputs, n)."""

    def begins_with(self, segment: Segment, theta: Array, active: list[ActiveEffect]) -> npt.NDArray[np.intp]:
        """Indices (k,) of the unknown states that `segment` begins with and that show in its outputs."""
        return np.zeros(0, dtype=np.intp) if segment.begin is None else np.flatnonzero(segment.begin.spread > 0.0)

    def passive(self, theta: Array, active: list[ActiveEffect]) -> bool:
        """Whether no part of the law, the active effects included, is a mass, damper or spring below zero."""
        return True

    def guess(self, segments: list[Segment]) -> Array:
        """Start values of the nominal parameters: those of the TOML."""
        return np.array([p.grid[0] for p in self.parameters])

    def simulate_all(self, segments: list[Segment], theta: Array, active: list[ActiveEffect]) -> list[Array]:
        """Outputs of several recordings; a model that can runs them in parallel."""
        return [self.simulate(segment, theta, active) for segment in segments]

    def try_out(self, segments: list[Segment]) -> None:  # noqa: B027 - most models are the project's own
        """Run the simulator of a user before anything is fitted. Raises InputError."""

    def announce(self, segments: list[Segment], theta: Array) -> str:
        """Return the expected cost of a diagnosis if simulations take long; empty if they do not."""
        return ""

    def findings(self) -> list[Finding]:
        """Return what the model has to say after all simulations."""
        return []

    def settle(self, segment: Segment, theta: Array) -> None:  # noqa: B027 - most models have nothing to settle
        """Prepare the recording for these nominal parameters: a measured output that is an input too, freed of noise."""

    def hold_as(self, segments: list[Segment], hold: str) -> None:
        """Let the input run between its samples as `hold` (of `holds`) says."""
        raise NotImplementedError(f"{self.kind}: no choice of hold")

    def linear_path(self, segment: Segment, theta: Array) -> tuple[str, ...]:
        """Names of ports that linear time-invariant parts of the model alone join; empty where none are."""
        return ()

    def restarts(self, segments: list[Segment]) -> list[Array]:
        """Further start values of the nominal parameters: for effects that hide them, and where the guess fails."""
        return []

    def along_motion(self) -> Model | None:
        """The same law compared along the measured motion, where no simulation leads a fit astray; None if there is none."""
        return None

    def noise_of(self, segment: Segment) -> Any:
        """Noise (`estimation.noise.Noise`) of a difference that the model itself makes; None: estimated from the output."""
        return None

    def noise_of_inputs(self, segment: Segment, theta: Array) -> Array:
        """Standard deviation (outputs,) of what the noise of measured inputs makes of the outputs, where it is known."""
        return np.zeros(len(self.outputs))

    def sensitivity(self, segment: Segment, theta: Array, axis: str, active: list[ActiveEffect]) -> Array:
        """Change of outputs (outputs, n) per change of the signal at port `axis`, of a model that is `pointwise`."""
        raise NotImplementedError(f"{self.kind}: outputs do not answer sample by sample")

    def slopes(self, segment: Segment, theta: Array, active: list[ActiveEffect]) -> dict[str, Any]:
        """Return the data for `change`, by port, for ports whose candidates can be screened without a simulation.

        Of a model that is `pointwise` it is the `sensitivity`, and a candidate's change is that times what it has `moved`.
        """
        return {}

    def change(self, segment: Segment, theta: Array, slopes: dict[str, Any], candidate: Candidate, values: Array) -> Array:
        """Linearized change of outputs (outputs, n) by a candidate at one of the ports of `slopes`."""
        raise KeyError(candidate.port.name)

    def moved(self, segment: Segment, theta: Array, candidate: Candidate, values: Array) -> Array:
        """Change (n,) of the signal at the port of a candidate, one of `slopes` of a model that is `pointwise`."""
        raise KeyError(candidate.port.name)

    def answer(self, slope: Any, moved: Array) -> Array:
        """Change of outputs (outputs, n) when the signal at a port of `slopes` changes by `moved` (n,)."""
        raise NotImplementedError(f"{self.kind}: no linearized port")

    @property
    def inner(self) -> Model:
        """The model without effects that are known to it."""
        return self

    @property
    def scripted(self) -> tuple[str, ...]:
        """Channels that the script of an experiment sets."""
        return self.quiet_inputs

    @property
    def on_rig(self) -> bool:
        """Whether experiments run on a rig, within its limits (`excitations`)."""
        return False

    def excitations(self, problem: Any, best: Any) -> list[Any]:
        """Motions of an experiment that a rig can make."""
        raise NotImplementedError(f"{self.kind}: no rig to move")


def tolerance_of(values: Array, span: float) -> float:
    """Movements below this are not movements: three steps of resolution, or 0.1 % of the span."""
    return max(3.0 * quantum(values), 1e-3 * span, 1e-12)


def apply_effects(
    signal: Array,
    active: list[ActiveEffect],
    port: str,
    segment: Segment,
    side: str | None,
    kind: str | None = None,
    finer: int = 1,
    before_gain: Array | None = None,
) -> Array:
    """`signal` (n * finer,) after all active effects at `port` (on `side` of the nominal gain), in their order.

    before_gain: (n,) motion or load that effects behind the nominal gain read; theirs is `signal` without it.
    finer: points of `signal` in one sample; it is then held within each of them, as are the other channels in each sample.
    """
    here = [effect for effect in active if effect[0].port.name == port and (side is None or effect[0].effect.side == side)]
    if not here:
        return signal
    motion = signal if before_gain is None else before_gain
    tolerance = segment.tolerances.get(port)
    if tolerance is None:
        tolerance = 1e-3 * (float(np.ptp(motion)) or 1.0)
    for candidate, values in sorted(here, key=lambda effect: effect[0].effect.order):
        if kind is not None and candidate.effect.port != kind:
            continue
        if candidate.effect.apply is None:
            continue
        source = segment.inputs[candidate.source] if candidate.source else None
        if source is not None and finer > 1:
            source = np.repeat(source, finer)
        base = segment.inputs.get(f"motion:{port}", motion) if candidate.effect.side == "output" else signal
        context = Context(
            _finer(segment.recording.time_s, segment.recording.dt_s, finer),
            segment.recording.dt_s / finer,
            base,
            tolerance,
            segment.start.get(port, 0.0),
            source,
            segment.equations,
            segment.start.get(rate_key(port), 0.0),
            tuple(segment.start.get(key, 0.0) for key in memory_keys(candidate)),
            finer,
        )
        signal = candidate.effect.apply(signal, context, values, candidate.form)
    return signal


def affine_reading(segment: Segment, active: list[ActiveEffect], port: str) -> tuple[float, float] | None:
    """Offset and gain of the affine effects on the reading at `port`, by which a state that is read begins elsewhere.

    None where there is no such effect, or none that can be undone (gain 0).
    """
    affine = [effect for effect in active if effect[0].effect.affine and effect[0].port.name == port]
    if not affine:
        return None
    at_zero, at_one = map(float, apply_effects(np.array([0.0, 1.0]), affine, port, segment, None))
    return (at_zero, at_one - at_zero) if at_one != at_zero else None


def _finer(time_s: Array, dt_s: float, finer: int) -> Array:
    if finer == 1:
        return time_s
    return np.asarray((time_s[:, None] + np.arange(finer) * (dt_s / finer)).ravel())


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
    unit = used[0].units[port.name]
    if candidate.effect.side == "output":
        unit = used[0].units.get(f"output:{port.name}", unit)
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
        source_unit=units.get(candidate.source, used[0].units.get(candidate.source, "")) or "1",
        source_rms=float(np.sqrt(np.mean(source**2))) or 1.0,
        source_span=float(np.ptp(source)) or 1.0,
        motion_unit=used[0].units.get(f"motion:{port.name}", unit),
        motion_span=span,
    )


def stack(recording: Recording, names: list[str]) -> Array:
    """Return the channels `names` as rows, (len(names), n)."""
    return np.vstack([recording.channels[name] for name in names])


def filled(recording: Recording, names: list[str]) -> dict[str, Array]:
    """Input channels with missing samples bridged."""
    return {name: fill(recording.channels[name]) for name in names}
