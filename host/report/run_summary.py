"""A contact run in figures: what was wanted, what was reached, what went wrong; from its recording and nothing else."""

from __future__ import annotations

import bisect
from dataclasses import dataclass, field

import numpy as np

from host.recordings.recording import RecordingFile
from protocol.enums import SafetyAction
from protocol.topics import HISTOGRAM_BUCKETS, RigCause

Array = np.ndarray
# A measured force above this is contact; below it is the sensor's noise.
TOUCH_N = 0.01
# The contact's first seconds are settling: they stay out of the mean and of the RMS errors, not out of the peak.
SETTLE_S = 3.0


@dataclass(frozen=True)
class TimeSpan:
    """A time span from start_ns to end_ns, with a name and a note."""

    start_ns: int
    end_ns: int
    name: str
    note: str = ""

    @property
    def seconds(self) -> float:
        """Return the duration in s."""
        return (self.end_ns - self.start_ns) * 1e-9


@dataclass(frozen=True)
class TickTimes:
    """Times of the loop's ticks at the end of the run; NaN if the recording has none."""

    loop_hz: float = float("nan")
    ticks: int = 0
    missed: int = 0
    p50_us: float = float("nan")
    p99_us: float = float("nan")
    p999_us: float = float("nan")
    max_us: float = float("nan")
    lateness_p99_us: float = float("nan")
    lateness_max_us: float = float("nan")
    longest_gap_ns: int = 0
    longest_gap_where: str = ""
    histogram: Array = field(default_factory=lambda: np.zeros(HISTOGRAM_BUCKETS, dtype=np.int64))


@dataclass(frozen=True)
class BoardHealth:
    """The stepper board's counters, worst over the run."""

    known: bool = False
    faults: tuple[str, ...] = ()
    crc_errors: int = 0
    underruns: int = 0
    rejected: int = 0
    refusals: dict[str, int] = field(default_factory=dict)  # reason of `protocol.serial_frames.Reject` -> set-points
    resets: int = 0
    encoder_gap_steps: tuple[int, int, int] = (0, 0, 0)


@dataclass(frozen=True)
class EstimateQuality:
    """Estimated against measured force along the force direction, during contact."""

    count: int = 0
    converged_share: float = float("nan")
    mean_error_N: float = float("nan")
    rms_error_N: float = float("nan")
    median_sd_N: float = float("nan")
    within_2sd_share: float = float("nan")
    median_delay_s: float = float("nan")


@dataclass(frozen=True)
class RunSummary:
    """Forces along `direction` (unit, into the tissue). Errors are NaN where there was no contact to judge."""

    duration_s: float
    direction: Array
    target_force_N: float
    force_limit_N: float
    force_mean_N: float
    force_rms_error_N: float
    force_peak_N: float
    tip_rms_error_m: float
    contact_seconds: float
    contact: TimeSpan | None
    modes: tuple[TimeSpan, ...]
    safety: tuple[TimeSpan, ...]
    ticks: TickTimes
    board: BoardHealth
    estimate: EstimateQuality
    lost: dict[str, int]
    truncated: bool
    virtual: bool
    first: RigCause | None = None

    @property
    def worst_action(self) -> str:
        """The strongest safety action of the run."""
        return max((span.name for span in self.safety), key=SafetyAction.labels().index, default="none")

    @property
    def judged_over(self) -> str:
        """Return the part of the contact over which mean force and RMS errors are computed."""
        settled = self.contact is not None and self.contact.seconds > SETTLE_S
        return f"after {SETTLE_S:g} s of settling" if settled else f"whole contact, not longer than {SETTLE_S:g} s"

    @property
    def force_kept(self) -> bool:
        """Return whether the mean force after settling is within a tenth of the set-point."""
        return abs(self.force_mean_N - self.target_force_N) <= 0.1 * self.target_force_N


def stack(table: dict[str, Array], *names: str) -> Array:
    """Columns `names` of `table` side by side, (n, len(names))."""
    return np.stack([table[name] for name in names], axis=1)


def table_or_none(recording: RecordingFile, topic: str) -> dict[str, Array] | None:
    """The table of `topic`, None where the recording has no message of it."""
    return recording.table(topic) if recording.topics.get(topic) else None


def spans(stamp_ns: Array, names: Array, notes: Array | None = None) -> list[TimeSpan]:
    """Runs of equal (name, note): each lasts until the next begins, the last one until the last stamp."""
    notes = np.full(len(names), "") if notes is None else notes
    if len(names) == 0:
        return []
    changes = 1 + np.flatnonzero((names[1:] != names[:-1]) | (notes[1:] != notes[:-1]))
    starts = np.concatenate([[0], changes])
    ends = np.append(stamp_ns[changes], stamp_ns[-1])
    return [
        TimeSpan(int(stamp_ns[start]), int(end), str(names[start]), str(notes[start]))
        for start, end in zip(starts, ends, strict=True)
    ]


def summarize(recording: RecordingFile) -> RunSummary:
    """All figures of `recording`; topics that it does not have leave theirs at NaN, zero or empty."""
    first_ns, last_ns = recording.span_ns
    state, force = table_or_none(recording, "state"), table_or_none(recording, "force/sensor")
    modes: list[TimeSpan] = []
    safety: list[TimeSpan] = []
    direction, target_N = np.array([0.0, 0.0, 1.0]), float("nan")
    if state is not None:
        modes = spans(state["stamp_ns"], state["mode"])
        safety = [span for span in spans(state["stamp_ns"], state["safety_action"], state["cause"]) if span.name != "none"]
        direction = _direction(state, direction)
        wanted = state["target_force_N"][np.isfinite(state["target_force_N"])]
        target_N = float(wanted[-1]) if len(wanted) else target_N
    contact = _contact_of(modes)
    pressing = _force_figures(force, contact, direction, target_N)
    return RunSummary(
        duration_s=(last_ns - first_ns) * 1e-9,
        direction=direction,
        target_force_N=target_N,
        force_limit_N=float(recording.configuration.get("safety", {}).get("over_force_N", float("nan"))),
        force_mean_N=pressing[0],
        force_rms_error_N=pressing[1],
        force_peak_N=pressing[2],
        contact_seconds=pressing[3],
        tip_rms_error_m=_tip_error_m(recording, state, contact, direction),
        contact=contact,
        modes=tuple(modes),
        safety=tuple(safety),
        ticks=_ticks(recording),
        board=_board(recording),
        estimate=_estimate(recording, force, contact, direction),
        lost=_lost(recording),
        truncated=recording.truncated or recording.damaged_chunks > 0,
        virtual=recording.run.get("clock") == "virtual",
        first=_first_cause(recording),
    )


def _first_cause(recording: RecordingFile) -> RigCause | None:
    """Return the first cause since the rig was last armed, None where there is none."""
    found = [body for body in recording.messages("cause") if body["name"]]
    if not found:
        return None
    return RigCause(**{name: found[-1][name] for name in ("stamp_ns", "name", "since_ns", "says", "remedy", "followed")})


def _direction(state: dict[str, Array], otherwise: Array) -> Array:
    rows = stack(state, "force_direction_x", "force_direction_y", "force_direction_z")
    rows = rows[np.isfinite(rows).all(axis=1) & (np.abs(np.linalg.norm(rows, axis=1) - 1) < 1e-3)]
    return rows[-1] if len(rows) else otherwise


def _contact_of(modes: list[TimeSpan]) -> TimeSpan | None:
    touching = [span for span in modes if span.name == "contact"]
    return TimeSpan(touching[0].start_ns, touching[-1].end_ns, "contact") if touching else None


def within(stamp_ns: Array, span: TimeSpan | None, settle_s: float = 0.0) -> Array:
    """Mask of the stamps in `span` (its end excluded), less its first `settle_s` where it is longer than that."""
    if span is None:
        return np.zeros(len(stamp_ns), dtype=bool)
    start_ns = span.start_ns + (round(settle_s * 1e9) if span.seconds > settle_s else 0)
    return (stamp_ns >= start_ns) & (stamp_ns < span.end_ns)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")


def _force_figures(
    force: dict[str, Array] | None, contact: TimeSpan | None, direction: Array, target_N: float
) -> tuple[float, float, float, float]:
    """(mean and RMS error after settling, peak of the whole run, seconds of touch)."""
    if force is None:
        return float("nan"), float("nan"), float("nan"), 0.0
    vectors, stamp_ns = stack(force, "fx_N", "fy_N", "fz_N"), force["stamp_ns"]
    pressing_N = vectors @ direction
    peak_N = float(np.linalg.norm(vectors, axis=1).max())
    if contact is None:
        return float("nan"), float("nan"), peak_N, 0.0
    settled = within(stamp_ns, contact, SETTLE_S)
    steps_s = np.diff(stamp_ns, append=stamp_ns[-1]) * 1e-9
    touching = within(stamp_ns, contact) & (pressing_N > TOUCH_N)
    return (
        float(pressing_N[settled].mean()) if settled.any() else float("nan"),
        _rms(pressing_N[settled] - target_N),
        peak_N,
        float(np.minimum(steps_s, 0.1)[touching].sum()),
    )


def _tip_error_m(
    recording: RecordingFile, state: dict[str, Array] | None, contact: TimeSpan | None, direction: Array
) -> float:
    """RMS distance of the tracked tip from its target during contact, across the direction that force controls."""
    pose = table_or_none(recording, "pose/tip")
    if pose is None or state is None:
        return float("nan")
    tip_m = stack(pose, "x_m", "y_m", "z_m")
    good = within(pose["stamp_ns"], contact, SETTLE_S) & ~pose["missing"]
    target_m = stack(state, "target_x_m", "target_y_m", "target_z_m")
    at = np.searchsorted(state["stamp_ns"], pose["stamp_ns"][good], side="right") - 1
    error_m = tip_m[good] - target_m[np.maximum(at, 0)]
    across_m = error_m - np.outer(error_m @ direction, direction)
    return _rms(np.linalg.norm(across_m[np.isfinite(across_m).all(axis=1)], axis=1))


def _ticks(recording: RecordingFile) -> TickTimes:
    table = table_or_none(recording, "loop")
    if table is None:
        return TickTimes()
    last = {name: values[-1] for name, values in table.items()}
    return TickTimes(
        loop_hz=float(last["loop_hz"]),
        ticks=int(last["ticks"]),
        missed=int(last["missed_ticks"]),
        p50_us=float(last["tick_p50_us"]),
        p99_us=float(last["tick_p99_us"]),
        p999_us=float(last["tick_p999_us"]),
        max_us=float(last["tick_max_us"]),
        lateness_p99_us=float(last["lateness_p99_us"]),
        lateness_max_us=float(last["lateness_max_us"]),
        longest_gap_ns=int(last["longest_gap_ns"]),
        longest_gap_where=str(last["longest_gap_where"]),
        histogram=np.array([last[f"tick_bucket_{k:02d}"] for k in range(HISTOGRAM_BUCKETS)]),
    )


def _board(recording: RecordingFile) -> BoardHealth:
    table = table_or_none(recording, "board")
    if table is None:
        return BoardHealth()
    faulty = table["fault"] != 0
    names = [
        str(name) or f"fault {code}" for name, code in zip(table["fault_name"][faulty], table["fault"][faulty], strict=True)
    ]
    gaps = [
        int(np.abs(table[f"position_{axis}_steps"] - _as_steps(recording, table, axis)).max())
        for axis in ("insertion", "roll", "knob")
    ]
    return BoardHealth(
        known=True,
        faults=tuple(dict.fromkeys(names)),
        crc_errors=int((table["crc_errors"] + table["host_crc_errors"]).max()),
        underruns=int(table["underruns"].max()),
        rejected=int(table["rejected"].max()),
        refusals=_refusals(table["rejected"], table["last_reject"]),
        resets=int(table["boot_count"].max() - table["boot_count"].min()),
        encoder_gap_steps=(gaps[0], gaps[1], gaps[2]),
    )


def _refusals(rejected: Array, reasons: Array) -> dict[str, int]:
    """Count refused set-points by reason, as far as the statuses show it: each has the reason of its newest refusal."""
    more = np.diff(rejected, prepend=0)
    counts: dict[str, int] = {}
    for count, reason in zip(more[more > 0], reasons[more > 0], strict=True):
        counts[str(reason)] = counts.get(str(reason), 0) + int(count)
    return counts


def _as_steps(recording: RecordingFile, table: dict[str, Array], axis: str) -> Array:
    stages = recording.configuration.get("stages", {})
    per_step = float(stages.get(axis, {}).get("encoder_counts_per_step", 1.0))
    return np.round(table[f"encoder_{axis}_counts"] / per_step).astype(np.int64)


def _estimate(
    recording: RecordingFile, force: dict[str, Array] | None, contact: TimeSpan | None, direction: Array
) -> EstimateQuality:
    table = table_or_none(recording, "force/estimate")
    if table is None or force is None:
        return EstimateQuality()
    asked = within(table["stamp_ns"], contact)
    good = asked & table["converged"] & (table["frame"] == "base")
    count = int(asked.sum())
    if not good.any():
        return EstimateQuality(count=count, converged_share=0.0 if count else float("nan"))
    along_N, sd_N = estimate_along(table, direction)
    measured_N = np.interp(table["stamp_ns"], force["stamp_ns"], stack(force, "fx_N", "fy_N", "fz_N") @ direction)
    error_N = (along_N - measured_N)[good]
    return EstimateQuality(
        count=count,
        converged_share=float(good.sum() / count),
        mean_error_N=float(error_N.mean()),
        rms_error_N=_rms(error_N),
        median_sd_N=float(np.median(sd_N[good])),
        within_2sd_share=float(np.mean(np.abs(error_N) <= 2 * sd_N[good])),
        median_delay_s=float(np.median((table["published_ns"] - table["stamp_ns"])[good]) * 1e-9),
    )


def estimate_along(table: dict[str, Array], direction: Array) -> tuple[Array, Array]:
    """Force estimates (n,) along `direction` and their standard deviations (n,), N; NaN where there was none."""
    names = [f"c{row}{column}_N2" for row in "xyz" for column in "xyz"]
    covariance_N2 = stack(table, *names).reshape(-1, 3, 3)
    variance_N2 = np.einsum("i,nij,j->n", direction, covariance_N2, direction)
    return stack(table, "fx_N", "fy_N", "fz_N") @ direction, np.sqrt(np.maximum(variance_N2, 0.0))


def _lost(recording: RecordingFile) -> dict[str, int]:
    """Topic -> messages that their numbers say are missing."""
    lost = {topic: missing_numbers(recording.table(topic)["sequence"]) for topic in recording.topics}
    return {topic: count for topic, count in lost.items() if count}


def missing_numbers(numbers: Array) -> int:
    """Return how many messages of a topic are missing between those with `numbers` (n,).

    Each publisher counts from 0, and again from 0 after a restart. A topic can have several of them, as the log has, and a
    message does not name its own: it is taken for the next one of the publisher whose newest number is closest below.
    """
    if len(numbers) < 2 or np.all(np.diff(numbers) == 1):
        return 0
    newest: list[int] = []
    missing = 0
    for number in map(int, numbers):
        at = bisect.bisect_left(newest, number)
        if at == 0 or number == 0:
            newest.insert(0, number)
        else:
            missing += number - newest[at - 1] - 1
            newest[at - 1] = number
    return missing


__all__ = [
    "BoardHealth",
    "EstimateQuality",
    "RunSummary",
    "TickTimes",
    "TimeSpan",
    "estimate_along",
    "spans",
    "stack",
    "summarize",
    "table_or_none",
    "within",
]
