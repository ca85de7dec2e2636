"""The control part of the thesis again: chapters 6 and 7, one section a figure."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from host.report.figure_page import HOLDS, Section, write_reproduction
from host.studies.reproduction import control_hybrid, control_kinematics, control_position, control_rig, control_transmission


def run(
    directory: Path, quick: bool = False, progress: Callable[[str], None] = lambda text: None, board: str = "native"
) -> tuple[list[Section], Path]:
    """All sections, and the page's path in `directory`. `quick`: shorter sweeps and runs. `board`: what runs the firmware.

    Raises BoardUnavailable where the board cannot be built.
    """
    directory.mkdir(parents=True, exist_ok=True)
    sections, _ = control_transmission.sections(directory, quick, board)
    progress("chapter 6: transmission done")
    sections += control_position.sections(quick)
    progress("chapter 6: position control done")
    sections += control_kinematics.sections()
    sections += control_hybrid.sections(quick)
    progress("chapter 7: simulations done")
    sections += control_rig.sections(quick, board, progress)
    held = sum(section.verdict == HOLDS for section in sections)
    lead = (
        "Chapters 6 and 7. The experiments run on the simulated rig, its firmware and protocols included. The simulations "
        "(Figs. 7.9 to 7.17) are those of the thesis: its rod against a spring, the contact force by Newton's method, and "
        "polynomials as the controller's inverse kinematics. The rod is solved by a faster method than Algorithm 3.1; Fig. "
        "7.3 compares the two. Circular arcs as the plant stand next to the rod. Where the thesis leaves a number or the "
        "form of the law out, each admissible setting is tried. The verdict then says where the statement holds."
    )
    page = write_reproduction(
        directory / "reproduction-control.html", f"Control: {held} of {len(sections)} statements hold", lead, sections
    )
    return sections, page
