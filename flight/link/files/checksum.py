"""Checksums of a file by type, CCSDS 727.0-B-5 4.2.5: modular (0), CRC-32 (3). In portions: none waits."""

from __future__ import annotations

import zlib
from pathlib import Path

import numpy as np

MODULAR, CRC32 = 0, 3
TYPES = (MODULAR, CRC32)
PORTION = 1 << 20


class FileSum:
    """Sums up the first `size` bytes of a file, a portion at each `step`."""

    def __init__(self, path: Path, kind: int, size: int) -> None:
        """`kind` is one of `TYPES`."""
        self._path, self._kind, self._left = path, kind, size
        self._at = self._value = 0

    def step(self) -> int | None:
        """Read a portion; return the sum when all is read, else None. Raises OSError."""
        if self._left:
            with self._path.open("rb") as file:
                file.seek(self._at)
                data = file.read(min(PORTION, self._left))
            if not data:
                raise OSError(f"{self._path.name} ends before its size")
            self._value = add(self._kind, self._value, data)
            self._at += len(data)
            self._left -= len(data)
        return None if self._left else self._value


def add(kind: int, value: int, data: bytes) -> int:
    """Return the sum `value` gone on with over `data`; all pieces but the last are whole words."""
    if kind == CRC32:
        return zlib.crc32(data, value)
    words = np.frombuffer(data + bytes(-len(data) % 4), dtype=">u4")
    return (value + int(words.sum(dtype=np.uint64))) % (1 << 32)
