"""The frames that a flight kept, as pictures that a browser shows, with what was found in them."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import Image
from knightcube.vision.camera.images import facts_of

_LARGEST = 640
"""px of a picture's side: what the page has room for."""
_DARK, _BRIGHT = 50.0, 99.9
"""Percentiles that are shown as black and white."""


class FrameFolder:
    """The folder of kept frames; `None` where there is none to look at."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder

    def facts(self, sequence: int) -> dict[str, Any] | None:
        """Return what was found in a frame, with its `columns` and `rows`; None where it is not kept."""
        data = self._read(sequence)
        if data is None:
            return None
        try:
            rows, columns = pixels_of(data).shape
            return {**facts_of(data), "columns": columns, "rows": rows}
        except ValueError:
            return None

    def picture(self, sequence: int) -> bytes | None:
        """Return a frame as PNG, binned to the page's size and stretched; None where it is not kept."""
        data = self._read(sequence)
        if data is None:
            return None
        try:
            return png(stretched(binned(pixels_of(data))))
        except ValueError:
            return None

    def _read(self, sequence: int) -> bytes | None:
        if self._folder is None:
            return None
        try:
            return (self._folder / f"frame-{sequence:08d}.pgm").read_bytes()
        except OSError:
            return None


def pixels_of(data: bytes) -> Image:
    """Return the pixels (rows, columns) of a kept frame, not copied. Raises ValueError for another file."""
    parts = data.split(b"\n", 4)
    if len(parts) != 5 or parts[0] != b"P5":
        raise ValueError("no kept frame")
    columns, rows = (int(word) for word in parts[2].split())
    kind = np.dtype(">u2") if int(parts[3]) > 255 else np.dtype(np.uint8)
    if columns < 1 or rows < 1 or len(parts[4]) != rows * columns * kind.itemsize:
        raise ValueError(f"{len(parts[4])} bytes are no frame of {columns} x {rows}")
    return np.frombuffer(parts[4], kind).reshape(rows, columns)


def binned(pixels: Image) -> Image:
    """Return the means of squares of pixels, so that no side is longer than the page shows."""
    step = -(-max(pixels.shape) // _LARGEST)
    rows, columns = (side // step for side in pixels.shape)
    squares = pixels[: rows * step, : columns * step].reshape(rows, step, columns, step)
    return np.asarray(squares.mean(axis=(1, 3), dtype=np.float32))


def stretched(pixels: Image) -> npt.NDArray[np.uint8]:
    """Return pixels as grey levels: faint stars show, bright ones do not drown them."""
    dark, bright = np.percentile(pixels, [_DARK, _BRIGHT])
    scale = max(float(bright - dark), 1e-9)
    levels = np.arcsinh(10.0 * np.clip((pixels - dark) / scale, 0.0, 1.0)) / np.arcsinh(10.0)
    return np.asarray(np.round(255.0 * levels), dtype=np.uint8)


def png(levels: npt.NDArray[np.uint8]) -> bytes:
    """Return grey levels (rows, columns) as the bytes of a PNG (ISO/IEC 15948), 8 bits."""
    rows, columns = levels.shape
    lines = np.hstack([np.zeros((rows, 1), np.uint8), levels]).tobytes()
    head = struct.pack(">IIBBBBB", columns, rows, 8, 0, 0, 0, 0)
    chunks = ((b"IHDR", head), (b"IDAT", zlib.compress(lines, 6)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(kind, data) for kind, data in chunks)


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
