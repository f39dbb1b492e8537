"""Emulated camera that exposes along the body's true motion and delivers the frame after the read-out.

The attitude is sampled every 10 ms during an exposure, and the renderer integrates the light along the
sampled attitude. The renderer returns a future, so that another process can render in real time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hal.interfaces.devices import Frame
from hal.interfaces.errors import NotResponding
from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.quaternion import multiply
from sim_hal.clock import NEVER
from sim_hal.worlds.world import BodyMotion

if TYPE_CHECKING:
    from sim_hal.star_camera import SourceTrack

SAMPLE_NS = 10_000_000

Expose = Callable[[int, FloatArray, FloatArray, "Sequence[SourceTrack]"], "Future[Image]"]
"""Function that renders a frame, given its number, times (k,), s, attitudes (k, 4) and object tracks."""
Moving = Callable[[int, FloatArray], "Sequence[SourceTrack]"]
"""Function that returns object tracks, given an exposure's start (ns) and times (k,), s, since the start."""


def no_objects(_: int, __: FloatArray) -> Sequence[SourceTrack]:
    """Return no tracks, for a sky without moving objects."""
    return ()


@dataclass(slots=True)
class _Exposure:
    sequence: int
    start_ns: int
    length_ns: int
    scan_ns: int
    times: list[int]
    attitudes: list[FloatArray]
    image: Future[Image] | None = None

    @property
    def end_ns(self) -> int:
        return self.start_ns + self.length_ns + self.scan_ns


class EmulatedCamera:
    """An emulated camera, which implements FrameSource and EmulatedDevice.

    Attributes:
        fault: present fault, which is "off", "frozen", "torn" or a key of `SPOILT`, or an empty text.
        late_ns: additional delay of the frames, ns.
        one_of: number n of triggers per frame; a camera with n > 1 has a fault and reacts only to every n-th
            trigger.
    """

    def __init__(
        self,
        motion: Callable[[int], BodyMotion],
        expose: Expose,
        now_ns: Callable[[], int],
        readout_ns: int,
        mounting: FloatArray,
        scan_ns: int = 0,
        moving: Moving = no_objects,
    ) -> None:
        """Connect the camera. The last row of a rolling shutter has the delay `scan_ns`."""
        self._motion, self._expose, self._now_ns = motion, expose, now_ns
        self._readout_ns, self._mounting, self._scan_ns = readout_ns, mounting, scan_ns
        self._moving = moving
        self._sequence = 0
        self._exposure: _Exposure | None = None
        self._last: Frame | None = None
        self.fault = ""
        self.late_ns = 0
        self.one_of = 1
        self._unanswered = 0

    @property
    def exposures(self) -> int:
        """Number of exposures since the start."""
        return self._sequence

    def trigger(self, exposure_ns: int) -> None:
        """Start an exposure and abandon an exposure in progress, as the reset of a camera does."""
        if self.fault == "off":
            raise NotResponding("camera", "does not answer the trigger")
        self._unanswered += 1
        if self._unanswered < self.one_of:
            return
        self._unanswered = 0
        self._sequence += 1
        self._exposure = _Exposure(self._sequence, self._now_ns(), exposure_ns, self._scan_ns, [], [])
        self.advance(self._now_ns())

    def poll(self) -> Frame | None:
        """Return the newest frame once, when its read-out has ended, otherwise None."""
        exposure, now_ns = self._exposure, self._now_ns()
        if exposure is None or exposure.image is None or not exposure.image.done():
            return None
        if now_ns < exposure.end_ns + self._readout_ns + self.late_ns:
            return None
        self._exposure = None
        if self.fault == "off":
            return None
        frame = Frame(
            exposure.sequence, exposure.start_ns, exposure.length_ns, now_ns, exposure.image.result()
        )
        shown = self._alter(frame)
        self._last = shown if self.fault == "frozen" else frame
        return shown

    def next_event_ns(self) -> int:
        """Return the time of the next attitude sample."""
        exposure = self._exposure
        if exposure is None or exposure.image is not None:
            return NEVER
        if not exposure.times:
            return exposure.start_ns
        return min(exposure.times[-1] + SAMPLE_NS, exposure.end_ns)

    def advance(self, now_ns: int) -> None:
        """Sample the attitude, and start the rendering at the end of the exposure."""
        while (event_ns := self.next_event_ns()) <= now_ns:
            exposure = self._exposure
            assert exposure is not None
            exposure.times.append(event_ns)
            exposure.attitudes.append(multiply(self._mounting, self._motion(event_ns).quaternion))
            if event_ns >= exposure.end_ns:
                times = (np.array(exposure.times) - exposure.start_ns) * 1e-9
                tracks = self._moving(exposure.start_ns, times)
                attitudes = np.array(exposure.attitudes)
                exposure.image = self._expose(exposure.sequence, times, attitudes, tracks)

    def close(self) -> None:
        """Abandon the exposure in progress."""
        self._exposure = None

    def _alter(self, frame: Frame) -> Frame:
        """Return the frame with the changes that the present fault makes."""
        if self.fault == "frozen" and self._last is not None:
            return replace(frame, sequence=self._last.sequence, pixels=self._last.pixels)
        if self.fault == "torn" and self._last is not None:
            middle = len(frame.pixels) // 2
            pixels = np.concatenate([self._last.pixels[:middle], frame.pixels[middle:]])
            return replace(frame, pixels=pixels)
        if self.fault in SPOILT:
            return replace(frame, pixels=SPOILT[self.fault](frame.pixels, frame.sequence))
        return frame


def _garbage(pixels: Image, seed: int) -> Image:
    top = np.iinfo(pixels.dtype).max
    return np.asarray(np.random.default_rng(seed).integers(0, top, pixels.shape).astype(pixels.dtype))


def blinded(pixels: Image, seed: int) -> Image:
    """Return a frame with stray light that is saturated at one edge and falls off across the frame."""
    rows, columns = pixels.shape
    top = np.iinfo(pixels.dtype).max
    angle = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi)
    y, x = np.mgrid[0:rows, 0:columns] / max(rows, columns) - 0.5
    away = np.hypot(x - 0.7 * np.cos(angle), y - 0.7 * np.sin(angle))
    veil = top * (0.1 + 1.5 * np.exp(-((away / 0.5) ** 2)))
    return np.asarray(np.clip(pixels + veil, 0, top).astype(pixels.dtype))


def capped(pixels: Image, seed: int) -> Image:
    """Return a frame as taken with a lens cap: the level and the noise of pixels without a star."""
    level = float(np.median(pixels))
    noise = 1.4826 * float(np.median(np.abs(pixels - level)))
    dark = np.random.default_rng(seed).normal(level, noise, pixels.shape)
    return np.asarray(np.clip(np.round(dark), 0, np.iinfo(pixels.dtype).max).astype(pixels.dtype))


SPOILT: dict[str, Callable[[Image, int], Image]] = {
    "black": lambda pixels, _: np.zeros_like(pixels),
    "saturated": lambda pixels, _: np.full_like(pixels, np.iinfo(pixels.dtype).max),
    "blinded": blinded,
    "capped": capped,
    "covered": lambda pixels, seed: np.random.default_rng(seed).integers(0, 3, pixels.shape, pixels.dtype),
    "garbage": _garbage,
    "wrong": lambda pixels, _: np.ascontiguousarray(pixels[::-1]),
}
"""Function of each fault that returns the changed pixels, given pixels (rows, columns) and frame number."""
