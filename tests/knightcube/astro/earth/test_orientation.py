"""Tests of Earth orientation and time scales against published values and the full IAU model."""

from __future__ import annotations

import erfa
import numpy as np
import pytest

from knightcube.astro.earth.orientation import (
    celestial_to_terrestrial,
    geodetic,
    julian_epoch,
    mean_equator_to_celestial,
    north_east_down,
    terrestrial_time,
)

DATES = np.array([2_460_676.5, 2_461_120.987654, 2_462_501.25])


def test_positions_of_sgp4_agree_with_the_published_example() -> None:
    """The example is that of Vallado et al., AIAA 2006-6753, for 2004-04-06 07:51:28.386009 UTC."""
    days, fraction = erfa.dtf2d("UTC", 2004, 4, 6, 7, 51, 28.386009)
    of_date = np.array([5094.18010720, 6127.64465950, 6380.34453270])
    celestial = np.array([5102.508959, 6123.011403, 6378.136925])
    turn = mean_equator_to_celestial(days + fraction, -0.439962)
    np.testing.assert_allclose(turn @ of_date, celestial, atol=0.01)
    terrestrial = celestial_to_terrestrial(days + fraction, -0.439962) @ celestial
    # The published position contains polar motion of 0.36", which is 14 m here.
    np.testing.assert_allclose(terrestrial, [-1033.4793830, 7901.2952754, 6380.3565958], atol=0.02)


def test_rotations_agree_with_the_full_model_to_two_milliarcseconds() -> None:
    """The full model is IAU 2006/2000A, for TT = UTC + 69.184 s and UT1 = UTC + 0.2 s."""
    found = celestial_to_terrestrial(DATES, 0.2)
    assert found.shape == (3, 3, 3)
    for date, turn in zip(DATES.tolist(), found, strict=True):
        tt, ut1 = date + 69.184 / 86_400.0, date + 0.2 / 86_400.0
        full = erfa.c2t06a(tt, 0.0, ut1, 0.0, 0.0, 0.0)
        angle = np.linalg.norm(full @ turn.T - np.eye(3)) / np.sqrt(2.0)
        assert angle < 1e-8 + 40e-6 * 7.3e-5, "and the resolution of a date"
    later = celestial_to_terrestrial(DATES, 1.2) @ np.swapaxes(found, 1, 2)
    turned = np.arctan2(later[:, 0, 1], later[:, 0, 0])
    np.testing.assert_allclose(turned, 7.292115e-5, rtol=1e-5)


def test_the_earth_turns_once_in_a_sidereal_day() -> None:
    date = 2_461_120.5
    first, later = (celestial_to_terrestrial(date + days) for days in (0.0, 86_164.0989 / 86_400.0))
    np.testing.assert_allclose(first @ later.T, np.eye(3), atol=1e-6)


def test_time_scales_have_their_published_epochs() -> None:
    assert (terrestrial_time(2_461_120.5) - 2_461_120.5) * 86_400.0 == pytest.approx(69.184, abs=1e-4)
    np.testing.assert_allclose(julian_epoch([2_451_545.0, 2_451_545.0 + 26 * 365.25]), [2000.0, 2026.0])


def test_geodetic_coordinates_of_equator_and_pole() -> None:
    """The semi-axes of WGS 84 are 6,378,137 m and 6,356,752.3142 m."""
    positions = np.array(
        [[0.0, 6_378_137.0, 0.0], [0.0, 0.0, 6_356_752.3142 + 500.0], [-6_378_237.0, 0.0, 0.0]]
    )
    longitude, latitude, height = geodetic(positions)
    np.testing.assert_allclose(longitude[[0, 2]], [0.5 * np.pi, np.pi])
    np.testing.assert_allclose(latitude, [0.0, 0.5 * np.pi, 0.0], atol=1e-12)
    np.testing.assert_allclose(height, [0.0, 500.0, 100.0], atol=1e-3)


def test_local_axes_point_north_east_and_down() -> None:
    np.testing.assert_allclose(
        north_east_down(0.0, 0.0), [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]], atol=1e-15
    )
    longitude, latitude = np.array([0.4, -2.1]), np.array([0.7, -1.1])
    axes = north_east_down(longitude, latitude)
    assert axes.shape == (2, 3, 3)
    step = 1e-6

    def up(along: np.ndarray, above: np.ndarray) -> np.ndarray:
        return np.stack(
            [np.cos(above) * np.cos(along), np.cos(above) * np.sin(along), np.sin(above)], axis=-1
        )

    north = (up(longitude, latitude + step) - up(longitude, latitude - step)) / (2.0 * step)
    east = (up(longitude + step, latitude) - up(longitude - step, latitude)) / (2.0 * step)
    np.testing.assert_allclose(axes[:, 0], north, atol=1e-9)
    np.testing.assert_allclose(axes[:, 1], east / np.cos(latitude)[:, None], atol=1e-9)
    np.testing.assert_allclose(axes[:, 2], -up(longitude, latitude), atol=1e-15)
