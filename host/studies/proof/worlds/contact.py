"""World `contact`: the catheter pressed on a moving curved wall, forces out of the bending plane, large deflections.

The wall's force is recorded and loads the nominal rod, so that a moving wall is nothing missing. What is planted acts
between handle and catheter, or loads the tip.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from host.studies.proof.worlds import ode, rod, signals, windows
from host.studies.proof.worlds import operators as op
from host.studies.proof.worlds.case import (
    Columns,
    Make,
    Mechanism,
    Plantable,
    Planted,
    Scales,
    SeparateRecordings,
    Setup,
    Trace,
)
from host.studies.proof.worlds.nominal_rod import DISTAL_M, NAMES, TORSION_TO_BENDING, tips

Array = np.ndarray
AXES = ("insertion", "roll", "knob")
REACH = (3e-3, 0.5, 0.12)  # usual amplitude of each handle motion (m, rad, rad)
_CHOSEN = (
    "backlash", "presliding_friction", "rate_lag", "latency", "creep_relaxation", "static_nonlinearity", "dead_zone",
    "periodic_disturbance", "missed_steps", "coupling",
)  # fmt: skip


def _sized(make: Make, reach: float) -> Make:
    return lambda s, c: make(s, replace(c, motion=reach))


def _handle_effects() -> tuple[Plantable, ...]:
    found = []
    for place, reach in zip(AXES, REACH, strict=True):
        for effect in ode.motion_effects(place, others=True, loads=False):
            if effect.id in _CHOSEN and not (place == "knob" and effect.id == "dead_zone"):
                same = (*effect.same, "whip") if effect.id == "periodic_disturbance" else effect.same
                found.append(replace(effect, make=_sized(effect.make, reach), same=same))
    return tuple(found)


class Pressed(SeparateRecordings):
    """Catheter on a sphere that moves with heart and breath."""

    name: str = "rod"
    outputs: tuple[str, ...] = ("tip_x_m", "tip_y_m", "tip_z_m")
    effects: tuple[Plantable, ...] = _handle_effects()
    outside: tuple[Plantable, ...] = (
        Plantable(
            "unlisted",
            "tip",
            lambda s, c: {"x_N": 2e-3 * s, "z_N": -4e-3 * s},
            same=("gravity_load",),
            says="weight at the tip",
        ),
        Plantable(
            "unlisted",
            "insertion",
            lambda s, c: {"product": 2e-4 * s},
            signed=True,
            says="insertion goes with roll times knob",
        ),
    )

    def draw(self, rng: np.random.Generator, closed_loop: bool) -> Setup:
        """Draw catheter, wall, sampling and noise."""
        rate, duration = float(rng.uniform(25.0, 80.0)), float(rng.uniform(9.0, 14.0))
        fastest = float(rng.uniform(0.6, 1.2))
        stamps = tuple(signals.stamps(rng, rate, duration, 0.0) for _ in range(3))
        slow = 1.0 / (2.0 * np.pi * fastest)
        scales = Scales(REACH[0], 0.1, REACH[0] / slow, slow, duration, 1.0 / rate)
        values = (
            float(rng.uniform(-0.068, -0.062)),
            float(rng.uniform(0.85, 1.1)),
            float(rng.uniform(26, 32)),
            float(rng.uniform(5e-4, 1.2e-3)),
        )
        sigma = dict.fromkeys(self.outputs, float(rng.uniform(1e-4, 2.5e-4)))
        style = {
            "fastest_Hz": fastest,
            "knob_rad": float(rng.uniform(0.4, 0.6)),
            "beat_Hz": float(rng.uniform(0.9, 1.4)),
            "beat_m": float(rng.uniform(5e-4, 1.5e-3)),
            "breath_m": float(rng.uniform(1e-3, 3e-3)),
            "radius_m": float(rng.uniform(0.015, 0.06)),
            "stiffness_N_per_m": float(rng.uniform(200.0, 600.0)),
            "aside_m": float(rng.uniform(-6e-3, 6e-3)),
        }
        lost = float(rng.uniform(0.002, 0.02)) if rng.random() < 0.4 else 0.0
        parameters = dict(zip(NAMES, values, strict=True))
        return Setup.drawn(rng, scales, stamps, closed_loop, sigma, parameters, style, lost=lost)

    def _one(self, setup: Setup, planted: Sequence[Planted], i: int) -> Trace:
        stamps, style = setup.stamps[i], setup.style
        grid, h = windows.fine_grid(setup, i)
        commands = [r * windows.command(setup, i, k)(grid) for k, r in enumerate(REACH)]
        commands[2] = commands[2] + style["knob_rad"]
        wanted = np.column_stack([np.interp(stamps, grid, x) for x in commands])
        handle, shift = wanted, np.zeros(stamps.size)
        target = self._tip(setup, (), i, grid, h, commands, shift)[0][:, 2] if setup.closed_loop else shift
        noise = setup.noise(i, "tip_z_m")
        for turn in range(6 if setup.closed_loop else 1):
            tip, force = self._tip(setup, planted, i, grid, h, commands, shift)
            if not setup.closed_loop:
                break
            # the insertion corrects the height by the noisy reading of two samples ago
            error = target - tip[:, 2] - noise
            late = np.concatenate((np.zeros(2), error[:-2]))
            now = 0.4 * op.lag(late, setup.scales.period_s, 0.3)
            change, shift = float(np.max(np.abs(now - shift))), now
            if change < 0.02 * setup.sigma["tip_z_m"]:
                break
            if turn == 5:
                raise ValueError("loop: found no stable correction, wanted one that settles")
        handle = wanted + np.column_stack([shift, np.zeros_like(shift), np.zeros_like(shift)])
        columns = {
            f"{name}_{unit}": handle[:, k] for k, (name, unit) in enumerate(zip(AXES, ("m", "rad", "rad"), strict=True))
        }
        columns |= {f"force_{a}_N": force[:, k] for k, a in enumerate("xyz")}
        return Trace(columns | {name: tip[:, k] for k, name in enumerate(self.outputs)})

    def _tip(
        self,
        setup: Setup,
        planted: Sequence[Planted],
        i: int,
        grid: Array,
        h: float,
        commands: Sequence[Array],
        shift: Array,
    ) -> tuple[Array, Array]:
        """Return tip (n, 3) and force (n, 3) at the stamps, with the insertion corrected by shift (n,)."""
        stamps, style, law = setup.stamps[i], setup.style, setup.parameters
        given = [commands[0] + np.interp(grid, stamps, shift, left=shift[0], right=shift[-1]), *commands[1:]]
        moved = list(given)
        weight = np.zeros(3)
        for one in planted:
            q = one.parameters
            if one.effect.place == "tip":
                weight = np.array([q["x_N"], 0.0, q["z_N"]])
            elif "product" in q:
                moved[0] = moved[0] + q["product"] * given[1] * (given[2] - style["knob_rad"]) / (REACH[1] * REACH[2])
            else:
                k = AXES.index(one.effect.place)
                other = given[1 if k != 1 else 0] / REACH[1 if k != 1 else 0] * REACH[k]
                middle = style["knob_rad"] if k == 2 else 0.0
                c = replace(setup.scales, motion=REACH[k])
                moved[k] = middle + ode.moved(moved[k] - middle, other, other, h, grid, [one], c)
        handle = np.column_stack([np.interp(stamps, grid, x) for x in moved])
        p = np.array([*(law[name] for name in NAMES), TORSION_TO_BENDING, DISTAL_M])
        tip, force, good = rod.session(
            p, handle, self._centre(setup, i), np.array([style["radius_m"], style["stiffness_N_per_m"]]), weight
        )
        if not good:
            raise ValueError("rod: found no equilibrium, wanted one")
        return tip, force

    def _centre(self, setup: Setup, i: int) -> Array:
        """Return the sphere's centre (n, 3): in front of the tip's usual place and aside, moving with beat and breath."""
        t, s = setup.stamps[i], setup.style
        rng = setup.stream(i, 8)
        bend = setup.parameters["knob_gain_per_m_rad"] * s["knob_rad"]
        length = DISTAL_M + setup.parameters["insertion_offset_m"]
        usual = np.array([0.0, -(1.0 - np.cos(bend * length)) / bend, np.sin(bend * length) / bend])
        beat = np.maximum(np.sin(2.0 * np.pi * s["beat_Hz"] * t + rng.uniform(0, 6.0)), 0.0) ** 2
        breath = np.sin(2.0 * np.pi * 0.25 * t + rng.uniform(0, 6.0))
        away = s["radius_m"] + 5e-4 - s["beat_m"] * beat - s["breath_m"] * breath
        up = np.array([s["aside_m"] / s["radius_m"], -0.3, 1.0])
        return np.asarray(usual + np.multiply.outer(away, up / np.linalg.norm(up)))

    def left(self, setup: Setup, traces: Sequence[Trace]) -> list[Columns]:
        """Return what the nominal rod, refitted by two Gauss-Newton steps, leaves."""
        p, scale = (
            dict(setup.parameters),
            {"insertion_offset_m": 1e-3, "roll_slope": 0.02, "knob_gain_per_m_rad": 0.3, "bending_stiffness_Nm2": 2e-5},
        )

        def apart(at: dict[str, float]) -> list[Array]:
            found = [tips(t.channels, at, stamps) for t, stamps in zip(traces, setup.stamps, strict=True)]
            return [
                np.column_stack([t.channels[n] - f[n] for n in self.outputs]) for t, f in zip(traces, found, strict=True)
            ]

        for _ in range(2):
            now = apart(p)
            columns = []
            for name, step in scale.items():
                ahead = apart({**p, name: p[name] + 0.1 * step})
                columns.append(np.concatenate([(a - b).ravel() for a, b in zip(ahead[:-1], now[:-1], strict=True)]) / 0.1)
            found = np.linalg.lstsq(np.column_stack(columns), -np.concatenate([r.ravel() for r in now[:-1]]), rcond=None)[0]
            p = {name: p[name] + float(np.clip(f, -5.0, 5.0)) * scale[name] for name, f in zip(scale, found, strict=True)}
        return [dict(zip(self.outputs, r.T, strict=True)) for r in apart(p)]

    def nominal(self, setup: Setup) -> dict[str, Any]:
        """Return the nominal file's content; parameters as a calibration sheet gives them, three digits."""
        inputs = ["insertion_m", "roll_rad", "knob_rad", "force_x_N", "force_y_N", "force_z_N"]
        return {
            "name": "catheter in contact",
            "kind": "callable",
            "channels": windows.channels(*inputs, *self.outputs),
            "callable": {
                "function": "host.studies.proof.worlds.nominal_rod:tips",
                "inputs": inputs,
                "outputs": list(self.outputs),
                "subsystem": "catheter",
                "load": ["force_x_N", "force_y_N", "force_z_N"],
            },
            "parameters": {k: float(f"{v:.3g}") for k, v in setup.parameters.items()},
        }


MECHANISMS: tuple[Mechanism, ...] = (Pressed(),)
