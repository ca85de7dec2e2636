"""What a data set is: how it is drawn, what its recordings hold, and the nominal models that users would write for it.

A data set draws a device, its excitation and its noise. Every measured column has a twin without the planted effects under
the same recorded inputs, so the size of the effects relative to the noise follows from both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

Array = np.ndarray
Columns = dict[str, Array]
SMALLEST, LARGEST = 0.7, 4.0  # size of the effects over the noise; outside of it a data set is drawn again


class Sheet:
    """One recording: columns as the laboratory stores them, and what is known about the measured ones."""

    def __init__(self, time_s: Array, begin_s: float = 0.0) -> None:
        """Begin a recording at time_s (n,) s; begin_s (s) is the reading of the clock at time 0."""
        self.columns: Columns = {"time_s": np.round(time_s + begin_s, 6)}
        self.true: Columns = {}  # measured columns without noise
        self.plain: Columns = {}  # measured columns without noise and without the planted effects
        self.alone: dict[str, tuple[Array, ...]] = {}  # measured columns with one of two effects each
        self.noise: Columns = {}
        self.exact: Columns = {}  # inputs without noise

    def drive(self, name: str, values: Array, noise: Array | float = 0.0) -> None:
        """Store an input (n,) in the unit of its column, read with `noise`."""
        self.exact[name] = values
        self.columns[name] = values + noise

    def read(
        self,
        name: str,
        true: Array,
        plain: Array,
        noise: Array,
        step: float = 0.0,
        lost: Array | None = None,
        alone: tuple[Array, ...] = (),
    ) -> None:
        """Store a measured column.

        Args:
            name: of the column.
            true: what the device does (n,), in the unit of the column.
            plain: what it would do without the planted effects under the same recorded inputs (n,).
            noise: of the reading (n,).
            step: resolution of the reading; 0 for none.
            lost: which samples (n,) are missing.
            alone: with two effects, what the device would do with each of them alone.
        """
        reading = true + noise
        if step > 0.0:
            reading = step * np.round(reading / step)
        self.true[name], self.plain[name], self.alone[name] = true, plain, alone
        self.noise[name] = reading - true
        self.columns[name] = reading if lost is None else np.where(lost, np.nan, reading)


@dataclass(frozen=True)
class Drawn:
    """Recordings of one draw, the nominal model as the content of its TOML, and what is true.

    Attributes:
        sheets: the recordings.
        nominal: content of nominal.toml.
        values: true parameters of the nominal law, in SI.
        planted: parameters of each planted effect.
    """

    sheets: list[Sheet]
    nominal: dict[str, Any]
    values: dict[str, float] = field(default_factory=dict)
    planted: tuple[dict[str, float], ...] = ()

    def sizes(self) -> tuple[float, ...]:
        """Return the RMS of (with the effects minus without) over that of the noise; then that of each effect alone.

        The measured column that shows most counts. The nominal model is not fitted again.
        """
        each = [self._size(name) for name in self.sheets[0].true]
        return tuple(max(column[i] for column in each) for i in range(len(each[0])))

    def _size(self, name: str) -> list[float]:
        noise = _rms([sheet.noise[name] for sheet in self.sheets])
        found = [_rms([sheet.true[name] - sheet.plain[name] for sheet in self.sheets])]
        for i in range(len(self.sheets[0].alone[name])):
            found.append(_rms([sheet.alone[name][i] - sheet.plain[name] for sheet in self.sheets]))
        return [size / noise for size in found]

    def wanted_size(self) -> bool:
        """Return whether the effects, and each of two, are neither hidden by the noise nor far above it."""
        sizes = self.sizes()
        return sizes[0] <= LARGEST and min(sizes) >= SMALLEST


def _rms(parts: Sequence[Array]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


@dataclass(frozen=True)
class DataSet:
    """One device with its recordings.

    Attributes:
        name: of the device.
        category: null, single, pair or outside.
        draw: recordings and nominal model from a stream of chance.
        truth: the planted effects as id@subsystem.
        names: for each of them, all ids that say the truth. Empty: the planted id alone.
        finding: mistake in the data that a verdict must state, an id of `data_findings`; empty for none.
        closed_loop: whether a controller acts on the noisy readings.
        says: what was done to the data, in words.
        compared: parameters of the planted effects whose meaning does not depend on the formula.
    """

    name: str
    category: str
    draw: Callable[[np.random.Generator], Drawn]
    truth: tuple[str, ...] = ()
    names: tuple[tuple[str, ...], ...] = ()
    finding: str = ""
    closed_loop: bool = False
    says: str = ""
    compared: tuple[str, ...] = ()

    def accepted(self) -> list[list[str]]:
        """Return all ids that say the truth, for every planted effect."""
        if self.names:
            return [list(names) for names in self.names]
        return [[place.partition("@")[0]] for place in self.truth]


def channel(unit: str, scale: float = 1.0, **more: Any) -> dict[str, Any]:
    """Return a channel of unit `unit` (of the SI value) whose column is multiplied by `scale`."""
    return {"unit": unit, **({} if scale == 1.0 else {"scale": scale}), **more}


def _content(kind: str, name: str, channels: dict[str, dict[str, Any]], parameters: dict[str, Any]) -> dict[str, Any]:
    return {
        "name": name.replace("_", " "),
        "kind": kind,
        "data": {"time": "time_s"},
        "channels": {key: {"column": key, **value} for key, value in channels.items()},
        **({"parameters": parameters} if parameters else {}),
    }


def link(
    place: str,
    input: str,
    output: str,
    channels: dict[str, dict[str, Any]],
    load: Sequence[str] = (),
    others: Sequence[str] = (),
    **parameters: Any,
) -> dict[str, Any]:
    """Return a nominal transmission: output = gain * input + offset."""
    row = {"subsystem": place, "input": input, "output": output}
    row |= {key: list(value) for key, value in (("load", load), ("others", others)) if value}  # type: ignore[misc]
    return {**_content("transmission", place, channels, parameters), "link": [row]}


def axis(
    place: str,
    input: str,
    output: str,
    channels: dict[str, dict[str, Any]],
    terms: Sequence[str],
    reads: str,
    hold: str,
    **parameters: Any,
) -> dict[str, Any]:
    """Return a nominal axis: m a + c v + k x = input + offset, with the `terms` that the user thinks of."""
    table = {"subsystem": place, "input": input, "output": output, "terms": list(terms), "reads": reads, "hold": hold}
    return {**_content("axis", place, channels, parameters), "axis": table}


def impedance(
    place: str, input: str, output: str, channels: dict[str, dict[str, Any]], terms: Sequence[str], **parameters: Any
) -> dict[str, Any]:
    """Return a nominal impedance: force = m a + c v + k x + offset."""
    table = {"subsystem": place, "input": input, "output": output, "terms": list(terms)}
    return {**_content("impedance", place, channels, parameters), "impedance": table}


def linear(
    place: str,
    input: str,
    output: str,
    channels: dict[str, dict[str, Any]],
    numerator: Sequence[Any],
    denominator: Sequence[Any],
    hold: str,
    **parameters: Any,
) -> dict[str, Any]:
    """Return a nominal transfer function, falling powers of s."""
    table = {
        "subsystem": place,
        "inputs": [input],
        "outputs": [output],
        "numerator": list(numerator),
        "denominator": list(denominator),
        "hold": hold,
    }
    return {**_content("linear", place, channels, parameters), "linear": table}


def sprung_slide(
    rng: np.random.Generator,
    place: str,
    input: str,
    output: str,
    channels: dict[str, dict[str, Any]],
    mass: float,
    stiffness: float,
) -> dict[str, Any]:
    """Return a nominal axis of a mass on a spring whose position is read, with mass and stiffness stated from `rng`."""
    terms, values = ("mass", "damping", "stiffness"), {"mass": stated(rng, mass), "stiffness": stated(rng, stiffness)}
    return axis(place, input, output, channels, terms, "position", "zero", **values)


def first_order(
    rng: np.random.Generator,
    place: str,
    input: str,
    output: str,
    channels: dict[str, dict[str, Any]],
    gain: float,
    lag: float,
) -> dict[str, Any]:
    """Return a nominal plant of one lag under a held input, with its gain and lag (s) stated from `rng`."""
    values = {"gain": stated(rng, gain), "lag": stated(rng, lag)}
    return linear(place, input, output, channels, ["gain"], ["lag", 1.0], "zero", **values)


def stated(rng: np.random.Generator, value: float, error: float = 0.15) -> float:
    """Return a parameter as a data sheet states it: two or three digits, up to `error` off."""
    return float(f"{value * (1.0 + rng.uniform(-error, error)):.3g}")
