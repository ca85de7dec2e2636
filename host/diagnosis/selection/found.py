"""What a search has found: its fits, and the moves that led there."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

from host.diagnosis.estimation.evidence import Gain
from host.diagnosis.estimation.fit import Fit
from host.diagnosis.selection.trial import Trial
from host.diagnosis.symbolic.dictionary import Form


class SearchMove(Enum):
    """What one step of the search did with the effect of its key."""

    FORWARD = "it entered"
    UPGRADE = "it entered in the place of a simpler form"
    JOINT = "it entered together with another one"
    SWAP = "it took the place of another one"
    REDUCE = "it took the place of a more general form"
    ROUND = "it took the place of the same law with a corner"
    EQUATION = "an equation entered"
    EXCHANGE = "it stayed: no other one does better in its place"
    REFIT = "the model before it was fitted again from the nominal parameters found with it"
    STOP = "no effect earned its place"
    BACKWARD = "removed again"
    UNSURE = "removed: its interval contains zero or all values"
    IMPROBABLE = "removed: it is improbable next to the others"

    @property
    def removes(self) -> bool:
        """Whether the effect left the model."""
        return self in (SearchMove.BACKWARD, SearchMove.UNSURE, SearchMove.IMPROBABLE)


@dataclass
class Step:
    """One step of the search, for the report."""

    move: SearchMove
    key: str
    gain: Gain | None = None  # none where no gain decided
    trials: list[Trial] = field(default_factory=list)


@dataclass
class Found:
    """Nominal fit, best fit, the moves between, trials fitted with the best structure, and its equations."""

    nominal: Fit
    best: Fit
    steps: list[Step]
    forms: list[Form] = field(default_factory=list)
    pairs: list[Fit] = field(default_factory=list)  # of two effects each, that do as well as the first one named
    alike: list[Fit] = field(default_factory=list)  # the best with a law without its corner, which is as likely

    @property
    def last_trials(self) -> list[Trial]:
        """Trials of the last step that had any."""
        return next((step.trials for step in reversed(self.steps) if step.trials), [])
