"""The examples of docs/api.md: each code block by the heading that it stands under; run them with an installed seldinger.

`python tests/seldinger/api_page.py` runs all of them in a fresh folder, with whichever seldinger Python finds.
"""

from __future__ import annotations

import os
import re
import sys
import tempfile
from pathlib import Path

PAGE = Path(__file__).resolve().parents[2] / "docs" / "api.md"
_BLOCK = re.compile(r"^## (\w+)$|^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def examples() -> dict[str, str]:
    """Heading -> code of the block under it."""
    found: dict[str, str] = {}
    heading = ""
    for match in _BLOCK.finditer(PAGE.read_text(encoding="utf-8")):
        if match.group(1):
            heading = match.group(1)
        else:
            assert heading not in found, f"two blocks under {heading}"
            found[heading] = match.group(2)
    return found


def write_recording(folder: Path) -> Path:
    """The file `run.mcap` that the page's example reads: a second of a force sensor on the simulated rig."""
    from host.recordings import RecordingWriter, header_of
    from protocol.rig_file import SIMULATED_RIG, load_rig
    from protocol.topics import ForceSensor

    path = folder / "run.mcap"
    with RecordingWriter(path, header_of(load_rig(SIMULATED_RIG), "virtual", 1)) as writer:
        for k in range(500):
            stamp_ns = 1_000_000_000 + 2_000_000 * k
            writer.write("force/sensor", ForceSensor(stamp_ns=stamp_ns, arrival_ns=stamp_ns, force_N=(0.0, 0.0, 0.001 * k)))
    return path


def run(name: str, code: str) -> None:
    """Run one example in the current folder."""
    exec(compile(code, f"docs/api.md, {name}", "exec"), {"__name__": "__main__"})


if __name__ == "__main__":
    import seldinger

    where, expected = Path(seldinger.__file__).parent, os.environ.get("EXPECTED_PREFIX", "")
    print(f"seldinger from {where}", file=sys.stderr)
    if not str(where).startswith(expected):
        sys.exit(f"found seldinger in {where}, wanted it below {expected}")
    with tempfile.TemporaryDirectory() as folder:
        write_recording(Path(folder))
        os.chdir(folder)
        for name, code in examples().items():
            print(f"--- {name}", file=sys.stderr)
            run(name, code)
