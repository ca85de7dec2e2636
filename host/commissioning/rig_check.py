"""Check that the catheter that a rig file names exists and has the length that the file states."""

from __future__ import annotations

from protocol.catheter import load_catheter
from protocol.rig_file import Rig

# Measured and tabulated lengths of a distal shaft differ by less than this (m).
DISTAL_TOLERANCE_M = 0.005


def catheter_problems(rig: Rig) -> list[str]:
    """Return a line where the named catheter is unknown, or its length is not the one in the rig file."""
    try:
        catheter = load_catheter(rig.catheter.name)
    except (ValueError, OSError) as error:
        return [f"catheter.name: found {rig.catheter.name!r}, wanted a catheter that ships or its file ({error})"]
    length_m = catheter.distal_length_m
    if abs(length_m - rig.catheter.distal_length_m) > DISTAL_TOLERANCE_M:
        return [
            f"catheter.distal_length_m: found {rig.catheter.distal_length_m}, wanted about {length_m}, which "
            f"{rig.catheter.name} has"
        ]
    return []
