"""Every threshold that decides what a diagnosis names, under its statistical name, with its reason: one home."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, field


@dataclass(frozen=True)
class SelectionRules:
    """Thresholds of selection. Log-likelihoods: natural logarithms, of independent samples only. Shares: of a variance.

    An effect enters (forward selection) by its gain on held-out samples, by its gain on all samples where the held-out
    ones hardly call for it, or by an overwhelming gain in few episodes; it leaves (backward elimination) and is replaced
    (exchange) by the same measure.
    """

    # What a parameter costs: Akaike's one for the samples it was fitted to, one more for those held out.
    parameter_penalty: float = 2.0

    # Forward selection.
    heldout_log_likelihood: float = 6.0  # least gain on held-out samples: odds of 400
    significance: float = 0.01  # p-value over held-out blocks
    pooled_log_likelihood: float = 11.0  # or: least gain on all samples where held-out ones show it dimly,
    weak_significance: float = 0.12  # with at most this p-value
    weak_log_likelihood: float = 1.8  # and at least this gain there
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
    reduced_form_tolerance: float = 0.1  # and where the richer form's further parameters ended at zero

    # Search effort: how many candidates are fitted, never how long.
    screening_log_likelihood: float = 3.0  # projected gain from which a candidate is fitted
    least_fits: int = 4  # candidates that are fitted for any promise, while the residual is above noise
    fits_per_step: int = 10
    fits_per_port: int = 6  # different effects
    first_iterations: int = 5  # of a fit from each start
    further_iterations: int = 9  # from the best of these on
    most_effects: int = 5
    most_steps: int = 10
    alternative_starts: int = 2  # second-best first effects from which selection is repeated
    alternative_start_score: float = 0.6  # least part of the best one's score
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
    crossed_fits: int = 4  # best candidates that are cross-validated where the recordings held out show nothing of them
    split_fits: int = 6  # pairs that are fitted in the place of one effect that joins two kinds
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
    simulated_over_noise: float = 4.0  # of a model with effects: the shape of friction at rest is an approximation
    ran_away_over_noise: float = 2000.0  # nominal residual above which no effect is tried; friction leaves 20 to 1500,
    # and noise of the recorded force 700 to 300000 (worlds `ode` and `mujoco`)
    partial_share: float = 0.15  # share of the mismatch that one effect may leave; several leave less
    partial_effects: int = 2  # effects that are named where they leave more
    predictable_log_likelihood: float = 8.0  # gain of simple forms from which a residual counts as structure
    predictable_error_reduction: float = 0.02
    predictable_significance: float = 0.2
    form_length_penalty: float = 0.03  # part of its gain a form may lack for each symbol that it is shorter
    equation_fits: int = 3
    equation_log_likelihood: float = 15.0  # gain that makes an equation a finding
    equation_significance: float = 0.1
    equation_known_ratio: float = 0.7  # gain of a refused known effect over the equation's, above which none is named
    equation_residual_share: float = 0.5  # an equation that leaves more of the mismatch is not a finding

    # Posterior over what was fitted (Miller & Dunson 2019, coarsened likelihood: formulas are not exact).
    coarsening: float = 60.0  # independent samples beyond which more data say nothing more of an idealized formula
    prior_none: float = 0.05  # of physics that no candidate has
    prior_equal: float = 0.12  # of all rivals together that are indistinguishable, at least: formulas are idealized
    exact_share: float = 0.06  # share of the mismatch that an idealized formula leaves where it is the right one
    coarsening_none: float = 8.0  # independent samples for the comparison with physics that would leave no more than that
    # Beta calibration (Kull et al. 2017): log-odds of a log p - b log(1 - p) + c, of effects that are named, of "none of
    # these" where one is named, and of the same where nothing is named. An equation that is named has the curve of effects.
    # Fitted on 120 cases of seeds 272013 and 305771 (four worlds), leaving one world out at a time; these are the means (of
    # absent_b without the fit that leaves out `own`, 3.35). Range over the worlds left out: effects a 0.14 to 0.26, b 0.77
    # to 0.90, c -0.12 to 0.36; none a 0.56 to 1.70, b 0.12 to 0.16, c -2.65 to -1.47; absent a 0.43 to 1.23, c 0.06 to 1.75.
    effect_a: float = 0.21
    effect_b: float = 0.81
    effect_c: float = 0.08
    none_a: float = 0.6
    none_b: float = 0.13
    none_c: float = -1.8
    absent_a: float = 0.84
    absent_b: float = 0.11
    absent_c: float = 1.7
    confident: float = 0.9  # probability from which a verdict counts as confident
    further_probability: float = (
        0.5  # that an effect next to a likelier one needs: below, leaving it out is right more often
    )

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
        """Rules by name, as a verdict prints them."""
        return asdict(self)


RULES = SelectionRules()


@dataclass(frozen=True)
class Budget:
    """Time (s) that the user gives a search, or None: nothing but an explicit budget lets a clock end a search."""

    seconds: float | None = None
    began: float = field(default_factory=time.monotonic)

    def spent(self) -> bool:
        """Whether the time is up: what is begun is brought to its end, nothing further is tried."""
        return self.seconds is not None and time.monotonic() - self.began > self.seconds
