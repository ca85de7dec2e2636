"""Gains of the thesis' controller by minimizing (7.4) on the simulated rig, and the stability margin of what comes out.

The rig is `sim.ideal_rig` (the tick on the plant, obedient stages): the board's firmware adds nothing to the loop but its
lead time, which is kept. An iteration of (7.4) is taken as 50 ms, its 40 iterations as 2 s from first contact on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import differential_evolution, minimize

from protocol.enums import Phase
from protocol.errors import InputError
from protocol.rig_file import Rig, parse_rig
from protocol.worker_process import end_with_parent
from realtime.control import inverse_kinematics
from realtime.control.configure import tick_parameters
from sim.heart import HeartConfig
from sim.ideal_rig import IdealRig, IdealTrace
from sim.plant import PlantConfig
from sim.vessel import VesselConfig

Array = NDArray[np.float64]
FORCES_N = (0.1, 0.2, 0.3)
ITERATIONS, ITERATION_S = 40, 0.05
GAINS = ("position_gain_per_s", "position_integral_per_s2", "force_gain_m_per_N", "force_integral_m_per_N_s")
# Range of each gain searched, as factors of the present one.
REACH = 8.0
# What a response that never touches, or is stopped, costs (N), beyond any that works.
FAILED_N = 1.0
# Ringing: RMS force about its mean over the last second (N) that no well damped loop leaves on a still wall.
RINGING_N = 0.025
WALL_POINT_M = (0.0, -0.0107, 0.025)
# Delay added at most: beyond it the failsafe holds for stale poses.
MOST_DELAY_S = 0.045
_APPROACH_S, _CLEARANCE_M = 1.2, 0.0015
# Least gain factor and phase margin of a proposal; below, the force gains are halved once.
LEAST_FACTOR, LEAST_PHASE_DEG = 2.0, 30.0


class Margin(NamedTuple):
    """`gain_factor`: all loop gains times this ring; `delay_s` more delay does; `phase_deg` follows from the frequency at
    which that rings, `crossover_Hz`. Where nothing rang, the search's limits (16, MOST_DELAY_S), and no phase (NaN)."""

    gain_factor: float
    delay_s: float
    crossover_Hz: float
    phase_deg: float


@dataclass(frozen=True)
class Tuned:
    """One method's best gains, their cost (7.4) in N, and how many simulated responses it took."""

    method: str
    gains: dict[str, float]
    cost_N: float
    evaluations: int


def still_wall(rig: Rig, clearance_m: float = _CLEARANCE_M) -> PlantConfig:
    """Return the demo's plant: heart at rest, tip `clearance_m` before the wall, backlash crossed forward."""
    out = np.zeros(3)
    kinematics = tick_parameters(rig)[0].kinematics
    out[:] = inverse_kinematics.apply(kinematics, np.array([*WALL_POINT_M[:2], WALL_POINT_M[2] - clearance_m]), 0.0)
    transmission = rig.transmission
    handle = (out[0] - transmission.insertion_at_home_m) / transmission.insertion_slope
    handle += 0.5 * transmission.insertion_backlash_m
    return PlantConfig(
        start_stage=(float(handle), float(out[1] / transmission.roll_slope), float(out[2])),
        vessel=VesselConfig(start_in_play=1.0),
        heart=HeartConfig(beat_m=0.0, respiration_m=0.0),
    )


def with_gains(rig: Rig, gains: dict[str, float]) -> Rig:
    """Return `rig` under the thesis' law with these gains. Raises InputError for an unknown gain or out of bounds."""
    data = rig.effective()
    data["control"] = {**data["control"], "law": "thesis", "form": "incremental", "force_added_to": "tip", **gains}
    return parse_rig(data, "gains")


def response(
    rig: Rig, force_N: float, seconds: float, seed: int = 0, extra_delay_s: float = 0.0, config: PlantConfig | None = None
) -> IdealTrace:
    """Contact and after: the tip presses `force_N` on a still wall, the trace from first contact on, `seconds` at most."""
    config = config or still_wall(rig)
    bench = IdealRig(rig, config, seed, extra_delay_s=extra_delay_s)
    trace = bench.press(force_N, np.array(WALL_POINT_M), seconds + _APPROACH_S).since_contact()
    keep = trace.time_s < seconds
    return trace.rows(keep)


def cost_of(trace: IdealTrace, force_N: float, seconds: float) -> float:
    """Return the mean absolute force error (N) of one response; time without contact counts as FAILED_N."""
    held = trace.phase == Phase.CONTACT
    wanted = max(1, round(seconds / max(_period_s(trace), 1e-9)))
    error = np.abs(trace.force_N - force_N)[held]
    missing = max(0.0, 1.0 - error.size / wanted)
    return float(error.sum() / wanted + FAILED_N * missing)


def _period_s(trace: IdealTrace) -> float:
    return float(np.median(np.diff(trace.time_s))) if trace.time_s.size > 1 else 0.001


def criterion(
    rig: Rig, gains: dict[str, float], forces_N: Sequence[float] = FORCES_N, iterations: int = ITERATIONS
) -> float:
    """J of (7.4): sum over iterations and mean over forces of the absolute error, over the number of iterations (N)."""
    seconds = iterations * ITERATION_S
    tuned = with_gains(rig, gains)
    return float(
        np.mean(
            [cost_of(response(tuned, force, seconds, seed=index), force, seconds) for index, force in enumerate(forces_N)]
        )
    )


def _rings(trace: IdealTrace, force_N: float) -> bool:
    if trace.time_s.size < 1000 or np.any(trace.phase != Phase.CONTACT):
        return True
    late = trace.force_N[trace.time_s > trace.time_s[-1] - 1.0]
    trend = np.polyval(np.polyfit(np.arange(late.size), late, 1), np.arange(late.size))
    return bool(np.std(late - trend) > RINGING_N or np.max(trace.force_N) > 2.2 * force_N + 0.1)


def _frequency_Hz(trace: IdealTrace) -> float:
    """Return the strongest frequency (Hz) of the force in its last 1.5 s."""
    late = trace.force_N[trace.time_s > trace.time_s[-1] - 1.5]
    late = (late - late.mean()) * np.hanning(late.size)
    spectrum = np.abs(np.fft.rfft(late, 8 * late.size))
    return float(np.fft.rfftfreq(8 * late.size, _period_s(trace))[1 + int(np.argmax(spectrum[1:]))])


def _limit(rings: Callable[[float], bool], low: float, high: float, steps: int) -> float:
    """Return where oscillation begins between `low` (none) and `high`, by bisection in ratio; `high` if it never does."""
    if not rings(high):
        return high
    for _ in range(steps):
        middle = math.sqrt(low * high)
        low, high = (low, middle) if rings(middle) else (middle, high)
    return low


def stability_margin(rig: Rig, gains: dict[str, float], force_N: float = 0.2, steps: int = 5) -> Margin:
    """Measure how much more gain and how much more delay the loop with `gains` takes before it oscillates.

    Raises InputError where it rings as it is.
    """
    seconds = 2.5
    config = still_wall(rig)

    def trial(factor: float, delay_s: float) -> IdealTrace:
        scaled = {key: value * (factor if key in GAINS[:1] + GAINS[2:] else 1.0) for key, value in gains.items()}
        return response(_unchecked(rig, scaled), force_N, seconds, extra_delay_s=delay_s, config=config)

    if _rings(trial(1.0, 0.0), force_N):
        raise InputError.from_sentence(
            f"gains: found a loop that rings at {rig.control.loop_hz} Hz with "
            + ", ".join(f"{key} = {value:.4g}" for key, value in gains.items())
            + ", wanted gains that settle on a wall at rest"
        )
    factor = _limit(lambda x: _rings(trial(x, 0.0), force_N), 1.0, 16.0, steps)
    delay = _limit(lambda x: _rings(trial(1.0, x), force_N), 0.001, MOST_DELAY_S, steps)
    if delay >= MOST_DELAY_S:
        return Margin(factor, delay, math.nan, math.nan)
    crossover = _frequency_Hz(trial(1.0, min(1.5 * delay, MOST_DELAY_S)))
    return Margin(factor, delay, crossover, 360.0 * crossover * delay)


def _unchecked(rig: Rig, gains: dict[str, float]) -> Rig:
    """Return `rig` with gains that may be out of bounds, only for the simulated search of a margin."""
    return rig.model_copy(
        update={
            "control": rig.control.model_copy(
                update={"law": "thesis", "form": "incremental", "force_added_to": "tip", **gains}
            )
        }
    )


class _Cost:
    """(7.4) over the logarithms of the gains' factors; what the rig file refuses costs FAILED_N."""

    def __init__(self, rig: Rig, start: dict[str, float], iterations: int) -> None:
        self.rig, self.start, self.iterations = rig, start, iterations

    def gains(self, x: Array) -> dict[str, float]:
        return {key: float(value * math.exp(part)) for (key, value), part in zip(self.start.items(), x, strict=True)}

    def __call__(self, x: Array) -> float:
        try:
            return criterion(self.rig, self.gains(x), iterations=self.iterations)
        except ValueError:
            return FAILED_N


def _simplex(cost: _Cost, start: Array, evaluations: int) -> tuple[Array, float, int]:
    found = minimize(
        cost,
        start,
        method="Nelder-Mead",
        options={
            "maxfev": evaluations,
            "xatol": 0.02,
            "fatol": 1e-5,
            "initial_simplex": np.vstack([start, start + 0.5 * np.eye(start.size)]),
        },
    )
    return found.x, float(found.fun), int(found.nfev)


def tune(
    rig: Rig,
    names: Sequence[str] = GAINS,
    evaluations: int = 100,
    processes: int = 2,
    seed: int = 1,
    iterations: int = ITERATIONS,
    progress: Callable[[str], None] = lambda text: None,
) -> list[Tuned]:
    """Best gains by simplex (from the present gains and from half of them, side by side) and by differential evolution.

    Arguments: names, keys of [control]; evaluations, of (7.4) for each method; iterations, of (7.4). Raises InputError for
    a gain that is not known or zero.
    """
    control = rig.control.model_dump()
    for name in names:
        if not isinstance(control.get(name), float) or control[name] <= 0.0:
            raise InputError.from_sentence(
                f"gains: found {name} = {control.get(name)}, wanted a positive gain of [control]: {', '.join(GAINS)}"
            )
    start = {name: float(control[name]) for name in names}
    cost = _Cost(rig, start, iterations)
    with ProcessPoolExecutor(processes, initializer=end_with_parent) as pool:
        simplex = _both_simplexes(cost, len(start), evaluations, pool)
        progress(f"simplex: J = {simplex.cost_N * 1e3:.2f} mN after {simplex.evaluations} evaluations")
        spread = _evolution(cost, len(start), evaluations, seed, pool)
        progress(f"differential evolution: J = {spread.cost_N * 1e3:.2f} mN after {spread.evaluations} evaluations")
    return [simplex, spread]


def _both_simplexes(cost: _Cost, size: int, evaluations: int, pool: Executor) -> Tuned:
    starts = [np.zeros(size), np.full(size, -0.7)]
    jobs = [pool.submit(_simplex, cost, start, evaluations // len(starts)) for start in starts]
    results = [job.result() for job in jobs]
    best = min(results, key=lambda result: result[1])
    return Tuned("simplex", cost.gains(best[0]), best[1], sum(result[2] for result in results))


def _evolution(cost: _Cost, size: int, evaluations: int, seed: int, pool: Executor) -> Tuned:
    population = max(3, min(10, evaluations // (4 * size)))
    rounds = max(1, evaluations // (population * size) - 1)
    found = differential_evolution(
        cost,
        [(-math.log(REACH), math.log(REACH))] * size,
        popsize=population,
        maxiter=rounds,
        seed=seed,
        polish=False,
        updating="deferred",
        workers=lambda function, items: list(pool.map(function, items)),
        x0=np.zeros(size),
        tol=1e-3,
    )
    return Tuned("differential evolution", cost.gains(found.x), float(found.fun), int(found.nfev))


def best_of(results: Sequence[Tuned]) -> Tuned:
    """Return the result with the smallest cost."""
    return min(results, key=lambda result: result.cost_N)


def half_way(rig: Rig, tuned: Tuned) -> Tuned:
    """Return `tuned` with its force gains halved, the proposal if the margin of the optimum is too small."""
    gains = {key: value * (0.5 if key in GAINS[2:] else 1.0) for key, value in tuned.gains.items()}
    return replace(tuned, gains=gains, cost_N=criterion(rig, gains), evaluations=tuned.evaluations + 1)


def present_gains(rig: Rig) -> dict[str, float]:
    """Return the gains of GAINS that the rig file has."""
    return {name: float(getattr(rig.control, name)) for name in GAINS}


def margin_report(rig: Rig) -> dict[str, Any]:
    """Return cost and stability margin of the rig's present gains. Raises InputError where the loop rings."""
    present = present_gains(rig)
    return {"present": _row(Tuned("present", present, criterion(rig, present), 1), stability_margin(rig, present))}


def proposal_report(rig: Rig, found: Sequence[Tuned]) -> dict[str, Any]:
    """Return the proposal (best of `found`, force gains halved once if its margin is small) and the present gains."""
    present, best = present_gains(rig), best_of(found)
    try:
        margin: Margin | None = stability_margin(rig, {**present, **best.gains})
    except InputError:
        margin = None
    halved = margin is None or margin.gain_factor < LEAST_FACTOR or margin.phase_deg < LEAST_PHASE_DEG
    if halved:
        best = half_way(rig, best)
        margin = stability_margin(rig, {**present, **best.gains})
    return {
        "present": _row(Tuned("present", present, criterion(rig, present), 1), None),
        "methods": [_row(item, None) for item in found],
        "proposal": {**_row(best, margin), "force_gains_halved_for_margin": halved},
        "loop_hz": rig.control.loop_hz,
        "simulated_on": "tick and plant with ideal stages, tracker and force sensor with noise and delays",
    }


def _row(tuned: Tuned, margin: Margin | None) -> dict[str, Any]:
    row: dict[str, Any] = {
        "method": tuned.method,
        "gains": tuned.gains,
        "cost_N": tuned.cost_N,
        "evaluations": tuned.evaluations,
    }
    if margin is not None:
        row["margin"] = margin._asdict()
    return row
