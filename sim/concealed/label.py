"""The sealed truth about one concealed case, the same for every generator: what was planted and how large it came out."""

from __future__ import annotations

from typing import Any, NotRequired, TypedDict


class PlantedTruth(TypedDict):
    """One planted effect: parameters in the generator's words, and those that a verdict can be compared with."""

    id: str
    port: str
    size: float
    start_s: float  # moment of the session from which it acts
    parameters: dict[str, float]
    compared: list[str]  # parameters whose meaning does not depend on the formula
    equivalent: dict[str, float]  # values in the words of docs/diagnosis.md where those differ
    gain: float  # of the link that the effect acts on; 1 where there is none


class Label(TypedDict):
    """The truth about one case, as labels.json keeps it."""

    id: str
    category: str  # null, single, pair, outside, unidentifiable
    puzzle: str  # why an unidentifiable case is one
    kind: str  # of the nominal model, or the world's mechanism
    closed_loop: bool
    truth: list[str]  # effect@subsystem
    names: list[list[str]]  # ids that say the truth, for every planted effect
    set: list[str]  # ids that the recordings leave open, for unidentifiable cases
    form: str  # equation of an effect outside the vocabulary; empty where only the flag counts
    says: list[str]
    rho: float  # RMS of the mismatch over the noise, on the channel that shows it most
    rho_wanted: float
    planted: list[PlantedTruth]
    windows_s: list[list[float]]  # empty where a world does not score windows
    channels: list[str]  # that show at least half of the largest mismatch, largest first
    mismatch_rms_heldout: dict[str, float]
    noise_rms_heldout: dict[str, float]
    plan: dict[str, Any]  # what rebuilds the case
    findings: NotRequired[list[str]]  # ids of mistakes in the data that a verdict must state, in the world `domains`
