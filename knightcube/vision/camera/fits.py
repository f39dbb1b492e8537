"""Reads the primary image of a FITS file (FITS Standard 4.0, sections 3, 4.4.1 and 5) from its bytes.

Read: BITPIX 8, 16, 32, -32 and -64, two axes, BZERO, BSCALE and BLANK. Not read: extensions, tables,
compressed images, cubes.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import Image
from knightcube.errors import UsageError

SIGNATURE = b"SIMPLE  ="
BLOCK = 2880
CARD = 80
KINDS = {8: ">u1", 16: ">i2", 32: ">i4", -32: ">f4", -64: ">f8"}
"""BITPIX to the pixels' type."""
UNSIGNED = {"i2": (32768.0, np.uint16), "i4": (2147483648.0, np.uint32)}
"""The BZERO by which unsigned numbers are stored as signed ones (section 4.4.2.5)."""


def primary_image(content: bytes, name: str) -> Image:
    """Return the image (rows, columns) of a FITS file's `content`, row 0 the file's first.

    Whole numbers without a scale keep their type; shifted unsigned 16 and 32-bit numbers become unsigned; any
    other scale gives float64. Raises UsageError, with `name`, for other content.
    """
    header, start = _header(content, name)
    bits = _whole(header, "BITPIX", name)
    if bits not in KINDS:
        raise UsageError(f"{name}: BITPIX = {bits}: one of {', '.join(map(str, KINDS))} is read")
    axes = [_whole(header, f"NAXIS{axis + 1}", name) for axis in range(_whole(header, "NAXIS", name))]
    if len(axes) < 2 or min(axes) < 1 or math.prod(axes[2:]) != 1:
        shape = " x ".join(map(str, axes)) or "nothing"
        raise UsageError(f"{name}: the primary image is {shape}: one plane of columns x rows is read")
    columns, rows = axes[:2]
    kind = np.dtype(KINDS[bits])
    if len(content) < start + rows * columns * kind.itemsize:
        raise UsageError(f"{name}: ends before its {columns} x {rows} pixels do: it was cut short")
    stored = np.frombuffer(content, dtype=kind, count=rows * columns, offset=start).reshape(rows, columns)
    if bits > 0 and "BLANK" in header and np.any(stored == _whole(header, "BLANK", name)):
        raise UsageError(f"{name}: has blank pixels: fill them first")
    image = _scaled(stored, _real(header, "BZERO", 0.0, name), _real(header, "BSCALE", 1.0, name))
    if not np.all(np.isfinite(image)):
        raise UsageError(f"{name}: has pixels that are not finite: fill them first")
    return image


def _scaled(stored: npt.NDArray[np.generic], zero: float, scale: float) -> Image:
    native = stored.astype(stored.dtype.newbyteorder("="))
    if (zero, scale) == (0.0, 1.0):
        return native
    offset, unsigned = UNSIGNED.get(native.dtype.str[1:], (0.0, None))
    if unsigned is not None and (zero, scale) == (offset, 1.0):
        # Adding the offset flips the highest bit only.
        return np.asarray(native.view(unsigned) ^ unsigned(offset))
    return np.asarray(zero + scale * native.astype(np.float64))


def _header(content: bytes, name: str) -> tuple[dict[str, str], int]:
    """Return the cards' values as text, without their comments, and where the pixels begin."""
    header: dict[str, str] = {}
    for place in range(0, len(content) - CARD + 1, CARD):
        card = content[place : place + CARD].decode("ascii", errors="replace")
        keyword = card[:8].rstrip()
        if keyword == "END":
            return header, (place // BLOCK + 1) * BLOCK
        if card[8:10] == "= ":
            header.setdefault(keyword, card[10:].split("/", 1)[0].strip())
    raise UsageError(f"{name}: its FITS header has no END: it was cut short")


def _whole(header: dict[str, str], keyword: str, name: str) -> int:
    try:
        return int(header[keyword])
    except KeyError:
        raise UsageError(f"{name}: its FITS header has no {keyword}") from None
    except ValueError:
        raise UsageError(f"{name}: {keyword} = {header[keyword]!r} is no whole number") from None


def _real(header: dict[str, str], keyword: str, otherwise: float, name: str) -> float:
    try:
        # The exponent of a double may be written with a D (section 4.2.4).
        value = float(header[keyword].replace("D", "E")) if keyword in header else otherwise
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise UsageError(f"{name}: {keyword} = {header[keyword]!r} is no number")
    return value
