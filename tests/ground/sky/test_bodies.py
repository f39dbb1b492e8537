"""Sun, Moon and planets of a picture, against published places."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ground.sky.bodies import bodies_in, directions_of_bodies
from knightcube.astro.arrays import FloatArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.startracker.sky_map import Pointing, SkyMap

# Julian date TT of the great conjunction, 2020 December 21, 18:20 UTC: 6.1' apart, by the almanacs.
_CONJUNCTION = 2_459_205.264
# Of the total eclipse of 2024 April 8: greatest at 18:17 UTC, gamma 0.3431 radii of the Earth.
_ECLIPSE = 2_460_409.263


def _apart_deg(one: FloatArray, other: FloatArray) -> float:
    return math.degrees(math.atan2(float(np.linalg.norm(np.cross(one, other))), float(one @ other)))


def test_jupiter_and_saturn_meet_on_the_day_of_the_great_conjunction() -> None:
    found = directions_of_bodies(_CONJUNCTION)
    assert _apart_deg(found["Jupiter"], found["Saturn"]) == pytest.approx(6.1 / 60.0, abs=1.5 / 60.0)


def test_the_moon_is_before_the_sun_at_an_eclipse() -> None:
    """Seen from the Earth's centre they are gamma times the Moon's parallax, about 1 deg, apart."""
    found = directions_of_bodies(_ECLIPSE)
    assert _apart_deg(found["Sun"], found["Moon"]) == pytest.approx(0.343 * 0.998, abs=0.05)


def test_a_picture_of_the_conjunction_shows_both_planets_and_no_other() -> None:
    x, y, z = directions_of_bodies(_CONJUNCTION)["Jupiter"]
    attitude = Pointing(math.atan2(y, x), math.asin(z), 0.3).quaternion()
    camera = Pinhole.from_field_of_view(640, 480, math.radians(3.0))
    found = bodies_in(SkyMap(camera, attitude), _CONJUNCTION)
    assert [body.name for body in found] == ["Jupiter", "Saturn"]
    assert found[0].point == pytest.approx(camera.centre, abs=0.1)
