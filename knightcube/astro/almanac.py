"""Sun direction, geomagnetic field, eclipse and orbit of a satellite as functions of time and position.

Times are `datetime` objects, in UTC unless they have a time zone. Positions and velocities are geocentric, in
ICRS axes, m and m/s, unless stated otherwise. Invalid times, positions and velocities raise ArgumentError.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import datetime

import numpy as np
from numpy.typing import ArrayLike

from knightcube.astro.arrays import FloatArray, brief, check_numbers, finite_array
from knightcube.astro.earth import geomagnetism
from knightcube.astro.earth.figure import EARTH_RADIUS, GRAVITATIONAL_PARAMETER
from knightcube.astro.earth.orbit_knowledge import (
    FARTHEST,
    FASTEST,
    LONGEST,
    LOWEST_RADIUS,
    elements_of,
    propagated,
)
from knightcube.astro.earth.orientation import julian_epoch, terrestrial_time
from knightcube.astro.earth.sun import (
    SPEED_OF_LIGHT,
    Shadow,
    earth_from_sun,
    ephemeris_date,
    julian_date,
    sunlit_share,
)
from knightcube.errors import ArgumentError, UsageError

_LOWEST_HEIGHT = -12e3
"""Smallest height (m) above the ellipsoid, which is below every point of the Earth's surface."""
_FARTHEST = 10.0 * EARTH_RADIUS
"""Largest distance (m) from the Earth's centre at which the field is that of the Earth's core.

The magnetopause is at about ten Earth radii on the day side.
"""


def _position(position: ArrayLike) -> FloatArray:
    """Return geocentric positions (..., 3), m, as an array of floats.

    Raises ArgumentError for another shape, for positions that are not finite, and for positions deep within
    the Earth, because such positions are usually in km.
    """
    at = finite_array("position", position)
    if at.shape[-1:] != (3,):
        raise ArgumentError("position", f"an array of shape {at.shape}: give three components, m")
    lowest = float(np.linalg.norm(at, axis=-1).min(initial=math.inf))
    if lowest < LOWEST_RADIUS:
        cure = ": give metres, not kilometres" if 1e3 * lowest >= LOWEST_RADIUS else ""
        raise ArgumentError(
            "position",
            f"{lowest:g} m from the Earth's centre, and no satellite is below {LOWEST_RADIUS:.0f} m"
            + (cure or ": give a geocentric position, m"),
        )
    return at


def _single_position(position: ArrayLike) -> FloatArray:
    """Return a geocentric position (3,), m. Raises ArgumentError for another shape or if `_position` does."""
    return _position(finite_array("position", position, (3,)))


def magnetic_field(time: datetime, position: ArrayLike) -> FloatArray:
    """Return the geomagnetic field (3,) in ICRS axes, T, at a position in orbit.

    The model is the World Magnetic Model 2025 (WMM2025) up to degree 12. A call takes 0.2 ms.

    Args:
        time: datetime in UTC or with a time zone, in the years 2025 to 2030.
        position: (3,) geocentric position in ICRS axes, m.

    Raises:
        GeomagneticError: if the time is outside the years of the model, or if the position is farther than
            ten Earth radii from the Earth's centre, where the solar wind determines the field.
        ArgumentError: if the position is not finite, or lies deep within the Earth, as a position in km does.
    """
    at, date = _single_position(position), julian_date(time)
    _check_near_earth(math.hypot(*at.tolist()))
    geomagnetism.check_year(float(julian_epoch(date)))
    return geomagnetism.field(date, at)


def magnetic_field_on_ground(
    time: datetime, *, latitude: float, longitude: float, height: float = 0.0
) -> FloatArray:
    """Return the north, east and down components (3,) of the geomagnetic field, T, at geodetic coordinates.

    Args:
        time: datetime in UTC or with a time zone, in the years 2025 to 2030.
        latitude: geodetic latitude, rad.
        longitude: longitude, positive towards the east, rad.
        height: height above the WGS 84 ellipsoid, m.

    Raises:
        GeomagneticError: for a time outside the years of the model, or a position that is not finite, beyond
            a pole, more than 12 km below the ellipsoid, or farther than ten Earth radii.
        ArgumentError: for a longitude beyond 2 pi rad; such a longitude is usually in degrees.
    """
    check_numbers(latitude=latitude, longitude=longitude, height=height)
    _check_angle("longitude", longitude)
    year = float(julian_epoch(julian_date(time)))
    geomagnetism.check_year(year)
    if height < _LOWEST_HEIGHT:
        raise geomagnetism.GeomagneticError(
            f"height {height:g} m: must be above {_LOWEST_HEIGHT:g} m, which is below every ocean"
        )
    if math.isfinite(height):
        _check_near_earth(EARTH_RADIUS + height)
    return geomagnetism.field_on_ground_axes(year, latitude, longitude, height)


def _check_near_earth(distance: float) -> None:
    """Raise GeomagneticError for a distance from the Earth's centre, m, at which the model is not valid."""
    if distance > _FARTHEST:
        raise geomagnetism.GeomagneticError(
            f"{distance:.4g} m from the Earth's centre: the model is valid up to {_FARTHEST:.4g} m, ten "
            "Earth radii: give metres"
        )


def _check_angle(name: str, angle: float, least: float = -2.0 * math.pi, most: float = 2.0 * math.pi) -> None:
    """Raise ArgumentError for a finite angle (rad) beyond its limits; such an angle is usually in degrees."""
    if math.isfinite(angle) and not least <= angle <= most:
        raise ArgumentError(
            name, f"{angle:g}: give {least:.4g} to {most:.4g} rad; math.radians converts degrees"
        )


def apparent_sun(date: float, position: FloatArray, velocity: FloatArray) -> tuple[FloatArray, float]:
    """Return the apparent direction (3,) of the Sun in ICRS axes, and its distance, m.

    The date is a Julian date UTC, and the geocentric position (3,), m, and velocity (3,), m/s, of the
    observer are in ICRS axes. For an observer in a low orbit, the parallax of the Sun is 9". The Earth's
    orbital motion causes an aberration of 20.5", and the satellite's motion an aberration of 5".
    """
    earth, earth_velocity = earth_from_sun(float(terrestrial_time(date)))
    towards = -earth - position
    distance = float(np.linalg.norm(towards))
    apparent = towards / distance + (earth_velocity + velocity) / SPEED_OF_LIGHT
    return np.asarray(apparent / np.linalg.norm(apparent)), distance


def sun_direction(
    time: datetime, position: ArrayLike = (0.0, 0.0, 0.0), velocity: ArrayLike = (0.0, 0.0, 0.0)
) -> FloatArray:
    """Return the apparent direction (3,) of the Sun as a unit vector in ICRS axes.

    The Sun's position is computed by VSOP2000. Parallax and aberration due to the observer are included.

    Args:
        time: datetime in UTC or with a time zone.
        position: (3,) geocentric position of the observer in ICRS axes, m; by default the Earth's centre.
        velocity: (3,) geocentric velocity of the observer in ICRS axes, m/s.

    Raises:
        ArgumentError: if position or velocity is not finite, if the position lies deep within the Earth but
            not at its centre (as a position in km does), or if the time is not in the years 1900 to 2099.
    """
    observer = finite_array("position", position, (3,))
    if observer.any():
        _position(observer)
    return apparent_sun(ephemeris_date("time", time), observer, finite_array("velocity", velocity, (3,)))[0]


def sunlit_fraction(time: datetime, position: ArrayLike, shadow: Shadow = "conical") -> FloatArray:
    """Return the visible fraction (...) of the Sun's disc, which is 1 in sunlight and 0 in the Earth's umbra.

    The Earth is modelled as a sphere with its equatorial radius and without an atmosphere.

    Args:
        time: datetime in UTC or with a time zone.
        position: (..., 3) geocentric positions in ICRS axes, m.
        shadow: shadow model, either "conical" with penumbra, or "cylindrical" with the values 0 and 1 only.

    Raises:
        ArgumentError: if a position is not finite or lies deep within the Earth (as a position in km does),
            if the time is not in the years 1900 to 2099, or for an unknown shadow model.
    """
    at = _position(position)
    sun = -earth_from_sun(float(terrestrial_time(ephemeris_date("time", time))))[0]
    return sunlit_share(at, sun, shadow)


def _check_elements(
    semi_major_axis: float, eccentricity: float, inclination: float, angles: dict[str, float]
) -> None:
    """Raise UsageError for Kepler elements that `orbit_state` rejects; `angles` are the other angles, rad."""
    sizes = {"semi_major_axis": semi_major_axis, "eccentricity": eccentricity, "inclination": inclination}
    check_numbers(**sizes, **angles)
    for name, value in (sizes | angles).items():
        if not math.isfinite(value):
            raise ArgumentError(name, f"{value}: the elements of an orbit must be finite")
    _check_angle("inclination", inclination, 0.0, math.pi)
    for name, value in angles.items():
        _check_angle(name, value)
    if not 0.0 <= eccentricity < 1.0:
        raise UsageError(f"eccentricity is {eccentricity}: it must be 0 to below 1")
    if semi_major_axis * (1.0 - eccentricity) <= EARTH_RADIUS:
        raise UsageError(
            f"the perigee lies {semi_major_axis * (1.0 - eccentricity):.0f} m from the Earth's centre:"
            f" it must be above {EARTH_RADIUS:.0f} m: give a larger semi_major_axis, in metres"
        )


def orbit_state(
    *,
    semi_major_axis: float,
    eccentricity: float = 0.0,
    inclination: float,
    ascending_node: float = 0.0,
    argument_of_perigee: float = 0.0,
    true_anomaly: float = 0.0,
) -> tuple[FloatArray, FloatArray]:
    """Return the position (3,), m, and velocity (3,), m/s, in ICRS axes for osculating Kepler elements.

    Args:
        semi_major_axis: semi-major axis, m.
        eccentricity: eccentricity, at least 0 (circle) and below 1.
        inclination: inclination to the ICRS equator, 0 to pi rad.
        ascending_node: right ascension of the ascending node, rad.
        argument_of_perigee: argument of perigee, rad.
        true_anomaly: true anomaly, rad. The angles may be -2 pi to 2 pi rad.

    Raises:
        UsageError: for elements that are not finite or whose orbit intersects the Earth, and for angles out
            of range; such angles are usually in degrees.
    """
    angles = {
        "ascending_node": ascending_node,
        "argument_of_perigee": argument_of_perigee,
        "true_anomaly": true_anomaly,
    }
    _check_elements(semi_major_axis, eccentricity, inclination, angles)
    latus_rectum = semi_major_axis * (1.0 - eccentricity**2)
    cosine, sine = math.cos(true_anomaly), math.sin(true_anomaly)
    in_plane = latus_rectum / (1.0 + eccentricity * cosine) * np.array([cosine, sine])
    speed = math.sqrt(GRAVITATIONAL_PARAMETER / latus_rectum)
    motion = speed * np.array([-sine, eccentricity + cosine])
    ci, si = math.cos(inclination), math.sin(inclination)
    co, so = math.cos(ascending_node), math.sin(ascending_node)
    cw, sw = math.cos(argument_of_perigee), math.sin(argument_of_perigee)
    axes = np.array(
        [
            [co * cw - so * sw * ci, -co * sw - so * cw * ci],
            [so * cw + co * sw * ci, -so * sw + co * cw * ci],
            [sw * si, cw * si],
        ]
    )
    return axes @ in_plane, axes @ motion


def propagate_orbit(
    position: ArrayLike, velocity: ArrayLike, seconds: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Return positions (n, 3), m, and velocities (n, 3), m/s, at times after or before an initial state.

    The force model contains the gravity of a spherical Earth and the oblateness term J2. The equations of
    motion are integrated by the classical Runge-Kutta method in steps of at most 30 s. The neglected forces
    shift a satellite in a low orbit by about one kilometre in two revolutions. The error of the integration
    is 0.1 km after a day, and 50 km after 30 days.

    Args:
        position: (3,) initial position in ICRS axes, m.
        velocity: (3,) initial velocity in ICRS axes, m/s.
        seconds: (n,) times relative to the initial state, s, in any order; at most 30 days.

    Raises:
        ArgumentError: if a value is not finite, if the orbit intersects the Earth (as a state in km does), if
            the position or the velocity is larger than that of a satellite of the Earth, or if a time is more
            than 30 days from the initial state.
    """
    at, motion = _single_position(position), finite_array("velocity", velocity, (3,))
    for name, vector, most, unit in (("position", at, FARTHEST, "m"), ("velocity", motion, FASTEST, "m/s")):
        if (length := math.hypot(*vector.tolist())) > most:
            raise ArgumentError(name, f"{length:g} {unit}: give at most {most:g} {unit}")
    lowest = _perigee(at, motion)
    if lowest < LOWEST_RADIUS:
        raise ArgumentError(
            "velocity",
            f"{motion.tolist()} m/s gives a perigee {lowest:.0f} m from the Earth's centre, and no satellite "
            f"is below {LOWEST_RADIUS:.0f} m: give the velocity in m/s, in axes that do not rotate",
        )
    times = np.atleast_1d(finite_array("seconds", seconds))
    if times.ndim != 1:
        raise ArgumentError("seconds", f"an array of shape {times.shape}: give times of shape (n,)")
    if (longest := float(np.abs(times).max(initial=0.0))) > LONGEST:
        raise ArgumentError(
            "seconds",
            f"{longest:g} s from the state: the orbit is unknown after {LONGEST:g} s (30 days): give a "
            "newer state",
        )
    found = np.empty((len(times), 6))
    for some in (np.flatnonzero(times >= 0.0), np.flatnonzero(times < 0.0)):
        state, elapsed = np.concatenate([at, motion]), 0.0
        for k in some[np.argsort(np.abs(times[some]), kind="stable")].tolist():
            time = float(times[k])
            state, elapsed = propagated(state, time - elapsed), time
            found[k] = state
    return found[:, :3], found[:, 3:]


def _perigee(position: FloatArray, velocity: FloatArray) -> float:
    """Return the smallest distance (m) from the Earth's centre on the conic section through a state."""
    momentum = np.cross(position, velocity)
    latus_rectum = float(momentum @ momentum) / GRAVITATIONAL_PARAMETER
    distance = float(np.linalg.norm(position))
    energy = 0.5 * float(velocity @ velocity) - GRAVITATIONAL_PARAMETER / distance
    square = 1.0 + 2.0 * energy * latus_rectum / GRAVITATIONAL_PARAMETER
    return latus_rectum / (1.0 + math.sqrt(max(square, 0.0)))


def propagate_elements(elements: tuple[str, str], times: Sequence[datetime]) -> tuple[FloatArray, FloatArray]:
    """Return positions (n, 3), m, and velocities (n, 3), m/s, in ICRS axes from a two-line element set.

    The propagator is SGP4. The position error of SGP4 is one to three kilometres near the epoch of the
    elements. The error grows by one to three kilometres per day; the unknown drag adds an error that grows
    with the square of the time. Elements are therefore useful for some days before and after their epoch.
    Elements are accepted if the standard deviation is at most 1,000 km, which is reached after about 5 days
    at a height of 300 km, two weeks at 400 km and two months at 800 km.

    Args:
        elements: the two lines of the element set.
        times: times in UTC, or with a time zone.

    Raises:
        ArgumentError: if `times` is a single time or contains anything but times.
        UsageError: if the lines are not a two-line element set or do not describe an orbit.
        OrbitError: if a time is too far from the epoch of the elements, or if SGP4 fails at a time, for
            example because the orbit has decayed.
    """
    if not np.iterable(times):
        raise ArgumentError("times", f"{brief(times)}: give a sequence of times, such as [time]")
    satellite = elements_of(elements)
    states = [satellite.known_at(julian_date(time)) for time in times]
    position = np.array([state.position for state in states]).reshape(-1, 3)
    return position, np.array([state.velocity for state in states]).reshape(-1, 3)
