"""Records of arrays: dataclasses whose fields are arrays with one row for each thing."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any, TypeVar

from knightcube.astro.arrays import BoolArray, IntArray

Record = TypeVar("Record")


def select(record: Record, chosen: BoolArray | IntArray, *common: str) -> Record:
    """Return a dataclass `record` with the rows that `chosen` picks, by mask (n,) or by index.

    Fields named `common` belong to all rows and stay as they are.
    """
    picked: dict[str, Any] = {
        field.name: getattr(record, field.name)[chosen]
        for field in fields(record)  # type: ignore[arg-type]  # a dataclass
        if field.name not in common
    }
    return replace(record, **picked)  # type: ignore[type-var]  # a dataclass
