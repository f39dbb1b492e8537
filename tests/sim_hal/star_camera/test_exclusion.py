"""Tests of Sun and Earth in the field of view, and of the Earth between the camera and an object."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.figure import EARTH_RADIUS
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT
from knightcube.vision.camera.lens import Pinhole
from sim_hal.star_camera.objects import hidden_by_earth
from tests.support.exclusion import boresights, earth_in_field, in_field, sun_in_field

HALF = np.radians(10.0)
CAMERA = np.array([[0.0, EARTH_RADIUS + 380e3, 0.0]])
SUN = np.array([[ASTRONOMICAL_UNIT, 0.0, 0.0]])


def _tilted(axis: FloatArray, towards: FloatArray, degrees: float) -> FloatArray:
    angle = np.radians(degrees)
    return np.asarray(np.cos(angle) * axis + np.sin(angle) * towards)


def test_the_boresight_is_the_cameras_z_through_its_mounting() -> None:
    """The boresight is the camera's axis z, rotated by the mounting.

    As in the errata to 2.16, the camera looks along body x, and the body is rotated by 90 deg about z.
    """
    body = quaternion.from_rotation_vector(np.array([[0.0, 0.0, 0.5 * np.pi]]))
    rows = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    mounting = quaternion.from_matrix(rows)
    assert boresights(body)[0] == pytest.approx([0.0, 0.0, 1.0])
    assert boresights(body, mounting)[0] == pytest.approx([0.0, 1.0, 0.0], abs=1e-12)


def _below_horizontal(degrees: float) -> tuple[float, float, float]:
    angle = np.radians(degrees)
    return (5e6 * np.cos(angle), EARTH_RADIUS + 380e3 - 5e6 * np.sin(angle), 0.0)


@pytest.mark.parametrize(
    ("degrees", "excluded"), [(0.0, True), (10.26, True), (10.27, False), (170.0, False)]
)
def test_the_sun_spoils_a_frame_to_its_limb(degrees: float, excluded: bool) -> None:
    """A frame is spoilt if any part of the Sun's disc is in the field of view.

    The limit is half the field plus the Sun's radius of 0.2666 deg. The parallax of the Sun is at most 10".
    """
    boresight = _tilted(SUN / ASTRONOMICAL_UNIT, np.array([[0.0, 0.0, 1.0]]), degrees)
    assert sun_in_field(boresight, np.zeros((1, 3)), SUN, HALF)[0] == excluded


def test_the_sun_is_seen_from_the_camera_not_from_the_earths_centre() -> None:
    """The Sun is seen from the camera, not from the Earth's centre.

    At a distance of 4 million km from the Earth, the Sun is displaced by 1.5 deg.
    """
    aside = np.array([[0.0, 4e9, 0.0]])
    boresight = _tilted(SUN / ASTRONOMICAL_UNIT, np.array([[0.0, -1.0, 0.0]]), 11.0)
    assert sun_in_field(boresight, aside, SUN, HALF)[0]
    assert not sun_in_field(boresight, -aside, SUN, HALF)[0]


@pytest.mark.parametrize("above_limb", [9.9, 10.1, 25.0])
def test_the_earth_spoils_a_frame_to_its_limb(above_limb: float) -> None:
    """A frame is spoilt if the Earth's limb is in the field of view.

    At 380 km the horizon is 19.3 deg below the horizontal (Meller et al. 4.1: "20 deg").
    """
    dip = np.degrees(np.arccos(EARTH_RADIUS / np.linalg.norm(CAMERA)))
    assert dip == pytest.approx(19.3, abs=0.1)
    horizontal, up = np.array([[0.0, 0.0, 1.0]]), np.array([[0.0, 1.0, 0.0]])
    boresight = _tilted(horizontal, up, above_limb - dip)
    assert earth_in_field(boresight, CAMERA, HALF)[0] == (above_limb < 10.0)


def test_a_buffer_widens_both() -> None:
    boresight = _tilted(SUN / ASTRONOMICAL_UNIT, np.array([[0.0, 1.0, 0.0]]), 15.0)
    assert not sun_in_field(boresight, CAMERA, SUN, HALF)[0]
    assert sun_in_field(boresight, CAMERA, SUN, HALF, buffer=np.radians(6.0))[0]
    assert not earth_in_field(boresight, CAMERA, HALF)[0]
    assert earth_in_field(boresight, CAMERA, HALF, buffer=np.radians(25.0))[0]


@pytest.mark.parametrize(
    ("target", "hidden"),
    [
        ((0.0, -7e6, 0.0), True),
        ((0.0, 9e6, 0.0), False),
        ((7e6, 0.0, 0.0), True),
        # Objects at a distance of 5000 km, 0.1 deg below and above the horizon, whose dip is 19.3 deg.
        (_below_horizontal(19.4), True),
        (_below_horizontal(19.2), False),
        # The object is straight below the camera, but above the ground, so the Earth does not hide it.
        ((0.0, EARTH_RADIUS + 1000.0, 0.0), False),
    ],
)
def test_the_earth_hides_what_is_behind_it(target: tuple[float, float, float], hidden: bool) -> None:
    """An object is hidden exactly if the line of sight to it passes through the Earth.

    The reference is the smallest distance from the Earth's centre of 100,000 points on the line.
    """
    end = np.array([target])
    way = CAMERA + np.linspace(0.0, 1.0, 100_001)[:, None] * (end - CAMERA)
    assert (np.linalg.norm(way, axis=1).min() < EARTH_RADIUS) == hidden
    assert hidden_by_earth(CAMERA, end)[0] == hidden
    assert hidden_by_earth(end, CAMERA)[0] == hidden


def test_the_field_ends_at_the_detectors_edge() -> None:
    pinhole = Pinhole.from_field_of_view(1024, 1024, 2.0 * HALF)
    attitude = quaternion.from_rotation_vector(np.array([0.3, -0.2, 0.9]))
    points = np.array([[511.5, 511.5], [-0.4, 511.5], [-0.6, 511.5], [1023.4, 1023.4], [1023.6, 1023.4]])
    seen = pinhole.unit_vectors(points) @ quaternion.attitude_matrix(attitude)
    attitudes = np.tile(attitude, (len(points), 1))
    assert in_field(pinhole, attitudes, seen).tolist() == [True, True, False, True, False]
    assert in_field(pinhole, attitudes, seen, margin=1.0).all()
    assert not in_field(pinhole, attitudes, -seen).any()
