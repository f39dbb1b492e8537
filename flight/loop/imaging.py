"""Imaging: triggers the star camera, hands frames to the vision worker, its findings to navigation.

A frame is known to be of a living camera by its sequence number, its pixels and its age, and to be the sky's
by its stars.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from flight.gnc.camera.lens import CameraModel
from flight.gnc.estimation.estimate import RATE, TURN, Estimate
from flight.gnc.estimation.measurements import AttitudeMeasurement, MeanRateMeasurement
from flight.gnc.math.arrays import FloatArray
from flight.gnc.math.quaternion import attitude_matrix, conjugate, multiply, to_rotation_vector
from flight.gnc.vision.startracker.frame_job import Found, FrameFound, FrameJob, TrackerSettings
from flight.gnc.vision.startracker.mid_exposure import NODES, doubt, reading_of
from flight.gnc.vision.startracker.solution import FrameSolution, SolveStatus
from flight.gnc.vision.startracker.solve import AttitudePrior, RatePrior
from flight.gnc.vision.streaks.corners.settings import StreakSettings
from flight.gnc.vision.streaks.maximum_likelihood.settings import LikelihoodSettings
from flight.gnc.vision.streaks.streak_result import StreakStatus
from flight.link import events
from flight.link.telemetry.definitions import STARS, STREAK
from flight.loop.body import BodyView
from flight.loop.executive.jobs import JobResult
from flight.loop.executive.rate_group import Cycle
from flight.loop.fdir import facts
from flight.loop.fdir.repeated_rows import RepeatedRows
from flight.loop.navigation import Navigation
from flight.loop.services import Services
from hal.interfaces.devices import FrameSource
from hal.interfaces.errors import DeviceError
from hal.interfaces.readings import Frame

WORKER = "vision"
# rad, of the mounting between the camera and the inertial unit that the estimate is of.
_LEAST_PRIOR_SIGMA = 5e-4
# Of so many that are taken for stars some are: a frame that they do not solve is not of the sky as it is.
_MANY_STARS = 12
_NAN = np.full(3, np.nan), np.full((3, 3), np.nan)


@dataclass(frozen=True, slots=True)
class ImagingSettings:
    """The camera as vision must know it.

    Attributes:
        late_ns: after the exposure, from which a frame is late.
        slow_ns: from which vision is slow over a frame.
        mounting: (4,) takes the body's axes to the camera's.
        angular_acceleration_psd: rad^2/s^3, density of the white angular acceleration that shakes the body.
    """

    camera: CameraModel
    exposure_ns: int
    max_age_ns: int
    late_ns: int
    slow_ns: int
    mounting: FloatArray
    estimator: StreakSettings | LikelihoodSettings
    tracker: TrackerSettings | None
    angular_acceleration_psd: float


class Imaging:
    """Owns the frame that is being worked on and the watch over the camera."""

    def __init__(
        self,
        camera: FrameSource,
        settings: ImagingSettings,
        navigation: Navigation,
        view: BodyView,
        services: Services,
    ) -> None:
        self._camera = camera
        self._settings = settings
        self._navigation = navigation
        self._view = view
        self._jobs = services.jobs
        self._recorder = services.recorder
        self._events = services.events
        self._facts = services.facts
        self._streams = services.streams
        self._body_to_camera = attitude_matrix(settings.mounting)
        self._frame: Frame | None = None
        self._last_sequence = -1
        self._last_checksum: int | None = None
        self._last_frame_ns = 0
        self._due_ns: int | None = None  # by when the oldest trigger without a frame should have one
        self._rows = RepeatedRows()
        self._busy_since_ns = 0
        self._frames = 0
        self._accepted = 0

    def counts(self) -> tuple[int, int]:
        """Return how many frames came, and how many rates from streaks entered the estimate."""
        return self._frames, self._accepted

    def busy_since_ns(self) -> int | None:
        """Return since when a frame is being worked on, None when none is."""
        return None if self._frame is None else self._busy_since_ns

    def begin(self, time_ns: int) -> None:
        """Count the camera's age from here."""
        self._last_frame_ns = time_ns

    def trigger(self, cycle: Cycle) -> None:
        """Start an exposure: the task of the camera's rate group."""
        try:
            self._camera.trigger(self._settings.exposure_ns)
        except DeviceError as error:
            self._facts.state(facts.CAMERA_LOST, True, cycle.start_ns, str(error))
            return
        if self._due_ns is None:
            # A camera that runs free is in an exposure already, and begins another one after it.
            patience_ns = 2 * self._settings.exposure_ns + self._settings.late_ns
            self._due_ns = cycle.start_ns + patience_ns

    def serve(self, now_ns: int) -> None:
        """Take in a finished frame, if there is one, and hand it to the worker."""
        self._look_at_worker(now_ns)
        frame = self._poll(now_ns)
        age_ns = now_ns - self._last_frame_ns
        if frame is None:
            if self._due_ns is not None and now_ns > self._due_ns:
                self._facts.state(facts.CAMERA_LATE, True, now_ns, "no frame yet after its trigger")
            if age_ns > self._settings.max_age_ns:
                self._facts.state(facts.CAMERA_LOST, True, now_ns, f"no frame for {age_ns * 1e-9:.1f} s")
            return
        if frame.sequence <= self._last_sequence:
            # A camera that repeats itself is no camera that gives frames: its age goes on.
            text = f"frame {frame.sequence} comes again"
            self._events.tell(events.CAMERA_FROZEN, now_ns, text)
            self._record_rate(frame, StreakStatus.FROZEN.value, None, now_ns, False)
            return
        self._due_ns = None
        # Old is what shows old light, however fresh it arrived.
        self._last_frame_ns = frame.exposure_start_ns + frame.exposure_ns
        age_ns = now_ns - self._last_frame_ns
        late = age_ns > self._settings.max_age_ns
        text = f"frame {frame.sequence} comes {age_ns * 1e-9:.1f} s after its exposure"
        self._facts.state(facts.CAMERA_LOST, late, now_ns, text)
        self._facts.state(facts.CAMERA_LATE, age_ns > self._settings.late_ns, now_ns, text)
        if not late:
            self._streams.note("camera", now_ns)
        old = self._rows.look(frame.pixels)
        if old:
            text = f"frame {frame.sequence}: {old} of the rows looked at are an earlier frame's"
            self._events.tell(events.CAMERA_TORN, now_ns, text)
        self._frames += 1
        self._last_sequence = frame.sequence
        if old:
            self._record_rate(frame, StreakStatus.FAILED.value, None, now_ns, False)
        elif self._jobs.submit(WORKER, self._job(frame)):
            self._frame = frame
            self._busy_since_ns = now_ns
        else:
            self._events.tell(events.VISION_FAILED, now_ns, "the worker has not finished the last frame")

    def finish(self, result: JobResult, now_ns: int) -> None:
        """Take in what the worker found."""
        frame, self._frame = self._frame, None
        if frame is None:
            return
        self._judge_speed(now_ns)
        if result.outcome != "done":
            self._events.tell(events.VISION_FAILED, now_ns, f"{result.outcome}: {result.error}")
            self._record_rate(frame, StreakStatus.FAILED.value, None, now_ns, False)
            return
        found: FrameFound = result.value
        motion = found.motion
        self._last_checksum = motion.checksum
        if motion.status is StreakStatus.FROZEN:
            self._events.tell(
                events.CAMERA_FROZEN, now_ns, f"frame {frame.sequence} has the pixels of the last"
            )
        elif motion.status in {StreakStatus.BLACK, StreakStatus.SATURATED}:
            self._events.tell(events.CAMERA_BLACK, now_ns, f"frame {frame.sequence} is {motion.status.value}")
        rate, attitude = self._mean_rate(frame, motion), self._attitude(frame, found)
        if _is_strange(found.solution):
            rate = None  # of pixels that are not in order
        known = self._navigation.past(_middle_ns(frame)) is not None
        late = [m for m in (rate, attitude if known else None) if m is not None]

        def told(accepted: list[bool]) -> None:
            took = dict(zip(map(type, late), accepted, strict=True))
            self._tell_rate(frame, motion, rate, now_ns, took.get(MeanRateMeasurement, False))
            if found.solution is not None:
                taken = took.get(AttitudeMeasurement)
                self._tell_stars(frame, found.solution, attitude, now_ns, taken)

        if late:
            self._navigation.ingest_late(late, told)
        else:
            told([])

    def _look_at_worker(self, now_ns: int) -> None:
        """Tell of a worker that is slow while it still is at it."""
        if self._frame is not None and now_ns - self._busy_since_ns > self._settings.slow_ns:
            self._judge_speed(now_ns)

    def _judge_speed(self, now_ns: int) -> None:
        taken_ns = now_ns - self._busy_since_ns
        text = f"{taken_ns * 1e-9:.2f} s over a frame, {self._settings.slow_ns * 1e-9:g} s expected"
        self._facts.state(facts.VISION_SLOW, taken_ns > self._settings.slow_ns, now_ns, text)

    def _poll(self, now_ns: int) -> Frame | None:
        try:
            return self._camera.poll()
        except DeviceError as error:
            self._facts.state(facts.CAMERA_LOST, True, now_ns, str(error))
            return None

    def _job(self, frame: Frame) -> FrameJob:
        past = self._navigation.past(_middle_ns(frame))
        return FrameJob(
            frame.pixels,
            self._settings.camera,
            frame.exposure_ns * 1e-9,
            self._estimator(past),
            self._settings.tracker,
            self._rate_prior(past) if past is not None else None,
            self._attitude_prior(past) if past is not None else None,
            self._last_checksum,
        )

    def _estimator(self, past: Estimate | None) -> StreakSettings | LikelihoodSettings:
        estimator = self._settings.estimator
        if past is None and isinstance(estimator, LikelihoodSettings):
            # Nobody knows how the rate changes, which draws the stars off mid-exposure: the pixels must tell.
            return replace(estimator, rate_model="accelerating")
        return estimator

    def _rate_prior(self, past: Estimate) -> RatePrior:
        widest = float(np.linalg.eigvalsh(past.covariance[RATE, RATE])[-1])
        return RatePrior(self._body_to_camera @ past.rate, math.sqrt(max(widest, 0.0)))

    def _attitude_prior(self, past: Estimate) -> AttitudePrior:
        widest = float(np.linalg.eigvalsh(past.covariance[TURN, TURN])[-1])
        sigma = math.sqrt(max(widest, 0.0) + _LEAST_PRIOR_SIGMA**2)
        return AttitudePrior(multiply(self._settings.mounting, past.quaternion), sigma)

    def _mean_rate(self, frame: Frame, motion: Found) -> MeanRateMeasurement | None:
        """Return the mean body rate over the exposure, None without one or before there was an estimate."""
        start_ns = frame.exposure_start_ns
        if motion.status is not StreakStatus.RATE or self._navigation.past(start_ns) is None:
            return None
        return MeanRateMeasurement(start_ns, start_ns + frame.exposure_ns, *self._rate_in_body(motion))

    def _tell_rate(
        self, frame: Frame, motion: Found, rate: MeanRateMeasurement | None, now_ns: int, accepted: bool
    ) -> None:
        self._accepted += accepted
        if rate is not None and not accepted:
            text = f"frame {frame.sequence}: {self._view.rate_text(rate)}"
            self._events.tell(events.STREAK_REFUSED, now_ns, text)
        self._record_rate(frame, motion.status.value, motion, now_ns, accepted)

    def _attitude(self, frame: Frame, found: FrameFound) -> AttitudeMeasurement | None:
        """Return the attitude at mid-exposure, None when the stars do not tell it."""
        fix = found.solution.fix if found.solution is not None else None
        if fix is None:
            return None
        turn = self._body_to_camera.T
        covariance = turn @ fix.covariance @ turn.T + self._off_middle(frame, found.motion)
        quaternion = multiply(conjugate(self._settings.mounting), fix.quaternion)
        return AttitudeMeasurement(_middle_ns(frame), quaternion, covariance)

    def _tell_stars(
        self,
        frame: Frame,
        solution: FrameSolution,
        attitude: AttitudeMeasurement | None,
        now_ns: int,
        accepted: bool | None,
    ) -> None:
        """Record what the stars said; `accepted` None when nobody was asked to take it."""
        if _is_strange(solution):
            text = f"frame {frame.sequence}: {len(solution.points)} stars that are nowhere in the sky"
            self._events.tell(events.CAMERA_STRANGE, now_ns, text)
        if accepted is False:
            text = f"frame {frame.sequence}: {len(solution.matched)} stars"
            self._events.tell(events.STARS_REFUSED, now_ns, text)
        quaternion = np.full(4, np.nan) if attitude is None else attitude.quaternion
        covariance = _NAN[1] if attitude is None else attitude.covariance
        self._recorder.record(
            STARS,
            now_ns,
            sequence=frame.sequence,
            middle_ns=_middle_ns(frame) - self._recorder.epoch_ns,
            status=solution.status.value,
            tracked=int(solution.tracked),
            found=len(solution.points),
            matched=len(solution.matched),
            quaternion=quaternion.tolist(),
            covariance=_packed(covariance),
            log10_false_alarm=solution.log10_false_alarm,
            accepted=int(bool(accepted)),
        )

    def _off_middle(self, frame: Frame, motion: Found) -> FloatArray:
        """Return by how much the stars' attitude may differ from that of mid-exposure, (3, 3) rad^2."""
        turns = np.zeros((len(NODES), 3))
        middle = self._navigation.past(_middle_ns(frame))
        if middle is not None:
            back = conjugate(middle.quaternion)
            for number, part in enumerate(NODES):
                past = self._navigation.past(frame.exposure_start_ns + round(part * frame.exposure_ns))
                if past is not None:
                    turns[number] = to_rotation_vector(multiply(past.quaternion, back))
        return doubt(
            reading_of(motion), turns, self._settings.angular_acceleration_psd, frame.exposure_ns * 1e-9
        )

    def _rate_in_body(self, found: Found) -> tuple[FloatArray, FloatArray]:
        """Return rate and covariance in body axes; NaN when there is none."""
        if found.rate is None or found.covariance is None:
            return _NAN
        turn = self._body_to_camera.T
        return turn @ found.rate, turn @ found.covariance @ turn.T

    def _record_rate(
        self, frame: Frame, status: str, found: Found | None, now_ns: int, accepted: bool
    ) -> None:
        rate, covariance = self._rate_in_body(found) if found is not None else _NAN
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
            covariance=_packed(covariance),
            residual=found.residual if found else math.nan,
            accepted=int(accepted),
        )


def _is_strange(solution: FrameSolution | None) -> bool:
    """Tell whether a frame shows many stars that are nowhere in the sky."""
    if solution is None or solution.status is not SolveStatus.NO_MATCH:
        return False
    return len(solution.points) >= _MANY_STARS


def _middle_ns(frame: Frame) -> int:
    return frame.exposure_start_ns + frame.exposure_ns // 2


def _packed(c: FloatArray) -> list[float]:
    """Return xx yy zz xy xz yz of a symmetric matrix (3, 3)."""
    return [float(c[0, 0]), float(c[1, 1]), float(c[2, 2]), float(c[0, 1]), float(c[0, 2]), float(c[1, 2])]
