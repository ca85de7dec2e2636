"""Compiled kernels are kept apart for each state of the sources."""

import os
from pathlib import Path

from protocol.kernel_cache import sources_state


def test_an_edited_source_is_another_state(tmp_path: Path) -> None:
    source = tmp_path / "realtime" / "tick.py"
    source.parent.mkdir()
    source.write_text("a = 1\n")
    first = sources_state(tmp_path)
    assert sources_state(tmp_path) == first
    source.write_text("a = 12\n")
    assert sources_state(tmp_path) != first


def test_the_rooms_have_chosen_a_folder() -> None:
    import realtime

    assert realtime.__doc__ and os.environ["NUMBA_CACHE_DIR"]
