"""The report of a diagnosis: one HTML file that a rig engineer reads top down."""

from __future__ import annotations

from pathlib import Path
from textwrap import wrap
from typing import Any, NamedTuple

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from host.diagnosis.pipeline import Diagnosis
from host.diagnosis.report.pictures import pictures, shown
from host.diagnosis.report.quantities import interval, quantity, short
from host.diagnosis.report.verdict import at_bound, likelier, remaining_power, remains, words

TEMPLATES = Path(__file__).parents[2] / "report" / "templates"
NBSP = "\u00a0"
PARAMETERS_DIFFER = {  # finding -> headline
    "changed": "The nominal parameters change within a recording",
    "drifting": "A parameter drifts with time",
    "session": "The nominal parameters differ between the recordings",
}


class Line(NamedTuple):
    """One figure with its name and what it is held against."""

    name: str
    value: str
    note: str = ""


class Row(NamedTuple):
    """One row of the table of candidates."""

    step: str
    name: str
    likelihood: str
    p_value: str
    share: str
    taken: bool


def _environment() -> Environment:
    return Environment(
        loader=FileSystemLoader(TEMPLATES), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )


def write_data_report(name: str, verdict: dict[str, Any], target: Path) -> Path:
    """The report of a JSON `verdict` on recordings that nominal model `name` cannot be compared with: findings about the
    data. Raises OSError where it cannot write `target`.
    """
    text = (
        _environment()
        .get_template("diagnosis_data.html.j2")
        .render(
            title="The recordings cannot be compared with the nominal model",
            eyebrow=f"Diagnosis of {name}",
            lead="A channel that the comparison needs cannot be used, so nothing was fitted.",
            footer=f"{verdict['seconds']:.0f} s.",
            findings=verdict["data_findings"],
            next_step=verdict["next"],
        )
    )
    target.write_text(text, encoding="utf-8")
    return target


def write_report(result: Diagnosis, verdict: dict[str, Any], target: Path) -> Path:
    """The report of `result`, with its JSON `verdict`, written to `target`. Raises OSError where it cannot write."""
    segment, _, row = shown(result)
    recordings = len(result.full.segments)
    samples = sum(p.n for p in result.full.segments)
    text = (
        _environment()
        .get_template("diagnosis.html.j2")
        .render(
            title=headline(verdict),
            eyebrow=f"Diagnosis of {result.spec.name}",
            lead=lead(verdict),
            footer=f"{recordings} recording{'s' if recordings > 1 else ''}, {samples} samples, {verdict['seconds']:.0f} s.",
            lines=lines(result, verdict),
            pictures=pictures(result),
            effects=[{**shown_effect(e, units_of(result)), "judged_by": judged_by(result, e)} for e in verdict["effects"]],
            nominal=_nominal(result),
            candidates=candidates(result),
            located=[{**place, "times": times(place, timed=segment.recording.timed)} for place in verdict["located"]],
            scripts=[Path(path).name for path in verdict.get("scripts", ())],
            on_rig=any(str(path).endswith(".toml") for path in verdict.get("scripts", ())),
            partly=remains(result).replace("its power", "the power of the mismatch"),
            noises=_noises(result),
            output=result.model.outputs[row].channel.replace("_", " "),
            recording=segment.recording.name,
            switches=switches(result),
            heldout=[p.recording.name for p in result.full.segments if p.heldout.any()],
            verdict=verdict["verdict"],
            findings=verdict["data_findings"],
            worse=verdict["worse"],
            comparisons=comparisons(result, verdict),
            probability_none=f"{verdict['probability_none']:.2f}",
            next_step=verdict["next"],
            rules=[(words(name), short(float(value))) for name, value in verdict["rules"].items()],
        )
    )
    target.write_text(text, encoding="utf-8")
    return target


def headline(verdict: dict[str, Any]) -> str:
    """Return the verdict in one sentence."""
    names = [f"{words(e['id'])} ({words(e['subsystem'])})" for e in verdict["effects"]]
    data = list(dict.fromkeys(finding["id"] for finding in verdict["data_findings"]))
    parameters = next((said for key, said in PARAMETERS_DIFFER.items() if key in data), "")
    data = [key for key in data if not parameters or key not in PARAMETERS_DIFFER]
    also = f"; data: {', '.join(data)}" if data else ""
    also += f"; {worse_words(verdict)}" if verdict["worse"] else ""
    if verdict["verdict"] == "nothing_missing":
        return "Nothing is missing: the nominal model explains these recordings" + also
    if verdict["verdict"] == "mismatch_not_identified":
        return (parameters or "There is a mismatch, and no known effect explains it") + also
    return "Missing: " + (names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1]) + also


def worse_words(verdict: dict[str, Any]) -> str:
    """Where the held-out error grew: the first output by name, and how many more."""
    first, more = verdict["worse"][0].partition(" in ")[0], len(verdict["worse"]) - 1
    return f"the error of {words(first)} grew" + (f", and {more} more" if more else "")


def lead(verdict: dict[str, Any]) -> str:
    """Return the sentence below the verdict."""
    fit = verdict["fit"]
    unit = fit["unit"]
    if verdict["verdict"] == "nothing_missing":
        return "No effect of the vocabulary improves the fit of recordings that were not used to fit."
    it = "it" if len(verdict["effects"]) == 1 else "them"
    said = f"With {it} the error on recordings that were not used to fit falls from "
    before, after = (quantity(fit[key], unit).replace(" ", NBSP) for key in ("rmse_before", "rmse_after"))
    said += f"{before} to {after}."
    if verdict["verdict"] == "mismatch_not_identified":
        return (
            "The effects below were fitted, but their names are probably wrong."
            if verdict["effects"]
            else "Windows and conditions are below."
        )
    return said


def lines(result: Diagnosis, verdict: dict[str, Any]) -> list[Line]:
    """Return the key figures at the top of the page."""
    fit = verdict["fit"]
    before, after, noise = (
        quantity(fit[key], fit["unit"]).replace(" ", NBSP) for key in ("rmse_before", "rmse_after", "noise_floor")
    )
    found = [Line("held-out error, nominal", before, "refitted"), Line("held-out error, extended", after, f"noise {noise}")]
    if verdict["located"]:
        found.append(Line("where", words(verdict["located"][0]["subsystem"]), verdict["located"][0]["condition"]))
    if result.found.best.terms:
        left = 100.0 * remaining_power(result)
        rms = f"of its RMS above noise ({left:.2g}{NBSP}% of its power)"
        found.append(Line("remaining mismatch", f"{10.0 * max(left, 0.0) ** 0.5:.0f}{NBSP}%", rms))
    return found


def units_of(result: Diagnosis) -> dict[str, tuple[str, str]]:
    """Name and unit of every effect's parameters by their keys."""
    return {p.key: (p.name, p.unit) for term in result.found.best.terms for p in term.parameters}


def times(place: dict[str, Any], most: int = 3, timed: bool = True) -> str:
    """When a place is at fault: the longest windows, recording by recording."""
    unit = "s" if timed else "samples"
    shown = []
    for name, spans in place["windows_by_recording"].items():
        longest = sorted(sorted(spans, key=lambda s: s[0] - s[1])[:most])
        if spans:
            more = f" and {len(spans) - most} more" if len(spans) > most else ""
            shown.append(
                f"{name}: " + ", ".join(f"{a:.{int(timed)}f} to {b:.{int(timed)}f} {unit}" for a, b in longest) + more
            )
    return "; ".join(shown[:most]) + (f"; and {len(shown) - most} more recordings" if len(shown) > most else "")


def judged_by(result: Diagnosis, effect: dict[str, Any]) -> str:
    """What is lower without an effect: the likelihood of the samples that its evidence is of."""
    named = effect["id"], effect["port"]
    standing = next(s for s in result.standings if (s.candidate.effect.id, s.candidate.port.name) == named)
    if standing.candidate.effect.dated:
        return "log-likelihood of all samples"
    return "log-likelihood of recordings predicted from the others" if standing.crossed else "held-out log-likelihood"


def shown_effect(effect: dict[str, Any], units: dict[str, tuple[str, str]]) -> dict[str, Any]:
    """An effect with its numbers as text."""
    rows = []
    for key, p in effect["parameters"].items():
        name, unit = units.get(key, (key, ""))
        low, high = p["ci95"]
        mark = " at its bound" if p["at_bound"] else ""
        rows.append((words(name), quantity(p["value"], unit), interval(low, high, unit, p["value"]) + mark))
    return {
        **effect,
        "name": words(effect["id"]),
        "where": words(effect["subsystem"]),
        "rows": rows,
        "alike": [words(name.replace("@", " at ")) for name in effect["indistinguishable_from"]],
        "script": [
            line
            for text in effect["experiment_to_tell_apart"].splitlines()
            for line in wrap(text, 88, subsequent_indent="    ")
        ],
        "probability": f"{effect['probability']:.2f}",
        "likelier": likelier(effect),
        "others": ", ".join(
            f"{words(other['name'].replace('@', ' at '))} {other['probability']:.2f}" for other in effect["alternatives"][:4]
        ),
        "gain": short(effect["evidence"]["heldout_log_likelihood_gain"]),
        "p": short(effect["evidence"]["p_value"]),
    }


def comparisons(result: Diagnosis, verdict: dict[str, Any]) -> list[tuple[str, str, str, str, bool]]:
    """Held-out RMS error of every output in every recording: recording, output, before, after, whether it grew."""
    units = {output.channel: output.unit for output in result.model.outputs}
    rows = []
    for recording, channels in verdict["fit"]["per_recording"].items():
        for channel, error in channels.items():
            before, after = error["rmse_before"], error["rmse_after"]
            grew = any(text.startswith(f"{channel} in {recording}:") for text in verdict["worse"])
            errors = (quantity(before, units[channel]), quantity(after, units[channel]))
            rows.append((recording, words(channel), *errors, grew))
    return rows


def switches(result: Diagnosis) -> tuple[str, str]:
    """What switches the effects on in the nominal model: options of the command line, and lines for its TOML file."""
    options, tables = [], []
    at = len(result.model.parameters)
    for term in result.found.best.terms:
        values = result.found.best.values[at : at + len(term.parameters)]
        at += len(term.parameters)
        c = term.candidate
        if c.effect.searched:
            continue
        texts = {key: text for key, text in (("source", c.source), ("form", c.form)) if text}
        numbers = {p.key: f"{float(v):.6g}" for p, v in zip(term.parameters, values, strict=True) if p.high > p.low}
        settings = [f"{key}={value}" for key, value in (texts | numbers).items()]
        options.append(f"--effect '{c.effect.id}@{c.port.name}:{','.join(settings)}'")
        lines_ = [
            f'id = "{c.effect.id}"',
            f'at = "{c.port.name}"',
            *(f'{key} = "{value}"' for key, value in texts.items()),
            "values = { " + ", ".join(f"{key} = {value}" for key, value in numbers.items()) + " }",
        ]
        tables.append("\n".join(["[[effect]]", *lines_]))
    return "\n".join(options), "\n\n".join(tables)


def named(key: str) -> str:
    """A candidate's key as text: its effect, form and place."""
    return words(key.replace("@", " at ").replace("(", " ("))


def candidates(result: Diagnosis) -> list[Row]:
    """What was fitted in full, step by step."""
    rows = []
    for count, step in enumerate(result.found.steps, start=1):
        if step.move.removes:
            gain = ("", "") if step.gain is None else (short(step.gain.log_likelihood), short(step.gain.p_value))
            rows.append(Row(str(count), f"{named(step.key)} {step.move.value}", *gain, "", False))
        for trial in step.trials[:6]:
            rows.append(
                Row(
                    str(count),
                    named(trial.candidate.key),
                    short(trial.heldout.log_likelihood),
                    short(trial.heldout.p_value),
                    f"{100 * trial.heldout.share:.1f} %",
                    trial.candidate.key == step.key,
                )
            )
    return rows


def _nominal(result: Diagnosis) -> list[tuple[str, str, str]]:
    spans = result.intervals
    return [
        (
            words(p.name),
            quantity(float(v), p.unit),
            (interval(a, b, p.unit, float(v)) + (" at its bound" if at_bound(p, float(v)) else ""))
            if p.high > p.low
            else "held",
        )
        for p, v, (a, b) in zip(result.model.parameters, result.found.best.values, spans, strict=False)
    ]


def _noises(result: Diagnosis) -> list[tuple[str, str, str]]:
    return [
        (
            words(o.channel),
            quantity(n.sigma, o.unit),
            f"{n.source.value}, correlated over {n.correlation_samples:.1f} samples",
        )
        for o, n in zip(result.model.outputs, result.full.noise, strict=True)
    ]
