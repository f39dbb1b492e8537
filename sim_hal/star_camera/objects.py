"""The star camera in orbit: objects that move in its sky, aberration, and light that spoils its frames.

An object on a line of sight moves on a great circle among the stars. An object in orbit is lit by the Sun and
hidden by the Earth. Its magnitude does not depend on the observer, except for the part of the Sun that the
Earth hides from it.

    camera = propagate(KeplerianElements(semi_major_axis=6748e3, inclination=0.497), 55_000.0)
    orbit = propagate(KeplerianElements(semi_major_axis=7078e3, inclination=1.553), 55_000.0)
    debris = ResidentSpaceObject(orbit, magnitude=4.0)
    tracks = source_tracks(camera, [debris], epoch=2_461_041.5, start=120.0, end=120.5)
    frame = render(model, directions, magnitudes, times, quaternions, rng, extra=tracks)

Aberration by the camera's motion rotates the whole frame by its value at the boresight (26" at most); the
change of scale across 20 deg, 4", is not modelled. An object in orbit shares the Earth's motion, so that the
part of the aberration by the Earth's motion does not apply to it; its track is shifted back by that part.
Sunlight beside the field, on ground in the field or through the baffle saturates the frame; the dark Earth
hides the stars behind it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from datetime import datetime
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
from sim_hal.settings import LineOfSight, ObjectState, SkyObject, Tumble
from sim_hal.star_camera.image import SourceTrack
from sim_hal.worlds.orbit import Orbit, propagate, sun_position
from sim_hal.worlds.world import OrbitEnvironment, OrbitingWorld, World, orbiting, utc_date

Expose = Callable[[int, FloatArray, FloatArray, Sequence[SourceTrack]], Future[Image]]
"""Renders a frame from its number, times (k,) s, camera attitudes (k, 4), and the tracks of objects."""

DEVICE = "resident space object"
TRACK_ERROR = 1e-7
"""Error (rad) of a track between its samples: 3e-4 px of the standard camera."""
NEAREST = 1.0
"""Shortest distance (m) at which an object is modelled as a point."""
_FIRST_DURATION = 1000.0
"""Time (s) over which an object's orbit is integrated at first; it is doubled as needed."""
_SAMPLES = 17
"""Samples of a track on a great circle; at 20 deg/s and 1 s the chords are within 6e-5 rad of it."""
BAFFLE = np.radians(25.0)
"""Angle (rad) outside the corner of the field within which the Sun blinds the camera."""


def hidden_by_earth(position: FloatArray, target: FloatArray) -> BoolArray:
    """Return for which pairs the Earth is between `position` and `target`, (m, 3) each."""
    way = target - position
    length = np.sum(way * way, axis=-1)
    nearest = np.clip(-np.sum(position * way, axis=-1) / np.where(length > 0.0, length, 1.0), 0.0, 1.0)
    closest = np.linalg.norm(position + nearest[..., None] * way, axis=-1)
    return np.asarray(closest < EARTH_RADIUS)


class BodyTrajectory(Protocol):
    """The trajectory of a body, such as an `Orbit`."""

    def states_at(self, times: FloatArray) -> FloatArray:
        """Return positions (m) and velocities (m/s), (m, 6), at `times` (m,) s."""

    def positions_at(self, times: FloatArray) -> FloatArray:
        """Return positions (m, 3) in m at `times` (m,) s."""


@dataclass(frozen=True, slots=True, eq=False)
class ResidentSpaceObject:
    """An object on its `orbit`, of Johnson V `magnitude` in full sunlight."""

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
    """Return the tracks from `start` to `end` s of the objects that are visible.

    `epoch` is the Julian date TT of the orbits' time 0. The times of the tracks count from `zero` s, so that
    they agree with those of an attitude history. An object in the umbra or behind the Earth throughout is
    left out; an object partly lit, or lit for part of the time, is fainter accordingly, evenly over the
    track. For a rolling shutter, `end` is the end of the last row's exposure. Raises OutOfRange beyond the
    ends of the orbits, and for an object within 1 m.
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
    """Return unit vectors (m, 3) from `observer` to `position`, (m, 3) m each."""
    way = position - observer
    return np.asarray(way / np.linalg.norm(way, axis=-1, keepdims=True))


def _track_times(camera: BodyTrajectory, orbit: Orbit, start: float, end: float) -> FloatArray:
    """Return times between which linear interpolation of the direction is within `TRACK_ERROR`.

    The direction of an object that passes at speed v and distance d accelerates by 0.65 (v/d)^2 at most; the
    error of a step h is an eighth of that, times h^2.
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
    """The objects of a simulated sky; mission time counts from `start_ns` until `begin` is called."""

    def __init__(self, entries: Sequence[SkyObject], utc: str, start_ns: int, world: World) -> None:
        """Take the objects; `utc` is the time of `start_ns`. Raises ConfigError for an invalid object."""
        for number, entry in enumerate(entries):
            name = f"simulation.objects[{number}]"
            if (entry.line_of_sight is None) == (entry.state is None):
                raise ConfigError(name, "give either a line_of_sight or a state")
            if entry.state is not None:
                orbiting(world, name)
        self._world = world
        self._start_ns = self._epoch_ns = start_ns
        self._utc = datetime.fromisoformat(utc).timestamp()
        self._date = UNIX_EPOCH + self._utc / DAY
        self._entries = tuple(entries)
        self._orbits = [None if entry.state is None else _GrowingOrbit(entry.state) for entry in entries]

    def begin(self, epoch_ns: int) -> None:
        """Begin mission time at `epoch_ns`."""
        self._epoch_ns = epoch_ns

    def tracks(self, start_ns: int, times: FloatArray) -> list[SourceTrack]:
        """Return the tracks over an exposure from `start_ns`; `times` (k,) s count from its start to now."""
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
            at[0], at[-1] = times[0], times[-1]  # despite rounding the track must cover the exposure
            shifted.append(SourceTrack(at, directions, track.magnitude))
        return shifted


@dataclass(frozen=True, slots=True, eq=False)
class _FreeFall:
    """A fall of about a second around the Earth, from position (3,) m and velocity (3,) m/s at time `at`."""

    at: float
    position: FloatArray
    velocity: FloatArray

    def states_at(self, times: FloatArray) -> FloatArray:
        """Return positions and velocities (m, 6); the error after a second is 0.03 mm."""
        since = (np.asarray(times) - self.at)[:, None]
        pull = -GRAVITATIONAL_PARAMETER * self.position / np.linalg.norm(self.position) ** 3
        places = self.position + since * self.velocity + 0.5 * since**2 * pull
        return np.hstack([places, self.velocity + since * pull])

    def positions_at(self, times: FloatArray) -> FloatArray:
        """Return positions (m, 3)."""
        return self.states_at(times)[:, :3]


class _GrowingOrbit:
    """The orbit of an object, integrated as far as needed."""

    def __init__(self, start: ObjectState) -> None:
        self._start = start
        self._orbit: Orbit | None = None

    def state(self) -> tuple[FloatArray, FloatArray]:
        """Return position (3,) m and velocity (3,) m/s at the start."""
        return np.array(self._start.position), np.array(self._start.velocity)

    def until(self, end: float) -> Orbit:
        """Return the orbit from 0 to at least `end` s."""
        if self._orbit is None or self._orbit.duration < end:
            self._orbit = propagate(self, max(2.0 * end, _FIRST_DURATION))
        return self._orbit


def _on_circle(line: LineOfSight, magnitude: float, mission: float, times: FloatArray) -> SourceTrack:
    """Return the track of an object on a great circle; the exposure starts at `mission` s."""
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
    """Return by how many magnitudes the mean light between two mission times is below the nominal light."""
    middles = start + (end - start) * (np.arange(64) + 0.5) / 64
    phase = 2.0 * np.pi * middles / tumble.period + math.radians(tumble.phase_deg)
    return float(-2.5 * math.log10(np.mean(10.0 ** (-0.4 * tumble.amplitude * np.sin(phase)))))


def from_orbit(expose: Expose, world: OrbitingWorld, camera: Camera) -> Expose:
    """Return the exposure of a camera in orbit; `expose` renders the stars without Earth and Sun."""
    pinhole = Pinhole.from_field_of_view(camera.columns, camera.rows, np.radians(camera.field_of_view_deg))
    top = (1 << camera.bits) - 1

    def exposed(
        sequence: int, times: FloatArray, attitudes: FloatArray, tracks: Sequence[SourceTrack]
    ) -> Future[Image]:
        around = world.surroundings()
        turned = aberrated(attitudes, earth_velocity(utc_date(world)) + around.velocity)
        rendered = expose(sequence, times, turned, tracks)
        to_camera = quaternion.attitude_matrix(attitudes[len(attitudes) // 2])
        blinded, hidden = view(pinhole, to_camera, around)
        if not blinded and hidden is None:
            return rendered
        seen: Future[Image] = Future()

        def finish(done: Future[Image]) -> None:
            if not seen.set_running_or_notify_cancel():
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
    """Return attitudes (k, 4) that shift the stars at the boresight towards `velocity` (3,) m/s."""
    boresights = quaternion.attitude_matrix(attitudes)[:, 2, :]
    # Aberration moves stars towards the velocity; the equivalent rotation of the camera is opposite.
    turn = np.cross(boresights, velocity / SPEED_OF_LIGHT)
    in_camera = np.einsum("kij,kj->ki", quaternion.attitude_matrix(attitudes), turn)
    return quaternion.multiply(quaternion.from_rotation_vector(-in_camera), attitudes)


def view(pinhole: Pinhole, to_camera: FloatArray, around: OrbitEnvironment) -> tuple[bool, BoolArray | None]:
    """Return whether sunlight blinds the camera, and the pixels (rows, columns) behind the dark Earth."""
    corner = float(np.arccos(pinhole.unit_vectors(np.zeros((1, 2)))[0, 2]))
    sun = to_camera @ around.sun
    if around.sunlit > 0.0 and np.arccos(np.clip(sun[2], -1.0, 1.0)) < corner + BAFFLE:
        return True, None
    distance = float(np.linalg.norm(around.position))
    down = to_camera @ around.position / -distance
    disc = float(np.arcsin(EARTH_RADIUS / distance))
    if np.arccos(np.clip(down[2], -1.0, 1.0)) > corner + disc:
        return False, None
    rows, columns = np.mgrid[0 : pinhole.rows, 0 : pinhole.columns]
    rays = pinhole.unit_vectors(np.stack([columns.ravel(), rows.ravel()], axis=1).astype(float))
    hidden = rays @ down > np.cos(disc)
    if not hidden.any():
        return False, None
    # The ground in view, sampled at about a thousand points; the upper air is lit to six degrees beyond the
    # terminator.
    sample = rays[hidden]
    sample = sample[:: max(1, len(sample) // 1000)]
    along = distance * (sample @ down)
    reach = along - np.sqrt(np.maximum(0.0, along**2 - distance**2 + EARTH_RADIUS**2))
    ground = reach[:, None] * sample - distance * down
    lit = bool(np.any(ground @ sun / EARTH_RADIUS > -0.1))
    return lit, hidden.reshape(pinhole.rows, pinhole.columns)
