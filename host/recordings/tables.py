"""A recording as pandas DataFrames: one for each topic, units in the names of the columns."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np

from host.recordings.recording import RecordingFile
from protocol.errors import InputError

if TYPE_CHECKING:
    import pandas


class RecordingTables:
    """One recording, read completely; a damaged or cut-off file gives every message that is intact."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        """Read the MCAP file `path`. Raises InputError where it cannot be read or is not a recording."""
        if not isinstance(path, str | os.PathLike):
            raise InputError("path", str(path), "the name of an MCAP file")
        self._recording = RecordingFile(os.fspath(path))

    @property
    def topics(self) -> dict[str, int]:
        """Topic -> number of messages, for topics that have any."""
        return self._recording.topics

    @property
    def run(self) -> dict[str, str]:
        """Rig, clock, seed, software version, start and notes, as texts."""
        return self._recording.run

    @property
    def configuration(self) -> dict[str, Any]:
        """The configuration of the rig when it was recorded."""
        return self._recording.configuration

    @property
    def catheter(self) -> dict[str, Any]:
        """The catheter's parameters when it was recorded."""
        return self._recording.catheter

    @property
    def truncated(self) -> bool:
        """Whether the file ends early, as after a power cut."""
        return self._recording.truncated

    def units(self, topic: str) -> dict[str, str]:
        """Column -> unit of `topic`'s table, an empty text where it has none. Raises InputError for an unknown topic."""
        self._check(topic)
        return self._recording.units(topic)

    def table(self, topic: str) -> pandas.DataFrame:
        """Read the messages of one topic.

        Parameters:
            topic: a key of `topics`, for example "force/sensor".

        Returns:
            DataFrame, one row for each message in the order of recording. The index `time_s` is the message's stamp in
            seconds since the recording began. Columns carry their unit as a suffix (`fx_N`, `position_x_m`, `stamp_ns`);
            vectors are spread over columns; missing values are NaN.

        Raises:
            InputError: a topic that the recording does not have.
            ImportError: pandas is not installed.
        """
        self._check(topic)
        try:
            import pandas
        except ImportError:
            raise ImportError("pandas is not installed: pip install 'seldinger[tables]'") from None
        columns = self._recording.table(topic)
        stamps = columns.get("stamp_ns", columns["recorded_ns"])
        time_s = (stamps - self._recording.span_ns[0]).astype(np.float64) * 1e-9
        return pandas.DataFrame(dict(columns), index=pandas.Index(time_s, name="time_s"))

    def _check(self, topic: str) -> None:
        if topic not in self._recording.topics:
            raise InputError("topic", topic, "one of " + (", ".join(sorted(self.topics)) or "none: the recording is empty"))


def open_recording(path: str | os.PathLike[str]) -> RecordingTables:
    """Open a recording.

    Parameters:
        path: an MCAP file that `seldinger demo`, `seldinger run` or the model process wrote.

    Returns:
        RecordingTables: `topics`, `table(topic)` as a DataFrame, `units(topic)`, `run`, `configuration`, `catheter`.

    Raises:
        InputError: the file cannot be read or is not a recording.

    Source:
        Format: MCAP (mcap.dev), messages as JSON with the schemas of docs/topics.md.

    Examples:
        >>> open_recording("run.mcap").table("force/sensor")["fz_N"].max()  # doctest: +SKIP
    """
    return RecordingTables(path)
