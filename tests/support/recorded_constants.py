"""The constants, default values and default arguments of modules, compared with a record.

Most of these numbers are tuned, so that none may change by accident. `check_constants(__file__)` in a test
folder compares those of the mirrored product folder with `recorded_constants.json` beside the test.
`KNIGHTCUBE_RECORD=1 python -m pytest -n 0 TEST` writes the record again, after a change that is intended.
"""

from __future__ import annotations

import ast
import dataclasses
import hashlib
import importlib
import inspect
import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import msgspec

from tests.support.places import ROOT
from tests.support.recorded_results import differences, figures_of

NEED_EXTRAS = ("sim_hal/worlds/basilisk",)
"""Folders whose modules cannot be imported without an extra."""
PRODUCT = ("knightcube", "flight", "hal", "sim_hal", "ground")
LONGEST = 1500
"""Length of the JSON of a value above which only its digest is kept."""


def check_constants(test: str) -> None:
    """Fail unless the constants of the mirrored folder are those of the record beside a test module."""
    folder = Path(test).resolve().parent
    path = folder / "recorded_constants.json"
    found = json.loads(json.dumps(constants_of(folder.relative_to(ROOT / "tests"))))
    if os.environ.get("KNIGHTCUBE_RECORD"):
        lines = [f"{json.dumps(name)}: {json.dumps(found[name], sort_keys=True)}" for name in sorted(found)]
        path.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
    record = json.loads(path.read_text(encoding="utf-8"))
    record = {name: values for name, values in record.items() if name in found or _is_importable(name)}
    cure = "if the change is intended, set KNIGHTCUBE_RECORD=1 and run the test to write the record again"
    assert differences(record, found, 1e-7) == [], cure


def constants_of(folder: Path) -> dict[str, Any]:
    """Return the constants by module of a product folder and of its subfolders that have no mirror.

    Modules that need a library that is not installed are left out.
    """
    found: dict[str, Any] = {}
    for path in sorted((ROOT / folder).rglob("*.py")):
        place = path.relative_to(ROOT)
        mirror = ROOT / "tests" / place.parent
        while not mirror.is_dir():
            mirror = mirror.parent
        extra = any(place.as_posix().startswith(name) for name in NEED_EXTRAS)
        if mirror != ROOT / "tests" / folder or path.stem == "__main__" or extra:
            continue
        name = ".".join(place.with_suffix("").parts).removesuffix(".__init__")
        try:
            module = importlib.import_module(name)
        except ModuleNotFoundError as error:
            if (error.name or "").partition(".")[0] in PRODUCT:
                raise
            continue
        values = dict(_constants(module, path))
        if values:
            found[name] = values
    return found


def _is_importable(name: str) -> bool:
    """Return whether a module exists and its libraries are installed."""
    try:
        importlib.import_module(name)
    except ModuleNotFoundError as error:
        return (error.name or "").partition(".")[0] in PRODUCT
    return True


def _constants(module: ModuleType, path: Path) -> Iterator[tuple[str, Any]]:
    """Yield the names and figures of the constants, default values and default arguments of a module."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign | ast.AnnAssign):
            for name in _names(node):
                if hasattr(module, name) and not name.startswith("__"):
                    yield from _shown(name, getattr(module, name))
        elif isinstance(node, ast.FunctionDef):
            yield from _arguments(node.name, getattr(module, node.name))
        elif isinstance(node, ast.ClassDef):
            kind = getattr(module, node.name)
            yield from _defaults(node.name, kind)
            for part in node.body:
                if isinstance(part, ast.FunctionDef):
                    yield from _arguments(f"{node.name}.{part.name}", inspect.getattr_static(kind, part.name))
                elif isinstance(part, ast.Assign) and not dataclasses.is_dataclass(kind):
                    for name in _names(part):
                        yield from _shown(f"{node.name}.{name}", getattr(kind, name, None))


def _names(node: ast.Assign | ast.AnnAssign) -> list[str]:
    targets = node.targets if isinstance(node, ast.Assign) else [node.target]
    return [name.id for target in targets for name in ast.walk(target) if isinstance(name, ast.Name)]


def _arguments(name: str, function: Any) -> Iterator[tuple[str, Any]]:
    function = inspect.unwrap(getattr(function, "__func__", function))
    if inspect.isfunction(function):
        for argument in inspect.signature(function).parameters.values():
            if argument.default is not inspect.Parameter.empty:
                yield from _shown(f"{name}({argument.name})", argument.default)


def _defaults(name: str, kind: Any) -> Iterator[tuple[str, Any]]:
    """Yield the default values of a dataclass or a msgspec structure."""
    if dataclasses.is_dataclass(kind):
        for field in dataclasses.fields(kind):
            if field.default is not dataclasses.MISSING:
                yield from _shown(f"{name}.{field.name}", field.default)
            elif field.default_factory is not dataclasses.MISSING:
                yield from _made(f"{name}.{field.name}", field.default_factory)
    elif isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        for entry in msgspec.structs.fields(kind):
            if entry.default is not msgspec.NODEFAULT:
                yield from _shown(f"{name}.{entry.name}", entry.default)
            elif entry.default_factory is not msgspec.NODEFAULT:
                yield from _made(f"{name}.{entry.name}", entry.default_factory)
            yield from _shown(f"{name}.{entry.name} bounds", _bounds(entry.type))


def _made(name: str, factory: Callable[[], Any]) -> Iterator[tuple[str, Any]]:
    """Yield what a factory makes, unless it is a time."""
    if getattr(factory, "__module__", "") != "time":
        yield from _shown(name, factory())


def _bounds(kind: Any) -> list[Any]:
    """Return the bounds in an annotated type."""
    found: list[Any] = []
    for meta in getattr(kind, "__metadata__", ()):
        if isinstance(meta, msgspec.Meta):
            found += [meta.gt, meta.ge, meta.lt, meta.le, meta.min_length, meta.max_length]
    for part in getattr(kind, "__args__", ()):
        found += _bounds(part)
    return found


def _shown(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield a name with the figures of a value, unless there is nothing to compare."""
    if isinstance(value, frozenset | set):
        value = sorted(value, key=str)
    figures = figures_of(_of_type(value))
    if figures is None or isinstance(figures, str) or figures in ([], {}):
        return
    text = json.dumps(figures, sort_keys=True)
    yield name, figures if len(text) <= LONGEST else hashlib.sha1(text.encode()).hexdigest()


def _of_type(value: Any) -> Any:
    """Return the bounds of an annotated type instead of the type."""
    return _bounds(value) if getattr(value, "__metadata__", ()) else value
