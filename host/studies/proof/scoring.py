"""One verdict against one sealed label: every fact that the table counts, and whether the verdict is right."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from host.studies.proof.calibration import Calibration, as_stated, kind_of_none
from host.studies.proof.equation_form import right_form
from sim.concealed.label import Label, PlantedTruth

Array = np.ndarray
CONFIDENT = 0.9  # stated probability from which on a name is a confident one
SILENT_BELOW = 0.19  # rho under which nothing is promised: `nothing_missing` is not a fault there
FROM_THE_BEGIN = {"clock_drift"}
BEHIND = "behind the gain"  # in the equation of an effect that acts on the output of its link
LOWER = "max(x, limit)"  # in the equation of a limit at the lower side alone, which is minus the planted one of both sides
_UNITS = {"m", "rad", "N", "Nm", "s", "Hz", "per", "m2", "m3", "N2", "s2", "square", "share", "kg"}


@dataclass(frozen=True)
class Facts:
    """Contributions of one case to the table; None for a figure to which the case does not contribute."""

    category: str
    rho: float
    rho_wanted: float
    failed: bool
    detected: bool
    named_first: bool
    in_set: bool
    wrong: bool
    subsystem: bool | None
    window_f1: float | None
    exact: bool
    flagged: bool
    form: bool | None
    parameter_errors: tuple[float, ...]
    covered: tuple[bool, ...]
    gap_closed: float | None
    seconds: float
    right: bool = field(default=False)
    windows: bool = True  # whether the label has windows
    named: bool = False  # verdict `missing_physics`
    processor_s: float = math.nan  # for the case, or for 60 s of it where it is longer
    stated: tuple[tuple[float, bool], ...] = ()  # (probability that the verdict gives to a statement, whether it is true)


def judge(
    label: Label,
    verdict: dict[str, Any],
    heldout: dict[str, Array] | None = None,
    calibrate: Calibration = as_stated,
) -> Facts:
    """Facts of one case.

    Args:
        label: the sealed truth.
        verdict: as `seldinger diagnose --json` prints it (docs/diagnosis.md, Fields of the verdict).
        heldout: columns of the held-out recording, for equations; without them no form is right.
        calibrate: what turns a verdict's probabilities into those that count.
    """
    kind = verdict.get("verdict")
    effects = [e for e in verdict.get("effects") or [] if isinstance(e, dict)]
    said = [_claim(e) for e in effects] if kind == "missing_physics" else []
    names = [set(n) for n in label["names"]]
    places = [t.rpartition("@")[2] for t in label["truth"]]
    first = bool(said) and any(said[0][0] in n for n in names)
    everything = set().union(*(claim for _, claim in said)) if said else set()
    library = label["category"] in ("single", "pair")
    errors, covered = parameters(label, effects) if library and said else ((), ())
    facts: dict[str, Any] = {
        "category": label["category"],
        "rho": label["rho"],
        "rho_wanted": label["rho_wanted"],
        "failed": kind not in ("missing_physics", "nothing_missing", "mismatch_not_identified"),
        "detected": kind in ("missing_physics", "mismatch_not_identified"),
        "named_first": first,
        "in_set": any(everything & n for n in names),
        "wrong": _wrong(label, kind, _confident(effects, said, calibrate), names),
        "subsystem": _subsystem(label, verdict, effects, places),
        "window_f1": window_f1(label, verdict),
        "windows": bool(label["windows_s"]),
        "exact": _exact(said, names),
        "flagged": kind == "mismatch_not_identified"
        or any("unlisted" in claim for _, claim in said)
        or (label["category"] == "outside" and first),
        "form": (label["category"] == "outside" and _form(label, effects, heldout)) if label["form"] else None,
        "parameter_errors": errors,
        "covered": covered,
        "gap_closed": gap_closed(label, verdict),
        "seconds": float(verdict.get("wall_s", verdict.get("seconds", math.nan)) or math.nan),
        "named": kind == "missing_physics",
        "processor_s": float(verdict.get("processor_s", math.nan) or math.nan)
        * 60.0
        / max(float(verdict.get("recorded_s", 60.0)), 60.0),
        "stated": _stated(label, verdict, effects if said else [], names, calibrate),
    }
    stray = _wrong(label, kind, said, names)
    named = _right(label, kind, said, facts) and not (stray and label["category"] != "unidentifiable")
    return Facts(**facts, right=named and _states_findings(label, verdict))


def _states_findings(label: Label, verdict: dict[str, Any]) -> bool:
    """Whether the verdict states every mistake in the data that it must."""
    stated = {str(f.get("id")) for f in verdict.get("data_findings") or [] if isinstance(f, dict)}
    return stated >= set(label.get("findings", []))


def _confident(
    effects: list[dict[str, Any]], said: list[tuple[str, set[str]]], calibrate: Calibration
) -> list[tuple[str, set[str]]]:
    """Those claims whose probability makes them confident; a claim without one is taken for certain."""
    return [
        claim
        for effect, claim in zip(effects, said, strict=False)
        if not isinstance(effect.get("probability"), (int, float)) or calibrate("effect", effect) >= CONFIDENT
    ]


def _stated(
    label: Label, verdict: dict[str, Any], effects: list[dict[str, Any]], names: list[set[str]], calibrate: Calibration
) -> tuple[tuple[float, bool], ...]:
    """Return a verdict's statements with a probability: its first effect is there; none of the vocabulary is missing."""
    out = []
    if effects and isinstance(effects[0].get("probability"), (int, float)):
        out.append((calibrate("effect", effects[0]), any(str(effects[0].get("id")) in n for n in names)))
    if isinstance(verdict.get("probability_none"), (int, float)):
        out.append((calibrate(kind_of_none(verdict), verdict), none_listed(label)))
    return tuple(out)


def none_listed(label: Label) -> bool:
    """Whether no effect of the vocabulary is missing: nothing is, or only physics outside it. `probability_none` says so."""
    return all(name == "unlisted" for names in label["names"] for name in names)


def _claim(effect: dict[str, Any]) -> tuple[str, set[str]]:
    """(id, all ids that the finder says it may be)."""
    others = effect.get("indistinguishable_from") or []
    name = str(effect.get("id"))
    return name, {name, *(str(o).partition("@")[0] for o in others)}


def _wrong(label: Label, kind: Any, said: list[tuple[str, set[str]]], names: list[set[str]]) -> bool:
    """Confident and wrong: an effect is named, and neither it nor anything it may be is true.

    Outside the library: a listed effect is named first and `unlisted` is not among what it may be.
    """
    if kind != "missing_physics" or not said:
        return False
    if label["category"] == "outside":
        return not said[0][1] & {"unlisted", *set().union(*names)}
    true = [*names, set(label["set"])]
    return any(not any(claim & n for n in true) for _, claim in said)


def _exact(said: list[tuple[str, set[str]]], names: list[set[str]]) -> bool:
    """All effects named first by their own names, and no others."""
    if len(said) != len(names):
        return False
    left = list(names)
    for name, _ in said:
        hit = next((n for n in left if name in n), None)
        if hit is None:
            return False
        left.remove(hit)
    return True


def _subsystem(label: Label, verdict: dict[str, Any], effects: list[dict[str, Any]], places: list[str]) -> bool | None:
    """Whether the first place named is true; None where the nominal model has one place only, or nothing was planted."""
    if not places or label["kind"] not in ("rig", "transmission"):
        return None
    named = [*effects, *(x for x in verdict.get("located") or [] if isinstance(x, dict))]
    return bool(named) and named[0].get("subsystem") in places


def window_f1(label: Label, verdict: dict[str, Any]) -> float | None:
    """F1 of the time that reported and true windows share, within the recordings that the verdict has windows in.

    Windows are in the recordings' own time, which runs on through the session. None without true or reported windows.
    """
    windows = _joined([w for x in verdict.get("located") or [] for w in x.get("windows_s") or []])
    if not label["windows_s"] or not windows:
        return None
    edges = [0.0, 32.0, 66.0, math.inf]  # recordings of 30 s with pauses of 4 s between them
    spoken = [(a, b) for a, b in itertools.pairwise(edges) if any(begin < b and end > a for begin, end in windows)]
    true = [[max(a, w[0]), min(b, w[1])] for a, b in spoken for w in label["windows_s"] if w[0] < b and w[1] > a]
    shared = sum(max(0.0, min(e, f) - max(b, c)) for b, e in windows for c, f in true)
    both = sum(e - b for b, e in windows) + sum(e - b for b, e in true)
    return 2.0 * shared / both if both > 0.0 else None


def _joined(segments: list[list[float]]) -> list[list[float]]:
    out: list[list[float]] = []
    for begin, end in sorted([float(p[0]), float(p[1])] for p in segments):
        if out and begin <= out[-1][1]:
            out[-1][1] = max(out[-1][1], end)
        else:
            out.append([begin, end])
    return out


def _form(label: Label, effects: list[dict[str, Any]], heldout: dict[str, Array] | None) -> bool:
    """Whether one of the equations found has the form of the true one."""
    if heldout is None:
        return False
    place = label["truth"][0].rpartition("@")[2]
    own = {
        "insertion": ["handle_insertion_m"],
        "roll": ["handle_roll_rad", "motor_a_rad"],
        "knob": ["handle_knob_rad", "motor_b_rad"],
    }.get(place, [])
    absorbed = [name for name in own if name in heldout]
    return any(
        right_form(str(e.get("equation", "")), label["form"], heldout, absorbed)
        for e in effects
        if e.get("id") == "unlisted"
    )


def _base(name: str) -> str:
    """A parameter's name without its unit: width_m -> width."""
    words = name.split("_")
    while len(words) > 1 and words[-1] in _UNITS:
        words.pop()
    return "_".join(words)


def parameters(label: Label, effects: list[dict[str, Any]]) -> tuple[tuple[float, ...], tuple[bool, ...]]:
    """(relative errors, whether the 95 % interval holds the truth) of all comparable parameters of truly named effects."""
    errors, covered = [], []
    for planted, names in zip(label["planted"], label["names"], strict=True):
        effect = next((e for e in effects if e.get("id") in names), None) or {}
        found = {_base(k): v for k, v in (effect.get("parameters") or {}).items()}
        for name, true in comparable(planted, effect).items():
            value = found.get(_base(name))
            if not isinstance(value, dict) or true == 0.0 or not isinstance(value.get("value"), (int, float)):
                continue
            errors.append(abs(float(value["value"]) - true) / abs(true))
            ends = value.get("ci95")
            if isinstance(ends, list) and len(ends) == 2 and None not in ends:
                covered.append(bool(ends[0] <= true <= ends[1]))
    return tuple(errors), tuple(covered)


def comparable(planted: PlantedTruth, effect: dict[str, Any]) -> dict[str, float]:
    """True values that the parameters of `effect` can be held against, by name, as the label or its equivalents have them.

    An amplitude that the effect counts behind the gain is turned there, and a limit that acts at the lower side alone is
    below zero; a drift that began later than the recordings is none whose rate counts from their begin.
    """
    if planted["id"] in FROM_THE_BEGIN and planted["start_s"] > 0.0:
        return {}
    equation = str(effect.get("equation", ""))
    gain = planted.get("gain", 1.0) if BEHIND in equation else -1.0 if LOWER in equation else 1.0
    return {name: gain * float(planted["parameters"][name]) for name in planted["compared"]} | planted.get("equivalent", {})


def gap_closed(label: Label, verdict: dict[str, Any]) -> float | None:
    """(E_nominal - E_fit) / (E_nominal - E_true), held out, on the channel that shows the mismatch most.

    E_true is the noise that was in fact added there: what the true model leaves. None below rho 0.5 on held-out data.
    """
    if not label["planted"] or not label["channels"]:
        return None
    channel = label["channels"][0]
    noise, mismatch = label["noise_rms_heldout"][channel], label["mismatch_rms_heldout"][channel]
    rows = (verdict.get("fit") or {}).get("per_channel") or {}
    row = rows.get(channel) or next((v for k, v in rows.items() if _base(k) == _base(channel)), None)
    if mismatch < 0.5 * noise or not isinstance(row, dict):
        return None
    before, after = row.get("rmse_before"), row.get("rmse_after")
    if not isinstance(before, (int, float)) or not isinstance(after, (int, float)) or before <= noise:
        return None
    return float((before - after) / (before - noise))


def _right(label: Label, kind: Any, said: list[tuple[str, set[str]]], facts: dict[str, Any]) -> bool:
    """The verdict in one word, by the category's rule (docs/proof.md)."""
    category = label["category"]
    if facts["failed"]:
        return False
    if category == "null":
        return bool(kind == "nothing_missing")
    if category == "unidentifiable":
        return _honest(label, kind, said)
    if facts["rho"] < SILENT_BELOW and kind != "missing_physics":
        return True
    if category == "outside":
        return bool(facts["flagged"] and not facts["wrong"])
    return bool((facts["named_first"] if category == "single" else facts["exact"]) and not facts["wrong"])


def _honest(label: Label, kind: Any, said: list[tuple[str, set[str]]]) -> bool:
    """An undecidable case: `nothing_missing` where that is in the set, doubt, or a true name together with another of the
    set.
    """
    allowed = set(label["set"])
    if kind == "nothing_missing":
        return "nothing_missing" in allowed
    if kind == "mismatch_not_identified":
        return "nothing_missing" not in allowed or label["rho"] >= 0.05
    return len(said) == 1 and said[0][0] in allowed and len(said[0][1] & allowed) > 1


def mean(values: list[float]) -> float | None:
    """Return the mean of `values`, None if there are none."""
    return float(np.mean(values)) if values else None
