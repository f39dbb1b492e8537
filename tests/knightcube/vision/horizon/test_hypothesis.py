"""Tests of the probability that random edges form a horizon, and of photographs without a limb."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from knightcube.errors import UsageError
from knightcube.vision.camera.images import read_image
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.horizon.hypothesis import LimbInView, limb_in_view, log10_chance
from knightcube.vision.horizon.nadir import HorizonStatus, find_nadir
from knightcube.vision.horizon.settings import HorizonKnowledge, HorizonSettings

CAMERA = Pinhole.from_field_of_view(512, 512, np.radians(67.0))
FAR = (100e3, 40e6)
DATA = Path(__file__).resolve().parents[5] / "shared/data"
PHOTOGRAPHS = ("esa_alt40_azi45.tiff", "esa_alt60_azi135.tiff", "tree.jpg", "hale_bopp.jpg", "orion2.jpg")


def test_the_number_of_scan_lines_that_cross_a_circle_follows_from_its_extent() -> None:
    """Scan lines cross a circle as often as its extent in x and y predicts.

    A scan line is counted only if its distance from the centre is at most 0.954 of the radius. There, the
    cosine of the angle between the scan line and the normal of the circle is 0.3.
    """
    angle = np.linspace(0.0, 2.0 * np.pi, 7200, endpoint=False)
    circle = 256.0 + 100.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    inside = np.ones(len(angle), dtype=bool)
    view = limb_in_view(circle, inside, angle < np.pi, (10.0, 10.0))
    assert view.all_crossings == pytest.approx(2 * 40.0 * np.sqrt(1.0 - 0.3**2), rel=1e-3)
    assert view.crossings == pytest.approx(0.5 * view.all_crossings, rel=1e-2)
    assert view.length == pytest.approx(100.0 * np.pi, rel=1e-3)


def test_edges_along_a_whole_limb_are_significant_and_a_tenth_of_them_are_not() -> None:
    limb, generator = LimbInView(500.0, 40.0, 40.0), np.random.default_rng(1)
    others = generator.uniform(-200.0, 200.0, 100)
    assert log10_chance(limb, generator.normal(0.0, 0.1, 40), others, CAMERA, 2) < -50.0
    assert log10_chance(limb, generator.uniform(-2.0, 2.0, 4), others, CAMERA, 2) > 0.0
    # An unknown altitude, and edges that are not on the limb, increase the probability of a chance horizon.
    good = generator.normal(0.0, 0.3, 25)
    known, unknown = (log10_chance(limb, good, others, CAMERA, n) for n in (2, 3))
    crowded = log10_chance(limb, good, generator.uniform(-20.0, 20.0, 200), CAMERA, 2)
    assert known < unknown
    assert known < crowded


def test_points_that_the_lens_does_not_image_are_not_part_of_a_limb() -> None:
    points = np.full((8, 2), np.nan)
    view = limb_in_view(points, np.zeros(8, dtype=bool), np.ones(8, dtype=bool), (10.0, 10.0))
    assert view == LimbInView(0.0, 0.0, 0.0)
    assert log10_chance(view, np.zeros(0), np.zeros(0), CAMERA, 2) > 0.0


def test_a_small_disc_is_not_a_limb_from_low_orbit() -> None:
    """A small disc is not the limb from a low orbit.

    A lens ghost with a radius of 10.6 deg looks like the Earth from an altitude of 28,000 km.
    """
    y, x = np.mgrid[0:512, 0:512]
    disc = np.clip(74.0 - np.hypot(x - 200.0, y - 230.0), 0.0, 1.0)
    pixels = np.random.default_rng(1).normal(10.0 + 100.0 * disc, 1.0).clip(0, 255).astype(np.uint8)
    low, any_ = (find_nadir(pixels, CAMERA, settings=each) for each in (None, HorizonSettings(altitudes=FAR)))
    assert low.nadir is None
    assert any_.nadir is not None
    assert 27e6 < any_.nadir.altitude < 30e6
    with pytest.raises(UsageError, match="give the lower altitude first"):
        HorizonSettings(altitudes=FAR[::-1])


@pytest.mark.slow
@pytest.mark.parametrize("name", PHOTOGRAPHS)
def test_a_photograph_of_the_sky_shows_no_horizon(name: str) -> None:
    """Photographs of the sky from the ground, with trees, a dome or a comet's tail, show no horizon."""
    path = DATA / "sky" / name
    if not path.exists():
        pytest.skip("needs ../shared/data/sky")
    pixels = read_image(path)
    rows, columns = pixels.shape
    for field in (12.8, 67.0):
        camera = Pinhole.from_field_of_view(columns, rows, np.radians(field))
        for altitude in (None, 515e3):
            found = find_nadir(pixels, camera, HorizonKnowledge(altitude=altitude))
            assert found.nadir is None, (field, altitude)


@pytest.mark.slow
def test_clouds_below_a_real_limb_show_no_horizon_of_their_own() -> None:
    path = DATA / "limb/opssat1_2020-08-16T062350.png"
    if not path.exists():
        pytest.skip("needs ../shared/data/limb")
    pixels = read_image(path)
    for top, left in ((1200, 0), (1200, 1024), (1400, 500)):
        crop = pixels[top : top + 544, left : left + 1024]
        camera = Pinhole.from_field_of_view(1024, 544, np.radians(6.4))
        found = find_nadir(crop, camera, HorizonKnowledge(altitude=515e3))
        assert found.status is not HorizonStatus.FOUND


@pytest.mark.parametrize("field", [4.0, 8.0, 12.8, 16.0, 30.0, 67.0])
def test_a_bright_day_sky_over_ground_shows_no_horizon(field: float) -> None:
    """A photograph of an aircraft, with a bright sky above dark textured ground, shows no horizon."""
    path = DATA / "limb/day_sky_uav.jpg"
    if not path.exists():
        pytest.skip("needs ../shared/data/limb")
    pixels = read_image(path)
    for picture in (pixels, pixels[::-1], pixels.T):
        rows, columns = picture.shape
        camera = Pinhole.from_field_of_view(columns, rows, np.radians(field))
        for altitude in (None, 350e3, 515e3):
            found = find_nadir(picture, camera, HorizonKnowledge(altitude=altitude))
            assert found.status is HorizonStatus.NO_HORIZON, (altitude, found.reason)
