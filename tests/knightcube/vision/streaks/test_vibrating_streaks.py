"""Tests of the model of vibrating streaks against an independent renderer and numerical derivatives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import from_rotation_vector, multiply
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks import vibrating_streaks, vibration
from knightcube.vision.streaks.camera_motion import CameraMotion, Vibration
from knightcube.vision.streaks.fit_windows import LINES, FitWindows, cut_windows
from knightcube.vision.streaks.frame import ReducedFrame, reduce_frame
from knightcube.vision.streaks.geometry import Shutter, StreakScene, positions
from knightcube.vision.streaks.streak_model import IMAGES
from tests.support.compiled_forms import assert_forms_agree
from tests.support.supersampled import Optics, Sky, gaussian, light

_PINHOLE = Pinhole.from_field_of_view(200, 180, np.radians(3.0))
_FOCAL = _PINHOLE.focal_length
# A vibration of 0.8 px with a wavelength of 9 px along streaks of about 50 px.
_SHAKING = Vibration(
    np.array([5.6]), np.array([[0.5, 0.4, 0.0]]) / _FOCAL, np.array([[-0.2, 0.4, 0.3]]) / _FOCAL
)
_MOTION = CameraMotion(np.array([-30.0, 40.0, 90.0]) / _FOCAL, np.zeros(3), vibration=_SHAKING)
_STARS = np.array([[60.3, 70.8], [120.6, 110.2]])
_WIDTH = 1.05
_SHUTTER = Shutter()


def _scene(motion: CameraMotion = _MOTION, stars: FloatArray = _STARS, width: float = _WIDTH) -> StreakScene:
    return StreakScene(motion, width, stars, np.ones(2), np.zeros(2), np.ones(2, dtype=np.bool_))


def _frame() -> ReducedFrame:
    return reduce_frame(np.full((180, 200), 100, np.uint16), 60_000.0, 1.0)


def _windows() -> FitWindows:
    return cut_windows(_frame(), _PINHOLE, _SHUTTER, _scene(), 5.0)


def _images(scene: StreakScene, windows: FitWindows, number: int = 0) -> FloatArray:
    stars, strips = scene.stars[windows.long], windows.strips
    images = vibrating_streaks.images(_PINHOLE, scene.motion, _SHUTTER, stars, scene.width, strips)
    return np.where(strips.inside, images[:, number], 0.0)


def test_streaks_equal_those_of_an_independent_renderer() -> None:
    """The renderer adds points of light; the model integrates over the exposure near each block of pixels."""
    windows = _windows()
    modelled = np.zeros(180 * 200)
    strips = windows.strips
    np.add.at(modelled, strips.index[strips.inside], _images(_scene(), windows)[strips.inside])

    def at(times: FloatArray) -> FloatArray:
        smooth = from_rotation_vector(times[:, None] * _MOTION.rate)
        return multiply(from_rotation_vector(_SHAKING.rotation(times).T), smooth)

    sigma = np.sqrt(_WIDTH**2 - 1.0 / 12.0)
    sky = Sky(_PINHOLE.unit_vectors(_STARS), np.ones(2))
    optics = Optics((gaussian(float(sigma)),), radius=8.0)
    drawn = light(_PINHOLE, optics, sky, at, 400.0, 0.0, np.random.default_rng(1)).reshape(-1)
    fitted = np.unique(strips.index[strips.inside])
    assert np.abs(modelled - drawn)[fitted].max() < 0.005 * drawn.max()
    assert modelled.sum() == pytest.approx(2.0, rel=2e-3)


def test_derivatives_equal_differences_of_the_counts() -> None:
    """The images, multiplied by the coefficients, give the derivatives by rate, position and width."""
    scene, windows, step = _scene(), _windows(), 1e-4
    strips, stars = windows.strips, _STARS[windows.long]
    images = vibrating_streaks.images(_PINHOLE, _MOTION, _SHUTTER, stars, _WIDTH, strips)[:, :-1]
    matrix = vibrating_streaks.coefficients(_PINHOLE, _MOTION, _SHUTTER, stars, strips)
    found = np.einsum("bilk,bip->bplk", images, matrix)
    assert images.shape[1] == IMAGES + 2

    def difference(before: StreakScene, after: StreakScene, size: float) -> FloatArray:
        return (_images(after, windows) - _images(before, windows)) / (2.0 * size)

    def agree(one: FloatArray, other: FloatArray, share: float) -> None:
        assert np.abs(np.where(strips.inside, one, 0.0) - other).max() < share * np.abs(other).max()

    for axis, change in enumerate(np.eye(3) * step):
        scenes = [
            _scene(replace(_MOTION, rate=_MOTION.rate + by * change / _FOCAL * 100.0)) for by in (-1.0, 1.0)
        ]
        agree(found[:, axis], difference(scenes[0], scenes[1], 100.0 * step / _FOCAL), 0.06)
    for axis, change in enumerate(np.eye(2) * step):
        scenes = [_scene(stars=_STARS + by * change * 100.0) for by in (-1.0, 1.0)]
        agree(found[:, 6 + axis], difference(scenes[0], scenes[1], 100.0 * step), 0.01)
    scenes = [replace(scene, width=_WIDTH + by * step) for by in (-1.0, 1.0)]
    agree(images[:, 5].astype(float), difference(scenes[0], scenes[1], step), 1e-3)


def test_derivatives_of_rotations_equal_differences_of_the_counts() -> None:
    """All parameters of a vibration, and a star's position, change the counts as their derivatives state."""
    windows, step = _windows(), 1e-3
    strips, stars = windows.strips, _STARS[windows.long]
    rotations = vibration._rotations(_SHAKING)
    found = vibrating_streaks.derivatives(_PINHOLE, _MOTION, _SHUTTER, stars, _WIDTH, strips, rotations)
    assert found.shape[1] == 6 + 7 + 2
    for index, change in enumerate(np.eye(7)):
        size = step / _FOCAL if index < 6 else step
        sine, cosine = size * change[:6].reshape(2, 1, 3)
        scenes = []
        for by in (-1.0, 1.0):
            shaken = Vibration(
                _SHAKING.frequency + by * size * change[6:],
                _SHAKING.sine + by * sine,
                _SHAKING.cosine + by * cosine,
            )
            scenes.append(_scene(replace(_MOTION, vibration=shaken)))
        expected = (_images(scenes[1], windows) - _images(scenes[0], windows)) / (2.0 * size)
        derivative = np.where(strips.inside, found[:, 6 + index], 0.0)
        assert np.abs(derivative - expected).max() < 0.02 * np.abs(expected).max()
    for axis, change in enumerate(np.eye(2) * step):
        scenes = [_scene(stars=_STARS + by * change) for by in (-1.0, 1.0)]
        expected = (_images(scenes[1], windows) - _images(scenes[0], windows)) / (2.0 * step)
        derivative = np.where(strips.inside, found[:, 13 + axis], 0.0)
        assert np.abs(derivative - expected).max() < 0.03 * np.abs(expected).max()


def test_ends_are_the_counts_per_px_at_start_and_stop() -> None:
    """The images of the ends are Gaussians around them, divided by the speed without the vibration."""
    windows = _windows()
    star = int(windows.long[0])
    mine = windows.strips.star == 0
    for number, end in ((3, -0.5), (4, 0.5)):
        counts = np.where(mine[:, None, None], _images(_scene(), windows, number), 0.0)
        index = windows.strips.index[counts > 0.0]
        y, x = np.divmod(index, 200)
        there = positions(_PINHOLE, _MOTION, _STARS[star : star + 1], np.array([end]))[0]
        near = positions(
            _PINHOLE, _MOTION.smooth, np.tile(_STARS[star], (2, 1)), np.array([end - 1e-4, end + 1e-4])
        )
        speed = np.linalg.norm(near[1] - near[0]) / 2e-4
        whole = counts[counts > 0.0]
        assert whole.sum() == pytest.approx(1.0 / speed, rel=0.02)
        assert np.average(x, weights=whole) == pytest.approx(there[0], abs=0.05)
        assert np.average(y, weights=whole) == pytest.approx(there[1], abs=0.05)


def test_paths_without_the_vibration_are_the_means_of_the_vibrating_paths() -> None:
    mean = _scene().without_vibration(_PINHOLE)
    assert not mean.motion.vibration.exists
    # The vibration is averaged over whole cycles.
    time = (np.arange(560) + 0.5) / 560 * 5.0 / 5.6 - 2.5 / 5.6
    for star, middle in zip(_STARS, mean.stars, strict=True):
        there = positions(_PINHOLE, _MOTION, np.tile(star, (560, 1)), time)
        smooth = positions(_PINHOLE, mean.motion, np.tile(middle, (560, 1)), time)
        assert np.mean(there - smooth, axis=0) == pytest.approx([0.0, 0.0], abs=0.03)
    plain = _scene(_MOTION.smooth)
    assert plain.without_vibration(_PINHOLE) is plain


@pytest.mark.parametrize("along_rows", [True, False])
def test_the_compiled_sums_equal_those_in_numpy(along_rows: bool) -> None:
    rng = np.random.default_rng(3)
    step = np.tile([1, 0] if along_rows else [0, 1], (3, 1))
    across = np.arange(LINES)[None, :, None] * step[:, None, ::-1]
    corner = np.tile(rng.integers(20, 40, (3, 1, 2)), (1, LINES, 1)) + across
    corner += rng.integers(0, 3, (3, LINES, 1)) * step[:, None]
    place = corner[:, rng.integers(0, 10, 12)] + rng.uniform(-3.0, 9.0, (3, 12, 2))
    arguments = corner, step, 7, place, rng.uniform(0.0, 0.1, (3, 12)), rng.normal(size=(3, 4, 12, 2)), 0.9
    assert_forms_agree(vibrating_streaks._sums, *arguments, relative=1e-7, interpreted=True)
