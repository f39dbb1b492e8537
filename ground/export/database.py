"""One SQLite file: a table for each kind of packet, and `fields` with the unit and meaning of each column.

NaN becomes NULL, and a column with whole numbers beyond 63 bits one of texts: SQLite has neither.
"""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ground.export.columns import Column, tables
from ground.telemetry import Run

_TYPES = {"f": "REAL", "i": "INTEGER", "u": "INTEGER"}
_LARGEST = (1 << 63) - 1


def write_database(run: Run, file: Path) -> list[Path]:
    """Write the database, in the place of one that is there; return the file. Raises OSError."""
    made = file.with_name(f"{file.name}.part")
    made.unlink(missing_ok=True)
    try:
        with closing(sqlite3.connect(made)) as database, database:
            database.execute("CREATE TABLE fields (packet TEXT, name TEXT, unit TEXT, meaning TEXT)")
            for name, columns in tables(run):
                _write_table(database, name, columns)
        os.replace(made, file)
    except sqlite3.Error as error:
        raise OSError(None, str(error), str(file)) from error
    finally:
        made.unlink(missing_ok=True)
    return [file]


def _write_table(database: sqlite3.Connection, name: str, columns: Sequence[Column]) -> None:
    described = [(name, column.name, column.unit, column.meaning) for column in columns]
    database.executemany("INSERT INTO fields VALUES (?, ?, ?, ?)", described)
    shape = ", ".join(f'"{column.name}" {_type(column)}' for column in columns)
    database.execute(f'CREATE TABLE "{name}" ({shape})')
    marks = ", ".join("?" * len(columns))
    rows = zip(*(_plain(column) for column in columns), strict=True)
    database.executemany(f'INSERT INTO "{name}" VALUES ({marks})', rows)


def _type(column: Column) -> str:
    values = column.values
    return "TEXT" if isinstance(values, list) or _is_wide(values) else _TYPES[values.dtype.kind]


def _plain(column: Column) -> list[object]:
    values = column.values
    if isinstance(values, list):
        return list(values)
    return [str(value) for value in values.tolist()] if _is_wide(values) else list(values.tolist())


def _is_wide(values: npt.NDArray[Any]) -> bool:
    """Return whether SQLite's whole numbers cannot hold these."""
    return bool(values.dtype.kind == "u" and np.any(values > _LARGEST))
