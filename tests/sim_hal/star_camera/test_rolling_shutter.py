"""A rolling shutter: every row against the definition, and its limits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hal.interfaces.errors import OutOfRange
from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray
from sim_hal.star_camera import SourceTrack, StarCameraModel, expected_electrons, render
from tests.sim_hal.star_camera.scenes import POINTING, at_pixels, centroid, integrated_by_brute_force, turning

MODEL = StarCameraModel(columns=120, rows=100, field_of_view=np.radians(3.0), line_time=2e-4)
FOCAL = MODEL.pinhole.focal_length
EXPOSURE = 0.2
INSTANTS = 1000
READOUT = MODEL.rows * MODEL.line_time


def _history(rate: object, samples: int = 2) -> tuple[FloatArray, FloatArray]:
    """Return an attitude history at constant `rate` (3,) rad/s that lasts from the first row to the last."""
    return turning(rate, EXPOSURE + READOUT, samples)


def _by_brute_force(
    model: StarCameraModel, star: FloatArray, times: FloatArray, attitudes: FloatArray, magnitude: float = 2.0
) -> FloatArray:
    """Return the image row by row, each from 1,000 instants of its own exposure; attitudes by scipy."""
    from scipy.spatial.transform import Rotation, Slerp  # noqa: PLC0415 - half a second, for these tests only

    camera_to_reference = Slerp(times, Rotation.from_quat(attitudes))
    exposure = times[-1] - times[0] - model.rows * model.line_time
    instants = times[0] + exposure * (np.arange(INSTANTS) + 0.5) / INSTANTS
    when = instants + model.line_time * np.arange(model.rows)[:, None]
    seen = camera_to_reference(when.reshape(-1)).inv().apply(star[0])
    paths = model.pinhole.project(seen).reshape(model.rows, INSTANTS, 2)
    electrons = float(model.electrons(magnitude, exposure))
    image = np.zeros((model.rows, model.columns))
    for row, path in enumerate(paths):
        near = path[np.abs(path[:, 1] - row) < 8.0 * model.psf_sigma] - np.array([0.0, row])
        if len(near):
            share = electrons * len(near) / INSTANTS
            image[row] = integrated_by_brute_force((1, model.columns), near, share, model.psf_sigma)[0]
    return image


def _worst(model: StarCameraModel, star: FloatArray, times: FloatArray, attitudes: FloatArray) -> float:
    """Return the largest error of a pixel, as a fraction of the streak's peak."""
    image = expected_electrons(model, star, [2.0], times, attitudes)
    expected = _by_brute_force(model, star, times, attitudes)
    return float(np.abs(image - expected).max() / expected.max())


@pytest.mark.parametrize("line_time", [1e-5, 2e-4, 6e-4])
@pytest.mark.parametrize("velocity", [(0.0, 0.0), (250.0, 0.0), (0.0, 250.0), (0.0, -250.0), (-170.0, 180.0)])
def test_every_row_is_the_integral_over_its_own_exposure(
    line_time: float, velocity: tuple[float, float]
) -> None:
    """Up to 0.15 px a line time, down after the shutter and up against it."""
    model = replace(MODEL, line_time=line_time)
    vx, vy = velocity
    span = EXPOSURE + model.rows * line_time
    rate = np.array([vy, -vx, 0.0]) / FOCAL
    times, attitudes = turning(rate, span, 3)
    middle = quaternion.multiply(quaternion.from_rotation_vector(0.5 * span * rate), POINTING)
    assert _worst(model, at_pixels(model, [61.3, 47.8], middle), times, attitudes) < 2e-3


def test_a_curved_streak_is_exact() -> None:
    assert _worst(MODEL, at_pixels(MODEL, [95.2, 50.3]), *_history([0.0, 0.0, 3.0])) < 2e-3


@pytest.mark.parametrize("sigma", [0.6, 1.8])
def test_other_widths_of_the_image_are_exact(sigma: float) -> None:
    model = replace(MODEL, psf_sigma=sigma)
    assert _worst(model, at_pixels(model, [50.2, 30.3]), *_history([150.0 / FOCAL, 0.1, 0.0])) < 2e-3


def test_a_changing_rate_is_exact() -> None:
    times = np.linspace(0.0, EXPOSURE + READOUT, 45)
    turn = np.outer(times**2, [900.0 / FOCAL, 500.0 / FOCAL, 0.5])
    attitudes = quaternion.multiply(quaternion.from_rotation_vector(turn), POINTING)
    assert _worst(MODEL, at_pixels(MODEL, [60.0, 40.0]), times, attitudes) < 2e-3


def test_jitter_is_followed() -> None:
    """Kinks of 0.1 px every 5 ms beside 150 px/s."""
    times = np.linspace(0.0, EXPOSURE + READOUT, 45)
    rng = np.random.default_rng(3)
    turn = np.outer(times, [0.0, 150.0 / FOCAL, 0.0]) + rng.normal(0.0, 0.1 / FOCAL, (45, 3))
    attitudes = quaternion.multiply(quaternion.from_rotation_vector(turn), POINTING)
    assert _worst(MODEL, at_pixels(MODEL, [80.0, 50.0]), times, attitudes) < 2e-3


@pytest.mark.parametrize("start", [(60.0, -2.0), (60.0, 101.0), (-25.0, 50.0), (110.0, 90.0)])
def test_streaks_that_an_edge_cuts_are_exact(start: tuple[float, float]) -> None:
    """In from above, up from below, in from the left, out at the corner."""
    vertical = 100.0 if start[1] < 60.0 else -100.0 if start[0] < 100.0 else 200.0
    rate = np.array([vertical, -200.0, 0.0]) / FOCAL
    assert _worst(MODEL, at_pixels(MODEL, start), *_history(rate)) < 2e-3


def test_a_track_under_a_rolling_shutter_is_a_star_under_the_opposite_turn() -> None:
    """A camera at rest and an object that moves as the star of a turning camera does: the same image."""
    times, attitudes = _history(np.array([100.0, -120.0, 0.0]) / FOCAL, 23)
    star = at_pixels(MODEL, [40.0, 40.0])
    seen = quaternion.attitude_matrix(attitudes) @ star[0]
    track = SourceTrack(times, seen @ quaternion.attitude_matrix(POINTING), 2.0)
    rest = np.tile(POINTING, (len(times), 1))
    image = expected_electrons(MODEL, np.zeros((0, 3)), [], times, rest, extra=[track])
    expected = expected_electrons(MODEL, star, [2.0], times, attitudes)
    assert np.abs(image - expected).max() < 1e-3 * expected.max()


def test_a_still_camera_sees_what_a_global_shutter_sees() -> None:
    rng = np.random.default_rng(5)
    stars = at_pixels(MODEL, rng.uniform(-5.0, 120.0, (40, 2)))
    magnitudes = rng.uniform(1.0, 6.0, 40)
    rolling = expected_electrons(MODEL, stars, magnitudes, *_history([0.0, 0.0, 0.0]))
    history = turning([0.0, 0.0, 0.0], EXPOSURE)
    whole = expected_electrons(replace(MODEL, line_time=0.0), stars, magnitudes, *history)
    assert np.abs(rolling - whole).max() < 1e-4 * whole.max()


def test_with_hardly_any_line_time_a_field_of_streaks_is_a_global_shutters() -> None:
    """Stars on and around the detector that come and go over every edge, and a few behind the camera."""
    rng = np.random.default_rng(6)
    stars = at_pixels(MODEL, rng.uniform(-150.0, 250.0, (300, 2)))
    stars[:20] *= -1.0
    magnitudes = rng.uniform(1.0, 6.0, 300)
    history = turning(np.array([300.0, -350.0, 200.0]) / FOCAL, EXPOSURE, 9)
    whole = expected_electrons(replace(MODEL, line_time=0.0), stars, magnitudes, *history)
    rolling = expected_electrons(replace(MODEL, line_time=1e-9), stars, magnitudes, *history)
    assert np.abs(rolling - whole).max() < 5e-4 * whole.max()


def test_stars_far_down_streak_later() -> None:
    """Two stars 80 rows apart, the camera turning about y: the lower one is 80 line times further on."""
    times, attitudes = _history([0.0, 200.0 / FOCAL, 0.0])
    upper, lower = (
        centroid(expected_electrons(MODEL, at_pixels(MODEL, [80.0, y]), [2.0], times, attitudes))[0]
        for y in (10.0, 90.0)
    )
    assert upper - lower == pytest.approx(200.0 * 80.0 * MODEL.line_time, abs=0.01)


def test_a_streak_that_runs_down_after_the_shutter_is_longer_and_brighter_in_all() -> None:
    """At 400 px/s and 0.2 ms a line its own row's exposure takes 1 / (1 - 0.08) times as long to pass."""
    star = at_pixels(MODEL, [60.0, 3.0])
    times, attitudes = turning([400.0 / FOCAL, 0.0, 0.0], 0.1 + READOUT)
    rolling = expected_electrons(MODEL, star, [2.0], times, attitudes).sum()
    assert rolling == pytest.approx(float(MODEL.electrons(2.0, 0.1)) / (1.0 - 0.08), rel=2e-3)


def test_the_frame_of_a_rolling_shutter_has_the_dark_current_of_one_exposure() -> None:
    model = replace(MODEL, dark_current=5000.0, read_noise=0.0)
    frame = render(model, np.zeros((0, 3)), [], *_history([0.0, 0.0, 0.0]), np.random.default_rng(1))
    assert frame.mean() == pytest.approx(100.0 + 5000.0 * EXPOSURE, abs=5.0 * np.sqrt(1000.0 / frame.size))


def test_a_history_too_short_for_the_last_row_is_refused() -> None:
    with pytest.raises(OutOfRange, match="attitude history's length"):
        expected_electrons(MODEL, np.zeros((0, 3)), [], *turning([0.0] * 3, READOUT))


def test_a_star_that_keeps_pace_with_the_shutter_is_refused() -> None:
    star = at_pixels(MODEL, [60.0, 10.0])
    with pytest.raises(OutOfRange, match="line time"):
        expected_electrons(replace(MODEL, line_time=2e-3), star, [2.0], *turning([0.2, 0.0, 0.0], 0.5))
