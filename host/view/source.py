"""What the server serves: the same three questions whether the rig is live or a recording."""

from __future__ import annotations

from typing import Any, Protocol


class Source(Protocol):
    """Called by one thread only, except `act`, which may take its time on another."""

    def hello(self) -> dict[str, Any]:
        """What stays the same while the page is open: kind, rig, limits, and of a recording its span and windows."""
        ...

    def frame(self) -> dict[str, Any]:
        """What has changed: `host.recordings.rig_picture.Picture.frame` and more. Called thirty times a second."""
        ...

    def act(self, text: str) -> dict[str, Any]:
        """Carry out what a page asks, in JSON, or refuse it; result and text for the one who asked."""
        ...


def refusal(text: str, result: str = "malformed") -> dict[str, Any]:
    """The answer to what was not carried out."""
    return {"action": "", "result": result, "text": text}
