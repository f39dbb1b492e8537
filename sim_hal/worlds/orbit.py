"""The orbit of the craft and its environment: position, Sun, magnetic field, sunlight and air density.

Orbits start from Keplerian elements and follow the Earth's central gravity and oblateness J2 (Sease, eqs.
2.13 and 2.14), without drag or other bodies. Positions are in m, ICRS. The ICRS pole is used as the Earth's
pole, although the two differ by 0.15 deg in 2026.

The Sun's position follows the low-precision series of the Astronomical Almanac. The flight software uses
ERFA's epv00 instead, so that simulation and flight software do not have the same error. The Almanac's series
takes 1.5 us for a date, and epv00 takes 230 us. The error of the series is up to 42" until 2030, which moves
the entry into the Earth's shadow by 0.2 s.

The environment is evaluated at knots 10 s apart and interpolated by cubic splines. The interpolation errors
of 2 mm and 1e-4 nT are far below the errors of the models. In the penumbra sunlight changes within seconds,
so sunlight has knots every second and is interpolated linearly. All knots within a chunk of 1,000 s are
computed together. Random numbers are drawn in the order of the knots, so that they do not depend on the
requested times.

The air density is an exponential profile (Vallado, Fundamentals of Astrodynamics, 4th ed. 2013, Table 8-4)
with a diurnal bulge. The apex of the diurnal bulge is 30 deg east of the Sun in right ascension, and the
density falls off as cos^4 of half the angle from the apex (Montenbruck & Gill 2000, section 3.5.2,
Harris-Priester). The density at the apex is four times the density on the opposite side, a typical ratio near
500 km altitude at mean solar activity.

The Earth's true magnetic field is the International Geomagnetic Reference Field, 14th generation (IGRF-14).
The field is an expansion in spherical harmonics of degree 13 (Alken et al. 2021, Earth Planets Space 73:49,
eq. 1), whose coefficients (2024, doi 10.5281/zenodo.14012302) are interpolated linearly between epochs. After
the last epoch, 2030, the coefficients are extrapolated with the secular variation and acceleration of the
last epochs. The flight software uses a different model (`knightcube.astro.earth.geomagnetism`), so that the
simulation includes a realistic model error. The function `ring_current` returns the field of the ring
current. Currents in the ionosphere are not modelled.

The table `igrf.npz` contains the coefficients as integers in units of 0.01 nT. `tests/support/build_igrf.py`
makes the table from the file that the package ppigrf ships. The package ppigrf itself is not used, because it
needs pandas and takes 81 ms for one position instead of 3 ms. The fields of ppigrf and of this module agree
within 0.06 nT.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt
from scipy.integrate import OdeSolution, solve_ivp
from scipy.interpolate import CubicSpline

from flight.schema.document import ConfigError
from hal.interfaces.errors import OutOfRange
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.figure import EARTH_RADIUS, GRAVITATIONAL_PARAMETER, J2
from knightcube.astro.earth.orbit_knowledge import TwoLineElements
from knightcube.astro.earth.orientation import (
    ROTATION_RATE,
    celestial_to_terrestrial,
    julian_epoch,
    north_east_down,
)
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT, DAY, J2000, UNIX_EPOCH, sunlit_share
from sim_hal.settings import Disturbances, OrbitSection, utc_seconds
from sim_hal.worlds.world import Floats, OrbitEnvironment

DEVICE = "orbit"
_TOLERANCE = 1e-12
"""Relative tolerance of the orbit integration, which causes errors of centimetres after ten low orbits."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KeplerianElements:
    """Keplerian elements of the osculating orbit, with angles in rad and the semi-major axis in m."""

    semi_major_axis: float
    eccentricity: float = 0.0
    inclination: float = 0.0
    ascending_node: float = 0.0
    argument_of_perigee: float = 0.0
    true_anomaly: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not math.isfinite(value):
                raise OutOfRange(DEVICE, field.name, value, -math.inf, math.inf, "")
        if self.semi_major_axis <= 0.0:
            raise OutOfRange(DEVICE, "semi_major_axis", self.semi_major_axis, 0.0, math.inf, "m")
        if not 0.0 <= self.eccentricity < 1.0:
            raise OutOfRange(DEVICE, "eccentricity", self.eccentricity, 0.0, 1.0, "")

    def state(self) -> tuple[FloatArray, FloatArray]:
        """Return the position (3,), m, and the velocity (3,), m/s, by Algorithm 10 of Vallado."""
        node, inclination = self.ascending_node, self.inclination
        towards_node = np.array([math.cos(node), math.sin(node), 0.0])
        across = np.array(
            [
                -math.cos(inclination) * math.sin(node),
                math.cos(inclination) * math.cos(node),
                math.sin(inclination),
            ]
        )
        argument = self.argument_of_perigee
        perigee = math.cos(argument) * towards_node + math.sin(argument) * across
        ahead = math.cos(argument) * across - math.sin(argument) * towards_node
        parameter = self.semi_major_axis * (1.0 - self.eccentricity**2)
        cosine, sine = math.cos(self.true_anomaly), math.sin(self.true_anomaly)
        radius = parameter / (1.0 + self.eccentricity * cosine)
        speed = math.sqrt(GRAVITATIONAL_PARAMETER / parameter)
        position = radius * (cosine * perigee + sine * ahead)
        velocity = speed * ((self.eccentricity + cosine) * ahead - sine * perigee)
        return position, velocity

    @property
    def period(self) -> float:
        """Orbital period (s) of the two-body orbit, without J2."""
        return 2.0 * math.pi * math.sqrt(self.semi_major_axis**3 / GRAVITATIONAL_PARAMETER)


@dataclass(frozen=True, slots=True, eq=False)
class Orbit:
    """The trajectory of a body from time 0 to `duration` s, integrated once and interpolated."""

    duration: float
    solution: OdeSolution

    def states_at(self, times: FloatArray) -> FloatArray:
        """Return the states (m, 6), position (m) and velocity (m/s), at `times` (m,), s.

        Raises OutOfRange for times before 0 or after `duration`.
        """
        times = np.asarray(times, dtype=float)
        for end in (np.min(times, initial=0.0), np.max(times, initial=0.0)):
            if not 0.0 <= end <= self.duration:
                raise OutOfRange(DEVICE, "time", float(end), 0.0, self.duration, "s")
        return np.asarray(self.solution(times).T) if times.size else np.zeros((0, 6))

    def positions_at(self, times: FloatArray) -> FloatArray:
        """Return the positions (m, 3), m, at `times` (m,), s."""
        return self.states_at(times)[:, :3]


class Start(Protocol):
    """Protocol of an orbit's initial state, such as Keplerian elements or a position and velocity."""

    def state(self) -> tuple[FloatArray, FloatArray]:
        """Return the position (3,), m, and the velocity (3,), m/s, at time zero."""


def propagate(elements: Start, duration: float, j2: float = J2) -> Orbit:
    """Return the orbit over `duration` s that starts with `elements` at time 0 (Sease, eqs. 2.13, 2.14).

    The integrator is the eighth-order method of Dormand and Prince with dense output. With `j2` = 0 the
    result is the two-body orbit. Raises OutOfRange if `duration` is not positive.
    """
    if not 0.0 < duration < math.inf:
        raise OutOfRange(DEVICE, "duration", duration, 0.0, math.inf, "s")
    oblateness = 1.5 * j2 * GRAVITATIONAL_PARAMETER * EARTH_RADIUS**2

    def derivative(_: float, state: FloatArray) -> list[float]:
        # Python floats are used, because numpy takes five times as long for three components.
        x, y, z, vx, vy, vz = state.tolist()
        squared = x * x + y * y + z * z
        cubed = squared * math.sqrt(squared)
        central = -GRAVITATIONAL_PARAMETER / cubed
        flat = oblateness / (cubed * squared)
        tilt = 5.0 * z * z / squared
        equatorial = central - flat * (1.0 - tilt)
        return [vx, vy, vz, equatorial * x, equatorial * y, (central - flat * (3.0 - tilt)) * z]

    position, velocity = elements.state()
    scale = np.repeat([np.linalg.norm(position), np.linalg.norm(velocity)], 3)
    result = solve_ivp(
        derivative,
        (0.0, duration),
        np.concatenate([position, velocity]),
        method="DOP853",
        rtol=_TOLERANCE,
        atol=_TOLERANCE * scale,
        dense_output=True,
    )
    return Orbit(float(duration), result.sol)


_PRECESSION = 1.3972 / 36_525.0
"""Drift of the equinox along the ecliptic (deg per day)."""


def sun_position(julian_date: npt.ArrayLike) -> FloatArray:
    """Return the Sun's apparent geocentric position (..., 3), m, ICRS, at Julian dates (...) TT.

    The position follows the "Low-precision formulas for the Sun" of the Astronomical Almanac, accurate to
    0.01 deg from 1950 to 2050. The series gives the longitude relative to the equinox of date; the drift of
    the equinox since J2000 is subtracted from this longitude. The obliquity of the ecliptic is that of J2000.
    Passing UTC instead of TT changes the Sun's direction by 3".
    """
    days = np.asarray(julian_date, dtype=float) - J2000
    anomaly = np.radians(357.528 + 0.9856003 * days)
    mean_longitude = 280.460 + (0.9856474 - _PRECESSION) * days
    longitude = np.radians(mean_longitude + 1.915 * np.sin(anomaly) + 0.020 * np.sin(2.0 * anomaly))
    distance = 1.00014 - 0.01671 * np.cos(anomaly) - 0.00014 * np.cos(2.0 * anomaly)
    obliquity = np.radians(23.439)
    across = np.sin(longitude)
    unit = np.stack([np.cos(longitude), np.cos(obliquity) * across, np.sin(obliquity) * across], axis=-1)
    return np.asarray(ASTRONOMICAL_UNIT * distance[..., None] * unit)


def julian_date(utc: str) -> float:
    """Return the Julian date (UTC) of an ISO 8601 time. Raises ConfigError as `utc_seconds` does."""
    return UNIX_EPOCH + utc_seconds(utc) / DAY


def elements(orbit: OrbitSection, date: float, key: str = "simulation.free_body.orbit") -> KeplerianElements:
    """Return the Keplerian elements of the orbit that the section `key` describes, at a Julian date.

    Raises ConfigError for a perigee that is too low.
    """
    perigee = (EARTH_RADIUS + orbit.altitude) * (1.0 - orbit.eccentricity) - EARTH_RADIUS
    if perigee < _LOWEST_PERIGEE:
        problem = f"is {orbit.eccentricity:g}: the perigee is at {1e-3 * perigee:.0f} km and must be above"
        raise ConfigError(f"{key}.eccentricity", f"{problem} {1e-3 * _LOWEST_PERIGEE:.0f} km")
    node = math.radians(orbit.ascending_node_deg)
    if orbit.local_time is not None:
        x, y, _ = sun_position(date).tolist()
        node = math.atan2(y, x) + math.radians(15.0 * (orbit.local_time - 12.0))
    return KeplerianElements(
        semi_major_axis=EARTH_RADIUS + orbit.altitude,
        eccentricity=orbit.eccentricity,
        inclination=math.radians(orbit.inclination_deg),
        ascending_node=node,
        argument_of_perigee=math.radians(orbit.argument_of_perigee_deg),
        true_anomaly=math.radians(orbit.true_anomaly_deg),
    )


_FARTHEST_ELEMENTS, _TILT = 100e3, 0.25
"""Tolerances between two-line elements and an orbit: distance (m) in a revolution, inclination (deg).

The inclination of two-line elements refers to the equator of date, whose pole is 0.15 deg from the ICRS pole
in 2026. J2 varies the inclination by 0.03 deg in a revolution.
"""


def misfit(
    lines: tuple[str, str], orbit: OrbitSection, utc: str, key: str = "simulation.free_body.orbit"
) -> str:
    """Return how two-line elements differ from the orbit in the section `key`, or an empty text if they fit.

    The mean elements of both orbits over the first revolution after `utc` are compared, and the largest
    distance between the orbits in this revolution is limited. The tolerances also hold for an orbit that is
    described by mean elements instead of osculating ones: J2 varies the semi-major axis by the fraction k =
    3/2 J2 (R/p)^2 and the eccentricity by at most 2 k in a revolution. Raises UsageError for invalid
    elements, and OrbitError if SGP4 cannot propagate them over the first revolution.
    """
    date = julian_date(utc)
    start, known = elements(orbit, date, key), TwoLineElements(*lines)
    times = np.linspace(0.0, start.period, 25)
    states = [known.at(date + time / DAY) for time in times.tolist()]
    found = np.array([[*state.position, *state.velocity] for state in states])
    true = propagate(start, start.period).states_at(times)
    axis, eccentricity, inclination = _mean_shape(true)
    other_axis, other_eccentricity, other_inclination = _mean_shape(found)
    share = 1.5 * J2 * (EARTH_RADIUS / (axis * (1.0 - eccentricity**2))) ** 2
    distance = float(np.linalg.norm((found - true)[:, :3], axis=1).max())
    compared = (
        ("mean inclination", other_inclination, inclination, _TILT, ".2f", " deg"),
        ("mean eccentricity", other_eccentricity, eccentricity, 2.0 * share, ".4f", ""),
        ("mean semi-major axis", 1e-3 * other_axis, 1e-3 * axis, 1e-3 * share * axis, ".1f", " km"),
        ("largest distance", 1e-3 * distance, 0.0, 1e-3 * _FARTHEST_ELEMENTS, ",.0f", " km"),
    )
    return ", ".join(
        f"{name} {one:{form}}{unit} instead of {two:{form}}{unit} (tolerance {tolerance:{form}}{unit})"
        for name, one, two, tolerance, form, unit in compared
        if not abs(one - two) <= tolerance
    )


def _mean_shape(states: FloatArray) -> tuple[float, float, float]:
    """Return the mean semi-major axis (m), eccentricity and inclination (deg) of osculating orbits (n, 6)."""
    position, velocity = states[:, :3], states[:, 3:]
    radius, momentum = np.linalg.norm(position, axis=1), np.cross(position, velocity)
    axes = 1.0 / (2.0 / radius - np.sum(velocity**2, axis=1) / GRAVITATIONAL_PARAMETER)
    perigees = np.cross(velocity, momentum) / GRAVITATIONAL_PARAMETER - position / radius[:, None]
    tilts = np.degrees(np.arccos(momentum[:, 2] / np.linalg.norm(momentum, axis=1)))
    return float(axes.mean()), float(np.linalg.norm(perigees.mean(axis=0))), float(tilts.mean())


_PROFILE = np.array([
    [150e3, 2.070e-9], [200e3, 2.789e-10], [250e3, 7.248e-11], [300e3, 2.418e-11],
    [350e3, 9.518e-12], [400e3, 3.725e-12], [450e3, 1.585e-12], [500e3, 6.967e-13],
    [600e3, 1.454e-13], [700e3, 3.614e-14], [800e3, 1.170e-14], [900e3, 5.245e-15],
    [1000e3, 3.019e-15], [1500e3, 4.67e-16], [2000e3, 7.23e-17], [3000e3, 1.73e-18],
])  # fmt: skip
"""Heights (m) and air densities (kg/m^3) of the exponential profile [Vallado, table 8-4].

Above 1,000 km, the values are extrapolated with the scale height at 1,000 km, 268 km.
"""
_LOWEST_PERIGEE = 150e3
"""Lowest permitted perigee height (m) of a configured orbit.

An orbit with a lower perigee decays within a revolution.
"""
_NIGHT, _DAY = 0.4, 1.6
"""Factors of the air density opposite to the apex of the diurnal bulge, and at the apex."""
_MEAN = _NIGHT + (_DAY - _NIGHT) / 3.0
"""Mean density factor of the diurnal bulge over all directions."""
_LAG = math.radians(30.0)


def log_density(position: FloatArray, sun: FloatArray, day_bulge: float = 1.0) -> FloatArray:
    """Return the logarithm (n,) of the air density in kg/m^3.

    `position` (n, 3) and the Sun's position `sun` (n, 3) are geocentric, m, ICRS.

    `day_bulge` scales the diurnal bulge; at zero the density depends only on the altitude.
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
"""Time (s) between the knots of the environment's interpolation."""
_CHUNK, _LIGHT_KNOTS = 100, 1_000
"""Numbers of environment knots and of sunlight knots in a chunk of 1,000 s."""
_SPAN = KNOT * _CHUNK
_FIRST_ORBIT = 12_000.0
"""Duration (s) of the first integration of the orbit, which is doubled when needed."""
RING_CURRENT = 20e-9
"""Mean field (T) of the ring current on a quiet day."""
_TURBULENCE, _TURBULENCE_TIME = 0.1, 600.0
"""Standard deviation and correlation time (s) of the random walk of the logarithmic air density."""
_WALK_TIME = 3_000.0
"""Correlation time (s) of the residual dipole's random walk."""
_STORM_TIMES = np.array([3.0, 7.0, 17.0]) * 3600.0
"""Periods (s) of the variations of the ring current."""


@dataclass(frozen=True, slots=True, eq=False)
class Chunk:
    """Interpolation of the environment over 1,000 s.

    `cubics` (knots, 4, columns) contains cubic polynomial coefficients, highest power first. `sunlit`
    (seconds,) contains the visible fraction of the Sun's disc in each second.
    """

    start: float
    cubics: list[list[list[float]]]
    sunlit: list[float]


class Environment:
    """Environment of the craft in orbit from time 0 s on.

    Times within a chunk of 1,000 s may be requested in any order, but no times before the present chunk.
    """

    def __init__(
        self,
        elements: KeplerianElements,
        julian_date: float,
        generator: np.random.Generator,
        multiples: Disturbances | None = None,
    ) -> None:
        """Begin at a Julian date UTC; `multiples` scales ring current, diurnal bulge and random walks."""
        self._multiples = multiples = multiples or Disturbances()
        self._elements, self._julian_date, self._generator = elements, julian_date, generator
        self._storm = multiples.ring_current * RING_CURRENT
        self._phases = generator.uniform(0.0, 2.0 * math.pi, 3)
        self._noise: FloatArray = generator.standard_normal(4)
        self._orbit: Orbit = propagate(elements, _FIRST_ORBIT)
        self._chunk = self._make(0)
        self._next = 1

    def position_and_field(self, time: float) -> tuple[Floats, Floats]:
        """Return the position (3,), m, and the magnetic field (3,), T, in ICRS axes at `time` s."""
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
        """Return the environment of the craft at `time` s."""
        part, (a, b, c, d) = self._cubic(time)
        values = [((i * part + j) * part + k) * part + m for i, j, k, m in zip(a, b, c, d, strict=True)]
        slope = [(3.0 * i * part + 2.0 * j) * part + k for i, j, k in zip(a[:3], b[:3], c[:3], strict=True)]
        px, py, pz, bx, by, bz, sx, sy, sz, density, wx, wy, wz = values
        sx, sy, sz = sx - px, sy - py, sz - pz
        distance = math.sqrt(sx * sx + sy * sy + sz * sz)
        light_knot = (time - self._chunk.start) * (_LIGHT_KNOTS / _SPAN)
        index = min(max(int(light_knot), 0), _LIGHT_KNOTS - 1)
        before, after = self._chunk.sunlit[index], self._chunk.sunlit[index + 1]
        seen = before + (light_knot - index) * (after - before)
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

    def _cubic(self, time: float) -> tuple[float, list[list[float]]]:
        """Return the time (s) since the knot before `time`, and the cubic polynomials from this knot on."""
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
        sun_there = sun_position(date)
        # Four Gauss-Markov processes of unit variance: air density, and three axes of the residual dipole.
        keep = np.exp(-KNOT / np.array([_TURBULENCE_TIME, _WALK_TIME, _WALK_TIME, _WALK_TIME]))
        walks = [self._noise]
        for kick in np.sqrt(1.0 - keep**2) * self._generator.standard_normal((_CHUNK, 4)):
            walks.append(keep * walks[-1] + kick)
        self._noise = walks[-1]
        noise = self._multiples.walks * np.array(walks)
        density = log_density(position, sun_there, self._multiples.day_bulge) + _TURBULENCE * noise[:, 0]
        # The ring current varies over hours and does not change its direction.
        waves = np.sin(times[:, None] * (2.0 * math.pi / _STORM_TIMES) + self._phases)
        ring = ring_current(date, self._storm) * (1.0 + np.mean(waves, axis=1))[:, None]
        field = magnetic_field(date, position) + ring
        knots = np.column_stack([position, field, sun_there, density, noise[:, 1:]])
        spline = CubicSpline(times, knots)
        seconds = np.linspace(start, times[-1], _LIGHT_KNOTS + 1)
        values = spline(seconds)
        sunlit = sunlit_share(values[:, :3], values[:, 6:9])
        return Chunk(start, np.moveaxis(spline.c, 1, 0).tolist(), sunlit.tolist())


def air_flow(environment: OrbitEnvironment) -> Floats:
    """Return the craft's velocity (3,), m/s, ICRS, relative to the air, which rotates with the Earth."""
    (x, y, _), (vx, vy, vz) = environment.position, environment.velocity
    return vx + ROTATION_RATE * y, vy - ROTATION_RATE * x, vz


TABLE = Path(__file__).with_name("igrf.npz")
DEGREE = 13
REFERENCE_RADIUS = 6_371_200.0
"""Reference radius (m) of the spherical-harmonic expansion."""
UNIT = 1e-11
"""Unit (T) of the integer coefficients in the table `igrf.npz`."""
EXTRAPOLATION = 15.0
"""Time (years) after the last epoch for which the field is extrapolated."""
_FIELD_DEVICE = "geomagnetic field"
_NEAR_POLE = 0.5 * np.pi - 1e-8
"""Latitude (rad) to which larger latitudes are limited, 7 cm from the pole, where east is undefined."""


def magnetic_field(julian_date: npt.ArrayLike, position: FloatArray) -> FloatArray:
    """Return the magnetic field (..., 3), T, ICRS axes.

    The field is evaluated at Julian dates UTC (...) and positions (..., 3), m, ICRS.

    Raises OutOfRange for a date before the first or more than `EXTRAPOLATION` years after the last epoch.
    """
    to_ground = celestial_to_terrestrial(julian_date)
    there = np.einsum("...ij,...j->...i", to_ground, position)
    return np.asarray(np.einsum("...ji,...j->...i", to_ground, magnetic_field_on_ground(julian_date, there)))


def magnetic_field_on_ground(julian_date: npt.ArrayLike, position: FloatArray) -> FloatArray:
    """Return the field (..., 3), T, at Julian dates (...) UTC and positions (..., 3), m, all in ITRS axes."""
    position = np.asarray(position, dtype=float)
    shape = np.broadcast_shapes(np.shape(julian_date), position.shape[:-1])
    place = np.broadcast_to(position, (*shape, 3)).reshape(-1, 3)
    year = np.broadcast_to(julian_epoch(julian_date), shape).reshape(-1)
    radius = np.linalg.norm(place, axis=-1)
    longitude = np.arctan2(place[:, 1], place[:, 0])
    latitude = np.arctan2(place[:, 2], np.hypot(place[:, 0], place[:, 1]))
    latitude = np.clip(latitude, -_NEAR_POLE, _NEAR_POLE)
    local = _expansion(_coefficients(year), radius, 0.5 * np.pi - latitude, longitude)
    axes = north_east_down(longitude, latitude)
    return np.asarray(np.einsum("nji,nj->ni", axes, local).reshape(*shape, 3))


def ring_current(julian_date: npt.ArrayLike, disturbance: float) -> FloatArray:
    """Return the uniform magnetic field (..., 3), T, ICRS axes, of a ring current.

    `disturbance` (T) is the negative Dst index, about 20 nT on a quiet day and 100 nT in a storm.
    """
    dipole = _coefficients(np.atleast_1d(julian_epoch(julian_date)).reshape(-1))[0, :3]
    # The dipole (g10, g11, h11) and the field inside the ring current both point south.
    axis = np.array([dipole[1], dipole[2], dipole[0]]) / np.linalg.norm(dipole)
    to_ground = celestial_to_terrestrial(julian_date)
    return np.asarray(np.einsum("...ji,j->...i", to_ground, disturbance * axis))


@cache
def _table() -> tuple[FloatArray, FloatArray]:
    """Return the epochs (e,), years, and the coefficients (e, 195), T, ordered g10, g11, h11, g20, ..."""
    with np.load(TABLE, allow_pickle=False) as stored:
        return stored["epoch"].astype(float), UNIT * stored["coefficient"].astype(float)


def _coefficients(year: FloatArray) -> FloatArray:
    """Return the coefficients (n, 195), T, interpolated or extrapolated to years (n,)."""
    epochs, values = _table()
    last = float(epochs[-1]) + EXTRAPOLATION
    if year.size and not (epochs[0] <= np.min(year) and np.max(year) <= last):
        worst = float(np.min(year) if np.min(year) < epochs[0] else np.max(year))
        raise OutOfRange(_FIELD_DEVICE, "year", worst, float(epochs[0]), last, "")
    after = np.clip(np.searchsorted(epochs, year, side="right"), 1, len(epochs) - 1)
    share = (year - epochs[after - 1]) / (epochs[after] - epochs[after - 1])
    found = np.asarray(values[after - 1] + share[:, None] * (values[after] - values[after - 1]))
    late = np.maximum(year - epochs[-1], 0.0)
    if np.any(late > 0.0):
        steps = np.diff(epochs[-3:])
        variation = np.diff(values[-3:], axis=0) / steps[:, None]
        found += 0.5 * (late**2)[:, None] * (variation[1] - variation[0]) / float(np.mean(steps))
    return found


def _expansion(
    coefficients: FloatArray, radius: FloatArray, colatitude: FloatArray, longitude: FloatArray
) -> FloatArray:
    """Return the field (n, 3), T, along geocentric north, east and down.

    The field is the negative gradient of the potential.
    """
    legendre, slope = _legendre(np.cos(colatitude), np.sin(colatitude))
    sine = np.sin(colatitude)
    ratio = REFERENCE_RADIUS / radius
    power = ratio**2
    north, east, down = np.zeros_like(radius), np.zeros_like(radius), np.zeros_like(radius)
    column = 0
    for n in range(1, DEGREE + 1):
        power = power * ratio
        for m in range(n + 1):
            g = coefficients[:, column]
            h = coefficients[:, column + 1] if m else np.zeros_like(g)
            column += 2 if m else 1
            cosine, sine_m = np.cos(m * longitude), np.sin(m * longitude)
            wave = g * cosine + h * sine_m
            north += power * wave * slope[n][m]
            east += power * m * (g * sine_m - h * cosine) * legendre[n][m] / sine
            down -= (n + 1) * power * wave * legendre[n][m]
    return np.stack([north, east, down], axis=-1)


def _legendre(cosine: FloatArray, sine: FloatArray) -> tuple[list[list[FloatArray]], list[list[FloatArray]]]:
    """Return associated Legendre functions P[n][m] and their derivatives with respect to colatitude.

    The functions are Schmidt quasi-normalised, and each element is an array (points,).
    The recursions are from Langel, "The main field", in Geomagnetism (Jacobs, 1987), eq. 27 and table 2.
    """
    p = [[np.ones_like(cosine)]]
    d = [[np.zeros_like(cosine)]]
    for n in range(1, DEGREE + 1):
        p_row, d_row = [], []
        for m in range(n):
            before = np.sqrt(n * n - m * m)
            lower = np.sqrt((n - 1) ** 2 - m * m)
            older_p = lower * p[n - 2][m] if m < n - 1 else 0.0
            older_d = lower * d[n - 2][m] if m < n - 1 else 0.0
            p_row.append(((2 * n - 1) * cosine * p[n - 1][m] - older_p) / before)
            d_row.append(((2 * n - 1) * (cosine * d[n - 1][m] - sine * p[n - 1][m]) - older_d) / before)
        factor = np.sqrt(1.0 - 0.5 / n) if n > 1 else 1.0
        p_row.append(factor * sine * p[n - 1][n - 1])
        d_row.append(factor * (cosine * p[n - 1][n - 1] + sine * d[n - 1][n - 1]))
        p.append(p_row)
        d.append(d_row)
    return p, d
