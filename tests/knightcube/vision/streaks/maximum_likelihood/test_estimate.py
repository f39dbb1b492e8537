"""The estimator on frames of the simulator, the real sky in them: against truth and against the bound."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix
from knightcube.errors import FlightError
from knightcube.vision.streaks.maximum_likelihood.course import Course
from knightcube.vision.streaks.maximum_likelihood.estimate import estimate_motion
from knightcube.vision.streaks.maximum_likelihood.result import MotionResult
from knightcube.vision.streaks.maximum_likelihood.settings import LikelihoodSettings
from knightcube.vision.streaks.streak_result import StreakStatus
from sim_hal.star_camera import scatter_hot_pixels
from tests.flight.loop.executive.passing import passed
from tests.knightcube.vision.streaks.maximum_likelihood.scenes import (
    CAMERA,
    SATURATION,
    Scene,
    real_sky,
    taken,
    turn_of,
)
from tests.support.row_exposure import row_scene

_SETTINGS = LikelihoodSettings(saturation=SATURATION)


def _estimated(scene: Scene, settings: LikelihoodSettings = _SETTINGS) -> MotionResult:
    return estimate_motion(scene.pixels, scene.camera.pinhole, scene.exposure, settings, scene.rate, 0.0)


def _squared(error: FloatArray, covariance: FloatArray) -> float:
    return float(error @ np.linalg.solve(covariance, error))


@pytest.mark.parametrize(
    ("theta", "length"),
    [(0.0, 51.0), (0.0, 205.0), (10.0, 102.0), (45.0, 51.0), (45.0, 205.0), (90.0, 102.0), (90.0, 205.0)],
)
def test_the_rate_is_within_what_its_covariance_and_the_bound_allow(theta: float, length: float) -> None:
    """One frame each: 3 degrees of freedom, 16.3 is exceeded once in a thousand; thrice the bound's size."""
    scene = real_sky(int(theta) + int(length), np.radians(theta), length, 0.2)
    found = _estimated(scene)
    assert found.status is StreakStatus.RATE
    assert found.rate is not None
    assert found.covariance is not None
    error = found.rate - scene.rate
    assert _squared(error, found.covariance) < 16.3
    assert _squared(error, scene.bound().covariance) < 9.0 * 3.0


def test_stars_at_mid_exposure_are_where_they_were() -> None:
    scene = real_sky(11, np.radians(60.0), 102.0, 0.2)
    found = _estimated(scene)
    nearest = np.linalg.norm(found.stars[found.used][:, None] - scene.stars, axis=2).argmin(axis=1)
    off = found.stars[found.used] - scene.stars[nearest]
    squares = [_squared(o, c) for o, c in zip(off, found.star_covariance[found.used], strict=True)]
    assert np.median(squares) < 4.0
    # The faintest of them are known to a few tenths only.
    assert np.median(np.abs(off[:8])) < 0.1


def test_without_a_prior_the_direction_of_time_is_reported_as_ambiguous_and_with_one_resolved() -> None:
    scene = real_sky(12, np.radians(45.0), 60.0, 0.2)
    alone = estimate_motion(scene.pixels, CAMERA.pinhole, 0.2, _SETTINGS)
    assert alone.status is StreakStatus.AMBIGUOUS
    forward = _estimated(scene)
    backward = estimate_motion(scene.pixels, CAMERA.pinhole, 0.2, _SETTINGS, -scene.rate, 0.0)
    assert forward.rate is not None
    assert backward.rate is not None
    assert np.array_equal(forward.rate, -backward.rate)
    assert np.array_equal(forward.endpoints, backward.endpoints[:, ::-1])
    assert np.linalg.norm(forward.rate - scene.rate) < 0.01 * np.linalg.norm(scene.rate)
    weak = estimate_motion(scene.pixels, CAMERA.pinhole, 0.2, _SETTINGS, scene.rate, 10.0)
    assert weak.status is StreakStatus.AMBIGUOUS


def test_directions_at_both_ends_are_joined_by_the_rate() -> None:
    """A(start to end) takes every star's direction at the start to the one at the end."""
    found = _estimated(real_sky(13, np.radians(30.0), 80.0, 0.2))
    assert found.start_to_end is not None
    turned = found.directions[:, 0] @ attitude_matrix(found.start_to_end).T
    assert np.allclose(turned, found.directions[:, 2], atol=1e-9)


def test_stars_at_rest_become_centroids_and_no_rate_is_claimed() -> None:
    scene = real_sky(14, np.radians(90.0), 1e-3, 0.2)
    found = _estimated(scene)
    assert found.status is StreakStatus.TOO_SHORT
    assert found.rate is None
    nearest = np.linalg.norm(found.stars[:5, None] - scene.stars, axis=2).argmin(axis=1)
    assert np.median(np.linalg.norm(found.stars[:5] - scene.stars[nearest], axis=1)) < 0.05


def test_short_streaks_give_a_rate_with_an_honest_covariance() -> None:
    scene = real_sky(15, np.radians(45.0), 6.0, 0.2)
    found = _estimated(scene)
    assert found.covariance is not None
    assert found.rate is not None
    assert _squared(found.rate - scene.rate, found.covariance) < 16.3


def test_a_saturated_frame_of_a_long_exposure_with_hot_pixels_is_no_obstacle() -> None:
    camera = scatter_hot_pixels(CAMERA, 300, 3000.0, np.random.default_rng(3))
    scene = real_sky(16, np.radians(45.0), 40.0, 1.0, camera)
    assert np.count_nonzero(scene.pixels >= SATURATION) > 50
    found = _estimated(scene)
    assert found.rate is not None
    assert found.covariance is not None
    assert found.hot_pixels > 20
    assert _squared(found.rate - scene.rate, found.covariance) < 16.3


def test_a_gradient_and_eight_bits_are_no_obstacle() -> None:
    camera = replace(CAMERA, bits=8, gain=16.0, pedestal=20.0)
    scene = real_sky(17, np.radians(70.0), 60.0, 0.2, camera)
    ramp = np.linspace(0.0, 40.0, 1024).astype(np.uint16)
    pixels = np.minimum(scene.pixels.astype(np.uint16) + ramp, 255).astype(np.uint8)
    settings = LikelihoodSettings(saturation=215.0, gain=16.0)
    found = estimate_motion(pixels, CAMERA.pinhole, 0.2, settings, scene.rate, 0.0)
    assert found.rate is not None
    assert found.covariance is not None
    assert _squared(found.rate - scene.rate, found.covariance) < 16.3


def test_a_rate_that_changes_misfits_the_constant_model_and_fits_the_accelerating_one() -> None:
    turn = turn_of(np.radians(90.0), 102.0, 0.7)
    scene = taken(np.random.default_rng(18), turn, 0.3 * turn, 0.5)
    constant = _estimated(scene, replace(_SETTINGS, rate_model="constant"))
    accelerating = _estimated(scene, replace(_SETTINGS, rate_model="accelerating"))
    assert accelerating.misfit < 1.2
    assert constant.misfit > 1.3 * accelerating.misfit
    assert accelerating.acceleration is not None
    along = accelerating.acceleration @ turn / np.linalg.norm(turn) * 0.5**2 / np.linalg.norm(turn)
    assert along == pytest.approx(0.3, abs=0.02)


@pytest.mark.parametrize("growth", [0.0, 0.1])
def test_the_pixels_decide_whether_the_rate_changes(growth: float) -> None:
    """Left to choose, the fit takes the model that the frame was taken under; its covariance is honest."""
    turn = turn_of(np.radians(60.0), 102.0, 0.4)
    scene = taken(np.random.default_rng(24), turn, growth * turn, 0.2)
    found = _estimated(scene)
    assert found.rate_model == ("accelerating" if growth else "constant")
    assert (found.acceleration is None) is (growth == 0.0)
    assert found.rate is not None
    assert found.covariance is not None
    assert _squared(found.rate - scene.rate, found.covariance) < 16.3


@pytest.mark.parametrize(("growth", "length"), [(1.0, 50.0), (2.0, 16.0), (-2.0, 90.0)])
def test_a_rate_that_grows_from_nothing_or_falls_to_it_is_fitted_from_the_start(
    growth: float, length: float
) -> None:
    """To 200 % of the mean over the exposure: the slow ends are bright, the fast ones dim."""
    turn = turn_of(np.radians(60.0), length, 0.4)
    found = _estimated(taken(np.random.default_rng(25), turn, growth * turn, 0.2))
    assert found.rate is not None
    assert found.covariance is not None
    assert found.acceleration is not None
    assert _squared(found.rate - turn / 0.2, found.covariance) < 16.3
    assert found.acceleration @ turn * 0.2**2 / (turn @ turn) == pytest.approx(growth, abs=0.05)


def test_a_step_within_the_exposure_is_fitted_where_navigation_knows_the_course() -> None:
    """At rest for a third of the exposure, then faster and faster: no growth describes that."""
    turn = turn_of(np.radians(70.0), 40.0, 0.9)
    share = 1.0 / 3.0

    def progress(times: FloatArray) -> FloatArray:
        return np.maximum(times + 0.5 - share, 0.0) ** 2 / (1.0 - share) ** 2

    def turns(times: FloatArray) -> FloatArray:
        return (progress(times) - progress(np.zeros(1)))[:, None] * turn

    scene = row_scene(CAMERA, turns, 1.0, np.random.default_rng(27))
    times = np.linspace(-0.5, 0.5, 17)[:, None]
    rates = 2.0 * np.maximum(times + 0.5 - share, 0.0) / (1.0 - share) ** 2 * turn
    course = Course.of_rates(rates, 1.0, 0.1 / CAMERA.pinhole.focal_length)
    found = estimate_motion(scene.pixels, CAMERA.pinhole, 1.0, _SETTINGS, turn, 1e-5, None, course)
    assert found.status is StreakStatus.RATE
    assert found.rate is not None
    assert found.covariance is not None
    assert found.misfit < 1.3
    assert _squared(found.rate - turn, found.covariance) < 16.3


def test_a_course_that_is_wrong_is_dropped() -> None:
    turn = turn_of(np.radians(60.0), 80.0, 0.4)
    scene = taken(np.random.default_rng(28), turn, np.zeros(3), 0.2)
    course = Course(np.stack([turn, turn, 0.0 * turn]), 1e-5)
    found = estimate_motion(scene.pixels, CAMERA.pinhole, 0.2, _SETTINGS, scene.rate, 1e-5, None, course)
    assert found.rate is not None
    assert found.covariance is not None
    assert _squared(found.rate - scene.rate, found.covariance) < 16.3


def test_a_turn_that_reverses_within_the_exposure_is_beyond_the_model_and_refused() -> None:
    turn = turn_of(np.radians(60.0), 50.0, 0.4)
    found = _estimated(taken(np.random.default_rng(25), turn, 4.0 * turn, 0.2))
    assert found.rate is None


def test_streaks_of_half_the_field_are_fitted_though_few_are_whole() -> None:
    """The turn is found by a scan along the circles about the axis, where the regions' lengths mislead."""
    scene = real_sky(26, np.radians(75.0), 512.0, 0.2)
    found = _estimated(scene)
    assert found.rate is not None
    assert found.covariance is not None
    error = found.rate - scene.rate
    assert _squared(error, found.covariance) < 16.3
    assert _squared(error, scene.bound().covariance) < 9.0 * 3.0


def test_a_rolling_shutter_is_part_of_the_model_and_spoils_the_rate_when_it_is_not() -> None:
    """20 microseconds a line on streaks of 100 px in 0.2 s: lengths are off by a per cent."""
    camera = replace(CAMERA, line_time=2e-5)
    turn = turn_of(np.radians(90.0), 102.0, 0.2)
    scene = taken(np.random.default_rng(21), turn, np.zeros(3), 0.2, camera)
    rolling = _estimated(scene, replace(_SETTINGS, line_time=2e-5))
    assert rolling.rate is not None
    assert rolling.covariance is not None
    assert _squared(rolling.rate - scene.rate, rolling.covariance) < 16.3
    blind = _estimated(scene)
    assert blind.rate is not None
    size = np.linalg.norm(scene.rate)
    assert abs(np.linalg.norm(rolling.rate) / size - 1.0) < 0.002
    assert abs(np.linalg.norm(blind.rate) / size - 1.0) > 0.005


def test_a_rolling_shutter_makes_two_motions_of_a_turn_and_its_reverse() -> None:
    """50 us a line in 0.2 s, across the boresight: 5 % apart. Without a prior the answer spans both."""
    camera = replace(CAMERA, line_time=5e-5)
    turn = turn_of(np.radians(90.0), 102.0, 0.2)
    scene = taken(np.random.default_rng(22), turn, np.zeros(3), 0.2, camera)
    settings = replace(_SETTINGS, line_time=5e-5)
    forward = _estimated(scene, settings)
    backward = estimate_motion(scene.pixels, camera.pinhole, 0.2, settings, -scene.rate, 0.0)
    alone = estimate_motion(scene.pixels, camera.pinhole, 0.2, settings)
    assert (forward.status, backward.status) == (StreakStatus.RATE, StreakStatus.RATE)
    assert alone.status is StreakStatus.AMBIGUOUS
    assert forward.rate is not None
    assert forward.covariance is not None
    assert backward.rate is not None
    assert alone.rate is not None
    assert alone.covariance is not None
    assert _squared(forward.rate - scene.rate, forward.covariance) < 16.3
    apart = abs(np.linalg.norm(backward.rate) / np.linalg.norm(forward.rate) - 1.0)
    assert apart > 0.02
    sign = np.sign(alone.rate @ scene.rate)
    assert _squared(sign * alone.rate - scene.rate, alone.covariance) < 16.3


def test_a_frame_of_noise_a_dead_and_a_frozen_one_are_told() -> None:
    noise = np.random.default_rng(19).normal(100.0, 10.0, (1024, 1024)).astype(np.uint16)
    found = estimate_motion(noise, CAMERA.pinhole, 1.0, _SETTINGS)
    assert found.status is StreakStatus.TOO_FEW
    frozen = estimate_motion(noise, CAMERA.pinhole, 1.0, _SETTINGS, previous_checksum=found.checksum)
    assert frozen.status is StreakStatus.FROZEN
    dead = estimate_motion(np.full((1024, 1024), 7, np.uint16), CAMERA.pinhole, 1.0, LikelihoodSettings())
    assert dead.status is not StreakStatus.RATE


def test_the_result_is_deterministic_and_travels_between_processes() -> None:
    scene = real_sky(20, np.radians(45.0), 40.0, 0.2)
    first, second = _estimated(scene), _estimated(scene)
    assert pickle.dumps(first) == pickle.dumps(second)
    assert passed(first).used_count == first.used_count


def test_nonsense_is_refused() -> None:
    with pytest.raises(FlightError, match="shape"):
        estimate_motion(np.zeros((5, 5), np.uint16), CAMERA.pinhole, 1.0, _SETTINGS)
    with pytest.raises(FlightError, match="exposure"):
        estimate_motion(np.zeros((1024, 1024), np.uint16), CAMERA.pinhole, 0.0, _SETTINGS)
