"""Tests of the fitted pixels: patches, numbers of shared pixels, frame values, and slow parts of paths."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks import fit_windows
from knightcube.vision.streaks.camera_motion import CameraMotion
from knightcube.vision.streaks.fit_windows import cut_patches, cut_windows, path_distances, window_areas
from knightcube.vision.streaks.frame import ReducedFrame, reduce_frame
from knightcube.vision.streaks.geometry import Shutter, StreakScene, path_lengths, paths
from tests.support.compiled_forms import assert_forms_agree

_PINHOLE = Pinhole(150, 120, 800.0)


def _scene(motion: CameraMotion, stars: FloatArray) -> StreakScene:
    n = len(stars)
    return StreakScene(motion, 1.1, stars, np.full(n, 4000.0), np.zeros(n), np.ones(n, dtype=np.bool_))


def _frame() -> ReducedFrame:
    noise = np.random.default_rng(2).normal(100.0, 4.0, (120, 150)).astype(np.uint16)
    noise[30, 50] = 5000
    return reduce_frame(noise, 4000.0, 2.0)


def test_patches_are_squares_of_pixels_and_know_the_frame() -> None:
    patches = cut_patches(_PINHOLE, np.array([[40.4, 60.6], [1.4, 118.6]]), 3)
    assert patches.column[0].tolist() == list(range(37, 44))
    assert patches.row[0].tolist() == list(range(58, 65))
    assert patches.index[0].tolist() == [
        [row * 150 + column for column in range(37, 44)] for row in range(58, 65)
    ]
    assert patches.inside[0].all()
    # The second patch covers the columns -2 to 4 and the rows 116 to 122.
    assert patches.inside[1].tolist() == [
        [row <= 119 and column >= 0 for column in range(-2, 5)] for row in range(116, 123)
    ]
    assert not patches.index[1][~patches.inside[1]].any()


def test_each_pixel_has_one_number() -> None:
    """A pixel in several windows has one number; pixels outside the frame have the number after the last."""
    index = np.array([7, 3, 7, 9, 3, 3, 0, 5])
    inside = np.array([True, True, True, True, True, True, False, True])
    for form in (fit_windows._numbered.numpy_form, fit_windows._numbered.loop_form):
        pixels, slot, crowded, common, shared = form(index, inside, 12)
        assert sorted(pixels.tolist()) == [3, 5, 7, 9]
        assert pixels[slot[inside]].tolist() == index[inside].tolist()
        assert slot[6] == 4
        # The pixels 3 and 7 belong to several windows.
        assert shared == 2
        assert crowded.tolist() == [0, 1, 2, 4, 5]
        assert sorted(common[:2].tolist()) == [0, 1]
        assert common.tolist() == [common[1 if value == 3 else 0] for value in index[crowded]]


def test_windows_have_the_values_of_the_frame_and_the_pixels_that_stars_share() -> None:
    motion = CameraMotion.steady(np.array([0.01, 0.04, 0.0]))
    stars = np.array([[50.0, 30.0], [52.0, 34.0], [100.0, 80.0]])
    frame = _frame()
    windows = cut_windows(frame, _PINHOLE, Shutter(), _scene(motion, stars), 3.6)
    assert windows.long.tolist() == [0, 1, 2]
    assert windows.spot.tolist() == []
    view, strips = windows.on_strips, windows.strips
    assert len(np.unique(windows.pixels)) == len(windows.pixels)
    inside = strips.inside
    assert windows.pixels[view.slot[inside]].tolist() == strips.index[inside].tolist()
    assert np.all(view.slot[~inside] == len(windows.pixels))
    index = strips.index
    assert np.array_equal(view.signal[inside], frame.signal[index][inside])
    assert np.array_equal(view.floor[inside], frame.floor[index][inside])
    assert view.gain == frame.gain
    # The level at which a pixel saturates is relative to its background.
    level = 4000.0 - (frame.counts.astype(float) - frame.signal)
    assert view.ceiling[inside] == pytest.approx(level[index][inside], abs=0.01)
    hot = index == 30 * 150 + 50
    assert not view.inside[hot & inside].any()
    assert np.array_equal(view.inside, inside & ~frame.bad[index])
    owner = np.broadcast_to(strips.star[:, None, None], index.shape)
    of_first, of_second = (set(index[inside & (owner == star)].tolist()) for star in (0, 1))
    both = of_first & of_second
    assert windows.shared == len(both) > 20
    assert set(index.reshape(-1)[view.crowded].tolist()) == both
    assert len(view.crowded) == 2 * len(both)
    names = dict(zip(view.common.tolist(), index.reshape(-1)[view.crowded].tolist(), strict=True))
    assert sorted(names) == list(range(len(both)))
    for place, name in zip(view.crowded.tolist(), view.common.tolist(), strict=True):
        assert names[name] == index.reshape(-1)[place]
    counts = np.ones(index.shape, dtype=np.float32) * inside
    n = len(stars)
    total = windows.total(counts[:, None], np.zeros((0, 0, 0)), np.ones(n), np.zeros(n))
    assert total[:-1].sum() == inside.sum()
    assert np.count_nonzero(total[:-1] == 2.0) == len(both)
    fewer = windows.only(view.inside & (owner == 1), np.zeros((0, 0, 0), dtype=np.bool_))
    assert np.array_equal(fewer.on_strips.inside, view.inside & (owner == 1))
    assert fewer.strips is windows.strips


def test_sums_over_windows_are_those_of_each_pixel() -> None:
    """Two blocks of two pixels and one patch of three pixels add their counts to four pixels."""
    slot = np.array([0, 2, 1, 1, 0, 2, 3])
    images = np.array([[[1.0, 2.0], [-9.0, -9.0]], [[3.0, 4.0], [-9.0, -9.0]]], dtype=np.float32)
    blocks = images, np.array([10.0, 100.0]), np.array([0.5, 0.0])
    patches = np.array([[5.0, 6.0, 7.0]]), np.array([1000.0]), np.array([-0.25])
    found = fit_windows._summed(slot, blocks, patches, 4)
    assert found.tolist() == [10.5 + 4999.75, 300.0 + 400.0, 20.5 + 5999.75, 6999.75]
    assert_forms_agree(fit_windows._summed, slot, blocks, patches, 4, compiled=False)


def test_areas_are_those_of_a_straight_strip() -> None:
    """The area of a strip along a row is its width in pixels times its length with both margins."""
    motion = CameraMotion.steady(np.array([0.0, 0.05, 0.0]))
    scene = _scene(motion, np.array([[75.0, 60.0], [0.0, 60.0]]))
    room = 4.0 * 1.1
    found = window_areas(_PINHOLE, scene, 4.0)
    across = 2.0 * np.floor(room + 0.5) + 1.0
    assert found[0] == pytest.approx(across * (40.0 + 2.0 * room), rel=0.02)
    # Five of nine instants of the second path are in the frame.
    assert found[1] == pytest.approx(across * (40.0 * 5.0 / 9.0 + 2.0 * room), rel=0.02)
    nobody = _scene(motion, np.zeros((0, 2)))
    assert window_areas(_PINHOLE, nobody, 4.0).shape == (0,)


def test_the_slow_part_of_a_path_is_at_the_end_with_the_smaller_rate() -> None:
    """The fast part begins where the relative change of the speed over one PSF width falls below 5 %."""
    rate = np.array([0.0, 0.08, 0.0])
    times = np.array([[-0.5, 0.5], [-0.5, 0.5]])
    stars = np.array([[75.0, 60.0], [60.0, 30.0]])
    steady = fit_windows._divided(_PINHOLE, _scene(CameraMotion.steady(rate), stars), times)
    assert np.array_equal(steady[0], times)
    assert not steady[1].any()
    for sign in (1.0, -1.0):
        motion = CameraMotion(rate, sign * 2.0 * rate)
        fast, slow = fit_windows._divided(_PINHOLE, _scene(motion, stars), times)
        speed = np.hypot(*paths(_PINHOLE, CameraMotion.steady(rate), stars, np.zeros(2)).velocity.T)
        # The rate is 1 + 2 t relative to the mean, and the limit is sqrt(change width/(5 % speed)).
        limit = np.sqrt(2.0 * 1.1 / (fit_windows._STEADY * speed))
        border = np.clip(0.5 * (limit - 1.0), -0.5, 0.5)
        assert fast[:, 0 if sign > 0.0 else 1] == pytest.approx(sign * border, abs=0.02)
        assert (fast[:, 1] if sign > 0.0 else fast[:, 0]) == pytest.approx(np.full(2, 0.5 * sign))
        assert slow[:, 0 if sign > 0.0 else 1] == pytest.approx(np.full(2, -0.5 * sign))
        begins, ends = (0, 1) if sign > 0.0 else (1, 0)
        assert fast[:, begins] == pytest.approx(slow[:, ends])
        # If too little of a path is fast, the whole path is slow.
        short = CameraMotion(0.1 * rate, sign * 0.2 * rate)
        none, _ = fit_windows._divided(_PINHOLE, _scene(short, stars), times)
        assert not none.any()
        assert path_lengths(_PINHOLE, short, stars).max() < 8.0


def test_distances_are_those_across_and_along_the_path() -> None:
    rng = np.random.default_rng(3)
    corner = rng.integers(0, 60, (2, 3, 2))
    step = np.array([[0, 1], [1, 0]])
    position, angle = rng.uniform(0.0, 60.0, (2, 3, 2)), rng.uniform(0.0, 6.0, (2, 3))
    tangent = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    aside, ahead = path_distances(corner, step, position, tangent, 5)
    for k, b, line in np.ndindex(5, 2, 3):
        away = corner[b, line] + k * step[b] - position[b, line]
        x, y = tangent[b, line]
        assert ahead[k, b, line] == pytest.approx(away @ tangent[b, line], abs=1e-4)
        assert aside[k, b, line] == pytest.approx(away[1] * x - away[0] * y, abs=1e-4)
