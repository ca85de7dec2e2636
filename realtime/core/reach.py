"""Where the tip can go: inside the workspace, and where the unloaded catheter reaches within the stages' travel."""

from __future__ import annotations

import numpy as np

from protocol.messages import Vector
from protocol.rig_file import Rig
from protocol.unit_slips import hint
from realtime.control import inverse_kinematics
from realtime.control.configure import tick_parameters

# A target may be out of reach by no more than this: the calibration is not better known.
REACH_m = 0.001


class TargetReach:
    """Judges targets of the tip for one rig."""

    def __init__(self, rig: Rig) -> None:
        self._rig, self._kinematics = rig, tick_parameters(rig)[0].kinematics

    def problem(self, target_m: Vector) -> str:
        """Return the reason why the tip cannot go to `target_m` (3,), base frame, as one sentence; empty if it can."""
        low, high = self._rig.safety.workspace_min_m, self._rig.safety.workspace_max_m
        for axis, value, least, most in zip("xyz", target_m, low, high, strict=True):
            if not least <= value <= most:
                slip = hint(("target_m",), value, lambda number, low_m=least, high_m=most: low_m <= number <= high_m)  # type: ignore[misc]
                return f"target_m: found {axis} = {value}, wanted {least} to {most} (safety.workspace){slip}"
        insertion, transmission = self._rig.stages.insertion, self._rig.transmission
        # Half the backlash on either side: the body may stand anywhere in it.
        half_m = 0.5 * transmission.insertion_backlash_m
        least_m, most_m = (
            transmission.insertion_at_home_m + transmission.insertion_slope * unit + side * half_m
            for unit, side in ((insertion.min_unit, -1.0), (insertion.max_unit, 1.0))
        )
        off_m = inverse_kinematics.out_of_reach_m(
            self._kinematics, np.asarray(target_m, float), least_m, most_m, self._rig.stages.knob.max_unit
        )
        if not off_m <= REACH_m:
            return (
                f"target_m: found {tuple(target_m)}, wanted a point that the unloaded tip can reach: "
                f"it comes no nearer than {off_m * 1e3:.1f} mm"
            )
        return ""
