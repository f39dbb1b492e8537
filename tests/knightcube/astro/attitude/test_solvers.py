"""Tests of all attitude solvers against each other, scipy and their covariances, and in degenerate cases."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from knightcube.astro.arrays import FloatArray
from knightcube.astro.attitude import wahba
from knightcube.astro.attitude.solvers import (
    DEFAULT,
    OPTIMAL,
    PROFILE_METHODS,
    SOLVERS,
    davenport_matrix,
    gain,
    largest_eigenvalue,
    rotation_between,
    solve,
)
from knightcube.astro.attitude.wahba import AttitudeError, AttitudeFix, profile_matrix, sightings
from knightcube.astro.quaternion import (
    IDENTITY,
    angle_between,
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    to_rotation_vector,
)
from tests.knightcube.astro.attitude.sights import Sight, information, sight, unit
from tests.support.streak_frames import rotate, star_camera

_ALL = sorted(SOLVERS)
_FIELD = 0.0524  # half of a 6 deg field of view, rad


def _by(name: str, seen: Sight) -> AttitudeFix:
    return SOLVERS[name](seen.observed, seen.reference, seen.sigma)


def _error(fix: AttitudeFix, quaternion: FloatArray) -> FloatArray:
    return to_rotation_vector(multiply(fix.quaternion, conjugate(quaternion)))


def _least_eigenvalue(seen: Sight) -> float:
    """Return the smallest eigenvalue of the information matrix, relative to the sum of the weights."""
    return float(np.linalg.eigvalsh(information(seen.observed, seen.sigma))[0] / np.sum(seen.sigma**-2.0))


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(2, 30),
    half_field=st.one_of(st.none(), st.floats(0.02, 0.5)),
    sigma=st.floats(1e-7, 1e-3),
    angle=st.one_of(st.none(), st.floats(0.0, 1e-6), st.floats(np.pi - 1e-6, np.pi)),
)
@example(seed=9904, n=2, half_field=0.02, sigma=1e-7, angle=None)
def test_all_optimal_solvers_agree_to_a_tenth_of_a_nanoradian(
    seed: int, n: int, half_field: float | None, sigma: float, angle: float | None
) -> None:
    seen = sight(np.random.default_rng(seed), n, half_field, sigma, angle)
    if _least_eigenvalue(seen) < (30.0 * sigma) ** 2:
        return  # two stars whose separation is within their errors do not determine the attitude
    fixes = {name: _by(name, seen) for name in OPTIMAL}
    for fix in fixes.values():
        assert angle_between(fix.quaternion, fixes[DEFAULT].quaternion) < 1e-10
        # The attitudes of different solvers differ by about 1e-15 rad, which limits the agreement of the
        # losses.
        assert fix.loss == pytest.approx(fixes[DEFAULT].loss, rel=1e-6, abs=1e-9 + 3e-15 / sigma)
        assert fix.quaternion[3] >= 0.0
        assert np.linalg.norm(fix.quaternion) == pytest.approx(1.0, abs=1e-14)


@pytest.mark.parametrize("name", sorted(PROFILE_METHODS))
@pytest.mark.parametrize("angle", [None, 0.0, 1e-9, np.pi - 1e-9, np.pi])
@pytest.mark.parametrize(("n", "half_field"), [(20, None), (20, _FIELD), (2, None), (2, _FIELD)])
def test_a_solver_loses_no_more_than_the_profile_matrix_has_lost(
    name: str, angle: float | None, n: int, half_field: float | None
) -> None:
    """A solver's loss exceeds the optimum by no more than rounding errors in the profile matrix allow.

    Before the refinement, the error is the rounding error divided by the gap between the eigenvalues of K.
    """
    rng = np.random.default_rng([61, n])
    for _ in range(20):
        seen = sight(rng, n, half_field, 1e-5, angle)
        weights = seen.sigma**-2.0
        profile = profile_matrix(seen.observed, seen.reference, weights / weights.sum())
        values, vectors = np.linalg.eigh(davenport_matrix(profile))
        apart = angle_between(PROFILE_METHODS[name](profile), vectors[:, 3])
        assert apart < 1e-13 / (values[3] - values[2])


@given(seed=st.integers(0, 2**32 - 1), n=st.integers(3, 10))
def test_the_polynomials_root_is_the_largest_eigenvalue(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    profile = profile_matrix(
        unit(rng.normal(size=(n, 3))), unit(rng.normal(size=(n, 3))), np.full(n, 1.0 / n)
    )
    values = np.linalg.eigvalsh(davenport_matrix(profile))
    # The error of a simple root is the rounding error divided by the slope. The error of two close roots is
    # the square root of the rounding error.
    slope = np.prod(values[3] - values[:3])
    assert largest_eigenvalue(profile) == pytest.approx(values[3], abs=min(1e-6, 1e-14 / slope))


@pytest.mark.parametrize("name", _ALL)
def test_directions_without_noise_give_the_true_attitude(name: str) -> None:
    rng = np.random.default_rng(62)
    for angle in (None, 0.0, 1e-9, 1.0, np.pi - 1e-9, np.pi):
        for n, half_field in ((2, None), (2, _FIELD), (20, _FIELD)):
            true = sight(rng, n, half_field, 1e-5, angle)
            exact = true.reference @ attitude_matrix(true.quaternion).T
            fix = SOLVERS[name](unit(exact), true.reference, true.sigma)
            # Directions have a rounding error of 1e-16. The error of the rotation about the boresight is the
            # rounding error divided by the separation of the stars.
            assert angle_between(fix.quaternion, true.quaternion) < 1e-15 / np.sqrt(_least_eigenvalue(true))


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (-1, 1, 1)])
@pytest.mark.parametrize("name", _ALL)
def test_half_a_turn_about_any_axis_is_solved(name: str, axis: tuple[int, int, int]) -> None:
    """Rotations by 180 deg about any axis are solved.

    The axis may be the boresight. If the axis is normal to the boresight, the rotation reverses the
    boresight.
    """
    q = from_rotation_vector(np.pi * unit(np.array(axis, dtype=float)))
    drawn = np.random.default_rng(63).normal(size=(6, 3)) * [_FIELD, _FIELD, 0.0]
    reference = unit(np.array([0.0, 0.0, 1.0]) + drawn)
    fix = SOLVERS[name](reference @ attitude_matrix(q).T, reference, np.full(6, 1e-5))
    assert angle_between(fix.quaternion, q) < 1e-13


def test_the_default_is_scipys_solution() -> None:
    rng = np.random.default_rng(64)
    for _ in range(50):
        seen = sight(rng, 20, _FIELD, 1e-5)
        rotation, root_loss = Rotation.align_vectors(seen.observed, seen.reference, weights=seen.sigma**-2.0)
        fix = solve(seen.observed, seen.reference, seen.sigma)
        # scipy's quaternion rotates vectors, and this library's quaternion rotates axes, so the conjugate is
        # used.
        assert angle_between(fix.quaternion, conjugate(rotation.as_quat())) < 1e-10
        # scipy computes the loss as a difference of numbers that are 1e11 times larger.
        assert fix.loss == pytest.approx(0.5 * root_loss**2, rel=1e-3)


def test_two_close_stars_give_the_attitude_to_the_accuracy_of_their_directions() -> None:
    """For two close stars, the attitude is as accurate as the directions of the stars.

    The profile matrix B alone gives the rotation about stars 1e-4 rad apart only to 1e-8 rad. A closed form
    is exact.
    """
    rng = np.random.default_rng(65)
    for _ in range(20):
        seen = sight(rng, 2, None, 1e-9)
        tiny = unit(seen.reference[:1] + np.array([np.zeros(3), 1e-4 * unit(rng.normal(size=3))]))
        observed = unit(tiny @ attitude_matrix(seen.quaternion).T)
        for name in OPTIMAL:
            fix = SOLVERS[name](observed, tiny, np.full(2, 1e-5))
            assert angle_between(fix.quaternion, seen.quaternion) < 3e-11


@pytest.mark.parametrize("name", _ALL)
@pytest.mark.parametrize(("n", "half_field"), [(2, _FIELD), (6, None), (20, _FIELD)])
def test_errors_agree_with_the_covariance(name: str, n: int, half_field: float | None) -> None:
    rng = np.random.default_rng([66, n])
    runs, total, losses = 120, 0.0, 0.0
    for _ in range(runs):
        seen = sight(rng, n, half_field, 1e-5)
        # No covariance describes the errors of two stars that are nearly at the same position.
        while _least_eigenvalue(seen) < 1e-5:
            seen = sight(rng, n, half_field, 1e-5)
        fix = _by(name, seen)
        error = _error(fix, seen.quaternion)
        total += float(error @ np.linalg.solve(fix.covariance, error))
        losses += 2.0 * fix.loss
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], 3 * runs)
    assert low < total < high
    if name in OPTIMAL:
        low, high = chi2.ppf([1e-4, 1.0 - 1e-4], (2 * n - 3) * runs)
        assert low < losses < high


@pytest.mark.parametrize("name", ["olae", "triad"])
def test_solvers_that_are_not_optimal_differ_from_the_optimum_as_their_covariances_state(name: str) -> None:
    """The deviations of suboptimal solvers from the optimum agree with the difference of the two covariances.

    An efficient estimate is uncorrelated with its difference from any other estimate, so the variances
    subtract.
    """
    rng = np.random.default_rng(67)
    runs, ratios, worse = 400, [], []
    for _ in range(runs):
        seen = sight(rng, 8, None, 1e-5)
        fix, best = _by(name, seen), _by(DEFAULT, seen)
        excess = fix.covariance - best.covariance
        # The covariances are computed from directions that have errors of 1e-5.
        assert np.linalg.eigvalsh(excess)[0] > -1e-4 * np.trace(best.covariance)
        apart = _error(fix, best.quaternion)
        ratios.append(float(apart @ apart / np.trace(excess)))
        worse.append(np.trace(fix.covariance) / np.trace(best.covariance))
        assert fix.loss >= best.loss * (1.0 - 1e-9)
    # The variance of the squared length is at most twice the square of the mean of the squared length.
    assert np.mean(ratios) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / runs))
    assert np.median(worse) > 1.001


def test_triads_covariance_is_the_optimal_one_when_its_anchor_is_exact() -> None:
    seen = sight(np.random.default_rng(68), 2, None, 1e-5)
    sigma = np.array([1e-7, 1e-4])
    triad = SOLVERS["triad"](seen.observed, seen.reference, sigma)
    best = solve(seen.observed, seen.reference, sigma).covariance
    assert np.allclose(triad.covariance, best, rtol=0.0, atol=1e-5 * np.trace(best))


def test_the_predictive_steps_also_start_from_the_previous_attitude() -> None:
    rng = np.random.default_rng(69)
    for _ in range(20):
        seen = sight(rng, 10, _FIELD, 1e-5)
        before = multiply(from_rotation_vector(0.02 * unit(rng.normal(size=3))), seen.quaternion)
        found = wahba.fix(sightings(seen.observed, seen.reference, seen.sigma), before)
        assert angle_between(found.quaternion, _by(DEFAULT, seen).quaternion) < 1e-12


@pytest.mark.parametrize("name", sorted(OPTIMAL))
def test_directions_that_share_no_attitude_give_the_least_loss_or_none(name: str) -> None:
    rng = np.random.default_rng(70)
    found = 0
    for _ in range(60):
        observed, reference = unit(rng.normal(size=(5, 3))), unit(rng.normal(size=(5, 3)))
        sigma = rng.uniform(0.5, 2.0, 5)
        try:
            fix = SOLVERS[name](observed, reference, sigma)
        except AttitudeError:
            continue
        found += 1
        weights = sigma**-2.0
        vectors = np.linalg.eigh(davenport_matrix(profile_matrix(observed, reference, weights)))[1]
        assert angle_between(fix.quaternion, vectors[:, 3]) < 1e-10
    assert found >= (50 if name == "predictive" else 60)


@pytest.mark.parametrize("name", _ALL)
def test_a_mirrored_field_has_no_attitude(name: str) -> None:
    """A mirrored field has no attitude.

    If all three axes are measured reversed, a rotation by 180 deg about any axis fits equally well.
    """
    axes = np.eye(3)
    if name in OPTIMAL:
        with pytest.raises(AttitudeError):
            SOLVERS[name](-axes, axes, np.full(3, 1e-5))
    else:
        # Some solvers fit a part of the data exactly. The loss of these solvers shows that the other data
        # contradict the attitude.
        try:
            fix = SOLVERS[name](-axes, axes, np.full(3, 1e-5))
        except AttitudeError:
            return
        assert fix.loss > 1e9


@pytest.mark.parametrize("name", _ALL)
def test_directions_that_fix_no_attitude_are_refused(name: str) -> None:
    star, other = unit(np.array([0.1, 0.2, 1.0])), unit(np.array([0.3, 0.0, 1.0]))
    apart = np.array([star, other])
    for line in ([star, star], [star, -star], [star, unit(star + np.array([1e-7, 0.0, 0.0]))], [star]):
        with pytest.raises(AttitudeError, match="on one line"):
            SOLVERS[name](np.array(line), apart[: len(line)], np.full(len(line), 1e-5))
        with pytest.raises(AttitudeError, match="on one line"):
            SOLVERS[name](apart[: len(line)], np.array(line), np.full(len(line), 1e-5))
    with pytest.raises(AttitudeError, match="0 observed"):
        SOLVERS[name](np.empty((0, 3)), np.empty((0, 3)), np.empty(0))


@pytest.mark.parametrize("name", _ALL)
def test_invalid_directions_and_errors_are_refused(name: str) -> None:
    good, sigma = np.eye(3), np.full(3, 1e-5)
    for wrong in (2.0 * good, np.where(good == 1.0, np.nan, good), np.where(good == 1.0, np.inf, good)):
        with pytest.raises(AttitudeError, match="observed directions must be"):
            SOLVERS[name](wrong, good, sigma)
        with pytest.raises(AttitudeError, match="reference directions must be"):
            SOLVERS[name](good, wrong, sigma)
    for bad in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(AttitudeError, match="finite and positive"):
            SOLVERS[name](good, good, np.array([1e-5, bad, 1e-5]))
    with pytest.raises(AttitudeError, match=r"\(n, 3\)"):
        SOLVERS[name](good[:2], good, sigma)
    assert angle_between(SOLVERS[name](good, good, sigma).quaternion, IDENTITY) < 1e-15


_PINHOLE = star_camera().pinhole


def _directions(n: int, seed: int) -> FloatArray:
    return _PINHOLE.unit_vectors(np.random.default_rng(seed).uniform(0.0, 1023.0, (n, 2)))


@given(st.tuples(*[st.floats(-1.0, 1.0)] * 3), st.integers(0, 1000))
def test_noise_free_data_give_the_rotation_exactly(vector: tuple[float, float, float], seed: int) -> None:
    rotation = np.array(vector)
    starts = _directions(5, seed)
    solution = rotation_between(starts, rotate(starts, rotation), np.ones(5))
    np.testing.assert_allclose(solution.rotation_vector, rotation, atol=1e-9)
    np.testing.assert_allclose(solution.residuals, 0.0, atol=1e-9)


def test_the_quaternion_turns_starts_into_ends() -> None:
    starts = _directions(6, 1)
    ends = rotate(starts, np.array([0.02, -0.5, 0.3]))
    matrix = attitude_matrix(rotation_between(starts, ends, np.ones(6)).quaternion)
    np.testing.assert_allclose(starts @ matrix.T, ends, atol=1e-12)


def _wahba(starts: FloatArray, ends: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the rotation matrix that minimises Wahba's loss, by SVD (Markley 1988)."""
    u, _, vt = np.linalg.svd(np.einsum("n,ni,nj->ij", weights, ends, starts))
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt)


def test_the_rotation_agrees_with_an_svd_solution_of_wahbas_problem_far_below_the_noise() -> None:
    rng = np.random.default_rng(2)
    sigma = 0.2 / _PINHOLE.focal_length
    starts = _directions(25, 3)
    ends = rotate(starts, np.array([0.003, 0.02, -0.001]))
    ends = ends + sigma * rng.normal(size=ends.shape)
    ends = ends / np.linalg.norm(ends, axis=-1, keepdims=True)
    weights = rng.uniform(0.2, 1.0, 25)
    found = attitude_matrix(rotation_between(starts, ends, weights).quaternion)
    difference = found @ _wahba(starts, ends, weights).T
    # The losses of the two solvers differ only by products of the noise and the rotation of 0.02 rad.
    skew = 0.5 * np.array([difference[2, 1], difference[0, 2], difference[1, 0]])
    assert np.linalg.norm(skew) < 0.05 * sigma


def test_the_gain_is_the_derivative_of_the_rotation_vector() -> None:
    starts = _directions(7, 4)
    rotation = np.array([0.1, 0.4, -0.2])
    ends = rotate(starts, rotation)
    weights = np.linspace(0.5, 1.5, 7)
    solution = rotation_between(starts, ends, weights)
    # Opposite errors of b and r change the difference d = b - r, but not the sum.
    error = 1e-6 * np.array([0.3, -0.5, 0.2])
    moved_starts, moved_ends = starts.copy(), ends.copy()
    moved_starts[2] -= 0.5 * error
    moved_ends[2] += 0.5 * error
    change = rotation_between(moved_starts, moved_ends, weights).rotation_vector - solution.rotation_vector
    np.testing.assert_allclose(change, gain(solution, weights)[2] @ error, atol=1e-11)


def test_parallel_directions_fix_no_rotation() -> None:
    v = np.tile([0.0, 0.0, 1.0], (4, 1))
    with pytest.raises(np.linalg.LinAlgError):
        rotation_between(v, v, np.ones(4))


def test_the_sign_is_that_of_stars_moving_with_minus_omega_cross_v() -> None:
    omega = np.array([0.0, 0.01, 0.0])
    v = np.array([[0.0, 0.0, 1.0], [0.1, 0.0, 0.995]])
    v = v / np.linalg.norm(v, axis=-1, keepdims=True)
    solution = rotation_between(v, v - np.cross(omega, v), np.ones(2))
    np.testing.assert_allclose(solution.rotation_vector, omega, atol=1e-5)
    np.testing.assert_allclose(to_rotation_vector(from_rotation_vector(omega)), omega)
