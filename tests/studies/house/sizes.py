"""Sizes of the product's files, classes and functions, in lines of source."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

LONG_FUNCTION = 50
LONG_CLASS = 350
LONG_FILE = 900
MOST_LONG_FUNCTIONS = 20
_REASON = re.compile(r"\blines\b", re.IGNORECASE)  # a long class says why in its docstring: "... lines: ..."
_Function = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass(frozen=True, slots=True)
class Piece:
    """A file, class or function and its length in lines; `reason` is whether its docstring excuses it."""

    name: str
    lines: int
    reason: bool = False

    def __str__(self) -> str:
        return f"{self.name} {self.lines}"


@dataclass(frozen=True, slots=True)
class Sizes:
    """All pieces, the largest first; package markers (`__init__.py`) are left out of `files`."""

    total: int
    files: list[Piece]
    classes: list[Piece]
    functions: list[Piece]

    @property
    def median_file(self) -> int:
        """The middle file's lines."""
        return self.files[len(self.files) // 2].lines

    @property
    def long_classes(self) -> list[Piece]:
        """Classes over the limit without a reason."""
        return [piece for piece in self.classes if piece.lines > LONG_CLASS and not piece.reason]

    @property
    def long_functions(self) -> list[Piece]:
        """Functions over the limit."""
        return [piece for piece in self.functions if piece.lines > LONG_FUNCTION]


def measure(files: Mapping[str, Path]) -> Sizes:
    """Measure modules given by name and file."""
    total, sized, classes, functions = 0, [], [], []
    for module, path in files.items():
        text = path.read_text(encoding="utf-8")
        lines = len(text.splitlines())
        total += lines
        if path.name != "__init__.py":
            sized.append(Piece(module, lines))
        for name, node in _definitions(ast.parse(text), module):
            length = (node.end_lineno or node.lineno) - node.lineno + 1
            if isinstance(node, ast.ClassDef):
                reason = bool(_REASON.search(ast.get_docstring(node) or ""))
                classes.append(Piece(name, length, reason))
            else:
                functions.append(Piece(name, length))
    return Sizes(total, *(sorted(group, key=_order) for group in (sized, classes, functions)))


def _order(piece: Piece) -> tuple[int, str]:
    return -piece.lines, piece.name


def _definitions(node: ast.AST, prefix: str) -> Iterator[tuple[str, ast.ClassDef | _Function]]:
    """Yield classes and functions with their dotted names; a nested function belongs to its outer one."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.ClassDef | _Function):
            name = f"{prefix}.{child.name}"
            yield name, child
            if isinstance(child, ast.ClassDef):
                yield from _definitions(child, name)
        elif not isinstance(child, ast.expr):
            yield from _definitions(child, prefix)
