"""What an exported module runs: effects at their ports, and the law of each kind. Gathered by source, so self-contained."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from host.diagnosis.model.effect import Context, rate_key
from host.diagnosis.model.force_kernel import run_axis
from host.diagnosis.model.model import tolerance_of
from host.diagnosis.model.operators import lag
from host.diagnosis.models.axis import stages
from host.diagnosis.models.linear import response, sampled

Array = npt.NDArray[np.float64]


class ExportedEffect(NamedTuple):
    """An effect with its fitted values, and the port where it acts."""

    port: str
    apply: Callable[..., Any]
    values: tuple[float, ...]
    form: str
    source: str
    side: str
    memories: tuple[str, ...] = ()


class ExportedRun(NamedTuple):
    """What one simulation has.

    inputs: channels (n,). start: port, or port/memory -> value of a memory at the first sample.
    """

    inputs: dict[str, Array]
    time_s: Array
    start: dict[str, float]
    effects: tuple[ExportedEffect, ...]


class ExportedLink(NamedTuple):
    """output = gain input + offset, then lags of these time constants (s)."""

    port: str
    input: str
    output: str
    gain: float
    offset: float
    lags_s: tuple[float, ...]


def period_of(time_s: Array) -> float:
    """Return the median period (s)."""
    return float(np.median(np.diff(time_s)))


def affected(
    run: ExportedRun, signal: Array, port: str, side: str = "", moving: str = "", before_gain: Array | None = None
) -> Array:
    """`signal` (n,) after the effects at `port` (on one `side` of a gain). moving: channel whose resolution counts there.
    before_gain: (n,) load that effects behind the gain read; theirs is `signal` without it.
    """
    here = [effect for effect in run.effects if effect.port == port and side in ("", effect.side)]
    motion = signal if before_gain is None else before_gain
    for effect in here:
        span = float(np.ptp(motion)) or 1.0
        values = run.inputs.get(moving)
        tolerance = 1e-3 * span if values is None else tolerance_of(values, float(np.ptp(values)))
        base = motion if effect.side == "output" else signal
        source = run.inputs[effect.source] if effect.source else None
        begun = run.start.get(port, 0.0)
        context = Context(run.time_s, period_of(run.time_s), base, tolerance, begun, source)
        context.start_rate = run.start.get(rate_key(port), 0.0)
        context.starts = tuple(run.start.get(f"{port}/{name}", 0.0) for name in effect.memories)
        signal = effect.apply(signal, context, np.array(effect.values), effect.form)
    return signal


def run_links(links: tuple[ExportedLink, ...], run: ExportedRun) -> dict[str, Array]:
    """Return the outputs (n,) of a transmission, by channel."""
    found = {}
    for link in links:
        signal = affected(run, run.inputs[link.input], link.port, "input", link.input)
        load = affected(run, signal, f"{link.port}_friction", "", link.input)
        signal = affected(run, link.gain * load + link.offset, f"{link.port}_spring", before_gain=load)
        for constant_s in link.lags_s:
            signal = lag(signal, period_of(run.time_s), constant_s)
        signal = affected(run, signal, link.port, "output", link.input)
        found[link.output] = affected(run, signal, f"{link.port}_reading")
    return found


def run_axis_law(
    names: dict[str, str], hold: str, substeps: int, linear: Array, slots: Array, begin: Array, run: ExportedRun
) -> dict[str, Array]:
    """Output of an axis in free run. names: input, output, subsystem and reads. linear: mass, damping, stiffness, offset."""
    force = affected(run, run.inputs[names["input"]], f"{names['subsystem']}_drive")
    nothing = np.zeros(run.time_s.size)
    start, first_s = run.start.get(names["subsystem"], 0.0), float(run.time_s[0])
    given = stages(force, substeps, hold)
    dt_s = period_of(run.time_s)
    rows = run_axis(given, substeps, dt_s, linear, slots, begin, nothing, np.zeros(0), nothing[None, :], start, first_s)
    motion = rows[("position", "velocity", "acceleration").index(names["reads"])]
    return {names["output"]: affected(run, motion, f"{names['subsystem']}_reading")}


def run_simulator(
    simulator: Callable[[dict[str, Array]], Any], names: tuple[tuple[str, ...], ...], run: ExportedRun
) -> dict[str, Array]:
    """Outputs of a simulator with effects at its inputs and outputs. names: inputs, outputs."""
    given = {name: affected(run, run.inputs[name], name, "", name) for name in names[0]}
    found = simulator(given)
    return {name: affected(run, np.asarray(found[name], dtype=np.float64), f"{name}_reading") for name in names[1]}


def run_state_space(matrices: tuple[Array, Array, Array, Array], hold: str, begin: Array, u: Array, time_s: Array) -> Array:
    """Outputs (outputs, n) of a linear model. hold: zero or linear, empty for a discrete model. u: (inputs, n)."""
    A, B, C, D = matrices
    Ad, B0, B1 = sampled(A, B, period_of(time_s), hold) if hold else (A, B, np.zeros_like(B))
    return response(Ad, B0, B1, C, D, u, begin)
