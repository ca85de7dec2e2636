"""Settings of the whole suite: the same examples in every run, and no deadline on the wall clock."""

import fcntl
import os
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("seldinger", deadline=None, derandomize=True, print_blob=False)
settings.load_profile("seldinger")

# Files whose tests fit models to recordings, run a whole rig or start processes: longer than eight seconds each on one core.
# A single slow test in another file has the mark itself. Every run prints its slowest tests; keep this list true by them.
SLOW = {
    "firmware": "proof",
    "host/diagnosis": "benches experiment folded_reading live nested nominals places planted rig_recording standing",
    "host/proof": "runner worlds",
    "host": "access demo device_commands estimator_process first_day live_study reproduction reproduction_mechanics "
    "rig_sweeps services stop_paths subscribers unplugged view_commands",
    "protocol": "zenoh_session",
    "realtime": "hybrid_control",
    "sim": "concealed home_run hostile_commands scenario sensor_failures sensor_servers rig_effects",
}
SLOW_FILES = {f"{folder}/test_{name}.py" for folder, names in SLOW.items() for name in names.split()}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of the slow files."""
    here = Path(__file__).parent
    for item in items:
        if item.path.is_relative_to(here) and item.path.relative_to(here).as_posix() in SLOW_FILES:
            item.add_marker(pytest.mark.slow)


@pytest.fixture(scope="session")
def avr_tools() -> None:
    """Skips, visibly, where the AVR tool chain or simavr is missing."""
    from sim.board import BoardUnavailable, ensure_built

    try:
        ensure_built("avr")
    except BoardUnavailable as error:
        pytest.skip(str(error))


@pytest.fixture
def signal_handlers() -> Iterator[None]:
    """Restore the handlers of SIGTERM and SIGINT after a test that sets them."""
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(scope="module")
def rig_alone() -> Iterator[None]:
    """One whole rig on the wall clock at a time: it takes 1.3 cores, and two of them start and end too slowly."""
    with open(Path(tempfile.gettempdir()) / f"seldinger-tests-{os.getuid()}.lock", "w", encoding="utf-8") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
        fcntl.flock(lock, fcntl.LOCK_UN)  # a forked process that is still there has the file open as well
