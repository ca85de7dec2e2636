"""Common parts of the worlds: plans from a seed, sizes scaled to a given rho, noise, files, and the sealed labels."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from host.studies.proof.worlds import signals
from sim.concealed.label import Label, PlantedTruth

Array = np.ndarray
Columns = dict[str, Array]
SHARES = {"null": 0.30, "single": 0.40, "pair": 0.15, "outside": 0.15}
LEVELS = (1.0, 0.5, 2.0, 4.0)
ATTEMPTS = 30
NULL_BELOW = 0.08  # largest rho that the nominal model may leave of a case with nothing planted
LEAST_ENERGY = 150.0  # squared mismatch over squared noise, summed: below, no method could find it and the case is redrawn


@dataclass(frozen=True)
class Scales:
    """Sizes of a case that planted effects are stated in, SI."""

    motion: float
    force: float
    speed: float
    slow_s: float  # 1 / (2 pi times the fastest excitation)
    duration_s: float
    period_s: float


Make = Callable[[float, Scales], dict[str, float]]


@dataclass(frozen=True)
class Plantable:
    """One effect that a mechanism can have. A size of 1 is middling.

    Attributes:
        id: effect of the vocabulary, or `unlisted`.
        place: subsystem where it acts, as the nominal model names it.
        make: parameters from a size and the case's scales.
        same: further ids that say the truth.
        compared: parameters that a verdict's can be held against.
        signed: the size may be negative.
        says: what it is, for effects outside the vocabulary.
    """

    id: str
    place: str
    make: Make
    same: tuple[str, ...] = ()
    compared: tuple[str, ...] = ()
    signed: bool = False
    says: str = ""

    def names(self) -> list[str]:
        """Return all ids that say the truth."""
        return [self.id, *self.same]


@dataclass(frozen=True)
class Planted:
    """A planted effect with its parameters."""

    effect: Plantable
    size: float
    parameters: dict[str, float]


@dataclass(frozen=True)
class Setup:
    """One mechanism before anything is planted.

    Attributes:
        scales: sizes.
        stamps: sample times (n,) s of each recording.
        closed_loop: whether a controller acts on the noisy readings.
        seed: of commands and noise.
        sigma: noise standard deviation of each recorded channel, in its unit; 0 for exact ones.
        share: part of the noise's energy that is coloured.
        lost: share of output samples that are lost.
        parameters: of the nominal law.
        style: how the mechanism is driven and read.
    """

    scales: Scales
    stamps: tuple[Array, ...]
    closed_loop: bool
    seed: int
    sigma: dict[str, float]
    share: float
    lost: float
    parameters: dict[str, float]
    style: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def drawn(
        cls,
        rng: np.random.Generator,
        scales: Scales,
        stamps: tuple[Array, ...],
        closed_loop: bool,
        sigma: dict[str, float],
        parameters: dict[str, float],
        style: dict[str, Any],
        lost: float = 0.0,
    ) -> Setup:
        """Return the setup with a seed and a share of coloured noise (0 to 0.4) drawn from `rng`."""
        seed, share = int(rng.integers(2**31)), float(rng.uniform(0.0, 0.4))
        return cls(scales, stamps, closed_loop, seed, sigma, share, lost, parameters, style)

    def noise(self, recording: int, channel: str) -> Array:
        """Return the noise (n,) of one channel: the same in the recording as in what a controller read."""
        order = sorted(self.sigma).index(channel)
        rng = np.random.default_rng([self.seed, recording, order, 5])
        return signals.noise(rng, self.stamps[recording].size, self.sigma[channel], self.share)

    def stream(self, *numbers: int) -> np.random.Generator:
        """Return an independent stream of chance of this case."""
        return np.random.default_rng([self.seed, *numbers])


@dataclass(frozen=True)
class Trace:
    """One recording without noise: what is recorded, and true derivatives that are not."""

    channels: Columns
    hidden: Columns = field(default_factory=dict)


class Mechanism(Protocol):
    """One family of cases of a world."""

    name: str
    outputs: tuple[str, ...]
    effects: tuple[Plantable, ...]
    outside: tuple[Plantable, ...]

    def draw(self, rng: np.random.Generator, closed_loop: bool) -> Setup:
        """Draw a mechanism, its sampling and its noise."""
        ...

    def run(self, setup: Setup, planted: Sequence[Planted]) -> list[Trace]:
        """Run all recordings with `planted`. Raises ValueError where the effect's size is impossible."""
        ...

    def left(self, setup: Setup, traces: Sequence[Trace]) -> list[Columns]:
        """Return what the nominal model, refitted to all recordings but the last, leaves of each channel."""
        ...

    def nominal(self, setup: Setup) -> dict[str, Any]:
        """Return the nominal model as the content of its TOML, without `data.heldout`."""
        ...


class SeparateRecordings:
    """Base of mechanisms whose recordings are simulated one by one."""

    def run(self, setup: Setup, planted: Sequence[Planted]) -> list[Trace]:
        """Run all recordings with `planted`. Raises ValueError where the effect's size is impossible."""
        return [self._one(setup, planted, i) for i in range(len(setup.stamps))]

    def _one(self, setup: Setup, planted: Sequence[Planted], i: int) -> Trace:
        raise NotImplementedError


@dataclass(frozen=True)
class CasePlan:
    """Plan of a case. `turn` counts within its category, `attempt` the redraws."""

    world: str
    seed: int
    index: int
    category: str
    mechanism: int
    closed_loop: bool
    rho: float
    turn: int
    attempt: int = 0

    @property
    def id(self) -> str:
        """Return the name of the case, which does not reveal its content."""
        return f"case_{self.index:04d}"

    def stream(self, number: int) -> np.random.Generator:
        """Return an independent stream of chance of this case."""
        world = int.from_bytes(hashlib.sha256(self.world.encode()).digest()[:4], "little")
        return np.random.default_rng([world, self.seed, self.index, self.attempt, number])


@dataclass(frozen=True)
class Case:
    """One finished case: recordings by file name, nominal model, and what the seal keeps."""

    recordings: dict[str, Columns]
    nominal: dict[str, Any]
    label: Label


@dataclass(frozen=True)
class DrawnCase:
    """A case before noise is added."""

    setup: Setup
    planted: tuple[Planted, ...]
    traces: list[Trace]
    left: list[Columns]
    rho: float


def check_suite(seed: int, cases: int) -> None:
    """Raise ValueError for less than one case or a negative seed."""
    if cases < 1 or seed < 0:
        raise ValueError(f"cases and seed: found {cases} and {seed}, wanted at least 1 and at least 0")


def plans(world: str, seed: int, cases: int, mechanisms: int) -> list[CasePlan]:
    """Return the whole suite in the order of its shuffled case numbers. Raises ValueError for less than one case."""
    check_suite(seed, cases)
    exact = {name: cases * share for name, share in SHARES.items()}
    counts = {name: int(value + 1e-9) for name, value in exact.items()}
    for name in sorted(SHARES, key=lambda n: counts[n] - exact[n])[: cases - sum(counts.values())]:
        counts[name] += 1
    drafts = [(category, turn) for category, count in counts.items() for turn in range(count)]
    order = np.random.default_rng([seed, 1]).permutation(len(drafts))
    found = []
    for number, k in enumerate(order):
        category, turn = drafts[k]
        rho = 0.0 if category == "null" else LEVELS[(turn + seed) % len(LEVELS)]
        found.append(
            CasePlan(world, seed, number, category, (turn + seed) % mechanisms, (number + seed) % 2 == 0, rho, turn)
        )
    return found


def size_of(setup: Setup, left: Sequence[Columns]) -> tuple[float, dict[str, float]]:
    """Return (rho, rho of each channel): RMS of the mismatch over the noise, over all recordings."""
    each = {
        name: float(np.sqrt(np.mean(np.concatenate([part[name] for part in left]) ** 2))) / setup.sigma[name]
        for name in left[0]
    }
    return max(each.values()), each


def _scaled(mechanism: Mechanism, setup: Setup, effect: Plantable, rho: float, sign: float) -> Planted | None:
    """Return `effect` at the size whose mismatch has `rho` within 15 %, by secant steps on logarithms, or None."""
    log_size, points = 0.0, []
    for _ in range(8):
        size = sign * float(np.exp(log_size))
        planted = Planted(effect, size, effect.make(size, setup.scales))
        try:
            found = size_of(setup, mechanism.left(setup, mechanism.run(setup, [planted])))[0]
        except ValueError:
            return None
        if not np.isfinite(found):
            return None
        if abs(np.log(max(found, 1e-9) / rho)) < 0.14:
            return planted
        points.append((log_size, float(np.log(max(found, 1e-9)))))
        slope = 1.0
        if len(points) > 1 and abs(points[-1][0] - points[-2][0]) > 1e-6:
            slope = float(np.clip((points[-1][1] - points[-2][1]) / (points[-1][0] - points[-2][0]), 0.3, 4.0))
        log_size = float(np.clip(log_size + np.clip((np.log(rho) - points[-1][1]) / slope, -3.0, 3.0), -9.0, 5.0))
    return None


def _shown(setup: Setup, left: Sequence[Columns]) -> bool:
    """Return whether the recordings that are fitted show the mismatch, and strongly enough to be found."""
    rho, each = size_of(setup, left)
    top = max(each, key=lambda name: each[name])
    energy = [float(np.sum(part[top] ** 2)) / setup.sigma[top] ** 2 for part in left]
    training = size_of(setup, left[:-1])[1][top]
    return sum(energy[:-1]) > LEAST_ENERGY and training >= 0.5 * rho


def _pick(mechanism: Mechanism, plan: CasePlan, menu: Sequence[Plantable], skip: int = 0) -> tuple[Plantable, float]:
    """Return the effect of this turn and its sign; redraws go on through the menu."""
    rng = plan.stream(2 + skip)
    effect = menu[(plan.turn * 5 + plan.seed + plan.attempt * 3 + skip + int(rng.integers(len(menu)))) % len(menu)]
    return effect, -1.0 if effect.signed and rng.random() < 0.5 else 1.0


def _attempt(mechanism: Mechanism, plan: CasePlan) -> DrawnCase | None:
    setup = mechanism.draw(plan.stream(1), plan.closed_loop)
    planted: tuple[Planted, ...] = ()
    if plan.category != "null":
        menu = mechanism.outside if plan.category == "outside" else mechanism.effects
        first = _pick(mechanism, plan, menu)
        chosen = [first]
        if plan.category == "pair":
            others = [e for e in menu if not set(e.names()) & set(first[0].names())]
            chosen.append(_pick(mechanism, plan, others, skip=1))
        scaled = [_scaled(mechanism, setup, effect, plan.rho, sign) for effect, sign in chosen]
        if any(one is None for one in scaled):
            return None
        planted = tuple(one for one in scaled if one is not None)
    try:
        traces = mechanism.run(setup, planted)
    except ValueError:
        return None
    left = mechanism.left(setup, traces)
    rho = size_of(setup, left)[0]
    good = rho < NULL_BELOW if not planted else _shown(setup, left) and rho > 0.4 * plan.rho
    return DrawnCase(setup, planted, traces, left, rho) if good else None


def make(mechanisms: Sequence[Mechanism], plan: CasePlan) -> Case:
    """Return the case of `plan`, redrawn until its effect has the wanted size. Raises RuntimeError if none does.

    The first draw is that of the plan's attempt. A mechanism that gives none in ATTEMPTS draws is followed by the next one.
    """
    for attempt in range(plan.attempt, ATTEMPTS * len(mechanisms)):
        number = (plan.mechanism + attempt // ATTEMPTS) % len(mechanisms)
        now = replace(plan, attempt=attempt, mechanism=number)
        drawn = _attempt(mechanisms[number], now)
        if drawn is not None:
            return _finished(mechanisms[number], now, drawn)
    raise RuntimeError(f"{plan.world} {plan.id}: found no {plan.category} case of rho {plan.rho} in {attempt + 1} draws")


def _finished(mechanism: Mechanism, plan: CasePlan, drawn: DrawnCase) -> Case:
    """Return the case with noise, drop-outs, nominal model and label."""
    setup, rng = drawn.setup, plan.stream(9)
    recordings: dict[str, Columns] = {}
    spread: Columns = {}
    for i, (trace, time_s) in enumerate(zip(drawn.traces, setup.stamps, strict=True)):
        columns = {"time_s": np.round(time_s + setup.style.get("begin_s", 0.0), 7)}
        for name, values in trace.channels.items():
            noise = setup.noise(i, name) if setup.sigma.get(name, 0.0) > 0.0 else np.zeros(time_s.size)
            columns[name] = values + noise
            if name in mechanism.outputs and setup.lost > 0.0:
                columns[name][signals.lost(rng, time_s.size, setup.lost)] = np.nan
            spread[name] = noise
        recordings["abcdef"[i]] = columns
    held = {name: float(np.sqrt(np.mean(spread[name] ** 2))) for name in drawn.left[-1]}
    nominal = mechanism.nominal(setup)
    nominal["data"] = {**nominal.get("data", {}), "time": "time_s", "heldout": [f"{'abcdef'[len(setup.stamps) - 1]}.*"]}
    return Case(recordings, nominal, _label(mechanism, plan, drawn, held))


def _label(mechanism: Mechanism, plan: CasePlan, drawn: DrawnCase, held: Mapping[str, float]) -> Label:
    """Return the label that is sealed."""
    rho, each = size_of(drawn.setup, drawn.left)
    order = sorted(each, key=lambda name: -each[name])
    planted: list[PlantedTruth] = [
        {
            "id": p.effect.id,
            "port": p.effect.place,
            "size": p.size,
            "start_s": 0.0,
            "parameters": p.parameters,
            "compared": list(p.effect.compared),
            "equivalent": {},
            "gain": float(drawn.setup.parameters.get("gain", 1.0)),
        }
        for p in drawn.planted
    ]
    return {
        "id": plan.id,
        "category": plan.category,
        "puzzle": "",
        "kind": mechanism.name,
        "closed_loop": drawn.setup.closed_loop,
        "truth": [f"{p.effect.id}@{p.effect.place}" for p in drawn.planted],
        "names": [p.effect.names() for p in drawn.planted],
        "set": [] if drawn.planted else ["nothing_missing"],
        "form": "",
        "says": [p.effect.says for p in drawn.planted],
        "rho": rho,
        "rho_wanted": plan.rho,
        "planted": planted,
        "windows_s": [],
        "channels": [name for name in order if each[name] >= 0.5 * each[order[0]]],
        "mismatch_rms_heldout": {k: float(np.sqrt(np.mean(v**2))) for k, v in drawn.left[-1].items()},
        "noise_rms_heldout": dict(held),
        "plan": asdict(plan),
    }


def write(case: Case, folder: Path) -> None:
    """Write recordings as csv and the nominal model as TOML into `folder`."""
    import pyarrow as pa
    from pyarrow import csv

    folder.mkdir(parents=True, exist_ok=True)
    for name, columns in case.recordings.items():
        arrays = {k: pa.array(np.where(np.isnan(v), 0.0, _rounded(v)), mask=np.isnan(v)) for k, v in columns.items()}
        csv.write_csv(pa.table(arrays), folder / f"{name}.csv")
    (folder / "nominal.toml").write_text(toml_of(case.nominal), encoding="utf-8")


def _rounded(v: Array) -> Array:
    """Return v with nine significant digits: more than any device has."""
    size = np.where(np.isfinite(v) & (v != 0.0), np.abs(v), 1.0)
    scale = 10.0 ** (8 - np.floor(np.log10(size)))
    return np.asarray(np.round(v * scale) / scale)


def toml_of(content: Mapping[str, Any]) -> str:
    """Return a nominal model's content as TOML: scalars, lists, tables, and lists of tables, two levels deep."""
    plain = {k: v for k, v in content.items() if not isinstance(v, dict) and not _tables(v)}
    lines = [f"{k} = {json.dumps(v)}" for k, v in plain.items()]
    for key, value in content.items():
        if _tables(value):
            for row in value:
                lines += ["", f"[[{key}]]", *(f"{k} = {json.dumps(v)}" for k, v in row.items())]
        elif isinstance(value, dict):
            nested = {k: v for k, v in value.items() if isinstance(v, dict)}
            lines += ["", f"[{key}]", *(f"{k} = {json.dumps(v)}" for k, v in value.items() if k not in nested)]
            for inner, table in nested.items():
                lines += ["", f"[{key}.{inner}]", *(f"{k} = {json.dumps(v)}" for k, v in table.items())]
    return "\n".join(lines) + "\n"


def _tables(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and isinstance(value[0], dict)
