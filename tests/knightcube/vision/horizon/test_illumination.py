"""Tests that false images contradict a known attitude, and that true images never contradict it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray, Image, tangent_basis
from knightcube.astro.quaternion import attitude_matrix, normalise
from knightcube.vision.camera.lens import MountedCamera, Pinhole
from knightcube.vision.horizon.edges import Samples
from knightcube.vision.horizon.illumination import (
    ImageBrightness,
    agreement,
    coarse_nadir,
    image_brightness,
    why_false,
    why_not_space,
)
from knightcube.vision.horizon.limb import MEAN_RADIUS, LimbView, mean_sphere
from knightcube.vision.horizon_camera_job import SUNLIT_COUNTS
from sim_hal.earth_camera import EarthCameraModel, EarthScene, render
from sim_hal.emulators.camera import SPOILT

PINHOLE = Pinhole.from_field_of_view(128, 128, math.radians(80.0))
CAMERA = MountedCamera(PINHOLE, np.array([0.0, 0.0, 0.0, 1.0]))
AWAY = 1.496e11
ERROR = math.radians(0.3)
"""Error (rad per axis) of the attitude in the tests of images."""


def _samples(rays: FloatArray, bright: bool) -> Samples:
    """Return samples at `rays` (m, 3), all bright or all dark."""
    count = len(rays)
    return Samples(rays, np.full(count, bright), np.full(count, float(bright)), np.zeros(count), 0.0, 0.0)


def view(seed: int) -> tuple[Image, FloatArray, float, FloatArray]:
    """Return an image at a random position and attitude, with the assumed nadir, altitude and Sun."""
    draw = np.random.default_rng(seed)
    attitude = normalise(draw.normal(size=4))
    up, sun = (vector / np.linalg.norm(vector) for vector in draw.normal(size=(2, 3)))
    altitude = float(draw.uniform(350e3, 900e3))
    model = EarthCameraModel(lens=PINHOLE, rows=128, columns=128, seed=seed)
    scene = EarthScene(
        (MEAN_RADIUS + altitude) * up, attitude, AWAY * sun, rotation=float(draw.uniform(0.0, 2.0 * np.pi))
    )
    turn = attitude_matrix(normalise(np.append(0.5 * ERROR * draw.normal(size=3), 1.0)))
    believed = turn @ attitude_matrix(attitude)
    return render(model, scene, draw), believed @ -up, altitude, believed @ sun


def judged(picture: Image, nadir: FloatArray, altitude: float, sun: FloatArray) -> str:
    return why_false(image_brightness(picture, CAMERA, SUNLIT_COUNTS), nadir, altitude, sun)


def test_no_sound_image_is_judged_false() -> None:
    assert [seed for seed in range(60) if judged(*view(seed))] == []


@pytest.mark.parametrize(
    ("fault", "least"), [("black", 6), ("saturated", 30), ("blinded", 30), ("garbage", 30)]
)
def test_images_of_a_broken_camera_are_judged_false(fault: str, least: int) -> None:
    """Images of a broken camera are found to be false in many of the 60 views.

    The other views show only the night side, or space near the Sun.
    """
    views = [view(seed) for seed in range(60)]
    false = [bool(judged(np.asarray(SPOILT[fault](one[0], 1)), *one[1:])) for one in views]
    assert sum(false) >= least


def test_the_ground_under_the_camera_decides() -> None:
    """A nadir camera must show bright ground at noon, and dark ground on the night side."""
    down, overhead, beside = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0]), np.array([1.0, 0.0, 0.0])
    dark, lit = np.zeros((128, 128), np.uint8), np.full((128, 128), 200, np.uint8)
    assert "dark" in judged(dark, down, 500e3, overhead)
    assert judged(lit, down, 500e3, overhead) == ""
    assert judged(dark, down, 500e3, down) == "", "the Sun is beneath the ground"
    assert judged(dark, overhead, 500e3, beside) == "", "the camera sees the sky"
    assert "bright" in judged(lit, overhead, 500e3, beside)


ALTITUDE = 500e3
LIMB = math.asin(MEAN_RADIUS / (MEAN_RADIUS + ALTITUDE))
DOWN = np.array([0.0, 0.0, 1.0])


def at(angle: float, count: int = 1) -> FloatArray:
    """Return rays (count, 3) at an `angle` (rad) from nadir."""
    return np.tile([math.sin(angle), 0.0, math.cos(angle)], (count, 1))


def ground_angle(angle: float) -> float:
    """Return the angle (rad) at the Earth's centre between nadir and the ground at `angle` from nadir."""
    return math.asin(math.sin(angle) * (1.0 + ALTITUDE / MEAN_RADIUS)) - angle


def sun_at(elevation: float, angle: float) -> FloatArray:
    """Return the Sun (3,) at an `elevation` (rad) above the ground seen at the `angle` (rad) from nadir."""
    zenith = ground_angle(angle) - (0.5 * math.pi - elevation)
    # The normal of the ground is opposite to nadir, rotated by the angle at the Earth's centre.
    return np.array([math.sin(zenith), 0.0, -math.cos(zenith)])


@pytest.mark.parametrize(("elevation_deg", "false"), [(19.0, False), (21.0, True)])
def test_dark_ground_is_false_under_a_sun_of_twenty_degrees(elevation_deg: float, false: bool) -> None:
    look = ImageBrightness(at(0.5, 8), np.zeros(8, dtype=bool))
    sun = sun_at(math.radians(elevation_deg), 0.5)
    assert bool(why_false(look, DOWN, ALTITUDE, sun)) is false


@pytest.mark.parametrize(("elevation_deg", "false"), [(-16.0, False), (-18.0, True)])
def test_bright_ground_is_false_in_the_night_beyond_twilight(elevation_deg: float, false: bool) -> None:
    look = ImageBrightness(at(0.5, 8), np.ones(8, dtype=bool))
    sun = sun_at(math.radians(elevation_deg), 0.5)
    assert bool(why_false(look, DOWN, ALTITUDE, sun)) is false


@pytest.mark.parametrize(
    ("beyond_deg", "bright", "false"),
    [(4.0, True, False), (6.0, True, True), (-4.0, False, False), (-6.0, False, True)],
)
def test_five_degrees_on_either_side_of_the_limb_are_excluded(
    beyond_deg: float, bright: bool, false: bool
) -> None:
    look = ImageBrightness(at(LIMB + math.radians(beyond_deg), 8), np.full(8, bright))
    assert bool(why_false(look, DOWN, ALTITUDE, -DOWN)) is false


@pytest.mark.parametrize(
    ("wrong", "count", "false"), [(7, 7, False), (8, 8, True), (6, 10, False), (7, 10, True)]
)
def test_most_of_eight_samples_must_contradict(wrong: int, count: int, false: bool) -> None:
    look = ImageBrightness(at(0.3, count), np.arange(count) >= wrong)
    assert bool(why_false(look, DOWN, ALTITUDE, -DOWN)) is false
    sky = ImageBrightness(at(2.0, count), np.arange(count) < wrong)
    assert bool(why_false(sky, DOWN, ALTITUDE, -DOWN)) is false


@pytest.mark.parametrize(("apart_deg", "false"), [(24.0, False), (26.0, True)])
def test_stray_light_of_the_sun_excuses_a_bright_sky(apart_deg: float, false: bool) -> None:
    look = ImageBrightness(at(2.0, 8), np.ones(8, dtype=bool))
    sun = at(2.0 + math.radians(apart_deg))[0]
    assert bool(why_false(look, DOWN, ALTITUDE, sun)) is false


@pytest.mark.parametrize(
    ("angle", "elevation_deg", "dark", "lit"),
    [
        (0.5, 7.0, 0, 0),
        (0.5, 9.0, 0, 1),
        (0.5, -11.0, 0, 0),
        (0.5, -13.0, 1, 0),
        (LIMB - 0.009, 40.0, 0, 0),
        (LIMB - 0.011, 40.0, 0, 1),
        (LIMB + 0.022, 40.0, 0, 0),
        (LIMB + 0.026, 40.0, 1, 0),
    ],
)
def test_samples_are_compared_by_day_by_night_and_above_the_air(
    angle: float, elevation_deg: float, dark: int, lit: int
) -> None:
    """Samples are compared on lit ground, on dark ground, and in the sky above the atmosphere.

    The atmosphere extends 60 km above a limb at a distance of 2,575 km, which is an angle of 0.0233 rad.
    """
    view = LimbView(np.eye(3), -(MEAN_RADIUS + ALTITUDE) * DOWN, mean_sphere(), 0.0)
    sun = sun_at(math.radians(elevation_deg), min(angle, LIMB - 1e-9))
    for bright in (True, False):
        found = agreement(view, sun, _samples(at(angle), bright))
        assert (found.dark_samples, found.lit_samples) == (dark, lit)
        assert (found.stray, found.missing) == (float(bright and dark == 1), float(not bright and lit == 1))


@pytest.mark.parametrize(("apart_deg", "count"), [(11.0, 0), (13.0, 1)])
def test_the_surroundings_of_the_sun_are_not_compared(apart_deg: float, count: int) -> None:
    view = LimbView(np.eye(3), -(MEAN_RADIUS + ALTITUDE) * DOWN, mean_sphere(), 0.0)
    sun = at(2.0 + math.radians(apart_deg))[0]
    assert agreement(view, sun, _samples(at(2.0), True)).dark_samples == count
    assert agreement(view, None, _samples(at(2.0), True)).dark_samples == 1


@pytest.mark.parametrize(("spread_deg", "stray"), [(6.0, False), (60.0, True)])
def test_the_glare_of_an_unknown_sun_is_not_stray_light_but_scattered_samples_are(
    spread_deg: float, stray: bool
) -> None:
    """Bright samples close together may be the glare of an unknown Sun.

    Scattered bright samples are stray light. Twelve of 400 samples of a dark sky are bright.
    """
    view = LimbView(np.eye(3), -(MEAN_RADIUS + ALTITUDE) * DOWN, mean_sphere(), 0.0)
    draw = np.random.default_rng(4)
    sky = normalise(at(2.2) + 0.8 * draw.standard_normal((400, 3)))
    sky = sky[np.arccos(sky @ DOWN) > 1.5]
    near = np.argsort(-(sky @ at(2.2)[0]))
    apart = np.arccos(np.clip(sky[near] @ at(2.2)[0], -1.0, 1.0))
    chosen = near[apart > math.radians(0.5 * spread_deg) if stray else apart >= 0.0][:12]
    bright = np.isin(np.arange(len(sky)), chosen)
    samples = Samples(sky, bright, bright.astype(float), np.zeros(len(sky)), 0.0, 0.0)
    assert (agreement(view, None, samples).stray > 0.02) is stray


def test_a_bright_band_in_the_sky_is_stray_light_although_it_is_as_small_as_a_glare() -> None:
    """A bright band in the sky is stray light, although its area is not larger than the area of a glare.

    The band is 4 deg wide and 20 deg long, and the samples are 1 deg apart.
    """
    view = LimbView(np.eye(3), -(MEAN_RADIUS + ALTITUDE) * DOWN, mean_sphere(), 0.0)
    middle = at(2.2)[0]
    first, second = tangent_basis(middle)
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(-19.5, 20.0), np.arange(-19.5, 20.0)))
    sky = normalise(middle + np.radians(x)[:, None] * first + np.radians(y)[:, None] * second)
    for bright, stray in ((np.hypot(x, y) < 5.0, 0.0), ((np.abs(x) < 2.0) & (np.abs(y) < 10.0), 0.05)):
        samples = Samples(sky, bright, bright.astype(float), np.zeros(len(sky)), 0.0, 0.0)
        assert agreement(view, None, samples).stray == pytest.approx(stray, abs=1e-6)


def test_samples_all_around_give_a_coarse_nadir_with_the_error_of_its_grid() -> None:
    """Samples in all directions give a coarse nadir with the error of its search grid.

    In 800 evenly spread directions with the Sun overhead, the ground is bright and the sky is dark.
    """
    number = np.arange(800) + 0.5
    z, turn = 1.0 - 2.0 * number / 800, math.pi * (3.0 - math.sqrt(5.0)) * number
    rays = np.column_stack([np.sqrt(1.0 - z**2) * np.cos(turn), np.sqrt(1.0 - z**2) * np.sin(turn), z])
    nadir = normalise(np.array([0.3, -0.5, 0.8]))
    bright = rays @ nadir > math.cos(LIMB)
    found = coarse_nadir([ImageBrightness(rays, bright)], ALTITUDE, -nadir)
    assert found is not None
    error = math.acos(min(1.0, float(found.direction @ nadir)))
    assert math.degrees(error) < 2.0
    # A grid of directions 4.5 deg apart has a rounding error of 4.5 / sqrt(12) deg per axis.
    assert found.sigma > math.radians(4.5 / math.sqrt(12.0))
    assert error < 2.0 * found.sigma < math.radians(6.0)
    assert found.covariance @ found.direction == pytest.approx(np.zeros(3), abs=1e-6)
    assert 0.9 < found.explained < 1.0
    # If the Sun direction is unknown, a dark sample may be ground.
    blind = coarse_nadir([ImageBrightness(rays, bright)], ALTITUDE)
    assert blind is not None
    assert blind.explained < found.explained
    assert coarse_nadir([ImageBrightness(rays, np.zeros(800, dtype=bool))], ALTITUDE, -nadir) is None
    few = [ImageBrightness(nadir[None], np.ones(1, dtype=bool))]
    assert coarse_nadir(few, ALTITUDE, -nadir) is None, "one sample leaves most of the sky"


def test_the_samples_of_an_image_stand_in_the_middle_of_its_cells() -> None:
    """In cells of 16 px, the samples are the rays of the pixels 8, 24, ... in columns and rows."""
    image = np.zeros((128, 128), np.uint8)
    image[:64, 40] = 31
    image[64:, 40] = 30
    look = image_brightness(image, CAMERA, 30.0)
    places = np.stack(np.meshgrid(np.arange(8, 128, 16), np.arange(8, 128, 16), indexing="ij"), axis=-1)
    points = places.reshape(-1, 2).astype(float)
    assert look.rays == pytest.approx(PINHOLE.unit_vectors(points))
    assert look.bright.tolist() == ((points[:, 0] == 40.0) & (points[:, 1] < 64.0)).tolist()
    assert look.share == 4.0 / 64.0


@pytest.mark.parametrize(
    ("level", "mottle", "noise", "floor", "complaint"),
    [
        (0.0, 0.0, 0.0, 0.0, ""),
        (0.1, 0.0, 0.0, 0.3, ""),
        (0.0, 0.03, 0.02, 0.0, ""),
        (0.2, 0.0, 0.0, 0.0, "median brightness of 20 %"),
        (0.05, 0.03, 0.01, 0.0, "texture of 3.0 %"),
        (0.0, 0.0, 0.0, 0.4, "darkest pixels have 40 %"),
    ],
    ids=("black", "stray light", "noise", "bright", "ground", "haze"),
)
def test_space_is_dark_and_has_no_texture_beyond_the_noise(
    level: float, mottle: float, noise: float, floor: float, complaint: str
) -> None:
    assumed = LimbView(np.eye(3), -(MEAN_RADIUS + ALTITUDE) * DOWN, mean_sphere(), 0.0)
    angles = LIMB + np.linspace(0.1, 0.5, 40)
    rays = np.concatenate([at(float(angle)) for angle in angles] + [at(0.3)] * 100)
    draw = np.random.default_rng(2)
    # A quarter of the sky has bright structure. The ground below the limb is bright and has texture.
    levels = np.where(np.arange(len(rays)) < 10, 1.0, np.where(np.arange(len(rays)) < 40, level, 1.0))
    texture = np.where(np.arange(len(rays)) < 40, 0.6745 * mottle * draw.choice([-1.0, 1.0], len(rays)), 1.0)
    samples = Samples(rays, levels > 0.3, levels, texture, noise, floor)
    found = why_not_space(assumed, None, samples, 1e-4)
    assert (found == "") == (complaint == "")
    assert complaint in found


def test_an_image_that_the_structure_hides_contradicts_nothing() -> None:
    hidden = np.ones((CAMERA.lens.rows, CAMERA.lens.columns), dtype=bool)
    look = image_brightness(np.full(hidden.shape, 200), CAMERA, SUNLIT_COUNTS, hidden)
    assert why_false(look, DOWN, ALTITUDE, -DOWN) == ""
