"""Missed steps: jumps between command and encoder that stay, one or several."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from host.diagnosis.model.effect import Array, Context, Effect, Evidence, Parameter, Scale

EDGE = 0.01  # of the recording: a jump closer to its ends has no plateau that bears it out
COARSE = 400  # blocks in which the instants are looked for first
COUNT = {"": 1, "two": 2, "three": 3, "four": 4}


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Size and instant of each jump."""
    found: list[Parameter] = []
    for k in range(COUNT[form]):
        number = f"_{k + 1}" if form else ""
        instants = tuple(np.linspace(0.02, 0.98, 49) * s.duration_s)
        edge = EDGE * s.duration_s
        found.append(Parameter(f"jump{number}", s.unit, (s.need,), linear=True))
        found.append(
            Parameter(f"instant{number}", "s", instants, edge, s.duration_s - edge, step=0.005 * s.duration_s, event=True)
        )
    return tuple(found)


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Steps at the instants, each one sample wide."""
    out = signal
    for jump, instant in zip(p[::2], p[1::2], strict=True):
        out = out + jump * c.after(instant)
    return np.asarray(out)


def seeds(evidence: Evidence, parameters: tuple[Parameter, ...], form: str) -> tuple[Parameter, ...]:
    """Instants at which a piecewise constant curve fits the residual best.

    Recordings without a common clock are laid upon each other from their begin: an axis that is homed before each of
    them forgets what it lost, and the same motion loses it again at the same instants.
    """
    count = sum(p.event for p in parameters)
    if count == 1 and not evidence.one_clock:
        return parameters
    time_s, need = np.concatenate(evidence.time_s), np.concatenate(evidence.need)
    good = np.isfinite(need)
    order = np.argsort(time_s[good], kind="stable")
    time_s, need = time_s[good][order], need[good][order]
    if time_s.size < 20 * (count + 1):
        return () if count > 1 else parameters
    found = []
    for k, p in enumerate(parameters):
        if p.linear:
            found.append(p)
            continue
        found.append(begun_at(p, time_s, change_points(need, count)[k // 2]))
    return tuple(found)


def begun_at(instant: Parameter, time_s: Array, sample: int) -> Parameter:
    """The parameter `instant` that is first tried between `sample` and the one before it."""
    middle = 0.5 * (time_s[sample - 1] + time_s[sample])
    return replace(instant, grid=(float(min(max(middle, instant.low), instant.high)),))


def change_points(values: Array, count: int) -> list[int]:
    """First samples of the second and later parts of the piecewise constant fit of `values` (n,) with `count` jumps.

    Exact on block means (dynamic programming, Bellman 1961), then each moved to the best sample between its neighbours.
    """
    edges = np.linspace(0, values.size, min(COARSE, values.size) + 1).astype(int)
    weights = np.diff(edges).astype(np.float64)
    means = np.add.reduceat(values, edges[:-1]) / weights
    places = [int(edges[k]) for k in _segmented(means, weights, count)]
    for _ in range(2):
        for k in range(count):
            low = places[k - 1] if k > 0 else 0
            high = places[k + 1] if k + 1 < count else values.size
            places[k] = low + two_levels(values[None, low:high])
    return places


@njit(cache=True)
def _segmented(means: Array, weights: Array, count: int) -> list[int]:
    """Blocks at which the parts begin that leave the least squared error."""
    n = means.size
    w, s, q = np.zeros(n + 1), np.zeros(n + 1), np.zeros(n + 1)
    for i in range(n):
        w[i + 1] = w[i] + weights[i]
        s[i + 1] = s[i] + weights[i] * means[i]
        q[i + 1] = q[i] + weights[i] * means[i] ** 2
    cost = np.full((count + 1, n + 1), np.inf)
    origin = np.zeros((count + 1, n + 1), np.int64)
    for j in range(1, n + 1):
        cost[0, j] = q[j] - s[j] ** 2 / w[j]
    for k in range(1, count + 1):
        for j in range(k + 1, n + 1):
            for i in range(k, j):
                here = cost[k - 1, i] + q[j] - q[i] - (s[j] - s[i]) ** 2 / (w[j] - w[i])
                if here < cost[k, j]:
                    cost[k, j], origin[k, j] = here, i
    places, j = [0], n
    for k in range(count, 0, -1):
        j = origin[k, j]
        places.append(j)
    return places[:0:-1]


def two_levels(values: Array) -> int:
    """Sample at which two constants for each row of `values` (rows, n) fit best."""
    n = values.shape[1]
    if n < 3:
        return max(n // 2, 1)
    first, total = np.arange(1, n), np.cumsum(values, axis=1)
    gain = total[:, :-1] ** 2 / first + (total[:, -1:] - total[:, :-1]) ** 2 / (n - first)
    return int(np.argmax(np.sum(gain, axis=0))) + 1


@dataclass(frozen=True)
class Loss:
    """Steps lost at one instant of one recording. size: what was lost, in the unit of the port."""

    recording: str
    instant: float
    clock: str  # unit of the instant: s, or samples
    size: float
    unit: str
    fitted: bool  # whether samples to fit show its size

    @property
    def key(self) -> str:
        """Name of the step's course among those that a recording holds for effects."""
        return f"lost {self.recording} {self.instant!r}"


def own_losses(losses: tuple[Loss, ...]) -> Effect:
    """Return the effect of steps that each recording loses at instants of its own, `losses`.

    The courses of the steps, each from 0 to 1, are laid out in the recordings (`Context.equations`). Sizes of those that are
    held out are not among the parameters: their courses have the size that these samples show.
    """
    fitted = [loss for loss in losses if loss.fitted]
    heldout = [loss for loss in losses if not loss.fitted]

    def own(s: Scale, form: str) -> tuple[Parameter, ...]:
        return tuple(Parameter(f"jump_{k}", s.unit, (loss.size,), linear=True) for k, loss in enumerate(fitted, 1))

    def moved(signal: Array, c: Context, p: Array, form: str) -> Array:
        for size, loss in zip([*p, *np.ones(len(heldout))], [*fitted, *heldout], strict=True):
            if loss.key in c.equations:  # of this recording
                signal = signal + size * c.laid_out(loss.key)
        return np.asarray(signal)

    places = [f"{{jump_{k}}} at {_instant(loss)}" for k, loss in enumerate(fitted, 1)]
    places += [f"about {loss.size:.3g} {loss.unit} at {_instant(loss)}" for loss in heldout]
    says = f"The axis lost {', '.join(places)}, and did not recover them. A sensor that was moved looks the same."
    equation = "y = x + sum_k jump_k*(t > instant_k), in each recording its own"
    effect = Effect("missed_steps", "motion", 10, own, says, equation, moved, timed=True, forms=("own",))
    return replace(effect, searched=True, dated=True, several=True)


def _instant(loss: Loss) -> str:
    name = loss.recording.replace("{", "{{").replace("}", "}}")
    return f"{loss.instant:.4g} {loss.clock} of {name}"


EFFECTS = tuple(
    Effect(
        "missed_steps",
        "motion",
        10,
        parameters,
        says,
        equation,
        apply,
        timed=True,
        forms=forms,
        seeds=seeds,
    )
    for forms, says, equation in (
        (("",), "The axis lost {jump} at {instant} and did not recover it.", "y = x + jump*(t > instant)"),
        (
            ("two",),
            "The axis lost {jump_1} at {instant_1} and {jump_2} at {instant_2}, and did not recover them.",
            "y = x + sum_k jump_k*(t > instant_k)",
        ),
        (
            ("three",),
            "The axis lost {jump_1} at {instant_1}, {jump_2} at {instant_2} and {jump_3} at {instant_3}, "
            "and did not recover them.",
            "y = x + sum_k jump_k*(t > instant_k)",
        ),
        (
            ("four",),
            "The axis lost {jump_1} at {instant_1}, {jump_2} at {instant_2}, {jump_3} at {instant_3} and {jump_4} at "
            "{instant_4}, and did not recover them.",
            "y = x + sum_k jump_k*(t > instant_k)",
        ),
    )
)
