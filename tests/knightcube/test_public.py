"""The public interface of the library: every exported name exists and is documented."""

from __future__ import annotations

import ast
import importlib
import inspect
import subprocess
import sys
from pathlib import Path

import pytest

import knightcube


def _names_for_type_checkers() -> set[tuple[str, str]]:
    """Return (module, name) of the imports that only type checkers read."""
    tree = ast.parse(Path(knightcube.__file__).read_text(encoding="utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    return {
        (str(node.module), alias.name)
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if alias.asname == alias.name
    }


def test_type_checkers_and_the_interpreter_know_the_same_names() -> None:
    at_run_time = {(inspect.getmodule(getattr(knightcube, name)), name) for name in knightcube.__all__}
    assert at_run_time == {
        (importlib.import_module(module), name) for module, name in _names_for_type_checkers()
    }


@pytest.mark.parametrize("name", knightcube.__all__)
def test_every_public_name_is_documented_with_its_public_methods(name: str) -> None:
    value = getattr(knightcube, name)
    assert name in dir(knightcube)
    assert len(inspect.getdoc(value) or "") > 100
    for member, method in vars(value).items() if inspect.isclass(value) else ():
        if callable(method) and not member.startswith("_"):
            assert inspect.getdoc(method)


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'StarTrackr'"):
        knightcube.StarTrackr  # noqa: B018 - the access is the test


def test_importing_the_library_imports_none_of_its_modules() -> None:
    """A program that needs one name does not pay for the others."""
    script = "import sys, knightcube; print([m for m in sys.modules if m.startswith('knightcube.')])"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
