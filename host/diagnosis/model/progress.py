"""Progress of a diagnosis as one share that never falls, with the number of the step."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str, float], None]
KEPT = 0.8  # share of the remaining part that one more step leaves: how many there will be is not known beforehand


class Overall:
    """Turns the shares of single steps into one of the whole. `part` gives the function that a part of the work calls."""

    def __init__(self, report: Progress) -> None:
        self._report = report
        self._share = 0.0
        self.steps = 0

    def part(self, low: float, high: float) -> Progress:
        """Return a function for the part of the work between the shares `low` and `high`.

        A step that begins again (its share falls) is the next one. A search has as many steps as it finds effects, so
        each covers a fixed part of what remains between `low` and `high`.
        """
        done, last = 0, 2.0

        def report(what: str, share: float) -> None:
            nonlocal done, last
            if share < last or share == 0.0:
                done += last <= 1.0
                self.steps += 1
            last = share
            within = 1.0 - KEPT ** (done + min(max(share, 0.0), 1.0))
            self._share = max(self._share, low + (high - low) * within)
            self._report(f"step {self.steps}: {what}", self._share)

        return report

    def end(self) -> None:
        """Report that the whole job is done."""
        self._report(f"step {self.steps}: done", 1.0)
