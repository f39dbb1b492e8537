"""Driver of GenICam cameras (USB3 Vision, GigE Vision) through Aravis, with software-triggered exposures.

Aravis (https://aravisproject.github.io/aravis) is a system library that Python calls by GObject
introspection. The library is imported only when a GenICam camera is opened.

The exposure is assumed to begin half-way between sending the trigger and receiving its acknowledgement. On
USB the start time is accurate to about one millisecond. The camera's own clock is not used, because its
offset from the host clock is unknown.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from hal.drivers.camera import CameraCounts, FrameNumbers
from hal.interfaces.devices import Frame
from hal.interfaces.errors import NotResponding, OutOfRange, Refused
from hal.interfaces.wires import Clock

PIXEL_KINDS: dict[str, np.dtype[Any]] = {
    "Mono8": np.dtype("u1"),
    "Mono10": np.dtype("<u2"),
    "Mono12": np.dtype("<u2"),
    "Mono16": np.dtype("<u2"),
}
"""Unpacked monochrome pixel formats (GenICam PFNC 2.4, table "Mono"), stored in 8 or 16 bits per pixel."""

CURE = (
    "needs Aravis: apt install gir1.2-aravis-0.8 python3-gi, the virtual environment made with "
    "--system-site-packages; or apt install libusb-1.0-0 and pip install 'knightcube-flight[genicam]'"
)
FAKE_PREFIX = "Fake"
"""Prefix of the names of cameras simulated by Aravis, such as Fake_1."""

# GigE Vision numbers frames from 1 to 65,535 cyclically; USB3 Vision uses 64-bit numbers.
_FRAME_IDS = (1 << 16) - 1
_MICROSECOND_NS = 1_000
# Largest accepted difference between requested and actual gain, relative to the range of gains.
_GAIN_TOLERANCE = 0.01


@dataclass(frozen=True, slots=True)
class AravisSettings:
    """Settings of an Aravis camera.

    Attributes:
        name: name of the camera in the list of `arv-tool-0.8`, such as "FLIR-1E10015B2E2F" or "Fake_1".
        columns, rows: size of the image region at the centre of the sensor, pixels.
        pixel_format: name of a pixel format in PIXEL_KINDS.
        exposure_ns: usual exposure time, ns.
        gain: gain in the camera's own unit (usually dB), or None to leave the gain unchanged.
        buffers: number of frame buffers that Aravis uses.
    """

    name: str
    columns: int
    rows: int
    pixel_format: str
    exposure_ns: int
    gain: float | None
    buffers: int = 4


class AravisCamera:
    """Driver of a camera through Aravis, which implements `hal.drivers.camera.CameraDevice`."""

    def __init__(self, settings: AravisSettings, clock: Clock) -> None:
        """Store the settings without opening the camera or importing Aravis."""
        self.name = settings.name
        self.counts = CameraCounts()
        self._settings, self._clock = settings, clock
        self._kind = PIXEL_KINDS[settings.pixel_format]
        self._numbers = FrameNumbers(_FRAME_IDS)
        self._last: int | None = None
        self._camera: Any = None
        self._stream: Any = None
        self._success: Any = None
        self._bounds = 1, 1 << 62
        self._asked_ns = 0
        self._exposure_ns = 0  # exposure time reported by the camera
        self._start_ns: int | None = None
        self._lost = False

    def open(self) -> None:
        """Open and configure the camera.

        Raises NotResponding, Refused or OutOfRange with advice for the user.
        """
        self.close()
        aravis = library(self.name)
        if self.name.startswith(FAKE_PREFIX):
            aravis.enable_interface("Fake")
        try:
            self._camera = aravis.Camera.new(self.name)
        except _glib_error() as error:
            aravis.update_device_list()
            found = [aravis.get_device_id(index) for index in range(aravis.get_n_devices())]
            raise NotResponding(
                self.name,
                f"{error}; found {', '.join(found) or 'no camera'}: is it plugged in, and "
                "may this user open it (udev rule for USB3 Vision)?",
            ) from error
        with self._during("setting it up"):
            self._set_up(aravis, self._camera)

    def check(self, exposure_ns: int) -> None:
        """Raise OutOfRange for an exposure time (ns) that the camera does not support."""
        low, high = self._bounds
        if not low <= exposure_ns <= high:
            raise OutOfRange(self.name, "exposure", exposure_ns * 1e-9, low * 1e-9, high * 1e-9, "s")

    def expose(self, exposure_ns: int, trigger_ns: int) -> None:
        """Trigger an exposure and discard earlier frames. Raises DeviceError."""
        camera, stream = self._opened()
        with self._during("triggering"):
            while (buffer := stream.try_pop_buffer()) is not None:
                self._number_of(buffer)
                stream.push_buffer(buffer)
            if exposure_ns != self._asked_ns:
                self._set_exposure(camera, exposure_ns)
            before_ns = self._clock.now_ns()
            camera.software_trigger()
            self._start_ns = (before_ns + self._clock.now_ns()) // 2

    def collect(self) -> Frame | None:
        """Return the triggered frame once, or None until the frame arrives. Raises NotResponding."""
        _, stream = self._opened()
        if self._lost:
            raise NotResponding(self.name, "the camera disappeared: check its cable")
        while (buffer := stream.try_pop_buffer()) is not None:
            frame = self._judge(buffer)
            stream.push_buffer(buffer)
            if frame is not None:
                self._start_ns = None
                return frame
        return None

    def close(self) -> None:
        """Stop and close the camera. The call has no effect if the camera is not open."""
        camera, self._camera, self._stream, self._start_ns = self._camera, None, None, None
        if camera is not None:
            with contextlib.suppress(_glib_error()):  # stopping a lost camera raises an error
                camera.stop_acquisition()

    def _opened(self) -> tuple[Any, Any]:
        if self._camera is None or self._stream is None:
            raise NotResponding(self.name, "is not open")
        return self._camera, self._stream

    @contextlib.contextmanager
    def _during(self, doing: str) -> Iterator[None]:
        """Convert errors of Aravis into a DeviceError that states the failed step."""
        try:
            yield
        except _glib_error() as error:
            raise NotResponding(self.name, f"failed while {doing}: {error}") from error

    def _set_up(self, aravis: Any, camera: Any) -> None:
        settings = self._settings
        if not camera.is_software_trigger_supported():
            raise Refused(self.name, f"{camera.get_model_name()} does not support software triggers")
        with contextlib.suppress(_glib_error()):
            # A camera whose program was killed continues to acquire, and its format is then locked.
            camera.stop_acquisition()
        offered = camera.dup_available_pixel_formats_as_strings()
        if settings.pixel_format not in offered:
            raise Refused(
                self.name, f"has no pixel format {settings.pixel_format}; it offers {', '.join(offered)}"
            )
        camera.set_pixel_format_from_string(settings.pixel_format)
        self._set_region(camera)
        self._set_gain(aravis, camera)
        camera.set_acquisition_mode(aravis.AcquisitionMode.CONTINUOUS)
        # The frame rate of many cameras limits the exposure time; the trigger disables the frame rate.
        camera.set_trigger("Software")
        if camera.is_exposure_auto_available():
            camera.set_exposure_time_auto(aravis.Auto.OFF)
        low, high = camera.get_exposure_time_bounds()
        self._bounds = round(low * _MICROSECOND_NS), round(high * _MICROSECOND_NS)
        self.check(settings.exposure_ns)
        self._set_exposure(camera, settings.exposure_ns)
        stream = camera.create_stream(None, None)
        if stream is None:
            raise NotResponding(self.name, "cannot open a stream: does another program use the camera?")
        payload = camera.get_payload()
        for _ in range(settings.buffers):
            stream.push_buffer(aravis.Buffer.new_allocate(payload))
        self._lost = False
        camera.get_device().connect("control-lost", self._on_lost)
        camera.start_acquisition()
        self._stream = stream
        self._success = aravis.BufferStatus.SUCCESS
        self._numbers.begin_again()
        self._last = None

    def _on_lost(self, _: Any) -> None:
        self._lost = True

    def _set_region(self, camera: Any) -> None:
        """Set the image region to the sensor centre, rounded down to the camera's offset increments."""
        columns, rows = self._settings.columns, self._settings.rows
        width, height = camera.get_sensor_size()
        if columns > width or rows > height:
            raise Refused(
                self.name, f"its sensor has {width} x {height} pixels; {columns} x {rows} are requested"
            )
        step_x, step_y = camera.get_x_offset_increment(), camera.get_y_offset_increment()
        x, y = (width - columns) // 2, (height - rows) // 2
        camera.set_region(x - x % max(step_x, 1), y - y % max(step_y, 1), columns, rows)
        region = camera.get_region()
        if (region[2], region[3]) != (columns, rows):
            raise Refused(
                self.name,
                f"reads {region[2]} x {region[3]} pixels, not {columns} x {rows}: give a supported size",
            )

    def _set_gain(self, aravis: Any, camera: Any) -> None:
        gain = self._settings.gain
        if camera.is_gain_auto_available():
            camera.set_gain_auto(aravis.Auto.OFF)
        if gain is None:
            return
        if not camera.is_gain_available():
            raise Refused(self.name, "has no adjustable gain: omit `gain`")
        low, high = camera.get_gain_bounds()
        if not low <= gain <= high:
            raise OutOfRange(self.name, "gain", gain, low, high, "")
        camera.set_gain(gain)
        actual = camera.get_gain()
        if not abs(actual - gain) <= _GAIN_TOLERANCE * (high - low):
            raise Refused(self.name, f"its gain is {actual:g} after {gain:g} was set: give a supported gain")

    def _set_exposure(self, camera: Any, exposure_ns: int) -> None:
        camera.set_exposure_time(exposure_ns / _MICROSECOND_NS)
        self._asked_ns = exposure_ns
        self._exposure_ns = round(camera.get_exposure_time() * _MICROSECOND_NS)

    def _number_of(self, buffer: Any) -> int:
        number = self._numbers.number(buffer.get_frame_id())
        if self._last is not None:
            self.counts.missed += max(0, number - self._last - 1)
        self._last = number
        return number

    def _judge(self, buffer: Any) -> Frame | None:
        """Return the frame in a buffer if it is the triggered frame, otherwise None."""
        now_ns = self._clock.now_ns()
        number = self._number_of(buffer)
        if buffer.get_status() != self._success:
            self.counts.spoiled += 1
            return None
        # A frame that arrives before the end of the exposure was not triggered.
        if self._start_ns is None or now_ns < self._start_ns + self._exposure_ns:
            return None
        rows, columns = self._settings.rows, self._settings.columns
        data = buffer.get_data()
        if len(data) < rows * columns * self._kind.itemsize:
            self.counts.short += 1
            return None
        pixels = np.frombuffer(data, self._kind, rows * columns).reshape(rows, columns)
        native = pixels.astype(self._kind.newbyteorder("="), copy=False)
        return Frame(number, self._start_ns, self._exposure_ns, now_ns, native)


def library(name: str) -> Any:
    """Return the Aravis library. Raises Refused with installation advice if Aravis is not installed."""
    try:
        if importlib.util.find_spec("aravis") is not None:
            importlib.import_module("aravis")  # the PyPI package registers the library for introspection
        gi = importlib.import_module("gi")
        gi.require_version("Aravis", "0.8")
        importlib.import_module("gi.repository.GLib")
        return importlib.import_module("gi.repository.Aravis")
    except (ImportError, ValueError, OSError) as error:
        raise Refused(name, f"{CURE} ({error})") from error


def _glib_error() -> type[Exception]:
    kind: type[Exception] = importlib.import_module("gi.repository.GLib").Error
    return kind
