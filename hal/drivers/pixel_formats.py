"""Conversion of the pixel formats of V4L2 cameras, named as in kernel drivers and libcamera, to grey images.

The layouts are those of the kernel's documentation (Linux Media userspace API, chapter "Image Formats"). The
MIPI formats pack four pixels of 10 bits into five bytes, or two pixels of 12 bits into three bytes. The last
byte of such a group holds the low bits of all its pixels, with the first pixel in the lowest bits.

A Bayer mosaic is convolved with the kernel (1, 2, 1) / 4 along rows and columns. Red, green and blue then
contribute a quarter, a half and a quarter to each pixel, at every position in the mosaic. All four colour
orders therefore give the same image, and the centroid of a star is not displaced. Motion JPEG is decoded by
Pillow, and its luma is used.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

BIG_ENDIAN = 1 << 31
"""Bit that marks big-endian pixels in the numeric code of a pixel format."""

Packing = Literal["u1", "<u2", ">u2", "mipi10", "mipi12", "bits10", "luma first", "luma second", "jpeg"]
_GROUPS: dict[str, tuple[int, int]] = {"mipi10": (4, 5), "mipi12": (2, 3), "bits10": (4, 5)}
"""Numbers of pixels and bytes in the smallest group that fills whole bytes, for each packing."""

Pixels = npt.NDArray[Any]


class PixelError(ValueError):
    """Raised if the data of a frame are not an image of the expected format and size."""


@dataclass(frozen=True, slots=True)
class PixelCoding:
    """Layout of the pixels of a format.

    Attributes:
        packing: numpy type of an unpacked pixel, or name of the packing.
        bits: significant bits of a pixel.
        is_bayer: whether the pixels are a mosaic of red, green and blue.
    """

    packing: Packing
    bits: int
    is_bayer: bool = False

    @property
    def is_compressed(self) -> bool:
        """Whether the length of a frame varies."""
        return self.packing == "jpeg"

    def row_bytes(self, columns: int) -> int:
        """Return the number of bytes of a row without padding, or 0 for a compressed format."""
        if self.is_compressed:
            return 0
        if self.packing in _GROUPS:
            pixels, size = _GROUPS[self.packing]
            return -(-columns // pixels) * size
        return columns if self.packing == "u1" else 2 * columns

    def image(self, data: npt.NDArray[np.uint8], columns: int, rows: int, stride: int) -> Pixels:
        """Return the grey image (rows, columns), of uint8 or uint16, in a frame buffer.

        Raises PixelError if the data are damaged, or an image of another size.

        Args:
            data: (n,) bytes of the frame.
            columns: number of columns of the image.
            rows: number of rows of the image.
            stride: distance between the starts of two rows, bytes.
        """
        if self.is_compressed:
            return _decoded(data.tobytes(), columns, rows)
        used = self.row_bytes(columns)
        if stride < used or len(data) < stride * (rows - 1) + used:
            raise PixelError(f"{len(data)} bytes are too few for {columns} x {rows} pixels")
        lines = np.lib.stride_tricks.as_strided(data, (rows, used), (stride, 1), writeable=False)
        grey = self._unpacked(lines)[:, :columns]
        return _luma(grey) if self.is_bayer else np.ascontiguousarray(grey)

    def _unpacked(self, lines: npt.NDArray[np.uint8]) -> Pixels:
        """Return the pixel values in rows of packed bytes."""
        if self.packing == "u1":
            return lines.copy()
        if self.packing in {"luma first", "luma second"}:
            return lines[:, self.packing == "luma second" :: 2]
        if self.packing in _GROUPS:
            groups = lines.reshape(len(lines), -1, _GROUPS[self.packing][1]).astype(np.uint16)
            return _UNPACK[self.packing](groups).reshape(len(lines), -1)
        return np.ascontiguousarray(lines).view(self.packing).astype(np.uint16)


def _mipi10(groups: Pixels) -> Pixels:
    low = groups[..., 4:] >> np.arange(0, 8, 2, dtype=np.uint16) & 3
    return groups[..., :4] << 2 | low


def _mipi12(groups: Pixels) -> Pixels:
    low = groups[..., 2:] >> np.array([0, 4], dtype=np.uint16) & 15
    return groups[..., :2] << 4 | low


def _bits10(groups: Pixels) -> Pixels:
    shifts = np.arange(2, 10, 2, dtype=np.uint16)
    high = groups[..., :4] << shifts & 0x3FF
    return high | groups[..., 1:] >> (8 - shifts)


_UNPACK = {"mipi10": _mipi10, "mipi12": _mipi12, "bits10": _bits10}


def _luma(mosaic: Pixels) -> Pixels:
    """Return the grey image of a Bayer mosaic, of the same type. The edges are extended by reflection."""
    wide = np.pad(mosaic, 1, mode="reflect").astype(np.uint32)
    rows = wide[:-2] + 2 * wide[1:-1] + wide[2:]
    total = rows[:, :-2] + 2 * rows[:, 1:-1] + rows[:, 2:]
    return np.asarray((total + 8) >> 4, dtype=mosaic.dtype)


def _decoded(data: bytes, columns: int, rows: int) -> Pixels:
    from PIL import Image, UnidentifiedImageError  # noqa: PLC0415  # an extra that only Motion JPEG needs

    try:
        with Image.open(io.BytesIO(data), formats=["JPEG"]) as picture:
            if picture.size != (columns, rows):
                width, height = picture.size
                raise PixelError(f"a JPEG of {width} x {height} pixels, not {columns} x {rows}")
            picture.draft("L", None)
            return np.asarray(picture.convert("L"))
    except (UnidentifiedImageError, OSError, SyntaxError) as error:
        raise PixelError(f"a damaged JPEG: {error}") from error


_BAYER: dict[tuple[Packing, int], tuple[str, str, str, str]] = {
    ("u1", 8): ("BA81", "GBRG", "GRBG", "RGGB"),
    ("<u2", 10): ("BG10", "GB10", "BA10", "RG10"),
    ("<u2", 12): ("BG12", "GB12", "BA12", "RG12"),
    ("<u2", 16): ("BYR2", "GB16", "GR16", "RG16"),
    ("mipi10", 10): ("pBAA", "pGAA", "pgAA", "pRAA"),
    ("mipi12", 12): ("pBCC", "pGCC", "pgCC", "pRCC"),
}
"""Names of the Bayer formats with the colour orders BGGR, GBRG, GRBG and RGGB, by packing and bits."""

PIXEL_FORMATS: dict[str, PixelCoding] = {
    "GREY": PixelCoding("u1", 8),
    "Y10": PixelCoding("<u2", 10),
    "Y12": PixelCoding("<u2", 12),
    "Y14": PixelCoding("<u2", 14),
    "Y16": PixelCoding("<u2", 16),
    "Y16-BE": PixelCoding(">u2", 16),
    "Y10P": PixelCoding("mipi10", 10),
    "Y12P": PixelCoding("mipi12", 12),
    "Y10B": PixelCoding("bits10", 10),
    "YUYV": PixelCoding("luma first", 8),
    "UYVY": PixelCoding("luma second", 8),
    "MJPG": PixelCoding("jpeg", 8),
    **{
        name: PixelCoding(packing, bits, is_bayer=True)
        for (packing, bits), names in _BAYER.items()
        for name in names
    },
}
"""Pixel formats by the four letters of their code; the suffix -BE marks big-endian pixels."""


def fourcc(name: str) -> int:
    """Return the numeric code of a pixel format from its name: up to four letters, with or without -BE."""
    letters = name.removesuffix("-BE")
    code = int.from_bytes(letters.ljust(4).encode("ascii"), "little")
    return code | BIG_ENDIAN if letters != name else code


def fourcc_name(code: int) -> str:
    """Return the name of a pixel format from its numeric code."""
    letters = (code & ~BIG_ENDIAN).to_bytes(4, "little").decode("ascii", "replace").rstrip()
    return f"{letters}-BE" if code & BIG_ENDIAN else letters
