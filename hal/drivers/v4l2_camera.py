"""A monochrome camera of Video for Linux: USB (UVC) or a board's own, free-running, with manual exposure.

Such a camera has no trigger: it exposes frame after frame, and the kernel stamps each on the monotonic clock.
A trigger here selects the first whole exposure that began after it; all other frames are returned unread.
"""

from __future__ import annotations

import errno

from hal.buses import videodev2
from hal.buses.v4l2 import ControlRange, Filled, Layout, VideoDevice
from hal.buses.videodev2 import EXPOSURE_UNIT_NS
from hal.drivers.camera import CameraCounts, FrameNumbers
from hal.drivers.v4l2_set_up import identity, manual_exposures, meaning, open_device, set_format, set_gain
from hal.drivers.v4l2_settings import V4l2Settings
from hal.drivers.v4l2_timing import ExposureTiming
from hal.interfaces.errors import NotResponding, OutOfRange
from hal.interfaces.readings import Frame
from hal.interfaces.wires import Clock

_SEQUENCE_MODULUS = 1 << 32
_EXPOSURE_LIMIT = (1 << 31) - 1
# The kernel's documentation: EIO of VIDIOC_DQBUF may be a signal that was lost for a moment.
_PASSING_NS = 500_000_000


class V4l2Camera:
    """A `hal.drivers.camera.CameraDevice`; its clock must be CLOCK_MONOTONIC, as that of the stamps is."""

    def __init__(self, settings: V4l2Settings, clock: Clock) -> None:
        """Keep the settings; nothing is opened yet."""
        self.name = settings.path
        self.counts = CameraCounts()
        self._settings = settings
        self._clock = clock
        self._kind = settings.kind
        self._timing = ExposureTiming(settings, clock, self.counts)
        self._device: VideoDevice | None = None
        self._layout = Layout(0, 0, "", 0)
        self._exposures: ControlRange | None = None
        self._asked_steps = 0
        self._exposure_ns = 0  # as the camera set it
        self._numbers = FrameNumbers(_SEQUENCE_MODULUS)
        self._before: tuple[int, int] | None = None  # number and stamp of the last frame
        self._trigger_ns: int | None = None
        self._changed_ns = 0
        self._to_settle = 0
        self._failing_ns: int | None = None  # since when fetching fails

    def open(self) -> None:
        """Open the device and start streaming. Raises NotResponding, Refused or OutOfRange, with the cure."""
        self.close()
        self._device = open_device(self.name)
        try:
            self._set_up(self._device)
        except OSError as error:
            raise meaning(self.name, error, "setting it up") from error

    def check(self, exposure_ns: int) -> None:
        """Raise OutOfRange for an exposure that the camera cannot make."""
        known = self._exposures
        low, high = (known.minimum, known.maximum) if known else (1, _EXPOSURE_LIMIT)
        if not low <= round(exposure_ns / EXPOSURE_UNIT_NS) <= high:
            unit = EXPOSURE_UNIT_NS * 1e-9
            raise OutOfRange(self.name, "exposure", exposure_ns * 1e-9, low * unit, high * unit, "s")

    def expose(self, exposure_ns: int, trigger_ns: int) -> None:
        """Select the first whole exposure that begins after the trigger. Raises DeviceError."""
        device = self._opened()
        self._trigger_ns = trigger_ns
        try:
            self._set_exposure(device, exposure_ns)
        except OSError as error:
            raise meaning(self.name, error, "setting the exposure") from error

    def collect(self) -> Frame | None:
        """Return the selected frame; all others go back to the kernel. Raises DeviceError."""
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
        """Stop streaming and release the camera. Safe to call when it is not open."""
        device, self._device = self._device, None
        if device is not None:
            device.close()

    def _dequeue(self, device: VideoDevice) -> Filled | None:
        """Return the oldest filled buffer; None, for a while, when the kernel fails to return one."""
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
        driver, card = identity(self.name, device)
        self._timing.begin(driver)
        self._layout = set_format(device, settings, card)
        device.set_interval(settings.exposure_ns)
        device.start(settings.buffers)
        # After the start: some cameras then lose what was set before.
        set_gain(device, settings)
        self._exposures = manual_exposures(self.name, device, card)
        self.check(settings.exposure_ns)
        self._asked_steps = 0
        self._set_exposure(device, settings.exposure_ns)
        self._numbers.begin_again()
        self._before = self._trigger_ns = self._failing_ns = None

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
        """Return the frame of a buffer if it is the selected one."""
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
        start_ns = self._timing.start_of(filled, self._exposure_ns)
        if start_ns >= self._changed_ns and self._to_settle > 0:
            self._to_settle -= 1
            return None
        if self._trigger_ns is None or start_ns < max(self._trigger_ns, self._changed_ns):
            return None
        if before is not None and number == before[0] + 1:
            interval_ns = filled.stamp_ns - before[1]
            if self._timing.contradicts(interval_ns, self._exposure_ns):
                return None
        pixels = device.pixels(filled.index, layout, self._kind)
        return Frame(number, start_ns, self._exposure_ns, self._clock.now_ns(), pixels)
