"""Camera service that operates a slow camera in parallel with the control loop.

Triggering, reading, configuring and reopening a camera can each take milliseconds to seconds. An unanswered
USB control transfer takes five seconds. A periodic job executes all slow camera operations. The methods
`trigger` and `poll`, which the control loop calls, only pass requests to the job and take frames from it.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Protocol

from hal.interfaces.devices import Frame
from hal.interfaces.errors import DeviceError, NotResponding, Refused
from hal.interfaces.wires import Clock

PERIOD_NS = 10_000_000
RETRY_NS = 1_000_000_000
PATIENCE_NS = 3_000_000_000
_MOST_EXPOSURES = 6


@dataclass(slots=True)
class CameraCounts:
    """Counts of camera frames by outcome since start, which never decrease.

    Attributes:
        delivered: number of frames returned by `poll` or ready to be returned.
        spoiled: number of frames that the device flagged as damaged.
        short: number of incomplete frames.
        absurd: number of frames with an impossible time stamp.
        contradictory: number of frames that arrived sooner after the previous frame than the exposure time
            allows.
        missed: number of frames that never arrived, counted from gaps in the frame numbers.
        openings: number of times the camera was opened.
    """

    delivered: int = 0
    spoiled: int = 0
    short: int = 0
    absurd: int = 0
    contradictory: int = 0
    missed: int = 0
    openings: int = 0


class CameraDevice(Protocol):
    """Interface of a camera driver.

    The method `check` may be called at any time; the other methods are called by one thread at a time.
    """

    name: str
    counts: CameraCounts

    def open(self) -> None:
        """Open and configure the camera. Raises DeviceError with advice for the user."""

    def check(self, exposure_ns: int) -> None:
        """Raise OutOfRange for an exposure time (ns) that the camera does not support."""

    def expose(self, exposure_ns: int, trigger_ns: int) -> None:
        """Start an exposure, or select the first exposure after the trigger time. Raises DeviceError."""

    def collect(self) -> Frame | None:
        """Return the frame of the started exposure once, or None until the frame arrives.

        Never blocks. Raises DeviceError.
        """

    def close(self) -> None:
        """Close the camera. The call has no effect if the camera is not open."""


class ServedCamera:
    """Camera operated by a periodic job, which also reopens a lost camera.

    The class implements `hal.interfaces.devices.FrameSource`.

    Attributes:
        name: name of the camera device.
        counts: counts of the camera's frames by outcome.
    """

    def __init__(self, device: CameraDevice, clock: Clock, patient: bool = False) -> None:
        """Open the camera and start the periodic job.

        Raises DeviceError if the camera cannot be opened. If `patient` is true, no error is raised: the
        camera counts as lost, and is opened later.

        The camera is reopened if no frame arrives within `PATIENCE_NS` plus six exposure times after the
        first unanswered trigger. A free-running camera may need several exposures until a new exposure time
        is effective.
        """
        self.name = device.name
        self.counts = device.counts
        self._device = device
        self._clock = clock
        self._lock = threading.Lock()
        self._asked: tuple[int, int] | None = None  # pending request: exposure and trigger time (ns)
        self._frame: Frame | None = None
        self._failure: DeviceError | None = None
        self._deadline_ns: int | None = None
        self._open = False
        self._retry_ns = clock.now_ns()
        self._closed = False
        try:
            self._open_device()
        except DeviceError as error:
            if not patient:
                raise
            self._drop(error)
        self._ticker = clock.ticker(f"camera {device.name}", PERIOD_NS, self._serve)

    def trigger(self, exposure_ns: int) -> None:
        """Start one exposure now and abandon an exposure in progress.

        Raises NotResponding while the camera is lost, and OutOfRange for an unsupported exposure time.
        """
        self._device.check(exposure_ns)
        with self._lock:
            self._raise_failure()
            self._asked = exposure_ns, self._clock.now_ns()
        self._ticker.kick()

    def poll(self) -> Frame | None:
        """Return the newest finished frame once, or None without a new frame. Never blocks.

        Raises DeviceError while the camera is lost.
        """
        with self._lock:
            frame, self._frame = self._frame, None
            if frame is None:
                self._raise_failure()
            return frame

    def close(self) -> None:
        """Close the camera. Calling `close` again has no effect."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            self._failure = NotResponding(self.name, "the camera was closed")
        self._ticker.stop()
        self._device.close()

    def _raise_failure(self) -> None:
        if self._failure is not None:
            # A new exception is created, because raising the same exception again would extend its traceback.
            raise type(self._failure)(self._failure.device, self._failure.message)

    def _serve(self) -> None:
        """Periodic job: pass requests to the camera device and take frames from it."""
        if not self._open and not self._reopened():
            return
        try:
            frame = self._advance()
        except DeviceError as error:
            self._drop(error)
            return
        if frame is not None:
            self._deadline_ns = None
            with self._lock:
                if self._asked is None:  # if there is a newer request, the frame is obsolete
                    self._frame = frame
                    self.counts.delivered += 1

    def _advance(self) -> Frame | None:
        with self._lock:
            asked, self._asked = self._asked, None
        if asked is not None:
            exposure_ns, trigger_ns = asked
            if self._deadline_ns is None:
                self._deadline_ns = trigger_ns + _MOST_EXPOSURES * exposure_ns + PATIENCE_NS
            self._device.expose(exposure_ns, trigger_ns)
        frame = self._device.collect()
        if frame is None and self._deadline_ns is not None and self._clock.now_ns() > self._deadline_ns:
            raise NotResponding(
                self.name, "no frame arrived after the trigger: check the camera and its cable"
            )
        return frame

    def _reopened(self) -> bool:
        """Try to open the camera if a retry is due, and return whether the camera was opened."""
        now_ns = self._clock.now_ns()
        if now_ns < self._retry_ns or self._closed:
            return False
        self._retry_ns = now_ns + RETRY_NS
        try:
            self._open_device()
        except DeviceError as error:
            self._drop(error)
            return False
        with self._lock:
            self._failure = None
        return True

    def _open_device(self) -> None:
        try:
            self._device.open()
        except DeviceError:
            self._device.close()
            raise
        self.counts.openings += 1
        self._open = True

    def _drop(self, error: DeviceError) -> None:
        """Close a failing camera and discard the pending request."""
        self._device.close()
        self._open = False
        self._deadline_ns = None
        self._retry_ns = self._clock.now_ns() + RETRY_NS
        kind = Refused if isinstance(error, Refused) else NotResponding
        with self._lock:
            self._asked = None
            if not self._closed:
                self._failure = kind(error.device, error.message)


class FrameNumbers:
    """Converter of a camera's frame numbers to numbers that keep increasing after a wrap-around or restart.

    Repeated numbers and small backward steps are preserved, so that a frozen camera can be detected.
    """

    def __init__(self, modulus: int) -> None:
        """Assume frame numbers modulo `modulus`, which is one more than the camera's highest frame number."""
        self._modulus = modulus
        self._last = -1
        self._offset = 0

    def begin_again(self) -> None:
        """Continue from the last number, because the camera was reopened and counts from zero again."""
        self._offset = self._last + 1

    def number(self, count: int) -> int:
        """Return the continued frame number for the camera's frame number `count`."""
        number = count + self._offset
        if number < self._last - self._modulus // 2:
            self._offset += self._modulus
            number += self._modulus
        self._last = max(self._last, number)
        return number
