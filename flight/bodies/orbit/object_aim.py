"""Where a satellite that follows an object points: the place of the search, then the track of the object.

While there is no track the boresight stays where it is looked for. Of several tracks the brightest is
followed, until it ends. The body is steered by the track's prediction, so it goes on while the object is not
seen.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from flight.link import events
from flight.loop.fdir.event_log import EventLog
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix
from knightcube.gnc.control.three_axes.pointing_job import ObjectDirection, PointingJob
from knightcube.gnc.control.three_axes.pointing_table import PointingTable
from knightcube.gnc.guidance.three_axes.attitude_law import BodyAxes
from knightcube.gnc.guidance.three_axes.pointing_target import Goal, PointingTarget
from knightcube.gnc.tracking.tracker import Track

EFFORT = 0.25
"""Of the coils' limit: the dipole that costs as much as the error of pointing that costs one."""
ROLL = math.radians(20.0)
"""rad about the boresight that cost as much: the field has no corners that matter."""
RATE = math.radians(1.0)
"""rad/s off the object's that cost as much: a body that rolls fast blurs the stars at the field's edge."""
FORESIGHT = 30.0
"""s ahead that an object is judged to leave the field; farther off a young track is not believed."""


@dataclass(frozen=True, slots=True, eq=False)
class Sensor:
    """The star camera: its boresight (3,), body axes, and rad from there to the nearest edge."""

    boresight: FloatArray
    half_field: float


class ObjectAim:
    """Directs the planner's jobs while the target is an object.

    Attributes:
        seeks: whether it is.
        moved: whether there is news for the planner.
    """

    def __init__(self, sensor: Sensor | None, limit: float, log: EventLog) -> None:
        """`sensor` None: none looks for objects; `limit` A m^2 of each coil."""
        self._sensor, self._limit, self._events = sensor, limit, log
        self._target: PointingTarget | None = None
        self._place: FloatArray | None = None
        self._tracks: tuple[Track, ...] = ()
        self._followed = 0
        self._escapes = False
        self.seeks = self.moved = False

    def aim(self, target: PointingTarget) -> None:
        """Set the target."""
        if target == self._target:
            return
        self._target, self._place = target, None
        self._followed, self._escapes, self.moved = 0, False, False
        self.seeks = target.goal is Goal.OBJECT and self._sensor is not None

    def accept(self, tracks: Sequence[Track], now_ns: int) -> None:
        """Accept the confirmed tracks after a frame, and choose the one to follow."""
        self._tracks = tuple(tracks)
        if not self.seeks:
            return
        before = self._followed
        if self._track() is None:
            found = min(tracks, key=lambda track: np.nan_to_num(track.magnitude, nan=99.0), default=None)
            self._followed, self._escapes = 0 if found is None else found.number, False
            if found is not None:
                text = f"object {found.number}, V {found.magnitude:.1f} +- {found.magnitude_sigma:.1f}"
                self._events.report(events.OBJECT_FOLLOWED, now_ns, text)
            elif before:
                self._place = None  # looked for again where the body is by then, or where it was ordered
        self.moved = self.moved or before > 0 or self._followed > 0

    def directed(self, job: PointingJob) -> PointingJob:
        """Return a job for the body's target, with what is pointed to where that is an object."""
        sensor = self._sensor
        self.moved = False
        if not self.seeks or sensor is None:
            return job
        boresight = sensor.boresight
        axes = BodyAxes(boresight, np.eye(3)[int(np.argmin(np.abs(boresight)))])
        track = self._track()
        if track is None:
            place = self._searched(job.quaternion)
            # Another axis would make it cheap to turn the boresight away.
            weights = replace(job.weights, roll=ROLL, axis=boresight)
            return replace(
                job, axes=axes, weights=weights, slew=None, sight=ObjectDirection(place, np.zeros(3), 0.0)
            )
        line = track.line
        weights = replace(job.weights, dipole=EFFORT * self._limit, roll=ROLL, rate=RATE, axis=boresight)
        since = (line.time_ns - job.origin_ns) / SECOND_NS
        sight = ObjectDirection(line.direction, line.velocity, since)
        return replace(job, axes=axes, weights=weights, slew=None, sight=sight)

    def judge(self, job: PointingJob, table: PointingTable, now_ns: int) -> None:
        """Report an object that the path of a table does not keep in the field."""
        sensor, sight = self._sensor, job.sight
        if sensor is None or sight is None or not sight.velocity.any():
            return
        near = table.path.times <= FORESIGHT
        shown, wanted = (
            attitude_matrix(motion.quaternion[near]).transpose(0, 2, 1) @ sensor.boresight
            for motion in (table.path, table.wanted)
        )
        off = np.arccos(np.clip(np.sum(shown * wanted, axis=1), -1.0, 1.0))
        outside = np.flatnonzero(off > sensor.half_field)
        if len(outside) and not self._escapes:
            first = int(outside[0])
            fastest, needed, made = np.degrees(
                [
                    np.linalg.norm(values[near], axis=1).max()
                    for values in (table.wanted.rate, table.wanted.acceleration, table.path.acceleration)
                ]
            )
            text = (
                f"object {self._followed} leaves the field in {table.path.times[first]:.0f} s: up to "
                f"{fastest:.2f} deg/s and {needed:.4f} deg/s^2, the body makes {made:.4f}"
            )
            self._events.report(events.OBJECT_ESCAPES, now_ns, text)
        self._escapes = bool(len(outside))

    def _track(self) -> Track | None:
        """Return the track that is followed, None when it has ended or none is."""
        return next((track for track in self._tracks if track.number == self._followed > 0), None)

    def _searched(self, quaternion: FloatArray) -> FloatArray:
        """Return the direction (3,) of the search: the ordered one, or that of the camera when it began."""
        if self._place is None:
            assert self._target is not None
            assert self._sensor is not None
            if self._target.numbers:
                right, up = self._target.numbers
                across = math.cos(up)
                place = [across * math.cos(right), across * math.sin(right), math.sin(up)]
                self._place = np.array(place)
            else:
                self._place = attitude_matrix(quaternion).T @ self._sensor.boresight
        return self._place
