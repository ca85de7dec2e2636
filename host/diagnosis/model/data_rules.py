"""Thresholds of the checks of the data before any fit, each under its statistical name, with its reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class DataRules:
    """Numbers that recordings are compared with before any physics is. Shares: of samples, unless said otherwise."""

    # Rows, gaps and stamps.
    least_rows: int = 50  # of a recording
    gap_samples: int = 10  # missing in a row in every channel, beyond which an input cannot be bridged by a line
    missing_share: float = 0.3  # of a channel, from which missing samples are a finding
    constant_span: float = 1e-9  # span over size below which a channel is constant
    uneven_period_share: float = 0.2  # largest deviation of a period from the median one that counts as even
    sampling_period_ratio: float = 1.05  # of recordings, from which they are sampled at different rates
    slow_period_s: float = 1.0  # sampling period from which the time column may not be in seconds,
    slow_period_ratio: float = 1.0  # and of a plant's slowest stated time constant to it, below which it probably is not

    # Samples that stand alone, and codes for a lost reading.
    outlier_noise_deviations: float = 12.0  # from the median of the neighbours,
    outlier_local_spreads: float = 8.0  # and deviations of these, from which a sample stands alone,
    outlier_resolution_steps: float = 2.5  # and steps of the resolution
    outlier_expected_triples: float = 0.01  # of outliers that fall together by chance, from which three of seven may be
    outlier_fewest_samples: int = 50  # measured ones of a channel
    spike_error_share: float = 0.3  # of what a law leaves about a spike of an input, below which it holds without the spike:
    # an answer that is late by some samples leaves half
    motion_over_noise: float = 5.0  # of the other samples, from which a channel carries a motion and no single blows, and of
    # what it moves while another one stays at its limit
    lost_jump_ratio: float = 4.0  # of the jump to a code over the changes that nine in ten do not exceed
    lost_code_returns: int = 3  # to the same value, from which that is a code for a lost reading
    lost_code_samples: int = 50  # in a row of such a code, at most

    # Resolution, and readings that are repeated.
    resolution_steps: float = 1000.0  # in the range of a channel, below which its resolution is stated
    switched_levels: int = 20  # up to which a channel may be a switched signal
    repeated_fewest_readings: int = 20  # of a channel that repeats them, below which nothing is stated
    repeated_regular_share: float = 0.9  # of its readings that last equally long, from which it repeats them
    repeated_fine_steps: float = 4.0  # smallest changes in the usual one; with less, a coarse reading stays the same

    # Frozen channels: one value again and again while another channel moves on.
    frozen_samples: int = 20  # of one value in a row, from which a channel that repeats hardly any may be frozen
    frozen_repeats: float = 0.05  # of its other samples that repeat the one before, up to which it repeats hardly any
    frozen_share: float = 0.8  # of a recording in such runs, up to which the other samples show how the channel is read
    frozen_noise: float = 1e-5  # over size, above which noise is more than rounding to six digits or to single precision
    frozen_alternation: float = 0.65  # of high differences that change sign: 0.81 do for white noise, few for a motion
    frozen_jump_ratio: float = 3.0  # of the change at an end of a run to those that nine in ten samples do not exceed
    frozen_stop_ratio: float = 0.5  # of the speed next to a run to the usual one, from which a motion stops at once
    frozen_driver_share: float = 0.1  # of its span by which another channel moves on
    frozen_error_ratio: float = 4.0  # of the nominal residual in a run to that elsewhere, without the run (RMS)
    frozen_unexplained: float = 0.03  # of an output's variance that this residual is at least: motion that goes on as driven

    # Copies: a channel that was computed from another one.
    copy_residual: float = 1e-7  # over span, below which a channel is a copy of another
    copy_noise: float = 1e-6  # noise over span, from which two channels cannot be alike by chance

    # Sign and unit of a pair of channels.
    opposite_correlation: float = -0.7  # with what the model says, below which the sign is opposite
    gain_correlation: float = 0.95  # of two channels, from which the gain between them is compared with the nominal one
    unit_factor_default: float = 0.02  # logarithm within which a gain is a factor of units, where the nominal is a default,
    unit_factor_stated: float = 0.4  # and where the nominal model gives parameters: those are not exact
    inverse_gain_distance: float = 5.0  # of a gain's square from one, over the first of these, to know it from its inverse
    law_fewest_samples: int = 100  # of a recording in which an equation of motion is looked at
    law_explained: float = 0.5  # share of the force's variance from which a law says something of signs and units
    law_term_share: float = 0.2  # of the largest term, from which a coefficient is compared with its value

    # Exchanged columns.
    exchanged_explained: float = 0.9  # share of the variance that a regression has to explain if they are,
    exchanged_unexplained_ratio: float = 0.1  # largest ratio of what it leaves unexplained to what the labelled order does,
    exchanged_least_unexplained: float = 3e-4  # share that this leaves at least: in a closed loop either leaves only noise
    passive_agreement: float = 0.95  # of the signs of all terms, weighted by their size, below which a law is not passive
    as_stated_factor: float = 3.0  # within which a coefficient is the stated one,
    not_as_stated_factor: float = 30.0  # and beyond which it is another

    # Clocks: an output that comes before its input.
    clock_lead_samples: int = 2  # by which it may not
    clock_residual_ratio: float = 0.5  # of the variance or RMS that is left with a shift to that without or a later one
    clock_over_noise: float = 1.5  # times the noise, up to which a law or model with a shift leaves nothing but noise

    # Limits of a reading, and excitation.
    clipped_share: float = 0.01  # at the largest reading, from which it is a limit
    clipped_run_samples: int = 5  # in a row at the limit
    clipped_overrun: float = 0.01  # share of the input's span by which it moves on
    level_samples: int = 3  # of one value in a row, from which an input is held at a level
    samples_between_levels: float = 1.0  # on average, up to which an input jumps: a resampled step may have one in between
    tone_power_share: float = 0.995  # of an input's power in one spectral line, from which it is one sinusoid
    tone_frequency_ratio: float = 1.1  # of the sinusoids of all recordings, below which they are one frequency
    reversal_share: float = 0.05  # of its span by which an input goes back that reverses

    # Lines in the spectrum of a residual.
    line_significance: float = 1e-4  # over all bins of all recordings
    line_variance_share: float = 0.05  # of the residual's variance that is in the line
    line_gain: float = 10.0  # at a line over that elsewhere, of a filter between another signal and the residual
    line_origin_share: float = 0.1  # of its share of the residual that a line has of the signal whose distortion made it
    line_answer_spread: float = 0.4  # of the answers of one law to a line, between recordings, over their mean
