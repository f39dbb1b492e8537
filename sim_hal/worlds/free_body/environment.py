"""The environment along an orbit: evaluated at knots, interpolated by cubic splines.

Knots are 10 s apart, in which position and field change by a thousandth of a revolution; interpolation is
then accurate to 2 mm and 1e-4 nT, far below the models' own errors. Sunlight changes within seconds in the
penumbra, so it has knots each second, joined by straight lines. Knots are made 1,000 s at a time, and random
draws follow the order of the knots, never the order of the times that are requested.

The air density is an exponential profile (Vallado, Fundamentals of Astrodynamics, 4th ed. 2013, Table 8-4)
with a day bulge. The bulge has its apex 30 deg behind the Sun in right ascension and falls off as cos^4 of
half the angle from it (Montenbruck & Gill 2000, 3.5.2, Harris-Priester). By day the air is four times as
dense as by night, as near 500 km at a mean solar activity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.figure import EARTH_RADIUS
from knightcube.astro.earth.orientation import ROTATION_RATE
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT, DAY, sunlit_share
from sim_hal.settings import Disturbances
from sim_hal.worlds import geomagnetism, sun
from sim_hal.worlds.orbit import KeplerianElements, Orbit, propagate
from sim_hal.worlds.world import Floats, OrbitEnvironment

_PROFILE = np.array(
    [
        [150e3, 2.070e-9],
        [200e3, 2.789e-10],
        [250e3, 7.248e-11],
        [300e3, 2.418e-11],
        [350e3, 9.518e-12],
        [400e3, 3.725e-12],
        [450e3, 1.585e-12],
        [500e3, 6.967e-13],
        [600e3, 1.454e-13],
        [700e3, 3.614e-14],
        [800e3, 1.170e-14],
        [900e3, 5.245e-15],
        [1000e3, 3.019e-15],
    ]
)
"""Height in m, density in kg/m^3."""
_NIGHT, _DAY = 0.4, 1.6
_MEAN = _NIGHT + (_DAY - _NIGHT) / 3.0
"""Over all sides."""
_LAG = math.radians(30.0)


def log_density(position: FloatArray, sun: FloatArray, day_bulge: float = 1.0) -> FloatArray:
    """Return the logarithm (n,) of the density in kg/m^3 at positions (n, 3) m, the Sun at (n, 3) m, ICRS.

    `day_bulge` is a share of the bulge: zero is its mean on all sides.
    """
    distance = np.linalg.norm(position, axis=-1)
    profile = np.interp(distance - EARTH_RADIUS, _PROFILE[:, 0], np.log(_PROFILE[:, 1]))
    cosine, sine = math.cos(_LAG), math.sin(_LAG)
    x, y = sun[..., 0], sun[..., 1]
    apex = np.stack([cosine * x - sine * y, sine * x + cosine * y, sun[..., 2]], axis=-1)
    facing = np.sum(position * apex, axis=-1) / (distance * np.linalg.norm(apex, axis=-1))
    bulge = _NIGHT + (_DAY - _NIGHT) * (0.5 + 0.5 * facing) ** 2
    return np.asarray(profile + np.log(_MEAN + day_bulge * (bulge - _MEAN)))


KNOT = 10.0
_CHUNK = 100
_LIGHT_KNOTS = 1_000
_SPAN = KNOT * _CHUNK
_FIRST_ORBIT = 12_000.0
RING_CURRENT = 20e-9
_TURBULENCE, _TURBULENCE_TIME = 0.1, 600.0
_WALK_TIME = 3_000.0
_STORM_TIMES = np.array([3.0, 7.0, 17.0]) * 3600.0

Row = list[float]


@dataclass(frozen=True, slots=True, eq=False)
class Chunk:
    """The knots of one stretch: cubics (knots, 4, columns), highest power first, and light (seconds,)."""

    start: float
    cubics: list[list[Row]]
    sunlit: Row


class Environment:
    """The surroundings from time 0, s, on; times are read in any order within a chunk, else forwards."""

    def __init__(
        self,
        elements: KeplerianElements,
        julian_date: float,
        generator: np.random.Generator,
        multiples: Disturbances | None = None,
    ) -> None:
        """Start at a Julian date UTC; `multiples` of ring current, bulge and walks, by default the whole."""
        self._multiples = multiples = multiples or Disturbances()
        self._elements = elements
        self._julian_date = julian_date
        self._generator = generator
        self._storm = multiples.ring_current * RING_CURRENT
        self._phases = generator.uniform(0.0, 2.0 * math.pi, 3)
        self._noise: FloatArray = generator.standard_normal(4)
        self._orbit: Orbit = propagate(elements, _FIRST_ORBIT)
        self._chunk = self._make(0)
        self._next = 1

    def position_and_field(self, time: float) -> tuple[Floats, Floats]:
        """Return position (3,) m and field (3,) T, ICRS: what every step of the motion needs."""
        part, (a, b, c, d) = self._cubic(time)
        return (
            (
                ((a[0] * part + b[0]) * part + c[0]) * part + d[0],
                ((a[1] * part + b[1]) * part + c[1]) * part + d[1],
                ((a[2] * part + b[2]) * part + c[2]) * part + d[2],
            ),
            (
                ((a[3] * part + b[3]) * part + c[3]) * part + d[3],
                ((a[4] * part + b[4]) * part + c[4]) * part + d[4],
                ((a[5] * part + b[5]) * part + c[5]) * part + d[5],
            ),
        )

    def at(self, time: float) -> OrbitEnvironment:
        """Return everything at `time` s."""
        part, (a, b, c, d) = self._cubic(time)
        values = [((i * part + j) * part + k) * part + m for i, j, k, m in zip(a, b, c, d, strict=True)]
        slope = [(3.0 * i * part + 2.0 * j) * part + k for i, j, k in zip(a[:3], b[:3], c[:3], strict=True)]
        px, py, pz, bx, by, bz, sx, sy, sz, density, wx, wy, wz = values
        sx, sy, sz = sx - px, sy - py, sz - pz
        distance = math.sqrt(sx * sx + sy * sy + sz * sz)
        seen = self._sunlit(time)
        vx, vy, vz = slope
        return OrbitEnvironment(
            (px, py, pz),
            (vx, vy, vz),
            (bx, by, bz),
            (sx / distance, sy / distance, sz / distance),
            seen * (ASTRONOMICAL_UNIT / distance) ** 2,
            seen,
            math.exp(density),
            (wx, wy, wz),
        )

    def _sunlit(self, time: float) -> float:
        place = (time - self._chunk.start) * (_LIGHT_KNOTS / _SPAN)
        index = min(max(int(place), 0), _LIGHT_KNOTS - 1)
        before, after = self._chunk.sunlit[index], self._chunk.sunlit[index + 1]
        return before + (place - index) * (after - before)

    def _cubic(self, time: float) -> tuple[float, list[Row]]:
        """Return the time since the knot before `time`, and its cubic."""
        since = time - self._chunk.start
        while since > _SPAN:
            self._chunk = self._make(self._next)
            self._next += 1
            since = time - self._chunk.start
        index = min(max(int(since / KNOT), 0), _CHUNK - 1)
        return since - index * KNOT, self._chunk.cubics[index]

    def _make(self, number: int) -> Chunk:
        start = number * _SPAN
        times: FloatArray = start + KNOT * np.arange(_CHUNK + 1.0)
        if times[-1] > self._orbit.duration:
            self._orbit = propagate(self._elements, 2.0 * self._orbit.duration)
        date = self._julian_date + times / DAY
        position = self._orbit.positions_at(times)
        sun_there = sun.position(date)
        noise = self._multiples.walks * self._walks()
        density = log_density(position, sun_there, self._multiples.day_bulge) + _TURBULENCE * noise[:, 0]
        field = geomagnetism.field(date, position) + self._ring_current(times, date)
        knots = np.column_stack([position, field, sun_there, density, noise[:, 1:]])
        spline = CubicSpline(times, knots)
        seconds = np.linspace(start, times[-1], _LIGHT_KNOTS + 1)
        values = spline(seconds)
        sunlit = sunlit_share(values[:, :3], values[:, 6:9])
        return Chunk(start, np.moveaxis(spline.c, 1, 0).tolist(), sunlit.tolist())

    def _ring_current(self, times: FloatArray, date: FloatArray) -> FloatArray:
        """Return the ring current's field (n, 3) T: never below nothing, changing by hours."""
        waves = np.sin(times[:, None] * (2.0 * math.pi / _STORM_TIMES) + self._phases)
        return np.asarray(
            geomagnetism.ring_current(date, self._storm) * (1.0 + np.mean(waves, axis=1))[:, None]
        )

    def _walks(self) -> FloatArray:
        """Return four Gauss-Markov walks of unit deviation at the knots (101, 4), the air's first."""
        keep = np.exp(-KNOT / np.array([_TURBULENCE_TIME, _WALK_TIME, _WALK_TIME, _WALK_TIME]))
        kicks = np.sqrt(1.0 - keep**2) * self._generator.standard_normal((_CHUNK, 4))
        rows = [self._noise]
        for kick in kicks:
            rows.append(keep * rows[-1] + kick)
        self._noise = rows[-1]
        return np.array(rows)


def air_flow(surroundings: OrbitEnvironment) -> Floats:
    """Return the craft's velocity (3,) m/s through air that turns with the Earth, ICRS."""
    (x, y, _), (vx, vy, vz) = surroundings.position, surroundings.velocity
    return vx + ROTATION_RATE * y, vy - ROTATION_RATE * x, vz
