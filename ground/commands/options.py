"""What the commands that read pictures have in common."""

from __future__ import annotations

import argparse
import math
import re
from pathlib import Path

from flight.gnc.camera.images import read_image, read_raw
from flight.gnc.math.arrays import Image

_RAW = re.compile(r"([0-9]+)x([0-9]+)x(8|16)")


def add_picture(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that name a picture."""
    parser.add_argument("image", type=Path, metavar="IMAGE", help="PNG, TIFF, JPEG, FITS, or see --raw")
    parser.add_argument(
        "--raw",
        type=raw_shape,
        metavar="CxRxB",
        help="IMAGE is bare pixels: columns x rows x bits (8, or 16 little-endian), such as 1280x960x16",
    )


def read_picture(options: argparse.Namespace) -> Image:
    """Return the pixels (rows, columns) of the picture that the arguments name. Raises UsageError."""
    return read_raw(options.image, *options.raw) if options.raw else read_image(options.image)


def raw_shape(text: str) -> tuple[int, int, int]:
    """Return columns, rows and bits. Raises ArgumentTypeError unless they are given as 1280x960x16."""
    found = _RAW.fullmatch(text)
    if found is None or "0" in found.groups():
        raise argparse.ArgumentTypeError(f"{text!r}: give columns x rows x bits, such as 1280x960x16")
    columns, rows, bits = found.groups()
    return int(columns), int(rows), int(bits)


def positive(text: str) -> float:
    """Return the number that an argument gives. Raises ArgumentTypeError unless it is finite and positive."""
    try:
        value = float(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from error
    if not (math.isfinite(value) and value > 0.0):
        raise argparse.ArgumentTypeError(f"{text} is not a positive number")
    return value
