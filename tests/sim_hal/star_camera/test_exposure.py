"""Tests of the image of a star over an exposure, with a global and with a rolling shutter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.interfaces.errors import OutOfRange
from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray
from sim_hal.star_camera import SourceTrack, StarCameraModel, expected_electrons, render
from sim_hal.star_camera.image import AttitudeHistory
from tests.sim_hal.star_camera.scenes import POINTING, at_pixels, centroid, integrated_by_brute_force, turning

MODEL = StarCameraModel(columns=200, rows=160, field_of_view=np.radians(4.0))
FOCAL = MODEL.pinhole.focal_length
FINE = 20_001


def _path(model: StarCameraModel, star: FloatArray, times: FloatArray, attitudes: FloatArray) -> FloatArray:
    """Return the pixels of a star at the middle of equal time steps, with attitudes interpolated by scipy."""
    from scipy.spatial.transform import Rotation, Slerp  # noqa: PLC0415 - half a second, for these tests only

    edges = np.linspace(times[0], times[-1], FINE)
    middles = 0.5 * (edges[1:] + edges[:-1])
    camera_to_reference = Slerp(times, Rotation.from_quat(attitudes))(middles)
    return model.pinhole.project(camera_to_reference.inv().apply(star[0]))


def _worst_against_brute_force(
    model: StarCameraModel, star: FloatArray, times: FloatArray, attitudes: FloatArray
) -> float:
    """Return the largest error of a pixel against a sum over instants, relative to the streak's peak."""
    image = expected_electrons(model, star, [2.0], times, attitudes)
    electrons = float(model.electrons(2.0, float(times[-1] - times[0])))
    path = _path(model, star, times, attitudes)
    expected = integrated_by_brute_force(image.shape, path, electrons, model.psf_sigma)
    return float(np.abs(image - expected).max() / expected.max())


@pytest.mark.parametrize(
    ("streak", "sigma"),
    [(0.1, 1.0), (0.7, 0.5), (3.3, 0.5), (3.3, 2.0), (17.0, 1.0), (90.0, 0.5), (90.0, 2.0)],
)
def test_a_streak_is_the_integral_of_the_still_images(streak: float, sigma: float) -> None:
    model = StarCameraModel(columns=200, rows=160, field_of_view=MODEL.field_of_view, psf_sigma=sigma)
    star = at_pixels(model, [120.3, 60.8])
    rate = streak / FOCAL * np.array([0.6, 0.8, 0.0])
    assert _worst_against_brute_force(model, star, *turning(rate)) < 1e-3


def test_a_curved_streak_about_the_boresight_is_exact() -> None:
    star = at_pixels(MODEL, [150.3, 90.8])
    assert _worst_against_brute_force(MODEL, star, *turning([0.0, 0.0, 1.2])) < 1e-3


def test_a_streak_of_changing_rate_is_exact() -> None:
    """The image of a streak at a changing rate agrees with a sum over instants.

    If the camera accelerates from rest, the start of the path is brighter than its end.
    """
    times = np.linspace(0.0, 1.0, 101)
    turn = np.outer(times**2, [60.0 / FOCAL, 30.0 / FOCAL, 0.0])
    attitudes = quaternion.multiply(quaternion.from_rotation_vector(turn), POINTING)
    assert _worst_against_brute_force(MODEL, at_pixels(MODEL, [80.0, 120.0]), times, attitudes) < 1e-3


@pytest.mark.parametrize("jitter", [0.003, 0.03, 0.3, 1.0])
def test_jitter_between_samples_is_followed(jitter: float) -> None:
    """The path of a star follows jitter from sample to sample of the attitude.

    The motion has kinks of up to about a pixel at its 200 samples. The renderer treats the smallest kinks as
    a smooth motion.
    """
    rng = np.random.default_rng(8)
    times = np.linspace(0.0, 1.0, 201)
    turn = np.outer(times, [0.0, 50.0 / FOCAL, 0.0]) + rng.normal(0.0, jitter / FOCAL, (201, 3))
    attitudes = quaternion.multiply(quaternion.from_rotation_vector(turn), POINTING)
    assert _worst_against_brute_force(MODEL, at_pixels(MODEL, [140.0, 80.0]), times, attitudes) < 1e-3


def test_a_stop_in_the_middle_of_a_slew_leaves_its_light_in_one_place() -> None:
    times = np.array([0.0, 0.2, 0.8, 1.0])
    turn = np.outer([0.0, 30.0, 30.0, 60.0], [0.0, 1.0 / FOCAL, 0.0])
    attitudes = quaternion.multiply(quaternion.from_rotation_vector(turn), POINTING)
    star = at_pixels(MODEL, [140.0, 80.0])
    assert _worst_against_brute_force(MODEL, star, times, attitudes) < 1e-3


@settings(max_examples=25, deadline=None)
@given(st.floats(0.0, 6.28), st.floats(20.0, 90.0), st.floats(-1.0, 1.0))
def test_the_light_is_the_same_however_far_the_star_moves(heading: float, streak: float, roll: float) -> None:
    rate = np.array([np.cos(heading) * streak / FOCAL, np.sin(heading) * streak / FOCAL, roll])
    middle = quaternion.multiply(quaternion.from_rotation_vector(0.5 * rate), POINTING)
    star = at_pixels(MODEL, [99.5, 79.5], middle)
    image = expected_electrons(MODEL, star, [3.0], *turning(rate))
    assert image.sum() == pytest.approx(float(MODEL.electrons(3.0, 1.0)), rel=2e-5)


def test_a_streak_runs_along_minus_omega_cross_v_over_the_known_length() -> None:
    """A streak runs along v' = -w x v and has the expected length.

    If the camera rotates by 80 px about +x, a star at the boresight moves towards +y.
    """
    star = at_pixels(MODEL, MODEL.pinhole.centre)
    angle = 70.0 / FOCAL
    image = expected_electrons(MODEL, star, [0.0], *turning([angle, 0.0, 0.0]))
    x, y = MODEL.pinhole.centre
    length = FOCAL * np.tan(angle)
    assert centroid(image) == pytest.approx([x, y + 0.5 * length], abs=0.01)
    profile = image.sum(axis=0)
    assert profile.argmax() in (int(x), int(x) + 1)
    lit = image.sum(axis=1)
    # The brightness at the ends is half of the brightness in the flat middle.
    half = 0.5 * np.median(lit[int(y) + 10 : int(y + length) - 10])
    start, *_, end = np.flatnonzero(lit > half)
    first = start - (lit[start] - half) / (lit[start] - lit[start - 1])
    last = end + (lit[end] - half) / (lit[end] - lit[end + 1])
    assert first == pytest.approx(y, abs=0.02)
    assert last == pytest.approx(y + length, abs=0.02)


def test_a_turn_about_plus_y_moves_stars_to_the_left() -> None:
    star = at_pixels(MODEL, [150.0, 80.0])
    image = expected_electrons(MODEL, star, [0.0], *turning([0.0, 60.0 / FOCAL, 0.0]))
    assert centroid(image)[0] == pytest.approx(120.0, abs=0.2)


def test_a_star_on_the_axis_of_rotation_does_not_move() -> None:
    """At any rate, a star on the axis of rotation has the image of a star at rest."""
    point = np.array([[120.3, 60.8]])
    axis = MODEL.pinhole.unit_vectors(point)[0]
    image = expected_electrons(MODEL, at_pixels(MODEL, point), [2.0], *turning(1.5 * axis, samples=3))
    expected = integrated_by_brute_force(image.shape, point, float(MODEL.electrons(2.0, 1.0)), 1.0)
    assert np.abs(image - expected).max() < 2e-4 * expected.max()


def test_sampling_the_same_motion_more_finely_changes_nothing() -> None:
    star, rate = at_pixels(MODEL, [140.0, 80.0]), np.array([0.01, 0.03, 0.2])
    coarse = expected_electrons(MODEL, star, [2.0], *turning(rate, samples=2))
    fine = expected_electrons(MODEL, star, [2.0], *turning(rate, samples=1001))
    assert np.abs(coarse - fine).max() < 1e-5 * coarse.max()


def test_an_even_turn_needs_no_more_knots_for_being_sampled_finely() -> None:
    rate = np.array([0.01, 0.03, 0.0])
    assert len(AttitudeHistory(*turning(rate, samples=1001)).knots(1e-6, 0.05)) == 2
    assert len(AttitudeHistory(*turning(10.0 * rate, samples=1001)).knots(1e-6, 0.05)) == 8


def test_an_edge_cuts_a_streak_without_moving_the_rest() -> None:
    """An edge of the detector truncates a streak without changing the rest of the streak.

    The image of the small detector equals the centre of the wide image, pixel by pixel.
    """
    wide = StarCameraModel(columns=400, rows=400, field_of_view=2.0 * np.arctan(200.0 / FOCAL))
    rng = np.random.default_rng(4)
    stars = at_pixels(MODEL, rng.uniform([-60.0, -60.0], [260.0, 220.0], (60, 2)))
    magnitudes = rng.uniform(1.0, 3.0, 60)
    history = turning(np.array([60.0, -40.0, 0.0]) / FOCAL, samples=5)
    cut = expected_electrons(MODEL, stars, magnitudes, *history)
    whole = expected_electrons(wide, stars, magnitudes, *history)[120:280, 100:300]
    assert np.abs(cut - whole).max() < 2e-4 * whole.max()
    assert np.count_nonzero(cut[:, 0] > 1.0) > 10


@pytest.mark.parametrize(("when", "crossings"), [(0.0, 0.5), (0.1, 1.0), (0.5, 1.0), (0.9, 1.0), (1.0, 0.5)])
def test_a_sweep_across_the_sky_shows_each_star_while_it_crosses(when: float, crossings: float) -> None:
    """In a fast rotation, each star appears while it crosses the field of view.

    The rotation is 0.5 rad, or seven fields of view. The star is on the boresight at the time `when`.
    """
    rate = np.array([0.0, 0.5, 0.0])
    then = quaternion.multiply(quaternion.from_rotation_vector(when * rate), POINTING)
    star = at_pixels(MODEL, MODEL.pinhole.centre, then)
    image = expected_electrons(MODEL, star, [0.0], *turning(rate))
    crossing = 2.0 * np.arctan(100.0 / FOCAL) / 0.5
    assert image.sum() == pytest.approx(float(MODEL.electrons(0.0, 1.0)) * crossing * crossings, rel=2e-3)


def test_the_thesis_model_streaks_too() -> None:
    """The model of the thesis gives streaks too: the mean of still images at 2,000 steps (Sease's sum)."""
    model = StarCameraModel(columns=64, rows=48, field_of_view=0.03, psf="bilinear")
    star = at_pixels(model, [20.0, 20.0])
    times, attitudes = turning(np.array([-9.0, -25.0, 0.0]) / model.pinhole.focal_length)
    streak = expected_electrons(model, star, [2.0], times, attitudes)
    history = AttitudeHistory(times, attitudes)
    steps = history.at(np.linspace(0.00025, 0.99975, 2000))
    summed = np.zeros_like(streak)
    for point in model.pinhole.project(quaternion.attitude_matrix(steps) @ star[0]):
        column, row = np.floor(point).astype(int)
        a, b = point - (column, row)
        summed[row : row + 2, column : column + 2] += np.outer([1.0 - b, b], [1.0 - a, a])
    kernel = np.exp(-0.5 * np.array([1.0, 0.0, 1.0]))
    kernel /= kernel.sum()
    for axis in (0, 1):
        summed = sum(
            weight * np.roll(summed, shift, axis) for weight, shift in zip(kernel, (-1, 0, 1), strict=True)
        )
    summed *= float(model.electrons(2.0, 1.0)) / 2000.0
    assert np.abs(streak - summed).max() < 2e-3 * summed.max()


def test_a_moving_source_streaks_while_the_stars_stand_still() -> None:
    track = SourceTrack(np.array([0.0, 1.0]), at_pixels(MODEL, [[40.0, 40.0], [100.0, 70.0]]), 3.0)
    history = turning([0.0, 0.0, 0.0])
    star = at_pixels(MODEL, [150.0, 120.0])
    image = expected_electrons(MODEL, star, [3.0], *history, extra=[track])
    assert image[100:, :].sum() == pytest.approx(float(MODEL.electrons(3.0, 1.0)), rel=1e-4)
    assert image[:100].sum() == pytest.approx(float(MODEL.electrons(3.0, 1.0)), rel=1e-4)
    assert centroid(image[:100]) == pytest.approx([70.0, 55.0], abs=0.02)


def test_a_source_that_the_camera_follows_is_a_point() -> None:
    """The image of an object that the camera follows is a point. The stars are streaks."""
    times, attitudes = turning([0.0, 60.0 / FOCAL, 0.0], samples=101)
    boresights = quaternion.attitude_matrix(attitudes)[:, 2]
    nothing = np.zeros((0, 3))
    track = SourceTrack(times, boresights, 3.0)
    image = expected_electrons(MODEL, nothing, [], times, attitudes, extra=[track])
    point = np.array([MODEL.pinhole.centre])
    expected = integrated_by_brute_force(image.shape, point, float(MODEL.electrons(3.0, 1.0)), 1.0)
    assert np.abs(image - expected).max() < 1e-3 * expected.max()


def test_a_track_that_ends_before_the_exposure_is_refused() -> None:
    track = SourceTrack(np.array([0.0, 0.5]), at_pixels(MODEL, [[40.0, 40.0], [100.0, 70.0]]), 3.0)
    with pytest.raises(ValueError, match="cover the exposure"):
        expected_electrons(MODEL, np.zeros((0, 3)), [], *turning([0.0, 0.0, 0.0]), extra=[track])


def test_impossible_tracks_are_refused() -> None:
    directions = at_pixels(MODEL, [[40.0, 40.0], [100.0, 70.0]])
    times = np.array([0.0, 1.0])
    with pytest.raises(ValueError, match="give"):
        SourceTrack(times[:1], directions[:1], 3.0)
    with pytest.raises(ValueError, match="increase"):
        SourceTrack(times[::-1], directions, 3.0)
    with pytest.raises(ValueError, match="unit vectors"):
        SourceTrack(times, 2.0 * directions, 3.0)
    with pytest.raises(ValueError, match="magnitude"):
        SourceTrack(times, directions, float("nan"))


ROLLING_MODEL = StarCameraModel(columns=120, rows=100, field_of_view=np.radians(3.0), line_time=2e-4)
ROLLING_FOCAL = ROLLING_MODEL.pinhole.focal_length
EXPOSURE = 0.2
INSTANTS = 1000
READOUT = ROLLING_MODEL.rows * ROLLING_MODEL.line_time


def _history(rate: object, samples: int = 2) -> tuple[FloatArray, FloatArray]:
    """Return an attitude history at the constant `rate` (3,), rad/s, from the first row to the last row."""
    return turning(rate, EXPOSURE + READOUT, samples)


def _by_brute_force(
    model: StarCameraModel, star: FloatArray, times: FloatArray, attitudes: FloatArray, magnitude: float = 2.0
) -> FloatArray:
    """Return the image row by row, each as a sum over 1,000 instants of its own exposure.

    Scipy interpolates the attitudes.
    """
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
    """Every row of a rolling shutter is the integral over its own exposure.

    The motion is up to 0.15 px per line time, along and against the motion of the shutter.
    """
    model = replace(ROLLING_MODEL, line_time=line_time)
    vx, vy = velocity
    span = EXPOSURE + model.rows * line_time
    rate = np.array([vy, -vx, 0.0]) / ROLLING_FOCAL
    times, attitudes = turning(rate, span, 3)
    middle = quaternion.multiply(quaternion.from_rotation_vector(0.5 * span * rate), POINTING)
    assert _worst(model, at_pixels(model, [61.3, 47.8], middle), times, attitudes) < 2e-3


def test_a_curved_streak_is_exact() -> None:
    assert _worst(ROLLING_MODEL, at_pixels(ROLLING_MODEL, [95.2, 50.3]), *_history([0.0, 0.0, 3.0])) < 2e-3


@pytest.mark.parametrize("sigma", [0.6, 1.8])
def test_other_widths_of_the_image_are_exact(sigma: float) -> None:
    model = replace(ROLLING_MODEL, psf_sigma=sigma)
    assert _worst(model, at_pixels(model, [50.2, 30.3]), *_history([150.0 / ROLLING_FOCAL, 0.1, 0.0])) < 2e-3


def test_a_changing_rate_is_exact() -> None:
    times = np.linspace(0.0, EXPOSURE + READOUT, 45)
    turn = np.outer(times**2, [900.0 / ROLLING_FOCAL, 500.0 / ROLLING_FOCAL, 0.5])
    attitudes = quaternion.multiply(quaternion.from_rotation_vector(turn), POINTING)
    assert _worst(ROLLING_MODEL, at_pixels(ROLLING_MODEL, [60.0, 40.0]), times, attitudes) < 2e-3


def test_jitter_is_followed() -> None:
    """Under a rolling shutter, the path of a star follows jitter.

    The motion has kinks of 0.1 px every 5 ms at 150 px/s.
    """
    times = np.linspace(0.0, EXPOSURE + READOUT, 45)
    rng = np.random.default_rng(3)
    turn = np.outer(times, [0.0, 150.0 / ROLLING_FOCAL, 0.0]) + rng.normal(0.0, 0.1 / ROLLING_FOCAL, (45, 3))
    attitudes = quaternion.multiply(quaternion.from_rotation_vector(turn), POINTING)
    assert _worst(ROLLING_MODEL, at_pixels(ROLLING_MODEL, [80.0, 50.0]), times, attitudes) < 2e-3


@pytest.mark.parametrize("start", [(60.0, -2.0), (60.0, 101.0), (-25.0, 50.0), (110.0, 90.0)])
def test_streaks_that_an_edge_cuts_are_exact(start: tuple[float, float]) -> None:
    """The images of streaks that an edge truncates agree with sums over instants.

    Stars enter from above, below and the left, and leave at the corner.
    """
    vertical = 100.0 if start[1] < 60.0 else -100.0 if start[0] < 100.0 else 200.0
    rate = np.array([vertical, -200.0, 0.0]) / ROLLING_FOCAL
    assert _worst(ROLLING_MODEL, at_pixels(ROLLING_MODEL, start), *_history(rate)) < 2e-3


def test_a_track_under_a_rolling_shutter_is_a_star_under_the_opposite_turn() -> None:
    """Under a rolling shutter, an object that passes a camera at rest has the image of a star.

    The image equals the image of a star in a camera that rotates in the opposite sense.
    """
    times, attitudes = _history(np.array([100.0, -120.0, 0.0]) / ROLLING_FOCAL, 23)
    star = at_pixels(ROLLING_MODEL, [40.0, 40.0])
    seen = quaternion.attitude_matrix(attitudes) @ star[0]
    track = SourceTrack(times, seen @ quaternion.attitude_matrix(POINTING), 2.0)
    rest = np.tile(POINTING, (len(times), 1))
    image = expected_electrons(ROLLING_MODEL, np.zeros((0, 3)), [], times, rest, extra=[track])
    expected = expected_electrons(ROLLING_MODEL, star, [2.0], times, attitudes)
    assert np.abs(image - expected).max() < 1e-3 * expected.max()


def test_a_still_camera_sees_what_a_global_shutter_sees() -> None:
    rng = np.random.default_rng(5)
    stars = at_pixels(ROLLING_MODEL, rng.uniform(-5.0, 120.0, (40, 2)))
    magnitudes = rng.uniform(1.0, 6.0, 40)
    rolling = expected_electrons(ROLLING_MODEL, stars, magnitudes, *_history([0.0, 0.0, 0.0]))
    history = turning([0.0, 0.0, 0.0], EXPOSURE)
    whole = expected_electrons(replace(ROLLING_MODEL, line_time=0.0), stars, magnitudes, *history)
    assert np.abs(rolling - whole).max() < 1e-4 * whole.max()


def test_with_hardly_any_line_time_a_field_of_streaks_is_a_global_shutters() -> None:
    """With a very short line time, a field of streaks equals the field of a global shutter.

    Stars on and around the detector cross each edge, and a few stars are behind the camera.
    """
    rng = np.random.default_rng(6)
    stars = at_pixels(ROLLING_MODEL, rng.uniform(-150.0, 250.0, (300, 2)))
    stars[:20] *= -1.0
    magnitudes = rng.uniform(1.0, 6.0, 300)
    history = turning(np.array([300.0, -350.0, 200.0]) / ROLLING_FOCAL, EXPOSURE, 9)
    whole = expected_electrons(replace(ROLLING_MODEL, line_time=0.0), stars, magnitudes, *history)
    rolling = expected_electrons(replace(ROLLING_MODEL, line_time=1e-9), stars, magnitudes, *history)
    assert np.abs(rolling - whole).max() < 5e-4 * whole.max()


def test_stars_far_down_streak_later() -> None:
    """Stars in lower rows are exposed later.

    For two stars 80 rows apart and a rotation about y, the lower star is exposed 80 line times later.
    """
    times, attitudes = _history([0.0, 200.0 / ROLLING_FOCAL, 0.0])
    upper, lower = (
        centroid(
            expected_electrons(ROLLING_MODEL, at_pixels(ROLLING_MODEL, [80.0, y]), [2.0], times, attitudes)
        )[0]
        for y in (10.0, 90.0)
    )
    assert upper - lower == pytest.approx(200.0 * 80.0 * ROLLING_MODEL.line_time, abs=0.01)


def test_a_streak_that_runs_down_after_the_shutter_is_longer_and_brighter_in_all() -> None:
    """A star that moves down with the shutter is exposed for 1 / (1 - 0.08) times the exposure of a row.

    The streak of the star is longer and brighter by the factor 1 / (1 - 0.08). The star moves at 400 px/s,
    and the readout takes 0.2 ms per line.
    """
    star = at_pixels(ROLLING_MODEL, [60.0, 3.0])
    times, attitudes = turning([400.0 / ROLLING_FOCAL, 0.0, 0.0], 0.1 + READOUT)
    rolling = expected_electrons(ROLLING_MODEL, star, [2.0], times, attitudes).sum()
    assert rolling == pytest.approx(float(ROLLING_MODEL.electrons(2.0, 0.1)) / (1.0 - 0.08), rel=2e-3)


def test_the_frame_of_a_rolling_shutter_has_the_dark_current_of_one_exposure() -> None:
    model = replace(ROLLING_MODEL, dark_current=5000.0, read_noise=0.0)
    frame = render(model, np.zeros((0, 3)), [], *_history([0.0, 0.0, 0.0]), np.random.default_rng(1))
    assert frame.mean() == pytest.approx(100.0 + 5000.0 * EXPOSURE, abs=5.0 * np.sqrt(1000.0 / frame.size))


def test_a_history_too_short_for_the_last_row_is_refused() -> None:
    with pytest.raises(OutOfRange, match="attitude history's length"):
        expected_electrons(ROLLING_MODEL, np.zeros((0, 3)), [], *turning([0.0] * 3, READOUT))


def test_a_star_that_keeps_pace_with_the_shutter_is_refused() -> None:
    star = at_pixels(ROLLING_MODEL, [60.0, 10.0])
    with pytest.raises(OutOfRange, match="line time"):
        expected_electrons(
            replace(ROLLING_MODEL, line_time=2e-3), star, [2.0], *turning([0.2, 0.0, 0.0], 0.5)
        )
