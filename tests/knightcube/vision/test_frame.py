"""Tests of the properties of a frame: regions, hot pixels and saturation."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from scipy import ndimage

from knightcube.astro.arrays import BoolArray, Image
from knightcube.errors import ArgumentError
from knightcube.vision import frame
from knightcube.vision.background import Background, estimate_background
from knightcube.vision.frame import (
    Bins,
    FrameState,
    are_hot,
    at_least,
    box_sum,
    find_hot_pixels,
    frame_state,
    gain_in_counts,
    grey_image,
    in_steps,
    label_pixels,
    line_of,
    moments,
    raw_counts,
    saturation_count,
    saturation_level,
    saturation_of_bright,
)
from knightcube.vision.startracker.survey import _bright_indices, hot_pixels_above
from knightcube.vision.streaks.faint_stars import less_boxes
from tests.support.compiled_forms import assert_forms_agree


def test_dead_overexposed_and_usable_frames_are_distinguished() -> None:
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


@pytest.mark.parametrize(
    ("image", "zero", "dtype"),
    [
        (np.array([[0, 65_535]], np.int64), 0.0, np.uint16),
        (np.array([[0.0, 65_536.0]], np.float32), 0.0, np.uint32),
        (np.array([[-128, 127]], np.int8), -128.0, np.uint16),
        (np.array([[-(2**63), 5 - 2**63]], np.int64), -(2.0**63), np.uint16),
        (np.array([[2**64 - 1, 2**64 - 6]], np.uint64), 2.0**64 - 6.0, np.uint16),
        (np.array([[1e15, 1e15 + 100_000.0]]), 1e15, np.uint32),
    ],
)
def test_whole_numbers_become_the_same_counts(image: Image, zero: float, dtype: type[np.generic]) -> None:
    counts, unit, least = raw_counts(image)
    assert (counts.dtype, unit, least) == (np.dtype(dtype), 1.0, zero)
    assert counts.tolist() == [[value - min(image[0].tolist()) for value in image[0].tolist()]]


def test_other_numbers_become_sixteenths_of_their_noise() -> None:
    image = 0.4 + 0.003 * np.random.default_rng(8).normal(size=(200, 240))
    counts, unit, zero = raw_counts(image)
    assert unit == pytest.approx(0.003 / 16.0, rel=0.05)
    assert np.abs(zero + unit * counts - image).max() <= 0.5001 * unit
    image[0, 0] = 1e12
    counts, unit, zero = raw_counts(image)
    assert zero + unit * float(counts[0, 0]) == pytest.approx(1e12)
    assert gain_in_counts(2.0, 0.5) == 1.0
    assert gain_in_counts(1.0, 1e-5) == 1.0, "the pixel values are not counts"
    assert gain_in_counts(1e-4, 1.0) == 1e-4
    with pytest.raises(ArgumentError, match="scale them"):
        raw_counts(np.array([[-1.7e308, 1.7e308]]))


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.ma.masked_greater(np.arange(400).reshape(20, 20), 397), "2 masked pixels: fill them"),
        (np.zeros((1, 3), np.uint16), "an array of shape (1, 3): give (rows, columns), 16 or more each"),
        (np.zeros((20, 20), bool), "pixels of bool: give integers or floating-point numbers"),
        (np.zeros((20, 20, 3), complex), "pixels of complex128"),
        (np.full((20, 20), np.inf), "400 pixels are not finite: replace them"),
        (np.zeros((20, 20, 5)), "an array of shape (20, 20, 5): give (rows, columns), or (rows, columns, 3)"),
        ([[1, 2], [3]], "setting an array element"),
    ],
)
def test_an_array_that_cannot_be_an_image_is_refused(image: Image, message: str) -> None:
    with pytest.raises(ArgumentError, match=re.escape(f"image: {message}")) as caught:
        grey_image(image)
    assert isinstance(caught.value, ValueError)


def test_an_image_gets_a_type_that_compiled_code_knows() -> None:
    image = np.arange(400.0).reshape(20, 20)
    kinds: dict[Any, type[np.generic]] = {
        np.float16: np.float32,
        np.longdouble: np.float64,
        ">f4": np.float32,
        ">i2": np.int16,
    }
    for given, used in kinds.items():
        found = grey_image(image.astype(given))
        assert found.dtype == np.dtype(used)
        assert found.dtype.isnative
        np.testing.assert_array_equal(found, image)
    assert np.array_equal(grey_image(np.ma.masked_array(image)), image)


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
        X % 149 == 0,  # the end of a row and the start of the next row are not neighbours
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
    assert_forms_agree(label_pixels, pixel, mask.shape[1], interpreted=len(pixel) < 5_000)


_EIGHT_BITS = np.random.default_rng(1).normal(20.0, 2.0, (64, 96)).astype(np.uint8)


@pytest.mark.parametrize(("step", "offset"), [(257, 0), (16, 5), (4, 3)])
def test_counts_with_a_common_step_are_returned_in_steps(step: int, offset: int) -> None:
    pixels = _EIGHT_BITS.astype(np.uint16) * np.uint16(step) + np.uint16(offset)
    found, *lattice = in_steps(pixels)
    assert np.array_equal(found, _EIGHT_BITS)
    assert lattice == [step, offset]
    assert found.dtype == pixels.dtype


def test_repaired_pixels_between_steps_are_rounded_to_the_nearest_step() -> None:
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


def test_box_sums_are_those_of_a_loop_and_follow_the_light_that_is_taken() -> None:
    image = np.random.default_rng(4).integers(0, 50, (9, 14)).astype(np.int64)
    expected = np.zeros_like(image)
    for row in range(1, 8):
        for column in range(1, 13):
            expected[row, column] = image[row - 1 : row + 2, column - 1 : column + 2].sum()
    assert box_sum(image).tolist() == expected.tolist()
    pixels, taken = np.array([0, 20, 21, 90, 125]), np.array([3, 5, 7, 11, 13])
    left = image.copy()
    left.reshape(-1)[pixels] -= taken
    assert less_boxes(box_sum(image).reshape(-1), (9, 14), pixels, taken).tolist() == (
        box_sum(left).reshape(-1).tolist()
    )


def test_moments_are_those_of_a_uniform_line_on_any_side_of_a_point_spread() -> None:
    """A region has the moments of a uniform line in any direction, blurred by a point spread.

    The line is 12 px long, and each of its 12,001 points is spread evenly over 1 px^2.
    """
    rng = np.random.default_rng(5)
    along = np.linspace(-6.0, 6.0, 12_001)
    spread = rng.normal(0.0, 0.8, (2, len(along)))
    spread -= spread.mean(axis=1, keepdims=True)
    x, y = 40.0 + along * np.sqrt(0.5) + spread[0], 30.0 + along * np.sqrt(0.5) + spread[1]
    light = np.full(len(along), 2.0)
    owner = np.zeros(len(along), dtype=np.int64)
    # In the second region only one pixel has counts, and in the third region no pixel has counts.
    both = np.append(owner, [1, 2])
    found = moments(both, np.append(x, [7.0, 9.0]), np.append(y, [8.0, 9.0]), np.append(light, [4.0, 0.0]), 3)
    assert found.flux.tolist() == pytest.approx([24_002.0, 4.0, 0.0])
    assert found.centre[0] == pytest.approx([40.0, 30.0], abs=1e-9)
    assert found.centre[1].tolist() == [7.0, 8.0]
    assert found.centre[2].tolist() == [0.0, 0.0]
    assert found.length[0] == pytest.approx(12.0, rel=0.02)
    assert found.thickness[0] == pytest.approx(0.8, rel=0.02)
    assert found.direction[0] == pytest.approx(0.25 * np.pi, abs=0.01)
    assert found.length[1] == found.thickness[1] == 0.0


def test_the_line_of_second_moments_has_their_length_and_direction() -> None:
    axis = np.array([0.6, 0.8])
    covariance = 5.0**2 / 12.0 * np.outer(axis, axis) + 0.49 * np.eye(2)
    ends = line_of(np.array([10.0, 20.0]), covariance, 4.9)
    np.testing.assert_allclose(ends.mean(axis=0), [10.0, 20.0])
    assert np.abs(ends[1] - ends[0]) == pytest.approx(5.0 * axis)
    assert line_of(np.array([10.0, 20.0]), covariance, 5.1).tolist() == [[10.0, 20.0]] * 2


@pytest.mark.parametrize(
    ("neighbours", "hot"),
    [
        ([0.0] * 8, True),  # a single bright pixel
        ([17.9, 17.9, *[0.0] * 6], True),  # 15 % of 100 counts plus three sigmas of 1 count is 18 counts
        ([18.1, 18.1, *[0.0] * 6], False),
        ([90.0, *[0.0] * 7], True),  # two bright pixels without bright neighbours
        ([90.0, 15.9, *[0.0] * 6], True),  # a third pixel below 15 % of the brightest plus one sigma
        ([90.0, 16.1, *[0.0] * 6], False),
    ],
)
def test_hot_pixels_are_one_or_two_bright_pixels_with_dark_neighbours(
    neighbours: list[float], hot: bool
) -> None:
    light = np.array([100.0, *neighbours])
    assert are_hot(light[:, None], np.ones(1)).tolist() == [hot]
    assert are_hot(light[::-1, None], np.ones(1)).tolist() == [hot]


def test_the_limit_of_a_faint_hot_pixel_is_a_fraction_of_its_light() -> None:
    for second, hot in ((2.9, True), (3.1, False)):  # limit: 30 % of 10 counts, at a noise of 1 count
        assert are_hot(np.array([10.0, second, *[0.0] * 7])[:, None], np.ones(1)).tolist() == [hot]


def test_hot_pixels_are_found_except_on_the_border() -> None:
    signal = np.zeros((12, 15), dtype=np.float32)
    signal[4, 6] = signal[0, 3] = signal[11, 14] = 100.0
    signal[8:10, 9:11] = 100.0  # four bright pixels in a square are not hot
    row, column = find_hot_pixels(signal, np.ones_like(signal), 1.0)
    assert (row.tolist(), column.tolist()) == ([4], [6])
    assert not len(find_hot_pixels(signal, np.full_like(signal, 13.0**2), 13.0**2)[0])  # below eight sigmas


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32])
def test_the_fast_search_finds_the_same_hot_pixels_as_the_search_with_a_background_of_every_pixel(
    kind: type[np.generic],
) -> None:
    rng = np.random.default_rng(31)
    frame = rng.normal(40.0, 3.0, (203, 331)) + np.linspace(0.0, 90.0, 331)
    places = rng.integers(0, frame.size, 400)
    frame.reshape(-1)[places] += rng.uniform(10.0, 120.0, 400)
    pixels = np.rint(np.clip(frame, 0.0, 255.0)).astype(kind)
    background = estimate_background(pixels, 64, 8)
    noise = background.map(background.noise)
    expected = find_hot_pixels(pixels - background.map(background.level), noise * noise, 0.0)
    found = hot_pixels_above(pixels, background, 10)
    assert len(expected[0]) > 100
    assert np.array_equal(found, expected)
    assert not len(hot_pixels_above(pixels, background, pixels.size)[0])


def test_the_saturation_is_a_count_that_several_pixels_share() -> None:
    pixels = np.random.default_rng(6).integers(0, 900, (60, 60)).astype(np.uint16)
    pixels[pixels == 899] = 898
    assert saturation_count(pixels) == (898.0 if np.count_nonzero(pixels == 898) >= 6 else 65_535.0)
    pixels[0, :6] = 1000
    assert saturation_count(pixels) == 1000.0
    pixels[0, 0] = 0
    assert saturation_count(pixels) == 65_535.0
    assert saturation_count(np.full((4, 4), 7, dtype=np.uint8)) == 255.0


def test_a_plateau_of_bright_counts_holds_more_pixels_than_the_counts_below_it() -> None:
    frame = np.zeros((4, 4), dtype=np.uint16)
    bright = np.concatenate([np.linspace(100.0, 900.0, 50), np.full(4, 1000.0)])
    assert saturation_of_bright(bright, frame, None) == 1000.0
    assert saturation_of_bright(bright, frame, 800.0) == 800.0
    assert saturation_of_bright(bright[:-1], frame, None) == 65_535.0  # three saturated pixels are too few
    crowded = np.concatenate([bright, np.full(3, 995.0)])  # counts within 2 % of the range below the plateau
    assert saturation_of_bright(crowded, frame, None) == 65_535.0
    assert saturation_of_bright(np.zeros(0), frame, None) == 65_535.0


def test_levels_between_counts_and_beyond_the_type_compare_as_numbers_do() -> None:
    pixels = np.array([0, 9, 10, 255], dtype=np.uint8)
    assert at_least(pixels, 9.5).tolist() == [False, False, True, True]
    assert at_least(pixels, 10.0).tolist() == [False, False, True, True]
    assert at_least(pixels, 256.0).tolist() == [False] * 4
    assert at_least(pixels, -1.0).tolist() == [True] * 4
    assert at_least(pixels.astype(float), 9.5).tolist() == [False, False, True, True]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_the_compiled_search_of_bright_pixels_equals_that_in_numpy(dtype: type[np.number[Any]]) -> None:
    draw = np.random.default_rng(5)
    pixels = draw.integers(0, 200, (50, 37)).astype(dtype)
    assert_forms_agree(_bright_indices, pixels, draw.integers(150, 199, (3, 2)).astype(dtype))
    assert_forms_agree(_bright_indices, pixels, np.full((1, 1), 255, dtype=dtype))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_the_compiled_search_of_hot_pixels_equals_that_in_numpy(dtype: type[np.generic]) -> None:
    draw = np.random.default_rng(8)
    pixels = np.clip(draw.normal(60.0, 6.0, (43, 70)), 0.0, 255.0).astype(dtype)
    pixels.reshape(-1)[draw.integers(0, pixels.size, 60)] = 250
    level, variance = draw.uniform(40.0, 80.0, (3, 4)), draw.uniform(30.0, 50.0, (3, 4))
    signal, floor = Background(level, variance**0.5, (43, 70)).subtracted(pixels)
    assert len(frame._find_hot_pixels_numpy(signal, floor, 30.0)[0]) > 20
    assert_forms_agree(find_hot_pixels, signal, floor, 30.0)
    assert_forms_agree(frame._box_sum, signal, relative=1e-6)


def test_the_compiled_moments_of_regions_equal_those_in_numpy() -> None:
    """The compiled moments of regions equal the moments by numpy.

    One region has no pixels, and one region has only pixels without light.
    """
    draw = np.random.default_rng(7)
    owner = draw.integers(0, 5, 300)
    light = np.where(owner == 2, 0.0, draw.uniform(0.0, 90.0, 300))
    column, row = draw.integers(0, 60, (2, 300))
    assert_forms_agree(frame._moment_sums, owner, column, row, light, 6)
    assert frame._moment_sums_numpy(owner, column, row, light, 6)[:, [2, 5]].tolist() == [[0.0, 0.0]] * 6


def test_the_compiled_hot_pixels_are_those_of_numpy_among_pairs_and_squares() -> None:
    draw = np.random.default_rng(9)
    signal = draw.normal(0.0, 1.0, (60, 50)).astype(np.float32)
    signal[draw.random(signal.shape) < 0.05] += 60.0
    signal[draw.random(signal.shape) < 0.05] += 25.0
    assert_forms_agree(find_hot_pixels, signal, np.ones_like(signal), 1.0)
    row, column = np.divmod(np.flatnonzero(signal > 5.0), 50)
    noise, level = draw.uniform(0.5, 1.5, len(row)), draw.normal(0.0, 1.0, len(row))
    assert_forms_agree(
        are_hot, draw.uniform(0.0, 30.0, (9, 200)) * draw.choice([0.1, 1.0, 9.0], 200), np.ones(200)
    )
    for pixels in (signal, np.clip(signal + 20.0, 0.0, 255.0).astype(np.uint8)):
        assert_forms_agree(frame.hot_among, pixels, row, column, noise, level)
    assert len(frame.hot_among.numpy_form(signal, row, column, noise, level)[0]) > 20


@pytest.mark.parametrize(
    ("length", "size", "bins"),
    [(9, 3, 3), (10, 3, 2), (11, 3, 3), (12, 3, 4), (25, 5, 5), (26, 5, 4), (27, 5, 5)],
)
def test_bins_leave_equal_margins(length: int, size: int, bins: int) -> None:
    for shape in ((length, 27), (27, length)):
        found = Bins.centred(shape, size)
        assert found is not None
        assert found.sums(np.zeros(shape, np.uint8)).shape[shape.index(length)] == bins
    assert (length - size * bins) % 2 == 0


def test_bins_of_even_size_need_an_even_margin() -> None:
    assert Bins.centred((12, 13), 2) is None
    assert Bins.centred((12, 14), 4) == Bins(4, 3, 3, (1, 0))


@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.float32])
def test_pixels_of_a_bin_are_summed_without_overflow(dtype: type[np.generic]) -> None:
    image = np.random.default_rng(1).integers(0, 120, (11, 15)).astype(dtype)
    image[1:4] = 120
    bins = Bins.centred(image.shape, 3)
    assert bins is not None
    found = bins.sums(image)
    # The margin of one row is equal at both ends: rows 1 to 9 and all columns are summed.
    expected = [
        [
            image[1 + 3 * row : 4 + 3 * row, 3 * column : 3 * column + 3].astype(float).sum()
            for column in range(5)
        ]
        for row in range(3)
    ]
    assert found.tolist() == expected
    assert found[0, 0] == 9 * 120


@pytest.mark.parametrize("dtype", [np.uint16, np.uint32, np.int32, np.float64])
def test_bright_pixels_of_a_bin_are_summed_exactly(dtype: type[np.generic]) -> None:
    highest = 2**40 + 1 if np.dtype(dtype).kind == "f" else int(np.iinfo(np.dtype(dtype)).max)
    image = np.full((9, 9), highest, dtype)
    bins = Bins.centred(image.shape, 3)
    assert bins is not None
    assert bins.sums(image)[0, 0].item() == 9 * highest
