"""Tests of least-squares fits of attitude, scale and distortion to simulated directions."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import (
    angle_between,
    attitude_matrix,
    from_rotation_vector,
    multiply,
    normalise,
)
from knightcube.vision.startracker.attitude_fit import (
    PRIOR,
    DistortedFit,
    Refinement,
    StarField,
    _agreeing,
    _fit_distorted,
    _refined,
    _true,
    fit_with_distortion,
    inflation,
    refine,
    scale_slope,
    stretched,
    turned,
)
from knightcube.vision.startracker.index import SkyIndex
from tests.support.compiled_forms import assert_forms_agree

SIGMA = 1e-4


def directions(count: int, seed: int = 1) -> FloatArray:
    """Return unit vectors (count, 3) within 20 deg of the boresight."""
    tangents = np.random.default_rng(seed).uniform(-0.36, 0.36, (count, 2))
    return np.asarray(normalise(np.column_stack([tangents, np.ones(count)])))


def test_the_attitude_and_scale_of_exact_directions_are_found() -> None:
    """Attitude and scale of exact directions are found to rounding, from errors of two degrees and 3 %.

    The fit converges quadratically.
    """
    seen, quaternion = directions(12), normalise(np.array([0.3, -0.2, 0.5, 0.7]))
    matrix = attitude_matrix(quaternion)
    reference = stretched(seen, 1.03) @ matrix
    start = attitude_matrix(multiply(from_rotation_vector(np.array([0.02, -0.02, 0.02])), quaternion))
    found = refine(seen, reference, np.full(12, SIGMA), start, 1.0, True)
    assert found is not None
    assert found.matrix == pytest.approx(matrix, abs=1e-8)
    assert found.scale == pytest.approx(1.03, abs=1e-8)
    assert found.squares.max() < 1e-3
    assert len(found.covariance) == 4
    assert found.scale_sigma == pytest.approx(math.sqrt(found.covariance[3, 3]))
    fixed = refine(seen, reference, np.full(12, SIGMA), start, 1.03, False)
    assert fixed is not None
    assert fixed.matrix == pytest.approx(matrix, abs=1e-8)
    assert fixed.scale_sigma == 0.0
    assert angle_between(fixed.fix().quaternion, quaternion) < 1e-8
    wrong = refine(seen, reference, np.full(12, SIGMA), start, 1.0, False)
    assert wrong is not None
    assert wrong.squares.sum() > 1e4


@pytest.mark.parametrize("free_scale", [False, True])
def test_the_covariance_and_the_residuals_agree_with_many_fits(free_scale: bool) -> None:
    """The mean chi-squares of 400 fits with 12 stars agree with their degrees of freedom.

    The attitude has 3 degrees of freedom, and the residuals have 21. If the scale is fitted too, attitude and
    scale have 4 degrees of freedom, and the residuals have 20.
    """
    draw = np.random.default_rng(2)
    seen, parameters = directions(12), 4 if free_scale else 3
    sigma = np.where(np.arange(12) < 4, SIGMA, 3.0 * SIGMA)
    errors, squares = [], []
    for _ in range(400):
        noisy = normalise(seen + sigma[:, None] * draw.normal(size=(12, 3)))
        found = refine(noisy, seen, sigma, np.eye(3), 1.0, free_scale)
        assert found is not None
        # The rotation error d is defined by A = exp(-[d x]).
        turn = np.array([found.matrix[1, 2], found.matrix[2, 0], found.matrix[0, 1]])
        error = np.append(turn, math.log(found.scale)) if free_scale else turn
        errors.append(float(error @ np.linalg.solve(found.covariance, error)))
        squares.append(float(found.squares.sum()))
    assert np.mean(errors) == pytest.approx(parameters, rel=0.12)
    assert np.mean(squares) == pytest.approx(24 - parameters, rel=0.03)


@pytest.mark.parametrize("apart", [0.0, 1e-7])
def test_directions_along_one_line_determine_no_attitude(apart: float) -> None:
    seen = normalise(np.array([[0.0, 0.0, 1.0], [apart, 0.0, 1.0], [0.0, apart, 1.0]]))
    assert refine(seen, seen, np.full(3, SIGMA), np.eye(3), 1.0, False) is None
    wider = normalise(np.array([[0.0, 0.0, 1.0], [1e-4, 0.0, 1.0], [0.0, 1e-4, 1.0]]))
    assert refine(wider, wider, np.full(3, SIGMA), np.eye(3), 1.0, False) is not None


def test_a_start_on_the_other_side_of_the_sky_diverges() -> None:
    seen = directions(6)
    assert refine(seen, seen, np.full(6, SIGMA), np.diag([1.0, -1.0, -1.0]), 1.0, True) is None


@pytest.mark.parametrize(("excess", "factor"), [(0.5, 1.0), (1.0, 1.0), (1.9, 1.0), (1.97, 1.97), (4.0, 4.0)])
def test_residuals_beyond_three_sigma_of_their_chi_square_increase_the_variances(
    excess: float, factor: float
) -> None:
    """Residuals that exceed their chi-square by three sigma increase the variances.

    12 stars and 4 parameters give 20 degrees of freedom, and a limit of 1 + 3 sqrt(2 / 20) = 1.949.
    """
    squares = np.full(12, excess * 20.0 / 12.0)
    assert inflation(squares, 4) == pytest.approx(factor)
    assert inflation(np.array([50.0, 50.0]), 4) == 1.0, "two stars leave no residuals"
    assert inflation(np.array([50.0, 50.0]), 3) == pytest.approx(100.0)


def test_a_widened_fit_has_the_scatter_of_its_residuals() -> None:
    """If the assumed standard deviations are three times too small, the covariance follows the residuals."""
    draw = np.random.default_rng(3)
    seen = directions(40)
    noisy = normalise(seen + 3.0 * SIGMA * draw.normal(size=(40, 3)))
    found = refine(noisy, seen, np.full(40, SIGMA), np.eye(3), 1.0, True)
    assert found is not None
    widened = found.widened()
    assert np.sqrt(widened.covariance / found.covariance) == pytest.approx(np.full((4, 4), 3.0), rel=0.2)
    assert widened.matrix is found.matrix


def test_stretching_multiplies_the_tangents_and_its_slope_is_that_of_differences() -> None:
    seen = directions(5)
    longer = stretched(seen, 1.1)
    assert longer[:, :2] / longer[:, 2:] == pytest.approx(1.1 * seen[:, :2] / seen[:, 2:])
    assert np.linalg.norm(longer, axis=1) == pytest.approx(np.ones(5))
    assert stretched(seen, np.linspace(0.9, 1.1, 5))[4] == pytest.approx(longer[4])
    difference = (stretched(seen, math.exp(1e-6)) - stretched(seen, math.exp(-1e-6))) / 2e-6
    assert scale_slope(seen) == pytest.approx(difference, abs=1e-9)


def test_a_rotation_of_the_attitude_equals_that_of_the_quaternion() -> None:
    quaternion, turn = normalise(np.array([0.3, -0.2, 0.5, 0.7])), np.array([0.4, -1.1, 0.7])
    expected = attitude_matrix(multiply(from_rotation_vector(turn), quaternion))
    assert turned(attitude_matrix(quaternion), turn) == pytest.approx(expected, abs=1e-12)
    assert turned(np.eye(3), np.zeros(3)).tolist() == np.eye(3).tolist()


def test_a_field_is_rescaled_mirrored_and_cut() -> None:
    field = StarField(directions(5), np.full(5, SIGMA), (0.4, 0.3), (0.98, 1.02), np.arange(5.0))
    larger = field.rescaled(1.02)
    assert larger.direction == pytest.approx(stretched(field.direction, 1.02))
    assert larger.sigma == pytest.approx(1.02 * field.sigma)
    assert larger.half_width == pytest.approx((0.408, 0.306))
    assert larger.scale == pytest.approx((0.98 / 1.02, 1.0))
    assert field.mirrored().direction.tolist() == (field.direction * [-1.0, 1.0, 1.0]).tolist()
    part = field.subset(np.array([3, 1]))
    assert len(part) == 2
    assert part.magnitude is not None
    assert part.magnitude.tolist() == [3.0, 1.0]
    assert part.direction.tolist() == field.direction[[3, 1]].tolist()


CORNER = math.hypot(0.36, 0.36)


def barrel(true: FloatArray, distortion: float) -> FloatArray:
    """Return the directions (n, 3) in the image of a lens that moves a tangent t to t (1 + c (t / R)^2)."""
    tangents = true[:, :2] / true[:, 2:]
    square = np.sum(tangents**2, axis=1, keepdims=True) / CORNER**2
    return np.asarray(
        normalise(np.column_stack([tangents * (1.0 + distortion * square), np.ones(len(true))]))
    )


def distorted_fit(
    seen: FloatArray, sky: FloatArray, sigma: float, first: int, far: float = 0.0
) -> DistortedFit | None:
    """Return the fit that starts with the `first` stars nearest to the axis, whose matches are correct."""
    index = cast(SkyIndex, SimpleNamespace(stars=SimpleNamespace(direction=sky)))
    known = np.argsort(-seen[:, 2])[:first]
    field = StarField(seen, np.full(len(seen), sigma), (0.36, 0.36))
    matrix = attitude_matrix(from_rotation_vector(np.array([far, 0.0, 0.0])))
    start = Refinement(matrix, 1.0, np.eye(4), np.zeros(first))
    return fit_with_distortion(field, index, np.arange(len(sky)), known, known, start)


@pytest.mark.parametrize("distortion", [-0.1, 0.07])
def test_a_match_grows_from_the_axis_as_the_distortion_is_determined(distortion: float) -> None:
    true = directions(60)
    found = distorted_fit(barrel(true, distortion), stretched(true, 1.01), 1e-5, 12, 1e-3)
    assert found is not None
    assert found.observed.tolist() == found.star.tolist() == list(range(60))
    assert found.distortion == pytest.approx(distortion, abs=2e-4)
    assert found.refined.scale == pytest.approx(1.01, abs=1e-4)
    assert found.refined.matrix == pytest.approx(np.eye(3), abs=1e-5)
    assert found.seen == pytest.approx(stretched(true, 1.01), abs=1e-5)


def test_the_distorted_fits_covariance_is_that_of_many_fits() -> None:
    """For lenses with distortion, the errors of attitude and scale have a chi-square.

    The chi-square has 4 degrees of freedom. The test draws 100 lenses with 5 % of distortion.
    """
    draw = np.random.default_rng(4)
    errors, shares = [], []
    for _ in range(100):
        true = directions(30, int(draw.integers(1 << 30)))
        true[:, 0] = np.abs(true[:, 0])
        seen = normalise(barrel(true, PRIOR * draw.normal()) + 2e-4 * draw.normal(size=(30, 3)))
        found = distorted_fit(seen, true, 2e-4, 30)
        assert found is not None
        turn = np.array([found.refined.matrix[1, 2], found.refined.matrix[2, 0], found.refined.matrix[0, 1]])
        error = np.append(turn, math.log(found.refined.scale))
        errors.append(float(error @ np.linalg.solve(found.refined.covariance, error)))
        rest = found.refined.covariance[:3, :3] - found.from_lens
        shares.append(float(np.linalg.eigvalsh(rest).min()))
    assert np.mean(errors) == pytest.approx(4.0, rel=0.2)
    assert min(shares) > 0.0, "the lens is a part of the covariance"


@pytest.mark.parametrize(("sigmas", "kept"), [(3.4, True), (5.0, False)])
def test_a_star_beyond_four_sigma_is_left_out(sigmas: float, kept: bool) -> None:
    true = directions(40)
    seen = barrel(true, 0.05)
    seen[5] = normalise(seen[5] + sigmas * 5e-4 * np.array([0.6, 0.8, 0.0]))
    found = distorted_fit(seen, true, 5e-4, 40)
    assert found is not None
    assert (5 in found.observed) is kept
    assert len(found.star) == (40 if kept else 39)


def test_a_lens_distortion_above_a_quarter_is_refused() -> None:
    true = directions(40)
    assert distorted_fit(barrel(true, 0.22), true, 1e-4, 40) is not None
    assert distorted_fit(barrel(true, 0.3), true, 1e-4, 40) is None


def test_scatter_beyond_the_sigmas_increases_all_but_the_prior() -> None:
    draw = np.random.default_rng(5)
    true = directions(40)
    seen = normalise(barrel(true, 0.03) + 6e-4 * draw.normal(size=(40, 3)))
    honest, proud = (distorted_fit(seen, true, sigma, 40) for sigma in (6e-4, 2e-4))
    assert honest is not None
    assert proud is not None
    ratio = np.sqrt(np.diag(proud.refined.covariance) / np.diag(honest.refined.covariance))
    assert ratio == pytest.approx(np.ones(4), rel=0.15)


@pytest.mark.parametrize("free_scale", [True, False])
def test_all_forms_of_the_fit_give_the_same_attitude(free_scale: bool) -> None:
    rng = np.random.default_rng(11)
    for count in (3, 4, 40):
        seen = directions(count, seed=count)
        turn = attitude_matrix(from_rotation_vector(rng.normal(0.0, 0.02, 3)))
        noisy = np.asarray(normalise(seen + rng.normal(0.0, SIGMA, seen.shape)))
        sigma = SIGMA * rng.uniform(0.5, 2.0, count)
        assert_forms_agree(_refined, noisy, seen, sigma, turn, 1.01, free_scale, relative=1e-6)
    same = np.repeat(directions(1), 4, axis=0)
    assert_forms_agree(_refined, same, same, np.full(4, SIGMA), np.eye(3), 1.0, free_scale)


@pytest.mark.parametrize("distortion", [0.0, -0.03, 0.2])
def test_the_compiled_fit_of_the_distortion_equals_that_in_numpy(distortion: float) -> None:
    rng = np.random.default_rng(12)
    for count in (4, 40):
        reference = directions(count, seed=count)
        turn = attitude_matrix(from_rotation_vector(rng.normal(0.0, 0.01, 3)))
        seen = stretched(reference @ turn.T, np.full(count, 1.02))
        seen = np.asarray(normalise(seen + rng.normal(0.0, SIGMA, seen.shape)))
        weight = rng.uniform(0.5, 2.0, count) / SIGMA
        assert_forms_agree(
            _fit_distorted, seen, reference, weight, np.eye(3), 0.99, distortion, 0.2, relative=1e-6
        )
        assert_forms_agree(_true, seen, 1.01, distortion, 0.2)
        sigma = rng.uniform(0.5, 2.0, count) * SIGMA
        assert len(_agreeing.numpy_form(seen, sigma, reference, turn, 1.0 / 1.02, 0.0, 0.2)[0]) == count
        assert_forms_agree(_agreeing, seen, sigma, reference[::2].copy(), turn, 0.98, distortion, 0.2)
