"""Tracks of several objects over frames, and the filter of the line of sight to one object.

The filter uses directions alone. Its state is the relative position and velocity divided by the present
range: y, a unit vector, and z. Without forces z is constant and y moves on a straight line, so that a pass at
any rate is linear except for the measurement. The range divides out and is reset to one after each step.
These are the modified polar coordinates of Aidala and Hammel (IEEE Trans. Automatic Control 28, 1983) in
vectors. The component of z across the line is the angular rate v, the component along it s = (range rate) /
range, and the angular acceleration is -2 s v.

Observer and object fall about the Earth. The gravity gradient at the observer's position, if known, gives
their relative acceleration to first order in the distance over the orbit's radius.

Process noise: the tides of two low orbits, which rotate with the line, are modelled as white accelerations of
density `wander`, after subtraction of the gradient `residual_wander`. The range component also follows
motions that are not straight lines, such as an object on a great circle at a constant rate, whose s would
change by rate^2: a density of (`bend` rate^2)^2 / rate.

Sightings are assigned to tracks in order of their chi-square, each to at most one track (greedy nearest
neighbour; Blackman and Popoli, Design and Analysis of Modern Tracking Systems, 1999, 6.4). Unassigned
sightings start tentative tracks. A track is confirmed after m sightings in n frames if its rate is not that
of a star. Until then, two tracks may share a sighting for at most n frames. A confirmed track coasts while
its object is not visible.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from knightcube.astro.arrays import FloatArray, cross_matrices, tangent_basis
from knightcube.astro.chi_square import bound
from knightcube.astro.earth.figure import GRAVITATIONAL_PARAMETER


@dataclass(frozen=True, slots=True, eq=False)
class FrameSightings:
    """The n detected objects of a frame at one instant, false detections included.

    Attributes:
        time_ns: time of mid-exposure.
        directions: (n, 3) unit vectors, ICRS, corrected for stellar aberration.
        covariance: (n, 3, 3) rad^2, covariance of the directions due to the positions in the image, ICRS
            axes, without the error of the attitude.
        magnitudes: (n,) calibrated by the frame's stars; NaN if unknown.
        attitude: (3, 3) rad^2, of the small rotation, ICRS axes, that is common to all directions of the
            frame.
        observer: (3,) m from the Earth's centre, ICRS; None on the ground or if unknown.
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
        rate: rad/s, standard deviation of each component before the second sighting.
        closing: 1/s, standard deviation of (range rate) / range before the second sighting.
        wander: 1/s^3, density of scaled accelerations. Tides in low orbit reach 1.5 n^2 = 1.8e-6 1/s^2. With
            this density the errors of position and rate agree with their covariance in passes of 0.05 to 0.6
            deg/s at up to 5,000 km.
        residual_wander: 1/s^3, the same density if the gravity gradient is known, from the same passes.
        bend: change of the closing rate per time that a straight line does not explain, as a fraction of
            rate^2.
    """

    rate: float = 0.01
    closing: float = 0.01
    wander: float = 1.6e-12
    residual_wander: float = 4e-13
    bend: float = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class LineOfSightState:
    """A line of sight and its motion at one time.

    Attributes:
        time_ns: time of the state.
        direction: (3,) unit vector, ICRS.
        velocity: (3,) 1/s, z: its component across the line is the angular rate, that along it the closing
            rate.
        covariance: (6, 6) of direction and velocity; zero along the direction.
    """

    time_ns: int
    direction: FloatArray
    velocity: FloatArray
    covariance: FloatArray

    @property
    def rate(self) -> FloatArray:
        """Derivative (3,) of the direction, rad/s, normal to it."""
        return self.velocity - (self.velocity @ self.direction) * self.direction

    @property
    def acceleration(self) -> FloatArray:
        """Derivative (3,) of the rate, rad/s^2, normal to the direction."""
        return -2.0 * float(self.velocity @ self.direction) * self.rate


@dataclass(frozen=True, slots=True, eq=False)
class DirectionInnovation:
    """A measured direction relative to the predicted one: residual (2,) rad, covariance and chi-square."""

    residual: FloatArray
    covariance: FloatArray
    observation: FloatArray
    chi_square: float


def begin(
    time_ns: int, direction: FloatArray, covariance: FloatArray, motion: MotionModel
) -> LineOfSightState:
    """Return the line of sight after one sighting of `covariance` (3, 3) rad^2; its rate is unknown."""
    along = np.outer(direction, direction)
    across = np.eye(3) - along
    start = np.zeros((6, 6))
    start[:3, :3] = across @ covariance @ across
    start[3:, 3:] = motion.rate**2 * across + motion.closing**2 * along
    return LineOfSightState(time_ns, direction, np.zeros(3), start)


def tides(observer: FloatArray) -> FloatArray:
    """Return the gravity gradient (3, 3) 1/s^2 at a position (3,) m from the Earth's centre, ICRS.

    To first order, an object falling beside the observer has a relative acceleration of this matrix times its
    relative position.
    """
    distance = float(np.linalg.norm(observer))
    up = observer / distance
    return np.asarray(GRAVITATIONAL_PARAMETER / distance**3 * (3.0 * np.outer(up, up) - np.eye(3)))


def predict(
    state: LineOfSightState, time_ns: int, motion: MotionModel, tide: FloatArray | None = None
) -> LineOfSightState:
    """Return the line of sight at another time, not before its own. Raises ValueError for an earlier time.

    `tide` (3, 3) 1/s^2 is the gravity gradient, None if unknown.
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
    spread = transition @ state.covariance @ transition.T + _noise(state, step, motion, tide is not None)
    moved = transition @ np.concatenate([state.direction, state.velocity])
    return _at_unit_range(time_ns, moved[:3], moved[3:], spread)


def compare(state: LineOfSightState, direction: FloatArray, covariance: FloatArray) -> DirectionInnovation:
    """Return a direction (3,) of `covariance` (3, 3) rad^2 relative to the state at the same time."""
    basis = tangent_basis(state.direction)
    residual = basis @ direction / max(float(direction @ state.direction), 1e-3)
    observation = np.hstack([basis, np.zeros((2, 3))])
    expected = observation @ state.covariance @ observation.T + basis @ covariance @ basis.T
    return DirectionInnovation(
        residual, expected, observation, float(residual @ np.linalg.solve(expected, residual))
    )


def update(state: LineOfSightState, direction: FloatArray, covariance: FloatArray) -> LineOfSightState:
    """Return the state updated with a sighting (3,) of `covariance` (3, 3) rad^2 at the same time."""
    seen = compare(state, direction, covariance)
    gain = np.linalg.solve(seen.covariance, seen.observation @ state.covariance).T
    change = gain @ seen.residual
    kept = np.eye(6) - gain @ seen.observation
    basis = tangent_basis(state.direction)
    noise = basis @ covariance @ basis.T
    spread = kept @ state.covariance @ kept.T + gain @ noise @ gain.T
    position, velocity = state.direction + change[:3], state.velocity + change[3:]
    return _at_unit_range(state.time_ns, position, velocity, spread)


def _at_unit_range(
    time_ns: int, position: FloatArray, velocity: FloatArray, covariance: FloatArray
) -> LineOfSightState:
    """Return the state divided by its range, the length of `position`."""
    size = float(np.linalg.norm(position))
    direction, scaled = position / size, velocity / size
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = (np.eye(3) - np.outer(direction, direction)) / size
    jacobian[3:, :3] = -np.outer(scaled, direction) / size
    jacobian[3:, 3:] = np.eye(3) / size
    spread = jacobian @ covariance @ jacobian.T
    return LineOfSightState(time_ns, direction, scaled, 0.5 * (spread + spread.T))


def _noise(state: LineOfSightState, step: float, motion: MotionModel, known: bool) -> FloatArray:
    """Return the covariance (6, 6) of white accelerations over `step` s.

    `known` is true if the gravity gradient is known.
    """
    along = np.outer(state.direction, state.direction)
    rate = float(np.linalg.norm(state.rate))
    wander = motion.residual_wander if known else motion.wander
    density = wander * np.eye(3) + motion.bend**2 * rate**3 * along
    return np.block(
        [[density * step**3 / 3.0, density * step**2 / 2.0], [density * step**2 / 2.0, density * step]]
    )


_UNSEEN = np.full(3, np.nan)
_ALIKE = 2.0
"""Largest brightness difference of a sighting from a tentative track, in standard deviations. The position of
a confirmed track is known closely, so that a flashing object may differ by more there."""


@dataclass(frozen=True, slots=True)
class TrackSettings:
    """Settings of the start, the confirmation and the end of tracks.

    Attributes:
        motion: the model of the motion.
        needed: number of sightings, within `within` frames, that confirm a track.
        within: number of frames in which `needed` sightings confirm a track.
        missed: probability that the gate rejects the object's own sighting.
        moving: standard deviations of the rate by which a confirmed track must differ from the stars.
        minimum_rate: rad/s, below which an object cannot be distinguished from an uncatalogued star.
        coast: s that a confirmed track lasts without a sighting.
        maximum_tracks: largest number of tracks, tentative ones included.
        brightness: magnitudes, standard deviation between sightings of one object.
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


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """One track.

    Attributes:
        number: counts from 1 once the track is confirmed; 0 before.
        line: line of sight at the newest frame.
        seen_ns: time of the last sighting.
        sightings: number of sightings.
        frames: number of frames since the start.
        magnitude: mean of the last sightings, NaN if unknown.
        magnitude_sigma: standard deviation of that mean by the scatter; NaN before the second sighting. It
            excludes the common error of the frames' magnitudes by the colours of the stars.
        history: one bit per frame, the newest lowest; set for a sighting.
        measured: (3,) direction of the sighting in the newest frame, NaN without one.
        measured_sigma: rad along each axis of that direction, including the attitude's share.
        chi_square: chi-square of the sightings relative to their predictions, with two degrees of freedom per
            sighting after the first.
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
    """Tracks the objects in successive frames."""

    def __init__(self, settings: TrackSettings) -> None:
        self._settings = settings
        self._gate = bound(settings.missed, 2)
        self._tracks: list[Track] = []
        self._confirmed = 0

    @property
    def objects(self) -> tuple[Track, ...]:
        """The confirmed tracks, the oldest first."""
        return tuple(sorted((t for t in self._tracks if t.confirmed), key=lambda track: track.number))

    def predicted(self, number: int, time_ns: int) -> LineOfSightState | None:
        """Return the predicted line of sight of a confirmed track; None if it has ended."""
        for track in self._tracks:
            if track.number == number > 0 and time_ns >= track.line.time_ns:
                return predict(track.line, time_ns, self._settings.motion)
        return None

    def clear(self) -> None:
        """Delete all tracks."""
        self._tracks = []

    def ingest(self, frame: FrameSightings) -> tuple[list[Track], list[Track]]:
        """Process a frame; return the tracks that it confirmed, and the confirmed tracks that it ended.

        Raises ValueError for a frame older than the last.
        """
        motion = self._settings.motion
        tide = None if frame.observer is None else tides(frame.observer)
        tracks = [
            replace(track, line=predict(track.line, frame.time_ns, motion, tide), frames=track.frames + 1)
            for track in self._tracks
        ]
        # The covariance of the directions includes that of the attitude.
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
        self._tracks = alive
        return confirmed, ended

    def _associated(self, tracks: list[Track], frame: FrameSightings, spread: FloatArray) -> dict[int, int]:
        """Return the index of the sighting for each track that has one."""
        pairs = []
        for index, track in enumerate(tracks):
            near = frame.directions @ track.line.direction > 0.5
            for number in np.flatnonzero(near).tolist():
                change = float(np.nan_to_num(frame.magnitudes[number] - track.magnitude))
                unlike = (change / self._settings.brightness) ** 2
                if unlike > _ALIKE**2 and not track.confirmed:
                    continue
                seen = compare(track.line, frame.directions[number], spread[number])
                if seen.chi_square + unlike <= self._gate:
                    # Compare normalised likelihoods, as a large covariance widens the gate.
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
        # The first two sightings give position and rate, and the others test them.
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
        """Return a tentative track for each unassigned sighting, the brightest if room is short."""
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
    """Return mean and standard deviation of the magnitude after a new sighting, the newest of `count`."""
    if not math.isfinite(magnitude):
        return track.magnitude, track.magnitude_sigma
    if not math.isfinite(track.magnitude):
        return magnitude, math.nan
    before = 0.0 if math.isnan(track.magnitude_sigma) else track.magnitude_sigma
    change = magnitude - track.magnitude
    # The variance of the mean of n is the scatter over n (n - 1); older sightings beyond n - 1 are ignored.
    scatter = before**2 * (count - 1) * max(count - 2, 0) + change**2 * (count - 1) / count
    return track.magnitude + change / count, math.sqrt(scatter / (count * (count - 1)))


def _sigma(covariance: FloatArray) -> float:
    """Return the standard deviation (rad) along each axis of a direction with a covariance (3, 3)."""
    return math.sqrt(0.5 * float(np.trace(covariance)))
