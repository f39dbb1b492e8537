"""Tests that a free satellite's filter is consistent, estimates the dipole and uses late attitudes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.disturbance import Pressures
from knightcube.astro.quaternion import (
    IDENTITY,
    angle_between,
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    to_rotation_vector,
)
from knightcube.errors import ArgumentError
from knightcube.gnc.estimation.estimate import Knowledge
from knightcube.gnc.estimation.free_filter import (
    ATTITUDE,
    COILS,
    DIPOLE,
    GYRO,
    MAGNET,
    RATE,
    STATES,
    SUN_CAMERA,
    FilterEnvironment,
    FreeFilter,
    FreeFilterSettings,
)
from knightcube.gnc.estimation.free_filter import INERTIA as INERTIA_ERROR
from knightcube.gnc.estimation.rigid_body import BodyErrors, per_trace
from tests.knightcube.gnc.estimation.filter_states import NO_ERRORS

INERTIA = np.diag([0.0066, 0.0333, 0.0333])
STAR, GYRO_SIGMA = 5e-5, 5e-5
RESIDUAL, BIAS = np.array([6e-4, -3e-4, 4e-4]), np.array([4e-4, -5e-4, 3e-4])
EXACT = FreeFilterSettings(errors=NO_ERRORS)
POSITION = np.array([6.878e6, 0.0, 0.0])


def around(time: float) -> FilterEnvironment:
    """Return a field that makes two rotations in 95 min, without air, sunlight and gravity gradient."""
    turned = attitude_matrix(from_rotation_vector(np.array([0.0, 2.2e-3 * time, 0.0])))
    nothing = Pressures(np.zeros((1, 3)), np.zeros((1, 3)))
    return FilterEnvironment(turned.T @ np.array([1e-5, 2e-5, 3e-5]), 1e3 * POSITION, nothing, 0.0)


def fly(
    seconds: int, seed: int, age: float = 0.0, settings: FreeFilterSettings | None = None
) -> tuple[FreeFilter, FloatArray, FloatArray]:
    """Return filter, true attitude and true rate after `seconds` without control, with stars every 10 s."""
    rng = np.random.default_rng(seed)
    found = FreeFilter(INERTIA, settings or FreeFilterSettings())
    q, w = IDENTITY, np.array([1e-3, -5e-4, 8e-4])
    attitudes = [q]
    start = multiply(from_rotation_vector(STAR * rng.standard_normal(3)), q)
    found.start(start, STAR**2 * np.eye(3), w + BIAS + GYRO_SIGMA * rng.standard_normal(3), by_stars=True)
    for second in range(1, seconds + 1):
        here = around(second - 0.5)
        torque = np.cross(RESIDUAL, attitude_matrix(q) @ here.field) - np.cross(w, INERTIA @ w)
        q = multiply(from_rotation_vector(w + 0.5 * np.linalg.solve(INERTIA, torque)), q)
        w = w + np.linalg.solve(INERTIA, torque)
        attitudes.append(q)
        found.advance(1.0, np.zeros(3), here)
        found.gyro(w + BIAS + GYRO_SIGMA * rng.standard_normal(3), GYRO_SIGMA**2 * np.eye(3))
        if second % 10 == 0:
            seen = attitudes[second - round(age)]
            error = from_rotation_vector(STAR * rng.standard_normal(3))
            found.attitude(multiply(error, seen), STAR**2 * np.eye(3), age)
    return found, q, w


def errors(found: FreeFilter, q: FloatArray, w: FloatArray) -> FloatArray:
    """Return the errors (9,) of attitude, rate and gyro bias."""
    turn = to_rotation_vector(multiply(q, conjugate(found.quaternion)))
    return np.concatenate([turn, w - found.rate, BIAS - found.gyro_bias])


def test_the_claim_is_honest_over_independent_flights() -> None:
    nees = []
    for seed in range(4):
        found, q, w = fly(120, seed, settings=EXACT)
        error = errors(found, q, w)
        nees.append(float(error @ np.linalg.solve(found.covariance[:9, :9], error)))
        assert found.refused == 0
    assert 3.0 < np.mean(nees) < 16.0, "nine errors, four flights: 99.9 % of a chi-square of 36 over 4"


def test_the_residual_dipole_is_estimated_within_its_uncertainty() -> None:
    found, _, _ = fly(400, 1)
    missing = found.residual_dipole(0.0) - RESIDUAL
    sigma = np.sqrt(np.diag(found.covariance)[DIPOLE])
    assert np.linalg.norm(missing) < 0.3 * np.linalg.norm(RESIDUAL)
    assert np.all(np.abs(missing) < 4.0 * sigma)


def test_late_attitudes_give_nearly_the_accuracy_of_timely_ones() -> None:
    timely, late = (fly(120, 3, age) for age in (0.0, 3.0))
    assert late[0].refused == 0
    assert angle_between(late[0].quaternion, late[1]) < 4.0 * STAR
    sigmas = [np.sqrt(np.diag(found.covariance)[ATTITUDE]).max() for found, _, _ in (timely, late)]
    assert sigmas[1] == pytest.approx(sigmas[0], rel=0.2)


@pytest.mark.parametrize("axis", [1, 2])
def test_an_unknown_dipole_turns_a_body_of_another_inertia_within_the_claim(axis: int) -> None:
    """Torques are perpendicular to the field, but the accelerations depend on the true inertia."""
    turned = attitude_matrix(from_rotation_vector(np.array([0.05, -0.06, 0.07])))
    inertia, dipole = turned @ INERTIA @ turned.T, 5.0 * np.eye(3)[axis]
    found, rng = FreeFilter(INERTIA, FreeFilterSettings()), np.random.default_rng(4)
    q, w = IDENTITY, np.zeros(3)
    found.start(q, STAR**2 * np.eye(3), BIAS, by_stars=True)
    for _ in range(5):  # the gyro and the stars determine the rate
        found.advance(1.0, np.zeros(3), around(0.0))
        found.gyro(BIAS + GYRO_SIGMA * rng.standard_normal(3), GYRO_SIGMA**2 * np.eye(3))
        found.attitude(q, STAR**2 * np.eye(3))
    for _ in range(60):
        torque = np.cross(dipole, attitude_matrix(q) @ around(0.0).field) - np.cross(w, inertia @ w)
        w = w + 0.05 * np.linalg.solve(inertia, torque)
        q = multiply(from_rotation_vector(0.05 * w), q)
        found.advance(0.05, np.zeros(3), around(0.0), float(np.abs(dipole).max()))
    error = to_rotation_vector(multiply(q, conjugate(found.quaternion)))
    claim = found.covariance[ATTITUDE, ATTITUDE]
    assert error @ np.linalg.solve(claim, error) < 16.3, "99.9 % of a chi-square of 3"


def test_sun_and_nadir_by_differently_misaligned_cameras_give_an_honest_attitude() -> None:
    """The Sun camera is misaligned by 0.1 deg, the nadir cameras are not. Sun and nadir are 20 deg apart.

    The misalignment causes an error of 0.1 deg / sin 20 deg = 0.29 deg about nadir. If another camera
    measures the Sun, the misalignment is unknown again.
    """
    settings = FreeFilterSettings()
    found = FreeFilter(INERTIA, settings)
    found.start(IDENTITY, np.radians(1.0) ** 2 * np.eye(3), np.zeros(3))
    down, noise = np.array([0.0, 0.0, 1.0]), np.radians(0.02) ** 2 * np.eye(3)
    sun = np.array([np.sin(np.radians(20.0)), 0.0, np.cos(np.radians(20.0))])
    misaligned = attitude_matrix(from_rotation_vector(np.radians([0.1, 0.0, 0.0]))) @ sun
    for _ in range(20):
        assert found.direction(misaligned, sun, noise, 0b1000)
        assert found.direction(down, down, noise)
    error = to_rotation_vector(found.quaternion)
    sigma = np.sqrt(found.covariance.diagonal())
    assert np.degrees(abs(error[2])) > 0.1
    assert np.all(np.abs(error) < 3.0 * sigma[ATTITUDE])
    assert sigma[SUN_CAMERA].min() < 0.9 * sigma[SUN_CAMERA].max()
    found.direction(sun, sun, 1e6 * noise, 0b0001)
    fresh = np.sqrt(found.covariance.diagonal())[SUN_CAMERA]
    np.testing.assert_allclose(fresh, settings.errors.horizon / np.sqrt(3.0), rtol=1e-3)


def test_two_directions_make_a_coarse_attitude_fine_and_a_false_one_is_refused() -> None:
    found = FreeFilter(INERTIA, FreeFilterSettings())
    assert found.knowledge.value == "lost"
    true = from_rotation_vector(np.array([0.3, -0.2, 0.5]))
    sigma = np.radians(2.0)
    found.start(
        multiply(from_rotation_vector(0.5 * sigma * np.ones(3)), true), sigma**2 * np.eye(3), np.zeros(3)
    )
    assert found.knowledge is Knowledge.COARSE
    precise = 1e-4**2 * np.eye(3)
    for reference in np.eye(3)[:2]:
        # The update is repeated, because the first update is linearised at an error of one degree.
        for _ in range(2):
            assert found.direction(attitude_matrix(true) @ reference, reference, precise)
    assert found.knowledge.value == "fine"
    assert angle_between(found.quaternion, true) < 2e-3
    before = found.quaternion
    assert not found.direction(np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0]), precise)
    assert not found.attitude(np.full(4, np.nan), precise)
    np.testing.assert_array_equal(found.quaternion, before)


def test_the_stars_separate_the_magnetometer_s_bias_from_the_attitude() -> None:
    found, q, _ = fly(60, 5, settings=EXACT)
    bias = np.array([2e-7, -1e-7, 3e-7])
    here = around(60.0)
    for _ in range(20):
        found.field(attitude_matrix(q) @ here.field + bias, here.field, 1e-8**2 * np.eye(3))
    np.testing.assert_allclose(found._constants[MAGNET], bias, atol=2e-8)


def test_a_new_start_keeps_the_estimates_of_the_slow_states() -> None:
    found, q, w = fly(120, 2)
    dipole, sigma = found.residual_dipole(0.0), np.diag(found.covariance)[DIPOLE]
    found.start(q, STAR**2 * np.eye(3), w + BIAS)
    np.testing.assert_array_equal(found.residual_dipole(0.0), dipole)
    np.testing.assert_array_equal(np.diag(found.covariance)[DIPOLE], sigma)
    assert np.all(found.covariance[RATE, GYRO].diagonal() < 0.0)
    assert np.linalg.eigvalsh(found.covariance)[0] > -1e-18 * STATES
    assert np.linalg.norm(found.rate - w) < 1e-4


def test_the_jacobian_of_the_ratios_is_the_derivative_of_the_ratios() -> None:
    rng = np.random.default_rng(11)
    whole = np.concatenate([[0.10, 0.42, 0.46, 0.02, -0.01, 0.03], np.eye(3).ravel()])
    whole += 0.02 * rng.standard_normal(15)

    def ratios(values: FloatArray) -> FloatArray:
        return np.asarray(values / values[:3].sum())

    step = 1e-6
    found = [(ratios(whole + step * e) - ratios(whole - step * e)) / (2.0 * step) for e in np.eye(15)]
    np.testing.assert_allclose(per_trace(whole[:6], whole[6:]), np.transpose(found), atol=1e-8)


def test_the_ratios_are_known_better_than_the_inertia_when_only_the_scale_is_uncertain() -> None:
    found = FreeFilter(INERTIA, FreeFilterSettings())
    found.covariance[:] = 0.0
    scale = np.concatenate([INERTIA[np.diag_indices(3)] / np.trace(INERTIA), np.zeros(3), np.eye(3).ravel()])
    body = slice(INERTIA_ERROR.start, COILS.stop)
    found.covariance[body, body] = 0.03**2 * np.outer(scale, scale)
    made = found.description()
    assert made["inertia_sigma"].max() > 0.02 * 0.0333
    np.testing.assert_allclose(made["inertia_ratio_sigma"], 0.0, atol=1e-7)
    np.testing.assert_allclose(made["coils_ratio_sigma"], 0.0, atol=1e-7)


def test_a_corrected_coil_is_a_new_coil_and_the_other_coils_keep_what_was_learned() -> None:
    found = FreeFilter(INERTIA, FreeFilterSettings())
    prior = found.layout.prior.copy()
    found.covariance[:] = 0.25 * prior + 1e-9
    found._constants[COILS] = np.arange(1.0, 10.0)
    then = found.memory()
    found.renew_coil(np.eye(3)[1], np.eye(3)[1], 0.3, [then])
    column = np.arange(COILS.start + 1, COILS.stop, 3)
    others = np.setdiff1d(np.arange(STATES), column)
    for constants, covariance in ((found._constants, found.covariance), (then.constants, then.covariance)):
        assert constants[COILS].tolist() == [1.0, 0.0, 3.0, 4.0, 0.0, 6.0, 7.0, 0.0, 9.0]
        expected = prior[column, column]
        expected[1] = 0.3**2
        assert covariance[column, column] == pytest.approx(expected)
        assert not covariance[np.ix_(column, others)].any()
        assert not covariance[np.ix_(others, column)].any()
        kept = (0.25 * prior + 1e-9)[np.ix_(others, others)]
        assert covariance[np.ix_(others, others)] == pytest.approx(kept)
    assert (found.coil_matrix[:, 1] == [0.0, 1.0, 0.0]).all()


def test_the_error_of_a_tilted_coil_is_reset_and_that_of_the_others_is_kept() -> None:
    rng = np.random.default_rng(2)
    coils = np.array([[1.0, 0.6, 0.0], [0.0, 0.8, 0.6], [0.0, 0.0, 0.8]])  # unit vectors as columns
    found = FreeFilter(INERTIA, FreeFilterSettings())
    found._constants[COILS] = 0.1 * rng.standard_normal(9)
    matrix, prior = found.coil_matrix - np.eye(3), found.layout.prior[COILS, COILS]
    found.covariance[COILS, COILS] = 0.01 * prior
    dual = np.linalg.inv(coils)[1]
    found.renew_coil(coils[:, 1], dual, 0.0)
    after = found.coil_matrix - np.eye(3)
    assert after @ coils[:, 1] == pytest.approx(np.zeros(3), abs=1e-12)
    assert after @ coils[:, [0, 2]] == pytest.approx(matrix @ coils[:, [0, 2]])
    for coil, scale in ((0, 0.01), (1, 1.0), (2, 0.01)):
        along = np.kron(np.eye(3), coils[:, coil])
        spread = along @ found.covariance[COILS, COILS] @ along.T
        assert spread == pytest.approx(scale * along @ prior @ along.T)


def test_redundant_coils_start_again_with_the_covariance_of_their_new_allocation() -> None:
    found = FreeFilter(INERTIA, FreeFilterSettings())
    prior = found.layout.prior.copy()
    found.covariance[:] = 0.25 * prior + 1e-9
    found._constants[COILS] = np.arange(1.0, 10.0)
    then, changes = found.memory(), found.changes
    fresh = np.diag(np.arange(1.0, 10.0)) + 0.1
    found.renew(COILS, fresh, [then])
    others = np.r_[0 : COILS.start, COILS.stop : STATES]
    for constants, covariance in ((found._constants, found.covariance), (then.constants, then.covariance)):
        assert not constants[COILS].any()
        assert covariance[COILS, COILS].tolist() == fresh.tolist()
        assert not covariance[COILS, others].any()
        assert not covariance[others, COILS].any()
        assert covariance[np.ix_(others, others)] == pytest.approx(
            (0.25 * prior + 1e-9)[np.ix_(others, others)]
        )
    assert found.changes == changes + 1
    known = FreeFilter(INERTIA, EXACT)
    known.renew(COILS, fresh)
    assert not known.covariance[COILS, COILS].any(), "coils that are known exactly stay known"


def test_a_coil_that_is_known_exactly_stays_known() -> None:
    found = FreeFilter(INERTIA, EXACT)
    found.renew_coil(np.eye(3)[0], np.eye(3)[0], 0.3)
    assert not found.covariance[COILS, COILS].any()


@pytest.mark.parametrize("inertia", [np.diag([0.21, 0.19, 0.004]), np.diag([1.0, -1.0, 1.0]), np.eye(2)])
def test_an_impossible_inertia_is_refused(inertia: FloatArray) -> None:
    with pytest.raises(ArgumentError, match="inertia"):
        FreeFilter(inertia, FreeFilterSettings())


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("gyro", (-1e-3, 0.0), "gyro: .*give two finite numbers of 0 or more"),
        ("gyro", 1e-3, r"gyro: 0\.001: give two finite numbers"),
        ("field", math.nan, "field: nan: give a finite number"),
        ("gate_sigma", 0.0, "gate_sigma: 0.0: give a finite number above zero"),
        ("gate_sigma", math.nan, "gate_sigma: nan"),
        ("coils", np.eye(3), r"coils: an array of shape \(3, 3\)"),
        ("errors", None, "errors: None: give an object of the class BodyErrors"),
    ],
)
def test_settings_out_of_their_range_are_refused_by_name(name: str, value: object, words: str) -> None:
    with pytest.raises(ArgumentError, match=words):
        FreeFilterSettings(**{name: value})  # type: ignore[arg-type]


def test_errors_of_a_body_that_are_negative_are_refused() -> None:
    with pytest.raises(ArgumentError, match=r"moments: -0.1"):
        BodyErrors(moments=-0.1)


def test_measurements_of_another_shape_or_length_are_refused_and_change_nothing() -> None:
    """Without the check, numpy would broadcast a scalar or a row, as if the errors were correlated."""
    found, _, _ = fly(3, 1)
    before, still, down = found.covariance.copy(), np.zeros(3), np.array([0.0, 0.0, 1.0])
    for wrong in (np.array(1e-8), 1e-8 * np.ones(3)):
        with pytest.raises(ArgumentError, match="covariance: an array of shape"):
            found.gyro(still, wrong)
        with pytest.raises(ArgumentError, match="covariance: an array of shape"):
            found.mean_rate(still, wrong, still)
        with pytest.raises(ArgumentError, match="covariance: an array of shape"):
            found.attitude(IDENTITY, wrong)
        with pytest.raises(ArgumentError, match="covariance: an array of shape"):
            found.direction(down, down, wrong)
        with pytest.raises(ArgumentError, match="covariance: an array of shape"):
            found.field(1e-5 * down, 1e-5 * down, wrong)
    with pytest.raises(ArgumentError, match="rate: an array of shape"):
        found.gyro(np.zeros(1), np.eye(3))
    with pytest.raises(ArgumentError, match="quaternion of length 1"):
        found.attitude(np.zeros(4), np.eye(3))
    with pytest.raises(ArgumentError, match=r"observed: .*vector of length 1"):
        found.direction(np.zeros(3), down, np.eye(3))
    with pytest.raises(ArgumentError, match="quaternion of length 1"):
        found.start(np.zeros(4), np.eye(3), still)
    with pytest.raises(ArgumentError, match=r"quaternion: .*finite"):
        found.start(np.nan * IDENTITY, np.eye(3), still)
    with pytest.raises(ArgumentError, match="seconds"):
        found.advance(-1.0, still, around(0.0))
    with pytest.raises(ArgumentError, match="dipole"):
        found.advance(1.0, np.nan * down, around(0.0))
    np.testing.assert_array_equal(found.covariance, before)


def test_quaternions_and_directions_of_nearly_unit_length_are_normalised() -> None:
    down, along, still = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.1, 0.995]), np.zeros(3)
    found = []
    for length in (1.0, 1.05):
        one = FreeFilter(INERTIA, FreeFilterSettings())
        one.start(length * IDENTITY, 1e-2 * np.eye(3), still)
        assert math.hypot(*one.quaternion) == pytest.approx(1.0, abs=1e-12)
        assert one.direction(length * down, length * along / math.hypot(*along), 1e-2 * np.eye(3))
        assert one.attitude(length * IDENTITY, 1e-2 * np.eye(3))
        found.append(one)
    np.testing.assert_allclose(found[1].quaternion, found[0].quaternion, atol=1e-12)
