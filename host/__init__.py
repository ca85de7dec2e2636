"""What may take its time: mechanics, estimation, identification, diagnosis, recordings, reports and the command line."""

import importlib.util
from pathlib import Path


def check_packages() -> None:
    """Check that the project's other packages are the ones that Python finds.

    The package index has other packages named `realtime` and `protocol`; where one of them is installed too, or comes first
    on the path, imports would fail far from the cause.
    Raises: ImportError, one line with the package's name, where it was found, and what to do.
    """
    folder = Path(__file__).resolve().parent.parent
    for name in ("protocol", "realtime", "sim"):
        spec = importlib.util.find_spec(name)
        found = Path(spec.origin).resolve().parent.parent if spec is not None and spec.origin else None
        if found != folder:
            raise ImportError(
                f"package '{name}': found it in {found or 'no folder'}, wanted seldinger's own in {folder}; another package "
                f"has that name: uninstall it (pip uninstall {name}), then reinstall seldinger"
            )


check_packages()

from protocol import kernel_cache  # noqa: E402 - after the check, so that the check speaks first

kernel_cache.choose()
