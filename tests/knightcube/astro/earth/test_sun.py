"""Tests of the Earth's motion about the Sun against published values and finite differences."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta, timezone

import numpy as np
import pytest

from knightcube.astro.earth.orientation import terrestrial_time
from knightcube.astro.earth.sun import (
    ASTRONOMICAL_UNIT,
    DAY,
    earth_from_sun,
    earth_velocity,
    julian_date,
)


@pytest.mark.parametrize(
    ("date", "distance"),
    [
        (datetime(2025, 1, 4, 13, 28, tzinfo=UTC), 0.98332728),  # perihelion (US Naval Observatory)
        (datetime(2025, 7, 3, 19, 55, tzinfo=UTC), 1.01664373),  # aphelion
    ],
)
def test_the_distance_of_the_sun_is_the_published_one(date: datetime, distance: float) -> None:
    position, velocity = earth_from_sun(float(terrestrial_time(julian_date(date))))
    assert np.linalg.norm(position) / ASTRONOMICAL_UNIT == pytest.approx(distance, abs=3e-5)
    radial = position @ velocity / np.linalg.norm(position)
    assert abs(radial) < 20.0, "the distance is extreme"


def test_the_velocity_is_the_derivative_of_the_position() -> None:
    date = 2_461_120.25
    step = 0.01
    before, after = earth_from_sun(date - step)[0], earth_from_sun(date + step)[0]
    slope = (after - before) / (2.0 * step * DAY)
    position, velocity = earth_from_sun(date)
    np.testing.assert_allclose(velocity, slope, atol=25.0)  # the Sun itself moves by 15 m/s
    np.testing.assert_allclose(earth_velocity(date), velocity, atol=25.0)
    assert np.linalg.norm(velocity) == pytest.approx(29.8e3, rel=0.02)
    assert np.cross(position, velocity)[2] > 0.0


def test_at_the_equinox_the_sun_is_at_the_vernal_point() -> None:
    """The March equinox of 2026 is on 20 March at 14:46 UTC."""
    date = julian_date(datetime(2026, 3, 20, 14, 46, tzinfo=UTC))
    sun = -earth_from_sun(float(terrestrial_time(date)))[0]
    sun /= np.linalg.norm(sun)
    # The vernal point has moved by 26.2 years of precession (50.29" per year along the ecliptic) since 2000.
    along = np.radians(26.2 * 50.29 / 3600.0)
    np.testing.assert_allclose(sun[1:], [-along * np.cos(0.40909), -along * np.sin(0.40909)], atol=2e-4)


def test_julian_dates_of_known_times() -> None:
    assert julian_date(datetime(2000, 1, 1, 12, 0, tzinfo=UTC)) == 2_451_545.0
    assert julian_date(datetime(2026, 3, 20, 18, 0)) == 2_461_120.25
    east = timezone(timedelta(hours=2))
    assert julian_date(datetime(2026, 3, 20, 20, 0, tzinfo=east)) == pytest.approx(2_461_120.25)
