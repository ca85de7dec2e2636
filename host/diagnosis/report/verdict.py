"""The findings as one JSON object (docs/diagnosis.md, Fields of the verdict), with one plain sentence for each effect."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np

from host.diagnosis.design.experiment import lines as experiment_lines
from host.diagnosis.estimation.rules import SelectionRules
from host.diagnosis.model.effect import Candidate, Parameter, alike_everywhere, memory_keys
from host.diagnosis.model.findings import Finding
from host.diagnosis.model.nominal import NominalSpec
from host.diagnosis.models import channels_of
from host.diagnosis.pipeline import Diagnosis
from host.diagnosis.selection.equivalence import Standing, probability_of
from host.diagnosis.selection.full_rate import rms
from host.diagnosis.selection.locate import Location, joined
from host.diagnosis.selection.posterior import Posterior, calibrated, of_refused

# Findings on what these data cannot decide, the most important one first.
UNDECIDED = (
    "line",
    "noise_fed_back",
    "noise_passed_on",
    "slow_noise",
    "noise_unseen",
    "above_noise",
    "within_sample",
    "lead",
    "excitation",
)
REMARKS = (
    "outliers",
    "quantized",
    "hold",
    "held",
    "repeated",
    "session",
    "changed",
    "drifting",
    "unexplained",
    *UNDECIDED,
)  # findings that ask for no change of the data


def as_json(result: Diagnosis, seconds: float) -> dict[str, Any]:
    """The JSON object of `seldinger diagnose --json`; docs/diagnosis.md explains its fields."""
    figures = result.figures
    primary = figures.primary
    per_channel = {
        output.channel: {
            "rmse_before": figures.before[row],
            "rmse_after": figures.after[row],
            "noise_floor": figures.noise_sd[row],
            "unit": output.unit,
            "whiteness_p_before": figures.white_before[row],
            "whiteness_p_after": figures.white_after[row],
        }
        for row, output in enumerate(result.model.outputs)
        if np.isfinite(figures.before[row])
    }
    content = without_fit(result.findings, result.problem.rules, seconds)
    content["fit"] |= {
        "heldout": True,
        "rmse_before": figures.before[primary],
        "rmse_after": figures.after[primary],
        "noise_floor": figures.noise_sd[primary],
        "unit": result.model.outputs[primary].unit,
        "per_channel": per_channel,
        "per_recording": per_recording(result),
        "nominal_parameters": nominal_parameters(result),
        "whiteness_p_before": figures.white_before[primary],
        "whiteness_p_after": figures.white_after[primary],
    }
    return content | {
        "verdict": result.verdict,
        "located": [_located(location, result) for location in result.located],
        "probability_none": _none_stated(result),
        "probability_none_raw": probability_none(result),
        "effects": effects(result),
        "worse": worse(result),
        "next": next_step(result),
        "stopped_early": result.stopped_early,
    }


def worse(result: Diagnosis) -> list[str]:
    """Outputs and held-out recordings whose error grew with the effects by more than a twentieth, as sentences."""
    found, units = [], {output.channel: output.unit for output in result.model.outputs}
    for recording, channels in per_recording(result).items():
        for channel, error in channels.items():
            before, after, unit = error["rmse_before"], error["rmse_after"], units[channel]
            if after > result.problem.rules.worse_error_ratio * before:
                says = f"{channel} in {recording}: held-out RMS error {before:.3g} {unit} before, {after:.3g} {unit} with"
                found.append(says + " the effects.")
    return found


def next_step(result: Diagnosis) -> str:
    """What to do next, in one sentence."""
    named = effects(result)
    if result.stopped_early:
        return "Diagnose again with a longer time budget: the search was stopped before its end."
    remarks = {("clock", "time"), ("unit", result.spec.data.time)}  # stamps: put right already, or only perhaps wrong
    first = next((f for f in result.findings if f.id not in REMARKS and (f.id, f.channel) not in remarks), None)
    if first is not None:
        return f"Correct the data first ({first.id}: {first.channel}), then diagnose again."
    held = [f.channel for f in result.findings if f.id == "held"]
    if held:
        names = " and ".join(dict.fromkeys(held))
        return f"Correct {names} in the nominal file, or let it be fitted, and find out why it differs."
    if any(term.candidate.effect.dated for term in result.found.best.terms):
        return "Home the axis, find out what happened to it and to its sensor at these instants, and record again."
    unsure = [entry for entry in named if entry["probability"] < result.problem.rules.confident]
    useful = next((design for design in result.designs if design.separates), None)
    if useful is not None:
        return f"Record the proposed motion and diagnose again with it: {useful.says}"
    if result.designs:
        one, other = result.designs[0].candidate, result.designs[0].other
        return (
            f"Measure a further signal at {one.port.subsystem}, or choose by what is known of the hardware: no motion that "
            f"was tried separates {one.name} from {other.name}, so their predictions hardly differ."
        )
    if unexplained := _unexplained(result):
        return unexplained
    if unsure and (places := placeless(result)):
        return f"Record a signal between {' and '.join(places)} as well: it alone can tell the place of the effect."
    if unsure:
        shown = words(unsure[0]["id"])
        return f"Record a further motion that shows {shown}, and diagnose again: the verdict is not confident yet."
    if named:
        return "Add the effects to the nominal model (the report has the lines), and check it on a new recording."
    undecided = sorted((f for f in result.findings if f.id in UNDECIDED), key=lambda f: UNDECIDED.index(f.id))
    if undecided:
        return undecided[0].says
    with_values = f" with {moved}" if (moved := refitted(result)) else ""
    return f"Nothing: the nominal model explains these recordings{with_values}."


def _unexplained(result: Diagnosis) -> str:
    """What to do about a residual that no effect explains; empty where there is none."""
    if any(f.id == "session" for f in result.findings):
        return "Find what was changed between the recordings, or diagnose those that agree with each other apart."
    if any(f.id == "changed" for f in result.findings):
        return "Find what was changed at that time, or cut the recording there and diagnose the parts apart."
    if any(f.id == "drifting" for f in result.findings):
        return "Record the same motion at the begin, in the middle and at the end of a run, and compare them."
    if (
        result.verdict == "mismatch_not_identified"
        and result.spec.linear is not None
        and result.spec.linear.feedback is None
    ):
        return (
            "Describe a mass on a spring or damper as kind axis and diagnose again: a linear model has candidates at its "
            "inputs and readings only, and not for a force inside it, such as friction or a hardening spring."
        )
    if result.verdict == "mismatch_not_identified" and result.model.simulates:
        return (
            "Offer the simulator's parameters that are nominally off ([[offer]]), or record slower and faster motions with "
            "rests, and diagnose again: no known effect at its inputs and outputs fits."
        )
    above = result.verdict == "mismatch_not_identified" or any(f.id == "noise_unseen" for f in result.findings)
    if above and not effects(result) and (beside := unused(result.spec)):
        return (
            f"Name the channels that may play a part under `others` of the {result.spec.kind} and diagnose again: no known "
            f"effect explains the residual, and the nominal model does not use {', '.join(beside)}."
        )
    if result.verdict == "mismatch_not_identified":
        return "Record slower and faster motions of single axes, with rests, and diagnose again: no known effect fits."
    return ""


def unused(spec: NominalSpec) -> list[str]:
    """Channels that a transmission or an impedance declares and does not read: no effect can depend on them."""
    if spec.kind not in ("transmission", "impedance"):
        return []
    return [name for name in spec.channels if name not in channels_of(spec)[0]]


def refitted(result: Diagnosis) -> str:
    """State the nominal parameters that were fitted and whose stated value is outside of their interval; empty if none is.

    A fitted parameter contains every error of its kind: a gain contains the wrong scale of a reading. "Nothing is missing"
    therefore says nothing of the stated value.
    """
    fitted = nominal_parameters(result)
    said = []
    for parameter in result.model.parameters:
        stated = result.spec.parameters.get(parameter.name)
        value, (low, high) = fitted[parameter.key]["value"], fitted[parameter.key]["ci95"]
        if stated is not None and stated.free and not low <= stated.value <= high:
            said.append(f"{parameter.name} {value:.4g} (stated: {stated.value:.4g})")
    return ", ".join(said)


def placeless(result: Diagnosis) -> list[str]:
    """Return the places of the first effect that would be confident if its place were known; empty if there is none."""
    for standing in result.standings:
        found = posterior_of(result, standing)
        rivals = [(rival, p) for rival, p in found.rivals if alike_everywhere(standing.candidate, rival)]
        together = found.effect + sum(p for _, p in rivals)
        if found.effect < result.problem.rules.confident <= together:
            return [words(port) for port in standing.candidate.port.path]
    return []


def likelier(effect: dict[str, Any]) -> str:
    """State the alternative that is more probable than the named effect, with its probability; empty if there is none.

    An effect keeps its name if an equation of recorded signals fits better in its place: an equation states no cause.
    """
    best = max(effect["alternatives"], key=lambda other: other["probability"], default=None)
    if best is None or best["probability"] <= effect["probability"]:
        return ""
    effect_id, _, place = best["name"].partition("@")
    name = "an equation of the recorded signals" if effect_id == "unlisted" else words(effect_id)
    return f"{name} at {words(place)} is more probable in its place ({best['probability']:.2f})"


def words(effect_id: str) -> str:
    """Return an effect's id with spaces for underscores."""
    return effect_id.replace("_", " ")


def without_fit(findings: list[Finding], rules: SelectionRules, seconds: float) -> dict[str, Any]:
    """The verdict on recordings in which there is nothing to compare: findings about the data, no effects.

    It has all keys of a verdict; `as_json` fills it.
    """
    return {
        "verdict": "mismatch_not_identified",
        "located": [],
        "data_findings": [finding_json(finding) for finding in findings],
        "probability_none": 1.0,
        "probability_none_raw": 1.0,
        "rules": rules.as_dict(),
        "effects": [],
        "fit": {
            "heldout": False,
            "rmse_before": None,
            "rmse_after": None,
            "noise_floor": None,
            "unit": "",
            "per_channel": {},
            "per_recording": {},
            "nominal_parameters": {},
            "whiteness_p_before": None,
            "whiteness_p_after": None,
        },
        "worse": [],
        "next": "Correct the data first, then diagnose again: " + (findings[0].says if findings else ""),
        "stopped_early": False,
        "seconds": seconds,
    }


def posterior_of(result: Diagnosis, standing: Standing, raw: bool = False) -> Posterior:
    """Probabilities at the place of one effect; raw: before calibration."""
    rules = result.problem.rules
    rules = replace(rules, effect_a=1.0, effect_b=1.0, effect_c=0.0) if raw else rules
    return probability_of(standing, result.remainder.share, rules)


def _none_stated(result: Diagnosis) -> float:
    rules, curve = result.problem.rules, result.problem.rules.absent_curve
    if result.verdict == "missing_physics":
        curve = rules.none_curve if _strongest(result).candidate.effect.listed else rules.effect_curve
    return calibrated(probability_none(result), *curve)


def _strongest(result: Diagnosis) -> Standing:
    return max(result.standings, key=lambda standing: standing.gain.log_likelihood)


def probability_none(result: Diagnosis) -> float:
    """Probability, before calibration, that no effect that was considered is what is missing: nothing is, or physics that
    is in no list.
    """
    if result.verdict == "missing_physics":
        strongest = _strongest(result)
        found = posterior_of(result, strongest, raw=True)
        equation = 0.0 if strongest.candidate.effect.listed else found.effect  # an equation is physics in no list
        return equation + found.nothing + found.none + sum(p for rival, p in found.rivals if not rival.effect.listed)
    if not result.standings:
        return 1.0 - of_refused(result.found.last_trials)
    return 1.0 - max(posterior_of(result, standing).raw for standing in result.standings)


def finding_json(finding: Finding) -> dict[str, str]:
    """One entry of `data_findings` (docs/diagnosis.md, Checks of the data)."""
    return {"id": finding.id, "channel": finding.channel, "says": finding.says}


def _located(location: Location, result: Diagnosis) -> dict[str, Any]:
    return {
        "windows_unit": "s" if result.full.segments[0].recording.timed else "samples",
        "subsystem": location.subsystem,
        "channels": location.channels,
        "windows_s": every_window(location, result.problem.rules),
        "windows_by_recording": {name: [list(span) for span in spans] for name, spans in location.windows_s.items()},
        "condition": location.condition.says if location.condition else "all along",
        "residual_share": location.residual_share,
    }


def nominal_parameters(result: Diagnosis) -> dict[str, dict[str, Any]]:
    """Parameters of the nominal model as refitted together with the effects, with intervals."""
    return {
        p.key: {"value": float(v), "ci95": [float(a), float(b)]}
        for p, v, (a, b) in zip(result.model.parameters, result.found.best.values, result.intervals, strict=False)
    }


def per_recording(result: Diagnosis) -> dict[str, dict[str, dict[str, float]]]:
    """RMS error before and after of every channel in every recording that was held out, by their names."""
    found: dict[str, dict[str, dict[str, float]]] = {}
    for segment, before, after in zip(
        result.full.segments, result.full_rate.nominal.residuals, result.full_rate.best.residuals, strict=True
    ):
        if segment.heldout.any():
            found[segment.recording.name] = {
                output.channel: {"rmse_before": rms([b[segment.heldout]]), "rmse_after": rms([a[segment.heldout]])}
                for output, b, a in zip(result.model.outputs, before, after, strict=True)
                if np.isfinite(b[segment.heldout]).any()
            }
    return found


def every_window(location: Location, rules: SelectionRules) -> list[list[float]]:
    """Windows of all recordings in order, those that overlap made one: recordings may lie on one clock, or each start
    at zero.
    """
    spans = [span for each in location.windows_s.values() for span in each]
    return [list(span) for span in joined(spans, rules)]


def effects(result: Diagnosis) -> list[dict[str, Any]]:
    """One entry for every effect of the best model, strongest evidence first."""
    entries = []
    at = len(result.model.parameters)
    for term, standing in zip(result.found.best.terms, result.standings, strict=True):
        count = len(term.parameters)
        values, spans = result.found.best.values[at : at + count], result.intervals[at : at + count]
        at += count
        entries.append((standing.gain.log_likelihood, _effect(result, term.parameters, values, spans, standing)))
    ranked = [entry for _, entry in sorted(entries, key=lambda item: -item[0])]
    white = result.figures.white_after[result.figures.primary] > result.problem.rules.white_significance
    if ranked and result.remainder.sure and result.remainder.share > result.problem.rules.partly_explained_share:
        ranked[0]["says"] += f" This explains the mismatch only partly: {remains(result)}."
    elif ranked and not white:
        figures = result.figures
        share = figures.after[figures.primary] / max(figures.before[figures.primary], 1e-300)
        ranked[0]["says"] += f" The held-out RMS error is {share:.0%} of what it was, and the residual is not white noise."
    return ranked


def remaining_power(result: Diagnosis) -> float:
    """Share of the mismatch's power above noise that remains: by the stated errors, or what is predictable if more."""
    figures, row = result.figures, result.figures.primary
    noise = figures.noise_sd[row] ** 2
    before, after = figures.before[row] ** 2 - noise, figures.after[row] ** 2 - noise
    stated = float(np.clip(np.nan_to_num(after) / before, 0.0, 1.0)) if before > 0.0 else 0.0
    return max(stated, result.remainder.share)


def remains(result: Diagnosis) -> str:
    """The mismatch above noise that remains, as power and as amplitude: 4 % of the power are 20 % of the RMS."""
    power = remaining_power(result)
    return f"{power:.0%} of its power above noise remains, {np.sqrt(power):.0%} of its RMS"


def _effect(
    result: Diagnosis, parameters: tuple[Parameter, ...], values: Any, spans: Any, standing: Standing
) -> dict[str, Any]:
    candidate, probable = standing.candidate, posterior_of(result, standing)
    by_name: dict[str, float] = {}
    for rival, p in probable.rivals:
        by_name[rival.name] = by_name.get(rival.name, 0.0) + p
    shown = {
        p.key: {"value": float(v), "ci95": [float(a), float(b)], "at_bound": at_bound(p, float(v))}
        for p, v, (a, b) in zip(parameters, values, spans, strict=True)
        if p.high > p.low
    }
    says = sentence(candidate, parameters, values)
    says += _amplitudes(result, candidate)
    says += elsewhere(result, candidate)
    if standing.rests_on and len(result.problem.segments) > 1:
        says += f" The evidence rests on one recording, {standing.rests_on}."
    if standing.crossed:
        says += " The samples held out hardly excite it, so each recording was predicted from the others."
    return {
        "id": candidate.effect.id,
        "subsystem": candidate.port.subsystem,
        "port": candidate.port.name,
        "probability": probable.effect,
        "probability_raw": probable.raw,
        "alternatives": [{"name": name, "probability": p} for name, p in sorted(by_name.items(), key=lambda item: -item[1])],
        "says": says,
        "equation": equation(candidate),
        "parameters": shown,
        "evidence": {"heldout_log_likelihood_gain": standing.gain.log_likelihood, "p_value": standing.gain.p_value},
        "rests_on": standing.rests_on,
        "cross_validated": standing.crossed,
        "indistinguishable_from": [other.name for other in standing.alike],
        "experiment_to_tell_apart": experiment_lines(result.designs, candidate),
        "experiment_separates": any(design.separates for design in result.designs if design.candidate == candidate),
    }


def _amplitudes(result: Diagnosis, candidate: Candidate) -> str:
    """Return a sentence with the amplitude in each recording, of an effect that has its own in each; else empty."""
    if not candidate.effect.memories:
        return ""
    keys, found = memory_keys(candidate), []
    for segment in result.problem.segments:
        size = float(np.linalg.norm([segment.start.get(key, 0.0) for key in keys]))
        unit = segment.units.get(candidate.port.name, "")
        found.append(f"{size:.3g} {unit}".strip() + f" in {segment.recording.name}")
    return f" Its amplitude is {', '.join(found)}."


def elsewhere(result: Diagnosis, candidate: Candidate) -> str:
    """Return a sentence that names the places at which the effect would act alike, if there are others; else empty."""
    active = [term.candidate for term in result.found.best.terms]
    places = [port.replace("_", " ") for port in candidate.port.path]
    if candidate.effect.shifts == "rate" and len(places) > 1:
        return _other_clock(result, candidate)
    if not candidate.effect.invariant or len(places) < 2 or not all(other.effect.invariant for other in active):
        return ""
    return f" These data cannot tell whether it acts at {' or at '.join(places)}: the model between them is linear."


def _other_clock(result: Diagnosis, candidate: Candidate) -> str:
    """A sentence on another place of a linear path at which a drift explains as much, with other nominal rates; else empty.

    A plant whose input comes faster by a factor answers as one does whose reading comes faster, if its masses are divided
    by the square of that factor and its dampings by the factor.
    """
    trials = [t for step in result.found.steps for t in step.trials if t.candidate.effect.id == candidate.effect.id]
    own = next((t for t in trials if t.candidate.key == candidate.key), None)
    others = [t for t in trials if t.candidate.port.name in candidate.port.path and t.candidate.form == candidate.form]
    for other in (t for t in others if t.candidate.port.name != candidate.port.name):
        if own is None or abs(own.score - other.score) > result.problem.rules.equal_log_likelihood:
            continue
        pairs = zip(result.model.parameters, own.fit.values, other.fit.values, strict=False)
        values = [f"{p.name} {value:.4g} {p.unit}".strip() for p, mine, value in pairs if not np.isclose(mine, value, 1e-3)]
        at = other.candidate.port.name.replace("_", " ")
        return f" A drift at {at} explains as much" + (f", with {', '.join(values)}." if values else ".")
    return ""


def at_bound(p: Parameter, value: float) -> bool:
    """Whether a fitted value ended at a bound of its parameter."""
    near = 1e-3 * max(abs(p.high - p.low), 1e-300) if abs(p.high - p.low) < float("inf") and not p.log else 1e-3 * abs(value)
    return p.high > p.low and bool(value - p.low <= near or p.high - value <= near)


def sentence(candidate: Candidate, parameters: tuple[Parameter, ...], values: Any) -> str:
    """The effect's own words with its values put in."""
    against = candidate.effect.dissipates and all(
        float(v) <= 0.0 for p, v in zip(parameters, values, strict=True) if p.linear
    )
    text = {
        p.name: f"{abs(float(v)) if against else float(v):.3g} {p.unit}".strip()
        for p, v in zip(parameters, values, strict=True)
    }
    text["source"] = candidate.source.replace("_", " ")
    said = re.sub(r"\{(\w+)\}", lambda m: text.get(m.group(1), m.group(1)), candidate.effect.says)
    return said[:1].upper() + said[1:] + (" The output counts it negative." if against else "")


def equation(candidate: Candidate) -> str:
    """The effect's equation, its load or other channel named."""
    return (
        re.sub(r"\b(load|other)\b", candidate.source, candidate.effect.equation)
        if candidate.source
        else candidate.effect.equation
    )
