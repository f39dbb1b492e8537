"""Tests of the uncertainty of the rotation: calibration errors, their corrections, and residuals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import from_rotation_vector, multiply
from knightcube.vision.camera.lens import EXACT, UNSTATED, CameraKnowledge
from knightcube.vision.streaks.estimate import estimate_motion
from knightcube.vision.streaks.frame import reduce_frame
from knightcube.vision.streaks.geometry import CameraMotion, Shutter, StreakScene, sensitivities
from knightcube.vision.streaks.joint_fit import FitProblem, brightest_fit
from knightcube.vision.streaks.streak_result import LikelihoodSettings
from knightcube.vision.streaks.uncertainty import apparent_rates, correct, end_displacement, side_displacement
from knightcube.vision.streaks.vibration import StreakResiduals
from sim_hal.star_camera import StarCameraModel, render
from tests.knightcube.vision.streaks.scenes import CAMERA, SATURATION, real_sky, turn_of
from tests.support.scenes import FIELD, RandomSlew

_TURN = np.array([0.02, 0.03, 0.0])


def _seeming(knowledge: CameraKnowledge, turn: FloatArray = _TURN) -> tuple[FloatArray, FloatArray]:
    """Return apparent rotations (n, 3, m) of n stars for m errors, and the stars' information (n, 3, 3)."""
    x, y = np.meshgrid(np.linspace(150.0, 870.0, 5), np.linspace(150.0, 870.0, 5))
    stars = np.stack([x.ravel(), y.ravel()], axis=1)
    ones = np.ones(len(stars))
    scene = StreakScene(CameraMotion.steady(turn), 1.04, stars, ones, ones, ones > 0.0)
    frame = reduce_frame(np.zeros((1024, 1024), np.uint16), SATURATION, 1.0)
    camera = FitProblem(frame, CAMERA.pinhole, Shutter(), LikelihoodSettings(knowledge=knowledge), 1.0)
    half = np.full(len(stars), 0.5)
    opening = (
        sensitivities(CAMERA.pinhole, scene.motion, stars, half)
        - sensitivities(CAMERA.pinhole, scene.motion, stars, -half)
    )[:, :, :3]
    return apparent_rates(camera, scene, 0.2), opening.swapaxes(1, 2) @ opening


def _together(seeming: FloatArray, information: FloatArray) -> FloatArray:
    """Return the apparent common rotation (3, m) of all stars for each of m calibration errors."""
    return np.asarray(np.linalg.solve(information.sum(axis=0), np.sum(information @ seeming, axis=0)))


def test_an_exact_camera_has_no_errors() -> None:
    assert _seeming(EXACT)[0].shape == (25, 3, 0)


def test_a_wrong_image_centre_appears_as_a_rotated_rate() -> None:
    """A wrong image centre appears as a rotated rate vector.

    A shift by dx is, to first order, a rotation by dx / f about y. Only half of the rotation by dx / f
    appears in the rate. The shift also changes the motion field in the image to second order, which cancels
    the effect on one of the two components of the motion. The fraction of one half holds for stars on a
    square.
    """
    focal = CAMERA.pinhole.focal_length
    found = _together(*_seeming(replace(EXACT, centre=5.0)))
    about_y, about_x = np.array([0.0, 5.0 / focal, 0.0]), np.array([-5.0 / focal, 0.0, 0.0])
    expected = 0.5 * np.stack([np.cross(about_y, _TURN), np.cross(about_x, _TURN)], axis=1)
    assert np.linalg.norm(found - expected) < 0.01 * np.linalg.norm(expected)


def test_wrong_focal_length_and_wrong_line_time_appear_as_another_rate() -> None:
    """Wrong focal length and wrong line time appear as a different rate.

    For an axis perpendicular to the boresight, the rate is the streak length divided by the focal length.
    """
    found = _together(*_seeming(replace(EXACT, focal_length=0.01)))
    assert found[:, 0] == pytest.approx(0.01 * _TURN, abs=0.1 * 0.01 * float(np.linalg.norm(_TURN)))
    late = _together(*_seeming(replace(EXACT, line_time=1e-5)))
    rows_crossed = CAMERA.pinhole.focal_length * _TURN[0] / 0.2 * 1e-5
    assert abs(late[:, 0] @ _TURN) / (_TURN @ _TURN) == pytest.approx(rows_crossed, rel=0.1)


def test_an_unstated_shutter_appears_as_a_larger_rotation_for_each_star() -> None:
    """An unknown shutter delay appears as a larger rotation of each star.

    The delay of the rows makes the paths longer without changing their curvature.
    """
    turn = np.array([0.07, 0.05, -0.05])
    late, _ = _seeming(replace(EXACT, line_time=1e-5), turn)
    size = float(np.linalg.norm(turn))
    along = late[:, :, 0] @ turn / size
    assert np.linalg.norm(late[:, :, 0] - along[:, None] * turn / size) < 0.05 * np.linalg.norm(along)


def test_a_shutter_counts_as_unstated_unless_line_time_or_accuracy_is_given() -> None:
    assert LikelihoodSettings().line_time_sigma == UNSTATED
    assert LikelihoodSettings(line_time=0.0).line_time_sigma == 0.0
    assert LikelihoodSettings(line_time=2e-5).line_time_sigma == 0.0
    assert LikelihoodSettings().shutter_unstated
    assert not LikelihoodSettings(line_time=0.0).shutter_unstated
    assert not LikelihoodSettings(knowledge=EXACT).shutter_unstated
    known = replace(CameraKnowledge(), line_time=3e-6)
    assert LikelihoodSettings(line_time=2e-5, knowledge=known).line_time_sigma == 3e-6


def test_significant_calibration_errors_are_corrected_and_others_widen_the_covariance() -> None:
    """Significant calibration errors are corrected, and other errors increase the covariance.

    A distortion of 1 %, a hundred times the noise, is corrected. An error that may be due to chance is not
    corrected.
    """
    seeming, information = _seeming(replace(EXACT, distortion=0.01))
    precise = 1e4 * information
    score = np.einsum("nij,njk->ni", precise, seeming)
    mean = np.linalg.solve(precise.sum(axis=0), score.sum(axis=0))
    done = correct(precise, score - np.einsum("nij,j->ni", precise, mean), seeming, 1.0, 1)
    assert done is not None
    assert done.step == pytest.approx(-mean, rel=0.05)
    assert np.abs(done.score).max() < 0.05 * np.abs(score).max()
    vague = 1e-6 * information
    done = correct(vague, np.zeros((25, 3)), seeming, 1.0, 1)
    assert done is not None
    assert not done.step.any()
    assert np.trace(done.added) == pytest.approx(float(mean @ mean), rel=0.05)


def test_an_uncertain_camera_widens_the_covariance_and_keeps_the_rate() -> None:
    scene = real_sky(12, np.radians(70.0), 102.0, 0.2)

    def found(**more: object) -> tuple[FloatArray, FloatArray]:
        settings = LikelihoodSettings(saturation=SATURATION, **more)  # type: ignore[arg-type]  # of settings
        result = estimate_motion(scene.pixels, CAMERA.pinhole, 0.2, settings, scene.rate, 0.0)
        assert result.rate is not None
        assert result.covariance is not None
        return result.rate, result.covariance

    rate, exact = found(knowledge=EXACT)
    same, usual = found()
    assert same == pytest.approx(rate)
    assert np.all(np.linalg.eigvalsh(usual - exact) > -1e-18)
    assert np.trace(usual) > 1.5 * np.trace(exact)
    _, doubted = found(knowledge=EXACT, psf_sigma=0.95, worst_uncertainty=0.1)
    assert np.trace(doubted) > 10.0 * np.trace(exact)


@pytest.mark.parametrize("measure", ["disagreement", "contradiction"])
def test_scatter_of_the_stars_beyond_their_noise_increases_the_rates_covariance(
    measure: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If the scatter of the stars is five times their noise, all variances from noise increase 25-fold."""
    scene = real_sky(12, np.radians(70.0), 102.0, 0.2)
    settings = LikelihoodSettings(saturation=SATURATION, knowledge=EXACT)
    sizes = []
    for scatter in (0.5, 25.0):
        monkeypatch.setattr(f"{correct.__module__}.{measure}", lambda *_, scatter=scatter: scatter)
        found = estimate_motion(scene.pixels, CAMERA.pinhole, 0.2, settings, scene.rate, 0.0)
        assert found.covariance is not None
        sizes.append(np.trace(found.covariance))
    assert 10.0 < sizes[1] / sizes[0] < 26.0


def test_short_streaks_of_another_point_spread_are_rejected_with_a_reason() -> None:
    scene = real_sky(12, np.radians(70.0), 12.0, 0.2, replace(CAMERA, psf_sigma=1.5))
    settings = LikelihoodSettings(saturation=SATURATION, line_time=0.0)
    result = estimate_motion(scene.pixels, CAMERA.pinhole, 0.2, settings, scene.rate, 0.0)
    assert result.rate is None
    assert "point spread is 1.4" in result.reason


def test_two_stars_give_a_rate_with_a_large_covariance() -> None:
    turn = turn_of(np.radians(60.0), 90.0, 0.3)
    middle = np.array([0.0, 0.0, 0.0, 1.0])
    stars = CAMERA.pinhole.unit_vectors(np.array([[300.0, 350.0], [700.0, 560.0]]))
    times = np.array([-0.5, 0.0, 0.5])
    attitudes = multiply(from_rotation_vector(times[:, None] * turn), middle)
    rng = np.random.default_rng(4)
    pixels = render(CAMERA, stars, np.array([2.0, 3.0]), 0.2 * (times + 0.5), attitudes, rng)
    settings = LikelihoodSettings(saturation=SATURATION, knowledge=EXACT)
    found = estimate_motion(pixels, CAMERA.pinhole, 0.2, settings, turn / 0.2, 0.0)
    assert found.used_count == 2
    assert found.rate is not None
    assert found.covariance is not None
    error = found.rate - turn / 0.2
    assert error @ np.linalg.solve(found.covariance, error) < 16.3
    assert np.linalg.norm(error) < 0.01 * np.linalg.norm(turn / 0.2)


def test_stars_hidden_in_streaks_do_not_move_the_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """Undetected stars in streaks do not displace the ends.

    In crowded frames, a fit of the brightest streaks that includes all undetected stars has smaller errors.
    """
    camera = StarCameraModel(field_of_view=FIELD)
    settings = LikelihoodSettings(saturation=SATURATION, gain=camera.gain, knowledge=EXACT)
    errors = []
    for run in (21, 67, 96):
        scene, _ = RandomSlew.drawn(1999, run).exposed(camera)
        for fitted in (brightest_fit, lambda *_: None):
            with monkeypatch.context() as patch:
                patch.setattr("knightcube.vision.streaks.uncertainty.brightest_fit", fitted)
                found = estimate_motion(
                    scene.pixels, camera.pinhole, scene.exposure, settings, scene.rate, 0.0
                )
            assert found.rate is not None
            assert found.covariance is not None
            error = found.rate - scene.rate
            size = np.linalg.norm(error) / np.linalg.norm(scene.rate)
            errors.append([size, error @ np.linalg.solve(found.covariance, error)])
    after, before = np.array(errors[::2]), np.array(errors[1::2])
    assert after[:, 0].mean() < 0.5 * before[:, 0].mean()
    assert after[:, 1].max() < chi2.isf(1e-3, 3)


def _left(residual: float, noise: float, shift: str) -> tuple[StreakResiduals, StreakScene]:
    """Return residuals of ends or sides that are displaced by `residual` px, with a noise factor."""
    rng = np.random.default_rng(3)
    images = np.zeros((40, 7, 10, 9), dtype=np.float32)
    ends, sides = slice(0, 20), slice(20, 40)
    images[ends, 3] = rng.uniform(0.1, 0.4, (20, 10, 9))
    images[sides, 1] = rng.uniform(-0.4, 0.4, (20, 10, 9))
    change = 500.0 * (images[:, 3] if shift == "ends" else images[:, 1])
    left = residual * change + rng.normal(0.0, 20.0 * noise, change.shape)
    weight = np.full(change.shape, 20.0**-2, dtype=np.float32)
    everyone = np.ones(1, dtype=np.bool_)
    scene = StreakScene(
        CameraMotion.steady(np.zeros(3)), 1.04, np.zeros((1, 2)), np.array([500.0]), np.zeros(1), everyone
    )
    star, time = np.zeros(40, dtype=np.int64), np.zeros((40, 10))
    return StreakResiduals(star, time, images, weight, left.astype(np.float32)), scene


@pytest.mark.parametrize(("shift", "measured"), [("ends", end_displacement), ("sides", side_displacement)])
def test_residuals_are_measured_as_a_displacement(shift: str, measured: object) -> None:
    assert callable(measured)
    displaced = measured(*_left(0.5, 1.0, shift))
    assert displaced.shown == pytest.approx(0.5, rel=0.1)
    assert displaced.chance >= displaced.shown
    by_chance = measured(*_left(0.0, 1.0, shift))
    assert by_chance.shown == 0.0
    assert 0.0 < by_chance.chance < 0.15


def test_streaks_without_ends_in_the_frame_have_no_displacement_of_ends() -> None:
    left, scene = _left(0.5, 1.0, "sides")
    left.images[:, 3] = 0.0
    assert end_displacement(left, scene) is None
