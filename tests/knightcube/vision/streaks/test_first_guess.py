"""Tests of initial guesses of axis and angle, from bright regions of drawn streaks and simulated frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks import first_guess
from knightcube.vision.streaks.camera_motion import CameraMotion
from knightcube.vision.streaks.first_guess import (
    FRAME_CAP,
    Circles,
    find_axis,
    frame_angles,
    guess_axis,
    measured_rate_change,
    motion_by_course,
    motions_by_length,
    motions_by_scan,
    scan_angles,
    sharper_widths,
)
from knightcube.vision.streaks.frame import BrightRegions, ReducedFrame, find_bright_regions, reduce_frame
from knightcube.vision.streaks.geometry import paths
from tests.knightcube.vision.streaks.scenes import CAMERA, SATURATION, Scene, real_sky, taken, turn_of
from tests.sim_hal.star_camera.scenes import integrated_by_brute_force
from tests.support.compiled_forms import assert_forms_agree


def _regions(scene: Scene) -> tuple[ReducedFrame, BrightRegions]:
    frame = reduce_frame(scene.pixels, SATURATION, 1.0)
    return frame, find_bright_regions(frame, 4.5, 48)


@pytest.mark.parametrize(("theta", "length"), [(90.0, 60.0), (50.0, 150.0), (3.0, 150.0)])
def test_regions_give_axis_and_angle(theta: float, length: float) -> None:
    """Bright regions give the axis and the angle of the rotation.

    The orientation of a region is uncertain by about 1 px over its length.
    """
    scene = real_sky(71, np.radians(theta), length, 0.5)
    rotation = scene.rate * scene.exposure
    angle = float(np.linalg.norm(rotation))
    _, regions = _regions(scene)
    guess = find_axis(regions, CAMERA.pinhole)
    assert guess is not None
    assert abs(guess.frame[2] @ rotation) / angle > np.cos(2.0 / length)
    assert guess.frame @ guess.frame.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.count_nonzero(guess.agree) > 0.8 * len(regions)
    best = next(motions_by_length(guess, regions, CAMERA.pinhole, 12))
    assert float(np.linalg.norm(best.motion.rate)) == pytest.approx(angle, rel=0.03)
    assert best.motion.constant
    assert len(best.stars) == len(best.light) <= 12
    distance = np.linalg.norm(best.stars[:, None] - scene.stars, axis=2).min(axis=1)
    assert np.median(distance) < 2.0


def test_fewer_than_two_long_regions_give_no_axis() -> None:
    frame, _ = _regions(real_sky(72, 1.2, 60.0, 0.5))
    regions = find_bright_regions(frame, 4.5, 1)
    assert len(regions) == 1
    assert guess_axis(regions, CAMERA.pinhole) is None
    assert find_axis(regions, CAMERA.pinhole) is None


def test_a_scan_along_the_circles_gives_the_angle_nearest_to_a_prior_first() -> None:
    scene = real_sky(73, np.radians(70.0), 400.0, 0.5)
    angle = float(np.linalg.norm(scene.rate * scene.exposure))
    frame, regions = _regions(scene)
    guess = find_axis(regions, CAMERA.pinhole)
    assert guess is not None
    found = next(motions_by_scan(guess, frame, CAMERA.pinhole, 12, angle))
    assert float(np.linalg.norm(found.motion.rate)) == pytest.approx(angle, rel=0.02)


@pytest.mark.parametrize("growth", [1.5, -1.5])
def test_the_asymmetry_of_regions_shows_a_change_of_the_rate(growth: float) -> None:
    """The asymmetry of the regions shows whether the rate increases or decreases during the exposure.

    If the guessed axis is opposite to the true axis, the change has the opposite sign.
    """
    rotation = turn_of(np.radians(70.0), 120.0, 0.4)
    scene = taken(np.random.default_rng(74), rotation, growth * rotation, 0.5)
    _, regions = _regions(scene)
    guess = find_axis(regions, CAMERA.pinhole)
    assert guess is not None
    change = measured_rate_change(guess, regions)
    reverse = np.sign(guess.frame[2] @ rotation)
    assert change * reverse == pytest.approx(growth, abs=0.4)
    best = next(motions_by_length(guess, regions, CAMERA.pinhole, 12, change))
    assert best.motion.acceleration == pytest.approx(change * best.motion.rate)


def test_a_constant_rate_shows_no_change() -> None:
    _, regions = _regions(real_sky(75, np.radians(70.0), 120.0, 0.5))
    guess = find_axis(regions, CAMERA.pinhole)
    assert guess is not None
    assert measured_rate_change(guess, regions) == 0.0


def test_a_known_motion_selects_the_entire_regions_of_its_length() -> None:
    scene = real_sky(76, np.radians(70.0), 80.0, 0.5)
    _, regions = _regions(scene)
    course = CameraMotion.steady(scene.rate * scene.exposure)
    found = motion_by_course(course, regions, CAMERA.pinhole, 12)
    assert found.motion is course
    assert 4 <= len(found.stars) <= 12
    distance = np.linalg.norm(found.stars[:, None] - scene.stars, axis=2).min(axis=1)
    assert np.median(distance) < 1.0
    longer = motion_by_course(CameraMotion.steady(3.0 * course.rate), regions, CAMERA.pinhole, 12)
    assert len(longer.stars) < len(found.stars)


_SMALL = Pinhole(240, 200, 700.0)
_AXIS = np.array([0.42, -0.56, 0.714])
_STARS = np.array(
    [[60.3, 50.7], [180.6, 60.2], [120.0, 100.5], [70.4, 150.9], [170.2, 145.3], [100.8, 40.1], [6.0, 100.0]]
)
_FLUX = np.array([9000.0, 8000.0, 7000.0, 6000.0, 5000.0, 4000.0, 3000.0])


def _drawn(
    motion: CameraMotion, stars: FloatArray = _STARS, flux: FloatArray = _FLUX, gap: float = 0.0
) -> BrightRegions:
    """Return the regions of streaks without noise. Fragments are separated by a `gap` of the exposure."""
    time = (np.arange(200.0) + 0.5) / 200.0 - 0.5
    parts = [time] if gap == 0.0 else [time[time < -0.5 * gap], time[time > 0.5 * gap]]
    shapes: list[tuple[FloatArray, FloatArray, float, float, bool]] = []
    pixels: list[tuple[IntArray, IntArray, IntArray, FloatArray]] = []
    for star, light in zip(stars, flux, strict=True):
        for part in parts:
            where = paths(_SMALL, motion, np.tile(star, (len(part), 1)), part).position
            image = integrated_by_brute_force((200, 240), where, light * len(part) / 200.0, 1.0)
            row, column = np.nonzero(image > 2.0)
            own = image[row, column]
            centre = np.array([column @ own, row @ own]) / own.sum()
            away = np.stack([column, row], axis=1) - centre
            size, ways = np.linalg.eigh((away * own[:, None]).T @ away / own.sum())
            cut = bool(row.min() < 3 or column.min() < 3 or row.max() > 196 or column.max() > 236)
            shapes.append((centre, ways[:, 0], np.sqrt(12.0 * (size[1] - size[0])), own.sum(), cut))
            pixels.append((np.full(len(row), len(pixels)), column, row, own))
    centre, normal, length, total, cuts = (np.array(each) for each in zip(*shapes, strict=True))
    owner, columns, rows, lights = (np.concatenate(each) for each in zip(*pixels, strict=True))
    return BrightRegions(centre, normal, length, total, cuts, owner, columns, rows, lights, 0.05)


def _polar(guess_frame: FloatArray, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return cosines of the angles from the axis, and azimuths, of pixels."""
    x, y, z = guess_frame @ _SMALL.unit_vectors(pixels).T
    return z, np.arctan2(y, x)


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_streaks_are_arcs_about_the_rotation_axis(way: float) -> None:
    """The regions give the axis, and the position, length and ends of each arc about the axis."""
    angle = 0.07
    motion = CameraMotion.steady(way * angle * _AXIS)
    regions = _drawn(motion)
    assert regions.cut.tolist() == [False] * 6 + [True]
    guess = find_axis(regions, _SMALL)
    assert guess is not None
    assert abs(guess.frame[2] @ _AXIS) / np.linalg.norm(_AXIS) == pytest.approx(1.0, abs=1e-3)
    assert guess.agree.all()
    whole = slice(0, 6)
    height, azimuth = _polar(guess.frame, _STARS)
    assert guess.height[whole] == pytest.approx(height[whole], abs=3e-4)
    assert guess.middle[whole] == pytest.approx(azimuth[whole], abs=2e-3)
    speed = 700.0 * np.sin(np.arccos(height))
    assert guess.speed[whole] == pytest.approx(speed[whole], rel=0.1)
    assert guess.width[whole] == pytest.approx(np.full(6, angle), rel=0.03)
    # Regions extend by the point spread beyond both ends.
    for end, sign in ((guess.first, 1.0), (guess.last, -1.0)):
        beyond = sign * (guess.middle - end)[whole] - 0.5 * angle
        assert np.all((beyond * speed[whole] > 0.5) & (beyond * speed[whole] < 4.0))
    # The end in the frame of the truncated streak is not at the border.
    assert guess.cut_first[6] != guess.cut_last[6]
    assert not (guess.cut_first | guess.cut_last)[whole].any()
    best = next(motions_by_length(guess, regions, _SMALL, 12))
    assert np.linalg.norm(best.motion.rate) == pytest.approx(0.07, rel=0.03)
    assert best.stars[whole] == pytest.approx(_STARS[whole], abs=0.5)
    assert best.stars[6] == pytest.approx(_STARS[6], abs=3.0)
    assert best.light[whole] == pytest.approx(_FLUX[whole], rel=0.05)
    assert best.light[6] == pytest.approx(_FLUX[6], rel=0.25)
    assert best.contradicted == 0.0
    assert len(next(motions_by_length(guess, regions, _SMALL, 3)).stars) == 3


def test_a_region_in_another_direction_does_not_change_the_axis() -> None:
    regions = _drawn(CameraMotion.steady(0.07 * _AXIS))
    across = regions.normal.copy()
    across[2] = [across[2, 1], -across[2, 0]]
    guess = guess_axis(replace(regions, normal=across), _SMALL)
    assert guess is not None
    axis, agree = guess
    assert agree.tolist() == [True, True, False, True, True, True, True]
    assert abs(axis @ _AXIS) / np.linalg.norm(_AXIS) == pytest.approx(1.0, abs=1e-3)
    short = np.where(np.arange(7) < 6, 0.99 * first_guess._LEAST_LENGTH, 30.0)
    assert guess_axis(replace(regions, length=short), _SMALL) is None


@pytest.mark.parametrize("growth", [1.2, -1.2, 0.2])
def test_the_centroid_of_a_streak_shows_the_change_of_the_rate(growth: float) -> None:
    """A significant change of the rate is found, with the opposite sign if the guessed axis is opposite."""
    motion = CameraMotion(0.07 * _AXIS, growth * 0.07 * _AXIS)
    regions = _drawn(motion)
    guess = find_axis(regions, _SMALL)
    assert guess is not None
    found = measured_rate_change(guess, regions) * np.sign(guess.frame[2] @ _AXIS)
    assert found == pytest.approx(growth if abs(growth) > 0.4 else 0.0, abs=0.35)
    few = replace(regions, cut=np.arange(7) > 1)
    assert measured_rate_change(guess, few) == 0.0
    change = float(measured_rate_change(guess, regions))
    best = next(motions_by_length(guess, regions, _SMALL, 12, change))
    # The centre of a streak is at half the angle between its ends.
    halfway = CameraMotion.steady(motion.halfway)
    centres = paths(_SMALL, halfway, _STARS[:6], np.ones(6)).position
    assert best.stars[:4] == pytest.approx(centres[:4], abs=1.0)
    assert np.linalg.norm(best.motion.rotation) == pytest.approx(0.07, rel=0.06)
    course = motion_by_course(motion, regions, _SMALL, 12)
    assert course.stars == pytest.approx(centres, abs=0.3)
    assert course.light == pytest.approx(regions.flux[:6])
    assert len(motion_by_course(motion, regions, _SMALL, 2).stars) == 2
    assert len(motion_by_course(CameraMotion.steady(0.12 * _AXIS), regions, _SMALL, 12).stars) == 0


def test_fragments_of_one_streak_give_its_angle() -> None:
    """Two fragments on one circle are a vote for the angle from the start of one to the end of the other."""
    regions = _drawn(CameraMotion.steady(0.12 * _AXIS), _STARS[1:4], _FLUX[1:4], gap=0.25)
    guess = find_axis(regions, _SMALL)
    assert guess is not None
    joined = first_guess._joined(guess, regions)
    assert joined.shape == (3, 3)
    assert joined[:, 0] == pytest.approx([0.12] * 3, rel=0.06)
    assert np.all(joined[:, 1] * guess.speed[[0, 2, 4]] < 5.0)
    assert joined[:, 2] == pytest.approx(0.5 * np.sqrt(np.minimum(regions.flux[::2], regions.flux[1::2])))
    angles = [angle for angle, _ in first_guess._angles(guess, regions)]
    assert min(abs(angle - 0.12) for angle in angles) < 0.008


def test_a_longer_region_contradicts_an_angle_by_its_flux() -> None:
    """The angle of most regions is the most likely, although another region is twice as long."""
    regions, longer = _drawn(CameraMotion.steady(0.05 * _AXIS)), _drawn(CameraMotion.steady(0.11 * _AXIS))
    keep, other = regions.owner != 4, longer.owner == 4
    mixed = replace(
        regions,
        owner=np.concatenate([regions.owner[keep], longer.owner[other]]),
        column=np.concatenate([regions.column[keep], longer.column[other]]),
        row=np.concatenate([regions.row[keep], longer.row[other]]),
        light=np.concatenate([regions.light[keep], longer.light[other]]),
        length=np.where(np.arange(7) == 4, longer.length, regions.length),
    )
    guess = find_axis(mixed, _SMALL)
    assert guess is not None
    angles = first_guess._angles(guess, mixed)
    assert angles[0][0] == pytest.approx(0.05, rel=0.05)
    assert angles[0][1] == pytest.approx(mixed.flux[4] / mixed.flux.sum())
    assert any(abs(angle - 0.11) < 0.005 and against == 0.0 for angle, against in angles)
    # If all regions are truncated, the angle of the longest region is a lower limit.
    truncated = replace(mixed, cut=np.ones(7, dtype=np.bool_))
    (limit, against), *others = first_guess._angles(guess, truncated)
    assert not others
    assert against == 0.0
    assert 0.11 < limit < 0.13
    nothing = replace(guess, agree=np.zeros(7, dtype=np.bool_))
    assert first_guess._angles(nothing, truncated) == []


def test_the_best_box_explains_most_of_the_samples() -> None:
    """The best of all boxes of one length that contain the middle has the largest squared sum per sample."""
    rng = np.random.default_rng(4)
    values, exist = rng.normal(1.0, 2.0, (3, 40)), rng.uniform(size=(3, 40)) > 0.2
    values[1, 12:19] += 5.0
    values[2, 36:] += 6.0
    values[0, :4] += 6.0
    exist[2, 36:] = exist[0, :4] = True
    values *= exist
    variance, middle, widths = np.array([2.0, 4.0, 1.0]), np.array([3, 15, 38]), np.array([4, 7, 12])
    total, number = (
        np.pad(np.cumsum(each, axis=1), ((0, 0), (1, 0))) for each in (values, exist.astype(float))
    )
    most, place, light, seen = first_guess._best_boxes(total, number, variance, middle, widths)
    for w, width in enumerate(widths):
        for n in range(3):
            trials = []
            for first in range(middle[n] - width, middle[n] + 1):
                box = slice(max(first, 0), min(max(first + width, 0), 40))
                own, count = values[n, box].sum(), exist[n, box].sum()
                trials.append((max(own, 0.0) ** 2 / (max(count, 1) * variance[n]), first, own, count))
            best = max(trials, key=lambda trial: trial[0])
            assert most[w, n] == pytest.approx(best[0])
            chosen = next(trial for trial in trials if trial[1] == place[w, n])
            assert (light[w, n], seen[w, n]) == pytest.approx(chosen[2:])
            assert chosen[0] == pytest.approx(best[0])
    arguments = total, number, variance, middle, widths
    assert_forms_agree(first_guess._best_boxes, *arguments, compiled=False)


def test_a_box_is_significant_relative_to_both_its_sides() -> None:
    """A box of w samples of the amplitude a has the significance a w/sqrt(2 w), at most `_FRAME_ENOUGH`.

    Boxes with equal samples on both sides, and boxes below the threshold, are not counted.
    """
    width, room = 10, 20
    least, most = first_guess._LEAST_SIGMAS, first_guess._FRAME_ENOUGH
    for sigmas, expected in ((1.1 * least, (1.1 * least) ** 2), (0.9 * least, 0.0), (1.2 * most, most**2)):
        samples = np.zeros((80, 5))
        samples[33:43, 2] = sigmas / np.sqrt(0.5 * width)
        held = np.pad(np.cumsum(samples, axis=0), ((1, 0), (0, 0)))
        padded = np.pad(held, ((room, room), (0, 0)), mode="edge").astype(np.float32)
        found = first_guess._box_significance(padded, room, width)
        assert found == pytest.approx(expected, rel=1e-3, abs=1e-3)


def test_variations_along_bright_streaks_are_not_streaks() -> None:
    """The whole frame gives the angle of the streaks, not that of the variations along them.

    Without the limit of the samples, the angle is wrong by a factor of eight.
    """
    pinhole, rng, angle = Pinhole(320, 300, 900.0), np.random.default_rng(5), 0.15
    image, along = np.zeros((300, 320)), np.arange(135)
    across = np.exp(-0.5 * np.arange(-4.0, 5.0) ** 2) / np.sqrt(2.0 * np.pi)
    light = 4000.0 * (1.0 + 0.4 * np.sin(2.0 * np.pi * along / 24.0))
    for row in range(20, 290, 15):
        first = int(rng.integers(5, 180))
        image[row - 4 : row + 5, first : first + 135] += across[:, None] * light
    frame = reduce_frame(rng.normal(image + 100.0, 4.0).astype(np.uint16), SATURATION, 1.0)
    found = frame_angles(frame, pinhole, np.array([0.0, angle, 0.0]), 1, FRAME_CAP)
    assert found == pytest.approx([angle], rel=0.05)


def test_refined_lengths_are_within_half_a_step_of_the_search() -> None:
    assert sharper_widths(100, 500).tolist() == list(range(94, 107))
    assert sharper_widths(100, 103).tolist() == list(range(94, 104))
    assert sharper_widths(5, 500).tolist() == [4, 5, 6]
    assert sharper_widths(2, 500).tolist() == [2, 3]


def test_a_scan_finds_angle_position_and_flux_of_streaks() -> None:
    """A scan along the circles of the regions finds the angle, and the positions and fluxes of the stars."""
    angle, rng = 0.09, np.random.default_rng(3)
    motion = CameraMotion.steady(angle * _AXIS / np.linalg.norm(_AXIS))
    image, time = rng.normal(100.0, 3.0, (200, 240)), np.linspace(-0.5, 0.5, 300)
    for star, light in zip(_STARS[:6], _FLUX[:6], strict=True):
        where = paths(_SMALL, motion, np.tile(star, (300, 1)), time).position
        image += integrated_by_brute_force((200, 240), where, light, 1.0)
    frame = reduce_frame(np.rint(image).astype(np.uint16), SATURATION, 1.0)
    axis = motion.rate / angle
    towards = np.array([0.0, 0.0, 1.0]) - axis[2] * axis
    towards = towards / np.linalg.norm(towards)
    basis = np.stack([towards, np.cross(axis, towards), axis])
    height, azimuth = _polar(basis, _STARS[:6])
    circles = Circles(basis, height, azimuth + 0.01)
    found, stars, light = next(scan_angles(frame, _SMALL, circles, 3))
    assert found == pytest.approx(angle, rel=0.04)
    assert np.all(np.diff(light) < 0.0)
    apart = np.linalg.norm(stars[:, None] - _STARS[:6], axis=2)
    assert sorted(apart.argmin(axis=1).tolist()) == list(range(6))
    assert apart.min(axis=1).max() < 1.6
    assert light == pytest.approx(_FLUX[:6][apart.argmin(axis=1)], rel=0.12)
    assert len(list(scan_angles(frame, _SMALL, circles, 1))) == 1
    at_axis = Circles(basis, np.ones(2) - 1e-7, np.zeros(2))
    assert list(scan_angles(frame, _SMALL, at_axis, 1)) == []
