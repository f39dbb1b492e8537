"""One flight of campaign `object-flights`: a craft that searches for an object and follows it.

The flight has the filter, the planner's job and the pointing law of `orbit_pointing_flight`. The flight's own
`ObjectAim` chooses the target from the tracks of the flight's own `ObjectTracker`. Every two seconds, a frame
gives a star attitude and a sighting with a random error. Star attitude, sighting and the planner's table
arrive two seconds later. The object moves on its own orbit, which is integrated by DOP853.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from flight.bodies.orbit.guidance import ObjectAim, Sensor
from flight.link.events import EventKind
from flight.loop.facts import EventLog
from knightcube.astro.arrays import FloatArray, tangent_basis
from knightcube.astro.quaternion import attitude_matrix, from_matrix, from_rotation_vector
from knightcube.gnc.control import pointing_job
from knightcube.gnc.control.pointing_job import PointingJob
from knightcube.gnc.control.pointing_table import PointingTable
from knightcube.gnc.guidance.pointing_target import Goal, PointingTarget
from knightcube.gnc.tracker import FrameSightings, ObjectTracker, TrackSettings
from sim_hal.settings import TipOff
from tests.studies.campaigns.free_flight import FreeFlight
from tests.studies.campaigns.orbit_pointing_flight import CYCLE, STAR_SIGMA, PointingFlight
from tests.support.short_arcs import flow, passing_object

NEAREST, END = 120.0, 210.0
"""Times (s) at which the line of sight to the object rotates at the drawn rate, and at which the flight ends.
"""
FIELD = np.radians(10.0)
"""Angle (rad) from the boresight to the nearest edge of a frame of 512 px over 20 deg."""
PIXEL = 2.0 * FIELD / 512
FASTEST, DEAR = np.radians(1.0), 0.8
"""Largest rate (rad/s) of an accepted path (`fastest_rate` of orbit_object.yaml), and the fraction of this
rate above which the planner adds a cost.
"""
SIGHTING = {
    2.0: (0.004, 0.005, 0.99),
    3.0: (0.005, 0.005, 0.99),
    4.0: (0.007, 0.007, 0.99),
    5.0: (0.010, 0.010, 0.99),
    6.0: (0.016, 0.017, 0.99),
}
"""Error and claimed sigma (px) of a sighting, and fraction of frames with a sighting, by magnitude.

The values are those of rendered frames (`object-passes --runs 3 --seed 22`).
"""
GAP = 10.0
"""Duration (s) without sightings, in the flights with a gap."""
BORESIGHT: FloatArray = np.array([0.0, -1.0, 0.0])


class ObjectChase(PointingFlight):
    """A flight that follows an object.

    Attributes:
        reported: names of the events, in order.
        refused: number of planner tables that were rejected because the body would rotate too fast.
        notes: for each cycle the time; the angle (rad) from the boresight to the object; the body's rate
            about the boresight and its total rate (rad/s); the number of the followed track; whether the
            frame showed the object.
        shown, directions, fields: boresight (3,), true direction (3,) and field (3,), T, of each cycle, ICRS.
    """

    def __init__(self, wanted: dict[str, Any], seed: int) -> None:
        """Create the flight.

        Keys of `wanted`: craft, orbit, share of the worst disturbances, rate_deg, magnitude, gap (s or None).
        """
        self._draw = np.random.default_rng([seed, 23])
        super().__init__({**wanted, "target": PointingTarget(Goal.OBJECT)}, seed)
        self.reported: list[str] = []
        self.refused = 0
        self.shown: list[FloatArray] = []
        self.directions: list[FloatArray] = []
        self.fields: list[FloatArray] = []
        self._aim = ObjectAim(Sensor(BORESIGHT, FIELD), self.flight.limit, EventLog(self._tell))
        self._aim.aim(PointingTarget(Goal.OBJECT))
        self._tracker = ObjectTracker(TrackSettings())
        self._frame: FrameSightings | None = None
        self._table: tuple[PointingTable, PointingJob, float] | None = None

    def fly(self) -> None:
        """Fly to the end."""
        for k in range(round(END / CYCLE)):
            self.cycle(k * CYCLE)

    def direction(self, time: float) -> FloatArray:
        """Return the true direction (3,) of the object at `time` (s)."""
        place = self._state(time)[:3] - self.flight.body.orbit_truth().position
        return np.asarray(place / np.linalg.norm(place))

    def _state(self, time: float) -> FloatArray:
        """Return the object's state (6,), m and m/s, at a time."""
        return np.asarray((self._before if time < NEAREST else self._after)(time))

    def _release(self, held: FreeFlight) -> TipOff:
        """Return the release at rest, with the boresight at the point where the object will pass."""
        ahead, near = held.ephemeris(END), np.array([NEAREST])
        own = np.concatenate([ahead.position_at(near)[0], ahead.velocity_at(near)[0]])
        other = self._passing(own)
        spans = (NEAREST, 0.0), (NEAREST, END)
        back, on = (
            solve_ivp(flow, span, other, method="DOP853", rtol=1e-11, atol=1e-4, dense_output=True).sol
            for span in spans
        )
        self._before, self._after = back, on
        early = NEAREST - self._draw.uniform(30.0, 60.0)
        place = self._state(early)[:3] - ahead.position_at(np.array([early]))[0]
        place = place / np.linalg.norm(place)
        aside = np.radians(self._draw.uniform(-4.0, 4.0, 2)) @ tangent_basis(place)
        place = (place + aside) / np.linalg.norm(place + aside)
        rolled = attitude_matrix(from_rotation_vector(self._draw.uniform(0.0, 2.0 * np.pi) * BORESIGHT))
        x, z = tangent_basis(place)
        y = -place
        sense = np.sign(np.dot(np.cross(x, y), z))
        qx, qy, qz, qw = from_matrix(rolled @ np.array([x, y, sense * z])).tolist()
        return TipOff(rate=(0.0, 0.0, 0.0), attitude=(qx, qy, qz, qw))

    def _passing(self, own: FloatArray) -> FloatArray:
        """Return an object's state (6,) at the closest distance.

        At that time, the line of sight to the object rotates at the drawn rate.
        """
        rng, wanted = self._draw, self._wanted["rate_deg"]
        while True:
            direction, away, other = passing_object(rng, own)
            radius = np.linalg.norm(other[:3])
            relative = (other[3:] - own[3:]) / away
            rate, closing = np.linalg.norm(np.cross(direction, relative)), abs(direction @ relative)
            if 6.7e6 < radius < 9e6 and abs(np.degrees(rate) / wanted - 1.0) < 0.05 and closing < 0.2 * rate:
                return other

    def cycle(self, time: float) -> None:
        """Simulate one cycle; it first receives the results of the last cycle's frame and planning job."""
        if self._frame is not None:
            self._tracker.ingest(self._frame)
            self._aim.accept(self._tracker.objects, self.flight.time_ns)
        if self._table is not None:
            table, job, begun = self._table
            self._table = None
            flown = table.below(FASTEST)
            if flown is not None:
                self._aim.judge(job, table, self.flight.time_ns)
                self._fly(flown, begun)
            else:
                self.refused += 1
        if self._law is not None and self._aim.moved:
            self._plan(time)
        super().cycle(time)

    def _plan(self, time: float) -> None:
        job = self._aim.directed(self._job())
        table = pointing_job.new_table(job)
        if self._law is None:
            self._fly(table, time)
        else:
            self._table = table, job, time

    def _job(self) -> PointingJob:
        job = super()._job()
        weights = replace(job.weights, fastest=DEAR * FASTEST)
        return replace(job, origin_ns=self.flight.time_ns, weights=weights)

    def _note(self, time: float, square: float) -> None:
        """Do nothing, because the notes are recorded with the frames."""

    def _see_stars(self, time: float) -> None:
        """Give the filter the star attitude of the frame of the previous cycle; expose the next frame."""
        if self._stars is not None:
            self._filter.attitude(self._stars, STAR_SIGMA**2 * np.eye(3), CYCLE)
        self._stars = self.flight.attitude(STAR_SIGMA)
        motion, true = self.flight.motion, self.direction(time)
        place = attitude_matrix(motion.quaternion) @ true
        shown = attitude_matrix(motion.quaternion).T @ BORESIGHT
        _, claim, share = SIGHTING[self._wanted["magnitude"]]
        gap = self._wanted["gap"]
        hidden = gap is not None and gap <= time < gap + GAP
        # The field is square, with rows along x.
        inside = place @ BORESIGHT > 0.0 and np.abs(place[[0, 2]]).max() < np.tan(FIELD) * (place @ BORESIGHT)
        seen = bool(inside and not hidden and self._draw.random() < share)
        self._frame = self._sightings(true, claim, seen)
        off = float(np.arccos(np.clip(shown @ true, -1.0, 1.0)))
        rate = motion.rate
        followed = next((track.number for track in self._tracker.objects), 0)
        self.shown.append(shown)
        self.directions.append(true)
        self.fields.append(attitude_matrix(motion.quaternion).T @ motion.field_body)
        self.notes.append(
            [time, off, float(rate @ BORESIGHT), float(np.linalg.norm(rate)), followed, float(seen)]
        )

    def _sightings(self, true: FloatArray, claim: float, seen: bool) -> FrameSightings:
        """Return a frame with or without a sighting of the object."""
        draw, magnitude = self._draw, self._wanted["magnitude"]
        basis, error = tangent_basis(true), SIGHTING[magnitude][0]
        off = PIXEL * error * draw.normal(size=2) @ basis
        turn = np.cross(STAR_SIGMA * draw.normal(size=3), true)
        direction = true + off + turn
        direction /= np.linalg.norm(direction)
        spread = (PIXEL * claim) ** 2 * basis.T @ basis
        shown = slice(0, 1 if seen else 0)
        return FrameSightings(
            self.flight.time_ns,
            direction[None][shown],
            spread[None][shown],
            np.array([magnitude + 0.05 * draw.normal()])[shown],
            STAR_SIGMA**2 * np.eye(3),
            self.flight.body.orbit_truth().position,
        )

    def _tell(self, kind: EventKind, _time_ns: int, _held: int, _text: str) -> None:
        self.reported.append(kind.name)
