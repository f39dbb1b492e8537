"""When the frames of a V4L2 camera were exposed, from the kernel's stamps.

A stamp is of the exposure's start (SOE) or of the frame's end, as the driver flags it. The kernel's uvcvideo
always flags SOE, yet unless its parameter `hwtimestamps` is set it stamps the arrival of the frame's first
packet (uvc_video_decode_start), when the exposure has ended: `Stamp.TOLD` takes that into account.
"""

from __future__ import annotations

from pathlib import Path

from hal.buses import videodev2
from hal.buses.v4l2 import Filled
from hal.drivers.camera import CameraCounts
from hal.drivers.v4l2_settings import Stamp, V4l2Settings
from hal.interfaces.errors import CorruptData, Refused
from hal.interfaces.wires import Clock

UVC_STAMPS = Path("/sys/module/uvcvideo/parameters/hwtimestamps")

# A stamp may be ahead of the clock by its rounding and by the fit of a camera's clock to the host's.
_STAMP_AHEAD_NS = 10_000_000
# Of the exposure: a shorter interval between frames contradicts the exposure.
_INTERVAL_SLACK = 0.05
_CONTRADICTIONS = 3


class ExposureTiming:
    """Derives the start of each exposure; detects a camera that exposes for less time than it claims."""

    def __init__(self, settings: V4l2Settings, clock: Clock, counts: CameraCounts) -> None:
        """Use the camera's settings and clock; contradictory frames are added to `counts`."""
        self._name = settings.path
        self._settings = settings
        self._clock = clock
        self._counts = counts
        self._arrival_stamps = False
        self._contradictions = 0

    def begin(self, driver: str) -> None:
        """Begin with a camera of this kernel driver."""
        self._arrival_stamps = driver == "uvcvideo" and not _uvc_uses_device_clock()
        self._contradictions = 0

    def start_of(self, filled: Filled, exposure_ns: int) -> int:
        """Return when a frame's exposure began. Raises CorruptData for a stamp of another clock."""
        if filled.flags & videodev2.STAMP_MASK != videodev2.STAMP_MONOTONIC:
            raise CorruptData(self._name, "stamps its frames by another clock than the monotonic one")
        ahead_ns = filled.stamp_ns - self._clock.now_ns()
        if ahead_ns > _STAMP_AHEAD_NS:
            raise CorruptData(
                self._name,
                f"a frame is stamped {ahead_ns * 1e-9:.3f} s ahead of the monotonic clock: "
                "has uvcvideo been loaded with clock=CLOCK_REALTIME?",
            )
        flagged_start = filled.flags & videodev2.STAMP_SOURCE_MASK == videodev2.STAMP_START_OF_EXPOSURE
        stamp = self._settings.stamp
        at_start = stamp is Stamp.START or (
            stamp is Stamp.TOLD and flagged_start and not self._arrival_stamps
        )
        start_ns = filled.stamp_ns - self._settings.stamp_delay_ns
        return start_ns if at_start else start_ns - exposure_ns

    def contradicts(self, interval_ns: int, exposure_ns: int) -> bool:
        """Return whether a frame followed the previous one sooner than its exposure takes.

        A rate is the streak's length over the exposure: a camera that exposes for less time than it claims
        makes every rate wrong. One such frame may have a late stamp; several in a row raise Refused.
        """
        if interval_ns >= exposure_ns * (1.0 - _INTERVAL_SLACK):
            self._contradictions = 0
            return False
        self._counts.contradictory += 1
        self._contradictions += 1
        if self._contradictions >= _CONTRADICTIONS:
            raise Refused(
                self._name,
                f"frames come every {interval_ns * 1e-6:.1f} ms, so none is exposed for the "
                f"{exposure_ns * 1e-6:.1f} ms that the camera claims: ask for a shorter exposure",
            )
        return True


def _uvc_uses_device_clock() -> bool:
    try:
        return UVC_STAMPS.read_text(encoding="ascii").strip() not in {"0", "N"}
    except OSError:
        return False  # the kernel's default
