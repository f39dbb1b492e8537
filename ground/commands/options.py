"""Command-line arguments and output that several commands share."""

from __future__ import annotations

import argparse
import math
import re
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from flight.app.cli import to_json
from flight.schema.document import config_path
from knightcube.astro.arrays import FloatArray, Image
from knightcube.errors import UsageError, reason_of
from knightcube.vision.camera.images import read_image, read_raw, stated_exposure
from knightcube.vision.frame import LEAST_SIDE

CONFIG_HELP = "YAML file, or name of a packaged configuration"
"""Help of an argument that is read by `config_path`."""
_RAW = re.compile(r"([0-9]+)x([0-9]+)x(8|16)(?:\+([0-9]+))?")


def add_picture(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that name a picture file."""
    parser.add_argument(
        "image", type=Path, metavar="IMAGE", help="PNG, TIFF, JPEG, BMP, PGM, FITS, or see --raw"
    )
    text = (
        "IMAGE is raw pixels: columns x rows x bits (8, or 16 little-endian), such as 1280x960x16, "
        "or 1280x960x16+512 after a header of 512 bytes"
    )
    parser.add_argument("--raw", type=raw_shape, metavar="CxRxB", help=text)


def add_field(parser: argparse.ArgumentParser, *, required: bool = False) -> None:
    """Add the arguments that describe the camera; if `required`, the user must give exactly one."""
    group = parser.add_mutually_exclusive_group(required=True) if required else parser
    group.add_argument("--fov", type=positive, metavar="DEG", help="field of view across the columns, deg")
    text = f"configuration ({CONFIG_HELP}) or calibration of the camera"
    group.add_argument("--camera", type=config_path, metavar="YAML", help=text)


def add_output(parser: argparse.ArgumentParser, run: Callable[[argparse.Namespace], int]) -> None:
    """Add the arguments that describe the output, and set the function that runs the command."""
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--overlay", type=Path, metavar="PNG", help="draw the result on the picture")
    parser.set_defaults(command=run)


def print_result(options: argparse.Namespace, facts: Any, text: str) -> None:
    """Print a result as one JSON object if the option `--json` is given, otherwise as text."""
    sys.stdout.write(to_json(facts) if options.json else text)


@contextmanager
def interruptible() -> Iterator[None]:
    """Make Ctrl-C raise KeyboardInterrupt instead of ending the process at once."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def read_picture(options: argparse.Namespace) -> Image:
    """Return the pixels (rows, columns) of the picture that the arguments name.

    Raises UsageError if the picture cannot be read, or if the overlay would replace a picture that is read.
    """
    second, mask = getattr(options, "second", None), getattr(options, "mask", None)
    check_picture("--overlay", options.overlay, options.image, second, mask, options.camera)
    if options.overlay is not None and options.overlay.suffix.lower() not in {"", ".png"}:
        raise UsageError(f"--overlay {options.overlay}: a PNG file is written: give a name that ends in .png")
    if options.raw:
        pixels = read_raw(options.image, *options.raw)
    else:  # for a camera, the picture stays in the orientation of the detector
        pixels = read_image(options.image, upright=options.camera is None)
    check_size(options.image, pixels)
    return pixels


def exposure_of(options: argparse.Namespace, configured: float | None) -> tuple[float | None, str]:
    """Return the exposure time (s) of a picture, or None if it is unknown, and a line about its source.

    The option `--exposure` has precedence over the metadata of the picture, and the metadata have precedence
    over the `configured` exposure time. The line is empty unless two of these times differ by more than 1 %.
    """
    given, stated = options.exposure, None if options.raw else stated_exposure(options.image)
    found = given or stated or configured
    others = [] if given is None else [("the picture states", stated)]
    others += [("the configuration states", configured)] if given is None and stated is not None else []
    if found is None:
        return None, ""
    different = [f"{who} {s:g} s" for who, s in others if s is not None and abs(s / found - 1.0) > 0.01]
    return found, f"exposure:      {found:g} s; {different[0]}\n" if different else ""


_MOST_ASIDE, _MOST_RATIO = 60.0, 3.0
"""Largest angle (deg) and largest ratio of magnitudes of a rough and a measured rate that agree."""


def prior_contradiction(prior: Sequence[float] | None, rate: FloatArray | None) -> str:
    """Return a text on how a rough and a measured rate (3,), rad/s, differ, or an empty text if they agree.

    A rough rate that contradicts the measured rate is not used to determine the sign of the latter.
    """
    if prior is None or rate is None or not np.any(prior):
        return ""
    sizes = float(np.linalg.norm(prior)), float(np.linalg.norm(rate))
    cosine = abs(float(np.dot(prior, rate))) / (sizes[0] * sizes[1])
    aside = math.degrees(math.acos(min(1.0, cosine)))
    if aside <= _MOST_ASIDE and 1.0 / _MOST_RATIO <= sizes[0] / sizes[1] <= _MOST_RATIO:
        return ""
    return (
        f"not used: {1e3 * sizes[0]:.3g} mrad/s, {aside:.0f} deg from the axis of the measured"
        f" rate of {1e3 * sizes[1]:.3g} mrad/s: check its axes and its unit (rad/s)"
    )


def check_size(path: Path, pixels: Image) -> None:
    """Raise UsageError for a picture that is too small to be analysed."""
    rows, columns = pixels.shape
    if min(rows, columns) < LEAST_SIDE:
        raise UsageError(f"{path}: {columns} x {rows} pixels: give {LEAST_SIDE} or more per side")


def check_camera(options: argparse.Namespace, pixels: Image, columns: int, rows: int) -> None:
    """Raise UsageError if the picture's size differs from that of the camera that `--camera` names."""
    if pixels.shape != (rows, columns):
        found = f"{options.image}: {pixels.shape[1]} x {pixels.shape[0]} pixels"
        own = f"the camera of {options.camera} has {columns} x {rows}"
        raise UsageError(f"{found}, but {own}: give the configuration of the camera that took the picture")


def raw_shape(text: str) -> tuple[int, int, int, int]:
    """Return columns, rows, bits and bytes of the header from a text such as 1280x960x16 or 1280x960x16+512.

    Raises ArgumentTypeError.
    """
    found = _RAW.fullmatch(text)
    if found is None or "0" in found.groups()[:3]:
        raise argparse.ArgumentTypeError(f"{text!r}: give columns x rows x bits, such as 1280x960x16")
    columns, rows, bits, header = found.groups(default="0")
    return int(columns), int(rows), int(bits), int(header)


def positive(text: str) -> float:
    """Return the positive finite number in an argument. Raises ArgumentTypeError for any other argument."""
    value = finite(text)
    if value <= 0.0:
        raise argparse.ArgumentTypeError(f"{text} is not a positive number")
    return value


def count(text: str) -> int:
    """Return the positive whole number in an argument. Raises ArgumentTypeError for any other argument."""
    if not re.fullmatch(r"0*[1-9][0-9]{0,8}", text):
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive whole number")
    return int(text)


def finite(text: str) -> float:
    """Return the finite number in an argument. Raises ArgumentTypeError for any other argument."""
    try:
        value = float(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from error
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text} is not a finite number")
    return value


def utc(text: str) -> datetime:
    """Return the time in an argument, in UTC unless the text has a time zone. Raises ArgumentTypeError."""
    try:
        found = datetime.fromisoformat(text)
        return found.replace(tzinfo=UTC) if found.tzinfo is None else found.astimezone(UTC)
    except (ValueError, OverflowError) as error:
        raise argparse.ArgumentTypeError(f"{text!r}: give a time such as 2026-03-01T12:00:00") from error


_PNG = b"\x89PNG\r\n\x1a\n"
"""The first bytes of a PNG file."""


def check_picture(option: str, path: Path | None, *read: Path | None) -> None:
    """Raise UsageError if a new PNG file would replace a file that is read, or a file that is not a PNG."""
    if path is None:
        return
    if any(one is not None and one.resolve() == path.resolve() for one in read):
        raise UsageError(f"{option} {path}: would replace a file that is read: name another file")
    with suppress(FileNotFoundError), path.open("rb") as file:
        if file.read(len(_PNG)) not in {_PNG, b""}:
            raise UsageError(f"{option} {path}: exists already and is not a PNG file: name another file")


def check_new(path: Path | None) -> None:
    """Raise UsageError if a file to be written exists already."""
    if path is not None and path.exists():
        raise UsageError(f"{path}: exists already: name another file")


def write_new(path: Path, text: str) -> None:
    """Write a new file, which must not exist. Raises UsageError."""
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except OSError as error:
        raise UsageError(f"{path}: cannot be written: {reason_of(error)}") from error
