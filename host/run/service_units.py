"""Unit files of the services: the templates in the folder units, filled in; written to a root and removed again."""

from __future__ import annotations

import ipaddress
import re
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from protocol.rig_file import Rig

HERE = Path(__file__).parent / "units"
UNIT_DIR, SYSUSERS_DIR = Path("etc/systemd/system"), Path("etc/sysusers.d")
MARK = "# Written by `seldinger install-services`; `seldinger install-services --undo` takes it away."
SYSUSERS = 'u seldinger - "Seldinger catheter rig" /var/lib/seldinger\nm seldinger dialout\n'


@dataclass(frozen=True)
class UnitSettings:
    """rig_file: absolute path; cpu: of the control loop; simulated: with the simulated rig as a service of its own."""

    rig_file: Path
    cpu: int
    simulated: bool = False
    board: str = "native"
    python: Path = Path(sys.executable)

    @property
    def names(self) -> tuple[str, ...]:
        """The units, in the order of their start."""
        return (
            ("seldinger-host.service", "seldinger-realtime.service")
            if not self.simulated
            else ("seldinger-rig.service", "seldinger-host.service", "seldinger-realtime.service")
        )


def unit_texts(settings: UnitSettings, rig: Rig) -> dict[str, str]:
    """File name -> contents. Raises ValueError for a path that a unit file cannot hold."""
    for path in (settings.rig_file, settings.python):
        if not path.is_absolute() or re.search(r"[\s%$'\"\\;]", str(path)):
            raise ValueError(f"path: found {str(path)!r}, wanted an absolute path without spaces, quotes, %, $ and \\")
    simulated = settings.simulated
    fields = {
        "python": str(settings.python),
        "rig": str(settings.rig_file),
        "cpu": str(settings.cpu),
        "board": settings.board,
        "after": "seldinger-rig.service" if simulated else "",
        "environment": "EnvironmentFile=/run/seldinger/ports.env" if simulated else "",
        "ports": "--board-port ${BOARD_PORT} --tracker-port ${TRACKER_PORT} --force-port ${FORCE_PORT}" if simulated else "",
        "devices": "DeviceAllow=char-pts rw" if simulated else "DeviceAllow=/dev/cpu_dma_latency rw",
    }
    texts = {}
    for name in settings.names:
        # Only the control loop speaks to the force box; if its address is a name, the network filter cannot allow it.
        # The model process is the one that other machines reach.
        peers = " ".join(rig.network.peers) if "host" in name else ""
        allowed = _addresses([rig.force_sensor.address]) if "realtime" in name else peers
        common = (HERE / "common.service.in").read_text(encoding="utf-8").strip().replace("@allow@", allowed)
        text = (HERE / f"{name}.in").read_text(encoding="utf-8").replace("@common@", common)
        for key, value in fields.items():
            text = text.replace(f"@{key}@", value)
        texts[name] = f"{MARK}\n{text}"
    return texts


def _addresses(hosts: Iterable[str]) -> str:
    out = []
    for host in hosts:
        try:
            out.append(str(ipaddress.ip_address(host)))
        except ValueError:
            raise ValueError(
                f"force_sensor.address: found {host!r}, wanted an IP address: the service may reach no other "
                "host, and a name cannot be allowed"
            ) from None
    return " ".join(out)


def install(root: Path, texts: dict[str, str]) -> list[Path]:
    """Write units and the service user's description below `root`. Raises FileExistsError for a file of someone else."""
    files = {root / UNIT_DIR / name: text for name, text in texts.items()}
    files[root / SYSUSERS_DIR / "seldinger.conf"] = f"{MARK}\n{SYSUSERS}"
    for path in files:
        if path.exists() and not _ours(path):
            raise FileExistsError(f"{path}: found a file that `seldinger install-services` did not write, wanted none")
    for path, text in files.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return list(files)


def undo(root: Path) -> list[Path]:
    """Remove what `install` wrote below `root`, and nothing else; returns what was removed."""
    removed = []
    for path in [*sorted((root / UNIT_DIR).glob("seldinger-*.service")), root / SYSUSERS_DIR / "seldinger.conf"]:
        if path.is_file() and _ours(path):
            path.unlink()
            removed.append(path)
    return removed


def _ours(path: Path) -> bool:
    return path.read_text(encoding="utf-8", errors="replace").startswith(MARK)
