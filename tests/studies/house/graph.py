"""Which room imports which: rooms, floors, arrows against the floors, circles.

A room is a package directly below `flight`, or one of the packages beside it; a loose module in `flight`
counts as a room of its own. Imports are read from the source, those inside functions and literal
`import_module` calls included. The floors' order is the `layers` contract in pyproject.toml.
"""

from __future__ import annotations

import ast
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

PRODUCT = ("knightcube", "flight", "ground", "hal", "sim_hal")
_NO_ROOM = ("flight", "flight.__init__")  # only the version
_DOOR = {"flight.__main__": "flight.app"}  # `python -m flight`
Graph = Mapping[str, frozenset[str]]


@dataclass(frozen=True, slots=True)
class Arrow:
    """One import from a module of one room to a module of another."""

    importer: str
    imported: str

    def __str__(self) -> str:
        return f"{self.importer} -> {self.imported}"


def product_files(root: Path) -> dict[str, Path]:
    """Return the product's modules: name to file."""
    files = sorted(path for package in PRODUCT for path in (root / package).rglob("*.py"))
    return {_module_name(path.relative_to(root)): path for path in files}


def import_graph(files: Mapping[str, Path]) -> dict[str, frozenset[str]]:
    """Return which module imports which, within `files`."""
    return {name: frozenset(_imports(name, path, files)) - {name} for name, path in files.items()}


def room_of(module: str) -> str | None:
    """Return a module's room; None for the root package itself, which holds nothing."""
    if module in _NO_ROOM:
        return None
    if module in _DOOR:
        return _DOOR[module]
    return ".".join(module.split(".")[: 2 if module.startswith("flight.") else 1])


def room_graph(modules: Graph) -> dict[str, frozenset[str]]:
    """Return which room imports which."""
    edges: dict[str, set[str]] = {}
    for importer, targets in modules.items():
        room = room_of(importer)
        if room is None:
            continue
        found = edges.setdefault(room, set())
        found.update(other for target in targets if (other := room_of(target)) not in (None, room))
    return {room: frozenset(targets) for room, targets in edges.items()}


def circles(graph: Graph) -> list[list[str]]:
    """Return the groups of nodes that reach one another (Tarjan's strongly connected components)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for other in sorted(graph.get(node, ())):
            if other not in index:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], index[other])
        if low[node] == index[node]:
            group: list[str] = []
            while not group or group[-1] != node:
                group.append(stack.pop())
            if len(group) > 1:
                found.append(sorted(group))

    for node in sorted(graph):
        if node not in index:
            visit(node)
    return sorted(found)


def floors(graph: Graph) -> dict[str, int]:
    """Return each room's floor, from 0: one above the highest room it imports. Circles count as one room."""
    group = {room: min(circle) for circle in circles(graph) for room in circle}

    def height(room: str) -> int:
        members = [member for member in graph if group.get(member, member) == group.get(room, room)]
        below = {target for member in members for target in graph[member]} - set(members)
        return 1 + max(map(height, below), default=-1)

    return {room: height(room) for room in graph}


def contract(root: Path) -> list[frozenset[str]]:
    """Return the layers of import-linter's contract, the highest first; rooms of one layer are siblings."""
    settings = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))
    for entry in settings["tool"]["importlinter"]["contracts"]:
        if entry["type"] == "layers":
            return [frozenset(room.strip() for room in layer.split("|")) for layer in entry["layers"]]
    raise ValueError("pyproject.toml has no layers contract")


def arrows_back(modules: Graph, layers: Iterable[frozenset[str]]) -> list[Arrow]:
    """Return the imports that go up, or to a sibling on the same floor.

    Raises ValueError for a room that is not in `layers`.
    """
    rank = {room: number for number, layer in enumerate(layers) for room in layer}
    back = []
    for importer, targets in modules.items():
        for target in sorted(targets):
            first, second = room_of(importer), room_of(target)
            if first is None or second is None or first == second:
                continue
            unknown = {first, second} - set(rank)
            if unknown:
                raise ValueError(f"the layers contract does not name {', '.join(sorted(unknown))}")
            if rank[second] <= rank[first]:
                back.append(Arrow(importer, target))
    return back


def _module_name(path: Path) -> str:
    parts = path.with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _imports(module: str, path: Path, known: Mapping[str, Path]) -> Iterator[str]:
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        for base, names in _named(node, package):
            below = [f"{base}.{name}" for name in names]
            yield from (name for name in below if name in known)
            if base in known and not (below and all(name in known for name in below)):
                yield base


def _named(node: ast.AST, package: str) -> list[tuple[str, list[str]]]:
    """Return the modules that a statement imports, each with the names imported from it."""
    match node:
        case ast.Import(names=names):
            return [(alias.name, []) for alias in names]
        case ast.ImportFrom(module=source, names=names, level=level):
            parts = package.split(".")[: len(package.split(".")) - level + 1] if level else []
            base = ".".join([*parts, *([source] if source else [])])
            return [(base, [alias.name for alias in names])]
        case ast.Call(
            func=ast.Name(id="import_module") | ast.Attribute(attr="import_module"),
            args=[ast.Constant(value=str(name)), *_],
        ):
            return [(name, [])]
    return []
