"""Frame sources for tests, each with a clock that tests can advance or wait for."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from hal.buses.system import SystemClock
from hal.drivers import aravis_camera
from hal.drivers.aravis_camera import AravisCamera, AravisSettings
from hal.drivers.camera import ServedCamera
from hal.drivers.v4l2_camera import Stamp, V4l2Camera, V4l2Settings
from hal.interfaces.devices import Frame, FrameSource
from hal.interfaces.errors import Refused
from hal.interfaces.wires import Clock
from knightcube.astro.arrays import FloatArray, Image
from sim_hal.emulators.camera import EmulatedCamera
from sim_hal.worlds.world import BodyMotion
from tests.hal.cameras.ioctl_camera import IoctlCamera
from tests.manual_clock import ManualClock

EXPOSURE_NS = 40_000_000
STEP_NS = 2_000_000
SETTLED_NS = 400_000_000


@dataclass(frozen=True, slots=True)
class Rig:
    """A frame source, its clock, and a function that unplugs the source, or None."""

    source: FrameSource
    clock: Clock
    shape: tuple[int, int]
    unplug: Callable[[], None] | None

    def wait(self, span_ns: int) -> None:
        """Advance the clock, or wait on a real clock."""
        self.clock.sleep_until_ns(self.clock.now_ns() + span_ns)

    def frame_within(self, span_ns: int) -> Frame | None:
        """Return the next frame, or None if none arrives."""
        deadline_ns = self.clock.now_ns() + span_ns
        while self.clock.now_ns() < deadline_ns:
            frame = self.source.poll()
            if frame is not None:
                return frame
            self.wait(STEP_NS)
        return None

    def next_frame(self) -> Frame:
        """Trigger an exposure and return the frame."""
        self.source.trigger(EXPOSURE_NS)
        frame = self.frame_within(2_000_000_000)
        assert frame is not None, "no frame came"
        return frame


@dataclass(frozen=True, slots=True)
class VideoRig:
    """A V4L2 camera that uses the test double of the kernel."""

    rig: Rig
    camera: ServedCamera
    kernel: IoctlCamera
    clock: ManualClock


class _World:
    """Runs an emulated camera while its clock advances."""

    def __init__(self, camera: EmulatedCamera) -> None:
        self._camera = camera

    def next_event_ns(self) -> int:
        return self._camera.next_event_ns()

    def advance_to(self, time_ns: int) -> None:
        self._camera.advance(time_ns)

    run_events = pass_to = advance_to


def emulated_rig() -> Rig:
    """Return the emulated camera with uniform images."""
    clock = ManualClock()

    def expose(sequence: int, _times: FloatArray, _attitudes: FloatArray, _tracks: object) -> Future[Image]:
        promise: Future[Image] = Future()
        promise.set_result(np.full((48, 64), sequence, np.uint16))
        return promise

    still = BodyMotion(0, np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3), np.zeros(3), np.zeros(3))
    camera = EmulatedCamera(lambda _: still, expose, clock.now_ns, 5_000_000, np.array([0.0, 0.0, 0.0, 1.0]))
    clock.attach(_World(camera))

    def unplug() -> None:
        camera.fault = "off"

    return Rig(camera, clock, (48, 64), unplug)


def video_rig(kernel: IoctlCamera, clock: ManualClock, **changes: object) -> VideoRig:
    """Return the V4L2 driver that uses the test double; `changes` are changed settings."""
    wanted: dict[str, object] = {
        "path": str(kernel.path),
        "columns": 64,
        "rows": 48,
        "pixel_format": "GREY",
        "exposure_ns": EXPOSURE_NS,
        "gain": None,
        "stamp": Stamp.TOLD,
        "stamp_delay_ns": 0,
    }
    settings = V4l2Settings(**(wanted | changes))  # type: ignore[arg-type]  # the values are the tests' own
    camera = ServedCamera(V4l2Camera(settings, clock), clock)
    return VideoRig(Rig(camera, clock, (48, 64), kernel.unplug), camera, kernel, clock)


def settled(kernel: IoctlCamera, clock: ManualClock, **changes: object) -> VideoRig:
    """Return a camera whose delivered frames all have the exposure that was set."""
    made = video_rig(kernel, clock, **changes)
    made.rig.wait(SETTLED_NS)
    return made


def require_aravis() -> None:
    """Skip the test if Aravis is not available in this Python."""
    with warnings.catch_warnings(action="ignore"):  # the import of PyGObject emits warnings
        try:
            aravis_camera.library("Fake_1")
        except Refused as error:
            pytest.skip(str(error))


def aravis_rig(**changes: object) -> Rig:
    """Return the Fake camera of Aravis, in real time."""
    require_aravis()
    clock = SystemClock()
    wanted: dict[str, object] = {
        "name": "Fake_1",
        "columns": 512,
        "rows": 256,
        "pixel_format": "Mono8",
        "exposure_ns": EXPOSURE_NS,
        "gain": None,
    }
    settings = AravisSettings(**(wanted | changes))  # type: ignore[arg-type]  # the values are the tests' own
    return Rig(ServedCamera(AravisCamera(settings, clock), clock), clock, (256, 512), None)


def kernel_in(folder: Path, clock: ManualClock, monkeypatch: pytest.MonkeyPatch) -> IoctlCamera:
    """Replace the kernel's V4L2 interface by a test double."""
    kernel = IoctlCamera(folder, clock.now_ns)
    monkeypatch.setattr("hal.drivers.v4l2_camera.ioctl", kernel)
    # The machine's kernel reports a setting of its UVC driver in a file. A file in `folder` replaces this
    # file.
    monkeypatch.setattr("hal.drivers.v4l2_camera.UVC_STAMPS", folder / "hwtimestamps")
    return kernel
