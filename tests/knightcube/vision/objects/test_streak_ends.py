"""Tests of regions, corners and ends of streaks, and of the centre of rotation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from knightcube.astro.arrays import FloatArray
from knightcube.vision.frame import box_sum, repair_hot_pixels
from knightcube.vision.objects import streak_ends
from knightcube.vision.objects.settings import EndpointSettings
from knightcube.vision.objects.streak_ends import (
    Regions,
    _bounding_boxes,
    _corners_of_regions,
    centre_of_intensity,
    centre_of_rotation,
    chord_outward,
    expected_sigma,
    extend,
    find_corners,
    find_regions,
    flashes_of_objects,
    gaussian_derivative_kernel,
    gaussian_kernel,
    gradient,
    harris_cornerness,
    harris_response,
    kernel_radius,
    local_maxima,
    measure_streaks,
    near_border,
    pixels_of_region,
    segment_frame,
    smoothed,
    structure_tensor,
    threshold_local,
    threshold_mean,
)
from knightcube.vision.streaks.faint_stars import less_boxes
from tests.support.compiled_forms import assert_forms_agree
from tests.support.streak_frames import deposit, rate_at, star_camera, star_frame


def test_the_box_sum_is_nine_times_the_uniform_filter() -> None:
    image = np.random.default_rng(1).normal(size=(20, 31))
    np.testing.assert_allclose(box_sum(image)[1:-1, 1:-1], 9.0 * ndimage.uniform_filter(image, 3)[1:-1, 1:-1])


def test_diagonal_neighbours_are_one_region_and_small_regions_are_dropped() -> None:
    mask = np.zeros((30, 40), dtype=np.bool_)
    mask[np.arange(5, 25), np.arange(10, 30)] = True
    mask[2, 35] = True
    regions = find_regions(mask, mask.astype(np.float32), least_area=2)
    assert len(regions) == 1
    np.testing.assert_array_equal(regions.boxes, [[5, 25, 10, 30]])
    assert regions.area[0] == 20


def test_a_lines_length_comes_from_its_moments_whatever_its_width() -> None:
    signal = np.zeros((60, 120), dtype=np.float32)
    signal[20:25, 10:91] = 3.0
    regions = find_regions(signal > 0, signal, least_area=2)
    # For whole pixels, the two second moments differ by (81^2 - 1 - (5^2 - 1))/12.
    assert regions.length[0] == pytest.approx(np.sqrt(81.0**2 - 5.0**2))
    assert regions.flux[0] == pytest.approx(3.0 * 5 * 81)


def test_an_empty_mask_has_no_regions() -> None:
    empty = np.zeros((16, 16), dtype=np.bool_)
    assert len(find_regions(empty, empty.astype(np.float32), 1)) == 0


def test_the_local_threshold_passes_normal_noise_at_its_own_rate() -> None:
    signal = np.random.default_rng(4).normal(0.0, 5.0, (700, 700)).astype(np.float32)
    passed = threshold_local(signal, np.full_like(signal, 5.0), 2.0).mean()
    # A normal variable exceeds 2 sigma with a probability of 2.275 %. About 54,000 of the correlated sums are
    # independent of each other.
    assert passed == pytest.approx(0.02275, abs=5.0 * np.sqrt(0.02275 / 54_000))


def test_the_thesiss_threshold_passes_half_of_a_noise_frame() -> None:
    noise = np.random.default_rng(5).normal(100.0, 10.0, (200, 200))
    assert threshold_mean(noise).mean() == pytest.approx(0.5, abs=0.02)


def test_hot_pixels_are_repaired_and_stars_are_left() -> None:
    camera = star_camera(512, psf_sigma=0.7)
    pixels = star_frame(camera, rate_at(0.5 * np.pi, 0.0), 1.0, seed=6)
    signal = pixels.astype(np.float32) - 150.0
    noise = np.full_like(signal, np.sqrt(150.0))
    clean = signal.copy()
    assert repair_hot_pixels(clean, noise) == 0
    np.testing.assert_array_equal(clean, signal)
    places = np.random.default_rng(7).integers(1, 511, (40, 2))
    places = places[clean[places[:, 0], places[:, 1]] < 60.0]
    for row, column in places:
        signal[row, column] = 3000.0
    assert repair_hot_pixels(signal, noise) == len(np.unique(places, axis=0))
    assert signal[places[:, 0], places[:, 1]].max() < 300.0


def test_sums_after_subtraction_are_those_of_the_remaining_light() -> None:
    """Sums after the subtraction of stars are sums of the remaining light, even at corners and edges."""
    generator = np.random.default_rng(9)
    image = generator.integers(0, 1000, (40, 50)).astype(np.float32)
    pixels = np.unique(np.append(generator.integers(0, image.size, 300), [0, 49, 50, image.size - 1]))
    taken = generator.integers(0, 500, len(pixels)).astype(np.float32)
    left = image.copy().reshape(-1)
    left[pixels] -= taken
    found = less_boxes(box_sum(image).reshape(-1), (40, 50), pixels, taken)
    np.testing.assert_array_equal(found.reshape(40, 50), box_sum(left.reshape(40, 50)))


def test_the_derivative_kernel_is_the_published_one_of_3_4() -> None:
    printed = np.array([[0.0466, 0, -0.0466], [0.3446, 0, -0.3446], [0.0466, 0, -0.0466]])
    kernel = np.outer(gaussian_kernel(0.5, 1), gaussian_derivative_kernel(0.5, 1))
    # Equation 3.4 is a convolution, which mirrors the kernel.
    np.testing.assert_allclose(kernel[:, ::-1], printed, atol=5.5e-5)


def test_the_gradient_of_a_ramp_is_its_slope() -> None:
    y, x = np.mgrid[0:40, 0:50]
    gx, gy = gradient(3.0 * x - 2.0 * y, sigma=1.0)
    # The kernels end at three sigma, and 3 % of the weight of the derivative lies beyond.
    np.testing.assert_allclose(gx[8:-8, 8:-8], 3.0, rtol=0.03)
    np.testing.assert_allclose(gy[8:-8, 8:-8], -2.0, rtol=0.03)


def _by_hand(image: FloatArray, row: int, column: int, sigma: float, window: float) -> FloatArray:
    """Return the structure tensor (2, 2) at one pixel by plain double sums."""
    r, w = kernel_radius(sigma), kernel_radius(window)
    tensor = np.zeros((2, 2))
    for j in range(-w, w + 1):
        for i in range(-w, w + 1):
            g = np.zeros(2)
            for n in range(-r, r + 1):
                for m in range(-r, r + 1):
                    value = image[row + j + n, column + i + m]
                    bell = np.exp(-(m * m + n * n) / (2 * sigma**2)) / (2 * np.pi * sigma**2)
                    g += value * bell * np.array([m, n]) / sigma**2
            weight = np.exp(-(i * i + j * j) / (2 * window**2)) / (2 * np.pi * window**2)
            tensor += weight * np.outer(g, g)
    return tensor


def test_the_structure_tensor_equals_a_hand_computation() -> None:
    image = np.random.default_rng(1).normal(size=(25, 25))
    tensor = structure_tensor(image, 1.0, 1.5)
    expected = _by_hand(image, 12, 11, 1.0, 1.5)
    found = [[tensor.xx[12, 11], tensor.xy[12, 11]], [tensor.xy[12, 11], tensor.yy[12, 11]]]
    np.testing.assert_allclose(found, expected, rtol=1e-10)


def test_without_the_window_the_tensor_would_have_rank_one() -> None:
    image = np.random.default_rng(2).normal(size=(25, 25))
    gx, gy = gradient(image, 1.0)
    np.testing.assert_allclose(gx * gx * gy * gy - (gx * gy) ** 2, 0.0, atol=1e-12)
    tensor = structure_tensor(image, 1.0, 1.5)
    determinant = tensor.xx * tensor.yy - tensor.xy**2
    assert determinant.min() > 0.0


def test_the_harris_response_is_that_of_the_eigenvalues() -> None:
    image = np.random.default_rng(3).normal(size=(20, 20))
    tensor = structure_tensor(image, 1.0, 1.5)
    matrices = np.stack([np.stack([tensor.xx, tensor.xy], -1), np.stack([tensor.xy, tensor.yy], -1)], -2)
    low, high = np.moveaxis(np.linalg.eigvalsh(matrices), -1, 0)
    expected = low * high - 0.15 * (low + high) ** 2
    np.testing.assert_allclose(harris_response(tensor, 0.15), expected, rtol=1e-9, atol=1e-12)


def test_the_response_is_negative_on_an_edge_and_positive_on_a_corner() -> None:
    image = np.zeros((40, 40))
    image[20:, 20:] = 1.0
    response = harris_response(structure_tensor(image, 1.0, 1.5))
    assert response[20, 35] < 0.0
    assert response[20, 20] > 0.0


def test_smoothing_keeps_the_light_and_none_keeps_the_image() -> None:
    image = np.zeros((31, 31))
    image[15, 15] = 7.0
    blurred = smoothed(image, 1.3)
    np.testing.assert_allclose(blurred.sum(), 7.0, rtol=1e-12)
    assert blurred[15, 15] < 1.0
    np.testing.assert_array_equal(smoothed(image, 0.0), image)


def test_only_pixels_above_all_eight_neighbours_are_peaks() -> None:
    response = np.zeros((7, 9))
    response[2, 3], response[2, 4], response[5, 7] = 5.0, 4.0, 2.0
    everywhere = np.ones(response.shape, dtype=np.bool_)
    np.testing.assert_array_equal(local_maxima(response, everywhere, 0.1), [[3, 2], [7, 5]])
    np.testing.assert_array_equal(local_maxima(response, everywhere, 0.5), [[3, 2]])
    masked = everywhere.copy()
    masked[2, 3] = False
    np.testing.assert_array_equal(local_maxima(response, masked, 0.1), [[7, 5]])


def test_a_response_without_corners_has_no_peaks() -> None:
    assert len(local_maxima(np.full((6, 6), -1.0), np.ones((6, 6), dtype=np.bool_), 0.1)) == 0


def test_the_centre_of_intensity_carries_the_coordinate() -> None:
    image = np.zeros((9, 9))
    image[4, 4], image[4, 5], image[3, 4] = 2.0, 1.0, 1.0
    np.testing.assert_allclose(centre_of_intensity(image, np.array([4, 4]), 3), [4.25, 3.75])


def test_a_window_cut_by_the_border_stays_centred() -> None:
    np.testing.assert_allclose(centre_of_intensity(np.ones((9, 9)), np.array([1, 4]), 3), [1.0, 4.0])


def test_extension_moves_both_ends_outward() -> None:
    ends = np.array([[[10.0, 10.0], [13.0, 14.0]]])
    moved = extend(ends, chord_outward(ends), 5.0)
    np.testing.assert_allclose(moved, [[[7.0, 6.0], [16.0, 18.0]]])


def test_extension_does_not_move_the_equal_ends_of_a_point() -> None:
    ends = np.array([[[10.0, 10.0], [10.0, 10.0]], [[0.0, 0.0], [0.0, 1.0]]])
    moved = extend(ends, chord_outward(ends), 5.0)
    np.testing.assert_array_equal(moved, [[[10.0, 10.0], [10.0, 10.0]], [[0.0, -5.0], [0.0, 6.0]]])


def test_the_centre_of_rotation_is_the_axis_projected() -> None:
    centre = np.array([700.0, 200.0])
    angle = np.array([0.1, 1.0, 2.3, 4.0])
    radius = np.array([[100.0], [200.0], [300.0], [50.0]])
    first = centre + radius * np.stack([np.cos(angle), np.sin(angle)], -1)
    second = centre + radius * np.stack([np.cos(angle + 0.4), np.sin(angle + 0.4)], -1)
    np.testing.assert_allclose(centre_of_rotation(np.stack([first, second], axis=1)), centre)


def test_parallel_streaks_have_no_centre_of_rotation() -> None:
    streaks = np.array([[[0.0, 0.0], [10.0, 0.0]], [[50.0, 40.0], [70.0, 40.0]]])
    assert np.isnan(centre_of_rotation(streaks)).all()


def test_all_forms_find_the_same_bright_pixels_boxes_and_regions() -> None:
    draw = np.random.default_rng(6)
    signal = (5.0 * ndimage.gaussian_filter(draw.normal(size=(30, 41)), 1.0)).astype(np.float32)
    noise = draw.uniform(0.2, 0.6, signal.shape).astype(np.float32)
    assert_forms_agree(threshold_local, signal, noise, 2.0)
    mask = threshold_local(signal, noise, 2.0)
    regions = find_regions(mask, signal, 1)
    assert len(regions) > 5
    row, column = np.nonzero(mask)
    number = regions.labels[row, column].astype(np.int64) - 1
    assert_forms_agree(_bounding_boxes, number, row, column, len(regions))
    for box, label in zip(regions.boxes, regions.label.tolist(), strict=True):
        assert_forms_agree(pixels_of_region, regions.labels, box, label)


@pytest.mark.parametrize("upright", [False, True])
@pytest.mark.parametrize("half_width", [0, 3])
def test_all_forms_find_the_same_corners_of_regions(half_width: int, upright: bool) -> None:
    """The compiled and the numpy implementation find the same corners of regions.

    The regions include a bright streak, noise peaks, and regions at the border of the frame.
    """
    draw = np.random.default_rng(5)
    signal = 10.0 * ndimage.gaussian_filter(draw.normal(size=(40, 50)), 1.2)
    signal += 40.0 * np.exp(-0.5 * (np.arange(40)[:, None] - 14.0 - 0.3 * np.arange(50)) ** 2)
    signal = np.ascontiguousarray(signal.T) if upright else signal
    regions = find_regions(signal > 3.0, signal.astype(np.float32), 1)
    labels = np.ascontiguousarray(regions.labels, dtype=np.int32)
    kernels = gaussian_kernel(1.0, 3), gaussian_derivative_kernel(1.0, 3), gaussian_kernel(1.5, 5)
    limits = 0.15, 0.005, half_width
    given = signal.astype(np.float32), labels, regions.boxes, regions.label, kernels, limits
    assert_forms_agree(_corners_of_regions, *given, relative=1e-6)
    assert _corners_of_regions(*given)[1].sum() > 1


def _regions(boxes: list[list[int]]) -> Regions:
    n = len(boxes)
    return Regions(
        np.zeros((60, 80), np.int32),
        np.arange(1, n + 1),
        np.array(boxes),
        np.full(n, 100),
        np.linspace(2000.0, 9000.0, n),
        np.linspace(20.0, 47.0, n),
    )


def test_regions_near_any_border_may_be_truncated() -> None:
    """A box of rows 5 to 54 and columns 5 to 74 is 5 px from each border of 60 x 80 px."""
    inner = [5, 55, 5, 75]
    boxes = [inner, [4, 55, 5, 75], [5, 56, 5, 75], [5, 55, 4, 75], [5, 55, 5, 76]]
    assert near_border(_regions(boxes), (60, 80), 5).tolist() == [False, True, True, True, True]
    assert not near_border(_regions(boxes), (60, 80), 4).any()


_DRAWN = (
    (np.array([[40.0, 30.0], [95.0, 52.0]]), 40_000.0),
    (np.array([[30.0, 90.0], [80.0, 84.0]]), 12_000.0),
    (np.array([[120.0, 40.0], [150.0, 100.0]]), 25_000.0),
    (np.array([[2.0, 110.0], [40.0, 115.0]]), 30_000.0),
    (np.array([[100.0, 112.0], [108.0, 113.0]]), 9_000.0),
)


def _frame() -> FloatArray:
    """Return a frame of 180 x 130 px with three streaks, a truncated streak and a short streak."""
    image = np.random.default_rng(6).normal(300.0, 6.0, (130, 180))
    for ends, flux in _DRAWN:
        deposit(image, ends[0] + np.linspace(0.0, 1.0, 801)[:, None] * np.diff(ends, axis=0), flux, 1.0)
    return np.rint(image)


def test_long_regions_inside_the_frame_are_candidates_the_strongest_first() -> None:
    settings = EndpointSettings(gain=2.0)
    found = segment_frame(_frame().astype(np.uint16), settings)
    assert len(found.regions) == 5
    candidates = found.candidates
    assert candidates.length == pytest.approx([59.2, 67.1, 50.4], abs=2.0)
    assert candidates.flux == pytest.approx([40_000.0, 25_000.0, 12_000.0], rel=0.03)
    # The strength is the length divided by the expected error of the ends.
    sigma = expected_sigma(candidates, found.background, settings)
    assert np.all(np.diff(candidates.length / sigma) < 0.0)
    density = candidates.flux / (candidates.length + 3.0)
    noise = np.sqrt(6.0**2 + streak_ends._PEAK_FRACTION * density / 2.0) / density
    assert sigma == pytest.approx(
        np.hypot(settings.endpoint_floor, settings.endpoint_noise * noise), rel=0.03
    )
    for most in (1, 2):
        few = segment_frame(_frame().astype(np.uint16), EndpointSettings(gain=2.0, most_streaks=most))
        assert few.candidates.label.tolist() == candidates.label[:most].tolist()
    # The brightest streak is saturated.
    top = float(_frame()[25:60, 35:100].max())
    clipped = segment_frame(_frame().astype(np.uint16), EndpointSettings(gain=2.0, saturation=top - 1.0))
    assert sorted(clipped.candidates.length) == pytest.approx(sorted(candidates.length[1:]))
    whole = segment_frame(_frame().astype(np.uint16), EndpointSettings(gain=2.0, saturation=top + 1.0))
    assert len(whole.candidates) == 3
    long = segment_frame(_frame().astype(np.uint16), EndpointSettings(least_length=100.0))
    assert len(long.candidates) == 0
    everywhere = segment_frame(_frame().astype(np.uint16), EndpointSettings(border=0))
    assert len(everywhere.candidates) == 4
    noise_level = found.background.typical_noise
    significance = found.regions.flux / (noise_level * np.sqrt(found.regions.area))
    limit = float(np.sort(significance)[2])
    assert found.regions.is_significant(0.999 * limit, found.background).sum() == 3
    assert found.regions.is_significant(1.001 * limit, found.background).sum() == 2


@pytest.mark.parametrize("centre_of", ["response", "image"])
def test_streaks_have_their_two_ends(centre_of: str) -> None:
    """The two corners of a region are the ends of its streak.

    The corners are up to 2 px inside the streak if they are centres of the image instead of the response.
    """
    settings = EndpointSettings(gain=2.0, centre_of=centre_of)  # type: ignore[arg-type]  # one of two words
    segmented = segment_frame(_frame().astype(np.uint16), settings)
    found = measure_streaks(segmented, settings)
    own = measure_streaks(segmented, settings, harris_cornerness)
    assert len(found) == len(own) == 3
    assert own.endpoints == pytest.approx(found.endpoints, abs=1e-6)
    truth = [ends for ends, _ in _DRAWN[:3]]
    for ends, flux, sigma in zip(found.endpoints, found.flux, found.sigma, strict=True):
        off = [min(np.abs(ends - each).max(), np.abs(ends[::-1] - each).max()) for each in truth]
        best = int(np.argmin(off))
        assert off[best] < (0.5 if centre_of == "response" else 2.5)
        assert flux == pytest.approx(_DRAWN[best][1], rel=0.03)
        assert 0.03 < sigma < 0.2
    assert found.lengths == pytest.approx(np.linalg.norm(np.diff(found.endpoints, axis=1)[:, 0], axis=1))
    assert found.candidate.tolist() == [0, 1, 2]
    assert found.crowded == ()


def test_regions_with_more_than_two_corners_are_reported_apart() -> None:
    image = np.random.default_rng(6).normal(300.0, 6.0, (130, 180))
    for ends in (np.array([[30.0, 30.0], [130.0, 90.0]]), np.array([[95.0, 38.0], [65.0, 83.0]])):
        deposit(image, ends[0] + np.linspace(0.0, 1.0, 801)[:, None] * np.diff(ends, axis=0), 30_000.0, 1.0)
    settings = EndpointSettings()
    found = measure_streaks(segment_frame(np.rint(image).astype(np.uint16), settings), settings)
    assert len(found) == 0
    ((index, corners),) = found.crowded
    assert index == 0
    assert len(corners) >= 4
    for place in ([30.0, 30.0], [130.0, 90.0], [95.0, 38.0], [65.0, 83.0]):
        assert np.linalg.norm(corners - place, axis=1).min() < 1.0


def test_corners_are_the_centres_of_intensity_around_peaks() -> None:
    response = np.zeros((9, 12))
    response[3, 4], response[3, 5], response[6, 9] = 8.0, 2.0, 5.0
    response[6, 2] = 0.3
    mask = np.ones((9, 12), dtype=np.bool_)
    found = find_corners(response, mask, 0.05, 1, response)
    assert found == pytest.approx(np.array([[4.2, 3.0], [9.0, 6.0]]))
    assert len(find_corners(response, mask, 0.03, 1, response)) == 3
    mask[3, 4] = False
    assert find_corners(response, mask, 0.05, 1, response)[-1] == pytest.approx([9.0, 6.0])


@pytest.mark.parametrize(
    ("spans", "expected"),
    [
        ([(40.0, 50.0), (0.0, 10.0), (20.0, 30.0)], [[0, 2, 1]]),
        ([(0.0, 10.0), (5.0, 15.0)], [[0], [1]]),
        ([(0.0, 3.0), (60.0, 63.0)], [[0], [1]]),
        ([(0.0, 0.0), (60.0, 60.0)], [[0], [1]]),
    ],
    ids=["flashes", "overlapping", "far apart", "points"],
)
@pytest.mark.parametrize("aside", [0.0, 8.0])
def test_streaks_along_one_line_are_flashes_of_one_object(
    spans: list[tuple[float, float]], expected: list[list[int]], aside: float
) -> None:
    """Flashes are joined if they lie on one line, do not overlap and are not far apart.

    If the streaks are displaced by 8 px from each other, they are different objects.
    """
    along, across = np.array([0.8, 0.6]), np.array([-0.6, 0.8])
    ends = np.array([[x * along + aside * k * across for x in span] for k, span in enumerate(spans)])
    # The streaks of a group are in the order along the line, in either direction.
    found = [min(group, group[::-1]) for group in flashes_of_objects(ends + 100.0)]
    assert found == (expected if aside == 0.0 else [[k] for k in range(len(ends))])
    assert flashes_of_objects(np.zeros((0, 2, 2))) == []
