"""Runs commands of the flight software with Video for Linux cameras whose frames are rendered.

`python -m tests.deploy.emulated_video CONFIG SOCKET WORDS... [-- WORDS...]` runs the commands `knightcube
WORDS...` in order until a command fails. The device server at SOCKET renders the frames for the cameras of
CONFIG, which are numbered in the order of CONFIG. The program replaces only the ioctls of /dev/videoN, which
the kernel otherwise performs. The driver's memory-mapped buffers are real files.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flight.app.cli import main
from flight.schema import reader
from flight.schema.devices import Camera, V4l2Device, WideCamera
from hal.buses.system import SystemClock
from hal.drivers import v4l2_camera as v4l2
from sim_hal.rig import RemoteFrameSource
from tests.hal.cameras.ioctl_camera import IoctlCamera, Knob

STAR_INTERVAL_NS, WIDE_INTERVAL_NS = 500_000_000, 1_000_000_000
"""Shortest intervals (ns) of the frames of a free-running star camera and wide camera.

Each frame is rendered, even if the driver selects a later frame.
"""
PATIENCE_NS = 3_000_000_000
"""Time (ns) after an exposure at which a frame that has not arrived is counted as lost."""


class ServedVideo(IoctlCamera):
    """A free-running camera whose frames are rendered by a device server.

    The exposure of a frame begins when the previous frame has arrived, so the interval between frames depends
    on the rendering time.
    """

    def __init__(self, camera: Camera | WideCamera, source: RemoteFrameSource, clock: SystemClock) -> None:
        """Create the device file of `camera` at its configured path."""
        device = camera.device
        assert isinstance(device, V4l2Device)
        folder = Path(device.path).parent
        folder.resolve().mkdir(exist_ok=True)  # only root may write to this folder, which may be a link
        super().__init__(folder, clock.now_ns)
        assert str(self.path) == device.path
        self.sizes = {device.pixel_format: (camera.columns, camera.rows)}
        self.knobs[v4l2.EXPOSURE_ABSOLUTE] = Knob(1, 50_000, 157)
        self._source = source
        self._interval_ns = STAR_INTERVAL_NS if isinstance(camera, Camera) else WIDE_INTERVAL_NS
        self._abandoned_ns = 0

    @property
    def inode(self) -> int:
        """Inode number of the memory file that represents the device."""
        return os.fstat(self._memory).st_ino

    def _streamon(self, argument: Any) -> None:
        super()._streamon(argument)
        self._abandoned_ns = 0

    def _run(self) -> None:
        """Deliver the frame that has been rendered, and begin the next exposure at the time of this frame."""
        if not self._streaming:
            return
        frame, now_ns = self._source.poll(), self._now_ns()
        if frame is not None and self._abandoned_ns:
            self.raw = np.ascontiguousarray(frame.pixels).tobytes()
            end_ns = frame.exposure_start_ns + frame.exposure_ns + self.readout_ns
            self._finish(frame.exposure_start_ns, end_ns, frame.exposure_ns)
            self._next_ns = max(now_ns, frame.exposure_start_ns + self._interval_ns)
            self._abandoned_ns = 0
        if now_ns >= (self._abandoned_ns or self._next_ns):
            exposure_ns = self.knobs[v4l2.EXPOSURE_ABSOLUTE].value * v4l2.EXPOSURE_UNIT_NS
            self._source.trigger(exposure_ns)
            self._abandoned_ns = now_ns + exposure_ns + PATIENCE_NS


def plug(path: Path, socket: Path) -> None:
    """Create the cameras of a configuration, so that the driver for Video for Linux finds them."""
    config, clock = reader.load(path), SystemClock()
    cameras = [camera for camera in (config.camera, *config.wide_cameras) if camera is not None]
    videos = [
        ServedVideo(camera, RemoteFrameSource(socket, clock, number), clock)
        for number, camera in enumerate(cameras)
    ]
    by_inode = {video.inode: video for video in videos}

    def ioctl(descriptor: int, request: int, argument: Any) -> int:
        return by_inode[os.fstat(descriptor).st_ino](descriptor, request, argument)

    vars(v4l2)["ioctl"] = ioctl  # replaces the ioctls of the kernel


def run(words: Sequence[str]) -> int:
    """Run commands that are separated by "--", and return the exit status of the last command."""
    first, rest = list(words), []
    if "--" in words:
        at = list(words).index("--")
        first, rest = first[:at], first[at + 1 :]
    return main(first) or (run(rest) if rest else 0)


if __name__ == "__main__":
    plug(Path(sys.argv[1]), Path(sys.argv[2]))
    raise SystemExit(run(sys.argv[3:]))
