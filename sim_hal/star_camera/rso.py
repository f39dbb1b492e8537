"""Resident space objects (RSOs) in the star camera's field: points that move in the sky (Sease ch. 2).

    camera = propagate(KeplerianElements(semi_major_axis=6748e3, inclination=0.497), 55_000.0)
    orbit = propagate(KeplerianElements(semi_major_axis=7078e3, inclination=1.553), 55_000.0)
    debris = ResidentSpaceObject(orbit, magnitude=4.0)
    tracks = source_tracks(camera, [debris], epoch=2_461_041.5, start=120.0, end=120.5)
    frame = render(model, directions, magnitudes, times, quaternions, rng, extra=tracks)

The magnitude of an object does not depend on the observer, except for the part of the Sun that the Earth
hides from the object. Directions are geometric: like the stars of the catalogue, they exclude the aberration
by the camera's motion.

Exclusion (Sease 2.16-2.19, corrected): the Sun or the Earth is in the camera's field, or the Earth is
between camera and object. The boresight is the camera's +z, and the field is a cone around it. With half the
field of view (the thesis's choice) a corner of the frame may still contain the Sun or the limb; with the
pinhole's half diagonal it may not. Vectors are in ICRS, positions geocentric in m.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from hal.interfaces.errors import OutOfRange
from knightcube.astro import quaternion
from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.astro.earth.figure import EARTH_RADIUS
from knightcube.astro.earth.sun import DAY, SUN_RADIUS, Shadow, sunlit_share
from knightcube.vision.camera.lens import Pinhole
from sim_hal.star_camera import SourceTrack
from sim_hal.worlds.orbit import Orbit, sun_position


def boresights(attitudes: FloatArray, mounting: FloatArray = quaternion.IDENTITY) -> FloatArray:
    """Return the boresights (m, 3), ICRS, at body `attitudes` (m, 4); `mounting` (4,) body into camera."""
    return np.asarray(quaternion.attitude_matrix(quaternion.multiply(mounting, attitudes))[..., 2, :])


def sun_in_field(
    boresight: FloatArray, position: FloatArray, sun: FloatArray, half_angle: float, buffer: float = 0.0
) -> BoolArray:
    """Return at which `boresight` (m, 3) the Sun's disc is within `half_angle` + `buffer` rad (2.16, 2.17).

    `position` (m, 3) is the camera's, `sun` (m, 3) the Sun's; `buffer` is for stray light past the baffle.
    """
    to_sun = np.asarray(sun) - position
    return _within(boresight, to_sun, SUN_RADIUS, half_angle + buffer)


def earth_in_field(
    boresight: FloatArray, position: FloatArray, half_angle: float, buffer: float = 0.0
) -> BoolArray:
    """Return at which `boresight` (m, 3) the Earth is within `half_angle` + `buffer` rad (2.18, 2.19)."""
    return _within(boresight, -np.asarray(position), EARTH_RADIUS, half_angle + buffer)


def hidden_by_earth(position: FloatArray, target: FloatArray) -> BoolArray:
    """Return for which pairs the Earth stands between `position` and `target`, (m, 3) each."""
    way = target - position
    length = np.sum(way * way, axis=-1)
    nearest = np.clip(-np.sum(position * way, axis=-1) / np.where(length > 0.0, length, 1.0), 0.0, 1.0)
    closest = np.linalg.norm(position + nearest[..., None] * way, axis=-1)
    return np.asarray(closest < EARTH_RADIUS)


def in_field(
    camera: Pinhole, attitudes: FloatArray, directions: FloatArray, margin: float = 0.0
) -> BoolArray:
    """Return which `directions` (m, 3) ICRS are within `margin` px of the detector at camera `attitudes`."""
    seen = (quaternion.attitude_matrix(attitudes) @ directions[..., None])[..., 0]
    return camera.contains(camera.project(seen), margin)


def _within(boresight: FloatArray, to_body: FloatArray, radius: float, half_angle: float) -> BoolArray:
    distance = np.linalg.norm(to_body, axis=-1)
    cosine = np.sum(boresight * to_body, axis=-1) / distance
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    return np.asarray(angle < np.arcsin(np.minimum(1.0, radius / distance)) + half_angle)


DEVICE = "resident space object"
TRACK_ERROR = 1e-7
"""rad, of a track between its samples: 3e-4 px of the standard camera."""
NEAREST = 1.0
"""m; nearer, an object would not be a point."""


class Trajectory(Protocol):
    """Where a body is: an `Orbit`, or a stretch of it."""

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
    camera: Trajectory,
    objects: Sequence[ResidentSpaceObject],
    epoch: float,
    start: float,
    end: float,
    *,
    zero: float = 0.0,
    shadow: Shadow = "conical",
) -> list[SourceTrack]:
    """Return the tracks from `start` to `end` s of those objects that light reaches the camera from.

    `epoch` is the Julian date TT of the orbits' time 0. The tracks' own times count from `zero` s, on the
    clock of the attitude history they go with. An object in the umbra or behind the Earth throughout is left
    out; an object partly lit, or lit for part of the time, is fainter by as much, evenly over the track. Give
    a rolling shutter's tracks its last row's end. Raises OutOfRange beyond the orbits' ends, or within 1 m.
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


def _track_times(camera: Trajectory, orbit: Orbit, start: float, end: float) -> FloatArray:
    """Return times close enough that an even motion between them stays within `TRACK_ERROR` of the track.

    The direction of an object that passes at speed v and distance d accelerates by 0.65 (v/d)^2 at most; the
    error of a step h is an eighth of that times h^2.
    """
    times = np.linspace(start, end, 9)
    apart = orbit.states_at(times) - camera.states_at(times)
    distance = float(np.min(np.linalg.norm(apart[:, :3], axis=1)))
    if distance < NEAREST:
        raise OutOfRange(DEVICE, "distance from the camera", distance, NEAREST, math.inf, "m")
    rate = float(np.max(np.linalg.norm(apart[:, 3:], axis=1))) / distance
    steps = max(8, math.ceil((end - start) * rate / math.sqrt(8.0 * TRACK_ERROR)))
    return np.linspace(start, end, steps + 1)
