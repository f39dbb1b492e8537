"""Test double of the kernel's /dev/videoN: a free-running camera that performs the ioctls of V4L2.

The buffers are in a memfd, which the driver's binding maps. The queue follows the kernel's rules (Linux Media
userspace API, "Streaming I/O (Memory Mapping)"). Calls in a wrong order fail with the errno that the kernel
documents.
"""

from __future__ import annotations

import ctypes
import errno
import itertools
import mmap
import os
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hal.drivers import v4l2_camera as v4l2
from hal.drivers.camera import PIXEL_FORMATS, fourcc

MILLISECOND_NS = 1_000_000


@dataclass(slots=True)
class Knob:
    """A camera control with its bounds and its value."""

    minimum: int
    maximum: int
    value: int
    name: bytes = b"knob"


class IoctlCamera:
    """A callable that replaces fcntl.ioctl.

    Attributes:
        sizes: image sizes of the formats, {fourcc: (columns, rows)}.
        padding: bytes after each row.
        shortest_ns: shortest interval of frames, ns; the interval is longer for long exposures.
        readout_ns: time from the end of an exposure to the end of the frame, ns.
        lag: number of frames until a changed control takes effect.
        stamp_source, clock_flag, stamp_offset_ns: reported source and clock of the time stamps, and their
            error.
        stamps_packets: whether a frame's time stamp is the time of its first USB packet, as with uvcvideo.
        spoil, shorten: numbers of the frames with an error flag, and of the frames with half their bytes.
        frozen: whether the sequence number stays constant.
        belies_exposure: whether the interval of frames is always `shortest_ns`, whatever the exposure.
        stopped: whether the camera has stopped sending frames.
        absurd: wrong time stamps of single frames, by frame number.
        raw: content of each frame instead of a pattern, and its number of used bytes.
        held_ns: delay of the frames, ns.
        automatic_gain: gain after automatic exposure has been switched off.
        stubborn: values of controls that accept each value, but do not keep it.
        intervals_ns: permitted intervals of frames, of which the nearest is chosen; if empty, each interval
            is permitted.
        bandwidth: whether the USB bus has enough bandwidth left for the frames.
        draws: whether each frame has its own pattern; otherwise the buffer keeps its old content.
    """

    def __init__(self, folder: Path, now_ns: Callable[[], int]) -> None:
        self.path = folder / "camera"
        self._now_ns = now_ns
        self._memory = os.memfd_create("camera")
        self.driver, self.card = b"double", b"Grey camera"
        self.capabilities = v4l2.CAP_VIDEO_CAPTURE | v4l2.CAP_STREAMING
        self.sizes = {"GREY": (64, 48), "Y10": (64, 48), "Y16": (64, 48)}
        self.padding = 0
        self.shortest_ns = 20 * MILLISECOND_NS
        self.readout_ns = 5 * MILLISECOND_NS
        self.lag = 1
        self.stamp_source, self.clock_flag = v4l2.STAMP_START_OF_EXPOSURE, v4l2.STAMP_MONOTONIC
        self.stamp_offset_ns = 0
        self.stamps_packets = False
        self.spoil: set[int] = set()
        self.shorten: set[int] = set()
        self.frozen = self.belies_exposure = self.stopped = False
        self.absurd: dict[int, int] = {}
        self.raw: bytes | None = None
        self.held_ns = 0
        self.first_sequence = 0
        self.automatic_gain = 10
        self.stubborn: dict[int, int] = {}
        self.bandwidth = True
        self.intervals_ns: tuple[int, ...] = ()
        self.knobs = {
            v4l2.EXPOSURE_AUTO: Knob(0, 3, 3),
            v4l2.EXPOSURE_ABSOLUTE: Knob(1, 5000, 157),
            v4l2.GAIN: Knob(0, 100, 10),
        }
        self.exposures: dict[int, tuple[int, int]] = {}
        self.level = itertools.count(1)
        self.draws = True
        self.interval_asked_ns = 0
        self.plug()

    def plug(self) -> None:
        """Plug in and switch on the camera."""
        self.plugged = True
        self.path.symlink_to(f"/proc/self/fd/{self._memory}")
        self._forget()

    def unplug(self) -> None:
        """Unplug the camera. Each later call and each opening fails."""
        self.plugged = False
        self.path.unlink()

    def close(self) -> None:
        """Release the memory."""
        os.close(self._memory)

    def _forget(self) -> None:
        self._kind = "GREY"
        self._count = 0
        self._streaming = False
        self._free: deque[int] = deque()
        self._filled: deque[v4l2.Buffer] = deque()
        self._pending: list[tuple[int, int]] = []  # delay (frames), exposure

    def __call__(self, _: int, request: int, argument: Any) -> int:
        """Perform one ioctl. Raises OSError as the kernel does."""
        if not self.plugged:
            raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))
        answers: dict[int, Callable[[Any], None]] = {
            v4l2.QUERYCAP: self._querycap,
            v4l2.ENUM_FMT: self._enum_fmt,
            v4l2.S_FMT: self._s_fmt,
            v4l2.G_PARM: self._g_parm,
            v4l2.S_PARM: self._s_parm,
            v4l2.REQBUFS: self._reqbufs,
            v4l2.QUERYBUF: self._querybuf,
            v4l2.QBUF: self._qbuf,
            v4l2.DQBUF: self._dqbuf,
            v4l2.STREAMON: self._streamon,
            v4l2.STREAMOFF: self._streamoff,
            v4l2.QUERYCTRL: self._queryctrl,
            v4l2.G_CTRL: self._g_ctrl,
            v4l2.S_CTRL: self._s_ctrl,
        }
        if request not in answers:
            raise OSError(errno.ENOTTY, f"request 0x{request:08x}")
        self._run()
        answers[request](argument)
        return 0

    @property
    def _row_bytes(self) -> int:
        return PIXEL_FORMATS[self._kind].row_bytes(self.sizes[self._kind][0]) + self.padding

    @property
    def _image_bytes(self) -> int:
        return self._row_bytes * self.sizes[self._kind][1] or 65536

    @property
    def _slot_bytes(self) -> int:
        return -(-self._image_bytes // mmap.PAGESIZE) * mmap.PAGESIZE

    def _querycap(self, answer: v4l2.Capability) -> None:
        answer.driver, answer.card = self.driver, self.card
        answer.capabilities = self.capabilities | 0x2 | v4l2.CAP_DEVICE_CAPS  # also capable of video output
        answer.device_caps = self.capabilities

    def _enum_fmt(self, answer: v4l2.FormatDescription) -> None:
        _require(answer.index < len(self.sizes), errno.EINVAL)
        answer.pixelformat = fourcc(list(self.sizes)[answer.index])

    def _s_fmt(self, answer: v4l2.Format) -> None:
        _require(self._count == 0, errno.EBUSY)
        _require(answer.type == v4l2.VIDEO_CAPTURE, errno.EINVAL)
        pix = answer.fmt.pix
        self._kind = next(
            (kind for kind in self.sizes if fourcc(kind) == pix.pixelformat), next(iter(self.sizes))
        )
        pix.width, pix.height = self.sizes[self._kind]
        pix.pixelformat, pix.bytesperline = fourcc(self._kind), self._row_bytes
        pix.sizeimage = self._image_bytes

    def _g_parm(self, answer: v4l2.StreamParameters) -> None:
        answer.capability = v4l2.CAP_TIME_PER_FRAME

    def _s_parm(self, answer: v4l2.StreamParameters) -> None:
        _require(not self._streaming, errno.EBUSY)
        time = answer.timeperframe
        self.interval_asked_ns = time.numerator * 10**9 // time.denominator
        if self.intervals_ns:
            nearest_ns = min(self.intervals_ns, key=lambda one: abs(one - self.interval_asked_ns))
            answer.timeperframe = v4l2.Fraction(nearest_ns // 1000, 1_000_000)
            self.interval_asked_ns = nearest_ns

    def _reqbufs(self, answer: v4l2.RequestBuffers) -> None:
        _require(not self._streaming, errno.EBUSY)
        answer.count = self._count = min(answer.count, 8)
        os.ftruncate(self._memory, self._count * self._slot_bytes)

    def _querybuf(self, answer: v4l2.Buffer) -> None:
        _require(answer.index < self._count, errno.EINVAL)
        answer.length, answer.m.offset = self._image_bytes, answer.index * self._slot_bytes

    def _qbuf(self, argument: v4l2.Buffer) -> None:
        lying = [*self._free, *(buffer.index for buffer in self._filled)]
        _require(argument.index < self._count and argument.index not in lying, errno.EINVAL)
        self._free.append(argument.index)

    def _dqbuf(self, answer: v4l2.Buffer) -> None:
        _require(self._streaming, errno.EINVAL)
        _require(bool(self._filled), errno.EAGAIN)
        ctypes.pointer(answer)[0] = self._filled.popleft()

    def _streamon(self, _: ctypes.c_int) -> None:
        _require(self._count > 0, errno.EINVAL)
        _require(self.bandwidth, errno.ENOSPC)
        self._streaming = True
        self._sequence = self.first_sequence
        self._next_ns = self._now_ns() + 3 * MILLISECOND_NS
        known = self.knobs.get(v4l2.EXPOSURE_ABSOLUTE)
        self._exposure = known.value if known else 100

    def _streamoff(self, _: ctypes.c_int) -> None:
        self._forget()

    def _queryctrl(self, answer: v4l2.QueryControl) -> None:
        _require(answer.id in self.knobs, errno.EINVAL)
        knob = self.knobs[answer.id]
        answer.name, answer.step = knob.name, 1
        answer.minimum, answer.maximum = knob.minimum, knob.maximum

    def _g_ctrl(self, answer: v4l2.ControlValue) -> None:
        _require(answer.id in self.knobs, errno.EINVAL)
        answer.value = self.knobs[answer.id].value

    def _s_ctrl(self, argument: v4l2.ControlValue) -> None:
        _require(argument.id in self.knobs, errno.EINVAL)
        knob = self.knobs[argument.id]
        _require(knob.minimum <= argument.value <= knob.maximum, errno.ERANGE)
        if argument.id == v4l2.EXPOSURE_ABSOLUTE:
            # Like UVC cameras, the camera refuses a set exposure while its exposure is automatic.
            _require(self.knobs[v4l2.EXPOSURE_AUTO].value == v4l2.EXPOSURE_MANUAL, errno.EACCES)
            self._pending.append((self.lag, argument.value))
        if argument.id == v4l2.EXPOSURE_AUTO and v4l2.GAIN in self.knobs and argument.value != knob.value:
            # Like many UVC cameras, the camera keeps the gain of its automatic exposure.
            self.knobs[v4l2.GAIN].value = self.automatic_gain
        knob.value = self.stubborn.get(argument.id, argument.value)

    def _run(self) -> None:
        """Finish each frame whose end is due. A frame without a free buffer is lost."""
        while self._streaming and not self.stopped:
            exposure_ns = self._exposure * v4l2.EXPOSURE_UNIT_NS
            start_ns = self._next_ns
            end_ns = start_ns + exposure_ns + self.readout_ns
            if end_ns + self.held_ns > self._now_ns():
                return
            self._finish(start_ns, end_ns, exposure_ns)
            period_ns = self.shortest_ns if self.belies_exposure else max(self.shortest_ns, exposure_ns)
            self._next_ns += period_ns
            self._pending = [(left - 1, value) for left, value in self._pending]
            while self._pending and self._pending[0][0] < 0:
                self._exposure = self._pending.pop(0)[1]

    def _finish(self, start_ns: int, end_ns: int, exposure_ns: int) -> None:
        number = self._sequence
        self.exposures[number] = start_ns, exposure_ns
        if not self.frozen:
            self._sequence = (self._sequence + 1) % (1 << 32)
        if not self._free:
            return
        index = self._free.popleft()
        stamp_ns = start_ns if self.stamp_source == v4l2.STAMP_START_OF_EXPOSURE else end_ns
        if self.stamps_packets:
            stamp_ns = start_ns + exposure_ns
        stamp_ns = self.absurd.get(number, stamp_ns + self.stamp_offset_ns)
        flags = self.clock_flag | self.stamp_source | (v4l2.FLAG_ERROR if number in self.spoil else 0)
        used = self._image_bytes // 2 if number in self.shorten else self._image_bytes
        if self.raw is not None:
            used = len(self.raw)
            os.pwrite(self._memory, self.raw, index * self._slot_bytes)
        elif self.draws:
            self._draw(index, next(self.level))
        buffer = v4l2.Buffer(
            index=index, type=v4l2.VIDEO_CAPTURE, bytesused=used, flags=flags, sequence=number
        )
        buffer.timestamp.seconds, rest_ns = divmod(stamp_ns, 10**9)
        buffer.timestamp.microseconds = rest_ns // 1000
        self._filled.append(buffer)

    def _draw(self, index: int, level: int) -> None:
        """Write an image whose pixel (x, y) is level + x + 100 y in the low bits. Padding bytes are 255."""
        columns, rows = self.sizes[self._kind]
        kind = np.dtype("u1") if self._kind == "GREY" else np.dtype("<u2")
        bits = {"GREY": 8, "Y10": 10, "Y12": 12, "Y16": 16}[self._kind]
        y, x = np.mgrid[:rows, :columns]
        image = ((level + x + 100 * y) % (1 << bits)).astype(kind)
        lines = b"".join(row.tobytes() + b"\xff" * self.padding for row in image)
        os.pwrite(self._memory, lines, index * self._slot_bytes)


def _require(fulfilled: bool, code: int) -> None:
    if not fulfilled:
        raise OSError(code, os.strerror(code))
