"""Everyday arrays through the public function: each verdict states the truth, or states what it cannot tell.

A case that the finder does not yet pass is marked as a strict failure with what it finds; it turns red when it passes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from host.diagnosis import diagnose
from protocol.errors import InputError
from tests.host.proof import everyday as make

CONFIDENT = 0.9
Build = Callable[[], tuple[list[Any], dict[str, Any]]]


@dataclass(frozen=True)
class Case:
    """Recordings with a nominal model, and what is true of them.

    truth: ids of the effect that is there, empty where nothing is missing. findings: ids of what is wrong with the data, one
    of which has to be said. parameters: nominal values to be met within 5 % or inside the interval. undecided: the data
    cannot decide, so that a confident single name is wrong.
    """

    build: Build
    truth: tuple[str, ...] = ()
    findings: tuple[str, ...] = ()
    parameters: tuple[tuple[str, float], ...] = ()
    undecided: bool = False


MASS = (("mass", make.MASS_kg), ("damping", make.DAMPING))
SPRUNG = (*MASS, ("stiffness", make.STIFFNESS))
CASES: dict[str, Case] = {}


def case(name: str, build: Build, **more: Any) -> None:
    """Add a case to CASES under its name; `more`: the other fields of `Case`."""
    assert name not in CASES
    CASES[name] = Case(build, **more)


def _changed(columns: dict[str, Any], **new: Callable[[Any], Any]) -> dict[str, Any]:
    return {**columns, **{name: change(columns[name].copy()) for name, change in new.items()}}


def _marred(values: Any, change: Callable[[Any, Any], None], number: int = 0) -> Any:
    change(values, make.stream(900 + number))
    return values


# --- nothing missing: a sprung mass in every hold and reads, cut from motion ---
for hold in ("zero", "linear", "band_limited"):
    for reads in ("position", "velocity", "acceleration"):
        case(
            f"sprung {hold} {reads}",
            lambda hold=hold, reads=reads: (  # type: ignore[misc]
                [make.sprung(k, hold, reads) for k in (1, 2)],
                make.axis_nominal(hold, reads),
            ),
            parameters=SPRUNG,
        )
case("plain mass and damper", lambda: ([make.free_mass(1), make.free_mass(2)], make.free_nominal()), parameters=MASS)
case("plain mass and damper, one recording", lambda: ([make.free_mass(3)], make.free_nominal()), parameters=MASS)
case("plain mass and damper, three seconds", lambda: ([make.free_mass(k, seconds=3.0) for k in (1, 2)], make.free_nominal()))
case("gear", lambda: ([make.gear(1), make.gear(2)], make.gear_nominal()), parameters=(("gain", 0.4),))
case("gear of one recording", lambda: ([make.gear(3)], make.gear_nominal()), parameters=(("gain", 0.4),))
case(
    "gear without a time column",
    lambda: ([{k: v for k, v in make.gear(n).items() if k != "t"} for n in (1, 2)], {**make.gear_nominal(), "data": {}}),
    parameters=(("gain", 0.4),),
)
case(
    "gear at two rates",
    lambda: ([make.gear(1), make.gear(2, rate_Hz=250.0)], make.gear_nominal()),
    parameters=(("gain", 0.4),),
)
case(
    "spring and damper",
    lambda: ([make.spring(1), make.spring(2)], make.spring_nominal()),
    parameters=(("stiffness", 200.0),),
)
case(
    "spring, damper and mass",
    lambda: ([make.spring(k, mass_kg=0.4) for k in (1, 2)], make.spring_nominal("mass", "damping", "stiffness", "offset")),
    parameters=(("stiffness", 200.0),),
)
case(
    "sprung mass, samples lost",
    lambda: (
        [
            _changed(make.sprung(k), x=lambda v: _marred(v, lambda a, r: a.__setitem__(r.random(a.size) < 0.2, np.nan)))
            for k in (1, 2)
        ],
        make.axis_nominal(),
    ),
    parameters=SPRUNG,
)
case(
    "gear with jittering stamps",
    lambda: ([_jittered(1), _jittered(2)], make.gear_nominal()),
    parameters=(("gain", 0.4),),
)


def _jittered(number: int) -> dict[str, Any]:
    rng, t = make.stream(number), np.arange(0.0, 20.0, 0.01)
    t = t + rng.uniform(-0.004, 0.004, t.size)
    motor = 1.5 * make.tones(rng, t, 1.5)
    return {"t": t, "motor": motor, "load": 0.4 * motor + 2e-3 * rng.standard_normal(t.size)}


# --- one effect ---
for hold in ("zero", "linear"):
    case(
        f"sprung mass with dry friction, {hold}",
        lambda hold=hold: ([make.sprung(k, hold, coulomb_N=0.15) for k in (1, 2)], make.axis_nominal(hold)),  # type: ignore[misc]
        truth=("coulomb_friction",),
    )
case(
    "free mass with dry friction",
    lambda: ([make.free_mass(k, coulomb_N=0.2) for k in (1, 2)], make.free_nominal()),
    truth=("coulomb_friction",),
)
case(
    "free mass whose damping grows with the place squared",
    lambda: ([make.free_mass(k, by_place=400.0) for k in (1, 2)], make.free_nominal()),
    truth=("unlisted",),
)
case(
    "spring with dry friction",
    lambda: ([make.spring(k, coulomb_N=0.3) for k in (1, 2)], make.spring_nominal()),
    truth=("coulomb_friction",),
)
case(
    "gear with play",
    lambda: ([make.with_play(make.gear(k), 0.05) for k in (1, 2)], make.gear_nominal()),
    truth=("backlash",),
)
case(
    "gear with play, cut from motion",
    lambda: (
        [{k: v[700:] for k, v in make.with_play(make.gear(n, 30.0), 0.05).items()} for n in (1, 2)],
        make.gear_nominal(),
    ),
    truth=("backlash",),
)
case(
    "gear with a delay",
    lambda: ([make.with_delay(make.gear(k, fastest_Hz=4.0), 0.03) for k in (1, 2)], make.gear_nominal()),
    truth=("latency",),
)
case(
    "gear with a lag",
    lambda: ([make.with_lag(make.gear(k, fastest_Hz=6.0), 0.05) for k in (1, 2)], make.gear_nominal()),
    truth=("rate_lag", "viscous_friction"),
)
case(
    "gear with a delay of a second",
    lambda: ([make.with_delay(make.gear(k), 1.0) for k in (1, 2)], make.gear_nominal()),
    truth=("latency",),
)
case(
    "delay or lag, one slow tone",
    lambda: ([make.with_delay(make.gear(k, fastest_Hz=0.15, count=1), 0.05) for k in (1, 2)], make.gear_nominal()),
    truth=("latency",),
    undecided=True,
)
case(
    "no second term in the nominal model",
    lambda: ([make.spring(k) for k in (1, 2)], make.spring_nominal("stiffness", "offset")),
    truth=("viscous_friction", "rate_lag", "contact_viscous"),
)
case(
    "a spring that hardens",
    lambda: (
        [_changed_by(make.spring(k), lambda c: {"f": c["f"] + 4e4 * c["x"] ** 3}) for k in (1, 2)],
        make.spring_nominal(),
    ),
    truth=("nonlinear_stiffness", "contact_nonlinear", "static_nonlinearity"),
)
case(
    "a force sensor that drifts",
    lambda: (
        [_changed_by(make.spring(k), lambda c: {"f": c["f"] + 0.02 * c["t"]}) for k in (1, 2)],
        make.spring_nominal(),
    ),
    truth=("sensor_drift",),
)


def _changed_by(columns: dict[str, Any], change: Callable[[dict[str, Any]], dict[str, Any]]) -> dict[str, Any]:
    return {**columns, **change(columns)}


# --- the data themselves ---
case(
    "sign of the force",
    lambda: ([_changed(make.free_mass(k), f=np.negative) for k in (1, 2)], make.free_nominal()),
    findings=("sign",),
)
case(
    "sign of the spring's force",
    lambda: ([_changed(make.sprung(k), f=np.negative) for k in (1, 2)], make.axis_nominal()),
    findings=("sign",),
)
case(
    "millimetres called metres, mass held",
    lambda: (
        [_changed(make.sprung(k), x=lambda v: 1e3 * v) for k in (1, 2)],
        make.axis_nominal(mass={"value": 0.5, "free": False}, damping=3.0, stiffness=120.0),
    ),
    findings=("unit",),
)
case(
    "degrees called radians",
    lambda: ([_changed(make.gear(k), load=np.rad2deg) for k in (1, 2)], make.gear_nominal(gain=0.4)),
    findings=("unit",),
)
case(
    "millinewtons called newtons",
    lambda: (
        [_changed(make.spring(k), f=lambda v: 1e3 * v) for k in (1, 2)],
        {**make.spring_nominal(), "parameters": {"stiffness": 200.0, "damping": 4.0}},
    ),
    findings=("unit",),
)
case(
    "columns swapped",
    lambda: (
        [{"t": c["t"], "f": c["x"], "x": c["f"]} for c in (make.sprung(1), make.sprung(2))],
        make.axis_nominal(mass=0.5, damping=3.0, stiffness=120.0),
    ),
    findings=("swapped", "unit"),
)
case("output is the input", lambda: ([_copied(k, 0.0) for k in (1, 2)], make.gear_nominal()), findings=("alias",))
case(
    "output is the input, late",
    lambda: ([_copied(k, 0.05) for k in (1, 2)], make.gear_nominal()),
    truth=("latency",),
    findings=("alias",),
)


def _copied(number: int, late_s: float) -> dict[str, Any]:
    columns = make.gear(number)
    return {**columns, "load": np.interp(columns["t"] - late_s, columns["t"], columns["motor"])}


case(
    "input does not move",
    lambda: ([_changed(make.gear(k), motor=np.zeros_like) for k in (1, 2)], make.gear_nominal()),
    findings=("constant", "excitation"),
)
case(
    "output does not move",
    lambda: ([_changed(make.gear(k), load=np.zeros_like) for k in (1, 2)], make.gear_nominal()),
    findings=("constant",),
)
case(
    "output all missing",
    lambda: ([_changed(make.gear(k), load=lambda v: v * np.nan) for k in (1, 2)], make.gear_nominal()),
    findings=("missing",),
)
case(
    "input all missing",
    lambda: ([_changed(make.sprung(k), f=lambda v: v * np.nan) for k in (1, 2)], make.axis_nominal()),
    findings=("missing",),
)
case(
    "one tone cannot tell mass from stiffness",
    lambda: ([_one_tone(k) for k in (1, 2)], make.axis_nominal()),
    findings=("excitation",),
)


def _one_tone(number: int) -> dict[str, Any]:
    rng, t = make.stream(number), np.arange(0.0, 20.0, 0.01)
    w = 2 * np.pi * 0.8
    gain = 1.0 / (make.STIFFNESS - make.MASS_kg * w**2 + 1j * make.DAMPING * w)
    x = np.real(gain * np.exp(1j * w * t))
    return {"t": t, "f": np.cos(w * t), "x": x + 5e-3 * np.std(x) * rng.standard_normal(t.size)}


case(
    "reading clips",
    lambda: (
        [_changed(make.sprung(k), x=lambda v: np.clip(v, -1.3 * np.std(v), 1.3 * np.std(v))) for k in (1, 2)],
        make.axis_nominal(),
    ),
    truth=("saturation",),
    findings=("saturated",),
)
case(
    "reading is coarse",
    lambda: ([_changed(make.gear(k), load=lambda v: np.round(v / 0.02) * 0.02) for k in (1, 2)], make.gear_nominal()),
    truth=("quantization",),
    findings=("quantized", "quantization", "saturated"),
)
case(
    "reading is very coarse",
    lambda: ([_changed(make.gear(k), load=lambda v: np.round(v / 0.2) * 0.2) for k in (1, 2)], make.gear_nominal()),
    truth=("quantization",),
    findings=("quantized",),
)
case(
    "wild samples",
    lambda: (
        [
            _changed(make.gear(k), load=lambda v: _marred(v, lambda a, r: a.__setitem__(r.integers(0, a.size, 15), 7.0)))
            for k in (1, 2)
        ],
        make.gear_nominal(),
    ),
    truth=("outlier",),
    findings=("outlier", "outliers", "missing"),
)
case(
    "wild samples of the input",
    lambda: (
        [
            _changed(make.gear(k), motor=lambda v: _marred(v, lambda a, r: a.__setitem__(r.integers(0, a.size, 15), 40.0)))
            for k in (1, 2)
        ],
        make.gear_nominal(),
    ),
    findings=("outliers",),
    parameters=(("gain", 0.4),),
)
case(
    "a code for lost readings",
    lambda: (
        [_changed(make.gear(k), load=lambda v: _marred(v, lambda a, r: _lost(a, r.integers(0, 1900, 8)))) for k in (1, 2)],
        make.gear_nominal(),
    ),
    findings=("outliers",),
    parameters=(("gain", 0.4),),
)


def _lost(values: Any, starts: Any) -> None:
    for first in starts:
        values[first : first + 8] = -5.0


case(
    "wild samples and play",
    lambda: (
        [
            _changed(
                make.with_play(make.gear(k), 0.05),
                load=lambda v: _marred(v, lambda a, r: a.__setitem__(r.integers(0, a.size, 15), 7.0)),
            )
            for k in (1, 2)
        ],
        make.gear_nominal(),
    ),
    truth=("backlash",),
    findings=("outliers",),
)
case(
    "counts called radians",
    lambda: ([_changed(make.gear(k), load=lambda v: np.round(v / 1.5e-3)) for k in (1, 2)], make.gear_nominal(gain=0.4)),
    findings=("unit",),
)
case(
    "milliseconds called seconds",
    lambda: (
        [_changed(make.free_mass(k), t=lambda v: 1e3 * v) for k in (5, 6)],
        {**make.free_nominal(), "parameters": {"mass": 0.5, "damping": 3.0}},
    ),
    findings=("unit",),
    parameters=MASS,
)
case(
    "columns of the spring swapped",
    lambda: ([{"t": c["t"], "x": c["f"], "f": c["x"]} for c in (make.spring(5), make.spring(6))], make.spring_nominal()),
    findings=("swapped",),
    parameters=(("stiffness", 200.0),),
)
case(
    "noisy output is the input, late by 5.3 samples",
    lambda: ([_noisy_copy(k) for k in (1, 2)], make.gear_nominal()),
    findings=("alias",),
)


def _noisy_copy(number: int) -> dict[str, Any]:
    columns = make.gear(number)
    motor = columns["motor"] + 0.01 * make.stream(number).standard_normal(columns["t"].size)
    return {**columns, "motor": motor, "load": np.interp(columns["t"] - 0.053, columns["t"], motor)}


case(
    "force held by a computer, called straight",
    lambda: ([make.sprung(k, "zero") for k in (1, 2)], make.axis_nominal("linear")),
    parameters=SPRUNG,
)
case(
    "two clocks",
    lambda: ([_changed_by(make.gear(k, fastest_Hz=4.0), _drifted) for k in (1, 2)], make.gear_nominal()),
    truth=("clock_drift",),
    findings=("clock",),
)


def _drifted(columns: dict[str, Any]) -> dict[str, Any]:
    late = np.interp(columns["t"] * (1 - 2e-3), columns["t"], columns["motor"])
    return {"load": columns["load"] + 0.4 * (late - columns["motor"])}


case(
    "a million rows",
    lambda: ([make.gear(1, 5000.0), make.gear(2, 5000.0)], make.gear_nominal()),
    parameters=(("gain", 0.4),),
)

# --- other fields: a thermal lag, a magnet, a servo on noise, three seconds of data ---
case("an oven's lag", lambda: ([make.oven(1), make.oven(2)], make.oven_nominal()), truth=("rate_lag",))
case(
    "a magnet: stiffness below zero, and dry friction",
    lambda: (
        [_changed_by(make.spring(k, coulomb_N=0.3), lambda c: {"f": c["f"] - 350.0 * c["x"]}) for k in (1, 2)],
        make.spring_nominal(),
    ),
    truth=("coulomb_friction",),
)
case(
    "a servo that reacts to the noise of the force",
    lambda: ([make.pressed_in_a_loop(k) for k in (1, 2, 3)], make.spring_nominal()),
    parameters=(("stiffness", 150.0),),
)
case(
    "sixty rows",
    lambda: ([make.gear(k, 3.0, rate_Hz=20.0) for k in (1, 2)], make.gear_nominal()),
    parameters=(("gain", 0.4),),
)
case(
    "whole numbers",
    lambda: (
        [{k: v if k == "t" else np.round(4096 * v).astype(int) for k, v in make.gear(n).items()} for n in (1, 2)],
        make.gear_nominal(),
    ),
    findings=("unit",),
    parameters=(("gain", 0.4),),
)

# What the finder says where it must not, one line a case.
FAILS: dict[str, str] = {}
SLOW = {  # over 2 s of processor time
    "a million rows",
    "sprung mass with dry friction, zero",
    "sprung mass with dry friction, linear",
    "free mass with dry friction",
    "free mass whose damping grows with the place squared",
    "gear with a delay of a second",
    "gear with a lag",
    "delay or lag, one slow tone",
    "no second term in the nominal model",
    "reading clips",
    "sprung zero velocity",
    "sprung linear velocity",
    "sprung band_limited velocity",
    "sprung zero acceleration",
    "sprung linear acceleration",
    "sprung band_limited acceleration",
    "an oven's lag",
    "plain mass and damper",
    "plain mass and damper, one recording",
    "plain mass and damper, three seconds",
    "force held by a computer, called straight",
    "sprung zero position",
    "sprung linear position",
    "sprung band_limited position",
    "one tone cannot tell mass from stiffness",
    "sign of the spring's force",
    "sprung mass, samples lost",
    "columns swapped",
    "millimetres called metres, mass held",
}


def _parameter(name: str) -> Any:
    marks = [pytest.mark.slow] if name in SLOW else []
    if name in FAILS:
        marks.append(pytest.mark.xfail(strict=True, reason=FAILS[name]))
    return pytest.param(name, id=name.replace(" ", "-").replace(",", ""), marks=marks)


def verdict_of(one: Case) -> dict[str, Any]:
    """The verdict as a dictionary; a refusal is one finding that says so."""
    recordings, nominal = one.build()
    try:
        return diagnose(recordings, nominal).as_dict()
    except InputError as error:
        return {"verdict": "refused", "effects": [], "data_findings": [{"id": "refused", "channel": "", "says": str(error)}]}


def complaints(one: Case, verdict: dict[str, Any]) -> list[str]:
    """Everything in `verdict` that is not true of the case, or that it should have said."""
    out = []
    effects, findings = verdict["effects"], verdict.get("data_findings") or []
    found = {f["id"] for f in findings}
    said = set(one.findings) & found or (verdict["verdict"] == "refused" and bool(one.findings))
    for effect in effects:
        among = {effect["id"], *(str(other).partition("@")[0] for other in effect["indistinguishable_from"])}
        if effect.get("probability", 1.0) >= CONFIDENT and not among & set(one.truth):
            out.append(f"{effect['id']} is named with probability {effect.get('probability', 1.0)}")
        if one.undecided and effect.get("probability", 1.0) >= CONFIDENT and len(among) == 1:
            out.append(f"{effect['id']} alone, though the data cannot decide")
    if one.findings and not said and not (one.truth and any(e["id"] in one.truth for e in effects)):
        out.append(f"no finding {' or '.join(one.findings)}; verdict {verdict['verdict']}, findings {sorted(found)}")
    if not one.findings and verdict["verdict"] == "refused":
        out.append(findings[0]["says"])
    if one.truth and not one.findings and verdict["verdict"] == "nothing_missing":
        out.append("nothing missing")
    if not one.truth and not one.findings and verdict["verdict"] not in ("nothing_missing", "refused"):
        out.append(verdict["verdict"])
    return out + _off(one, verdict)


def _off(one: Case, verdict: dict[str, Any]) -> list[str]:
    """Nominal parameters that are neither within 5 % of the truth nor have it in their interval."""
    out = []
    fitted = (verdict.get("fit") or {}).get("nominal_parameters") or {}
    for name, true in one.parameters:
        key = next((k for k in fitted if k == name or k.startswith(f"{name}_")), None)
        if key is None:
            out.append(f"no {name}")
            continue
        value, (low, high) = fitted[key]["value"], fitted[key]["ci95"]
        inside = low is not None and high is not None and low <= true <= high
        if abs(value / true - 1.0) > 0.05 and not inside:
            out.append(f"{name} {value:.4g} instead of {true}")
    return out


@pytest.mark.parametrize("name", [_parameter(name) for name in CASES])
def test_the_verdict_is_true_or_says_what_it_cannot_tell(name: str) -> None:
    one = CASES[name]
    assert complaints(one, verdict_of(one)) == []


def test_there_are_enough_cases_and_every_listed_failure_is_one() -> None:
    assert len(CASES) >= 40
    assert set(FAILS) <= set(CASES)


# --- input that cannot be used: one line with the key ---
REFUSED: dict[str, tuple[Build, str]] = {
    "a column that is not there": (
        lambda: ([{"t": np.arange(100) / 10, "motor": np.ones(100)}], make.gear_nominal()),
        "load",
    ),
    "columns of two lengths": (
        lambda: ([{**make.gear(1), "load": np.ones(7)}, make.gear(2)], make.gear_nominal()),
        "rows|load|long|length",
    ),
    "a time that runs back": (
        lambda: ([_changed(make.gear(1), t=lambda v: v[::-1].copy()), make.gear(2)], make.gear_nominal()),
        "time|increas",
    ),
    "too few rows": (lambda: ([{k: v[:5] for k, v in make.gear(1).items()}], make.gear_nominal()), "rows"),
    "a key that is misspelt": (lambda: ([make.gear(1)], {**make.gear_nominal(), "chanels": {}}), "chanels"),
    "a kind that is not known": (lambda: ([make.gear(1)], {**make.gear_nominal(), "kind": "gearbox"}), "kind"),
    "no recording": (lambda: ([], make.gear_nominal()), "recording"),
    "text instead of numbers": (
        lambda: ([{**make.gear(1), "load": np.full(2000, "a")}], make.gear_nominal()),
        "load|number|numeric",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_bad_input_is_one_line_with_the_key(name: str) -> None:
    build, wanted = REFUSED[name]
    recordings, nominal = build()
    with pytest.raises(InputError, match=wanted) as refused:
        diagnose(recordings, nominal)
    assert "\n" not in str(refused.value)
