"""Tests of the two field models against NOAA's published values and against each other."""

from __future__ import annotations

import numpy as np
import pytest

from hal.interfaces.errors import OutOfRange
from knightcube.astro.earth import geomagnetism as believed
from knightcube.astro.earth.orientation import celestial_to_terrestrial, geodetic, north_east_down
from knightcube.errors import UsageError
from sim_hal.worlds import orbit as true
from tests.support import build_igrf

# WMM2025 test values of NOAA NCEI (WMM2025_TEST_VALUES.txt in the PyPI package AHRS 0.4.0). The columns are
# year, height (km), latitude and longitude (deg), and north, east and down (nT).
NOAA = (
    (2025.0, 0.0, 80.0, 0.0, 6521.6, 145.9, 54791.5),
    (2025.0, 0.0, 0.0, 120.0, 39677.8, -109.6, -10580.2),
    (2025.0, 0.0, -80.0, 240.0, 6117.5, 15751.9, -52022.5),
    (2025.0, 100.0, 80.0, 0.0, 6216.0, 92.4, 52598.8),
    (2025.0, 100.0, 0.0, 120.0, 37688.6, -96.2, -10152.1),
    (2025.0, 100.0, -80.0, 240.0, 5907.6, 14780.3, -49540.7),
    (2027.5, 0.0, 80.0, 0.0, 6500.8, 294.5, 54869.4),
    (2027.5, 0.0, 0.0, 120.0, 39701.6, -167.4, -10381.8),
    (2027.5, 0.0, -80.0, 240.0, 6200.7, 15730.3, -51783.7),
    (2027.5, 100.0, 80.0, 0.0, 6196.7, 233.8, 52670.5),
    (2027.5, 100.0, 0.0, 120.0, 37711.5, -148.7, -9969.8),
    (2027.5, 100.0, -80.0, 240.0, 5984.0, 14760.1, -49317.7),
)
DATE = 2_461_365.8
"""2026 November 21."""


def julian_date(year: float) -> float:
    return 2_451_545.0 + (year - 2000.0) * 365.25


@pytest.mark.parametrize("row", NOAA)
def test_the_field_of_the_flight_software_is_the_published_one(row: tuple[float, ...]) -> None:
    """The field of the flight software equals NOAA's values to 0.06 nT, half the last digit plus rounding."""
    year, height, latitude, longitude, *published = row
    found = believed.field_on_ground_axes(year, np.radians(latitude), np.radians(longitude), 1e3 * height)
    np.testing.assert_allclose(1e9 * found, published, atol=0.06)


@pytest.mark.parametrize("row", NOAA)
def test_the_true_field_differs_from_the_published_one_as_two_models_do(row: tuple[float, ...]) -> None:
    """The fields of IGRF-14 and WMM2025 at NOAA's points differ as expected of two models.

    IGRF-14 is computed from positions, and converted back to the axes of the ellipsoid.
    """
    year, height, latitude, longitude, *published = row
    up, along = np.radians(latitude), np.radians(longitude)
    a, f = 6_378_137.0, 1.0 / 298.257223563
    e2 = f * (2.0 - f)
    n = a / np.sqrt(1.0 - e2 * np.sin(up) ** 2)
    h = 1e3 * height
    place = np.array(
        [
            (n + h) * np.cos(up) * np.cos(along),
            (n + h) * np.cos(up) * np.sin(along),
            (n * (1.0 - e2) + h) * np.sin(up),
        ]
    )
    found = north_east_down(along, up) @ true.magnetic_field_on_ground(julian_date(year), place)
    np.testing.assert_allclose(1e9 * found, published, atol=60.0)


def test_in_orbit_both_models_agree_to_nanoteslas() -> None:
    """At 400 km, 2025 to 2029.9, both models agree within 40 nT and 0.15 deg, and to 10 nT on average."""
    rng = np.random.default_rng(5)
    away = rng.standard_normal((60, 3))
    positions = 6.778e6 * away / np.linalg.norm(away, axis=-1, keepdims=True)
    dates = julian_date(2025.01) + rng.uniform(0.0, 1780.0, 60)
    truth = true.magnetic_field(dates, positions)
    belief = np.array([believed.field(d, p) for d, p in zip(dates.tolist(), positions, strict=True)])
    apart = 1e9 * np.linalg.norm(truth - belief, axis=-1)
    assert 1.0 < np.mean(apart) < 15.0
    assert np.max(apart) < 40.0
    sine = np.linalg.norm(np.cross(truth, belief), axis=-1)
    assert np.max(np.degrees(np.arctan2(sine, np.sum(truth * belief, axis=-1)))) < 0.15


def test_the_true_field_has_no_sources_and_no_currents() -> None:
    """The true field has no divergence and no curl: both are below 1e-4 of the gradient of the field.

    The derivatives are central differences over 20 km.
    """
    place, step = np.array([3.1e6, -4.2e6, 4.3e6]), 2e4
    slope = np.empty((3, 3))
    for axis in range(3):
        off = step * np.eye(3)[axis]
        up, down = (true.magnetic_field_on_ground(DATE, place + sign * off) for sign in (1.0, -1.0))
        slope[axis] = (up - down) / (2.0 * step)
    size = np.abs(slope).max()
    assert abs(np.trace(slope)) < 1e-4 * size
    assert np.abs(slope - slope.T).max() < 1e-4 * size


def test_many_places_have_the_fields_of_each_alone_and_the_poles_are_finite() -> None:
    places = np.array([[0.0, 0.0, 6.8e6], [1.0, 0.0, 6.8e6], [0.0, 0.0, -6.8e6], [6.8e6, 1e5, 0.0]])
    together = true.magnetic_field_on_ground(DATE, places)
    for place, found in zip(places, together, strict=True):
        np.testing.assert_array_equal(true.magnetic_field_on_ground(DATE, place), found)
    np.testing.assert_allclose(together[0], together[1], atol=1e-11)


def test_the_ring_current_weakens_the_field_at_the_magnetic_equator() -> None:
    quiet = true.ring_current(DATE, 20e-9)
    assert np.linalg.norm(quiet) == pytest.approx(20e-9)
    north = celestial_to_terrestrial(DATE) @ quiet
    # The dipole's pole of 2025 is at 80.8 N, 72.8 W (IGRF-14). The field of the ring current points away from
    # this pole.
    _, latitude, _ = geodetic(-7e6 * north / np.linalg.norm(north))
    assert np.degrees(float(latitude)) == pytest.approx(80.8, abs=0.4)


def test_years_and_places_that_no_model_knows_are_refused() -> None:
    with pytest.raises(believed.GeomagneticError, match=r"year 2031\.00: WMM2025 is valid from 2025 to 2030"):
        believed.check_year(2031.0)
    with pytest.raises(believed.GeomagneticError, match="invalid position"):
        believed.field_on_ground_axes(2026.0, float("nan"), 0.0, 0.0)
    with pytest.raises(OutOfRange, match="year"):
        true.magnetic_field(julian_date(2046.0), np.array([7e6, 0.0, 0.0]))


@pytest.mark.parametrize("year", [2030.5, 2031.0, 2033.0, 2036.0, 2040.0])
def test_the_extrapolated_field_is_within_its_standard_deviation(year: float) -> None:
    rng = np.random.default_rng(int(year))
    away = rng.standard_normal((60, 3))
    positions = 6.878e6 * away / np.linalg.norm(away, axis=-1, keepdims=True)
    date = julian_date(year)
    truth = true.magnetic_field(np.full(60, date), positions)
    belief = np.array([believed.field(date, position) for position in positions])
    sigma = believed.extrapolation_sigma(date)
    assert sigma == pytest.approx(2.5e-8 * (year - 2030.0), rel=1e-6)
    assert np.sqrt(np.mean((truth - belief) ** 2)) < 1.2 * np.hypot(sigma, 2e-8)
    assert np.abs(truth - belief).max() < 4.0 * np.hypot(sigma, 2e-8)


def test_the_extrapolation_begins_without_a_step_and_ends() -> None:
    before, after = (believed.field_on_ground_axes(2030.0 + s, 0.5, 0.5, 5e5) for s in (-0.001, 0.001))
    assert np.linalg.norm(after - before) < 1e-9
    assert believed.extrapolation_sigma(julian_date(2027.0)) == 0.0
    assert believed.extrapolation_sigma(julian_date(2023.0)) == pytest.approx(5e-8, rel=1e-3)
    late, later = (believed.field_on_ground_axes(year, 0.5, 0.5, 5e5) for year in (2050.0, 2070.0))
    np.testing.assert_array_equal(late, later)


def test_the_builder_refuses_a_text_that_is_not_a_table_of_the_field() -> None:
    with pytest.raises(UsageError, match="not a table of IGRF-14"):
        build_igrf.parse("# nothing\n1 13 27 2 1 1900.0 2030.0\n 2020.0 2025.0 2030.0\n 1 0 1 2 3\n")
    rows = "\n".join(f"{n} {m} 1 2 3" for n, m in build_igrf.order())
    with pytest.raises(UsageError, match="the dipole of 2025"):
        build_igrf.parse(f"1 13 3 2 1 2020 2030\n2020.0 2025.0 2030.0\n{rows}\n")


def test_the_stored_table_is_the_builder_s() -> None:
    """The stored table has the builder's columns, so the published dipole of 2025 is in the right columns."""
    with np.load(true.TABLE) as stored:
        epochs, table = stored["epoch"], stored["coefficient"]
    assert epochs.tolist() == [2000, 2005, 2010, 2015, 2020, 2025, 2030]
    row = table[epochs.tolist().index(2025)]
    for pair, value in build_igrf.PUBLISHED.items():
        assert row[build_igrf.order().index(pair)] == value


def test_many_positions_give_exactly_the_fields_of_each() -> None:
    """An array of positions gives exactly the fields of the single positions.

    Positions range from below the ground to the geostationary orbit. Some dates are after the model's last
    year.
    """
    generator = np.random.default_rng(3)
    directions = generator.normal(size=(100, 3))
    heights = np.geomspace(6.3e6, 4.2e7, 100)[:, None]
    positions = heights * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    dates = generator.uniform(julian_date(2000.0), julian_date(2060.0), 100)
    each = [believed.field(float(date), position) for date, position in zip(dates, positions, strict=True)]
    np.testing.assert_array_equal(believed.fields(dates, positions), each)


@pytest.mark.parametrize("off", [0.0, 1e-12, 1e-9, 2e-6])
def test_a_position_near_a_pole_among_others_gives_its_field(off: float) -> None:
    to_ground = celestial_to_terrestrial(DATE)
    positions = 7e6 * np.array([[off, 0.0, 1.0], [0.0, off, -1.0], [1.0, 0.0, 0.0]]) @ to_ground
    found = believed.fields(np.full(3, DATE), positions)
    np.testing.assert_array_equal(found, [believed.field(DATE, position) for position in positions])
