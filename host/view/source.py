"""What the server serves: the same three questions whether the rig is live or a recording."""

from __future__ import annotations

from typing import Any, Protocol


class Source(Protocol):
    """Called by one thread only, except `act`, which may take its time on another."""

    def hello(self) -> dict[str, Any]:
        """Return the constants of the page: kind, rig, limits, and of a recording its span and windows."""
        ...

    def frame(self) -> dict[str, Any]:
        """Return the changes: `host.recordings.rig_picture.Picture.frame` and more. Called thirty times a second."""
        ...

    def act(self, text: str) -> dict[str, Any]:
        """Carry out the request of a page, in JSON, or refuse it; return result and text for that page."""
        ...


def refusal(text: str, result: str = "malformed") -> dict[str, Any]:
    """Return the answer to a refused request."""
    return {"action": "", "result": result, "text": text}
