"""Numbers that the thesis leaves out: its statement is tried at every admissible setting, and the map is reported.

A statement that holds at some settings is a statement about those. The verdict is then that it holds, and the verdict's
line says where; one setting chosen by us would decide it in either direction.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple


class Tried(NamedTuple):
    """One setting, what came out there, and whether the statement holds there."""

    setting: str
    found: str
    holds: bool


class Admissible:
    """The settings that were tried, in the order of the scan."""

    def __init__(self, tried: Iterable[Tried]) -> None:
        self.tried = tuple(tried)

    @property
    def holds(self) -> bool:
        """Whether the statement holds at one of the settings at least."""
        return any(one.holds for one in self.tried)

    @property
    def where(self) -> str:
        """Say at how many settings it holds, and at which."""
        good = [one.setting for one in self.tried if one.holds]
        if not good:
            return f"at none of {len(self.tried)} admissible settings"
        if len(good) == len(self.tried):
            return f"at all {len(good)} admissible settings"
        return f"at {len(good)} of {len(self.tried)} admissible settings: {'; '.join(good)}"

    def rows(self, heading: tuple[str, str] = ("setting", "found")) -> tuple[tuple[str, ...], ...]:
        """Return the map as the rows of a table, a row for each setting."""
        return (*((*heading, "holds"),), *((one.setting, one.found, "yes" if one.holds else "no") for one in self.tried))
