"""Conversion of plain values to typed sections; an error names file, line, value and what is permitted."""

from __future__ import annotations

import difflib
import re
from typing import Any, TypeVar

import msgspec
from msgspec import inspect

from flight.schema.document import Document, join

T = TypeVar("T")

_NOUNS = {
    "`object`": "a section",
    "`array`": "a list",
    "`str`": "a text",
    "`int`": "a whole number",
    "`float`": "a number",
    "`bool`": "true or false",
    "`null`": "nothing",
}
"""Plain nouns for msgspec's names of types."""
_LONGEST = 200
"""Largest number of characters of a value in a message."""


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
        message = _permitted(message, shape, path)
        value = tree
        try:
            for key, index in _steps_of(path):
                value = value[key] if key else value[int(index)]
        except (KeyError, IndexError, TypeError, ValueError):
            pass  # msgspec writes [...] for an element whose index it does not know
        else:
            if not isinstance(value, dict):
                text = repr(value)
                cut = text if len(text) <= _LONGEST else text[:_LONGEST] + "..."
                message = f"is {cut}: {message}"
        raise document.error(dotted, message) from error


def _steps_of(path: str) -> list[tuple[str, str]]:
    """Return the steps of a msgspec path such as `.coils.channels[1]`: (key, "") or ("", index)."""
    return re.findall(r"\.([^.\[]+)|\[(\d+|\.\.\.)\]", path)


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

    Of several tagged structs it is the one whose tag is in `tree`.
    """
    if isinstance(annotation, type) and issubclass(annotation, msgspec.Struct):
        config = annotation.__struct_config__
        tag = tree.get(config.tag_field) if isinstance(tree, dict) and config.tag_field else config.tag
        return annotation if tag == config.tag else None
    for inner in getattr(annotation, "__args__", ()):
        if (found := _struct_of(inner, tree)) is not None:
            return found
    return None


def _permitted(message: str, shape: Any, path: str) -> str:
    """Return msgspec's message about the value at a `path` of a `shape`, with the permitted values."""
    kinds: list[inspect.Type] = _alternatives(inspect.type_info(shape))
    for key, index in _steps_of(path):
        kinds = [
            inner for kind in kinds for each in _within(kind, key, index) for inner in _alternatives(each)
        ]
    choices = [value for kind in kinds if isinstance(kind, inspect.LiteralType) for value in kind.values]
    if choices:
        return "expected one of " + ", ".join(map(str, choices))
    schemas = [kind.extra_json_schema or {} for kind in kinds if isinstance(kind, inspect.Metadata)]
    hints = [str(schema["description"]) for schema in schemas if "description" in schema]
    if "matching regex" in message and hints:
        return f"expected {' or '.join(hints)}"
    plain = message[0].lower() + message[1:]
    for technical, noun in _NOUNS.items():
        plain = plain.replace(technical, noun)
    return plain


def _alternatives(kind: inspect.Type) -> list[inspect.Type]:
    """Return the members of a union, with the descriptions of each."""
    if isinstance(kind, inspect.Metadata):
        return [kind, *_alternatives(kind.type)]
    if isinstance(kind, inspect.UnionType):
        return [inner for each in kind.types for inner in _alternatives(each)]
    return [kind]


def _within(kind: inspect.Type, key: str, index: str) -> list[inspect.Type]:
    """Return the types at a key or an index of a type; the tag of a union's section is a choice."""
    if isinstance(kind, inspect.StructType) and key:
        if key == kind.tag_field:
            return [inspect.LiteralType((kind.tag,))]
        return [field.type for field in kind.fields if field.encode_name == key]
    if isinstance(kind, inspect.TupleType) and index:
        position = int(index) if index.isdigit() else 0
        return list(kind.item_types[position : position + 1])
    if isinstance(kind, inspect.VarTupleType) and index:
        return [kind.item_type]
    return []
