"""What the detector makes of known light: response, noise, blemishes, and the seeds they come from."""

from __future__ import annotations

import numpy as np
import pytest

from sim_hal.earth_camera import EarthCameraModel, render
from sim_hal.earth_camera.image import counts, spill
from tests.sim_hal.earth_camera.scenes import limb_scene

LOGARITHMIC = EarthCameraModel.fuga15d(dead_pixels=0, hot_pixels=0, fixed_pattern=0.0)
LINEAR = EarthCameraModel.fuga15d(
    response="linear", dead_pixels=0, hot_pixels=0, fixed_pattern=0.0, response_spread=0.0
)


def _even(model: EarthCameraModel, radiance: float, seed: int = 1) -> np.ndarray:
    light = np.full((model.rows, model.columns), radiance, dtype=np.float32)
    return counts(model, light, np.random.default_rng(seed))


def test_counts_grow_with_the_light_over_six_decades_evenly_by_its_logarithm() -> None:
    light = LOGARITHMIC.darkest * 10.0 ** np.arange(0.0, 6.01, 0.25)
    mean = np.array([_even(LOGARITHMIC, value).mean() for value in light])
    assert np.all(np.diff(mean) > 0.0)
    steps = np.diff(mean[6:-1])  # above the knee at the dark current
    assert steps == pytest.approx(0.25 * (255 - 8) / 6.0, abs=0.5)
    assert mean[-1] == pytest.approx(255, abs=1.0)


def test_darkness_reads_the_pedestal_with_the_stated_noise() -> None:
    """Rounding adds a twelfth of a count to the variance; 262,144 pixels give it to 0.3 %."""
    for model, sigma in ((LOGARITHMIC, 0.7), (LINEAR, 20.0 / 80.0)):
        fine = EarthCameraModel.fuga15d(
            response=model.response,
            bits=12,
            pedestal=200.0,
            noise=0.7 * 16,
            gain=80.0 / 16,
            dead_pixels=0,
            hot_pixels=0,
            fixed_pattern=0.0,
        )
        dark = _even(fine, 0.0)
        assert dark.dtype == np.uint16
        assert dark.mean() == pytest.approx(200.0, abs=0.1)
        assert dark.std() == pytest.approx(np.hypot(16 * sigma, 12**-0.5), rel=0.01)


def test_the_linear_cameras_noise_is_that_of_the_charge() -> None:
    """Shot noise: variance in e- is the charge plus the read noise's; then the full well ends it."""
    model = EarthCameraModel.fuga15d(
        response="linear",
        bits=16,
        gain=1.0,
        dead_pixels=0,
        hot_pixels=0,
        fixed_pattern=0.0,
        response_spread=0.0,
    )
    frame = _even(model, 0.5)
    assert frame.mean() == pytest.approx(8.0 + 8000.0, rel=1e-3)
    assert frame.std() == pytest.approx(np.sqrt(8000.0 + 400.0), rel=0.01)
    full = _even(model, 50.0)
    assert full.mean() == pytest.approx(8.0 + 20_000.0, abs=0.5)
    assert full.std() == pytest.approx(20.0, rel=0.01)


def test_the_fixed_pattern_stays_from_frame_to_frame_and_goes_with_the_seed() -> None:
    model = EarthCameraModel.fuga15d(fixed_pattern=4.0, pedestal=60.0, seed=3)
    frames = [_even(model, 0.0, seed).astype(float) for seed in (1, 2)]
    noise = np.std(frames[0] - frames[1]) / np.sqrt(2.0)
    assert noise == pytest.approx(np.hypot(0.7, 12**-0.5), rel=0.05)
    assert np.corrcoef(frames[0].ravel(), frames[1].ravel())[0, 1] > 0.9
    other = _even(EarthCameraModel.fuga15d(fixed_pattern=4.0, pedestal=60.0, seed=4), 0.0).astype(float)
    assert abs(np.corrcoef(frames[0].ravel(), other.ravel())[0, 1]) < 0.1


def test_dead_pixels_read_zero_and_hot_ones_are_bright_whatever_the_light() -> None:
    model = EarthCameraModel.fuga15d(dead_pixels=25, hot_pixels=40, seed=9)
    dark, bright = _even(model, 0.0), _even(model, 1.0)
    dead, hot = bright == 0, dark >= int(0.3 * 255)
    assert np.sum(dead) == 25
    assert np.sum(hot) == 40
    assert np.all(dark[dead] == 0)
    assert np.all(bright[hot] >= int(0.3 * 255))


def test_blooming_fills_the_column_and_loses_no_charge_inside_it() -> None:
    charge = np.zeros((9, 3), dtype=np.float32)
    charge[4, 1] = 500.0
    charge[3, 1] = 30.0
    spill(charge, 100.0)
    assert charge[:, 1] == pytest.approx([0, 30, 100, 100, 100, 100, 100, 0, 0])
    assert charge[:, 1].sum() == pytest.approx(530.0)
    assert charge.max() <= 100.0
    assert charge[:, [0, 2]].sum() == 0.0
    with_it = EarthCameraModel.fuga15d(response="linear", blooming=True, hot_pixels=0, dead_pixels=0)
    light = np.zeros((512, 512), dtype=np.float32)
    light[200, 100] = 40.0
    assert np.sum(counts(with_it, light, np.random.default_rng(0)) > 200) > 25


def test_the_same_seeds_make_the_same_frame_and_others_another() -> None:
    model = EarthCameraModel.fuga15d(seed=2)
    scene = limb_scene(zenith=np.array([1.0, 0.2, 0.1]), sun=np.array([1.0, 0.0, 0.3]))
    frames = [render(model, scene, np.random.default_rng(seed)) for seed in (5, 5, 6)]
    assert frames[0].dtype == np.uint8
    assert frames[0].shape == (512, 512)
    assert np.array_equal(frames[0], frames[1])
    assert not np.array_equal(frames[0], frames[2])
