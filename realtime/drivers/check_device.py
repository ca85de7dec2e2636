"""Is a sensor fit for an experiment? Reads it for some seconds and gives figures and what is wrong with them."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from realtime.drivers.aurora import AuroraConfig
from realtime.drivers.device_events import DeviceEvent, DeviceEventKind
from realtime.drivers.net_ft import RDT_PORT, ForceSample, NetFtConfig
from realtime.drivers.net_ft_calibration import fetch_calibration
from realtime.drivers.pose_sample import PoseSample
from realtime.drivers.sensor_threads import AuroraThread, NetFtThread, SensorThread
from realtime.drivers.transport import Transport

# Below this share of the nominal rate, above these shares of missing or damaged, a device is not fit.
MIN_RATE, MAX_MISSING, MAX_DAMAGED, MAX_LOST = 0.98, 0.01, 0.001, 0.001
MAX_POSITION_NOISE_M = 0.001
# Longest time to the first sample: an Aurora resets and starts its tools, a force box only streams.
AURORA_START_UP_S, NET_FT_START_UP_S, SOURCE_START_UP_S = 30.0, 3.0, 5.0


@dataclass
class DeviceReport:
    """figures: name with unit -> value; problems: one line each, empty when the device is fit; events: of its driver."""

    device: str
    figures: dict[str, float | str] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    events: list[DeviceEvent] = field(default_factory=list)

    @property
    def good(self) -> bool:
        """Return whether the device is fit for an experiment."""
        return not self.problems


def check_aurora(
    open_transport: Callable[[], Transport],
    config: AuroraConfig | None = None,
    seconds: float = 5.0,
) -> DeviceReport:
    """Bring an Aurora up and read it for `seconds`; the tools should lie still in the volume."""
    config = config or AuroraConfig()
    report, samples = DeviceReport("aurora"), list[PoseSample]()
    thread = AuroraThread(open_transport, samples.append, config, report.events.append)
    if not _run(thread, samples, seconds, report, AURORA_START_UP_S):
        return report
    counters, client = thread.client.counters, thread.client
    report.figures |= {
        "firmware": client.firmware,
        "clock_drift": client.clock.drift,
        "polls": counters.polls,
        "damaged": counters.damaged,
        "poll_timeouts": counters.poll_timeouts,
    }
    if counters.damaged > MAX_DAMAGED * counters.replies:
        report.problems.append(f"{counters.damaged} of {counters.replies} replies damaged: cable, speed, interference")
    ages_s = np.array([sample.arrival_ns - sample.stamp_ns for sample in samples]) * 1e-9
    report.figures |= {"age_median_s": float(np.median(ages_s)), "age_p99_s": float(np.quantile(ages_s, 0.99))}
    for handle, tool in client.tools.items():
        report.figures[f"{handle}.serial"] = tool.serial
        if handle in client.written:
            report.figures[f"{handle}.definition_bytes"] = client.written[handle]
    for handle in config.tools or tuple(client.tools):
        _check_tool(report, handle, [sample for sample in samples if sample.tool == handle], config.rate_hz)
    return report


def check_poses(
    make_thread: Callable[[Callable[[PoseSample], object], Callable[[DeviceEvent], object]], SensorThread],
    tools: tuple[str, ...],
    rate_hz: float,
    seconds: float,
    device: str,
) -> DeviceReport:
    """Read any tracker for `seconds`; the tools should lie still in the volume.

    Args:
        make_thread: makes its thread, not started, of a callback for samples and one for events.
        tools: names that its samples bear. rate_hz: of each tool. device: kind of the tracker, for the report.
    """
    report, samples = DeviceReport(device), list[PoseSample]()
    if not _run(make_thread(samples.append, report.events.append), samples, seconds, report, SOURCE_START_UP_S):
        return report
    for tool in tools:
        _check_tool(report, tool, [sample for sample in samples if sample.tool == tool], rate_hz)
    return report


def check_forces(
    make_thread: Callable[[Callable[[ForceSample], object], Callable[[DeviceEvent], object]], SensorThread],
    rate_hz: float,
    seconds: float,
    device: str,
) -> DeviceReport:
    """Read any force sensor for `seconds`; nothing should touch it. Arguments as of `check_poses`."""
    report, samples = DeviceReport(device), list[ForceSample]()
    if not _run(make_thread(samples.append, report.events.append), samples, seconds, report, SOURCE_START_UP_S):
        return report
    rate = (len(samples) - 1) / max((samples[-1].stamp_ns - samples[0].stamp_ns) * 1e-9, 1e-9)
    force_N = np.array([sample.force_N for sample in samples])
    report.figures["rate_hz"] = rate
    for axis, name in enumerate("xyz"):
        report.figures |= {
            f"mean_{name}_N": float(np.mean(force_N[:, axis])),
            f"noise_{name}_N": float(np.std(force_N[:, axis])),
        }
    if rate < MIN_RATE * rate_hz:
        report.problems.append(f"{rate:.0f} samples a second, wanted {rate_hz:g}")
    return report


def _check_tool(report: DeviceReport, handle: str, samples: list[PoseSample], rate_hz: float) -> None:
    if len(samples) < 2:
        report.problems.append(f"tool {handle}: no poses; is it plugged in?")
        return
    rate = (len(samples) - 1) / ((samples[-1].stamp_ns - samples[0].stamp_ns) * 1e-9)
    missing = float(np.mean([sample.missing for sample in samples]))
    report.figures |= {f"{handle}.rate_hz": rate, f"{handle}.missing_share": missing}
    if rate < MIN_RATE * rate_hz:
        report.problems.append(f"tool {handle}: {rate:.1f} poses a second, wanted {rate_hz:g}")
    if missing > MAX_MISSING:
        report.problems.append(f"tool {handle}: missing in {100 * missing:.1f} % of the frames; in the volume? metal near?")
    seen = np.array([sample.position_m for sample in samples if not sample.missing])
    if len(seen) > 2:
        noise_m = float(np.max(np.std(np.diff(seen, axis=0), axis=0)) / np.sqrt(2))
        report.figures[f"{handle}.noise_m"] = noise_m
        if noise_m > MAX_POSITION_NOISE_M:
            report.problems.append(f"tool {handle}: noise of {1e3 * noise_m:.2f} mm; metal near the field generator?")


def check_net_ft(host: str, seconds: float = 5.0, port: int = RDT_PORT, web_port: int = 80) -> DeviceReport:
    """Read the box's page, then its stream for `seconds`; nothing should touch the sensor."""
    report, samples = DeviceReport("net_ft"), list[ForceSample]()
    try:
        calibration = fetch_calibration(host, web_port)
    except (OSError, ValueError) as bad:
        report.problems.append(str(bad))
        return report
    report.figures |= {
        "serial": calibration.serial,
        "counts_per_N": calibration.counts_per_N,
        "counts_per_Nm": calibration.counts_per_Nm,
    }
    thread = NetFtThread(host, samples.append, NetFtConfig(calibration), report.events.append, port)
    if not _run(thread, samples, seconds, report, NET_FT_START_UP_S):
        return report
    counters = thread.client.counters
    force_N = np.array([sample.force_N for sample in samples])
    rate = (len(samples) - 1) / max((samples[-1].stamp_ns - samples[0].stamp_ns) * 1e-9, 1e-9)
    report.figures |= {
        "rate_hz": rate,
        "lost": counters.lost,
        "status_errors": counters.status_errors,
        "clock_drift": thread.client.clock.drift,
    }
    for axis, name in enumerate("xyz"):
        report.figures[f"mean_{name}_N"] = float(np.mean(force_N[:, axis]))
        report.figures[f"noise_{name}_N"] = float(np.std(force_N[:, axis]))
    if rate < MIN_RATE * calibration.rdt_rate_hz:
        report.problems.append(f"{rate:.0f} records a second, the box is set to {calibration.rdt_rate_hz:g}")
    if counters.lost > MAX_LOST * counters.records:
        report.problems.append(f"{counters.lost} of {counters.records} records lost: network shared?")
    if counters.status_errors or counters.frozen:
        report.problems.append(f"{counters.status_errors} records with a fault, {counters.frozen} frozen; see the events")
    return report


def _run(thread: SensorThread, samples: list[Any], seconds: float, report: DeviceReport, start_up_s: float) -> bool:
    """Let the thread collect for `seconds` after its first sample; return False if none came.

    It ends at once where the port or address is not there, or where bringing the device up has failed.
    """
    thread.start()
    deadline_s = time.monotonic() + start_up_s
    while not samples and time.monotonic() < deadline_s and thread.is_alive() and not _absent(thread):
        time.sleep(0.01)
    if samples:
        time.sleep(seconds)
    thread.stop()
    report.problems += [event.text for event in report.events if event.kind is DeviceEventKind.ERROR]
    if thread.error is not None:
        report.problems.append(f"{report.device}: ended by {type(thread.error).__name__}: {thread.error}")
    if not samples and not report.problems:
        report.problems.append(f"no sample within {start_up_s:g} s")
    return bool(samples)


def _absent(thread: SensorThread) -> bool:
    """Return whether the device could not be opened, or its first session has failed."""
    return thread.failures > 0 or (isinstance(thread, AuroraThread) and thread.client.phase == "waiting")
