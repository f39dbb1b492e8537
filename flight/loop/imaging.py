"""Imaging: triggers the star camera, passes frames to the vision worker, and passes results to navigation.

The star camera is monitored by sequence number, pixels and age of its frames, and by whether the detected
stars match the catalogue. Objects that vision detects are tracked from frame to frame.
"""

from __future__ import annotations

import math
import zlib
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from flight.link import events
from flight.link.telemetry.definitions import LENS as LENS_PACKET
from flight.link.telemetry.definitions import MOST_SIGHTINGS, SIGHTINGS, STARS, STREAK, TRACK
from flight.loop import facts
from flight.loop.body import BodyView, FlightBody
from flight.loop.executive import Cycle, JobResult
from flight.loop.facts import Services
from flight.loop.navigation import Navigation
from flight.loop.state import Learned
from flight.schema.devices import FAST
from hal.interfaces.devices import Frame, FrameSource
from hal.interfaces.errors import DeviceError
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import FloatArray, Image, cross_matrices
from knightcube.astro.quaternion import (
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    to_rotation_vector,
)
from knightcube.gnc.estimation.estimate import (
    ATTITUDE,
    RATE,
    AttitudeMeasurement,
    Estimate,
    Knowledge,
    MeanRateMeasurement,
)
from knightcube.gnc.tracker import FrameSightings, ObjectTracker, Track, TrackSettings
from knightcube.vision.camera.images import KeptFrames
from knightcube.vision.camera.lens import CameraModel, Exposures
from knightcube.vision.frame_job import FrameFound, FrameJob, StreakEstimator, TrackerSettings
from knightcube.vision.lens_knowledge import LensKnowledge
from knightcube.vision.objects.settings import (
    FLOOR_PX,
    FieldPoints,
    MeasuredObjects,
    ObjectMeasurementSettings,
)
from knightcube.vision.startracker.solve import (
    NODES,
    AttitudePrior,
    FrameSolution,
    RatePrior,
    SolveStatus,
    middle_covariance,
    weighting_of,
)
from knightcube.vision.startracker.survey import DetectionSettings
from knightcube.vision.streaks.geometry import Course
from knightcube.vision.streaks.streak_result import FrameMotion, LikelihoodSettings, StreakStatus

_LEAST_PRIOR_SIGMA = 5e-4
"""Standard deviation (rad) of the alignment error between star camera and inertial unit."""
_COURSE_NODES = 17
"""Number of equally spaced times in an exposure at which the body rate is sampled."""
_NAN = np.full(3, np.nan), np.full((3, 3), np.nan)
"""Rate (3,) and covariance (3, 3) of a frame in which no rate was measured."""


@dataclass(frozen=True, slots=True)
class ImagingSettings:
    """Properties and time limits of the star camera, and the settings of vision.

    Attributes:
        exposures: exposure time as a function of the body rate.
        fine_rest_ns: minimum time (ns) between exposures while the attitude estimate is accurate, the body
            rotates slowly and no object is searched for.
        seeks: function that returns whether the body searches for an object.
        calm: function of a time and an exposure time (ns) that returns the first start time (ns), not before
            this time, of an exposure during which no coil is switched.
        late_ns: time (ns) after the end of an exposure from which its frame counts as late.
        max_rate: body rate (rad/s) above which no exposure is made.
        slow_ns: processing time (ns) of a frame above which vision is reported as slow.
        most_every: largest permitted n if only every n-th due exposure is made under overload.
        mounting: quaternion (4,) from body axes to camera axes.
        angular_acceleration_psd: function of a time that returns the power spectral density (3, 3),
            rad^2/s^3, of the body's white angular acceleration.
        objects: settings of the search for objects, or None if frames are not searched for objects.
        kept: storage of frames, or None if frames are not stored.
        velocity: function of a time that returns the velocity (3,), m/s, relative to the Sun, or None if the
            velocity in `tracker` is used.
        knowledge: function that returns how well the attitude is known.
        lens: initial lens parameters of the star tracker, or None if the lens parameters are not estimated.
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
    detection: DetectionSettings = field(default_factory=DetectionSettings)
    lens: LensKnowledge | None = None
    most_every: int = 8


class CameraAttitude(NamedTuple):
    """Attitude (4,) of the camera in inertial axes, and its covariance (3, 3), rad^2, in inertial axes."""

    quaternion: FloatArray
    covariance: FloatArray


class FrameMeasurer:
    """Makes jobs for the vision worker from frames, and measurements from the results."""

    def __init__(self, settings: ImagingSettings, navigation: Navigation) -> None:
        self._settings, self._navigation = settings, navigation
        self._body_to_camera = attitude_matrix(settings.mounting)

    def job(self, frame: Frame, last_checksum: int | None, spare: bool = True) -> FrameJob:
        """Return the vision worker's job for a frame.

        The checksum `last_checksum` of the previous frame serves to detect a repeated frame. The frame is
        searched for objects only if there is enough time (`spare`).
        """
        past, kept = self._navigation.past(middle_ns(frame)), self._settings.kept
        tracker, velocity = self._settings.tracker, self._settings.velocity(middle_ns(frame))
        if tracker is not None and velocity is not None:
            tracker = replace(tracker, solve=replace(tracker.solve, velocity=velocity))
        estimator = self._settings.estimator
        if past is None and isinstance(estimator, LikelihoodSettings):
            # If there is no prior attitude estimate, the change of the rate in the exposure is also fitted.
            estimator = replace(estimator, rate_model="accelerating")
        return FrameJob(
            frame.pixels,
            self._settings.camera,
            frame.exposure_ns * 1e-9,
            estimator,
            tracker,
            *self._priors(frame, past),
            last_checksum,
            objects=self._settings.objects if spare else None,
            kept=None if kept is None else replace(kept, name=f"frame-{frame.sequence:08d}"),
            detection=self._settings.detection,
        )

    def camera_attitude(self, time_ns: int) -> CameraAttitude | None:
        """Return the estimated attitude of the camera at a past time, or None if there is no estimate."""
        past = self._navigation.past(time_ns)
        if past is None:
            return None
        turn = attitude_matrix(past.quaternion).T
        covariance = turn @ past.covariance[ATTITUDE, ATTITUDE] @ turn.T
        return CameraAttitude(multiply(self._settings.mounting, past.quaternion), covariance)

    def exposure_ns(self, now_ns: int) -> int:
        """Return the exposure time (ns) for the next frame, from the estimated rate across the boresight."""
        exposures, estimate = self._settings.exposures, self._navigation.estimate(now_ns)
        if estimate is None:
            return round(exposures.usual * SECOND_NS)
        x, y, _ = (self._body_to_camera @ estimate.rate).tolist()
        return round(exposures.at(math.hypot(x, y)) * SECOND_NS)

    def _priors(self, frame: Frame, past: Estimate | None) -> tuple[RatePrior | None, AttitudePrior | None]:
        """Return the priors of rate and attitude in camera axes, from the estimate `past` at mid-exposure."""
        if past is None:
            return None, None
        rate_sigma = math.sqrt(max(float(np.linalg.eigvalsh(past.covariance[RATE, RATE])[-1]), 0.0))
        begin_ns, course = frame.exposure_start_ns, None
        spanning = self._navigation.rates(begin_ns, begin_ns + frame.exposure_ns)
        if spanning is not None:
            times, rates = spanning
            at = np.linspace(0.0, frame.exposure_ns, _COURSE_NODES) + (begin_ns - times[0])
            even = np.stack([np.interp(at, times - times[0], rate) for rate in rates.T], axis=1)
            course = Course.of_rates(even @ self._body_to_camera.T, frame.exposure_ns * 1e-9, rate_sigma)
        widest = float(np.linalg.eigvalsh(past.covariance[ATTITUDE, ATTITUDE])[-1])
        attitude = AttitudePrior(
            multiply(self._settings.mounting, past.quaternion),
            math.sqrt(max(widest, 0.0) + _LEAST_PRIOR_SIGMA**2),
        )
        return RatePrior(self._body_to_camera @ past.rate, rate_sigma, course), attitude

    def mean_rate(self, frame: Frame, motion: FrameMotion) -> MeanRateMeasurement | None:
        """Return the mean body rate over the exposure.

        Returns None if no rate was measured, or if there was no estimate at the start of the exposure.
        """
        start_ns = frame.exposure_start_ns
        if motion.status is not StreakStatus.RATE or self._navigation.past(start_ns) is None:
            return None
        return MeanRateMeasurement(start_ns, start_ns + frame.exposure_ns, *self.rate_in_body(motion))

    def attitude(self, frame: Frame, found: FrameFound) -> AttitudeMeasurement | None:
        """Return the measured attitude at mid-exposure, or None if the frame gave no star fix."""
        fix = found.solution.fix if found.solution is not None else None
        if fix is None:
            return None
        turn = self._body_to_camera.T
        covariance = turn @ fix.covariance @ turn.T + self._off_middle(frame, found.motion)
        quaternion = multiply(conjugate(self._settings.mounting), fix.quaternion)
        return AttitudeMeasurement(middle_ns(frame), quaternion, covariance, by_stars=True)

    def rate_in_body(self, found: FrameMotion | None) -> tuple[FloatArray, FloatArray]:
        """Return the rate (3,) and its covariance (3, 3) in body axes, or NaN if no rate was measured."""
        if found is None or found.rate is None or found.covariance is None:
            return _NAN
        turn = self._body_to_camera.T
        return turn @ found.rate, turn @ found.covariance @ turn.T

    def _off_middle(self, frame: Frame, motion: FrameMotion) -> FloatArray:
        """Return the covariance (3, 3), rad^2, of the star fix minus the attitude at mid-exposure."""
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
    """Return the time (ns) of mid-exposure."""
    return frame.exposure_start_ns + frame.exposure_ns // 2


_MANY_STARS = 12
"""Minimum number of unmatched detections in a frame that is considered not to show the sky."""
_NAMED_ELSEWHERE = {
    StreakStatus.TOO_SHORT,  # no motion
    StreakStatus.BLACK,
    StreakStatus.SATURATED,
    StreakStatus.FROZEN,
}
"""Streak results that are not reported: the body is at rest, or another event reports the cause."""


class FrameReport:
    """Records results of frames. The attribute `accepted` counts accepted rates from streaks."""

    def __init__(self, measurer: FrameMeasurer, view: BodyView, services: Services) -> None:
        self._measurer, self._view, self._recorder = measurer, view, services.recorder
        self._events = services.events
        self.accepted = 0

    def rate(
        self, frame: Frame, motion: FrameMotion, rate: MeanRateMeasurement | None, now_ns: int, accepted: bool
    ) -> None:
        """Record a rate measured from streaks, and report a rejected rate."""
        self.accepted += accepted
        if rate is not None and not accepted:
            text = f"frame {frame.sequence}: {self._view.rate_text(rate)}"
            self._events.report(events.STREAK_REFUSED, now_ns, text)
        self.record(frame, motion.status.value, motion, now_ns, accepted)

    def unused(self, frame: Frame, found: FrameFound, now_ns: int) -> None:
        """Report a frame of a rotating body that provided neither rate nor attitude."""
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
        """Record an attitude measured with stars; `accepted` is None if the filter was not updated."""
        if is_strange(solution):
            text = f"frame {frame.sequence}: {len(solution.points)} detected stars match no part of the sky"
            self._events.report(events.CAMERA_STRANGE, now_ns, text)
        if accepted is False:
            text = f"frame {frame.sequence}: {len(solution.matched)} stars"
            self._events.report(events.STARS_REFUSED, now_ns, text)
        quaternion = np.full(4, np.nan) if attitude is None else attitude.quaternion
        covariance = _NAN[1] if attitude is None else attitude.covariance
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

    def lens(self, frame: Frame, before: LensKnowledge, lens: LensKnowledge, now_ns: int) -> None:
        """Record the lens parameters, and report if the frame contradicted the earlier ones (`before`)."""
        if lens.contradictions > before.contradictions:
            text = (
                f"frame {frame.sequence} contradicts the lens estimated from {before.frames} frames: "
                "the lens is estimated again"
            )
            self._events.report(events.LENS_CHANGED, now_ns, text)
        f, x, y, k1, k2, line_time, psf_sigma = lens.learned[0].tolist()
        sigma = np.sqrt(np.diag(lens.learned[1]))
        self._recorder.record(
            LENS_PACKET,
            now_ns,
            sequence=frame.sequence,
            frames=lens.frames,
            contradictions=lens.contradictions,
            focal_length=f,
            centre=[x, y],
            distortion=[k1, k2],
            line_time=line_time,
            psf_sigma=psf_sigma,
            sigma=sigma.tolist(),
            corner_sigma=lens.accuracy.distortion,
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
    """Return whether a frame contains many stars that match no part of the sky."""
    if solution is None or solution.status is not SolveStatus.NO_MATCH:
        return False
    return len(solution.points) >= _MANY_STARS


def _packed(c: FloatArray) -> list[float]:
    """Return the elements xx, yy, zz, xy, xz, yz of a symmetric matrix (3, 3)."""
    return [float(c[0, 0]), float(c[1, 1]), float(c[2, 2]), float(c[0, 1]), float(c[0, 2]), float(c[1, 2])]


_ROWS = 32
"""Number of image rows of which a checksum is stored."""
_FRAMES = 4
"""Number of frame buffers of a camera driver, any of which may contain old rows."""
_LEAST_CHANGES = 0.125
"""Minimum fraction of the pixels of a row that differ from the next pixel if the row contains noise."""


class RepeatedRows:
    """Detects image rows that are copies from earlier frames, by checksums of some rows of each frame."""

    def __init__(self) -> None:
        self._seen: deque[dict[int, int]] = deque(maxlen=_FRAMES)

    def count(self, pixels: Image) -> int:
        """Return how many sampled rows are copies from earlier frames; 0 if all are (a repeated frame)."""
        rows = np.unique(np.linspace(0, len(pixels) - 1, _ROWS).astype(int)).tolist()
        sampled = np.ascontiguousarray(pixels[rows])
        noisy = np.mean(sampled[:, 1:] != sampled[:, :-1], axis=1) >= _LEAST_CHANGES
        here = {rows[place]: zlib.crc32(sampled[place]) for place in np.flatnonzero(noisy).tolist()}
        old = sum(any(before.get(row) == value for before in self._seen) for row, value in here.items())
        self._seen.append(here)
        return old if old < len(here) else 0


_UNKNOWN = [math.nan] * 3
"""Recorded position (m) and velocity (m/s) of a body whose orbit is unknown."""
_STEP_PX = 2.0
"""Standard deviation (px) of the predicted rotation of the camera from one frame to the next."""


class ObjectTracks:
    """Tracks objects from frame to frame, and reports and records their tracks.

    In frames without identified stars, tracks are measured relative to the star field of the earlier frames
    (`knightcube.vision.objects.star_field`). Control and telemetry receive the tracks in the axes of the
    attitude estimate. The error of the attitude estimate is part of the recorded covariances of the
    directions.
    """

    def __init__(self, settings: TrackSettings, body: FlightBody, services: Services) -> None:
        from knightcube.vision.objects.star_field import StarField  # noqa: PLC0415 - only with a search

        self._body = body
        self._tracker = ObjectTracker(settings)
        self._recorder, self._events = services.recorder, services.events
        self._field = StarField()
        self._located: tuple[int, FloatArray, CameraAttitude | None] | None = None

    def ingest(self, sequence: int, middle_ns: int, sighted: MeasuredObjects, now_ns: int) -> None:
        """Accept the objects detected in the frame `sequence`, whose mid-exposure is at `middle_ns`."""
        if self._located is not None:
            self._clear("stars are identified again", now_ns)
            self._located = None
        self._track(sequence, middle_ns, sighted, now_ns, np.eye(3))
        for track in self._tracker.objects:
            self._record_track(track, now_ns)
        self._body.control.accept_tracks(self._tracker.objects, now_ns)

    def ingest_field(
        self,
        sequence: int,
        middle_ns: int,
        seen: FieldPoints,
        motion: FrameMotion,
        attitude: CameraAttitude | None,
        now_ns: int,
    ) -> None:
        """Accept the point sources `seen` in a frame without identified stars.

        The argument `attitude` is the camera's estimated attitude at mid-exposure, or None if unknown.
        """
        predicted = self._predicted(middle_ns, motion, attitude)
        pixel = float(seen.sigma.min(initial=1.0)) / FLOOR_PX
        place = self._field.locate(seen, predicted, _STEP_PX * pixel)
        if place.begun or self._located is None:
            self._clear("the frame shares no stars with earlier frames", now_ns)
        self._located = middle_ns, place.quaternion, attitude
        kept, turn = ~place.is_star, attitude_matrix(place.quaternion).T
        directions = seen.directions[kept] @ turn.T
        across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
        covariance = seen.sigma[kept, None, None] ** 2 * across
        unknown = np.full(len(directions), np.nan)
        common = turn @ place.covariance @ turn.T
        sighted = MeasuredObjects(seen.points[kept], directions, covariance, unknown, common)
        # If the attitude is unknown, directions are in axes of the star field, whose orientation is unknown.
        known = CameraAttitude(place.quaternion, np.eye(3)) if attitude is None else attitude
        to_estimate = attitude_matrix(known.quaternion).T @ turn.T
        self._track(sequence, middle_ns, sighted, now_ns, to_estimate)
        tracks = [_rotated(track, to_estimate) for track in self._tracker.objects]
        for track in tracks:
            self._record_track(track, now_ns, known.covariance)
        if attitude is not None:
            self._body.control.accept_tracks(tracks, now_ns)

    def _predicted(self, middle_ns: int, motion: FrameMotion, attitude: CameraAttitude | None) -> FloatArray:
        """Predict the camera's attitude (4,) in the star field by the estimate or by the streaks' rate."""
        if self._located is None:
            return np.array([0.0, 0.0, 0.0, 1.0]) if attitude is None else attitude.quaternion
        then_ns, quaternion, before = self._located
        if attitude is not None and before is not None:
            return multiply(multiply(attitude.quaternion, conjugate(before.quaternion)), quaternion)
        if motion.rate is None:
            return quaternion
        return multiply(from_rotation_vector((middle_ns - then_ns) * 1e-9 * motion.rate), quaternion)

    def _clear(self, reason: str, now_ns: int) -> None:
        for track in self._tracker.objects:
            self._events.report(events.OBJECT_LOST, now_ns, f"object {track.number}: {reason}")
        self._tracker.clear()

    def _track(
        self, sequence: int, middle_ns: int, sighted: MeasuredObjects, now_ns: int, to_estimate: FloatArray
    ) -> None:
        """Record sightings, update the tracks, and report changes.

        The matrix `to_estimate` (3, 3) rotates directions into the axes of the attitude estimate.
        """
        x, y = np.reshape(sighted.points, (-1, 2)).T
        self._recorder.record(
            SIGHTINGS,
            now_ns,
            sequence=sequence,
            middle_ns=middle_ns - self._recorder.epoch_ns,
            found=len(x),
            x=_padded(x),
            y=_padded(y),
            magnitude=_padded(sighted.magnitudes),
        )
        orbit = self._body.estimation.orbit(middle_ns)
        frame = FrameSightings(
            middle_ns,
            sighted.directions,
            sighted.covariance,
            sighted.magnitudes,
            sighted.attitude,
            None if orbit is None else to_estimate.T @ orbit.position,
        )
        confirmed, ended = self._tracker.ingest(frame)
        for track in confirmed:
            rate_deg = math.degrees(float(np.linalg.norm(track.line.rate)))
            known = math.isfinite(track.magnitude)
            brightness = f"V {track.magnitude:.1f}" if known else "brightness unknown"
            text = f"object {track.number}: {rate_deg:.3f} deg/s among the stars, {brightness}"
            self._events.report(events.OBJECT_FOUND, now_ns, text)
        for track in ended:
            away = (middle_ns - track.seen_ns) * 1e-9
            text = f"object {track.number}: not detected for {away:.1f} s, {track.sightings} sightings"
            self._events.report(events.OBJECT_LOST, now_ns, text)

    def _record_track(self, track: Track, now_ns: int, attitude: FloatArray | None = None) -> None:
        """Record a track; `attitude` (3, 3), rad^2, is the covariance of an attitude without a star fix."""
        line = track.line
        across = np.eye(3) - np.outer(line.direction, line.direction)
        orbit = self._body.estimation.orbit(line.time_ns)
        cross = cross_matrices(line.direction[None])[0]
        shared = np.zeros((3, 3)) if attitude is None else cross @ attitude @ cross.T
        self._recorder.record(
            TRACK,
            now_ns,
            number=track.number,
            middle_ns=line.time_ns - self._recorder.epoch_ns,
            seen=int(track.seen),
            sightings=track.sightings,
            measured=track.measured.tolist(),
            measured_sigma=math.sqrt(track.measured_sigma**2 + 0.5 * float(np.trace(shared))),
            direction=line.direction.tolist(),
            rate=line.rate.tolist(),
            acceleration=line.acceleration.tolist(),
            covariance=_packed(line.covariance[:3, :3] + shared),
            rate_covariance=_packed(across @ line.covariance[3:, 3:] @ across),
            magnitude=track.magnitude,
            magnitude_sigma=track.magnitude_sigma,
            place=_UNKNOWN if orbit is None else orbit.position.tolist(),
            velocity=_UNKNOWN if orbit is None else orbit.velocity.tolist(),
            place_sigma=math.nan if orbit is None else orbit.sigma,
            relative=int(attitude is not None),
        )


def _rotated(track: Track, turn: FloatArray) -> Track:
    """Return a track whose directions are rotated by the matrix `turn` (3, 3)."""
    line = track.line
    both = np.kron(np.eye(2), turn)
    rotated = replace(
        line,
        direction=turn @ line.direction,
        velocity=turn @ line.velocity,
        covariance=both @ line.covariance @ both.T,
    )
    return replace(track, line=rotated, measured=turn @ track.measured)


def _padded(values: FloatArray) -> list[float]:
    """Return the first MOST_SIGHTINGS values, padded with NaN."""
    first = [float(value) for value in values[:MOST_SIGHTINGS]]
    return first + [math.nan] * (MOST_SIGHTINGS - len(first))


WORKER = "vision"
LENS = "lens"
"""Name of the estimated lens parameters among the parameters that are stored for the next boot."""


class Imaging:
    """Triggers and monitors the star camera, and keeps the frame that the worker processes."""

    def __init__(
        self,
        camera: FrameSource,
        settings: ImagingSettings,
        navigation: Navigation,
        view: BodyView,
        services: Services,
        objects: ObjectTracks | None = None,
    ) -> None:
        self._camera, self._settings, self._navigation = camera, settings, navigation
        self._measurer = FrameMeasurer(settings, navigation)
        self._report = FrameReport(self._measurer, view, services)
        self._jobs, self._events, self._facts = services.jobs, services.events, services.facts
        self._streams = services.streams
        self._frame: Frame | None = None
        self._last_sequence = -1
        self._last_checksum: int | None = None
        self._last_frame_ns = 0
        self._triggered_ns = -settings.fine_rest_ns
        self._rest_ns = 0
        self._ordered: tuple[int, int] | None = None  # start and duration (ns) of a scheduled exposure
        self._due_ns: int | None = None  # time (ns) after which the oldest trigger's frame is late
        self._rows = RepeatedRows()
        self._busy_since_ns = self._frames = 0
        self._objects = objects
        self._lens, self._lens_ns = settings.lens, 0
        self._spare = True  # whether there was time to search the last frame for objects
        self._searches, self._frame_every, self._turn = True, 1, 0
        self._shed = self._late = 0
        # End of the newest frame's exposure, and time from the preceding frame to it.
        self._exposed_ns = self._pause_ns = 0

    def counts(self) -> tuple[int, int]:
        """Return the number of frames, and the number of rates from streaks that the filter accepted."""
        return self._frames, self._report.accepted

    def learned(self) -> dict[str, Learned]:
        """Return the estimated lens parameters for the next boot; empty before there is an estimate."""
        if self._lens is None or not self._lens.frames:
            return {}
        return {LENS: Learned.of(*self._lens.learned)}

    def busy_since_ns(self) -> int | None:
        """Return the time (ns) at which the worker received its present frame, or None while it is idle."""
        return None if self._frame is None else self._busy_since_ns

    def rest(self, seconds: float) -> None:
        """Leave at least `seconds` s between two exposures, because the battery is low."""
        # Half a second is subtracted, so that the trigger after a late trigger is not skipped.
        self._rest_ns = round((seconds - 0.5) * 1e9)

    def reduce(self, search: bool, frame_every: int) -> None:
        """Set how much work is done: the search for objects, and the fraction of exposures that are made.

        Frames are searched for objects only if `search` is true, and only every n-th exposure is made, where
        n is `frame_every`, but at most `ImagingSettings.most_every`.
        """
        self._searches = search
        self._frame_every = max(min(frame_every, self._settings.most_every), 1)

    def workload(self) -> tuple[int, int]:
        """Return the number of omitted exposures, and the number of frames that were late.

        A frame is late if it arrives while the worker is busy, or if its processing takes longer than
        `slow_ns` and than half the time since the preceding frame.
        """
        return self._shed, self._late

    def begin(self, time_ns: int) -> None:
        """Until the first frame arrives, measure the age of the newest frame from `time_ns`."""
        self._last_frame_ns = self._exposed_ns = time_ns

    def trigger(self, cycle: Cycle) -> None:
        """Schedule the next exposure of the star camera, if an exposure is permitted now.

        No exposure is made while the body rotates faster than permitted, or too soon after the last exposure
        while the battery is low. Exposures are less frequent while the attitude estimate is accurate and the
        body rotates slowly. An exposure starts when no coil will be switched until its end, so that the body
        rate is nearly constant.
        """
        speed, rested_ns = self._navigation.speed, cycle.start_ns - self._triggered_ns
        if speed > self._settings.max_rate or rested_ns < self._rest_ns:
            self._last_frame_ns = cycle.start_ns
            self._streams.note("camera", cycle.start_ns)  # the pause is intended, so the camera is not stale
            return
        fine = self._settings.knowledge() is Knowledge.FINE and not self._settings.seeks()
        if rested_ns < self._settings.fine_rest_ns and fine and speed <= FAST:
            return
        self._triggered_ns = now_ns = cycle.start_ns
        self._turn = (self._turn + 1) % self._frame_every
        if self._turn:
            self._shed += 1
            self._last_frame_ns = now_ns
            self._streams.note("camera", now_ns)
            return
        exposure_ns = self._measurer.exposure_ns(now_ns)
        self._ordered = self._settings.calm(now_ns, exposure_ns), exposure_ns
        self._expose(now_ns)

    def _expose(self, now_ns: int) -> None:
        """Start the scheduled exposure when its start time is reached."""
        if self._ordered is None or now_ns < self._ordered[0]:
            return
        (_, exposure_ns), self._ordered = self._ordered, None
        try:
            self._camera.trigger(exposure_ns)
        except DeviceError as error:
            self._facts.update(facts.CAMERA_LOST, True, now_ns, str(error))
            return
        if self._due_ns is None:
            # A free-running camera first completes its present exposure.
            self._due_ns = now_ns + 2 * exposure_ns + self._settings.late_ns

    def serve(self, now_ns: int) -> None:
        """Start an exposure that is due, check the camera, and pass a new frame to the worker."""
        if self._frame is not None and now_ns - self._busy_since_ns > self._settings.slow_ns:
            self._judge_speed(now_ns)
        self._expose(now_ns)
        frame = None
        try:
            frame = self._camera.poll()
        except DeviceError as error:
            self._facts.update(facts.CAMERA_LOST, True, now_ns, str(error))
        if frame is not None and frame.sequence <= self._last_sequence:
            text = f"frame {frame.sequence} was delivered again"
            self._events.report(events.CAMERA_FROZEN, now_ns, text)
            self._report.record(frame, StreakStatus.FROZEN.value, None, now_ns, False)
            frame = None  # a repeated frame does not count as a new frame
        if frame is None:
            age_ns = now_ns - self._last_frame_ns
            if self._due_ns is not None and now_ns > self._due_ns:
                self._facts.update(facts.CAMERA_LATE, True, now_ns, "no frame yet after its trigger")
            if age_ns > self._settings.max_age_ns:
                self._facts.update(facts.CAMERA_LOST, True, now_ns, f"no frame for {age_ns * 1e-9:.1f} s")
            return
        self._due_ns = None
        # The age of a frame is measured from the end of its exposure, not from its arrival.
        end_ns = frame.exposure_start_ns + frame.exposure_ns
        self._pause_ns, self._exposed_ns, self._last_frame_ns = end_ns - self._exposed_ns, end_ns, end_ns
        age_ns = now_ns - end_ns
        late = age_ns > self._settings.max_age_ns
        text = f"frame {frame.sequence} arrives {age_ns * 1e-9:.1f} s after its exposure"
        self._facts.update(facts.CAMERA_LOST, late, now_ns, text)
        self._facts.update(facts.CAMERA_LATE, age_ns > self._settings.late_ns, now_ns, text)
        if not late:
            self._streams.note("camera", now_ns)
        self._frames += 1
        self._last_sequence = frame.sequence
        if old := self._rows.count(frame.pixels):
            text = f"frame {frame.sequence}: {old} sampled rows are copies from an earlier frame"
            self._events.report(events.CAMERA_TORN, now_ns, text)
            self._report.record(frame, StreakStatus.FAILED.value, None, now_ns, False)
        elif self._jobs.submit(WORKER, self._job(frame)):
            self._frame = frame
            self._busy_since_ns = now_ns
        else:
            self._late += self._frame is not None
            self._events.report(events.VISION_FAILED, now_ns, "the worker is busy or not running")

    def _job(self, frame: Frame) -> FrameJob:
        """Return the worker's job for a frame, with the estimated lens parameters."""
        job = self._measurer.job(frame, self._last_checksum, self._spare and self._searches)
        if self._lens is None:
            return job
        elapsed = max(frame.exposure_start_ns - self._lens_ns, 0) * 1e-9 if self._lens_ns else 0.0
        return replace(job, lens=(self._lens, elapsed))

    def _keep_lens(self, frame: Frame, lens: LensKnowledge | None, now_ns: int) -> None:
        """Use the lens parameters after a frame for the next frames; a frame without stars has no effect."""
        before = self._lens
        if lens is None or before is None:
            return
        if (lens.frames, lens.contradictions) == (before.frames, before.contradictions):
            return
        self._lens, self._lens_ns = lens, frame.exposure_start_ns
        self._report.lens(frame, before, lens, now_ns)

    def finish(self, result: JobResult, now_ns: int) -> None:
        """Accept the worker's result, and pass its measurements to navigation."""
        frame, self._frame = self._frame, None
        if frame is None:
            return
        self._late += now_ns - self._busy_since_ns > max(self._settings.slow_ns, self._pause_ns // 2)
        self._judge_speed(now_ns)
        if result.outcome != "done":
            self._events.report(events.VISION_FAILED, now_ns, f"{result.outcome}: {result.error}")
            self._report.record(frame, StreakStatus.FAILED.value, None, now_ns, False)
            return
        found: FrameFound = result.value
        motion = found.motion
        self._last_checksum = motion.checksum
        self._keep_lens(frame, found.lens, now_ns)
        if motion.status is StreakStatus.FROZEN:
            text = f"frame {frame.sequence} repeats the pixels of the last frame"
            self._events.report(events.CAMERA_FROZEN, now_ns, text)
        elif motion.status in {StreakStatus.BLACK, StreakStatus.SATURATED}:
            text = f"frame {frame.sequence} is {motion.status.value}"
            black = motion.status is StreakStatus.BLACK
            self._events.report(events.CAMERA_BLACK if black else events.CAMERA_SATURATED, now_ns, text)
        rate, attitude = self._measurer.mean_rate(frame, motion), self._measurer.attitude(frame, found)
        if is_strange(found.solution):
            rate = None  # the pixels are invalid
        if found.objects is not None and self._objects is not None:
            self._objects.ingest(frame.sequence, middle_ns(frame), found.objects, now_ns)
        if found.field is not None and self._objects is not None:
            middle, attitude_then = middle_ns(frame), self._measurer.camera_attitude(middle_ns(frame))
            self._objects.ingest_field(frame.sequence, middle, found.field, motion, attitude_then, now_ns)
        if found.problem:
            self._events.report(events.VISION_FAILED, now_ns, found.problem)
        if rate is None and attitude is None:
            self._report.unused(frame, found, now_ns)
        known = self._navigation.past(middle_ns(frame)) is not None
        began = attitude is not None and self._navigation.begin_from(attitude)
        late = [m for m in (rate, attitude if known else None) if m is not None]

        def report(accepted: list[bool]) -> None:
            took = dict(zip(map(type, late), accepted, strict=True))
            self._report.rate(frame, motion, rate, now_ns, took.get(MeanRateMeasurement, False))
            if found.solution is not None:
                self._report.stars(
                    frame, found.solution, attitude, now_ns, began or took.get(AttitudeMeasurement)
                )

        if late:
            self._navigation.ingest_late(late, report)
        else:
            report([])

    def _judge_speed(self, now_ns: int) -> None:
        taken_ns = now_ns - self._busy_since_ns
        self._spare = taken_ns <= self._settings.slow_ns
        text = f"{taken_ns * 1e-9:.2f} s to process a frame, {self._settings.slow_ns * 1e-9:g} s expected"
        self._facts.update(facts.VISION_SLOW, taken_ns > self._settings.slow_ns, now_ns, text)
