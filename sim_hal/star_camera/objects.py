"""Effects of the star camera's orbit: moving objects, aberration, stray light, and the Earth in view.

An object without an orbit, which is configured by a line of sight, moves along a great circle among the
stars. An object in orbit is lit by the Sun and can be hidden by the Earth. If the object does not tumble, its
magnitude changes only while the Earth covers part of the Sun as seen from the object.

    camera = propagate(KeplerianElements(semi_major_axis=6748e3, inclination=0.497), 55_000.0)
    orbit = propagate(KeplerianElements(semi_major_axis=7078e3, inclination=1.553), 55_000.0)
    debris = ResidentSpaceObject(orbit, magnitude=4.0)
    tracks = source_tracks(camera, [debris], epoch=2_461_041.5, start=120.0, end=120.5)
    frame = render(model, directions, magnitudes, times, quaternions, rng, extra=tracks)

Stellar aberration by the camera's motion is modelled as a rotation of the whole frame by the aberration at
the boresight (26" at most). The variation of the aberration across 20 deg, 4", is not modelled. An object in
orbit shares the Earth's motion, so the aberration that the Earth's motion causes is subtracted from its
track. The frame saturates if the Sun or sunlit ground is in the field of view, or if the boresight is closer
to one of them than the exclusion angle of the camera's baffle (`SkySection`). The dark Earth hides the stars
behind it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from flight.schema.devices import Camera
from flight.schema.document import ConfigError
from hal.interfaces.errors import OutOfRange
from knightcube.astro import quaternion
from knightcube.astro.arrays import BoolArray, FloatArray, Image
from knightcube.astro.earth.figure import EARTH_RADIUS, GRAVITATIONAL_PARAMETER
from knightcube.astro.earth.sun import DAY, SPEED_OF_LIGHT, UNIX_EPOCH, Shadow, earth_velocity, sunlit_share
from knightcube.vision.camera.lens import Pinhole
from sim_hal.settings import LineOfSight, ObjectState, SkyObject, SkySection, Tumble, utc_seconds
from sim_hal.star_camera.image import SourceTrack
from sim_hal.worlds.orbit import Orbit, propagate, sun_position
from sim_hal.worlds.world import OrbitEnvironment, OrbitingWorld, World, orbiting, utc_date

Expose = Callable[[int, FloatArray, FloatArray, Sequence[SourceTrack]], Future[Image]]
"""Function that renders a frame from number, times (k,), s, camera attitudes (k, 4) and object tracks."""

DEVICE = "resident space object"
TRACK_ERROR = 1e-7
"""Largest interpolation error (rad) of a track between its samples, 3e-4 px of the default camera."""
NEAREST = 1.0
"""Shortest distance (m) at which an object is modelled as a point."""
_FIRST_DURATION = 1000.0
"""Shortest time (s) over which an object's orbit is integrated."""
_SAMPLES = 17
"""Number of samples of a great-circle track; the chord error is 6e-5 rad at 20 deg/s over 1 s."""
_LIT_AIR = -0.1
"""Sine of the Sun's elevation (-6 deg) above which the air over the ground is sunlit."""
_RINGS, _SPOKES = 46, 120
"""Numbers of nadir angles (every 1.5 deg) and azimuths (every 3 deg) at which the ground is sampled."""


def hidden_by_earth(position: FloatArray, target: FloatArray) -> BoolArray:
    """Return whether the Earth hides `target` (m, 3) from `position` (m, 3), row by row (geocentric, m)."""
    way = target - position
    length = np.sum(way * way, axis=-1)
    nearest = np.clip(-np.sum(position * way, axis=-1) / np.where(length > 0.0, length, 1.0), 0.0, 1.0)
    closest = np.linalg.norm(position + nearest[..., None] * way, axis=-1)
    return np.asarray(closest < EARTH_RADIUS)


class BodyTrajectory(Protocol):
    """Protocol of the trajectory of a body, such as an `Orbit`."""

    def states_at(self, times: FloatArray) -> FloatArray:
        """Return the states (m, 6), position (m) and velocity (m/s), at `times` (m,), s."""

    def positions_at(self, times: FloatArray) -> FloatArray:
        """Return the positions (m, 3), m, at `times` (m,), s."""


@dataclass(frozen=True, slots=True, eq=False)
class ResidentSpaceObject:
    """An object in orbit whose Johnson V magnitude in full sunlight is `magnitude`."""

    orbit: Orbit
    magnitude: float


def source_tracks(
    camera: BodyTrajectory,
    objects: Sequence[ResidentSpaceObject],
    epoch: float,
    start: float,
    end: float,
    *,
    zero: float = 0.0,
    shadow: Shadow = "conical",
) -> list[SourceTrack]:
    """Return the tracks of the visible objects from `start` to `end` s.

    `epoch` is the Julian date (TT) at time 0 of the orbits. The times of the returned tracks are relative to
    the time `zero`, s. An object that is in the umbra or behind the Earth during the entire exposure is
    omitted. An object that is partly sunlit, or sunlit for part of the time, is given its mean brightness
    over the track. For a rolling shutter, `end` is the end of the last row's exposure. Raises OutOfRange for
    times outside the orbits, and for an object within 1 m of the camera.
    """
    if not start < end:
        raise OutOfRange(DEVICE, "end of the exposure", end, start, math.inf, "s")
    tracks = []
    for item in objects:
        times = _track_times(camera, item.orbit, start, end)
        position = item.orbit.positions_at(times)
        observer = camera.positions_at(times)
        seen = np.where(hidden_by_earth(observer, position), 0.0, 1.0)
        seen *= sunlit_share(position, sun_position(epoch + times / DAY), shadow)
        share = float(np.trapezoid(seen, times) / (end - start))
        if share > 0.0:
            direction = directions(observer, position)
            tracks.append(SourceTrack(times - zero, direction, item.magnitude - 2.5 * math.log10(share)))
    return tracks


def directions(observer: FloatArray, position: FloatArray) -> FloatArray:
    """Return the unit vectors (m, 3) from `observer` (m, 3) to `position` (m, 3), both in m."""
    way = position - observer
    return np.asarray(way / np.linalg.norm(way, axis=-1, keepdims=True))


def _track_times(camera: BodyTrajectory, orbit: Orbit, start: float, end: float) -> FloatArray:
    """Return times (s) between which the error of linearly interpolated directions is at most `TRACK_ERROR`.

    The angular acceleration of an object that passes at speed v and distance d is at most 0.65 (v/d)^2. An
    angular acceleration a gives an interpolation error of a h^2 / 8 in a step of h s.
    """
    times = np.linspace(start, end, 9)
    apart = orbit.states_at(times) - camera.states_at(times)
    distance = float(np.min(np.linalg.norm(apart[:, :3], axis=1)))
    if distance < NEAREST:
        raise OutOfRange(DEVICE, "distance from the camera", distance, NEAREST, math.inf, "m")
    rate = float(np.max(np.linalg.norm(apart[:, 3:], axis=1))) / distance
    steps = max(8, math.ceil((end - start) * rate / math.sqrt(8.0 * TRACK_ERROR)))
    return np.linspace(start, end, steps + 1)


class SkyObjects:
    """Moving objects of a simulated sky. Until `begin` is called, mission time counts from `start_ns`."""

    def __init__(self, entries: Sequence[SkyObject], utc: str, start_ns: int, world: World) -> None:
        """Store the objects.

        `utc` is the UTC at `start_ns`. Raises ConfigError for an invalid object.
        """
        for number, entry in enumerate(entries):
            name = f"simulation.objects[{number}]"
            if (entry.line_of_sight is None) == (entry.state is None):
                raise ConfigError(name, "give either a line_of_sight or a state")
            if entry.state is not None:
                orbiting(world, name)
                if (radius := math.hypot(*entry.state.position)) < EARTH_RADIUS:
                    problem = f"is {radius:g} m from the centre of the Earth, below the ground: give metres"
                    raise ConfigError(f"{name}.state.position", problem)
        self._world = world
        self._start_ns = self._epoch_ns = start_ns
        self._utc = utc_seconds(utc)
        self._date = UNIX_EPOCH + self._utc / DAY
        self._entries = tuple(entries)
        self._orbits = [None if entry.state is None else _GrowingOrbit(entry.state) for entry in entries]

    def begin(self, epoch_ns: int) -> None:
        """Set mission time zero to `epoch_ns`."""
        self._epoch_ns = epoch_ns

    def tracks(self, start_ns: int, times: FloatArray) -> list[SourceTrack]:
        """Return the tracks during the exposure that starts at `start_ns`.

        `times` (k,), s, run from the start of the exposure to now.
        """
        found: list[SourceTrack] = []
        for entry, orbit in zip(self._entries, self._orbits, strict=True):
            mission = (start_ns - self._epoch_ns) * 1e-9 + times[[0, -1]]
            magnitude = entry.magnitude + (0.0 if entry.tumble is None else _dimming(entry.tumble, *mission))
            if orbit is not None:
                found += self._of_orbit(orbit, magnitude, start_ns, times)
            elif entry.line_of_sight is not None:
                found.append(_on_circle(entry.line_of_sight, magnitude, mission[0], times))
        return found

    def _of_orbit(
        self, orbit: _GrowingOrbit, magnitude: float, start_ns: int, times: FloatArray
    ) -> list[SourceTrack]:
        assert isinstance(self._world, OrbitingWorld)  # checked by `__init__`
        zero = (start_ns - self._start_ns) * 1e-9
        start, end = zero + float(times[0]), zero + float(times[-1])
        around = self._world.surroundings()
        now = self._world.utc_ns() * 1e-9 - self._utc
        camera = _FreeFall(now, np.array(around.position), np.array(around.velocity))
        target = ResidentSpaceObject(orbit.until(end), magnitude)
        shifted = []
        for track in source_tracks(camera, [target], self._date, start, end, zero=zero):
            velocity = target.orbit.states_at(np.clip(zero + track.times, 0.0, None))[:, 3:]
            own = (velocity + earth_velocity(self._date + end / DAY)) / SPEED_OF_LIGHT
            directions = track.directions - own
            directions /= np.linalg.norm(directions, axis=1, keepdims=True)
            at = track.times.copy()
            at[0], at[-1] = times[0], times[-1]  # the track must cover the exposure in spite of rounding
            shifted.append(SourceTrack(at, directions, track.magnitude))
        return shifted


@dataclass(frozen=True, slots=True, eq=False)
class _FreeFall:
    """Trajectory over about 1 s, given the position (3,), m, and velocity (3,), m/s, at time `at`, s."""

    at: float
    position: FloatArray
    velocity: FloatArray

    def states_at(self, times: FloatArray) -> FloatArray:
        """Return the extrapolated states (m, 6); after one second, the error of the position is 0.03 mm."""
        since = (np.asarray(times) - self.at)[:, None]
        pull = -GRAVITATIONAL_PARAMETER * self.position / np.linalg.norm(self.position) ** 3
        places = self.position + since * self.velocity + 0.5 * since**2 * pull
        return np.hstack([places, self.velocity + since * pull])

    def positions_at(self, times: FloatArray) -> FloatArray:
        """Return positions (m, 3)."""
        return self.states_at(times)[:, :3]


class _GrowingOrbit:
    """Orbit of an object, which is integrated again over a longer time when needed."""

    def __init__(self, start: ObjectState) -> None:
        self._start = start
        self._orbit: Orbit | None = None

    def state(self) -> tuple[FloatArray, FloatArray]:
        """Return the position (3,), m, and the velocity (3,), m/s, at time zero."""
        return np.array(self._start.position), np.array(self._start.velocity)

    def until(self, end: float) -> Orbit:
        """Return the orbit from time 0 to at least `end` s."""
        if self._orbit is None or self._orbit.duration < end:
            self._orbit = propagate(self, max(2.0 * end, _FIRST_DURATION))
        return self._orbit


def _on_circle(line: LineOfSight, magnitude: float, mission: float, times: FloatArray) -> SourceTrack:
    """Return the great-circle track of an object for an exposure that starts at mission time `mission` s."""
    right, up = math.radians(line.right_ascension_deg), math.radians(line.declination_deg)
    towards = math.radians(line.towards_deg)
    place = np.array([math.cos(up) * math.cos(right), math.cos(up) * math.sin(right), math.sin(up)])
    east = np.array([-math.sin(right), math.cos(right), 0.0])
    ahead = math.cos(towards) * np.cross(place, east) + math.sin(towards) * east
    at = np.linspace(times[0], times[-1], _SAMPLES)
    since = mission - times[0] + at - line.at
    angle = np.radians(line.rate_deg * since + 0.5 * line.acceleration_deg * since**2)[:, None]
    return SourceTrack(at, np.cos(angle) * place + np.sin(angle) * ahead, magnitude)


def _dimming(tumble: Tumble, start: float, end: float) -> float:
    """Return the mean change of a tumbling object's magnitude between two mission times (s)."""
    middles = start + (end - start) * (np.arange(64) + 0.5) / 64
    phase = 2.0 * np.pi * middles / tumble.period + math.radians(tumble.phase_deg)
    return float(-2.5 * math.log10(np.mean(10.0 ** (-0.4 * tumble.amplitude * np.sin(phase)))))


def from_orbit(expose: Expose, world: OrbitingWorld, camera: Camera, sky: SkySection) -> Expose:
    """Return an exposure function that adds the effects of Earth and Sun in orbit.

    The function `expose` renders the stars without Earth and Sun. `sky` holds the exclusion angles of the
    baffle.
    """
    pinhole = Pinhole.from_field_of_view(camera.columns, camera.rows, np.radians(camera.field_of_view_deg))
    top = (1 << camera.bits) - 1

    def exposed(
        sequence: int, times: FloatArray, attitudes: FloatArray, tracks: Sequence[SourceTrack]
    ) -> Future[Image]:
        around = world.surroundings()
        turned = aberrated(attitudes, earth_velocity(utc_date(world)) + around.velocity)
        rendered = expose(sequence, times, turned, tracks)
        to_camera = quaternion.attitude_matrix(attitudes[len(attitudes) // 2])
        blinded, hidden = view(pinhole, to_camera, around, sky)
        if not blinded and hidden is None:
            return rendered
        seen: Future[Image] = Future()

        def finish(done: Future[Image]) -> None:
            if not seen.set_running_or_notify_cancel():
                return
            if (error := done.exception()) is not None:
                seen.set_exception(error)
                return
            frame = done.result().copy()
            if blinded:
                frame[:] = min(top, np.iinfo(frame.dtype).max)
            elif hidden is not None:
                frame[hidden] = np.median(frame)
            seen.set_result(frame)

        rendered.add_done_callback(lambda done: None if done.cancelled() else finish(done))
        return seen

    return exposed


def aberrated(attitudes: FloatArray, velocity: FloatArray) -> FloatArray:
    """Return attitudes (k, 4), rotated so that the stars at the boresight are shifted by the aberration.

    The aberration shifts the stars towards `velocity` (3,), m/s.
    """
    boresights = quaternion.attitude_matrix(attitudes)[:, 2, :]
    # Aberration moves the stars towards the velocity, so the equivalent rotation of the camera is opposite.
    turn = np.cross(boresights, velocity / SPEED_OF_LIGHT)
    in_camera = np.einsum("kij,kj->ki", quaternion.attitude_matrix(attitudes), turn)
    return quaternion.multiply(quaternion.from_rotation_vector(-in_camera), attitudes)


def view(
    pinhole: Pinhole, to_camera: FloatArray, around: OrbitEnvironment, sky: SkySection
) -> tuple[bool, BoolArray | None]:
    """Return whether stray light blinds the camera, and a mask (rows, columns) of the dark Earth.

    The mask is None if the camera is blinded or the Earth is not in view. `sky` contains the exclusion angles
    of the baffle. Sun or sunlit ground in the field of view always blinds the camera.
    """
    corner = float(np.arccos(pinhole.unit_vectors(np.zeros((1, 2)))[0, 2]))
    sun_excluded = max(corner, math.radians(sky.sun_exclusion_deg))
    earth_excluded = max(corner, math.radians(sky.earth_exclusion_deg))
    boresight = to_camera[2]
    if around.sunlit > 0.0 and math.acos(np.clip(boresight @ around.sun, -1.0, 1.0)) < sun_excluded:
        return True, None
    position = np.array(around.position)
    down = -position / np.linalg.norm(position)
    disc = math.asin(EARTH_RADIUS / float(np.linalg.norm(position)))
    away = math.acos(np.clip(boresight @ down, -1.0, 1.0)) - disc
    sun = np.array(around.sun)
    if away < earth_excluded and sunlit_ground_angle(position, sun, boresight) < earth_excluded:
        return True, None
    if away > corner:
        return False, None
    rows, columns = np.mgrid[0 : pinhole.rows, 0 : pinhole.columns]
    rays = pinhole.unit_vectors(np.stack([columns.ravel(), rows.ravel()], axis=1).astype(float))
    hidden = rays @ (to_camera @ down) > math.cos(disc)
    return False, hidden.reshape(pinhole.rows, pinhole.columns) if hidden.any() else None


def sunlit_ground_angle(position: FloatArray, sun: FloatArray, boresight: FloatArray) -> float:
    """Return the smallest angle (rad) between `boresight` (3,) and visible ground under sunlit air.

    `position` (3,) is geocentric, m, and `sun` (3,) is the direction to the Sun; all vectors have the same
    axes. The error of the angle is about 1.5 deg, or zero if the nearest point of the limb is lit. Returns pi
    if all visible ground is dark.
    """
    distance = float(np.linalg.norm(position))
    down = -position / distance
    # The azimuths start at the azimuth of the boresight, so that the nearest point of the limb is sampled.
    across = boresight - (boresight @ down) * down
    if float(np.linalg.norm(across)) < 1e-9:
        across = np.cross(down, np.eye(3)[int(np.argmin(np.abs(down)))])
    ahead = across / np.linalg.norm(across)
    off = np.linspace(0.0, math.asin(EARTH_RADIUS / distance), _RINGS)[:, None, None]
    azimuth = np.linspace(0.0, 2.0 * np.pi, _SPOKES, endpoint=False)[None, :, None]
    around = np.cos(azimuth) * ahead + np.sin(azimuth) * np.cross(down, ahead)
    rays = np.cos(off) * down + np.sin(off) * around
    along = distance * np.cos(off)
    reach = along - np.sqrt(np.maximum(0.0, along**2 - distance**2 + EARTH_RADIUS**2))
    lit = (reach * rays + position) @ sun / EARTH_RADIUS > _LIT_AIR
    return math.acos(np.clip(np.max(rays[lit] @ boresight), -1.0, 1.0)) if lit.any() else math.pi
