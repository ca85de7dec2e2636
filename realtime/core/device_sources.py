"""Trackers and force sensors as plug-ins: what a source is, how the rig file chooses one, and the thread that reads it.

A source is a small class with `read` and `close`. It is found by the `kind` of its section in the rig file: among those that
come with the package, or by an entry point that another package declares in the group `seldinger.trackers` or
`seldinger.force_sensors`. docs/devices.md shows one of each.
"""

from __future__ import annotations

import difflib
import importlib
import time
from collections.abc import Callable
from importlib import metadata
from typing import Any, Generic, Protocol, TypeVar, cast

from protocol.errors import Description, InputError
from protocol.rig_file import ForceSensorSection, Rig, Tracker
from realtime.core.lines import force_config, tracker_config
from realtime.drivers.device_events import DeviceEvent, DeviceEventKind
from realtime.drivers.net_ft import RDT_PORT, ForceSample
from realtime.drivers.pose_sample import PoseSample
from realtime.drivers.sample_checks import checked_force, checked_pose
from realtime.drivers.sensor_threads import AuroraThread, NetFtThread, OnEvent, SensorThread
from realtime.drivers.transport import open_serial

TRACKERS, FORCE_SENSORS = "seldinger.trackers", "seldinger.force_sensors"
# Sources of the package itself, found as those of other packages are: kind -> module:function.
_OWN = {
    TRACKERS: {"openigtlink": "realtime.drivers.openigtlink:open_tracker"},
    FORCE_SENSORS: {"nano17": "realtime.drivers.nano17_daq:open_force_sensor"},
}
# Kinds whose drivers the loop serves as bytes, in virtual time too.
AURORA, NET_FT = "aurora", "net_ft"
_SERVED = {TRACKERS: AURORA, FORCE_SENSORS: NET_FT}
_KEYS = {TRACKERS: "tracker.kind", FORCE_SENSORS: "force_sensor.kind"}
# A source from which nothing comes for so long is lost; it is closed and opened again.
SILENT_S = 1.0

Sample = TypeVar("Sample")
T = TypeVar("T")


class DeviceSource(Protocol[Sample]):
    """An open device. Samples have times of CLOCK_MONOTONIC, ns, and are in the tracker's or the sensor's frame."""

    def read(self) -> list[Sample]:
        """Return the samples since the last call; wait for them at most 50 ms. Raises OSError if the device is gone."""

    def close(self) -> None:
        """Release the port or socket of the device."""


OpenTracker = Callable[[Tracker], DeviceSource[PoseSample]]
OpenForceSensor = Callable[[ForceSensorSection], DeviceSource[ForceSample]]


def _offered(group: str) -> dict[str, str]:
    """Kind -> module:function of all sources in a group, those of other packages included."""
    return {point.name: point.value for point in metadata.entry_points(group=group)} | _OWN[group]


def check_kinds(rig: Rig) -> None:
    """Check that the rig's tracker and force sensor have drivers, and that these and their files load. Raises InputError."""
    tracker_config(rig)
    for group, kind in ((TRACKERS, rig.tracker.kind), (FORCE_SENSORS, rig.force_sensor.kind)):
        if kind != _SERVED[group]:
            source_of(group, kind)


def source_of(group: str, kind: str) -> Callable[[Any], DeviceSource[Any]]:
    """Return the function that opens a source, called with the section of the rig file.

    Args:
        group: TRACKERS or FORCE_SENSORS.
        kind: as in the rig file.

    Raises:
        InputError: no package offers that kind, or what it offers cannot be imported.
    """
    found = _offered(group)
    key = _KEYS[group]
    if kind not in found:
        known = sorted({_SERVED[group], *found})
        near = difflib.get_close_matches(kind, known, 1)
        meant = f"; did you mean {near[0]}?" if near else ""
        raise InputError(key, kind, f"one of {', '.join(known)}; a package adds one in group {group}{meant}")
    module, _, name = found[kind].partition(":")
    try:
        return cast(Callable[[Any], DeviceSource[Any]], getattr(importlib.import_module(module), name))
    except (ImportError, AttributeError) as error:
        raise InputError(
            key, Description(f"{kind}, which does not load ({error})"), "a package that is installed whole"
        ) from None


class SourceThread(SensorThread, Generic[Sample]):
    """Opens a source, reads it, and opens it again after a loss. `kind` names it in events.

    checked: returns a sample as it may be used, None for one to be dropped; raises TypeError for what is not a sample.
    """

    def __init__(
        self,
        kind: str,
        open_source: Callable[[], DeviceSource[Sample]],
        callback: Callable[[Sample], object],
        on_event: OnEvent | None = None,
        now_ns: Callable[[], int] = time.monotonic_ns,
        checked: Callable[[Sample], Sample | None] = lambda sample: sample,
    ) -> None:
        super().__init__(kind, on_event, now_ns)
        self.samples = 0
        self._checked = checked
        self._kind, self._open, self._callback = kind, open_source, callback
        self._flows, self._flowed, self._reported = False, False, ""

    def _driver(self, what: str, call: Callable[[], T]) -> T:
        """Call into the driver. Raises OSError for anything that it raises: a plug-in's fault is reported like a loss."""
        try:
            return call()
        except OSError as error:
            raise OSError(f"{self._kind}: {error.strerror or error}") from error
        except InputError as error:
            raise OSError(str(error)) from error
        except (Exception, SystemExit) as error:
            said = " ".join(str(error).split())
            raise OSError(
                f"{self._kind}: {what} failed with {type(error).__name__}: {said}; check its section of the rig file "
                "(port, options), then the driver"
            ) from error

    def _serve(self) -> None:
        source = self._driver("open", self._open)
        # What a source's own checks have found, where it has any.
        take_events: Callable[[], list[DeviceEvent]] = getattr(source, "take_events", list)
        try:
            newest_ns, dropped = self._now_ns(), 0
            while not self._halt.is_set():
                given, samples = self._driver("read", lambda: self._read(source))
                dropped += given - len(samples)
                now_ns = self._now_ns()
                if samples:
                    newest_ns, dropped = now_ns, 0
                    self._begin(now_ns)
                elif now_ns - newest_ns > SILENT_S * 1e9:
                    # Without their number: the same line again is not logged again.
                    what = "only samples that are not finite" if dropped else "no sample"
                    raise OSError(f"{self._kind}: {what} for {SILENT_S:g} s")
                for sample in samples:
                    self.samples += 1
                    self._callback(sample)
                self._report(take_events())
        finally:
            source.close()

    def _read(self, source: DeviceSource[Sample]) -> tuple[int, list[Sample]]:
        """Return how many samples the source gave, and those that may be used. Raises TypeError for what is not a sample."""
        given: Any = source.read()
        if not isinstance(given, (list, tuple)):
            raise TypeError(f"read returned {type(given).__name__}, wanted a list of samples")
        checked = [self._checked(sample) for sample in given]
        return len(given), [sample for sample in checked if sample is not None]

    def _begin(self, now_ns: int) -> None:
        if self._flows:
            return
        kind = DeviceEventKind.RECONNECTED if self._flowed else DeviceEventKind.TRACKING
        self._flows, self._flowed, self._reported = True, True, ""
        self._report([DeviceEvent(now_ns, self._kind, kind, "samples flow")])

    def _lost(self, why: str) -> None:
        kind = DeviceEventKind.LOST if self._flows else DeviceEventKind.ERROR
        self._flows = False
        if why != self._reported:
            self._report([DeviceEvent(self._now_ns(), self._kind, kind, why)])
        self._reported = why


def tracker_thread(
    rig: Rig, port: str | None, callback: Callable[[PoseSample], object], on_event: OnEvent | None = None
) -> SensorThread:
    """Return the thread, not started, that reads the rig's tracker; `port` instead of the rig file's. Raises InputError."""
    tracker = rig.tracker if port is None else rig.tracker.model_copy(update={"port": port})
    if tracker.kind == AURORA:
        return AuroraThread(lambda: open_serial(tracker.port, 9600), callback, tracker_config(rig), on_event)
    open_tracker = source_of(TRACKERS, tracker.kind)
    return SourceThread(tracker.kind, lambda: open_tracker(tracker), callback, on_event, checked=checked_pose)


def force_thread(
    rig: Rig, port: int = RDT_PORT, callback: Callable[[ForceSample], object] = print, on_event: OnEvent | None = None
) -> SensorThread:
    """Return the thread, not started, that reads the rig's force sensor; `port`: of a force box. Raises InputError."""
    sensor = rig.force_sensor
    if sensor.kind == NET_FT:
        return NetFtThread(sensor.address, callback, force_config(rig), on_event, port)
    open_sensor = source_of(FORCE_SENSORS, sensor.kind)
    return SourceThread(sensor.kind, lambda: open_sensor(sensor), callback, on_event, checked=checked_force)
