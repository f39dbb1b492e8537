"""Real photographs: the brightest detections are stars of the catalogue, where the truth says they are."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from knightcube.astro import catalogue
from knightcube.astro.arrays import FloatArray
from knightcube.vision.camera.images import read_image
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.startracker.detection import FrameKind, detect, kind_of_frame

SKY = Path(__file__).parents[5].parent / "shared" / "data" / "sky"
_TOLERANCE = 0.007
"""Of the frame's width: the lenses' distortion is not taken out."""
_AMONG = 80

pytestmark = pytest.mark.skipif(not SKY.is_dir(), reason="the photographs of ../shared/data/sky are missing")


def catalogue_places(truth: dict[str, float], shape: tuple[int, ...]) -> FloatArray:
    """Return the pixels of the brightest stars in the field, by cedar-solve's convention of roll."""
    ra, dec, roll = (np.radians(truth[name]) for name in ("ra", "dec", "roll"))
    boresight = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    north = np.cross(boresight, east)
    right = -east * np.cos(roll) - north * np.sin(roll)
    down = east * np.sin(roll) - north * np.cos(roll)
    stars = catalogue.load()
    camera = stars.directions_at(2019.0) @ np.stack([right, down, boresight]).T
    pinhole = Pinhole.from_field_of_view(shape[1], shape[0], float(np.radians(truth["fov"])))
    places = pinhole.project(camera)
    return places[pinhole.contains(places)][:_AMONG]


@pytest.mark.parametrize(
    "name",
    [
        "esa_alt40_azi-135.tiff",
        "esa_alt40_azi45.tiff",
        "esa_alt60_azi135.tiff",
        "hale_bopp.jpg",
        "orion2.jpg",
        "pleiades.jpg",
        "polar_05sec.jpg",
        "test2_g100_e50ms.jpg",
    ],
)
def test_nearly_all_of_the_twenty_brightest_detections_are_bright_catalogue_stars(name: str) -> None:
    pixels = read_image(SKY / name)
    found = detect(pixels).stars()
    places = catalogue_places(json.loads((SKY / "truth.json").read_text())[name], pixels.shape)
    apart = np.linalg.norm(found.points[:20, None] - places, axis=-1).min(axis=1)
    assert np.count_nonzero(apart < max(4.0, _TOLERANCE * pixels.shape[1])) >= 15
    assert kind_of_frame(pixels).kind is FrameKind.POINTS


def test_leaves_are_not_among_the_stars() -> None:
    """The tree fills the picture's upper right corner."""
    found = detect(read_image(SKY / "tree.jpg")).stars()
    in_tree = (found.points[:, 0] > 310.0) & (found.points[:, 1] < 310.0)
    assert np.count_nonzero(in_tree[:20]) <= 5
    assert np.count_nonzero(~in_tree) >= 14
    assert kind_of_frame(read_image(SKY / "tree.jpg")).kind is not FrameKind.STREAKS


def test_a_noisy_raw_frame_gives_few_false_stars_and_a_dark_one_too() -> None:
    for name in ("may8_50ms_gain40_0.png", "may8_100ms_gain12_3.png"):
        assert 5 <= len(detect(read_image(SKY / name)).stars()) <= 60
