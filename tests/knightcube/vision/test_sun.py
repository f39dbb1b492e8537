"""Tests of the Sun direction from simulated frames of one or several cameras, with and without the Sun.

Solar strings select the camera that is read. If no camera finds the Sun, the strings give the Sun direction.
"""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from flight.schema.devices import WideCamera
from knightcube.astro.arrays import FloatArray, Image, tangent_basis
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT
from knightcube.astro.quaternion import from_matrix, from_rotation_vector
from knightcube.errors import UsageError
from knightcube.vision import sun as sun_module
from knightcube.vision.camera.lens import MountedCamera, Pinhole
from knightcube.vision.horizon.initial_guess import shortest_turn
from knightcube.vision.solar_cells import CoarseSun, CoarseSunStatus, SolarStringModel, coarse_sun
from knightcube.vision.sun import (
    LINEAR,
    Circle,
    SunMeasurement,
    SunSettings,
    SunStatus,
    cameras_by_sun,
    find_sun,
    fit_circle,
    sample,
    sun_of_cameras,
)
from sim_hal.assembly import wide_model
from sim_hal.earth_camera import EarthCameraModel, EarthScene, render
from tests.sim_hal.earth_camera.scenes import LOW, pointing, random_sun_scene
from tests.support.earth_truth import sun_direction
from tests.support.sun_frames import CAMERAS, Outcome, frames_with_sun, frames_without_sun

MODEL, SETTINGS = CAMERAS["logarithmic"]
CAMERA = Pinhole.from_field_of_view(512, 512, np.radians(67.0))


@cache
def _campaign(name: str) -> Outcome:
    """Return the results for frames with the Sun."""
    return frames_with_sun(name, 12, seed=11)


@pytest.mark.parametrize(("name", "limit"), [("logarithmic", 0.005), ("linear", 0.01)])
def test_the_sun_is_found_to_hundredths_of_a_degree_at_any_position_in_the_frame(
    name: str, limit: float
) -> None:
    """The Sun is found to hundredths of a degree at any position in the frame.

    A pixel is 0.15 deg, and the core of the Sun's disc is saturated in both cameras. The test uses twelve
    frames of seed 11.
    """
    outcome = _campaign(name)
    assert outcome.statuses["found"] + outcome.statuses["partial"] >= 11
    assert np.degrees(np.sqrt(np.mean(np.square(outcome.errors)))) < limit


@pytest.mark.parametrize("name", ["logarithmic", "linear"])
def test_the_covariance_is_honest(name: str) -> None:
    """The normalised squared errors agree with the covariance.

    The mean of 12 chi-squares with two degrees of freedom is below 4.3 in 99.9 % of cases.
    """
    squares = _campaign(name).squares
    assert np.mean(squares) < 4.3
    assert max(squares) < 25.0


@pytest.mark.parametrize("name", list(CAMERAS))
def test_no_sun_is_found_in_frames_without_the_sun(name: str) -> None:
    """No Sun is found in frames that show limb, clouds and hot pixels.

    The frames of the overexposed camera also show large saturated clouds.

    The test uses three frames of seed 12.
    """
    outcome = frames_without_sun(name, 3, seed=12)
    assert outcome.statuses["found"] + outcome.statuses["partial"] == 0


def _space_scene(ray: FloatArray) -> EarthScene:
    """Return a scene that shows no Earth, with the Sun along `ray` (3,) in camera axes."""
    position = (6.378e6 + LOW) * np.array([0.0, 0.0, 1.0])
    attitude = pointing(np.array([0.0, 0.0, 1.0]), np.array([0.0, -1.0, 0.0]))
    empty = EarthScene(position, attitude, position + ASTRONOMICAL_UNIT * np.array([0.0, 0.0, 1.0]))
    return replace(empty, sun=position + ASTRONOMICAL_UNIT * (empty.camera_matrix.T @ ray))


def _frame_at(x: float, y: float, model: EarthCameraModel, seed: int = 1) -> tuple[Image, FloatArray]:
    ray = model.lens.unit_vectors(np.array([[x, y]]))[0]
    scene = _space_scene(ray)
    return render(model, scene, np.random.default_rng(seed)), sun_direction(scene)


def test_a_sun_cut_by_the_edge_is_found_with_a_covariance_that_grows_across_the_edge() -> None:
    """A Sun at the edge is found, with a covariance that is larger normal to the edge.

    The disc has a radius of 11 px, and its centre is 2 px inside or outside of the frame.
    """
    model, settings = CAMERAS["linear"]
    whole, _ = _frame_at(200.0, 300.0, model)
    entire = find_sun(whole, model.lens, settings).sun
    assert entire is not None
    assert not entire.cut
    for x in (2.0, -2.0):
        frame, truth = _frame_at(x, 300.0, model)
        solution = find_sun(frame, model.lens, settings)
        assert solution.status is SunStatus.PARTIAL
        assert solution.sun is not None
        assert solution.sun.sigma > max(1.2 * entire.sigma, np.radians(0.05))
        off = solution.sun.basis @ truth
        # Limit that is exceeded in one of a thousand cases.
        assert off @ np.linalg.solve(solution.sun.tangent_covariance, off) < 14.0
        assert np.degrees(np.hypot(*off)) < 0.06


def _with_reflection() -> Image:
    """Return an image of the Sun's glare, and of a larger saturated disc on the other side of the axis."""
    rays = CAMERA.unit_vectors(np.stack(np.meshgrid(np.arange(512.0), np.arange(512.0)), axis=-1))
    sun, reflection = CAMERA.unit_vectors(np.array([[180.3, 300.8], [331.0, 210.0]]))
    away = np.arccos(np.clip(rays @ sun, -1.0, 1.0))
    frame = 200.0 * (np.radians(1.6) / np.maximum(away, 1e-3)) ** 2
    frame[rays @ reflection > np.cos(np.radians(1.8))] = 255.0
    noise = np.random.default_rng(32).normal(0.0, 1.0, frame.shape)
    return np.asarray(np.clip(frame + noise, 0.0, 255.0).astype(np.uint8))


def test_the_sun_and_a_reflection_of_its_size_are_ambiguous() -> None:
    """Neither disc is reported as the Sun, and both are candidates. Solar strings decide between them."""
    frame = _with_reflection()
    solution = find_sun(frame, CAMERA)
    assert solution.status is SunStatus.AMBIGUOUS
    assert not solution
    assert len(solution.candidates) == 2
    truth = CAMERA.unit_vectors(np.array([[180.3, 300.8]]))[0]
    assert max(float(one.direction @ truth) for one in solution.candidates) > np.cos(1e-3)
    cameras = [MountedCamera(CAMERA, np.array([0.0, 0.0, 0.0, 1.0]))]
    for sigma, camera in ((0.02, 0), (0.5, None)):
        strings = CoarseSun(CoarseSunStatus.FOUND, truth, tangent_basis(truth), sigma**2 * np.eye(2))
        found = sun_of_cameras({0: frame}, cameras, strings, LINEAR)
        assert found.camera == camera
        assert found.direction is not None
        assert float(found.direction @ truth) > np.cos(1e-3)
        assert ("2 discs" in found.reason) == (camera is None)


@pytest.mark.parametrize("share", [0.0, 0.2, 0.4])
def test_glare_that_is_brighter_on_one_side_increases_the_covariance(share: float) -> None:
    """Glare that is brighter on one side by `share` displaces the disc; the covariance includes this error.

    The covariance of symmetric glare does not increase, and its error is below a hundredth of a degree.
    """
    truth = CAMERA.unit_vectors(np.array([[180.3, 300.8]]))[0]
    rays = CAMERA.unit_vectors(np.stack(np.meshgrid(np.arange(512.0), np.arange(512.0)), axis=-1))
    first = np.cross(truth, [0.0, 1.0, 0.0])
    away = np.maximum(np.degrees(np.arccos(np.clip(rays @ truth, -1.0, 1.0))), 0.1)
    aside = np.degrees(rays @ (first / np.linalg.norm(first))) / away
    glare = 200.0 * (1.6 / away) ** 2 * (1.0 + share * aside)
    noise = np.random.default_rng(31).normal(0.0, 1.0, glare.shape)
    sun = find_sun(np.clip(glare + noise, 0.0, 255.0).astype(np.uint8), CAMERA).sun
    assert sun is not None
    off = sun.basis @ truth
    assert off @ np.linalg.solve(sun.tangent_covariance, off) < 14.0
    if share == 0.0:
        assert np.degrees(sun.sigma) < 0.01
    else:
        assert np.degrees(np.linalg.norm(off)) > 0.1
        assert np.degrees(sun.sigma) < 0.5


def test_the_sun_is_found_in_the_corners_of_a_field_of_92_deg() -> None:
    """The Sun is found in the corners of a field of 92 deg.

    In the corners, a pinhole projection widens the disc to 1.7 times its width, but not the blur around it.
    """
    model = wide_model(WideCamera(columns=512, rows=512, field_of_view_deg=92.0))
    for number, (x, y) in enumerate(
        [(36.0, 40.0), (51.0, 479.0), (470.0, 38.5), (466.2, 470.7), (256.0, 30.0)]
    ):
        frame, sun = _frame_at(x, y, model, seed=number)
        found = find_sun(frame, model.lens, SETTINGS).sun
        assert found is not None
        off = found.basis @ sun
        assert np.degrees(np.linalg.norm(off)) < 0.02
        assert off @ np.linalg.solve(found.tangent_covariance, off) < 20.0


def test_the_same_sun_is_found_in_twelve_bits() -> None:
    deep = replace(MODEL, bits=12, pedestal=128.0, noise=11.0, fixed_pattern=16.0)
    frame, truth = _frame_at(300.3, 120.8, deep)
    solution = find_sun(frame, deep.lens, replace(SETTINGS, level=3200.0))
    assert solution.sun is not None
    assert np.degrees(np.linalg.norm(solution.sun.basis @ truth)) < 0.01


def test_a_sun_that_blooms_over_whole_columns_is_refused() -> None:
    """A Sun that blooms over a whole column is refused, because its patch is not round.

    The message recommends a shorter exposure.
    """
    blooming = replace(CAMERAS["linear"][0], blooming=True)
    frame, _ = _frame_at(300.3, 240.8, blooming)
    solution = find_sun(frame, blooming.lens, LINEAR)
    assert solution.status is SunStatus.NOT_THE_SUN
    assert "larger" in solution.reason


def test_without_settings_the_camera_is_a_linear_one() -> None:
    model, settings = CAMERAS["linear"]
    frame, truth = _frame_at(250.0, 250.0, model)
    found = find_sun(frame, model.lens)
    assert found
    assert settings == LINEAR
    assert found.sun is not None
    assert np.degrees(np.linalg.norm(found.sun.basis @ truth)) < 0.05
    assert not find_sun(np.zeros_like(frame), model.lens)


def test_few_pixels_are_read() -> None:
    """Few pixels are read: at first every third row, and then all rows around the Sun."""
    frame, _ = _frame_at(250.0, 250.0, MODEL)
    solution = find_sun(frame, MODEL.lens, SETTINGS)
    rows = solution.pixels_read / 512
    assert rows == int(rows)
    assert len(range(1, 512, 3)) < rows < 0.45 * 512


def test_dead_and_hot_pixels_hardly_change_the_sun_direction() -> None:
    frame, truth = _frame_at(250.2, 250.6, MODEL)
    frame = frame.copy()
    frame[251, 251] = 0
    frame[248, 258] = 255
    sun = find_sun(frame, MODEL.lens, SETTINGS).sun
    assert sun is not None
    assert np.degrees(np.linalg.norm(sun.basis @ truth)) < 0.02


def _disc_frame(radius: float, x: float = 256.0, y: float = 200.0) -> Image:
    yy, xx = np.mgrid[0:512, 0:512]
    inside = np.clip(radius + 0.5 - np.hypot(xx - x, yy - y), 0.0, 1.0)
    return np.asarray((20 + 235 * inside).astype(np.uint8))


def test_a_ragged_rim_increases_the_covariance() -> None:
    """A ragged edge of the disc increases the covariance.

    The radius of the disc varies with five periods around its edge, by 0 or 0.3 px.
    """
    y, x = np.mgrid[0:512, 0:512] - np.array([200.0, 256.0])[:, None, None]
    around = np.sin(5.0 * np.arctan2(y, x))
    sizes = []
    for amplitude in (0.0, 0.3):
        inside = np.clip(4.5 + amplitude * around + 0.5 - np.hypot(x, y), 0.0, 1.0)
        sun = find_sun((20 + 235 * inside).astype(np.uint8), CAMERA, SunSettings()).sun
        assert sun is not None
        sizes.append((sun.residual, np.trace(sun.tangent_covariance)))
    assert sizes[1][0] > 1.5 * sizes[0][0]
    assert sizes[1][1] > 3.0 * sizes[0][1]


def test_patches_that_are_too_small_too_large_or_not_round_are_refused_with_a_reason() -> None:
    for radius in (1.0, 9.0, 60.0):
        solution = find_sun(_disc_frame(radius), CAMERA, SunSettings())
        assert solution.status in (SunStatus.NOT_THE_SUN, SunStatus.NO_SUN)
        assert solution.sun is None
        assert solution.reason
    bar = np.full((512, 512), 20, dtype=np.uint8)
    bar[200:203, 100:112] = 255
    assert find_sun(bar, CAMERA, SunSettings()).sun is None
    assert find_sun(_disc_frame(3.0), CAMERA, SunSettings()).status is SunStatus.FOUND


def _sun_frame(radius_deg: float, sky: float, disc: float) -> FloatArray:
    """Return an image of `CAMERA` with a disc of `radius_deg` around pixel (256, 200)."""
    y, x = np.mgrid[0:512, 0:512] - np.array([200.0, 256.0])[:, None, None]
    inside = np.clip(np.radians(radius_deg) * CAMERA.focal_length + 0.5 - np.hypot(x, y), 0.0, 1.0)
    return np.asarray(sky + (disc - sky) * inside)


@pytest.mark.parametrize(
    ("frame", "settings", "reason"),
    [
        (
            _sun_frame(1.6, 0.05, 1.0),
            None,
            "the largest pixel value, 1, is below the level of 200: set `level`",
        ),
        (
            _sun_frame(1.6, 900.0, 6e4),
            None,
            r"deg radius at level 200, larger than `greatest_radius` of 2\.00 deg",
        ),
        (
            _sun_frame(0.3, 20.0, 250.0),
            None,
            r"at level 200, smaller than `least_radius` of 1\.30 deg, \d px wide",
        ),
        (_sun_frame(1.6, 900.0, 6e4), SunSettings(level=5e4), r"use replace\(LINEAR, level=50000\)"),
        (
            np.where(np.arange(512**2).reshape(512, 512) == 512 * 100 + 7, 255.0, 9.0),
            None,
            "fewer than 3 adjacent pixels reach the level of 200",
        ),
    ],
)
def test_the_reason_names_the_setting_that_excludes_the_sun(
    frame: FloatArray, settings: SunSettings | None, reason: str
) -> None:
    found = find_sun(frame, CAMERA, settings)
    assert not found
    assert re.search(reason, found.reason), found.reason


@pytest.mark.parametrize(("sky", "disc", "level"), [(900.0, 6e4, 5e4), (0.05, 1.0, 0.9)])
def test_the_level_of_the_linear_settings_fits_other_ranges_of_pixel_values(
    sky: float, disc: float, level: float
) -> None:
    found = find_sun(_sun_frame(1.6, sky, disc), CAMERA, replace(LINEAR, level=level))
    assert found.sun is not None
    assert np.hypot(*(found.sun.point - [256.0, 200.0])) < 0.2


def test_an_empty_and_a_full_frame_have_no_sun() -> None:
    dark = find_sun(np.zeros((512, 512), dtype=np.uint8), CAMERA, SunSettings())
    assert dark.status is SunStatus.NO_SUN
    full = find_sun(np.full((512, 512), 255, dtype=np.uint8), CAMERA, SunSettings())
    assert full.status is SunStatus.NOT_THE_SUN


def test_a_frame_of_another_size_and_settings_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="512 x 512"):
        find_sun(np.zeros((100, 512), dtype=np.uint8), CAMERA, SunSettings())
    with pytest.raises(UsageError, match="stride"):
        SunSettings(stride=0)
    with pytest.raises(UsageError, match="stride: 1024: no row of 512 is read"):
        find_sun(np.zeros((512, 512), dtype=np.uint8), CAMERA, SunSettings(stride=1024))
    with pytest.raises(UsageError, match="least_radius"):
        SunSettings(least_radius=0.02, greatest_radius=0.01)
    with pytest.raises(UsageError, match="level"):
        SunSettings(level=float("nan"))


WIDE_MODEL = EarthCameraModel.fuga15d(seed=1)
JOINT_SETTINGS = SunSettings()
DARK = np.full((512, 512), 8, dtype=np.uint8)
TURNS = np.array([[0.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, -2.0, 0.0]])
"""Mountings of three cameras, as rotation vectors (rad) from body axes to camera axes."""
MOUNTED = [MountedCamera(WIDE_MODEL.lens, from_rotation_vector(turn)) for turn in TURNS]


@pytest.fixture(scope="module")
def scene_with_sun() -> tuple[EarthScene, Image]:
    """Return a scene and an image in which camera 1 shows the Sun."""
    generator = np.random.default_rng(3)
    scene = random_sun_scene(generator, WIDE_MODEL, margin=40.0)
    return scene, render(WIDE_MODEL, scene, generator)


def _in_body(scene: EarthScene, number: int = 1) -> FloatArray:
    """Return the true Sun direction (3,), body axes, in the scene of one camera."""
    return MOUNTED[number].in_body(sun_direction(scene))


def _strings(sun: FloatArray) -> CoarseSun:
    strings = SolarStringModel()
    return coarse_sun(np.maximum(strings.normals @ sun, 0.0), strings)


def test_only_the_camera_that_the_strings_choose_is_read(scene_with_sun: tuple[EarthScene, Image]) -> None:
    scene, frame = scene_with_sun
    sun = _in_body(scene)
    found = sun_of_cameras({0: DARK, 1: frame, 2: DARK}, MOUNTED, _strings(sun), JOINT_SETTINGS)
    assert found.camera == 1
    assert list(found.each) == [1]
    assert found.direction is not None
    assert found.covariance is not None
    assert np.degrees(np.arccos(min(1.0, float(found.direction @ sun)))) < 0.02
    assert np.degrees(np.sqrt(0.5 * np.trace(found.covariance))) < 0.02


def test_the_solar_strings_give_the_direction_if_no_camera_finds_the_sun(
    scene_with_sun: tuple[EarthScene, Image],
) -> None:
    sun = _in_body(scene_with_sun[0])
    found = sun_of_cameras({0: DARK, 1: DARK, 2: DARK}, MOUNTED, _strings(sun), JOINT_SETTINGS)
    assert found.camera is None
    assert found.direction is not None
    assert found.covariance is not None
    off = np.arccos(min(1.0, float(found.direction @ sun)))
    sigma = float(np.sqrt(0.5 * np.trace(found.covariance)))
    assert np.radians(0.5) < sigma < np.radians(6.0)
    assert off < 4.0 * sigma
    assert "is below the level of 200" in found.reason


def test_a_reflection_far_from_the_strings_sun_is_not_the_sun(
    scene_with_sun: tuple[EarthScene, Image],
) -> None:
    """A reflection far from the strings' Sun direction is not taken as the Sun.

    The image with the Sun is from a camera whose field of view only just includes the coarse direction.
    """
    scene, frame = scene_with_sun
    true = MOUNTED[0].in_body(np.array([0.0, np.sin(0.5), np.cos(0.5)]))
    assert float(true @ _in_body(scene, 0)) < np.cos(0.3)
    found = sun_of_cameras({0: frame}, MOUNTED, _strings(true), JOINT_SETTINGS)
    assert found.camera is None
    assert found.reason == "camera 0: its Sun direction contradicts the solar strings"
    assert found.direction is not None
    assert float(found.direction @ true) > np.cos(0.1)


def test_a_sun_cut_by_the_frames_edge_has_a_larger_covariance(
    scene_with_sun: tuple[EarthScene, Image],
) -> None:
    """The covariance of a Sun that the edge truncates is larger.

    The error of a truncated disc is the same in every frame, up to 0.03 deg for a sigma of 0.007 deg.
    """
    scene, _ = scene_with_sun
    turn = shortest_turn(sun_direction(scene), WIDE_MODEL.lens.unit_vectors(np.array([[510.7, 300.0]]))[0])
    cut = replace(scene, attitude=from_matrix(turn @ scene.camera_matrix))
    sun, frame = _in_body(cut), render(WIDE_MODEL, cut, np.random.default_rng(4))
    found = sun_of_cameras({1: frame}, MOUNTED, _strings(sun), JOINT_SETTINGS)
    assert found.camera == 1
    assert found.each[1].status is SunStatus.PARTIAL
    assert found.direction is not None
    assert found.covariance is not None
    sigma = float(np.sqrt(0.5 * np.trace(found.covariance)))
    assert np.radians(0.05) < sigma < np.radians(0.07)
    assert float(np.linalg.norm(np.cross(found.direction, sun))) < 2.0 * sigma


def test_all_cameras_are_read_with_uncertain_strings_and_none_in_eclipse(
    scene_with_sun: tuple[EarthScene, Image],
) -> None:
    _, frame = scene_with_sun
    doubt = CoarseSun(CoarseSunStatus.UNCERTAIN, reason="unclear")
    found = sun_of_cameras({0: DARK, 1: frame}, MOUNTED, doubt, JOINT_SETTINGS)
    assert list(found.each) == [0, 1]
    assert found.camera == 1
    night = sun_of_cameras(
        {1: frame}, MOUNTED, CoarseSun(CoarseSunStatus.DARK, reason="eclipse"), JOINT_SETTINGS
    )
    assert not night.each
    assert night.direction is None
    assert night.reason == "no light: eclipse"


def test_a_strip_is_sampled_bilinearly_up_to_its_border() -> None:
    rows, columns = np.indices((5, 7))
    strip = (100.0 + 10.0 * columns + 3.0 * rows + 0.5 * rows * columns).astype(np.float64)
    x = np.array([0.0, 2.25, 5.5, 5.999, 6.0, 3.0])
    y = np.array([0.0, 1.5, 3.75, 3.999, 4.0, 2.0])
    found = sample(strip, 20, np.stack([x, y + 20.0], axis=1))
    np.testing.assert_allclose(found, 100.0 + 10.0 * x + 3.0 * y + 0.5 * x * y)
    outside = np.array([[-0.01, 21.0], [6.01, 21.0], [2.0, 19.99], [2.0, 24.01]])
    assert np.isnan(sample(strip, 20, outside)).all()
    line = sample(strip[:1, :1], 0, np.array([[0.0, 0.0], [0.5, 0.0]]))
    assert line[0] == 100.0
    assert np.isnan(line[1])


def test_strings_in_one_plane_leave_the_cameras_above_and_below_it_possible() -> None:
    """Strings in one plane do not exclude the cameras above and below this plane.

    Six side panels determine only the azimuth of the Sun. The error of the Sun's elevation is not limited.
    """
    direction, basis = np.array([1.0, 0.0, 0.0]), np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    coarse = CoarseSun(CoarseSunStatus.FOUND, direction, basis, np.diag([1e-4, 1e6]))
    lens = Pinhole.from_field_of_view(128, 128, np.radians(40.0))

    def camera(elevation: float, azimuth: float) -> MountedCamera:
        """Return a camera whose boresight has the given angles (deg) from x."""
        up, side = np.radians([elevation, azimuth])
        boresight = np.array([np.cos(up) * np.cos(side), np.cos(up) * np.sin(side), np.sin(up)])
        right = np.array([-np.sin(side), np.cos(side), 0.0])
        return MountedCamera(lens, from_matrix(np.array([right, np.cross(boresight, right), boresight])))

    mounted = [
        camera(0.0, 0.0),
        camera(45.0, 0.0),
        camera(-60.0, 5.0),
        camera(0.0, 180.0),
        camera(30.0, 90.0),
    ]
    possible = {choice.index for choice in cameras_by_sun(coarse, mounted) if choice.possible}
    assert possible == {0, 1, 2}


def _rim(count: int, radius: float, centre: tuple[float, float], noise: float, seed: int = 1) -> FloatArray:
    angle = np.arange(count) * 2.0 * np.pi / count
    away = radius + noise * np.random.default_rng(seed).normal(size=count)
    return np.asarray(np.array(centre) + away[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1))


def test_a_circle_is_fitted_through_the_points_of_a_rim() -> None:
    """A fifth of the points are on another curve and do not change the circle."""
    points = _rim(60, 5.0, (2.0, -1.0), 0.01)
    points[40:52] *= 1.4
    found = fit_circle(points, 0.02)
    assert found is not None
    assert found.centre == pytest.approx([2.0, -1.0], abs=0.01)
    assert found.radius == pytest.approx(5.0, abs=0.01)
    assert not found.used[40:52].any()
    assert found.used[:40].all()
    assert found.residual == pytest.approx(0.01, rel=0.3)
    # The covariance is that of a linear fit of centre and radius to points of unit variance.
    offset = points[found.used] - found.centre
    design = np.column_stack([offset / np.linalg.norm(offset, axis=1)[:, None], np.ones(len(offset))])
    expected = np.linalg.inv(design.T @ design)[:2, :2]
    ratio = found.shape / expected
    assert ratio == pytest.approx(np.full((2, 2), ratio[0, 0]), rel=0.02)
    assert 1.0 <= ratio[0, 0] < 2.0
    assert fit_circle(points[:5], 0.02) is None
    assert fit_circle(np.stack([np.arange(20.0), np.arange(20.0)], axis=1), 0.02) is None


def test_correlated_errors_of_a_rim_increase_the_covariance() -> None:
    """If the errors of neighbours have the correlation r, the variance grows by (1 + r)/(1 - r)."""
    angle = np.arange(80) * 2.0 * np.pi / 80
    wavy = 5.0 + 0.01 * np.sin(8.0 * angle)
    points = wavy[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    found = fit_circle(points, 0.02)
    assert found is not None
    correlation = np.cos(8.0 * 2.0 * np.pi / 80)
    assert found.shape[0, 0] == pytest.approx(2.0 / 80 * (1.0 + correlation) / (1.0 - correlation), rel=0.02)
    # Opposite errors of neighbours do not decrease the variance.
    saw = 5.0 + 0.01 * np.where(np.arange(80) % 2 == 0, 1.0, -1.0)
    other = fit_circle(saw[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1), 0.02)
    assert other is not None
    assert other.shape[0, 0] == pytest.approx(2.0 / 80, rel=0.02)


def test_the_smaller_of_two_nearly_equal_circles_is_preferred() -> None:
    inner, outer = _rim(60, 5.0, (0.0, 0.0), 0.0), _rim(60, 7.0, (0.0, 0.0), 0.0)
    for count, radius in ((24, 7.0), (28, 5.0)):
        mixed = np.where((np.arange(60) % 60 < count)[:, None], inner, outer)
        found = sun_module._consensus(mixed, 0.05)
        assert found is not None
        assert found == pytest.approx([0.0, 0.0, radius], abs=1e-6)


def test_distances_from_a_circle_have_their_derivatives() -> None:
    points, circle = np.array([[3.0, 4.0], [-1.0, 0.5]]), np.array([0.5, -0.2, 2.0])
    distance, slopes = sun_module._distances(points, circle)
    assert distance == pytest.approx(np.linalg.norm(points - circle[:2], axis=1) - 2.0)
    for k, step in enumerate(1e-6 * np.eye(3)):
        ahead, behind = (sun_module._distances(points, circle + way * step)[0] for way in (1.0, -1.0))
        assert slopes[:, k] == pytest.approx((ahead - behind) / 2e-6)


def _disc(radius_deg: float, used: int, points: int, endless: int, residual_px: float, stretch: float) -> str:
    """Return the problem of a disc in a camera of 700 px/rad with a stretched second axis."""
    scale = np.diag([700.0, 700.0 * stretch])
    per_radian = 700.0 * np.sqrt(stretch)
    mask = np.arange(points) < used
    circle = Circle(np.zeros(2), np.radians(radius_deg), mask, residual_px / per_radian, np.eye(2))
    rim = sun_module._Rim(np.array([0.0, 0.0, 1.0]), np.eye(3)[:2], np.zeros((points, 2)), 0, endless)
    return sun_module._flaw(sun_module._Disc(rim, circle, scale), SunSettings())


def test_a_disc_is_refused_beyond_each_limit() -> None:
    """The default limits are 0.35 to 0.6 deg, 55 % of the directions, 110 deg of arc, and 0.25 px."""
    spokes = sun_module._SPOKES
    assert _disc(0.45, spokes, spokes, 0, 0.1, 1.0) == ""
    assert _disc(0.351, spokes, spokes, 0, 0.1, 1.0) == ""
    assert _disc(0.349, spokes, spokes, 0, 0.1, 1.0) == (
        "a patch of 0.35 deg radius at level 200, smaller than `least_radius` of 0.35 deg,"
    )
    assert _disc(0.599, spokes, spokes, 0, 0.1, 1.0) == ""
    assert _disc(0.62, spokes, spokes, 0, 0.1, 1.0) == (
        "a patch of 0.62 deg radius at level 200, larger than `greatest_radius` of 0.60 deg "
        "(set `level` just below saturation, or expose for a shorter time),"
    )
    few = int(0.54 * spokes)
    assert (
        _disc(0.45, few, spokes, 0, 0.1, 1.0) == f"an edge on the circle in only {few} of {spokes} directions"
    )
    assert _disc(0.45, few, few, spokes - few, 0.1, 1.0).endswith(f"{few} of {spokes} directions")
    assert _disc(0.45, few, few + 1, 0, 0.1, 1.0) == ""
    short = int(109.0 / 360.0 * spokes)
    assert _disc(0.45, short, short, 0, 0.1, 1.0) == (
        f"too short an arc of the limb, {short * 360 // spokes} deg,"
    )
    enough = int(np.ceil(110.0 / 360.0 * spokes))
    assert _disc(0.45, enough, enough, 0, 0.1, 1.0) == ""
    assert _disc(0.45, spokes, spokes, 0, 0.249, 1.0) == ""
    assert _disc(0.45, spokes, spokes, 0, 0.26, 1.0) == "an edge that deviates from a circle by 0.26 px rms"
    # A lens that stretches the disc by 1.44 also stretches its blur, so that 0.3 px are permitted.
    assert _disc(0.45, spokes, spokes, 0, 0.299, 1.44) == ""
    assert _disc(0.45, spokes, spokes, 0, 0.301, 1.44) != ""


def test_a_measured_sun_has_a_covariance_across_its_direction() -> None:
    direction = np.array([0.0, 0.6, 0.8])
    basis = np.array([[1.0, 0.0, 0.0], [0.0, 0.8, -0.6]])
    tangent = np.array([[4e-8, 1e-8], [1e-8, 2e-8]])
    measured = SunMeasurement(direction, basis, tangent, np.zeros(2), 0.008, 0.1, 6.0, False)
    assert measured.covariance @ direction == pytest.approx(np.zeros(3), abs=1e-20)
    assert basis @ measured.covariance @ basis.T == pytest.approx(tangent)
    assert measured.sigma == pytest.approx(np.sqrt(3e-8))


def test_a_direction_contradicts_the_strings_beyond_five_standard_deviations() -> None:
    direction, basis = np.array([0.0, 0.0, 1.0]), np.eye(3)[:2]
    strings = CoarseSun(CoarseSunStatus.FOUND, direction, basis, np.diag([4e-4, 1e-4]))
    for share, contradicts in ((0.98, False), (1.02, True)):
        for axis, sigma in ((0, 0.02), (1, 0.01)):
            off = np.zeros(3)
            off[axis] = share * 5.0 * sigma
            seen = (direction + off) / np.linalg.norm(direction + off)
            assert sun_module._contradicts(seen, strings) == contradicts
    assert sun_module._contradicts(-direction, strings)
    assert not sun_module._contradicts(-direction, CoarseSun(CoarseSunStatus.UNCERTAIN))


@pytest.mark.parametrize(
    ("name", "good", "bad"),
    [
        ("stride", (1,), (0,)),
        ("level", (1e-9,), (0.0, np.inf)),
        ("tolerance", (1e-9,), (0.0, np.inf)),
        ("rim_sigma", (1e-9,), (0.0,)),
        ("floor_sigma", (1e-9,), (0.0,)),
        ("least_agreement", (0.5, 1.0), (0.49, 1.01)),
        ("least_arc", (1e-6, 2.0 * np.pi), (0.0, 6.29)),
        ("least_radius", (1e-6,), (0.0, np.radians(0.6))),
        ("greatest_radius", (0.49,), (0.5, np.radians(0.35))),
    ],
)
def test_settings_of_the_sun_have_their_ranges(
    name: str, good: tuple[float, ...], bad: tuple[float, ...]
) -> None:
    for value in good:
        assert getattr(SunSettings(**{name: value}), name) == value  # type: ignore[arg-type]  # named settings
    for value in bad:
        with pytest.raises(UsageError, match=name):
            SunSettings(**{name: value})  # type: ignore[arg-type]  # named settings
