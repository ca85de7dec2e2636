"""The suite that the tests of the proof share."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.host.proof import suite


@pytest.fixture(scope="session")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[dict]]:  # type: ignore[type-arg]
    folder = tmp_path_factory.mktemp("suite")
    return folder, suite.build(folder)


@pytest.fixture
def fresh(built: tuple[Path, list[dict]], tmp_path: Path) -> Callable[[], Path]:  # type: ignore[type-arg]
    """A copy of the suite in which nothing was diagnosed yet."""

    def copy() -> Path:
        return Path(shutil.copytree(built[0], tmp_path / "run"))

    return copy
