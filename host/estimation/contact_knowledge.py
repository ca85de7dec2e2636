"""Prior uncertainty of the contact force and the stiffness."""

from __future__ import annotations

from dataclasses import dataclass

from host.estimation.interface import Actuation
from protocol.enums import Phase
from protocol.rig_file import Rig

UNKNOWN_N = 30.0  # standard deviation of a force that nothing is assumed of


@dataclass(frozen=True)
class ContactKnowledge:
    """Standard deviations of the force and of the stiffness before the poses are seen.

    Two poses hardly determine the force along the catheter while little of it is outside the sheath. There the estimate
    stays near zero, within these standard deviations, instead of showing noise of 0.5 N.
    """

    free_sd_N: float = 1.0  # of the force while no contact is commanded
    force_sd_N: float = 1.0  # while one is
    tangential_sd_N: float = 1.0  # across the commanded direction of the force
    out_of_plane_sd_N: float = 0.05  # of what the planar model does not estimate
    stiffness_sd: float = 0.0  # relative

    @classmethod
    def from_rig(cls, rig: Rig) -> ContactKnowledge:
        """Return the values of section [estimation] of the rig file."""
        known = rig.estimation
        return cls(
            free_sd_N=known.free_force_sd_N,
            force_sd_N=known.contact_force_sd_N,
            tangential_sd_N=known.tangential_force_sd_N,
            stiffness_sd=known.stiffness_sd,
        )

    def force_sd(self, actuation: Actuation) -> float:
        """Standard deviation of the force, N: whether a contact is commanded decides; a tip that is held may be pressed."""
        return self.free_sd_N if _free(actuation) else self.force_sd_N

    def learned_sd(self, actuation: Actuation) -> float:
        """Return the standard deviation (N) of the force for what is learned of lasting errors.

        A force that presses lasts. Expected to be zero in each of many poses, it would count as an error of the joints.
        """
        return self.free_sd_N if _free(actuation) else UNKNOWN_N


def _free(actuation: Actuation) -> bool:
    return actuation.force_direction is None and actuation.mode != Phase.HOLD.label
