"""Tests of bright regions, binning, point-spread width, limbs and colour mosaics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from knightcube.astro.arrays import Image
from knightcube.vision.camera.lens import EXACT, Pinhole
from knightcube.vision.streaks.estimate import estimate_motion
from knightcube.vision.streaks.frame import (
    Binning,
    BrightRegions,
    ReducedFrame,
    find_bright_regions,
    measured_psf_sigma,
    prepare_frames,
    reduce_frame,
    without_glare,
    without_mosaic,
)
from knightcube.vision.streaks.streak_result import LikelihoodSettings, MotionResult, StreakStatus
from tests.knightcube.vision.streaks.scenes import CAMERA, SATURATION, Scene, real_sky

_SHAPE = (60, 90)
_LEAST = 12


def _frame(mask: np.ndarray) -> ReducedFrame:
    """Return a frame whose 3 x 3 sums exceed the threshold where `mask` (rows, columns) is true."""
    light = np.where(mask, 100.0, 0.0).astype(np.float32).reshape(-1)
    light += mask.reshape(-1) * np.arange(mask.size, dtype=np.float32) % 7
    nothing = np.zeros(mask.size, dtype=np.bool_)
    counts = np.zeros(mask.size, dtype=np.uint16)
    return ReducedFrame(_SHAPE, light, light, np.ones_like(light), counts, 4095.0, nothing, 1.0, 0)


@pytest.mark.parametrize("share", [0.02, 0.2, 0.35, 0.45, 0.7])
def test_regions_are_those_of_an_independent_labelling(share: float) -> None:
    """Regions are 8-connected, as an independent labelling finds, for any pixel density.

    Some densities are near percolation.
    """
    rng = np.random.default_rng(5)
    mask = np.zeros(_SHAPE, dtype=np.bool_)
    mask[1:-1, 1:-1] = rng.random((_SHAPE[0] - 2, _SHAPE[1] - 2)) < share
    labels, _ = ndimage.label(mask, structure=np.ones((3, 3), dtype=np.int64))
    area = np.bincount(labels.reshape(-1))[1:]
    frame = _frame(mask)
    found = find_bright_regions(frame, 4.5, 10_000)
    assert len(found) == np.count_nonzero(area >= _LEAST)
    for region in range(len(found)):
        mine = found.owner == region
        theirs = labels[found.row[mine], found.column[mine]]
        assert np.all(theirs == theirs[0])
        assert np.count_nonzero(mine) == area[theirs[0] - 1]
    assert np.all(np.diff(found.flux) <= 0.0)


def test_a_frame_without_light_has_no_regions() -> None:
    """A frame without light has no regions, and raises no error."""
    assert len(find_bright_regions(_frame(np.zeros(_SHAPE, dtype=np.bool_)), 4.5, 48)) == 0


@pytest.mark.parametrize(
    ("columns", "rows", "sigma", "size"),
    [(1024, 768, 1.9, 1), (1024, 768, 3.0, 3), (1025, 768, 2.6, 1), (1280, 1024, 4.3, 4)],
)
def test_a_star_is_in_the_same_direction_in_small_and_large_pixels(
    columns: int, rows: int, sigma: float, size: int
) -> None:
    full = Pinhole(columns, rows, 3000.0)
    binning = Binning.suited(full, sigma)
    assert binning.size == size
    small = np.array([[0.0, 0.0], [100.25, 60.5]])
    seen = MotionResult(StreakStatus.FAILED, 0, 1.0, stars=small)
    there = binning.in_pixels(seen).stars
    assert full.unit_vectors(there) == pytest.approx(binning.pinhole.unit_vectors(small), abs=1e-12)


def test_binning_keeps_light_and_saturation() -> None:
    pixels = np.arange(64, dtype=np.uint16).reshape(8, 8) * np.uint16(16)
    sums, top = Binning.suited(Pinhole(8, 8, 10.0), 2.0).frame(pixels, 1000.0)
    assert sums.shape == (4, 4)
    assert sums[0, 0] == 16 * (0 + 1 + 8 + 9)
    # The last sum contains a pixel of 1008 counts, and the previous sum contains pixels of at most 976
    # counts.
    assert top == 4 * 1008
    assert (sums >= top).sum() == 1
    assert np.all(sums % 16 == 0)


def test_a_point_spread_of_three_pixels_gives_a_rate_within_its_covariance() -> None:
    """With a point spread of three pixels, the rate error agrees with its covariance.

    A chi-square with 3 degrees of freedom exceeds 16.3 once in a thousand frames.
    """
    camera = replace(CAMERA, psf_sigma=3.0)
    scene = real_sky(2, 1.0, 90.0, 0.5, camera)
    settings = LikelihoodSettings(saturation=SATURATION, psf_sigma=3.0)
    found = estimate_motion(scene.pixels, camera.pinhole, scene.exposure, settings, scene.rate, 0.0)
    assert found.status is StreakStatus.RATE
    assert found.rate is not None
    assert found.covariance is not None
    error = found.rate - scene.rate
    assert error @ np.linalg.solve(found.covariance, error) < 16.3
    assert np.linalg.norm(error) < 0.005 * np.linalg.norm(scene.rate)
    assert found.psf_sigma == pytest.approx(3.0, rel=0.05)
    assert found.length == pytest.approx(90.0, rel=0.3)
    # The stars used are stars of the simulated sky, at pixels of the full frame.
    apart = np.linalg.norm(found.stars[found.used][:, None] - scene.stars, axis=2).min(axis=1)
    assert np.median(apart) < 0.5


def test_the_line_time_of_binned_rows_is_a_multiple_whether_stated_or_not() -> None:
    nobody, stated = LikelihoodSettings(), LikelihoodSettings(line_time=1e-5)
    assert nobody.binned(3).line_time_sigma == pytest.approx(3.0 * nobody.line_time_sigma)
    assert nobody.binned(3).shutter_unstated
    assert stated.binned(3).line_time == pytest.approx(3e-5)
    assert stated.binned(3).line_time_sigma == 0.0


def test_the_uncertainty_of_the_point_spread_is_given_in_binned_pixels() -> None:
    settings = LikelihoodSettings(psf_sigma=3.0, knowledge=replace(EXACT, psf_sigma=0.06))
    binned = settings.binned(3)
    assert binned.psf_sigma == pytest.approx(1.0)
    assert binned.knowledge.psf_sigma == pytest.approx(0.02)


# Chi-square with 3 degrees of freedom that one of a thousand frames exceeds by chance.
_HONEST = 16.3


def _read(scene: Scene, pixels: Image | None = None) -> tuple[ReducedFrame, BrightRegions]:
    frame = reduce_frame(scene.pixels if pixels is None else pixels, SATURATION, 1.0)
    return frame, find_bright_regions(frame, 4.5, 48)


def _found(scene: Scene, pixels: Image | None = None, psf_sigma: float = 1.0) -> MotionResult:
    settings = LikelihoodSettings(saturation=SATURATION, line_time=0.0, psf_sigma=psf_sigma)
    pixels = scene.pixels if pixels is None else pixels
    return estimate_motion(pixels, CAMERA.pinhole, scene.exposure, settings, scene.rate, 0.0)


def _nees(found: MotionResult, scene: Scene) -> float:
    assert found.rate is not None, found.reason
    assert found.covariance is not None
    error = found.rate - scene.rate
    return float(error @ np.linalg.solve(found.covariance, error))


@pytest.mark.parametrize("sigma", [0.7, 1.0, 2.0, 3.0])
@pytest.mark.parametrize(("theta", "length"), [(1.2, 60.0), (0.03, 250.0)])
def test_the_measured_width_is_true_for_straight_and_bent_streaks(
    sigma: float, theta: float, length: float
) -> None:
    scene = real_sky(2, theta, length, 1.0, replace(CAMERA, psf_sigma=sigma))
    seen = measured_psf_sigma(*_read(scene))
    assert seen is not None
    assert seen == pytest.approx(sigma, rel=0.2, abs=0.15)


def test_without_regions_no_width_is_measured() -> None:
    dark = np.random.default_rng(1).normal(100.0, 10.0, (1024, 1024)).astype(np.uint16)
    frame = reduce_frame(dark, SATURATION, 1.0)
    assert measured_psf_sigma(frame, find_bright_regions(frame, 4.5, 48)) is None


@pytest.mark.parametrize(("true", "described"), [(1.0, 2.0), (2.0, 1.0), (3.0, 1.0)])
def test_a_point_spread_of_another_width_gives_a_rate_within_its_covariance(
    true: float, described: float
) -> None:
    """The fitted width is near the true width, which a learned profile determines less well than a Gaussian.

    The shares of the Gaussians in a learned profile describe a part of the width, too.
    """
    scene = real_sky(12, np.radians(70.0), 80.0, 1.0, replace(CAMERA, psf_sigma=true))
    found = _found(scene, psf_sigma=described)
    assert _nees(found, scene) < _HONEST
    assert found.psf_sigma == pytest.approx(true, rel=0.15)


def test_a_bright_limb_is_excluded_and_the_stars_give_the_rate() -> None:
    scene = real_sky(12, np.radians(70.0), 80.0, 0.2)
    y, x = np.indices(scene.pixels.shape)
    limb = 3000.0 / (1.0 + np.exp(np.clip((np.hypot(x - 512.0, y - 3412.0) - 2600.0) / 4.0, -50.0, 50.0)))
    noisy = np.random.default_rng(5).poisson(limb)
    pixels = np.clip(scene.pixels + noisy, 0, SATURATION).astype(np.uint16)
    frame, blobs = _read(scene, pixels)
    clear = without_glare(frame, blobs)
    assert clear is not None
    bad = clear.bad.reshape(clear.shape)
    edge = int(3412.0 - 2600.0)
    assert bad[edge - 4 : edge + 4, 500:524].all()
    assert bad[: edge - 60].mean() < 0.02
    assert without_glare(*_read(scene)) is None
    assert _nees(_found(scene, pixels), scene) < _HONEST


def test_a_colour_mosaic_is_equalised_and_a_monochrome_frame_is_unchanged() -> None:
    scene = real_sky(12, np.radians(70.0), 30.0, 1.0)
    mosaic = np.tile(np.array([[1.0, 0.6], [0.5, 1.0]]), (512, 512))
    dark = float(np.median(scene.pixels))
    pixels = (dark + mosaic * (scene.pixels - dark)).clip(0.0).astype(np.uint16)
    frame, blobs = _read(scene, pixels)
    even = without_mosaic(frame, blobs)
    assert even is not None
    ratio = (frame.signal / np.where(even.signal == 0.0, 1.0, even.signal)).reshape(even.shape)[:2, :2]
    assert ratio == pytest.approx(mosaic[:2, :2] / 0.775, rel=0.03)
    assert without_mosaic(*_read(scene)) is None
    assert _nees(_found(scene, pixels), scene) < _HONEST


def test_a_frame_that_saturates_below_the_described_level_is_recognised() -> None:
    scene = real_sky(12, np.radians(70.0), 30.0, 1.0)
    pixels = np.minimum(scene.pixels, 600)
    assert np.count_nonzero(pixels == 600) > 50
    found = _found(scene, pixels)
    assert _nees(found, scene) < _HONEST
    assert found.misfit < 1.5


@pytest.mark.parametrize(("sigma", "sizes"), [(1.0, [1]), (1.5, [1, 2]), (3.0, [2])])
def test_a_blurred_frame_is_prepared_again_with_larger_pixels(sigma: float, sizes: list[int]) -> None:
    """A frame with the configured PSF width is prepared once, and one with a very wide PSF only binned."""
    scene = real_sky(2, 1.2, 60.0, 1.0, replace(CAMERA, psf_sigma=sigma))
    settings = LikelihoodSettings(saturation=SATURATION, line_time=0.0)
    frames = prepare_frames(scene.pixels, CAMERA.pinhole, SATURATION, settings)
    assert [binning.size for binning, *_ in frames] == sizes
