"""Memory operators on sampled signals: play, hysteresis, lag, delay and friends. All `njit`, arrays (n,) in and out."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[np.float64]
FIRST_SAMPLES = 10  # that show the speed with which a recording begins
STEADY_SHARE = 0.9  # of all changes of a reading that repeat the one before, from which on the motion has equal steps
RANGE = 6.0  # standard deviations between the extremes of noise in some hundred samples
STEPPED = 0.7  # of the level of the spectrum, below which the usual second difference shows that steps make it
LONGEST = 40  # samples to either side of one whose noise a parabola through them takes out
WIDE_STEPS = 3  # from which on they show whether all are multiples of the smallest
LEAST_INERTIA = 1e-9  # in sample periods: below this a lag is of first order, or none


@njit(cache=True)
def play(x: Array, radius: float, start: float) -> Array:
    """Backlash operator of half-width `radius`: the output rests until the input pushes it. `start`: first output
    minus input.
    """
    out = np.empty(x.size)
    z = x[0] + min(max(start, -radius), radius)
    for i in range(x.size):
        z = min(max(z, x[i] - radius), x[i] + radius)
        out[i] = z
    return out


@njit(cache=True)
def capstan(x: Array, exponent: float, start: float) -> Array:
    """Pull behind a rope round a post: it stays between x exp(-exponent) and x exp(exponent), which is mu times the angle
    (Euler, Eytelwein); `start`: beyond x at first.
    """
    out = np.empty(x.size)
    low, high = math.exp(-exponent), math.exp(exponent)
    y = x[0] + start
    for i in range(x.size):
        a, b = (x[i] * low, x[i] * high) if x[i] >= 0.0 else (x[i] * high, x[i] * low)
        y = min(max(y, a), b)
        out[i] = y
    return out


@njit(cache=True)
def pressed(x: Array, friction: float, coefficient: float, start: float) -> Array:
    """Load F behind dry friction that it presses on: |F - x| <= friction + coefficient |F|, F at rest in between.

    x: (n,) load before friction. coefficient: below 1, or the load would lock itself. start: first F minus x.
    """
    out = np.empty(x.size)
    F = x[0] + start
    for i in range(x.size):
        above, below = x[i] + friction, x[i] - friction
        most = above / (1.0 - coefficient) if above >= 0.0 else above / (1.0 + coefficient)
        least = below / (1.0 + coefficient) if below >= 0.0 else below / (1.0 - coefficient)
        F = min(max(F, least), most)
        out[i] = F
    return out


@njit(cache=True)
def jenkins(x: Array, distance: float, start: float) -> Array:
    """Elastic-plastic element in [-1, 1]: rises over `distance` after a reversal, then slides (Jenkin 1922)."""
    out = np.empty(x.size)
    z = min(max(start, -1.0), 1.0)
    out[0] = z
    for i in range(1, x.size):
        z = min(max(z + (x[i] - x[i - 1]) / distance, -1.0), 1.0)
        out[i] = z
    return out


@njit(cache=True)
def dahl(x: Array, distance: float, start: float) -> Array:
    """Dahl friction state in [-1, 1]: dz = (1 - z sgn dx) dx / distance, integrated exactly (Dahl 1968, exponent 1)."""
    out = np.empty(x.size)
    z = min(max(start, -1.0), 1.0)
    out[0] = z
    for i in range(1, x.size):
        dx = x[i] - x[i - 1]
        side = 1.0 if dx > 0.0 else -1.0
        z = side + (z - side) * math.exp(-abs(dx) / distance)
        out[i] = z
    return out


SLIP_ELEMENTS = 4


@njit(cache=True)
def maxwell_slip(x: Array, distance: float, ratio: float, levels: Array, start: float) -> Array:
    """Sum of Jenkin elements of levels (4,) that slide after `distance` times ratio^-2, ratio^-1, 1 and ratio.

    Memory is non-local. start: sum at the first sample, shared by all in proportion to their levels. Rate-independent
    part of the generalized Maxwell slip model (Lampaert, Al-Bender and Swevers 2003; Iwan 1966).
    """
    out = np.zeros(x.size)
    total = np.sum(np.abs(levels))
    share = start / total if total > 0.0 else 0.0
    for k in range(levels.size):
        if levels[k] != 0.0:
            out += levels[k] * jenkins(x, distance * ratio ** (k - 2.0), share)
    return out


@njit(cache=True)
def lag(x: Array, dt_s: float, time_constant_s: float, start: float = 0.0) -> Array:
    """First-order low pass, exact for an input that is linear between samples. `start`: first output minus input."""
    out = np.empty(x.size)
    a = math.exp(-dt_s / time_constant_s)
    slope = time_constant_s / dt_s * (1.0 - a)
    y = x[0] + start
    out[0] = y
    for i in range(1, x.size):
        y = a * y + (slope - a) * x[i - 1] + (1.0 - slope) * x[i]
        out[i] = y
    return out


@njit(cache=True)
def digital_lag(x: Array, dt_s: float, time_constant_s: float, start: float = 0.0) -> Array:
    """First-order low pass of samples, each output moved towards the newest input. `start`: first output minus input."""
    out = np.empty(x.size)
    share = 1.0 - math.exp(-dt_s / time_constant_s)
    y = x[0] + start
    out[0] = y
    for i in range(1, x.size):
        y += share * (x[i] - y)
        out[i] = y
    return out


def lagged_rows(values: Array, dt_s: float, time_constant_s: float) -> Array:
    """First-order low pass of every row of `values` (..., n), begun as in a steady motion."""
    flat = np.ascontiguousarray(values.reshape(-1, values.shape[-1]))
    rows = [lag(row, dt_s, time_constant_s, -held_back(row, dt_s, time_constant_s)) for row in flat]
    return np.vstack(rows).reshape(values.shape)


def shifted_rows(values: Array, dt_s: float, delay_s: Array) -> Array:
    """Every row of `values` (..., n) `delay_s` (n,) late, begun as in a steady motion."""
    flat = np.ascontiguousarray(values.reshape(-1, values.shape[-1]))
    rows = [shift(row, dt_s, delay_s, -held_back(row, dt_s, max(float(delay_s[0]), 0.0))) for row in flat]
    return np.vstack(rows).reshape(values.shape)


def held_back(x: Array, dt_s: float, time_s: float) -> float:
    """Distance by which an output that is `time_s` late is behind the first sample of `x` (n,), if the motion was steady.

    Recordings are cut from motion. The speed is that of the first samples; one that is late by more than three times
    these has a beginning that they do not show.
    """
    first = int(min(x.size - 1, max(2, min(round(time_s / dt_s), FIRST_SAMPLES))))
    return float((x[first] - x[0]) * min(time_s / (first * dt_s), 3.0))


@njit(cache=True)
def second_order(x: Array, dt_s: float, lag_s: float, inertia_s2: float, start: float = 0.0, rate: float = 0.0) -> Array:
    """Low pass inertia y'' + lag y' + y = x, exact for an input that is linear between samples.

    Arguments:
        x: (n,) input. lag_s, inertia_s2: coefficients, 0 and more; without inertia this is a first-order lag.
        start: first output minus input. The output begins at the input's speed, as it does in a steady motion; without
            a start (0.0) it begins at rest. rate: what its speed (per second) is beyond that.
    Returns:
        (n,) output.
    Source: first-order hold of a linear system, Franklin, Powell and Workman, Digital Control, 1998, section 4.3.
    """
    a, b = lag_s / dt_s, inertia_s2 / dt_s**2
    if b <= LEAST_INERTIA * max(a, LEAST_INERTIA):
        return lag(x, dt_s, max(a, LEAST_INERTIA) * dt_s, start)
    return _second_order(x, dt_s, a, b, start, rate)[0]


@njit(cache=True)
def followed(x: Array, dt_s: float, lag_s: float, inertia_s2: float, start: float = 0.0, rate: float = 0.0) -> Array:
    """Motion (n,) of a mass that `x` moves by a spring and a damper: inertia y'' + lag y' + y = x + lag x'.

    It is m + lag m', m that of `second_order`, whose arguments these are: `start` and `rate` are of m. An inertia of zero is
    not among them.
    """
    a, b = lag_s / dt_s, inertia_s2 / dt_s**2
    mode, slope = _second_order(x, dt_s, a, b, start, rate)
    return mode + a * slope


@njit(cache=True)
def _second_order(x: Array, dt_s: float, a: float, b: float, start: float, rate: float) -> tuple[Array, Array]:
    """Output (n,) of `second_order` and its change in one sample's time (n,); lag and inertia in units of a sample."""
    # In units of one sample. On a ramp the output runs `a` samples behind; the deviation from that dies out freely, by
    # the exponential of [[0, 1], [-1/b, -a/b]]: (cosh s +- d/s sinh s, sinh s / s) exp(-d), s complex where it rings.
    d, w2 = 0.5 * a / b, 1.0 / b
    if d * d > w2:
        root = math.sqrt(d * d - w2)
        slow, fast = math.exp(-w2 / (d + root)), math.exp(-(d + root))
        even, odd = 0.5 * (slow + fast), 0.5 * (slow - fast) / root
    elif d * d < w2:
        root = math.sqrt(w2 - d * d)
        even, odd = math.cos(root) * math.exp(-d), math.sin(root) / root * math.exp(-d)
    else:
        even, odd = math.exp(-d), math.exp(-d)
    out, slope = np.empty(x.size), np.empty(x.size)
    y, v = x[0] + start, (x[1] - x[0] if start != 0.0 else 0.0) + rate * dt_s
    out[0], slope[0] = y, v
    for i in range(1, x.size):
        rise = x[i] - x[i - 1]
        off, slip = y - x[i - 1] + a * rise, v - rise
        y = x[i] - a * rise + (even + d * odd) * off + odd * slip
        v = rise - w2 * odd * off + (even - d * odd) * slip
        out[i], slope[i] = y, v
    return out, slope


@njit(cache=True)
def delayed_second_order(
    x: Array, dt_s: float, delay_s: float, lag_s: float, inertia_s2: float, start: float = 0.0, rate: float = 0.0
) -> Array:
    """`x` after a dead time and a second-order low pass: inertia y'' + lag y' + y = x(t - delay).

    start: first output minus input. In a steady motion dead time and lag each hold back their share of it, and so they
    share it here. rate: what the output's first speed (per second) is beyond that of the input.
    """
    total = delay_s + lag_s
    waiting = start * delay_s / total if total > 0.0 else 0.0
    late = shift(x, dt_s, np.full(x.size, delay_s), waiting)
    return second_order(late, dt_s, lag_s, inertia_s2, start - waiting, rate)


@njit(cache=True)
def servo(x: Array, dt_s: float, time_constant_s: float, dead_band: float, fastest: float, start: float) -> Array:
    """Position loop around an integrator with a dead band and a limit of speed in it.

    dy/dt = clip(e - clip(e, -dead_band, dead_band), -fastest T, fastest T) / T with e = x - y and T the time constant.
    On each side of a corner the equation is linear, and short steps keep the error of a corner small.

    Arguments: x (n,); fastest: speed limit, in units of x per second; start: first output minus input.
    """
    out = np.empty(x.size)
    steps = max(4, math.ceil(4.0 * dt_s / time_constant_s))
    h = dt_s / steps
    keep = math.exp(-h / time_constant_s)
    y = x[0] + start
    out[0] = y
    for i in range(1, x.size):
        for j in range(steps):
            u = x[i - 1] + (x[i] - x[i - 1]) * (j + 0.5) / steps
            error = u - y
            if abs(error) > dead_band:
                side = 1.0 if error > 0.0 else -1.0
                y += side * min((abs(error) - dead_band) * (1.0 - keep), fastest * h)
        out[i] = y
    return out


@njit(cache=True)
def shift(x: Array, dt_s: float, delay_s: Array, start: float = 0.0) -> Array:
    """`x` as it was `delay_s[i]` seconds earlier, straight between samples as `lag` has it; held at the end.

    start: first output minus input, of a recording that was cut from motion; until the first sample arrives the output
    goes straight from there to the input's first value.
    """
    n = x.size
    out = np.empty(n)
    for i in range(n):
        place = min(i - delay_s[i] / dt_s, n - 1.0)
        if place < 0.0:
            out[i] = x[0] + start * place * dt_s / -delay_s[i]
            continue
        k = min(int(place), n - 2)
        out[i] = x[k] + (place - k) * (x[k + 1] - x[k])
    return out


@njit(cache=True)
def overload(x: Array, level: float) -> Array:
    """Permanent set left by |x| beyond `level`: grows with each new extreme, in the direction of the load, and stays."""
    out = np.empty(x.size)
    high, low = level, -level
    for i in range(x.size):
        high, low = max(high, x[i]), min(low, x[i])
        out[i] = (high - level) + (low + level)
    return out


@njit(cache=True)
def whip(theta: Array, amplitude_rad: float, phase_rad: float) -> Array:
    """Tip roll of a pre-curved shaft in a curved vessel: out + A sin(out + phase) = in, on the branch that is
    followed; jumps if A > 1.
    """
    out = np.empty(theta.size)
    y = theta[0]
    for i in range(theta.size):
        low, high = theta[i] - amplitude_rad - 1e-9, theta[i] + amplitude_rad + 1e-9
        for _ in range(40):
            residual = y + amplitude_rad * math.sin(y + phase_rad) - theta[i]
            slope = 1.0 + amplitude_rad * math.cos(y + phase_rad)
            if residual > 0.0:
                high = y
            else:
                low = y
            y_new = y - residual / slope if slope > 0.05 else 0.5 * (low + high)
            if y_new <= low or y_new >= high:
                y_new = 0.5 * (low + high)
            if abs(y_new - y) < 1e-10:
                y = y_new
                break
            y = y_new
        out[i] = y
    return out


@njit(cache=True)
def since_reversal(x: Array, tolerance: float) -> Array:
    """Distance travelled since the last reversal larger than `tolerance`; before the first one, since the start."""
    out = np.empty(x.size)
    extreme, turn, side = x[0], x[0], 0.0
    for i in range(x.size):
        if (side >= 0.0 and x[i] > extreme) or (side <= 0.0 and x[i] < extreme):
            side = side if side != 0.0 else (1.0 if x[i] > extreme else -1.0)
            extreme = x[i]
        elif side != 0.0 and abs(x[i] - extreme) > tolerance:
            turn, extreme, side = extreme, x[i], -side
        out[i] = abs(x[i] - turn)
    return out


@njit(cache=True)
def wiped_at_reversal(x: Array, distance: float, tolerance: float, start: float) -> Array:
    """Friction state in [-1, 1] that knows nothing but the last reversal: side (1 - 2 exp(-s / distance)), s since there.

    A reversal is larger than `tolerance`. Unlike Dahl's state it forgets how far the motion before it went: nested loops
    do not close. Until the first reversal it builds up from `start`.
    """
    out = np.empty(x.size)
    extreme, turn, side = x[0], x[0], 0.0
    left = 1.0
    for i in range(x.size):
        if (side >= 0.0 and x[i] > extreme) or (side <= 0.0 and x[i] < extreme):
            if side == 0.0:
                side = 1.0 if x[i] > extreme else -1.0
                left = 1.0 - side * min(max(start, -1.0), 1.0)
            extreme = x[i]
        elif side != 0.0 and abs(x[i] - extreme) > tolerance:
            turn, extreme, side, left = extreme, x[i], -side, 2.0
        out[i] = side * (1.0 - left * math.exp(-abs(x[i] - turn) / distance)) if side != 0.0 else start
    return out


@njit(cache=True)
def direction(x: Array, tolerance: float) -> Array:
    """Sign of the last movement larger than `tolerance`, held while still; 0 before the first."""
    out = np.zeros(x.size)
    extreme, side = x[0], 0.0
    for i in range(x.size):
        if side * (x[i] - extreme) > 0.0:
            extreme = x[i]
        elif abs(x[i] - extreme) > tolerance:
            side = 1.0 if x[i] > extreme else -1.0
            extreme = x[i]
        out[i] = side
    return out


def fill(values: Array) -> Array:
    """`values` with missing samples bridged linearly (ends held); zeros if all are missing."""
    good = np.isfinite(values)
    if good.all():
        return values
    if not good.any():
        return np.zeros_like(values)
    index = np.arange(values.size)
    return np.interp(index, index[good], values[good])


def later(values: Array, part: float, smooth: bool = True) -> Array:
    """`values` (n,) put later by a part of a sample (0 to 1): by a spline, or by a line for what is held between samples.

    A missing sample makes both samples missing that are made of it; the first sample is repeated.
    """
    from scipy.interpolate import CubicSpline

    line = (1.0 - part) * values + part * np.concatenate((values[:1], values[:-1]))
    if not smooth or not np.isfinite(values).any():
        return line
    at = np.arange(values.size)
    return np.where(np.isfinite(line), CubicSpline(at, fill(values))(at - part), np.nan)


def signal_band(x: Array, dt_s: float, sigma: float) -> float:
    """Frequency (Hz) at which the power of the motion `x` (n,) falls to three times that of white noise `sigma`."""
    from scipy.signal import medfilt, welch

    frequency, power = welch(x, fs=1.0 / dt_s, nperseg=min(x.size, 1024), window="blackman")
    out = np.flatnonzero(medfilt(power, 9) > 3.0 * 2.0 * sigma * sigma * dt_s)
    return float(frequency[out[-1]] if out.size and out[-1] > 0 else frequency[1])


def smoothing_window(x: Array, dt_s: float, sigma: float, least_s: float, bands: float = 2.0) -> int:
    """Samples (odd) of a local cubic that passes `bands` times the band in which the motion `x` (n,) stands out of white
    noise `sigma`, and no less than `least_s`. Cut-off of the cubic after Schafer (2011).
    """
    least = max(7, round(least_s / dt_s) | 1)
    if sigma <= 0.0 or x.size < 8 * least:
        return least
    half = (4.0 * 0.5 / (bands * signal_band(x, dt_s, sigma) * dt_s) + 4.6) / 3.2
    return int(min(max(least, 2 * int(half) + 1), x.size // 8))


def least_error_window(x: Array, dt_s: float, sigma: float, degree: int, order: int) -> int:
    """Samples (odd) of the local polynomial whose derivative of `order` of the motion `x` (n,) has the least squared error:
    what it takes from the motion, and what it passes of white noise `sigma`.

    The motion's spectrum is the part of its periodogram that noise alone exceeds at one frequency in 20 recordings: three
    times the noise, which it exceeds at one frequency in 20, would count noise at high frequencies as motion, times the
    fourth power of the frequency in an acceleration. A window that is set by the band alone takes 1 to 5 % of what lies at
    the band's edge; times the stiffness, that may exceed the noise of a force.
    """
    from scipy.signal import savgol_coeffs

    taper = np.hanning(x.size)
    line = np.polynomial.polynomial.polyfit(np.arange(x.size), x, 1)
    power = np.abs(np.fft.rfft((x - np.polynomial.polynomial.polyval(np.arange(x.size), line)) * taper)) ** 2
    noise = sigma * sigma * float(taper @ taper)
    least = noise * (3.0 + math.log(power.size))  # a periodogram of noise is exponential, and exp(-3) is one in 20
    signal = np.where(power > least, power - noise, 0.0) * 2.0 / (x.size * float(taper @ taper))
    exact = (2j * np.pi * np.fft.rfftfreq(x.size, dt_s)) ** order
    errors = {}
    for half in np.unique(np.geomspace((degree + 2) // 2, max(x.size // 16, degree), 24).astype(int)):
        window = 2 * int(half) + 1
        h = savgol_coeffs(window, degree, deriv=order, delta=dt_s, use="dot")
        passed = np.fft.rfft(np.roll(np.pad(h, (0, max(x.size - window, 0))), -int(half)))[: exact.size]
        errors[window] = float(signal @ np.abs(exact - np.conj(passed)) ** 2) + sigma * sigma * float(h @ h)
    return min(errors, key=lambda window: errors[window])


def smooth_derivatives(x: Array, dt_s: float, window: int, degree: int = 3) -> tuple[Array, Array, Array]:
    """Position, velocity, acceleration (n,) of a measured motion, see `smooth_derivative`."""
    place, speed, acceleration = (smooth_derivative(x, dt_s, window, order, degree) for order in range(3))
    return place, speed, acceleration


def smooth_derivative(x: Array, dt_s: float, window: int, order: int, degree: int = 3) -> Array:
    """Derivative (n,) of `order` of a measured motion by a local polynomial over `window` samples (odd).

    It has no phase. Over 7 samples a cubic takes 2 % of an acceleration at a fortieth of the sampling rate; degree 5
    takes 0.03 % and passes more noise.
    """
    from scipy.signal import savgol_filter

    window = max(degree + 2, min(window | 1, (x.size - 1) | 1))
    return np.asarray(savgol_filter(x, window, degree, deriv=order, delta=dt_s, mode="interp"))


def wander_at_rest(x: Array, smooth: Array, window: int, degree: int = 3) -> float:
    """Range of the noise that a local polynomial leaves in a motion `x` (n,) at rest; `smooth` (n,) is its result.

    A movement below it cannot be separated from noise. The noise is taken from the median difference of both, which steps
    do not change.
    """
    from scipy.signal import savgol_coeffs

    passed = float(np.sum(savgol_coeffs(window, degree) ** 2))
    noise = 1.4826 * float(np.median(np.abs(x - smooth))) / math.sqrt(max(1.0 - passed, 1e-3))
    return RANGE * noise * math.sqrt(passed)


@njit(cache=True)
def calm(x: Array, sigma: float, correlation: float, from_zero: bool = False) -> Array:
    """`x` (n,) without noise `sigma` of that correlation time (samples): at every sample the longest mean about it that
    agrees
    with all shorter ones (Lepski 1991). `from_zero`: a mean within three of its standard errors counts as zero."""
    n = x.size
    total = np.zeros(n + 1)
    for i in range(n):
        total[i + 1] = total[i] + x[i]
    out = np.empty(n)
    for i in range(n):
        low, high, best, sure = -1e300, 1e300, x[i], 3.0 * sigma
        half = 2
        while half <= 2 * n:
            first, last = max(i - half, 0), min(i + half + 1, n)
            count = last - first
            mean = (total[last] - total[first]) / count
            spread = 3.0 * sigma * math.sqrt(correlation / count)
            if mean < low - spread or mean > high + spread:
                break
            best, sure = mean, spread
            low, high = max(low, mean - spread), min(high, mean + spread)
            half = half + 1 if half < 4 else int(half * 1.3) + 1
        out[i] = 0.0 if from_zero and abs(best) < sure else best
    return out


@njit(cache=True)
def parabola(x: Array, i: int, half: int) -> tuple[float, float]:
    """Value at sample i of the parabola through `half` samples to either side, and how much of white variance it keeps.

    Weights: Savitzky and Golay, Analytical Chemistry 36 (1964) 1627.
    """
    middle = 3.0 * half * half + 3.0 * half - 1.0
    scale = 3.0 / ((2.0 * half + 1.0) * (2.0 * half - 1.0) * (2.0 * half + 3.0))
    value = 0.0
    for j in range(-half, half + 1):
        value += scale * (middle - 5.0 * j * j) * x[i + j]
    return value, scale * middle


@njit(cache=True)
def smoothed(x: Array, sigma: float) -> Array:
    """`x` (n,) without white noise `sigma`: at every sample the parabola over half of the longest window about it, at most
    LONGEST samples to either side, that agrees with those over all shorter ones within three standard errors (Lepski 1991).

    Over the whole window the parabola is off by about as much as its noise; over half of it, by a sixteenth of that. A mean
    (`calm`) takes the bends of a signal for noise: at 25 samples a period they are larger than that of most force sensors.
    """
    n = x.size
    out = x.copy()
    for i in range(n):
        low, high, longest, half = x[i] - 3.0 * sigma, x[i] + 3.0 * sigma, 0, 2
        while half <= min(LONGEST, i, n - 1 - i):
            value, kept = parabola(x, i, half)
            spread = 3.0 * sigma * math.sqrt(kept)
            if value < low - spread or value > high + spread:
                break
            longest = half
            low, high = max(low, value - spread), min(high, value + spread)
            half = half + 1 if half < 8 else int(half * 1.2)
        if longest >= 4:
            out[i] = parabola(x, i, (longest + 1) // 2)[0]
    return out


def white_level(x: Array) -> float:
    """Standard deviation of white noise as strong as the upper half of the spectrum of `x` (n,)."""
    from scipy.signal.windows import blackmanharris

    window = blackmanharris(x.size)
    power = np.abs(np.fft.rfft((x - np.mean(x)) * window)) ** 2
    # the median of chi-squared with two degrees of freedom is ln 2 of its mean
    return float(np.sqrt(np.median(power[power.size // 2 :]) / np.log(2.0) / np.sum(window**2)))


def reading_noise(x: Array) -> float:
    """`white_level` of a signal (n,) that may also be held and jump: steps are not noise, but fill its spectrum.

    Most second differences of such a signal are of noise alone. Those of a signal in fine steps may be zero, and its
    resolution counts as noise.
    """
    level = white_level(x)
    usual = 1.4826 * float(np.median(np.abs(np.diff(x, 2)))) / math.sqrt(6.0)
    held = max(usual, quantum(x) / math.sqrt(12.0))
    return held if held < STEPPED * level else level


def quantum(values: Array) -> float:
    """Resolution of a channel: its smallest step that is not rounding dust; 0 if it is not visibly quantized.

    Steps of a twentieth of the range and more are a signal that switches between levels, no resolution. So are the steps of
    a motion of constant speed, such as a triangle wave: each is as long as the one before. A command that is held between
    steps of any size has few levels too, but the steps between them are not multiples of the smallest.
    """
    good = values[np.isfinite(values)]
    levels = np.unique(good)
    if levels.size < 3 or levels.size > 0.5 * good.size:
        return 0.0
    steps = np.diff(levels)
    dust = 1e-9 * (levels[-1] - levels[0])
    smallest = float(np.min(steps[steps > dust], initial=np.inf))
    wide = steps[steps > 1.5 * smallest] / smallest
    if wide.size >= WIDE_STEPS and np.mean(np.abs(wide - np.round(wide)) < 0.1) < 0.6:
        return 0.0
    return smallest if smallest < 0.05 * (levels[-1] - levels[0]) and not constant_speed(values, smallest) else 0.0


def constant_speed(values: Array, step: float) -> bool:
    """Whether nearly every change of `values` (n,) repeats the one before to 1/1000 of `step`.

    The reading of a coarse sensor does so only if the motion advances by a whole number of steps in every sample.
    """
    steps = np.diff(values)
    moving = np.abs(steps[:-1]) > 0.5 * step
    alike = np.abs(np.diff(steps)) < 1e-3 * step
    return int(np.count_nonzero(moving & alike)) > STEADY_SHARE * max(int(np.count_nonzero(moving)), 1)
