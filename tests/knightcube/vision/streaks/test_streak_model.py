"""Tests of the streak model against sums over thousands of instants, each integrated over every pixel."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks import streak_model
from knightcube.vision.streaks.camera_motion import CameraMotion
from knightcube.vision.streaks.fit_windows import LINES, cut_patches, cut_strips, cut_windows
from knightcube.vision.streaks.frame import reduce_frame
from knightcube.vision.streaks.geometry import (
    Shutter,
    StreakScene,
    paths,
    sensitivities,
    sensitivities_and_velocity,
)
from knightcube.vision.streaks.scene_images import light_of
from knightcube.vision.streaks.streak_model import IMAGES, QUADRATIC_IMAGES
from tests.sim_hal.star_camera.scenes import integrated_by_brute_force
from tests.support.compiled_forms import assert_forms_agree

_PINHOLE = Pinhole(320, 320, 2903.6)
_CASES = [
    ([0.02, 0.03, 0.0], [160.0, 150.0]),
    ([0.05, -0.02, 0.1], [120.3, 190.6]),
    ([0.0, 0.0, 1.0], [230.0, 215.0]),
    ([0.0, 0.03, 0.4], [20.0, 160.0]),
]


def _brute(motion: CameraMotion, star: FloatArray, sigma: float) -> FloatArray:
    count = 2000
    time = (np.arange(count) + 0.5) / count - 0.5
    where = paths(_PINHOLE, motion, np.tile(star, (count, 1)), time).position
    return integrated_by_brute_force((320, 320), where, 1.0, sigma)


def _modelled(
    motion: CameraMotion, star: FloatArray, sigma: float
) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Return the covered pixels, the modelled counts, and the derivatives (9, ...) of the counts."""
    stars, width = star[None], float(np.sqrt(sigma**2 + 1.0 / 12.0))
    strips = cut_strips(_PINHOLE, motion, stars, np.array([[-0.5, 0.5]]), 5.0 * width)
    images = streak_model.images(_PINHOLE, motion, Shutter(), stars, width, strips)[:, :IMAGES].astype(float)
    mixture = streak_model.coefficients(_PINHOLE, motion, Shutter(), stars, strips)
    changes = np.einsum("bijk,bip->pbjk", images, mixture)
    frames = np.zeros((10, 320 * 320))
    for frame, values in zip(frames, [images[:, 0], *changes, images[:, 5]], strict=True):
        np.add.at(frame, strips.index[strips.inside], values[strips.inside])
    times = np.bincount(strips.index[strips.inside], minlength=320 * 320).reshape(320, 320)
    assert times.max() == 1
    return times > 0, frames[0].reshape(320, 320), frames[1:].reshape(9, 320, 320)


@pytest.mark.parametrize(("turn", "star"), _CASES)
@pytest.mark.parametrize(("sigma", "allowed"), [(1.0, 1.0e-3), (0.6, 4.0e-3)])
def test_the_light_is_that_of_brute_force(
    turn: list[float], star: list[float], sigma: float, allowed: float
) -> None:
    """The light of a streak differs from a sum over instants by less than a thousandth of its peak.

    The difference is far below the noise of an unsaturated pixel.
    """
    motion = CameraMotion.steady(np.array(turn))
    truth = _brute(motion, np.array(star), sigma)
    covered, light, _ = _modelled(motion, np.array(star), sigma)
    assert truth[~covered].sum() < 1e-2 * truth.sum()
    assert np.abs(light - truth)[covered].max() < allowed * truth.max()


@pytest.mark.parametrize("growth", [0.3, 1.0, 2.0, -2.0])
@pytest.mark.parametrize("length", [16.0, 30.0, 90.0])
def test_the_light_of_a_changing_rate_is_that_of_brute_force(growth: float, length: float) -> None:
    """The light of a streak with a changing rate agrees with a sum over instants.

    For a motion from rest, a patch models the bright slow end, and strips model the rest of the streak.
    """
    turn = np.array([0.4, 0.9, 0.1]) * length / _PINHOLE.focal_length
    motion, star = CameraMotion(turn, growth * turn), np.array([160.3, 155.2])
    truth = _brute(motion, star, 1.0).reshape(-1)
    noise = np.random.default_rng(1).normal(100.0, 3.0, (320, 320)).astype(np.uint16)
    scene = StreakScene(
        motion, float(np.sqrt(13.0 / 12.0)), star[None], np.ones(1), np.zeros(1), np.ones(1, dtype=np.bool_)
    )
    windows = cut_windows(reduce_frame(noise, 65535.0, 1.0), _PINHOLE, Shutter(), scene, 5.0)
    light = np.zeros(320 * 320)
    light[windows.pixels] = light_of(_PINHOLE, Shutter(), scene, windows)
    covered = np.bincount(windows.pixels, minlength=320 * 320) > 0
    assert truth[~covered].sum() < 1e-3
    assert np.abs(light - truth)[covered].max() < 2.5e-3 * truth.max()


@pytest.mark.parametrize(("turn", "star"), _CASES)
def test_the_derivatives_are_those_of_brute_force(turn: list[float], star: list[float]) -> None:
    """The derivatives agree with a sum over instants to 4 %.

    An accuracy of 4 % is sufficient, because derivatives do not change the solution of the fit.
    """
    motion, place = CameraMotion.steady(np.array(turn)), np.array(star)
    covered, _, changes = _modelled(motion, place, 1.0)
    for k in range(5):
        step = np.zeros(5)
        step[k] = 1e-5 if k < 3 else 1e-2
        up = _brute(CameraMotion.steady(motion.rate + step[:3]), place + step[3:], 1.0)
        down = _brute(CameraMotion.steady(motion.rate - step[:3]), place - step[3:], 1.0)
        truth = ((up - down) / (2.0 * step[k]))[covered]
        found = changes[k if k < 3 else k + 3][covered]
        assert np.linalg.norm(found - truth) < 0.04 * np.linalg.norm(truth)


@pytest.mark.parametrize("length", [9.0, 12.0, 20.0, 40.0])
@pytest.mark.parametrize("place", [0.0, 5.3, 10.6])
def test_the_derivatives_of_short_streaks_by_the_acceleration_are_those_of_brute_force(
    length: float, place: float
) -> None:
    """The quadratic images give the derivatives of streaks that are shorter than two blocks of pixels.

    Before the comparison, the part of a derivative that changes of position, flux and rate can explain is
    removed. The remaining part agrees with a sum over instants to 6 %.
    """
    axis = np.array([0.6, 0.8, 0.3])
    turn, star = length / _PINHOLE.focal_length * axis, np.array([[160.2 + place, 150.7]])
    motion, width = CameraMotion.steady(turn), float(np.sqrt(13.0 / 12.0))
    strips = cut_strips(_PINHOLE, motion, star, np.array([[-0.5, 0.5]]), 5.0 * width)
    count = IMAGES + QUADRATIC_IMAGES
    images = streak_model.images(_PINHOLE, motion, Shutter(), star, width, strips, count + 1)[:, :count]
    mixture = streak_model.coefficients(_PINHOLE, motion, Shutter(), star, strips, quadratic=True)
    changes = np.einsum("bijk,bip->pbjk", images.astype(float), mixture)[:, strips.inside].T
    explained = np.column_stack([changes[:, :3], changes[:, 6:], images[:, 0][strips.inside]])
    explained = np.linalg.qr(explained)[0]
    step = 0.02 * length / _PINHOLE.focal_length
    for k in range(2):
        up, down = (
            _brute(CameraMotion(turn, sign * step * np.eye(3)[k]), star[0], 1.0).reshape(-1)
            for sign in (1.0, -1.0)
        )
        truth = ((up - down) / (2.0 * step))[strips.index[strips.inside]]
        truth, found = (each - explained @ (explained.T @ each) for each in (truth, changes[:, 3 + k]))
        assert np.linalg.norm(found - truth) < 0.06 * np.linalg.norm(truth)


def test_strips_extend_beyond_both_ends_for_any_times() -> None:
    """Strips extend beyond both ends of a streak, whatever its start and end times.

    With a rolling shutter, the times of a streak are arbitrary. The strips have the same number of additional
    pixels at both ends.
    """
    motion, star = CameraMotion.steady(np.array([0.0, 0.04, 0.0])), np.array([160.0, 150.0])
    rng = np.random.default_rng(11)
    for begin, end in np.sort(rng.uniform(-0.55, 0.55, (200, 2)), axis=1):
        if end - begin < 0.2:
            continue
        strips = cut_strips(_PINHOLE, motion, star[None], np.array([[begin, end]]), 3.7)
        row, column = np.divmod(strips.index[strips.inside], 320)
        ends = paths(_PINHOLE, motion, np.tile(star, (2, 1)), np.array([begin, end])).position[:, 0]
        about = np.abs(row - 150.0) < 1.0
        assert 2.0 * 3.7 - 2.0 <= np.ptp(column[about]) - np.ptp(ends) <= 2.0 * 3.7


@pytest.mark.parametrize("turn", [0.9, 2.5])
def test_strips_of_a_bent_streak_contain_each_pixel_once_in_short_lines(turn: float) -> None:
    """The strips of a curved streak contain each pixel near the path exactly once, in short lines.

    The selected pixels are compared with the distances of all pixels from a finely sampled path.
    """
    motion, star, width = CameraMotion.steady(np.array([0.0, 0.02, turn])), np.array([231.3, 214.6]), 3.7
    strips = cut_strips(_PINHOLE, motion, star[None], np.array([[-0.5, 0.5]]), width)
    times = np.bincount(strips.index[strips.inside], minlength=320 * 320).reshape(320, 320)
    time = np.linspace(-0.5, 0.5, 600)
    path = paths(_PINHOLE, motion, np.tile(star, (600, 1)), time).position
    row, column = np.indices((320, 320))
    apart = np.full((320, 320), np.inf)
    for x, y in path:
        np.minimum(apart, np.hypot(column - x, row - y), out=apart)
    assert times.max() == 1
    assert np.count_nonzero(times[apart <= width - 0.1]) > 0.995 * np.count_nonzero(apart <= width - 0.1)
    # A row of pixels crosses a streak at 45 deg over sqrt(2) times its width, and over a longer distance at
    # its ends.
    assert strips.index.shape[2] <= 2.0 * np.sqrt(2.0) * width + 4.0


def test_a_short_bent_streak_is_summed_exactly() -> None:
    """The image of a short curved streak agrees with a sum over instants.

    The star is 5 px from the rotation axis and rotates by one radian, so its path is far from straight.
    """
    motion, star = CameraMotion.steady(np.array([0.0, 0.0, 1.0])), np.array([163.0, 155.0])
    patches = cut_patches(_PINHOLE, star[None], 10)
    light, _ = streak_model.spot_derivatives(_PINHOLE, motion, Shutter(), star[None], 1.0, patches)
    truth = _brute(motion, star, 1.0).reshape(-1)[patches.index[0]]
    assert np.abs(light[0] - truth).max() < 2e-4 * truth.max()


def test_sensitivities_are_finite_differences_of_the_path() -> None:
    motion = CameraMotion(np.array([0.1, -0.2, 0.3]), np.array([0.02, 0.03, -0.05]))
    stars, time = np.array([[100.0, 250.0], [280.0, 40.0]]), np.array([-0.4, 0.3])
    found = sensitivities(_PINHOLE, motion, stars, time)

    def position(change: FloatArray) -> FloatArray:
        moved = CameraMotion(motion.rate + change[:3], motion.acceleration + change[3:6])
        return paths(_PINHOLE, moved, stars + change[6:], time).position

    for k, step in enumerate(1e-6 * np.eye(8)):
        truth = (position(step) - position(-step)) / 2e-6
        scale = np.abs(truth).max()
        assert np.abs(found[:, :, k] - truth).max() < (0.02 if k < 6 else 1e-5) * scale


@pytest.mark.parametrize("growth", [[0.0, 0.0, 0.0], [0.02, 0.03, -0.05]])
def test_velocities_with_the_sensitivities_equal_those_of_the_paths(growth: list[float]) -> None:
    """The velocities that are computed with the sensitivities equal the velocities of the paths.

    The two functions use different formulas for constant and changing rates.
    """
    motion = CameraMotion(np.array([0.1, -0.2, 0.3]), np.array(growth))
    stars, time = np.array([[100.0, 250.0], [280.0, 40.0]]), np.array([-0.4, 0.3])
    _, velocity = sensitivities_and_velocity(_PINHOLE, motion, stars, time)
    assert np.allclose(velocity, paths(_PINHOLE, motion, stars, time).velocity, rtol=1e-9)


def test_the_rotation_of_a_changing_rate_equals_many_small_rotations() -> None:
    """The rotation at a changing rate (Magnus expansion) equals 4,000 short rotations at constant rates."""
    motion = CameraMotion(np.array([0.1, -0.2, 0.3]), np.array([0.1, 0.15, 0.1]))
    vector = np.array([0.02, -0.03, 1.0])
    steps = 4000
    for k in range(steps):
        rate = motion.rate + motion.acceleration * (k + 0.5) / (2 * steps)
        step = rate / (2 * steps)
        angle = np.linalg.norm(step)
        axis = step / angle
        vector = (
            vector * np.cos(angle)
            - np.cross(axis, vector) * np.sin(angle)
            + axis * (axis @ vector) * (1 - np.cos(angle))
        )
    star = _PINHOLE.project(np.array([[0.02, -0.03, 1.0]]))
    found = paths(_PINHOLE, motion, star, np.array([0.5])).position
    assert np.allclose(found, _PINHOLE.project(vector[None]), atol=2e-3)


@pytest.mark.parametrize("growth", [0.0, 1.2])
@pytest.mark.parametrize("delay", [0.0, 4e-4])
@pytest.mark.parametrize("further", [0, QUADRATIC_IMAGES])
@pytest.mark.parametrize(("turn", "star"), _CASES)
def test_the_compiled_images_equal_those_in_numpy(
    turn: list[float], star: list[float], further: int, delay: float, growth: float
) -> None:
    motion = CameraMotion(np.array(turn), growth * np.array(turn))
    stars = np.array([star, [150.2, 180.9]])
    strips = cut_strips(_PINHOLE, motion, stars, np.tile([-0.45, 0.5], (2, 1)), 4.1)
    points = paths(_PINHOLE, motion, np.repeat(stars[strips.star], LINES, axis=0), strips.time.reshape(-1))
    shape = len(strips.star), IMAGES + further + 1, *strips.index.shape[1:]
    out = np.zeros(shape, dtype=np.float32)
    lines, at_lines = (strips.corner, strips.step, strips.time), points.at_lines(strips.time.shape)
    arguments = out, lines, at_lines, 1.3, (delay, 160.0)
    assert_forms_agree(streak_model._draw, *arguments, relative=3e-5, interpreted=growth == 0.0)
