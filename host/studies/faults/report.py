"""The results of a fault campaign: the section of docs/reliability.md."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from host.studies.faults.campaign import DELAYS_S, HOLD_AFTER_S, OVER_FORCE_SHARE, SECOND_WITHIN_S, RunResult, summary_of
from protocol.rig_file import SIMULATED_RIG, load_rig
from realtime.control.stage_limiter import crossing_time_s
from sim.fault_table import BY_NAME, FAULTS, LINK_REST_S, PEAK_N, STEPS_TO_FIND, FaultKind

MOST_EXAMPLES = 12


_PAGE = """## Faults

`seldinger faults --runs {runs} --seed {seed} --board {board} --docs docs/reliability.md`

In {reached} runs in lock step the rig reached the phase in which the fault was injected. (Approach: on the way to the
beating wall; contact: up to {touch_s:g} s after first contact; hold: from {hold_s:g} s after it.) In {not_reached} further
runs it did not reach the phase: the drawn catheter, wall or heart differs so much from the rig file that the rig retracted
before, without a fault. Force and motion are those of the plant, not readings of a sensor.

One rig of three is as its file says. One of three has another patient: wall 1 to 10 N/mm, heart 0.8 to 3 Hz and 0.5 to
5 mm, irregular. One of three also has another catheter, with 0.5 to 2 times the stiffness of its file. Half of the rigs
close the loop with the force sensor, half with the estimate. A fifth of the runs has a second fault within {second_s:g} s.

The limit of the true force is {limit_N} N. It is higher only if the drawn wall presses a catheter at rest with a larger
force, because no software can move the catheter while the board has no link. An alarm without a fault counts as false
unless the catheter differs from its file, or the true force was above {over_share:.0%} of the limit.

Runs that broke a rule: **{bad}**. Largest true force: {peak_N:.3f} N (limit {limit_N} N). Unhandled exceptions:
{unhandled}. Recordings that could not be read: {unreadable}. Motion without a command after a stop: {rearmed}.

**What was injected:**

{injected}

**How it was detected:**

{detected}

- *must be detected*: runs in which the fault was large or long enough to have an effect (`sim/fault_table.py`); the others
  may or may not be detected. A jam or slip must be detected if more than {steps_to_find} steps were lost for {lost_s:g} s
  or longer; its time of detection counts from the begin of that loss.
- *first detected by*: a cause of the failsafe, a line in the log, or a count of a driver or the board.

**What followed:**

{followed}

- *strongest action*: number of runs in which it was the strongest.
- *motion into the tissue after*: motion of the insertion stage after the fault was detected, if the action was hold,
  retract or stop.
- After a lost link, reset or power cycle all stages must be at rest within {rest_ms:.0f} ms: longest {longest_ms:.0f} ms.

{violations}

Loss of the zenoh router, processes killed with SIGKILL and real disks need the wall clock. Other tests cover them
(`tests/host/test_wall_clock.py`, `tests/host/test_recording.py`). An encoder that fails while its axis is at rest is
detected when the axis moves. A wrong force sensor is detected when its difference from the estimate exceeds 1.5 standard
deviations of the estimate (`realtime/control/witnesses.py`).

**A knob that slips at the stage's full speed straightens the catheter** before the insertion stage has crossed its
backlash ({crossing_ms:.0f} ms). Use a motor with a torque reserve: it slips more slowly.
"""


def page_section(results: list[RunResult], seed: int, board: str) -> str:
    """The section as Markdown: what was done, a table with a row per fault, every kind of violation, what is missing."""
    bad = [result for result in results if result.violations]
    missing = summary_of(results)["not_reached"]
    return _PAGE.format(
        runs=len(results),
        reached=len(results) - missing,
        not_reached=missing,
        seed=seed,
        board=board,
        touch_s=DELAYS_S["contact"],
        hold_s=HOLD_AFTER_S,
        bad=len(bad),
        peak_N=max((result.outcome.get("peak_force_N", 0.0) for result in results), default=0.0),
        limit_N=PEAK_N,
        second_s=SECOND_WITHIN_S,
        over_share=OVER_FORCE_SHARE,
        unhandled=sum(bool(result.unhandled) for result in results),
        unreadable=sum(not result.recording_readable for result in results),
        rearmed=sum(bool(result.outcome.get("rearmed")) for result in results),
        **_tables(results),
        rest_ms=1e3 * LINK_REST_S,
        longest_ms=_longest_rest_ms(results),
        violations="\n".join(_violations(bad)),
        steps_to_find=STEPS_TO_FIND,
        lost_s=BY_NAME["missed_steps"].within_s,
        crossing_ms=_crossing_ms(),
    )


def _tables(results: list[RunResult]) -> dict[str, str]:
    """The three tables of the section: what was injected, how it was detected, what followed; a row for each fault."""
    shown = [(fault, [r for r in results if r.plan.fault == fault.name]) for fault in FAULTS]
    shown = [(fault, runs) for fault, runs in shown if runs]
    return {
        "injected": _table("fault | what it does | size and duration", [_injected(fault) for fault, _ in shown]),
        "detected": _table(
            "fault | runs | must be detected, missed | detected after, ms (median, 99 %) | first detected by",
            [(fault.name, *_detected(runs)) for fault, runs in shown],
        ),
        "followed": _table(
            "fault | strongest action | peak, N | motion into the tissue after, mm | poses lost",
            [(fault.name, *_followed(runs)) for fault, runs in shown],
        ),
    }


def _table(head: str, rows: Sequence[Sequence[object]]) -> str:
    lines = [f"| {head} |", "|" + "---|" * (head.count("|") + 1)]
    return "\n".join([*lines, *("| " + " | ".join(map(str, row)) + " |" for row in rows)])


def _injected(fault: FaultKind) -> tuple[str, str, str]:
    """Name, meaning, and the ranges from which size and duration are drawn."""
    drawn = [f"{fault.size[0]:g} to {fault.size[1]:g} {fault.unit}"] if fault.unit else []
    if fault.seconds[0] != fault.seconds[1]:
        drawn.append(f"{fault.seconds[0]:g} to {fault.seconds[1]:g} s")
    return fault.name, fault.says, ", ".join(drawn)


def _detected(results: list[RunResult]) -> tuple[object, ...]:
    """Runs, those in which the fault must be detected, times of detection, and what detected it most often."""
    s = summary_of(results)
    times = "" if s["detection_ms_p50"] is None else f"{s['detection_ms_p50']:.0f}, {s['detection_ms_p99']:.0f}"
    found = Counter(_what(result.outcome["detected_by"]) for result in results if result.outcome.get("detected_by"))
    return s["runs"], f"{s['must_detect']}, {s['missed']}", times, found.most_common(1)[0][0] if found else ""


def _followed(results: list[RunResult]) -> tuple[object, ...]:
    """Actions with their counts, largest force, largest motion into the tissue, and lost poses."""
    s = summary_of(results)
    actions = ", ".join(f"{name} {count}" for name, count in sorted(s["actions"].items(), key=lambda item: -item[1]))
    return actions, f"{s['peak_force_N']:.3f}", f"{1e3 * s['moved_after_m']:.2f}", s["poses_lost"]


def _what(found: str) -> str:
    """The kind of finding and its source, without the particulars."""
    kind, _, rest = found.partition(": ")
    return f"{kind}: " + (rest.split(":")[0] if kind == "log" else rest.split(",")[0])


def _crossing_ms() -> float:
    """Time that the insertion stage of the simulated rig takes to cross the backlash."""
    rig = load_rig(SIMULATED_RIG)
    insertion = rig.stages.insertion
    return 1e3 * crossing_time_s(
        rig.transmission.insertion_backlash_m, insertion.max_speed_unit_per_s, insertion.max_accel_unit_per_s2
    )


def _longest_rest_ms(results: list[RunResult]) -> float:
    links = {fault.name for fault in FAULTS if fault.rest_s}
    return max((1e3 * r.outcome.get("rest_s", 0.0) for r in results if r.plan.fault in links), default=0.0)


def _violations(bad: list[RunResult]) -> list[str]:
    if not bad:
        return ["No run broke a rule."]
    lines = ["Runs that broke a rule" + (f" (the first {MOST_EXAMPLES})" if len(bad) > MOST_EXAMPLES else "") + ":", ""]
    for result in bad[:MOST_EXAMPLES]:
        plan = result.plan
        lines.append(
            f"- run {plan.index}: {plan.fault} in {plan.phase}, size {plan.size:.3g}, {plan.seconds:.2f} s: "
            + "; ".join(result.violations)
        )
    return lines
