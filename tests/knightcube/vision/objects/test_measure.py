"""Tests of the image-processing job, with satellites near stars and brighter than stars."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro import catalogue
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import angle_between, attitude_matrix
from knightcube.vision.startracker.index.build import default_index
from tests.knightcube.vision.satellite_frames import CAMERA, HELD, Shot
from tests.support.scenes import catalogue as sky_to


def _star(brightest: float, faintest: float) -> FloatArray:
    """Return the position (2,) px of an isolated star in the magnitude range, away from the border."""
    stars, directions = sky_to(8.5)
    places = CAMERA.pinhole.project(directions @ attitude_matrix(HELD).T)
    inside = np.all((places > 60.0) & (places < 450.0), axis=1)
    for number in np.flatnonzero(inside & (stars.magnitude > brightest) & (stars.magnitude < faintest)):
        away = np.linalg.norm(places - places[number], axis=1)
        if np.sum(away < 12.0) == 1:
            return np.asarray(places[number])
    raise AssertionError("no star of that magnitude is alone")


@pytest.mark.parametrize(("apart", "magnitude", "star"), [(2.0, 4.0, 5.0), (3.0, 5.5, 5.0), (1.5, 3.0, 4.5)])
def test_an_object_beside_a_catalogue_star_is_measured_correctly(
    apart: float, magnitude: float, star: float
) -> None:
    place = _star(star - 0.5, star + 0.5) + apart * np.array([0.6, 0.8])
    shot = Shot(place, np.array([0.8, -0.3]), magnitude, np.zeros(3))
    sighted = shot.found().objects
    assert sighted is not None
    own = shot.sighting(sighted)
    assert own is not None
    focal = CAMERA.pinhole.focal_length
    claim = np.sqrt(0.5 * np.trace(sighted.covariance[own])) * focal
    assert claim < 0.06
    # The limit is the 99.99 % quantile of chi-square with two degrees of freedom.
    assert np.linalg.norm(sighted.points[own] - place) < 4.3 * claim
    assert abs(sighted.magnitudes[own] - magnitude) < 0.3
    assert len(sighted.points) == 1


def test_stars_alone_are_not_reported_as_objects() -> None:
    far = Shot(np.array([-900.0, -900.0]), np.zeros(2), 4.0, np.zeros(3))
    sighted = far.found().objects
    assert sighted is not None
    assert not len(sighted.points)


@pytest.mark.parametrize("knows", [True, False])
@pytest.mark.parametrize(("turn", "magnitude"), [(0.0, -1.0), (0.02, 2.0)])
def test_a_bright_satellite_is_not_identified_as_a_star(turn: float, magnitude: float, knows: bool) -> None:
    """Neither the star identification nor the second fit identifies a bright satellite as a star."""
    place, motion = np.array([203.3, 301.8]), np.array([2.5, 1.0])
    shot = Shot(place, motion, magnitude, np.array([0.0, turn, 0.0]), knows)
    found = shot.found()
    solution = found.solution
    assert solution is not None
    assert solution.fix is not None
    assert angle_between(solution.fix.quaternion, HELD) < 3e-4
    away = np.linalg.norm(solution.points - place, axis=1)
    assert not np.any((away < 3.0) & (solution.star >= 0))
    error = 6.0 * np.sqrt(np.trace(solution.fix.covariance))
    assert angle_between(solution.fix.quaternion, HELD) < error
    assert turn > 0.0 or shot.sighting(found.objects) is not None


def test_the_catalogue_holds_stars_only() -> None:
    """The catalogue contains only stars. Hipparcos numbers end at 120,416.

    The fastest star is Barnard's Star with 10.4" per year.
    """
    stars = catalogue.load()
    assert len(np.unique(stars.hip)) == len(stars.hip)
    assert stars.hip.min() >= 1
    assert stars.hip.max() <= 120_416
    assert np.linalg.norm(stars.proper_motion, axis=1).max() < np.radians(10.4 / 3600.0)
    guides = default_index().stars
    near = np.array([(stars.directions_at(guides.epoch) @ one).max() for one in guides.direction[::500]])
    assert np.all(np.arccos(np.clip(near, -1.0, 1.0)) < 1e-4)
