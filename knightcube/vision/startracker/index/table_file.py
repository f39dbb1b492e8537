"""Table columns in one memory-mapped file with a version and a checksum.

The file begins with a header: 8 bytes of magic that identify the kind of table, the version (uint32), the
CRC-32 of everything after the header (uint32), and the length of the table of contents (uint32). The table of
contents is JSON. The columns follow, little-endian, each at a multiple of 64 bytes. The same columns give the
same bytes.
"""

from __future__ import annotations

import json
import math
import mmap
import os
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from knightcube.errors import InputError

Columns = dict[str, npt.NDArray[Any]]
Facts = dict[str, float]
_HEADER = struct.Struct("<8sIII")
_ALIGNMENT = 64
_UNFIT = (ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RecursionError, SyntaxError)
"""Exceptions that invalid contents with a correct checksum may raise."""


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of table file.

    Attributes:
        magic: first 8 bytes of the file.
        version: version of the columns.
        name: name in messages.
        cure: advice in messages about a file that cannot be used.
    """

    magic: bytes
    version: int
    name: str
    cure: str

    def __post_init__(self) -> None:
        """Raise ValueError unless the magic has 8 bytes."""
        if len(self.magic) != 8:
            raise ValueError(f"magic {self.magic!r}: give 8 bytes")


def save(path: Path, kind: Kind, columns: Columns, facts: Facts) -> None:
    """Write columns and numbers to `path` atomically: a partly written file is never left there."""
    little = {name: _little(column) for name, column in columns.items()}
    contents: dict[str, Any] = {"facts": facts, "columns": {}}
    offset = 0
    for name, column in little.items():
        contents["columns"][name] = [column.dtype.str, list(column.shape), offset]
        offset += -(-column.nbytes // _ALIGNMENT) * _ALIGNMENT
    table = json.dumps(contents, sort_keys=True).encode()
    table += b" " * (-(_HEADER.size + len(table)) % _ALIGNMENT)
    body = bytearray(table)
    for column in little.values():
        body += column.tobytes() + b"\0" * (-column.nbytes % _ALIGNMENT)
    # Two processes may write at once: each writes a file of its own, and the last one replaces the other.
    temporary = path.with_name(f"{path.name}.{os.getpid()}.new")
    temporary.write_bytes(_HEADER.pack(kind.magic, kind.version, zlib.crc32(body), len(table)) + bytes(body))
    temporary.replace(path)


def load(path: Path, kind: Kind) -> tuple[Columns, Facts]:
    """Return the columns, memory-mapped and read-only, and the numbers.

    Raises InputError if the file is missing, damaged, of another kind or of another version.
    """
    name, cure = kind.name, kind.cure
    try:
        with path.open("rb") as file:
            mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except (OSError, ValueError) as error:
        raise InputError(str(path), f"the {name} cannot be read ({error}); {cure}") from error
    if len(mapped) < _HEADER.size or mapped[: len(kind.magic)] != kind.magic:
        raise InputError(str(path), f"the file is not a {name}; {cure}")
    _, version, checksum, length = _HEADER.unpack_from(mapped)
    if version != kind.version:
        raise InputError(str(path), f"the {name} has version {version} instead of {kind.version}; {cure}")
    if zlib.crc32(memoryview(mapped)[_HEADER.size :]) != checksum:
        raise InputError(str(path), f"the {name} is damaged: its CRC-32 is wrong; {cure}")
    try:
        return _columns(mapped, _HEADER.size + length)
    except _UNFIT as error:
        raise InputError(str(path), f"the contents of the {name} cannot be read ({error}); {cure}") from error


def _columns(mapped: mmap.mmap, begin: int) -> tuple[Columns, Facts]:
    contents = json.loads(mapped[_HEADER.size : begin])
    columns = {
        name: np.frombuffer(mapped, np.dtype(kind), math.prod(shape), begin + offset).reshape(shape)
        for name, (kind, shape, offset) in contents["columns"].items()
    }
    if any(column.dtype.hasobject for column in columns.values()):
        raise TypeError("a column does not contain numbers")
    return columns, {str(name): float(fact) for name, fact in contents["facts"].items()}


def _little(column: npt.NDArray[Any]) -> npt.NDArray[Any]:
    return np.ascontiguousarray(column, dtype=column.dtype.newbyteorder("<"))
