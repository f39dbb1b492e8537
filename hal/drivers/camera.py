"""A `FrameSource` for a camera whose calls may take long, served in parallel to the control loop.

Triggering, fetching, setting controls and reopening a camera may each take milliseconds to seconds (an
unanswered USB control transfer: five). A job of the clock does all of it; `trigger` and `poll`, which the
control loop calls, only exchange requests and frames with that job.
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
    """Counts of frames by outcome since start; they only grow.

    Attributes:
        delivered: frames returned by `poll` or ready for it.
        spoiled: frames that the device flagged as damaged.
        short: frames with fewer than all their pixels.
        contradictory: frames that followed the previous one sooner than their exposure allows.
        missed: frames that never arrived, by the gaps in the sequence numbers.
        openings: how often the camera was opened.
    """

    delivered: int = 0
    spoiled: int = 0
    short: int = 0
    contradictory: int = 0
    missed: int = 0
    openings: int = 0


class CameraDevice(Protocol):
    """A camera's driver; calls come from one thread at a time, except `check`.

    `check` may be called at the same time as another method.
    """

    name: str
    counts: CameraCounts

    def open(self) -> None:
        """Open the camera and set it up. Raises DeviceError, with the cure."""

    def check(self, exposure_ns: int) -> None:
        """Raise OutOfRange for an exposure that the camera cannot make."""

    def expose(self, exposure_ns: int, trigger_ns: int) -> None:
        """Start, or select, an exposure that begins at the trigger or later. Raises DeviceError."""

    def collect(self) -> Frame | None:
        """Return that exposure's frame once, None until it arrives. Never waits. Raises DeviceError."""

    def close(self) -> None:
        """Release the camera. Safe to call when it is not open."""


class ServedCamera:
    """Implements `hal.interfaces.devices.FrameSource`; reopens a lost camera.

    Attributes:
        name: name of the device.
        counts: counts of its frames by outcome.
    """

    def __init__(self, device: CameraDevice, clock: Clock, patient: bool = False) -> None:
        """Open the camera and serve it.

        Raises DeviceError when it cannot be opened; a `patient` camera counts as lost until it opens.

        A camera that delivers nothing within `PATIENCE_NS` and six exposures after a trigger is reopened; a
        free-running camera may be in an exposure, and may need several more to apply a new setting.
        """
        self.name = device.name
        self.counts = device.counts
        self._device = device
        self._clock = clock
        self._lock = threading.Lock()
        self._asked: tuple[int, int] | None = None  # exposure, trigger: not yet passed to the device
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
        """Start one exposure now; an exposure that is under way is abandoned.

        Raises NotResponding while the camera is lost, OutOfRange for an exposure that it cannot make.
        """
        self._device.check(exposure_ns)
        with self._lock:
            self._raise_failure()
            self._asked = exposure_ns, self._clock.now_ns()
        self._ticker.kick()

    def poll(self) -> Frame | None:
        """Return the newest finished frame once, None without a new one. Never blocks.

        Raises the DeviceError that prevents frames, while it lasts.
        """
        with self._lock:
            frame, self._frame = self._frame, None
            if frame is None:
                self._raise_failure()
            return frame

    def close(self) -> None:
        """Release the camera. Safe to call twice."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            self._failure = NotResponding(self.name, "the camera was closed")
        self._ticker.stop()
        self._device.close()

    def _raise_failure(self) -> None:
        if self._failure is not None:
            # A new exception each time: one that is raised repeatedly grows its traceback.
            raise type(self._failure)(self._failure.device, self._failure.message)

    def _serve(self) -> None:
        """Exchange requests and frames with the device; the job of the ticker."""
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
                if self._asked is None:  # otherwise abandoned while the device was busy
                    self._frame = frame
                    self.counts.delivered += 1

    def _advance(self) -> Frame | None:
        with self._lock:
            asked, self._asked = self._asked, None
        if asked is not None:
            exposure_ns, trigger_ns = asked
            self._deadline_ns = trigger_ns + _MOST_EXPOSURES * exposure_ns + PATIENCE_NS
            self._device.expose(exposure_ns, trigger_ns)
        frame = self._device.collect()
        if frame is None and self._deadline_ns is not None and self._clock.now_ns() > self._deadline_ns:
            raise NotResponding(
                self.name, "no frame arrived after the trigger: check the camera and its cable"
            )
        return frame

    def _reopened(self) -> bool:
        """Try to open the camera when a retry is due; return whether it is open."""
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
        """Close a camera that fails and drop the pending request."""
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
    """Continues the camera's frame numbers where they wrap around or restart.

    Repeated numbers and small steps back are preserved, so that a frozen camera can be detected.
    """

    def __init__(self, modulus: int) -> None:
        """Count modulo `modulus`, one more than the camera's highest number."""
        self._modulus = modulus
        self._last = -1
        self._offset = 0

    def begin_again(self) -> None:
        """Continue from the last number whatever the camera's next one is: it was reopened."""
        self._offset = self._last + 1

    def number(self, count: int) -> int:
        """Return the frame's number."""
        number = count + self._offset
        if number < self._last - self._modulus // 2:
            self._offset += self._modulus
            number += self._modulus
        self._last = max(self._last, number)
        return number
