"""Tracks of the objects that vision sights, with their packets and events."""

from __future__ import annotations

import math

import numpy as np

from flight.link import events
from flight.link.telemetry.definitions import SIGHTINGS, TRACK
from flight.link.telemetry.vision_definitions import MOST_SIGHTINGS
from flight.loop.body import Body
from flight.loop.services import Services
from knightcube.astro.arrays import FloatArray
from knightcube.gnc.tracking.tracker import FrameSightings, ObjectTracker, Track, TrackSettings
from knightcube.vision.objects.sighted import Sighted

_UNKNOWN = [math.nan] * 3


class ObjectTracking:
    """Owns the tracks of objects."""

    def __init__(self, settings: TrackSettings, body: Body, services: Services) -> None:
        self._body = body
        self._tracker = ObjectTracker(settings)
        self._recorder = services.recorder
        self._events = services.events

    def ingest(self, sequence: int, middle_ns: int, sighted: Sighted, now_ns: int) -> None:
        """Accept the sightings of frame number `sequence`, exposed about `middle_ns`."""
        self._record_sightings(sequence, middle_ns, sighted, now_ns)
        orbit = self._body.place(middle_ns)
        frame = FrameSightings(
            middle_ns,
            sighted.directions,
            sighted.covariance,
            sighted.magnitudes,
            sighted.attitude,
            None if orbit is None else orbit.position,
        )
        confirmed, ended = self._tracker.ingest(frame)
        for track in confirmed:
            rate_deg = math.degrees(float(np.linalg.norm(track.line.rate)))
            text = f"object {track.number}: {rate_deg:.3f} deg/s among the stars, V {track.magnitude:.1f}"
            self._events.report(events.OBJECT_FOUND, now_ns, text)
        for track in ended:
            away = (middle_ns - track.seen_ns) * 1e-9
            text = f"object {track.number}: not seen for {away:.1f} s, {track.sightings} sightings"
            self._events.report(events.OBJECT_LOST, now_ns, text)
        for track in self._tracker.objects:
            self._record_track(track, now_ns)
        self._body.sighted(self._tracker.objects, now_ns)

    def _record_sightings(self, sequence: int, middle_ns: int, sighted: Sighted, now_ns: int) -> None:
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

    def _record_track(self, track: Track, now_ns: int) -> None:
        line = track.line
        across = np.eye(3) - np.outer(line.direction, line.direction)
        orbit = self._body.place(line.time_ns)
        self._recorder.record(
            TRACK,
            now_ns,
            number=track.number,
            middle_ns=line.time_ns - self._recorder.epoch_ns,
            seen=int(track.seen),
            sightings=track.sightings,
            measured=track.measured.tolist(),
            measured_sigma=track.measured_sigma,
            direction=line.direction.tolist(),
            rate=line.rate.tolist(),
            acceleration=line.acceleration.tolist(),
            covariance=_packed(line.covariance[:3, :3]),
            rate_covariance=_packed(across @ line.covariance[3:, 3:] @ across),
            magnitude=track.magnitude,
            magnitude_sigma=track.magnitude_sigma,
            place=_UNKNOWN if orbit is None else orbit.position.tolist(),
            velocity=_UNKNOWN if orbit is None else orbit.velocity.tolist(),
            place_sigma=math.nan if orbit is None else orbit.sigma,
        )


def _padded(values: FloatArray) -> list[float]:
    """Return the first values, and NaN for those that are missing."""
    first = [float(value) for value in values[:MOST_SIGHTINGS]]
    return first + [math.nan] * (MOST_SIGHTINGS - len(first))


def _packed(c: FloatArray) -> list[float]:
    """Return xx yy zz xy xz yz of a symmetric matrix (3, 3)."""
    return [float(c[0, 0]), float(c[1, 1]), float(c[2, 2]), float(c[0, 1]), float(c[0, 2]), float(c[1, 2])]
