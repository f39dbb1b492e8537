"""Reading of image files (PNG, TIFF, JPEG and BMP through Pillow, FITS and PGM), and writing of images.

    pixels = read_image("night.fits")      # counts (rows, columns), unchanged from the file
    pixels = read_raw(Path("night.raw"), columns=1280, rows=960, bits=16)      # pixels without a header
    write_picture(Path("found.png"), grey_stretch(pixels))

Row 0 of an image array is the top row. A photograph is rotated according to the orientation in its EXIF data.
In a FITS file, the first row is the top row unless the keyword ROWORDER is 'BOTTOM-UP'. An image read in the
wrong row order is a mirror image of the sky.

The FITS reader follows FITS Standard 4.0, sections 3, 4.4.1, 5 and 7.1. The reader accepts files compressed
by gzip, and reads the primary image or the first image extension. An image may have BITPIX 8, 16, 32, -32 or
-64, and one plane or three planes of colour. The reader applies BZERO and BSCALE. The reader rejects blank
pixels (BLANK), tables and tile-compressed images.

The vision worker keeps its newest frames on disk (`keep_frame`). A kept frame is a PGM file (Netpbm), which
most image programs can open. The PGM file contains the unchanged grey counts of the frame, of 8 or 16 bits,
and metadata in JSON as a comment.
"""

from __future__ import annotations

import gzip
import json
import math
import re
import struct
import sys
import warnings
import zlib
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import Image, brief
from knightcube.errors import ArgumentError, UsageError, reason_of
from knightcube.vision.frame import LUMINANCE, grey_of_planes

if TYPE_CHECKING:
    from PIL.Image import Image as Picture

SIGNATURE = b"SIMPLE  ="
BLOCK = 2880
CARD = 80
_GZIP, _MOST_BYTES, _MOST_AXES = b"\x1f\x8b", 1 << 30, 999
"""First bytes of a gzip file; largest accepted decompressed size (bytes); largest NAXIS of the FITS Standard.
"""
KINDS = {8: ">u1", 16: ">i2", 32: ">i4", -32: ">f4", -64: ">f8"}
"""NumPy types of the pixels of a FITS file by the value of its BITPIX keyword."""
UNSIGNED = {"i2": (32768.0, np.uint16), "i4": (2147483648.0, np.uint32)}
"""BZERO and type of unsigned integers that FITS stores as signed integers (FITS Standard 4.0, 4.4.2.5)."""


def fits_image(content: bytes, name: str) -> Image:
    """Return the image (rows, columns) in the bytes of a FITS file; row 0 is the top row.

    The image is the primary image or, if the primary image is empty, the first image extension. Integer
    pixels without BZERO and BSCALE keep their type. Signed pixels with the BZERO value of unsigned integers
    become unsigned. Pixels with any other BZERO or BSCALE value become float64. Three planes of colour are
    converted to luminance. Raises UsageError, with the file's `name` in its message, for an unsupported
    image.
    """
    header, axes, start = _first_image(content, name)
    bits = _whole(header, "BITPIX", name)
    kind, size = np.dtype(KINDS[bits]), math.prod(axes)
    if len(content) < start + size * kind.itemsize:
        shape = " x ".join(map(str, axes))
        raise UsageError(f"{name}: ends before the last of {shape} pixels: it was cut short")
    stored = np.frombuffer(content, dtype=kind, count=size, offset=start).reshape(axes[::-1])
    if bits > 0 and "BLANK" in header and np.any(stored == _whole(header, "BLANK", name)):
        raise UsageError(f"{name}: has blank pixels (BLANK = {header['BLANK']}): fill them first")
    zero, scale = _real(header, "BZERO", 0.0, name), _real(header, "BSCALE", 1.0, name)
    planes = _scaled(stored, zero, scale).reshape(-1, axes[1], axes[0])
    if not np.all(np.isfinite(planes)):
        scaled = f" with BZERO = {zero:g} and BSCALE = {scale:g}" if (zero, scale) != (0.0, 1.0) else ""
        raise UsageError(f"{name}: has pixels that are not finite{scaled}: fill them first")
    image = planes[0] if len(planes) == 1 else grey_of_planes(planes)
    return image[::-1].copy() if _bottom_up(header, name) else image


def _first_image(content: bytes, name: str) -> tuple[dict[str, str], list[int], int]:
    """Return header, axes (columns, rows, perhaps 3) and data offset of the first image of a FITS file."""
    place, empty = 0, ""
    while place == 0 or content.startswith(b"XTENSION=", place):
        header, start = _header(content, name, place)
        axes = _axes(header, name)
        bits = _whole(header, "BITPIX", name)
        if bits not in KINDS:
            raise UsageError(f"{name}: BITPIX = {bits} is not supported: use {', '.join(map(str, KINDS))}")
        if header.get("ZIMAGE") == "T":
            method = header.get("ZCMPTYPE", "unknown")
            raise UsageError(f"{name}: the image is tile-compressed (ZCMPTYPE = {method}): use funpack first")
        if header.get("XTENSION", "'IMAGE").strip("' ") == "IMAGE" and len(axes) >= 2 and min(axes) >= 1:
            colours = math.prod(axes[2:])
            if colours not in (1, 3):
                shape = " x ".join(map(str, axes))
                raise UsageError(f"{name}: the image is {shape}: only one plane or 3 colours are supported")
            return header, [*axes[:2], *([3] if colours == 3 else [])], start
        empty = empty or " x ".join(map(str, axes)) or "nothing"
        parameters = _whole(header, "PCOUNT", name) if "PCOUNT" in header else 0
        size = abs(bits) // 8 * ((math.prod(axes) if axes else 0) + max(parameters, 0))
        place = start + -(-max(size, 0) // BLOCK) * BLOCK
    raise UsageError(f"{name}: the primary image is {empty or 'nothing'} and no extension has an image")


def _axes(header: dict[str, str], name: str) -> list[int]:
    """Return the lengths of the axes of a FITS image: columns, rows and any further axes."""
    count = _whole(header, "NAXIS", name)
    if not 0 <= count <= _MOST_AXES:
        raise UsageError(f"{name}: NAXIS = {count}: give 2 axes, or 3 for colour")
    axes = [_whole(header, f"NAXIS{axis + 1}", name) for axis in range(count)]
    for number, size in enumerate(axes, start=1):
        if size < 0:
            raise UsageError(f"{name}: NAXIS{number} = {size} is negative")
    return axes


def _bottom_up(header: dict[str, str], name: str) -> bool:
    order = header.get("ROWORDER", "'TOP-DOWN'").strip("' ").upper()
    if order not in ("TOP-DOWN", "BOTTOM-UP"):
        raise UsageError(f"{name}: ROWORDER = {order!r}: give TOP-DOWN or BOTTOM-UP")
    return order == "BOTTOM-UP"


def rows_reversed(path: Path) -> bool:
    """Return whether `read_image` reverses the rows, as in FITS files with ROWORDER = 'BOTTOM-UP'."""
    content = _fits_content(path)
    return bool(content) and _bottom_up(_first_image(content, str(path))[0], str(path))


def _fits_content(path: Path) -> bytes:
    """Return the bytes of a FITS file, decompressed by gzip, or no bytes for files of other formats."""
    try:
        with path.open("rb") as file:
            beginning = file.read(len(SIGNATURE))
            file.seek(0)
            if beginning == SIGNATURE:
                return file.read()
            if beginning[:2] != _GZIP:
                return b""
            with gzip.open(file) as packed:
                content = packed.read(_MOST_BYTES + 1)
    except (EOFError, zlib.error) as error:
        raise UsageError(f"{path}: is damaged: {error}") from error
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {reason_of(error)}") from error
    if not content.startswith(SIGNATURE):
        raise UsageError(f"{path}: compressed, but not a FITS image: decompress or convert it")
    if len(content) > _MOST_BYTES:
        raise UsageError(f"{path}: is larger than {_MOST_BYTES >> 20} MiB: decompress it first")
    return content


def _scaled(stored: npt.NDArray[np.generic], zero: float, scale: float) -> Image:
    native = stored.astype(stored.dtype.newbyteorder("="))
    if (zero, scale) == (0.0, 1.0):
        return native
    offset, unsigned = UNSIGNED.get(native.dtype.str[1:], (0.0, None))
    if unsigned is not None and (zero, scale) == (offset, 1.0):
        # Adding the BZERO value of unsigned integers flips only the highest bit of a pixel.
        return np.asarray(native.view(unsigned) ^ unsigned(offset))
    # Pixels beyond the range of float64 become infinite, and the calling function rejects infinite pixels.
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(zero + scale * native.astype(np.float64))


def _header(content: bytes, name: str, begin: int) -> tuple[dict[str, str], int]:
    """Return the values of a FITS header at `begin`, by keyword, and the byte offset of the first pixel."""
    header: dict[str, str] = {}
    for place in range(begin, len(content) - CARD + 1, CARD):
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
        raise UsageError(f"{name}: {keyword} = {header[keyword]!r} is not an integer") from None


def _real(header: dict[str, str], keyword: str, otherwise: float, name: str) -> float:
    try:
        # FITS allows a D before the exponent of a double (FITS Standard 4.0, section 4.2.4).
        value = float(header[keyword].replace("D", "E")) if keyword in header else otherwise
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise UsageError(f"{name}: {keyword} = {header[keyword]!r} is not a number")
    return value


FORMATS = ("PNG", "TIFF", "JPEG", "BMP")
EXTRA = "pip install pillow"

PHOTOMETRIC_INTERPRETATION, WHITE_IS_ZERO = 262, 0
"""Number of the TIFF tag PhotometricInterpretation, and the tag's value WhiteIsZero (TIFF 6.0, section 8)."""
GREY_MODES = {"L": np.uint8, "1": np.uint8, "I;16": np.uint16, "I;16L": np.uint16, "I;16B": np.uint16}
"""NumPy types of grey images by the name of their Pillow mode."""
COLOUR_MODES = ("LA", "La", "P", "PA", "RGB", "RGBA", "RGBa", "RGBX", "CMYK", "YCbCr", "LAB", "HSV")

_NATIVE_SWAPPED = "B" if sys.byteorder == "little" else "L"
# Pillow keeps only the high byte of 16-bit colour values, or the low byte if the byte order is swapped.
_OTHER_BYTES = {
    f"{colour};16{order}": f"{colour};16{other}"
    for colour in ("RGB", "RGBA", "RGBX")
    for order, other in (("B", "L"), ("L", "B"), ("N", _NATIVE_SWAPPED))
}


def read_image(path: Path | str, *, upright: bool = True) -> Image:
    """Return the image (rows, columns) of a FITS, PNG, TIFF, JPEG, BMP or PGM file.

    The format is recognised by the file's content, not by its name. The pixels are uint8 or uint16. The
    pixels of FITS files may also be signed, 32-bit or floating-point. Colour images are converted to
    luminance (ITU-R BT.601). Photographs are rotated according to the orientation in their EXIF data unless
    `upright` is false. If `upright` is false, rows and columns are those of the camera's detector, as a
    calibrated lens requires. All formats except FITS and PGM need Pillow. Raises UsageError if the file is
    missing, damaged or in an unsupported format, if pixels are not finite, or if Pillow is not installed.
    """
    if not isinstance(path, str | Path):
        raise ArgumentError("path", f"{brief(path)}: give the path of an image")
    path = Path(path)
    if content := _fits_content(path):
        return fits_image(content, str(path))
    with suppress(OSError), path.open("rb") as file:
        if file.read(2) == b"P5":
            return grey_map_image(path.read_bytes(), str(path))
    return _through_pillow(path, upright)


_SPACE = rb"(?:\s|#[^\n]*\n)+"
_GREY_MAP = re.compile(rb"P5" + _SPACE + rb"(\d{1,7})" + _SPACE + rb"(\d{1,7})" + _SPACE + rb"(\d{1,5})\s")
"""Header of a binary PGM file: columns, rows and largest count, between spaces and comments."""


def grey_map_image(content: bytes, name: str) -> Image:
    """Return the counts (rows, columns), uint8 or uint16, in the bytes of a binary PGM file (Netpbm, P5).

    Raises UsageError, with the file's `name` in its message, for a damaged file.
    """
    found = _GREY_MAP.match(content)
    columns, rows, largest = (int(number) for number in found.groups()) if found else (0, 0, 0)
    if found is None or not (columns and rows and 0 < largest < 1 << 16):
        raise UsageError(f"{name}: is damaged: its PGM header has no columns, rows and largest count")
    kind = np.dtype("u1") if largest < 256 else np.dtype(">u2")
    if len(content) - found.end() < columns * rows * kind.itemsize:
        raise UsageError(f"{name}: ends before the last of {columns} x {rows} pixels: it was cut short")
    pixels = np.frombuffer(content, kind, columns * rows, found.end())
    return pixels.reshape(rows, columns).astype(kind.newbyteorder("="))


def read_raw(path: Path, columns: int, rows: int, bits: int, header: int | None = 0) -> Image:
    """Return the image (rows, columns) of a file of raw pixels, of 8 bits or of 16 bits little-endian.

    The pixels are stored row by row after `header` bytes, up to the end of the file. If `header` is None,
    the number of bytes before the pixels is arbitrary. Raises UsageError if the file is missing or has
    another size.
    """
    kind = np.dtype("<u2") if bits == 16 else np.dtype("u1")
    try:
        content = path.read_bytes()
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {reason_of(error)}") from error
    wanted = columns * rows * kind.itemsize
    extra = len(content) - wanted
    if extra < 0 or header not in (None, extra):
        text = f"{path}: has {len(content)} bytes, but {columns} x {rows} pixels of {bits} bits need {wanted}"
        text += f" after a header of {header}" if header else ""
        shape = f"{columns}x{rows}x{bits}+{extra}"
        raise UsageError(
            f"{text}; if the file has a header of {extra}, state it: {shape}" if extra > 0 else text
        )
    pixels = np.frombuffer(content, kind, columns * rows, len(content) - wanted)
    return pixels.reshape(rows, columns).astype(kind.newbyteorder("="))


def grey_stretch(image: Image, low: float = 1.0, high: float = 99.7) -> npt.NDArray[np.uint8]:
    """Return a contrast-stretched image as RGB (rows, columns, 3), so that coloured marks can be drawn on it.

    The `low`th percentile of the pixels becomes black and the `high`th percentile becomes white. Raises
    UsageError unless 0 <= low < high <= 100.
    """
    if not 0.0 <= low < high <= 100.0:
        raise UsageError(f"percentiles {low} and {high}: give 0 <= low < high <= 100")
    black, white = np.percentile(image, [low, high])
    scale = 255.0 / (white - black) if white > black else 0.0
    grey = np.clip((np.asarray(image, dtype=float) - black) * scale, 0.0, 255.0)
    return np.repeat(np.rint(grey).astype(np.uint8)[..., None], 3, axis=-1)


_EXIF_FOLDER, _EXPOSURE_TIME = 0x8769, 0x829A
"""Numbers of the EXIF tags Exif IFD Pointer and ExposureTime (s) (EXIF 2.3, section 4.6)."""


def stated_exposure(path: Path) -> float | None:
    """Return the exposure time (s) in the metadata of an image file, or None.

    The exposure time is read from EXPTIME or EXPOSURE of a FITS file, from the metadata of a frame that a
    flight kept (`keep_frame`), or from ExposureTime in the EXIF data of other files. Raises UsageError if a
    FITS file cannot be read.
    """
    value: Any = None
    # Damaged metadata are ignored; `read_image` reports damaged files.
    with suppress(ImportError, OSError, SyntaxError, ValueError, TypeError, LookupError, ArithmeticError):
        kept = path.read_bytes() if path.suffix.lower() == ".pgm" else b""
        if kept.startswith(b"P5\n# {"):
            value = facts_of(kept).get("exposure_s")
        elif content := _fits_content(path):
            header = _first_image(content, str(path))[0]
            stated = next((header[key] for key in ("EXPTIME", "EXPOSURE") if key in header), None)
            # FITS allows a D before the exponent of a double.
            value = None if stated is None else stated.replace("D", "E")
        else:
            from PIL import Image as pillow  # noqa: PLC0415 - an extra, and only for files

            with warnings.catch_warnings(action="ignore"), pillow.open(path, formats=FORMATS) as picture:
                value = picture.getexif().get_ifd(_EXIF_FOLDER).get(_EXPOSURE_TIME)
        seconds = math.nan if value is None else float(value)
        return seconds if math.isfinite(seconds) and seconds > 0.0 else None
    return None


def write_picture(
    path: Path, picture: npt.NDArray[np.uint8] | npt.NDArray[np.uint16], exposure: float | None = None
) -> None:
    """Write a PNG file from an RGB image (rows, columns, 3) or a grey image (rows, columns) of 8 or 16 bits.

    An `exposure` time (s) is written as EXIF data, from which `stated_exposure` reads it. Raises UsageError
    if the file cannot be written.
    """
    try:
        from PIL import Image as pillow  # noqa: PLC0415 - an extra, and only for files
    except ImportError as error:
        raise UsageError(f"{path}: a PNG needs Pillow: {EXTRA}") from error
    try:
        metadata = pillow.Exif()
        if exposure is not None:
            metadata[_EXIF_FOLDER] = {_EXPOSURE_TIME: exposure}
        # Noise cannot be compressed: a higher level takes five times as long, for files 3 % smaller.
        pillow.fromarray(picture).save(path, format="PNG", compress_level=1, exif=metadata)
    except OSError as error:
        raise UsageError(f"{path}: cannot be written: {reason_of(error)}") from error


def _through_pillow(path: Path, upright: bool) -> Image:
    try:
        from PIL import Image as pillow  # noqa: PLC0415
        from PIL import UnidentifiedImageError  # noqa: PLC0415
    except ImportError as error:
        raise UsageError(f"{path}: {', '.join(FORMATS)} need Pillow: {EXTRA}") from error
    try:
        # Pillow's warnings concern metadata, which is not used; damaged pixels raise an exception.
        with warnings.catch_warnings(action="ignore"), pillow.open(path, formats=FORMATS) as picture:
            _check_kept(path, picture)
            if _is_deep(picture):
                high = _colours(picture)
                with pillow.open(path, formats=FORMATS) as again:
                    again.tile = [tile._replace(args=_low_bytes(tile.args)) for tile in again.tile]
                    luminance = np.rint((256.0 * high + _colours(again)) @ LUMINANCE)
                    return _upright(luminance.astype(np.uint16), picture, upright)
            picture.load()
            return _upright(_grey(path, picture), picture, upright)
    except UnidentifiedImageError as error:
        raise UsageError(f"{path}: is not a {', '.join(FORMATS)}, PGM or FITS image: convert it") from error
    except pillow.DecompressionBombError as error:
        raise UsageError(f"{path}: has too many pixels: {error}") from error
    # Pillow raises exceptions of many types for damaged files.
    except (OSError, SyntaxError, ValueError, TypeError, LookupError, ArithmeticError, struct.error) as error:
        raise UsageError(f"{path}: is damaged: {error}") from error


_ON_SIDE = (5, 6, 7, 8)
"""Values of the EXIF tag Orientation for which the stored rows are columns of the displayed image."""
_ORIENTATION = 0x0112
"""Number of the tag Orientation (EXIF 2.3, TIFF 6.0), which states on which sides row and column 0 lie."""


def _upright(image: Image, picture: Picture, upright: bool) -> Image:
    """Return an image (rows, columns) rotated and mirrored according to the EXIF data of its file.

    The image of a JPEG, PNG or BMP file is returned as it is stored if `upright` is false.
    """
    orientation: object = 1
    if not upright:
        return image
    # Pillow itself rotates TIFF images by 180 deg or mirrors them. Damaged metadata are ignored.
    with suppress(OSError, SyntaxError, ValueError, TypeError, LookupError, struct.error):
        orientation = picture.getexif().get(_ORIENTATION, 1)
    if orientation not in range(1, 9):
        return image
    if orientation in _ON_SIDE:
        image = image.T
    if orientation in (3, 4, 7, 8):
        image = image[::-1]
    if orientation in (2, 3, 6, 7):
        image = image[:, ::-1]
    return np.ascontiguousarray(image)


def _check_kept(path: Path, picture: Picture) -> None:
    """Raise UsageError for images that Pillow misreads.

    Pillow truncates 16-bit colour, ignores the TIFF value WhiteIsZero, and reorders the rows incorrectly in
    TIFF images that are stored rotated by 90 deg.
    """
    deep = any(";16" in _raw_mode(tile[3]) for tile in getattr(picture, "tile", ()))
    if picture.mode in COLOUR_MODES and deep and not _is_deep(picture):
        raise UsageError(f"{path}: 16-bit colour of this kind is not supported: convert it to 16-bit grey")
    tags = getattr(picture, "tag_v2", {})
    orientation, interpretation = tags.get(_ORIENTATION), tags.get(PHOTOMETRIC_INTERPRETATION)
    if orientation in _ON_SIDE:
        raise UsageError(f"{path}: this TIFF is on its side (Orientation = {orientation}): save it upright")
    if picture.mode.startswith("I") and interpretation == WHITE_IS_ZERO:
        raise UsageError(f"{path}: in this TIFF zero is white: convert it to a TIFF in which zero is black")


def _raw_mode(args: object) -> str:
    """Return the raw mode of an image tile: the first argument in `args`, those of its Pillow decoder."""
    return str(args[0]) if isinstance(args, tuple) and args else str(args)


def _is_deep(picture: Picture) -> bool:
    """Return whether an image has 16-bit colour values, of which Pillow keeps only the high bytes."""
    modes = {_raw_mode(tile[3]) for tile in getattr(picture, "tile", ())}
    return len(modes) == 1 and modes <= _OTHER_BYTES.keys()


def _low_bytes(args: Any) -> Any:
    """Return the arguments of a Pillow decoder with swapped byte order, so that it keeps the low bytes."""
    other = _OTHER_BYTES[_raw_mode(args)]
    return (other, *args[1:]) if isinstance(args, tuple) else other


def _colours(picture: Picture) -> npt.NDArray[np.float64]:
    return np.asarray(picture.convert("RGB"), dtype=np.float64)


def _grey(path: Path, picture: Picture) -> Image:
    mode = picture.mode
    if mode in COLOUR_MODES:
        # Pillow converts some colour modes to grey only through RGB, which drops transparency.
        return np.asarray(picture.convert("RGB").convert("L"))
    if mode in GREY_MODES:
        grey = picture.convert("L") if mode == "1" else picture
        return np.asarray(grey).astype(GREY_MODES[mode])
    if mode == "I":
        # Pixels of Pillow mode I are 32-bit integers, but their values often fit into 16 bits.
        pixels = np.asarray(picture)
        if pixels.min() >= 0 and pixels.max() <= np.iinfo(np.uint16).max:
            return pixels.astype(np.uint16)
    raise UsageError(f"{path}: has pixels of kind {mode!r}: convert it to 8 or 16 bit grey")


KEPT_FRAMES_FOLDER = "frames"
"""Name of the folder of kept frames inside the output folder of a flight."""


@dataclass(frozen=True, slots=True)
class KeptFrames:
    """Folder and maximum number of the frames that the vision worker keeps on disk.

    The attribute `name` is the file name of the next frame, without suffix.
    """

    folder: Path
    most: int
    name: str = ""


def keep_frame(kept: KeptFrames, pixels: Image, facts: dict[str, Any]) -> None:
    """Write a frame (rows, columns) with its metadata (`facts`) to disk.

    If there are more kept frames than the maximum, the oldest frames are deleted. If the frame cannot be
    written, it is lost and no exception is raised.
    """
    with suppress(OSError):
        kept.folder.mkdir(exist_ok=True)
        beside = kept.folder / "frame~"
        beside.write_bytes(portable_grey_map(pixels, facts))
        beside.replace(kept.folder / f"{kept.name}.pgm")
        for old in sorted(kept.folder.glob("*.pgm"))[: -kept.most]:
            old.unlink()


def portable_grey_map(pixels: Image, facts: dict[str, Any]) -> bytes:
    """Return the bytes of a PGM file with 8-bit or 16-bit counts and the metadata `facts` as a comment."""
    deep = pixels.dtype.itemsize > 1
    rows, columns = pixels.shape
    text = json.dumps(facts)
    head = f"P5\n# {text}\n{columns} {rows}\n{65535 if deep else 255}\n"
    return head.encode("ascii") + pixels.astype(np.dtype(">u2") if deep else np.uint8).tobytes()


def facts_of(data: bytes) -> dict[str, Any]:
    """Return the metadata that the bytes of a kept frame contain.

    Raises ValueError if `data` is not a kept frame.
    """
    head, _, rest = data.partition(b"\n# ")
    if head != b"P5":
        raise ValueError("no kept frame")
    facts: dict[str, Any] = json.loads(rest.partition(b"\n")[0])
    return facts
