"""Tests of Sun, Moon and planets in an image, and of its world coordinates."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ground.sky import _coordinates, bodies_in, directions_of_bodies, header_text
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix, normalise
from knightcube.vision.camera.lens import Lens, Pinhole
from knightcube.vision.startracker.sky_map import Pointing, SkyMap
from tests.support.scenes import catalogue

# Julian date (TT) of the great conjunction of Jupiter and Saturn, 2020 December 21, 18:20 UTC. The almanacs
# give a separation of 6.1'.
_CONJUNCTION = 2_459_205.264
# The total eclipse of 2024 April 8 is greatest at 18:17 UTC, with a gamma of 0.3431 Earth radii.
_ECLIPSE = 2_460_409.263


def _apart_deg(one: FloatArray, other: FloatArray) -> float:
    return math.degrees(math.atan2(float(np.linalg.norm(np.cross(one, other))), float(one @ other)))


def test_jupiter_and_saturn_meet_on_the_day_of_the_great_conjunction() -> None:
    found = directions_of_bodies(_CONJUNCTION)
    assert _apart_deg(found["Jupiter"], found["Saturn"]) == pytest.approx(6.1 / 60.0, abs=1.5 / 60.0)


def test_a_right_ascension_is_below_360_deg() -> None:
    assert _coordinates(np.array([1.0, -1e-17, 0.0]))["right_ascension_deg"] == 0.0


def test_the_moon_is_before_the_sun_at_an_eclipse() -> None:
    """At an eclipse, Sun and Moon are separated by gamma times the Moon's parallax, which is about 1 deg.

    The separation is that seen from the Earth's centre.
    """
    found = directions_of_bodies(_ECLIPSE)
    assert _apart_deg(found["Sun"], found["Moon"]) == pytest.approx(0.343 * 0.998, abs=0.05)


def test_a_picture_of_the_conjunction_shows_both_planets_and_no_other() -> None:
    x, y, z = directions_of_bodies(_CONJUNCTION)["Jupiter"]
    attitude = Pointing(math.atan2(y, x), math.asin(z), 0.3).quaternion()
    camera = Pinhole.from_field_of_view(640, 480, math.radians(3.0))
    found = bodies_in(SkyMap(camera, attitude), _CONJUNCTION)
    assert [body.name for body in found] == ["Jupiter", "Saturn"]
    assert found[0].point == pytest.approx(camera.centre, abs=0.1)
    # In the mirrored image, Saturn is on the other side of Jupiter.
    back = bodies_in(SkyMap(camera, attitude, mirrored=True), _CONJUNCTION)
    assert [body.name for body in back] == ["Jupiter", "Saturn"]
    assert back[1].point == pytest.approx([639.0 - found[1].point[0], found[1].point[1]], abs=1e-6)


fits = pytest.importorskip("astropy.io.fits", reason="astropy is of the extra `test`")
wcs = pytest.importorskip("astropy.wcs", reason="astropy is of the extra `test`")

# Astropy warns about FITS headers without an image, which some star solvers write.
pytestmark = pytest.mark.filterwarnings("ignore:The WCS transformation has more axes")

_LENS = Lens(1280, 960, 4000.0, (655.0, 470.0), k1=-0.3, k2=0.4)
_ARCSECONDS = 3600.0


def _sky(seed: int) -> SkyMap:
    return SkyMap(_LENS, normalise(np.random.default_rng(seed).normal(size=4)))


def _stars(sky: SkyMap) -> tuple[FloatArray, FloatArray]:
    """Return right ascension and declination (n, 2), deg, of stars in the picture, and their pixels.

    The pixels are computed by the camera's projection, which the code that makes the header does not use.
    """
    _, directions = catalogue(8.5)
    place = _LENS.project(directions @ attitude_matrix(sky.quaternion).T)
    inside = _LENS.contains(place)
    x, y, z = directions[inside].T
    return np.degrees(np.stack([np.arctan2(y, x) % (2.0 * np.pi), np.arcsin(z)], axis=1)), place[inside]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_astropy_finds_the_stars_where_they_are(seed: int) -> None:
    """The conversions from pixel to sky and back agree to 0.1" and 0.01 px over the whole distorted image."""
    sky = _sky(seed)
    header = fits.Header.fromstring(header_text(sky))
    frame = wcs.WCS(header)
    radec, place = _stars(sky)
    assert len(place) > 20
    found = frame.all_pix2world(place, 0)
    turned = (found[:, 0] - radec[:, 0] + 180.0) % 360.0 - 180.0
    off = np.stack([turned * np.cos(np.radians(radec[:, 1])), found[:, 1] - radec[:, 1]])
    assert np.abs(off).max() * _ARCSECONDS < 0.1
    assert np.abs(frame.all_world2pix(radec, 0) - place).max() < 0.01


def test_a_header_without_the_distortion_has_errors_of_more_than_a_pixel() -> None:
    """Without the SIP polynomials of the distortion, the errors at the corners are several px."""
    sky = _sky(1)
    plain = wcs.WCS(fits.Header.fromstring(header_text(sky)))
    radec, place = _stars(sky)
    assert np.abs(plain.wcs_world2pix(radec, 0) - place).max() > 1.0


@pytest.mark.parametrize(("mirrored", "reversed_rows"), [(True, False), (False, True), (True, True)])
def test_the_header_is_of_the_pixels_of_the_file(mirrored: bool, reversed_rows: bool) -> None:
    """In a mirrored image, the determinant of the CD matrix has the opposite sign."""
    plain = _sky(2)
    radec, place = _stars(plain)
    if mirrored:
        place = np.array([2.0 * _LENS.centre[0], 0.0]) + place * np.array([-1.0, 1.0])
    sky = SkyMap(_LENS, plain.quaternion, mirrored=mirrored)
    directions = sky.directions(place)
    assert np.abs(sky.pixels(directions) - place).max() < 1e-6
    in_file = np.array([0.0, _LENS.rows - 1.0]) + place * np.array([1.0, -1.0]) if reversed_rows else place
    header = fits.Header.fromstring(header_text(sky, reversed_rows))
    assert np.abs(wcs.WCS(header).all_world2pix(radec, 0) - in_file).max() < 0.01
    determinant = header["CD1_1"] * header["CD2_2"] - header["CD1_2"] * header["CD2_1"]
    assert (determinant < 0.0) == (mirrored != reversed_rows)
