"""The input between its samples: a discrete nominal parameter, chosen before any physics is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from host.diagnosis.estimation.fit import Fit, Problem
from host.diagnosis.model.effect import Candidate
from host.diagnosis.model.readings import Finding
from host.diagnosis.selection.equivalence import Standing
from host.diagnosis.selection.found import Found
from host.diagnosis.selection.refits import fit_nominal, try_fit
from host.diagnosis.selection.screening import screen
from host.diagnosis.selection.trial import Trial, lead_of, leads


def hold_between_samples(problem: Problem, others: Sequence[Problem], candidates: Sequence[Candidate]) -> list[Finding]:
    """Let a model's input run between samples as its recordings say, and say so where the nominal model says otherwise.

    Only a hold that is better by as much as an effect has to be, on all samples, takes the place of the stated one. It is
    not physics: without it, a force that is straight where it should be smooth passes for a faint resonance.
    A held input is half a sample late, so a delay makes it look right. The holds are therefore also compared with a free
    delay each. If no hold is better then, the chosen one has to explain as much without a delay as the stated one with it.
    others: problems of the same model, which get the same hold. candidates: all effects that will be tried.
    """
    model = problem.model
    if not model.holds:
        return []
    stated = model.hold
    fits = {}
    for hold in (stated, *(other for other in model.holds if other != stated)):
        model.hold_as(problem.segments, hold)
        fits[hold] = fit_nominal(problem)
    chosen = _better(problem, fits[stated], fits) or stated
    if chosen != stated:
        late = {hold: _late(problem, hold, candidates) for hold in fits}
        shaped = _better(problem, late[chosen], late)
        if shaped is not None:
            chosen = shaped
        elif not _better(problem, late[stated], {chosen: late[chosen]}) and _better(
            problem, fits[chosen], {stated: late[stated]}
        ):
            chosen = stated
    for each in (problem, *others):
        model.hold_as(each.segments, chosen)
    if chosen == stated or not model.hold_stated:
        return []
    columns = [problem.columns.get(name, name) for name in model.quiet_inputs]
    which = f"column {columns[0]}" if len(columns) == 1 else "each input"
    subject, words = model.hold_words
    says = f"{subject or f'Between its samples {which}'} {words[chosen]}; the nominal model says that it {words[stated]}. "
    says += f'The diagnosis continues with this ({model.kind}.hold = "{chosen}").'
    return [Finding("hold", columns[0], says)]


def _better(problem: Problem, base: Fit, fits: Mapping[str, Fit]) -> str | None:
    """The hold of the best of `fits`, if that is better than `base` by as much as an effect has to be; else None."""
    rules = problem.rules
    gains = {hold: problem.gain("both", base.residuals, fit.residuals) for hold, fit in fits.items()}
    best = max(gains, key=lambda hold: gains[hold].log_likelihood)
    sure = gains[best].log_likelihood > rules.pooled_log_likelihood and gains[best].p_value < rules.significance
    return best if sure else None


def _late(problem: Problem, hold: str, candidates: Sequence[Candidate]) -> Fit:
    """The nominal model with a free delay of the input that `hold` is about."""
    model = problem.model
    model.hold_as(problem.segments, hold)
    nominal = fit_nominal(problem)
    own = model.quiet_inputs
    delays = [c for c in candidates if (c.port.held or c.port.name in own) and c.effect.shifts == "time"]
    fits = [try_fit(problem, nominal, item).fit for item in screen(problem, nominal, delays, lambda *_: None)]
    return min([nominal, *fits], key=lambda fit: fit.cost)


def late_by_a_sample(problem: Problem, late: Trial, past: bool = False) -> list[Finding]:
    """Say that a delay within one sample, or a lead, explains a mismatch and is not named.

    past: it was searched on with it.
    """
    period_s, port = problem.segments[0].recording.dt_s, late.candidate.port
    place, removed = port.name.replace("_", " "), f"removes {late.both.share:.0%} of the squared error. "
    lead_s = lead_of(late)
    if lead_s > 0.0:
        says = f"The recordings are {lead_s:.3g} s ({lead_s / period_s:.2g} samples) ahead of the nominal model at {place}: "
        says += f"a lead of that size {removed}No effect is named for it, because no law answers an input that is yet to "
        says += "come. The clocks of two columns disagree, one sensor has a slower filter, or the input is held between "
        says += "samples in another way. "
    else:
        says = f"A delay of up to one sample ({period_s:.3g} s) at {place} {removed}"
        says += "No effect is named for it: these recordings cannot separate a delay or lag of this size "
        says += "from the way in which the input is held between samples, recorded or simulated. "
    if past:
        says += f"The diagnosis continues with this {'lead' if lead_s > 0.0 else 'delay'}."
    elif lead_s > 0.0:
        says += "Shift the column that is early by that time."
    else:
        says += "Record at a higher rate, or shift that column by one sample."
    id = "clock" if lead_s > period_s else "within_sample"
    return [Finding(id, _column(problem, late), says)]


def _column(problem: Problem, late: Trial) -> str:
    name = late.candidate.port.channels[0]
    return problem.columns.get(name, name)


def lead_instead(problem: Problem, found: Found, standing: Sequence[Standing]) -> list[Finding]:
    """Say where a lead explains the recordings as well as an effect that is named."""
    tried = {trial.candidate.key: trial for step in found.steps for trial in step.trials if leads(trial)}
    findings = []
    for one in standing:
        for trial in (tried[rival.key] for rival in one.alike if rival.key in tried):
            column = _column(problem, trial)
            says = f"The recordings do not separate {one.candidate.name} from column {column} being early by "
            says += f"{lead_of(trial):.3g} s, as it is where clocks disagree or one sensor has a slower filter."
            findings.append(Finding("lead", column, says))
    return findings
