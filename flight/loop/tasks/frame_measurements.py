"""Builds the vision worker's job for a frame, and measurements, packets and events of the job's result."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from flight.link import events
from flight.link.telemetry.definitions import STARS, STREAK
from flight.loop.body import BodyView
from flight.loop.services import Services
from flight.loop.tasks.navigation import Navigation
from hal.interfaces.devices import Frame
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix, conjugate, multiply, to_rotation_vector
from knightcube.gnc.estimation.estimate import ATTITUDE, RATE, Estimate, Knowledge
from knightcube.gnc.estimation.measurements import AttitudeMeasurement, MeanRateMeasurement
from knightcube.vision.camera.images import KeptFrames
from knightcube.vision.camera.lens import CameraModel, Exposures
from knightcube.vision.frame_job import FrameFound, FrameJob, StreakEstimator, TrackerSettings
from knightcube.vision.objects.settings import ObjectMeasurementSettings
from knightcube.vision.startracker.solve import (
    NODES,
    AttitudePrior,
    FrameSolution,
    RatePrior,
    SolveStatus,
    middle_covariance,
    weighting_of,
)
from knightcube.vision.streaks.geometry import Course
from knightcube.vision.streaks.settings import LikelihoodSettings
from knightcube.vision.streaks.streak_result import FrameMotion, StreakStatus

# rad, of the mounting between the camera and the inertial unit that the estimate is of.
_LEAST_PRIOR_SIGMA = 5e-4
# Instants of an exposure at which the rate is taken.
_COURSE_NODES = 17
_NAN = np.full(3, np.nan), np.full((3, 3), np.nan)


@dataclass(frozen=True, slots=True)
class ImagingSettings:
    """Properties and time limits of the camera, and the settings of vision.

    Attributes:
        exposures: how long to expose at a rate.
        fine_rest_ns: minimum time between exposures while the attitude is fine and no object is searched for.
        seeks: returns whether an object is searched for.
        calm: returns when, from a time on, an exposure of a length begins that meets no step of the coils.
        late_ns: age after the exposure from which a frame is late.
        max_rate: rad/s of the body, beyond which no exposure is begun.
        slow_ns: processing time from which vision is slow.
        mounting: (4,) body axes to camera axes.
        angular_acceleration_psd: returns the density (3, 3) rad^2/s^3 of the body's white angular
            acceleration at a time.
        objects: how objects are sighted; None: they are not.
        kept: where frames are kept; None: they are not.
        velocity: returns the velocity (3,) m/s about the Sun at a time; None: as in `tracker`.
        knowledge: returns how well the attitude is known now.
    """

    camera: CameraModel
    exposures: Exposures
    fine_rest_ns: int
    max_age_ns: int
    late_ns: int
    slow_ns: int
    max_rate: float
    mounting: FloatArray
    estimator: LikelihoodSettings | StreakEstimator
    tracker: TrackerSettings | None
    angular_acceleration_psd: Callable[[int], FloatArray]
    velocity: Callable[[int], FloatArray | None]
    knowledge: Callable[[], Knowledge]
    seeks: Callable[[], bool]
    calm: Callable[[int, int], int]
    objects: ObjectMeasurementSettings | None = None
    kept: KeptFrames | None = None


class FrameMeasurer:
    """Builds jobs from frames, and measurements from the worker's results."""

    def __init__(self, settings: ImagingSettings, navigation: Navigation) -> None:
        self._settings = settings
        self._navigation = navigation
        self._body_to_camera = attitude_matrix(settings.mounting)

    def job(self, frame: Frame, last_checksum: int | None, spare: bool = True) -> FrameJob:
        """Return the worker's job; `last_checksum` is that of the previous frame, to detect a repetition.

        `spare`: whether there is time to look for objects.
        """
        past, kept = self._navigation.past(middle_ns(frame)), self._settings.kept
        return FrameJob(
            frame.pixels,
            self._settings.camera,
            frame.exposure_ns * 1e-9,
            self._estimator(past),
            self._tracker(frame),
            self._rate_prior(frame, past) if past is not None else None,
            self._attitude_prior(past) if past is not None else None,
            last_checksum,
            objects=self._settings.objects if spare else None,
            kept=None if kept is None else replace(kept, name=f"frame-{frame.sequence:08d}"),
        )

    def exposure_ns(self, now_ns: int) -> int:
        """Return how long to expose from now on: by the estimated rate across the boresight."""
        exposures, estimate = self._settings.exposures, self._navigation.estimate(now_ns)
        if estimate is None:
            return round(exposures.usual * SECOND_NS)
        x, y, _ = (self._body_to_camera @ estimate.rate).tolist()
        return round(exposures.at(math.hypot(x, y)) * SECOND_NS)

    def _tracker(self, frame: Frame) -> TrackerSettings | None:
        tracker, velocity = self._settings.tracker, self._settings.velocity(middle_ns(frame))
        if tracker is None or velocity is None:
            return tracker
        return replace(tracker, solve=replace(tracker.solve, velocity=velocity))

    def _estimator(self, past: Estimate | None) -> LikelihoodSettings | StreakEstimator:
        estimator = self._settings.estimator
        if past is None and isinstance(estimator, LikelihoodSettings):
            # A change of rate moves the stars off mid-exposure: without an estimate, fit it to the pixels.
            return replace(estimator, rate_model="accelerating")
        return estimator

    def _rate_prior(self, frame: Frame, past: Estimate) -> RatePrior:
        widest = float(np.linalg.eigvalsh(past.covariance[RATE, RATE])[-1])
        rate, sigma = self._body_to_camera @ past.rate, math.sqrt(max(widest, 0.0))
        return RatePrior(rate, sigma, self._course(frame, sigma))

    def _course(self, frame: Frame, sigma: float) -> Course | None:
        """Return how the camera turned, its rate known to `sigma` rad/s; None beyond the history."""
        spanning = self._navigation.rates(
            frame.exposure_start_ns, frame.exposure_start_ns + frame.exposure_ns
        )
        if spanning is None:
            return None
        times, rates = spanning
        at = np.linspace(0.0, frame.exposure_ns, _COURSE_NODES) + (frame.exposure_start_ns - times[0])
        even = np.stack([np.interp(at, times - times[0], rate) for rate in rates.T], axis=1)
        return Course.of_rates(even @ self._body_to_camera.T, frame.exposure_ns * 1e-9, sigma)

    def _attitude_prior(self, past: Estimate) -> AttitudePrior:
        widest = float(np.linalg.eigvalsh(past.covariance[ATTITUDE, ATTITUDE])[-1])
        sigma = math.sqrt(max(widest, 0.0) + _LEAST_PRIOR_SIGMA**2)
        return AttitudePrior(multiply(self._settings.mounting, past.quaternion), sigma)

    def mean_rate(self, frame: Frame, motion: FrameMotion) -> MeanRateMeasurement | None:
        """Return the mean body rate over the exposure, None without a rate or without an estimate then."""
        start_ns = frame.exposure_start_ns
        if motion.status is not StreakStatus.RATE or self._navigation.past(start_ns) is None:
            return None
        return MeanRateMeasurement(start_ns, start_ns + frame.exposure_ns, *self.rate_in_body(motion))

    def attitude(self, frame: Frame, found: FrameFound) -> AttitudeMeasurement | None:
        """Return the attitude at mid-exposure, None without a fix."""
        fix = found.solution.fix if found.solution is not None else None
        if fix is None:
            return None
        turn = self._body_to_camera.T
        covariance = turn @ fix.covariance @ turn.T + self._off_middle(frame, found.motion)
        quaternion = multiply(conjugate(self._settings.mounting), fix.quaternion)
        return AttitudeMeasurement(middle_ns(frame), quaternion, covariance)

    def rate_in_body(self, found: FrameMotion | None) -> tuple[FloatArray, FloatArray]:
        """Return rate and covariance in body axes; NaN when there is none."""
        if found is None or found.rate is None or found.covariance is None:
            return _NAN
        turn = self._body_to_camera.T
        return turn @ found.rate, turn @ found.covariance @ turn.T

    def _off_middle(self, frame: Frame, motion: FrameMotion) -> FloatArray:
        """Return the covariance (3, 3) rad^2 of the stars' attitude relative to that of mid-exposure."""
        turns = np.zeros((len(NODES), 3))
        middle = self._navigation.past(middle_ns(frame))
        if middle is not None:
            back = conjugate(middle.quaternion)
            for number, part in enumerate(NODES):
                past = self._navigation.past(frame.exposure_start_ns + round(part * frame.exposure_ns))
                if past is not None:
                    turns[number] = to_rotation_vector(multiply(past.quaternion, back))
        density = self._settings.angular_acceleration_psd(middle_ns(frame))
        return middle_covariance(weighting_of(motion), turns, density, frame.exposure_ns * 1e-9)


def middle_ns(frame: Frame) -> int:
    """Return the time of mid-exposure."""
    return frame.exposure_start_ns + frame.exposure_ns // 2


_MANY_STARS = 12
"""A frame with at least this many unmatched detections does not show the sky: its pixels are invalid."""
_NAMED_ELSEWHERE = {
    StreakStatus.TOO_SHORT,  # no motion
    StreakStatus.BLACK,
    StreakStatus.SATURATED,
    StreakStatus.FROZEN,
}
"""States of a frame without motion, or with an event of their own."""
_NAN4, _NAN33 = np.full(4, np.nan), np.full((3, 3), np.nan)


class FrameReport:
    """Records frames; `accepted` counts the rates from streaks that entered the estimate."""

    def __init__(self, measurer: FrameMeasurer, view: BodyView, services: Services) -> None:
        self._measurer = measurer
        self._view = view
        self._recorder = services.recorder
        self._events = services.events
        self.accepted = 0

    def rate(
        self, frame: Frame, motion: FrameMotion, rate: MeanRateMeasurement | None, now_ns: int, accepted: bool
    ) -> None:
        """Record the rate from the streaks, and report a rejected rate."""
        self.accepted += accepted
        if rate is not None and not accepted:
            text = f"frame {frame.sequence}: {self._view.rate_text(rate)}"
            self._events.report(events.STREAK_REFUSED, now_ns, text)
        self.record(frame, motion.status.value, motion, now_ns, accepted)

    def unused(self, frame: Frame, found: FrameFound, now_ns: int) -> None:
        """Report a frame of a body in motion that gave no rate and no attitude."""
        if found.motion.status in _NAMED_ELSEWHERE:
            return
        stars = f", stars {found.solution.status.value}" if found.solution is not None else ""
        text = f"frame {frame.sequence}: streaks {found.motion.status.value}{stars}"
        self._events.report(events.FRAME_UNUSED, now_ns, text)

    def stars(
        self,
        frame: Frame,
        solution: FrameSolution,
        attitude: AttitudeMeasurement | None,
        now_ns: int,
        accepted: bool | None,
    ) -> None:
        """Record the attitude from the stars; `accepted` is None when not offered to the filter."""
        if is_strange(solution):
            text = f"frame {frame.sequence}: {len(solution.points)} stars that are nowhere in the sky"
            self._events.report(events.CAMERA_STRANGE, now_ns, text)
        if accepted is False:
            text = f"frame {frame.sequence}: {len(solution.matched)} stars"
            self._events.report(events.STARS_REFUSED, now_ns, text)
        quaternion = _NAN4 if attitude is None else attitude.quaternion
        covariance = _NAN33 if attitude is None else attitude.covariance
        self._recorder.record(
            STARS,
            now_ns,
            sequence=frame.sequence,
            middle_ns=middle_ns(frame) - self._recorder.epoch_ns,
            status=solution.status.value,
            tracked=int(solution.tracked),
            found=len(solution.points),
            matched=len(solution.matched),
            quaternion=quaternion.tolist(),
            covariance=_packed(covariance),
            log10_false_alarm=solution.log10_false_alarm,
            accepted=int(bool(accepted)),
        )

    def record(
        self, frame: Frame, status: str, found: FrameMotion | None, now_ns: int, accepted: bool
    ) -> None:
        """Record the streak packet."""
        rate, covariance = self._measurer.rate_in_body(found)
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


def is_strange(solution: FrameSolution | None) -> bool:
    """Return whether a frame shows many stars but matches no part of the sky."""
    if solution is None or solution.status is not SolveStatus.NO_MATCH:
        return False
    return len(solution.points) >= _MANY_STARS


def _packed(c: FloatArray) -> list[float]:
    """Return xx yy zz xy xz yz of a symmetric matrix (3, 3)."""
    return [float(c[0, 0]), float(c[1, 1]), float(c[2, 2]), float(c[0, 1]), float(c[0, 2]), float(c[1, 2])]
