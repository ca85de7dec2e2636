"""A recording for the page: plays, pauses, seeks, and marks the windows that a diagnosis has found."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, ValidationError

from host.recordings.recording import RecordingFile
from host.recordings.rig_picture import WAITING, Picture
from host.view.source import refusal
from protocol.errors import Description, InputError
from protocol.requests import Request
from protocol.text_files import read_json

# Topics whose every message is shown, and those of which only the newest counts.
EVERY = ("state", "force/estimate", "log", "plan")
NEWEST = ("stage", "pose/tip", "pose/shaft", "pose/rear", "force/sensor", "board", "cause", "loop", "stiffness", "contact")
# Of the others the last few: a tool that was not seen leaves the pose before it standing.
LAST = 3
# After a jump the traces are filled with so much of the past.
HISTORY_S = 20.0
MIN_SPEED, MAX_SPEED = 0.05, 50.0


class ReplayControl(Request):
    """Request of the page to the player; fields that are not given stay unchanged."""

    play: bool | None = None
    seek_s: float | None = None
    speed: Annotated[float, Field(ge=MIN_SPEED, le=MAX_SPEED)] | None = None


class Window(Request):
    """One window of a diagnosis. span_s is in seconds from the recording's first sample."""

    subsystem: str
    condition: str
    span_s: tuple[float, float]


class Findings(Request):
    """Parts of a diagnosis that the player shows: verdict, a sentence for each effect, windows."""

    verdict: str
    says: list[str]
    windows: list[Window]


def read_findings(source: str) -> Findings:
    """The findings in the JSON that `seldinger diagnose` writes. Raises InputError where it is none."""
    data = read_json(source)
    try:
        windows = [
            Window(
                subsystem=place["subsystem"],
                condition=str(place.get("condition") or ""),
                span_s=(float(span[0]), float(span[1])),
            )
            for place in data["located"]
            for span in place["windows_s"]
        ]
        return Findings(verdict=data["verdict"], says=[effect["says"] for effect in data["effects"]], windows=windows)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        what = f"no key {error}" if isinstance(error, KeyError) else " ".join(str(error).split())
        raise InputError(source, Description(what), "the JSON that `seldinger diagnose` writes") from None


def origin_ns(recording: RecordingFile) -> int:
    """Return the origin of the times of a diagnosis: the first stamp of the topic with most messages."""
    base = max(recording.topics, key=lambda topic: recording.topics[topic])
    first = recording.message(base, 0)
    if first is None:
        raise InputError(
            str(recording.path), f"a first message of {base} that is not what the topic declares", "one that is"
        )
    return int(first["stamp_ns"])


class Replay:
    """A `Source`. Time advances between frames while it plays, times `speed`, up to the end.

    Raises InputError for a recording without messages, or a speed out of its bounds.
    """

    def __init__(
        self,
        recording: RecordingFile,
        speed: float = 1.0,
        findings: Findings | None = None,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        if not any(topic in recording.topics for topic in (*EVERY, *NEWEST)):
            raise InputError(str(recording.path), "no message of the rig's", "a recording that has some")
        if not MIN_SPEED <= speed <= MAX_SPEED:
            raise InputError("--speed", speed, f"{MIN_SPEED:g} to {MAX_SPEED:g}")
        self._recording, self._findings, self._clock_s = recording, findings, clock_s
        self._picture = Picture(recording.configuration, recording.catheter)
        self._times = {topic: recording.times_ns(topic) for topic in (*EVERY, *NEWEST)}
        self._next = {topic: 0 for topic in self._times}
        self._begin_ns, self._end_ns = recording.span_ns
        self._at_ns, self._looked_s = float(self._begin_ns), clock_s()
        self._playing, self._speed, self._seen = False, speed, False
        self._lock = threading.Lock()
        self._jumps = 0

    def hello(self) -> dict[str, Any]:
        """Kind, rig, span and windows; times are the rig's, seconds. The first to ask starts the player."""
        with self._lock:
            if not self._seen:
                self._seen = self._playing = True
                self._looked_s = self._clock_s()
        configuration, found = self._recording.configuration, self._findings
        origin_s = origin_ns(self._recording) * 1e-9
        windows = (
            []
            if found is None
            else [
                {
                    "from": origin_s + window.span_s[0],
                    "to": origin_s + window.span_s[1],
                    "subsystem": window.subsystem,
                    "condition": window.condition,
                }
                for window in found.windows
            ]
        )
        return {
            "kind": "play",
            "rig": self._recording.run.get("rig", ""),
            "file": Path(self._recording.path).name,
            "catheter": self._recording.catheter.get("name", ""),
            "begin": self._begin_ns * 1e-9,
            "end": self._end_ns * 1e-9,
            "truncated": self._recording.truncated,
            "windows": windows,
            "verdict": found.verdict if found else "",
            "says": found.says if found else [],
            "over_force_N": configuration.get("safety", {}).get("over_force_N"),
            "radius_m": 0.5 * self._recording.catheter.get("diameter_m", 0.0023),
            "past": self._picture.past(),
        }

    def frame(self) -> dict[str, Any]:
        """The picture at the player's time, and where the player is; `jumps` counts the jumps so far."""
        with self._lock:
            now_s = self._clock_s()
            if self._playing:
                self._at_ns = min(self._at_ns + (now_s - self._looked_s) * self._speed * 1e9, self._end_ns)
                self._playing = self._at_ns < self._end_ns
            self._looked_s = now_s
            self._catch_up()
            return {
                **self._picture.frame(),
                "jumps": self._jumps,
                "malformed": 0,
                "silent_s": 0.0,
                "play": {"at": round(self._at_ns * 1e-9, 4), "playing": self._playing, "speed": self._speed},
            }

    def _catch_up(self) -> None:
        """Give the picture all that was recorded up to now; of a long stretch an even choice."""
        for topic in (*NEWEST, *EVERY):
            upto = int(np.searchsorted(self._times[topic], self._at_ns, side="right"))
            first = self._next[topic]
            if upto > first:
                chosen = list(range(max(first, upto - LAST), upto))
                if topic in EVERY:
                    chosen = sorted(set(np.linspace(first, upto - 1, min(upto - first, WAITING)).round().astype(int)))
                for index in chosen:
                    body = self._recording.message(topic, int(index))
                    if body is not None:
                        self._picture.take(topic, body)
            self._next[topic] = upto

    def _seek(self, at_s: float) -> None:
        self._at_ns = float(np.clip(at_s * 1e9, self._begin_ns, self._end_ns))
        self._picture.clear()
        self._jumps += 1
        for topic, times in self._times.items():
            since_ns = self._at_ns - HISTORY_S * 1e9 if topic in EVERY and topic not in ("log", "plan") else self._begin_ns
            self._next[topic] = int(np.searchsorted(times, since_ns))

    def act(self, text: str) -> dict[str, Any]:
        """Carry out a `Control`; a recording has nothing that could move."""
        try:
            asked = ReplayControl.model_validate_json(text)
        except ValidationError as error:
            first = error.errors()[0]
            return refusal(f"{'.'.join(map(str, first['loc'])) or 'message'}: {first['msg']}")
        with self._lock:
            self._speed = asked.speed if asked.speed is not None else self._speed
            if asked.seek_s is not None:
                self._seek(asked.seek_s)
            if asked.play is not None:
                if asked.play and self._at_ns >= self._end_ns:
                    self._seek(self._begin_ns * 1e-9)
                self._playing, self._looked_s = asked.play, self._clock_s()
        return {"action": "play", "result": "accepted", "text": ""}
