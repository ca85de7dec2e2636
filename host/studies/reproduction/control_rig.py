"""Figs. 7.20 to 7.27: hybrid control on the whole simulated rig, firmware and protocols included, in both configurations.

The thesis gives the gains (7.6) per iteration, but neither the length of an iteration nor how the law is read. Each
statement is tried in every reading, and the verdict's line says where it holds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from host.report.figure_page import Section, verdict
from host.report.style import MUTED
from host.studies.reproduction.admissible import Admissible, Tried
from host.studies.reproduction.drawing import Panel, PlotLine, panels
from protocol.errors import InputError
from protocol.rig_file import SIMULATED_RIG, Rig, load_rig, parse_rig
from protocol.topics import Message
from sim.board import SimulatedBoard
from sim.heart import HeartConfig
from sim.scenario import ContactJob, Scenario
from sim.tissue import TissueConfig
from sim.world import World, simulated_plant

Array = NDArray[np.float64]
# Figures are taken from this share of the time since contact on; how long is held (s): the soft direction takes longer.
SETTLED_SHARE = 0.6
HOLD_ACROSS_S, HOLD_ALONG_S = 25.0, 16.0
# (7.6), per iteration: position (dimensionless) and force (m/N).
K_PP, K_IP, K_PF, K_IF = 0.083, 0.006, 0.1, 0.003
# A force counts as held when its mean is this near (share, and N) and its standard deviation below this share of it.
HELD_SHARE, HELD_N, HELD_SD_SHARE = 0.1, 0.005, 0.2
# The position counts as held when its mean is this near to the target (m).
HELD_m = 1e-3
# Of the plate with its low-friction tape.
FRICTION = 0.2


class Configuration(NamedTuple):
    """Where the force sensor stands: `point_m` on its plate, `into` the plate (unit), `shift`: what moving it 6 mm closer
    is."""

    name: str
    point_m: tuple[float, float, float]
    into: tuple[float, float, float]
    along: tuple[float, float, float]


# First: force across the catheter's axis, position along it; second: force along, position across (Fig. 7.19).
# Near the axis: further off, the compliant roll gives way under a force across (0.1 N at 14 mm), and the tip slides aside.
ACROSS = Configuration("force across, position along", (0.0, -0.008, 0.029), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0))
AXIAL = Configuration("force along, position across", (0.0, -0.0107, 0.025), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0))


class RigRun(NamedTuple):
    """One experiment from first contact on: time (s), force into the plate (N), tip across the plate from its target (m),
    stages (n, 3)."""

    label: str
    contact: bool
    time_s: Array
    force_N: Array
    off_m: Array
    stage_s: Array
    stage: Array
    wanted_N: float

    def late(self) -> Array:
        """Return the force (n,) in N after it has settled."""
        return self.force_N[self.settled]

    @property
    def settled(self) -> NDArray[np.bool_]:
        """The samples after SETTLED_SHARE of the time."""
        return self.time_s > SETTLED_SHARE * self.time_s.max(initial=0.0)


class LawReading(NamedTuple):
    """Reading of the law: `form` and `force_added_to` of section [control], and the length of an iteration (s)."""

    form: str
    force_added_to: str
    iteration_s: float

    @property
    def name(self) -> str:
        """Return form, length of an iteration and place of the force, as the tables name the reading."""
        form = "PI form" if self.form == "pi" else "incremental form"
        return f"{form}, {self.iteration_s * 1e3:.0f} ms, force added to the {self.force_added_to} position"

    def gain(self, gain: str) -> str:
        """Return the key of the rig file for one of K_pp, K_ip, K_pf, K_if."""
        return (_PI_KEYS if self.form == "pi" else _INCREMENTAL_KEYS)[gain]


_PI_KEYS = {
    "K_pp": "pi_position_gain",
    "K_ip": "pi_position_integral_per_s",
    "K_pf": "pi_force_gain_m_per_N",
    "K_if": "pi_force_integral_m_per_N_s",
}
_INCREMENTAL_KEYS = {
    "K_pp": "position_gain_per_s",
    "K_ip": "position_integral_per_s2",
    "K_pf": "force_gain_m_per_N",
    "K_if": "force_integral_m_per_N_s",
}
# A tracker frame is 25 ms. At 100 ms, the longest iteration with which the incremental form was tried, it comes to rest.
READINGS = (
    LawReading("pi", "desired", 0.025),
    LawReading("incremental", "tip", 0.025),
    LawReading("incremental", "tip", 0.100),
)
# Tried for the second configuration only: in the first, it differs from the first reading by less than the noise.
SECOND_READING = LawReading("pi", "tip", 0.025)


def thesis_rig(reading: LawReading = READINGS[0]) -> Rig:
    """The simulated rig under the thesis' own law, with the gains of its experiments. Raises InputError where refused."""
    data, T = load_rig(SIMULATED_RIG).effective(), reading.iteration_s
    per_s = {"K_pp": K_PP, "K_ip": K_IP / T, "K_pf": K_PF, "K_if": K_IF / T}
    if reading.form == "incremental":
        per_s |= {"K_pp": K_PP / T, "K_ip": K_IP / T**2}
    gains = {reading.gain(name): value for name, value in per_s.items()}
    data["control"].update(law="thesis", form=reading.form, force_added_to=reading.force_added_to, **gains)
    return parse_rig(data, "thesis rig")


def with_control(rig: Rig, **factors: float) -> Rig:
    """`rig` with gains of [control] multiplied. Raises InputError beyond their bounds."""
    data = rig.effective()
    for key, factor in factors.items():
        data["control"][key] *= factor
    return parse_rig(data, "gains")


def experiment(
    rig: Rig,
    where: Configuration,
    label: str,
    wanted_N: float,
    hold_s: float,
    seed: int,
    shift_m: float = 0.0,
    board: str = "native",
) -> RigRun:
    """Touch the plate and hold `wanted_N`, in lock step with the firmware; `shift_m` brings the plate closer."""
    point = np.array(where.point_m) - shift_m * np.array(where.into)
    tissue = TissueConfig(point_m=tuple(point), normal=tuple(-np.array(where.into)), friction=FRICTION)
    plant = simulated_plant(rig, seed, tissue=tissue, heart=HeartConfig(beat_m=0.0, respiration_m=0.0))
    received: dict[str, list[Message]] = {"force/sensor": [], "state": [], "stage": []}

    def publish(topic: str, message: Message) -> None:
        if topic in received:
            received[topic].append(message)

    with SimulatedBoard(board) as made:
        scenario = Scenario(rig, World(rig, plant, made, seed), publish)
        job = ContactJob(tuple(point), where.into, force_N=wanted_N, hold_s=hold_s, approach_s=8.0)
        outcome = scenario.press(job)
    return _cut(received, where, label, wanted_N, point, outcome.contact, hold_s)


def _cut(
    received: dict[str, list[Message]],
    where: Configuration,
    label: str,
    wanted_N: float,
    point: Array,
    contact: bool,
    hold_s: float,
) -> RigRun:
    states = [m for m in received["state"] if m.mode == "contact"]  # type: ignore[attr-defined]
    if not contact or not states:
        empty = np.zeros(0)
        return RigRun(label, False, empty, empty, empty, empty, np.zeros((0, 3)), wanted_N)
    start_s = states[0].stamp_ns * 1e-9

    def window(messages: Sequence[Message], before_s: float) -> list[Message]:
        return [m for m in messages if -before_s <= m.stamp_ns * 1e-9 - start_s <= hold_s]

    forces, tips, stages = (
        window(received["force/sensor"], 0.5),
        window(received["state"], 0.0),
        window(received["stage"], 3.0),
    )
    time_s = np.array([m.stamp_ns for m in forces]) * 1e-9 - start_s
    into = np.array(where.into)
    force = np.array([m.force_N for m in forces]) @ into  # type: ignore[attr-defined]
    tip_s = np.array([m.stamp_ns for m in tips]) * 1e-9 - start_s
    off = (np.array([m.tip_m for m in tips]) - point) @ np.array(where.along)  # type: ignore[attr-defined]
    columns = [[m.command_insertion_m, m.command_roll_rad, m.command_knob_rad] for m in stages]  # type: ignore[attr-defined]
    return RigRun(
        label,
        True,
        time_s,
        force,
        np.interp(time_s, tip_s, off),
        np.array([m.stamp_ns for m in stages]) * 1e-9 - start_s,
        np.array(columns),
        wanted_N,
    )


def _force_panel(runs: Sequence[RigRun], title: str) -> Panel:
    there = [run for run in runs if run.contact]
    ends_s = [0.0, max(run.time_s.max(initial=0.0) for run in there)]
    levels = [PlotLine(ends_s, [wanted_N] * 2, "", MUTED, "--") for wanted_N in sorted({run.wanted_N for run in there})]
    lines = [PlotLine(run.time_s, _smooth(run.force_N), run.label) for run in there]
    return Panel("time since contact, s", "force, N", [*lines, *levels], title=title)


def _smooth(force_N: Array) -> Array:
    """Mean over 20 ms, as the eye does with a force sensor's noise."""
    return np.convolve(force_N, np.full(10, 0.1), "same") if force_N.size > 10 else force_N


def _held(runs: Sequence[RigRun]) -> tuple[bool, str]:
    """Return whether all runs held force and position, and a sentence about how well."""
    said, good = [], True
    for run in runs:
        if not run.contact or run.late().size == 0:
            return False, f"{run.label}: no contact"
        off_m = float(np.mean(run.off_m[run.settled]))
        mean, sd, peak = float(run.late().mean()), float(run.late().std()), float(_smooth(run.force_N).max())
        good &= abs(mean - run.wanted_N) < HELD_SHARE * run.wanted_N + HELD_N and sd < HELD_SD_SHARE * run.wanted_N
        good &= abs(off_m) < HELD_m
        said.append(
            f"{run.label}: mean {mean:.3f} of {run.wanted_N} N, sd {sd * 1e3:.0f} mN, peak {peak:.2f} N, "
            f"position {off_m * 1e3:+.2f} mm off"
        )
    return good, "; ".join(said)


class GainEffect(NamedTuple):
    """A figure about one gain: factors of it but 1, the thesis' statement, and which of `_judge`'s figures shows it."""

    number: str
    gain: str
    words: str
    factors: tuple[float, ...]
    thesis: str
    kind: str


EFFECTS = (
    GainEffect("7.22", "K_if", "integral, force", (0.5, 2.0), "A higher integral gain lowers the steady oscillation.", "sd"),
    # the rig file allows no more of it
    GainEffect(
        "7.23", "K_pf", "proportional, force", (0.25, 0.5), "The proportional gain sets the speed at the beginning.", "rise"
    ),
    GainEffect(
        "7.24", "K_ip", "integral, position", (0.5, 2.0), "A higher integral gain lowers overshoot and oscillation.", "less"
    ),
    GainEffect(
        "7.25", "K_pp", "proportional, position", (0.5, 2.0), "A higher gain gives more overshoot and oscillation.", "more"
    ),
)


class RigFigures(NamedTuple):
    """Results of one reading for each figure: its runs, and whether the statement holds, with a line about it."""

    reading: LawReading
    runs: dict[str, list[RigRun]]
    judged: dict[str, tuple[bool, str]]


def sections(quick: bool, board: str = "native", progress: Callable[[str], None] = lambda text: None) -> list[Section]:
    """Return the sections for figures 7.20 to 7.27. quick: shorter runs, the first reading of each form."""
    out = []
    for reading in READINGS[:2] if quick else (*READINGS, SECOND_READING):
        out.append(figures(reading, quick, board))
        progress(f"{reading.name}: done")
    return [
        _section(
            out,
            "7.20_7.21",
            "Figs. 7.20, 7.21: first configuration",
            "Force and position are regulated, with minimal overshoot and smooth commands, for two places of the sensor.",
            "Force across 0.1 N, position along; two plates, the second 6 mm closer.",
        ),
        *(
            _section(
                out,
                effect.number,
                f"Fig. {effect.number}: {effect.words}",
                effect.thesis,
                f"{effect.gain} of (7.6) times {', '.join(f'{f:g}' for f in sorted({*effect.factors, 1.0}))}, "
                "first configuration.",
            )
            for effect in EFFECTS
        ),
        _section(
            out,
            "7.26",
            "Fig. 7.26: second configuration",
            "Force 0.1 N along and position across are regulated, with jumps of the position by static friction.",
            f"Force along the stiff axis; friction {FRICTION} on the plate, which is 0 to 3 mm closer.",
        ),
        _section(
            out,
            "7.27",
            "Fig. 7.27: desired forces",
            "0.2, 0.25 and 0.3 N are reached.",
            "Force along the axis, the same gains for all.",
        ),
    ]


def figures(reading: LawReading, quick: bool, board: str = "native") -> RigFigures:
    """Run the experiments of all figures in one reading. Gains that the rig file refuses give no run."""
    across_s, along_s = (15.0, 8.0) if quick else (HOLD_ACROSS_S, HOLD_ALONG_S)
    runs: dict[str, list[RigRun]] = {}
    judged: dict[str, tuple[bool, str]] = {}
    try:
        rig = thesis_rig(reading)
    except InputError as error:
        numbers = ["7.20_7.21", *(effect.number for effect in EFFECTS), "7.26", "7.27"]
        return RigFigures(reading, {number: [] for number in numbers}, dict.fromkeys(numbers, (False, f"refused: {error}")))
    if reading != SECOND_READING:
        _first_configuration(rig, reading, across_s, board, runs, judged)
    count = 2 if quick else 4
    runs["7.26"] = [
        experiment(rig, AXIAL, f"experiment {k + 1}", 0.1, along_s, k + 1, 0.001 * k, board) for k in range(count)
    ]
    runs["7.27"] = [experiment(rig, AXIAL, f"{force} N", force, along_s, 1, board=board) for force in (0.2, 0.25, 0.3)]
    for number in ("7.26", "7.27"):
        judged[number] = _held(runs[number])
    return RigFigures(reading, runs, judged)


def _first_configuration(
    rig: Rig,
    reading: LawReading,
    across_s: float,
    board: str,
    runs: dict[str, list[RigRun]],
    judged: dict[str, tuple[bool, str]],
) -> None:
    """Add the runs of figures 7.20 to 7.25 and what they show."""
    plain = experiment(rig, ACROSS, "experiment 1", 0.1, across_s, 1, board=board)
    runs["7.20_7.21"] = [plain, experiment(rig, ACROSS, "experiment 2", 0.1, across_s, 2, 0.006, board)]
    judged["7.20_7.21"] = _held(runs["7.20_7.21"])
    for effect in EFFECTS:
        found, refused = {1.0: plain._replace(label="× 1")}, []
        for factor in effect.factors:
            try:
                changed = with_control(rig, **{reading.gain(effect.gain): factor})
            except InputError as error:
                refused.append(f"× {factor:g} refused: {error}")
                continue
            found[factor] = experiment(changed, ACROSS, f"× {factor:g}", 0.1, across_s, 1, board=board)
        runs[effect.number] = [found[factor] for factor in sorted(found)]
        holds, says = _judge(runs[effect.number], effect.kind)
        judged[effect.number] = holds and not refused, "; ".join([says, *refused])


def _section(out: Sequence[RigFigures], number: str, title: str, thesis: str, ours: str) -> Section:
    """One figure: where its statement holds, the map of the readings, and the force in each."""
    settings = Admissible(
        Tried(one.reading.name, one.judged[number][1], one.judged[number][0]) for one in out if number in one.judged
    )
    shown = [one for one in out if any(run.contact for run in one.runs.get(number, []))]
    curves = [_force_panel(one.runs[number], one.reading.name) for one in shown]
    caption = "Force since contact, mean over 20 ms; dashed: desired."
    pictures = (panels(title, "Force in each reading of the law.", caption, curves, 2.7),) if shown else ()
    return Section(
        f"fig_{number}",
        title,
        thesis,
        ours,
        verdict(settings.holds),
        f"{settings.where}. {settings.tried[0].setting}: {settings.tried[0].found}.",
        pictures,
        settings.rows(),
    )


def _judge(runs: Sequence[RigRun], kind: str) -> tuple[bool, str]:
    if not all(run.contact and run.late().size for run in runs):
        return False, "; ".join(f"{run.label}: {'contact' if run.contact else 'no contact'}" for run in runs)
    spread = [float(_smooth(run.late()).std()) * 1e3 for run in runs]
    peak = [float(_smooth(run.force_N).max() - run.wanted_N) * 1e3 for run in runs]
    rise = [_rise_s(run) for run in runs]
    says = (
        f"gain {', '.join(run.label for run in runs)}: oscillation {', '.join(f'{v:.1f}' for v in spread)} mN, overshoot "
        f"{', '.join(f'{v:.0f}' for v in peak)} mN, 80 % after {', '.join(f'{v:.2f}' for v in rise)} s"
    )
    holds = {
        "sd": spread[-1] < spread[0],
        "rise": rise[-1] < rise[0],
        "less": peak[-1] < peak[0] and spread[-1] < spread[0],
        "more": peak[-1] > peak[0] and spread[-1] > spread[0],
    }
    return holds[kind], says


def _rise_s(run: RigRun) -> float:
    """Time at which 80 % of the requested force are reached; infinite where never."""
    there = np.flatnonzero(_smooth(run.force_N) > 0.8 * run.wanted_N)
    return float(run.time_s[there[0]]) if there.size else float("inf")
