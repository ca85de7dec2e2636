"""The thresholds that decide what a diagnosis states, under their statistical names, with their reasons: one home.

A rule is a number that the data are compared with: it changes what is named, refused or stated. Numerics (step sizes,
iteration limits, lengths of filters, start values, limits of memory, sizes of a format) stay next to the code that uses
them.

Thresholds of the checks of the data before any fit are in `DataRules`, the field `data`. Numbers of a single effect or
nominal model stay in its file; a model that estimates noise to prepare a recording uses the defaults.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

from host.diagnosis.model.data_rules import DataRules


@dataclass(frozen=True)
class SelectionRules:
    """Thresholds of estimation and selection, and `data`, those of the checks of the data before any fit.

    Log-likelihoods: natural logarithms, of independent samples only. Shares: of a variance.

    An effect enters (forward selection) by its gain on held-out samples, by its gain on all samples where the held-out
    ones hardly call for it, or by an overwhelming gain in few episodes; it leaves (backward elimination) and is replaced
    (exchange) by the same measure.
    """

    data: DataRules = field(default_factory=DataRules)

    # Noise: samples at rest, else what does not repeat, else the spectrum.
    rest_range_share: float = 0.002  # share of its range by which an input that rests may move,
    rest_resolution_steps: float = 2.1  # or steps of its resolution
    rest_shortest_samples: int = 30  # of a stretch at rest that counts
    rest_fewest_samples: int = 100  # of all such stretches together; with fewer, the noise is that of repeats
    rest_independent_samples: float = 10.0  # of a stretch, below which slow noise has a higher level than at rest
    settling_variance_ratio: float = 3.0  # first halves' variance over that of the second ones, from which an output settles
    under_way_correlation: float = 0.8  # of neighbours, from which a slow plant is on its way while its input rests,
    under_way_over_noise: float = 3.0  # and its ratio to the noise that the spectrum suggests
    input_repeat_deviation: float = 2e-3  # deviation of two inputs over their own, below which one repeats the other
    input_period_correlation: float = 0.8  # of a channel with itself, from which a period is looked for
    input_repeat_samples: int = 200  # of a stretch that repeats another, at least
    held_reading_share: float = 0.05  # of third differences that are zero, from which readings repeat: no median of them
    quietest_share: float = 0.05  # part of the spectrum that is taken for noise where nothing rests

    # Noise that a controller feeds back into its input.
    noise_passed_share: float = 0.5  # of the residual's variance that is noise of measured inputs, above which effects that
    # could cancel it are not tried; elsewhere they have to remove
    noise_passed_margin: float = 1.5  # so many times that share, which is estimated
    feedback_share: float = 0.05  # of the residual's variance that later input has to predict, beyond chance,
    feedback_over_past: float = 2.0  # and over what earlier input predicts: that is a wrong model
    feedback_innovation_share: float = 0.01  # of its innovations' variance that earlier input may predict, if it is coloured
    feedback_over_remainder: float = 2.0  # least ratio of the coefficients on the new part of the input and on the other
    feedback_predicted_share: float = 0.5  # of the new input by the motion so far; of the residual by the new input
    new_input_deviations: float = 5.0  # robust, up to which new input may be noise; more is a step of the set-point

    # Coloured noise: whether a residual has a structure.
    coloured_significance: float = 1e-3  # of each test, over all its bins, samples and features
    slow_noise_samples: float = 30.0  # independent, of all recordings; with fewer, these are compared with each other too
    slow_structure_significance: float = 0.01  # share of simulated noises that may look as much like a structure

    # Jumps of a residual's level.
    jump_deviations: float = 8.0  # robust standard deviations, from which a difference of medians is more than noise
    jump_abrupt_share: float = 0.6  # of a jump that happens within few samples: a ramp has a seventh there
    jumps_per_recording: int = 5  # at most: a sensor is not moved more often, so more of them have another cause

    # Evidence: gain of one model over another.
    evidence_independent_samples: float = 3.0  # of an output, below which it says nothing
    evidence_blocks: int = 6  # below which blocks are not tested against each other,
    few_blocks_p_value: float = 0.04  # and p-value that a gain then has
    excess_noise_ratio: float = 1.5  # variance over that of the noise up to which a model leaves no more than noise

    # Intervals of parameters.
    scatter_probability: float = 0.95  # chance below which scatter between recordings stays, if formulas are true
    undetermined_ratio: float = 10.0  # of an interval's ends, from which a positive parameter counts as not determined
    undetermined_change: float = 0.1  # part of the largest contribution that half an interval of a signed one may move
    nominal_bound_share: float = 0.01  # relative distance from a bound at which a nominal parameter ended there

    # Readings of a simulator against what it simulates.
    simulator_unit_correlation: float = 0.95  # from which a factor between the two is one of units, or columns are exchanged
    simulator_own_correlation: float = 0.5  # of exchanged columns with what is simulated of themselves, at most
    simulator_match_correlation: float = 0.9  # from which an output is as simulated, where the gain is near one as well
    simulator_unexplained_ratio: float = 0.1  # of what is unexplained, that a mistake put right leaves at most
    simulator_start_correlation: float = 0.8  # below which a simulator of one output is started in other units
    simulator_largest_response: float = 30.0  # of the measured motion, to first order, that an input put right may cause

    # Samples that stand alone in the residual at a jump of an input.
    input_jump_share: float = 0.6  # of what a signal moves there that one step makes: a smooth turning point has 0.56
    input_jump_over_output: float = 2.0  # residual over what the output moves there: errors of timing or gain leave one

    # What a parameter costs: Akaike's one for the samples it was fitted to, one more for those held out.
    parameter_penalty: float = 2.0  # of a gain on the samples that were fitted, or on all
    heldout_parameter_cost: float = 1.0  # of a gain on held-out samples, on which no parameter was fitted

    # Forward selection.
    heldout_log_likelihood: float = 6.0  # least gain on held-out samples: odds of 400
    significance: float = 0.01  # p-value over held-out blocks
    pooled_log_likelihood: float = 11.0  # or: least gain on all samples where held-out ones show it dimly,
    weak_significance: float = 0.12  # with at most this p-value
    weak_log_likelihood: float = 1.8  # and at least this gain there,
    pooled_significance: float = 0.001  # and at most this p-value on all samples
    decisive_log_likelihood: float = 25.0  # or: gain that needs no agreement of blocks, since few episodes may hold it
    least_error_reduction: float = 0.015  # share of some output's held-out error that has to go: idealization takes less
    least_excess_reduction: float = 0.10  # and share of what is above noise
    least_amount: float = 0.01  # of the least amount tried first: an effect of less is its initial state alone
    further_error_reduction: float = 0.05  # of a further effect: a residual of idealized formulas is not an effect
    further_likelihood_ratio: float = 0.2  # and least gain over that of the effects before it,
    large_error_reduction: float = 0.3  # but for one that takes this share of the residual, in either part,
    large_log_likelihood: float = 25.0  # and gains so much in either: its own evidence is enough
    refinement_error_reduction: float = 0.15  # a finer form has to take this share to be preferred to a simpler one
    refinement_tolerance: float = 0.02  # part of the gain that a simpler form may lack,
    refinement_score_share: float = 0.3  # part of its score beyond which a finer form need not gain
    reduced_form_tolerance: float = 0.1  # and where the richer form's further parameters ended at zero
    same_equation_log_likelihood: float = 0.01  # trials that differ by less, with as many parameters, are one equation
    sampling_delay: float = 1.05  # samples: a delay up to this may be a matter of how the input was recorded,
    integrator_delay: float = 0.25  # one up to this of the simulation's steps (two in a sample, input held in each),
    sampling_delay_margin: float = 0.1  # and one this near to a half or to a whole sample, since formulas are idealized,
    sampling_delay_deviations: float = 3.0  # or within so many of its standard deviations
    removal_tolerance: float = 0.5  # part of the least error reductions with which an effect stays (backward elimination)

    # Search effort: how many candidates are fitted, never how long.
    screening_log_likelihood: float = 3.0  # projected gain from which a candidate is fitted
    least_fits: int = 4  # candidates that are fitted for any promise, while the residual is above noise
    fits_per_step: int = 10
    fits_per_port: int = 6  # different effects
    fits_per_effect: int = 3  # its forms and places
    first_iterations: int = 5  # of a fit from each start
    further_iterations: int = 9  # from the best of these on
    most_effects: int = 5
    most_steps: int = 10
    alternative_starts: int = 2  # second-best first effects from which selection is repeated
    alternative_start_score: float = 0.6  # least part of the best one's score
    held_values_tried: int = 2  # that are fitted for each place among those to fit
    first_pairs: int = 8  # pairs of the first step's effects on a loaded link from which the best is taken to begin again
    exchange_rounds: int = 2
    exchange_fits: int = 4  # rivals fitted in each place
    exchange_promise: float = 0.4  # least part of the best projected gain
    swap_fits: int = 3
    most_refits: int = 2  # times that a step is judged again because a trial led to a better minimum without it
    simpler_fits: int = 3  # simpler shapes of the best candidate that are fitted after it
    wider_fits: int = 4  # other forms that are fitted where one that the data call for ended at a bound
    joint_first: int = 2  # of them, of unlike families, past which further effects are looked for,
    joint_second: int = 3  # and how many of these are fitted
    astray_ratio: float = 1.5  # error of the forces by the parameters of a simulated motion, over that by their own, from
    # which a fit starts from the latter
    nominal_restarts: int = 3  # starts of the nominal parameters kept for an effect that hides them
    crossed_folds: int = 4  # groups of recordings that are predicted from the others, at most
    crossed_fits: int = 4  # best candidates that are cross-validated where the recordings held out show nothing of them
    split_fits: int = 6  # pairs that are fitted in the place of one effect that joins two kinds
    joint_over_noise: float = 1.3  # residual over noise from which pairs are tried: slow noise raises it so far
    joint_singles: int = 5  # refused effects of which pairs are fitted, where none passes alone

    # Indistinguishable: rivals in an effect's place.
    most_equals: int = 4
    equals_fits: int = 8
    equals_score: float = 0.5  # least part of the winner's score when it was tried first
    equal_log_likelihood: float = 4.0  # difference below which two models are equal,
    equal_significance: float = 0.01  # or p-value above which
    equal_error: float = 0.1  # or difference of errors below which, since formulas are idealized,
    equal_mismatch: float = 0.05  # or part of the mismatch
    equal_likelihood_ratio: float = 0.25  # while the difference is below this part of the effect's own gain

    # None of these: what known effects leave.
    noise_uncertainty: float = 1.15  # factor within which a measured noise level is known
    residual_over_noise: float = 2.0  # residual beyond which an extended model is not adequate,
    residual_over_noise_nominal: float = 3.0  # a nominal one,
    residual_over_guessed_noise: float = 8.0  # where noise was never seen alone
    # A free mass is compared by its simulated motion where that agrees down to the noise of single readings.
    simulated_over_noise_nominal: float = 1.2  # residual of a nominal model over white noise, which is known to some 5 %,
    simulated_whiteness: float = 1e-3  # and least p-value of the test that it is white
    simulated_over_rounding: float = 1.15  # residual over that of rounding: not white while a motion is slow
    simulated_over_noise: float = 4.0  # of a model with effects: the shape of friction at rest is an approximation
    ran_away_over_noise: float = 2000.0  # nominal residual above which no effect is tried; friction leaves 20 to 1500,
    # and noise of the recorded force 700 to 300000 (worlds `ode` and `mujoco`)
    partial_share: float = 0.15  # share of the mismatch that one effect may leave; several leave less
    partial_effects: int = 2  # effects that are named where they leave more
    predictable_log_likelihood: float = 8.0  # gain of simple forms from which a residual counts as structure
    predictable_error_reduction: float = 0.02
    predictable_significance: float = 0.2
    forms_joined: int = 2  # simple forms that predict a residual together
    forms_refitted: int = 6  # best forms that are fitted again
    forms_judged: int = 3  # best forms on the samples to fit, of which those held out choose
    form_new_share: float = 1e-3  # of a form that is seen past nominal parameters and forms chosen before, at least
    form_length_penalty: float = 0.03  # part of its gain a form may lack for each symbol that it is shorter
    equation_fits: int = 3
    equation_log_likelihood: float = 15.0  # gain that makes an equation a finding
    equation_significance: float = 0.1
    equation_known_ratio: float = 0.7  # gain of a refused known effect over the equation's, above which none is named
    equation_residual_share: float = 0.5  # an equation that leaves more of the mismatch is not a finding

    # Recordings with nominal parameters of their own.
    session_residual_share: float = 0.1  # of the mismatch's power above noise that recordings may leave, each fitted alone
    session_samples_per_parameter: int = 50  # of a recording, at least

    # Location: where and when the mismatch is large, and under which condition.
    located_output_ratio: float = 3.0  # largest change over that of another output that is named with it, in units of noise
    window_output_share: float = 0.5  # of the largest change, from which an output's windows count
    window_quantile: float = 0.95  # of the moving RMS of a mismatch,
    window_level: float = 0.5  # and part of it that the RMS exceeds in a window
    window_over_noise: float = 1.3  # or its ratio to the noise, where no effect is named
    window_gap_s: float = 0.5  # between windows that are made one
    window_shortest_s: float = 0.3
    condition_excess: float = 0.1  # share of the mismatch's energy less the share of samples, at least
    condition_fewest_share: float = 0.02  # of the samples,
    condition_most_share: float = 0.7  # and at most: a condition on nearly all of them says nothing
    condition_false_discovery: float = 0.05  # rate (Benjamini and Hochberg 1995)

    # Statements of the verdict.
    white_significance: float = 1e-3  # p-value of whiteness below which the held-out residual is reported not to be noise
    worse_error_ratio: float = 1.05  # of held-out errors, from which one counts as worse
    partly_explained_share: float = 0.05  # of the mismatch that remains, from which the verdict says so
    experiment_separation: float = 3.0  # predicted, from which a proposed recording separates two models

    # Posterior over what was fitted (Miller & Dunson 2019, coarsened likelihood: formulas are not exact).
    coarsening: float = 60.0  # independent samples beyond which more data say nothing more of an idealized formula
    prior_none: float = 0.05  # of physics that no candidate has
    prior_equal: float = 0.12  # of all rivals together that are indistinguishable, at least: formulas are idealized
    exact_share: float = 0.06  # share of the mismatch that an idealized formula leaves where it is the right one
    coarsening_none: float = 8.0  # independent samples for the comparison with physics that would leave no more than that
    # Beta calibration (Kull et al. 2017): log-odds of a log p - b log(1 - p) + c, of effects that are named, of "none of
    # these" where one is named, and of the same where nothing is named. An equation that is named has the curve of effects.
    # Fitted on 525 cases of the seeds 428657 and 584613 (own, mujoco, ode), 277301 (ode) and 693147 (contact), leaving one
    # world out at a time; these are the means. Range over the worlds left out: effects a 0.15 to 0.27, b 0.39 to 0.72,
    # c 0.69 to 1.45; none a 0.21 to 0.42, b 0.10 to 0.12, c -3.06 to -2.63; absent a 0.57 to 0.90, b 0.17 to 0.80,
    # c 1.05 to 1.55.
    effect_a: float = 0.18
    effect_b: float = 0.54
    effect_c: float = 1.06
    none_a: float = 0.27
    none_b: float = 0.11
    none_c: float = -2.93
    absent_a: float = 0.75
    absent_b: float = 0.34
    absent_c: float = 1.34
    confident: float = 0.9  # probability from which a verdict counts as confident
    further_probability: float = 0.5  # of an effect next to a likelier one: below, leaving it out is right more often

    @property
    def effect_curve(self) -> tuple[float, float, float]:
        """Calibration (a, b, c) of effects."""
        return self.effect_a, self.effect_b, self.effect_c

    @property
    def none_curve(self) -> tuple[float, float, float]:
        """Calibration (a, b, c) of "none of these" where an effect is named."""
        return self.none_a, self.none_b, self.none_c

    @property
    def absent_curve(self) -> tuple[float, float, float]:
        """Calibration (a, b, c) of "none of these" where nothing is named."""
        return self.absent_a, self.absent_b, self.absent_c

    def as_dict(self) -> dict[str, float]:
        """All rules by name, those of the data too, as a verdict prints them."""
        own = asdict(self)
        of_data = own.pop("data")
        return {**own, **of_data}

    def changed(self, **values: float) -> SelectionRules:
        """The rules with other values of some; each name is that of a rule here or in `data`."""
        of_data = {rule.name for rule in fields(self.data)}
        data: dict[str, Any] = {name: value for name, value in values.items() if name in of_data}
        own: dict[str, Any] = {name: value for name, value in values.items() if name not in of_data}
        return replace(self, data=replace(self.data, **data), **own)


RULES = SelectionRules()


@dataclass(frozen=True)
class Budget:
    """Time (s) that the user gives a search, or None: nothing but an explicit budget lets a clock end a search."""

    seconds: float | None = None
    began: float = field(default_factory=time.monotonic)

    def spent(self) -> bool:
        """Whether the time is up: what is begun is brought to its end, nothing further is tried."""
        return self.seconds is not None and time.monotonic() - self.began > self.seconds
