"""Tests of the Cramer-Rao bound against published values and against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.vision.camera.lens import Pinhole
from tests.support.streak_bound import endpoint_bound, rate_bound

_ELECTRONS = 1.9e10 * np.pi / 4.0 * 0.025**2 * 0.2
_FLOOR = 10.0**2 + 50.0 * 0.2
# Bounds (px) of one end point: streak length, then the bounds along and across the streak for magnitudes 2, 4
# and 6 (design notes on streaks).
_TABLE = [
    (10, 0.007, 0.004, 0.021, 0.012, 0.077, 0.043),
    (50, 0.017, 0.004, 0.061, 0.015, 0.29, 0.065),
    (100, 0.027, 0.005, 0.105, 0.017, 0.55, 0.087),
    (200, 0.043, 0.005, 0.19, 0.022, 1.07, 0.12),
    (500, 0.086, 0.006, 0.44, 0.031, 2.6, 0.18),
]


@pytest.mark.parametrize("row", _TABLE)
def test_one_endpoint_has_the_published_bound(row: tuple[float, ...]) -> None:
    """The bounds of an end point are the published bounds, within half a unit of the last digit plus 3 %.

    The published values, down to 0.004, have two digits.
    """
    length, *published = row
    found: list[float] = []
    for magnitude in (2.0, 4.0, 6.0):
        found.extend(endpoint_bound(length, _ELECTRONS * 10.0 ** (-0.4 * magnitude), 1.0, _FLOOR))
    for value, printed in zip(found, published, strict=True):
        unit = 0.01 if printed >= 0.12 and printed != 0.105 else 0.001
        unit = 0.1 if printed >= 2.0 else unit
        assert value == pytest.approx(printed, rel=0.03, abs=0.55 * unit)


def test_a_star_at_rest_is_bounded_as_a_gaussian_spot_of_photons_is() -> None:
    """The position of a star at rest is bounded by sigma / sqrt(N), as for N photons in a Gaussian spot.

    The bound holds for photon noise alone and fine pixels.
    """
    end = endpoint_bound(200.0, 1e9, 3.0, 1e-6)
    # The offset of a bright line is known to sigma / sqrt(N). The end of a straight line with unknown
    # direction is known to 2 sigma / sqrt(N) across the line.
    assert end[1] == pytest.approx(2.0 * np.hypot(3.0, np.sqrt(1.0 / 12.0)) / np.sqrt(1e9), rel=0.02)


def test_the_bound_of_the_rate_shrinks_with_stars_and_with_light() -> None:
    pinhole = Pinhole.from_field_of_view(1024, 1024, np.radians(20.0))
    rng = np.random.default_rng(5)
    stars = rng.uniform(150.0, 870.0, (8, 2))
    light = np.full(8, 2e5)
    rate = np.array([0.02, 0.03, 0.01])
    few = rate_bound(pinhole, stars[:4], light[:4], rate, 1.0, 1.0, 150.0).covariance
    many = rate_bound(pinhole, stars, light, rate, 1.0, 1.0, 150.0).covariance
    bright = rate_bound(pinhole, stars, 4.0 * light, rate, 1.0, 1.0, 150.0).covariance
    assert np.all(np.linalg.eigvalsh(few - many) > 0.0)
    # Four times the signal divides the bound by a number between two (photon noise) and four (read noise).
    ratio = np.sqrt(np.trace(many) / np.trace(bright))
    assert 2.0 < ratio < 4.0


def test_the_boresight_component_is_the_weak_one_across_the_boresight() -> None:
    """For a rate normal to the boresight, the component along the boresight is the least accurate.

    The error of the rate vector is several times the error of its magnitude.
    """
    pinhole = Pinhole.from_field_of_view(1024, 1024, np.radians(20.0))
    stars = np.random.default_rng(6).uniform(150.0, 870.0, (10, 2))
    bound = rate_bound(pinhole, stars, np.full(10, 2e5), np.array([0.0, 0.035, 0.0]), 1.0, 1.0, 150.0)
    sigma = np.sqrt(np.diag(bound.covariance))
    assert 2.0 < sigma[2] / sigma[1] < 8.0


def test_one_star_hardly_fixes_the_rate() -> None:
    """One star hardly determines the rate.

    One star gives two components of the rate. The third component follows from the curvature and the change
    of speed.
    """
    pinhole = Pinhole.from_field_of_view(1024, 1024, np.radians(20.0))
    rate = np.array([0.0, 0.03, 0.0])
    one = rate_bound(pinhole, np.array([[500.0, 500.0]]), np.array([1e5]), rate, 1.0, 1.0, 100.0)
    known = np.sqrt(np.linalg.eigvalsh(one.covariance))
    assert known[2] > 30.0 * known[1]
    with pytest.raises(np.linalg.LinAlgError):
        rate_bound(pinhole, np.array([[-500.0, 500.0]]), np.array([1e5]), rate, 1.0, 1.0, 100.0)
