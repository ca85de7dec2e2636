"""What a name needs to stand: weight beside others, events enough, and readings in steps told by their saw tooth."""

from __future__ import annotations

import numpy as np
import pytest

from host.diagnosis.effect import Candidate, Port, library
from host.diagnosis.effects.quantization import stepped
from host.diagnosis.equivalence import Standing, scanty
from host.diagnosis.evidence import Gain
from host.diagnosis.fit import Fit
from host.diagnosis.trial import Trial, weighty

BACKLASH = Candidate(next(e for e in library() if e.id == "backlash"), Port("cable", "motion", "cable", ("angle",)))
NOTHING = Gain(0.0, 1.0, 0.0)


def standing(held_p: float, both_p: float, likelihood: float = 50.0) -> Standing:
    return Standing(BACKLASH, Gain(likelihood, held_p, 0.2), Gain(2.0 * likelihood, both_p, 0.2), ())


def trial(likelihood: float, share: float) -> Trial:
    return Trial(BACKLASH, Fit((), np.zeros(0)), NOTHING, NOTHING, Gain(likelihood, 1e-9, share), likelihood)


@pytest.mark.parametrize(("held", "both", "doubted"), [(1e-4, 1e-3, False), (0.03, 1e-4, True), (0.03, 1e-9, False)])
def test_a_name_that_rests_on_few_events_is_doubted(held: float, both: float, doubted: bool) -> None:
    assert scanty([standing(held, both)]) is doubted


def test_the_strongest_effect_decides_whether_a_name_is_doubted() -> None:
    assert not scanty([standing(0.3, 0.01, 10.0), standing(1e-6, 1e-9, 80.0)])
    assert not scanty([])


@pytest.mark.parametrize(
    ("likelihood", "share", "place", "enough"),
    [
        (50.0, 0.2, "cable", False),  # less than an eighth of what is named there
        (200.0, 0.2, "cable", True),
        (50.0, 0.2, "elsewhere", False),  # and than a sixteenth of all
        (70.0, 0.2, "elsewhere", True),
        (200.0, 0.03, "cable", False),  # hardly anything of any output
        (50.0, 0.4, "cable", True),  # a third of what an output has left
    ],
)
def test_a_further_effect_outdoes_what_modules_lack(likelihood: float, share: float, place: str, enough: bool) -> None:
    assert weighty(trial(likelihood, share), {place: 1000.0}) is enough
    assert weighty(trial(likelihood, share), {})


def test_steps_by_their_saw_tooth() -> None:
    x = np.linspace(-0.02, 0.03, 5000)
    step = 1.7e-3
    assert np.corrcoef(stepped(x, step) - x, step * np.round(x / step) - x)[0, 1] > 0.92
