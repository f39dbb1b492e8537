"""Driver of free-running cameras (Video for Linux 2) with manual exposure.

A free-running camera has no trigger. The camera exposes frames continuously, and the kernel stamps each frame
with the monotonic time. A trigger selects the first frame whose exposure begins after the trigger. The driver
returns the buffers of earlier frames to the kernel without reading their pixels.

A flag of the kernel driver states whether the time stamp refers to the start of exposure (SOE) or to the end
of the frame. The kernel driver uvcvideo always sets the flag SOE. Unless the module parameter `hwtimestamps`
is set, however, uvcvideo stamps the arrival of the first packet of a frame (uvc_video_decode_start), which is
after the end of the exposure. The setting `stamp` can override the meaning that this flag states.

`VideoDevice` executes the system calls. A failed system call raises OSError with the kernel's errno. The
device is opened in non-blocking mode, so that no call waits for a frame. The structures and request numbers
are those of linux/videodev2.h (Linux Media Infrastructure userspace API, part "Video for Linux"). A request
number contains the size of its structure, which ctypes computes for the present platform.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import importlib.util
import mmap
import os
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from fcntl import ioctl
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hal.drivers.camera import (
    PIXEL_FORMATS,
    CameraCounts,
    FrameNumbers,
    PixelCoding,
    PixelError,
    fourcc,
    fourcc_name,
)
from hal.interfaces.devices import Frame
from hal.interfaces.errors import CorruptData, DeviceError, NotResponding, OutOfRange, Refused
from hal.interfaces.wires import Clock

VIDEO_CAPTURE = 1
MMAP = 1
FIELD_NONE = 1

CAP_VIDEO_CAPTURE = 0x0000_0001
CAP_STREAMING = 0x0400_0000
CAP_DEVICE_CAPS = 0x8000_0000
CAP_TIME_PER_FRAME = 0x1000

FLAG_ERROR = 0x0000_0040
STAMP_MASK, STAMP_MONOTONIC = 0x0000_E000, 0x0000_2000
STAMP_SOURCE_MASK, STAMP_START_OF_EXPOSURE = 0x0007_0000, 0x0001_0000

CONTROL_DISABLED = 0x0001
AUTO_GAIN = 0x0098_0912
GAIN = 0x0098_0913
ANALOGUE_GAIN = 0x009E_0903
EXPOSURE_AUTO, EXPOSURE_MANUAL = 0x009A_0901, 1
EXPOSURE_ABSOLUTE, EXPOSURE_UNIT_NS = 0x009A_0902, 100_000


_KINDS: dict[str, Any] = {
    "I": ctypes.c_uint32, "i": ctypes.c_int32, "B": ctypes.c_uint8, "c": ctypes.c_char, "l": ctypes.c_long
}  # fmt: skip


def _fields(layout: str) -> list[tuple[str, Any]]:
    """Return ctypes fields: `name` is a c_uint32, and `name:16c` an array of 16 chars (kinds in `_KINDS`)."""
    fields: list[tuple[str, Any]] = []
    for word in layout.split():
        name, _, kind = word.partition(":")
        basic = _KINDS[kind[-1:] or "I"]
        fields.append((name, basic * int(kind[:-1]) if kind[:-1] else basic))
    return fields


class Capability(ctypes.Structure):
    """Structure v4l2_capability of the kernel."""

    _fields_ = _fields("driver:16c card:32c bus_info:32c version capabilities device_caps reserved:3I")


class FormatDescription(ctypes.Structure):
    """Structure v4l2_fmtdesc of the kernel."""

    _fields_ = _fields("index type flags description:32c pixelformat mbus_code reserved:3I")


class PixelFormat(ctypes.Structure):
    """Structure v4l2_pix_format of the kernel."""

    _fields_ = _fields(
        "width height pixelformat field bytesperline sizeimage colorspace priv flags encoding quantization"
        " transfer"
    )


class _FormatUnion(ctypes.Union):
    # The kernel's union also contains a structure with pointers, which determines the alignment.
    _fields_ = (("pix", PixelFormat), ("raw_data", ctypes.c_uint8 * 200), ("pointer", ctypes.c_void_p))


class Format(ctypes.Structure):
    """Structure v4l2_format of the kernel."""

    _fields_ = (("type", ctypes.c_uint32), ("fmt", _FormatUnion))


class RequestBuffers(ctypes.Structure):
    """Structure v4l2_requestbuffers of the kernel."""

    _fields_ = _fields("count type memory capabilities flags:B reserved:3B")


class TimeValue(ctypes.Structure):
    """Structure timeval of the kernel."""

    _fields_ = _fields("seconds:l microseconds:l")


class _TimeCode(ctypes.Structure):
    _fields_ = _fields("type flags frames:B seconds:B minutes:B hours:B userbits:4B")


class _BufferUnion(ctypes.Union):
    _fields_ = (("offset", ctypes.c_uint32), ("userptr", ctypes.c_ulong))


class Buffer(ctypes.Structure):
    """Structure v4l2_buffer of the kernel."""

    _fields_ = (
        *_fields("index type bytesused flags field"),
        ("timestamp", TimeValue),
        ("timecode", _TimeCode),
        *_fields("sequence memory"),
        ("m", _BufferUnion),
        *_fields("length reserved2 request_fd:i"),
    )


class Fraction(ctypes.Structure):
    """Structure v4l2_fract of the kernel."""

    _fields_ = _fields("numerator denominator")


class StreamParameters(ctypes.Structure):
    """Structure v4l2_streamparm of the kernel, for video capture."""

    _fields_ = (
        *_fields("type capability capturemode"),
        ("timeperframe", Fraction),
        *_fields("extendedmode readbuffers reserved:176B"),
    )


class ControlValue(ctypes.Structure):
    """Structure v4l2_control of the kernel."""

    _fields_ = _fields("id value:i")


class QueryControl(ctypes.Structure):
    """Structure v4l2_queryctrl of the kernel."""

    _fields_ = _fields("id type name:32c minimum:i maximum:i step:i default_value:i flags reserved:2I")


def _request(direction: int, number: int, structure: type[ctypes.Structure] | type[ctypes.c_int]) -> int:
    """Return an ioctl request number (asm-generic/ioctl.h) with direction 1 (write), 2 (read) or 3 (both)."""
    return direction << 30 | ctypes.sizeof(structure) << 16 | ord("V") << 8 | number


QUERYCAP = _request(2, 0, Capability)
ENUM_FMT = _request(3, 2, FormatDescription)
S_FMT = _request(3, 5, Format)
REQBUFS = _request(3, 8, RequestBuffers)
QUERYBUF = _request(3, 9, Buffer)
QBUF = _request(3, 15, Buffer)
DQBUF = _request(3, 17, Buffer)
STREAMON = _request(1, 18, ctypes.c_int)
STREAMOFF = _request(1, 19, ctypes.c_int)
G_PARM = _request(3, 21, StreamParameters)
S_PARM = _request(3, 22, StreamParameters)
G_CTRL = _request(3, 27, ControlValue)
S_CTRL = _request(3, 28, ControlValue)
QUERYCTRL = _request(3, 36, QueryControl)


_MICROSECOND_NS = 1_000
_SECOND_NS = 1_000_000_000
_MOST_FORMATS = 64
# Frame intervals that are requested in turn, as multiples of half the wanted interval.
_INTERVAL_FACTORS = (2, 3, 4, 8)
# Tolerance of the frame interval, relative to the exposure time.
_INTERVAL_SLACK = 0.05


@dataclass(frozen=True, slots=True)
class PixelLayout:
    """Image size (pixels), four-character pixel format, and bytes between the starts of two rows."""

    columns: int
    rows: int
    fourcc: str
    stride: int


@dataclass(frozen=True, slots=True)
class Filled:
    """Buffer with a received frame: index, used bytes, time stamp, sequence number and flags."""

    index: int
    used_bytes: int
    stamp_ns: int
    sequence: int
    flags: int


class VideoDevice:
    """An opened video device /dev/videoN and its frame buffers."""

    def __init__(self, path: str) -> None:
        """Open the device. Raises OSError."""
        self._descriptor = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        self._maps: list[mmap.mmap] = []
        self._streaming = False

    def capability(self) -> tuple[str, str, int]:
        """Return the driver name, the camera name and the capability bits of the device."""
        answer = Capability()
        self._ask(QUERYCAP, answer)
        own = answer.device_caps if answer.capabilities & CAP_DEVICE_CAPS else answer.capabilities
        return _text(answer.driver), _text(answer.card), own

    def formats(self) -> Iterator[str]:
        """Yield the names of the pixel formats that the device offers."""
        for index in range(_MOST_FORMATS):
            answer = FormatDescription(index=index, type=VIDEO_CAPTURE)
            try:
                self._ask(ENUM_FMT, answer)
            except OSError as error:
                if error.errno == errno.EINVAL:
                    return
                raise
            yield fourcc_name(answer.pixelformat)

    def set_format(self, columns: int, rows: int, name: str) -> PixelLayout:
        """Request an image format and return the format that the device has chosen, which may differ."""
        answer = Format(type=VIDEO_CAPTURE)
        pix = answer.fmt.pix
        pix.width, pix.height, pix.pixelformat, pix.field = columns, rows, fourcc(name), FIELD_NONE
        self._ask(S_FMT, answer)
        return PixelLayout(pix.width, pix.height, fourcc_name(pix.pixelformat), pix.bytesperline)

    def set_interval(self, interval_ns: int) -> None:
        """Request a frame interval (ns) or a longer one, if the device supports frame intervals.

        The kernel chooses the nearest interval that the device has. If this interval is too short, longer
        intervals are requested.
        """
        answer = StreamParameters(type=VIDEO_CAPTURE)
        try:
            self._ask(G_PARM, answer)
            for factor in _INTERVAL_FACTORS if answer.capability & CAP_TIME_PER_FRAME else ():
                answer.timeperframe = Fraction(-(-factor * interval_ns // (2 * _MICROSECOND_NS)), 1_000_000)
                self._ask(S_PARM, answer)
                given = answer.timeperframe
                if given.numerator * _SECOND_NS >= (1.0 - _INTERVAL_SLACK) * interval_ns * given.denominator:
                    return
        except OSError as error:
            if error.errno not in {errno.ENOTTY, errno.EINVAL}:
                raise

    def control_range(self, control: int) -> tuple[int, int] | None:
        """Return the minimum and maximum of a control, or None if the device does not have the control."""
        answer = QueryControl(id=control)
        try:
            self._ask(QUERYCTRL, answer)
        except OSError as error:
            if error.errno in {errno.EINVAL, errno.ENOTTY}:
                return None
            raise
        return None if answer.flags & CONTROL_DISABLED else (answer.minimum, answer.maximum)

    def set_control(self, control: int, value: int) -> int:
        """Set a control and return the resulting value of the control."""
        answer = ControlValue(control, value)
        self._ask(S_CTRL, answer)
        self._ask(G_CTRL, answer)
        return int(answer.value)

    def start(self, count: int) -> int:
        """Map and queue `count` buffers and start streaming.

        Return the number of buffers granted by the device.
        """
        request = RequestBuffers(count=count, type=VIDEO_CAPTURE, memory=MMAP)
        self._ask(REQBUFS, request)
        for index in range(request.count):
            buffer = _numbered(index)
            self._ask(QUERYBUF, buffer)
            self._maps.append(mmap.mmap(self._descriptor, buffer.length, offset=buffer.m.offset))
            self.queue(index)
        self._ask(STREAMON, ctypes.c_int(VIDEO_CAPTURE))
        self._streaming = True
        return int(request.count)

    def dequeue(self) -> Filled | None:
        """Return the oldest filled buffer, or None if no buffer is filled.

        The caller must return the buffer by `queue`.
        """
        buffer = _numbered(0)
        try:
            self._ask(DQBUF, buffer)
        except BlockingIOError:
            return None
        stamp = buffer.timestamp
        stamp_ns = stamp.seconds * _SECOND_NS + stamp.microseconds * _MICROSECOND_NS
        return Filled(buffer.index, buffer.bytesused, stamp_ns, buffer.sequence, buffer.flags)

    def queue(self, index: int) -> None:
        """Return a buffer to the kernel, so that it can be filled again."""
        self._ask(QBUF, _numbered(index))

    def data(self, index: int, used_bytes: int) -> npt.NDArray[np.uint8]:
        """Return a copy (n,) of the used bytes in a buffer."""
        return np.frombuffer(self._maps[index], np.uint8, used_bytes).copy()

    def close(self) -> None:
        """Stop streaming and close the device. Calling `close` again has no effect."""
        if self._descriptor < 0:
            return
        if self._streaming:
            self._streaming = False
            with contextlib.suppress(OSError):  # stopping a lost camera raises an error
                self._ask(STREAMOFF, ctypes.c_int(VIDEO_CAPTURE))
        for memory in self._maps:
            memory.close()
        self._maps.clear()
        descriptor, self._descriptor = self._descriptor, -1
        os.close(descriptor)

    def _ask(self, request: int, argument: ctypes.Structure | ctypes.c_int) -> None:
        # No retry for EINTR is needed, because these calls do not wait.
        ioctl(self._descriptor, request, argument)


def _text(name: bytes) -> str:
    """Return a device name as text. A long name may be truncated within a UTF-8 character."""
    return name.decode("utf-8", "replace")


def _numbered(index: int) -> Buffer:
    return Buffer(index=index, type=VIDEO_CAPTURE, memory=MMAP)


class Stamp(Enum):
    """Meaning of the kernel's time stamp: as flagged by the driver, start of exposure, or end of exposure."""

    TOLD = "told"
    START = "start"
    END = "end"


@dataclass(frozen=True, slots=True)
class V4l2Settings:
    """Settings of a V4L2 camera.

    Attributes:
        path: path of the device, such as /dev/knightcube-camera.
        columns, rows: size of the image, pixels.
        pixel_format: name of a pixel format in PIXEL_FORMATS.
        exposure_ns: usual exposure time, ns; the frame interval is set to this value or longer.
        gain: gain in the camera's own units, or None to leave the gain unchanged.
        stamp: meaning of the time stamps.
        stamp_delay_ns: delay of the time stamp after the start or end of exposure, ns.
        settling: number of frames that may still have the old exposure time after a change.
        buffers: number of frame buffers of the kernel.
    """

    path: str
    columns: int
    rows: int
    pixel_format: str
    exposure_ns: int
    gain: int | None
    stamp: Stamp
    stamp_delay_ns: int
    settling: int = 2
    buffers: int = 4

    @property
    def pixels(self) -> PixelCoding:
        """Layout of the pixels."""
        return PIXEL_FORMATS[self.pixel_format]


UVC_STAMPS = Path("/sys/module/uvcvideo/parameters/hwtimestamps")

# A time stamp can be slightly in the future, because the kernel estimates the offset of the camera's clock.
_STAMP_AHEAD_NS = 10_000_000
_CONTRADICTIONS = 3
# Number of consecutive impossible time stamps after which the camera is reopened.
_ABSURD = 8


class ExposureTiming:
    """Computation of exposure start times, and detection of exposures that are shorter than reported."""

    def __init__(self, settings: V4l2Settings, clock: Clock, counts: CameraCounts) -> None:
        """Use the camera's settings and clock; `counts` counts the frames that contradict the settings."""
        self._name = settings.path
        self._settings, self._clock, self._counts = settings, clock, counts
        self._arrival_stamps = False
        self._contradictions = 0
        self._absurd = 0  # number of consecutive frames with an impossible time stamp
        self._stamp_ns = 0  # last valid time stamp

    def begin(self, driver: str) -> None:
        """Reset the detection for a newly opened camera, given the name of its kernel driver."""
        uses_device_clock = False  # default of the kernel
        with contextlib.suppress(OSError):
            uses_device_clock = UVC_STAMPS.read_text(encoding="ascii").strip() not in {"0", "N"}
        self._arrival_stamps = driver == "uvcvideo" and not uses_device_clock
        self._contradictions = self._absurd = self._stamp_ns = 0

    def start_of(self, filled: Filled, exposure_ns: int) -> int | None:
        """Return the host time (ns) of the start of a frame's exposure, or None for an impossible time stamp.

        A time stamp in the future, or earlier than that of the previous frame, is impossible. Raises
        CorruptData after several consecutive impossible time stamps, and for time stamps of a different
        clock.
        """
        if filled.flags & STAMP_MASK != STAMP_MONOTONIC:
            raise CorruptData(self._name, "the time stamps of its frames are not from the monotonic clock")
        ahead_ns = filled.stamp_ns - self._clock.now_ns()
        if ahead_ns > _STAMP_AHEAD_NS or filled.stamp_ns < self._stamp_ns:
            self._counts.absurd += 1
            self._absurd += 1
            if self._absurd >= _ABSURD:
                # The reset allows the camera to be opened again after its clock has stepped back.
                self._absurd = self._stamp_ns = 0
                raise CorruptData(
                    self._name,
                    f"{_ABSURD} frames in a row have impossible time stamps, the last one "
                    f"{ahead_ns * 1e-9:.3f} s ahead of the monotonic clock: has uvcvideo been "
                    "loaded with clock=CLOCK_REALTIME?",
                )
            return None
        self._absurd, self._stamp_ns = 0, filled.stamp_ns
        flagged_start = filled.flags & STAMP_SOURCE_MASK == STAMP_START_OF_EXPOSURE
        stamp = self._settings.stamp
        at_start = stamp is Stamp.START or (
            stamp is Stamp.TOLD and flagged_start and not self._arrival_stamps
        )
        start_ns = filled.stamp_ns - self._settings.stamp_delay_ns
        return start_ns if at_start else start_ns - exposure_ns

    def contradicts(self, interval_ns: int, exposure_ns: int) -> bool:
        """Return whether the interval between two frames is shorter than the reported exposure time.

        Body rates are computed as streak length divided by exposure time, so a wrong exposure time would make
        all rates wrong. A single short interval can be caused by a late time stamp. Raises Refused after
        several consecutive short intervals.
        """
        if interval_ns >= exposure_ns * (1.0 - _INTERVAL_SLACK):
            self._contradictions = 0
            return False
        self._counts.contradictory += 1
        self._contradictions += 1
        if self._contradictions >= _CONTRADICTIONS:
            raise Refused(
                self._name,
                f"frames arrive every {interval_ns * 1e-6:.1f} ms, which is shorter than the exposure of "
                f"{exposure_ns * 1e-6:.1f} ms that the camera reports: configure a shorter exposure",
            )
        return True


def meaning(name: str, error: OSError, doing: str) -> DeviceError:
    """Return the DeviceError that corresponds to an errno of the kernel."""
    if error.errno in {errno.ENODEV, errno.ENXIO}:
        return NotResponding(name, f"the camera disappeared while {doing}: check its cable")
    if error.errno == errno.EBUSY:
        return Refused(name, f"busy while {doing}: another program uses the camera")
    if error.errno == errno.ENOSPC:
        cure = "connect it to another USB controller, or choose a smaller image or a compressed pixel format"
        return Refused(name, f"the bandwidth of its USB bus is exhausted (while {doing}): {cure}")
    if error.errno == errno.ENOTTY:
        return Refused(name, f"is not a V4L2 device (while {doing})")
    return NotResponding(name, f"failed while {doing}: {os.strerror(error.errno or errno.EIO)}")


def set_format(device: VideoDevice, settings: V4l2Settings, card: str) -> PixelLayout:
    """Set the image format. Raises Refused or CorruptData if the camera does not support the format."""
    name = settings.path
    if settings.pixels.is_compressed and importlib.util.find_spec("PIL") is None:
        raise Refused(name, "Motion JPEG needs Pillow: pip install 'knightcube-flight[images]'")
    layout = device.set_format(settings.columns, settings.rows, settings.pixel_format)
    if layout.fourcc != settings.pixel_format:
        offered = ", ".join(device.formats()) or "none"
        raise Refused(name, f"{card} has no pixel format {settings.pixel_format}; it offers {offered}")
    if (layout.columns, layout.rows) != (settings.columns, settings.rows):
        raise Refused(
            name,
            f"{card} gives {layout.columns} x {layout.rows} pixels, not {settings.columns} x "
            f"{settings.rows}: `v4l2-ctl --list-formats-ext` lists its sizes",
        )
    if layout.stride < settings.pixels.row_bytes(layout.columns):
        raise CorruptData(name, f"{card} reports rows of {layout.stride} bytes for {layout.columns} pixels")
    return layout


_GAIN_STEPS = 16
"""Smallest number of steps of a gain control; a gain that differs by more than a step is refused."""


def set_checked(
    device: VideoDevice, path: str, what: str, control: int, value: int, tolerance: int = 0
) -> None:
    """Set a control. Raises Refused if the resulting value differs by more than the tolerance."""
    actual = device.set_control(control, value)
    if abs(actual - value) > tolerance:
        cure = "`v4l2-ctl --list-ctrls` lists the values of each control and its step"
        raise Refused(path, f"{what} is {actual} after {value} was set: {cure}")


def set_gain(device: VideoDevice, settings: V4l2Settings) -> None:
    """Switch automatic gain control off and set the gain. Raises Refused or OutOfRange."""
    if device.control_range(AUTO_GAIN) is not None:
        set_checked(device, settings.path, "automatic gain", AUTO_GAIN, 0)
    gain = settings.gain
    if gain is None:
        return
    for control in (GAIN, ANALOGUE_GAIN):
        known = device.control_range(control)
        if known is not None:
            if not known[0] <= gain <= known[1]:
                raise OutOfRange(settings.path, "gain", gain, *known, "")
            # Many cameras round a requested gain to their nearest gain step.
            tolerance = max(1, (known[1] - known[0]) // _GAIN_STEPS)
            set_checked(device, settings.path, "gain", control, gain, tolerance)
            return
    raise Refused(settings.path, "has no adjustable gain: omit `gain`")


def manual_exposures(name: str, device: VideoDevice, card: str) -> tuple[int, int]:
    """Switch automatic exposure off and return the range of exposure times.

    Raises Refused if the camera has no control of the exposure time, or keeps its automatic exposure.
    """
    exposures = device.control_range(EXPOSURE_ABSOLUTE)
    if exposures is None:
        raise Refused(name, f"{card} has no exposure control in units of time (exposure_absolute)")
    if device.control_range(EXPOSURE_AUTO) is not None:
        set_checked(device, name, "automatic exposure", EXPOSURE_AUTO, EXPOSURE_MANUAL)
    return exposures


_SEQUENCE_MODULUS = 1 << 32
_EXPOSURE_LIMIT = (1 << 31) - 1
# According to the kernel documentation, EIO of VIDIOC_DQBUF may be caused by a temporary signal loss.
_PASSING_NS = 500_000_000


class V4l2Camera:
    """Driver of a V4L2 camera, which implements `hal.drivers.camera.CameraDevice`.

    The clock must be based on CLOCK_MONOTONIC, like the time stamps of the kernel.
    """

    def __init__(self, settings: V4l2Settings, clock: Clock) -> None:
        """Store the settings without opening the device."""
        self.name = settings.path
        self.counts = CameraCounts()
        self._settings, self._clock = settings, clock
        self._pixels = settings.pixels
        self._timing = ExposureTiming(settings, clock, self.counts)
        self._device: VideoDevice | None = None
        self._layout = PixelLayout(0, 0, "", 0)
        self._exposures = 1, _EXPOSURE_LIMIT
        self._asked_steps = 0
        self._exposure_ns = 0  # exposure time reported by the camera
        self._numbers = FrameNumbers(_SEQUENCE_MODULUS)
        self._before: tuple[int, int | None] | None = None  # number and valid time stamp of the last frame
        self._trigger_ns: int | None = None
        self._changed_ns = 0
        self._to_settle = 0
        self._failing_ns: int | None = None  # time of the first of successive read failures

    def open(self) -> None:
        """Open the device and start streaming. Raises NotResponding, Refused or OutOfRange with advice."""
        self.close()
        try:
            self._device = VideoDevice(self.name)
        except FileNotFoundError as error:
            raise NotResponding(
                self.name,
                "no such camera: is it plugged in, and does a udev rule give it this name "
                "(deploy/99-knightcube.rules)? `v4l2-ctl --list-devices` lists the connected cameras",
            ) from error
        except PermissionError as error:
            raise Refused(self.name, "no permission: add the user to the group video") from error
        except OSError as error:
            raise meaning(self.name, error, "opening it") from error
        try:
            self._set_up(self._device)
        except OSError as error:
            raise meaning(self.name, error, "setting it up") from error

    def check(self, exposure_ns: int) -> None:
        """Raise OutOfRange for an exposure time (ns) that the camera does not support."""
        low, high = self._exposures
        if not low <= round(exposure_ns / EXPOSURE_UNIT_NS) <= high:
            unit = EXPOSURE_UNIT_NS * 1e-9
            raise OutOfRange(self.name, "exposure", exposure_ns * 1e-9, low * unit, high * unit, "s")

    def expose(self, exposure_ns: int, trigger_ns: int) -> None:
        """Select the first exposure that begins after the trigger time. Raises DeviceError."""
        device = self._opened()
        self._trigger_ns = trigger_ns
        try:
            self._set_exposure(device, exposure_ns)
        except OSError as error:
            raise meaning(self.name, error, "setting the exposure") from error

    def collect(self) -> Frame | None:
        """Return the selected frame, or None if it has not arrived. Raises DeviceError.

        The buffers of other frames are returned to the kernel.
        """
        device = self._opened()
        try:
            while (filled := self._dequeue(device)) is not None:
                frame = self._judge(device, filled)
                device.queue(filled.index)
                if frame is not None:
                    self._trigger_ns = None
                    return frame
        except OSError as error:
            raise meaning(self.name, error, "fetching a frame") from error
        return None

    def close(self) -> None:
        """Stop streaming and close the camera. The call has no effect if the camera is not open."""
        device, self._device = self._device, None
        if device is not None:
            device.close()

    def _dequeue(self, device: VideoDevice) -> Filled | None:
        """Return the oldest filled buffer, or None if none is filled or a possibly temporary error occurs."""
        try:
            filled = device.dequeue()
        except OSError as error:
            now_ns = self._clock.now_ns()
            if self._failing_ns is None:
                self._failing_ns = now_ns
            if error.errno != errno.EIO or now_ns - self._failing_ns >= _PASSING_NS:
                raise
            return None
        self._failing_ns = None
        return filled

    def _opened(self) -> VideoDevice:
        if self._device is None:
            raise NotResponding(self.name, "is not open")
        return self._device

    def _set_up(self, device: VideoDevice) -> None:
        settings = self._settings
        driver, card, can = device.capability()
        if not (can & CAP_VIDEO_CAPTURE and can & CAP_STREAMING):
            raise Refused(self.name, f"{card} ({driver}) cannot capture video: use its capture device")
        self._timing.begin(driver)
        self._layout = set_format(device, settings, card)
        device.set_interval(settings.exposure_ns)
        device.start(settings.buffers)
        # The controls are set after the start, because some cameras reset their controls at the start.
        # Automatic exposure is switched off before the gain is set, because it may also control the gain.
        self._exposures = manual_exposures(self.name, device, card)
        set_gain(device, settings)
        self.check(settings.exposure_ns)
        self._asked_steps = 0
        self._set_exposure(device, settings.exposure_ns)
        self._numbers.begin_again()
        self._before = self._trigger_ns = self._failing_ns = None

    def _set_exposure(self, device: VideoDevice, exposure_ns: int) -> None:
        steps = round(exposure_ns / EXPOSURE_UNIT_NS)
        if steps == self._asked_steps:
            return
        actual = device.set_control(EXPOSURE_ABSOLUTE, steps)
        self._exposure_ns = actual * EXPOSURE_UNIT_NS
        self._asked_steps = steps
        self._changed_ns = self._clock.now_ns()
        self._to_settle = self._settings.settling

    def _judge(self, device: VideoDevice, filled: Filled) -> Frame | None:
        """Return the frame in a buffer if it is the selected frame, otherwise None."""
        number = self._numbers.number(filled.sequence)
        before = self._before
        if before is not None:
            self.counts.missed += max(0, number - before[0] - 1)
        start_ns = self._start_of(filled)
        self._before = number, None if start_ns is None else filled.stamp_ns
        if start_ns is None:
            return None
        if start_ns >= self._changed_ns and self._to_settle > 0:
            self._to_settle -= 1
            return None
        if self._trigger_ns is None or start_ns < max(self._trigger_ns, self._changed_ns):
            return None
        if before is not None and before[1] is not None and number == before[0] + 1:
            interval_ns = filled.stamp_ns - before[1]
            if self._timing.contradicts(interval_ns, self._exposure_ns):
                return None
        layout = self._layout
        data = device.data(filled.index, filled.used_bytes)
        try:
            pixels = self._pixels.image(data, layout.columns, layout.rows, layout.stride)
        except PixelError:
            self.counts.spoiled += 1
            return None
        return Frame(number, start_ns, self._exposure_ns, self._clock.now_ns(), pixels)

    def _start_of(self, filled: Filled) -> int | None:
        """Return the start (ns) of a frame's exposure, or None for a damaged frame or an impossible time."""
        layout, pixels = self._layout, self._pixels
        if filled.flags & FLAG_ERROR:
            self.counts.spoiled += 1
            return None
        least = layout.stride * (layout.rows - 1) + pixels.row_bytes(layout.columns)
        if filled.used_bytes < (1 if pixels.is_compressed else least):
            self.counts.short += 1
            return None
        return self._timing.start_of(filled, self._exposure_ns)
