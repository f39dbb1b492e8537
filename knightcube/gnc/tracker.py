"""Tracks of several objects over camera frames, and a filter of the line of sight to each object.

The line-of-sight filter uses measured directions only, without ranges. The filter state consists of the
position y (a unit vector) and the velocity z of the object relative to the observer, both divided by the
present range. Without forces the velocity z is constant and the position y moves on a straight line. The
motion model of the line-of-sight filter is therefore linear at any angular rate, and only the measurement
model is nonlinear. After each step the filter state is divided by the length of the position y, so that y is
a unit vector again. The filter state is the vector form of the modified polar coordinates of Aidala and
Hammel (1983, IEEE Transactions on Automatic Control 28). The component of the velocity z across the line of
sight is the angular rate v. The component along the line of sight is s = (range rate) / range. Without
forces, the angular acceleration of the line of sight is -2 s v.

Observer and object are in free fall about the Earth. If the observer's position is known, the gravity
gradient gives the relative acceleration of object and observer, to first order in the distance divided by the
orbit radius.

The process noise models tidal accelerations as white noise of density `wander`, or `residual_wander` if the
gravity gradient is known. More process noise along the line of sight lets the filter follow motions that are
not straight lines. For example, an object that circles the observer at the angular rate v accelerates towards
the observer by v^2 times the range. The spectral density of the process noise along the line of sight is
therefore increased by (`bend` rate^2)^2 / rate, where rate is the angular rate of the object.

Each sighting is assigned to at most one track, first to confirmed and then to tentative tracks, in order of
increasing cost. The cost is the chi-square of direction and brightness plus the logarithm of the determinant
of the innovation's covariance. The assignment is the greedy nearest neighbour method (Blackman and Popoli
1999, Design and Analysis of Modern Tracking Systems, section 6.4). Unassigned sightings start tentative
tracks. A track is confirmed after m sightings in n frames if its angular rate differs from the rate of the
stars. A confirmed track is propagated without measurements while the object is not detected.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from knightcube.astro.arrays import FloatArray, check_type, cross_matrices, tangent_basis
from knightcube.astro.chi_square import bound
from knightcube.astro.earth.figure import GRAVITATIONAL_PARAMETER
from knightcube.errors import ArgumentError
from knightcube.gnc.estimation.error_state import check_amounts, updated


@dataclass(frozen=True, slots=True, eq=False)
class FrameSightings:
    """The n detections in a frame, including false detections.

    Attributes:
        time_ns: time of mid-exposure.
        directions: unit vectors (n, 3) to the objects, ICRS, corrected for stellar aberration.
        covariance: covariance (n, 3, 3) of the directions due to errors of the image positions, ICRS axes,
            rad^2; the attitude error is not included.
        magnitudes: magnitudes (n,) of the objects, calibrated by the stars in the frame, or NaN if unknown.
        attitude: covariance (3, 3) of the attitude error, ICRS axes, rad^2. The attitude error rotates all
            directions of a frame by the same rotation.
        observer: geocentric position (3,) of the observer, ICRS, m, or None on the ground or if unknown.
    """

    time_ns: int
    directions: FloatArray
    covariance: FloatArray
    magnitudes: FloatArray
    attitude: FloatArray
    observer: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class MotionModel:
    """The prior and the process noise of the objects' motion.

    Attributes:
        rate: initial standard deviation of each component of the angular rate, rad/s.
        closing: initial standard deviation of the ratio (range rate) / range, 1/s.
        wander: noise density of the tidal acceleration divided by the range, 1/s^3. Between two low orbits
            with the orbital rate n, the component of the tidal acceleration across the line of sight, divided
            by the range, is at most 1.5 n^2 = 1.8e-6 1/s^2. With the default density, the errors of direction
            and rate agree with the covariance in passes with angular rates of 0.05 to 0.6 deg/s and ranges of
            up to 5,000 km.
        residual_wander: noise density that replaces `wander` if the gravity gradient is known, 1/s^3.
        bend: standard deviation of the unmodelled acceleration along the line of sight on curved paths,
            divided by the range and by the squared angular rate of the object.
    """

    rate: float = 0.01
    closing: float = 0.01
    wander: float = 1.6e-12
    residual_wander: float = 4e-13
    bend: float = 0.3

    def __post_init__(self) -> None:
        """Raise ArgumentError for a value that is negative or not a finite number."""
        check_amounts(self)


@dataclass(frozen=True, slots=True, eq=False)
class LineOfSightState:
    """Direction of an object, and velocity of the object relative to the observer, at one time.

    Attributes:
        time_ns: time of the state.
        direction: unit vector (3,) to the object, ICRS.
        velocity: velocity (3,) relative to the observer, divided by the range (z of the module's docstring),
            ICRS, 1/s.
        covariance: covariance (6, 6) of direction and velocity, with zero variance along the direction.
    """

    time_ns: int
    direction: FloatArray
    velocity: FloatArray
    covariance: FloatArray

    @property
    def rate(self) -> FloatArray:
        """Time derivative (3,) of the direction, which is normal to the direction, rad/s."""
        return self.velocity - (self.velocity @ self.direction) * self.direction

    @property
    def acceleration(self) -> FloatArray:
        """Component (3,) of the angular acceleration normal to the direction, rad/s^2."""
        return -2.0 * float(self.velocity @ self.direction) * self.rate


@dataclass(frozen=True, slots=True, eq=False)
class DirectionInnovation:
    """Residual (2,), rad, of a measured and a predicted direction, with covariance and chi-square."""

    residual: FloatArray
    covariance: FloatArray
    observation: FloatArray
    chi_square: float


def begin(
    time_ns: int, direction: FloatArray, covariance: FloatArray, motion: MotionModel
) -> LineOfSightState:
    """Return the line of sight, with unknown rate, after one sighting with covariance (3, 3), rad^2."""
    along = np.outer(direction, direction)
    across = np.eye(3) - along
    start = np.zeros((6, 6))
    start[:3, :3] = across @ covariance @ across
    start[3:, 3:] = motion.rate**2 * across + motion.closing**2 * along
    return LineOfSightState(time_ns, direction, np.zeros(3), start)


def tides(observer: FloatArray) -> FloatArray:
    """Return the gravity gradient (3, 3), 1/s^2, at a geocentric position (3,), m, in ICRS axes.

    To first order, the relative acceleration in free fall is the gradient times the relative position.
    """
    distance = float(np.linalg.norm(observer))
    up = observer / distance
    return np.asarray(GRAVITATIONAL_PARAMETER / distance**3 * (3.0 * np.outer(up, up) - np.eye(3)))


def predict(
    state: LineOfSightState, time_ns: int, motion: MotionModel, tide: FloatArray | None = None
) -> LineOfSightState:
    """Return the line of sight propagated to `time_ns`. Raises ValueError for an earlier time.

    The argument `tide` (3, 3), 1/s^2, is the gravity gradient, or None if unknown.
    """
    step = (time_ns - state.time_ns) * 1e-9
    if step == 0.0:
        return state
    if step < 0.0:
        raise ValueError(f"time_ns is {time_ns}: it must not be before {state.time_ns}")
    transition = np.eye(6)
    transition[:3, 3:] = step * np.eye(3)
    if tide is not None:
        transition[:3, :3] += 0.5 * step**2 * tide
        transition[3:, :3] = step * tide
    along = np.outer(state.direction, state.direction)
    rate = float(np.linalg.norm(state.rate))
    wander = motion.residual_wander if tide is not None else motion.wander
    density = wander * np.eye(3) + motion.bend**2 * rate**3 * along
    spread = transition @ state.covariance @ transition.T + np.block(
        [[density * step**3 / 3.0, density * step**2 / 2.0], [density * step**2 / 2.0, density * step]]
    )
    moved = transition @ np.concatenate([state.direction, state.velocity])
    return _at_unit_range(time_ns, moved[:3], moved[3:], spread)


def compare(state: LineOfSightState, direction: FloatArray, covariance: FloatArray) -> DirectionInnovation:
    """Return the residual of a measured direction (3,) of covariance (3, 3), rad^2, from `state`."""
    basis = tangent_basis(state.direction)
    residual = basis @ direction / max(float(direction @ state.direction), 1e-3)
    observation = np.hstack([basis, np.zeros((2, 3))])
    expected = observation @ state.covariance @ observation.T + basis @ covariance @ basis.T
    return DirectionInnovation(
        residual, expected, observation, float(residual @ np.linalg.solve(expected, residual))
    )


def update(state: LineOfSightState, direction: FloatArray, covariance: FloatArray) -> LineOfSightState:
    """Return the line of sight updated with a measured direction (3,) of covariance (3, 3), rad^2."""
    seen = compare(state, direction, covariance)
    cross = state.covariance @ seen.observation.T
    gain = np.asarray(np.linalg.solve(seen.covariance, cross.T).T)
    change = gain @ seen.residual
    spread = updated(state.covariance, gain, cross, seen.covariance)
    position, velocity = state.direction + change[:3], state.velocity + change[3:]
    return _at_unit_range(state.time_ns, position, velocity, spread)


def _at_unit_range(
    time_ns: int, position: FloatArray, velocity: FloatArray, covariance: FloatArray
) -> LineOfSightState:
    """Return the line of sight from a filter state, which is first divided by the length of `position`."""
    size = float(np.linalg.norm(position))
    direction, scaled = position / size, velocity / size
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = (np.eye(3) - np.outer(direction, direction)) / size
    jacobian[3:, :3] = -np.outer(scaled, direction) / size
    jacobian[3:, 3:] = np.eye(3) / size
    spread = jacobian @ covariance @ jacobian.T
    return LineOfSightState(time_ns, direction, scaled, 0.5 * (spread + spread.T))


_UNSEEN = np.full(3, np.nan)
_ALIKE = 2.0
"""Largest brightness difference between a sighting and a tentative track, in standard deviations. For a
confirmed track the brightness difference is not limited, because the position is known well and an object may
flash."""


@dataclass(frozen=True, slots=True)
class TrackSettings:
    """Settings for starting, confirming and ending tracks.

    Attributes:
        motion: prior and process noise of the objects' motion.
        needed: number of sightings within `within` frames that confirm a track.
        within: number of frames in which `needed` sightings confirm a track.
        missed: probability that the gate rejects a true sighting of the object.
        moving: minimum angular rate at which a track is confirmed, in standard deviations of the rate.
        minimum_rate: minimum angular rate at which a track is confirmed, rad/s; slower objects may be
            uncatalogued stars.
        coast: time without a sighting after which a confirmed track ends, s.
        maximum_tracks: largest number of tracks, including tentative tracks.
        brightness: standard deviation of the brightness of an object from sighting to sighting, magnitudes.
    """

    motion: MotionModel = field(default_factory=MotionModel)
    needed: int = 4
    within: int = 6
    missed: float = 1e-4
    moving: float = 8.0
    minimum_rate: float = 1e-4
    coast: float = 15.0
    maximum_tracks: int = 32
    brightness: float = 0.75

    def __post_init__(self) -> None:
        """Raise ArgumentError for a value out of its range."""
        check_amounts(self, "needed", "missed", "maximum_tracks", "brightness")
        check_type("motion", self.motion, MotionModel)
        if not self.missed < 1.0:
            raise ArgumentError("missed", f"{self.missed}: give a probability below 1")
        if self.needed > self.within:
            raise ArgumentError("needed", f"{self.needed}: give at most `within`, which is {self.within}")


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """One track.

    Attributes:
        number: number of the confirmed track, counted from 1; 0 for a tentative track.
        line: line of sight to the object at the time of the newest frame.
        seen_ns: time of the last sighting of the object, ns.
        sightings: number of sightings assigned to the track.
        frames: number of frames since the start of the track.
        magnitude: mean magnitude of the last sightings, or NaN if unknown.
        magnitude_sigma: standard deviation of the mean magnitude, computed from the scatter, or NaN before
            the second sighting. The error due to the colours of the stars is not included.
        history: one bit per frame, set if the frame contains a sighting of the object; the lowest bit is the
            newest frame.
        measured: direction (3,) of the sighting in the newest frame, or NaN without a sighting.
        measured_sigma: standard deviation of `measured` along each axis, including the attitude error, rad.
        chi_square: chi-square of the sightings relative to the predictions, with two degrees of freedom per
            sighting after the first sighting.
    """

    number: int
    line: LineOfSightState
    seen_ns: int
    sightings: int
    frames: int
    magnitude: float
    history: int
    measured: FloatArray
    measured_sigma: float
    chi_square: float = 0.0
    magnitude_sigma: float = math.nan

    @property
    def confirmed(self) -> bool:
        """Whether the track is confirmed as an object."""
        return self.number > 0

    @property
    def seen(self) -> bool:
        """Whether the newest frame has a sighting of the object."""
        return bool(self.history & 1)


class ObjectTracker:
    """A tracker of objects in successive frames."""

    def __init__(self, settings: TrackSettings) -> None:
        self._settings = settings
        self._gate = bound(settings.missed, 2)
        self._tracks: list[Track] = []
        self._newest_ns: int | None = None
        self._confirmed = 0

    @property
    def objects(self) -> tuple[Track, ...]:
        """The confirmed tracks, the oldest track first."""
        return tuple(sorted((t for t in self._tracks if t.confirmed), key=lambda track: track.number))

    def predicted(self, number: int, time_ns: int) -> LineOfSightState | None:
        """Return the predicted line of sight of a confirmed track, or None if the track has ended."""
        for track in self._tracks:
            if track.number == number > 0 and time_ns >= track.line.time_ns:
                return predict(track.line, time_ns, self._settings.motion)
        return None

    def clear(self) -> None:
        """Delete all tracks. The next frame may be earlier than the previous frame."""
        self._tracks, self._newest_ns = [], None

    def ingest(self, frame: FrameSightings) -> tuple[list[Track], list[Track]]:
        """Process a frame, and return the newly confirmed tracks and the confirmed tracks that ended.

        Raises ValueError, without any change of the tracks, for a frame that is not later than the previous
        frame. Two frames of the same time may show the same exposure, so their errors would not be
        independent.
        """
        if self._newest_ns is not None and frame.time_ns <= self._newest_ns:
            raise ValueError(f"time_ns is {frame.time_ns}: it must be after {self._newest_ns}")
        motion = self._settings.motion
        tide = None if frame.observer is None else tides(frame.observer)
        tracks = [
            replace(track, line=predict(track.line, frame.time_ns, motion, tide), frames=track.frames + 1)
            for track in self._tracks
        ]
        # From here on, the covariances of the sighted directions include the attitude error.
        crosses = cross_matrices(frame.directions)
        spread = np.asarray(
            frame.covariance + crosses @ frame.attitude @ crosses.transpose(0, 2, 1), dtype=float
        )
        taken = self._associated(tracks, frame, spread)
        after = []
        for index, track in enumerate(tracks):
            number = taken.get(index)
            history = (track.history << 1) & ((1 << self._settings.within) - 1)
            if number is None:
                after.append(replace(track, history=history, measured=_UNSEEN, measured_sigma=math.nan))
            else:
                after.append(self._updated(replace(track, history=history | 1), frame, number, spread))
        alive = [track for track in after if self._is_alive(track, frame.time_ns)]
        ended = [track for track in after if track.confirmed and track not in alive]
        confirmed = []
        for index, track in enumerate(alive):
            if not track.confirmed and self._is_object(track):
                self._confirmed += 1
                alive[index] = replace(track, number=self._confirmed)
                confirmed.append(alive[index])
        alive += self._new_tracks(
            frame, spread, set(taken.values()), self._settings.maximum_tracks - len(alive)
        )
        self._tracks, self._newest_ns = alive, frame.time_ns
        return confirmed, ended

    def _associated(self, tracks: list[Track], frame: FrameSightings, spread: FloatArray) -> dict[int, int]:
        """Return the index of the assigned sighting for each track that has a sighting."""
        pairs = []
        for index, track in enumerate(tracks):
            near = frame.directions @ track.line.direction > 0.5
            for number in np.flatnonzero(near).tolist():
                change = float(np.nan_to_num(frame.magnitudes[number] - track.magnitude))
                unlike = (change / self._settings.brightness) ** 2
                if unlike > _ALIKE**2 and not track.confirmed:
                    continue
                seen = compare(track.line, frame.directions[number], spread[number])
                if seen.chi_square + (0.0 if track.confirmed else unlike) <= self._gate:
                    # Chi-square alone would favour tracks with large covariances.
                    cost = seen.chi_square + unlike + math.log(float(np.linalg.det(seen.covariance)))
                    pairs.append((not track.confirmed, cost, index, number))
        taken: dict[int, int] = {}
        used: set[int] = set()
        for _, _, index, chosen in sorted(pairs):
            if index not in taken and chosen not in used:
                taken[index] = chosen
                used.add(chosen)
        return taken

    def _updated(self, track: Track, frame: FrameSightings, number: int, spread: FloatArray) -> Track:
        seen = compare(track.line, frame.directions[number], spread[number])
        count = track.sightings + 1
        mean, sigma = _brightness(track, float(frame.magnitudes[number]), min(count, self._settings.within))
        return replace(
            track,
            line=update(track.line, frame.directions[number], spread[number]),
            seen_ns=frame.time_ns,
            sightings=count,
            magnitude=mean,
            magnitude_sigma=sigma,
            measured=frame.directions[number],
            measured_sigma=_sigma(spread[number]),
            chi_square=track.chi_square + seen.chi_square,
        )

    def _is_alive(self, track: Track, now_ns: int) -> bool:
        settings = self._settings
        if track.confirmed:
            return now_ns - track.seen_ns <= round(settings.coast * 1e9)
        remaining = settings.within - track.frames
        return track.history.bit_count() + max(remaining, 0) >= settings.needed

    def _is_object(self, track: Track) -> bool:
        if track.history.bit_count() < self._settings.needed:
            return False
        # The first two sightings determine direction and rate, and later sightings test both.
        tested = 2 * (track.sightings - 1)
        if track.chi_square > bound(self._settings.missed, tested):
            return False
        rate = float(np.linalg.norm(track.line.rate))
        along = track.line.rate / max(rate, 1e-12)
        sigma = math.sqrt(max(float(along @ track.line.covariance[3:, 3:] @ along), 0.0))
        return rate > self._settings.minimum_rate and rate > self._settings.moving * sigma

    def _new_tracks(
        self, frame: FrameSightings, spread: FloatArray, used: set[int], room: int
    ) -> list[Track]:
        """Return tentative tracks for up to `room` unassigned sightings, the brightest first."""
        free = [number for number in range(len(frame.directions)) if number not in used]
        free.sort(key=lambda number: float(np.nan_to_num(frame.magnitudes[number], nan=99.0)))
        return [
            Track(
                0,
                begin(frame.time_ns, frame.directions[number], spread[number], self._settings.motion),
                frame.time_ns,
                1,
                1,
                float(frame.magnitudes[number]),
                1,
                frame.directions[number],
                _sigma(spread[number]),
            )
            for number in free[: max(room, 0)]
        ]


def _brightness(track: Track, magnitude: float, count: int) -> tuple[float, float]:
    """Return mean and standard deviation of the magnitude after the newest of `count` sightings."""
    if not math.isfinite(magnitude):
        return track.magnitude, track.magnitude_sigma
    if not math.isfinite(track.magnitude):
        return magnitude, math.nan
    before = 0.0 if math.isnan(track.magnitude_sigma) else track.magnitude_sigma
    change = magnitude - track.magnitude
    # The variance of the mean of n magnitudes is the sum of squared deviations divided by n (n - 1).
    scatter = before**2 * (count - 1) * max(count - 2, 0) + change**2 * (count - 1) / count
    return track.magnitude + change / count, math.sqrt(scatter / (count * (count - 1)))


def _sigma(covariance: FloatArray) -> float:
    """Return the standard deviation (rad) along each axis of a direction with a covariance (3, 3)."""
    return math.sqrt(0.5 * float(np.trace(covariance)))
