"""One face for all families of concealed cases: run it, calibrate the nominal model, compute residuals, write tables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sim.concealed import generic as concealed_generic
from sim.concealed import nominal as concealed_nominal
from sim.concealed import rig as concealed_rig
from sim.concealed.generic import GenericCase
from sim.concealed.rig import NoiselessRecordings, RigCase
from sim.concealed.scalable_effects import ScalableEffect
from sim.concealed.signals import coloured, lost
from sim.effects import PlantedEffect

Array = np.ndarray
_HANDLE = ("handle_insertion_m", "handle_roll_rad", "handle_knob_rad")


@dataclass(frozen=True)
class ScaledEffect:
    """A scalable effect with its size and the moment (s of the session) from which it acts."""

    effect: ScalableEffect
    size: float
    start_s: float = 0.0

    @property
    def parameters(self) -> dict[str, float]:
        """Return the planted parameters by name."""
        return self.effect.make(self.size)


@dataclass(frozen=True)
class System:
    """A case's rig or mechanism; `parts` hands outputs over as residuals in SI, one column a channel."""

    kind: str
    case: RigCase | GenericCase
    channels: tuple[str, ...]
    sigma: Array
    period_s: float

    def run(self, planted: Sequence[ScaledEffect], replay: Sequence[Array] | None = None) -> NoiselessRecordings:
        """The session with `planted` in it, without noise. `replay`: recorded inputs instead of excitation and control."""
        if isinstance(self.case, GenericCase):
            return concealed_generic.simulate(self.case, [(p.effect, p.parameters) for p in planted], replay)
        effects = [
            PlantedEffect(p.effect.id, p.effect.port, p.parameters, p.start_s) for p in planted if p.effect.id != "unlisted"
        ]
        strange = [p for p in planted if p.effect.id == "unlisted"]
        return concealed_rig.simulate(
            self.case, effects, Warp(strange) if strange else None, None if replay is None else self._bridged(replay)
        )

    def _bridged(self, replay: Sequence[Array]) -> Array:
        """Recorded handle positions of all recordings as one session, pauses bridged."""
        assert isinstance(self.case, RigCase)
        case = RigCase(self.case.nominal, self.case.starts_s, tuple(replay), self.sigma, False, 0)
        return concealed_rig.commands(case)[0]

    def calibrate(
        self, session: NoiselessRecordings, which: Sequence[int], start: Array, every: int = 3, robust: bool = False
    ) -> Array:
        """Nominal parameters fitted to recordings `which`, every so many samples of them."""
        if isinstance(self.case, GenericCase):
            return concealed_generic.fit(
                self.kind,
                start,
                [session.inputs[i] for i in which],
                [session.outputs[i] for i in which],
                self.sigma,
                self.period_s,
            )
        handle, outputs = (np.vstack([x[i][::every] for i in which]) for x in (session.inputs, session.outputs))
        return concealed_nominal.fit(start, handle, outputs, self.sigma, robust=robust)

    def residuals(self, p: Array, session: NoiselessRecordings) -> list[Array]:
        """Recorded minus nominal per recording, (n, channels), SI."""
        if isinstance(self.case, GenericCase):
            return [
                y - concealed_generic.predict(self.kind, p, u, self.period_s)
                for u, y in zip(session.inputs, session.outputs, strict=True)
            ]
        return [concealed_nominal.residual(p, u, y) for u, y in zip(session.inputs, session.outputs, strict=True)]

    def apart(self, model: Array, outputs: Array) -> Array:
        """Outputs minus model, (n, channels), SI."""
        return outputs - model if isinstance(self.case, GenericCase) else concealed_nominal.apart(model, outputs)

    def noisy(self, session: NoiselessRecordings, rng: np.random.Generator) -> NoiselessRecordings:
        """The session as devices record it: coloured noise on every channel, samples lost in bursts."""
        share, correlation = rng.uniform(0.0, 0.4), rng.uniform(0.04, 0.25)
        drops, burst = rng.uniform(0.002, 0.03), rng.uniform(1.5, 5.0)
        outputs = []
        for y in session.outputs:
            noise = coloured(rng, (len(y), len(self.channels)), self.sigma, share, correlation, self.period_s)
            outputs.append(self._disturbed(y, noise, [lost(rng, len(y), drops, burst) for _ in range(2)]))
        return NoiselessRecordings(session.time_s, session.inputs, tuple(outputs))

    def _disturbed(self, y: Array, noise: Array, gone: list[Array]) -> Array:
        if isinstance(self.case, GenericCase):
            out = y + noise
            out[gone[0]] = np.nan
            return np.asarray(out)
        out = y.copy()
        for tool in range(2):
            at, n = 7 * tool, 6 * tool
            out[:, at : at + 3] += noise[:, n : n + 3]
            out[:, at + 3 : at + 7] = _turned(y[:, at + 3 : at + 7], noise[:, n + 3 : n + 6])
            out[gone[tool], at : at + 7] = np.nan
        out[:, 14:] += noise[:, 12:]
        return out


class Warp:
    """An effect outside every library between handle and rig, evaluated step by step."""

    def __init__(self, planted: Sequence[ScaledEffect]) -> None:
        self._planted, self._last, self._rate = planted, np.zeros(0), np.zeros(3)
        self._play = math.nan

    def __call__(self, handle: Array, dt_s: float) -> Array:
        """Return the handle positions (3,) that reach the rig in this step."""
        if self._last.size == 0:
            self._last = handle.copy()
        self._rate += ((handle - self._last) / dt_s - self._rate) * (1.0 - math.exp(-dt_s / 0.01))
        self._last = handle.copy()
        out = handle.copy()
        for p in self._planted:
            out[("insertion", "roll", "knob").index(p.effect.port)] += p.parameters["size"] * self._value(
                p.effect.form, handle
            )
        return out

    def _value(self, form: str, handle: Array) -> float:
        roll = float(handle[1])
        if form.startswith("play"):
            self._play = roll if math.isnan(self._play) else min(max(self._play, roll - 0.25), roll + 0.25)
            return self._play
        text = form
        for name, value in zip(_HANDLE, self._rate, strict=True):
            text = text.replace(f"rate({name})", f"({float(value)!r})")
        names = {"sin": math.sin, "cos": math.cos, "abs": abs, **dict(zip(_HANDLE, handle, strict=True))}
        return float(eval(text, {"__builtins__": {}}, names))


def _turned(q: Array, v: Array) -> Array:
    """Quaternions (n, 4) turned in their own frame by small rotation vectors (n, 3)."""
    w, x, y, z = np.ones(len(v)), *(0.5 * v.T)
    a, b, c, d = q.T
    out = np.column_stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ]
    )
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))


def rig(case: RigCase) -> System:
    """Return the system of a catheter rig."""
    return System("rig", case, concealed_rig.CHANNELS, case.sigma, concealed_rig.FRAME_S)


def generic(case: GenericCase) -> System:
    """Return the system of a plain mechanism."""
    return System(case.kind, case, concealed_generic.OUTPUTS[case.kind], case.sigma, case.period_s)


def columns(system: System, session: NoiselessRecordings, i: int) -> dict[str, Array]:
    """Columns of recording i as they are written."""
    out: dict[str, Array] = {"time_s": np.round(session.time_s[i], 6)}
    if isinstance(system.case, GenericCase):
        names = [*concealed_generic.INPUTS[system.kind], *concealed_generic.OUTPUTS[system.kind]]
    else:
        names = list(_HANDLE)
        for tool in ("tip", "shaft"):
            names += [f"{tool}_{part}" for part in ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")]
        names += ["force_x_N", "force_y_N", "force_z_N"]
    values = np.hstack([session.inputs[i], session.outputs[i]])
    return out | {name: values[:, k] for k, name in enumerate(names)}


def write(system: System, session: NoiselessRecordings, calibrated: Array, folder: Path, parquet: bool) -> None:
    """Recordings a, b, c (c is held out) and nominal.toml into `folder`."""
    import pyarrow as pa
    from pyarrow import csv
    from pyarrow import parquet as pq

    folder.mkdir(parents=True, exist_ok=True)
    ending = "parquet" if parquet else "csv"
    for i, name in enumerate("abc"):
        arrays = {
            k: pa.array(np.where(np.isnan(v), 0.0, _rounded(v)), mask=np.isnan(v))
            for k, v in columns(system, session, i).items()
        }
        table = pa.table(arrays)
        if parquet:
            pq.write_table(table, folder / f"{name}.parquet")
        else:
            csv.write_csv(table, folder / f"{name}.csv")
    (folder / "nominal.toml").write_text(nominal_toml(system, calibrated, f"c.{ending}"), encoding="utf-8")


def _rounded(v: Array) -> Array:
    """Eight significant digits are more than any device has."""
    size = np.where(np.isfinite(v) & (v != 0.0), np.abs(v), 1.0)
    scale = 10.0 ** (7 - np.floor(np.log10(size)))
    return np.asarray(np.round(v * scale) / scale)


_LINKS = """[[link]]
subsystem = "roll"
input = "motor_a_rad"
output = "tip_a_rad"
load = ["load_a_Nm"]
others = ["motor_b_rad"]

[[link]]
subsystem = "knob"
input = "motor_b_rad"
output = "tip_b_rad"
others = ["motor_a_rad"]
"""
_AXIS = """[axis]
subsystem = "knob"
input = "drive_N"
output = "position_m"
terms = ["mass", "damping", "stiffness", "offset"]
hold = "linear"
reads = "position"
"""
_IMPEDANCE = """[impedance]
subsystem = "contact"
input = "motion_m"
output = "force_N"
terms = ["mass", "damping", "stiffness", "offset"]
"""


def nominal_toml(system: System, calibrated: Array, heldout: str) -> str:
    """The nominal model of a case as docs/nominal-models.md describes it, with parameters as calibrated."""
    head = f'name = "concealed case"\nkind = "{system.kind}"\n\n[data]\ntime = "time_s"\nheldout = ["{heldout}"]\n\n'
    if system.kind == "rig":
        values: dict[str, Any] = dict(zip(concealed_nominal.PARAMETERS, calibrated, strict=True))
        body = (
            f"[rig]\ndistal_length_m = {concealed_nominal.DISTAL_M}\n"
            f"shaft_sensor_offset_m = {concealed_nominal.SHAFT_OFFSET_M}\n"
            f"torsion_to_bending = {concealed_nominal.TORSION_TO_BENDING}\nwall_normal = [0.0, 0.0, 1.0]\n"
        )
        return head + body + "\n[parameters]\n" + "".join(f"{k} = {_digits(v)}\n" for k, v in values.items())
    names = {
        "transmission": (*concealed_generic.INPUTS["transmission"], *concealed_generic.OUTPUTS["transmission"]),
        "axis": ("drive_N", "position_m"),
        "impedance": ("motion_m", "force_N"),
    }[system.kind]
    channels = "".join(f'[channels.{n}]\ncolumn = "{n}"\nunit = "{n.rpartition("_")[2]}"\n\n' for n in names)
    return head + channels + {"transmission": _LINKS, "axis": _AXIS, "impedance": _IMPEDANCE}[system.kind]


def _digits(value: float) -> str:
    """Four significant digits, as a calibration sheet gives them."""
    text = f"{value:.4g}"
    return text if any(c in text for c in ".en") else text + ".0"
