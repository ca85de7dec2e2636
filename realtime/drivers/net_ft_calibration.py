"""Counts per newton, range and rates of a Net F/T box, read from its netftapi2.xml page."""

from __future__ import annotations

import http.client
import math
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass

MAX_PAGE_BYTES = 65536
NEWTONS_PER = {"N": 1.0, "kN": 1e3, "lbf": 4.4482216152605, "klbf": 4448.2216152605, "kgf": 9.80665, "gf": 9.80665e-3}
NEWTON_METRES_PER = {
    "Nm": 1.0,
    "N-m": 1.0,
    "Nmm": 1e-3,
    "N-mm": 1e-3,
    "kNm": 1e3,
    "kN-m": 1e3,
    "lbf-in": 0.1129848290276167,
    "lbf-ft": 1.3558179483314,
    "kgf-cm": 0.0980665,
    "kgf-m": 9.80665,
}


@dataclass(frozen=True)
class NetFtCalibration:
    """counts_per_N, counts_per_Nm: scale of the records; range_N, range_Nm: rated (x, y, z); rdt_rate_hz: records a
    second; serial: of the transducer's calibration."""

    counts_per_N: float = 1e6
    counts_per_Nm: float = 1e6
    range_N: tuple[float, float, float] = (12.0, 12.0, 17.0)
    range_Nm: tuple[float, float, float] = (0.12, 0.12, 0.12)
    rdt_rate_hz: float = 1000.0
    serial: str = ""

    def __post_init__(self) -> None:
        for key in ("counts_per_N", "counts_per_Nm", "rdt_rate_hz"):
            if not (math.isfinite(getattr(self, key)) and getattr(self, key) > 0):
                raise ValueError(f"{key}: found {getattr(self, key)}, wanted more than 0")


def parse_calibration(page: bytes) -> NetFtCalibration:
    """Read the calibration in a netftapi2.xml page and convert it from the box's units to SI.

    Raises ValueError with the element's name when one is missing or not what it should be, or when RDT is disabled.
    """
    if len(page) > MAX_PAGE_BYTES or b"<!" in page:
        raise ValueError(
            f"netftapi2.xml: found {len(page)} bytes or a DOCTYPE, wanted a plain page up to {MAX_PAGE_BYTES} bytes"
        )
    try:
        root = ElementTree.fromstring(page)
    except ElementTree.ParseError as bad:
        raise ValueError(f"netftapi2.xml: found no XML ({bad}), wanted the box's page") from bad
    texts = {element.tag: (element.text or "").strip() for element in root.iter()}
    if texts.get("comrdte", "Enabled") != "Enabled":
        raise ValueError(f"comrdte: found {texts['comrdte']!r}, wanted Enabled (communications page of the box)")
    newtons, newton_metres = _unit(texts, "scfgfu", NEWTONS_PER), _unit(texts, "scfgtu", NEWTON_METRES_PER)
    ratings = [_number(part, "cfgmr") for part in _text(texts, "cfgmr").split(";")]
    if len(ratings) != 6:
        raise ValueError(f"cfgmr: found {len(ratings)} ratings, wanted 6")
    fx, fy, fz, tx, ty, tz = ratings
    return NetFtCalibration(
        _number(_text(texts, "cfgcpf"), "cfgcpf") / newtons,
        _number(_text(texts, "cfgcpt"), "cfgcpt") / newton_metres,
        (fx * newtons, fy * newtons, fz * newtons),
        (tx * newton_metres, ty * newton_metres, tz * newton_metres),
        _number(_text(texts, "comrdtrate"), "comrdtrate"),
        texts.get("cfgcalsn", ""),
    )


def fetch_calibration(host: str, port: int = 80, timeout_s: float = 2.0) -> NetFtCalibration:
    """Read the page from the box's web server. Raises OSError when it cannot be reached, ValueError as above."""
    connection = None
    try:
        connection = http.client.HTTPConnection(host, port, timeout=timeout_s)
        connection.request("GET", "/netftapi2.xml")
        response = connection.getresponse()
        page = response.read(MAX_PAGE_BYTES + 1)
    except (http.client.HTTPException, OSError) as bad:
        found = getattr(bad, "strerror", None) or str(bad) or type(bad).__name__
        raise OSError(f"http://{host}:{port}/netftapi2.xml: found no web page ({found}), wanted the box's own") from bad
    finally:
        if connection is not None:
            connection.close()
    if response.status != 200:
        raise OSError(f"{host}:{port}/netftapi2.xml: found HTTP status {response.status}, wanted 200")
    return parse_calibration(page)


def _text(texts: dict[str, str], key: str) -> str:
    if key not in texts:
        raise ValueError(f"{key}: found nothing, wanted this element in netftapi2.xml")
    return texts[key]


def _number(text: str, key: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise ValueError(f"{key}: found {text!r}, wanted a number") from None
    if not (math.isfinite(value) and value > 0):
        raise ValueError(f"{key}: found {text}, wanted a number more than 0")
    return value


def _unit(texts: dict[str, str], key: str, table: dict[str, float]) -> float:
    unit = _text(texts, key)
    if unit not in table:
        raise ValueError(f"{key}: found {unit!r}, wanted one of {', '.join(table)}")
    return table[unit]
