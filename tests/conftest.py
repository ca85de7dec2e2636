"""Settings of the whole suite: the same examples in every run, and no deadline on the wall clock."""

import pytest
from hypothesis import settings

settings.register_profile("seldinger", deadline=None, derandomize=True, print_blob=False)
settings.load_profile("seldinger")


@pytest.fixture(scope="session")
def avr_tools() -> None:
    """Skips, visibly, where the AVR tool chain or simavr is missing."""
    from sim.board import BoardUnavailable, ensure_built

    try:
        ensure_built("avr")
    except BoardUnavailable as error:
        pytest.skip(str(error))
