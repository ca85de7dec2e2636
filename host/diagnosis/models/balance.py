"""The forces on a free mass: its equation of motion in weak form, with smooth test functions along the recording.

They are compared if a simulation of the motion does not explain the recordings down to their noise.

    (phi * f)(t) = m (phi'' * x)(t) + c (phi' * x)(t) + k (phi * x)(t) - offset + (phi * other forces)(t)

phi is a bump of finite length: (1 - (s / L)^2)^4. Integration by parts puts every derivative on phi, so that no measured
signal is differentiated; samples whose test function would reach over an end or a gap of the recording are not compared
(weak form: Messenger & Bortz 2021). The force is integrated as it is held between samples.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy import fft

from host.diagnosis.estimation.noise import ORDER, Noise, NoiseSource, autoregression, estimate, quiescent
from host.diagnosis.model.force_kernel import (
    COULOMB,
    DAMPING2,
    EXCESS,
    MASS2,
    MAXWELL_K,
    MAXWELL_T,
    OMEGA2,
    STRIBECK_D,
    along,
    second_mass,
)
from host.diagnosis.model.model import Segment
from host.diagnosis.model.operators import followed, reading_noise, signal_band, white_level

Array = npt.NDArray[np.float64]
POWER = 4  # of the bump: its second derivative is smooth at the ends
HALF_GAIN = 0.62  # half length times the frequency at which the bump's gain is one half
FEWEST = 5  # samples in half a bump
HOLDS = ("linear", "zero", "band_limited")
FINE = 32  # points a sample, to integrate a held force
PARTS = 8  # of a recording, in each of which the share of the input that is applied is looked at
AT_REST = 0.05  # of the largest spread of a part: below it the input rests


@dataclass(frozen=True)
class Kernel:
    """Weights (2 half + 1,) of a convolution, and their spectrum for records of one length."""

    weights: Array
    spectrum: npt.NDArray[np.complex128]
    size: int  # of the transform

    @classmethod
    def of(cls, weights: Array, n: int) -> Kernel:
        """Return the kernel for records of n samples."""
        size = int(fft.next_fast_len(n + weights.size - 1, real=True))
        return cls(weights, np.asarray(fft.rfft(weights, size)), size)

    def along(self, values: Array) -> Array:
        """Convolution (n,) with `values` (n,), of no meaning within half a kernel of the ends."""
        first = self.weights.size // 2
        return np.asarray(fft.irfft(fft.rfft(values, self.size) * self.spectrum, self.size)[first : first + values.size])


@dataclass(frozen=True)
class Balance:
    """Test function of one recording, and what it leaves of the motion."""

    input: str  # channel of the force
    bump: Kernel  # test function
    held: Kernel  # its integral over what each sample of the force stands for
    force: Array  # (n,) as it is recorded
    recorded: Array  # (n,) the same under `held`
    rows: Array  # (3, n) acceleration, speed and place of the motion under the test function
    noise: Noise
    kernels: Array  # (3, 2 half + 1) of the rows
    support: Array  # (2 half + 1,) times of the test function, s
    length: float  # half its length, s
    sigma_motion: float  # white noise of the motion
    sigma_force: float  # and of the force
    finer: dict[int, Kernel] = field(default_factory=dict)  # `held` for so many held points in each sample


@dataclass(frozen=True)
class Motion:
    """Smoothed motion, its two derivatives (n,); the movement below which nothing has moved; friction held at first.

    At rest (n,) friction is what holds the axis against the input `pushed` (n,), freed of noise.
    """

    x: Array
    v: Array
    a: Array
    tolerance: float
    start: float
    rests: npt.NDArray[np.bool_]
    pushed: Array


def prepare(segment: Segment, force: str, motion: Array, seen: npt.NDArray[np.bool_], least_s: float, hold: str) -> Balance:
    """Test function, and the motion's (acceleration, speed, place) (3, n) under it.

    Its length follows the band in which the motion stands out of its noise; being the same for all terms it bends none of
    their coefficients.

    force: its channel; motion: (n,), gaps bridged; seen: where motion and force were measured; hold: how the force runs
    between samples.
    """
    dt_s, recording = segment.recording.dt_s, segment.recording
    sigma = estimate([motion], [quiescent([motion], dt_s, recording.timed)]).sigma
    length = max(HALF_GAIN / signal_band(motion, dt_s, sigma), least_s, FEWEST * dt_s)
    length = min(length, max(FEWEST * dt_s, motion.size * dt_s / 16.0))
    half = int(np.ceil(length / dt_s))
    s: Array = np.arange(-half, half + 1, dtype=np.float64) * dt_s
    bump, slope, bend = _bump(s, length)
    bump /= bump.sum()
    slope = (slope - slope.mean()) / -float(slope @ s)
    bend -= bump * bend.sum()
    bend *= 2.0 / float(bend @ s**2)
    kernels = np.array([bend, slope, bump])
    rows = np.array([Kernel.of(kernel, segment.n).along(motion) for kernel in kernels])
    gap = np.concatenate((np.zeros(1), np.cumsum(~seen)))
    first, last = np.maximum(np.arange(segment.n) - half, 0), np.minimum(np.arange(segment.n) + half + 1, segment.n)
    whole = (np.arange(segment.n) >= half) & (np.arange(segment.n) < segment.n - half) & (gap[last] == gap[first])
    segment.y[:, ~whole] = np.nan
    sigma_motion = white_level(motion)
    held, under, noise = _held_force(segment.inputs[force], rows, kernels, s, length, sigma_motion, hold)
    recorded = segment.inputs[force]
    return Balance(
        force,
        Kernel.of(bump, segment.n),
        held,
        recorded,
        under,
        rows,
        noise,
        kernels,
        s,
        length,
        sigma_motion,
        sigma_force=reading_noise(recorded),
    )


def held_as(balance: Balance, segment: Segment, hold: str) -> Balance:
    """`balance` with the force running between its samples as `hold` says."""
    recorded = segment.inputs[balance.input]
    held, under, noise = _held_force(
        recorded, balance.rows, balance.kernels, balance.support, balance.length, balance.sigma_motion, hold
    )
    return replace(balance, held=held, force=recorded, recorded=under, noise=noise)


def _held_force(
    recorded: Array, rows: Array, kernels: Array, s: Array, length: float, sigma_motion: float, hold: str
) -> tuple[Kernel, Array, Noise]:
    """Weights of force samples under the test function, the recorded force (n,) there, and the noise."""
    weights = _held(s, length, float(s[1] - s[0]), hold)
    held = Kernel.of(weights, recorded.size)
    half = s.size // 2
    kept = slice(half, recorded.size - half)
    columns = np.vstack([rows, np.ones(recorded.size)])[:, kept].T
    under = held.along(recorded)
    found: Array = np.asarray(np.linalg.lstsq(columns, under[kept], rcond=1e-12)[0])
    noise = _noise(np.asarray(found[:3], dtype=np.float64), sigma_motion, reading_noise(recorded), kernels, weights)
    return held, under, noise


def _bump(s: Array, length: float) -> tuple[Array, Array, Array]:
    """The test function and its first and second derivative at `s` (n,)."""
    z = np.clip(1.0 - (s / length) ** 2, 0.0, None)
    first = -2.0 * POWER * s / length**2 * z ** (POWER - 1)
    second = 4.0 * POWER * (POWER - 1) * s**2 / length**4 * z ** (POWER - 2) - 2.0 * POWER / length**2 * z ** (POWER - 1)
    return z**POWER, first, second


def _held(s: Array, length: float, dt_s: float, hold: str) -> Array:
    """Weights of force samples under the test function: its integral over what each sample stands for."""
    if hold == "band_limited":
        weights = _bump(s, length)[0]
    else:
        inside = (np.arange(FINE) + 0.5) / FINE * dt_s
        shares = [(inside, np.ones(FINE))] if hold == "zero" else []
        if hold == "linear":
            shares = [(inside, 1.0 - inside / dt_s), (-inside, 1.0 - inside / dt_s)]
        weights = np.zeros_like(s)
        for place, share in shares:
            weights += np.sum(_bump(s[:, None] - place[None, :], length)[0] * share, axis=1)
    return np.asarray(weights / weights.sum())


def _finely(balance: Balance, dt_s: float, finer: int, n: int) -> Kernel:
    """Weights of a force (n,) with `finer` held points in each sample under the test function."""
    if finer == 1:
        return balance.held
    if finer in balance.finer:
        return balance.finer[finer]
    reach = (balance.support.size // 2 + 1) * finer
    at: Array = (np.arange(-reach, reach + 1, dtype=np.float64) - 0.5) * (dt_s / finer)
    weights = _bump(at, balance.length)[0]
    balance.finer[finer] = Kernel.of(np.asarray(weights / weights.sum()), n)
    return balance.finer[finer]


def _noise(coefficients: Array, sigma_motion: float, sigma_force: float, kernels: Array, held: Array) -> Noise:
    """Noise behind the test function: that of the force and, by acceleration, speed and place, that of the motion.

    Both are taken from the upper half of their spectra, where no axis follows: never from what the nominal model leaves.
    """
    of_motion = sigma_motion * (coefficients @ kernels)
    of_force = sigma_force * held
    lags = np.zeros(ORDER + 1)
    for kernel in (of_motion, of_force):
        lags += [kernel[k:] @ kernel[: kernel.size - k] for k in range(ORDER + 1)]
    lags[0] = lags[0] * (1.0 + 1e-9) or 1e-300  # neither has noise in an experiment that is only planned
    return Noise(max(float(np.sqrt(lags[0])), 1e-300), autoregression(lags), NoiseSource.BALANCE)


def quieted(balance: Balance, linear: Array, p: Array, dt_s: float) -> float:
    """Noise that a second mass or a branch that relaxes leaves in the balance, over that of the nominal law; 1 without them.

    The noise of a motion enters the balance mostly as m a. A spring of fitted frequency and damping pulls against it in just
    that band, although the force has no such part: a smaller error of this kind is not evidence. linear: m, c, k, offset.
    """
    if p[MASS2] <= 0.0 and p[MAXWELL_K] == 0.0:
        return 1.0
    size = 1 << (2 * balance.support.size).bit_length()
    w = 2j * np.pi * np.fft.rfftfreq(size, dt_s)
    second = 2.0 * p[DAMPING2] * p[OMEGA2] * w + p[OMEGA2] ** 2
    added = p[MASS2] * w**2 * second / (w**2 + second) if p[MASS2] > 0.0 else np.zeros_like(w)
    if p[MAXWELL_K] != 0.0:
        added = added + p[MAXWELL_K] * w * p[MAXWELL_T] / (1.0 + w * p[MAXWELL_T])
    weights = (linear[:3] @ balance.kernels, balance.bump.weights, balance.held.weights)
    law, bump, held = (np.fft.rfft(each, size) for each in weights)
    of_motion, of_force = balance.sigma_motion * (law + added * bump), balance.sigma_force * held
    power = np.abs(of_motion) ** 2 + np.abs(of_force) ** 2
    return float(np.sqrt((2.0 * power.sum() - power[0] - power[-1]) / size)) / balance.noise.sigma


def at_rest(x: Array, tolerance: float, half: int) -> npt.NDArray[np.bool_]:
    """Samples (n,) about which the motion `x` (n,) moves by less than `tolerance` within `half` samples to either side."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    return np.asarray(maximum_filter1d(x, 2 * half + 1) - minimum_filter1d(x, 2 * half + 1) < tolerance)


def at_edges(rests: npt.NDArray[np.bool_], half: int) -> npt.NDArray[np.bool_]:
    """Samples (n,) whose test function, `half` samples to either side, reaches over the begin or end of a rest; none where
    that is more than half of the motion.

    Friction jumps there, and noise hides the instant. The error of these few samples would bend its size by a tenth.
    """
    from scipy.ndimage import binary_dilation

    edges = np.diff(rests, prepend=rests[:1])
    near = binary_dilation(edges, iterations=half + 1) if edges.any() else edges
    return near if 2 * np.count_nonzero(near & ~rests) <= np.count_nonzero(~rests) else np.zeros_like(near)


def _forces(segment: Segment, motion: Motion, p: Array) -> Array:
    """Forces (n,) of the effects along the motion."""
    recording = segment.recording
    return along(
        motion.x,
        motion.v,
        motion.a,
        np.zeros(segment.n),
        recording.time_s,
        recording.dt_s,
        motion.tolerance,
        motion.start,
        p,
    )


def _without(p: Array, *slots: int) -> Array:
    """`p` with zero in `slots`."""
    less = p.copy()
    less[list(slots)] = 0.0
    return less


def error(balance: Balance, segment: Segment, motion: Motion, linear: Array, force: Array, p: Array) -> Array:
    """Force (1, n) that the motion needs beyond the input. linear: m, c, k, offset; p: slots of the force kernel.

    An effect of the drive changes the input `force` (n,), which is what is compared here: where it shrinks the
    input the error counts in the size of the recorded one, so that nothing is gained by shrinking; likewise where forces
    along the motion take noise out of it (`quieted`). `force` may have several points in each sample, each held until the
    next one.
    """
    recording = segment.recording
    a, v, x = balance.rows
    need = linear[0] * a + linear[1] * v + linear[2] * x - linear[3]
    if np.any(p):
        dry = _forces(segment, motion, _without(p, MASS2))
        most = p[COULOMB] + max(p[EXCESS], 0.0)
        if p[COULOMB] > 0.0 and p[STRIBECK_D] <= 0.0 and motion.rests.any():
            other = _forces(segment, motion, _without(p, COULOMB, EXCESS, MASS2))
            holds = np.clip(motion.pushed + linear[3] - linear[2] * motion.x - other, -most, most)
            dry = np.where(motion.rests, other + holds, dry)
        need = need + balance.bump.along(dry)
    applied, size = balance.recorded, 1.0
    if force is not balance.force:
        finer = force.size // segment.n
        applied = _finely(balance, recording.dt_s, finer, force.size).along(force)[::finer]
        size = _passed(applied, balance.recorded, np.isfinite(segment.y[0]))
    size *= min(quieted(balance, linear, p, recording.dt_s), 1.0)
    left = need - applied
    if p[MASS2] > 0.0:
        left = left + _pull_of_second_mass(balance, segment, p, left)
    return np.asarray(left)[None, :] / min(max(size, 1e-6), 1.0)


def _pull_of_second_mass(balance: Balance, segment: Segment, p: Array, left: Array) -> Array:
    """Force (n,) of the second mass under the test function; left (n,): error without it.

    It follows from the acceleration under the test function: a smoothed one would lack what is fast. How the mass moved
    before is not known. Its free oscillation is fitted to the error, and is expected to be as large as its forced one.
    """
    first, dt_s, omega = balance.support.size // 2, segment.recording.dt_s, p[OMEGA2]
    pull = np.zeros(segment.n)
    pull[first:] = second_mass(balance.rows[0][first:], dt_s, p)
    seen = np.isfinite(segment.y[0])
    usual = float(np.std(pull[seen])) if seen.any() else 0.0
    if usual == 0.0:
        return pull
    free = np.zeros((segment.n, 2))
    still = np.zeros(segment.n - first)
    for column, begun in enumerate(((1.0, 0.0), (0.0, omega))):
        free[first:, column] = usual * followed(still, dt_s, 2.0 * p[DAMPING2] / omega, 1.0 / omega**2, *begun)
    error, by = left + pull, np.zeros(2)
    for _ in range(2):
        variance = float(np.mean((error + free @ by)[seen] ** 2))
        by = np.linalg.solve(free[seen].T @ free[seen] + variance * np.eye(2), -free[seen].T @ error[seen])
    return np.asarray(pull + free @ by)


def _passed(applied: Array, recorded: Array, compared: npt.NDArray[np.bool_]) -> float:
    """Share of the recorded input that is applied: the median over parts of the recording of the ratio of their spreads.

    One ratio for the whole recording is not a measure. A limit that lets a single peak pass leaves no error anywhere else.

    applied, recorded: (n,), under the test function; compared: (n,).
    """
    parts = _spreads(applied, recorded, compared)
    moved = [(a, r) for a, r in parts if r > 0.0]
    least = AT_REST * max((r for _, r in moved), default=0.0)
    return float(np.median([a / r for a, r in moved if r > least])) if moved else 1.0


@njit(cache=True)
def _spreads(a: Array, b: Array, used: npt.NDArray[np.bool_]) -> Array:
    """Standard deviations (PARTS, 2) of `a` and `b` (n,) in equal parts of their `used` samples."""
    at = np.flatnonzero(used)
    found = np.zeros((PARTS, 2))
    for part in range(PARTS):
        inside = at[part * at.size // PARTS : (part + 1) * at.size // PARTS]
        if inside.size:
            found[part, 0], found[part, 1] = np.std(a[inside]), np.std(b[inside])
    return found
