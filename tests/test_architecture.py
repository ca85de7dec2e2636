"""The rooms and the arrows between them: imports run down only, no circle, and nothing loads a room above itself."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections import defaultdict
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent

# Room -> rooms that it may import. A module belongs to the room with the longest matching name.
BELOW_REALTIME = {"protocol"}
BELOW_SIM = {*BELOW_REALTIME, "realtime.control", "realtime.loop", "realtime.drivers", "realtime.core"}
BELOW_HOST = {*BELOW_SIM, "sim"}
MODELS = {"host.mechanics", "host.estimation"}
ROOMS: dict[str, set[str]] = {
    "protocol": set(),
    "realtime.control": {"protocol"},
    "realtime.loop": {"protocol", "realtime.control"},
    "realtime.drivers": {"protocol"},
    "realtime.core": {"protocol", "realtime.control", "realtime.loop", "realtime.drivers"},
    "realtime": BELOW_SIM,
    "sim": BELOW_SIM,
    "host": {"protocol"},
    "host.mechanics": {"protocol"},
    "host.estimation": {"protocol", "host.mechanics"},
    "host.identification": {"protocol", *MODELS},
    "host.navigation": {"protocol", "realtime.control", *MODELS},
    "host.recordings": {"protocol", "realtime.control", "host.mechanics"},
    "host.report": {"protocol", "host.recordings"},
    "host.security": {"protocol"},
    "host.commissioning": {*BELOW_HOST, *MODELS, "host.recordings", "host.report"},
    "host.run": {*BELOW_HOST, *MODELS, "host.recordings", "host.report", "host.commissioning", "host.navigation"},
    "host.view": {"protocol", "host.mechanics", "host.recordings", "host.run"},
}
BELOW_DIAGNOSIS = {"protocol", *MODELS, "host.recordings", "host.report", "host.commissioning"}
DIAGNOSIS = [  # bottom up: each may import those above it in this list
    "host.diagnosis.model",
    "host.diagnosis.effects",
    "host.diagnosis.estimation",
    "host.diagnosis.models",
    "host.diagnosis.symbolic",
    "host.diagnosis.selection",
    "host.diagnosis.design",
    "host.diagnosis.live",
    "host.diagnosis.problems",
    "host.diagnosis.second_search",
    "host.diagnosis.pipeline",
    "host.diagnosis.report",
    "host.diagnosis.export",
    "host.diagnosis",
]
for place, name in enumerate(DIAGNOSIS):
    ROOMS[name] = {*BELOW_DIAGNOSIS, *DIAGNOSIS[:place]}
PRODUCT = {room for room in ROOMS if room.startswith("host.")}
ROOMS["seldinger"] = {"protocol", *PRODUCT}
ROOMS["host.studies"] = {*BELOW_HOST, *PRODUCT, "seldinger"}
ROOMS["host.cli"] = {*BELOW_HOST, *PRODUCT, "seldinger", "host.studies"}
PACKAGES = ("protocol", "realtime", "sim", "host", "seldinger")


def module_name(path: Path) -> str:
    """The dotted name of a file below the root."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


FILES = {module_name(path): path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))}


def room_of(module: str) -> str:
    """The room that a module belongs to."""
    return max((room for room in ROOMS if module == room or module.startswith(f"{room}.")), key=len)


def imported_modules(text: str) -> set[str]:
    """Modules of the project that a source imports, anywhere in it."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    found = set()
    for name in names:
        if name in FILES:
            found.add(name)
        elif name.rpartition(".")[0] in FILES:
            found.add(name.rpartition(".")[0])
    return found


def forbidden_arrows(module: str, text: str) -> set[str]:
    """Modules that `module` imports from rooms that its room may not import."""
    room = room_of(module)
    return {other for other in imported_modules(text) if room_of(other) not in {room, *ROOMS[room]}}


@cache
def arrows() -> dict[str, set[str]]:
    """Module -> modules that it imports."""
    return {module: imported_modules(path.read_text(encoding="utf-8")) for module, path in FILES.items()}


def circles(graph: dict[str, set[str]]) -> list[set[str]]:
    """Sets of nodes that reach each other (strongly connected, more than one node)."""
    reach: dict[str, set[str]] = {}
    for start in graph:
        seen, waiting = set(), [start]
        while waiting:
            for other in graph.get(waiting.pop(), ()):
                if other not in seen:
                    seen.add(other)
                    waiting.append(other)
        reach[start] = seen
    groups = {frozenset({a, *(b for b in reach[a] if a in reach.get(b, ()))}) for a in graph}
    return [set(group) for group in groups if len(group) > 1]


def test_rooms_arrows_and_circles_are_counted(capsys: pytest.CaptureFixture[str]) -> None:
    """Prints the count (`pytest -rP`), so that a figure in a document has a command."""
    between: dict[str, set[str]] = defaultdict(set)
    for module, others in arrows().items():
        between[room_of(module)] |= {room_of(other) for other in others} - {room_of(module)}
    order = list(ROOMS)
    upward = [(a, b) for a, others in between.items() for b in others if b not in ROOMS[a]]
    rings = circles(between)
    print(
        f"{len(order)} rooms, {sum(map(len, between.values()))} arrows between them, "
        f"{len(upward)} upward, {len(rings)} circles of rooms, {len(circles(arrows()))} circles of modules"
    )
    assert not upward and not rings


@pytest.mark.parametrize("module", FILES)
def test_imports_follow_the_arrows(module: str) -> None:
    assert not forbidden_arrows(module, FILES[module].read_text(encoding="utf-8"))


@pytest.mark.parametrize("module", FILES)
def test_every_file_opens_with_its_idea(module: str) -> None:
    docstring = ast.get_docstring(ast.parse(FILES[module].read_text(encoding="utf-8")))
    assert docstring and len(docstring.splitlines()[0]) > 20


def test_no_circle_of_modules() -> None:
    assert not circles(arrows())


def test_host_has_no_loose_module() -> None:
    assert {path.name for path in (ROOT / "host").glob("*.py")} == {"__init__.py"}


@pytest.mark.parametrize("room", [room for room in ROOMS if (ROOT / room.replace(".", "/")).is_dir()])
def test_importing_a_room_loads_no_room_above_it(room: str) -> None:
    script = f"import sys, {room}; print(*sorted(sys.modules))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT)
    loaded = {room_of(name) for name in done.stdout.split() if name in FILES}
    parents = {name.rpartition(".")[0] for name in (room, *ROOMS[room])} - {""}
    assert loaded <= {room, *ROOMS[room], *parents}


def test_the_test_sees_a_forbidden_arrow() -> None:
    text = "import host.mechanics\nfrom sim.plant import Plant\n"
    assert forbidden_arrows("realtime.control.tick", text) == {"host.mechanics", "sim.plant"}
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [{"a", "b", "c"}]


def test_every_file_marked_slow_exists() -> None:
    """A renamed file must not leave the list unnoticed."""
    from tests.conftest import SLOW_FILES

    assert not [name for name in SLOW_FILES if not (ROOT / "tests" / name).is_file()]
