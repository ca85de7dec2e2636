"""Concealed recordings of the catheter rig: one session of the simulated plant, open or closed loop, in several recordings.

The clock runs on through the session: the second recording's time begins where the rig's clock then was, and what has
memory (play, creep, drift) keeps it from one recording to the next.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sim.catheter_chain import CatheterConfig
from sim.concealed import nominal
from sim.concealed.signals import KINDS, QUIET_S, presses, signal
from sim.effects import PlantedEffect
from sim.heart import HeartConfig
from sim.knob import KnobConfig
from sim.plant import Plant, PlantConfig
from sim.tissue import TissueConfig
from sim.vessel import VesselConfig

Array = np.ndarray
FRAME_S = 0.025
STEPS = 5  # plant steps a frame
DURATION_S, PAUSE_S = 30.0, 4.0
CHANNELS = tuple(f"{tool}_{part}" for tool in ("tip", "shaft") for part in ("x", "y", "z", "turn_x", "turn_y", "turn_z")) + (
    "force_x",
    "force_y",
    "force_z",
)
STEPS_PER_UNIT = np.array([320000.0, 12800.0 / (2.0 * np.pi), 12800.0 / (2.0 * np.pi)])
_TICK = np.array([0.02, 3.0, 3.0]) * FRAME_S  # fastest command change a frame
# The concealed catheter is not one of those that ship, so its geometry is its own.
_DIAMETER_M, _WIRE_OFFSET_M = 0.00233, 0.0008
_UNIT = np.array([1e-3, 0.1, 0.07])  # a middling correction of each axis
Distortion = Callable[[Array, float], Array]  # (handle (3,), dt_s) -> what reaches the rig (3,)


@dataclass(frozen=True)
class RigCase:
    """A rig, its noise and what is done with it. nominal (9,) is the rig's own; reference: (n, 3) per recording."""

    nominal: Array
    starts_s: tuple[float, ...]
    reference: tuple[Array, ...]
    sigma: Array
    closed_loop: bool
    seed: int


@dataclass(frozen=True)
class NoiselessRecordings:
    """What happened, without noise: per recording time (n,), inputs (n, k) and outputs (n, m)."""

    time_s: tuple[Array, ...]
    inputs: tuple[Array, ...]
    outputs: tuple[Array, ...]


def draw(
    rng: np.random.Generator, closed_loop: bool, still_axis: int | None = None, touches: bool = True, bent: bool = False
) -> RigCase:
    """A rig and three recordings: free motion; presses on the wall; both, with other excitation (held out).

    still_axis: an axis that never moves; touches: whether the wall is met; bent: the knob never crosses its centre.
    """
    slope, gain, stiffness = rng.uniform(0.44, 0.52), rng.uniform(26.0, 31.0), rng.uniform(1.2e-3, 2.0e-3)
    p = np.array(
        [1.0, -0.070 + rng.uniform(-0.002, 0.002), slope, 0.0, gain, 0.0, stiffness, 0.0, rng.uniform(300.0, 1000.0)]
    )
    knob = rng.uniform(9.0, 14.0) / gain
    at_rest = np.array([[0.0, 0.0, knob]])
    height = float(nominal.predict(p, at_rest, np.zeros((1, 3)))[0, 2])
    gap = rng.uniform(5e-5, 1.5e-4)
    p[7] = height + gap
    soft = 1.0 / _push(p, knob, height)
    deep = 1.2 * gap + rng.uniform(0.05, 0.08) * soft if touches else 0.0
    starts = tuple(i * (DURATION_S + PAUSE_S) for i in range(3))
    plans = [_free(rng, knob, bent), _pressing(rng, knob, deep), _mixed(rng, knob, deep, bent)]
    if still_axis is not None:
        for plan in plans:
            plan[:, still_axis] = plan[0, still_axis]
    sigma = np.repeat([rng.uniform(1e-4, 2.9e-4), rng.uniform(0.002, 0.0045)] * 2 + [rng.uniform(6e-4, 1.2e-3)], 3)
    return RigCase(p, starts, tuple(plans), sigma, closed_loop, int(rng.integers(2**31)))


def _push(p: Array, knob: float, height: float) -> float:
    """Force on the wall per insertion beyond touch (N/m) with the knob at `knob`."""
    ahead = p.copy()
    ahead[7] = height
    return float(nominal.predict(ahead, np.array([[1e-4, 0.0, knob]]), np.zeros((1, 3)))[0, 16]) / 1e-4


def _clock() -> Array:
    return np.arange(0.0, DURATION_S, FRAME_S)


def _kind(rng: np.random.Generator) -> str:
    return KINDS[int(rng.choice(5, p=[0.3, 0.25, 0.2, 0.1, 0.15]))]


def _free(rng: np.random.Generator, knob: float, bent: bool) -> Array:
    """All axes in motion well before the wall."""
    t = _clock()
    insertion = -0.0065 + 0.004 * signal(rng, _kind(rng), t)
    roll = rng.uniform(1.0, 1.8) * signal(rng, _kind(rng), t, 0.4)
    swing = rng.uniform(0.4, 0.9) * knob if bent else rng.uniform(0.55, 0.8)
    return np.column_stack([insertion, roll, knob * bent + swing * signal(rng, _kind(rng), t)])


def _pressing(rng: np.random.Generator, knob: float, deep: float) -> Array:
    """Pushes on the wall while roll and knob move a little."""
    t = _clock()
    roll = rng.uniform(0.5, 1.2) * signal(rng, _kind(rng), t, 0.3)
    return np.column_stack([deep * presses(rng, t), roll, knob + 0.006 * signal(rng, _kind(rng), t, 0.3)])


def _mixed(rng: np.random.Generator, knob: float, deep: float, bent: bool) -> Array:
    """Half free motion, half presses: other signals than in training."""
    free, press = _free(rng, knob, bent), _pressing(rng, knob, deep)
    n = len(free) // 2
    half = np.empty_like(free)
    half[:n], half[n:] = free[::2][:n], press[: len(free) - n]
    share = np.clip((_clock() - DURATION_S / 2.0 + 1.0) / 2.0, 0.0, 1.0)[:, None]
    share = share * share * (3.0 - 2.0 * share)
    first, second = np.where(_clock()[:, None] < DURATION_S / 2.0 + 1.0, half, half[n - 1]), half.copy()
    second[:n] = half[n]
    return np.asarray((1.0 - share) * first + share * second)


def plant(case: RigCase, effects: Sequence[PlantedEffect]) -> Plant:
    """The simulated plant without any of its habits: what is planted is all that is missing from the nominal model."""
    p = case.nominal
    rigidity = (p[6], p[6], nominal.TORSION_TO_BENDING * p[6])
    first = case.reference[0][0]
    return Plant(
        PlantConfig(
            catheter=CatheterConfig(
                "concealed",
                nominal.DISTAL_M,
                _DIAMETER_M,
                _WIRE_OFFSET_M,
                rigidity,
                rigidity,
                distal_cells=44,
                retardation_s=1e-4,
            ),
            vessel=VesselConfig(
                home_insertion_m=float(p[1]),
                play_width_m=0.0,
                roll_slope=float(p[2]),
                roll_lag_s=0.0,
                windup_stiffness_Nm_per_rad=10.0,
            ),
            knob=KnobConfig(slack_rad=0.0, stop_rad=3.0, curvature_at_stop_per_m=3.0 * float(p[4])),
            tissue=TissueConfig(point_m=(0.0, 0.0, float(p[7])), stiffness_N_per_m=float(p[8])),
            heart=HeartConfig(beat_m=0.0, respiration_m=0.0),
            start_stage=(float(first[0]), float(first[1]), float(first[2])),
            tool_offsets_m=(0.0, nominal.SHAFT_OFFSET_M),
            effects=tuple(effects),
        ),
        seed=case.seed,
    )


def commands(case: RigCase) -> tuple[Array, list[slice]]:
    """Reference of the whole session (n, 3), pauses bridged, and where each recording lies in it."""
    total = round((case.starts_s[-1] + DURATION_S) / FRAME_S)
    clock, at, value, where = np.arange(total), [], [], []
    for start, reference in zip(case.starts_s, case.reference, strict=True):
        first = round(start / FRAME_S)
        where.append(slice(first, first + len(reference)))
        at.append(np.arange(first, first + len(reference)))
        value.append(reference)
    knots, values = np.concatenate(at), np.concatenate(value)
    return np.column_stack([np.interp(clock, knots, values[:, k]) for k in range(3)]), where


def simulate(
    case: RigCase, effects: Sequence[PlantedEffect] = (), distortion: Distortion | None = None, replay: Array | None = None
) -> NoiselessRecordings:
    """Run the session. `distortion` stands between handle and rig; `replay` (n, 3) gives the handle instead of control."""
    reference, where = commands(case)
    rig = plant(case, effects)
    loop = _Loop(case, reference, where) if case.closed_loop and replay is None else None
    outputs, handles = np.empty((len(reference), 17)), np.empty_like(reference)
    last = reference[0].copy()
    for i in range(len(reference)):
        handle = loop.command(i) if loop else (reference[i] if replay is None else replay[i])
        handle = np.rint(handle * STEPS_PER_UNIT) / STEPS_PER_UNIT
        for k in range(STEPS):
            now = last + (handle - last) * (k + 1.0) / STEPS
            rig.step(FRAME_S / STEPS, now if distortion is None else distortion(now, FRAME_S / STEPS))
        last = handles[i] = handle
        for tool in range(2):
            shown = rig.measured_pose(tool)
            outputs[i, 7 * tool : 7 * tool + 3], outputs[i, 7 * tool + 3 : 7 * tool + 7] = (
                shown.position_m,
                shown.quaternion_wxyz,
            )
        outputs[i, 14:] = rig.measured_wrench()[0]
        if loop:
            loop.seen(outputs[i, :3])
    clock = np.arange(len(reference)) * FRAME_S + FRAME_S
    return NoiselessRecordings(
        tuple(clock[w] for w in where), tuple(handles[w] for w in where), tuple(outputs[w] for w in where)
    )


class _Loop:
    """PI control of the tip's position on poses that are noisy and one frame late; hides part of what is planted.

    Like a rig before it is armed, the handle holds still for the first moments of every recording.
    """

    def __init__(self, case: RigCase, reference: Array, where: list[slice]) -> None:
        self._rng = np.random.default_rng([case.seed, 7])
        self._noise = float(case.sigma[0])
        p, none = case.nominal, np.zeros((len(reference), 3))
        force = nominal.predict(p, reference, none)[:, 14:]
        self._target = nominal.predict(p, reference, force)[:, :3]
        self._jacobian = np.stack(
            [
                (nominal.predict(p, reference + 0.01 * step, none) - nominal.predict(p, reference, none))[:, :3] / 0.01
                for step in np.diag(_UNIT)
            ],
            axis=2,
        )
        self._reference, self._sum, self._last = reference, np.zeros(3), reference[0].copy()
        self._seen = [self._target[0], self._target[0]]
        self._held = np.zeros(len(reference), bool)
        for part in where:
            self._held[part.start : part.start + round(QUIET_S / FRAME_S)] = True

    def seen(self, position: Array) -> None:
        """The tracker's position of this frame, which control gets with the next one."""
        self._seen.append(position + self._noise * self._rng.standard_normal(3))

    def command(self, i: int) -> Array:
        """Handle position (3,) for frame i."""
        if self._held[i]:
            return self._last
        j, back = self._jacobian[i], max(0, i - 2)
        error = self._target[back] - self._seen[-2]
        step = np.linalg.solve(j.T @ j + (3e-4) ** 2 * np.eye(3), j.T @ error)
        self._sum = np.clip(self._sum + FRAME_S * 0.6 * step, -1.5, 1.5)
        wanted = self._reference[i] + _UNIT * np.clip(0.08 * step + self._sum, -1.5, 1.5)
        self._last = self._last + np.clip(wanted - self._last, -_TICK, _TICK)
        return self._last
