"""A Linux video capture device: the calls that a monochrome camera needs.

Every call raises OSError with the kernel's errno; none waits for a frame, because the device is non-blocking.
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

from hal.buses.videodev2 import (
    CAP_DEVICE_CAPS,
    CAP_TIME_PER_FRAME,
    CONTROL_DISABLED,
    DQBUF,
    ENUM_FMT,
    FIELD_NONE,
    G_CTRL,
    G_PARM,
    MMAP,
    QBUF,
    QUERYBUF,
    QUERYCAP,
    QUERYCTRL,
    REQBUFS,
    S_CTRL,
    S_FMT,
    S_PARM,
    STREAMOFF,
    STREAMON,
    VIDEO_CAPTURE,
    Buffer,
    Capability,
    Control,
    Format,
    FormatDescription,
    Fraction,
    QueryControl,
    RequestBuffers,
    StreamParameters,
)

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
