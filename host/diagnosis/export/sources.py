"""Source text of functions with everything of the project that they use, in an order that runs."""

from __future__ import annotations

import ast
import importlib
import inspect
from dataclasses import dataclass, field
from functools import cache
from types import ModuleType
from typing import Any

OURS = ("host", "protocol", "realtime", "sim")
Place = tuple[str, str]  # module, name in it


@dataclass
class Gathered:
    """Definitions in the order in which they have to stand, and the imports from other packages."""

    names: dict[Place, str] = field(default_factory=dict)
    texts: list[str] = field(default_factory=list)
    imports: dict[str, None] = field(default_factory=dict)

    def add(self, function: Any) -> str:
        """Gather a function of the project; returns its name in the gathered text."""
        plain = getattr(function, "py_func", function)  # what numba compiled
        return self._define((plain.__module__, plain.__name__))

    def text(self) -> str:
        """Return imports and definitions as source text."""
        return "\n".join(self.imports) + "\n\n\n" + "\n\n\n".join(self.texts) + "\n"

    def _define(self, place: Place) -> str:
        if place in self.names:
            return self.names[place]
        module, name = place
        taken = set(self.names.values())
        own = name if name not in taken else f"{name}_{module.rpartition('.')[2]}"
        self.names[place] = own
        node, lines = _definitions(module)[name]
        renamed: dict[str, str] = {} if own == name else {name: own}
        for used in _names_used(node):
            new = self._use(module, used)
            if new is not None and new != used:
                renamed[used] = new
        if renamed:
            node = _Renamed(renamed).visit(ast.parse(lines).body[0])
            lines = ast.unparse(ast.fix_missing_locations(node))
        if lines not in self.texts:
            self.texts.append(lines)
        return own

    def _use(self, module: str, name: str) -> str | None:
        """Name under which what `name` means in `module` is in the gathered text; None for a builtin or a local."""
        if name in _definitions(module):
            return self._define((module, name))
        found = _imports(module).get(name)
        if found is None:
            return None
        source, original = found
        if source.partition(".")[0] in OURS:
            return self._define((source, original))
        line = f"from {source} import {original}" if original else f"import {source}"
        if name != (original or source):
            line += f" as {name}"
        self.imports.setdefault(line)
        return name


class _Renamed(ast.NodeTransformer):
    """Definitions and uses of names under new ones."""

    def __init__(self, names: dict[str, str]) -> None:
        self.names = names

    def visit_Name(self, node: ast.Name) -> ast.Name:
        """Rename a name where it is used."""
        return ast.copy_location(ast.Name(self.names.get(node.id, node.id), node.ctx), node)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        """Rename a definition and what it uses."""
        node.name = self.names.get(node.name, node.name)
        return self.generic_visit(node)


def _source(module: str) -> tuple[ModuleType, str]:
    loaded = importlib.import_module(module)
    return loaded, inspect.getsource(loaded)


@cache
def _definitions(module: str) -> dict[str, tuple[ast.stmt, str]]:
    """Functions, classes and constants at the top of `module`, with their source text."""
    _, text = _source(module)
    lines = text.splitlines()
    found: dict[str, tuple[ast.stmt, str]] = {}
    for node in ast.parse(text).body:
        names: list[str] = []
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names = [node.name]
        elif isinstance(node, ast.Assign):
            names = [n.id for target in node.targets for n in ast.walk(target) if isinstance(n, ast.Name)]
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            names = [node.target.id]
        first = min([node.lineno, *(d.lineno for d in getattr(node, "decorator_list", []))])
        for name in names:
            found[name] = (node, "\n".join(lines[first - 1 : node.end_lineno]))
    return found


@cache
def _imports(module: str) -> dict[str, tuple[str, str]]:
    """Name -> (module, name in it; empty for the module itself)."""
    _, text = _source(module)
    found: dict[str, tuple[str, str]] = {}
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            found |= {alias.asname or alias.name: (alias.name, "") for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {alias.asname or alias.name: (node.module, alias.name) for alias in node.names}
    return found


def _names_used(node: ast.stmt) -> list[str]:
    """Names that `node` reads when it is defined or run; annotations are text."""
    annotations: set[int] = set()
    for one in ast.walk(node):
        for key in ("annotation", "returns"):
            found = getattr(one, key, None)
            if isinstance(found, ast.AST):
                annotations |= {id(part) for part in ast.walk(found)}
    names = [one.id for one in ast.walk(node) if isinstance(one, ast.Name) and id(one) not in annotations]
    return list(dict.fromkeys(names))
