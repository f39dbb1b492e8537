"""Position of the Sun relative to the Earth, Earth shadow, and astronomical constants.

The Earth's position and velocity relative to the Sun are computed by the ERFA function epv00 (VSOP2000:
Moisson & Bretagnon 2001), which takes 0.35 ms per call.

The shadow model is Sease, eq. 2.15, with two corrections: the shadow is evaluated at the position of the
object, and the penumbra is included by default. The Earth is modelled as a sphere with its equatorial radius
and without an atmosphere.
"""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import Literal

import numpy as np

from knightcube.astro.arrays import FloatArray, brief
from knightcube.astro.earth.figure import EARTH_RADIUS
from knightcube.errors import ArgumentError

SPEED_OF_LIGHT = 299_792_458.0
"""Speed of light, m/s."""
ASTRONOMICAL_UNIT = 149_597_870_700.0
"""Astronomical unit, m (IAU 2012)."""
SUN_RADIUS = 695_700_000.0
"""Radius of the Sun, m (IAU 2015)."""
J2000 = 2_451_545.0
"""Julian date of 2000 January 1.5 TT."""
UNIX_EPOCH = 2_440_587.5
"""Julian date of 1970 January 1.0."""
DAY = 86_400.0
"""Length of a day, s."""


def julian_date(utc: datetime) -> float:
    """Return the Julian date UTC, days, of a `datetime`, which is in UTC unless it has a time zone.

    Raises ArgumentError for an argument of another type.
    """
    if not isinstance(utc, datetime):
        raise ArgumentError("time", f"{utc!r}: give a datetime, such as datetime(2026, 11, 26, 12)")
    instant = utc.replace(tzinfo=UTC) if utc.tzinfo is None else utc
    return J2000 + (instant - datetime(2000, 1, 1, 12, tzinfo=UTC)).total_seconds() / DAY


FIRST_YEAR, LAST_YEAR = 1900, 2100
"""Years between which the positions of Earth and Sun are known."""


def ephemeris_date(name: str, utc: datetime) -> float:
    """Return the Julian date UTC, days, of the time in the argument `name`.

    Raises ArgumentError if the argument is not a `datetime`, and for a time before 1900 or after 2099.
    """
    date = julian_date(utc)
    if not FIRST_YEAR <= utc.year < LAST_YEAR:
        raise ArgumentError(
            name,
            f"{utc.isoformat()}: give a time from {FIRST_YEAR} to {LAST_YEAR - 1}, in which the positions of "
            "Earth and Sun are known",
        )
    return date


def earth_from_sun(julian_date: float) -> tuple[FloatArray, FloatArray]:
    """Return the Earth's heliocentric position (3,), m, and barycentric velocity (3,), m/s, in ICRS axes.

    The Julian date is TT. From 1900 to 2100 the differences from the JPL ephemeris DE405 are below 12 km and
    5 mm/s (documentation of epv00).
    """
    # ERFA is imported here, because most modules use only the constants of this module.
    import erfa  # noqa: PLC0415

    whole = math.floor(julian_date)
    heliocentric, barycentric = erfa.epv00(float(whole), julian_date - whole)
    position = ASTRONOMICAL_UNIT * np.asarray(heliocentric["p"])
    return position, ASTRONOMICAL_UNIT / DAY * np.asarray(barycentric["v"])


def earth_velocity(julian_date: float) -> FloatArray:
    """Return the Earth's barycentric velocity (3,) in ICRS axes, m/s, at a Julian date TT.

    The Earth's velocity causes the annual aberration. The orbital velocity of a satellite in a low orbit (7.6
    km/s) causes an additional aberration of 5".
    """
    return earth_from_sun(julian_date)[1]


Shadow = Literal["conical", "cylindrical"]


def sunlit_share(position: FloatArray, sun: FloatArray, shadow: Shadow = "conical") -> FloatArray:
    """Return the visible fraction (...) of the Sun's disc, which is 1 in sunlight and 0 in the Earth's umbra.

    The positions of the observer and of the Sun (..., 3), m, are geocentric. The "conical" shadow model
    computes the overlap of the discs of Sun and Earth (Montenbruck & Gill 2000, section 3.4.2). The
    "cylindrical" model returns 0 or 1 (Sease, eq. 2.15, corrected). Raises ArgumentError for another model.
    """
    position, sun = np.asarray(position, dtype=float), np.asarray(sun, dtype=float)
    distance = np.linalg.norm(position, axis=-1)
    if not (isinstance(shadow, str) and shadow in ("conical", "cylindrical")):
        raise ArgumentError("shadow", f"{brief(shadow)}: give conical or cylindrical")
    if shadow == "cylindrical":
        towards = sun / np.linalg.norm(sun, axis=-1, keepdims=True)
        cosine = np.sum(position * towards, axis=-1) / distance
        tangent = np.sqrt(np.maximum(0.0, distance**2 - EARTH_RADIUS**2)) / distance
        return np.where(cosine <= -tangent, 0.0, 1.0)
    to_sun = sun - position
    sun_distance = np.linalg.norm(to_sun, axis=-1)
    sun_disc = np.arcsin(SUN_RADIUS / sun_distance)
    earth_disc = np.arcsin(np.minimum(1.0, EARTH_RADIUS / distance))
    cosine = -np.sum(position * to_sun, axis=-1) / (distance * sun_distance)
    # The sine is computed by the cross product, because the arc cosine is inaccurate for small angles.
    sine = np.linalg.norm(np.cross(position, to_sun), axis=-1) / (distance * sun_distance)
    return 1.0 - _covered_share(sun_disc, earth_disc, np.arctan2(sine, cosine))


def _covered_share(disc: FloatArray, cover: FloatArray, apart: FloatArray) -> FloatArray:
    """Return the fraction (...) of a disc of angular radius `disc` that a disc of radius `cover` covers.

    The centres are `apart` rad from each other. The covered area of two plane discs consists of two circular
    segments along the common chord. Plane discs are a sufficient approximation, because the Sun's disc is
    small and the Earth's limb across the disc is nearly straight.
    """
    crossing = (apart < disc + cover) & (apart > np.abs(disc - cover))
    safe = np.where(crossing, apart, disc + cover)
    chord = np.clip((safe**2 + disc**2 - cover**2) / (2.0 * safe * disc), -1.0, 1.0)
    other = np.clip((safe**2 + cover**2 - disc**2) / (2.0 * safe * cover), -1.0, 1.0)
    first = disc**2 * (np.arccos(chord) - chord * np.sqrt(1.0 - chord**2))
    second = cover**2 * (np.arccos(other) - other * np.sqrt(1.0 - other**2))
    within = np.where(apart <= cover - disc, 1.0, np.where(apart <= disc - cover, (cover / disc) ** 2, 0.0))
    return np.asarray(np.where(crossing, (first + second) / (np.pi * disc**2), within))
