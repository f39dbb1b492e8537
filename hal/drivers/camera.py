"""Camera service that operates a slow camera in parallel with the control loop, and pixel formats.

Triggering, reading, configuring and reopening a camera can each take milliseconds to seconds. An unanswered
USB control transfer takes five seconds. A periodic job executes all slow camera operations. The methods
`trigger` and `poll`, which the control loop calls, only pass requests to the job and take frames from it.

`PixelCoding` converts the pixel formats of V4L2 cameras, named as in kernel drivers and libcamera, to grey
images. The layouts of the pixel formats are those of the kernel's documentation (Linux Media userspace API,
chapter "Image Formats"). The MIPI formats pack four pixels of 10 bits into five bytes, or two pixels of 12
bits into three bytes. The last byte of such a group of pixels contains the low bits of its pixels, with the
first pixel in the lowest bits.

A Bayer mosaic is convolved with the kernel (1, 2, 1) / 4 along rows and columns. After the convolution of the
mosaic, red, green and blue contribute a quarter, a half and a quarter to each pixel, at every position in the
mosaic. All four colour orders of a mosaic therefore give the same grey image, and the centroid of a star is
not displaced. Motion JPEG is decoded by Pillow, and its luma is used.
"""

from __future__ import annotations

import io
import threading
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
import numpy.typing as npt

from hal.interfaces.devices import Frame
from hal.interfaces.errors import DeviceError, NotResponding, Refused
from hal.interfaces.wires import Clock

PERIOD_NS = 10_000_000
RETRY_NS = 1_000_000_000
PATIENCE_NS = 3_000_000_000
_MOST_EXPOSURES = 6
_FAILURES = DeviceError, OSError, RuntimeError, ValueError
"""Exceptions after which a camera is reopened; only a driver of another team raises the last three."""


@dataclass(slots=True)
class CameraCounts:
    """Counts of camera frames by outcome since start, which never decrease.

    Attributes:
        delivered: number of frames returned by `poll` or ready to be returned.
        spoiled: number of frames that the device flagged as damaged.
        short: number of incomplete frames.
        absurd: number of frames with an impossible time stamp.
        contradictory: number of frames that arrived sooner after the previous frame than the exposure time
            allows.
        missed: number of frames that never arrived, counted from gaps in the frame numbers.
        openings: number of times the camera was opened.
    """

    delivered: int = 0
    spoiled: int = 0
    short: int = 0
    absurd: int = 0
    contradictory: int = 0
    missed: int = 0
    openings: int = 0


class CameraDevice(Protocol):
    """Interface of a camera driver.

    The method `check` may be called at any time; the other methods are called by one thread at a time.
    """

    name: str
    counts: CameraCounts

    def open(self) -> None:
        """Open and configure the camera. Raises DeviceError with advice for the user."""

    def check(self, exposure_ns: int) -> None:
        """Raise OutOfRange for an exposure time (ns) that the camera does not support."""

    def expose(self, exposure_ns: int, trigger_ns: int) -> None:
        """Start an exposure, or select the first exposure after the trigger time. Raises DeviceError."""

    def collect(self) -> Frame | None:
        """Return the frame of the started exposure once, or None until the frame arrives.

        Never blocks. Raises DeviceError.
        """

    def close(self) -> None:
        """Close the camera. The call has no effect if the camera is not open."""


class ServedCamera:
    """Camera operated by a periodic job, which also reopens a lost camera.

    The class implements `hal.interfaces.devices.FrameSource`, and counts the frames by outcome.
    """

    def __init__(self, device: CameraDevice, clock: Clock, patient: bool = False) -> None:
        """Open the camera and start the periodic job.

        Raises DeviceError if the camera cannot be opened. If `patient` is true, a camera that cannot be
        opened counts as lost, and is opened later.

        The camera is reopened if no frame arrives within `PATIENCE_NS` plus six exposure times after the
        first unanswered trigger. A free-running camera may need several exposures until a new exposure time
        is effective.
        """
        self.name = device.name
        self.counts = device.counts
        self._device, self._clock = device, clock
        self._lock = threading.Lock()
        self._asked: tuple[int, int] | None = None  # pending request: exposure and trigger time (ns)
        self._frame: Frame | None = None
        self._failure: DeviceError | None = None
        self._deadline_ns: int | None = None
        self._open = False
        self._retry_ns = clock.now_ns()
        self._closed = False
        try:
            self._open_device()
        except _FAILURES as error:
            if not patient:
                raise
            self._drop(error)
        self._ticker = clock.ticker(f"camera {device.name}", PERIOD_NS, self._serve)

    def trigger(self, exposure_ns: int) -> None:
        """Start one exposure, which replaces an exposure in progress. Raises NotResponding or OutOfRange."""
        self._device.check(exposure_ns)
        with self._lock:
            self._raise_failure()
            self._asked = exposure_ns, self._clock.now_ns()
        self._ticker.kick()

    def poll(self) -> Frame | None:
        """Return the newest finished frame once, or None. Raises DeviceError while the camera is lost."""
        with self._lock:
            frame, self._frame = self._frame, None
            if frame is None:
                self._raise_failure()
            return frame

    def close(self) -> None:
        """Close the camera. Calling `close` again has no effect."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            self._failure = NotResponding(self.name, "the camera was closed")
        self._ticker.stop()
        self._device.close()

    def _raise_failure(self) -> None:
        if self._failure is not None:
            # A new exception is created, because raising the same exception again would extend its traceback.
            raise type(self._failure)(self._failure.device, self._failure.message)

    def _serve(self) -> None:
        """Pass requests to the camera device and take frames from it. The clock calls this periodically."""
        if not self._open and not self._reopened():
            return
        with self._lock:
            asked, self._asked = self._asked, None
        try:
            if asked is not None:
                exposure_ns, trigger_ns = asked
                if self._deadline_ns is None:
                    self._deadline_ns = trigger_ns + _MOST_EXPOSURES * exposure_ns + PATIENCE_NS
                self._device.expose(exposure_ns, trigger_ns)
            frame = self._device.collect()
            if frame is None and self._deadline_ns is not None and self._clock.now_ns() > self._deadline_ns:
                problem = "no frame arrived after the trigger: check the camera and its cable"
                raise NotResponding(self.name, problem)
        except _FAILURES as error:
            self._drop(error)
            return
        if frame is not None:
            self._deadline_ns = None
            with self._lock:
                if self._asked is None:  # if there is a newer request, the frame is obsolete
                    self._frame = frame
                    self.counts.delivered += 1

    def _reopened(self) -> bool:
        """Try to open the camera if a retry is due, and return whether the camera was opened."""
        now_ns = self._clock.now_ns()
        if now_ns < self._retry_ns or self._closed:
            return False
        self._retry_ns = now_ns + RETRY_NS
        try:
            self._open_device()
        except _FAILURES as error:
            self._drop(error)
            return False
        with self._lock:
            self._failure = None
        return True

    def _open_device(self) -> None:
        try:
            self._device.open()
        except _FAILURES:
            self._device.close()
            raise
        self.counts.openings += 1
        self._open = True

    def _drop(self, error: Exception) -> None:
        """Close a failing camera and discard the pending request."""
        self._open = False
        self._deadline_ns = None
        self._retry_ns = self._clock.now_ns() + RETRY_NS
        kind = Refused if isinstance(error, Refused) else NotResponding
        device, text = self.name, f"{type(error).__name__}: {error}"
        if isinstance(error, DeviceError):
            device, text = error.device, error.message
        with self._lock:
            self._asked = None
            if not self._closed:
                self._failure = kind(device, text)
        self._device.close()


class FrameNumbers:
    """Converter of a camera's frame numbers to numbers that keep increasing after a wrap-around or restart.

    Repeated numbers and small backward steps are preserved, so that a frozen camera can be detected.
    """

    def __init__(self, modulus: int) -> None:
        """Assume frame numbers modulo `modulus`, which is one more than the camera's highest frame number."""
        self._modulus = modulus
        self._last = -1
        self._offset = 0

    def begin_again(self) -> None:
        """Continue from the last number, because the camera was reopened and counts from zero again."""
        self._offset = self._last + 1

    def number(self, count: int) -> int:
        """Return the increasing frame number that corresponds to the camera's frame number `count`."""
        number = count + self._offset
        if number < self._last - self._modulus // 2:
            self._offset += self._modulus
            number += self._modulus
        self._last = max(self._last, number)
        return number


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
        """Return the grey image (rows, columns), of uint8 or uint16, in the bytes `data` (n,) of a frame.

        The starts of two rows are `stride` bytes apart. Raises PixelError if the data are damaged or are an
        image of a different size.
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
    """Return the grey image of a Bayer mosaic, with the numpy type of the mosaic.

    The edges are extended by reflection.
    """
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
