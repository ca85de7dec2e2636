"""The input between its samples: a discrete nominal parameter, chosen before any physics is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from host.diagnosis.estimation.evidence import compare
from host.diagnosis.estimation.fit import Problem
from host.diagnosis.model.readings import Finding
from host.diagnosis.selection.search import fit_nominal

WORDS = {"zero": "is held", "linear": "runs straight", "band_limited": "runs smoothly (band-limited)"}


def hold_between_samples(problem: Problem, others: Sequence[Problem]) -> list[Finding]:
    """Let a model's input run between samples as its recordings say, and say so where the nominal model says otherwise.

    Only a hold that is better by as much as an effect has to be, on all samples, takes the place of the stated one. It is
    not physics: without it, a force that is straight where it should be smooth passes for a faint resonance.
    others: problems of the same model, which get the same hold.
    """
    model = problem.model
    if not model.holds:
        return []
    noise_sd = np.array([noise.sigma for noise in problem.noise])
    stated, column = model.hold, problem.columns.get(model.quiet_inputs[0], "")
    fits = {}
    for hold in (stated, *(other for other in model.holds if other != stated)):
        model.hold_as(problem.segments, hold)
        fits[hold] = fit_nominal(problem).residuals
    gains = {hold: compare(problem.segments, "both", fits[stated], fits[hold], noise_sd) for hold in fits}
    best = max(gains, key=lambda hold: gains[hold].log_likelihood)
    rules = problem.rules
    sure = gains[best].log_likelihood > rules.pooled_log_likelihood and gains[best].p_value < rules.significance
    chosen = best if sure else stated
    for each in (problem, *others):
        model.hold_as(each.segments, chosen)
    if chosen == stated or not model.hold_stated:
        return []
    says = f"Between its samples column {column} {WORDS[chosen]}; the nominal model says that it {WORDS[stated]}. "
    says += f'The diagnosis continues with this (axis.hold = "{chosen}").'
    return [Finding("hold", column, says)]
