"""Tracks of several objects over frames: association, start, coasting and end.

Sightings go to the tracks in order of their chi-square, each to one track at most (greedy nearest neighbour;
Blackman and Popoli, Design and Analysis of Modern Tracking Systems, 1999, 6.4). What is left starts tentative
tracks. A track is confirmed after m sightings in n frames if its rate is not that of a star; until then two
tracks may hold on to one sighting no longer than n frames. A confirmed track coasts while it is not seen.

The attitude's error is common to the sightings of a frame. Each track alone sees it as an error of its own,
so its covariance stays honest; the gate between two tracks that are seen together is only the wider for it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.chi_square import bound
from knightcube.astro.directions import cross_matrices
from knightcube.gnc.tracking.line_of_sight import LineOfSight, Motion, begin, compare, predict, tides, update
from knightcube.gnc.tracking.sightings import Sightings

_UNSEEN = np.full(3, np.nan)
_ALIKE = 2.0
"""Standard deviations of the brightness, of a sighting of a tentative track at most. Where a confirmed one
shows itself is known closely: there an object that flashes may differ by more."""


@dataclass(frozen=True, slots=True)
class TrackSettings:
    """How tracks start, go on and end.

    Attributes:
        motion: what is believed of the motion.
        needed: sightings of a track before it is confirmed,
        within: in this many frames.
        missed: probability that the gate excludes the object's own sighting.
        moving: standard deviations of the rate by which a confirmed track must differ from the stars.
        least_rate: rad/s, below which nothing is told from a star that no catalogue has.
        coast: s that a confirmed track lasts without a sighting.
        most_tracks: tentative ones included.
        brightness: magnitudes, standard deviation between sightings of one object.
    """

    motion: Motion = field(default_factory=Motion)
    needed: int = 4
    within: int = 6
    missed: float = 1e-4
    moving: float = 8.0
    least_rate: float = 1e-4
    coast: float = 15.0
    most_tracks: int = 32
    brightness: float = 0.75


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """One track: `number` counts from 1 once it is confirmed, 0 before.

    Attributes:
        line: of sight, at the newest frame.
        seen_ns: time of the last sighting.
        sightings: how many; `frames` since the start.
        magnitude: mean of the last sightings', NaN when unknown.
        magnitude_sigma: of that mean, by their scatter; NaN before the second. The stars' colours, by which
            the frames' magnitudes are off together, are not in it.
        history: one bit a frame, the newest lowest: seen or not.
        measured: (3,) direction of the newest frame's sighting, NaN where it has none.
        measured_sigma: rad along an axis, of that, the attitude's share included.
        chi_square: of the sightings against their predictions, two degrees of freedom each after the first.
    """

    number: int
    line: LineOfSight
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
        """Whether it is an object."""
        return self.number > 0

    @property
    def seen(self) -> bool:
        """Whether the newest frame shows it."""
        return bool(self.history & 1)


class Tracker:
    """Owns the tracks."""

    def __init__(self, settings: TrackSettings) -> None:
        self._settings = settings
        self._gate = bound(settings.missed, 2)
        self._tracks: list[Track] = []
        self._confirmed = 0

    @property
    def objects(self) -> tuple[Track, ...]:
        """The confirmed tracks, the oldest first."""
        return tuple(sorted((t for t in self._tracks if t.confirmed), key=lambda track: track.number))

    def predicted(self, number: int, time_ns: int) -> LineOfSight | None:
        """Return the line of sight to the confirmed track of a number; None when it has ended."""
        for track in self._tracks:
            if track.number == number > 0 and time_ns >= track.line.time_ns:
                return predict(track.line, time_ns, self._settings.motion)
        return None

    def clear(self) -> None:
        """Forget all tracks."""
        self._tracks = []

    def ingest(self, frame: Sightings) -> tuple[list[Track], list[Track]]:
        """Accept a frame, not older than the last; return the tracks confirmed by it, and those it ended.

        A frame older than the last raises ValueError.
        """
        motion = self._settings.motion
        tide = None if frame.observer is None else tides(frame.observer)
        tracks = [
            replace(track, line=predict(track.line, frame.time_ns, motion, tide), frames=track.frames + 1)
            for track in self._tracks
        ]
        spread = _with_attitude(frame)
        taken = self._associated(tracks, frame, spread)
        after = []
        for index, track in enumerate(tracks):
            number = taken.get(index)
            history = (track.history << 1) & ((1 << self._settings.within) - 1)
            if number is None:
                after.append(replace(track, history=history, measured=_UNSEEN, measured_sigma=math.nan))
            else:
                after.append(self._seen(replace(track, history=history | 1), frame, number, spread))
        alive = [track for track in after if self._lives(track, frame.time_ns)]
        ended = [track for track in after if track.confirmed and track not in alive]
        alive, confirmed = self._confirm(alive)
        alive += self._started(frame, spread, set(taken.values()), self._settings.most_tracks - len(alive))
        self._tracks = alive
        return confirmed, ended

    def _associated(self, tracks: list[Track], frame: Sightings, spread: FloatArray) -> dict[int, int]:
        """Return the sighting of each track that has one."""
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
                    # A wide gate must not win by its width: the likelihood, with its normalisation.
                    cost = seen.chi_square + unlike + math.log(float(np.linalg.det(seen.covariance)))
                    pairs.append((not track.confirmed, cost, index, number))
        taken: dict[int, int] = {}
        used: set[int] = set()
        for _, _, index, chosen in sorted(pairs):
            if index not in taken and chosen not in used:
                taken[index] = chosen
                used.add(chosen)
        return taken

    def _seen(self, track: Track, frame: Sightings, number: int, spread: FloatArray) -> Track:
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

    def _lives(self, track: Track, now_ns: int) -> bool:
        settings = self._settings
        if track.confirmed:
            return now_ns - track.seen_ns <= round(settings.coast * 1e9)
        left = settings.within - track.frames
        return track.history.bit_count() + max(left, 0) >= settings.needed

    def _confirm(self, tracks: list[Track]) -> tuple[list[Track], list[Track]]:
        """Return the tracks, and those of them that are confirmed by now."""
        after, confirmed = [], []
        for track in tracks:
            if not track.confirmed and self._is_object(track):
                self._confirmed += 1
                track = replace(track, number=self._confirmed)  # noqa: PLW2901
                confirmed.append(track)
            after.append(track)
        return after, confirmed

    def _is_object(self, track: Track) -> bool:
        if track.history.bit_count() < self._settings.needed:
            return False
        # The first two sightings give place and rate, of which little was known: the others test them.
        tested = 2 * (track.sightings - 1)
        if track.chi_square > bound(self._settings.missed, tested):
            return False
        rate = float(np.linalg.norm(track.line.rate))
        along = track.line.rate / max(rate, 1e-12)
        sigma = math.sqrt(max(float(along @ track.line.covariance[3:, 3:] @ along), 0.0))
        return rate > self._settings.least_rate and rate > self._settings.moving * sigma

    def _started(self, frame: Sightings, spread: FloatArray, used: set[int], room: int) -> list[Track]:
        """Return a tentative track for each sighting that no track took, the brightest if room is short."""
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
    """Return mean and its standard deviation with a sighting's magnitude, the newest of `count`."""
    if not math.isfinite(magnitude):
        return track.magnitude, track.magnitude_sigma
    if not math.isfinite(track.magnitude):
        return magnitude, math.nan
    before = 0.0 if math.isnan(track.magnitude_sigma) else track.magnitude_sigma
    change = magnitude - track.magnitude
    # The variance of the mean of n is the scatter over n (n - 1): carried on as if the last n - 1 were all.
    scatter = before**2 * (count - 1) * max(count - 2, 0) + change**2 * (count - 1) / count
    return track.magnitude + change / count, math.sqrt(scatter / (count * (count - 1)))


def _sigma(covariance: FloatArray) -> float:
    """Return the standard deviation along an axis, rad, of a direction with a covariance (3, 3)."""
    return math.sqrt(0.5 * float(np.trace(covariance)))


def _with_attitude(frame: Sightings) -> FloatArray:
    """Return the covariance (n, 3, 3) of the directions with the attitude's share."""
    cross = cross_matrices(frame.directions)
    return np.asarray(frame.covariance + cross @ frame.attitude @ cross.transpose(0, 2, 1))
