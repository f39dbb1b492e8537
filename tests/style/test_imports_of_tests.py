"""Tests of the imports of tests: a product test imports neither studies nor another test."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

TESTS = Path(__file__).resolve().parents[1]


def forbidden(module: str, path: str) -> bool:
    """Return whether the file `path`, relative to `tests`, must not import `module`."""
    study = module == "tests.studies" or module.startswith("tests.studies.")
    return (study and not path.startswith("studies/")) or any(
        part.startswith("test_") for part in module.split(".") if module.startswith("tests.")
    )


def may_be_wrong(source: str) -> bool:
    """Return whether a source has the words of a forbidden import. Only such sources are parsed."""
    return re.search(r"\bstudies\b|(?<!\bdef )\btest_", source) is not None


def statements(node: ast.AST) -> Iterator[ast.AST]:
    """Yield all statements within a node, at any depth. An expression contains no import."""
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, ast.expr):
            yield child
            yield from statements(child)


def imports(source: str) -> list[str]:
    """Return the modules that a source imports. `from a import b` counts as `a` and as `a.b`."""
    found = []
    for node in statements(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            found += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
    return found


@pytest.mark.parametrize(
    ("module", "path", "refused"),
    [
        ("tests.studies.mutants", "flight/test_a.py", True),
        ("tests.studies", "support/flights.py", True),
        ("tests.studies.mutants", "studies/checks/test_mutants.py", False),
        ("tests.flight.test_a", "hal/test_b.py", True),
        ("tests.flight.test_a.CASES", "studies/campaigns/faults.py", True),
        ("tests.support.flights", "flight/test_a.py", False),
        ("numpy.testing.test_a", "flight/test_a.py", False),
    ],
)
def test_studies_and_test_modules_are_refused(module: str, path: str, refused: bool) -> None:
    assert forbidden(module, path) is refused
    assert may_be_wrong(f"import {module}") or not refused


def test_an_import_is_found_in_any_statement() -> None:
    source = (
        "def f():\n  with a:\n    try: b\n    except C:\n      if d: pass\n      else: import e\n"
        "match g:\n  case 1: from h import i\n"
    )
    assert imports(source) == ["e", "h", "h.i"]


def test_no_test_imports_a_study_or_another_test() -> None:
    sources = {path: path.read_text(encoding="utf-8") for path in sorted(TESTS.rglob("*.py"))}
    wrong = [
        f"{path.relative_to(TESTS)}: {module}"
        for path, source in sources.items()
        if may_be_wrong(source)
        for module in imports(source)
        if forbidden(module, path.relative_to(TESTS).as_posix())
    ]
    assert not wrong, "move what is shared to tests/support or to a helper module"
