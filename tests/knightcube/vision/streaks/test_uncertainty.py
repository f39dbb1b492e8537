"""Tests of the uncertainty of the rotation: calibration errors, their corrections, and residuals."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.stats import chi2

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import from_rotation_vector, multiply
from knightcube.vision.camera.lens import EXACT, UNSTATED, CameraKnowledge, DistortedPinhole
from knightcube.vision.streaks import uncertainty
from knightcube.vision.streaks.camera_motion import CameraMotion, Vibration
from knightcube.vision.streaks.estimate import estimate_motion
from knightcube.vision.streaks.fit_windows import Strips
from knightcube.vision.streaks.frame import reduce_frame
from knightcube.vision.streaks.geometry import (
    PsfProfile,
    Shutter,
    StreakScene,
    sensitivities,
)
from knightcube.vision.streaks.joint_fit import FitProblem, StreakFit, brightest_fit
from knightcube.vision.streaks.normal_equations import ALONE, SHARED, StarEquations
from knightcube.vision.streaks.streak_result import LikelihoodSettings
from knightcube.vision.streaks.uncertainty import (
    Displacement,
    apparent_rates,
    contradiction,
    correct,
    disagreement,
    distorted_camera,
    end_displacement,
    side_displacement,
)
from knightcube.vision.streaks.vibration import StreakResiduals
from sim_hal.star_camera import StarCameraModel, render
from tests.knightcube.vision.streaks.scenes import CAMERA, SATURATION, real_sky, turn_of
from tests.sim_hal.star_camera.scenes import integrated_by_brute_force
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

    A shift by dx is, to first order, a rotation by dx / f about y. Only half of this rotation appears in the
    rate. The shift also changes the motion field in the image to second order, which cancels the effect on
    one of the two components of the motion. The fraction of one half applies to stars spread over a square.
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
    scene = real_sky(12, np.radians(70.0), 8.0, 0.2, replace(CAMERA, psf_sigma=1.5))
    settings = LikelihoodSettings(saturation=SATURATION, line_time=0.0)
    result = estimate_motion(scene.pixels, CAMERA.pinhole, 0.2, settings, scene.rate, 0.0)
    assert result.rate is None
    assert "point spread is 1.49" in result.reason


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
    """Return residuals of streak ends or sides displaced by `residual` px, with `noise` times their noise."""
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
    no_strips = cast("Strips", None)  # not used here
    return StreakResiduals(no_strips, star, time, images, weight, left.astype(np.float32)), scene


@pytest.mark.parametrize(("shift", "measured"), [("ends", end_displacement), ("sides", side_displacement)])
def test_residuals_are_measured_as_a_displacement(shift: str, measured: object) -> None:
    assert callable(measured)
    displaced = measured(*_left(0.5, 1.0, shift))
    assert displaced.shown == pytest.approx(0.5, rel=0.1)
    assert displaced.chance >= displaced.shown
    by_chance = measured(*_left(0.0, 1.0, shift))
    assert by_chance.shown == 0.0
    assert 0.0 < by_chance.chance < 0.15


def test_a_learned_profile_that_is_wrong_everywhere_does_not_displace_the_ends() -> None:
    """With a learned profile, only residuals larger than those elsewhere show a displacement."""
    learned = PsfProfile((0.5, 1.0), (-0.5, 1.5))
    for displaced, expected in ((0.0, 0.0), (0.5, 0.5)):
        left, scene = _left(displaced, 1.5, "ends")
        found = end_displacement(left, replace(scene, profile=learned))
        usual = end_displacement(left, scene)
        assert found is not None
        assert usual is not None
        assert found.shown == pytest.approx(expected, rel=0.1, abs=1e-9)
        assert usual.shown > found.shown + 0.02


def test_streaks_without_ends_in_the_frame_have_no_displacement_of_ends() -> None:
    left, scene = _left(0.5, 1.0, "sides")
    left.images[:, 3] = 0.0
    assert end_displacement(left, scene) is None


@pytest.mark.parametrize("spread", [1.0, 2.5])
@pytest.mark.parametrize("counted", [None, np.array([0.3, -0.7, 0.2])])
def test_calibration_errors_are_estimated_together_with_the_motion(
    spread: float, counted: FloatArray | None
) -> None:
    """The correction is that of dense equations for the motion and all calibration errors.

    Each calibration error has a prior standard deviation of one. The errors that the fit has already
    corrected are part of the prior. The covariance increases by the contribution of the errors and by the
    square of the correction.
    """
    rng = np.random.default_rng(8)
    n, k, m, described = 6, 4, 3, 2
    root = rng.normal(size=(n, k, 7))
    information, apparent = root @ root.swapaxes(1, 2), rng.normal(size=(n, k, m)) * [5.0, 2.0, 3.0]
    true = np.array([2.0, -1.5, 1.0])
    score = np.einsum("nij,nj->ni", information, apparent @ true + 0.1 * rng.normal(size=(n, k)))
    found = correct(information, score, apparent, spread, described, counted)
    assert found is not None

    def dense(of: int) -> FloatArray:
        """Return the information matrix of the motion and of the first `of` calibration errors."""
        whole = np.zeros((k + of, k + of))
        for known, change in zip(information / spread, apparent[:, :, :of], strict=True):
            design = np.hstack([np.eye(k), change])
            whole += design.T @ known @ design
        whole[range(k, k + of), range(k, k + of)] += 1.0
        return whole

    prior = np.zeros(m) if counted is None else counted
    right = np.append(score.sum(axis=0), np.einsum("nkm,nk->m", apparent, score)) / spread
    right[k:] -= prior
    both = np.linalg.solve(dense(m), right)
    alone = np.linalg.solve(information.sum(axis=0), score.sum(axis=0))
    assert found.error == pytest.approx(both[k:])
    assert found.step == pytest.approx(both[:k] - alone)
    exact = spread * np.linalg.inv(information.sum(axis=0))
    change = both[:k] - alone
    more = np.linalg.inv(dense(m))[:k, :k] - exact + np.outer(change, change)
    assert found.added == pytest.approx(more)
    partial = np.linalg.solve(information.sum(axis=0), (information @ apparent).sum(axis=0))[:, :described]
    described_change = partial @ both[k : k + described]
    stated = np.linalg.inv(dense(described))[:k, :k] - exact
    assert found.described == pytest.approx(stated + np.outer(described_change, described_change))
    left = score - np.einsum("nij,nj->ni", information, apparent @ both[k:] + change)
    assert found.score == pytest.approx(left)


def test_a_calibration_error_is_corrected_if_it_is_hardly_due_to_chance() -> None:
    """A calibration error is corrected if chi-square exceeds its quantile for a probability of 1e-5.

    The difference of the two stars has a variance of 2 from noise and of 4 from the calibration error.
    """
    information = np.array([[[1.0]], [[1.0]]])
    apparent = np.array([[[1.0]], [[-1.0]]])
    limit = float(chi2.isf(uncertainty._BY_CHANCE, 1))
    for share, corrected in ((0.99, False), (1.01, True)):
        # The scores (d, -d) give the gradient 2 d for the error, whose information is 2 + 1 (prior).
        difference = np.sqrt(share * limit * 3.0) / 2.0
        score = np.array([[difference], [-difference]])
        done = correct(information, score, apparent, 1.0, 1)
        assert done is not None
        assert done.error == pytest.approx([2.0 * difference / 3.0])
        # The error has no effect on the common motion.
        assert done.step == pytest.approx([0.0], abs=1e-12)
        tilted = correct(np.array([[[1.0]], [[1.001]]]), score, apparent, 1.0, 1)
        assert tilted is not None
        assert tilted.step.any() == corrected
    assert correct(0.0 * information, score, apparent, 1.0, 1) is None


def _camera(knowledge: CameraKnowledge) -> FitProblem:
    frame = reduce_frame(np.zeros((64, 80), np.uint16), SATURATION, 1.0)
    settings = LikelihoodSettings(line_time=0.0, knowledge=knowledge)
    return FitProblem(frame, replace(CAMERA.pinhole, columns=80, rows=64), Shutter(), settings, 1.0)


def test_a_lens_is_corrected_by_its_errors() -> None:
    """The errors are those of focal length, image centre and distortion; exactly known values are omitted."""
    camera = _camera(replace(EXACT, focal_length=0.01, centre=3.0, distortion=0.02, line_time=1e-5))
    lens = distorted_camera(camera, np.array([0.5, -1.0, 2.0, 0.25, 7.0])).pinhole
    assert isinstance(lens, DistortedPinhole)
    assert (lens.scale, lens.cubic) == pytest.approx((0.005, 0.005))
    assert lens.shift == pytest.approx((-3.0, 6.0))
    assert (lens.columns, lens.rows, lens.focal_length) == (80, 64, camera.pinhole.focal_length)
    partly = _camera(replace(EXACT, centre=3.0))
    again = distorted_camera(replace(partly, pinhole=lens), np.array([1.0, 0.5])).pinhole
    assert isinstance(again, DistortedPinhole)
    assert (again.scale, again.cubic) == pytest.approx((0.005, 0.005))
    assert again.shift == pytest.approx((0.0, 7.5))


def test_correlated_calibration_errors_have_the_stated_covariance() -> None:
    root = np.random.default_rng(5).normal(size=(5, 5)) * np.array([[0.01], [2.0], [3.0], [0.02], [0.0]])
    covariance = root @ root.T
    knowledge = replace(EXACT, covariance=tuple(tuple(row) for row in covariance.tolist()))
    found = uncertainty._error_root(_camera(knowledge))
    assert found @ found.T == pytest.approx(covariance)


@pytest.mark.parametrize("share", [-0.3, 0.0, 0.4, 0.9])
@pytest.mark.parametrize("length", [30.0, 44.0])
def test_the_intensity_of_a_reversing_motion_is_that_of_many_instants(share: float, length: float) -> None:
    """The chi-square of a reversing motion is that of a fit of flux and sky level to all pixels.

    The exposure lasts from -`share` to 1 in a time that is 0 at the reversal. The distance from the point of
    rest grows with the square of this time.
    """
    rng = np.random.default_rng(2)
    places = np.arange(-uncertainty._BEFORE, 60.0, uncertainty._STEP)
    nearest = rng.integers(0, len(places), 500)
    across, weight = rng.uniform(0.1, 1.0, 500), rng.uniform(0.5, 2.0, 500)
    time = np.linspace(-share, 1.0, 400_001)
    middle = 0.5 * (time[1:] + time[:-1])
    edges = np.append(places, places[-1] + uncertainty._STEP) - 0.5 * uncertainty._STEP
    light = np.histogram(length * middle**2, edges)[0] / len(middle)
    light = gaussian_filter1d(light, 1.2 / uncertainty._STEP, mode="constant")
    data = 300.0 * light[nearest] * across + 2.0 + rng.normal(size=500)
    design = np.stack([light[nearest] * across, np.ones(500)], axis=1) * np.sqrt(weight)[:, None]
    solved = np.linalg.lstsq(design, data * np.sqrt(weight), rcond=None)[0]
    expected = float(np.sum((data * np.sqrt(weight) - design @ solved) ** 2))
    terms = across**2, across * data, across
    square, cross, plain = (np.bincount(nearest, weight * each, len(places)).astype(float) for each in terms)
    moments = float(np.sum(weight)), float(weight @ data), float(weight @ data**2)
    one = uncertainty._PathLight(places, square, cross, plain, moments, 500)
    found = uncertainty._reversal_chi2(one, np.array([share, 0.2]), np.array([length, 20.0, 25.0]), 1.2)
    assert found.shape == (2, 3)
    assert found[0, 0] == pytest.approx(expected, rel=1e-3)


def test_ends_are_uncertain_by_the_difference_of_the_point_spread(monkeypatch: pytest.MonkeyPatch) -> None:
    """The uncertainty is the root of the difference of the variances, or less if the residuals are small.

    An excess within one standard deviation of the fitted and of the learned variance is neglected.
    """
    left, scene = _left(0.0, 1.0, "ends")
    described = 1.2**2 + 1.0 / 12.0

    def found(
        change: float,
        misfit: float,
        ends: Displacement | None,
        deviation: float = 0.0,
        scene: StreakScene = scene,
        learned: float = 0.0,
    ) -> float:
        monkeypatch.setattr(uncertainty, "end_displacement", lambda *_: ends)
        width = float(np.sqrt(described + change))
        covariance = np.zeros((SHARED, SHARED))
        covariance[-1, -1] = (deviation / (2.0 * width)) ** 2
        fit = SimpleNamespace(
            scene=replace(scene, width=width), solution=SimpleNamespace(covariance=covariance)
        )
        knowledge = replace(EXACT, psf_sigma=learned / (2.0 * 1.2))
        settings = LikelihoodSettings(psf_sigma=1.2, knowledge=knowledge)
        return uncertainty._end_uncertainty(left, cast("StreakFit", fit), settings, misfit)

    difference, another = 0.49 + uncertainty._WIDER * described, uncertainty._END_SHARE * 0.7
    assert found(difference, 0.5, None) == pytest.approx(another)
    assert found(-0.49 - uncertainty._NARROWER * described, 0.5, None) == pytest.approx(another)
    assert found(difference + 0.1, 0.5, None, deviation=0.1) == pytest.approx(another)
    assert found(difference, 1.5, None) == pytest.approx(1.5 * another)
    assert found(0.99 * uncertainty._WIDER * described, 1.0, None) == 0.0
    assert found(0.09, 1.0, None, deviation=0.1) == 0.0
    assert found(-0.99 * uncertainty._NARROWER * described, 1.0, None) == 0.0
    assert found(difference + 0.5, 0.5, None, deviation=0.3, learned=0.4) == pytest.approx(another)
    assert found(-0.49 - uncertainty._NARROWER * described - 0.1, 0.5, None, learned=0.1) == pytest.approx(
        another
    )
    assert found(difference, 1.0, Displacement(50.0, 60.0)) == pytest.approx(another)
    ends = Displacement(0.04, 0.1)
    shown = np.array([uncertainty._END_FLOOR, uncertainty._END_SHOWN * 0.04, uncertainty._END_CHANCE * 0.1])
    assert found(difference, 1.0, ends) == pytest.approx(float(np.linalg.norm(shown)))
    # With a learned profile or a fitted vibration, the uncertainty is that of the residuals, whatever the
    # variances.
    shown[0] = uncertainty._FITTED_FLOOR
    vibration = Vibration(np.array([3.0]), np.array([[1e-4, 0.0, 0.0]]), np.zeros((1, 3)))
    learned = replace(scene, profile=PsfProfile((0.5, 1.0), (-0.5, 1.5)))
    for fitted in (learned, replace(scene, motion=replace(scene.motion, vibration=vibration))):
        assert found(0.0, 1.0, ends, scene=fitted) == pytest.approx(float(np.linalg.norm(shown)))


def test_a_displacement_is_the_root_of_the_excess_chi_square_per_information() -> None:
    """`shown` is the excess minus two standard deviations of chi-square, and `chance` the excess plus one."""
    left, scene = _left(0.0, 0.0, "ends")
    left.images[:] = 0.0
    left.images[:1, 3] = 0.2
    left.images[:1, 4] = 0.1
    left.weight[:] = 0.25
    left.residual[:] = 2.0
    left.residual[0] = 6.0
    count, information = 90, 90 * 0.25 * (500.0 * 0.3) ** 2
    found = end_displacement(left, scene)
    assert found is not None
    chance = np.sqrt(2.0 * count)
    beyond = count * (9.0 - 1.0)
    assert found.shown == pytest.approx(np.sqrt((beyond - 2.0 * chance) / information))
    assert found.chance == pytest.approx(np.sqrt((beyond + chance) / information))
    # Residuals elsewhere that are smaller than the noise replace the noise as the reference.
    left.residual[1:] = 1.0
    small = end_displacement(left, scene)
    assert small is not None
    assert small.shown == pytest.approx(np.sqrt((count * (9.0 - 0.25) - 2.0 * chance) / information))
    # Residuals elsewhere that exceed the noise do not raise the reference.
    left.residual[1:] = 4.0
    large = end_displacement(left, scene)
    assert large is not None
    assert large.shown == pytest.approx(found.shown)


def _streaked(share: float, length: float, flux: float) -> tuple[FitProblem, StreakScene]:
    """Return a frame with the streak of a motion that reverses, and the fitted motion from rest.

    The exposure lasts from -`share` to 1, in a time that is 0 when the star is at the point of rest.
    """
    pinhole = replace(CAMERA.pinhole, columns=160, rows=90)
    image = np.random.default_rng(3).normal(100.0, 3.0, (90, 160))
    rest = np.array([30.0, 44.6])
    time = np.linspace(-share, 1.0, 600)
    where = rest + np.outer(length * time**2, [1.0, 0.05] / np.hypot(1.0, 0.05))
    image += integrated_by_brute_force((90, 160), where, flux, 1.0)
    frame = reduce_frame(np.rint(image).astype(np.uint16), SATURATION, 1.0)
    camera = FitProblem(frame, pinhole, Shutter(), LikelihoodSettings(), 1.0)
    # A star at rest at the start of the exposure moves by `length` px until its end.
    turn = length / pinhole.focal_length * np.array([0.05, -1.0, 0.0]) / np.hypot(1.0, 0.05)
    motion = CameraMotion(turn, 2.0 * turn)
    middle = rest + 0.25 * length * np.array([1.0, 0.05]) / np.hypot(1.0, 0.05)
    scene = StreakScene(motion, 1.04, middle[None], np.array([flux]), np.zeros(1), np.ones(1, dtype=np.bool_))
    return camera, scene


def test_the_intensity_along_a_streak_shows_a_reversal() -> None:
    """A reversing rotation improves the fit, but a rotation from rest or with two equal parts does not."""
    assert uncertainty.reversal_improvement(*_streaked(0.0, 60.0, 40_000.0)) < 20.0
    camera, scene = _streaked(0.45, 60.0, 40_000.0)
    found = uncertainty.reversal_improvement(camera, scene)
    assert 60.0 < found <= uncertainty._MOST_IMPROVEMENT
    # Only bright, trusted stars near rest are tested, and only motions that do not come from navigation.
    half = replace(scene.motion, acceleration=0.7 * scene.motion.acceleration)
    assert uncertainty.reversal_improvement(camera, replace(scene, motion=half)) == 0.0
    known = replace(scene.motion, higher_terms=np.full((1, 3), 1e-9))
    assert uncertainty.reversal_improvement(camera, replace(scene, motion=known)) == 0.0
    nobody = replace(scene, trusted=np.zeros(1, dtype=np.bool_))
    assert uncertainty.reversal_improvement(camera, nobody) == 0.0
    # The time-reversed motion comes to rest at the end.
    back = CameraMotion(-scene.motion.rate, scene.motion.acceleration)
    assert uncertainty.reversal_improvement(camera, replace(scene, motion=back)) == pytest.approx(
        found, rel=0.2
    )


def test_the_memory_for_the_reversal_check_is_proportional_to_the_streak_length() -> None:
    pinhole = replace(CAMERA.pinhole, columns=1300, rows=40)
    image = np.random.default_rng(3).normal(100.0, 3.0, (40, 1300))
    frame = reduce_frame(np.rint(image).astype(np.uint16), SATURATION, 1.0)
    camera = FitProblem(frame, pinhole, Shutter(), LikelihoodSettings(), 1.0)
    peaks = []
    for length in (60.0, 600.0):
        onward = CameraMotion.steady(length / pinhole.focal_length * np.array([0.0, -1.0, 0.0]))
        tracemalloc.start()
        light = uncertainty._path_light(camera, onward, np.array([20.0, 20.0]), length, 1.0)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        # The path is examined over 1.9 times its length, on 5 rows within 3 px.
        assert light.pixels > 9.0 * length
    assert peaks[1] < 20.0 * peaks[0]


_STARS = 400
_KEPT = np.array([0, 1, 2, 6])


def _drawn(noise: float, blind: bool = False) -> StarEquations:
    """Return the normal equations of stars with very different fluxes.

    The errors of the right-hand sides are `noise` times the errors that the equations state. If `blind` is
    set, each star has no information about two random directions.
    """
    rng = np.random.default_rng(3)
    change = rng.normal(size=(_STARS, 4, 6)) * 10.0 ** rng.uniform(-2.0, 2.0, (_STARS, 1, 1))
    change *= np.array([1e3, 1e3, 1e3, 1.0])[:, None]
    if blind:
        change = change[:, :, :2]
    step = np.array([1e-3, -2e-3, 0.0, 0.1])
    information = change @ change.swapaxes(1, 2)
    drawn = noise * rng.normal(size=(_STARS, change.shape[2], 1))
    return StarEquations(_KEPT, information, information @ step + (change @ drawn)[..., 0])


@pytest.mark.parametrize("blind", [False, True])
@pytest.mark.parametrize("noise", [1.0, 3.0])
def test_the_scatter_of_noise_is_one_per_degree_of_freedom(noise: float, blind: bool) -> None:
    """The scatter of pure noise is one per degree of freedom.

    The result depends neither on the units of the parameters nor on undetermined directions.
    """
    assert contradiction(_drawn(noise, blind)) == pytest.approx(noise**2, rel=0.1)


def test_a_single_star_has_no_scatter() -> None:
    many = _drawn(3.0)
    assert contradiction(StarEquations(_KEPT, many.information[:1], many.score[:1])) == 1.0


def test_the_scatter_of_equally_accurate_stars_is_their_sample_variance() -> None:
    """The scatter is the ratio of sample to noise variance, reduced by its standard deviation."""
    values = np.array([-3.0, -2.0, -1.0, -1.0, 0.0, 1.0, 1.0, 2.0, 3.0])
    change = np.stack([10.0 + values, 0.1 * values], axis=1)
    deviation = np.full((9, 2), 0.5)
    expected = np.var(values, ddof=1) / 0.25 / (1.0 + np.sqrt(2.0 / 8.0))
    assert disagreement(change, deviation) == pytest.approx(expected)
    assert disagreement(change[:, ::-1], deviation) == pytest.approx(expected)
    faint = np.append(deviation, [[500.0, 500.0]], axis=0)
    assert disagreement(np.append(change, [[90.0, 90.0]], axis=0), faint) == pytest.approx(expected, rel=1e-2)
    assert disagreement(change[:2], deviation[:2]) == 1.0
    assert disagreement(change[:3], deviation[:3]) != 1.0


def test_the_misfit_of_the_star_that_determines_the_rate_counts_most(monkeypatch: pytest.MonkeyPatch) -> None:
    """The misfits are weighted by the stars' information on the worst component of the rate.

    A star that does not affect the motion does not count.
    """
    information = np.array([[90.0, 1.0, 1.0, 1.0], [5.0, 1.0, 1.0, 1.0], [5.0, 2.0, 2.0, 9.0], [1e4] * 4])
    monkeypatch.setattr(uncertainty, "star_equations", lambda *_: None)
    monkeypatch.setattr(uncertainty, "estimates_of", lambda *_: (information, information**-0.5))
    trusted = SimpleNamespace(trusted=np.array([True, True, True, False]))
    pixels = np.array([105.0, 205.0, 305.0, 5.0])
    evaluation = SimpleNamespace(pixels=pixels, chi2=np.array([4.0, 1.0, 2.0, 1e3]) * (pixels - ALONE - 1.0))
    solution = SimpleNamespace(eliminated=None)
    fit = SimpleNamespace(scene=trusted, evaluation=evaluation, solution=solution)
    assert uncertainty._misfit_of_motion(cast("StreakFit", fit)) == pytest.approx(3.6 + 0.05 + 0.1)
