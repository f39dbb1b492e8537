"""Local level and noise, and the frames that are not worth looking at.

Regions of pixels against scipy's labels.

The step between the counts of a frame.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from knightcube.astro.arrays import BoolArray
from knightcube.vision.frame import (
    FrameState,
    estimate_background,
    frame_state,
    in_steps,
    label_pixels,
    saturation_level,
)
from tests.support.streak_frames import rate_at, star_camera, star_frame


def test_a_sloping_background_is_followed_within_its_sampling_error() -> None:
    rng = np.random.default_rng(1)
    slope = 100.0 + 0.2 * np.arange(512.0)[None, :] + np.zeros((512, 1))
    pixels = np.rint(slope + rng.normal(0.0, 12.0, slope.shape)).astype(np.uint16)
    background = estimate_background(pixels)
    error = background.map(background.level) - slope
    # 256 samples a block give 12/16 counts: six times that for the worst of 64 blocks, the rim apart.
    assert np.abs(error[:, 32:-32]).max() < 4.5
    # Within a block the slope spans 12.8 counts: sqrt(12^2 + 12.8^2/12) = 12.6.
    assert background.noise.mean() == pytest.approx(12.6, rel=0.03)


def test_streaks_hardly_move_level_and_noise() -> None:
    camera = star_camera(512)
    pixels = star_frame(camera, rate_at(0.5 * np.pi, 0.02), 1.0, seed=2)
    background = estimate_background(pixels)
    # Pedestal 100 and 50 electrons of dark; read noise 10 and the dark's own: sqrt(150).
    assert np.median(background.level) == pytest.approx(150.0, abs=1.0)
    assert np.median(background.noise) == pytest.approx(np.sqrt(150.0), rel=0.05)


def test_noise_below_the_rounding_is_not_called_zero() -> None:
    background = estimate_background(np.full((128, 128), 7, dtype=np.uint8))
    np.testing.assert_allclose(background.noise, np.sqrt(1.0 / 12.0))


def test_a_frame_that_blocks_do_not_divide_is_covered() -> None:
    background = estimate_background(np.full((150, 201), 9, dtype=np.uint16))
    level = background.map(background.level)
    assert level.shape == (150, 201)
    np.testing.assert_allclose(level, 9.0, rtol=1e-6)


def test_dead_overexposed_and_living_frames_are_told_apart() -> None:
    rng = np.random.default_rng(3)
    dead = np.zeros((256, 256), dtype=np.uint16)
    dead[10, 20] = 4000
    noise = np.rint(rng.normal(100.0, 10.0, (256, 256))).astype(np.uint16)
    bright = noise.copy()
    bright[:, :100] = 4095
    assert frame_state(dead, 4095.0, 0.25) is FrameState.BLACK
    assert frame_state(np.full((256, 256), 4095, dtype=np.uint16), 4095.0, 0.25) is FrameState.SATURATED
    assert frame_state(bright, 4095.0, 0.25) is FrameState.SATURATED
    assert frame_state(bright, 4095.0, 0.5) is FrameState.USABLE
    assert frame_state(noise, 4095.0, 0.25) is FrameState.USABLE


def test_saturation_is_the_integer_types_top_unless_given() -> None:
    assert saturation_level(np.zeros(1, dtype=np.uint8), None) == 255.0
    assert saturation_level(np.zeros(1, dtype=np.uint16), 4095.0) == 4095.0


Y, X = np.indices((200, 150))
RNG = np.random.default_rng(0)
SPIRAL = (np.hypot(Y - 100, X - 75) + np.arctan2(Y - 100, X - 75) * 6.0 / np.pi) % 12.0 < 4.0


@pytest.mark.parametrize(
    "mask",
    [
        np.zeros((200, 150), dtype=bool),
        np.ones((200, 150), dtype=bool),
        *(RNG.random((200, 150)) < share for share in (0.001, 0.1, 0.4, 0.6)),
        (X + Y) % 40 < 3,
        (X % 7 < 2) | (RNG.random((200, 150)) < 0.02),
        SPIRAL,
        X % 149 == 0,  # the ends of rows touch nothing
    ],
)
def test_regions_are_scipys_numbered_by_their_first_pixels(mask: BoolArray) -> None:
    pixel = np.flatnonzero(mask)
    number, count = label_pixels(pixel, mask.shape[1])
    labels, wanted = ndimage.label(mask, np.ones((3, 3)))
    own = labels.ravel()[pixel]
    _, first, group = np.unique(own, return_index=True, return_inverse=True)
    assert count == wanted
    np.testing.assert_array_equal(number, np.argsort(np.argsort(first))[group])


_EIGHT_BITS = np.random.default_rng(1).normal(20.0, 2.0, (64, 96)).astype(np.uint8)


@pytest.mark.parametrize(("step", "offset"), [(257, 0), (16, 5), (4, 3)])
def test_counts_that_share_a_step_come_back_in_steps(step: int, offset: int) -> None:
    pixels = _EIGHT_BITS.astype(np.uint16) * np.uint16(step) + np.uint16(offset)
    found, *lattice = in_steps(pixels)
    assert np.array_equal(found, _EIGHT_BITS)
    assert lattice == [step, offset]
    assert found.dtype == pixels.dtype


def test_a_few_repaired_pixels_between_the_steps_go_to_the_nearest() -> None:
    pixels = _EIGHT_BITS.astype(np.uint16) * np.uint16(257)
    pixels[3, 5] = 20 * 257 + 200
    found, step, _ = in_steps(pixels)
    assert step == 257
    assert found[3, 5] == 21


def test_counts_without_a_common_step_and_constant_ones_stay_as_they_are() -> None:
    for pixels in (_EIGHT_BITS, np.full((64, 64), 7, np.uint16)):
        found, step, offset = in_steps(pixels)
        assert found is pixels
        assert (step, offset) == (1, 0)
