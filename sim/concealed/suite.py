"""Concealed cases: from a seed, a suite of recordings with physics left out, and the labels that a seal keeps apart.

`python -m sim.concealed.suite --seed S --cases N --dir DIR` writes DIR/cases/ID/{a,b,c}.csv or .parquet with nominal.toml,
and DIR/sealed/labels.json, whose sha256 it prints. Nothing under cases/ reveals what was planted.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from protocol.worker_process import end_with_parent
from sim.concealed import generic as concealed_generic
from sim.concealed import rig as concealed_rig
from sim.concealed import system as concealed_system
from sim.concealed.label import Label
from sim.concealed.rig import NoiselessRecordings
from sim.concealed.scalable_effects import EFFECTS, UNLISTED, ScalableEffect, equivalents
from sim.concealed.signals import tidy, windows
from sim.concealed.system import ScaledEffect, System

Array = np.ndarray
SHARES = {"null": 0.30, "single": 0.30, "pair": 0.15, "outside": 0.15, "unidentifiable": 0.10}
KINDS = ("rig", "rig", "transmission", "rig", "axis", "rig", "impedance", "rig")
LEVELS = {
    "null": (0.0,),
    "single": (0.5, 1.0, 0.25, 2.0, 0.5, 0.25, 1.0, 0.1, 0.5, 2.0, 1.0, 0.05),
    "pair": (1.0, 0.5, 2.0),
    "outside": (1.0, 0.5, 2.0),
    "unidentifiable": (1.0,),
}
PUZZLES = ("below_noise", "not_moved", "force_scale", "bias_or_base", "one_slow_tone", "never_touched")
NOTHING = "nothing_missing"
_TRAIN, _ALL = (0, 1), (0, 1, 2)


@dataclass(frozen=True)
class ConcealedPlan:
    """What a case is to be; `index` numbers the streams of chance, `attempt` the redraws."""

    seed: int
    index: int
    category: str
    kind: str
    closed_loop: bool
    rho: float
    turn: int  # number within its category, from 0
    attempt: int = 0

    @property
    def id(self) -> str:
        """Return the name of the case, which does not reveal its content."""
        return f"case_{self.index:04d}"

    def stream(self, number: int) -> np.random.Generator:
        """Independent stream of chance of this case."""
        return np.random.default_rng([self.seed, self.index, self.attempt, number])


def counts(cases: int) -> dict[str, int]:
    """How many of `cases` each category gets: largest remainders."""
    exact = {name: cases * share for name, share in SHARES.items()}
    out = {name: int(value + 1e-9) for name, value in exact.items()}
    for name in sorted(SHARES, key=lambda n: out[n] - exact[n])[: cases - sum(out.values())]:
        out[name] += 1
    return out


def plans(seed: int, cases: int) -> list[ConcealedPlan]:
    """The whole suite in the order of its case numbers, which is shuffled. Raises ValueError for less than one case."""
    if cases < 1 or seed < 0:
        raise ValueError(f"cases and seed: found {cases} and {seed}, wanted at least 1 and at least 0")
    drafts = []
    for category, count in counts(cases).items():
        for turn in range(count):
            kind = KINDS[turn % len(KINDS)] if category != "unidentifiable" else "rig"
            level = LEVELS[category][(turn + seed) % len(LEVELS[category])]
            drafts.append((category, kind, level, turn))
    order = np.random.default_rng([seed, 1]).permutation(len(drafts))
    closed = np.random.default_rng([seed, 2]).permutation(len(drafts)) % 2 == 0
    return [
        ConcealedPlan(seed, number, drafts[k][0], drafts[k][1], bool(closed[k]), drafts[k][2], drafts[k][3])
        for number, k in enumerate(order)
    ]


@dataclass(frozen=True)
class ConcealedCase:
    """A case before noise: system, what is planted, how it came out."""

    plan: ConcealedPlan
    system: System
    planted: tuple[ScaledEffect, ...]
    session: NoiselessRecordings
    rho: float
    mismatch: tuple[Array, ...]
    truth_set: tuple[str, ...] = ()
    puzzle: str = ""


def _system(plan: ConcealedPlan, puzzle: str = "") -> System:
    """The case's rig or mechanism, with the excitation that its puzzle needs."""
    rng = plan.stream(1)
    if plan.kind == "rig":
        still = {"not_moved": 1}.get(puzzle)
        return concealed_system.rig(concealed_rig.draw(rng, plan.closed_loop, still, puzzle != "never_touched"))
    signals = ("sine",) * 3 if puzzle == "one_slow_tone" else None
    return concealed_system.generic(
        concealed_generic.draw(rng, plan.kind, plan.closed_loop, signals, puzzle != "one_slow_tone")
    )


def measure(system: System, session: NoiselessRecordings) -> tuple[float, list[Array]]:
    """(rho, mismatch per recording): what the nominal model, refitted to noise-free training data, leaves.

    rho is the RMS over the noise of the channel that shows it most, over all recordings.
    """
    p = system.calibrate(session, _TRAIN, system.case.nominal)
    left = system.residuals(p, session)
    return float(np.max(np.sqrt(np.mean(np.vstack(left) ** 2, axis=0)) / system.sigma)), left


def scaled(
    system: System, effect: ScalableEffect, rho: float, start_s: float, sign: float
) -> tuple[ScaledEffect, NoiselessRecordings, float, list[Array]] | None:
    """`effect` at the size whose mismatch has `rho` within 15 %: secant steps on logarithms; None where there is none."""
    size, best, points = 1.0, None, []
    for _ in range(7):
        planted = ScaledEffect(effect, sign * size, start_s)
        try:
            session = system.run([planted])
        except ValueError:
            return best
        found, left = measure(system, session)
        if not np.isfinite(found) or found > 50.0:
            return best
        if best is None or abs(np.log(max(found, 1e-9) / rho)) < abs(np.log(max(best[2], 1e-9) / rho)):
            best = (planted, session, found, left)
        if abs(np.log(max(found, 1e-9) / rho)) < 0.14:
            return best
        points.append((np.log(size), np.log(max(found, 1e-9))))
        size = float(np.exp(_next(points, np.log(rho))))
    return best


def _next(points: list[tuple[float, float]], wanted: float) -> float:
    """Next log size: slope 1 from a first point, then the secant, slope between 0.3 and 4, at most a factor of 20."""
    x, y = points[-1]
    slope = 1.0
    if len(points) > 1 and abs(points[-2][0] - x) > 1e-6:
        slope = float(np.clip((y - points[-2][1]) / (x - points[-2][0]), 0.3, 4.0))
    return float(np.clip(x + np.clip((wanted - y) / slope, -3.0, 3.0), -9.0, 6.0))


def _fits(rho: float, wanted: float) -> bool:
    return 0.75 < rho / wanted < 1.33


def _choose(
    plan: ConcealedPlan, effects: Sequence[ScalableEffect], rng: np.random.Generator, skip: int = 0
) -> tuple[ScalableEffect, float, float]:
    """One of `effects`, its sign, its start: by turn, so that a suite goes round all ports before it repeats."""
    ports = sorted({d.port for d in effects})
    port = ports[(plan.turn + plan.seed + skip + int(rng.integers(2)) * plan.attempt) % len(ports)]
    among = [d for d in effects if d.port == port]
    effect = among[int(rng.integers(len(among)))]
    sign = -1.0 if effect.signed and rng.random() < 0.5 else 1.0
    start = float(rng.uniform(8.0, 18.0)) if effect.late and plan.kind == "rig" and rng.random() < 0.6 else 0.0
    return effect, sign, round(start, 2)


def _null(plan: ConcealedPlan) -> ConcealedCase | None:
    """Nothing planted, and the nominal model good to a small part of the noise, even as calibrated on noisy recordings."""
    system = _system(plan)
    session = system.run([])
    rho, left = measure(system, session)
    calibrated = system.calibrate(system.noisy(session, plan.stream(3)), _TRAIN, system.case.nominal)
    size = np.sqrt(np.mean(np.vstack(system.residuals(calibrated, session)) ** 2, axis=0)) / system.sigma
    return (
        ConcealedCase(plan, system, (), session, rho, tuple(left), (NOTHING,))
        if rho < 0.06 and np.max(size) < 0.13
        else None
    )


def taught(system: System, left: Sequence[Array]) -> bool:
    """Whether training recordings show the mismatch `left` too: at least half as strong as all do, where it is strongest."""
    everywhere, training = (
        np.sqrt(np.mean(np.vstack([left[i] for i in which]) ** 2, axis=0)) / system.sigma for which in (_ALL, _TRAIN)
    )
    top = int(np.argmax(everywhere))
    return bool(training[top] >= 0.5 * everywhere[top])


def _single(plan: ConcealedPlan, effects: Sequence[ScalableEffect]) -> ConcealedCase | None:
    system = _system(plan)
    effect, sign, start = _choose(plan, effects, plan.stream(2))
    found = scaled(system, effect, plan.rho, start, sign)
    if found is None or not _fits(found[2], plan.rho) or not taught(system, found[3]):
        return None
    return ConcealedCase(plan, system, (found[0],), found[1], found[2], tuple(found[3]))


def _pair(plan: ConcealedPlan) -> ConcealedCase | None:
    """Two effects, each of the plan's rho by itself; in every fourth case the second one's sign is that which cancels."""
    system, rng = _system(plan), plan.stream(2)
    effects = EFFECTS[plan.kind]
    first = _choose(plan, effects, rng)
    rest = [d for d in effects if d.id not in first[0].names()]
    cancelling = plan.turn % 4 == 0
    if cancelling:
        near = [d for d in rest if d.signed and (d.port == first[0].port or plan.kind != "rig")]
        rest = near or [d for d in rest if d.signed] or rest
    second = _choose(plan, rest, rng, skip=1)
    one = scaled(system, first[0], plan.rho, first[2], first[1])
    two = scaled(system, second[0], plan.rho, second[2], second[1])
    if one is None or two is None or not (_fits(one[2], plan.rho) and _fits(two[2], plan.rho)):
        return None
    options = [two[0], replace(two[0], size=-two[0].size)] if cancelling and two[0].effect.signed else [two[0]]
    tried = []
    for other in options:
        session = system.run([one[0], other])
        tried.append((*measure(system, session), other, session))
    rho, left, other, session = min(tried, key=lambda t: t[0])
    if rho < 0.2 or not (taught(system, one[3]) and taught(system, two[3])):
        return None
    return ConcealedCase(plan, system, (one[0], other), session, rho, tuple(left))


def _puzzle(plan: ConcealedPlan) -> ConcealedCase | None:
    """A case that its own data cannot decide; the label says what they leave open."""
    puzzle = PUZZLES[(plan.turn + plan.attempt) % len(PUZZLES)]
    if puzzle == "one_slow_tone":
        plan = replace(plan, kind="transmission", closed_loop=False)
    system, rng, wanted = _system(plan, puzzle), plan.stream(2), 0.02

    def effect_at(name: str, port: str) -> ScalableEffect:
        return next(d for d in EFFECTS[plan.kind] if (d.id, d.port) == (name, port))

    if puzzle in ("below_noise", "not_moved", "force_scale", "never_touched"):
        ways: dict[str, Callable[[], tuple[ScalableEffect, float, float]]] = {
            "below_noise": partial(_choose, plan, EFFECTS["rig"], rng),
            "not_moved": lambda: (effect_at(str(rng.choice(["backlash", "latency", "whip"])), "roll"), 1.0, 0.0),
            "force_scale": lambda: (_FORCE_SCALE, 1.0, 0.0),
            "never_touched": lambda: (
                effect_at(str(rng.choice(["contact_nonlinear", "contact_viscous", "contact_friction"])), "contact"),
                1.0,
                0.0,
            ),
        }
        chosen = ways[puzzle]()
        names = (NOTHING, *chosen[0].names())
    elif puzzle == "bias_or_base":
        chosen, names, wanted = (_STANDING_BIAS, 1.0, 0.0), ("sensor_bias", "base_motion", "sensor_misalignment"), plan.rho
    else:
        chosen, wanted = (effect_at(str(rng.choice(["latency", "rate_lag"])), "roll"), 1.0, 0.0), 0.5
        names = ("latency", "rate_lag", "viscous_friction", "creep_relaxation", "resonance")
    found = (
        _as_is(system, chosen[0])
        if puzzle in ("not_moved", "force_scale", "never_touched")
        else scaled(system, chosen[0], wanted, chosen[2], chosen[1])
    )
    if found is None or (NOTHING in names and found[2] > 0.08) or (NOTHING not in names and not _fits(found[2], wanted)):
        return None
    return ConcealedCase(plan, system, (found[0],), found[1], found[2], tuple(found[3]), names, puzzle)


_FORCE_SCALE = ScalableEffect("sensor_scale", "force_sensor", lambda s: {"gain": 1.0 + 0.12 * s})
_STANDING_BIAS = ScalableEffect(
    "sensor_bias", "pose_sensor", lambda s: {"x_m": 2e-4 * s, "y_m": 1e-4 * s, "z_m": 0.0}, signed=True
)


def _as_is(system: System, effect: ScalableEffect) -> tuple[ScaledEffect, NoiselessRecordings, float, list[Array]]:
    """Return `effect` at size 1, for a case in which the data do not show it."""
    session = system.run([ScaledEffect(effect, 1.0)])
    return (ScaledEffect(effect, 1.0), session, *measure(system, session))


def draw(plan: ConcealedPlan) -> ConcealedCase:
    """The case of `plan`, redrawn until its effect has the wanted size. Raises RuntimeError after 40 attempts."""
    for attempt in range(40):
        now = replace(plan, attempt=attempt)
        ways: dict[str, Callable[[], ConcealedCase | None]] = {
            "null": partial(_null, now),
            "single": partial(_single, now, EFFECTS[plan.kind]),
            "pair": partial(_pair, now),
            "outside": partial(_single, now, UNLISTED[plan.kind]),
            "unidentifiable": partial(_puzzle, now),
        }
        drawn = ways[plan.category]()
        if drawn is not None:
            return drawn
    raise RuntimeError(f"{plan.id}: no {plan.category} case of kind {plan.kind} and rho {plan.rho} after 40 attempts")


def label(drawn: ConcealedCase, recorded: NoiselessRecordings) -> dict[str, Any]:
    """What the seal keeps: the truth in plain words and numbers, and what a scorer needs to hold a verdict against it."""
    plan, system = drawn.plan, drawn.system
    size = np.sqrt(np.mean(np.vstack(drawn.mismatch) ** 2, axis=0)) / system.sigma
    noise = np.sqrt(np.nanmean(system.apart(drawn.session.outputs[2], recorded.outputs[2]) ** 2, axis=0))
    shown = [k for k in np.argsort(-size) if size[k] >= 0.5 * size.max()]
    seen = tidy([w for k in shown for i in _ALL for w in windows(drawn.mismatch[i][:, k], drawn.session.time_s[i])])
    return {
        "id": plan.id,
        "category": plan.category,
        "puzzle": drawn.puzzle,
        "kind": plan.kind,
        "closed_loop": plan.closed_loop,
        "truth": [f"{p.effect.id}@{_place(plan.kind, p.effect)}" for p in drawn.planted],
        "names": [list(p.effect.names()) for p in drawn.planted],
        "set": list(drawn.truth_set),
        "form": drawn.planted[0].effect.form if plan.category == "outside" else "",
        "says": [p.effect.says for p in drawn.planted],
        "rho": drawn.rho,
        "rho_wanted": plan.rho,
        "planted": [
            {
                "id": p.effect.id,
                "port": p.effect.port,
                "size": p.size,
                "start_s": p.start_s,
                "parameters": p.parameters,
                "compared": list(p.effect.compared),
                "equivalent": equivalents(p.effect, p.parameters, _gain(system, p.effect.port), p.start_s),
                "gain": _gain(system, p.effect.port),
            }
            for p in drawn.planted
        ],
        "windows_s": seen if drawn.rho >= 0.05 and drawn.planted else [],
        "channels": [system.channels[k] for k in shown],
        "mismatch_rms_heldout": dict(
            zip(system.channels, np.sqrt(np.mean(drawn.mismatch[2] ** 2, axis=0)).tolist(), strict=True)
        ),
        "noise_rms_heldout": dict(zip(system.channels, noise.tolist(), strict=True)),
        "plan": asdict(plan),
    }


def _gain(system: System, port: str) -> float:
    """True gain of the link at `port`; 1 where there is none."""
    at = {"rig": {"insertion": 0, "roll": 2, "knob": 4}, "transmission": {"roll": 0, "knob": 2}}.get(system.kind, {})
    return float(system.case.nominal[at[port]]) if port in at else 1.0


def _place(kind: str, effect: ScalableEffect) -> str:
    """Subsystem in which an effect acts, as the case's nominal file names it."""
    return effect.port or {"axis": "knob", "impedance": "contact"}[kind]


def make(plan: ConcealedPlan, folder: Path) -> dict[str, Any]:
    """Draw the case of `plan`, write its recordings and nominal file into `folder`, return its label."""
    drawn = draw(plan)
    rng = drawn.plan.stream(3)
    recorded = drawn.system.noisy(drawn.session, rng)
    start = drawn.system.case.nominal * (1.0 + 0.05 * rng.standard_normal(len(drawn.system.case.nominal)))
    start = _near(drawn.system, rng) if drawn.plan.kind == "rig" else start
    calibrated = drawn.system.calibrate(recorded, _TRAIN, start, every=6)
    concealed_system.write(drawn.system, recorded, calibrated, folder, bool(rng.random() < 0.3))
    return label(drawn, recorded)


def _near(system: System, rng: np.random.Generator) -> Array:
    """Where a rig engineer's calibration starts: near the rig's own values, the wall within reach of the presses.

    Without a contact force the fit would not find the wall.
    """
    p = system.case.nominal.copy()
    p[[2, 4, 6, 8]] *= 1.0 + 0.05 * rng.standard_normal(4)
    p[1] += 5e-4 * rng.standard_normal()
    p[7] += min(p[1] - system.case.nominal[1], 0.0) - 5e-4 * abs(rng.standard_normal()) - 2e-4
    return p


def rebuild(truth: Label) -> tuple[System, list[ScaledEffect]]:
    """System and planted effects of a label, for the oracle."""
    plan = ConcealedPlan(**truth["plan"])
    known = [*EFFECTS[plan.kind], *UNLISTED[plan.kind], _FORCE_SCALE, _STANDING_BIAS]
    planted = []
    for item, says in zip(truth["planted"], truth["says"], strict=True):
        same = [d for d in known if (d.id, d.port, d.says) == (item["id"], item["port"], says)]
        exact = [d for d in same if d.make(item["size"]) == item["parameters"]]
        planted.append(ScaledEffect(exact[0], item["size"], item["start_s"]))
    return _system(plan, truth["puzzle"]), planted


def suite(seed: int, cases: int, folder: Path, jobs: int = 1, progress: Callable[[int], None] = lambda _: None) -> str:
    """Write the whole suite into `folder` and return the sha256 of its labels; cases already there are not made again."""
    sealed = folder / "sealed"
    seal = sealed / "labels.json"
    if not seal.exists():
        parts = sealed / "parts"
        parts.mkdir(parents=True, exist_ok=True)
        todo = [plan for plan in plans(seed, cases) if not (parts / f"{plan.id}.json").exists()]
        done = cases - len(todo)
        with ProcessPoolExecutor(max_workers=jobs, initializer=end_with_parent) as pool:
            for made in (pool.map if jobs > 1 else map)(partial(_keep, folder), todo):
                done += made
                progress(done)
        labels = [json.loads((parts / f"{plan.id}.json").read_text()) for plan in plans(seed, cases)]
        seal.write_text(json.dumps({"seed": seed, "cases": cases, "labels": labels}, sort_keys=True))
        for part in parts.iterdir():
            part.unlink()
        parts.rmdir()
    seal.chmod(0o400)
    return hashlib.sha256(seal.read_bytes()).hexdigest()


def _keep(folder: Path, plan: ConcealedPlan) -> int:
    """Make one case and put its label behind the seal."""
    truth = make(plan, folder / "cases" / plan.id)
    part = folder / "sealed" / "parts" / f"{plan.id}.json"
    part.with_suffix(".new").write_text(json.dumps(truth))
    part.with_suffix(".new").rename(part)
    return 1


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line of the generator: the sha256 of the labels on standard output, cases made so far on standard error."""
    parser = argparse.ArgumentParser(prog="python -m sim.concealed.suite")
    for name in ("--seed", "--cases"):
        parser.add_argument(name, type=int, required=True)
    parser.add_argument("--dir", type=Path, required=True)
    parser.add_argument("--jobs", type=int, default=1)
    given = parser.parse_args(arguments)
    print(suite(given.seed, given.cases, given.dir, given.jobs, lambda n: print(n, file=sys.stderr, flush=True)))


if __name__ == "__main__":
    main()
