"""What a value should have been, in a reader's words: the permitted values, or a kind and its bounds."""

from __future__ import annotations

import re
from typing import Any

from msgspec import inspect

_NOUNS = {
    "`object`": "a section",
    "`array`": "a list",
    "`str`": "a text",
    "`int`": "a whole number",
    "`float`": "a number",
    "`bool`": "true or false",
    "`null`": "nothing",
}


def steps_of(path: str) -> list[tuple[str, str]]:
    """Return the steps of a msgspec path such as `.coils.channels[1]`: (key, "") or ("", index)."""
    return re.findall(r"\.([^.\[]+)|\[(\d+|\.\.\.)\]", path)


def expectation(message: str, shape: Any, path: str) -> str:
    """Return msgspec's complaint about the value at a `path` of a `shape`, with what is permitted there."""
    kinds = _kinds_at(shape, path)
    choices = [value for kind in kinds if isinstance(kind, inspect.LiteralType) for value in kind.values]
    if choices:
        return "expected one of " + ", ".join(map(str, choices))
    hints = [hint for kind in kinds if (hint := _hint(kind))]
    if "matching regex" in message and hints:
        return f"expected {' or '.join(hints)}"
    plain = message[0].lower() + message[1:]
    for technical, noun in _NOUNS.items():
        plain = plain.replace(technical, noun)
    return plain


def _hint(kind: inspect.Type) -> str:
    schema = (kind.extra_json_schema or {}) if isinstance(kind, inspect.Metadata) else {}
    return str(schema.get("description", ""))


def _kinds_at(shape: Any, path: str) -> list[inspect.Type]:
    """Return the kinds that a value at `path` may be of; descriptions stay, unions are taken apart."""
    kinds: list[inspect.Type] = _apart(inspect.type_info(shape))
    for key, index in steps_of(path):
        kinds = [inner for kind in kinds for each in _within(kind, key, index) for inner in _apart(each)]
    return kinds


def _apart(kind: inspect.Type) -> list[inspect.Type]:
    if isinstance(kind, inspect.Metadata):
        return [kind, *_apart(kind.type)]
    if isinstance(kind, inspect.UnionType):
        return [inner for each in kind.types for inner in _apart(each)]
    return [kind]


def _within(kind: inspect.Type, key: str, index: str) -> list[inspect.Type]:
    """Return what stands at a key or an index of a kind; the tag of a union's section is a choice."""
    if isinstance(kind, inspect.StructType) and key:
        if key == kind.tag_field:
            return [inspect.LiteralType((kind.tag,))]
        return [field.type for field in kind.fields if field.encode_name == key]
    if isinstance(kind, inspect.TupleType) and index:
        place = int(index) if index.isdigit() else 0
        return list(kind.item_types[place : place + 1])
    if isinstance(kind, inspect.VarTupleType) and index:
        return [kind.item_type]
    return []
