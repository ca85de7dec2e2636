"""How one channel follows another: as its copy, by a gain, by the terms of a law, and earlier or later than it should.

A pair is an input and an output that the nominal model says to move together. Nothing here judges a pair: `findings` does.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize_scalar
from scipy.signal import savgol_coeffs

from host.diagnosis.model.data_rules import DataRules
from host.diagnosis.model.dataset import Recording
from host.diagnosis.model.nominal import NominalSpec
from host.diagnosis.model.operators import fill, smooth_derivative, smooth_derivatives, smoothing_window, white_level

Array = npt.NDArray[np.float64]

LONGEST_FOR_CLOCK = 20000  # samples of a recording in which a shift is looked for
SLOWEST_CYCLES = 5  # of a recording: what is slower is left out where an acceleration is integrated


@dataclass(frozen=True)
class Pair:
    """One input and the output that it drives, by a gain or by the terms `law` of input = m a + c v + k x.

    related: whether the nominal model connects the two at all (an impedance may follow its load alone).
    """

    input: str
    output: str
    law: tuple[str, ...] = ()
    reads: str = "position"
    gain: float | None = None  # what the nominal model says of it
    related: bool = True
    stated: bool = False  # whether the nominal model's file states the gain, so that it is not a default
    values: tuple[float, ...] = ()  # of the terms `law`, 0 where the nominal model's file does not state one


def pairs_of(spec: NominalSpec) -> list[Pair]:
    """Pairs of channels that the nominal model says to move together."""
    found = []
    for link in spec.link:
        gain = spec.start("gain" if len(spec.link) == 1 else f"{link.subsystem}_gain", 1.0)[0]
        same = spec.channels[link.input].unit == spec.channels[link.output].unit
        stated = "gain" in spec.parameters or f"{link.subsystem}_gain" in spec.parameters
        found.append(Pair(link.input, link.output, gain=gain if stated or same else None, stated=stated))
    if spec.axis is not None:
        law = tuple(term for term in spec.axis.terms if term != "offset")
        found.append(Pair(spec.axis.input, spec.axis.output, law, spec.axis.reads, values=_stated(spec, law)))
    if spec.impedance is not None:
        law = tuple(term for term in spec.impedance.terms if term in ("mass", "damping", "stiffness"))
        path = Pair(spec.impedance.output, spec.impedance.input, law, related=bool(law), values=_stated(spec, law))
        found.append(path)
    return found


def driven_of(spec: NominalSpec) -> set[str]:
    """Channels that the nominal model predicts, where its sections name them (not those of a rig)."""
    found = {link.output for link in spec.link}
    for section in (spec.axis, spec.impedance):
        found |= {section.output} if section is not None else set()
    return found | set(spec.simulator.outputs if spec.simulator is not None else ())


def _stated(spec: NominalSpec, law: Sequence[str]) -> tuple[float, ...]:
    return tuple(spec.start(term, 0.0)[0] if term in spec.parameters else 0.0 for term in law)


def centred(recordings: list[Recording], name: str) -> Array:
    """Channel `name` of all recordings (n,), gaps bridged, each recording without its mean."""
    each = [fill(recording.channels[name]) for recording in recordings]
    return np.concatenate([values - np.mean(values) for values in each])


def explained_by_gain(recordings: list[Recording], input: str, output: str) -> float:
    """Share of the variance of `output` that a gain on `input` explains, the offset of each recording apart."""
    x, y = centred(recordings, input), centred(recordings, output)
    power = float(x @ x) * float(y @ y)
    return float(x @ y) ** 2 / power if power > 0.0 else 0.0


def lead_by_gain(recording: Recording, path: Pair, rules: DataRules) -> float:
    """Samples by which the output comes before the input, by the residual of a gain at each shift; 0 if it does not.

    Both are smoothed alike to find a part of a sample: an interpolated reading has less noise.
    """
    x, y = fill(recording.channels[path.input]), fill(recording.channels[path.output])
    most = min(x.size // 10, 200)
    if most < rules.clock_lead_samples + 1:
        return 0.0
    leads = [_left(x[lag:], y[: y.size - lag]) for lag in range(most)]
    lags = [_left(x[: x.size - lag], y[lag:]) for lag in range(most)]  # merely late, it would do no worse that way
    best = int(np.argmin(leads))
    if best == 0 or not leads[best] < rules.clock_residual_ratio * min(leads[0], *lags):
        return 0.0
    dt = recording.dt_s
    window = smoothing_window(x, dt, white_level(x), 7 * dt)
    smooth_x, smooth_y = (smooth_derivative(signal, dt, window, 0) for signal in (x, y))
    line, at = CubicSpline(np.arange(x.size), smooth_x), np.arange(x.size - best - 1)
    return _between_samples(lambda lead: _left(line(at + lead), smooth_y[at]), best)[0]


def _between_samples(left: Callable[[float], float], whole: int) -> tuple[float, float]:
    """The shift (samples) within one of `whole`, and from 0 on, with the least residual, and that residual."""
    best = minimize_scalar(left, bounds=(max(whole - 1, 0), whole + 1), method="bounded")
    return float(best.x), float(best.fun)


def _left(x: Array, y: Array) -> float:
    """Variance of `y` (n,) that a positive gain on `x` (n,) leaves: a lag of half a period does not count as a lead."""
    a, b = x - x.mean(), y - y.mean()
    across, spread = max(float(a @ b), 0.0), float(a @ a)
    return (float(b @ b) - (across**2 / spread if spread > 0.0 else 0.0)) / a.size


@dataclass(frozen=True)
class Copied:
    """A channel that is another one, scaled and shifted, up to `tolerance`.

    noisy: with the noise of that one, so that it was not measured. unlike: the two are quantities of different kinds, such
    as a force and a place, which no plant makes equal.
    """

    gain: float
    offset: float
    lag: float  # samples
    noisy: bool
    tolerance: float
    unlike: bool = False

    @property
    def whole(self) -> bool:
        """Return whether the channel has no information beyond the other."""
        return self.noisy or (self.same and (self.lag == 0.0 or self.unlike))

    @property
    def same(self) -> bool:
        """Return whether the channel has the values of the other, perhaps later."""
        return abs(self.gain - 1.0) < self.tolerance and self.offset == 0.0

    def sentence(self, copy: str, original: str, recording: Recording) -> str:
        """Return the sentence of the finding."""
        if self.same:
            says = f"Column {copy} is column {original} in every sample"
        else:
            says = f"Column {copy} is column {original} times {self.gain:.4g}"
        if self.lag:
            late = f"{self.lag * recording.dt_s:.4g} s" if recording.timed else f"{self.lag:.4g} samples"
            says += f", {late} later"
        if self.whole and not self.noisy:
            return says + ", exactly: it was copied, not measured. There is nothing to compare."
        if self.whole:
            return says + ", noise included: it was computed from it, not measured. There is nothing to compare."
        return says + ", exactly and without any noise: was it measured, or computed from it?"


def copy_of(recordings: list[Recording], a: str, b: str, rules: DataRules) -> Copied | None:
    """How `b` is `a` scaled and shifted, alike in every recording and exact; None if it is not."""
    found = [_copied(recording, a, b, rules) for recording in recordings]
    first = found[0] if found else None
    if first is None:
        return None
    for other in found:
        if other is None or abs(other.lag - first.lag) > 1e-3 or abs(other.gain - first.gain) > 1e-6 * abs(first.gain):
            return None
    return replace(first, noisy=all(other is not None and other.noisy for other in found))


def _copied(recording: Recording, a: str, b: str, rules: DataRules) -> Copied | None:
    """As `copy_of`, of one recording: lags of whole samples and between two."""
    x, y = recording.channels.get(a), recording.channels.get(b)
    if x is None or y is None:
        return None
    x, y = fill(x), fill(y)
    if np.ptp(x) == 0.0 or np.ptp(y) == 0.0:
        return None
    most_left = rules.copy_residual
    if np.array_equal(x, y):
        return Copied(1.0, 0.0, 0.0, white_level(x) >= rules.copy_noise * float(np.ptp(x)), most_left)
    dx, dy = np.diff(x, 2), np.diff(y, 2)
    size = 1 << int(np.ceil(np.log2(2 * dx.size)))
    across = np.fft.irfft(np.conj(np.fft.rfft(dx, size)) * np.fft.rfft(dy, size), size)
    most = x.size // 10
    near = int(np.argmax(np.abs(across[: most + 1])))
    for lag in dict.fromkeys((0, near, max(near - 1, 0))):
        now, before = x[1 : x.size - lag], x[: x.size - lag - 1]
        columns = np.array([now, before, np.ones(now.size)]).T
        late = y[lag + 1 :]
        (p, q, offset), *_ = np.linalg.lstsq(columns, late, rcond=1e-12)
        inside = slice(lag, None)  # what is held at the start is not yet the other's
        left = (late - columns @ (p, q, offset))[inside]
        if left.size < 50 or float(np.max(np.abs(left))) > most_left * float(np.ptp(y)) or p * q < -most_left * (p + q) ** 2:
            continue
        gain = float(p + q)
        if gain == 0.0:
            continue
        whole = float(q / gain) + lag
        near_whole = abs(whole - round(whole)) < 1e-4
        noisy = white_level(x) >= rules.copy_noise * float(np.ptp(x))
        offset = 0.0 if abs(offset) < most_left * float(np.ptp(y)) else offset
        return Copied(gain, float(offset), round(whole) if near_whole else whole, noisy, most_left)
    return None


class LawFit(NamedTuple):
    """The law of a pair as regressed in one recording: coefficients (k,), RMS of each term (k,), share of variance."""

    coefficients: Array
    rms: Array
    explained: float

    @property
    def sign(self) -> float:
        """Return 1 if all terms are positive, -1 if all are negative, weighted by their size in between.

        Mass, damping and stiffness have one sign. The law of exchanged columns is nearly that of a spring at low frequency,
        with a damping of the other sign.
        """
        return float(np.sum(np.sign(self.coefficients) * self.rms)) / max(float(np.sum(self.rms)), 1e-300)


def regression(recording: Recording, path: Pair, exchanged: bool = False) -> LawFit:
    """The law by smoothed derivatives, without its offset. exchanged: each channel is read in the other's place."""
    force, motion = fill(recording.channels[path.input]), fill(recording.channels[path.output])
    if exchanged:
        force, motion = motion, force
    dt = recording.dt_s
    window = smoothing_window(motion, dt, white_level(motion), 7 * dt)
    f = smooth_derivative(force, dt, window, 0)
    inside = slice(window, -window) if f.size > 6 * window else slice(None)
    found, rms, explained = _least_squares(_terms(path, motion, dt, window)[:, inside], f[inside])
    return LawFit(found[:-1], rms[:-1], explained)


def sides_of_law(recording: Recording, path: Pair, window: int) -> tuple[Array, Array]:
    """Terms (k + 1, n) of which a pair's law or gain makes a signal (n,), and that signal, filtered alike.

    The terms end with ones. window: samples over which a law is smoothed.
    """
    x, y = fill(recording.channels[path.input]), fill(recording.channels[path.output])
    if not path.law:
        return np.array([x, np.ones_like(x)]), y
    if path.reads == "acceleration":
        terms, force = _by_spectra(recording, path)
        return np.vstack([terms, np.ones_like(force)]), force
    return _terms(path, y, recording.dt_s, window), smooth_derivative(x, recording.dt_s, window, 0)


def _terms(path: Pair, motion: Array, dt: float, window: int) -> Array:
    """Rows (k + 1, n) that the coefficients of the law multiply, by derivatives smoothed over `window`, and ones."""
    x, v, a = smooth_derivatives(motion, dt, window)
    if path.reads == "velocity":
        x, v, a = np.cumsum(x) * dt, x, v
    table = {"mass": a, "damping": v, "stiffness": x}
    return np.array([*(table[term] for term in path.law), np.ones_like(motion)])


def _least_squares(terms: Array, force: Array) -> LawFit:
    """Fit `terms` (k, n) to `force` (n,)."""
    size = np.linalg.norm(terms, axis=1) + 1e-300
    found = np.linalg.lstsq((terms / size[:, None]).T, force, rcond=1e-9)[0] / size
    explained = 1.0 - float(np.var(force - found @ terms)) / max(float(np.var(force)), 1e-300)
    return LawFit(found, np.std(terms, axis=1) * np.abs(found), explained)


def regression_by_spectra(recording: Recording, path: Pair) -> LawFit:
    """As `regression`, of a recorded acceleration: speed and place by integration in the spectrum, without what is slow.

    An integral of a reading with an offset drifts. All terms and the force lose the same slow part.
    """
    return _least_squares(*_by_spectra(recording, path))


def _by_spectra(recording: Recording, path: Pair) -> tuple[Array, Array]:
    """Terms (k, n) and force (n,) of the law of a recorded acceleration, without what is slow."""
    rows = np.vstack([fill(recording.channels[name]) for name in (path.output, path.input)])
    n = rows.shape[1]
    window = np.sin(np.pi * (np.arange(n) + 0.5) / n) ** 2
    spectra = np.fft.rfft((rows - rows.mean(axis=1, keepdims=True)) * window, axis=1)
    turn = 2.0 * np.pi * np.fft.rfftfreq(n, recording.dt_s)
    kept = np.arange(turn.size) >= SLOWEST_CYCLES
    turn[~kept] = 1.0
    a, force = np.where(kept, spectra, 0.0)
    table = {"mass": a, "damping": a / (1j * turn), "stiffness": -a / turn**2}
    terms = np.array([np.fft.irfft(table[term], n) for term in path.law])
    return terms, np.fft.irfft(force, n)


def explained_by_law(fits: list[LawFit]) -> float:
    """Share of the variance of the force that the law explains, median of the recordings."""
    return float(np.median([fit.explained for fit in fits]))


def agreement(fits: list[LawFit]) -> float:
    """How far the terms of the law have one sign (`LawFit.sign`), median of the recordings."""
    return float(np.median([fit.sign for fit in fits]))


def typical(fits: list[LawFit]) -> tuple[Array, Array]:
    """Magnitude of each coefficient (k,) and RMS of its term (k,), medians of the recordings."""
    sizes = np.median([np.abs(fit.coefficients) for fit in fits], axis=0)
    return np.asarray(sizes), np.asarray(np.median([fit.rms for fit in fits], axis=0))


def as_stated(path: Pair, straight: list[LawFit], across: list[LawFit], rules: DataRules) -> bool:
    """Whether the law of exchanged columns alone is passive and has the stated values, where it has several terms.

    Uneven stamps and noise leave a part of either order, and slow motion little of both, so that what is unexplained does
    not decide.
    """
    if len(path.law) < 2 or agreement(across) < 1.0 or agreement(straight) > rules.passive_agreement:
        return False
    if not elsewhere(path, straight, rules):
        return False
    return bool(np.max(_from_stated(path, across)) < np.log(rules.as_stated_factor))


def elsewhere(path: Pair, fits: list[LawFit], rules: DataRules) -> bool:
    """Whether every coefficient whose value is stated has another one."""
    away = _from_stated(path, fits)
    return bool(away.size and np.min(away) > np.log(rules.not_as_stated_factor))


def _from_stated(path: Pair, fits: list[LawFit]) -> Array:
    """Magnitude of the logarithm of the ratio of each coefficient to its value, of those that are stated."""
    stated = np.abs(np.array(path.values))
    found = typical(fits)[0][stated > 0.0]
    return np.asarray(np.abs(np.log(np.maximum(found, 1e-300) / stated[stated > 0.0])))


def lead_by_law(recording: Recording, path: Pair, leading: str, rules: DataRules) -> float:
    """Samples by which `leading` comes first, by what the law leaves at each shift of it; 0 if it does not.

    A force is compared as it was read, and smoothed as its motion is. As read, slow noise of the force passes for noise.
    Smoothed, it shows a part of a sample and tolerates what smoothing takes from the motion.
    """
    part = slice(0, LONGEST_FOR_CLOCK)
    force, motion = fill(recording.channels[path.input])[part], fill(recording.channels[path.output])[part]
    dt, noise = recording.dt_s, white_level(force)
    most = min(force.size // 10, 200)
    window = smoothing_window(motion, dt, white_level(motion), 7 * dt)
    if most < rules.clock_lead_samples + 1 or force.size < 4 * window + 4 * most:
        return 0.0
    rows = _terms(path, motion, dt, window)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True) + 1e-300
    edge = most + window
    middle = rows[:, edge:-edge].T
    gram = np.linalg.pinv(middle.T @ middle, rcond=1e-10, hermitian=True)

    def left(f: Array) -> float:
        """RMS that the law leaves of the force `f` (samples in the middle,)."""
        return float(np.sqrt(np.mean((f - middle @ (gram @ (middle.T @ f))) ** 2)))

    def shifted(signal: Array, shift: int) -> float:
        """RMS that the law leaves of a force that comes `shift` samples later than its motion."""
        return left(signal[edge + shift : signal.size - edge + shift])

    smooth, passed = smooth_derivative(force, dt, window, 0), float(np.linalg.norm(savgol_coeffs(window, 3)))
    ratio, over = rules.clock_residual_ratio, rules.clock_over_noise
    levels = [(force, shifted(force, 0), over * noise), (smooth, shifted(smooth, 0), over * passed * noise)]
    if all(clean > ratio * now for _, now, clean in levels):
        return 0.0
    side = -1 if leading == path.input else 1  # a force that comes first is found before its motion
    # A damping takes over a part of a shift. Only a force that is smoothed as its motion is finds the whole of it.
    whole = int(np.argmin([shifted(smooth, side * lead) for lead in range(most)]))
    line, at = CubicSpline(np.arange(force.size), smooth), np.arange(edge, force.size - edge)
    best, least = _between_samples(lambda lead: left(line(at + side * lead)), whole)
    for (signal, now, clean), after in zip(levels, (shifted(force, side * whole), least), strict=True):
        others = min(shifted(signal, -side * lag) for lag in range(0, most, 2))
        if after < min(clean, ratio * now, ratio * others):
            return best
    return 0.0
