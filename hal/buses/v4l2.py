"""A Linux video capture device: the calls for a monochrome camera, and the kernel's structures for them.

Every call raises OSError with the kernel's errno. No call waits for a frame, because the device is
non-blocking. The structures and request numbers are those of linux/videodev2.h (Linux Media Infrastructure
userspace API, part "Video for Linux"); ctypes lays them out for this machine. A request number contains the
size of its structure.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import mmap
import os
from collections.abc import Iterator
from dataclasses import dataclass
from fcntl import ioctl
from types import TracebackType
from typing import Any

import numpy as np
import numpy.typing as npt

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


class Capability(ctypes.Structure):
    """struct v4l2_capability."""

    _fields_ = (
        ("driver", ctypes.c_char * 16),
        ("card", ctypes.c_char * 32),
        ("bus_info", ctypes.c_char * 32),
        ("version", ctypes.c_uint32),
        ("capabilities", ctypes.c_uint32),
        ("device_caps", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32 * 3),
    )


class FormatDescription(ctypes.Structure):
    """struct v4l2_fmtdesc."""

    _fields_ = (
        ("index", ctypes.c_uint32),
        ("type", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("description", ctypes.c_char * 32),
        ("pixelformat", ctypes.c_uint32),
        ("mbus_code", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32 * 3),
    )


class PixelFormat(ctypes.Structure):
    """struct v4l2_pix_format."""

    _fields_ = (
        ("width", ctypes.c_uint32),
        ("height", ctypes.c_uint32),
        ("pixelformat", ctypes.c_uint32),
        ("field", ctypes.c_uint32),
        ("bytesperline", ctypes.c_uint32),
        ("sizeimage", ctypes.c_uint32),
        ("colorspace", ctypes.c_uint32),
        ("priv", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("encoding", ctypes.c_uint32),
        ("quantization", ctypes.c_uint32),
        ("transfer", ctypes.c_uint32),
    )


class _FormatUnion(ctypes.Union):
    # The window of an overlay holds pointers, which is what aligns the kernel's union.
    _fields_ = (
        ("pix", PixelFormat),
        ("raw_data", ctypes.c_uint8 * 200),
        ("pointer", ctypes.c_void_p),
    )


class Format(ctypes.Structure):
    """struct v4l2_format."""

    _fields_ = (("type", ctypes.c_uint32), ("fmt", _FormatUnion))


class RequestBuffers(ctypes.Structure):
    """struct v4l2_requestbuffers."""

    _fields_ = (
        ("count", ctypes.c_uint32),
        ("type", ctypes.c_uint32),
        ("memory", ctypes.c_uint32),
        ("capabilities", ctypes.c_uint32),
        ("flags", ctypes.c_uint8),
        ("reserved", ctypes.c_uint8 * 3),
    )


class TimeValue(ctypes.Structure):
    """struct timeval."""

    _fields_ = (("seconds", ctypes.c_long), ("microseconds", ctypes.c_long))


class _TimeCode(ctypes.Structure):
    _fields_ = (
        ("type", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("frames", ctypes.c_uint8),
        ("seconds", ctypes.c_uint8),
        ("minutes", ctypes.c_uint8),
        ("hours", ctypes.c_uint8),
        ("userbits", ctypes.c_uint8 * 4),
    )


class _BufferUnion(ctypes.Union):
    _fields_ = (("offset", ctypes.c_uint32), ("userptr", ctypes.c_ulong))


class Buffer(ctypes.Structure):
    """struct v4l2_buffer."""

    _fields_ = (
        ("index", ctypes.c_uint32),
        ("type", ctypes.c_uint32),
        ("bytesused", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("field", ctypes.c_uint32),
        ("timestamp", TimeValue),
        ("timecode", _TimeCode),
        ("sequence", ctypes.c_uint32),
        ("memory", ctypes.c_uint32),
        ("m", _BufferUnion),
        ("length", ctypes.c_uint32),
        ("reserved2", ctypes.c_uint32),
        ("request_fd", ctypes.c_int32),
    )


class Fraction(ctypes.Structure):
    """struct v4l2_fract."""

    _fields_ = (("numerator", ctypes.c_uint32), ("denominator", ctypes.c_uint32))


class StreamParameters(ctypes.Structure):
    """struct v4l2_streamparm, its capture side."""

    _fields_ = (
        ("type", ctypes.c_uint32),
        ("capability", ctypes.c_uint32),
        ("capturemode", ctypes.c_uint32),
        ("timeperframe", Fraction),
        ("extendedmode", ctypes.c_uint32),
        ("readbuffers", ctypes.c_uint32),
        ("reserved", ctypes.c_uint8 * 176),
    )


class Control(ctypes.Structure):
    """struct v4l2_control."""

    _fields_ = (("id", ctypes.c_uint32), ("value", ctypes.c_int32))


class QueryControl(ctypes.Structure):
    """struct v4l2_queryctrl."""

    _fields_ = (
        ("id", ctypes.c_uint32),
        ("type", ctypes.c_uint32),
        ("name", ctypes.c_char * 32),
        ("minimum", ctypes.c_int32),
        ("maximum", ctypes.c_int32),
        ("step", ctypes.c_int32),
        ("default_value", ctypes.c_int32),
        ("flags", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32 * 2),
    )


def _request(direction: int, number: int, structure: type[ctypes.Structure] | type[ctypes.c_int]) -> int:
    """Return the request's code as asm-generic/ioctl.h composes it; 1 writes to the kernel, 2 reads."""
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
G_CTRL = _request(3, 27, Control)
S_CTRL = _request(3, 28, Control)
QUERYCTRL = _request(3, 36, QueryControl)


_MICROSECOND_NS = 1_000
_SECOND_NS = 1_000_000_000
_MOST_FORMATS = 64


@dataclass(frozen=True, slots=True)
class Layout:
    """Layout of the pixels in a buffer: `fourcc` names their format, rows are `stride` bytes apart."""

    columns: int
    rows: int
    fourcc: str
    stride: int


@dataclass(frozen=True, slots=True)
class ControlRange:
    """The range of a control."""

    name: str
    minimum: int
    maximum: int
    step: int


@dataclass(frozen=True, slots=True)
class Filled:
    """A filled buffer: its index, bytes used, time stamp, sequence number and flags."""

    index: int
    used_bytes: int
    stamp_ns: int
    sequence: int
    flags: int


def fourcc(name: str) -> int:
    """Return the code of a pixel format of up to four letters, padded with blanks."""
    return int.from_bytes(name.ljust(4).encode("ascii"), "little")


def fourcc_name(code: int) -> str:
    """Return the letters of a pixel format's code."""
    return code.to_bytes(4, "little").decode("ascii", "replace").rstrip()


class VideoDevice:
    """One open /dev/videoN and its buffers."""

    def __init__(self, path: str) -> None:
        """Open the device. Raises OSError."""
        self._descriptor = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        self._maps: list[mmap.mmap] = []
        self._streaming = False

    def __enter__(self) -> VideoDevice:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def capability(self) -> tuple[str, str, int]:
        """Return the names of driver and card, and the capabilities of this node."""
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

    def set_format(self, columns: int, rows: int, name: str) -> Layout:
        """Request a format; return the one that the device set, which may differ."""
        answer = Format(type=VIDEO_CAPTURE)
        pix = answer.fmt.pix
        pix.width, pix.height, pix.pixelformat, pix.field = columns, rows, fourcc(name), FIELD_NONE
        self._ask(S_FMT, answer)
        return Layout(pix.width, pix.height, fourcc_name(pix.pixelformat), pix.bytesperline)

    def set_interval(self, interval_ns: int) -> int:
        """Request an interval between frames; return the device's, 0 when it cannot be set."""
        answer = StreamParameters(type=VIDEO_CAPTURE)
        try:
            self._ask(G_PARM, answer)
            if not answer.capability & CAP_TIME_PER_FRAME:
                return 0
            answer.timeperframe = Fraction(-(-interval_ns // _MICROSECOND_NS), 1_000_000)
            self._ask(S_PARM, answer)
        except OSError as error:
            if error.errno in {errno.ENOTTY, errno.EINVAL}:
                return 0
            raise
        time = answer.timeperframe
        return time.numerator * _SECOND_NS // time.denominator if time.denominator else 0

    def control_range(self, control: int) -> ControlRange | None:
        """Return the range of a control, None when the device has no such control."""
        answer = QueryControl(id=control)
        try:
            self._ask(QUERYCTRL, answer)
        except OSError as error:
            if error.errno in {errno.EINVAL, errno.ENOTTY}:
                return None
            raise
        if answer.flags & CONTROL_DISABLED:
            return None
        return ControlRange(_text(answer.name), answer.minimum, answer.maximum, max(answer.step, 1))

    def set_control(self, control: int, value: int) -> int:
        """Set a control; return its resulting value."""
        answer = Control(control, value)
        self._ask(S_CTRL, answer)
        self._ask(G_CTRL, answer)
        return int(answer.value)

    def start(self, count: int) -> int:
        """Map and queue buffers and start streaming; return how many buffers the device granted."""
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
        """Return the oldest filled buffer, None when there is none. Return it with `queue`."""
        buffer = _numbered(0)
        try:
            self._ask(DQBUF, buffer)
        except BlockingIOError:
            return None
        stamp = buffer.timestamp
        stamp_ns = stamp.seconds * _SECOND_NS + stamp.microseconds * _MICROSECOND_NS
        return Filled(buffer.index, buffer.bytesused, stamp_ns, buffer.sequence, buffer.flags)

    def queue(self, index: int) -> None:
        """Return a buffer to the kernel to be filled again."""
        self._ask(QBUF, _numbered(index))

    def pixels(self, index: int, layout: Layout, kind: np.dtype[Any]) -> npt.NDArray[Any]:
        """Return a copy (rows, columns) of a buffer's pixels, without the padding of its rows."""
        memory = self._maps[index]
        view: npt.NDArray[Any] = np.ndarray(
            (layout.rows, layout.columns), kind, memory, strides=(layout.stride, kind.itemsize)
        )
        return view.astype(kind.newbyteorder("="), order="C")

    def close(self) -> None:
        """Stop streaming and release everything. Safe to call twice."""
        if self._descriptor < 0:
            return
        if self._streaming:
            self._streaming = False
            with contextlib.suppress(OSError):  # a lost camera has stopped
                self._ask(STREAMOFF, ctypes.c_int(VIDEO_CAPTURE))
        for memory in self._maps:
            memory.close()
        self._maps.clear()
        descriptor, self._descriptor = self._descriptor, -1
        os.close(descriptor)

    def _ask(self, request: int, argument: ctypes.Structure | ctypes.c_int) -> None:
        # The kernel returns EINTR only where a call may wait; these do not.
        ioctl(self._descriptor, request, argument)


def _text(name: bytes) -> str:
    """Return a name of the device; one too long for its field may be cut inside a character."""
    return name.decode("utf-8", "replace")


def _numbered(index: int) -> Buffer:
    return Buffer(index=index, type=VIDEO_CAPTURE, memory=MMAP)
