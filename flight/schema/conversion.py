"""From plain values to a typed section; a complaint names file, line, value and the nearest known key."""

from __future__ import annotations

import difflib
import re
from typing import Any, TypeVar

import msgspec

from flight.schema.document import Document, join
from flight.schema.expectation import expectation, steps_of

T = TypeVar("T")

_ABSENT = object()


def convert(document: Document, shape: type[T], section: str = "") -> T:
    """Return a section of a document, or all of it, as `shape`. Raises ConfigError."""
    tree: Any = document.values[section] if section else document.values
    try:
        return msgspec.convert(tree, shape)
    except msgspec.ValidationError as error:
        message, _, path = str(error).partition(" - at `$")
        path = path.rstrip("`")
        dotted = join(section, path.lstrip("."))
        unknown = re.match(r"Object contains unknown field `(.+)`", message)
        if unknown:
            key = unknown.group(1)
            problem = "is an unknown key" + _nearest(key, shape, tree, path)
            raise document.error(join(dotted, key), problem) from error
        missing = re.match(r"Object missing required field `(.+)`", message)
        if missing:
            raise document.error(join(dotted, missing.group(1)), "is missing") from error
        value = _lookup(tree, path)
        message = expectation(message, shape, path)
        if value is not _ABSENT:
            message = f"is {_shown(value)}: {message}"
        raise document.error(dotted, message) from error


def _shown(value: Any) -> str:
    """Return a value as a complaint shows it, cut to 200 characters."""
    text = repr(value)
    return text if len(text) <= 200 else text[:200] + "..."


def _lookup(tree: Any, path: str) -> Any:
    """Return the value at a msgspec path such as `.coils.channels[1]`; _ABSENT for a section."""
    for key, index in steps_of(path):
        try:
            tree = tree[key] if key else tree[int(index)]
        except (KeyError, IndexError, TypeError, ValueError):
            return _ABSENT
    return tree if not isinstance(tree, dict) else _ABSENT


def _nearest(key: str, shape: Any, tree: Any, path: str) -> str:
    """Suggest the right name for an unknown key of the struct found along `path`."""
    for step in re.findall(r"\.([^.\[]+)", path):
        fields = {f.encode_name: f.type for f in msgspec.structs.fields(shape)}
        tree = tree.get(step) if isinstance(tree, dict) else None
        shape = _struct_of(fields.get(step), tree)
        if shape is None:
            return ""
    names = [f.encode_name for f in msgspec.structs.fields(shape)]
    close = difflib.get_close_matches(key, names, n=1, cutoff=0.5)
    return f", did you mean `{close[0]}`?" if close else f"; known keys: {', '.join(names)}"


def _struct_of(annotation: Any, tree: Any) -> Any:
    """Return the struct inside an annotation such as `Camera | None` or `tuple[Step, ...]`.

    Of several tagged structs it is the one whose tag stands in `tree`.
    """
    if isinstance(annotation, type) and issubclass(annotation, msgspec.Struct):
        config = annotation.__struct_config__
        tag = tree.get(config.tag_field) if isinstance(tree, dict) and config.tag_field else config.tag
        return annotation if tag == config.tag else None
    for inner in getattr(annotation, "__args__", ()):
        if (found := _struct_of(inner, tree)) is not None:
            return found
    return None
