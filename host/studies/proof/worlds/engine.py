"""World `mujoco`: servo joints with gear play, belts, sliders on a floor, pads, a two-link arm, all run by MuJoCo.

What is planted is MuJoCo's own: tendon limits, tendon springs, frictionloss, contact with cone friction, actuator dynamics,
joint equalities with polynomial ratios, bodies that hang on. Needs the extra `[mujoco]`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from host.studies.proof.worlds import ode, signals, windows
from host.studies.proof.worlds.case import Columns, Mechanism, Plantable, Planted, Scales, SeparateRecordings, Setup, Trace
from host.studies.proof.worlds.nominal_arm import torques

Array = np.ndarray
STEP_S = 1e-3
LOAD_kg_m2 = 1e-3  # inertia of a gear's load
UNTWISTED = 2e-4  # twist of a shaft over the load's motion: a tenth of the least noise
SOFT = 1e-3  # impedance of a soft contact: the share of the acceleration without contact that the contact takes away
_HEAD = f'<option timestep="{STEP_S}" gravity="{{gravity}}" integrator="implicitfast"/>'
Control = Callable[[int, Any], None]  # (step, data): sets the controls


def simulate(xml: str, steps: int, control: Control, read: Callable[[Any], tuple[float, ...]]) -> Array:
    """Return (steps, k) readings of a MuJoCo model, each taken before its step. Raises ValueError where it diverges."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    rows = []
    for step in range(steps):
        control(step, data)
        mujoco.mj_forward(model, data)
        rows.append(read(data))
        mujoco.mj_step(model, data)
    out = np.array(rows)
    if not np.all(np.isfinite(out)):
        raise ValueError("mujoco: found a state that is not finite, wanted a stable run")
    return out


def sampling(
    rng: np.random.Generator, steps: Sequence[int] = (1, 2, 4, 5, 10)
) -> tuple[Scales, tuple[Array, ...], float, int]:
    """Return scales with motion and force 1, stamps of the recordings, fastest excitation (Hz), steps between samples."""
    every = int(rng.choice(steps))
    rate = 1.0 / (STEP_S * every)
    duration = float(rng.uniform(max(1.5, 500.0 / rate), max(2.5, min(8.0, 4000.0 / rate))))
    fastest = min(float(rng.uniform(6.0, 14.0)) / duration, rate / 25.0)
    stamps = tuple(signals.stamps(rng, rate, duration, 0.0) for _ in range(2 if rng.random() < 0.4 else 3))
    slow = 1.0 / (2.0 * np.pi * fastest)
    return Scales(1.0, 1.0, 1.0 / slow, slow, duration, every * STEP_S), stamps, fastest, every


def _clock(setup: Setup, i: int) -> tuple[Array, int]:
    """Return the engine's times (steps,), s from the recording's begin, and how many lie before it."""
    every = setup.style["every"]
    lead = every * round(min(1.5, 0.5 * setup.scales.duration_s) / (every * STEP_S))
    steps = lead + every * (setup.stamps[i].size - 1) + 1
    return (np.arange(steps) - lead) * STEP_S, lead


def _place(position: float, speed: float) -> float:
    """Return the position at the step's begin to second order: MuJoCo's Euler step moves with the speed after the step."""
    return position - 0.5 * STEP_S * speed


def _around(force: Array) -> Array:
    """Return the force (n,) about each step's begin: a command that is held over a step jumps there."""
    return np.asarray(0.5 * (force + np.concatenate((force[:1], force[:-1]))))


def _only(planted: Sequence[Planted], name: str) -> dict[str, float]:
    """Return the parameters of the planted effect `name`, or nothing."""
    return next((p.parameters for p in planted if p.effect.id == name or p.effect.says == name), {})


_GEAR = "gear"
_GEAR_EFFECTS = (
    Plantable("backlash", _GEAR, lambda s, c: {"width_rad": 0.06 * c.motion * s}, compared=("width_rad",)),
    Plantable("compliance", _GEAR, lambda s, c: {"deflection_rad": 0.05 * c.motion * s}),
    Plantable("latency", _GEAR, lambda s, c: {"delay_s": 0.15 * c.slow_s * s}, compared=("delay_s",)),
    Plantable("static_nonlinearity", _GEAR, lambda s, c: {"cubic": 0.1 * s}, signed=True),
    Plantable(
        "resonance",
        _GEAR,
        lambda s, c: {"frequency_Hz": 1.0 / (2.0 * np.pi * c.slow_s * 0.3 * max(s, 0.02) ** 0.5)},
        same=("compliance",),  # the spring of the load also gives way to the recorded torque
        compared=("frequency_Hz",),
    ),
    Plantable(
        "gravity_load",
        _GEAR,
        lambda s, c: {"share": 0.05 * s},
        same=("whip", "static_nonlinearity", "periodic_disturbance"),
    ),
)
_GEAR_OUTSIDE = (
    Plantable("unlisted", _GEAR, lambda s, c: {"size": 0.05 * s}, says="stiffness that the other motor changes"),
    Plantable("unlisted", _GEAR, lambda s, c: {"size": 0.05 * s}, signed=True, says="ratio that the load torque changes"),
)


class Gear(ode.Link):
    """Servo joint behind a gear or belt: motor angle in, load angle out."""

    name = "gear"
    outputs: tuple[str, ...] = ("load_rad",)
    effects: tuple[Plantable, ...] = _GEAR_EFFECTS
    outside: tuple[Plantable, ...] = _GEAR_OUTSIDE

    def draw(self, rng: np.random.Generator, closed_loop: bool) -> Setup:
        """Draw ratio, sampling and noise; the servo's loop is about the motor and reads no load encoder."""
        scales, stamps, fastest, every = sampling(rng)
        motion = float(rng.uniform(0.4, 2.5))
        scales = Scales(
            motion, float(rng.uniform(0.02, 0.5)), motion / scales.slow_s, scales.slow_s, scales.duration_s, scales.period_s
        )
        gain = float(rng.uniform(0.3, 1.5))
        sigma = {"load_rad": gain * motion * float(np.exp(rng.uniform(np.log(2e-3), np.log(1e-2))))}
        style = {"fastest_Hz": fastest, "every": every}
        parameters = {"gain": gain, "offset": 0.0}
        return Setup.drawn(rng, scales, stamps, closed_loop, sigma, parameters, style)

    def _one(self, setup: Setup, planted: Sequence[Planted], i: int) -> Trace:
        c, (time_s, lead), gain = setup.scales, _clock(setup, i), setup.parameters["gain"]
        wanted = c.motion * windows.command(setup, i, 0)(time_s)
        other = windows.command(setup, i, 1)(time_s)
        pressed = windows.command(setup, i, 2)(time_s)
        load = self._torque(setup, planted) * pressed
        xml, pull = self._xml(setup, planted), self._pull(setup, planted)
        noise = np.repeat(setup.noise(i, "load_rad"), setup.style["every"])
        slow = [0.0]

        def control(step: int, data: Any) -> None:
            correction = 0.0
            if setup.closed_loop and step > lead + 5:  # the outer loop reads the noisy load encoder 5 ms late
                at = min(step - lead - 5, noise.size - 1)
                slow[0] += 0.01 * ((gain * wanted[step] - data.qpos[1] - noise[at]) / gain - slow[0])
                correction = 0.4 * slow[0]
            data.ctrl[0], data.ctrl[1] = wanted[step] + correction, load[step]
            data.qfrc_applied[1] = pull(data, other[step], pressed[step])

        out = simulate(xml, time_s.size, control, lambda data: (float(data.qpos[0]), float(data.qpos[1])))
        late = _only(planted, "latency").get("delay_s", 0.0)
        motor, turned = out[:, 0], np.interp(time_s - late, time_s, out[:, 1])
        cut = slice(lead, None, setup.style["every"])
        columns = {
            "motor_rad": motor[cut],
            "other_rad": c.motion * other[cut],
            "torque_Nm": load[cut],
            "load_rad": turned[cut],
        }
        return Trace(columns)

    def _pull(self, setup: Setup, planted: Sequence[Planted]) -> Callable[[Any, float, float], float]:
        """Return the torque (N m) of a hanging mass, or of an effect outside the vocabulary, at the load behind its shaft: a
        function of the engine's data, the other motor's command and the load's, both in units of their size.

        The mass hangs on an arm without length in the plane of rotation: as a body, it added up to 300 times the inertia of
        the load, a mode within the recording that no label named.
        """
        stiffness, hang = self._shaft(setup, planted), _only(planted, "gravity_load")
        product = _only(planted, "stiffness that the other motor changes").get("size", 0.0)
        ratio = _only(planted, "ratio that the load torque changes").get("size", 0.0)
        if hang:
            moment = stiffness * hang["share"] * setup.parameters["gain"] * setup.scales.motion
            return lambda data, other, pressed: -moment * float(np.sin(data.qpos[1]))
        return lambda data, other, pressed: (
            stiffness * (product * float(data.qpos[1]) * other + ratio * float(data.qpos[0]) * pressed)
        )

    def _stiffness(self, setup: Setup) -> float:
        """Return the stiffness (N m/rad) of a shaft whose mode with the load lies far above the excitation."""
        return LOAD_kg_m2 * (12.0 / setup.scales.slow_s) ** 2

    def _shaft(self, setup: Setup, planted: Sequence[Planted]) -> float:
        """Return the stiffness (N m/rad) between motor and load; 0 where they turn as one."""
        soft, mode = _only(planted, "compliance"), _only(planted, "resonance")
        if mode:
            return LOAD_kg_m2 * float(2.0 * np.pi * mode["frequency_Hz"]) ** 2
        if soft:
            return setup.scales.force / soft["deflection_rad"]
        return self._stiffness(setup) if _only(planted, "gravity_load") or _only(planted, "unlisted") else 0.0

    def _torque(self, setup: Setup, planted: Sequence[Planted]) -> float:
        """Return the size (N m) of the recorded torque at the load.

        A hanging mass and the effects outside the vocabulary act behind an elastic shaft. There the torque is so small that
        it does not twist the shaft: a compliance would be a second effect, which the label does not name.
        """
        c = setup.scales
        carried = _only(planted, "gravity_load") or _only(planted, "unlisted")
        if not carried or _only(planted, "compliance") or _only(planted, "resonance"):
            return c.force
        return min(c.force, UNTWISTED * setup.parameters["gain"] * c.motion * self._stiffness(setup))

    def _xml(self, setup: Setup, planted: Sequence[Planted]) -> str:
        """Return the MJCF: motor and load joint, coupled by an equality, a limited tendon, or a tendon spring."""
        c, gain = setup.scales, setup.parameters["gain"]
        inertia, stiffness, friction = LOAD_kg_m2, self._shaft(setup, planted), 0.0
        gap, bend = _only(planted, "backlash"), _only(planted, "static_nonlinearity").get("cubic", 0.0)
        soft, mode = _only(planted, "compliance"), _only(planted, "resonance")
        if stiffness and not mode:  # keep the load's own mode out of the recording
            inertia = min(inertia, stiffness * ((0.05 if soft else 0.02) * c.slow_s) ** 2)
        if gap:
            friction = 4.0 * c.force + 20.0 * inertia * c.motion / c.slow_s**2
        damping = 2.0 * 0.15 * (stiffness * inertia) ** 0.5
        poly = f"0 {gain} 0 {-bend * gain / c.motion**2} 0"
        rigid = (
            f'<equality><joint joint1="load" joint2="motor" polycoef="{poly}" solref="0.002 1"'
            ' solimp="0.999 0.9999 1e-6"/></equality>'
        )
        limit = (
            f'limited="true" range="{-0.5 * gap["width_rad"] * gain} {0.5 * gap["width_rad"] * gain}"'
            ' solreflimit="0.002 1" solimplimit="0.99 0.999 1e-6"'
            if gap
            else ""
        )
        joined = (
            f'<tendon><fixed name="belt" {limit} stiffness="{stiffness}" damping="{damping}" springlength="0">'
            f'<joint joint="load" coef="1"/><joint joint="motor" coef="{-gain}"/></fixed></tendon>'
        )
        return f"""<mujoco>{_HEAD.format(gravity="0 0 0")}
<worldbody>
<body><joint name="motor" type="hinge" axis="0 1 0"/><inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/></body>
<body><joint name="load" type="hinge" axis="0 1 0" damping="{1e-6}" frictionloss="{friction}"/>
<inertial pos="0 0 0" mass="1" diaginertia="{inertia} {inertia} {inertia}"/></body>
</worldbody>
{joined if gap or stiffness else rigid}
<actuator><position joint="motor" kp="400" kv="8"/><motor joint="load"/></actuator></mujoco>"""

    def left(self, setup: Setup, traces: Sequence[Trace]) -> list[Columns]:
        """Return what gain and offset leave."""
        x = [t.channels["motor_rad"] for t in traces]
        columns = np.column_stack([np.concatenate(x), np.ones(sum(a.size for a in x))])
        turned = np.concatenate([t.channels["load_rad"] for t in traces])
        rest = windows.without(columns, turned, sum(a.size for a in x[:-1]))
        return [{"load_rad": part} for part in windows.split(rest, x)]

    def nominal(self, setup: Setup) -> dict[str, Any]:
        """Return the nominal file's content."""
        names = {"input": "motor_rad", "output": "load_rad", "load": ["torque_Nm"], "others": ["other_rad"]}
        return {
            "name": "servo joint",
            "kind": "transmission",
            "channels": windows.channels("motor_rad", "other_rad", "torque_Nm", "load_rad"),
            "link": [{"subsystem": _GEAR, **names}],
        }


_AXIS = "axis"
_SLIDER_EFFECTS = (
    Plantable(
        "coulomb_friction", _AXIS, lambda s, c: {"force_N": 0.05 * c.force * s}, compared=("force_N",), says="frictionloss"
    ),
    Plantable("coulomb_friction", _AXIS, lambda s, c: {"force_N": 0.05 * c.force * s}, compared=("force_N",), says="floor"),
    Plantable("rate_lag", _AXIS, lambda s, c: {"time_constant_s": 0.15 * c.slow_s * s}, compared=("time_constant_s",)),
    Plantable("saturation", _AXIS, lambda s, c: {"limit_N": 1.1 * c.force / (1.0 + 0.3 * s)}, compared=("limit_N",)),
    Plantable(
        "latency",
        _AXIS,
        lambda s, c: {"delay_s": STEP_S * round(0.15 * c.slow_s * s / STEP_S)},  # commands wait for whole steps
        compared=("delay_s",),
    ),
    Plantable("resonance", _AXIS, lambda s, c: {"share": min(0.1 * s, 1.0), "frequency_Hz": 1.6 / (2.0 * np.pi * c.slow_s)}),
    Plantable(
        "periodic_disturbance",
        _AXIS,
        lambda s, c: {"amplitude_N": 0.05 * c.force * s, "frequency_Hz": 0.35 / (2.0 * np.pi * c.slow_s)},
        compared=("frequency_Hz", "amplitude_N"),
    ),
)
_SLIDER_OUTSIDE = (
    Plantable("unlisted", _AXIS, lambda s, c: {"size": 0.5 * s}, says="damping grows with the place squared"),
    Plantable("unlisted", _AXIS, lambda s, c: {"size": 0.3 * s}, says="force goes with place and speed's size"),
)


class Slider(ode.Axis):
    """Slide on a floor, moved by a force: joint friction, contact friction, actuator dynamics, a hanging mass."""

    effects: tuple[Plantable, ...] = _SLIDER_EFFECTS
    outside: tuple[Plantable, ...] = _SLIDER_OUTSIDE

    def __init__(self, sprung: bool) -> None:
        """Choose between a slide with a spring and a free one."""
        self.sprung = sprung
        self.name = "slider" if sprung else "free_slider"

    def draw(self, rng: np.random.Generator, closed_loop: bool) -> Setup:
        """Draw as the parent does, on the engine's clock."""
        setup = super().draw(rng, closed_loop)
        scales, stamps, fastest, every = sampling(rng)
        c, p = setup.scales, dict(setup.parameters)
        faster = c.slow_s / scales.slow_s
        p["stiffness"] *= faster**2
        p["damping"] *= faster
        force = c.force * faster**2
        p["offset"] *= faster**2
        sigma = {k: v * (faster**2 if k == "drive_N" else 1.0) for k, v in setup.sigma.items()}
        late = max(1, round(float(rng.uniform(2e-3, 6e-3)) / scales.period_s))
        style = {"fastest_Hz": fastest, "held": True, "late": late, "every": every}
        found = Scales(c.motion, force, c.motion / scales.slow_s, scales.slow_s, scales.duration_s, scales.period_s)
        return Setup(found, stamps, setup.closed_loop, setup.seed, sigma, setup.share, 0.0, p, style)

    def _one(self, setup: Setup, planted: Sequence[Planted], i: int, p: Array | None = None) -> Trace:
        c, (time_s, lead), own, every = setup.scales, _clock(setup, i), setup.parameters, setup.style["every"]
        wanted = windows.command(setup, i, 0)(time_s) * (c.motion if setup.closed_loop else c.force)
        noise = setup.noise(i, "position_m")
        gains, lead_n = ode.axis_loop(setup), lead // every
        late = round(_only(planted, "latency").get("delay_s", 0.0) / STEP_S)
        commands, read, total, before = np.zeros(time_s.size), [], 0.0, 0.0

        def force(n: int, step: int, x: float) -> float:
            nonlocal total, before
            if not setup.closed_loop:
                return float(wanted[step])
            read.append(x + (noise[n - lead_n] if n >= lead_n else 0.0))
            at = max(n - gains.late, 0)
            error = wanted[at * every] - read[at]
            total += error * c.period_s
            slope, before = (error - before) / c.period_s if n > 1 else 0.0, error
            return float(own["stiffness"] * wanted[step] + gains.kp * error + gains.ki * total + gains.kd * slope)

        def control(step: int, data: Any) -> None:
            x, v = float(data.qpos[0]), float(data.qvel[0])
            commands[step] = force(step // every, step, x) if step % every == 0 else commands[step - 1]
            data.ctrl[0] = commands[max(step - late, 0)]
            data.qfrc_applied[0] = own["offset"] + self._strange(planted, c, x, v, time_s[step])

        def readings(data: Any) -> tuple[float, ...]:
            x, v = float(data.qpos[0]), float(data.qvel[0])
            return _place(x, v), v, float(data.qacc[0])

        out = simulate(self._xml(setup, planted), time_s.size, control, readings)
        if np.max(np.abs(out[:, 0])) > 20.0 * c.motion:
            raise ValueError("slider: found a motion that runs away, wanted one that stays")
        cut = slice(lead, None, every)
        return Trace({"drive_N": commands[cut], "position_m": out[cut, 0]}, {"v": out[cut, 1], "a": out[cut, 2]})

    def _strange(self, planted: Sequence[Planted], c: Scales, x: float, v: float, time_s: float) -> float:
        """Return the force (N) of effects that MuJoCo has no element for."""
        line = _only(planted, "periodic_disturbance")
        total = line["amplitude_N"] * np.sin(2.0 * np.pi * line["frequency_Hz"] * time_s) if line else 0.0
        damping = _only(planted, "damping grows with the place squared").get("size", 0.0)
        total -= damping * c.force * (x / c.motion) ** 2 * v / c.speed
        grip = _only(planted, "force goes with place and speed's size").get("size", 0.0)
        return float(total - grip * c.force * x * abs(v) / (c.motion * c.speed))

    def _xml(self, setup: Setup, planted: Sequence[Planted]) -> str:
        p = setup.parameters
        loss = _only(planted, "frictionloss").get("force_N", 0.0)
        floor = _only(planted, "floor").get("force_N", 0.0)
        lag, limit = _only(planted, "rate_lag").get("time_constant_s", 0.0), _only(planted, "saturation").get("limit_N", 0.0)
        hung = _only(planted, "resonance")
        mass = hung["share"] * p["mass"] if hung else 0.0
        w = 2.0 * np.pi * hung["frequency_Hz"] if hung else 0.0
        second = (
            f'<body><joint name="hung" type="slide" axis="1 0 0" stiffness="{mass * w * w}" damping="{0.2 * mass * w}"/>'
            f'<inertial pos="0 0 0" mass="{mass}" diaginertia="1 1 1"/></body>'
            if hung
            else ""
        )
        # with friction on the floor a second slide lets the weight press: the coefficient is force / (mass * g)
        up = '<joint name="up" type="slide" axis="0 0 1"/>' if floor else ""
        slide = f"{floor / (p['mass'] * 9.81)} 0 0"
        touch = f'contype="1" conaffinity="1" friction="{slide}" condim="3"' if floor else 'contype="0" conaffinity="0"'
        # "actearly": the force follows the state after the step; without it MuJoCo adds a delay of one step to the lag
        lagged = (
            f'<general joint="x" dyntype="filterexact" dynprm="{lag}" gainprm="1" biastype="none" actearly="true"'
            if lag
            else '<motor joint="x"'
        )
        limited = f' forcelimited="true" forcerange="{-limit} {limit}"' if limit else ""
        return f"""<mujoco>{_HEAD.format(gravity="0 0 -9.81" if floor else "0 0 0")}<option impratio="100" cone="elliptic"/>
<worldbody><geom type="plane" size="100 100 1" pos="0 0 -0.05" {touch} solref="0.004 1"/>
<body><joint name="x" type="slide" axis="1 0 0" stiffness="{p["stiffness"]}" damping="{p["damping"]}"
frictionloss="{loss}"/>{up}<inertial pos="0 0 0" mass="{p["mass"]}" diaginertia="1 1 1"/>
<geom type="box" size="0.05 0.05 0.05" {touch} solref="0.004 1"/>{second}</body>
</worldbody><actuator>{lagged}{limited}/></actuator></mujoco>"""


_PAD = "pad"
_PAD_EFFECTS = (
    Plantable("coulomb_friction", _PAD, lambda s, c: {"force_N": 0.05 * c.force * s}, compared=("force_N",)),
    Plantable(
        "contact_nonlinear",
        _PAD,
        lambda s, c: {"stiffness": 0.2 * s * c.force / c.motion},
        same=("nonlinear_stiffness", "static_nonlinearity", "second_contact", "dead_zone"),
    ),
    Plantable(
        "creep_relaxation",
        _PAD,
        lambda s, c: {"share": 0.15 * s, "time_constant_s": c.duration_s / 8.0},
        same=("contact_viscous",),
    ),
    Plantable("latency", _PAD, lambda s, c: {"delay_s": 0.15 * c.slow_s * s}, compared=("delay_s",)),
    Plantable("saturation", _PAD, lambda s, c: {"limit_N": 1.1 * c.force / (1.0 + 0.3 * s)}),
    Plantable("sensor_drift", _PAD, lambda s, c: {"drift_N": 0.1 * c.force * s}, signed=True),
)


class Pad(ode.Press):
    """Stamp pressed on a sprung pad by a servo: motion in, servo force out; a second wall, joint friction, a Maxwell arm."""

    name = "pad"
    outputs: tuple[str, ...] = ("force_N",)
    effects: tuple[Plantable, ...] = _PAD_EFFECTS
    outside: tuple[Plantable, ...] = (
        Plantable("unlisted", _PAD, lambda s, c: {"size": 0.3 * s}, says="force goes with place and speed's size"),
        Plantable("unlisted", _PAD, lambda s, c: {"size": 0.5 * s}, says="damping grows with the place squared"),
    )

    def draw(self, rng: np.random.Generator, closed_loop: bool) -> Setup:
        """Draw stiffness, damping and mass, sampling and noise."""
        scales, stamps, fastest, every = sampling(rng)
        motion, force = float(rng.uniform(2e-3, 0.05)), float(rng.uniform(0.5, 50.0))
        found = Scales(motion, force, motion / scales.slow_s, scales.slow_s, scales.duration_s, scales.period_s)
        stiffness = force / motion
        parameters = {
            "stiffness": stiffness,
            "damping": stiffness * scales.slow_s * float(rng.uniform(0.05, 0.4)),
            "mass": stiffness * scales.slow_s**2 * float(rng.uniform(0.02, 0.2)),
            "offset": 0.0,
            "gain": stiffness,
        }
        sigma = {"force_N": force * float(np.exp(rng.uniform(np.log(2e-3), np.log(1e-2)))), "motion_m": 2e-6 * motion}
        return Setup.drawn(rng, found, stamps, closed_loop, sigma, parameters, {"fastest_Hz": fastest, "every": every})

    def _one(self, setup: Setup, planted: Sequence[Planted], i: int) -> Trace:
        c, (time_s, lead), p, every = setup.scales, _clock(setup, i), setup.parameters, setup.style["every"]
        wanted = c.motion * windows.command(setup, i, 0)(time_s)
        noise = np.repeat(setup.noise(i, "force_N"), every)
        w = 10.0 / c.slow_s
        kp, kd, slow = p["mass"] * w * w, 2.0 * p["mass"] * w, [0.0]
        limit, drift = (_only(planted, n) for n in ("saturation", "sensor_drift"))
        late = _only(planted, "latency").get("delay_s", 0.0)

        def control(step: int, data: Any) -> None:
            x, v = float(data.qpos[0]), float(data.qvel[0])
            asked = wanted[step]
            if setup.closed_loop and step > lead + 5:  # a force loop around the servo, 5 ms late, on the noisy force
                sensed = float(data.actuator_force[0]) + noise[min(step - lead - 5, noise.size - 1)]
                slow[0] += 0.01 * ((p["stiffness"] * wanted[step] - sensed) / p["stiffness"] - slow[0])
                asked += 0.3 * slow[0]
            strange = Slider._strange(self, planted, c, x, v, time_s[step])  # type: ignore[arg-type]
            data.qfrc_applied[0] = strange
            data.ctrl[0] = p["stiffness"] * x + p["damping"] * v + kp * (asked - x) - kd * v

        def readings(data: Any) -> tuple[float, ...]:
            x, v = float(data.qpos[0]), float(data.qvel[0])
            return _place(x, v), v, 0.0, float(data.actuator_force[0])

        out = simulate(self._xml(setup, planted), time_s.size, control, readings)
        force = np.interp(time_s - late, time_s, _around(out[:, 3]))
        if limit:
            force = np.clip(force, -limit["limit_N"], limit["limit_N"])
        if drift:
            force = force + drift["drift_N"] * np.maximum(time_s, 0.0) / c.duration_s
        cut = slice(lead, None, every)
        return Trace(
            {"motion_m": out[cut, 0], "force_N": force[cut]}, {"v": out[cut, 1], "a": np.gradient(out[:, 1], STEP_S)[cut]}
        )

    def _xml(self, setup: Setup, planted: Sequence[Planted]) -> str:
        c, p = setup.scales, setup.parameters
        loss, wall, arm = (_only(planted, n) for n in ("coulomb_friction", "contact_nonlinear", "creep_relaxation"))
        maxwell = tendon = touch = ""
        if arm:
            k = arm["share"] * p["stiffness"]
            maxwell = (
                f'<body><joint name="arm" type="slide" axis="1 0 0" damping="{k * arm["time_constant_s"]}"/>'
                f'<inertial pos="0 0 0" mass="{1e-3 * p["mass"]}" diaginertia="1 1 1"/></body>'
            )
            tendon = (
                f'<tendon><fixed stiffness="{k}" springlength="0"><joint joint="x" coef="1"/><joint joint="arm" coef="-1"/>'
                "</fixed></tendon>"
            )
        if wall:  # MuJoCo's soft contact, stiffness given directly (negative solref); SOFT of the inertia is held back, too
            k = wall["stiffness"]
            touch = (
                '<geom type="sphere" size="0.01" contype="1" conaffinity="1" condim="1" priority="1"'
                f' solref="{-k / p["mass"]} {-0.1 * k * c.slow_s / p["mass"]}" solimp="{SOFT} {SOFT} 0.001"/>'
            )
        plane = (
            f'<geom type="plane" size="1 1 1" pos="{0.2 * c.motion + 0.01} 0 0" zaxis="-1 0 0"'
            ' contype="1" conaffinity="1" condim="1"/>'
            if wall
            else ""
        )
        return f"""<mujoco>{_HEAD.format(gravity="0 0 0")}<worldbody>{plane}
<body><joint name="x" type="slide" axis="1 0 0" stiffness="{p["stiffness"]}" damping="{p["damping"]}"
frictionloss="{loss.get("force_N", 0.0)}"/>
<inertial pos="0 0 0" mass="{p["mass"]}" diaginertia="1 1 1"/>{touch}</body>{maxwell}</worldbody>
{tendon}<actuator><motor joint="x"/></actuator></mujoco>"""

    def left(self, setup: Setup, traces: Sequence[Trace]) -> list[Columns]:
        """Return what mass, damping, stiffness and offset leave."""
        rows = [
            np.column_stack([t.hidden["a"], t.hidden["v"], t.channels["motion_m"], np.ones(t.hidden["a"].size)])
            for t in traces
        ]
        force = np.concatenate([t.channels["force_N"] for t in traces])
        rest = windows.without(np.vstack(rows), force, sum(len(r) for r in rows[:-1]))
        return [{"force_N": part} for part in windows.split(rest, [r[:, 0] for r in rows])]

    def nominal(self, setup: Setup) -> dict[str, Any]:
        """Return the nominal file's content."""
        terms = ["mass", "damping", "stiffness", "offset"]
        return {
            "name": "pad",
            "kind": "impedance",
            "channels": windows.channels("motion_m", "force_N"),
            "impedance": {"subsystem": _PAD, "input": "motion_m", "output": "force_N", "terms": terms},
        }


_LINKS = {
    "mass_1": 1.2,
    "mass_2": 0.8,
    "inertia_1": 0.01,
    "inertia_2": 0.006,
    "length_1": 0.3,
    "centre_1": 0.14,
    "centre_2": 0.12,
}


_STIFF, _DAMP = np.array([150.0, 60.0]), np.array([8.0, 3.0])


class Arm(SeparateRecordings):
    """Two-link arm under joint servos: angles in, torques out, by a Python function with the drawing's link data."""

    name: str = "arm"
    outputs: tuple[str, ...] = ("shoulder_Nm", "elbow_Nm")
    effects: tuple[Plantable, ...] = (
        Plantable("latency", "elbow", lambda s, c: {"delay_s": 0.1 * c.slow_s * s}, compared=("delay_s",)),
        Plantable("sensor_drift", "elbow", lambda s, c: {"drift_Nm": 0.05 * c.force * s}, signed=True),
        Plantable("saturation", "shoulder", lambda s, c: {"limit_Nm": 1.1 * c.force / (1.0 + 0.3 * s)}),
        Plantable("gravity_load", "elbow", lambda s, c: {"payload_kg": 0.05 * s}, same=("unlisted",)),
        Plantable("coulomb_friction", "elbow", lambda s, c: {"torque_Nm": 0.03 * c.force * s}, same=("unlisted",)),
    )
    outside: tuple[Plantable, ...] = (
        Plantable("unlisted", "elbow", lambda s, c: {"payload_kg": 0.05 * s}, same=("gravity_load",), says="payload"),
        Plantable(
            "unlisted", "elbow", lambda s, c: {"size": 0.05 * s}, says="joint friction goes with the other joint's torque"
        ),
    )

    def draw(self, rng: np.random.Generator, closed_loop: bool) -> Setup:
        """Draw sampling, noise and the amplitude; the servos close the loop on exact encoders."""
        scales, stamps, fastest, every = sampling(rng, (1, 2))
        motion, force = float(rng.uniform(0.3, 0.9)), 4.0
        found = Scales(motion, force, motion / scales.slow_s, scales.slow_s, scales.duration_s, scales.period_s)
        sigma = dict.fromkeys(self.outputs, force * float(np.exp(rng.uniform(np.log(3e-3), np.log(1e-2)))))
        parameters = {**_LINKS, "damping_1": float(rng.uniform(0.05, 0.3)), "damping_2": float(rng.uniform(0.02, 0.1))}
        style = {"fastest_Hz": min(fastest, 2.0), "every": every}
        return Setup.drawn(rng, found, stamps, True, sigma, parameters, style)

    def _one(self, setup: Setup, planted: Sequence[Planted], i: int) -> Trace:
        c, (time_s, lead), every = setup.scales, _clock(setup, i), setup.style["every"]
        wanted = np.column_stack([c.motion * windows.command(setup, i, k)(time_s) for k in (0, 1)])
        late, drift, limit = (_only(planted, n) for n in ("latency", "sensor_drift", "saturation"))
        grip = _only(planted, "joint friction goes with the other joint's torque").get("size", 0.0)

        def control(step: int, data: Any) -> None:
            data.ctrl[:] = _STIFF * (wanted[step] - data.qpos) - _DAMP * data.qvel  # a digital servo at 1 kHz
            data.qfrc_applied[1] = (
                -grip * abs(float(data.actuator_force[0])) * np.tanh(float(data.qvel[1]) / (0.02 * c.speed))
            )

        def readings(data: Any) -> tuple[float, ...]:
            places = (_place(float(x), float(v)) for x, v in zip(data.qpos[:2], data.qvel[:2], strict=True))
            return (*places, *map(float, data.actuator_force[:2]))

        out = simulate(self._xml(setup, planted), time_s.size, control, readings)
        shoulder, elbow = _around(out[:, 2]), np.interp(time_s - late.get("delay_s", 0.0), time_s, _around(out[:, 3]))
        elbow = elbow + drift.get("drift_Nm", 0.0) * np.maximum(time_s, 0.0) / c.duration_s
        if limit:
            shoulder = np.clip(shoulder, -limit["limit_Nm"], limit["limit_Nm"])
        cut = slice(lead, None, every)
        names = ("shoulder_rad", "elbow_rad", "shoulder_Nm", "elbow_Nm")
        return Trace(dict(zip(names, (out[cut, 0], out[cut, 1], shoulder[cut], elbow[cut]), strict=True)))

    def _xml(self, setup: Setup, planted: Sequence[Planted]) -> str:
        p = setup.parameters
        payload = next((q.parameters["payload_kg"] for q in planted if "payload_kg" in q.parameters), 0.0)
        loss = _only(planted, "coulomb_friction").get("torque_Nm", 0.0)
        tip = (
            f'<body pos="0 0 -0.25"><inertial pos="0 0 0" mass="{payload}" diaginertia="1e-9 1e-9 1e-9"/></body>'
            if payload
            else ""
        )

        def inertial(k: int) -> str:
            turn = " ".join([str(p[f"inertia_{k}"])] * 3)
            return f'<inertial pos="0 0 {-p[f"centre_{k}"]}" mass="{p[f"mass_{k}"]}" diaginertia="{turn}"/>'

        return f"""<mujoco>{_HEAD.format(gravity="0 0 -9.81")}<worldbody>
<body><joint name="shoulder" type="hinge" axis="0 -1 0" damping="{p["damping_1"]}"/>{inertial(1)}
<body pos="0 0 {-p["length_1"]}">
<joint name="elbow" type="hinge" axis="0 -1 0" damping="{p["damping_2"]}" frictionloss="{loss}"/>
{inertial(2)}{tip}</body></body></worldbody>
<actuator><motor joint="shoulder"/><motor joint="elbow"/></actuator></mujoco>"""

    def left(self, setup: Setup, traces: Sequence[Trace]) -> list[Columns]:
        """Return what the function leaves once both dampings are fitted."""
        rows = []
        for i, trace in enumerate(traces):
            time_s, given = setup.stamps[i], {k: trace.channels[k] for k in ("shoulder_rad", "elbow_rad")}
            base, one, two = (
                torques(given, {**setup.parameters, "damping_1": a, "damping_2": b}, time_s)
                for a, b in ((0, 0), (1, 0), (0, 1))
            )
            rows.append(
                [np.column_stack([trace.channels[n] - base[n], one[n] - base[n], two[n] - base[n]]) for n in self.outputs]
            )
        train = np.vstack([part for row in rows[:-1] for part in row])
        found = np.linalg.lstsq(train[:, 1:], train[:, 0], rcond=None)[0]
        return [{n: part[:, 0] - part[:, 1:] @ found for n, part in zip(self.outputs, row, strict=True)} for row in rows]

    def nominal(self, setup: Setup) -> dict[str, Any]:
        """Return the nominal file's content; link data are held, dampings refitted."""
        held = {k: {"value": v, "free": False} for k, v in setup.parameters.items() if not k.startswith("damping")}
        return {
            "name": "two-link arm",
            "kind": "callable",
            "channels": windows.channels("shoulder_rad", "elbow_rad", *self.outputs),
            "callable": {
                "function": "host.studies.proof.worlds.nominal_arm:torques",
                "inputs": ["shoulder_rad", "elbow_rad"],
                "outputs": list(self.outputs),
                "subsystem": "arm",
            },
            "parameters": {"damping_1": 0.1, "damping_2": 0.05, **held},
        }


MECHANISMS: tuple[Mechanism, ...] = (Gear(), Slider(sprung=True), Arm(), Pad(), Slider(sprung=False))
