"""Imaging: triggers the star camera, hands frames to the vision worker, and its rates to navigation.

A frame is known to be of a living camera by its sequence number, its pixels and its age.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flight import events
from flight.arrays import FloatArray
from flight.events import Condition, EventLog
from flight.executive.jobs import JobResult, JobRunner
from flight.executive.rate_group import Cycle
from flight.pinhole import Pinhole
from flight.quaternion import attitude_matrix
from flight.tasks.navigation import Navigation
from flight.telemetry.definitions import STREAK
from flight.telemetry.recorder import Recorder
from flight.vision.job import Found, StreakJob
from flight.vision.likelihood.settings import LikelihoodSettings
from flight.vision.settings import StreakSettings
from flight.vision.streak_rate import StreakStatus
from hal.interfaces.devices import FrameSource
from hal.interfaces.errors import DeviceError
from hal.interfaces.readings import Frame

WORKER = "vision"


@dataclass(frozen=True, slots=True)
class ImagingSettings:
    """The camera as vision must know it; `mounting` (4,) takes the body's axes to the camera's."""

    pinhole: Pinhole
    exposure_ns: int
    max_age_ns: int
    mounting: FloatArray
    estimator: StreakSettings | LikelihoodSettings


class Imaging:
    """Owns the frame that is being worked on and the watch over the camera."""

    def __init__(
        self,
        camera: FrameSource,
        settings: ImagingSettings,
        navigation: Navigation,
        jobs: JobRunner,
        recorder: Recorder,
        event_log: EventLog,
    ) -> None:
        self._camera = camera
        self._settings = settings
        self._navigation = navigation
        self._jobs = jobs
        self._recorder = recorder
        self._events = event_log
        self._body_to_camera = attitude_matrix(settings.mounting)
        self._frame: Frame | None = None
        self._last_sequence = -1
        self._last_checksum: int | None = None
        self._last_frame_ns = 0
        self._lost = Condition(event_log, events.CAMERA_LOST, events.CAMERA_RECOVERED)
        self.frames = 0
        self.accepted = 0

    def begin(self, time_ns: int) -> None:
        """Count the camera's age from here."""
        self._last_frame_ns = time_ns

    def trigger(self, cycle: Cycle) -> None:
        """Start an exposure: the task of the camera's rate group."""
        try:
            self._camera.trigger(self._settings.exposure_ns)
        except DeviceError as error:
            self._lost.update(True, cycle.start_ns, str(error))

    def serve(self, now_ns: int) -> None:
        """Take in a finished frame, if there is one, and hand it to the worker."""
        frame = self._poll(now_ns)
        age_ns = now_ns - self._last_frame_ns
        if frame is None:
            if age_ns > self._settings.max_age_ns:
                self._lost.update(True, now_ns, f"no frame for {age_ns * 1e-9:.1f} s")
            return
        self._lost.update(False, now_ns, f"frame {frame.sequence} has come")
        self._last_frame_ns = now_ns
        self.frames += 1
        if frame.sequence <= self._last_sequence:
            text = f"frame {frame.sequence} comes again"
            self._events.tell(events.CAMERA_FROZEN, now_ns, text)
            self._record(frame, StreakStatus.FROZEN.value, None, now_ns, False)
            return
        self._last_sequence = frame.sequence
        if self._jobs.submit(WORKER, self._job(frame)):
            self._frame = frame
        else:
            self._events.tell(events.VISION_FAILED, now_ns, "the worker has not finished the last frame")

    def finish(self, result: JobResult, now_ns: int) -> None:
        """Take in what the worker found."""
        frame, self._frame = self._frame, None
        if frame is None:
            return
        if result.outcome != "done":
            self._events.tell(events.VISION_FAILED, now_ns, f"{result.outcome}: {result.error}")
            self._record(frame, StreakStatus.FAILED.value, None, now_ns, False)
            return
        found: Found = result.value
        self._last_checksum = found.checksum
        if found.status is StreakStatus.FROZEN:
            self._events.tell(
                events.CAMERA_FROZEN, now_ns, f"frame {frame.sequence} has the pixels of the last"
            )
        elif found.status in {StreakStatus.BLACK, StreakStatus.SATURATED}:
            self._events.tell(events.CAMERA_BLACK, now_ns, f"frame {frame.sequence} is {found.status.value}")
        accepted = found.status is StreakStatus.RATE and self._use(frame, found, now_ns)
        self._record(frame, found.status.value, found, now_ns, accepted)

    def _poll(self, now_ns: int) -> Frame | None:
        try:
            return self._camera.poll()
        except DeviceError as error:
            self._lost.update(True, now_ns, str(error))
            return None

    def _job(self, frame: Frame) -> StreakJob:
        past = self._navigation.past_rate(frame.exposure_start_ns + frame.exposure_ns // 2)
        rate, sigma = past if past is not None else (0.0, math.inf)
        prior = self._body_to_camera @ np.array([0.0, rate, 0.0]) if past is not None else None
        return StreakJob(
            frame.pixels,
            self._settings.pinhole,
            frame.exposure_ns * 1e-9,
            self._settings.estimator,
            prior,
            sigma,
            self._last_checksum,
        )

    def _use(self, frame: Frame, found: Found, now_ns: int) -> bool:
        """Give the mean rate about the thread over the exposure to navigation."""
        start_ns = frame.exposure_start_ns
        if self._navigation.past_rate(start_ns) is None:
            return False  # exposed before there was an estimate
        rate, covariance = self._in_body(found)
        accepted = self._navigation.take_mean_rate(
            start_ns, start_ns + frame.exposure_ns, float(rate[1]), float(covariance[1, 1])
        )
        if accepted:
            self.accepted += 1
        else:
            text = f"frame {frame.sequence}: {rate[1]:.5f} rad/s +- {math.sqrt(covariance[1, 1]):.1e}"
            self._events.tell(events.STREAK_REFUSED, now_ns, text)
        return accepted

    def _in_body(self, found: Found) -> tuple[FloatArray, FloatArray]:
        """Return rate and covariance in body axes; NaN when there is none."""
        if found.rate is None or found.covariance is None:
            return np.full(3, np.nan), np.full((3, 3), np.nan)
        turn = self._body_to_camera.T
        return turn @ found.rate, turn @ found.covariance @ turn.T

    def _record(self, frame: Frame, status: str, found: Found | None, now_ns: int, accepted: bool) -> None:
        nan = np.full(3, np.nan), np.full((3, 3), np.nan)
        rate, c = self._in_body(found) if found is not None else nan
        self._recorder.record(
            STREAK,
            now_ns,
            sequence=frame.sequence,
            exposure_start_ns=frame.exposure_start_ns - self._recorder.epoch_ns,
            exposure=frame.exposure_ns * 1e-9,
            status=status,
            streaks=found.found if found else 0,
            used=found.used_count if found else 0,
            length=found.length if found else math.nan,
            rate=rate.tolist(),
            covariance=[c[0, 0], c[1, 1], c[2, 2], c[0, 1], c[0, 2], c[1, 2]],
            residual=found.residual if found else math.nan,
            accepted=int(accepted),
        )
