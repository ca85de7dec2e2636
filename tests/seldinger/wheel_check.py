"""An installation as a user makes it: wheel, empty environment, examples of docs/api.md. `make wheel-test` runs it.

Downloads the dependencies, so that it is no part of `make test`.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = {"host", "protocol", "realtime", "sim", "seldinger", "seldinger_start.py"}


def main() -> int:
    """Build, install and run. Returns the exit status: 0 where every example ran with the installed packages."""
    folder = Path(tempfile.mkdtemp(prefix="seldinger-wheel-"))
    try:
        return _check(folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _check(folder: Path) -> int:
    say("building the wheel")
    # A copy without the build folder: what an earlier build left there would get into the wheel.
    sources = folder / "sources"
    shutil.copytree(
        ROOT, sources, ignore=shutil.ignore_patterns(".git", ".venv", "build", "runs", "*.egg-info", "__pycache__")
    )
    run(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(folder), str(sources))
    wheel = next(folder.glob("seldinger-*.whl"))
    say(f"installing {wheel.name} into an empty environment")
    venv.create(folder / "venv", with_pip=True, system_site_packages=False)
    python = folder / "venv" / "bin" / "python"
    run(str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", f"{wheel}[all]")
    top = subprocess.run(
        [str(python), "-c", "from importlib.metadata import files; print(*{f.parts[0] for f in files('seldinger')})"],
        check=True,
        capture_output=True,
        text=True,
        cwd=folder,
    ).stdout.split()
    installed = {name for name in top if not name.endswith(".dist-info") and not name.startswith(("..", "__pycache__"))}
    if installed != PACKAGES:
        say(f"the wheel installs {sorted(installed)}, wanted {sorted(PACKAGES)}")
        return 1
    say("running the examples of docs/api.md")
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    environment["EXPECTED_PREFIX"] = str(folder / "venv")
    run(str(python), str(ROOT / "tests" / "seldinger" / "api_page.py"), cwd=folder, env=environment)
    run(str(folder / "venv" / "bin" / "seldinger"), "--version", cwd=folder, env=environment)
    say("the wheel installs and the examples run")
    return 0


def run(*command: str, cwd: Path | None = None, env: dict[str, str] | None = None) -> None:
    """Run a command; ends this process with its status where it fails."""
    done = subprocess.run(command, check=False, cwd=cwd, env=env)
    if done.returncode:
        say(f"failed with status {done.returncode}: {' '.join(command)}")
        sys.exit(1)


def say(text: str) -> None:
    """One line of progress on standard error."""
    print(f"wheel-test: {text}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
