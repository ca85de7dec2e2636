"""The rig's estimator with a stiffness that is adapted while it runs: the same model twice, with and without.

The estimate by the adapted stiffness closes the loop. The one by the stiffness of the catheter's file goes along as
`TipForce.nominal`, bit by bit what it would be without adaptation: the witnesses of the realtime process judge by it, and
take whichever is greater for too much force. An adaptation that went wrong therefore hides nothing from them.
"""

from __future__ import annotations

from collections import deque

from host.estimation.adaptation import AdaptationConfig, StiffnessState, StiffnessTracker, scaled
from host.estimation.free_shape import FreeShape, FreeShapeFit
from host.estimation.interface import Actuation, Estimator, PoseReading, StiffnessUser, TipForce
from protocol.catheter import Catheter
from protocol.enums import Phase
from protocol.errors import InputError
from protocol.rig_file import Rig
from protocol.topics import Message, Stiffness

# Phases in which nothing is meant to touch. In an approach the wall may be met at any time; a free pose counts only when
# those of the next 0.4 s are free as well, and contact drops what waits.
FREE_PHASES = frozenset(phase.label for phase in (Phase.HOLD, Phase.POSITION, Phase.APPROACH, Phase.JOG))
# In one frame of the tracker: a knob that turns faster bends the shaft between the pose and its stage message.
STEADY_per_m = 0.5
REPORT_EVERY = 10  # samples
REPORTS_KEPT = 64  # where nothing takes them
# Handed over when it has changed by this much: every change is a new rod for the kernels.
SCALE_STEP = 1e-3


class AdaptedRigEstimator:
    """Implements `Estimator` and `Reporting` around two estimators of one model."""

    def __init__(
        self,
        catheter: Catheter,
        nominal: Estimator,
        adapted: Estimator,
        shape: FreeShapeFit,
        config: AdaptationConfig,
        sd: float,
    ) -> None:
        """`nominal` keeps the stiffness of `catheter`, known to `sd` (relative); `adapted` follows the tracker's.

        Raises: TypeError where the stiffness of `adapted` cannot be changed.
        """
        if not isinstance(adapted, StiffnessUser):
            raise TypeError(f"adapted: found {type(adapted).__name__}, wanted an estimator with use_stiffness")
        self._catheter, self._nominal, self._adapted, self._user = catheter, nominal, adapted, adapted
        self._shape, self._config, self._sd = shape, config, sd
        self._tracker = StiffnessTracker(config)
        self._used: StiffnessState | None = None
        self._curvature_per_m: float | None = None
        self._since_report = 0
        self.held = ""  # why the stiffness is to be held, empty where nothing speaks against learning
        self._reports: deque[tuple[str, Message]] = deque(maxlen=REPORTS_KEPT)

    @classmethod
    def from_rig(cls, rig: Rig, catheter: Catheter, nominal: Estimator, adapted: Estimator) -> AdaptedRigEstimator:
        """For two estimators of one rig file."""
        shape = FreeShapeFit.from_rig(rig, catheter)
        return cls(catheter, nominal, adapted, shape, AdaptationConfig.from_rig(rig), rig.estimation.stiffness_sd)

    def estimate(
        self,
        pose_tip: PoseReading,
        pose_shaft: PoseReading | None,
        actuation: Actuation,
        pose_rear: PoseReading | None = None,
    ) -> TipForce:
        """The force by the adapted stiffness, with that by the file's as `nominal`. Raises: InputError (bad input)."""
        nominal = self._nominal.estimate(pose_tip, pose_shaft, actuation, pose_rear)
        before_per_m = self._tracker.adapted_curvature(actuation.curvature_per_m)
        state, why = self._learn(pose_tip, pose_shaft, actuation)
        self._use(state)
        bent = actuation._replace(curvature_per_m=self._tracker.adapted_curvature(actuation.curvature_per_m))
        # `adapted` follows the curvature's error by the same poses: what the tracker takes over must not count twice.
        self._user.restate_curvature(bent.curvature_per_m - before_per_m)
        try:
            answer = self._adapted.estimate(pose_tip, pose_shaft, bent, pose_rear)
        except (InputError, ArithmeticError):
            answer = nominal  # adapted out of range: what stands without adaptation stands
        self._report(pose_tip.stamp_ns, state, why)
        return answer._replace(nominal=nominal)

    def free_curvature(self, curvature_per_m: float) -> tuple[float, float]:
        """Return the unloaded curvature (1/m) where the knob's curve gives `curvature_per_m`, and its standard deviation."""
        return self._tracker.adapted_curvature(curvature_per_m), self._tracker.curvature_sd(curvature_per_m)

    def reports(self) -> list[tuple[str, Message]]:
        """Return (topic, message) of what is new since the last call, and forget it."""
        reports = list(self._reports)
        self._reports.clear()
        return reports

    def _learn(self, tip: PoseReading, shaft: PoseReading | None, actuation: Actuation) -> tuple[StiffnessState, str]:
        """The tracker's state after this frame, and why it did not learn, empty where it did."""
        curvature, last = actuation.curvature_per_m, self._curvature_per_m
        self._curvature_per_m = curvature
        shape: FreeShape | None = None
        if self.held:
            why = f"{self.held}: the stiffness is held"
        elif actuation.mode not in FREE_PHASES:
            why = f"phase {actuation.mode or 'not known'}: the stiffness is held"
        elif last is None or abs(curvature - last) > STEADY_per_m:
            why = "the knob turns"
        elif abs(curvature) < self._config.least_curvature_per_m:
            why = f"straighter than {self._config.least_curvature_per_m:g} 1/m: the shape does not show the stiffness"
        else:
            shape = self._shape(tip, shaft, actuation)
            why = "the shape is not that of a free catheter, or not for long enough"
        state = self._tracker.update(tip.stamp_ns * 1e-9, curvature, shape)
        return state, "" if state.free else why

    def _use(self, state: StiffnessState) -> None:
        """Give the adapted estimator the stiffness, where that has changed."""
        used = self._used
        sd = self._stated_sd(state)
        if used is None or abs(state.scale - used.scale) > SCALE_STEP * used.scale or abs(sd - self._stated_sd(used)) > 1e-3:
            self._user.use_stiffness(scaled(self._catheter, state.scale), sd)
            self._used = state

    def _stated_sd(self, state: StiffnessState) -> float:
        """Relative standard deviation of the stiffness in use: never less than the rig file states without adaptation."""
        return max(self._sd, state.sd) if state.samples else self._sd

    def _report(self, stamp_ns: int, state: StiffnessState, why: str) -> None:
        self._since_report -= 1
        if self._since_report > 0 and not state.changed:
            return
        self._since_report = REPORT_EVERY
        if self._config.curvature_exponent == 0.0:
            adaptation, why = "not observable", "curvature_exponent is 0: free curvature does not show the stiffness"
        elif state.limited:
            adaptation, why = "limited", "the stiffness seems to be off by more than adaptation_limit"
        else:
            adaptation = "learning" if state.free else "frozen"
        used = self._used or state
        self._reports.append(
            (
                "stiffness",
                Stiffness(
                    stamp_ns=stamp_ns,
                    scale=used.scale,
                    sd=min(self._stated_sd(state), 100.0),
                    adaptation=adaptation,
                    text=why,
                    samples=state.samples,
                    changes=state.changes,
                ),
            )
        )
