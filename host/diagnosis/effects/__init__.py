"""The vocabulary of missing physics, one small module an effect, found by name."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache

from host.diagnosis.model.effect import Candidate, Effect, Port


@cache
def library() -> tuple[Effect, ...]:
    """Every effect of the package `effects`, in the order of their files."""
    found: list[Effect] = []
    for info in sorted(pkgutil.iter_modules(__path__), key=lambda item: item.name):
        module = importlib.import_module(f"{__name__}.{info.name}")
        found += list(getattr(module, "EFFECTS", ()))
    return tuple(found)


def candidates(ports: tuple[Port, ...], timed: bool, left_out: frozenset[str] = frozenset()) -> list[Candidate]:
    """All candidates at `ports`; rate effects only with a time line.

    `left_out`: ids, id:form, or id:form@port, not to use: what the nominal model has already, and those of a
    leave-one-out proof.
    """
    found = []
    for port in ports:
        for effect in library():
            if (
                left_out.intersection((effect.id, *effect.spans))
                or effect.port not in port.kind.split("+")
                or (effect.timed and not timed)
            ):
                continue
            sources = {
                "": ("",),
                "load": port.loads,
                "drag": port.drags or port.loads,
                "spring": port.springs,
                "other": port.others,
            }[effect.source]
            forms = [
                form for form in effect.forms if not {f"{effect.id}:{form}", f"{effect.id}:{form}@{port.name}"} & left_out
            ]
            found += [Candidate(effect, port, source, form) for source in sources for form in forms]
        found += [Candidate(effect, port) for effect in port.offers if effect.id not in left_out]
    return found
