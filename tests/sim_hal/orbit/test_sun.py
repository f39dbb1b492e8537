"""The Sun against published positions: the Almanac's, Meeus's, and the instants of the seasons."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT, DAY, J2000
from sim_hal.worlds.orbit import sun_position

ARCSECOND = np.radians(1.0 / 3600.0)
OBLIQUITY = np.radians(23.4393)
ABERRATION = 20.5 * ARCSECOND


@pytest.mark.parametrize(
    ("julian_date", "published"),
    [
        # Astronomical Almanac 1999, page C20: 1999 January 22.0 TDT, J2000.
        (2_451_200.5, (0.51453130, -0.7697110, -0.3337152)),
        # Meeus, Astronomical Algorithms, Example 26.b: 1992 October 13.0 TD, J2000.
        (2_448_908.5, (-0.93739691, -0.31316824, -0.13577924)),
    ],
)
def test_the_sun_stands_where_it_was_published(
    julian_date: float, published: tuple[float, float, float]
) -> None:
    """Those are geometric; the apparent place is 20.5" behind along the ecliptic. To 40" and 1e-4 AU."""
    place = np.array(published)
    pole = np.array([0.0, -np.sin(OBLIQUITY), np.cos(OBLIQUITY)])
    apparent = place - ABERRATION * np.cross(pole, place)
    computed = sun_position(julian_date) / ASTRONOMICAL_UNIT
    assert np.linalg.norm(np.cross(computed, apparent)) / np.linalg.norm(apparent) ** 2 < 40.0 * ARCSECOND
    assert np.linalg.norm(computed) == pytest.approx(np.linalg.norm(place), abs=1e-4)


@pytest.mark.parametrize(
    ("julian_date", "longitude"),
    [
        # US Naval Observatory, Earth's seasons: 2026 March 20 14:46, June 21 08:25, September 23 00:05,
        # December 21 20:50; 2030 March 20 13:52 UT. 69 s more are TT.
        (2_461_120.11528, 0.0),
        (2_461_212.85069, 90.0),
        (2_461_306.50347, 180.0),
        (2_461_396.36806, 270.0),
        (2_462_581.07778, 0.0),
    ],
)
def test_at_equinox_and_solstice_the_sun_is_a_quarter_further(julian_date: float, longitude: float) -> None:
    """Longitudes of date; J2000's are less by the precession, 50.29" a year, far more than the 60" here."""
    when = julian_date + 69.0 / DAY
    x, y, z = sun_position(when)
    along = np.arctan2(y * np.cos(OBLIQUITY) + z * np.sin(OBLIQUITY), x)
    precession = 50.29 * ARCSECOND * (when - J2000) / 365.25
    error = np.remainder(along + precession - np.radians(longitude) + np.pi, 2.0 * np.pi) - np.pi
    assert abs(error) < 60.0 * ARCSECOND
    assert precession > 1000.0 * ARCSECOND


def test_the_distance_is_least_in_january_and_greatest_in_july() -> None:
    """Perihelion 0.9833 AU and aphelion 1.0167 AU, 2026 January 3 and July 6 (US Naval Observatory)."""
    days = 2_461_041.5 + np.arange(365.0)
    distance = np.linalg.norm(sun_position(days), axis=-1) / ASTRONOMICAL_UNIT
    assert distance.min() == pytest.approx(0.9833, abs=1e-4)
    assert distance.max() == pytest.approx(1.0167, abs=1e-4)
    assert abs(int(distance.argmin()) - 2) <= 1
    assert abs(int(distance.argmax()) - 186) <= 2


def test_many_dates_are_answered_at_once() -> None:
    days = J2000 + np.linspace(0.0, 9000.0, 7)
    together = sun_position(days)
    assert together.shape == (7, 3)
    assert np.array_equal(together[3], sun_position(days[3]))
