"""Tests that an object is searched for, followed, predicted while it is lost, and given up with a reason."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from flight.bodies.orbit.guidance import ObjectAim, Sensor
from flight.link.events import EventKind
from flight.loop.facts import EventLog
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.ephemeris import predict
from knightcube.astro.earth.orbit_knowledge import OrbitState
from knightcube.astro.quaternion import attitude_matrix, from_matrix, from_rotation_vector, multiply
from knightcube.gnc.control.pointing_job import LEAD, PointingJob, new_table
from knightcube.gnc.control.pointing_law import PointingLaw
from knightcube.gnc.control.pointing_table import PointingWeights
from knightcube.gnc.guidance.attitude_law import BodyAxes, following, references
from knightcube.gnc.guidance.pointing_target import Goal, PointingTarget
from knightcube.gnc.tracker import ObjectTracker, TrackSettings
from tests.support.object_passes import PIXEL, sightings

BORESIGHT = np.array([0.0, -1.0, 0.0])
SENSOR = Sensor(BORESIGHT, np.radians(10.0))
ORBIT = OrbitState(2_461_120.0, np.array([6.878e6, 0.0, 0.0]), np.array([0.0, -988.0, 7548.0]), 10.0)
FIELD = predict(ORBIT, 300.0)
OBJECT = PointingTarget(Goal.OBJECT)
CUBE, LONG = (np.array([1.1e-3, 1.05e-3, 0.99e-3]), 0.0959), (np.array([0.0066, 0.0333, 0.0333]), 0.2)
"""Inertia (kg m^2) and dipole limit (A m^2) of the KnightCube and of the 3U."""
BLINK = 0.05
"""Time step (s) of the test's integrator."""


@dataclass
class Chase:
    """A simulated rigid body in the magnetic field, with simulated sightings and plans without delay.

    The object starts at `begin` deg from the boresight and moves at `rate` deg/s in the direction `across`.
    """

    inertia: FloatArray
    limit: float
    rate: float
    begin: float
    quaternion: FloatArray
    across: FloatArray
    spin: FloatArray = field(default_factory=lambda: np.zeros(3))
    told: list[tuple[str, str]] = field(default_factory=list)
    off: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        log = EventLog(self._tell)
        self.aim = ObjectAim(SENSOR, self.limit, log)
        self.tracker = ObjectTracker(TrackSettings())
        self.first = attitude_matrix(self.quaternion).T @ BORESIGHT
        self.random = np.random.default_rng(5)

    def _tell(self, kind: EventKind, _time_ns: int, _held: int, text: str) -> None:
        self.told.append((kind.name, text))

    def place(self, time: float) -> FloatArray:
        angle = np.radians(self.begin) + np.radians(self.rate) * time
        return np.asarray(np.cos(angle) * self.first + np.sin(angle) * self.across)

    def fly(self, seconds: int, unseen: range = range(0)) -> None:
        law, origin = None, 0
        for second in range(seconds):
            shown = attitude_matrix(self.quaternion).T @ BORESIGHT
            self.off.append(float(np.degrees(np.arccos(min(float(shown @ self.place(second)), 1.0)))))
            in_field = self.off[-1] < 10.0 and second not in unseen
            seen = self.place(second)[None] if in_field else np.zeros((0, 3))
            frame = sightings(self.random, second, seen, 0.1 * PIXEL, 0.05 * PIXEL)
            self.tracker.ingest(frame)
            self.aim.aim(OBJECT)
            self.aim.accept(self.tracker.objects, frame.time_ns)
            if self.aim.moved and second % 3 == 0:
                job = self.aim.directed(self._job(second))
                table = new_table(job)
                self.aim.judge(job, table, frame.time_ns)
                law, origin = PointingLaw(table, self.limit), second
            self._turn(law, second, origin)

    def _job(self, second: int) -> PointingJob:
        at = FIELD.position_at(np.array([float(second)]))[0], FIELD.velocity_at(np.array([float(second)]))[0]
        orbit = OrbitState(FIELD.julian_date + second / 86_400.0, *at, 10.0)
        weights = PointingWeights(turn=0.0175, rate=1.0, dipole=1e-3, fastest=0.014)
        axes = BodyAxes(np.eye(3)[2], np.eye(3)[0])
        target, nothing = PointingTarget(Goal.NADIR), np.zeros(9)
        inertia, areas = np.diag(self.inertia), np.ones(3)
        origin_ns = second * SECOND_NS
        state = self.quaternion, self.spin
        return PointingJob(
            1, origin_ns, orbit, inertia, axes, weights, target, *state, nothing, self.limit, areas
        )

    def _turn(self, law: PointingLaw | None, second: int, origin: int) -> None:
        field_ = FIELD.field_at(np.array([float(second)]))[0]
        q, w, dipole = self.quaternion, self.spin, np.zeros(3)
        if law is not None and second - origin >= LEAD:
            seen = attitude_matrix(q) @ field_
            dipole = law.command(float(second - origin), q, w, seen, np.zeros(3), np.zeros(9)).dipole
        assert np.abs(dipole).max() <= self.limit * (1.0 + 1e-9)
        for _ in range(round(1.0 / BLINK)):
            torque = np.cross(dipole, attitude_matrix(q) @ field_)
            w = w + BLINK * (torque - np.cross(w, self.inertia * w)) / self.inertia
            q = multiply(from_rotation_vector(BLINK * w), q)
        self.quaternion, self.spin = q, w


def chase(craft: tuple[FloatArray, float], rate: float, begin: float) -> Chase:
    """Return a pursuit of an object that the coils can follow without a torque along the field."""
    strength = FIELD.field_at(np.zeros(1))[0]
    up = strength / np.linalg.norm(strength)
    first = np.cross(up, np.array([0.3, -0.5, 0.8]))
    first /= np.linalg.norm(first)
    # If the boresight is along the field, the coils can rotate it about both axes normal to the field.
    rows = np.stack([first, -up, np.cross(first, -up)])
    return Chase(*craft, rate, begin, from_matrix(rows), first)


def test_the_law_keeps_the_object_on_the_boresight_without_rotation_about_it() -> None:
    rng = np.random.default_rng(1)
    direction, velocity = rng.normal(size=3), 0.01 * rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    begun = rng.normal(size=4)
    law = following(BORESIGHT, direction, velocity, -3.0, begun / np.linalg.norm(begun)).attitudes
    times = np.arange(0.0, 60.0, 5.0)
    found = references(law, FIELD, times)
    place = direction + (times + 3.0)[:, None] * velocity
    place /= np.linalg.norm(place, axis=1, keepdims=True)
    shown = attitude_matrix(found.quaternion).transpose(0, 2, 1) @ BORESIGHT
    np.testing.assert_allclose(shown, place, atol=1e-9)
    np.testing.assert_allclose(found.rate @ BORESIGHT, 0.0, atol=1e-9)


def test_a_knightcube_follows_an_object_through_ten_seconds_without_it() -> None:
    flown = chase(CUBE, 0.4, -8.0)
    flown.fly(45, unseen=range(26, 36))
    assert [name for name, _ in flown.told] == ["object-followed"]
    assert max(flown.off[6:]) < 10.0
    assert max(flown.off[25:]) < 3.0


def test_a_3u_reports_that_its_torque_is_not_sufficient() -> None:
    flown = chase(LONG, 0.6, 0.0)
    flown.fly(8)
    names = [name for name, _ in flown.told]
    assert names[:2] == ["object-followed", "object-escapes"]
    assert "deg/s^2" in flown.told[1][1]
    assert flown.off[-1] > 2.0


def test_an_object_is_searched_in_the_commanded_direction_or_along_the_boresight() -> None:
    flown = chase(CUBE, 0.0, 0.0)
    job = flown._job(0)
    flown.aim.aim(OBJECT)
    sight = flown.aim.directed(job).sight
    assert sight is not None
    np.testing.assert_allclose(sight.direction, flown.first, atol=1e-12)
    flown.aim.aim(PointingTarget(Goal.OBJECT, (np.radians(90.0), np.radians(30.0))))
    sight = flown.aim.directed(job).sight
    assert sight is not None
    np.testing.assert_allclose(sight.direction, [0.0, np.cos(np.radians(30.0)), 0.5], atol=1e-12)
    flown.aim.aim(PointingTarget(Goal.NADIR))
    assert flown.aim.directed(job) is job
    assert not flown.aim.seeks


def test_the_boresight_stays_on_the_search_direction_for_any_pointing_axis() -> None:
    """The boresight stays on the search direction, whichever body axis is the pointing axis.

    If the weights of the rotation about +z were small, the optimal path would deviate by up to 7 deg.
    """
    rng = np.random.default_rng(3)
    for attitude in rng.normal(size=(5, 4)):
        spin = 3.5e-4 * np.array([0.4, -0.5, 0.8])
        flown = Chase(*CUBE, 0.0, 0.0, attitude / np.linalg.norm(attitude), np.eye(3)[0], spin)
        flown.aim.aim(OBJECT)
        axis = np.array([0.0, 0.0, 1.0])
        weights = PointingWeights(turn=0.0175, rate=1.0, dipole=3e-4, fastest=0.014, roll=0.1745, axis=axis)
        table = new_table(flown.aim.directed(replace(flown._job(0), weights=weights)))
        shown = attitude_matrix(table.path.quaternion).transpose(0, 2, 1) @ BORESIGHT
        assert np.degrees(np.arccos(np.clip(shown @ flown.first, -1.0, 1.0))).max() < 2.5


def test_of_two_objects_the_brighter_is_followed_to_its_end() -> None:
    flown = chase(CUBE, 0.3, -2.0)
    flown.aim.aim(OBJECT)
    aside = np.array([flown.place(0.0) + 0.03 * np.cross(flown.first, flown.across), flown.place(0.0)])
    for second in range(40):
        now = aside + np.radians(0.3) * second * flown.across
        now /= np.linalg.norm(now, axis=1, keepdims=True)
        shown = now if second < 12 else now[1:]
        magnitudes = np.array([3.0, 5.0])[-len(shown) :]
        flown.tracker.ingest(sightings(flown.random, second, shown, 0.1 * PIXEL, 0.0, magnitudes))
        flown.aim.accept(flown.tracker.objects, second * SECOND_NS)
    assert [text.split(",")[1] for _, text in flown.told] == [" V 3.0 +- 0.0", " V 5.0 +- 0.0"]
    assert flown.told[0][1] != flown.told[1][1]
