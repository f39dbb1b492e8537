"""Tests of the attitudes at both ends of an exposure, and of the rate between them (Sease 3.22-3.29)."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import (
    angle_between,
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    normalise,
    to_rotation_vector,
)
from knightcube.errors import KnightCubeError
from knightcube.reference.corner_streak_rate import attitudes_of_ends, estimate_rate, solve_ends
from knightcube.reference.corner_streaks import DetectorName, StreakResult, StreakSettings
from knightcube.vision.startracker.solve import AttitudePrior, FrameSolution, SolveSettings, SolveStatus
from knightcube.vision.streaks.streak_result import StreakStatus
from tests.knightcube.vision.startracker.frames import NARROW, SkyFrame, sky, sky_frame
from tests.support.attitude_errors import attitude_error, error_in_pixels, field_fraction
from tests.support.streak_frames import expose, random_stars, rate_at, read_out, star_camera, true_endpoints

_EXPOSURE = 0.5
_STREAK_PX = 40.0


@cache
def _frame(seed: int) -> SkyFrame:
    return sky_frame(np.random.default_rng([31, seed]), _STREAK_PX, _EXPOSURE)


def _streaks(frame: SkyFrame, detector: DetectorName = "harris") -> StreakResult:
    settings = StreakSettings.of(detector)
    return estimate_rate(frame.pixels, NARROW.pinhole, frame.exposure, settings, frame.rate, 1e-6)


def _solve(found: StreakResult, prior: AttitudePrior | None = None) -> tuple[FrameSolution, StreakResult]:
    return solve_ends(found, NARROW.pinhole, (1.0, 1.0), sky(), SolveSettings(), prior)


def _error(solution: FrameSolution, truth: FloatArray) -> FloatArray:
    assert solution.fix is not None
    return to_rotation_vector(multiply(solution.fix.quaternion, conjugate(truth)))


@pytest.mark.parametrize("detector", ["harris", "minimum-eigenvalue", "trajkovic-4", "trajkovic-8"])
def test_the_streaks_of_every_detector_are_identified_and_both_ends_give_the_rate(
    detector: DetectorName,
) -> None:
    """With each detector, the attitude is correct to a third of a pixel (15"), and the rate to 2 %.

    The thesis states the same accuracies.
    """
    frame = _frame(0)
    solution, found = _solve(_streaks(frame, detector))
    assert solution.status is SolveStatus.SOLVED
    assert len(solution.matched) >= 0.9 * found.used_count
    assert np.linalg.norm(_error(solution, frame.attitude)[:2]) < 0.33 / NARROW.pinhole.focal_length
    assert found.rate is not None
    assert np.linalg.norm(found.rate) == pytest.approx(np.linalg.norm(frame.rate), rel=0.02)


def test_the_errors_of_attitude_and_rate_agree_with_their_covariances() -> None:
    """The squared normalised errors of ten frames are below twice the 1e-5 quantiles of chi-square."""
    attitude, rate = 0.0, 0.0
    for seed in range(10):
        frame = _frame(seed)
        solution, found = _solve(_streaks(frame))
        assert solution.fix is not None
        assert found.rate is not None
        assert found.covariance is not None
        error = _error(solution, frame.attitude)
        attitude += float(error @ np.linalg.solve(solution.fix.covariance, error))
        error = found.rate - frame.rate
        rate += float(error @ np.linalg.solve(found.covariance, error))
    assert 4.0 < attitude < 140.0
    assert 4.0 < rate < 140.0


def test_a_wrong_direction_of_time_leaves_the_attitude_at_mid_exposure_and_turns_the_rate() -> None:
    """If the order of the ends is wrong, the attitude at mid-exposure is right, and the rate is reversed.

    A frame does not show which end of a streak was exposed first.
    """
    frame = _frame(1)
    streaks = _streaks(frame)
    turned = replace(streaks, endpoints=streaks.endpoints[:, ::-1])
    (solution, found), (other, back) = _solve(streaks), _solve(turned)
    assert solution.fix is not None
    assert np.linalg.norm(_error(other, solution.fix.quaternion)) < 1e-6
    assert found.rate is not None
    assert back.rate == pytest.approx(-found.rate, rel=1e-3, abs=1e-6)


def test_the_stars_are_identified_by_tracking_near_a_prior_attitude() -> None:
    frame = _frame(1)
    near = multiply(from_rotation_vector(np.array([2e-4, 1e-4, -3e-4])), frame.attitude)
    solution, _ = _solve(_streaks(frame), AttitudePrior(near, 3e-4))
    assert solution.tracked
    assert np.linalg.norm(_error(solution, frame.attitude)[:2]) < 0.33 / NARROW.pinhole.focal_length


def test_streaks_of_no_sky_are_refused_and_their_rate_stays() -> None:
    """Streaks of a mirrored sky are not identified, but the rate of the streaks is still found."""
    streaks = _streaks(_frame(2))
    mirrored = streaks.endpoints * np.array([-1.0, 1.0]) + np.array([NARROW.pinhole.columns - 1.0, 0.0])
    strewn = replace(streaks, endpoints=mirrored)
    solution, found = _solve(strewn)
    assert solution.status is SolveStatus.NO_MATCH
    assert solution.fix is None
    assert found is strewn


def test_without_streaks_the_stars_are_not_named() -> None:
    solution, _ = _solve(StreakResult(StreakStatus.TOO_FEW, 0, _EXPOSURE))
    assert solution.status is SolveStatus.NO_STARS


_CAMERA = star_camera()
_FIELD = np.deg2rad(20.0)


def _field(seed: int, n: int = 12) -> FloatArray:
    """Return directions (n, 3) within 7 deg of the boresight, in the axes of mid-exposure."""
    points = np.random.default_rng(seed).uniform(160.0, 860.0, (n, 2))
    return _CAMERA.pinhole.unit_vectors(points)


@pytest.mark.parametrize("theta_deg", [0.0, 10.0, 45.0, 90.0])
@pytest.mark.parametrize("fraction", [0.001, 0.1, 0.5])
def test_exact_endpoints_give_back_the_rate_its_angle_and_axis(theta_deg: float, fraction: float) -> None:
    exposure = 0.5
    rate = rate_at(np.deg2rad(theta_deg), fraction * _FIELD / exposure, 0.7)
    stars = _field(1)
    ends = true_endpoints(_CAMERA, stars, rate * exposure)
    found = attitudes_of_ends(ends, stars, np.full(len(stars), 0.1), _CAMERA.pinhole, exposure)
    np.testing.assert_allclose(found.rate, rate, atol=1e-11 / exposure)
    assert np.linalg.norm(found.rotation_vector) == pytest.approx(fraction * _FIELD, abs=1e-11)
    np.testing.assert_allclose(
        found.rotation_vector / np.linalg.norm(found.rotation_vector), rate / np.linalg.norm(rate), atol=1e-8
    )
    assert field_fraction(found.rate, exposure, _FIELD) == pytest.approx(fraction, rel=1e-8)
    # The ends are half the rotation before and after mid-exposure. The star directions are in the axes of
    # mid-exposure.
    for fix, sign in ((found.start, -0.5), (found.end, 0.5)):
        assert angle_between(fix.quaternion, from_rotation_vector(sign * rate * exposure)) < 1e-11


def test_the_sign_is_that_of_a_star_fixed_in_the_sky() -> None:
    """In a camera that rotates about +y, stars move towards -x, because v' = (-omega_y, omega_x) at v = z."""
    stars = _field(2)
    ends = _CAMERA.pinhole.project(stars)[:, None] + np.array([[4.0, 0.0], [-4.0, 0.0]])
    found = attitudes_of_ends(ends, stars, np.full(len(stars), 0.1), _CAMERA.pinhole, 1.0)
    assert found.rate[1] > 0.0
    assert abs(found.rate[0]) < 0.05 * found.rate[1]


def test_the_equations_as_printed_hold_with_the_sign_corrected() -> None:
    """Equations 3.24-3.26 hold with the corrected sign.

    The equations use the matrix Delta from start to end, its trace and its skew-symmetric part.
    """
    rate = rate_at(np.deg2rad(50.0), 0.1, 0.3)
    stars = _field(3)
    found = attitudes_of_ends(
        true_endpoints(_CAMERA, stars, rate), stars, np.full(12, 0.1), _CAMERA.pinhole, 1.0
    )
    delta = attitude_matrix(found.end.quaternion) @ attitude_matrix(found.start.quaternion).T
    angle = np.arccos(0.5 * (np.trace(delta) - 1.0))
    skew = (delta.T - delta) / (2.0 * np.sin(angle))
    assert np.linalg.norm(found.rotation_vector) == pytest.approx(angle, abs=1e-12)
    np.testing.assert_allclose(
        found.rotation_vector / np.linalg.norm(found.rotation_vector),
        [skew[2, 1], skew[0, 2], skew[1, 0]],
        atol=1e-10,
    )


def test_the_attitudes_are_of_the_frame_the_reference_is_given_in() -> None:
    q = normalise(np.array([0.3, -0.5, 0.7, 0.2]))
    rate = rate_at(1.0, 0.05)
    stars = _field(4)
    ends = true_endpoints(_CAMERA, stars, rate)
    # Catalogue directions of the same stars. The matrix A(q) transforms catalogue axes into the axes of
    # mid-exposure.
    catalogue = stars @ attitude_matrix(q)
    found = attitudes_of_ends(ends, catalogue, np.full(12, 0.1), _CAMERA.pinhole, 1.0)
    middle = multiply(from_rotation_vector(0.5 * found.rotation_vector), found.start.quaternion)
    assert angle_between(middle, q) < 1e-11


def test_the_covariance_is_that_of_the_errors() -> None:
    rng = np.random.default_rng(5)
    runs, sigma = 300, np.random.default_rng(6).uniform(0.05, 0.3, 12)
    exposure, stars = 0.4, _field(5)
    rate = rate_at(np.deg2rad(40.0), 0.5 * _FIELD / exposure, 1.0)
    ends = true_endpoints(_CAMERA, stars, rate * exposure)
    squared = []
    for _ in range(runs):
        noisy = ends + sigma[:, None, None] * rng.normal(size=ends.shape)
        found = attitudes_of_ends(noisy, stars, sigma, _CAMERA.pinhole, exposure)
        error = found.rate - rate
        squared.append(error @ np.linalg.solve(found.covariance, error))
    assert np.mean(squared) == pytest.approx(3.0, abs=3.0 * np.sqrt(6.0 / runs))


def test_the_error_in_pixels_is_that_of_3_29() -> None:
    assert error_in_pixels(np.deg2rad(0.01), 1024, _FIELD) == pytest.approx(0.512)


def test_a_turn_about_the_boresight_does_not_count_as_an_error_across_it() -> None:
    truth = normalise(np.array([0.1, 0.4, -0.2, 0.9]))
    for turn, across in (([0.0, 0.0, 1e-3], 0.0), ([6e-4, 8e-4, 0.0], 1e-3), ([0.0, 0.0, 0.0], 0.0)):
        estimate = multiply(from_rotation_vector(np.array(turn)), truth)
        found = attitude_error(estimate, truth)
        assert found[0] == pytest.approx(np.linalg.norm(turn), abs=1e-12)
        assert found[1] == pytest.approx(across, abs=1e-12)
        assert attitude_error(conjugate(estimate), conjugate(truth))[0] == pytest.approx(found[0], abs=1e-12)


def test_a_frame_with_its_stars_known_gives_both_attitudes_to_a_fifth_of_a_pixel() -> None:
    """With known identifications, both attitudes are correct to a fifth of a pixel.

    For Harris's corners and streaks of 10 % of the field, the thesis states 0.10 px.
    """
    rng = np.random.default_rng(7)
    rate = rate_at(np.deg2rad(60.0), 0.1 * _FIELD, 0.4)
    stars, magnitudes = random_stars(rng, _CAMERA.pinhole, 0.05, 6.0)
    pixels = read_out(_CAMERA, expose(_CAMERA, stars, magnitudes, rate, 1.0), 1.0, rng)
    result = estimate_rate(pixels, _CAMERA.pinhole, 1.0, StreakSettings(), rate, 1e-3)
    assert result.status is StreakStatus.RATE
    ends = result.endpoints[result.used]
    truth = true_endpoints(_CAMERA, stars, rate)
    distance = np.linalg.norm(truth[None] - ends[:, None], axis=-1).max(axis=-1)
    star = np.nanargmin(distance, axis=1)
    assert distance[np.arange(len(ends)), star].max() < 1.0
    found = attitudes_of_ends(ends, stars[star], np.full(len(ends), 0.1), _CAMERA.pinhole, 1.0)
    for fix, sign in ((found.start, -0.5), (found.end, 0.5)):
        across = attitude_error(fix.quaternion, from_rotation_vector(sign * rate))[1]
        assert error_in_pixels(across, 1024, _FIELD) < 0.2
    assert np.linalg.norm(found.rate) == pytest.approx(np.linalg.norm(rate), rel=0.005)


def test_an_impossible_exposure_is_refused() -> None:
    stars = _field(8)
    ends = true_endpoints(_CAMERA, stars, rate_at(1.0, 0.02))
    for exposure in (0.0, -1.0, float("nan")):
        with pytest.raises(KnightCubeError, match="exposure"):
            attitudes_of_ends(ends, stars, np.full(12, 0.1), _CAMERA.pinhole, exposure)
