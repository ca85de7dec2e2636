"""Soak: hours of the job in virtual time; memory, clocks, steps, counters and the recording's size, minute by minute."""

from __future__ import annotations

import gc
import os
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from host.estimation.service import DEFAULT_ESTIMATOR, EstimationService, load_estimator
from host.recordings.header import header_of
from host.recordings.recording import is_whole
from host.recordings.writer import RecordingWriter
from protocol.enums import Phase
from protocol.rig_file import SIMULATED_RIG, load_rig
from protocol.topics import Message
from sim.board import STEP_TIMER_CYCLES, SimulatedBoard, resolve_kind
from sim.forked_board import LibraryBoard
from sim.scenario import TARGET_M, ContactJob, Scenario
from sim.world import World, simulated_plant

JOB = ContactJob(target_m=TARGET_M)
MAX_MEMORY_SLOPE_MB_PER_H, MAX_CLOCK_ERROR_S, MAX_RECORDING_MB_PER_MIN = 1.0, 1e-3, 6.0
MAX_INTERRUPT_SHARE, MIN_STACK_FREE_BYTES = 0.8, 256
# The first minutes compile, fill caches and the filters' windows; they are not part of the slope.
WARM_UP_SHARE = 0.3
NOT_KNOWN = "not measured with the native board"


@dataclass
class SoakResult:
    """Figures of a soak. memory_mb: resident, at each virtual minute; the slope is per virtual hour."""

    virtual_s: float = 0.0
    memory_mb: list[float] = field(default_factory=list)
    memory_slope_mb_per_h: float = 0.0
    clock_error_s: float = 0.0
    steps_exact: bool = True
    edges: int = 0
    peak_force_N: float = 0.0
    step_interrupt_share: float = 0.0
    stack_free_bytes: int = 0
    edge_jitter_s: float = 0.0
    recording_mb_per_min: float = 0.0
    recording_readable: bool = False
    counts: dict[str, int] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)

    def as_dict(self) -> dict[str, Any]:
        """Return the figures as a dictionary for JSON."""
        return asdict(self)


def resident_mb() -> float:
    """Resident memory of this process, once the garbage collector has been through."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def _board(kind: str) -> SimulatedBoard:
    """The native board in this process, the AVR one in its own; the campaign's keeps what it was asked, and would grow."""
    return LibraryBoard() if resolve_kind(kind) == "native" else SimulatedBoard(kind)


def soak(
    minutes: float,
    seed: int = 1,
    board_kind: str = "native",
    progress: Callable[[float], None] = lambda share: None,
    record_all: bool = True,
) -> SoakResult:
    """Press on the beating wall for `minutes` of virtual time; without `record_all` the recording stays empty.

    Raises BoardUnavailable where there is no board.
    """
    rig, result = load_rig(SIMULATED_RIG), SoakResult()
    with _board(board_kind) as board, tempfile.TemporaryDirectory(prefix="seldinger-soak-") as folder:
        world = World(rig, simulated_plant(rig, seed), board, seed)
        path = Path(folder) / "soak.mcap"
        with RecordingWriter(path, header_of(rig, "virtual", seed, {"job": "soak"})) as recording:

            def record(topic: str, message: Message) -> None:
                if record_all:
                    recording.write(topic, message, world.now_ns)

            run = Scenario(rig, world, record, estimator=EstimationService(load_estimator(DEFAULT_ESTIMATOR, rig)))
            if not run.arm():
                result.problems.append("rig not armed")
                return result
            run._shape(JOB)
            run.command("target", "contact", target_m=JOB.target_m, normal=JOB.into, force_N=JOB.force_N)
            if not run.run(10.0, lambda: run.phase == Phase.CONTACT):
                result.problems.append("no contact")
                return result
            _minutes(run, minutes, result, progress)
        result.recording_mb_per_min = path.stat().st_size / 1e6 / (world.now_ns / 60e9)
        result.recording_readable = is_whole(path)
    _judge(result)
    return result


def _minutes(run: Scenario, minutes: float, result: SoakResult, progress: Callable[[float], None]) -> None:
    world, loop, begin_ns = run.world, run.loop, run.now_ns
    offset_ns = loop.core.link.mcu_offset_ns(begin_ns)
    every_s = min(60.0, minutes * 60.0 / 20)
    while run.now_ns - begin_ns < minutes * 60e9 and run.phase == Phase.CONTACT:
        run.run(every_s)
        status = loop.core.link.status
        assert status is not None
        result.memory_mb.append(resident_mb())
        # Board and computer share one time here: any change of the offset between their clocks is the link's own error.
        drifted_ns = abs(loop.core.link.mcu_offset_ns(run.now_ns) - offset_ns)
        result.clock_error_s = max(result.clock_error_s, drifted_ns * 1e-9)
        progress((run.now_ns - begin_ns) / (minutes * 60e9))
    if run.phase != Phase.CONTACT:
        result.problems.append(f"contact ended after {(run.now_ns - begin_ns) * 1e-9:.0f} s")
    run.command("target", "hold")
    run.run(0.3)
    status = loop.core.link.status
    assert status is not None
    commanded = [int(steps) for steps in loop.outputs[0].position_steps]
    result.steps_exact = commanded == world.steps.tolist() == list(status.position_steps)
    result.edges, result.peak_force_N, result.virtual_s = int(world.edges.sum()), world.peak_force_N, run.now_ns * 1e-9
    if world.slice is not None:
        result.step_interrupt_share = world.slice.cpu.step_isr_max_cycles / STEP_TIMER_CYCLES
        result.stack_free_bytes = world.slice.cpu.stack_free_bytes
    result.edge_jitter_s = world.edge_jitter_s
    result.counts = {
        "crc_errors": status.crc_errors + loop.core.link.decoder.counters.crc_errors,
        "underruns": status.underruns,
        "rx_overruns": status.rx_overruns,
        "rejected": status.rejected + status.expired + status.overflows,
        "missed_ticks": loop.missed_ticks,
        "force_lost": loop.sensors.force_sensor.counters.lost,
        "poses_damaged": loop.sensors.tracker.counters.damaged,
    }


def _judge(result: SoakResult) -> None:
    """The slope after the warm-up, and what is not as it must be."""
    start = int(WARM_UP_SHARE * len(result.memory_mb))
    late = np.array(result.memory_mb[start:])
    if len(late) > 2:
        hours = np.arange(len(late)) * result.virtual_s / 3600.0 / len(result.memory_mb)
        result.memory_slope_mb_per_h = float(np.polyfit(hours, late, 1)[0])
    if result.memory_slope_mb_per_h > MAX_MEMORY_SLOPE_MB_PER_H:
        result.problems.append(f"memory grows by {result.memory_slope_mb_per_h:.2f} MB/h")
    if result.clock_error_s > MAX_CLOCK_ERROR_S:
        result.problems.append(f"clocks {1e3 * result.clock_error_s:.2f} ms apart")
    if result.step_interrupt_share > MAX_INTERRUPT_SHARE:
        result.problems.append(f"step interrupt takes {100 * result.step_interrupt_share:.0f} % of its period")
    if result.step_interrupt_share and result.stack_free_bytes < MIN_STACK_FREE_BYTES:
        result.problems.append(f"{result.stack_free_bytes} bytes of the board's memory between variables and deepest stack")
    if not result.steps_exact:
        result.problems.append("steps commanded, on the pins and reported differ")
    if not result.recording_readable:
        result.problems.append("recording not readable to its end")
    if result.recording_mb_per_min > MAX_RECORDING_MB_PER_MIN:
        result.problems.append(f"recording of {result.recording_mb_per_min:.1f} MB a minute")
    result.problems += [f"{name}: {count}" for name, count in result.counts.items() if count]


def page_section(result: SoakResult, minutes: float, seed: int, board: str) -> str:
    """The section on the soak in docs/reliability.md."""
    counts = ", ".join(f"{name} {count}" for name, count in result.counts.items())
    known = bool(result.step_interrupt_share)  # the native board counts no cycles
    return "\n".join(
        [
            "## Soak" if not board.startswith("avr") else "## Soak with the firmware's ELF in simavr",
            "",
            f"`seldinger soak --minutes {minutes:g} --seed {seed} --board {board} --docs docs/reliability.md`",
            "",
            f"{result.virtual_s / 60:.1f} minutes of virtual time, {result.edges} step edges.",
            "",
            "| quantity | found | limit |",
            "|---|---|---|",
            f"| memory, after the first {100 * WARM_UP_SHARE:.0f} % | {result.memory_slope_mb_per_h:+.2f} MB per hour, "
            f"{result.memory_mb[-1] if result.memory_mb else 0:.0f} MB at the end | below {MAX_MEMORY_SLOPE_MB_PER_H:g} |",
            f"| board's clock against the loop's | {1e3 * result.clock_error_s:.3f} ms | {1e3 * MAX_CLOCK_ERROR_S:g} ms |",
            f"| steps commanded, on the pins, reported | {'equal' if result.steps_exact else 'differ'} | equal |",
            f"| peak force | {result.peak_force_N:.3f} N | 0.55 N |",
            f"| recording | {result.recording_mb_per_min:.2f} MB a minute, "
            f"{'readable' if result.recording_readable else 'not readable'} | {MAX_RECORDING_MB_PER_MIN:g} MB |",
            "| longest step interrupt | "
            + (f"{100 * result.step_interrupt_share:.0f} % of its period" if known else NOT_KNOWN)
            + f" | {100 * MAX_INTERRUPT_SHARE:.0f} % |",
            "| memory between variables and deepest stack | "
            + (f"{result.stack_free_bytes} bytes" if known else NOT_KNOWN)
            + f" | {MIN_STACK_FREE_BYTES} bytes |",
            "| jitter of step edges at the pins, peak to peak | "
            + (f"{1e6 * result.edge_jitter_s:.1f} us" if known else NOT_KNOWN)
            + " | 50 us, the timer's period |",
            f"| counts | {counts} | all 0 |",
            "",
            "Problems: " + ("; ".join(result.problems) or "none") + ".",
        ]
    )
