"""`seldinger reproduce mechanics`: chapters 2 to 5 in the thesis' order, one page."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from host.report.figure_page import Section, write_reproduction
from host.studies.reproduction import planar, spatial, spatial_experiments, spatial_force

PAGE = "reproduction-mechanics.html"
NOT_WHEN_QUICK = (planar.figure_2_5, planar.figure_4_8)  # they identify the planar arcs first, most of a minute
LEAD = (
    "Chapters 2 to 5 of the thesis, reproduced: planar arcs, the spatial rod, and the force estimated from poses "
    "of each. The thesis' own "
    "schemes run together with ours, with its errata applied. Where its recordings would be needed a finer, independent "
    "catheter stands in, and "
    "the caption says so. A statement that does not come out is marked as not holding."
)
SHORTER = " This is the quick form: coarser grids, and no sections that identify the planar arcs (Figs. 2.5, 4.8)."


def sections_of(quick: bool) -> Iterator[tuple[str, Callable[[], Section]]]:
    """Name and maker of every section, chapters 2, 3, 4, 5."""
    flat = [make for make in planar.SECTIONS if not (quick and make in NOT_WHEN_QUICK)]
    second = [make for make in flat if make.__name__.startswith("figure_2")]
    for make in second:
        yield make.__name__, make
    for longer in spatial.SECTIONS:
        yield longer.__name__, partial(longer, quick)
    for make in flat:
        if make not in second:
            yield make.__name__, make
    for longer in (*spatial_force.SECTIONS, *spatial_experiments.SECTIONS):
        yield longer.__name__, partial(longer, quick)


def run(directory: Path, quick: bool, progress: Callable[[str], None]) -> tuple[list[Section], Path]:
    """Make every section, call `progress` with each one's name before it, write the page into `directory`.

    Result: the sections and the page's path. Raises OSError where the page cannot be written.
    """
    done = []
    for name, make in sections_of(quick):
        progress(name.replace("_", " ", 1).replace("_", "."))
        done.append(make())
    page = write_reproduction(
        directory / PAGE, "Mechanics, force and identification, made again", LEAD + SHORTER * quick, done
    )
    return done, page
