"""Static models of the catheter: circular arcs in the plane (PCAR), and a rod in space (Cosserat).

`solve` is one function over both; the other names are what it returns and what the models are made of. A name is loaded
when it is first used, because the compiled models take half a second to import.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from host.mechanics.cosserat import CosseratSolution, CosseratSolutions, solve_cosserat, solve_cosserat_cases
    from host.mechanics.pcar import Arcs, arcs_of
    from host.mechanics.rod_loads import PointLoad
    from host.mechanics.statics import PcarSolution, solve

__all__ = [
    "Arcs",
    "CosseratSolution",
    "CosseratSolutions",
    "PcarSolution",
    "PointLoad",
    "arcs_of",
    "solve",
    "solve_cosserat",
    "solve_cosserat_cases",
]

_HOME = {
    "PcarSolution": "host.mechanics.statics",
    "solve": "host.mechanics.statics",
    "CosseratSolution": "host.mechanics.cosserat",
    "CosseratSolutions": "host.mechanics.cosserat",
    "solve_cosserat": "host.mechanics.cosserat",
    "solve_cosserat_cases": "host.mechanics.cosserat",
    "PointLoad": "host.mechanics.rod_loads",
    "Arcs": "host.mechanics.pcar",
    "arcs_of": "host.mechanics.pcar",
}


def __getattr__(name: str) -> Any:
    """Load a name of this room's face when it is first used."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME[name]), name)
    globals()[name] = value
    return value
