"""Tests of the attitude from positions with elongated errors: accuracy and covariance."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.attitude.solvers import solve
from knightcube.astro.attitude.wahba import AttitudeError
from knightcube.astro.quaternion import (
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    to_rotation_vector,
)
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.startracker import image_fit
from knightcube.vision.startracker.attitude_fit import stretched, turned
from knightcube.vision.startracker.image_fit import (
    ImageFit,
    Unknowns,
    _fitted,
    _missed,
    _reweighted,
    _whiteners,
    attitude_by,
    fit_in_image,
)
from knightcube.vision.startracker.sky_map import bent
from tests.knightcube.vision.startracker.unknown_lenses import drawn
from tests.support.compiled_forms import assert_forms_agree

_CAMERA = Pinhole.from_field_of_view(1024, 1024, float(np.deg2rad(12.0)))
_ATTITUDE = np.array([0.5, -0.5, 0.5, 0.5])
_ALONG_PX, _ACROSS_PX = 2.0, 0.1
_TRIALS = 200
# Quantiles (1e-5 and 1 - 1e-5) of a chi-square with 600 degrees of freedom, divided by 600.
_LOW, _HIGH = 0.77, 1.27


def _streaks(rng: np.random.Generator, count: int) -> tuple[FloatArray, FloatArray]:
    """Return positions (n, 2) px and covariances (n, 2, 2), each elongated in a random direction."""
    points = rng.uniform(50.0, 970.0, (count, 2))
    angle = rng.uniform(0.0, np.pi, count)
    axes = np.stack([np.cos(angle), np.sin(angle), -np.sin(angle), np.cos(angle)], axis=-1).reshape(-1, 2, 2)
    variance = np.diag([_ALONG_PX**2, _ACROSS_PX**2])
    return points, np.swapaxes(axes, -1, -2) @ variance @ axes


def _reference(points: FloatArray) -> FloatArray:
    return np.asarray(_CAMERA.unit_vectors(points) @ attitude_matrix(_ATTITUDE))


def _fit(
    seen: FloatArray, covariance: FloatArray, reference: FloatArray, free_scale: bool = False
) -> ImageFit:
    start = multiply(from_rotation_vector(np.array([1e-3, -2e-3, 3e-3])), _ATTITUDE)
    return fit_in_image(seen, covariance, reference, _CAMERA, start, Unknowns(free_scale))


def _error(found: ImageFit) -> FloatArray:
    return to_rotation_vector(multiply(found.fix.quaternion, conjugate(_ATTITUDE)))


@pytest.mark.parametrize("free_scale", [False, True])
def test_exact_positions_give_the_exact_attitude_and_scale(free_scale: bool) -> None:
    """Exact positions give the exact attitude, and the exact scale if the focal length is wrong by 1 %."""
    points, covariance = _streaks(np.random.default_rng(1), 10)
    reference = _reference(points)
    scale = 1.01 if free_scale else 1.0
    centre = np.array(_CAMERA.centre)
    found = _fit(centre + (points - centre) / scale, covariance, reference, free_scale)
    assert np.linalg.norm(_error(found)) < 1e-9
    assert found.scale == pytest.approx(scale, rel=1e-9)
    assert found.excess == 1.0


@pytest.mark.parametrize("free_scale", [False, True])
def test_elongated_errors_agree_with_the_covariance_and_beat_round_ones(free_scale: bool) -> None:
    """The errors of 200 fields with elongated position errors agree with the covariance.

    The attitude errors are smaller than in fields of 12 stars whose position errors are isotropic and have
    the same mean variance.
    """
    rng = np.random.default_rng(2)
    mismatch, mine, rounds, scales = 0.0, 0.0, 0.0, 0.0
    for _ in range(_TRIALS):
        points, covariance = _streaks(rng, 12)
        reference = _reference(points)
        noise = np.einsum("nij,nj->ni", np.linalg.cholesky(covariance), rng.standard_normal((12, 2)))
        found = _fit(points + noise, covariance, reference, free_scale)
        error = _error(found)
        mismatch += float(error @ np.linalg.solve(found.fix.covariance, error))
        if free_scale:
            scales += (np.log(found.scale) / found.scale_sigma) ** 2
        even = 0.5 * np.trace(covariance, axis1=1, axis2=2)[:, None, None] * np.eye(2)
        mine += float(error @ error)
        away = _error(_fit(points + noise, even, reference, free_scale))
        rounds += float(away @ away)
    assert _LOW < mismatch / (3.0 * _TRIALS) < _HIGH
    assert mine < 0.1 * rounds
    if free_scale:
        assert 0.6 < scales / _TRIALS < 1.55


def test_excess_scatter_of_the_stars_increases_the_covariance() -> None:
    rng = np.random.default_rng(3)
    points, covariance = _streaks(rng, 12)
    reference = _reference(points)
    noise = np.einsum("nij,nj->ni", np.linalg.cholesky(covariance), rng.standard_normal((12, 2)))
    sound = _fit(points + noise, covariance, reference)
    wider = _fit(points + noise, covariance / 25.0, reference)
    ratio = np.trace(wider.fix.covariance) / np.trace(sound.fix.covariance)
    assert sound.excess == 1.0
    assert wider.excess == pytest.approx(25.0, rel=0.5)
    # In the covariance of the attitude, the residuals have 24 - 3 degrees of freedom. In `excess`, which also
    # accounts for the scale, the residuals have 24 - 4 degrees of freedom.
    assert ratio == pytest.approx(wider.excess * (24 - 4) / (24 - 3) / 25.0, rel=1e-3)


def test_a_solver_of_wahbas_problem_gets_the_scatter_of_the_stars_too() -> None:
    rng = np.random.default_rng(3)
    points = _streaks(rng, 12)[0]
    reference, noise = _reference(points), 0.5 * rng.standard_normal((12, 2))
    sizes = []
    for sigma in (0.5, 0.05):
        covariance = np.tile(sigma**2 * np.eye(2), (12, 1, 1))
        fit = _fit(points + noise, covariance, reference)
        stars = points + noise, covariance, reference
        fix = attitude_by(solve, *stars, _CAMERA, fit, np.zeros((0, 2)))
        sizes.append(np.trace(fix.covariance))
    assert sizes[1] == pytest.approx(sizes[0], rel=0.6)


def test_stars_that_disagree_are_rejected_and_the_covariance_stays_correct() -> None:
    """Stars that contradict the others are rejected, and the covariance remains correct.

    Two of 14 stars are displaced by 6 px, sixty standard deviations across their streaks.
    """
    rng = np.random.default_rng(4)
    mismatch = 0.0
    for _ in range(_TRIALS):
        points, covariance = _streaks(rng, 14)
        reference = _reference(points)
        noise = np.einsum("nij,nj->ni", np.linalg.cholesky(covariance), rng.standard_normal((14, 2)))
        _, axes = np.linalg.eigh(covariance[:2])
        noise[:2] += 6.0 * axes[:, :, 0]
        found = _fit(points + noise, covariance, reference)
        assert not found.agree[:2].any()
        error = _error(found)
        mismatch += float(error @ np.linalg.solve(found.fix.covariance, error))
    assert _LOW < mismatch / (3.0 * _TRIALS) < _HIGH


def test_all_stars_are_kept_if_too_few_would_remain() -> None:
    """If too few stars would remain, no star is rejected.

    The data do not show which of four stars is wrong.
    """
    rng = np.random.default_rng(5)
    points, covariance = rng.uniform(50.0, 970.0, (4, 2)), np.tile(0.01 * np.eye(2), (4, 1, 1))
    reference = _reference(points)
    sound = _fit(points, covariance, reference)
    points[0] += 6.0
    found = _fit(points, covariance, reference)
    assert found.agree.all()
    error = _error(found)
    assert np.trace(found.fix.covariance) > 100.0 * np.trace(sound.fix.covariance)
    assert float(error @ np.linalg.solve(found.fix.covariance, error)) < 3.0 * 3.0


def test_stars_in_one_direction_do_not_determine_an_attitude() -> None:
    points = np.full((3, 2), 400.0)
    with pytest.raises(AttitudeError):
        _fit(points, np.tile(np.eye(2), (3, 1, 1)), _reference(points))


def test_stars_from_different_parts_of_the_sky_do_not_give_an_attitude() -> None:
    """Stars from different parts of the sky, imaged side by side, do not give an attitude.

    The two stars are 90 deg apart.
    """
    points = np.array([[500.0, 500.0], [520.0, 500.0]])
    reference = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    with pytest.raises(AttitudeError):
        _fit(points, np.tile(1e-4 * np.eye(2), (2, 1, 1)), reference)


def test_an_unknown_lens_is_fitted_and_included_in_the_covariance() -> None:
    """An unknown lens is fitted, and its uncertainty is included in the covariance.

    The optical axis is 25 px from the image centre, and the distortion is 2 % at the corner.
    """
    squares, off = [], []
    for number in range(12):
        found, truth = drawn("poor", number)
        assert found.fix is not None
        error = to_rotation_vector(multiply(found.fix.quaternion, conjugate(truth)))
        squares.append(error @ np.linalg.solve(found.fix.covariance, error) / 3.0)
        off.append(np.linalg.norm(error[:2]) * found.camera.focal_length)
    assert np.mean(squares) < 1.0
    # A fit of the focal length alone would have an error of 0.7 px.
    assert np.sqrt(np.mean(np.square(off))) < 0.2


def test_an_unspecified_shutter_is_fitted_and_included_in_the_covariance() -> None:
    """An unknown delay of the shutter is fitted, and its uncertainty is included in the covariance.

    The delay is random in 200 fields of 12 moving stars. One standard deviation shifts a star at the bottom
    of the frame by 1 px relative to a star at the top.
    """
    rng = np.random.default_rng(6)
    known, unknown, delays = 0.0, 0.0, 0.0
    for _ in range(_TRIALS):
        points, covariance = rng.uniform(50.0, 970.0, (12, 2)), np.tile(1e-4 * np.eye(2), (12, 1, 1))
        velocity = rng.normal(size=2)
        late = velocity / np.linalg.norm(velocity) * (points[:, 1:] - _CAMERA.centre[1]) / _CAMERA.rows
        reference, delay = _reference(points), rng.normal()
        seen = points + delay * late + 0.01 * rng.standard_normal((12, 2))
        found = fit_in_image(seen, covariance, reference, _CAMERA, _ATTITUDE, Unknowns(late=late))
        error, without = _error(found), _fit(seen, covariance, reference)
        known += float(error @ np.linalg.solve(found.fix.covariance, error))
        error = _error(without)
        unknown += float(error @ np.linalg.solve(without.fix.covariance, error))
        delays += (found.delay - delay) ** 2
    assert _LOW < known / (3.0 * _TRIALS) < _HIGH
    assert unknown > 2.0 * known
    assert delays / _TRIALS < 0.02**2


@pytest.mark.parametrize("scatter", [False, True])
def test_equal_errors_of_bright_and_faint_stars_are_in_the_covariance(scatter: bool) -> None:
    """The covariance includes errors that are equal for bright and faint stars.

    In 200 fields, all positions have errors of 0.05 px, which is ten times the noise of the brightest stars.
    """
    rng = np.random.default_rng(7)
    known, off, ideal = 0.0, 0.0, 0.0
    for _ in range(_TRIALS):
        points, sigma = rng.uniform(50.0, 970.0, (20, 2)), np.geomspace(0.005, 0.2, 20)
        covariance, reference = sigma[:, None, None] ** 2 * np.eye(2), _reference(points)
        seen = points + np.hypot(sigma, 0.05)[:, None] * rng.standard_normal((20, 2))
        found = fit_in_image(seen, covariance, reference, _CAMERA, _ATTITUDE, Unknowns(scatter=scatter))
        error = _error(found)
        known += float(error @ np.linalg.solve(found.fix.covariance, error))
        off += float(np.sum(error[:2] ** 2))
        ideal += float(np.sum(_error(_fit(seen, covariance + 0.05**2 * np.eye(2), reference))[:2] ** 2))
    # Some of the brightest stars are rejected, so the variance of the remaining stars is slightly too small.
    # Without `scatter`, an excess is added only if it is significant.
    assert known / (3.0 * _TRIALS) < (2.3 if scatter else 2.5)
    assert off < 1.5 * ideal


def test_fitting_the_scatter_costs_little_accuracy_with_correct_noise() -> None:
    rng = np.random.default_rng(8)
    known, ratio = 0.0, []
    for _ in range(_TRIALS):
        points, covariance = _streaks(rng, 20)
        reference = _reference(points)
        seen = points + np.einsum("nij,nj->ni", np.linalg.cholesky(covariance), rng.standard_normal((20, 2)))
        found = fit_in_image(seen, covariance, reference, _CAMERA, _ATTITUDE, Unknowns(scatter=True))
        error = _error(found)
        known += float(error @ np.linalg.solve(found.fix.covariance, error))
        claim = np.trace(_fit(seen, covariance, reference).fix.covariance)
        ratio.append(float(np.trace(found.fix.covariance) / claim))
    assert _LOW < known / (3.0 * _TRIALS) < _HIGH
    assert np.median(ratio) < 1.05
    assert np.mean(ratio) < 1.7


@pytest.mark.parametrize("scale", [False, True])
@pytest.mark.parametrize("bends", [0, 6, 8])
@pytest.mark.parametrize("delayed", [False, True])
def test_the_compiled_fit_equals_that_in_numpy(scale: bool, bends: int, delayed: bool) -> None:
    draw = np.random.default_rng([scale, bends, delayed])
    observed = _CAMERA.unit_vectors(draw.uniform(0.0, 1_023.0, (30, 2)))
    # The stars are displaced by the errors of all parameters and by noise.
    reference = observed @ attitude_matrix(from_rotation_vector(np.array([0.01, -0.02, 0.03])))
    reference = reference + 1e-3 * draw.normal(size=reference.shape)
    reference /= np.linalg.norm(reference, axis=1, keepdims=True)
    across = np.linalg.svd(observed[:, None, :])[2][:, 1:]
    known = draw.uniform(1.0, 4.0, bends + delayed)
    late = 1e-3 * draw.normal(size=(30 if delayed else 0, 3))
    given = observed, 1e4 * across, reference, late, known, np.eye(3), 1.01, 1e-3 * known, scale
    weight, squares = draw.uniform(0.0, 1.0, 30), draw.uniform(0.0, 20.0, 30)
    assert_forms_agree(_fitted, *given, weight, 8, relative=1e-7)
    assert_forms_agree(_reweighted, *given, squares, 5, relative=1e-7)
    bend = 1e-2 * draw.normal(size=8) if bends else np.zeros(8)
    assert_forms_agree(_missed, observed, reference, late, np.eye(3), 1.01, bend, 0.3)
    agreed, matrix, *_ = _fitted.numpy_form(*given, weight, 8)
    assert agreed
    assert np.abs(np.mean(observed - reference @ matrix.T, axis=0)).max() < 1e-2


def test_the_compiled_whitening_of_directions_equals_that_in_numpy() -> None:
    draw = np.random.default_rng(5)
    root = draw.normal(size=(20, 2, 2))
    covariance = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(2)
    assert_forms_agree(_whiteners, 1e-4 * draw.normal(size=(20, 3, 2)), covariance)


@pytest.mark.parametrize("scale", [False, True])
@pytest.mark.parametrize("bends", [0, 6, 8])
@pytest.mark.parametrize("shutter", [False, True])
def test_the_normal_equations_are_those_of_numerical_derivatives(
    scale: bool, bends: int, shutter: bool
) -> None:
    """Normal matrix and gradient are those of the residuals, differentiated numerically by each parameter."""
    rng = np.random.default_rng(4)
    points, _ = _streaks(rng, 9)
    observed, reference = _CAMERA.unit_vectors(points + rng.normal(size=(9, 2))), _reference(points)
    whitener = rng.normal(size=(9, 2, 3)) * 1e3
    late = 1e-4 * rng.normal(size=(9, 3)) if shutter else np.zeros((0, 3))
    matrix = attitude_matrix(_ATTITUDE)
    count = 3 + int(scale) + bends + int(shutter)

    def residuals(change: FloatArray) -> FloatArray:
        rest = change[3 + int(scale) :]
        seen = stretched(observed, float(np.exp(change[3])) if scale else 1.0)
        bend = np.zeros(8)
        bend[:bends] = rest[:bends]
        seen = bent(seen, bend)
        if shutter:
            seen = seen - rest[bends] * late
        missed = seen - reference @ turned(matrix, change[:3]).T
        return np.asarray(np.einsum("nij,nj->ni", whitener, missed).reshape(-1))

    steps = 1e-5 * np.eye(count)
    design = np.stack([(residuals(step) - residuals(-step)) / 2e-5 for step in steps], axis=1)
    normal, gradient = image_fit._normal(whitener, observed, reference @ matrix.T, late, scale, bends)
    assert normal == pytest.approx(design.T @ design, rel=1e-5, abs=1e-6 * np.abs(normal).max())
    expected = design.T @ residuals(np.zeros(count))
    assert gradient == pytest.approx(expected, rel=1e-5, abs=1e-6 * np.abs(gradient).max())


def test_a_late_shutter_is_fitted_with_its_prior() -> None:
    """The delay is in units of its standard deviation, and its prior variance is one."""
    rng = np.random.default_rng(6)
    points = _streaks(rng, 30)[0]
    covariance = np.tile(0.01 * np.eye(2), (30, 1, 1))
    late = np.stack([0.01 * (points[:, 1] - 511.5), 0.002 * (points[:, 1] - 511.5)], axis=1)
    start = multiply(from_rotation_vector(np.array([1e-3, -2e-3, 3e-3])), _ATTITUDE)
    seen = points + 0.8 * late
    found = fit_in_image(seen, covariance, _reference(points), _CAMERA, start, Unknowns(late=late))
    assert found.delay == pytest.approx(0.8, abs=0.02)
    assert np.linalg.norm(_error(found)) < 1e-4
    none = fit_in_image(points, covariance, _reference(points), _CAMERA, start, Unknowns(late=late))
    assert none.delay == pytest.approx(0.0, abs=1e-6)
    assert none.bend.tolist() == [0.0] * 8
    # If the delay hardly moves the stars, its prior keeps it near zero.
    unknown = fit_in_image(seen, covariance, _reference(points), _CAMERA, start, Unknowns(late=1e-6 * late))
    assert abs(unknown.delay) < 1e-2
    fixed = fit_in_image(seen, covariance, _reference(points), _CAMERA, start)
    assert fixed.delay == 0.0
    assert np.linalg.norm(_error(fixed)) > 1e-3


def test_the_excess_of_common_variance_over_a_factor_is_judged_by_the_likelihood() -> None:
    """-2 ln L is the sum of the log determinants and of the chi-squares for multiplied variances."""
    rng = np.random.default_rng(5)
    points, covariance = _streaks(rng, 8)
    seen = points + np.einsum("nij,nj->ni", np.linalg.cholesky(covariance), rng.normal(size=(8, 2)))
    slopes = np.zeros((8, 3, 2))
    slopes[:, 0, 0] = slopes[:, 1, 1] = 1.0 / _CAMERA.focal_length
    observed = _CAMERA.unit_vectors(seen)
    held = image_fit._Seen(observed, slopes, covariance, _reference(points), Unknowns())
    pose = image_fit._FittedPose(attitude_matrix(_ATTITUDE), 1.0)
    agree = np.arange(8) < 6
    for factor in (1.0, 3.0):
        expected = 0.0
        for k in range(6):
            missed = held.missed(pose)[k] @ slopes[k] * _CAMERA.focal_length**2
            whole = factor * covariance[k]
            expected += np.log(np.linalg.det(whole)) + missed @ np.linalg.solve(whole, missed)
        assert image_fit._surprise(held, pose, agree, factor) == pytest.approx(expected, rel=1e-6)


def test_an_added_variance_makes_chi_square_equal_to_the_degrees_of_freedom() -> None:
    rng = np.random.default_rng(8)
    points = _streaks(rng, 40)[0]
    own = np.tile(0.01 * np.eye(2), (40, 1, 1)) * rng.uniform(0.2, 3.0, (40, 1, 1))
    noise = rng.normal(size=(40, 2)) * np.sqrt(own[:, 0, 0, None] + 0.09)
    start = multiply(from_rotation_vector(np.array([1e-3, -2e-3, 3e-3])), _ATTITUDE)
    seen = points + noise
    found = fit_in_image(seen, own, _reference(points), _CAMERA, start, Unknowns(scatter=True))
    wide = own + 0.09 * np.eye(2)
    truth = fit_in_image(seen, wide, _reference(points), _CAMERA, start)
    assert np.trace(found.fix.covariance) == pytest.approx(np.trace(truth.fix.covariance), rel=0.35)
    assert 2.0 * found.fix.loss == pytest.approx(2.0 * found.agree.sum() - 3.0, abs=1.2)
    assert found.agree.sum() >= 36
    error = _error(found)
    assert error @ np.linalg.solve(found.fix.covariance, error) < 16.3
