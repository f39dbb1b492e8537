"""Defaults of configuration sections as plain values, to be compared with the published defaults."""

from __future__ import annotations

import inspect
from types import ModuleType
from typing import Any

import msgspec

Defaults = dict[str, dict[str, Any]]


def defaults_of(*modules: ModuleType) -> Defaults:
    """Return the defaults of all sections of modules: numbers, texts and lists by section and key.

    An inherited default is listed under the section that defines it. Missing values and subsections are
    omitted.
    """
    found: Defaults = {}
    for module in modules:
        for name, kind in inspect.getmembers(module, inspect.isclass):
            if kind.__module__ != module.__name__ or not issubclass(kind, msgspec.Struct):
                continue
            inherited = {
                (field.name, repr(field.default))
                for base in kind.__mro__[1:]
                if issubclass(base, msgspec.Struct) and base is not msgspec.Struct
                for field in msgspec.structs.fields(base)
            }
            found[name] = {
                field.name: msgspec.to_builtins(field.default)
                for field in msgspec.structs.fields(kind)
                if field.default not in (None, msgspec.NODEFAULT, (), {})
                and not isinstance(field.default, msgspec.Struct)
                and (field.name, repr(field.default)) not in inherited
            }
    return {name: values for name, values in found.items() if values}
