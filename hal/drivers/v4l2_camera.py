"""A monochrome camera of Video for Linux: USB (UVC) or a board's own, free-running, exposed by hand.

Such a camera takes no trigger: it exposes frame after frame, and the kernel stamps each on the monotonic
clock. A trigger therefore means the first whole exposure that began after it; the others are given back.

When an exposure began follows from the stamp, which the driver says is of the exposure's start (SOE) or of
the frame's end. The kernel's uvcvideo says SOE whatever it does, yet unless its parameter `hwtimestamps` is
set it stamps the arrival of the frame's first packet (uvc_video_decode_start), when the exposure has ended:
`Stamp.TOLD` knows that.
"""

from __future__ import annotations

import errno
import os
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

from hal.buses import videodev2
from hal.buses.v4l2 import ControlRange, Filled, Layout, VideoDevice
from hal.buses.videodev2 import EXPOSURE_UNIT_NS
from hal.drivers.camera import CameraCounts, FrameNumbers
from hal.interfaces.errors import CorruptData, DeviceError, NotResponding, OutOfRange, Refused
from hal.interfaces.readings import Frame
from hal.interfaces.wires import Clock

PIXEL_KINDS: dict[str, np.dtype[Any]] = {
    "GREY": np.dtype("u1"),
    "Y10": np.dtype("<u2"),
    "Y12": np.dtype("<u2"),
    "Y16": np.dtype("<u2"),
}
"""V4L2's grey pixel formats, "Luma-Only Formats": those of 10 and 12 bits stand in the low bits of 16."""

UVC_STAMPS = Path("/sys/module/uvcvideo/parameters/hwtimestamps")

_SEQUENCE_MODULUS = 1 << 32
# A stamp may be ahead of the clock by its own rounding and that of a camera's clock fitted to the host's.
_STAMP_AHEAD_NS = 10_000_000
# Of the exposure: an interval between frames that is shorter by more than this belies it.
_INTERVAL_SLACK = 0.05
_CONTRADICTIONS = 3
_EXPOSURE_LIMIT = (1 << 31) - 1
# An EIO of VIDIOC_DQBUF may be of a signal that was lost for a moment, as the kernel's documentation has it.
_PASSING_NS = 500_000_000


class Stamp(Enum):
    """What the kernel's stamp of a frame is of: as told, or the exposure's start or end in spite of it."""

    TOLD = "told"
    START = "start"
    END = "end"


@dataclass(frozen=True, slots=True)
class V4l2Settings:
    """What is asked of the camera.

    Attributes:
        path: of its device, such as /dev/knightcube-camera.
        pixel_format: a key of PIXEL_KINDS.
        exposure_ns: the usual one; the time between frames is set by it.
        gain: in the camera's own steps, None to leave it.
        stamp: what the stamps are of.
        stamp_delay_ns: from that instant to the stamp.
        settling: frames that may still have the old exposure after it was changed.
        buffers: how many frames the kernel may hold.
    """

    path: str
    columns: int
    rows: int
    pixel_format: str
    exposure_ns: int
    gain: int | None = None
    stamp: Stamp = Stamp.TOLD
    stamp_delay_ns: int = 0
    settling: int = 2
    buffers: int = 4


class V4l2Camera:
    """A `hal.drivers.camera.CameraDevice`; its clock must be CLOCK_MONOTONIC, as that of the stamps is."""

    def __init__(self, settings: V4l2Settings, clock: Clock) -> None:
        """Take what is asked; nothing is opened yet."""
        self.name = settings.path
        self.counts = CameraCounts()
        self._settings = settings
        self._clock = clock
        self._kind = PIXEL_KINDS[settings.pixel_format]
        self._device: VideoDevice | None = None
        self._layout = Layout(0, 0, "", 0)
        self._exposures: ControlRange | None = None
        self._asked_steps = 0
        self._exposure_ns = 0  # what the camera made of it
        self._soft_stamps = False
        self._numbers = FrameNumbers(_SEQUENCE_MODULUS)
        self._before: tuple[int, int] | None = None  # number and stamp of the last frame
        self._trigger_ns: int | None = None
        self._changed_ns = 0
        self._to_settle = 0
        self._contradictions = 0
        self._failing_ns: int | None = None  # since when fetching fails

    def open(self) -> None:
        """Open the device and let it run. Raises NotResponding, Refused or OutOfRange, with the cure."""
        self.close()
        try:
            self._device = VideoDevice(self.name)
        except FileNotFoundError as error:
            raise NotResponding(
                self.name,
                "no such camera: is it plugged in, and does a udev rule give it this name "
                "(deploy/99-knightcube.rules)? `v4l2-ctl --list-devices` lists what there is",
            ) from error
        except PermissionError as error:
            raise Refused(self.name, "no permission: add the user to the group video") from error
        except OSError as error:
            raise self._meaning(error, "opening it") from error
        try:
            self._set_up(self._device)
        except OSError as error:
            raise self._meaning(error, "setting it up") from error

    def check(self, exposure_ns: int) -> None:
        """Raise OutOfRange for an exposure that the camera cannot make."""
        known = self._exposures
        low, high = (known.minimum, known.maximum) if known else (1, _EXPOSURE_LIMIT)
        if not low <= round(exposure_ns / EXPOSURE_UNIT_NS) <= high:
            unit = EXPOSURE_UNIT_NS * 1e-9
            raise OutOfRange(self.name, "exposure", exposure_ns * 1e-9, low * unit, high * unit, "s")

    def expose(self, exposure_ns: int, trigger_ns: int) -> None:
        """Wait for the first whole exposure that begins after the trigger. Raises DeviceError."""
        device = self._opened()
        self._trigger_ns = trigger_ns
        try:
            self._set_exposure(device, exposure_ns)
        except OSError as error:
            raise self._meaning(error, "setting the exposure") from error

    def collect(self) -> Frame | None:
        """Return the frame that was waited for; give all others back to the kernel. Raises DeviceError."""
        device = self._opened()
        try:
            while (filled := self._take(device)) is not None:
                frame = self._judge(device, filled)
                device.queue(filled.index)
                if frame is not None:
                    self._trigger_ns = None
                    return frame
        except OSError as error:
            raise self._meaning(error, "fetching a frame") from error
        return None

    def close(self) -> None:
        """Stop streaming and release the camera. Safe to call when it is not open."""
        device, self._device = self._device, None
        if device is not None:
            device.close()

    def _take(self, device: VideoDevice) -> Filled | None:
        """Return the oldest filled buffer; none, for a while, where the kernel fails to hand one over."""
        try:
            filled = device.take()
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

    def _meaning(self, error: OSError, doing: str) -> DeviceError:
        """Return what an errno of the kernel means for who has to mend it."""
        if error.errno in {errno.ENODEV, errno.ENXIO}:
            return NotResponding(self.name, f"gone while {doing}: was it unplugged?")
        if error.errno == errno.EBUSY:
            return Refused(self.name, f"busy while {doing}: another program has the camera")
        if error.errno == errno.ENOTTY:
            return Refused(self.name, f"is no V4L2 device (found {doing})")
        return NotResponding(self.name, f"failed while {doing}: {os.strerror(error.errno or errno.EIO)}")

    def _set_up(self, device: VideoDevice) -> None:
        settings = self._settings
        driver, card, can = device.capability()
        if not (can & videodev2.CAP_VIDEO_CAPTURE and can & videodev2.CAP_STREAMING):
            raise Refused(self.name, f"{card} ({driver}) delivers no video here: give its capture node")
        self._soft_stamps = driver == "uvcvideo" and not _uvc_uses_device_clock()
        self._layout = device.set_format(settings.columns, settings.rows, settings.pixel_format)
        self._check_layout(device, card)
        device.set_interval(settings.exposure_ns)
        device.start(settings.buffers)
        # After the start, at which some cameras forget what was set before.
        self._set_gain(device)
        self._exposures = device.control_range(videodev2.EXPOSURE_ABSOLUTE)
        if self._exposures is None:
            raise Refused(self.name, f"{card} has no exposure to be set in units of time (exposure_absolute)")
        if device.control_range(videodev2.EXPOSURE_AUTO) is not None:
            device.set_control(videodev2.EXPOSURE_AUTO, videodev2.EXPOSURE_MANUAL)
        self.check(settings.exposure_ns)
        self._asked_steps = 0
        self._set_exposure(device, settings.exposure_ns)
        self._numbers.begin_again()
        self._before = self._trigger_ns = self._failing_ns = None
        self._contradictions = 0

    def _check_layout(self, device: VideoDevice, card: str) -> None:
        layout, settings = self._layout, self._settings
        if layout.fourcc != settings.pixel_format:
            offered = ", ".join(device.formats()) or "none"
            raise Refused(
                self.name, f"{card} has no pixel format {settings.pixel_format}; it offers {offered}"
            )
        if (layout.columns, layout.rows) != (settings.columns, settings.rows):
            raise Refused(
                self.name,
                f"{card} gives {layout.columns} x {layout.rows} pixels, not {settings.columns} x "
                f"{settings.rows}: `v4l2-ctl --list-formats-ext` lists its sizes",
            )
        if layout.stride < layout.columns * self._kind.itemsize:
            raise CorruptData(
                self.name, f"{card} claims rows of {layout.stride} bytes for {layout.columns} pixels"
            )

    def _set_gain(self, device: VideoDevice) -> None:
        if device.control_range(videodev2.AUTO_GAIN) is not None:
            device.set_control(videodev2.AUTO_GAIN, 0)
        gain = self._settings.gain
        if gain is None:
            return
        for control in (videodev2.GAIN, videodev2.ANALOGUE_GAIN):
            known = device.control_range(control)
            if known is not None:
                if not known.minimum <= gain <= known.maximum:
                    raise OutOfRange(self.name, "gain", gain, known.minimum, known.maximum, "")
                device.set_control(control, gain)
                return
        raise Refused(self.name, "has no gain to set: leave `gain` out")

    def _set_exposure(self, device: VideoDevice, exposure_ns: int) -> None:
        steps = round(exposure_ns / EXPOSURE_UNIT_NS)
        if steps == self._asked_steps:
            return
        actual = device.set_control(videodev2.EXPOSURE_ABSOLUTE, steps)
        self._exposure_ns = actual * EXPOSURE_UNIT_NS
        self._asked_steps = steps
        self._changed_ns = self._clock.now_ns()
        self._to_settle = self._settings.settling

    def _judge(self, device: VideoDevice, filled: Filled) -> Frame | None:
        """Return the frame of a buffer if it is the one that is waited for."""
        number = self._numbers.number(filled.sequence)
        before, self._before = self._before, (number, filled.stamp_ns)
        if before is not None:
            self.counts.missed += max(0, number - before[0] - 1)
        layout = self._layout
        if filled.flags & videodev2.FLAG_ERROR:
            self.counts.spoiled += 1
            return None
        if filled.used_bytes < layout.stride * (layout.rows - 1) + layout.columns * self._kind.itemsize:
            self.counts.short += 1
            return None
        start_ns = self._start_of(filled)
        if start_ns >= self._changed_ns and self._to_settle > 0:
            self._to_settle -= 1
            return None
        if self._trigger_ns is None or start_ns < max(self._trigger_ns, self._changed_ns):
            return None
        if self._belied(number, filled.stamp_ns, before):
            return None
        pixels = device.pixels(filled.index, layout, self._kind)
        return Frame(number, start_ns, self._exposure_ns, self._clock.now_ns(), pixels)

    def _start_of(self, filled: Filled) -> int:
        """Return when a frame's exposure began."""
        if filled.flags & videodev2.STAMP_MASK != videodev2.STAMP_MONOTONIC:
            raise CorruptData(self.name, "stamps its frames by another clock than the monotonic one")
        ahead_ns = filled.stamp_ns - self._clock.now_ns()
        if ahead_ns > _STAMP_AHEAD_NS:
            raise CorruptData(
                self.name,
                f"a frame is stamped {ahead_ns * 1e-9:.3f} s ahead of the monotonic clock: "
                "has uvcvideo been loaded with clock=CLOCK_REALTIME?",
            )
        told_start = filled.flags & videodev2.STAMP_SOURCE_MASK == videodev2.STAMP_START_OF_EXPOSURE
        stamp = self._settings.stamp
        at_start = stamp is Stamp.START or (stamp is Stamp.TOLD and told_start and not self._soft_stamps)
        start_ns = filled.stamp_ns - self._settings.stamp_delay_ns
        return start_ns if at_start else start_ns - self._exposure_ns

    def _belied(self, number: int, stamp_ns: int, before: tuple[int, int] | None) -> bool:
        """Tell whether a frame followed the one before it sooner than its exposure takes.

        A rate is the streak's length over the exposure: a camera that does not expose as long as it says
        makes every rate wrong. One such frame may be a late stamp; several in a row are the camera, which
        raises Refused.
        """
        if before is None or number != before[0] + 1:
            return False
        interval_ns = stamp_ns - before[1]
        if interval_ns >= self._exposure_ns * (1.0 - _INTERVAL_SLACK):
            self._contradictions = 0
            return False
        self.counts.contradictory += 1
        self._contradictions += 1
        if self._contradictions >= _CONTRADICTIONS:
            raise Refused(
                self.name,
                f"frames come every {interval_ns * 1e-6:.1f} ms, so none is exposed for the "
                f"{self._exposure_ns * 1e-6:.1f} ms that the camera claims: ask for a shorter exposure",
            )
        return True


def _uvc_uses_device_clock() -> bool:
    try:
        return UVC_STAMPS.read_text(encoding="ascii").strip() not in {"0", "N"}
    except OSError:
        return False  # the kernel's default
