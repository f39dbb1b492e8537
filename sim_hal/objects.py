"""Objects in the sky of the simulated star camera: `simulation.objects`, as tracks over an exposure.

An object on a line of sight moves on a great circle among the stars. One in orbit is seen from the craft,
lit by the Sun and hidden by the Earth (`star_camera.rso`). The camera's aberration shifts the whole frame;
a body that goes with the Earth does not share the Earth's part, and its light is the time of its way old:
its track is shifted back by that.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING

import numpy as np

from flight.schema.document import ConfigError
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.figure import GRAVITATIONAL_PARAMETER
from knightcube.astro.earth.sun import DAY, SPEED_OF_LIGHT, earth_velocity
from sim_hal.settings import LineOfSight, ObjectState, SkyObject, Tumble
from sim_hal.worlds.world import OrbitingWorld, World, orbiting

if TYPE_CHECKING:
    from sim_hal.star_camera import SourceTrack
    from sim_hal.worlds.orbit import Orbit

_UNIX_EPOCH = 2_440_587.5
_FIRST_REACH = 1000.0
"""s that an orbit is integrated at first; doubled whenever that is over."""
_SAMPLES = 17
"""Instants of a track on a great circle: at 20 deg/s and 1 s the chords miss it by 6e-5 rad at most."""


class Objects:
    """The objects of a simulated sky; mission time is counted from `start_ns` until `begin`."""

    def __init__(self, entries: Sequence[SkyObject], utc: str, start_ns: int, world: World) -> None:
        """Take the section's objects; `utc` labels `start_ns`. Raises ConfigError for what cannot be."""
        for number, entry in enumerate(entries):
            name = f"simulation.objects[{number}]"
            if (entry.line_of_sight is None) == (entry.state is None):
                raise ConfigError(name, "give either a line_of_sight or a state")
            if entry.state is not None:
                orbiting(world, name)
        self._world = world
        self._start_ns = self._epoch_ns = start_ns
        self._utc = datetime.fromisoformat(utc).timestamp()
        self._date = _UNIX_EPOCH + self._utc / DAY
        self._entries = tuple(entries)
        self._ways = [None if entry.state is None else _Way(entry.state) for entry in entries]

    def begin(self, epoch_ns: int) -> None:
        """Let mission time begin."""
        self._epoch_ns = epoch_ns

    def tracks(self, start_ns: int, times: FloatArray) -> list[SourceTrack]:
        """Return the tracks over an exposure from `start_ns`; `times` (k,) s after it, the last one now."""
        found: list[SourceTrack] = []
        for entry, way in zip(self._entries, self._ways, strict=True):
            mission = (start_ns - self._epoch_ns) * 1e-9 + times[[0, -1]]
            fainter = 0.0 if entry.tumble is None else _fainter(entry.tumble, *mission)
            if way is not None:
                found += self._of_orbit(way, entry.magnitude + fainter, start_ns, times)
            elif entry.line_of_sight is not None:
                found.append(_on_circle(entry.line_of_sight, entry.magnitude + fainter, mission[0], times))
        return found

    def _of_orbit(self, way: _Way, magnitude: float, start_ns: int, times: FloatArray) -> list[SourceTrack]:
        from sim_hal.star_camera import SourceTrack  # noqa: PLC0415
        from sim_hal.star_camera.rso import ResidentSpaceObject, source_tracks  # noqa: PLC0415 - heavy

        assert isinstance(self._world, OrbitingWorld)  # `__init__` has seen to it
        zero = (start_ns - self._start_ns) * 1e-9
        start, end = zero + float(times[0]), zero + float(times[-1])
        around = self._world.surroundings()
        now = self._world.utc_ns() * 1e-9 - self._utc
        camera = _Stretch(now, np.array(around.position), np.array(around.velocity))
        target = ResidentSpaceObject(way.until(end), magnitude)
        seen = source_tracks(camera, [target], self._date, start, end, zero=zero)
        shifted = []
        for track in seen:
            velocity = target.orbit.states_at(np.clip(zero + track.times, 0.0, None))[:, 3:]
            own = (velocity + earth_velocity(self._date + end / DAY)) / SPEED_OF_LIGHT
            directions = track.directions - own
            directions /= np.linalg.norm(directions, axis=1, keepdims=True)
            at = track.times.copy()
            # The rounding of sums must not leave the exposure uncovered.
            at[0], at[-1] = times[0], times[-1]
            shifted.append(SourceTrack(at, directions, track.magnitude))
        return shifted


@dataclass(frozen=True, slots=True, eq=False)
class _Stretch:
    """A fall of a second or so about the Earth, from position (3,) m and velocity (3,) m/s at time `at`."""

    at: float
    position: FloatArray
    velocity: FloatArray

    def states_at(self, times: FloatArray) -> FloatArray:
        """Return positions and velocities (m, 6); 0.03 mm off after a second."""
        since = (np.asarray(times) - self.at)[:, None]
        pull = -GRAVITATIONAL_PARAMETER * self.position / np.linalg.norm(self.position) ** 3
        places = self.position + since * self.velocity + 0.5 * since**2 * pull
        return np.hstack([places, self.velocity + since * pull])

    def positions_at(self, times: FloatArray) -> FloatArray:
        """Return positions (m, 3)."""
        return self.states_at(times)[:, :3]


class _Way:
    """The orbit of an object, integrated as far as it is asked for."""

    def __init__(self, start: ObjectState) -> None:
        self._start = start
        self._orbit: Orbit | None = None

    def state(self) -> tuple[FloatArray, FloatArray]:
        """Return position (3,) m and velocity (3,) m/s at the start."""
        return np.array(self._start.position), np.array(self._start.velocity)

    def until(self, end: float) -> Orbit:
        """Return the orbit from 0 to `end` s at least."""
        from sim_hal.worlds.orbit import propagate  # noqa: PLC0415 - scipy's integrators are slow to import

        if self._orbit is None or self._orbit.duration < end:
            self._orbit = propagate(self, max(2.0 * end, _FIRST_REACH))
        return self._orbit


def _on_circle(line: LineOfSight, magnitude: float, mission: float, times: FloatArray) -> SourceTrack:
    """Return the track of an object on a great circle; the exposure starts at `mission` s."""
    from sim_hal.star_camera import SourceTrack  # noqa: PLC0415 - heavy

    right, up = math.radians(line.right_ascension_deg), math.radians(line.declination_deg)
    towards = math.radians(line.towards_deg)
    place = np.array([math.cos(up) * math.cos(right), math.cos(up) * math.sin(right), math.sin(up)])
    east = np.array([-math.sin(right), math.cos(right), 0.0])
    ahead = math.cos(towards) * np.cross(place, east) + math.sin(towards) * east
    at = np.linspace(times[0], times[-1], _SAMPLES)
    since = mission - times[0] + at - line.at
    angle = np.radians(line.rate_deg * since + 0.5 * line.acceleration_deg * since**2)[:, None]
    return SourceTrack(at, np.cos(angle) * place + np.sin(angle) * ahead, magnitude)


def _fainter(tumble: Tumble, start: float, end: float) -> float:
    """Return the magnitude of the mean light between two mission times, less the object's own."""
    middles = start + (end - start) * (np.arange(64) + 0.5) / 64
    phase = 2.0 * np.pi * middles / tumble.period + math.radians(tumble.phase_deg)
    return float(-2.5 * math.log10(np.mean(10.0 ** (-0.4 * tumble.amplitude * np.sin(phase)))))
