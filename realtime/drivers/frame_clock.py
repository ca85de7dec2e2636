"""From a device's frame counter to sampling times on the host's clock: a minimum-delay filter that follows drift."""

from __future__ import annotations

from collections import deque
from itertools import pairwise

# Closed blocks from which on the slope is fitted.
_LINE_FROM = 3


class FrameClock:
    """Learns at which host time each frame could have arrived at the earliest.

    Arrivals are late by a varying delay, never early: the truth lies along the lower edge of (frame, arrival).
    Of each `block_s` the least delayed arrival is kept, over `window_s`; below these points lies the line with the
    least sum of distances, which is the edge of their lower convex hull under their mean (Moon, Skelly and Towsley,
    "Estimation and removal of clock skew from network delay measurements", 1999). Its slope is the drift.
    An arrival far before or after the line is not learnt from; a run of such begins the learning again.
    """

    def __init__(
        self,
        period_s: float,
        *,
        window_s: float = 30.0,
        block_s: float = 0.5,
        max_drift: float = 500e-6,
        early_s: float = 0.005,
        late_s: float = 1.0,
        strange_in_row: int = 10,
    ) -> None:
        """Args: period_s: nominal time between frames; max_drift: largest clock error assumed (ratio);
        early_s, late_s: distance from the line beyond which an arrival is strange."""
        if not period_s > 0:
            raise ValueError(f"period_s: found {period_s}, wanted more than 0")
        self.period_ns = period_s * 1e9
        self.restarts = 0
        self.strange = 0
        self._block_frames = max(1, round(block_s / period_s))
        self._blocks: deque[tuple[float, float]] = deque(maxlen=max(2, round(window_s / block_s)))
        self._max_slope = max_drift * self.period_ns
        self._early_ns, self._late_ns, self._strange_in_row = early_s * 1e9, late_s * 1e9, strange_in_row
        self._origin: tuple[int, int] | None = None

    @property
    def drift(self) -> float:
        """Rate error of the device's clock against the host's (ratio, positive: the device is slow)."""
        return self._slope / self.period_ns if self._origin else 0.0

    def reset(self) -> None:
        """Forget everything; the next arrival starts again."""
        self._origin = None

    def observe(self, frame: int, arrival_ns: int) -> int:
        """Learn from an arrival of `frame` (unwrapped) and return `time_ns(frame)`, never after the arrival."""
        if self._origin is None:
            self._start(frame, arrival_ns)
        residual = self._residual(frame, arrival_ns)
        distance = residual - self._line(frame - self._frame_0)
        # Before the line is known an early arrival is not strange: the ones before it were late.
        if distance <= self._late_ns and (distance >= -self._early_ns or len(self._blocks) < _LINE_FROM):
            self._row = 0
            self._learn(frame - self._frame_0, residual)
        else:
            self.strange += 1
            self._row += 1
            if self._row >= self._strange_in_row:
                self.restarts += 1
                self._start(frame, arrival_ns)
        return min(self.time_ns(frame), arrival_ns)

    def time_ns(self, frame: int) -> int:
        """Host time at which `frame` would have arrived with the least delay. Raises ValueError before any arrival."""
        if self._origin is None:
            raise ValueError("frame clock: found no arrival yet, wanted at least one")
        x = frame - self._frame_0
        return self._arrival_0 + round(x * self.period_ns + self._line(x))

    def _start(self, frame: int, arrival_ns: int) -> None:
        self._origin = (frame, arrival_ns)
        self._frame_0, self._arrival_0 = frame, arrival_ns
        self._offset, self._slope, self._row = 0.0, 0.0, 0
        self._blocks.clear()
        self._block = 0
        self._least: tuple[float, float] = (0.0, 0.0)

    def _residual(self, frame: int, arrival_ns: int) -> float:
        return arrival_ns - self._arrival_0 - (frame - self._frame_0) * self.period_ns

    def _line(self, x: float) -> float:
        return self._offset + self._slope * x

    def _learn(self, x: int, residual: float) -> None:
        block = x // self._block_frames
        if block != self._block:
            self._blocks.append(self._least)
            self._block, self._least = block, (x, residual)
            self._fit()
        elif residual < self._least[1]:
            self._least = (x, residual)
        if residual < self._line(x):
            self._fit()

    def _fit(self) -> None:
        """The line under all kept points; flat until there are enough of them."""
        points = sorted([*self._blocks, self._least])
        if len(points) > _LINE_FROM:
            hull = _lower_hull(points)
            mean = sum(x for x, _ in points) / len(points)
            for (x0, y0), (x1, y1) in pairwise(hull):
                if x0 <= mean <= x1 and x1 > x0:
                    self._slope = min(max((y1 - y0) / (x1 - x0), -self._max_slope), self._max_slope)
        self._offset = min(y - self._slope * x for x, y in points)


def _lower_hull(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Lower convex hull of points sorted by x (Andrew's monotone chain)."""
    hull: list[tuple[float, float]] = []
    for x, y in points:
        while len(hull) >= 2:
            (x0, y0), (x1, y1) = hull[-2], hull[-1]
            if (x1 - x0) * (y - y0) > (y1 - y0) * (x - x0):
                break
            hull.pop()
        hull.append((x, y))
    return hull
