"""Array types used throughout the library, and the selection of rows from records of arrays."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
Image = npt.NDArray[Any]

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
